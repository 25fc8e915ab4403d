"""Single drives of ``terrain faults``: with a fault, clean, and by plain commands."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipelines.faults.guard import GuardedPilot, blamed_sensors
from pipelines.faults.results import CleanDrive, FaultCase, FaultRow
from pipelines.live.pilot import LivePilot
from pipelines.live.pilot_settings import PilotSettings
from pipelines.live.terrain_source import KnownTerrain
from terrain.control.drive_metrics import drive_history
from terrain.control.fault_evaluation import FaultDrive, FaultFigures, fault_drive, fault_figures, judge
from terrain.control.fault_situations import FaultSituation, make_fault_situation
from terrain.control.slip_table import SlipTable
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.dynamic.simulate import simulate
from terrain.simulation.faults.catalogue import fault_catalogue
from terrain.simulation.faults.fault import FaultyBus, SensorFault

DELAY_S = PilotSettings().delay_s
"""From a sample to the wheel."""


@dataclass(frozen=True, slots=True, eq=False)
class FaultInputs:
    """Robot and target slips of all drives."""

    robot: Robot
    table: SlipTable


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


def drive_references(inputs: FaultInputs, place: Place) -> References:
    """Return the clean and the plain drive of a place."""
    made = make_fault_situation(place.situation, inputs.robot, place.terrain, place.seed)
    clean, plain = (_drive(inputs, made, place.seed, controller=name).drive for name in ("traction", "plain"))
    return References(clean, plain, made.start_s)


def drive_case(inputs: FaultInputs, case: FaultCase) -> Driven:
    """Return the drive with a fault."""
    made = make_fault_situation(case.situation, inputs.robot, case.terrain, case.seed)
    fault = fault_catalogue(inputs.robot)[case.fault]
    return _drive(inputs, made, case.seed, fault, case.duration_s)


def evaluate_case(inputs: FaultInputs, case: FaultCase, references: References) -> FaultRow:
    """Return the row of a drive with a fault.

    Parameters
    ----------
    inputs : of all drives
    case : what is driven
    references : of the same place
    """
    fault = fault_catalogue(inputs.robot)[case.fault]
    driven = drive_case(inputs, case)
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
    blamed = blamed_sensors(pilot.health, acts.tolist(), float(time_s[1] - time_s[0]))
    bars = judge(figures, fault.nature)
    row = (fault.kind, fault.streams, fault.nature.value, figures, bars, blamed, pilot.exception)
    return FaultRow(case, *row)


def clean_drive(place: Place, references: References) -> CleanDrive:
    """Return what the clean and the plain drive of a place show."""
    clean, plain, start_s = references
    one: FaultFigures = fault_figures(clean, clean, plain, start_s, math.inf)
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
    inputs: FaultInputs,
    made: FaultSituation,
    seed: int,
    fault: SensorFault | None = None,
    duration_s: float = math.inf,
    controller: str = "traction",
) -> Driven:
    settings = PilotSettings(controller=controller, delay_s=DELAY_S)
    pilot = GuardedPilot(LivePilot(inputs.robot, inputs.table, KnownTerrain(), settings))
    step = pilot.step
    if fault is not None:
        step = FaultyBus(step, fault, made.start_s, made.start_s + duration_s, seed).__call__
    situation = made.situation
    with np.errstate(all="ignore"):  # values of a fault are squared
        run = simulate(
            inputs.robot,
            situation.scenario,
            situation.soils,
            situation.seed,
            conditions=situation.conditions,
            faults=situation.faults,
            controller=step,
            command_delay_s=DELAY_S,
        )
    history = drive_history(run, inputs.robot, situation.conditions.radius_factors)
    drive = fault_drive(run, history, inputs.robot, situation.scenario)
    return Driven(drive, pilot, np.array(pilot.speed_mps))
