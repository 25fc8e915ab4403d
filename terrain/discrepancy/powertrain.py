r"""How wheels follow commanded speeds: a stepped model of the powertrain, and which parts of it runs show.

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

Parts are added one at a time, and a part stays if it reduces the squared error of runs left out of the fit by more
than chance.  A gain that is not 1 says that the commands are no wheel speeds; the other parts hold behind it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import LEVEL, bootstrap_counts, percentile_interval
from terrain.discrepancy.faults import Fault
from terrain.discrepancy.robot_terms import listed
from terrain.identify import Fit, Parameter, deal, folds, identify
from terrain.kernels import njit, record
from terrain.records import Array, RunLog
from terrain.robots import Robot

STEP_S = 0.02  #: Of the simulated powertrain; a fifth of the shortest delays that robots have.
MIN_RUNS = 5  #: Fewer do not tell an error from the scatter between runs.
FOLDS = 5  #: Into which runs are dealt, to be left out of a fit one after the other.
DRAWS = 1000  #: Bootstrap samples of runs.
#: Of the squared error, that a part removes of the runs fitted; less is not worth a number, whatever its
#: significance: a thousandth of 0.1 rad/s rms is 3 mrad/s.
MIN_GAIN_RATIO = 0.002
#: A part of a usual size has to change the squared error by so many standard deviations to be visible.
EXCITED_SIGMAS = 3.0
#: What the grid leaves open of delay and time constant, whatever the number of runs: commands that change with the
#: grid answer alike to all delays within a step.
GRID_ROOM_S = STEP_S

SCALE_TOLERANCE = 0.1  #: Gains further from 1 than that: the commands are no wheel speeds.
TOLERANCE = 1e-4  #: A fit ends where a step reduces the squared error by less, relative to it.
LIMIT_STARTS = (0.3, 0.5, 0.7, 0.9)  #: Ratios of the largest measured speed, from which fits of limits start.


class _Kind(NamedTuple):
    """Of a part: value that does nothing, bounds, step of derivatives, size that robots have, starts, words."""

    absent: float
    low: float
    high: float
    step: float
    usual: float
    starts: tuple[float, ...]
    label: str
    words: str


# fmt: off
KINDS = {
    "delay_s": _Kind(0.0, 0.0, 1.0, STEP_S, 0.1, (0.05, 0.15, 0.3, 0.5),
                     "a delay", "the wheels answer {} s late"),
    "time_constant_s": _Kind(0.0, 0.0, 2.0, 0.01, 0.1, (0.05, 0.15, 0.4, 1.0),
                             "a time constant", "they settle with a time constant of {} s"),
    "slew_radps2": _Kind(math.inf, 0.1, 500.0, 0.5, 5.0, (2.0, 5.0, 10.0, 20.0, 40.0),
                         "a slew limit", "they speed up and slow down by at most {} rad/s²"),
    "deadband_radps": _Kind(0.0, 0.0, 5.0, 0.05, 0.3, (0.1, 0.3, 1.0, 2.0),
                            "a deadband", "commands below {} rad/s do not move them"),
    "gain_ratio": _Kind(1.0, 0.05, 5.0, 0.01, 1.2, (0.6, 0.8, 1.25, 1.7),
                        "a gain", "they turn {} times as fast as commanded"),
    "difference_gain_ratio": _Kind(1.0, 0.05, 5.0, 0.01, 1.2, (0.4, 0.6, 0.8, 1.25),
                                   "a gain of the difference of the sides",
                                   "they turn {} times as fast against each other as commanded"),
    "common_limit_radps": _Kind(math.inf, 0.1, 200.0, 0.05, 2.0, (),
                                "a limit of the mean of both sides",
                                "the mean of both sides is at most {} rad/s"),
    "difference_limit_radps": _Kind(math.inf, 0.1, 200.0, 0.05, 1.0, (),
                                    "a limit of the difference of the sides",
                                    "half the difference of the sides is at most {} rad/s"),
    "wheel_limit_radps": _Kind(math.inf, 0.1, 200.0, 0.05, 2.0, (),
                               "a largest wheel speed", "no wheel turns faster than {} rad/s"),
}
# fmt: on
"""Parts by name; limits start from ratios of the largest measured speed."""

NAMES = tuple(KINDS)
OF_TWO_SIDES = ("difference_gain_ratio", "common_limit_radps", "difference_limit_radps")
ABSENT = np.array([kind.absent for kind in KINDS.values()])
#: Values (len(NAMES),) of all parts as kernels take them: ``values.view(VALUES)[0]``.
VALUES = record(dict.fromkeys(NAMES, float))


class PartStatus(Enum):
    """Whether a part of the powertrain is there."""

    FOUND = "it reduces the error of runs left out"
    NOT_NEEDED = "it does not reduce the error of runs left out"
    NOT_EXCITED = "the commands would not show it"


class Part(NamedTuple):
    """One part of the powertrain, with its 95 % interval over runs; NaN where it was not found.

    ``gain_ratio`` is what it removes, beside the others, of the squared error of runs left out.  A delay of wheels
    that then follow at once is known to a period of the logger at the best.
    """

    name: str
    status: PartStatus
    value: float = math.nan
    low: float = math.nan
    high: float = math.nan
    gain_ratio: float = math.nan

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        named = {"name": self.name, "unit": self.name.rpartition("_")[2], "status": self.status.name.lower()}
        return {**named, "value": self.value, "ci": (self.low, self.high), "held_out_gain": self.gain_ratio}


class Powertrain(NamedTuple):
    """From commanded to measured wheel speeds."""

    #: in the order of :data:`NAMES`; without those of two sides where a robot has not just two
    parts: tuple[Part, ...] = ()
    rms_before_radps: float = (
        math.nan
    )  #: measured minus commanded, and minus predicted of runs left out of the fit
    rms_after_radps: float = math.nan
    #: of the squared error of these runs, over that of the commands, with its 95 % interval over runs
    reduction: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    hold_s: float = math.nan  #: period at which new wheel speeds are logged
    n_runs: int = 0
    reason: str = ""  #: why nothing of it is known; empty where it is

    @property
    def found(self) -> tuple[Part, ...]:
        """Parts that are there."""
        return tuple(part for part in self.parts if part.status is PartStatus.FOUND)

    @property
    def is_scaled(self) -> bool:
        """Whether commands are no wheel speeds: a gain is not 1."""
        return any(abs(part.value - 1.0) > SCALE_TOLERANCE for part in self.found if "gain" in part.name)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found, with its interval, what that gains, and what was not excited; or why it is not known."""
        if self.reason:
            return (f"The wheel speeds are not compared with their commands: {self.reason}.",)
        missed = [KINDS[part.name].label for part in self.parts if part.status is PartStatus.NOT_EXCITED]
        last = [f"The commands would not have shown {listed(missed, 'or')}."] if missed else []
        if not self.found:
            return ("The wheels turn as they are commanded, as far as the runs show it.", *last)
        stated = []
        for part in self.found:
            words = KINDS[part.name].words.format(f"{part.value:.3g}")
            stated.append(f"{words[0].upper()}{words[1:]} ({part.low:.3g} to {part.high:.3g}).")
        if self.is_scaled:
            stated.append("The commands are no wheel speeds: they are scaled before the wheels get them.")
        ratio, low, high = self.reduction
        stated.append(
            f"On runs left out of the fit the wheel speeds are then off by {self.rms_after_radps:.3g} rad/s "
            f"rms instead of {self.rms_before_radps:.3g}, a squared error less by {ratio:.1%} ({low:.1%} to "
            f"{high:.1%})."
        )
        return (*stated, *last)

    def as_json(self) -> dict[str, Any]:
        """Return the answer as JSON has it."""
        if self.reason:
            return {"measured": False, "reason": self.reason, "sentences": self.sentences}
        fields = {name: value for name, value in self._asdict().items() if name != "reason"}
        return {"measured": True, "sentences": self.sentences, **fields}


class Traces(NamedTuple):
    """All runs on one grid."""

    area_rad: Array  #: (m, wheels) integrals of the commands from the start of each run
    first: Array  #: (runs + 1,) rows of each run in the grid
    start_radps: Array  #: (runs, wheels) first measured wheel speeds
    run: Array  #: (n,) number of the run of each sample
    place: Array  #: (n,) of each sample in the grid of its run, in steps
    measured: Array  #: (n, wheels) wheel speeds
    new: Array  #: (n, wheels) 1 where a sample of a wheel is new, else 0


def powertrain_of(
    runs: Sequence[RunLog], robot: Robot, faults: Sequence[Fault] = (), seed: int = 0
) -> Powertrain | None:
    """Return what is between commanded and measured wheel speeds; None where no run logs both.

    Parameters
    ----------
    runs : with a stream ``commands`` that has a channel ``wheel_<wheel>_radps`` for each wheel
    robot : names of its wheels, wheel radius and reduction
    faults : of their logs; runs whose wheel speeds have one are left out
    seed : of the folds and of the bootstrap
    """
    commanded = [run for run in runs if _is_commanded(run, robot)]
    if not commanded:
        return None
    faulty = {run_id for fault in faults if fault.change.of_wheels for run_id in fault.run_ids}
    traces, hold_s = traces_of([run for run in commanded if run.run_id not in faulty], robot)
    n_runs = len(traces.start_radps)
    if n_runs < MIN_RUNS:
        left_out = f" ({len(faulty)} have a fault of their wheel speeds)" if faulty else ""
        return Powertrain(
            reason=f"runs: {n_runs} have commanded and measured wheel speeds; at least {MIN_RUNS} are "
            f"required{left_out}"
        )
    two_sides = traces.measured.shape[1] == 2
    candidates = [name for name in NAMES if two_sides or name not in OF_TWO_SIDES]
    fold = deal(np.arange(n_runs), FOLDS, np.random.default_rng(seed))
    draws = bootstrap_counts(n_runs, DRAWS, seed)
    gains, values, error = _select_parts(traces, candidates, fold, draws)
    values, fit = _fit(traces, list(gains), values)
    parts = []
    for name in candidates:
        if name not in gains:
            seen = PartStatus.NOT_NEEDED if _is_excited(traces, values, name) else PartStatus.NOT_EXCITED
            parts.append(Part(name, seen))
            continue
        assert fit is not None
        room_s = GRID_ROOM_S if name in ("delay_s", "time_constant_s") else 0.0
        if name == "delay_s" and not {"time_constant_s", "slew_radps2"} & gains.keys():
            room_s += hold_s  # the next sample shows all of a step
        low, high = fit.interval[:, list(gains).index(name)]
        low, high = (
            max(float(low) - room_s, KINDS[name].low, 0.0),
            min(float(high), KINDS[name].high) + room_s,
        )
        parts.append(Part(name, PartStatus.FOUND, float(values[NAMES.index(name)]), low, high, gains[name]))
    raw = squared_errors(traces, ABSENT)
    reduction = (0.0, 0.0, 0.0)
    if raw.sum() > 0:
        drawn = 1.0 - (draws @ error) / np.maximum(draws @ raw, 1e-12)
        reduction = (1.0 - float(error.sum() / raw.sum()), *percentile_interval(drawn))
    before, after = (math.sqrt(float(each.sum()) / int(traces.new.sum())) for each in (raw, error))
    return Powertrain(tuple(parts), before, after, reduction, hold_s, n_runs)


def _is_commanded(run: RunLog, robot: Robot) -> bool:
    """Return whether a run logs the commanded and the measured speed of each wheel."""
    if not {"commands", "wheels"} <= run.streams.keys():
        return False
    ordered = {f"wheel_{wheel}_radps" for wheel in robot.logged_wheels}
    commanded = ordered <= set(run.streams["commands"].channels)
    return commanded and set(robot.rate_channels) <= set(run.streams["wheels"].channels)


def traces_of(runs: Sequence[RunLog], robot: Robot) -> tuple[Traces, float]:
    """Return runs that log commanded and measured wheel speeds on one grid, and the period of new samples (s)."""
    per_radps = robot.logged_rates(np.full(len(robot.wheels), robot.wheel_radius_m))
    n_wheels = len(robot.rate_channels)
    traced: list[tuple[Any, ...]] = []
    for run in runs:
        commands, wheels = run.streams["commands"], run.streams["wheels"]
        rates = np.column_stack([wheels.channel(name) for name in robot.rate_channels]) / per_radps
        orders = np.column_stack([commands.channel(f"wheel_{wheel}_radps") for wheel in robot.logged_wheels])
        inside = (wheels.time_s >= commands.time_s[0]) & (wheels.time_s <= commands.time_s[-1])
        inside &= np.isfinite(rates).all(axis=1)
        time_s, rates = wheels.time_s[inside], rates[inside]
        if len(time_s) < 3 or not np.isfinite(orders).all():
            continue
        new, hold_s = _new_samples(time_s, rates)
        some = new.any(axis=1)
        if some.any():
            grid_s = np.arange(time_s[0], time_s[-1] + 2.0 * STEP_S, STEP_S)
            area = np.column_stack([_integral(grid_s, commands.time_s, held) for held in orders.T])
            traced.append(
                (area, rates[0], (time_s[some] - grid_s[0]) / STEP_S, rates[some], new[some], hold_s)
            )
    if not traced:
        none = np.empty((0, n_wheels))
        return Traces(none, np.zeros(1, int), none, np.empty(0, int), np.empty(0), none, none), math.nan
    areas, start, place, measured, news = ([each[i] for each in traced] for i in range(5))
    first = np.cumsum([0, *map(len, areas)])
    of_run = np.repeat(np.arange(len(traced)), [len(each) for each in place])
    columns = np.concatenate(place), np.vstack(measured), np.vstack(news).astype(float)
    hold_s = float(np.median([each[5] for each in traced]))
    return Traces(np.vstack(areas), first, np.vstack(start), of_run, *columns), hold_s


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
def follow(area_rad: Array, start_radps: Array, values: Array, dt: float) -> Array:
    """Return wheel speeds (m, wheels) that follow commands.

    Parameters
    ----------
    area_rad : (m, wheels) integral of the commands (rad/s) up to each step
    start_radps : (wheels,) wheel speeds until the first command arrives
    values : (len(NAMES),) of the parts
    dt : step in s

    Examples
    --------
    A step from 0 to 1 rad/s, a tenth of a second late:

    >>> step = np.maximum(np.arange(40) - 9.0, 0.0)[:, None] * 0.01
    >>> late = np.where(np.array(NAMES) == "delay_s", 0.1, ABSENT)
    >>> follow(step, np.zeros(1), late, 0.01)[[18, 20], 0]
    array([0., 1.])
    """
    p = values.view(VALUES)[0]
    m, wheels = area_rad.shape
    out = np.empty((m, wheels))
    state, x = start_radps.copy(), np.empty(wheels)
    late = p.delay_s / dt
    quick = 1.0 - math.exp(-dt / p.time_constant_s) if p.time_constant_s > 0.0 else 1.0
    furthest = p.slew_radps2 * dt
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
                common, half = (
                    0.5 * p.gain_ratio * (x[1] + x[0]),
                    0.5 * p.difference_gain_ratio * (x[1] - x[0]),
                )
                common = min(max(common, -p.common_limit_radps), p.common_limit_radps)
                half = min(max(half, -p.difference_limit_radps), p.difference_limit_radps)
                x[0], x[1] = common - half, common + half
            for j in range(wheels):
                goal = x[j] if wheels == 2 else p.gain_ratio * x[j]
                size = abs(goal)
                if size < 2.0 * p.deadband_radps:
                    goal = math.copysign(max(2.0 * (size - p.deadband_radps), 0.0), goal)
                goal = min(max(goal, -p.wheel_limit_radps), p.wheel_limit_radps)
                state[j] += min(max(quick * (goal - state[j]), -furthest), furthest)
        out[k] = state
    return out


@njit
def predict(traces: Traces, values: Array) -> Array:
    """Return predicted wheel speeds (n, wheels) at the samples of all runs."""
    out, n = np.empty_like(traces.measured), 0
    for run in range(traces.start_radps.shape[0]):
        area = traces.area_rad[traces.first[run] : traces.first[run + 1]]
        speed = follow(area, traces.start_radps[run], values, STEP_S)
        while n < traces.run.size and traces.run[n] == run:
            k = min(int(traces.place[n]), len(speed) - 2)
            for j in range(out.shape[1]):
                out[n, j] = speed[k, j] + (traces.place[n] - k) * (speed[k + 1, j] - speed[k, j])
            n += 1
    return out


def left_over(traces: Traces, values: Array) -> Array:
    """Return measured minus predicted wheel speeds (n, wheels), 0 where a sample is not new."""
    return np.asarray((traces.measured - predict(traces, values)) * traces.new)


def squared_errors(traces: Traces, values: Array) -> Array:
    """Return the sum of the squared errors of each run (runs,)."""
    return np.bincount(traces.run, (left_over(traces, values) ** 2).sum(axis=1))


def _fit(
    traces: Traces, names: Sequence[str], start: Array, used: Array | None = None
) -> tuple[Array, Fit | None]:
    """Return the values of all parts, those named fitted to some runs, to all by default; and the fit."""
    if not names:
        return start, None
    at = [NAMES.index(name) for name in names]
    weight = np.ones((len(traces.run), 1))
    if used is not None:
        weight[:, 0] = np.isin(traces.run, used)

    def inserted(values: Array) -> Array:
        whole = start.copy()
        whole[at] = values
        return whole

    def derivative(values: Array) -> Array:
        columns = []
        for i, name in zip(at, names, strict=True):
            ahead, back = inserted(values), inserted(values)
            ahead[i] += KINDS[name].step
            back[i] = max(back[i] - KINDS[name].step, KINDS[name].low)
            change = (predict(traces, ahead) - predict(traces, back)) / (ahead[i] - back[i])
            columns.append(-np.ravel(change * traces.new * weight))
        return np.column_stack(columns)

    fit = identify(
        lambda values: left_over(traces, inserted(values)) * weight,
        [
            Parameter(name, start[i], KINDS[name].low, KINDS[name].high, step=KINDS[name].usual)
            for i, name in zip(at, names, strict=True)
        ],
        clusters=traces.run if used is None else None,
        derivative=derivative,
        ftol=TOLERANCE,
    )
    return inserted(fit.value), fit


def _left_out(traces: Traces, names: Sequence[str], start: Array, fold: Array) -> Array:
    """Return the squared error of each run (runs,), of a fit that it is left out of."""
    error = np.empty(len(fold))
    for train, test in folds(fold):
        error[test] = squared_errors(traces, _fit(traces, names, start, train)[0])[test]
    return error


def _is_less(after: Array, before: Array, draws: Array) -> bool:
    """Return whether squared errors (runs,) are less over bootstrap samples of the runs (n_draws, runs).

    The level leaves to all parts together what an interval leaves to one.
    """
    return percentile_interval(draws @ (before - after), 1.0 - (1.0 - LEVEL) / len(NAMES))[0] > 0.0


def _select_parts(
    traces: Traces, candidates: Sequence[str], fold: Array, draws: Array
) -> tuple[dict[str, float], Array, Array]:
    """Return the parts that reduce the error of runs left out, each with what it removes beside the others.

    Further returned are all values, and the squared error of each run (runs,) left out.  Parts are added one at a
    time; those that a later one made needless are dropped again.
    """
    present: list[str] = []
    values, error = ABSENT, squared_errors(traces, ABSENT)
    added = True
    while added:
        least = (1.0 - MIN_GAIN_RATIO) * float(squared_errors(traces, values).sum())
        fits = {}
        for name in candidates:
            if name not in present:
                fitted = _fit(traces, [*present, name], _started(traces, values, name))[0]
                fits[name] = float(squared_errors(traces, fitted).sum()), fitted
        added = False
        for name in sorted(fits, key=lambda name: fits[name][0]):
            size, fitted = fits[name]
            if size < least:
                left = _left_out(traces, [*present, name], fitted, fold)
                if _is_less(left, error, draws):
                    present, values, error = sorted([*present, name], key=NAMES.index), fitted, left
                    added = True
                    break
    while True:
        error = _left_out(traces, present, values, fold)
        gains, needless = {}, {}
        for name in present:
            rest = [other for other in present if other != name]
            without = np.where(np.array(NAMES) == name, ABSENT, values)
            without = _fit(traces, rest, without)[0]
            left = _left_out(traces, rest, without, fold)
            gains[name] = float(1.0 - error.sum() / left.sum())
            if not _is_less(error, left, draws):
                needless[name] = rest, without
        if not needless:
            return gains, values, error
        present, values = needless[min(needless, key=lambda name: gains[name])]


def _started(traces: Traces, values: Array, name: str) -> Array:
    """Return the values with a part added, at the best of those that its fit may start from."""
    kind, top = KINDS[name], float(np.abs(traces.measured).max())
    starts = kind.starts or tuple(ratio * top for ratio in LIMIT_STARTS)
    shorter = values.copy()
    shorter[NAMES.index("time_constant_s")] *= 0.5  # a slew limit takes over much of it
    points = np.repeat([values, shorter], len(starts), axis=0)
    points[:, NAMES.index(name)] = np.clip(np.tile(starts, 2), kind.low, kind.high)
    return np.asarray(min(points, key=lambda point: float(squared_errors(traces, point).sum())))


def _is_excited(traces: Traces, values: Array, name: str) -> bool:
    """Return whether a part of a usual size would change the wheel speeds noticeably.

    The runs then start at the speeds that their first commands lead to: noise of the first samples is no motion.
    """
    there = np.where(np.array(NAMES) == name, KINDS[name].usual, values)
    at_once = np.where(np.isin(NAMES, ("delay_s", "time_constant_s", "slew_radps2")), ABSENT, values)
    none = np.zeros(traces.measured.shape[1])
    settled = [follow(traces.area_rad[k : k + 2], none, at_once, STEP_S)[1] for k in traces.first[:-1]]
    traces = traces._replace(start_radps=np.array(settled))
    change = (predict(traces, there) - predict(traces, values)) * traces.new
    scatter = np.bincount(traces.run, 2.0 * (change * left_over(traces, values)).sum(axis=1))
    least = MIN_GAIN_RATIO * float(squared_errors(traces, values).sum())
    return float((change**2).sum()) > max(EXCITED_SIGMAS * float(np.linalg.norm(scatter)), least, 1e-9)
