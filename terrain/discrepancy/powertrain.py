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
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import LEVEL, bootstrap_counts, percentile_interval
from terrain.discrepancy.health.fault import Fault
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


def traces_of(runs: Sequence[RunLog], robot: Robot) -> tuple[Traces, float]:
    """Return runs that log commanded and measured wheel speeds on one grid, and the period of new samples (s).

    Samples are new that differ from the one before; what stays the same for twice the period of these is new as well:
    a wheel that turns steadily.
    """
    per_radps = robot.logged_rates(np.full(len(robot.wheels), robot.wheel_radius_m))
    none = np.empty((0, len(robot.rate_channels)))
    areas, starts, places, measured, news, holds = [none], [none], [np.empty(0)], [none], [none], []
    for run in runs:
        commands, wheels = run.streams["commands"], run.streams["wheels"]
        rates = wheels.columns(robot.rate_channels) / per_radps
        orders = commands.columns(f"wheel_{wheel}_radps" for wheel in robot.logged_wheels)
        inside = (wheels.time_s >= commands.time_s[0]) & (wheels.time_s <= commands.time_s[-1])
        inside &= np.isfinite(rates).all(axis=1)
        time_s, rates = wheels.time_s[inside], rates[inside]
        if len(time_s) < 3 or not np.isfinite(orders).all():
            continue
        new = np.diff(rates, axis=0, prepend=rates[:1]) != 0.0
        between = np.concatenate([np.diff(np.flatnonzero(column)) for column in new.T])
        every = int(np.median(between)) if between.size else 1
        for column in new.T:
            last = 0
            for k in range(1, len(time_s)):
                if column[k] or k - last >= 2 * every:
                    column[k], last = True, k
        some = new.any(axis=1)
        if not some.any():
            continue
        grid_s = np.arange(time_s[0], time_s[-1] + 2.0 * STEP_S, STEP_S)
        # integral of a command that is held from stamp to stamp, and after the last
        sums = np.cumsum(orders[:-1] * np.diff(commands.time_s)[:, None], axis=0)
        area = np.maximum(grid_s - commands.time_s[-1], 0.0)[:, None] * orders[-1]
        for j, column in enumerate(sums.T):
            area[:, j] += np.interp(grid_s, commands.time_s, np.concatenate([[0.0], column]))
        areas.append(area)
        starts.append(rates[:1])
        places.append((time_s[some] - grid_s[0]) / STEP_S)
        measured.append(rates[some])
        news.append(new[some].astype(float))
        holds.append(every * float(np.median(np.diff(time_s))))
    first = np.cumsum([len(area) for area in areas])
    of_run = np.repeat(np.arange(len(holds)), [len(place) for place in places[1:]])
    samples = np.concatenate(places), np.vstack(measured), np.vstack(news)
    hold_s = float(np.median(holds)) if holds else math.nan
    return Traces(np.vstack(areas), first, np.vstack(starts), of_run, *samples), hold_s


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


def powertrain_of(
    runs: Sequence[RunLog], robot: Robot, faults: Sequence[Fault] = (), seed: int = 0
) -> Powertrain | None:
    """Return what is between commanded and measured wheel speeds; None where no run logs both.

    Parts are added one at a time, each the one that leaves least; those that a later one made needless are dropped
    again.  A part's gain is what it removes, beside the others, of the squared error of runs left out.

    Parameters
    ----------
    runs : with a stream ``commands`` that has a channel ``wheel_<wheel>_radps`` for each wheel
    robot : names of its wheels, wheel radius and reduction
    faults : of their logs; runs whose wheel speeds have one are left out
    seed : of the folds and of the bootstrap
    """
    ordered, commanded = {f"wheel_{wheel}_radps" for wheel in robot.logged_wheels}, []
    for run in runs:
        if {"commands", "wheels"} <= run.streams.keys():
            both = ordered <= set(run.streams["commands"].channels)
            if both and set(robot.rate_channels) <= set(run.streams["wheels"].channels):
                commanded.append(run)
    if not commanded:
        return None
    faulty = {run_id for fault in faults if fault.change.of_wheels for run_id in fault.run_ids}
    traces, hold_s = traces_of([run for run in commanded if run.run_id not in faulty], robot)
    n_runs, n_wheels = traces.start_radps.shape
    if n_runs < MIN_RUNS:
        left_out = f" ({len(faulty)} have a fault of their wheel speeds)" if faulty else ""
        return Powertrain(
            reason=f"runs: {n_runs} have commanded and measured wheel speeds; at least {MIN_RUNS} are "
            f"required{left_out}"
        )
    names = np.array(NAMES)
    fold = deal(np.arange(n_runs), FOLDS, np.random.default_rng(seed))
    draws = bootstrap_counts(n_runs, DRAWS, seed)

    def left_over(values: Array) -> Array:
        """Return measured minus predicted wheel speeds (n, wheels), 0 where a sample is not new."""
        return np.asarray((traces.measured - predict(traces, values)) * traces.new)

    def squared_errors(values: Array) -> Array:
        """Return the sum of the squared errors of each run (runs,)."""
        return np.bincount(traces.run, (left_over(values) ** 2).sum(axis=1))

    def fit_parts(some: Sequence[str], start: Array, used: Array | None = None) -> tuple[Array, Fit | None]:
        """Return the values of all parts, those named fitted to some runs, to all by default; and the fit."""
        if not some:
            return start, None
        at = [NAMES.index(name) for name in some]
        weight = np.ones((len(traces.run), 1)) if used is None else np.isin(traces.run, used)[:, None] * 1.0

        def inserted(values: Array) -> Array:
            whole = start.copy()
            whole[at] = values
            return whole

        def derivative(values: Array) -> Array:
            columns = []
            for i, name in zip(at, some, strict=True):
                ahead, back = inserted(values), inserted(values)
                ahead[i] += KINDS[name].step
                back[i] = max(back[i] - KINDS[name].step, KINDS[name].low)
                change = (predict(traces, ahead) - predict(traces, back)) / (ahead[i] - back[i])
                columns.append(-np.ravel(change * traces.new * weight))
            return np.column_stack(columns)

        parameters = []
        for i, name in zip(at, some, strict=True):
            kind = KINDS[name]
            parameters.append(Parameter(name, start[i], kind.low, kind.high, step=kind.usual))
        fit = identify(
            lambda values: left_over(inserted(values)) * weight,
            parameters,
            clusters=traces.run if used is None else None,
            derivative=derivative,
            ftol=TOLERANCE,
        )
        return inserted(fit.value), fit

    def held_out_errors(some: Sequence[str], start: Array) -> Array:
        """Return the squared error of each run (runs,), of a fit that it is left out of."""
        error = np.empty(n_runs)
        for train, test in folds(fold):
            error[test] = squared_errors(fit_parts(some, start, train)[0])[test]
        return error

    def is_less(after: Array, before: Array) -> bool:
        """Return whether squared errors (runs,) are less over bootstrap samples of the runs.

        The level leaves to all parts together what an interval leaves to one.
        """
        return percentile_interval(draws @ (before - after), 1.0 - (1.0 - LEVEL) / len(NAMES))[0] > 0.0

    candidates = [name for name in NAMES if n_wheels == 2 or name not in OF_TWO_SIDES]
    present: list[str] = []
    values, raw = ABSENT, squared_errors(ABSENT)
    error, top, added = raw, float(np.abs(traces.measured).max()), True
    while added:
        added, fits = False, []
        least = (1.0 - MIN_GAIN_RATIO) * float(squared_errors(values).sum())
        for name in (name for name in candidates if name not in present):
            # from the best of the values that a fit may start from
            kind, i = KINDS[name], NAMES.index(name)
            starts = kind.starts or tuple(ratio * top for ratio in LIMIT_STARTS)
            shorter = np.where(
                names == "time_constant_s", 0.5 * values, values
            )  # a slew limit takes over much of it
            points = np.repeat([values, shorter], len(starts), axis=0)
            points[:, i] = np.clip(np.tile(starts, 2), kind.low, kind.high)
            sizes = [float(squared_errors(point).sum()) for point in points]
            fitted = fit_parts([*present, name], points[int(np.argmin(sizes))])[0]
            fits.append((float(squared_errors(fitted).sum()), name, fitted))
        for size, name, fitted in sorted(fits, key=itemgetter(0)):
            left = held_out_errors([*present, name], fitted) if size < least else error
            if size < least and is_less(left, error):
                present, values, error = sorted([*present, name], key=NAMES.index), fitted, left
                added = True
                break
    while True:
        error, gains, needless = held_out_errors(present, values), {}, {}
        for name in present:
            rest = [other for other in present if other != name]
            without = fit_parts(rest, np.where(names == name, ABSENT, values))[0]
            left = held_out_errors(rest, without)
            gains[name] = float(1.0 - error.sum() / left.sum())
            if not is_less(error, left):
                needless[name] = rest, without
        if not needless:
            break
        present, values = needless[min(needless, key=lambda name: gains[name])]
    values, fit = fit_parts(present, values)

    # Whether a part of a usual size would change the wheel speeds noticeably: runs then start at the speeds that
    # their first commands lead to, since noise of the first samples is no motion.
    at_once = np.where(np.isin(names, ("delay_s", "time_constant_s", "slew_radps2")), ABSENT, values)
    first = [traces.area_rad[k : k + 2] for k in traces.first[:-1]]
    settled = [follow(area, np.zeros(n_wheels), at_once, STEP_S)[1] for area in first]
    steady = traces._replace(start_radps=np.array(settled))
    now = predict(steady, values)
    misses = (traces.measured - now) * traces.new
    least = max(MIN_GAIN_RATIO * float((misses**2).sum()), 1e-9)
    parts = []
    for i, name in enumerate(NAMES):
        kind = KINDS[name]
        if name in present:
            assert fit is not None
            room_s = GRID_ROOM_S if name in ("delay_s", "time_constant_s") else 0.0
            if name == "delay_s" and not {"time_constant_s", "slew_radps2"} & {*present}:
                room_s += hold_s  # the next sample shows all of a step
            low, high = fit.interval[:, present.index(name)].tolist()
            ends = max(low - room_s, kind.low, 0.0), min(high, kind.high) + room_s
            parts.append(Part(name, PartStatus.FOUND, float(values[i]), *ends, gains[name]))
        elif name in candidates:
            change = (predict(steady, np.where(names == name, kind.usual, values)) - now) * traces.new
            scatter = np.linalg.norm(np.bincount(traces.run, 2.0 * (change * misses).sum(axis=1)))
            seen = float((change**2).sum()) > max(EXCITED_SIGMAS * float(scatter), least)
            parts.append(Part(name, PartStatus.NOT_NEEDED if seen else PartStatus.NOT_EXCITED))
    reduction = (0.0, 0.0, 0.0)
    if raw.sum() > 0:
        drawn = 1.0 - (draws @ error) / np.maximum(draws @ raw, 1e-12)
        reduction = (1.0 - float(error.sum() / raw.sum()), *percentile_interval(drawn))
    n_new = int(traces.new.sum())
    before, after = math.sqrt(float(raw.sum()) / n_new), math.sqrt(float(error.sum()) / n_new)
    return Powertrain(tuple(parts), before, after, reduction, hold_s, n_runs)
