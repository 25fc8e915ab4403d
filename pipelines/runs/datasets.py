"""Data sets: every readable layout becomes a list of run logs, and a digest that names their content."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from terrain.errors import ConfigError, LogError
from terrain.records import Array, RunLog

LAYOUTS = ("auto", "runs", "borealtc", "csv", "drive")
"""``runs``: run folders as this package writes them; ``csv``: any CSV, by a mapping file; ``drive``: the
file ``samples.csv.gz`` of the Husky log of DRIVE."""

ACCEPTED = (
    "accepted are run folders (run.json), the BorealTC layout (<CLASS>/imu_N.csv and pro_N.csv), "
    "the DRIVE layout (samples.csv.gz), and any CSV with a mapping file"
)

_log = logging.getLogger(__name__)


def load_runs(
    folder: str | Path,
    *,
    layout: str = "auto",
    mapping: str | Path | None = None,
    repair: bool = False,
    align: bool = False,
    on_skip: Callable[[str], None] = _log.warning,
) -> list[RunLog]:
    """Return the runs that lie under a folder, sorted by their id.

    Parameters
    ----------
    folder : a run folder, a folder of run folders, a folder in the BorealTC or the DRIVE layout, or the
        folder that the files of ``mapping`` are found under
    layout : one of ``LAYOUTS``; ``auto`` looks
    mapping : YAML file that describes how to read CSV files (``terrain.logs.mapping``)
    repair : drop and count what a strict read refuses, and skip runs that cannot be read at all
    align : bring the wheel stream onto the clock of the IMU where the two clocks can be compared
    on_skip : called with a sentence for each run that is skipped when repairing; logs a warning by default

    Raises
    ------
    LogError
        if nothing readable is there, a run cannot be read, or two runs have one id.
    ConfigError
        if the layout is unknown, the mapping is not accepted, or a robot is unknown (to align, or to turn
        motor rates into wheel speeds).
    DataError
        if a run that is to be aligned has no gyro or no wheel speeds.
    """
    folder = Path(folder)
    runs = []
    skipped: list[str] = []
    places: dict[str, list[str]] = {}
    for read in _readers(folder, layout, mapping):
        try:
            run = read(repair=repair)
        except LogError as error:
            if not repair:
                raise
            on_skip(f"run skipped: {error}")
            skipped.append(str(error))
            continue
        runs.append(run)
        places.setdefault(run.run_id, []).append(_place(read, run))
    if not runs:
        raise LogError(f"{folder}: not one run could be read, the first for this: {skipped[0]}")
    for run_id, found in places.items():
        if len(found) > 1:
            raise LogError(f"{folder}: {len(found)} runs have the id {run_id!r} ({' and '.join(found)})")
    runs = sorted(map(_with_wheel_speeds, runs), key=lambda run: run.run_id)
    return [_aligned(run) for run in runs] if align else runs


def data_digest(runs: Sequence[RunLog]) -> str:
    """Return a SHA-256 over the content of the runs, in hexadecimal.

    It covers ids, robots, labels, channels, times and values, and neither order nor source nor layout on
    disk: a data set read from CSV and from the run folders it was imported into has one digest.

    Examples
    --------
    >>> data_digest([])[:8]
    'e3b0c442'
    """
    digest = hashlib.sha256()
    for run in sorted(runs, key=lambda run: run.run_id):
        orders = {name: np.argsort(stream.channels) for name, stream in sorted(run.streams.items())}
        head = {
            "run_id": run.run_id,
            "robot": run.robot,
            "labels": [list(label) for label in run.labels],
            "streams": {
                name: [len(run.streams[name]), [run.streams[name].channels[i] for i in order]]
                for name, order in orders.items()
            },
        }
        digest.update(json.dumps(head, sort_keys=True).encode())
        for name, order in orders.items():
            digest.update(_canonical_bytes(run.streams[name].time_s))
            digest.update(_canonical_bytes(run.streams[name].values[:, order]))
    return digest.hexdigest()


def _canonical_bytes(array: Array) -> bytes:
    """Return little-endian doubles with one form of NaN and one of zero."""
    return (np.where(np.isnan(array), np.nan, array) + 0.0).astype("<f8").tobytes()


def _place(read: Callable[..., RunLog], run: RunLog) -> str:
    """Return where a run was found: its run folder, else what the reader calls its source."""
    first = getattr(read, "args", (None,))[0]
    return str(first) if isinstance(first, Path) and (first / "run.json").is_file() else run.source


def _readers(folder: Path, layout: str, mapping: str | Path | None) -> list[Callable[..., RunLog]]:
    if layout not in LAYOUTS:
        raise ConfigError(f"layout {layout!r} is unknown: choose one of {', '.join(LAYOUTS)}")
    if not folder.is_dir():
        fault = "is no folder" if folder.exists() else "does not exist"
        raise LogError(f"{folder}: {fault}; {ACCEPTED}")
    if (mapping is not None) and layout in ("runs", "borealtc", "drive"):
        raise ConfigError(f"a mapping file is for CSV files, not for the layout {layout!r}")
    if mapping is not None or layout == "csv":
        if mapping is None:
            raise ConfigError("the layout 'csv' needs a mapping file")
        from terrain.logs import mapping as by_mapping

        return by_mapping.find_runs(folder, by_mapping.load_mapping(mapping))
    if layout in ("auto", "runs"):
        from terrain.logs import read

        readers = read.find_runs(folder)
        if readers or layout == "runs":
            return _some(readers, folder)
    if layout in ("auto", "borealtc"):
        from terrain.logs import borealtc

        readers = borealtc.find_runs(folder)
        if readers or layout == "borealtc":
            return _some(readers, folder)
    from terrain.logs import drive

    return _some(drive.find_runs(folder), folder)


def _some(readers: list[Callable[..., RunLog]], folder: Path) -> list[Callable[..., RunLog]]:
    if not readers:
        raise LogError(f"{folder}: holds no run; {ACCEPTED}")
    return readers


def _with_wheel_speeds(run: RunLog) -> RunLog:
    """Add wheel speeds where a log has motor rates, so that windows know how fast the robot drove."""
    wheels = run.streams.get("wheels")
    if wheels is None or not any(channel.startswith("motor_") for channel in wheels.channels):
        return run
    from terrain.kinematics.wheel_speed import with_wheel_speeds
    from terrain.robots import load_robot

    return with_wheel_speeds(run, load_robot(run.robot))


def _aligned(run: RunLog) -> RunLog:
    from terrain.logs.align import align
    from terrain.logs.clock import estimate_clock
    from terrain.robots import load_robot

    return align(run, estimate_clock(run, track_m=load_robot(run.robot).track_m))
