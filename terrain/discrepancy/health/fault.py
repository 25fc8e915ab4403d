"""A fault of a column: what is wrong with it, in words, with its repair."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.discrepancy.health.agreement import AMPS, MOTION, A, G, H, T, X, Y
from terrain.discrepancy.health.samples import clipped, held
from terrain.discrepancy.runs import IMU_AXES, Signals
from terrain.effects import CHANNELS
from terrain.records import Array
from terrain.robots import Robot


class FaultKind(StrEnum):
    """What is wrong with a column."""

    SIGN = "sign"
    UNIT = "unit"
    SWAPPED = "swapped"
    OFFSET = "offset"
    SCALE = "scale"
    AXES = "axes"
    DROPOUT = "dropout"
    SATURATION = "saturation"
    DRIFT = "drift"


class FaultStatus(StrEnum):
    """Whether a log is changed for a fault: only where runs that it was not found in confirm it.

    ``undecided``: the logs have no channel that tells it from other readings, which are given.  ``not confirmed``: so
    few runs show it that none is left to confirm it; nothing is changed.
    """

    CONFIRMED = "confirmed"
    UNDECIDED = "undecided"
    NOT_CONFIRMED = "not confirmed"


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
    """Of a column: measured channels, name in logs, unit, other units that loggers have, and its sides."""

    channels: tuple[int, ...]
    logged: str
    si: str
    units: dict[str, float]
    sides: str = ""


#: By column; wheel speeds are the inputs of the simulation.
KINDS = {
    Column.GYRO: _Kind((G,), "gyro_z_radps", "rad/s", {"deg/s": DEG, "rpm": RPM}),
    Column.HEADING: _Kind((H,), "yaw_rate_radps", "rad/s", {"deg/s": DEG, "rpm": RPM}),
    Column.SPEED: _Kind((X, Y), "speed_x_mps and speed_y_mps", "m/s", {"km/h": KMH, "mm/s": MILLI}),
    Column.ACCEL: _Kind((A,), "accel_x_mps2", "m/s^2", {"g": GRAVITY_MPS2}),
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
    axis: int = -1  #: place in IMU_AXES of the axis that is in the column's place
    drift: float = 0.0  #: that is added each second of a run
    over_runs: float = 0.0  #: that is added from run to run, in their order

    @property
    def of_wheels(self) -> bool:
        """Whether it changes what drives the simulation."""
        return self.column in (Column.WHEELS, Column.SIDES)

    @property
    def of_samples(self) -> bool:
        """Whether it takes samples of a run, and not all rows alike."""
        return self.kind in (FaultKind.AXES, FaultKind.DROPOUT, FaultKind.SATURATION, FaultKind.DRIFT)

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
        own = list(KINDS[self.column].channels)
        if self.kind in (FaultKind.DROPOUT, FaultKind.SATURATION):
            measured, is_held = run.measured.copy(), self.kind is FaultKind.DROPOUT
            for c in own:
                values = measured[:, c]
                mask = held(values, run.dt_s, c in MOTION) if is_held else clipped(values, run.dt_s)
                measured[mask, c] = np.nan
            return replace(run, measured=measured)
        if self.kind is FaultKind.AXES:
            if not run.axes.size:
                return run
            measured = run.measured.copy()
            measured[:, own[0]] = self.factor * run.axes[:, self.axis]
            return replace(run, measured=measured)
        measured = self.measured(run.measured)
        if self.kind is FaultKind.DRIFT:
            place = run.place if math.isfinite(run.place) else 0.0
            measured[:, own[0]] += self.drift * (run.time_s - run.start_s) + self.over_runs * place
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
    status: FaultStatus = FaultStatus.CONFIRMED
    rivals: Changes = ()  #: other readings that the logs cannot distinguish from it

    @property
    def heading(self) -> str:
        """What was done about it, in words."""
        return {
            FaultStatus.CONFIRMED: "Fault of the logs, repaired before anything was compared",
            FaultStatus.UNDECIDED: "Fault of the logs, whose column the other channels cannot determine",
            FaultStatus.NOT_CONFIRMED: "Fault of the logs that no other run confirms, so that nothing was changed",
        }[self.status]

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        change = {name: getattr(self.change, name) for name in ("kind", "column", "factor")}
        text = {"sentence": self.sentence, "repair": self.repair, "status": self.status}
        return {**change, "runs": self.run_ids, **text}


def repaired(signals: Sequence[Signals], faults: Sequence[Fault]) -> tuple[Signals, ...]:
    """Return runs without faults, in the same order.

    Where readings that are mirror images cannot be distinguished, either gives the same comparison but for the side; of
    other readings the channel is left out.  What no other run confirms is left as it is.
    """
    fixed = list(signals)
    for fault in faults:
        if fault.status is FaultStatus.NOT_CONFIRMED:
            continue
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


def change_in_words(change: Change, robot: Robot) -> tuple[str, str]:
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
    if change.kind in (FaultKind.DROPOUT, FaultKind.SATURATION):
        first = logged.split(" and ")[0]
        how = (
            "holds its value for seconds"
            if change.kind is FaultKind.DROPOUT
            else "is at the end of its range"
        )
        return f"{name} {how} while it should change", f"these samples of {first} are left out"
    if change.kind is FaultKind.AXES:
        axis, own = IMU_AXES[change.axis], IMU_AXES[3 * (change.axis // 3) + (2 if change.axis < 3 else 0)]
        sign = "" if change.factor > 0 else ", with its sign turned"
        return f"axes of {name} are exchanged: {own} is in {axis}{sign}", f"take {own} from {axis}{sign}"
    if change.kind is FaultKind.DRIFT and change.over_runs:
        size, first = f"{-change.over_runs:.2g} {kind.si} from run to run", logged.split(" and ")[0]
        return (
            f"the zero of {name} drifts by {size}",
            f"subtract {-change.offset:.2g} and {size} from {first}",
        )
    if change.kind is FaultKind.DRIFT:
        size, first = f"{-change.drift:.2g} {kind.si} a second", logged.split(" and ")[0]
        return f"the zero of {name} drifts by {size} in each run", f"subtract {size} from {first}"
    if change.kind is FaultKind.OFFSET:
        size, first = f"{-change.offset:.3g} {kind.si}", logged.split(" and ")[0]
        hint = f"mapping file: offset: {change.offset:.3g}"
        return f"{name} has an offset of {size}", f"subtract {size} from {first} ({hint})"
    hint = f"scale: {change.factor:.4g}"
    if change.kind is FaultKind.SCALE:
        what = f"{name} reads {abs(1.0 / change.factor - 1.0):.0%} too {'much' if change.factor < 1.0 else 'little'}"
        return what, f"multiply {logged} by {change.factor:.4g} (mapping file: {hint})"
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


def fault_of(change: Change, has: Sequence[int], every: Sequence[str], seen: str, robot: Robot) -> Fault:
    """Return the fault of a change in some of the runs, with how it is seen."""
    ids = tuple(every[i] for i in has)
    what, repair = change_in_words(change, robot)
    return Fault(change, ids, f"{what} {in_runs(ids, every)}{seen}; {repair}", repair)
