"""Closed-loop drives with a sensor fault, clean, and by plain commands; and what the fault does to them.

A pilot's exceptions do not end a drive: they are counted, and the wheels keep their last command.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Protocol

import numpy as np

from terrain.control.drive_metrics import drive_history
from terrain.control.fault_evaluation import FaultDrive, FaultFigures, fault_drive, fault_figures, judge
from terrain.control.fault_situations import FaultSituation, make_fault_situation
from terrain.control.situations import simulate_situation
from terrain.control.traction import TractionStatus
from terrain.records import Array, Command, Sample
from terrain.robots import Robot
from terrain.simulation.faults.catalogue import fault_catalogue
from terrain.simulation.faults.fault import FaultyBus, SensorFault

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
    blamed : by the name of a sensor, what the controller's ``health`` named it; None without a ``health``
    exception : the first one that the controller raised, or empty
    """

    case: FaultCase
    kind: str
    streams: tuple[str, ...]
    nature: str
    figures: FaultFigures
    bars: Mapping[str, bool | None]
    blamed: Mapping[str, str] | None
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
        blamed=named_sensors(pilot.health, acts.tolist(), float(time_s[1] - time_s[0])),
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
