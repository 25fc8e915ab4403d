"""Faults of channels: what is wrong with a column of the logs, in words, with its repair."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from enum import StrEnum
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.discrepancy.clocks import CLOCKED, INDEPENDENT_HZ, Latencies, Shift, latencies_of
from terrain.discrepancy.residuals import INPUTS, LowPass, Rows, rows_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import (
    ACCEL,
    CHANNELS,
    CURRENT,
    GYRO,
    HEADING,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
)
from terrain.records import Array
from terrain.robots import Robot

# -- How each run responds to its wheels: measured beside predicted on one clock, and the gain between them --

G, X, Y, A, AMPS, T, H = (
    CHANNELS.index(name) for name in (GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING)
)
"""Columns of the channels."""

MOTION = (G, X, H)
"""Channels that follow the wheels whatever the effects are: of a lateral speed, a lever arm sets the sign."""

CLOCK_OF = {G: GYRO, X: SPEED_X, Y: SPEED_X, A: GYRO, H: HEADING}
"""Channel that measures the clock of a channel; currents are on that of the wheels."""

LEAST = {G: 0.1, X: 0.08, Y: 0.03, A: 0.1, AMPS: 0.5, T: 0.5, H: 0.1}
"""Root mean square of a prediction (rad/s, m/s, m/s^2, A) from which a run is asked for its response: several
times the bias and noise of the sensors."""

MAX_FIT = 0.9999
"""Largest correlation that counts: beyond it the noise of the sensors decides."""


class Response(NamedTuple):
    """A run, each measured row beside the prediction of its own clock.

    Parameters
    ----------
    run_id, terrain : of the run
    period_s : of its rows
    measured, predicted : (m, channels)
    climb_mps2 : (m,) part of the predicted specific force that is gravity
    """

    run_id: str
    terrain: str
    period_s: float
    measured: Array
    predicted: Array
    climb_mps2: Array


def responses_of(
    rows: Sequence[Rows], latencies: Latencies | None = None, shift: Shift | None = None
) -> tuple[Response, ...]:
    """Return the responses of runs, each channel on its clock.

    Parameters
    ----------
    rows : of all runs
    latencies : of all runs together; without them the medians of those that each run measures
    shift : of each run, where it measures one of its own
    """
    common: dict[str, float] = {}
    if latencies is not None:
        common = {lag.channel: lag.lag_s for lag in latencies.channels}
    elif shift is not None:
        for name, lag_s in zip(CLOCKED, shift.lag_s.T, strict=True):
            if np.isfinite(lag_s).any():
                common[name] = float(np.median(lag_s[np.isfinite(lag_s)]))
    usual_s = float(np.median(list(common.values()))) if common else 0.0
    found = []
    for i, run in enumerate(rows):
        own = {} if shift is None else dict(zip(CLOCKED, shift.lag_s[i], strict=True))
        known = {name: float(lag) for name, lag in own.items() if np.isfinite(lag)}
        predicted = run.predicted.copy()
        centred_s = run.time_s - run.time_s.mean() if run.time_s.size else run.time_s
        rate = 0.0 if shift is None else shift.rate
        for c, name in CLOCK_OF.items() if run.time_s.size else ():
            late_s = known.get(name, common.get(name, usual_s)) + rate * centred_s
            predicted[:, c] = np.interp(run.time_s - late_s, run.time_s, run.predicted[:, c])
        period_s = float(np.median(np.diff(run.time_s))) if run.time_s.size > 1 else 0.0
        climb = GRAVITY_MPS2 * np.sin(run.inputs[:, INPUTS.index("grade_rad")])
        found.append(Response(run.run_id, run.terrain, period_s, run.measured, predicted, climb))
    return tuple(found)


def fits(response: Response) -> tuple[Array, Array]:
    """Return correlation about zero of each channel (channels,), and twice the log-likelihood that it gains.

    Both are 0 where the prediction is too small to ask for.  The accelerometer's is about its mean, since
    its bias is large.
    """
    measured, predicted = response.measured, response.predicted
    known = np.isfinite(measured) & np.isfinite(predicted)
    n = known.sum(axis=0)
    m, p = np.where(known, measured, 0.0), np.where(known, predicted, 0.0)
    if n[A]:
        for each in (m, p):
            each[:, A] -= np.where(known[:, A], each[:, A].sum() / n[A], 0.0)
    power = (p * p).sum(axis=0)
    asked = np.sqrt(power / np.maximum(n, 1)) > np.array([LEAST[c] for c in range(len(CHANNELS))])
    norm = np.sqrt(power * (m * m).sum(axis=0))
    correlation = np.divide((m * p).sum(axis=0), norm, out=np.zeros(len(n)), where=asked & (norm > 0))
    ahead = np.clip(correlation, 0.0, MAX_FIT)
    n_independent = n * min(response.period_s * INDEPENDENT_HZ, 1.0)
    return correlation, -n_independent * np.log1p(-(ahead**2))


def gains_of(response: Response) -> tuple[Array, Array]:
    """Return the gain of each channel (channels,) about zero, and its correlation; NaN and 0 where unknown.

    The accelerometer's is that of its acceleration, beside gravity and a bias.
    """
    correlation = fits(response)[0]
    known = np.isfinite(response.measured) & np.isfinite(response.predicted)
    m, p = np.where(known, response.measured, 0.0), np.where(known, response.predicted, 0.0)
    power = (p * p).sum(axis=0)
    gain = np.divide((m * p).sum(axis=0), power, out=np.full(len(power), np.nan), where=correlation != 0.0)
    rows = known[:, A]
    if correlation[A] != 0.0:
        climb = response.climb_mps2[rows]
        basis = np.column_stack([p[rows, A] - climb, climb, np.ones(climb.size)])
        if np.std(basis[:, 0]) > 0.5 * LEAST[A]:
            gain[A] = np.linalg.lstsq(basis, m[rows, A], rcond=None)[0][0]
        else:
            gain[A] = np.nan
    return gain, correlation


# -- A fault: what is wrong with a column, in words, with its repair ------------------------------------------

MIN_FAULTY_RATIO = 0.05
"""A fault of a logger is in that ratio of the runs at the least: units and zeros are set once, and a run in a
hundred that is off is one whose sensor failed, which is no reason to repair it."""


class FaultKind(StrEnum):
    """What is wrong with a column."""

    SIGN = "sign"
    UNIT = "unit"
    SWAPPED = "swapped"
    OFFSET = "offset"


class Column(StrEnum):
    """Columns of a log that have faults of their own, as sentences name them."""

    GYRO = "gyro"
    HEADING = "heading rate"
    SPEED = "speed over ground"
    ACCEL = "accelerometer"
    CURRENTS = "currents"
    WHEELS = "wheel speeds"
    SIDES = "wheel speeds and currents"


CHANNELS_OF: dict[Column, tuple[int, ...]] = {
    Column.GYRO: (G,),
    Column.HEADING: (H,),
    Column.SPEED: (X, Y),
    Column.ACCEL: (A,),
    Column.CURRENTS: (AMPS, T),
    Column.WHEELS: (),
    Column.SIDES: (),
}
"""Measured channels of each; those of wheels are the inputs of the simulation."""

LOGGED: dict[Column, str] = {
    Column.GYRO: "gyro_z_radps",
    Column.HEADING: "yaw_rate_radps",
    Column.SPEED: "speed_x_mps and speed_y_mps",
    Column.ACCEL: "accel_x_mps2",
    Column.CURRENTS: "the currents",
    Column.WHEELS: "the wheel speeds",
    Column.SIDES: "the wheel speeds and currents",
}
"""Names as logs have them."""


class Change(NamedTuple):
    """What makes a log right again: a linear map of its columns.

    Parameters
    ----------
    kind, column : what is changed, and how
    factor : by which samples are multiplied; 1 for columns that are exchanged, NaN for one that is left out,
        since readings of it cannot be distinguished
    wheel : which wheel alone; -1 for all
    offset : that is added
    pair : wheels that are exchanged
    """

    kind: FaultKind
    column: Column
    factor: float = 1.0
    wheel: int = -1
    offset: float = 0.0
    pair: tuple[int, int] = (0, 1)

    @property
    def of_wheels(self) -> bool:
        """Whether it changes what drives the simulation."""
        return self.column in (Column.WHEELS, Column.SIDES)

    def measured(self, values: Array) -> Array:
        """Return measured channels (n, channels) as they are without the fault."""
        order, factor, offset = np.arange(len(CHANNELS)), np.ones(len(CHANNELS)), np.zeros(len(CHANNELS))
        own = list(CHANNELS_OF[self.column])
        if self.kind is not FaultKind.SWAPPED:
            factor[own], offset[own] = self.factor, self.offset
        elif self.column is Column.SPEED:
            order[[X, Y]] = Y, X
        elif self.column in (Column.CURRENTS, Column.SIDES):
            factor[T] = -1.0
        return np.asarray(values[:, order] * factor + offset)

    def applied(self, run: Signals) -> Signals:
        """Return a run without the fault."""
        measured = self.measured(run.measured)
        if not self.of_wheels:
            return replace(run, measured=measured)
        n = run.wheel_speed_mps.shape[1]
        order, factor = np.arange(n), np.ones(n)
        if self.kind is FaultKind.SWAPPED:
            order[list(self.pair)] = self.pair[::-1]
        else:
            factor[[self.wheel] if self.wheel >= 0 else slice(None)] = self.factor
        return replace(run, measured=measured, wheel_speed_mps=run.wheel_speed_mps[:, order] * factor)


class Fault(NamedTuple):
    """A fault of a column in some runs.

    Parameters
    ----------
    change : that makes the log right
    run_ids : of the runs that have it
    sentence : what is wrong, how that is seen, and what to do
    repair : what to do alone
    """

    change: Change
    run_ids: tuple[str, ...]
    sentence: str
    repair: str

    @property
    def kind(self) -> FaultKind:
        """What is wrong."""
        return self.change.kind

    @property
    def column(self) -> Column:
        """With what."""
        return self.change.column

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        of_change = {"kind": self.kind, "column": self.column, "factor": self.change.factor}
        return {**of_change, "runs": self.run_ids, "sentence": self.sentence, "repair": self.repair}


def repaired(signals: Sequence[Signals], faults: Sequence[Fault]) -> tuple[Signals, ...]:
    """Return runs without faults, in the same order: changed, or left out where it is not clear how."""
    fixed = list(signals)
    for fault in faults:
        fixed = [fault.change.applied(run) if run.run_id in fault.run_ids else run for run in fixed]
    return tuple(fixed)


def session_of(run_id: str) -> str:
    """Return the session of a run: its id without the number at its end.

    Examples
    --------
    >>> session_of("gravel_1_step_012"), session_of("SNOW_07"), session_of("step_012")
    ('gravel_1', 'SNOW', '')
    """
    return re.sub(r"[\W_]*(?:step|run)?[\W_]*\d+$", "", run_id)


def in_runs(ids: Sequence[str], every: Sequence[str]) -> str:
    """Return which runs in words: all, those of a session, or by name.

    Examples
    --------
    >>> in_runs(["a_1", "a_2"], ["a_1", "a_2", "b_1"])
    'in all 2 runs of a'
    >>> in_runs(["a_1", "b_1"], ["a_1", "b_1"]), in_runs(["a_1"], ["a_1", "a_2"])
    ('in all 2 runs', 'in 1 of 2 runs (a_1)')
    """
    sessions = list(dict.fromkeys(session_of(run_id) for run_id in ids))
    whole = [run_id for run_id in every if session_of(run_id) in sessions]
    if len(ids) == len(every):
        named = f" of {sessions[0]}" if len(sessions) == 1 and sessions[0] else ""
        return f"in all {len(ids)} runs{named}"
    if len(whole) == len(ids) and all(sessions) and len(sessions) <= 3:
        return f"in all {len(ids)} runs of {' and '.join(sessions)}"
    shown = ", ".join(ids[:5]) + (", ..." if len(ids) > 5 else "")
    return f"in {len(ids)} of {len(every)} runs ({shown})"


# -- Signs that are turned and columns that are exchanged, found by what makes all channels of a run agree --
# Every reading of a run that is one fault away is tried: a change of its measured channels, or of its wheels,
# which are then simulated again.  Under the right one all channels follow the wheels, each with a gain above
# zero; the likelihood that a reading gains is summed over the runs that it mends.

TURNED, RIGHT = 0.3, 0.7
"""A channel does not follow the wheels below the first correlation about zero, and does over the second.  Of
measured runs, those that slip hardly fall below 0.8."""

RISE, CLEAR = 0.25, 0.95
"""A channel that half follows the wheels, as one wheel's do, is mended if its correlation rises by the first
and to over the second."""

LOSS = 0.1
"""Largest loss of correlation of any other channel under a reading that mends one."""

GAIN = 20.0
"""Twice the log-likelihood that a reading has to gain in a run: odds of e^10, over a score of readings and
hundreds of runs."""

TIE, TIE_RATIO = 10.0, 0.03
"""Readings whose gains differ by less, or by less than that ratio, cannot be distinguished."""

FOLLOWERS = (*MOTION, A, AMPS, T)
"""Channels whose gain is above zero, whatever the effects are."""

WORDS = dict(zip(CHANNELS, ("gyro", "speed", "lateral speed", "accelerometer", "sum of the currents",
                            "difference of the currents", "heading rate"), strict=True))  # fmt: skip


class Reading(NamedTuple):
    """What a change makes of runs.

    Parameters
    ----------
    change : tried
    correlation : (runs, channels) under it
    gain : (runs,) of twice the log-likelihood
    mends : (runs,) whether a channel follows the wheels that did not, and none is worse
    suits : (runs,) whether the gain is as clear and none is worse; a channel may have followed before
    """

    change: Change
    correlation: Array
    gain: Array
    mends: Array
    suits: Array


def candidate_changes(robot: Robot) -> tuple[Change, ...]:
    """Return the changes that are tried, those of fewest columns first."""
    sign, swapped, n_wheels = FaultKind.SIGN, FaultKind.SWAPPED, len(robot.rate_channels)
    single = (Column.GYRO, Column.HEADING, Column.SPEED, Column.ACCEL, Column.CURRENTS)
    changes = [Change(sign, column, -1.0) for column in single]
    changes.append(Change(swapped, Column.SPEED))
    if robot.skids:
        changes += [Change(swapped, column) for column in (Column.CURRENTS, Column.WHEELS, Column.SIDES)]
    else:
        pairs = combinations(range(n_wheels), 2)
        changes += [Change(swapped, Column.WHEELS, pair=pair) for pair in pairs]
    each = range(n_wheels) if n_wheels > 1 else ()
    changes += [Change(sign, Column.WHEELS, -1.0, wheel) for wheel in (-1, *each)]
    return tuple(changes)


def is_suspect(response: Response) -> bool:
    """Whether a channel of a run that is asked does not follow the wheels well."""
    correlation = fits(response)[0]
    return any(correlation[c] != 0.0 and correlation[c] < RIGHT for c in FOLLOWERS)


def reading_of(change: Change, before: Sequence[Response], after: Sequence[Response]) -> Reading:
    """Return what a change makes of runs."""
    was, now = ([fits(run) for run in runs] for runs in (before, after))
    old, new = (np.array([each[0] for each in fitted]) for fitted in (was, now))
    gain = np.array([b[1].sum() - a[1].sum() for a, b in zip(was, now, strict=True)])
    keys = list(FOLLOWERS)
    turned = (old < TURNED) & (new > RIGHT)
    asked = old != 0.0  # what a run does not show cannot be wrong in it
    mended = (asked & (turned | ((new - old > RISE) & (new > CLEAR))))[:, keys].any(axis=1)
    worse = ((new < old - LOSS) & (old > RIGHT))[:, keys].any(axis=1)
    suits = ~worse & (gain > GAIN)
    return Reading(change, new, gain, mended & suits, suits)


def best_reading(readings: Sequence[Reading]) -> tuple[Reading, list[Reading]] | None:
    """Return the reading that gains most over the runs that it mends, and those as good on the same runs."""
    best = max(readings, key=lambda reading: float(reading.gain[reading.mends].sum()), default=None)
    if best is None or not best.mends.any():
        return None
    most = float(best.gain[best.mends].sum())
    near = [
        reading
        for reading in readings
        if reading.mends[best.mends].all()
        and most - float(reading.gain[best.mends].sum()) < max(TIE, TIE_RATIO * most)
    ]
    return near[0], near[1:]


def runs_with(reading: Reading, ids: Sequence[str], responses: Sequence[Response]) -> list[int]:
    """Return the runs that have a fault: those that it suits, and of their sessions those that cannot say.

    A run that drives straight measures no sign of a gyro; it has that of the others.
    """
    has = set(np.flatnonzero(reading.suits).tolist())
    old = np.array([fits(run)[0] for run in responses])
    mended = np.flatnonzero(reading.mends)
    shift = np.median(np.abs(reading.correlation[mended] - old[mended]), axis=0)
    shows = [c for c in FOLLOWERS if shift[c] > RISE]
    for session in {session_of(ids[i]) for i in has}:
        members = [i for i in range(len(ids)) if session_of(ids[i]) == session]
        asked = [i for i in members if (np.abs(old[i, shows]) > RIGHT).any()]
        if all(i in has for i in asked):
            has |= set(members)
    return sorted(has)


def sign_fault(
    best: Reading,
    rivals: Sequence[Reading],
    has: Sequence[int],
    responses: Sequence[Response],
    robot: Robot,
) -> Fault:
    """Return the fault of a reading, in words.

    Readings that are as good are mirror images, left for right or ahead for back: the change of fewest
    columns is taken, and the diagnosis is that of either but for the side.
    """
    change, every = best.change, [run.run_id for run in responses]
    ids = tuple(every[i] for i in has)
    where = in_runs(ids, every)
    shown = [i for i in has if best.mends[i]]
    seen = _evidence(change, responses, shown, best)
    what, repair = _fault_words(change, robot)
    other = ""
    if rivals:
        words = " or ".join(_fault_words(rival.change, robot)[0] for rival in rivals)
        other = f" (these channels cannot distinguish it from another reading: {words})"
    sentence = f"{what} {where}: {seen}{other}; {repair}"
    return Fault(change, ids, sentence, repair)


def _evidence(change: Change, responses: Sequence[Response], shown: Sequence[int], best: Reading) -> str:
    """Return how a fault is seen: the gains of the channels that it turns."""
    runs = [responses[i] for i in shown]
    gains, old = (np.array(each) for each in zip(*(gains_of(run) for run in runs), strict=True))
    new = best.correlation[list(shown)]
    own = [c for c in FOLLOWERS if c in CHANNELS_OF[change.column] or change.of_wheels]
    asked = (old != 0.0) & np.isfinite(gains)
    turned = [c for c in own if asked[:, c].any() and np.median((new - old)[asked[:, c], c]) > RISE]
    words = []
    for c in turned:
        on = asked[:, c]
        text = f"the {WORDS[CHANNELS[c]]} follows the wheels with the factor {np.median(gains[on, c]):.2f}"
        both = on & np.isfinite(gains[:, H])
        if change.column is Column.GYRO and both.any():
            ratio = float(np.median(gains[both, c] / gains[both, H]))
            text += f", and the heading rate with {ratio:.2f}"
        words.append(text)
    return " and ".join(words)


def _fault_words(change: Change, robot: Robot) -> tuple[str, str]:
    """Return a fault and its repair in words."""
    if change.kind is FaultKind.SWAPPED:
        if change.column is Column.SPEED:
            names = "speed_x_mps and speed_y_mps"
            what = "the speeds forward and to the left are exchanged"
        elif not robot.skids:
            names = " and ".join(robot.rate_channels[i] for i in change.pair)
            what = "wheel speeds of {} and {} are exchanged".format(*(robot.wheels[i] for i in change.pair))
        else:
            what = f"{change.column.value} of left and right are exchanged"
            names = {
                Column.CURRENTS: "current_left_a and current_right_a",
                Column.WHEELS: "speed_left_mps and speed_right_mps",
                Column.SIDES: "left and right of the wheel speeds, and of the currents,",
            }[change.column]
        return what, f"exchange {names} (mapping file: exchange their columns)"
    if change.wheel >= 0:
        wheel = robot.wheels[change.wheel]
        what, logged = f"the sign of the {wheel} wheel's speed is turned", f"the speed of the wheel {wheel}"
    else:
        plural = change.column in (Column.WHEELS, Column.CURRENTS)
        what = f"the sign of the {change.column.value} is turned"
        logged = LOGGED[change.column]
        if not plural:
            what = f"the {change.column.value}'s sign is turned"
    return what, f"multiply {logged} by -1 (mapping file: scale: -1)"


# -- Units that are not those of the channel's name, found by gains that no effect reaches -----------------
# The logarithms of the gains have a prior: what robots and effects do to them.  A reading of the logs in which
# a column is in another unit costs a fixed evidence, and is taken where the gains cost more without it.

DEG, RPM, KMH, MILLI = math.pi / 180.0, math.pi / 30.0, 1.0 / 3.6, 1e-3

UNITS: dict[Column, dict[str, float]] = {
    Column.GYRO: {"deg/s": DEG, "rpm": RPM},
    Column.HEADING: {"deg/s": DEG, "rpm": RPM},
    Column.SPEED: {"km/h": KMH, "mm/s": MILLI},
    Column.ACCEL: {"g": GRAVITY_MPS2},
    Column.CURRENTS: {"mA": MILLI},
    Column.WHEELS: {"deg/s": DEG, "rpm": RPM, "km/h": KMH, "mm/s": MILLI},
}
"""By column, units that loggers have, and their size in SI."""

SI = {
    Column.GYRO: "rad/s",
    Column.HEADING: "rad/s",
    Column.SPEED: "m/s",
    Column.ACCEL: "m/s^2",
    Column.CURRENTS: "A",
}

NOT_IN_MAPPINGS = ("mm/s",)
"""Units that a mapping file has no word for; there the scale is changed."""

MIN_FIT = 0.7
"""Correlation about zero from which a gain is used: of a run that hardly responds it says nothing."""

SKID_TURN, SWERVE_TURN = (math.log(0.75), 0.5, 0.35), (0.0, 0.2, 0.2)
"""Gain of the yaw rate, mean of its logarithm and standard deviations to below and above: skid-steer robots
have an effective track of 1 to 2.5 times the nominal one (Mandow et al., IROS 2007), and the bounds of the
catalogue, which are gains of 0.2 and 2, are within three; a swerve robot turns as its wheels do."""

SPEED_GAIN = (-0.08, 0.2)
"""Gain of the speed: a wheel radius may be off by 30 %, and slip takes up to a half, within three and a half
standard deviations."""

GYRO_SPREAD = 0.12
"""Of gyro over heading rate: the catalogue's bound of a gyro's scale is within three standard deviations."""

ACCEL_SPREAD = 0.25
"""Of the accelerometer over the speed: it sees bumps too."""

CURRENT_GAIN = (0.7, 1.2)
"""Of the currents: constants of motors and the resistance of a terrain are known to a factor of 10."""

COST = 16.0
"""Evidence that a unit has to bring, in minus twice the log-likelihood: four standard deviations."""

LEFT = 9.0
"""Cost of the gains under the right reading, at most: three standard deviations."""

UNIT_TIE = 1.5
"""Readings whose costs differ by less cannot be distinguished: their odds are within 2."""

MIN_USUAL_RATIO = 0.2
"""Ratio of runs without a fault, from which they are what the others are compared with."""

NEAR, TIGHT, SCATTERS = 0.35, 0.1, 3.0
"""A run of another unit than the others agrees with them after its repair: within so many times their
scatter, the second at the least and the first at the most, in the logarithm.  Where its motion would be too
small it is the second, since a run may slip or stall, by any factor."""

CLEAR_FIT = 0.95
"""Correlation of the channels of such a run, if it is another unit and nothing that changes over a run."""

KEYS = (G, X, A, AMPS, H)
"""Channels that have a gain, in the order of the columns of logarithms."""

_PLACE = {c: i for i, c in enumerate(KEYS)}
_MOTION = [_PLACE[c] for c in (G, X, A, H)]

Changes = tuple[Change, ...]


def unit_faults(responses: Sequence[Response], robot: Robot) -> tuple[Fault, ...]:
    """Return columns whose unit is not that of their name, in all runs or in some of them."""
    logs, fit = (np.array(each) for each in zip(*(_log_gains(run) for run in responses), strict=True))
    informed = [i for i in range(len(logs)) if np.isfinite(logs[i]).any()]
    if not informed:
        return ()
    options = _options(logs, robot)
    turn = SKID_TURN if robot.skids else SWERVE_TURN
    own = {i: _best(logs[i], options, turn)[0] for i in informed}
    suggested = {changes for changes in own.values() if changes}
    usual = [i for i in informed if not own[i] and any(_shows(logs[i], changes) for changes in suggested)]
    if not suggested:
        return ()
    if len(usual) < MIN_USUAL_RATIO * len(informed):
        best, rivals = _best(_middle(logs[[i for i in informed if i not in usual]]), options, turn)
        has = [i for i in range(len(logs)) if i not in usual]
        return tuple(_fault(best, change, rivals, has, responses, logs) for change in best)
    middle, scatter = _middle(logs[usual]), 1.48 * _middle(np.abs(logs[usual] - _middle(logs[usual])))
    near = np.clip(SCATTERS * np.where(np.isfinite(scatter), scatter, TIGHT), TIGHT, NEAR)
    of_runs: dict[Changes, list[int]] = {}
    for i in (i for i in informed if own[i]):
        off = np.where(fit[i] > CLEAR_FIT, logs[i], np.nan) - middle
        fitting = [changes for changes in options if changes and _agrees(off, changes, near)]
        if fitting:
            nearest = min(fitting, key=partial(_distance, off))
            of_runs.setdefault(nearest, []).append(i)
    return tuple(
        _fault(changes, change, (), has, responses, logs)
        for changes, has in of_runs.items()
        if len(has) >= MIN_FAULTY_RATIO * len(informed)
        for change in changes
    )


def _log_gains(response: Response) -> tuple[Array, Array]:
    """Return the logarithms of the gains (len(KEYS),), NaN where none is clear, and correlations."""
    gain, correlation = gains_of(response)
    clear = np.isfinite(gain) & (gain > 0) & (np.abs(correlation) > MIN_FIT)
    return np.log(np.where(clear, gain, np.nan))[list(KEYS)], correlation[list(KEYS)]


def _middle(logs: Array) -> Array:
    """Return the medians of columns, NaN where nothing is known."""
    return np.array([np.median(x[np.isfinite(x)]) if np.isfinite(x).any() else np.nan for x in logs.T])


def _options(logs: Array, robot: Robot) -> list[Changes]:
    """Return the readings: nothing, one column in another unit, or two that are measured.

    Wheels and what they turn in one other unit would hide each other: then a body that slips looks like it.
    """
    known = np.array([np.isfinite(column).any() for column in logs.T])
    units = {column: list(sizes.values()) for column, sizes in UNITS.items()}
    units[Column.WHEELS].append(robot.wheel_radius_m)  # rates of wheels in the place of speeds
    single = [
        Change(FaultKind.UNIT, column, factor)
        for column, sizes in units.items()
        if column is Column.WHEELS or any(known[_PLACE[c]] for c in CHANNELS_OF[column] if c in _PLACE)
        for size in sizes
        for factor in (size, 1.0 / size)
    ]
    measured = [change for change in single if not change.of_wheels]
    pairs = [pair for pair in combinations(measured, 2) if pair[0].column is not pair[1].column]
    return [(), *((change,) for change in single), *pairs]


def _repaired_logs(logs: Array, changes: Changes) -> Array:
    """Return the logarithms of gains after changes: of measured channels up, of a larger prediction down.

    The currents are not in proportion to the wheel speeds: beside a motion their gain says nothing of these.
    """
    after = logs.copy()
    for change in changes:
        if change.of_wheels:
            after[_MOTION] -= math.log(change.factor)
            if np.isfinite(after[_MOTION]).any():
                after[_PLACE[AMPS]] = np.nan
        else:
            for c in CHANNELS_OF[change.column]:
                if c in _PLACE:
                    after[_PLACE[c]] += math.log(change.factor)
    return after


def _cost(logs: Array, turn: tuple[float, float, float]) -> float:
    """Return minus twice the logarithm of the prior of gains, up to a constant."""
    gyro, speed, accel, current, heading = logs
    yaw = heading if math.isfinite(heading) else gyro
    along = speed if math.isfinite(speed) else SPEED_GAIN[0]
    terms = (
        (yaw - turn[0]) / (turn[1] if yaw < turn[0] else turn[2]),
        (gyro - heading) / GYRO_SPREAD,
        (speed - SPEED_GAIN[0]) / SPEED_GAIN[1],
        (accel - along) / ACCEL_SPREAD,
        (current - CURRENT_GAIN[0]) / CURRENT_GAIN[1],
    )
    return float(sum(term**2 for term in terms if math.isfinite(term)))


def _shows(logs: Array, changes: Changes) -> bool:
    """Whether a run has the channels in which changes show."""
    return not np.array_equal(_repaired_logs(logs, changes), logs, equal_nan=True)


def _best(
    logs: Array, options: Sequence[Changes], turn: tuple[float, float, float]
) -> tuple[Changes, list[Changes]]:
    """Return the reading of least cost, and those that cost hardly more."""
    costs = [_cost(_repaired_logs(logs, changes), turn) for changes in options]
    total = [cost + COST * len(changes) for cost, changes in zip(costs, options, strict=True)]
    best = int(np.argmin(total))
    if not options[best] or costs[best] > LEFT:
        return (), []
    rivals = [
        changes
        for i, changes in enumerate(options)
        if i != best and changes and len(changes) == len(options[best]) and total[i] - total[best] < UNIT_TIE
    ]
    return options[best], rivals


def _distance(off: Array, changes: Changes) -> float:
    return float(np.nansum(np.abs(_repaired_logs(off, changes)))) + COST * (len(changes) - 1)


def _agrees(off: Array, changes: Changes, near: Array) -> bool:
    """Whether a run that is off from the others agrees with them after changes, and may not just stall."""
    after = np.abs(_repaired_logs(off, changes))
    known = np.isfinite(off)
    if not known.any() or (after[known] > near[known]).any() or not (np.abs(off[known]) > 2 * NEAR).any():
        return False
    small = [i for i in _MOTION if known[i] and off[i] < -2 * NEAR]
    sound = [i for i in _MOTION if known[i] and abs(off[i]) < near[i]]  # these show that it moved
    return not small or (bool((after[small] < TIGHT).all()) and len(small) + len(sound) > 1)


def _fault(
    changes: Changes,
    change: Change,
    rivals: Sequence[Changes],
    has: Sequence[int],
    responses: Sequence[Response],
    logs: Array,
) -> Fault:
    """Return the fault of a change in words; it is left out where other readings are as good."""
    every = [run.run_id for run in responses]
    ids = tuple(every[i] for i in has)
    seen = ", ".join(_gain_words(_middle(logs[list(has)]), change.column))
    what, unit = _words(change)
    scale = unit in NOT_IN_MAPPINGS or not unit
    hint = f"scale: {change.factor:.4g}" if scale else f"unit: {unit}"
    repair = f"multiply {LOGGED[change.column]} by {change.factor:.4g} (mapping file: {hint})"
    sentence = f"{what} {in_runs(ids, every)}: {seen}"
    if not rivals:
        return Fault(change, ids, f"{sentence}; {repair}", repair)
    others = " or ".join(" and ".join(_words(each)[0] for each in reading) for reading in rivals)
    measured = next((each for reading in (changes, *rivals) for each in reading if not each.of_wheels), None)
    if measured is None:  # of the wheels in either case: without them there is nothing to compare
        sentence = f"{sentence}; another reading is as good ({others}); {repair}"
        return Fault(change, ids, sentence, repair)
    left_out = f"{LOGGED[measured.column]} is left out; state the units that the logger has"
    sentence = f"{sentence}; another reading is as good ({others}), so that {left_out}"
    return Fault(measured._replace(factor=math.nan), ids, sentence, left_out)


def _words(change: Change) -> tuple[str, str]:
    """Return what is wrong with a unit, and the unit that the samples have."""
    sizes = UNITS[change.column]
    plural = change.column in (Column.WHEELS, Column.CURRENTS)
    subject, verb = ("the " + change.column.value, "are" if plural else "is")
    for unit, size in sizes.items():
        si = SI.get(change.column, "m/s" if unit in ("km/h", "mm/s") else "rad/s")
        if math.isclose(change.factor, size):
            return f"{subject} {verb} in {unit} instead of {si}", unit
        if math.isclose(change.factor, 1.0 / size):
            return f"{subject} {verb} in {si}, and {'were' if plural else 'was'} read as {unit}", si
    if change.factor < 1.0:
        return f"{subject} are rates in rad/s instead of speeds in m/s", ""
    return f"{subject} are speeds in m/s, and were read as rates in rad/s", ""


def _gain_words(middle: Array, column: Column) -> Iterator[str]:
    names = {
        G: "the gyro reads {:.3g} times what the wheels predict",
        X: "the speed {:.3g} times",
        A: "the acceleration {:.3g} times",
        AMPS: "the currents {:.3g} times",
        H: "the heading rate {:.3g} times",
    }
    for c, place in _PLACE.items():
        if math.isfinite(middle[place]) and (c == AMPS) is (column is Column.CURRENTS):
            yield names[c].format(math.exp(middle[place]))


# -- Constant offsets of sensors that no bias of the catalogue reaches: sensors not zeroed, or turned ------

LARGEST: dict[Column, tuple[int, float, str]] = {
    Column.GYRO: (G, 0.3, "rad/s"),
    Column.HEADING: (H, 0.3, "rad/s"),
    Column.SPEED: (X, 0.3, "m/s"),
    Column.ACCEL: (A, 3.0, "m/s^2"),
}
"""Channel, offset and unit: half more than the bounds of the catalogue's biases, and for a heading rate and a
speed, which have none, as much and a slow robot's speed."""

SIGMAS = 4.0
"""An offset is over the largest by so many standard deviations."""

MIN_ROWS = 10


def offset_faults(responses: Sequence[Response]) -> tuple[Fault, ...]:
    """Return columns with an offset that no effect has, in all runs or in some of them."""
    every = [run.run_id for run in responses]
    found = []
    for column, (c, largest, unit) in LARGEST.items():
        offsets = np.array([_offset(run, c) for run in responses])
        has = np.flatnonzero(np.abs(offsets[:, 0]) > largest + SIGMAS * offsets[:, 1])
        if has.size < max(MIN_FAULTY_RATIO * np.isfinite(offsets[:, 0]).sum(), 1):
            continue
        offset = float(np.median(offsets[has, 0]))
        ids = tuple(every[i] for i in has)
        what = f"the {column.value} has an offset of {offset:.3g} {unit} {in_runs(ids, every)}"
        logged = LOGGED[column].split(" and ")[0]
        repair = f"subtract {offset:.3g} {unit} from {logged} (mapping file: offset: {-offset:.3g})"
        sentence = f"{what}, where a sensor's is below {largest:g}; {repair}"
        found.append(Fault(Change(FaultKind.OFFSET, column, offset=-offset), ids, sentence, repair))
    return tuple(found)


def _offset(run: Response, c: int) -> tuple[float, float]:
    """Return what a channel measures where nothing is predicted, and its error; NaN if unknown."""
    known = np.isfinite(run.measured[:, c]) & np.isfinite(run.predicted[:, c])
    if known.sum() < MIN_ROWS:
        return np.nan, np.nan
    measured, predicted = run.measured[known, c], run.predicted[known, c]
    if np.std(predicted) < LEAST[c] and np.sqrt(np.mean(predicted**2)) > LEAST[c]:
        return np.nan, np.nan  # of one motion throughout, a gain looks the same
    columns = [np.ones(measured.size)]
    if np.std(predicted) > LEAST[c]:
        columns.append(predicted)
    basis = np.column_stack(columns)
    value, *_ = np.linalg.lstsq(basis, measured, rcond=None)
    left = measured - basis @ value
    n_independent = max(measured.size * min(run.period_s, 1.0), 1.0)  # what is left changes within seconds
    spread = np.linalg.inv(basis.T @ basis / measured.size)[0, 0] / n_independent
    return float(value[0]), float(np.std(left) * np.sqrt(spread))


# -- Faults of channels of all runs: signs, exchanged columns and units, before any cause is searched ------

MAX_FAULTS = 4
"""Signs and exchanges that are searched one after the other; logs with more are no logs of this robot."""


def faults_of(
    signals: Sequence[Signals],
    rows: Sequence[Rows],
    simulation: Simulation,
    low_pass: LowPass,
    shift: Shift | None = None,
    latencies: Latencies | None = None,
) -> tuple[Fault, ...]:
    """Return the faults of channels, in the order in which they are to be repaired: signs, units, offsets.

    The simulation may be wrong: a fault is what no effect of the catalogue does.

    Parameters
    ----------
    signals, rows : of all runs, in the same order; the rows with the prediction of the simulation
    simulation, low_pass : of the rows
    shift, latencies : clocks of the runs where they are known already; from the runs otherwise
    """
    if latencies is None:
        latencies = latencies_of(signals, simulation)
    found: list[Fault] = []
    runs, now = tuple(signals), tuple(rows)
    responses = responses_of(now, latencies, shift)
    while len(found) < MAX_FAULTS:
        fault = _turned(runs, now, simulation, low_pass, shift, latencies, responses)
        if fault is None:
            break
        found.append(fault)
        now = _with_rows(runs, now, fault, simulation, low_pass)
        runs = repaired(runs, [fault])
        responses = responses_of(now, latencies, shift)
    units = unit_faults(responses, simulation.robot)
    for fault in units:
        now = _with_rows(runs, now, fault, simulation, low_pass)
        runs = repaired(runs, [fault])
    return (*found, *units, *offset_faults(responses_of(now, latencies, shift)))


def _turned(
    runs: Sequence[Signals],
    rows: Sequence[Rows],
    simulation: Simulation,
    low_pass: LowPass,
    shift: Shift | None,
    latencies: Latencies,
    responses: Sequence[Response],
) -> Fault | None:
    """Return the sign or exchange that mends most, or None if there is none."""
    suspects = [i for i, run in enumerate(responses) if is_suspect(run)]
    if not suspects:
        return None
    robot = simulation.robot

    def tried(change: Change, places: Iterable[int]) -> Reading:
        after = list(responses)
        for i in places:
            if change.of_wheels:
                changed = _simulated(change.applied(runs[i]), simulation, low_pass)
            else:
                changed = rows[i]._replace(measured=change.measured(rows[i].measured))
            own = None if shift is None else _of_run(shift, i)
            after[i] = responses_of([changed], latencies, own)[0]
        return reading_of(change, responses, after)

    found = best_reading([tried(change, suspects) for change in candidate_changes(robot)])
    if found is None:
        return None
    best = tried(found[0].change, range(len(runs)))
    has = runs_with(best, [run.run_id for run in runs], responses)
    return sign_fault(best, found[1], has, responses, robot)


def _of_run(shift: Shift, i: int) -> Shift:
    one = slice(i, i + 1)
    return Shift(shift.lag_s[one], shift.std_s[one], shift.rate, shift.lost[one])


def _simulated(run: Signals, simulation: Simulation, low_pass: LowPass) -> Rows:
    return rows_of(run, simulation.planar_on(run.terrain), simulation.vector, (), low_pass)


def _with_rows(
    runs: Sequence[Signals],
    rows: Sequence[Rows],
    fault: Fault,
    simulation: Simulation,
    low_pass: LowPass,
) -> tuple[Rows, ...]:
    """Return the rows of repaired runs."""
    ids = set(fault.run_ids)
    return tuple(
        each
        if each.run_id not in ids
        else _simulated(fault.change.applied(run), simulation, low_pass)
        if fault.change.of_wheels
        else each._replace(measured=fault.change.measured(each.measured))
        for run, each in zip(runs, rows, strict=True)
    )
