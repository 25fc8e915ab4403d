"""Health of logs: what is wrong with a column of them, in words, with its repair; and which runs are unfit.

A fault is a linear map of columns (:class:`Change`): a sign that is turned, columns that are exchanged, another unit,
an offset.  The right reading of logs is one under which every channel follows what the wheels predict, with a gain
above zero (:class:`Agreement`), of a size that robots and effects reach, without an offset that no bias has.  The
simulation may be wrong: a fault is what no effect of the catalogue does.

A run is unfit for a fault of its own: a channel that is missing or frozen, a clock offset of its own, wheels
that turn under a body at rest, or another robot or terrain than its log states.  What all runs have in common
is no fault of a run: it is what the diagnosis searches.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import StrEnum
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.discrepancy.clocks import (
    CLOCKED,
    INDEPENDENT_HZ,
    MAX_LAG_S,
    MIN_LAG_S,
    Latencies,
    Shift,
    offsets_of,
    shifts_of,
)
from terrain.discrepancy.evidence import Evidence
from terrain.discrepancy.runs import INPUTS, Excluded, LowPass, Rows, Signals, Simulation, rows_of
from terrain.effects import CHANNELS, GYRO, HEADING, INDEX, SPEED_X
from terrain.records import Array
from terrain.robots import Robot
from terrain.signals import agreement, true_stretches

# -- How runs respond to their wheels: measured beside predicted on one clock, and the gain between them -------

#: Places of the channels: gyro, speed ahead and left, accelerometer, sum and difference of the currents, heading rate.
G, X, Y, A, AMPS, T, H = range(len(CHANNELS))
#: Channels that follow the wheels whatever the effects are: of a lateral speed, a lever arm sets the sign.
MOTION = [G, X, H]
FOLLOWERS = [*MOTION, A, AMPS, T]  #: Channels whose gain is above zero, whatever the effects are.
#: Channel that measures the clock of a channel; currents are on that of the wheels.
CLOCK_OF = {G: GYRO, X: SPEED_X, Y: SPEED_X, A: GYRO, H: HEADING}
#: Root mean square of a prediction (rad/s, m/s, m/s^2, A), by channel, from which a run is asked for its response:
#: several times the bias and noise of the sensors.
LEAST = np.array([0.1, 0.08, 0.03, 0.1, 0.5, 0.5, 0.1])

MAX_FIT = 0.9999  #: Largest correlation that counts: beyond it the noise of the sensors decides.


class Agreement(NamedTuple):
    """How channels of runs (runs, channels) follow what the wheels predict."""

    #: about zero, of the accelerometer about its mean, since its bias is large; 0 where the prediction is too small
    #: to ask for
    correlation: Array
    likelihood: Array  #: twice the logarithm that they gain by following with a gain above zero
    #: about zero, of the accelerometer that of its acceleration, beside gravity and a bias; NaN where unknown
    gain: Array


def on_own_clocks(rows: Sequence[Rows], lags: Latencies | Shift) -> tuple[Rows, ...]:
    """Return runs with the prediction of each channel on the clock by which it is measured.

    The clock is the run's own, where it measures one, else that of all runs together; without it the median of those
    that are known.
    """
    if isinstance(lags, Shift):
        own_s, rate, common_s = lags.lag_s, lags.rate, _medians(lags.lag_s)
    else:
        found, rate = lags.channels, 0.0
        common_s = np.array([found[name].delay_s if name in found else math.nan for name in CLOCKED])
        own_s = np.tile(common_s, (len(rows), 1))
    common_s = np.where(np.isfinite(common_s), common_s, np.nan_to_num(_medians(common_s[:, None])))
    own_s = np.where(np.isfinite(own_s), own_s, common_s)
    shifted = []
    for run, late_s in zip(rows, own_s, strict=True):
        predicted = run.predicted.copy()
        for c, name in CLOCK_OF.items() if run.time_s.size else ():
            at_s = run.time_s - late_s[CLOCKED.index(name)] - rate * (run.time_s - run.time_s.mean())
            predicted[:, c] = np.interp(at_s, run.time_s, run.predicted[:, c])
        shifted.append(run._replace(predicted=predicted))
    return tuple(shifted)


def _medians(table: Array) -> Array:
    """Return the medians of columns, NaN where nothing is known."""
    return np.array([np.median(x[np.isfinite(x)]) if np.isfinite(x).any() else np.nan for x in table.T])


def agreement_of(runs: Sequence[Rows]) -> Agreement:
    """Return how the channels of runs, on their clocks, follow the wheels."""
    every = []
    for run in runs:
        measured, predicted = run.measured.copy(), run.predicted.copy()
        known = np.isfinite(measured) & np.isfinite(predicted)
        n, rows = known.sum(axis=0), known[:, A]
        climb = GRAVITY_MPS2 * np.sin(run.inputs[rows, INPUTS.index("grade_rad")])
        accel, basis = (
            measured[rows, A],
            np.column_stack([predicted[rows, A] - climb, climb, np.ones_like(climb)]),
        )
        for values in (measured, predicted) if n[A] else ():
            values[:, A] -= values[rows, A].mean()
        power = np.where(known, predicted, 0.0) ** 2
        asked = np.sqrt(power.sum(axis=0) / np.maximum(n, 1)) > LEAST
        correlation, gain = agreement(measured, predicted)
        correlation = np.where(asked, correlation, 0.0)
        gain[correlation == 0.0] = np.nan
        if correlation[A] != 0.0:
            varies = np.std(basis[:, 0]) > 0.5 * LEAST[A]
            gain[A] = np.linalg.lstsq(basis, accel, rcond=None)[0][0] if varies else np.nan
        n_independent = n * min(run.period_s * INDEPENDENT_HZ, 1.0)
        likelihood = -n_independent * np.log1p(-(np.clip(correlation, 0.0, MAX_FIT) ** 2))
        every.append((correlation, likelihood, gain))
    return Agreement(*np.array(every).transpose(1, 0, 2))


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
    """Of a column: measured channels, name in logs, unit, other units that loggers have, largest offset, its sides."""

    channels: tuple[int, ...]
    logged: str
    si: str
    units: dict[str, float]
    largest: float = math.inf
    sides: str = ""


#: By column; wheel speeds are the inputs of the simulation.  The largest offset is half more than the bounds of the
#: catalogue's biases, and for a heading rate and a speed, which have none, as much and a slow robot's speed.
KINDS = {
    Column.GYRO: _Kind((G,), "gyro_z_radps", "rad/s", {"deg/s": DEG, "rpm": RPM}, 0.3),
    Column.HEADING: _Kind((H,), "yaw_rate_radps", "rad/s", {"deg/s": DEG, "rpm": RPM}, 0.3),
    Column.SPEED: _Kind((X, Y), "speed_x_mps and speed_y_mps", "m/s", {"km/h": KMH, "mm/s": MILLI}, 0.3),
    Column.ACCEL: _Kind((A,), "accel_x_mps2", "m/s^2", {"g": GRAVITY_MPS2}, 3.0),
    Column.CURRENTS: _Kind(
        (AMPS, T), "the currents", "A", {"mA": MILLI}, sides="current_left_a and current_right_a"
    ),
    Column.WHEELS: _Kind(
        *((), "the wheel speeds", "", {"deg/s": DEG, "rpm": RPM, "km/h": KMH, "mm/s": MILLI}),
        sides="speed_left_mps and speed_right_mps",
    ),
    Column.SIDES: _Kind((), "", "", {}, sides="left and right of the wheel speeds, and of the currents,"),
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
    sessions = list(dict.fromkeys(map(session_of, ids)))
    is_all = len(ids) == len(every)
    whole = len(ids) == sum(session_of(run_id) in sessions for run_id in every)
    if is_all or (whole and all(sessions) and len(sessions) <= 3):
        named = all(sessions) and (len(sessions) == 1 or not is_all)
        return f"in all {len(ids)} runs" + (f" of {' and '.join(sessions)}" if named else "")
    shown = ", ".join(ids[:5]) + (", ..." if len(ids) > 5 else "")
    return f"in {len(ids)} of {len(every)} runs ({shown})"


def _words(change: Change, robot: Robot) -> tuple[str, str]:
    """Return what a change says is wrong, and how to repair it, in words."""
    column, kind = change.column, KINDS[change.column]
    name, logged = f"the {column.value}", kind.logged
    several = column in (Column.WHEELS, Column.CURRENTS)
    if change.kind is FaultKind.SWAPPED:
        what, names = f"{column.value} of left and right are exchanged", kind.sides
        if column is Column.SPEED:
            what, names = "the speeds forward and to the left are exchanged", logged
        elif not robot.skids:
            names = " and ".join(robot.rate_channels[i] for i in change.pair)
            what = "wheel speeds of {} and {} are exchanged".format(*(robot.wheels[i] for i in change.pair))
        return what, f"exchange {names} (mapping file: exchange their columns)"
    if change.kind is FaultKind.OFFSET:
        size, first = f"{-change.offset:.3g} {kind.si}", logged.split(" and ")[0]
        hint = f"mapping file: offset: {change.offset:.3g}"
        return f"{name} has an offset of {size}", f"subtract {size} from {first} ({hint})"
    hint = f"scale: {change.factor:.4g}"
    if change.kind is FaultKind.SIGN:
        what = f"the sign of {name} is turned" if several else f"{name}'s sign is turned"
        hint = "scale: -1"
        if change.wheel >= 0:
            wheel = robot.wheels[change.wheel]
            what, logged = (
                f"the sign of the {wheel} wheel's speed is turned",
                f"the speed of the wheel {wheel}",
            )
    else:
        is_, was = ("are", "were") if several else ("is", "was")
        what, unit = f"{name} are speeds in m/s, and were read as rates in rad/s", ""
        if change.factor < 1.0:
            what = f"{name} are rates in rad/s instead of speeds in m/s"
        for other, factor in kind.units.items():
            si = kind.si or ("m/s" if other in ("km/h", "mm/s") else "rad/s")
            if math.isclose(change.factor, factor):
                what, unit = f"{name} {is_} in {other} instead of {si}", other
            elif math.isclose(change.factor, 1.0 / factor):
                what, unit = f"{name} {is_} in {si}, and {was} read as {other}", si
        if unit and unit not in NOT_IN_MAPPINGS:
            hint = f"unit: {unit}"
    return what, f"multiply {logged} by {change.factor:.4g} (mapping file: {hint})"


def _fault(change: Change, has: Sequence[int], every: Sequence[str], seen: str, robot: Robot) -> Fault:
    """Return the fault of a change in some of the runs, with how it is seen."""
    ids = tuple(every[i] for i in has)
    what, repair = _words(change, robot)
    return Fault(change, ids, f"{what} {in_runs(ids, every)}{seen}; {repair}", repair)


# -- Faults of channels of all runs, before any cause is searched ----------------------------------------------

#: Signs and exchanges that are searched one after the other; logs with more are no logs of this robot.
MAX_FAULTS = 4


def faults_of(
    signals: Sequence[Signals],
    rows: Sequence[Rows],
    simulation: Simulation,
    low_pass: LowPass,
    latencies: Latencies,
) -> tuple[Fault, ...]:
    """Return the faults of channels, in the order in which they are to be repaired: signs, units, offsets.

    ``rows`` are those of the runs by the simulation, ``latencies`` the lags of their channels.
    """
    runs, logs, robot = list(signals), list(rows), simulation.robot
    ids, faults = [run.run_id for run in rows], []

    def without(change: Change, i: int) -> Rows:
        """Return the rows of a run after a change; one of the wheels is simulated again."""
        if not change.of_wheels:
            return logs[i]._replace(measured=change.measured(logs[i].measured))
        run = change.applied(runs[i])
        return rows_of(run, simulation.planar_on(run.terrain), simulation.vector, (), low_pass)

    def repair(fault: Fault) -> None:
        for i in (i for i, run_id in enumerate(ids) if run_id in fault.run_ids):
            logs[i] = without(fault.change, i)
            runs[i] = fault.change.applied(runs[i])
        faults.append(fault)

    def responses() -> tuple[Rows, ...]:
        return on_own_clocks(logs, latencies)

    while len(faults) < MAX_FAULTS:
        before = agreement_of(responses())

        def tried(change: Change, places: Sequence[int], before: Agreement = before) -> Reading:
            """Return what a change makes of the runs at some places."""
            after = Agreement(*(each.copy() for each in before))
            own = agreement_of(on_own_clocks([without(change, i) for i in places], latencies))
            for whole, part in zip(after, own, strict=True):
                whole[list(places)] = part
            return reading_of(change, before, after)

        turned = _turned_fault(before, tried, ids, robot)
        if turned is None:
            break
        repair(turned)
    for fault in _unit_faults(responses(), robot):
        repair(fault)
    return (*faults, *_offset_faults(responses(), robot))


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

WORDS = (
    *("gyro", "speed", "lateral speed", "accelerometer"),
    *("sum of the currents", "difference of the currents", "heading rate"),
)


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
    changes = [*(Change(sign, column, -1.0) for column in single), Change(swapped, Column.SPEED)]
    if robot.skids:
        changes += [Change(swapped, column) for column in (Column.CURRENTS, Column.WHEELS, Column.SIDES)]
    else:
        changes += [Change(swapped, Column.WHEELS, pair=pair) for pair in combinations(range(n_wheels), 2)]
    each = range(n_wheels) if n_wheels > 1 else ()
    return (*changes, *(Change(sign, Column.WHEELS, -1.0, wheel) for wheel in (-1, *each)))


def reading_of(change: Change, before: Agreement, after: Agreement) -> Reading:
    """Return what a change makes of runs."""
    old, new = before.correlation[:, FOLLOWERS], after.correlation[:, FOLLOWERS]
    gain = after.likelihood.sum(axis=1) - before.likelihood.sum(axis=1)
    turned = (old < TURNED) & (new > RIGHT)
    asked = old != 0.0  # what a run does not show cannot be wrong in it
    mended = (asked & (turned | ((new - old > RISE) & (new > CLEAR)))).any(axis=1)
    worse = ((new < old - LOSS) & (old > RIGHT)).any(axis=1)
    suits = ~worse & (gain > GAIN)
    return Reading(change, after.correlation, gain, mended & suits, suits)


def _turned_fault(
    before: Agreement, tried: Callable[[Change, Sequence[int]], Reading], ids: Sequence[str], robot: Robot
) -> Fault | None:
    """Return the sign or exchange that mends most, or None if there is none.

    It is the reading that gains most over the runs that it mends.  Those that are as good on the same runs are mirror
    images, left for right or ahead for back: the change of fewest columns is taken, and the diagnosis is that of
    either but for the side.  The runs that have the fault are those that it suits, and of their sessions those that
    cannot say: a run that drives straight measures no sign of a gyro; it has that of the others.
    """
    old = before.correlation
    fit = old[:, FOLLOWERS]
    suspects = np.flatnonzero(((fit != 0.0) & (fit < RIGHT)).any(axis=1)).tolist()
    readings = [tried(change, suspects) for change in candidate_changes(robot)] if suspects else []
    first = max(readings, key=lambda reading: float(reading.gain[reading.mends].sum()), default=None)
    if first is None or not first.mends.any():
        return None
    most = float(first.gain[first.mends].sum())
    change, *rivals = (
        reading.change
        for reading in readings
        if reading.mends[first.mends].all()
        and most - float(reading.gain[first.mends].sum()) < max(TIE, TIE_RATIO * most)
    )
    best = tried(change, range(len(ids)))
    rise, session = best.correlation - old, [session_of(run_id) for run_id in ids]
    shift = np.median(np.abs(rise)[best.mends], axis=0)
    shows = [c for c in FOLLOWERS if shift[c] > RISE]
    has = set(np.flatnonzero(best.suits).tolist())
    for name in {session[i] for i in has}:
        members = [i for i in range(len(ids)) if session[i] == name]
        if all(i in has for i in members if (np.abs(old[i, shows]) > RIGHT).any()):
            has |= set(members)
    # how it is seen: the gains of the channels that it turns
    shown, words = [i for i in sorted(has) if best.mends[i]], []
    gains, asked = before.gain[shown], (old[shown] != 0.0) & np.isfinite(before.gain[shown])
    for c in FOLLOWERS:
        on = asked[:, c]
        own = c in KINDS[change.column].channels or change.of_wheels
        if own and on.any() and np.median(rise[shown][on, c]) > RISE:
            text = f"the {WORDS[c]} follows the wheels with the factor {np.median(gains[on, c]):.2f}"
            both = on & np.isfinite(gains[:, H])
            if change.column is Column.GYRO and both.any():
                text += f", and the heading rate with {float(np.median(gains[both, c] / gains[both, H])):.2f}"
            words.append(text)
    seen = f": {' and '.join(words)}"
    if rivals:
        others = " or ".join(_words(rival, robot)[0] for rival in rivals)
        seen += f" (these channels cannot distinguish it from another reading: {others})"
    return _fault(change, sorted(has), ids, seen, robot)


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

#: Channels that have a gain, in the order of the columns of logarithms, with what a sentence calls it.
KEYS = {
    G: "the gyro reads {:.3g} times what the wheels predict",
    X: "the speed {:.3g} times",
    A: "the acceleration {:.3g} times",
    AMPS: "the currents {:.3g} times",
    H: "the heading rate {:.3g} times",
}
_MOVING = np.array([c != AMPS for c in KEYS])

#: Readings, and what they add to the logarithms of gains (readings, keys): see :func:`options_of`.
Options = tuple[list[Changes], Array]


def _unit_faults(runs: Sequence[Rows], robot: Robot) -> tuple[Fault, ...]:
    """Return columns whose unit is not that of their name, in all runs or in some of them."""
    follows, keys, ids = agreement_of(runs), list(KEYS), [run.run_id for run in runs]
    gain, fit = follows.gain[:, keys], follows.correlation[:, keys]
    clear = np.isfinite(gain) & (gain > 0) & (np.abs(fit) > MIN_FIT)
    logs = np.log(np.where(clear, gain, np.nan))
    informed = np.flatnonzero(clear.any(axis=1)).tolist()
    options = changes, adds = options_of(logs, robot)
    own = {i: likeliest(logs[i], options, robot)[0] for i in informed}
    suggested = [changes.index(each) for each in {each for each in own.values() if each}]
    if not suggested:
        return ()

    def fault(reading: Changes, change: Change, rivals: Sequence[Changes], has: Sequence[int]) -> Fault:
        """Return the fault of a change in words; it is left out where other readings are as good."""
        middle = _medians(logs[list(has)])
        gains = [
            text.format(math.exp(at))
            for (c, text), at in zip(KEYS.items(), middle, strict=True)
            if math.isfinite(at) and (c == AMPS) is (change.column is Column.CURRENTS)
        ]
        seen = f": {', '.join(gains)}"
        if rivals:
            words = (" and ".join(_words(each, robot)[0] for each in rival) for rival in rivals)
            seen += f"; another reading is as good ({' or '.join(words)})"
        fault = _fault(change, has, ids, seen, robot)
        measured = [each for some in (reading, *rivals) for each in some if not each.of_wheels]
        if not rivals or not measured:  # without wheels there is nothing to compare
            return fault
        left_out = f"{KINDS[measured[0].column].logged} is left out; state the units that the logger has"
        sentence = f"{fault.sentence.removesuffix(f'; {fault.repair}')}, so that {left_out}"
        return Fault(measured[0]._replace(factor=math.nan), fault.run_ids, sentence, left_out)

    # those that would show it if they had one of the units that others seem to have
    moved = np.nan_to_num(adds[suggested]).any(axis=0)
    usual = [i for i in informed if not own[i] and (np.isfinite(logs[i]) & moved).any()]
    if len(usual) < MIN_USUAL_RATIO * len(informed):
        middle = _medians(logs[[i for i in informed if i not in usual]])
        best, rivals = likeliest(middle, options, robot)
        has = [i for i in range(len(logs)) if i not in usual]
        return tuple(fault(best, change, rivals, has) for change in best)
    middle, scatter = _medians(logs[usual]), 1.48 * _medians(np.abs(logs[usual] - _medians(logs[usual])))
    near = np.clip(SCATTERS * np.where(np.isfinite(scatter), scatter, TIGHT), TIGHT, NEAR)
    of_runs: dict[Changes, list[int]] = {}
    n_changes = np.array([len(each) for each in changes])
    for i in (i for i in informed if own[i]):
        off = np.where(fit[i] > CLEAR_FIT, logs[i], np.nan) - middle
        left = np.abs(_after(off, adds))
        agrees = (np.nan_to_num(left) <= near).all(axis=1) & (n_changes > 0) & (np.abs(off) > 2 * NEAR).any()
        small, sound = (off < -2 * NEAR) & _MOVING, (np.abs(off) < near) & _MOVING
        if small.any():  # it may just stall, unless another channel shows that it moved
            agrees &= (left[:, small] < TIGHT).all(axis=1) & (small.sum() + sound.sum() > 1)
        if agrees.any():
            distance = np.where(agrees, np.nansum(left, axis=1) + COST * n_changes, np.inf)
            of_runs.setdefault(changes[int(np.argmin(distance))], []).append(i)
    return tuple(
        fault(reading, change, (), has)
        for reading, has in of_runs.items()
        if len(has) >= MIN_FAULTY_RATIO * len(informed)
        for change in reading
    )


def options_of(logs: Array, robot: Robot) -> Options:
    """Return the readings: nothing, one column in another unit, or two that are measured; and what each adds.

    Added is NaN for the currents where wheels change, since they are not in proportion to the wheel speeds: beside a
    motion their gain says nothing of these.  Wheels and what they turn in one other unit would hide each other: then
    a body that slips looks like it.
    """
    known = {c for c, column in zip(KEYS, logs.T, strict=True) if np.isfinite(column).any()}
    single, adds = [], []
    for column, kind in KINDS.items():
        rates = [robot.wheel_radius_m] if column is Column.WHEELS else []  # of wheels in the place of speeds
        if rates or known & {*kind.channels}:
            by = [float(c in kind.channels) for c in KEYS]
            if rates:
                by = [math.nan if c == AMPS else -1.0 for c in KEYS]
            for factor in np.ravel([(size, 1.0 / size) for size in (*kind.units.values(), *rates)]).tolist():
                single.append(Change(FaultKind.UNIT, column, factor))
                adds.append(math.log(factor) * np.array(by))
    measured = [i for i, change in enumerate(single) if not change.of_wheels]
    pairs = [(i, j) for i, j in combinations(measured, 2) if single[i].column is not single[j].column]
    changes = [(), *((change,) for change in single), *((single[i], single[j]) for i, j in pairs)]
    return changes, np.array([np.zeros(len(KEYS)), *adds, *(adds[i] + adds[j] for i, j in pairs)])


def _after(logs: Array, adds: Array) -> Array:
    """Return the logarithms of gains (readings, keys) after changes: a larger prediction makes them less."""
    after = logs + np.nan_to_num(adds)
    if np.isfinite(logs[_MOVING]).any():
        after[np.isnan(adds)] = np.nan
    return np.asarray(after)


def likeliest(logs: Array, options: Options, robot: Robot) -> tuple[Changes, list[Changes]]:
    """Return the reading whose gains are likeliest by their prior, and those that are hardly less likely."""
    changes, adds = options
    gyro, speed, accel, current, heading = _after(logs, adds).T
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
    n_changes = np.array([len(each) for each in changes])
    total = cost + COST * n_changes
    best = int(np.argmin(total))
    if not changes[best] or cost[best] > LEFT:
        return (), []
    near = (total - total[best] < UNIT_TIE) & (n_changes == n_changes[best])
    return changes[best], [changes[i] for i in np.flatnonzero(near).tolist() if i != best]


# -- Constant offsets of sensors that no bias of the catalogue reaches: sensors not zeroed, or turned ------

OFFSET_SIGMAS = 4.0  #: An offset is over the largest by so many standard deviations.
MIN_ROWS = 10


def _offset_faults(runs: Sequence[Rows], robot: Robot) -> tuple[Fault, ...]:
    """Return columns with an offset that no effect has, in all runs or in some of them.

    It is what a channel measures where nothing is predicted; of one motion throughout, a gain looks the same.
    """
    faults = []
    for column, kind in KINDS.items():
        if not math.isfinite(kind.largest):
            continue
        c, value, std = kind.channels[0], *np.full((2, len(runs)), np.nan)
        for i, run in enumerate(runs):
            known = np.isfinite(run.measured[:, c]) & np.isfinite(run.predicted[:, c])
            measured, predicted = run.measured[known, c], run.predicted[known, c]
            if known.sum() < MIN_ROWS:
                continue
            varies = np.std(predicted) > LEAST[c]
            if varies or not np.sqrt(np.mean(predicted**2)) > LEAST[c]:
                basis = np.column_stack([np.ones(measured.size), *([predicted] if varies else [])])
                fit, *_ = np.linalg.lstsq(basis, measured, rcond=None)
                n_independent = max(
                    measured.size * min(run.period_s, 1.0), 1.0
                )  # what is left changes within seconds
                spread = np.linalg.inv(basis.T @ basis / measured.size)[0, 0] / n_independent
                value[i], std[i] = fit[0], np.std(measured - basis @ fit) * np.sqrt(spread)
        has = np.flatnonzero(np.abs(value) > kind.largest + OFFSET_SIGMAS * std)
        if has.size >= max(MIN_FAULTY_RATIO * np.isfinite(value).sum(), 1):
            change = Change(FaultKind.OFFSET, column, offset=-float(np.median(value[has])))
            below = f", where a sensor's is below {kind.largest:g}"
            faults.append(_fault(change, has.tolist(), [run.run_id for run in runs], below, robot))
    return tuple(faults)


# -- Unfit runs: those with a fault of their own, which are excluded before causes are searched ------------

#: A clock is a run's own if it is off by the first, and by so many times its error and the scatter of the others, which
#: is the third at the least.
CLOCK_S, CLOCK_SIGMAS, CLOCK_SCATTER_S = 0.12, 6.0, 0.01
#: Spread of a wheel speed that never changes, of one that does, and a speed at which no wheel rests.
STILL_MPS, VARIES_MPS, MOVING_MPS = 0.002, 0.05, 0.2
#: Of the gain of a run over that of the others, which one dead wheel of two makes 2 or 0: a wheel that never changes is
#: dead only beyond that, or where the body does not follow the wheels at all.
OFF_RATIO = 1.5
#: A channel is dead in a run that has some of it but less than the first, the others over the second.
MIN_FINITE_RATIO, USUAL_FINITE_RATIO = 0.3, 0.7
#: A channel is frozen if it is constant for the first at a time, and clipped if it is at its extreme for the second in
#: all and the third of a run, while the prediction varies.
FROZEN_S, CLIPPED_S, CLIPPED_RATIO = 2.0, 1.0, 0.03

MARGIN_S = 0.6  #: Tolerance of the time at which a predicted change arrives.
#: Of what is expected meanwhile: range and spread over its spread in the run.
FROZEN_RANGE, CLIPPED_SPREAD = 0.5, 0.1
#: The end of a range is so far out at the least, over the largest size: idle currents rest at the other.
FAR_END = 0.5


class Clock(NamedTuple):
    """Delay of the IMU's and the camera's logger behind the wheels' in a run, and its standard deviation."""

    run_id: str
    offset_s: float
    std_s: float


def unfit_runs(
    signals: Sequence[Signals], info: Evidence, shift: Shift | None = None
) -> tuple[Excluded, ...]:
    """Return the unfit runs, each with the first reason that is found; clocks are measured unless they are known.

    Raises
    ------
    DataError
        if most runs' clocks are further apart than is searched.
    """
    shift = shifts_of(info) if shift is None else shift
    runs = on_own_clocks(info.rows, shift)
    follows, every = agreement_of(runs), range(len(runs))
    has_clock = [bool(known.any()) for known in np.isfinite(shift.lag_s)]
    reasons = _frozen(signals, info.rows)
    reasons |= stalled_runs(runs, follows, has_clock, MAX_LAG_S + MARGIN_S - STRETCH_S)
    reasons |= _late(info, shift) | _dead(signals, runs, follows)  # the last of these counts
    reasons |= odd_runs(runs, follows, [i for i in every if i not in reasons])
    reasons |= _unlike(info, [i for i in every if i not in reasons])
    return tuple(Excluded(signals[i].run_id, reasons[i]) for i in sorted(reasons))


def clocks_of(info: Evidence, shift: Shift) -> tuple[Clock, ...]:
    """Return how far IMU and camera are behind the wheels at the middle of each run, NaN where unknown."""
    offset_s, std_s = offsets_of(shift)
    offset_s += info.vector[INDEX["clock_offset_s"]]
    return tuple(map(Clock, (run.run_id for run in info.rows), offset_s.tolist(), std_s.tolist()))


def _frozen(signals: Sequence[Signals], rows: Sequence[Rows]) -> dict[int, str]:
    """Return runs with a channel that is constant, or clipped, while the prediction varies."""
    reasons: dict[int, str] = {}
    for i, (run, beside) in enumerate(zip(signals, rows, strict=True)):
        for c in np.flatnonzero(np.isfinite(run.measured).any(axis=0)):
            values, expected = run.measured[:, c], beside.predicted[:, c]
            spread, name = float(np.std(expected)), CHANNELS[c]
            if not spread > 0:
                continue
            for start_s, end_s in true_stretches(values[1:] == values[:-1]) * run.dt_s:
                inside = (beside.time_s > start_s + MARGIN_S) & (beside.time_s < end_s - MARGIN_S)
                if end_s - start_s > FROZEN_S and np.ptp(expected[inside]) > FROZEN_RANGE * spread:
                    reasons[i] = f"its {name} is frozen for {end_s - start_s:.1f} s while it should change"
            for end in (np.nanmax(values), np.nanmin(values)):
                there = np.flatnonzero(values == end)
                if len(there) < max(CLIPPED_S / run.dt_s, CLIPPED_RATIO * len(values)):
                    continue
                if abs(end) < FAR_END * np.nanmax(np.abs(values)):  # a value at rest is no end of a range
                    continue
                if np.std(np.interp(there * run.dt_s, beside.time_s, expected)) > CLIPPED_SPREAD * spread:
                    reasons[i] = f"its {name} is clipped at {end:.3g} for {len(there) * run.dt_s:.1f} s"
    return reasons


def _late(info: Evidence, shift: Shift) -> dict[int, str]:
    """Return runs with a clock of their own: all channels that measure it are off, and by the same lag."""
    offset_s = offsets_of(shift)[0] + info.vector[INDEX["clock_offset_s"]]
    reasons: dict[int, str] = {}
    for i, lag_s in enumerate(shift.lag_s):
        if shift.lost[i]:
            reasons[i] = f"its IMU and camera are not {MIN_LAG_S:g} to {MAX_LAG_S:g} s behind its wheels"
        others = np.delete(shift.lag_s, i, axis=0)
        middle_s = _medians(others)
        scatter_s = np.fmax(1.48 * _medians(np.abs(others - middle_s)), CLOCK_SCATTER_S)
        known = np.isfinite(lag_s) & (np.isfinite(others).sum(axis=0) >= 2)
        off, error = (lag_s - middle_s)[known], np.hypot(shift.std_s[i], scatter_s)[known]
        own = known.any() and (np.abs(off) > np.maximum(CLOCK_S, CLOCK_SIGMAS * error)).all()
        if own and np.ptp(off) < CLOCK_S + CLOCK_SIGMAS * error.max():
            behind, usual = (
                f"{abs(at_s):.2f} s {'behind' if at_s >= 0 else 'ahead of'}"
                for at_s in (offset_s[i], np.nanmedian(np.delete(offset_s, i)))
            )
            reasons[i] = f"its IMU and camera are {behind} its wheels, {usual} in the other runs"
    return reasons


def _dead(signals: Sequence[Signals], runs: Sequence[Rows], follows: Agreement) -> dict[int, str]:
    """Return runs with a wheel or a channel of which hardly anything is there.

    A wheel that is driven at a steady speed beside others that change is no dead one: the body follows them, as the
    wheels make it move in the other runs.
    """
    reasons: dict[int, str] = {}
    known_ratio = np.array([np.isfinite(run.measured).mean(axis=0) for run in signals])
    usual, common = np.median(known_ratio, axis=0), common_gains(follows)
    for i, run in enumerate(signals):
        dead = (known_ratio[i] > 0) & (known_ratio[i] < MIN_FINITE_RATIO) & (usual > USUAL_FINITE_RATIO)
        dead[AMPS] &= not run.steer_rad.any()  # it is compared only while the wheels are parallel
        for c in np.flatnonzero(dead):
            reasons[i] = f"its {CHANNELS[c]} is known in {known_ratio[i, c]:.0%} of its samples"
        known = np.isfinite(run.wheel_speed_mps).all(axis=1)
        if known.mean() < MIN_FINITE_RATIO:
            reasons[i] = f"its wheel speeds are known in {known.mean():.0%} of its samples"
            continue
        speed_mps = run.wheel_speed_mps[known]
        spread = speed_mps.std(axis=0)
        asked = [c for c in MOTION if follows.correlation[i, c] != 0.0]
        off = np.abs(
            np.log(np.abs(follows.gain[i, asked] / common[asked]))
        )  # NaN, which is not over, if unknown
        disagrees = (follows.correlation[i, asked] < FOLLOWS).any() or (off > math.log(OFF_RATIO)).any()
        if spread.min() < STILL_MPS and spread.max() > VARIES_MPS and disagrees:
            reasons[i] = f"its wheel {int(np.argmin(spread)) + 1} never turns faster or slower, the others do"
        elif np.abs(speed_mps).max() < STILL_MPS:
            shown = np.nan_to_num(runs[i].measured[:, [X, Y]])
            if np.hypot(*shown.T).max(initial=0.0) > MOVING_MPS:
                reasons[i] = "its wheels are at rest, its camera moves"
    return reasons


#: Least number of other runs of its terrain that a run is compared with: of three runs two may be wrong.
MIN_OTHERS = 3
#: Information over that of the prior, below which a parameter is not counted: fitting it costs nothing.
UNKNOWN_RATIO = 1e-6
#: A run is an outlier if a simulation in common with the others costs it so many times what one in common costs them
#: among themselves, and so many variances of the noise a row.  Of 15 000 simulated runs without a fault, whatever was
#: hidden in all runs of a set, one passed both.
UNLIKE_RATIO, UNLIKE_NOISE_RATIO = 12.0, 0.2


def _unlike(info: Evidence, among: Sequence[int]) -> dict[int, str]:
    """Return runs that no simulation in common with those of the same terrain fits.

    What a simulation in common costs a run is that in minus twice the log-likelihood, over a fit of each run by itself.
    """
    reasons: dict[int, str] = {}

    def loss(a: Array, g: Array) -> Array:
        x = np.linalg.solve(a + info.prior, g[..., None])[..., 0]
        return np.asarray(-(x * g).sum(axis=-1))

    for terrain in dict.fromkeys(info.rows[i].terrain for i in among):
        left = [i for i in among if info.rows[i].terrain == terrain]
        for _ in range((len(left) - 1) // MIN_OTHERS):
            a, g, n = info.a[left], info.g[left], len(left)
            k = int((a.sum(axis=0).diagonal() > UNKNOWN_RATIO * info.prior.diagonal()).sum())
            own = loss(a, g)
            n_rows = np.array([int((info.white[i][-1] != 0.0).sum()) for i in left])
            seen = n_rows > 0  # of a short run nothing may be left once filters have settled
            noise = float(np.median((info.c[left] + own)[seen] / n_rows[seen])) if seen.any() else 1.0
            others = loss(a.sum(axis=0) - a, g.sum(axis=0) - g) - (own.sum() - own)
            alone = float(loss(a.sum(axis=0), g.sum(axis=0))) - own.sum() - others
            ratio = alone / (others / max(n - 2, 1) + k * noise)
            worst = int(np.argmax(ratio))
            noise_ratio = alone[worst] / (noise * max(n_rows[worst], 1))
            if not (ratio[worst] > UNLIKE_RATIO and noise_ratio > UNLIKE_NOISE_RATIO):
                break
            reasons[left.pop(worst)] = (
                f"it is unlike the other runs: in common with them it fits {ratio[worst]:.0f} times worse than "
                "they do among themselves"
            )
    return reasons


# -- Runs against the common response of the others: those that stall, and those of another robot ----------
# The common response is a gain of each channel over the simulation's prediction, which may be wrong by any
# factor.  How far runs scatter about it is estimated from them.

#: Correlation about zero of a channel with its prediction, from which a run shows the common response: a body that
#: sticks and comes free follows its wheels less.
FOLLOWS = 0.85
MIN_RUNS = 3  #: Least number of runs that show it.
#: Ratio of the common response below which a body stalls, and of the prediction where none is known: slip of the
#: catalogue goes to 0.1 of what is predicted.
STALLED_RATIO, NOMINAL_RATIO = 0.25, 0.05
#: A run stalls that does so for the first in all, or for the third of the time that it should move, in stretches of the
#: second at the least, and far longer than the others.
STALLED_S, STRETCH_S, ALL_RATIO = 2.0, 1.0, 0.8
FLOOR = np.array(
    [0.02, 0.015, 0.02]
)  #: What sensors measure of the motion of a body at rest (rad/s, m/s, rad/s).
#: Of rows in which no turn is predicted, and so many at the least, the median of the gyro is its bias.
STRAIGHT_RADPS, MIN_STRAIGHT = 0.02, 10
#: A run is of another robot or terrain if its gain is off by so many times the scatter of the runs and its own error,
#: times one plus the second over their number, since few runs measure their scatter badly: of normal gains at most one
#: set of 500 has such a run.  It is off by the third, too, in the logarithm: radii of one robot differ by less.
SIGMAS, FEW_RUNS, LEAST_OFF = 4.5, 8.0, 0.15
MIN_COMPARED = 6  #: Of fewer runs with a gain, one in a hundred sets has such a run.
#: Scatter comes from that ratio of the runs, the nearest to the median, and what it is of a normal law: the rest may be
#: of other robots.
INNER, INNER_SIGMAS = 2 / 3, 0.967
MIN_SCATTER = 0.02  #: Scatter of a robot's runs at the least, in the logarithm.
#: More runs than that are no outliers: runs then differ in groups, which is for the diagnosis to say.
MAX_ODD_RATIO = 1 / 3
#: Channels by which runs are compared: gains of the others depend on what was driven.
ODD_CHANNELS = {G: "yaw rate", H: "heading rate", X: "speed"}
#: What wheels make of a body in the common response, and what it does.
STALLS = {
    G: "its wheels turn it at {:.2f} rad/s by the other runs, its body turns at {:.2f} rad/s",
    H: "its wheels turn it at {:.2f} rad/s by the other runs, its heading changes at {:.2f} rad/s",
    X: "its wheels drive it at {:.2f} m/s by the other runs, its body moves at {:.2f} m/s",
}


def common_gains(follows: Agreement) -> Array:
    """Return the common response (channels,): the median gain of runs that follow; NaN for too few."""
    shown = np.where((follows.correlation > FOLLOWS) & (follows.gain > 0), follows.gain, np.nan)
    return np.where(np.isfinite(shown).sum(axis=0) >= MIN_RUNS, _medians(shown), np.nan)


def stalled_runs(
    runs: Sequence[Rows], follows: Agreement, has_clock: Sequence[bool], extra_s: float
) -> dict[int, str]:
    """Return runs whose wheels turn while the body hardly responds, far longer than in the others, and why.

    Stretches have to be longer by ``extra_s`` where the clock of a run is not known and the run does not follow the
    wheels on the clock of all: a clock of its own looks like a short stall.
    """
    if len(runs) < 2:
        return {}
    common = common_gains(follows)
    least_ratio = np.where(np.isfinite(common), STALLED_RATIO, NOMINAL_RATIO)[MOTION]
    common = np.where(np.isfinite(common), common, 1.0)
    stalls, time_s, asked_s = [], [], []
    for run, clock, fit in zip(runs, has_clock, follows.correlation, strict=True):
        expected, seen = run.predicted * common, run.measured.copy()
        straight = np.isfinite(seen[:, G]) & (np.abs(expected[:, G]) < STRAIGHT_RADPS)
        if straight.sum() >= MIN_STRAIGHT:
            seen[:, G] -= np.median(seen[straight, G])
        size, should = np.abs(seen[:, MOTION]), np.abs(expected[:, MOTION])
        sideways = np.where(np.isfinite(seen[:, Y]), seen[:, Y], 0.0)  # the body may slide
        size[:, 1] = np.hypot(size[:, 1], sideways)
        known, still = np.isfinite(size), size < least_ratio * should + FLOOR
        asked = (known & (should > LEAST[MOTION])).any(axis=1)
        stalled = asked & (known & still).any(axis=1) & ~(known & ~still).any(axis=1)
        least_s = STRETCH_S + (0.0 if clock or (fit[MOTION] > FOLLOWS).any() else extra_s)
        for start, end in true_stretches(stalled):
            stalled[start:end] = (end - start) * run.period_s >= least_s
        stalls.append((expected, stalled))
        time_s.append(run.period_s * stalled.sum())
        asked_s.append(run.period_s * asked.sum())
    reasons = {}
    for i, (run, (expected, stalled)) in enumerate(zip(runs, stalls, strict=True)):
        least_s = min(STALLED_S, max(ALL_RATIO * asked_s[i], STRETCH_S))
        if time_s[i] < least_s + 3.0 * float(np.median(np.delete(time_s, i))):
            continue
        words = []
        for c, text in STALLS.items():
            moves, does = np.abs(expected[stalled, c]), np.abs(run.measured[stalled, c])
            there = np.isfinite(does)
            if there.any() and moves[there].mean() > LEAST[c]:
                words.append(text.format(moves[there].mean(), does[there].mean()))
        words.append("its wheels turn, its body is at rest")
        reasons[i] = f"it is stalled for {time_s[i]:.1f} s in all: {words[0]}"
    return reasons


def odd_runs(runs: Sequence[Rows], follows: Agreement, among: Sequence[int]) -> dict[int, str]:
    """Return runs, among those at some places, that respond to their wheels unlike the others of their terrain.

    Their gain is an outlier of all runs'; none is where there are too many.
    """
    reasons: dict[int, str] = {}
    for terrain in dict.fromkeys(runs[i].terrain for i in among):
        of_terrain = [i for i in among if runs[i].terrain == terrain]
        for c, name in ODD_CHANNELS.items():
            gain, fit = follows.gain[:, c], follows.correlation[:, c]
            places = [i for i in of_terrain if gain[i] > 0 and fit[i] > FOLLOWS]
            if len(places) < MIN_COMPARED:
                continue
            seconds = [np.isfinite(runs[i].measured[:, c]).sum() * min(runs[i].period_s, 1.0) for i in places]
            error = np.sqrt(np.maximum(1.0 / fit[places] ** 2 - 1.0, 0.0) / np.maximum(seconds, 1.0))
            logs = np.log(gain[places])
            off = logs - np.median(logs)
            inner = float(np.quantile(np.abs(off), INNER, method="higher"))
            scatter = max(inner / INNER_SIGMAS, MIN_SCATTER)
            sigmas = SIGMAS * (1.0 + FEW_RUNS / len(places))
            far = np.flatnonzero(np.abs(off) > np.maximum(sigmas * np.hypot(scatter, error), LEAST_OFF))
            for k in far if len(far) <= MAX_ODD_RATIO * len(places) else ():
                text = f"its {name} is {math.exp(off[k]):.2f} times what they make of the same wheels"
                reason = f"it is unlike the other runs: {text}, and they scatter by {scatter:.0%}"
                reasons.setdefault(places[k], reason)
    return reasons
