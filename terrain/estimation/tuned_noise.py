"""Process noise of a filter from runs, by likelihood."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from terrain.errors import DataError
from terrain.estimation.estimate import model_and_noise
from terrain.estimation.filter import Noise
from terrain.estimation.filters.tuning import NoiseGroup, TuningStatus, tune_noise
from terrain.estimation.table import measurement_table
from terrain.extension import corrected, corrected_log
from terrain.records import RunLog
from terrain.robots import Robot, packaged_robot

MAX_RUNS = 3
"""Number of runs to tune on unless they are named: the likelihood of each is evaluated a hundred times."""

MAX_EVALUATIONS = 200

GROUPS = ("speed", "yaw_rate", "accel", "steer", "slip", "effective_track", "gyro_bias")
"""States are tuned together whose names begin alike.

Measurement noise stays: behind the common low-pass an error lasts longer than a sample, and a likelihood that
takes each for independent would drive the variances of the sensors to zero."""


@dataclass(frozen=True, slots=True)
class TunedNoise:
    """Result of a tuning.

    Parameters
    ----------
    runs : ids of the runs tuned on
    log_likelihood_before, log_likelihood_after : summed over them
    scales : of the variances, by group
    status : of each scale, by group
    """

    runs: tuple[str, ...]
    log_likelihood_before: float
    log_likelihood_after: float
    scales: Mapping[str, float]
    status: Mapping[str, TuningStatus]


def tuning_runs(runs: Sequence[RunLog], names: Sequence[str] | None) -> list[RunLog]:
    """Return the runs named, or the first few.

    Raises
    ------
    DataError
        if none is named, or there is no run of a name.
    """
    if names is None:
        return list(runs[:MAX_RUNS])
    if not names:
        raise DataError("no run to tune on is named")
    known = {run.run_id: run for run in runs}
    for name in names:
        if name not in known:
            raise DataError(f"there is no run {name!r} to tune on; there are {', '.join(known)}")
    return [known[name] for name in names]


def tuned_noise(
    runs: Sequence[RunLog], robot: Robot | None, name: str, names: Sequence[str] | None = None
) -> tuple[Noise, TunedNoise]:
    """Return noise under which the runs are most likely, and what became of each group.

    Parameters
    ----------
    runs : logs, as measured
    robot : whose they are; by default the one that the first names
    name : of the filter
    names : of the runs to tune on; the first few by default

    Raises
    ------
    DataError
        if there is no run of a name.
    """
    chosen = tuning_runs(runs, names)
    robot = robot or packaged_robot(chosen[0].robot)
    runs, robot = [corrected_log(run, robot) for run in chosen], corrected(robot)
    model, noise = model_and_noise(runs[0], robot, name)
    tables = []
    for run in runs:
        table = measurement_table(run, robot)
        tables.append((table.time_s, table.columns(model.rows)))
    grouped = [
        NoiseGroup(name, tuple(state for state in model.states if state.startswith(name))) for name in GROUPS
    ]
    found, report = tune_noise(
        model, tables, noise, [group for group in grouped if group.states], MAX_EVALUATIONS
    )
    return found, TunedNoise(
        runs=tuple(run.run_id for run in runs),
        log_likelihood_before=report.log_likelihood_before,
        log_likelihood_after=report.log_likelihood_after,
        scales={group.name: group.scale for group in report.groups},
        status={group.name: group.status for group in report.groups},
    )
