"""Simulated drives that take the wheels through a range of slips, for learning the curve of a terrain.

Each covers a part: *starts* at several accelerations, down to a step of the command in which the wheels spin
and the robot accelerates through the whole curve; *climbs* over terrain that rises and falls, slowly;
*sweeps* in which one wheel of the long side turns ever faster than the robot drives and the others hold it
back: they show the curve on terrain so hard that no start would, without load transfer and slowly.
"""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from terrain.records import Array, Command, RunLog, Sample
from terrain.robots import Robot
from terrain.simulation.conditions import Conditions, draw_conditions, load_spread
from terrain.simulation.dynamic.simulate import simulate
from terrain.simulation.scenario import RATE_HZ, Patch, Scenario
from terrain.terramechanics.soil import load_soil, scattered

SWEEP_SLIP = 0.75
"""Largest slip of the swept wheel."""

SWEEP_S = 6.0
"""From no slip to the largest and back."""

SWEEP_SPEED_MPS = 0.8
"""Of a sweep: the swept wheel stays within its motor's speed up to a slip of 0.6."""

STEADY_S = 3.0
"""Before the first sweep."""


class Drive(NamedTuple):
    """Kind of a drive (``starts``, ``climb``, ``sweep``), acceleration, speed and the terrain's gradient."""

    kind: str
    accel_mps2: float
    speed_mps: float
    duration_s: float = 30.0
    grade_ratio: float = 0.0
    undulation_ratio: float = 0.0


LEARNING_DRIVES: tuple[Drive, ...] = (
    Drive("sweep", 1.0, SWEEP_SPEED_MPS, 40.0),
    Drive("sweep", 1.0, SWEEP_SPEED_MPS, 40.0),
    Drive("sweep", 1.0, SWEEP_SPEED_MPS, 40.0),
    Drive("sweep", 1.0, SWEEP_SPEED_MPS, 40.0),
    Drive("sweep", 1.0, SWEEP_SPEED_MPS, 40.0),
    Drive("starts", 1.5, 1.2),
    Drive("starts", 40.0, 1.8),
    Drive("climb", 2.0, 1.2, 30.0, 0.1, 0.08),
)
"""Eight runs that together cover slips from 0 to over 0.5 on every soil."""


def learning_runs(
    robot: Robot, terrain: str, seed: int, drives: tuple[Drive, ...] = LEARNING_DRIVES
) -> list[RunLog]:
    """Return one run a drive, with soil, load, slope, tyres and roughness drawn for each.

    Parameters
    ----------
    robot : swerve robot with all sections
    terrain : name of a soil or path of its YAML file
    seed : of everything that is drawn
    drives : one a run
    """
    return [learning_run(robot, terrain, seed, number, drive) for number, drive in enumerate(drives, start=1)]


def learning_run(
    robot: Robot, terrain: str, seed: int, number: int, drive: Drive | None = None, run_id: str | None = None
) -> RunLog:
    """Return one run.

    Parameters
    ----------
    robot, terrain, seed : as for :func:`learning_runs`
    number : from 1 on
    drive : by default those of :data:`LEARNING_DRIVES` in turn
    run_id : named after terrain, drive and number by default
    """
    if drive is None:
        drive = LEARNING_DRIVES[(number - 1) % len(LEARNING_DRIVES)]
    nominal = load_soil(terrain)
    key = [seed, zlib.crc32(nominal.name.encode()), zlib.crc32(b"slip"), number]
    drawn, simulated = np.random.SeedSequence(key).spawn(2)
    rng = np.random.default_rng(drawn)
    soil = scattered(nominal, rng)
    ground = Conditions(grade_ratio=(drive.grade_ratio, 0.0), undulation_ratio=drive.undulation_ratio)
    return simulate(
        robot,
        scenario_of(drive, nominal.name),
        {nominal.name: soil},
        simulated,
        run_id=run_id or f"{nominal.name}_{drive.kind}_{number:02d}",
        conditions=draw_conditions(load_spread(), rng, ground),
        controller=SlipSweep(robot) if drive.kind == "sweep" else None,
    )


def scenario_of(drive: Drive, terrain: str) -> Scenario:
    """Return the scenario: straight ahead from rest, once, or repeatedly for ``starts``.

    Examples
    --------
    >>> steps = scenario_of(Drive("starts", 40.0, 1.8), "grass")
    >>> steps.twist[[0, 49, 53, 54], 0].round(2), float(steps.twist[:, 0].max())
    (array([0. , 0. , 1.8, 1.8]), 1.8)
    """
    time_s = np.arange(round(drive.duration_s * RATE_HZ) + 1) / RATE_HZ
    since_s = time_s - 1.0
    speed = np.clip(since_s * drive.accel_mps2, 0.0, drive.speed_mps)
    if drive.kind == "starts":
        ramp_s = drive.speed_mps / drive.accel_mps2
        length_s = 2.5 + 2 * ramp_s
        since_s = np.where(since_s < 0, 0.0, since_s % (length_s + 1.0))
        rising, falling = since_s * drive.accel_mps2, (length_s - since_s) * drive.accel_mps2
        speed = np.clip(np.minimum(rising, falling), 0.0, drive.speed_mps)
    twist = np.column_stack([speed, np.zeros((len(speed), 2))])
    return Scenario(drive.kind, RATE_HZ, time_s, twist, (Patch(0.0, terrain),))


class SlipSweep:
    """A controller that drives straight ahead and takes one wheel after the other through a range of slips.

    The wheels in turn are those in line with the direction of motion: their pull against each other turns the
    robot little. The command is ``w = v / (r (1 - s))`` with a slip s that rises to :data:`SWEEP_SLIP` and
    falls again; the other wheels hold the robot, so that the slip is nearly as commanded.
    """

    def __init__(self, robot: Robot) -> None:
        self._radius_m = robot.wheel_radius_m
        self._limit_radps = robot.equipment.motors.speed_max_radps
        inner = np.abs(robot.wheel_positions_m[:, 1]).min()
        self._swept = np.flatnonzero(np.isclose(np.abs(robot.wheel_positions_m[:, 1]), inner))

    def __call__(self, sample: Sample) -> Command:
        """Return the wheels' rates for one instant."""
        wheels: Array = np.full(3, sample.twist[0] / self._radius_m)
        number, part = divmod(max(sample.time_s - STEADY_S, 0.0) / SWEEP_S, 1.0)
        slip = SWEEP_SLIP * (1.0 - abs(2.0 * part - 1.0))
        swept = self._swept[int(number) % len(self._swept)]
        wheels[swept] = min(wheels[swept] / (1.0 - slip), self._limit_radps)
        return Command(wheels, np.zeros(3), sample.twist, {"swept_slip_ratio": float(slip)})
