"""Faults of channels: what is wrong with a column of the logs, in words, with its repair.

A fault is a linear map of columns (:class:`Change`): a sign that is turned, columns that are exchanged, another unit,
an offset.  The right reading of logs is one under which every channel follows what the wheels predict, with a gain
above zero (:class:`Agreement`), of a size that robots and effects reach, without an offset that no bias has.  The
simulation may be wrong: a fault is what no effect of the catalogue does.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.discrepancy.clocks import CLOCKED, INDEPENDENT_HZ, Latencies, Shift, latencies_of
from terrain.discrepancy.residuals import INPUTS, LowPass, Rows, rows_of
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.effects import ACCEL, CHANNELS, CURRENT, GYRO, HEADING, SPEED_X, SPEED_Y, TURNING_CURRENT
from terrain.records import Array
from terrain.robots import Robot
from terrain.signals import agreement

# -- How each run responds to its wheels: measured beside predicted on one clock, and the gain between them --

#: Columns of the channels.
G, X, Y, A, AMPS, T, H = (
    CHANNELS.index(name) for name in (GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING)
)
#: Channels that follow the wheels whatever the effects are: of a lateral speed, a lever arm sets the sign.
MOTION = (G, X, H)

FOLLOWERS = (*MOTION, A, AMPS, T)  #: Channels whose gain is above zero, whatever the effects are.
#: Channel that measures the clock of a channel; currents are on that of the wheels.
CLOCK_OF = {G: GYRO, X: SPEED_X, Y: SPEED_X, A: GYRO, H: HEADING}
#: Root mean square of a prediction (rad/s, m/s, m/s^2, A) from which a run is asked for its response: several times
#: the bias and noise of the sensors.
LEAST = {G: 0.1, X: 0.08, Y: 0.03, A: 0.1, AMPS: 0.5, T: 0.5, H: 0.1}

MAX_FIT = 0.9999  #: Largest correlation that counts: beyond it the noise of the sensors decides.


class Response(NamedTuple):
    """A run, each measured row beside the prediction of its own clock.

    ``measured, predicted`` are (m, channels), ``climb_mps2`` (m,) is the part of the predicted specific force that
    is gravity, and ``period_s`` that of the rows.
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

    The clock is the run's own, where it measures one, else that of all runs together; without it the median of those
    that each run measures.
    """
    lag_s = np.full((len(rows), len(CLOCKED)), np.nan) if shift is None else shift.lag_s
    rate = 0.0 if shift is None else shift.rate
    if latencies is not None:
        common = {name: lag.delay_s for name, lag in latencies.channels.items()}
    else:
        known = [column[np.isfinite(column)] for column in lag_s.T]
        common = {
            name: float(np.median(lags)) for name, lags in zip(CLOCKED, known, strict=True) if lags.size
        }
    usual_s = float(np.median(list(common.values()))) if common else 0.0
    responses = []
    for run, own_s in zip(rows, lag_s, strict=True):
        predicted = run.predicted.copy()
        for c, name in CLOCK_OF.items() if run.time_s.size else ():
            late_s = own_s[CLOCKED.index(name)]
            late_s = late_s if np.isfinite(late_s) else common.get(name, usual_s)
            at_s = run.time_s - late_s - rate * (run.time_s - run.time_s.mean())
            predicted[:, c] = np.interp(at_s, run.time_s, run.predicted[:, c])
        period_s = float(np.median(np.diff(run.time_s))) if run.time_s.size > 1 else 0.0
        climb = GRAVITY_MPS2 * np.sin(run.inputs[:, INPUTS.index("grade_rad")])
        responses.append(Response(run.run_id, run.terrain, period_s, run.measured, predicted, climb))
    return tuple(responses)


class Agreement(NamedTuple):
    """How channels (..., channels) follow what the wheels predict."""

    #: about zero, of the accelerometer about its mean, since its bias is large; 0 where the prediction is too small
    #: to ask for
    correlation: Array
    likelihood: Array  #: twice the logarithm that they gain by following with a gain above zero
    #: about zero, of the accelerometer that of its acceleration, beside gravity and a bias; NaN where unknown
    gain: Array


def agreement_of(responses: Sequence[Response]) -> Agreement:
    """Return how the channels of runs (runs, channels) follow the wheels."""
    return Agreement(*map(np.array, zip(*map(_agreement, responses), strict=True)))


def gains_of(response: Response) -> tuple[Array, Array]:
    """Return the gain of each channel (channels,), and its correlation; see :class:`Agreement`."""
    run = _agreement(response)
    return run.gain, run.correlation


def _agreement(response: Response) -> Agreement:
    measured, predicted = response.measured.copy(), response.predicted.copy()
    known = np.isfinite(measured) & np.isfinite(predicted)
    n, rows = known.sum(axis=0), known[:, A]
    climb, accel = response.climb_mps2[rows], measured[rows, A]
    basis = np.column_stack([predicted[rows, A] - climb, climb, np.ones(climb.size)])
    for values in (measured, predicted) if n[A] else ():
        values[:, A] -= values[rows, A].mean()
    power = np.where(known, predicted, 0.0) ** 2
    asked = np.sqrt(power.sum(axis=0) / np.maximum(n, 1)) > np.array([LEAST[c] for c in range(len(CHANNELS))])
    correlation, gain = agreement(measured, predicted)
    correlation = np.where(asked, correlation, 0.0)
    gain[correlation == 0.0] = np.nan
    if correlation[A] != 0.0:
        varies = np.std(basis[:, 0]) > 0.5 * LEAST[A]
        gain[A] = np.linalg.lstsq(basis, accel, rcond=None)[0][0] if varies else np.nan
    n_independent = n * min(response.period_s * INDEPENDENT_HZ, 1.0)
    return Agreement(correlation, -n_independent * np.log1p(-(np.clip(correlation, 0.0, MAX_FIT) ** 2)), gain)


# -- A fault: what is wrong with a column, in words, with its repair ------------------------------------------

#: A fault of a logger is in that ratio of the runs at the least: units and zeros are set once, and a run in a hundred
#: that is off is one whose sensor failed, which is no reason to repair it.
MIN_FAULTY_RATIO = 0.05


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


DEG, RPM, KMH, MILLI = math.pi / 180.0, math.pi / 30.0, 1.0 / 3.6, 1e-3


class _Kind(NamedTuple):
    """Of a column: measured channels, name in logs, unit, other units that loggers have, largest offset."""

    channels: tuple[int, ...]
    logged: str
    si: str
    units: dict[str, float]
    largest: float = math.inf


#: By column; wheel speeds are the inputs of the simulation.  The largest offset is half more than the bounds of the
#: catalogue's biases, and for a heading rate and a speed, which have none, as much and a slow robot's speed.
KINDS = {
    Column.GYRO: _Kind((G,), "gyro_z_radps", "rad/s", {"deg/s": DEG, "rpm": RPM}, 0.3),
    Column.HEADING: _Kind((H,), "yaw_rate_radps", "rad/s", {"deg/s": DEG, "rpm": RPM}, 0.3),
    Column.SPEED: _Kind((X, Y), "speed_x_mps and speed_y_mps", "m/s", {"km/h": KMH, "mm/s": MILLI}, 0.3),
    Column.ACCEL: _Kind((A,), "accel_x_mps2", "m/s^2", {"g": GRAVITY_MPS2}, 3.0),
    Column.CURRENTS: _Kind((AMPS, T), "the currents", "A", {"mA": MILLI}),
    Column.WHEELS: _Kind((), "the wheel speeds", "", {"deg/s": DEG, "rpm": RPM, "km/h": KMH, "mm/s": MILLI}),
    Column.SIDES: _Kind((), "the wheel speeds and currents", "", {}),
}

NOT_IN_MAPPINGS = ("mm/s",)  #: Units that a mapping file has no word for; there the scale is changed.


class Change(NamedTuple):
    """What makes a log right again: a linear map of its columns."""

    kind: FaultKind  #: what is changed, and how
    column: Column
    #: by which samples are multiplied; 1 for columns that are exchanged, NaN for one that is left out, since readings
    #: of it cannot be distinguished
    factor: float = 1.0
    wheel: int = -1  #: which wheel alone; -1 for all
    offset: float = 0.0  #: that is added
    pair: tuple[int, int] = (0, 1)  #: wheels that are exchanged

    @property
    def of_wheels(self) -> bool:
        """Whether it changes what drives the simulation."""
        return self.column in (Column.WHEELS, Column.SIDES)

    def measured(self, values: Array) -> Array:
        """Return measured channels (n, channels) as they are without the fault."""
        order, factor, offset = np.arange(len(CHANNELS)), np.ones(len(CHANNELS)), np.zeros(len(CHANNELS))
        own = list(KINDS[self.column].channels)
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


Changes = tuple[Change, ...]


class Fault(NamedTuple):
    """A fault of a column in some runs: what makes the log right, a sentence on what is wrong, and what to do."""

    change: Change
    run_ids: tuple[str, ...]
    sentence: str
    repair: str

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        change = {name: getattr(self.change, name) for name in ("kind", "column", "factor")}
        return {**change, "runs": self.run_ids, "sentence": self.sentence, "repair": self.repair}


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


def _fault_words(change: Change, robot: Robot) -> tuple[str, str]:
    """Return what a change says is wrong, and how to repair it, in words."""
    column, kind = change.column, KINDS[change.column]
    name, plural = f"the {column.value}", column in (Column.WHEELS, Column.CURRENTS)
    if change.kind is FaultKind.SWAPPED:
        what = f"{column.value} of left and right are exchanged"
        names = {
            Column.CURRENTS: "current_left_a and current_right_a",
            Column.WHEELS: "speed_left_mps and speed_right_mps",
            Column.SIDES: "left and right of the wheel speeds, and of the currents,",
        }.get(column, kind.logged)
        if column is Column.SPEED:
            what = "the speeds forward and to the left are exchanged"
        elif not robot.skids:
            names = " and ".join(robot.rate_channels[i] for i in change.pair)
            what = "wheel speeds of {} and {} are exchanged".format(*(robot.wheels[i] for i in change.pair))
        return what, f"exchange {names} (mapping file: exchange their columns)"
    if change.kind is FaultKind.OFFSET:
        size = f"{-change.offset:.3g} {kind.si}"
        repair = f"subtract {size} from {kind.logged.split(' and ')[0]} (mapping file: offset: {change.offset:.3g})"
        return f"{name} has an offset of {size}", repair
    logged, hint = kind.logged, "scale: -1"
    if change.kind is FaultKind.SIGN:
        what = f"the sign of {name} is turned" if plural else f"{name}'s sign is turned"
        if change.wheel >= 0:
            wheel = robot.wheels[change.wheel]
            what, logged = (
                f"the sign of the {wheel} wheel's speed is turned",
                f"the speed of the wheel {wheel}",
            )
    else:
        what, unit = _unit_words(change)
        what = f"{name} {what}"
        hint = f"unit: {unit}" if unit and unit not in NOT_IN_MAPPINGS else f"scale: {change.factor:.4g}"
    return what, f"multiply {logged} by {change.factor:.4g} (mapping file: {hint})"


def _fault(change: Change, has: Sequence[int], every: Sequence[str], seen: str, robot: Robot) -> Fault:
    """Return the fault of a change in some of the runs, with how it is seen."""
    ids = tuple(every[i] for i in has)
    what, repair = _fault_words(change, robot)
    return Fault(change, ids, f"{what} {in_runs(ids, every)}{seen}; {repair}", repair)


def _unit_words(change: Change) -> tuple[str, str]:
    """Return what is wrong with a unit, and the unit that the samples have."""
    is_, was = ("are", "were") if change.column in (Column.WHEELS, Column.CURRENTS) else ("is", "was")
    for unit, size in KINDS[change.column].units.items():
        si = KINDS[change.column].si or ("m/s" if unit in ("km/h", "mm/s") else "rad/s")
        if math.isclose(change.factor, size):
            return f"{is_} in {unit} instead of {si}", unit
        if math.isclose(change.factor, 1.0 / size):
            return f"{is_} in {si}, and {was} read as {unit}", si
    if change.factor < 1.0:
        return "are rates in rad/s instead of speeds in m/s", ""
    return "are speeds in m/s, and were read as rates in rad/s", ""


# -- Signs that are turned and columns that are exchanged, found by what makes all channels of a run agree --
# Every reading of a run that is one fault away is tried: a change of its measured channels, or of its wheels,
# which are then simulated again.  Under the right one all channels follow the wheels, each with a gain above
# zero; the likelihood that a reading gains is summed over the runs that it mends.

#: A channel does not follow the wheels below the first correlation about zero, and does over the second.  Of measured
#: runs, those that slip hardly fall below 0.8.
TURNED, RIGHT = 0.3, 0.7
#: A channel that half follows the wheels, as one wheel's do, is mended if its correlation rises by the first and to
#: over the second.
RISE, CLEAR = 0.25, 0.95

LOSS = 0.1  #: Largest loss of correlation of any other channel under a reading that mends one.
#: Twice the log-likelihood that a reading has to gain in a run: odds of e^10, over a score of readings and hundreds
#: of runs.
GAIN = 20.0
#: Readings whose gains differ by less, or by less than that ratio, cannot be distinguished.
TIE, TIE_RATIO = 10.0, 0.03

WORDS = dict(zip(CHANNELS, ("gyro", "speed", "lateral speed", "accelerometer", "sum of the currents",
                            "difference of the currents", "heading rate"), strict=True))  # fmt: skip


class Reading(NamedTuple):
    """What a change makes of runs."""

    change: Change  #: tried
    correlation: Array  #: (runs, channels) under it
    gain: Array  #: (runs,) of twice the log-likelihood
    mends: Array  #: (runs,) whether a channel follows the wheels that did not, and none is worse
    #: (runs,) whether the gain is as clear and none is worse; a channel may have followed before
    suits: Array


def candidate_changes(robot: Robot) -> Changes:
    """Return the signs and exchanges that are tried, those of fewest columns first."""
    sign, swapped, n_wheels = FaultKind.SIGN, FaultKind.SWAPPED, len(robot.rate_channels)
    single = (Column.GYRO, Column.HEADING, Column.SPEED, Column.ACCEL, Column.CURRENTS)
    changes = [Change(sign, column, -1.0) for column in single]
    changes.append(Change(swapped, Column.SPEED))
    if robot.skids:
        changes += [Change(swapped, column) for column in (Column.CURRENTS, Column.WHEELS, Column.SIDES)]
    else:
        changes += [Change(swapped, Column.WHEELS, pair=pair) for pair in combinations(range(n_wheels), 2)]
    each = range(n_wheels) if n_wheels > 1 else ()
    return (*changes, *(Change(sign, Column.WHEELS, -1.0, wheel) for wheel in (-1, *each)))


def reading_of(change: Change, before: Agreement, after: Agreement) -> Reading:
    """Return what a change makes of runs."""
    keys, old, new = list(FOLLOWERS), before.correlation, after.correlation
    gain = after.likelihood.sum(axis=1) - before.likelihood.sum(axis=1)
    turned = (old < TURNED) & (new > RIGHT)
    asked = old != 0.0  # what a run does not show cannot be wrong in it
    mended = (asked & (turned | ((new - old > RISE) & (new > CLEAR))))[:, keys].any(axis=1)
    worse = ((new < old - LOSS) & (old > RIGHT))[:, keys].any(axis=1)
    suits = ~worse & (gain > GAIN)
    return Reading(change, new, gain, mended & suits, suits)


def _best_reading(readings: Sequence[Reading]) -> tuple[Reading, list[Reading]] | None:
    """Return the reading that gains most over the runs that it mends, and those as good on the same runs."""
    best = max(readings, key=lambda reading: float(reading.gain[reading.mends].sum()))
    if not best.mends.any():
        return None
    most = float(best.gain[best.mends].sum())
    near = [
        reading
        for reading in readings
        if reading.mends[best.mends].all()
        and most - float(reading.gain[best.mends].sum()) < max(TIE, TIE_RATIO * most)
    ]
    return near[0], near[1:]


def _runs_with(reading: Reading, ids: Sequence[str], old: Array) -> list[int]:
    """Return the runs that have a fault: those that it suits, and of their sessions those that cannot say.

    A run that drives straight measures no sign of a gyro; it has that of the others.  ``old`` are the correlations
    (runs, channels) without the change.
    """
    session = [session_of(run_id) for run_id in ids]
    has = set(np.flatnonzero(reading.suits).tolist())
    shift = np.median(np.abs(reading.correlation - old)[reading.mends], axis=0)
    shows = [c for c in FOLLOWERS if shift[c] > RISE]
    for name in {session[i] for i in has}:
        members = [i for i in range(len(ids)) if session[i] == name]
        asked = [i for i in members if (np.abs(old[i, shows]) > RIGHT).any()]
        if all(i in has for i in asked):
            has |= set(members)
    return sorted(has)


def _gain_sentence(best: Reading, before: Agreement, shown: Sequence[int]) -> str:
    """Return how a sign or exchange is seen: the gains of the channels that it turns."""
    gains, old = before.gain[shown], before.correlation[shown]
    rise, asked = best.correlation[shown] - old, (old != 0.0) & np.isfinite(gains)
    words = []
    for c in FOLLOWERS:
        on = asked[:, c]
        own = c in KINDS[best.change.column].channels or best.change.of_wheels
        if not (own and on.any() and np.median(rise[on, c]) > RISE):
            continue
        text = f"the {WORDS[CHANNELS[c]]} follows the wheels with the factor {np.median(gains[on, c]):.2f}"
        both = on & np.isfinite(gains[:, H])
        if best.change.column is Column.GYRO and both.any():
            text += f", and the heading rate with {float(np.median(gains[both, c] / gains[both, H])):.2f}"
        words.append(text)
    return " and ".join(words)


# -- Units that are not those of the channel's name, found by gains that no effect reaches -----------------
# The logarithms of the gains have a prior: what robots and effects do to them.  A reading of the logs in which
# a column is in another unit costs a fixed evidence, and is taken where the gains cost more without it.

#: Correlation about zero from which a gain is used: of a run that hardly responds it says nothing.
MIN_FIT = 0.7
#: Gain of the yaw rate, mean of its logarithm and standard deviations to below and above: skid-steer robots have an
#: effective track of 1 to 2.5 times the nominal one (Mandow et al., IROS 2007), and the bounds of the catalogue,
#: which are gains of 0.2 and 2, are within three; a swerve robot turns as its wheels do.
SKID_TURN, SWERVE_TURN = (math.log(0.75), 0.5, 0.35), (0.0, 0.2, 0.2)
#: Gain of the speed: a wheel radius may be off by 30 %, and slip takes up to a half, within three and a half standard
#: deviations.
SPEED_GAIN = (-0.08, 0.2)
#: Of gyro over heading rate: the catalogue's bound of a gyro's scale is within three standard deviations.
GYRO_SPREAD = 0.12

ACCEL_SPREAD = 0.25  #: Of the accelerometer over the speed: it sees bumps too.
#: Of the currents: constants of motors and the resistance of a terrain are known to a factor of 10.
CURRENT_GAIN = (0.7, 1.2)

#: Evidence that a unit has to bring, in minus twice the log-likelihood: four standard deviations.
COST = 16.0
LEFT = 9.0  #: Cost of the gains under the right reading, at most: three standard deviations.
UNIT_TIE = 1.5  #: Readings whose costs differ by less cannot be distinguished: their odds are within 2.
#: Ratio of runs without a fault, from which they are what the others are compared with.
MIN_USUAL_RATIO = 0.2
#: A run of another unit than the others agrees with them after its repair: within so many times their scatter, the
#: second at the least and the first at the most, in the logarithm.  Where its motion would be too small it is the
#: second, since a run may slip or stall, by any factor.
NEAR, TIGHT, SCATTERS = 0.35, 0.1, 3.0
#: Correlation of the channels of such a run, if it is another unit and nothing that changes over a run.
CLEAR_FIT = 0.95

KEYS = (G, X, A, AMPS, H)  #: Channels that have a gain, in the order of the columns of logarithms.
_PLACE = {c: i for i, c in enumerate(KEYS)}
_MOTION = [_PLACE[c] for c in (G, X, A, H)]

GAIN_WORDS = {
    G: "the gyro reads {:.3g} times what the wheels predict",
    X: "the speed {:.3g} times",
    A: "the acceleration {:.3g} times",
    AMPS: "the currents {:.3g} times",
    H: "the heading rate {:.3g} times",
}


def unit_faults(responses: Sequence[Response], robot: Robot) -> tuple[Fault, ...]:
    """Return columns whose unit is not that of their name, in all runs or in some of them."""
    follows = agreement_of(responses)
    gain, fit = follows.gain[:, list(KEYS)], follows.correlation[:, list(KEYS)]
    clear = np.isfinite(gain) & (gain > 0) & (np.abs(fit) > MIN_FIT)
    logs = np.log(np.where(clear, gain, np.nan))
    informed = np.flatnonzero(clear.any(axis=1)).tolist()
    options = _options(logs, robot)
    own = {i: _best(logs[i], options, robot)[0] for i in informed}
    suggested = {changes for changes in own.values() if changes}
    if not suggested:
        return ()
    shows = {
        i: [not np.array_equal(_repaired_logs(logs[i], [c])[0], logs[i], equal_nan=True) for c in suggested]
        for i in informed
    }
    usual = [i for i in informed if not own[i] and any(shows[i])]
    if len(usual) < MIN_USUAL_RATIO * len(informed):
        best, rivals = _best(_middle(logs[[i for i in informed if i not in usual]]), options, robot)
        has = [i for i in range(len(logs)) if i not in usual]
        return tuple(_unit_fault(best, change, rivals, has, responses, logs, robot) for change in best)
    middle, scatter = _middle(logs[usual]), 1.48 * _middle(np.abs(logs[usual] - _middle(logs[usual])))
    near = np.clip(SCATTERS * np.where(np.isfinite(scatter), scatter, TIGHT), TIGHT, NEAR)
    of_runs: dict[Changes, list[int]] = {}
    for i in (i for i in informed if own[i]):
        off = np.where(fit[i] > CLEAR_FIT, logs[i], np.nan) - middle
        left = np.abs(_repaired_logs(off, options))
        distance = np.nansum(left, axis=1) + [COST * (len(changes) - 1) for changes in options]
        distance[
            [
                not changes or not _agrees(off, after, near)
                for changes, after in zip(options, left, strict=True)
            ]
        ] = np.inf
        if np.isfinite(distance).any():
            of_runs.setdefault(options[int(np.argmin(distance))], []).append(i)
    return tuple(
        _unit_fault(changes, change, (), has, responses, logs, robot)
        for changes, has in of_runs.items()
        if len(has) >= MIN_FAULTY_RATIO * len(informed)
        for change in changes
    )


def _middle(logs: Array) -> Array:
    """Return the medians of columns, NaN where nothing is known."""
    return np.array([np.median(x[np.isfinite(x)]) if np.isfinite(x).any() else np.nan for x in logs.T])


def _options(logs: Array, robot: Robot) -> list[Changes]:
    """Return the readings: nothing, one column in another unit, or two that are measured.

    Wheels and what they turn in one other unit would hide each other: then a body that slips looks like it.
    """
    known = {c for c, column in zip(KEYS, logs.T, strict=True) if np.isfinite(column).any()}
    single = []
    for column, kind in KINDS.items():
        rates = [robot.wheel_radius_m] if column is Column.WHEELS else []  # of wheels in the place of speeds
        if rates or known & {*kind.channels}:
            factors = [factor for size in (*kind.units.values(), *rates) for factor in (size, 1.0 / size)]
            single += [Change(FaultKind.UNIT, column, factor) for factor in factors]
    measured = [change for change in single if not change.of_wheels]
    pairs = [pair for pair in combinations(measured, 2) if pair[0].column is not pair[1].column]
    return [(), *((change,) for change in single), *pairs]


def _repaired_logs(logs: Array, options: Sequence[Changes]) -> Array:
    """Return the logarithms of gains (options, keys) after changes: a larger prediction makes them less.

    The currents are not in proportion to the wheel speeds: beside a motion their gain says nothing of these.
    """
    after = np.tile(logs, (len(options), 1))
    for row, changes in zip(after, options, strict=True):
        for change in changes:
            if change.of_wheels:
                row[_MOTION] -= math.log(change.factor)
                if np.isfinite(row[_MOTION]).any():
                    row[_PLACE[AMPS]] = np.nan
            else:
                row[[_PLACE[c] for c in KINDS[change.column].channels if c in _PLACE]] += math.log(
                    change.factor
                )
    return after


def _best(logs: Array, options: Sequence[Changes], robot: Robot) -> tuple[Changes, list[Changes]]:
    """Return the reading whose gains are likeliest by their prior, and those that are hardly less likely."""
    gyro, speed, accel, current, heading = _repaired_logs(logs, options).T
    mean, below, above = SKID_TURN if robot.skids else SWERVE_TURN
    yaw = np.where(np.isfinite(heading), heading, gyro)
    along = np.where(np.isfinite(speed), speed, SPEED_GAIN[0])
    terms = (
        (yaw - mean) / np.where(yaw < mean, below, above),
        (gyro - heading) / GYRO_SPREAD,
        (speed - SPEED_GAIN[0]) / SPEED_GAIN[1],
        (accel - along) / ACCEL_SPREAD,
        (current - CURRENT_GAIN[0]) / CURRENT_GAIN[1],
    )
    cost = np.nansum(np.square(terms), axis=0)
    n_changes = np.array([len(changes) for changes in options])
    total = cost + COST * n_changes
    best = int(np.argmin(total))
    if not options[best] or cost[best] > LEFT:
        return (), []
    near = (total - total[best] < UNIT_TIE) & (n_changes == n_changes[best])
    return options[best], [options[i] for i in np.flatnonzero(near).tolist() if i != best]


def _agrees(off: Array, after: Array, near: Array) -> bool:
    """Whether a run that is off from the others agrees with them after changes, and may not just stall."""
    known = np.isfinite(off)
    if not known.any() or (after[known] > near[known]).any() or not (np.abs(off[known]) > 2 * NEAR).any():
        return False
    small = [i for i in _MOTION if known[i] and off[i] < -2 * NEAR]
    sound = [i for i in _MOTION if known[i] and abs(off[i]) < near[i]]  # these show that it moved
    return not small or (bool((after[small] < TIGHT).all()) and len(small) + len(sound) > 1)


def _unit_fault(
    changes: Changes,
    change: Change,
    rivals: Sequence[Changes],
    has: Sequence[int],
    responses: Sequence[Response],
    logs: Array,
    robot: Robot,
) -> Fault:
    """Return the fault of a change in words; it is left out where other readings are as good."""
    middle = _middle(logs[list(has)])
    gains = [
        GAIN_WORDS[c].format(math.exp(middle[place]))
        for c, place in _PLACE.items()
        if math.isfinite(middle[place]) and (c == AMPS) is (change.column is Column.CURRENTS)
    ]
    seen = f": {', '.join(gains)}"
    if rivals:
        words = (" and ".join(_fault_words(each, robot)[0] for each in reading) for reading in rivals)
        seen += f"; another reading is as good ({' or '.join(words)})"
    fault = _fault(change, has, [run.run_id for run in responses], seen, robot)
    measured = [each for reading in (changes, *rivals) for each in reading if not each.of_wheels]
    if not rivals or not measured:  # of the wheels in either case: without them there is nothing to compare
        return fault
    left_out = f"{KINDS[measured[0].column].logged} is left out; state the units that the logger has"
    sentence = f"{fault.sentence.removesuffix(f'; {fault.repair}')}, so that {left_out}"
    return Fault(measured[0]._replace(factor=math.nan), fault.run_ids, sentence, left_out)


# -- Constant offsets of sensors that no bias of the catalogue reaches: sensors not zeroed, or turned ------

SIGMAS = 4.0  #: An offset is over the largest by so many standard deviations.
MIN_ROWS = 10


def offset_faults(responses: Sequence[Response], robot: Robot) -> tuple[Fault, ...]:
    """Return columns with an offset that no effect has, in all runs or in some of them."""
    every = [run.run_id for run in responses]
    faults = []
    for column, kind in KINDS.items():
        if not math.isfinite(kind.largest):
            continue
        offsets = np.array([_offset(run, kind.channels[0]) for run in responses])
        has = np.flatnonzero(np.abs(offsets[:, 0]) > kind.largest + SIGMAS * offsets[:, 1])
        if has.size < max(MIN_FAULTY_RATIO * np.isfinite(offsets[:, 0]).sum(), 1):
            continue
        change = Change(FaultKind.OFFSET, column, offset=-float(np.median(offsets[has, 0])))
        below = f", where a sensor's is below {kind.largest:g}"
        faults.append(_fault(change, has.tolist(), every, below, robot))
    return tuple(faults)


def _offset(run: Response, c: int) -> tuple[float, float]:
    """Return what a channel measures where nothing is predicted, and its error; NaN if unknown."""
    known = np.isfinite(run.measured[:, c]) & np.isfinite(run.predicted[:, c])
    if known.sum() < MIN_ROWS:
        return np.nan, np.nan
    measured, predicted = run.measured[known, c], run.predicted[known, c]
    if np.std(predicted) < LEAST[c] and np.sqrt(np.mean(predicted**2)) > LEAST[c]:
        return np.nan, np.nan  # of one motion throughout, a gain looks the same
    varies = [predicted] if np.std(predicted) > LEAST[c] else []
    basis = np.column_stack([np.ones(measured.size), *varies])
    value, *_ = np.linalg.lstsq(basis, measured, rcond=None)
    n_independent = max(measured.size * min(run.period_s, 1.0), 1.0)  # what is left changes within seconds
    spread = np.linalg.inv(basis.T @ basis / measured.size)[0, 0] / n_independent
    return float(value[0]), float(np.std(measured - basis @ value) * np.sqrt(spread))


# -- Faults of channels of all runs: signs, exchanged columns and units, before any cause is searched ------

#: Signs and exchanges that are searched one after the other; logs with more are no logs of this robot.
MAX_FAULTS = 4


class _Logs(NamedTuple):
    """Runs as repaired so far, with the prediction of the simulation, and their clocks."""

    signals: tuple[Signals, ...]
    rows: tuple[Rows, ...]
    simulation: Simulation
    low_pass: LowPass
    latencies: Latencies
    shift: Shift | None

    def changed_rows(self, change: Change, i: int) -> Rows:
        """Return the rows of a run after a change; one of the wheels is simulated again."""
        if not change.of_wheels:
            return self.rows[i]._replace(measured=change.measured(self.rows[i].measured))
        run = change.applied(self.signals[i])
        return rows_of(run, self.simulation.planar_on(run.terrain), self.simulation.vector, (), self.low_pass)

    def without(self, fault: Fault) -> _Logs:
        """Return the runs without a fault."""
        rows = tuple(
            self.changed_rows(fault.change, i) if run.run_id in fault.run_ids else run
            for i, run in enumerate(self.rows)
        )
        return self._replace(signals=repaired(self.signals, [fault]), rows=rows)

    def responses(self) -> tuple[Response, ...]:
        return responses_of(self.rows, self.latencies, self.shift)

    def tried(self, change: Change, before: Agreement, places: Sequence[int]) -> Reading:
        """Return what a change makes of the runs at some places."""
        shift = self.shift
        if shift is not None:
            at = list(places)
            shift = Shift(shift.lag_s[at], shift.std_s[at], shift.rate, shift.lost[at])
        changed = responses_of([self.changed_rows(change, i) for i in places], self.latencies, shift)
        after = Agreement(*(each.copy() for each in before))
        for own, each in zip(after, agreement_of(changed), strict=True):
            own[list(places)] = each
        return reading_of(change, before, after)


def faults_of(
    signals: Sequence[Signals],
    rows: Sequence[Rows],
    simulation: Simulation,
    low_pass: LowPass,
    shift: Shift | None = None,
    latencies: Latencies | None = None,
) -> tuple[Fault, ...]:
    """Return the faults of channels, in the order in which they are to be repaired: signs, units, offsets.

    Clocks are those of the runs, where they are not known already.
    """
    latencies = latencies_of(signals, simulation) if latencies is None else latencies
    logs = _Logs(tuple(signals), tuple(rows), simulation, low_pass, latencies, shift)
    faults: list[Fault] = []
    while len(faults) < MAX_FAULTS and (fault := _turned(logs)) is not None:
        faults.append(fault)
        logs = logs.without(fault)
    units = unit_faults(logs.responses(), simulation.robot)
    for fault in units:
        logs = logs.without(fault)
    return (*faults, *units, *offset_faults(logs.responses(), simulation.robot))


def _turned(logs: _Logs) -> Fault | None:
    """Return the sign or exchange that mends most, or None if there is none.

    Readings that are as good are mirror images, left for right or ahead for back: the change of fewest columns is
    taken, and the diagnosis is that of either but for the side.
    """
    before, robot = agreement_of(logs.responses()), logs.simulation.robot
    fit = before.correlation[:, list(FOLLOWERS)]
    suspects = np.flatnonzero(((fit != 0.0) & (fit < RIGHT)).any(axis=1)).tolist()
    if not suspects:
        return None
    found = _best_reading([logs.tried(change, before, suspects) for change in candidate_changes(robot)])
    if found is None:
        return None
    change, rivals, every = found[0].change, found[1], [run.run_id for run in logs.rows]
    best = logs.tried(change, before, range(len(every)))
    has = _runs_with(best, every, before.correlation)
    seen = f": {_gain_sentence(best, before, [i for i in has if best.mends[i]])}"
    if rivals:
        words = " or ".join(_fault_words(rival.change, robot)[0] for rival in rivals)
        seen += f" (these channels cannot distinguish it from another reading: {words})"
    return _fault(change, has, every, seen, robot)
