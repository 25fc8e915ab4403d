"""Runs held out of a diagnosis: which, their repair, and what an extension changes for a filter on them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from terrain.discrepancy.earned import MIN_RUNS, units_of
from terrain.discrepancy.gain import ratio_of_sums
from terrain.discrepancy.health.fault import Fault
from terrain.discrepancy.runs import LowPass, Signals, Simulation, rows_of
from terrain.effects import CHANNELS
from terrain.errors import DataError, NotTakenWarning, TerrainError
from terrain.estimation.estimate import estimate_run, summarize
from terrain.records import Array, RunLog
from terrain.robots import Robot

HOLD_OUT_FROM, HOLD_OUT_EVERY = 24, 4
"""With so many runs or more, one in every so many is held out; of fewer a quarter is too few to judge on."""


def quarter(n_runs: int) -> int:
    """Return how many of runs are a quarter, none of so few that those left would be too few.

    Examples
    --------
    >>> quarter(8), quarter(5)
    (2, 0)
    """
    return math.ceil(n_runs / HOLD_OUT_EVERY) if n_runs >= 2 * MIN_RUNS else 0


def split_runs(runs: Sequence[RunLog], hold_out: int | None, seed: int) -> tuple[list[RunLog], list[RunLog]]:
    """Return the runs for the diagnosis and those held out; of sessions, where there are several, whole ones.

    Runs (sessions) are put in a random order, and of ``n`` that are held out every ``len(runs) / n``-th is taken.  The
    order knows nothing of labels, so that the same logs are split alike under any.

    Parameters
    ----------
    hold_out : number of runs held out, of sessions at least; by default a quarter of 24 runs or more
    seed : of the order

    Raises
    ------
    DataError
        if too few would be left for the diagnosis.
    """
    units = units_of(runs)
    names = list(dict.fromkeys(units))
    order = [names[i] for i in np.random.default_rng(seed).permutation(len(names))]
    most = math.ceil(len(names) / HOLD_OUT_EVERY)
    if hold_out is not None:
        most = len(names) if hold_out else 0
    held: set[str] = set()
    if hold_out or (hold_out is None and len(runs) >= HOLD_OUT_FROM):
        for n in range(1 if hold_out else most, most + 1):
            held = {order[k * len(order) // n] for k in range(n)}
            if hold_out and sum(unit in held for unit in units) >= hold_out:
                break
    used = [run for run, unit in zip(runs, units, strict=True) if unit not in held]
    if len(used) < MIN_RUNS:
        if hold_out:
            raise DataError(
                f"--hold-out is {hold_out} of {len(runs)} runs; the diagnosis requires at least {MIN_RUNS}"
            )
        return list(runs), []
    return used, [run for run, unit in zip(runs, units, strict=True) if unit in held]


def repair_held_out(
    signals: Sequence[Signals],
    faults: Sequence[Fault],
    simulation: Simulation,
    low_pass: LowPass,
    noise: Mapping[str, float],
) -> tuple[Signals, ...]:
    """Return runs held out without the faults that were found in the others, in the order of their repair.

    A run has a fault if it is nearer to the simulation, with the causes built in, without it: by squares over the
    ``noise`` of each channel.  A channel whose readings could not be distinguished is left out of all of them.
    """
    size = np.array([noise.get(name) or math.nan for name in CHANNELS])

    def misfit(run: Signals) -> float:
        planar = simulation.planar_on(run.terrain)
        residual = rows_of(run, planar, simulation.vector, (), low_pass).residual
        return float(np.nansum((residual / size) ** 2))

    fixed = []
    for run in signals:
        for fault in faults:
            right = fault.change.applied(run)
            run = right if math.isnan(fault.change.factor) else min(run, right, key=misfit)
        fixed.append(run)
    return tuple(fixed)


# -- What an extension gains for the robot's filter, against the truth of runs that have one ---------------

FILTERS = {"swerve": "vio12", "skid_steer": "slip", "tracked": "slip"}
"""By kind of drive, the filter or observer whose errors are compared."""

ERRORS = ("speed_mps", "yaw_rate_radps", "slip_ratio")
"""Errors that are compared: root mean squares of speed and yaw rate, and the error of the mean slip."""


class Change(NamedTuple):
    """A figure before and after an extension, and the 95 % interval of its change (None for one run)."""

    before: float
    after: float
    change_ci: tuple[float, float] | None


class Comparison(NamedTuple):
    """What an extension changes for a filter or a classifier (recipe) on held-out runs."""

    name: str
    reason: str | None  #: why there are no errors; None where there are
    n_runs: int  #: that were compared
    errors: Mapping[str, Change]  #: by figure
    terrains: tuple[str, ...] | None = None  #: of the runs; None where they do not matter

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as JSON has it."""
        return {key: value for key, value in self._asdict().items() if key != "terrains" or value is not None}


def filter_gain(runs: Sequence[RunLog], robot: Robot, extended: Simulation, seed: int) -> Comparison | None:
    """Return the errors of the robot's filter before and after, on runs with a truth; None without any.

    Errors are means over runs; the interval is that of the difference, by bootstrap over runs.
    """
    name = FILTERS.get(robot.drive)
    known = [run for run in runs if "truth" in run.streams]
    if name is None or not known:
        return None
    better = replace(robot, effects=dict(extended.effects), effects_cov=np.empty((0, 0)))
    better = replace(better, learned=extended.learned)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotTakenWarning)  # the errors show it
            rows = [[_errors(run, one, name) for one in (robot, better)] for run in known]
    except TerrainError as error:
        return Comparison(name, str(error), len(known), {})
    errors = {}
    for key, (before, after) in zip(ERRORS, np.array(rows).transpose(2, 1, 0), strict=True):
        if np.isfinite(before + after).all():
            interval = ratio_of_sums(after - before, np.ones(len(rows)), seed)[1]
            of_means = float(before.mean()), float(after.mean())
            errors[key] = Change(*of_means, interval if len(rows) > 1 else None)
    return Comparison(name, None, len(rows), errors)


def _errors(run: RunLog, robot: Robot, name: str) -> tuple[float, ...]:
    """Return the errors of a run, in the order of :data:`ERRORS`."""
    found = estimate_run(run, robot, name)
    slips, track = summarize(found).slip.values(), found.track
    slip_error = float(np.mean([abs(each.mean - each.true_mean) for each in slips]))
    truth, squares = run.streams["truth"], []
    for state in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"):
        true = np.interp(track.time_s, truth.time_s, truth.channel(state))
        squares.append(float(np.nanmean((track.state(state) - true) ** 2)))
    return math.sqrt(squares[0] + squares[1]), math.sqrt(squares[2]), slip_error


def accuracy_change(before: Array, after: Array, run_id: Array, seed: int) -> Change:
    """Return accuracies before and after (n,), and the 95 % interval of their difference by bootstrap over runs (n,).

    Examples
    --------
    >>> before, after = np.array([0, 0, 1, 1]), np.array([1, 1, 1, 1])
    >>> accuracy_change(before, after, np.array(["a", "a", "b", "b"]), 0)
    Change(before=0.5, after=1.0, change_ci=(-1.0, 1.0))
    """
    runs, of = np.unique(run_id, return_inverse=True)
    change = np.bincount(of, weights=after.astype(float) - before.astype(float), minlength=len(runs))
    interval = ratio_of_sums(change, np.bincount(of, minlength=len(runs)), seed)[1]
    return Change(float(before.mean()), float(after.mean()), (max(interval[0], -1.0), min(interval[1], 1.0)))
