"""Channels and rates of runs, found without holding a run longer than it takes to look at it."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from pipelines.data.datasets import RunLoader
from terrain.errors import LogError
from terrain.logs.log_files import check_log_file
from terrain.logs.parquet_file import read_parquet
from terrain.logs.read import read_run_head
from terrain.records import RunLog, Stream


class Head(NamedTuple):
    """Id, robot, and per stream channels and sample period (s) of a run; ``fault`` where it was skipped."""

    run_id: str
    robot: str
    streams: tuple[tuple[str, tuple[str, ...], float], ...]
    fault: str | None = None

    def sketch(self) -> RunLog:
        """Return a run of two samples a stream that has these channels and rates, and nothing else."""
        return RunLog(self.run_id, self.robot, {name: _pair(c, p) for name, c, p in self.streams})


@lru_cache(maxsize=1024)
def _pair(channels: tuple[str, ...], period_s: float) -> Stream:
    time_s = np.array([0.0, period_s]) if np.isfinite(period_s) else np.zeros(1)
    return Stream(time_s, np.zeros((len(time_s), len(channels))), channels)


def head_of(load: RunLoader) -> Head:
    """Return the head of a run; of a plain run folder only ``run.json`` and the times are read.

    Raises
    ------
    LogError
        if the run cannot be read, and is not to be skipped.
    """
    try:
        return _light_head(load) or _head(load())
    except LogError as error:
        if not load.repair:
            raise
        return Head("", "", (), str(error))


def _light_head(load: RunLoader) -> Head | None:
    """Return the head of a run folder by its times; None where the whole run has to be looked at."""
    folder = load.plain_folder
    if folder is None:
        return None
    head = read_run_head(folder)
    streams = []
    try:
        for name, entry in head.document["streams"].items():
            channels = tuple(entry["channels"])
            if any(channel.startswith("motor_") for channel in channels):
                return None  # it gets wheel speeds when it is loaded
            (time_s,) = read_parquet(check_log_file(folder / entry["file"], folder), ["time_s"])
            period_s = _period_s(time_s)
            if not period_s > 0:
                return None
            streams.append((name, channels, period_s))
        return Head(head.run_id, str(head.document["robot"]), tuple(streams)) if streams else None
    except (KeyError, TypeError, AttributeError):
        return None  # loading it states what is wrong


def _head(run: RunLog) -> Head:
    streams = ((name, stream.channels, _period_s(stream.time_s)) for name, stream in run.streams.items())
    return Head(run.run_id, run.robot, tuple(streams))


def _period_s(time_s: np.ndarray) -> float:
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else float("nan")
