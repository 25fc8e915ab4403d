"""What an extension gains for the robot's filter, against the truth of runs that have one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.discrepancy.simulation import Simulation
from terrain.errors import TerrainError
from terrain.estimation.estimate import Estimate, estimate_run
from terrain.estimation.summary import summarize
from terrain.records import Array, RunLog
from terrain.robots import Robot

FILTERS = {"swerve": "vio12", "skid_steer": "skid", "tracked": "skid"}
"""By kind of drive, the filter whose errors are compared."""

ERRORS = ("speed_mps", "yaw_rate_radps", "slip_ratio")
"""Errors that are compared: root mean squares of speed and yaw rate, and the error of the mean slip."""

N_BOOTSTRAP = 2000


class Change(NamedTuple):
    """A figure before and after an extension, and the 95 % interval of its change (None for one run)."""

    before: float
    after: float
    change_ci: tuple[float, float] | None


class Comparison(NamedTuple):
    """What an extension changes for a filter or a classifier on held-out runs.

    Parameters
    ----------
    name : of the filter or the recipe
    reason : why there are no errors; None where there are
    n_runs : that were compared
    errors : by figure
    terrains : of the runs; None where they do not matter
    """

    name: str
    reason: str | None
    n_runs: int
    errors: Mapping[str, Change]
    terrains: tuple[str, ...] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as JSON has it."""
        shown = self._asdict()
        if self.terrains is None:
            del shown["terrains"]
        return shown


def filter_gain(runs: Sequence[RunLog], robot: Robot, extended: Simulation, seed: int) -> Comparison | None:
    """Return the errors of the robot's filter before and after, on runs with a truth; None without any.

    Errors are means over runs; the interval is that of the difference, by bootstrap over runs.
    """
    name = FILTERS.get(robot.drive)
    known = [run for run in runs if "truth" in run.streams]
    if name is None or not known:
        return None
    better = replace(robot, effects=dict(extended.effects), effects_cov=np.empty((0, 0)))
    rows: list[list[tuple[float, ...]]] = []
    try:
        for run in known:
            rows.append([_errors(estimate_run(run, one, name)) for one in (robot, better)])
    except TerrainError as error:
        return Comparison(name, str(error), len(known), {})
    table = np.array(rows)  # (runs, 2, errors)
    counts = bootstrap_counts(len(rows), N_BOOTSTRAP, seed)
    errors = {}
    for k, key in enumerate(ERRORS):
        both = table[:, :, k]
        if np.isfinite(both).all():
            changes = counts @ (both[:, 1] - both[:, 0]) / len(rows)
            interval = percentile_interval(changes) if len(rows) > 1 else None
            errors[key] = Change(float(both[:, 0].mean()), float(both[:, 1].mean()), interval)
    return Comparison(name, None, len(rows), errors)


def _errors(found: Estimate) -> tuple[float, ...]:
    """Return the errors of a run, in the order of :data:`ERRORS`."""
    summary, track, truth = summarize(found), found.track, found.run.streams["truth"]
    squares = dict.fromkeys(("speed", "yaw_rate"), np.zeros(len(track.time_s)))
    for state in track.states:
        kind = state.removesuffix("_mps").removesuffix("_radps").removesuffix("_x").removesuffix("_y")
        if kind in squares:
            true = truth.channel("speed_x_mps" if state == "speed_mps" else state)
            error = track.state(state) - np.interp(track.time_s, truth.time_s, true)
            squares[kind] = squares[kind] + error**2
    rms = [math.sqrt(float(np.nanmean(square))) for square in squares.values()]
    slip_error = abs(summary.slip_mean - summary.slip_true_mean)
    return (*rms, slip_error if summary.slip_observable else math.nan)


def accuracy_change(before: Array, after: Array, run_id: Array, seed: int) -> Change:
    """Return accuracies before and after, and the 95 % interval of their difference.

    Parameters
    ----------
    before, after : (n,) whether each window is classified correctly
    run_id : (n,) run of each window
    seed : of the bootstrap over runs

    Examples
    --------
    >>> before, after = np.array([0, 0, 1, 1]), np.array([1, 1, 1, 1])
    >>> accuracy_change(before, after, np.array(["a", "a", "b", "b"]), 0)
    Change(before=0.5, after=1.0, change_ci=(0.0, 1.0))
    """
    runs, of = np.unique(run_id, return_inverse=True)
    n = len(runs)
    windows = np.bincount(of, minlength=n)
    change = np.bincount(of, weights=after.astype(float) - before.astype(float), minlength=n)
    counts = bootstrap_counts(n, N_BOOTSTRAP, seed)
    interval = percentile_interval((counts @ change) / (counts @ windows))
    return Change(float(before.mean()), float(after.mean()), interval)
