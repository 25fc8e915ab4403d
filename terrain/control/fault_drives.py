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
from dataclasses import dataclass
from typing import Any, NamedTuple

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
from terrain.signals import low_pass, true_stretches
from terrain.simulation.faults import FaultyBus, Nature, fault_catalogue
from terrain.simulation.scenario import Faults, Scenario

#: From rest at 1 m/s^2 to 1 m/s, where the fault begins as the start does; a command to stop at once from 1 m/s, where
#: it begins with the command; and at 1 m/s, where it begins 3 s after the speed was reached.
FAULT_SITUATIONS = START, STOP, STEADY = "start", "stop", "steady"
LENGTHS_S = {START: 7.0, STEADY: 10.0}  #: Long enough for a fault of 3 s and 2 s after it.
#: By then the slip of steady motion is known to the controller, after 1 s of rest and 1 s of start.
STEADY_FAULT_S = 5.0


def make_fault_situation(name: str, robot: Robot, terrain: str, seed: int) -> tuple[Situation, float]:
    """Return a situation without any fault by chance, and the time at which a fault begins in it.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> make_fault_situation("start", load_robot("agrimaro"), "grass", 0)[1]
    1.0
    """
    if name not in FAULT_SITUATIONS:
        raise ConfigError(f"situation {name!r} is unknown: use {', '.join(FAULT_SITUATIONS)}")
    options = SituationOptions(duration_s=LENGTHS_S.get(name))
    made = make_situation(BRAKE if name == STOP else "straight", robot, terrain, seed, options)
    made = made._replace(faults=Faults(by_chance=False))
    if name == STEADY:
        return made, STEADY_FAULT_S
    return made, brake_time(made.scenario) if name == STOP else start_times(made.scenario)[0]


_SLACK_S = 1e-9  # figures and instants that differ by less are the same

#: The error of slip is evaluated where each wheel, or the ground below it, is faster: there an error of 1 cm/s in a
#: speed is 3 % of slip.
RATIO_ABOVE_MPS = 0.3
#: A commanded speed counts as above the desired one by more than this; a wheel's share of the torque among wheels of
#: different radii is corrected by less.
OVERSPEED_MPS = 0.05


class FaultDrive(NamedTuple):
    """What is evaluated of a drive, at the instants of its control: rows (n,)."""

    time_s: Array
    ok: Array  #: whether the status is OK
    slip_ratio: Array  #: largest of the wheels, as the controller estimates it; NaN where unknown
    true_slip_ratio: Array  #: the true one behind the estimate's low-pass; NaN where a wheel is slow
    body_slip_ratio: Array  #: true slip of the robot, the mean over its wheels; NaN where it is slow
    moving: Array  #: whether the robot moves or motion is desired
    commanded_mps: Array  #: mean of the wheels
    desired_mps: Array
    speed_mps: Array  #: true, over ground
    stop_m: float = math.nan  #: from the command to stop to standstill; NaN where there was none


class FaultFigures(NamedTuple):
    """Figures of a drive with a fault; NaN where one is not defined.  Slip counts from the fault's start on."""

    ok_total_s: float  #: with status OK while the fault acts and the robot is to move
    ok_longest_s: float  #: of it, the longest in one piece
    not_ok_s: float  #: without OK meanwhile, beyond the clean drive's
    slip_error_ratio: float  #: largest error of slip while the status is OK
    clean_slip_error_ratio: float  #: that of the clean drive
    slip_peak_ratio: float  #: largest magnitude of the robot's true slip
    plain_slip_peak_ratio: float  #: that of the plain drive
    stop_m: float  #: stopping distance; infinite without a standstill
    stop_ratio: float  #: over that of the plain drive
    recovery_s: float  #: from the fault's end until the status is OK for good; infinite where it is not
    overspeed_s: float  #: longest time for which the commanded speed is above the desired one
    n_exceptions: int  #: steps at which the controller raised
    n_not_finite: int  #: steps at which a command was not finite


class Limits(NamedTuple):
    """Limits of the figures."""

    ok_s: float = 0.3  #: for which a stream may be dead or lying before the status is another than OK
    held_back_s: float = 0.3  #: without OK beyond the clean drive's while a fault is tolerable
    slip_error_ratio: float = 0.05
    slip_error_chance_ratio: float = 0.03  #: the limit is at least the clean drive's own error and this
    slip_peak_ratio: float = 0.03  #: above the plain drive's: by chance between drives that differ little
    stop_ratio: float = 1.1  #: over the plain drive's
    recovery_s: float = 1.0
    overspeed_s: float = 1.0  #: a controlled braking from 1 m/s on a slick floor takes 0.5 s


LIMITS = Limits()

#: The bars by name, with the limits of :class:`Limits`.
BARS = {
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


def fault_drive(run: RunLog, history: DriveHistory, robot: Robot, scenario: Scenario) -> FaultDrive:
    """Return what is evaluated of a simulated drive straight ahead, whose truth has that history.

    The robot's encoders' low-pass is the lag of every estimate.
    """
    control, commands, time_s = run.streams["control"], run.streams["commands"], run.streams["control"].time_s
    step_s = float(history.time_s[1] - history.time_s[0])
    tau_s = robot.sensors.encoder_time_constant_s
    wheel, ground = (
        low_pass(each, step_s, tau_s, at_first=True) for each in (history.wheel_speed_mps, history.ground_mps)
    )
    fastest = np.maximum(np.abs(wheel), np.abs(ground))
    with np.errstate(invalid="ignore", divide="ignore"):
        slip = ((wheel - ground) / fastest).max(axis=1)
    slip[fastest.min(axis=1) < RATIO_ABOVE_MPS] = np.nan
    body = history.slip_ratio.mean(axis=1)
    body[history.speed_mps <= PEAK_ABOVE_MPS] = np.nan
    speed, true_slip, body_slip = (
        np.interp(time_s, history.time_s, each) for each in (history.speed_mps, slip, body)
    )
    wheels = commands.columns(f"wheel_{i}_radps" for i in robot.logged_wheels)
    desired = np.hypot(scenario.twist[:, 0], scenario.twist[:, 1])
    return FaultDrive(
        time_s,
        control.channel("status_code") == TractionStatus.OK,
        control.channel("slip_ratio"),
        true_slip,
        body_slip,
        moving=(speed > STANDING_MPS) | (desired > 0.0),
        commanded_mps=np.abs(wheels).mean(axis=1) * robot.wheel_radius_m,
        desired_mps=desired,
        speed_mps=speed,
        stop_m=stopping_distance(history, brake_time(scenario)) if scenario.name == BRAKE else math.nan,
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
    """Return the figures of a drive with a fault that acts between two times; an infinite end is for good.

    The drives with the fault, without it, and by plain commands are at the same instants; exceptions and
    commands that are not finite are those counted in the drive.
    """
    time_s = drive.time_s
    step_s = float(np.median(np.diff(time_s)))
    since, until = time_s >= start_s - _SLACK_S, time_s < end_s - _SLACK_S
    acts = since & until
    ok, not_ok = (acts & drive.moving & each for each in (drive.ok, ~drive.ok))
    clean_not_ok = acts & clean.moving & ~clean.ok
    too_fast = since & (drive.commanded_mps > drive.desired_mps + OVERSPEED_MPS)
    ok_longest, overspeed = (np.ptp(true_stretches(each), axis=1).max(initial=0) for each in (ok, too_fast))
    held_back = max(not_ok.sum() - clean_not_ok.sum(), 0)
    ok_total_s, ok_longest_s, not_ok_s, overspeed_s = (
        round(float(n) * step_s, 6) for n in (ok.sum(), ok_longest, held_back, overspeed)
    )
    slip_error, clean_slip_error = (
        _largest((one.slip_ratio - one.true_slip_ratio)[since & one.ok]) for one in (drive, clean)
    )
    recovery_s = math.nan
    if (after := drive.moving & ~until).any():
        left_s, lost = time_s[after], np.flatnonzero(~drive.ok[after])
        resumes = int(lost[-1]) + 1 if lost.size else 0
        recovery_s = math.inf if resumes == left_s.size else round(float(left_s[resumes] - end_s), 6)
        recovery_s = recovery_s if lost.size else 0.0
    stop_m = drive.stop_m if math.isfinite(drive.stop_m) else math.inf
    stop_m = stop_m if math.isfinite(plain.stop_m) else math.nan
    return FaultFigures(
        ok_total_s,
        ok_longest_s,
        not_ok_s,
        slip_error,
        clean_slip_error,
        _largest(drive.body_slip_ratio[since]),
        _largest(plain.body_slip_ratio[since]),
        stop_m,
        stop_m / plain.stop_m,
        recovery_s,
        overspeed_s,
        n_exceptions,
        n_not_finite,
    )


def _largest(values: Array) -> float:
    """Return the largest magnitude that is known; NaN of none."""
    known = np.abs(values[np.isfinite(values)])
    return float(known.max()) if known.size else math.nan


def judge(figures: FaultFigures, nature: Nature) -> dict[str, bool | None]:
    """Return which of :data:`BARS` are met; None where a figure is undefined, or a fault of that nature may miss it."""
    one, limits = figures, LIMITS
    error_limit = max(
        limits.slip_error_ratio, one.clean_slip_error_ratio + limits.slip_error_chance_ratio
    )  # the clean drive's error is NaN where it has none: the first then
    at_most = {
        "ok_ends": (one.ok_total_s, limits.ok_s),
        "goes_on": (one.not_ok_s, limits.held_back_s),
        "slip_error": (one.slip_error_ratio, error_limit),
        "slip_peak": (one.slip_peak_ratio, one.plain_slip_peak_ratio + limits.slip_peak_ratio),
        "stop": (one.stop_ratio, limits.stop_ratio),
        "recovery": (one.recovery_s, limits.recovery_s),
        "overspeed": (one.overspeed_s, limits.overspeed_s),
        "finite": (float(one.n_exceptions + one.n_not_finite), 0.0),
    }
    applies = {"ok_ends": (Nature.DEAD, Nature.LYING), "goes_on": (Nature.TOLERABLE,)}
    return {
        name: None
        if nature not in applies.get(name, (nature,)) or math.isnan(value + limit)
        else value <= limit + _SLACK_S
        for name, (value, limit) in at_most.items()
    }


class BarCount(NamedTuple):
    """A bar over all drives: what it asks for, and how many meet it, do not, and are not judged by it."""

    text: str
    n_met: int
    n_unmet: int
    n_not_judged: int


def count_bars(judged: Sequence[Mapping[str, bool | None]]) -> dict[str, BarCount]:
    """Return each bar by name, over the drives that were judged."""
    met = {name: [bars[name] for bars in judged] for name in BARS}
    return {
        name: BarCount(text.format(**LIMITS._asdict()), *map(met[name].count, (True, False, None)))
        for name, text in BARS.items()
    }


FRESH = "fresh"  #: Status of a sensor that nothing is wrong with, in a pilot's ``health``.
NAMED_S = 0.1  #: A sensor counts as named where it has been for this time.


class Place(NamedTuple):
    """Situation, terrain and seed, which one clean and one plain drive are made for."""

    situation: str
    terrain: str
    seed: int


class FaultCase(NamedTuple):
    """A drive with a fault of the catalogue, which acts for a time, infinite for good, in a :class:`Place`."""

    fault: str
    duration_s: float
    situation: str
    terrain: str
    seed: int


@dataclass(frozen=True, slots=True)
class FaultRow:
    """A drive with a fault, and what it shows."""

    case: FaultCase
    kind: str
    streams: tuple[str, ...]
    nature: str
    figures: FaultFigures
    bars: Mapping[str, bool | None]
    sensors_named: Mapping[str, str] | None  #: by sensor, what the controller's health named it; None without
    exception: str  #: the first one that the controller raised, or empty

    @property
    def unmet(self) -> tuple[str, ...]:
        """Names of the bars that are not met."""
        return tuple(name for name, met in self.bars.items() if met is False)

    def as_json(self) -> dict[str, Any]:
        """Return the fields in one object, with the verdict; what is infinite is None."""
        own = ("kind", "streams", "nature", "bars", "sensors_named", "exception")
        given = {name: getattr(self, name) for name in own}
        return {**self.case._asdict(), **given, **self.figures._asdict(), "is_met": not self.unmet}


class FaultLoop(NamedTuple):
    """The closed loop of all drives: a robot, its pilots by controller, and the delay to the wheel."""

    robot: Robot
    new_pilot: Callable[[str], Any]  #: of ``traction`` or ``plain``; is sent to other processes
    delay_s: float


class References(NamedTuple):
    """What drives with a fault are compared with, and when the fault begins."""

    clean: FaultDrive
    plain: FaultDrive
    start_s: float


def drive_references(loop: FaultLoop, place: Place) -> References:
    """Return the clean and the plain drive of a place."""
    found = [_drive(loop, place, name) for name in ("traction", "plain")]
    return References(found[0][0], found[1][0], found[0][2])


def drive_case(loop: FaultLoop, case: FaultCase) -> tuple[FaultDrive, GuardedPilot]:
    """Return the drive with a fault, and its pilot with its record."""
    return _drive(loop, Place(*case[2:]), "traction", case)[:2]


def _drive(
    loop: FaultLoop, place: Place, controller: str, case: FaultCase | None = None
) -> tuple[FaultDrive, GuardedPilot, float]:
    """Return a drive, with a fault or without, its pilot, and the time at which a fault begins."""
    robot, new_pilot, delay_s = loop
    made, start_s = make_fault_situation(place.situation, robot, place.terrain, place.seed)
    pilot = GuardedPilot(new_pilot(controller))
    step: Callable[[Sample], Command] = pilot.step
    if case is not None:
        fault, end_s = fault_catalogue(robot)[case.fault], start_s + case.duration_s
        step = FaultyBus(pilot.step, fault, start_s, end_s, case.seed).__call__
    with np.errstate(all="ignore"):  # values of a fault are squared
        log = simulate_situation(robot, made, step, delay_s)
    history = drive_history(log, robot, made.conditions.radius_factors)
    return fault_drive(log, history, robot, made.scenario), pilot, start_s


def evaluate_case(loop: FaultLoop, case: FaultCase, references: References) -> FaultRow:
    """Return the row of a drive with a fault, compared with the references of the same place."""
    fault, (clean, plain, start_s) = fault_catalogue(loop.robot)[case.fault], references
    drive, pilot = drive_case(loop, case)
    end_s, time_s = start_s + case.duration_s, drive.time_s
    counts = pilot.n_exceptions, pilot.n_not_finite
    figures = fault_figures(drive, clean, plain, start_s, end_s, *counts)
    acts = ((time_s >= start_s) & (time_s < end_s)).tolist()
    named = named_sensors(pilot.health, acts, float(time_s[1] - time_s[0]))
    kind = fault.kind, fault.streams, fault.nature.value
    return FaultRow(case, *kind, figures, judge(figures, fault.nature), named, pilot.exception)


def clean_drive(place: Place, references: References) -> dict[str, Any]:
    """Return what the clean and the plain drive of a place show, from when faults begin."""
    clean, plain, start_s = references
    one = fault_figures(clean, clean, plain, start_s, math.inf)
    not_ok = ~clean.ok & clean.moving & (clean.time_s >= start_s)
    return {
        **place._asdict(),
        "start_s": start_s,
        "slip_error_ratio": one.slip_error_ratio,
        "not_ok_s": float(not_ok.sum()) * float(clean.time_s[1] - clean.time_s[0]),
        "slip_peak_ratio": one.slip_peak_ratio,
        "plain_slip_peak_ratio": one.plain_slip_peak_ratio,
        "stop_m": clean.stop_m,
        "plain_stop_m": plain.stop_m,
        "overspeed_s": one.overspeed_s,
    }


class GuardedPilot:
    """Passes samples to a pilot; where it fails, the wheels keep their last command.

    Counted are steps at which it raised, or gave a command that is not finite numbers, with the first exception;
    recorded after each step are the estimated forward speed, NaN without one, and the pilot's ``health``, a mapping
    from a sensor to the name of its status, None without one.
    """

    def __init__(self, pilot: Any) -> None:
        self._pilot = pilot
        self._last: Command | None = None
        self.n_exceptions = self.n_not_finite = 0
        self.exception = ""
        self.speed_mps: list[float] = []
        self.health: list[dict[str, str] | None] = []

    def step(self, sample: Sample) -> Command:
        """Return the pilot's command, or its last one that was finite with the status ``NO_SLIP``.

        An exception in the first step is raised.
        """
        command: Command | None = None
        try:
            command = self._pilot.step(sample)
        except Exception as error:
            if self._last is None:
                raise
            self.n_exceptions += 1
            self.exception = self.exception or f"{type(error).__name__}: {error}"
        if command is not None and self._last is not None:
            try:
                rows = [np.asarray(row, dtype=np.float64) for row in command[:3]]
                shapes = [np.shape(row) for row in self._last[:3]]
                finite = [row.shape for row in rows] == shapes and all(np.isfinite(row).all() for row in rows)
            except (TypeError, ValueError):
                finite = False
            self.n_not_finite += not finite
            command = command if finite else None
        if command is None:
            assert self._last is not None
            changed = {"status_code": float(TractionStatus.NO_SLIP), "slip_ratio": math.nan}
            command = self._last._replace(status={**self._last.status, **changed})
        else:
            self._last = command
        estimate, health = self._pilot.estimate, getattr(self._pilot, "health", None)
        self.speed_mps.append(math.nan if estimate is None else estimate.speed_x_mps)
        self.health.append(None if health is None else dict(health))
        return command


def named_sensors(
    health: Sequence[Mapping[str, str] | None], acts: Sequence[bool], step_s: float
) -> dict[str, str] | None:
    """Return the sensors that were named as other than fresh, with how, for :data:`NAMED_S` at least.

    ``health`` is that after each step, ``acts`` whether the fault acted at it.

    Examples
    --------
    >>> named_sensors([{"imu": "fresh"}, {"imu": "lost"}, {"imu": "lost"}], [True] * 3, step_s=0.05)
    {'imu': 'lost'}
    """
    named = [each for each, acting in zip(health, acts, strict=True) if acting]
    if all(each is None for each in named):
        return None
    counts = Counter((sensor, status) for each in named if each for sensor, status in each.items())
    found: dict[str, str] = {}
    for (sensor, status), n in counts.items():
        if status != FRESH and n * step_s >= NAMED_S - 1e-9:
            found[sensor] = f"{found[sensor]}, {status}" if sensor in found else status
    return found
