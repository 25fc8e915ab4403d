"""From commanded to measured wheel speeds: what the powertrain does to a command, where commands are logged.

The model is that of :mod:`terrain.discrepancy.command_response`.  Its parts are added one at a time, and a
part stays if it reduces the squared error of runs left out of the fit, with an interval over runs that
excludes 0.
A gain that is not 1 says that the commands are no wheel speeds; the other parts hold behind it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from terrain.bootstrap import LEVEL, bootstrap_counts, percentile_interval
from terrain.discrepancy.command_response import (
    ABSENT,
    COMMON_LIMIT,
    DELAY,
    DIFFERENCE_GAIN,
    DIFFERENCE_LIMIT,
    NAMES,
    SLEW,
    STEP_S,
    TIME_CONSTANT,
    Traces,
    is_commanded,
    left_over,
    predict,
    settled,
    squared_errors,
    traces_of,
)
from terrain.discrepancy.faults import Fault
from terrain.discrepancy.powertrain_answer import Part, PartStatus, Powertrain, PowertrainAnswer
from terrain.errors import DataError
from terrain.records import Array, RunLog
from terrain.robots import Robot

FOLDS = 5
"""Into which runs are dealt, to be left out of a fit one after the other."""

DRAWS = 1000
"""Bootstrap samples of an interval."""

MIN_GAIN_RATIO = 0.002
"""Of the squared error, that a part removes of the runs fitted; less is not worth a number, whatever its
significance: a thousandth of 0.1 rad/s rms is 3 mrad/s."""

EXCITED_SIGMAS = 3.0
"""A part of a usual size has to change the squared error by so many standard deviations to be visible."""

GRID_ROOM_S = STEP_S / 2
"""What the grid leaves open of delay and time constant: no number of runs makes their intervals narrower."""

LOW = np.array([0.0, 0.0, 0.1, 0.0, 0.05, 0.05, 0.1, 0.1, 0.1])
HIGH = np.array([1.0, 2.0, 500.0, 5.0, 5.0, 5.0, 200.0, 200.0, 200.0])
"""Bounds of the fit."""

STEPS = np.array([STEP_S, 0.01, 0.5, 0.05, 0.01, 0.01, 0.05, 0.05, 0.05])
"""Changes over which derivatives are taken."""

USUAL = np.array([0.1, 0.1, 5.0, 0.3, 1.2, 1.2, 2.0, 1.0, 2.0])
"""A size of each part that robots have; what the runs would show of it says whether they excite it."""

MAX_STEPS, MAX_DAMPING, TOLERANCE = 20, 1e4, 1e-4
"""Of the Gauss-Newton fit; it ends where a step reduces the error, or would, by less than the tolerance."""

STARTS: tuple[tuple[float, ...], ...] = (
    (0.05, 0.15, 0.3, 0.5),
    (0.05, 0.15, 0.4, 1.0),
    (2.0, 5.0, 10.0, 20.0, 40.0),
    (0.1, 0.3, 1.0, 2.0),
    (0.6, 0.8, 1.25, 1.7),
    (0.4, 0.6, 0.8, 1.25),
    (),
    (),
    (),
)
"""Where the fit of each part starts from; limits start from shares of the largest measured speed."""

LIMIT_STARTS = (0.3, 0.5, 0.7, 0.9)


def powertrain_of(runs: Sequence[RunLog], robot: Robot, seed: int = 0) -> Powertrain:
    """Return what is between commanded and measured wheel speeds, over all runs that log both.

    Parameters
    ----------
    runs : with a stream ``commands`` that has a channel ``wheel_<wheel>_radps`` for each wheel
    robot : names of its wheels, wheel radius and reduction
    seed : of the folds and of the bootstrap

    Raises
    ------
    DataError
        if fewer than five runs have commanded and measured wheel speeds.
    """
    traces = traces_of(runs, robot)
    n_runs = len(traces.start_radps)
    two_sides = traces.measured.shape[1] == 2
    of_two_sides = (DIFFERENCE_GAIN, COMMON_LIMIT, DIFFERENCE_LIMIT)
    candidates = [i for i in range(len(NAMES)) if two_sides or i not in of_two_sides]
    fold_of = np.random.default_rng(seed).permutation(n_runs) % FOLDS
    kept, vector = _add_parts(traces, candidates, fold_of, seed)
    kept, vector, error, gains = _drop_parts(traces, kept, vector, fold_of, seed)
    vector = _fit(traces, kept, vector, np.ones(n_runs), both_sides=True)
    intervals = _intervals(traces, kept, vector, seed)
    parts = []
    for i in candidates:
        if i in kept:
            room_s = GRID_ROOM_S if i in (DELAY, TIME_CONSTANT) else 0.0
            low, high = max(intervals[i][0] - room_s, 0.0), intervals[i][1] + room_s
            if i == DELAY and not {TIME_CONSTANT, SLEW} & set(kept):  # the next sample shows all of a step
                low, high = max(low - traces.hold_s, 0.0), high + traces.hold_s
            parts.append(Part(NAMES[i], PartStatus.FOUND, float(vector[i]), low, high, gains[i]))
        else:
            shown = PartStatus.NOT_NEEDED if _is_excited(traces, vector, i) else PartStatus.NOT_EXCITED
            parts.append(Part(NAMES[i], shown, math.nan, math.nan, math.nan, math.nan))
    size, raw = traces.n_values, squared_errors(traces, ABSENT)
    before, after = (math.sqrt(float(each.sum()) / size) for each in (raw, error))
    return Powertrain(tuple(parts), before, after, _reduction(raw, error, seed), traces.hold_s, n_runs)


def powertrain_answer(
    runs: Sequence[RunLog], robot: Robot, faults: Sequence[Fault], seed: int = 0
) -> PowertrainAnswer | None:
    """Return what is between commanded and measured wheel speeds; None where no run logs both.

    Parameters
    ----------
    runs : of the robot
    robot : names of its wheels, wheel radius and reduction
    faults : of their logs; runs whose wheel speeds have one are left out
    seed : of the folds and of the bootstrap
    """
    if not any(is_commanded(run, robot) for run in runs):
        return None
    faulty = {run_id for fault in faults if fault.change.of_wheels for run_id in fault.run_ids}
    try:
        return PowertrainAnswer(powertrain_of([run for run in runs if run.run_id not in faulty], robot, seed))
    except DataError as error:
        left_out = f" ({len(faulty)} have a fault of their wheel speeds)" if faulty else ""
        return PowertrainAnswer(None, f"{error}{left_out}")


def _reduction(before: Array, after: Array, seed: int) -> tuple[float, float, float]:
    """Return by what the squared errors (runs,) are less, with its interval over runs; 0 of none at all."""
    if not before.sum() > 0:
        return 0.0, 0.0, 0.0
    counts = bootstrap_counts(len(before), DRAWS, seed)
    drawn = 1.0 - (counts @ after) / np.maximum(counts @ before, 1e-12)
    return (1.0 - float(after.sum() / before.sum()), *percentile_interval(drawn))


def _normal(traces: Traces, active: Sequence[int], p: Array, both_sides: bool = False) -> tuple[Array, Array]:
    """Return the normal equations of each run: (runs, k, k) and (runs, k)."""
    left, here = left_over(traces, p), predict(traces, p)
    change = np.empty((len(active), *left.shape))
    for row, i in enumerate(active):
        far, near = p.copy(), p.copy()
        far[i] += STEPS[i]
        near[i] = max(p[i] - STEPS[i], LOW[i]) if both_sides else p[i]
        back = predict(traces, near) if both_sides else here
        change[row] = (predict(traces, far) - back) / (far[i] - near[i]) * traces.new
    ends = list(pairwise(traces.sample.tolist()))
    parts = [(change[:, i:j].reshape(len(active), -1), left[i:j].ravel()) for i, j in ends]
    return np.array([d @ d.T for d, _ in parts]), np.array([d @ r for d, r in parts])


def _fit(
    traces: Traces,
    active: Sequence[int],
    start: Array,
    used: Array,
    both_sides: bool = False,
    first: tuple[Array, Array] | None = None,
) -> Array:
    """Return the values that fit runs with weights ``used`` (runs,) best, by guarded Gauss-Newton steps.

    ``first`` are the normal equations of the runs at the start, where they are known.
    """
    p, damping = start.copy(), 1e-3
    if not active:
        return p
    at = list(active)
    best = float(used @ squared_errors(traces, p))
    for n in range(MAX_STEPS):
        normal = first if first is not None and n == 0 else _normal(traces, at, p, both_sides)
        a, g = (np.tensordot(used, each, axes=1) for each in normal)
        before = best
        while damping < MAX_DAMPING:
            scaled = a + damping * np.diag(np.diag(a)) + 1e-12 * np.eye(len(at))
            step = np.linalg.solve(scaled, g)
            if not step @ (2.0 * g - a @ step) > TOLERANCE * before:
                return p
            trial = p.copy()
            trial[at] = np.clip(p[at] + step, LOW[at], HIGH[at])
            error = float(used @ squared_errors(traces, trial))
            if error < best:
                p, best, damping = trial, error, damping / 5.0
                break
            damping *= 5.0
        if not before - best > TOLERANCE * before:
            break
        damping = max(damping, 1e-6)
    return p


def _left_out(traces: Traces, active: Sequence[int], start: Array, fold_of: Array) -> Array:
    """Return the squared error of each run (runs,), of a fit that it is left out of."""
    error = np.empty(len(fold_of))
    first = _normal(traces, active, start) if active else None
    for fold in range(FOLDS):
        out = fold_of == fold
        if out.any():
            p = _fit(traces, active, start, (~out).astype(float), first=first)
            error[out] = squared_errors(traces, p)[out]
    return error


def _add_parts(
    traces: Traces, candidates: Sequence[int], fold_of: Array, seed: int
) -> tuple[list[int], Array]:
    """Return the parts that reduce the error of runs left out, added one at a time, and all values."""
    every = np.ones(len(fold_of))
    kept: list[int] = []
    vector, error = ABSENT.copy(), squared_errors(traces, ABSENT)
    while True:
        fits = []
        for i in candidates:
            if i not in kept:
                p = _fit(traces, [*kept, i], _started(traces, vector, i), every)
                fits.append((float(squared_errors(traces, p).sum()), i, p))
        least = (1.0 - MIN_GAIN_RATIO) * float(squared_errors(traces, vector).sum())
        for fitted, i, p in sorted(fits, key=lambda each: each[0]):
            if fitted >= least:
                return kept, vector
            left = _left_out(traces, [*kept, i], p, fold_of)
            if _low_gain(error, left, seed) > 0.0:
                kept, vector, error = sorted([*kept, i]), p, left
                break
        else:
            return kept, vector


def _drop_parts(
    traces: Traces, kept: list[int], vector: Array, fold_of: Array, seed: int
) -> tuple[list[int], Array, Array, dict[int, float]]:
    """Return the parts without those that a later one made needless, and what each removes beside the others.

    Further returned are all values and the squared error of each run (runs,) that is left out.
    """
    every = np.ones(len(fold_of))
    while True:
        error = _left_out(traces, kept, vector, fold_of)
        gains, needless = {}, {}
        for i in kept:
            rest = [j for j in kept if j != i]
            without = _fit(traces, rest, _without(vector, i), every)
            left = _left_out(traces, rest, without, fold_of)
            gains[i] = float(1.0 - error.sum() / left.sum())
            if _low_gain(left, error, seed) <= 0.0:
                needless[i] = rest, without
        if not needless:
            return kept, vector, error, gains
        kept, vector = needless[min(needless, key=lambda i: gains[i])]


def _started(traces: Traces, vector: Array, i: int) -> Array:
    """Return the values with a part added, at the best of those that its fit may start from."""
    top = float(np.abs(traces.measured).max())
    starts = STARTS[i] or tuple(ratio * top for ratio in LIMIT_STARTS)
    shorter = vector.copy()
    shorter[TIME_CONSTANT] *= 0.5  # a slew limit takes over much of what a time constant did without it
    points = np.repeat([vector, shorter], len(starts), axis=0)
    points[:, i] = np.clip(np.tile(starts, 2), LOW[i], HIGH[i])
    return np.asarray(min(points, key=lambda p: float(squared_errors(traces, p).sum())))


def _without(vector: Array, i: int) -> Array:
    rest = vector.copy()
    rest[i] = ABSENT[i]
    return rest


def _low_gain(before: Array, after: Array, seed: int) -> float:
    """Return the low end of the reduction of squared errors (runs,), over bootstrap samples of the runs.

    Its level leaves to all parts together what an interval leaves to one.
    """
    counts = bootstrap_counts(len(before), DRAWS, seed)
    return percentile_interval(counts @ (before - after), 1.0 - (1.0 - LEVEL) / len(NAMES))[0]


def _intervals(
    traces: Traces, kept: Sequence[int], vector: Array, seed: int
) -> dict[int, tuple[float, float]]:
    """Return the interval of each part over bootstrap samples of the runs, by one Gauss-Newton step each."""
    if not kept:
        return {}
    a, g = _normal(traces, kept, vector, both_sides=True)
    counts = bootstrap_counts(len(a), DRAWS, seed).astype(float)
    total = np.tensordot(counts, a, axes=1) + 1e-12 * np.eye(len(kept))
    change = np.linalg.solve(total, (counts @ g)[..., None])[..., 0]
    draws = np.clip(vector[list(kept)] + change, LOW[list(kept)], HIGH[list(kept)])
    return {i: percentile_interval(draws[:, k]) for k, i in enumerate(kept)}


def _is_excited(traces: Traces, vector: Array, i: int) -> bool:
    """Return whether a part of a usual size would change the wheel speeds noticeably."""
    there = vector.copy()
    there[i] = USUAL[i]
    traces = traces._replace(start_radps=settled(traces, vector))  # noise of the first samples is no motion
    change = (predict(traces, there) - predict(traces, vector)) * traces.new
    runs = traces.sample[:-1]
    removed = float((change**2).sum())
    scatter = np.add.reduceat(2.0 * (change * left_over(traces, vector)).sum(axis=1), runs)
    least = MIN_GAIN_RATIO * float(squared_errors(traces, vector).sum())
    return removed > max(EXCITED_SIGMAS * float(np.sqrt((scatter**2).sum())), least, 1e-9)
