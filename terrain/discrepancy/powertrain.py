r"""How wheels follow commanded speeds: a stepped model of the powertrain, and runs prepared for it.

A command ``c`` (rad/s of each wheel) becomes a wheel speed ``y`` by parts, each of which may be absent::

    a = g_c (c_r + c_l)/2,  b = g_d (c_r - c_l)/2       gains, common to the sides and of their difference
    a, b limited to A and B                             where a command is a speed and a turn to the robot
    x = 0 for |x| < d, min(|x|, 2 (|x| - d)) beyond     deadband d; twice as large commands pass whole
    x limited to the largest wheel speed
    T dy/dt = x(t - D) - y,  |dy/dt| <= s               delay D, time constant T, slew limit s

At the start of a run the command before is not known: its wheels are assumed to go on as they were measured
first, until the first command arrives.

Loggers hold a measurement until the next one comes.  Of each wheel only new samples are compared, so that the
period of the logger is no part of the delay; what its messages need to arrive is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import LEVEL, bootstrap_counts, percentile_interval
from terrain.discrepancy.faults import Fault
from terrain.discrepancy.statements import listed
from terrain.errors import DataError
from terrain.kernels import njit
from terrain.records import Array, RunLog
from terrain.robots import Robot

STEP_S = 0.02
"""Of the simulated powertrain; a fifth of the shortest delays that robots have."""

MIN_RUNS = 5
"""Fewer do not tell an error from the scatter between runs."""

NAMES = (
    "delay_s",
    "time_constant_s",
    "slew_radps2",
    "deadband_radps",
    "gain_ratio",
    "difference_gain_ratio",
    "common_limit_radps",
    "difference_limit_radps",
    "wheel_limit_radps",
)
"""Parts, as the kernel takes them."""

DELAY, TIME_CONSTANT, SLEW, DEADBAND, GAIN, DIFFERENCE_GAIN, COMMON_LIMIT, DIFFERENCE_LIMIT, WHEEL_LIMIT = (
    range(9)
)

ABSENT = np.array([0.0, 0.0, math.inf, 0.0, 1.0, 1.0, math.inf, math.inf, math.inf])
"""Values of parts that do nothing."""


class Traces(NamedTuple):
    """All runs on one grid.

    Parameters
    ----------
    area_rad : (m, wheels) integrals of the commands from the start of each run
    first : (runs + 1,) rows of each run in the grid
    start_radps : (runs, wheels) first measured wheel speeds
    at, between : (n,) row ahead of each sample, and share of a step behind it
    measured : (n, wheels) wheel speeds
    new : (n, wheels) 1 where a sample of a wheel is new, else 0
    sample : (runs + 1,) samples of each run
    hold_s : period at which new wheel speeds are logged
    """

    area_rad: Array
    first: Array
    start_radps: Array
    at: Array
    between: Array
    measured: Array
    new: Array
    sample: Array
    hold_s: float

    @property
    def n_values(self) -> int:
        """How many values are compared."""
        return int(self.new.sum())


def is_commanded(run: RunLog, robot: Robot) -> bool:
    """Return whether a run logs the commanded and the measured speed of each wheel."""
    if not {"commands", "wheels"} <= run.streams.keys():
        return False
    ordered = {f"wheel_{wheel}_radps" for wheel in robot.logged_wheels}
    commanded = ordered <= set(run.streams["commands"].channels)
    return commanded and set(robot.rate_channels) <= set(run.streams["wheels"].channels)


def traces_of(runs: Sequence[RunLog], robot: Robot) -> Traces:
    """Return the runs that log commanded and measured wheel speeds on one grid.

    Raises
    ------
    DataError
        if fewer than :data:`MIN_RUNS` do.
    """
    area, start, at, between, measured, news, holds = [], [], [], [], [], [], []
    first, sample = [0], [0]
    per_radps = robot.logged_rates(np.full(len(robot.wheels), robot.wheel_radius_m))
    for run in runs:
        if not is_commanded(run, robot):
            continue
        commands, wheels = run.streams["commands"], run.streams["wheels"]
        rates = np.column_stack([wheels.channel(name) for name in robot.rate_channels]) / per_radps
        orders = np.column_stack([commands.channel(f"wheel_{wheel}_radps") for wheel in robot.logged_wheels])
        inside = (wheels.time_s >= commands.time_s[0]) & (wheels.time_s <= commands.time_s[-1])
        inside &= np.isfinite(rates).all(axis=1)
        time_s, rates = wheels.time_s[inside], rates[inside]
        if len(time_s) < 3 or not np.isfinite(orders).all():
            continue
        new, hold_s = _new_samples(time_s, rates)
        any_new = new.any(axis=1)
        if not any_new.any():
            continue
        grid_s = np.arange(time_s[0], time_s[-1] + 2.0 * STEP_S, STEP_S)
        area.append(np.column_stack([_integral(grid_s, commands.time_s, each) for each in orders.T]))
        place = (time_s[any_new] - grid_s[0]) / STEP_S
        row = np.minimum(place.astype(np.int64), len(grid_s) - 2)
        at.append(row + first[-1])
        between.append(place - row)
        measured.append(rates[any_new])
        news.append(new[any_new].astype(float))
        start.append(rates[0])
        holds.append(hold_s)
        first.append(first[-1] + len(grid_s))
        sample.append(sample[-1] + len(row))
    if len(start) < MIN_RUNS:
        raise DataError(
            f"runs: {len(start)} have commanded and measured wheel speeds; at least {MIN_RUNS} are required"
        )
    return Traces(
        np.vstack(area),
        np.array(first),
        np.vstack(start),
        np.concatenate(at),
        np.concatenate(between),
        np.vstack(measured),
        np.vstack(news),
        np.array(sample),
        float(np.median(holds)),
    )


def _integral(time_s: Array, stamps_s: Array, held: Array) -> Array:
    """Return the integral (m,) of a command that is held from stamp to stamp, and after the last."""
    sums = np.concatenate([[0.0], np.cumsum(held[:-1] * np.diff(stamps_s))])
    after = np.maximum(time_s - stamps_s[-1], 0.0) * held[-1]
    return np.asarray(np.interp(time_s, stamps_s, sums) + after)


def _new_samples(time_s: Array, rates: Array) -> tuple[Array, float]:
    """Return which samples (n, wheels) are new, and the period at which they come.

    What stays the same for twice that period is new as well: a wheel that turns steadily.
    """
    new = np.vstack([np.zeros(rates.shape[1], dtype=bool), np.diff(rates, axis=0) != 0.0])
    between = [np.diff(np.flatnonzero(column)) for column in new.T]
    every = int(np.median(np.concatenate(between))) if any(len(each) for each in between) else 1
    for column in new.T:
        last = 0
        for k in range(1, len(time_s)):
            if column[k] or k - last >= 2 * every:
                column[k], last = True, k
    return new, every * float(np.median(np.diff(time_s)))


@njit
def follow(area_rad: Array, start_radps: Array, p: Array, dt: float) -> Array:
    """Return wheel speeds (m, wheels) that follow commands.

    Parameters
    ----------
    area_rad : (m, wheels) integral of the commands (rad/s) up to each step
    start_radps : (wheels,) wheel speeds until the first command arrives
    p : (len(NAMES),) parts
    dt : step in s

    Examples
    --------
    A step from 0 to 1 rad/s, a tenth of a second late:

    >>> step = np.maximum(np.arange(40) - 9.0, 0.0)[:, None] * 0.01
    >>> late = ABSENT.copy()
    >>> late[DELAY] = 0.1
    >>> follow(step, np.zeros(1), late, 0.01)[[18, 20], 0]
    array([0., 1.])
    """
    m, wheels = area_rad.shape
    out = np.empty((m, wheels))
    state, x = start_radps.copy(), np.empty(wheels)
    late = p[0] / dt
    quick = 1.0 - math.exp(-dt / p[1]) if p[1] > 0.0 else 1.0
    furthest = p[2] * dt
    for k in range(m):
        at = k - late
        if at >= 1.0:
            i = int(at)
            part = at - i
            for j in range(wheels):
                x[j] = (area_rad[i, j] - area_rad[i - 1, j]) * (1.0 - part) / dt
                if part > 0.0:
                    x[j] += (area_rad[i + 1, j] - area_rad[i, j]) * part / dt
            if wheels == 2:
                common = min(max(0.5 * p[4] * (x[1] + x[0]), -p[6]), p[6])
                half = min(max(0.5 * p[5] * (x[1] - x[0]), -p[7]), p[7])
                x[0], x[1] = common - half, common + half
            for j in range(wheels):
                goal = x[j] if wheels == 2 else p[4] * x[j]
                size = abs(goal)
                if size < 2.0 * p[3]:
                    goal = math.copysign(max(2.0 * (size - p[3]), 0.0), goal)
                goal = min(max(goal, -p[8]), p[8])
                state[j] += min(max(quick * (goal - state[j]), -furthest), furthest)
        out[k] = state
    return out


@njit
def _predicted(
    area_rad: Array, first: Array, start_radps: Array, at: Array, between: Array, sample: Array, p: Array
) -> Array:
    """Return predicted wheel speeds (n, wheels) at the samples of all runs."""
    out = np.empty((at.size, area_rad.shape[1]))
    for run in range(start_radps.shape[0]):
        speed = follow(area_rad[first[run] : first[run + 1]], start_radps[run], p, STEP_S)
        for n in range(sample[run], sample[run + 1]):
            k = at[n] - first[run]
            for j in range(out.shape[1]):
                out[n, j] = speed[k, j] + between[n] * (speed[k + 1, j] - speed[k, j])
    return out


def predict(traces: Traces, p: Array) -> Array:
    """Return predicted wheel speeds (n, wheels) at the samples."""
    shown: Array = _predicted(
        traces.area_rad, traces.first, traces.start_radps, traces.at, traces.between, traces.sample, p
    )
    return shown


def settled(traces: Traces, p: Array) -> Array:
    """Return the wheel speeds (runs, wheels) that the first commands lead to."""
    at_once = p.copy()
    at_once[[DELAY, TIME_CONSTANT]], at_once[SLEW] = 0.0, math.inf
    first = traces.first[:-1]
    starts = [traces.area_rad[k : k + 2] for k in first.tolist()]
    zero = np.zeros(traces.area_rad.shape[1])
    return np.array([follow(area, zero, at_once, STEP_S)[1] for area in starts])


def left_over(traces: Traces, p: Array) -> Array:
    """Return measured minus predicted wheel speeds (n, wheels), 0 where a sample is not new."""
    return np.asarray((traces.measured - predict(traces, p)) * traces.new)


def squared_errors(traces: Traces, p: Array) -> Array:
    """Return the sum of the squared errors of each run (runs,)."""
    square = (left_over(traces, p) ** 2).sum(axis=1)
    return np.asarray(np.add.reduceat(square, traces.sample[:-1]))


# -- What is between commanded and measured wheel speeds, as stated: parts with intervals, and sentences ---

SCALE_TOLERANCE = 0.1
"""Gains further from 1 than that: the commands are no wheel speeds."""

WORDS = {
    "delay_s": "the wheels answer {} s late",
    "time_constant_s": "they settle with a time constant of {} s",
    "slew_radps2": "they speed up and slow down by at most {} rad/s²",
    "deadband_radps": "commands below {} rad/s do not move them",
    "gain_ratio": "they turn {} times as fast as commanded",
    "difference_gain_ratio": "they turn {} times as fast against each other as commanded",
    "common_limit_radps": "the mean of both sides is at most {} rad/s",
    "difference_limit_radps": "half the difference of the sides is at most {} rad/s",
    "wheel_limit_radps": "no wheel turns faster than {} rad/s",
}
"""What each part does, with a place for its value."""


LABELS = {
    "delay_s": "a delay",
    "time_constant_s": "a time constant",
    "slew_radps2": "a slew limit",
    "deadband_radps": "a deadband",
    "gain_ratio": "a gain",
    "difference_gain_ratio": "a gain of the difference of the sides",
    "common_limit_radps": "a limit of the mean of both sides",
    "difference_limit_radps": "a limit of the difference of the sides",
    "wheel_limit_radps": "a largest wheel speed",
}
"""What each part is called."""


class PartStatus(Enum):
    """Whether a part of the powertrain is there."""

    FOUND = "it reduces the error of runs left out"
    NOT_NEEDED = "it does not reduce the error of runs left out"
    NOT_EXCITED = "the commands would not show it"


class Part(NamedTuple):
    """One part of the powertrain.

    Parameters
    ----------
    name : of :data:`NAMES`, ends in its unit
    status : whether it is there
    value, low, high : with its 95 % interval over runs; NaN where it was not found.  A delay of wheels that
        then follow at once is known to a period of the logger at the best
    gain_ratio : of the squared error of runs left out, that it removes beside the others; NaN where not found
    """

    name: str
    status: PartStatus
    value: float
    low: float
    high: float
    gain_ratio: float

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        named = {"name": self.name, "unit": self.name.rpartition("_")[2], "status": self.status.name.lower()}
        return {**named, "value": self.value, "ci": (self.low, self.high), "held_out_gain": self.gain_ratio}


class Powertrain(NamedTuple):
    """From commanded to measured wheel speeds.

    Parameters
    ----------
    parts : in the order of :data:`NAMES`; without those of two sides where a robot has not just two
    rms_before_radps, rms_after_radps : measured minus commanded, and minus predicted of runs left out of the
        fit
    reduction : of the squared error of these runs, over that of the commands, with its 95 % interval over
        runs
    hold_s : period at which new wheel speeds are logged
    n_runs : that have both
    """

    parts: tuple[Part, ...]
    rms_before_radps: float
    rms_after_radps: float
    reduction: tuple[float, float, float]
    hold_s: float
    n_runs: int

    @property
    def found(self) -> tuple[Part, ...]:
        """Parts that are there."""
        return tuple(part for part in self.parts if part.status is PartStatus.FOUND)

    @property
    def vector(self) -> Array:
        """Values (len(NAMES),) as :func:`follow` takes them."""
        vector = ABSENT.copy()
        for part in self.found:
            vector[NAMES.index(part.name)] = part.value
        return vector

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found, a sentence each, with its interval, what that gains, and what was not excited."""
        if not self.found:
            return ("The wheels turn as they are commanded, as far as the runs show it.", *self._missed)
        parts = ((WORDS[p.name].format(f"{p.value:.3g}"), f"{p.low:.3g} to {p.high:.3g}") for p in self.found)
        stated = [f"{words[0].upper()}{words[1:]} ({interval})." for words, interval in parts]
        if self.is_scaled:
            stated.append("The commands are no wheel speeds: they are scaled before the wheels get them.")
        ratio, low, high = self.reduction
        stated.append(
            f"On runs left out of the fit the wheel speeds are then off by {self.rms_after_radps:.3g} rad/s "
            f"rms instead of {self.rms_before_radps:.3g}, a squared error less by {ratio:.1%} ({low:.1%} to "
            f"{high:.1%})."
        )
        return (*stated, *self._missed)

    @property
    def _missed(self) -> tuple[str, ...]:
        """One sentence on the parts that the commands would not show, if there are any."""
        missed = [LABELS[part.name] for part in self.parts if part.status is PartStatus.NOT_EXCITED]
        return (f"The commands would not have shown {listed(missed, 'or')}.",) if missed else ()

    @property
    def is_scaled(self) -> bool:
        """Whether commands are no wheel speeds: a gain is not 1."""
        gains = [part for part in self.found if "gain" in part.name]
        return any(abs(part.value - 1.0) > SCALE_TOLERANCE for part in gains)


class PowertrainAnswer(NamedTuple):
    """The powertrain of runs that log commands.

    Parameters
    ----------
    powertrain : None where it is not known
    reason : why it is not
    """

    powertrain: Powertrain | None
    reason: str = ""

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is between commands and wheels, or why that is not known."""
        if self.powertrain is None:
            return (f"The wheel speeds are not compared with their commands: {self.reason}.",)
        return self.powertrain.sentences

    def as_json(self) -> dict[str, Any]:
        """Return the answer as JSON has it."""
        if self.powertrain is None:
            return {"measured": False, "reason": self.reason, "sentences": self.sentences}
        return {"measured": True, "sentences": self.sentences, **self.powertrain._asdict()}


# -- From commanded to measured wheel speeds: what the powertrain does to a command, where commands are logged --
# The model is that of :mod:`terrain.discrepancy.powertrain`.  Its parts are added one at a time, and a
# part stays if it reduces the squared error of runs left out of the fit, with an interval over runs that
# excludes 0.
# A gain that is not 1 says that the commands are no wheel speeds; the other parts hold behind it.

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
    present, vector = _add_parts(traces, candidates, fold_of, seed)
    present, vector, error, gains = _drop_parts(traces, present, vector, fold_of, seed)
    vector = _fit(traces, present, vector, np.ones(n_runs), both_sides=True)
    intervals = _intervals(traces, present, vector, seed)
    parts = []
    for i in candidates:
        if i in present:
            room_s = GRID_ROOM_S if i in (DELAY, TIME_CONSTANT) else 0.0
            low, high = max(intervals[i][0] - room_s, 0.0), intervals[i][1] + room_s
            if i == DELAY and not {TIME_CONSTANT, SLEW} & set(present):  # the next sample shows all of a step
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
    present: list[int] = []
    vector, error = ABSENT.copy(), squared_errors(traces, ABSENT)
    while True:
        fits = []
        for i in candidates:
            if i not in present:
                p = _fit(traces, [*present, i], _started(traces, vector, i), every)
                fits.append((float(squared_errors(traces, p).sum()), i, p))
        least = (1.0 - MIN_GAIN_RATIO) * float(squared_errors(traces, vector).sum())
        for fitted, i, p in sorted(fits, key=lambda each: each[0]):
            if fitted >= least:
                return present, vector
            left = _left_out(traces, [*present, i], p, fold_of)
            if _low_gain(error, left, seed) > 0.0:
                present, vector, error = sorted([*present, i]), p, left
                break
        else:
            return present, vector


def _drop_parts(
    traces: Traces, present: list[int], vector: Array, fold_of: Array, seed: int
) -> tuple[list[int], Array, Array, dict[int, float]]:
    """Return the parts without those that a later one made needless, and what each removes beside the others.

    Further returned are all values and the squared error of each run (runs,) that is left out.
    """
    every = np.ones(len(fold_of))
    while True:
        error = _left_out(traces, present, vector, fold_of)
        gains, needless = {}, {}
        for i in present:
            rest = [j for j in present if j != i]
            without = _fit(traces, rest, _without(vector, i), every)
            left = _left_out(traces, rest, without, fold_of)
            gains[i] = float(1.0 - error.sum() / left.sum())
            if _low_gain(left, error, seed) <= 0.0:
                needless[i] = rest, without
        if not needless:
            return present, vector, error, gains
        present, vector = needless[min(needless, key=lambda i: gains[i])]


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
    traces: Traces, present: Sequence[int], vector: Array, seed: int
) -> dict[int, tuple[float, float]]:
    """Return the interval of each part over bootstrap samples of the runs, by one Gauss-Newton step each."""
    if not present:
        return {}
    a, g = _normal(traces, present, vector, both_sides=True)
    counts = bootstrap_counts(len(a), DRAWS, seed).astype(float)
    total = np.tensordot(counts, a, axes=1) + 1e-12 * np.eye(len(present))
    change = np.linalg.solve(total, (counts @ g)[..., None])[..., 0]
    draws = np.clip(vector[list(present)] + change, LOW[list(present)], HIGH[list(present)])
    return {i: percentile_interval(draws[:, k]) for k, i in enumerate(present)}


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
