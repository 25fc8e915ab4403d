"""What a sensor fault does to a closed-loop drive: situations, drives, figures, and the bars that they have to meet.

A drive with a fault is compared with two others in the same situation and by the same seed: the *clean* one,
by the same controller without the fault, and the *plain* one, by the commands of the kinematics alone, which
no sensor fault touches.  A fault must not make slip control worse than having none.  A pilot's exceptions do not
end a drive: they are counted, and the wheels keep their last command.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Protocol

import numpy as np

from terrain.control.drive_metrics import (
    PEAK_ABOVE_MPS,
    STANDING_MPS,
    DriveHistory,
    drive_history,
    stopping_distance,
)
from terrain.control.situations import (
    BRAKE,
    Situation,
    SituationOptions,
    brake_time,
    make_situation,
    simulate_situation,
    start_times,
)
from terrain.control.traction import TractionStatus
from terrain.errors import ConfigError
from terrain.records import Array, Command, RunLog, Sample
from terrain.robots import Robot
from terrain.signals import low_pass
from terrain.simulation.conditions import Faults
from terrain.simulation.faults import FaultyBus, Nature, SensorFault, fault_catalogue
from terrain.simulation.scenario import Scenario

START, STOP, STEADY = "start", "stop", "steady"

FAULT_SITUATIONS: dict[str, str] = {
    START: "from rest at 1 m/s^2 to 1 m/s; the fault begins as the start does",
    STOP: "a command to stop at once from 1 m/s; the fault begins with the command",
    STEADY: "at 1 m/s; the fault begins 3 s after the speed was reached",
}
"""Situations by name."""

START_LENGTH_S, STEADY_LENGTH_S = 7.0, 10.0
"""Long enough for a fault of 3 s and 2 s after it."""

STEADY_FAULT_S = 5.0
"""By then the slip of steady motion is known to the controller, after 1 s of rest and 1 s of start."""


class FaultSituation(NamedTuple):
    """A situation, and the time at which a fault begins in it."""

    situation: Situation
    start_s: float


def make_fault_situation(name: str, robot: Robot, terrain: str, seed: int) -> FaultSituation:
    """Return a situation without any fault by chance.

    Parameters
    ----------
    name : one of :data:`FAULT_SITUATIONS`
    robot : swerve robot
    terrain : soil
    seed : of all that is drawn: load, soil, tyres, noise

    Raises
    ------
    ConfigError
        if the situation or the terrain is unknown.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> make_fault_situation("start", load_robot("agrimaro"), "grass", 0).start_s
    1.0
    """
    if name not in FAULT_SITUATIONS:
        raise ConfigError(f"situation {name!r} is unknown: use {', '.join(FAULT_SITUATIONS)}")
    length_s = {START: START_LENGTH_S, STEADY: STEADY_LENGTH_S}.get(name)
    scenario = BRAKE if name == STOP else "straight"
    made = make_situation(scenario, robot, terrain, seed, SituationOptions(duration_s=length_s))
    made = made._replace(faults=Faults(by_chance=False))
    if name == START:
        return FaultSituation(made, start_times(made.scenario)[0])
    return FaultSituation(made, brake_time(made.scenario) if name == STOP else STEADY_FAULT_S)


_SLACK_S = 1e-9  # figures and instants that differ by less are the same

RATIO_ABOVE_MPS = 0.3
"""The error of slip is evaluated where each wheel, or the ground below it, is faster: there an error of
1 cm/s in a speed is 3 % of slip."""

OVERSPEED_MPS = 0.05
"""A commanded speed counts as above the desired one by more than this; a wheel's share of the torque among
wheels of different radii is corrected by less."""


class Limits(NamedTuple):
    """Limits of the figures.

    Parameters
    ----------
    ok_s : time for which a stream may be dead or lying before the status is another than OK
    held_back_s : time without OK beyond the clean drive's while a fault is tolerable
    slip_error_ratio : of the slip while the status is OK
    slip_error_chance_ratio : the limit is at least the clean drive's own error and this
    slip_peak_ratio : true slip above the plain drive's: what differs by chance between two drives whose
        commands differ little
    stop_ratio : stopping distance over the plain drive's
    recovery_s : from the end of the fault to OK
    overspeed_s : time for which the commanded speed is above the desired one: a controlled braking from
        1 m/s on a slick floor takes 0.5 s
    """

    ok_s: float = 0.3
    held_back_s: float = 0.3
    slip_error_ratio: float = 0.05
    slip_error_chance_ratio: float = 0.03
    slip_peak_ratio: float = 0.03
    stop_ratio: float = 1.1
    recovery_s: float = 1.0
    overspeed_s: float = 1.0


LIMITS = Limits()


class FaultDrive(NamedTuple):
    """What is evaluated of a drive, at the instants of its control.

    Parameters
    ----------
    time_s : (n,)
    ok : (n,) whether the status is OK
    slip_ratio, true_slip_ratio : (n,) largest of the wheels, estimated by the controller, and the true one
        behind the estimate's low-pass; NaN where unknown, and the true one where a wheel is slow
    body_slip_ratio : (n,) true slip of the robot, the mean over its wheels; NaN where it is slow
    moving : (n,) whether the robot moves or motion is desired
    commanded_mps, desired_mps, speed_mps : (n,) mean of the wheels' commands, what is desired, and the true
        speed over ground
    stop_s : time of the command to stop; infinite without one
    stop_m : distance travelled from then to standstill; NaN where there was none
    """

    time_s: Array
    ok: Array
    slip_ratio: Array
    true_slip_ratio: Array
    body_slip_ratio: Array
    moving: Array
    commanded_mps: Array
    desired_mps: Array
    speed_mps: Array
    stop_s: float = math.inf
    stop_m: float = math.nan


class FaultFigures(NamedTuple):
    """Figures of a drive with a fault; NaN where one is not defined.

    Parameters
    ----------
    ok_total_s, ok_longest_s : time with status OK while the fault acts and the robot is to move: all, and the
        longest in one piece
    not_ok_s : time without OK meanwhile, beyond the clean drive's
    slip_error_ratio, clean_slip_error_ratio : largest error of slip while the status is OK, from the fault's
        start on; of the clean drive
    slip_peak_ratio, plain_slip_peak_ratio : largest magnitude of the robot's true slip, from the fault's
        start on; of the plain drive
    stop_m, stop_ratio : stopping distance, and over that of the plain drive; infinite without a standstill
    recovery_s : from the end of the fault until the status is OK and remains so while the robot is to move;
        infinite where it does not; NaN of a fault for good, and where the robot stands by then
    overspeed_s : longest time for which the commanded speed is above the desired one
    n_exceptions, n_not_finite : steps at which the controller raised, or gave a command that is not finite
    """

    ok_total_s: float
    ok_longest_s: float
    not_ok_s: float
    slip_error_ratio: float
    clean_slip_error_ratio: float
    slip_peak_ratio: float
    plain_slip_peak_ratio: float
    stop_m: float
    stop_ratio: float
    recovery_s: float
    overspeed_s: float
    n_exceptions: int
    n_not_finite: int


BARS: Mapping[str, str] = {
    "ok_ends": "status OK while a dead or lying stream acts: at most {ok_s:g} s in all",
    "goes_on": "status not OK while a tolerable fault acts: at most {held_back_s:g} s more than without it",
    "slip_error": "error of slip while the status is OK: at most {slip_error_ratio:g}, or the clean drive's "
    "own and {slip_error_chance_ratio:g}",
    "slip_peak": "peak of the true slip: at most that of plain commands and {slip_peak_ratio:g}",
    "stop": "stopping distance: at most {stop_ratio:g} times that of plain commands",
    "recovery": "status OK again after the fault: within {recovery_s:g} s",
    "overspeed": "commanded speed above the desired one: for at most {overspeed_s:g} s",
    "finite": "commands that are not finite, and exceptions: none",
}
"""The bars by name; the limits are those of :class:`Limits`."""


def fault_drive(
    run: RunLog,
    history: DriveHistory,
    robot: Robot,
    scenario: Scenario,
) -> FaultDrive:
    """Return what is evaluated of a drive straight ahead.

    Parameters
    ----------
    run, history : its log with the streams ``control`` and ``commands``, and the history of its truth
    robot : the one that was simulated; its encoders' low-pass is the lag of every estimate
    scenario : straight ahead; a command to stop is one of :func:`terrain.control.situations.brake_time`
    """
    control, commands, time_s = run.streams["control"], run.streams["commands"], run.streams["control"].time_s
    step_s = float(history.time_s[1] - history.time_s[0])
    tau_s = robot.equipment.sensors.encoder_time_constant_s
    wheel, ground = (
        low_pass(each, step_s, tau_s, at_first=True) for each in (history.wheel_speed_mps, history.ground_mps)
    )
    fastest = np.maximum(np.abs(wheel), np.abs(ground))
    with np.errstate(invalid="ignore", divide="ignore"):
        slip = ((wheel - ground) / fastest).max(axis=1)
    slip[fastest.min(axis=1) < RATIO_ABOVE_MPS] = np.nan
    body = history.slip_ratio.mean(axis=1)
    body[history.speed_mps <= PEAK_ABOVE_MPS] = np.nan
    speed = np.interp(time_s, history.time_s, history.speed_mps)
    wheels = np.column_stack([commands.channel(f"wheel_{i}_radps") for i in robot.wheels])
    desired = np.hypot(scenario.twist[:, 0], scenario.twist[:, 1])
    stop_s = brake_time(scenario) if scenario.name == BRAKE else math.inf
    return FaultDrive(
        time_s=time_s,
        ok=control.channel("status_code") == TractionStatus.OK,
        slip_ratio=control.channel("slip_ratio"),
        true_slip_ratio=np.interp(time_s, history.time_s, slip),
        body_slip_ratio=np.interp(time_s, history.time_s, body),
        moving=(speed > STANDING_MPS) | (desired > 0.0),
        commanded_mps=np.abs(wheels).mean(axis=1) * robot.wheel_radius_m,
        desired_mps=desired,
        speed_mps=speed,
        stop_s=stop_s,
        stop_m=stopping_distance(history, stop_s) if math.isfinite(stop_s) else math.nan,
    )


def fault_figures(
    drive: FaultDrive,
    clean: FaultDrive,
    plain: FaultDrive,
    start_s: float,
    end_s: float,
    n_exceptions: int = 0,
    n_not_finite: int = 0,
) -> FaultFigures:
    """Return the figures of a drive with a fault.

    Parameters
    ----------
    drive, clean, plain : with the fault, without it, and by plain commands, at the same instants
    start_s, end_s : between which the fault acts; an infinite end is for good
    n_exceptions, n_not_finite : as counted in the drive
    """
    time_s = drive.time_s
    step_s = float(np.median(np.diff(time_s)))
    since = time_s >= start_s - _SLACK_S
    acts = since & (time_s < end_s - _SLACK_S)
    ok, not_ok = (acts & drive.moving & each for each in (drive.ok, ~drive.ok))
    clean_not_ok = acts & clean.moving & ~clean.ok
    too_fast = drive.commanded_mps > drive.desired_mps + OVERSPEED_MPS
    is_stop = math.isfinite(plain.stop_m)
    stop_m = drive.stop_m if math.isfinite(drive.stop_m) else math.inf
    return FaultFigures(
        ok_total_s=_time_s(ok.sum(), step_s),
        ok_longest_s=_time_s(_longest(ok), step_s),
        not_ok_s=_time_s(max(not_ok.sum() - clean_not_ok.sum(), 0), step_s),
        slip_error_ratio=_slip_error(drive, since),
        clean_slip_error_ratio=_slip_error(clean, since),
        slip_peak_ratio=_largest(np.abs(drive.body_slip_ratio[since])),
        plain_slip_peak_ratio=_largest(np.abs(plain.body_slip_ratio[since])),
        stop_m=stop_m if is_stop else math.nan,
        stop_ratio=stop_m / plain.stop_m if is_stop else math.nan,
        recovery_s=_recovery_s(drive, end_s),
        overspeed_s=_time_s(_longest(since & too_fast), step_s),
        n_exceptions=n_exceptions,
        n_not_finite=n_not_finite,
    )


def judge(figures: FaultFigures, nature: Nature, limits: Limits = LIMITS) -> dict[str, bool | None]:
    """Return which of :data:`BARS` are met; None for one that does not apply, or whose figure is undefined.

    Parameters
    ----------
    figures : of the drive
    nature : of the fault, which decides on ``ok_ends`` and ``goes_on``
    limits : of the figures
    """
    one = figures
    error_limit = max(
        limits.slip_error_ratio, one.clean_slip_error_ratio + limits.slip_error_chance_ratio
    )  # the clean drive's error is NaN where it has none: the first then
    return {
        "ok_ends": _at_most(one.ok_total_s, limits.ok_s) if nature in (Nature.DEAD, Nature.LYING) else None,
        "goes_on": _at_most(one.not_ok_s, limits.held_back_s) if nature is Nature.TOLERABLE else None,
        "slip_error": _at_most(one.slip_error_ratio, error_limit),
        "slip_peak": _at_most(one.slip_peak_ratio, one.plain_slip_peak_ratio + limits.slip_peak_ratio),
        "stop": _at_most(one.stop_ratio, limits.stop_ratio),
        "recovery": _at_most(one.recovery_s, limits.recovery_s),
        "overspeed": _at_most(one.overspeed_s, limits.overspeed_s),
        "finite": one.n_exceptions + one.n_not_finite == 0,
    }


def bar_texts(limits: Limits = LIMITS) -> dict[str, str]:
    """Return what each bar asks for.

    Examples
    --------
    >>> bar_texts()["recovery"]
    'status OK again after the fault: within 1 s'
    """
    return {name: text.format(**limits._asdict()) for name, text in BARS.items()}


class BarCount(NamedTuple):
    """A bar over all drives: what it asks for, and how many meet it, do not, and are not judged by it."""

    text: str
    n_met: int
    n_unmet: int
    n_not_judged: int


def count_bars(judged: Sequence[Mapping[str, bool | None]], limits: Limits = LIMITS) -> dict[str, BarCount]:
    """Return each bar by name, over the drives that were judged."""
    counted = {}
    for name, text in bar_texts(limits).items():
        met = [bars[name] for bars in judged]
        counted[name] = BarCount(text, met.count(True), met.count(False), met.count(None))
    return counted


def _at_most(value: float, limit: float) -> bool | None:
    return None if math.isnan(value) or math.isnan(limit) else value <= limit + _SLACK_S


def _slip_error(drive: FaultDrive, since: Array) -> float:
    return _largest(np.abs(drive.slip_ratio - drive.true_slip_ratio)[since & drive.ok])


def _recovery_s(drive: FaultDrive, end_s: float) -> float:
    after = drive.moving & (drive.time_s >= end_s - _SLACK_S)
    if not after.any():
        return math.nan
    time_s, not_ok = drive.time_s[after], np.flatnonzero(~drive.ok[after])
    if not not_ok.size:
        return 0.0
    last = int(not_ok[-1])
    return round(float(time_s[last + 1] - end_s), 6) if last + 1 < time_s.size else math.inf


def _time_s(n_steps: float, step_s: float) -> float:
    """Return the time of so many steps, to a microsecond."""
    return round(float(n_steps) * step_s, 6)


def _longest(mask: Array) -> int:
    """Return the length of the longest stretch of a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return int((edges[1::2] - edges[::2]).max()) if edges.size else 0


def _largest(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else math.nan


FRESH = "fresh"
"""Status of a sensor that nothing is wrong with, in a pilot's ``health``."""

NAMED_S = 0.1
"""A sensor counts as named where it has been for this time."""


class FaultCase(NamedTuple):
    """A drive with a fault.

    Parameters
    ----------
    fault : its name in the catalogue
    duration_s : for which it acts; infinite for good, None in JSON
    situation, terrain, seed : of the drive
    """

    fault: str
    duration_s: float
    situation: str
    terrain: str
    seed: int


@dataclass(frozen=True, slots=True)
class FaultRow:
    """A drive with a fault, and what it shows.

    Parameters
    ----------
    case : what was driven
    kind, streams, nature : of the fault
    figures : of the drive
    bars : by name, whether it is met; None where it does not apply
    sensors_named : by the name of a sensor, what the controller's ``health`` named it; None without a ``health``
    exception : the first one that the controller raised, or empty
    """

    case: FaultCase
    kind: str
    streams: tuple[str, ...]
    nature: str
    figures: FaultFigures
    bars: Mapping[str, bool | None]
    sensors_named: Mapping[str, str] | None
    exception: str

    @property
    def unmet(self) -> tuple[str, ...]:
        """Names of the bars that are not met."""
        return tuple(name for name, met in self.bars.items() if met is False)

    def as_json(self) -> dict[str, Any]:
        """Return the fields in one object, with the verdict; what is infinite is None."""
        given = {each.name: getattr(self, each.name) for each in fields(self)}
        case, figures = given.pop("case"), given.pop("figures")
        return {**case._asdict(), **given, **figures._asdict(), "is_met": not self.unmet}


@dataclass(frozen=True, slots=True)
class CleanDrive:
    """What the controller does without a fault, and plain commands do, where a situation's rows are compared.

    Parameters
    ----------
    situation, terrain, seed : of the drives
    start_s : when faults begin
    slip_error_ratio : largest error of slip of the controller, from then on
    not_ok_s : time without the status OK from then on while the robot is to move
    slip_peak_ratio, plain_slip_peak_ratio : largest true slip
    stop_m, plain_stop_m : stopping distance; NaN where no stop is commanded
    overspeed_s : longest time for which the commanded speed is above the desired one
    """

    situation: str
    terrain: str
    seed: int
    start_s: float
    slip_error_ratio: float
    not_ok_s: float
    slip_peak_ratio: float
    plain_slip_peak_ratio: float
    stop_m: float
    plain_stop_m: float
    overspeed_s: float


class Pilot(Protocol):
    """What drives: a step from a sample to a command, and the estimate behind it; ``health`` is optional."""

    @property
    def estimate(self) -> Any:
        """Last estimate, with ``speed_x_mps``; None where there is none."""

    def step(self, sample: Sample) -> Command:
        """Return the command."""


@dataclass(frozen=True, slots=True, eq=False)
class FaultLoop:
    """The closed loop of all drives.

    Parameters
    ----------
    robot : swerve robot
    new_pilot : returns a pilot of a controller, ``traction`` or ``plain``; to be sent to other processes
    delay_s : from a sample to the wheel
    """

    robot: Robot
    new_pilot: Callable[[str], Pilot]
    delay_s: float


class Place(NamedTuple):
    """Situation, terrain and seed, which one clean and one plain drive are made for."""

    situation: str
    terrain: str
    seed: int


class References(NamedTuple):
    """What drives with a fault are compared with, and when the fault begins."""

    clean: FaultDrive
    plain: FaultDrive
    start_s: float


class Driven(NamedTuple):
    """A drive, the pilot with its record, and the estimated forward speed (n,)."""

    drive: FaultDrive
    pilot: GuardedPilot
    speed_mps: Array


def drive_references(loop: FaultLoop, place: Place) -> References:
    """Return the clean and the plain drive of a place."""
    made = make_fault_situation(place.situation, loop.robot, place.terrain, place.seed)
    clean, plain = (_drive(loop, made, place.seed, controller=name).drive for name in ("traction", "plain"))
    return References(clean, plain, made.start_s)


def drive_case(loop: FaultLoop, case: FaultCase) -> Driven:
    """Return the drive with a fault."""
    made = make_fault_situation(case.situation, loop.robot, case.terrain, case.seed)
    fault = fault_catalogue(loop.robot)[case.fault]
    return _drive(loop, made, case.seed, fault, case.duration_s)


def evaluate_case(loop: FaultLoop, case: FaultCase, references: References) -> FaultRow:
    """Return the row of a drive with a fault.

    Parameters
    ----------
    loop : of all drives
    case : what is driven
    references : of the same place
    """
    fault = fault_catalogue(loop.robot)[case.fault]
    driven = drive_case(loop, case)
    pilot, start_s = driven.pilot, references.start_s
    figures = fault_figures(
        driven.drive,
        references.clean,
        references.plain,
        start_s,
        start_s + case.duration_s,
        pilot.n_exceptions,
        pilot.n_not_finite,
    )
    time_s = driven.drive.time_s
    acts = (time_s >= start_s) & (time_s < start_s + case.duration_s)
    return FaultRow(
        case=case,
        kind=fault.kind,
        streams=fault.streams,
        nature=fault.nature.value,
        figures=figures,
        bars=judge(figures, fault.nature),
        sensors_named=named_sensors(pilot.health, acts.tolist(), float(time_s[1] - time_s[0])),
        exception=pilot.exception,
    )


def drawn_cases(rows: Sequence[FaultRow], draw: Sequence[str] = ()) -> list[FaultCase]:
    """Return the drives that are drawn, of the first seed.

    Parameters
    ----------
    rows : all drives
    draw : faults or kinds of them whose drives are drawn, for the longest time that was driven; without, of
        each kind the drive with the most unmet bars
    """
    longest_s = max(row.case.duration_s for row in rows)
    first_seed = min(row.case.seed for row in rows)
    first = [row for row in rows if row.case.seed == first_seed]
    if draw:
        return [
            row.case
            for row in first
            if {row.case.fault, row.kind} & set(draw) and row.case.duration_s == longest_s
        ]
    worst: dict[str, FaultRow] = {}
    for row in first:
        if row.unmet and len(row.unmet) > len(worst[row.kind].unmet if row.kind in worst else ()):
            worst[row.kind] = row
    return [row.case for row in worst.values()]


def clean_drive(place: Place, references: References) -> CleanDrive:
    """Return what the clean and the plain drive of a place show."""
    clean, plain, start_s = references
    one = fault_figures(clean, clean, plain, start_s, math.inf)
    since = clean.time_s >= start_s
    step_s = float(clean.time_s[1] - clean.time_s[0])
    return CleanDrive(
        *place,
        start_s=start_s,
        slip_error_ratio=one.slip_error_ratio,
        not_ok_s=float((~clean.ok & clean.moving & since).sum()) * step_s,
        slip_peak_ratio=one.slip_peak_ratio,
        plain_slip_peak_ratio=one.plain_slip_peak_ratio,
        stop_m=clean.stop_m,
        plain_stop_m=plain.stop_m,
        overspeed_s=one.overspeed_s,
    )


def _drive(
    loop: FaultLoop,
    made: FaultSituation,
    seed: int,
    fault: SensorFault | None = None,
    duration_s: float = math.inf,
    controller: str = "traction",
) -> Driven:
    pilot = GuardedPilot(loop.new_pilot(controller))
    step = pilot.step
    if fault is not None:
        step = FaultyBus(step, fault, made.start_s, made.start_s + duration_s, seed).__call__
    situation = made.situation
    with np.errstate(all="ignore"):  # values of a fault are squared
        log = simulate_situation(loop.robot, situation, step, loop.delay_s)
    history = drive_history(log, loop.robot, situation.conditions.radius_factors)
    drive = fault_drive(log, history, loop.robot, situation.scenario)
    return Driven(drive, pilot, np.array(pilot.speed_mps))


class GuardedPilot:
    """Passes samples to a pilot; where it fails, the wheels keep their last command.

    Parameters
    ----------
    pilot : gets the samples.  Its ``health``, a mapping from a sensor to the name of its status or a method
        that returns one, is recorded where it has one

    Attributes
    ----------
    n_exceptions, n_not_finite : steps at which it raised, or gave a command that is not three finite numbers
    exception : the first one, or empty
    speed_mps : estimated forward speed after each step; NaN where there is none
    health : after each step; None where the pilot has none
    """

    def __init__(self, pilot: Pilot) -> None:
        self._pilot = pilot
        self._last: Command | None = None
        self.n_exceptions = self.n_not_finite = 0
        self.exception = ""
        self.speed_mps: list[float] = []
        self.health: list[dict[str, str] | None] = []

    def step(self, sample: Sample) -> Command:
        """Return the pilot's command, or its last one that was finite with the status ``NO_SLIP``.

        Raises
        ------
        Exception
            that of the pilot, if it is in the first step.
        """
        try:
            command = self._pilot.step(sample)
        except Exception as error:
            if self._last is None:
                raise
            self.n_exceptions += 1
            self.exception = self.exception or f"{type(error).__name__}: {error}"
            command = _without_correction(self._last)
        else:
            if is_finite(command) or self._last is None:
                self._last = command
            else:
                self.n_not_finite += 1
                command = _without_correction(self._last)
        estimate = self._pilot.estimate
        self.speed_mps.append(math.nan if estimate is None else estimate.speed_x_mps)
        self.health.append(_health(self._pilot))
        return command


def is_finite(command: Command) -> bool:
    """Return whether all that is commanded is three finite numbers."""
    try:
        rows = [np.asarray(row, dtype=np.float64) for row in command[:3]]
    except (TypeError, ValueError):
        return False
    return all(row.shape == (3,) and bool(np.isfinite(row).all()) for row in rows)


def named_sensors(
    health: list[dict[str, str] | None], acts: list[bool], step_s: float
) -> dict[str, str] | None:
    """Return the sensors that were named as other than fresh, with how, for :data:`NAMED_S` at least.

    Parameters
    ----------
    health : after each step
    acts : whether the fault acted at it
    step_s : from step to step

    Examples
    --------
    >>> named_sensors([{"imu": "fresh"}, {"imu": "lost"}, {"imu": "lost"}], [True] * 3, step_s=0.05)
    {'imu': 'lost'}
    """
    named = [each for each, acting in zip(health, acts, strict=True) if acting]
    if not named or all(each is None for each in named):
        return None
    counts = Counter((sensor, status) for each in named if each for sensor, status in each.items())
    found: dict[str, str] = {}
    for (sensor, status), n in counts.items():
        if status != FRESH and n * step_s >= NAMED_S - 1e-9:
            found[sensor] = f"{found[sensor]}, {status}" if sensor in found else status
    return found


def _health(pilot: Any) -> dict[str, str] | None:
    health = getattr(pilot, "health", None)
    health = health() if callable(health) else health
    if not isinstance(health, Mapping):
        return None
    return {str(sensor): str(getattr(status, "name", status)).lower() for sensor, status in health.items()}


def _without_correction(command: Command) -> Command:
    changed = {"status_code": float(TractionStatus.NO_SLIP), "slip_ratio": math.nan}
    return command._replace(status={**command.status, **changed})
