"""``terrain inspect``: rates, lengths, gaps, stuck channels, plausibility, and the clocks of the loggers."""

from __future__ import annotations

from pipelines.runs.breaks import odd_stretches
from pipelines.runs.datasets import data_digest, robot_of
from pipelines.runs.results import InspectedRun, Inspection
from pipelines.runs.settings import RunsSettings, load
from pipelines.runs.verdicts import verdict
from terrain.errors import ConfigError, DataError
from terrain.logs.clock import estimate_clock
from terrain.logs.duplicates import shared_stretches
from terrain.logs.quality import stream_quality
from terrain.records import RunLog
from terrain.robots import Robot, load_robot


def inspect_logs(settings: RunsSettings) -> Inspection:
    """Return the quality of the runs under a folder.

    Raises
    ------
    LogError
        if a run cannot be read.
    """
    runs, skipped = load(settings)
    given = getattr(settings, "robot", None)
    robot = None if given is None else load_robot(given)
    inspected = tuple(_inspected(run, robot) for run in runs)
    return Inspection(len(runs), data_digest(runs), tuple(skipped), inspected, shared_stretches(runs))


def _inspected(run: RunLog, robot: Robot | None) -> InspectedRun:
    try:
        clock = estimate_clock(run, track_m=robot_of(run, robot).track_m)
    except (ConfigError, DataError):
        clock = None
    streams = {name: stream_quality(stream) for name, stream in run.streams.items()}
    odd = odd_stretches(run)
    checks = verdict(run, robot)
    return InspectedRun(run.run_id, run.terrains, dict(run.dropped), streams, clock, odd, checks)
