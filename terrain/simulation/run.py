"""One simulated run by names: robot, terrain, scenario and number in, a run log out.

This entry picks the plant by the robot's drive: swerve robots are simulated by the dynamic plant
(:mod:`terrain.simulation.dynamic.simulate`), tracked ones on ground that shears by the forces under their
tracks (:mod:`terrain.simulation.tracked`), all others, and whatever has effects, by the planar one
(:mod:`terrain.simulation.planar.run`).

**Bench**: a simulated IMU, held still in six positions in turn (Danzi, AgriMaRo thesis, 3.3.3).

**Slip**: drives that take the wheels through a range of slips, for learning the curve of a terrain.  Each covers a
part: *starts* at several accelerations, down to a step of the command in which the wheels spin and the robot
accelerates through the whole curve; *climbs* over terrain that rises and falls, slowly; *sweeps* in which one wheel
of the long side turns ever faster than the robot drives and the others hold it back: they show the curve on
terrain so hard that no start would, without load transfer and slowly.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from terrain.constants import GRAVITY_MPS2
from terrain.effects import NUISANCES, PARAMETER, SENSED_ONLY
from terrain.errors import ConfigError
from terrain.extension import warn_outside
from terrain.kinematics.commands import wheel_motion
from terrain.records import Array, Command, RunLog, Sample, Stream
from terrain.robots import BicycleRobot, Robot, SwerveRobot, TrackedRobot, load_robot
from terrain.simulation.conditions import Conditions, Faults, draw_conditions, load_spread
from terrain.simulation.dynamic.simulate import simulate
from terrain.simulation.planar.model import planar_ground
from terrain.simulation.planar.noise import load_noise, load_scatter
from terrain.simulation.planar.run import Hills, simulate_planar
from terrain.simulation.scenario import RATE_HZ, Patch, Scenario, make_scenario
from terrain.simulation.sensors import Gnss, imu_samples, is_lost, with_raw_fixes
from terrain.simulation.tracked import COMMANDS_HZ, Slope, simulate_tracked
from terrain.terramechanics.soil import Soil, load_soil, scattered, soil_names

COURSE = "course"
"""A path over all terrains, in place of the name of one."""

BENCH = "six_positions"
"""Word for the IMU alone on a bench, in place of a scenario."""

BENCH_TERRAIN = "bench"
"""The terrain that goes with it."""

SLIP = "slip"
"""Word for drives that take the wheels through their slips, for ``terrain learn-slip``."""


class Setup(NamedTuple):
    """Conditions, faults of the sensors, receiver and effects of a run."""

    conditions: Conditions
    faults: Faults
    gnss: Gnss | None
    effects: Mapping[str, float]


def simulate_run(
    robot: Robot | str | Path,
    terrain: str,
    scenario: str,
    seed: int = 0,
    number: int = 1,
    *,
    duration_s: float | None = None,
    vary: bool = False,
    conditions: Conditions | None = None,
    faults: Faults | None = None,
    gnss: Gnss | None = None,
    effects: Mapping[str, float] | None = None,
) -> RunLog:
    """Return one simulated run.

    What is drawn depends on ``seed``, ``terrain``, ``scenario`` and ``number`` alone: a run is the same
    whatever is simulated beside it.

    Parameters
    ----------
    robot : swerve robot with all sections, or another robot with all but steering; or its name or YAML file
    terrain : name of a soil or path of its YAML file, or ``course`` for all soils in one run
    scenario : name of a scenario; ``course`` goes with the terrain ``course``, ``six_positions`` (the IMU
        alone, for calibration) with ``bench``; ``slip`` sweeps the slip of the wheels under varied conditions
    seed, number : of what is drawn
    duration_s : length; the scenario's own by default
    vary : draw soil, slope, load, tyres and roughness for this run by ``data/soils`` and ``data/spread``
    conditions : nominal conditions
    faults : faults of the sensors
    gnss : receiver on board, if any
    effects : parameters of :mod:`terrain.effects` that act

    Raises
    ------
    ConfigError
        if the terrain or scenario is unknown or they do not go together, or the robot cannot drive it.

    Warns
    -----
    OutsideRegionWarning
        if the run leaves the region that the robot's effects were validated in.

    Examples
    --------
    >>> run = simulate_run("husky", "grass", "straight", duration_s=6.0)
    >>> run.run_id, sorted(run.streams)[:2]
    ('grass_straight_01', ['commands', 'imu'])
    """
    if isinstance(robot, str | Path):
        robot = load_robot(robot)
    if effects and scenario in (BENCH, SLIP):
        raise ConfigError(f"scenario {scenario!r} is simulated without effects: leave them out")
    if scenario == BENCH:
        return _bench(robot, terrain, seed, number, duration_s)
    if scenario == SLIP:
        _check_slip(terrain, duration_s, conditions, faults, gnss)
        run_id = run_id_of(load_soil(terrain).name, SLIP, number)
        return learning_run(robot, terrain, seed, number, run_id=run_id)
    if (terrain == COURSE) != (scenario == COURSE):
        raise ConfigError("terrain 'course' and scenario 'course' go together: give both or neither")
    soils = {soil.name: soil for soil in map(load_soil, soil_names() if terrain == COURSE else (terrain,))}
    names = list(soils)
    terrain = terrain if terrain == COURSE else names[0]
    key = [seed, zlib.crc32(terrain.encode()), zlib.crc32(scenario.encode()), number]
    drawn, driven, simulated = np.random.SeedSequence(key).spawn(3)
    if vary:
        rng = np.random.default_rng(drawn)
        soils = {name: scattered(soil, rng) for name, soil in soils.items()}
        conditions = draw_conditions(load_spread(), rng, conditions)
    run_id, planar = run_id_of(terrain, scenario, number), not isinstance(robot, SwerveRobot)
    if planar and terrain == COURSE:
        raise ConfigError(f"robot {robot.name}: scenario {COURSE!r} is for swerve robots")
    drive_seed = int(driven.generate_state(1)[0])
    drive = make_scenario(scenario, robot, names, duration_s, seed=drive_seed)
    setup = Setup(conditions or Conditions(), faults or Faults(), gnss, effects or {})
    if (
        isinstance(robot, TrackedRobot)
        and soils[terrain].law == "janosi"
        and not {**robot.effects, **setup.effects}
    ):
        run = _tracked_run(robot, soils[terrain], drive.twist, simulated, run_id, setup)
    elif planar:
        run = _planar_run(robot, soils[terrain], drive.twist, simulated, run_id, setup, vary)
    else:
        run = simulate(robot, drive, soils, simulated, run_id=run_id, **setup._asdict())
    warn_outside(run, robot)
    return run


def _tracked_run(
    robot: TrackedRobot, soil: Soil, twist: Array, seed: np.random.SeedSequence, run_id: str, setup: Setup
) -> RunLog:
    """Return a run on an even slope, without undulations; a receiver is always on board."""
    conditions = setup.conditions
    ahead, left = conditions.grade_ratio
    slope = Slope(math.atan(math.hypot(ahead, left)), math.atan2(left, ahead))
    loaded = replace(robot, mass_kg=robot.mass_kg + conditions.payload_kg)
    speeds = wheel_motion(robot, twist, 1.0 / COMMANDS_HZ).wheel_speed_mps
    return _without_camera(
        simulate_tracked(loaded, soil, speeds, seed, slope=slope, run_id=run_id), setup.faults
    )


def _planar_run(
    robot: Robot,
    soil: Soil,
    twist: Array,
    seed: np.random.SeedSequence,
    run_id: str,
    setup: Setup,
    vary: bool,
) -> RunLog:
    """Return a run of the planar simulation; the scatter of its sensors does not depend on ``vary``."""
    conditions, faults, gnss, effects = setup
    if gnss is not None:
        raise ConfigError(f"robot {robot.name}: its simulation has no receiver, leave gnss out")
    scatter = load_scatter()
    if not vary:
        fixed = (name for name in NUISANCES if name in PARAMETER and name not in SENSED_ONLY)
        scatter = scatter._replace(**dict.fromkeys(fixed, 0.0))
    load = conditions.payload_kg / robot.mass_kg
    run = simulate_planar(
        robot,
        twist,
        seed,
        ground=planar_ground(robot, soil),
        effects={**effects, "payload_ratio": effects.get("payload_ratio", 0.0) + load},
        scatter=scatter,
        hills=Hills(conditions.grade_ratio, conditions.undulation_ratio, conditions.undulation_length_m),
        noise=load_noise(),
        run_id=run_id,
        terrain=soil.name,
    )
    if isinstance(robot, BicycleRobot):
        run = replace(run, streams=with_raw_fixes(run, np.random.default_rng(seed.spawn(1)[0])))
    return _without_camera(run, faults)


def _without_camera(run: RunLog, faults: Faults) -> RunLog:
    """Return the run without the samples of the lost camera."""
    if not faults.camera_lost_s:
        return run
    name = "odometry" if "odometry" in run.streams else "pose"
    seen = run.streams[name]
    kept = ~is_lost(seen.time_s, faults.camera_lost_s)
    left = Stream(seen.time_s[kept], seen.values[kept], seen.channels)
    streams = {**run.streams, name: left}
    if len(left) < 2:
        del streams[name]
    return RunLog(run.run_id, run.robot, streams, run.labels, run.source)


def _check_slip(
    terrain: str,
    duration_s: float | None,
    conditions: Conditions | None,
    faults: Faults | None,
    gnss: Gnss | None,
) -> None:
    """Refuse options of drives for learning slip, which draw all conditions."""
    if terrain == COURSE:
        raise ConfigError(f"scenario {SLIP!r} is driven on one terrain, not on 'course'")
    if duration_s is not None or conditions not in (None, Conditions()) or gnss is not None:
        raise ConfigError(
            f"scenario {SLIP!r} draws its conditions: leave duration, grade, payload and gnss out"
        )
    if faults not in (None, Faults()):
        raise ConfigError(f"scenario {SLIP!r} has no faults on purpose: leave the camera's loss out")


def _bench(robot: Robot, terrain: str, seed: int, number: int, duration_s: float | None) -> RunLog:
    """Return the log of an IMU that is held still in six positions, for ``terrain calibrate``."""
    if terrain != BENCH_TERRAIN:
        raise ConfigError(
            f"scenario {BENCH!r} is done on a bench: give the terrain {BENCH_TERRAIN!r}, not {terrain!r}"
        )
    hold_s = 5.0 if duration_s is None else duration_s / len(POSITIONS) - TURN_S
    key = np.random.SeedSequence([seed, zlib.crc32(BENCH.encode()), number])
    return six_positions_log(
        robot, key, hold_s=hold_s, run_id=run_id_of(terrain, scenario=BENCH, number=number)
    )


def run_id_of(terrain: str, scenario: str, number: int) -> str:
    """Return the name of a simulated run.

    Examples
    --------
    >>> run_id_of("grass", "straight", 3), run_id_of("course", "course", 12)
    ('grass_straight_03', 'course_12')
    """
    return f"{terrain}_{number:02d}" if terrain == scenario else f"{terrain}_{scenario}_{number:02d}"


TURN_S = 1.5
"""Time by hand from one position to the next; assumed."""

CROOKED_RAD = 0.03
"""Standard deviation of how far a position is from its axis; assumed."""

POSITIONS = (
    # turns about body axes that bring one axis up after the other: z, -z, x, -x, y, -y
    (0.0, 0.0),
    (math.pi, 0.0),
    (0.0, -math.pi / 2),
    (0.0, math.pi / 2),
    (math.pi / 2, 0.0),
    (-math.pi / 2, 0.0),
)
"""Roll and pitch of the six positions."""


def six_positions_log(
    robot: Robot, seed: int | np.random.SeedSequence, *, hold_s: float = 5.0, run_id: str = "bench"
) -> RunLog:
    """Return the log of an IMU alone, held still in six positions and turned by hand between them.

    Parameters
    ----------
    robot : with all sections
    seed : of everything that is drawn; the same seed gives the same log
    hold_s : time in each position
    run_id : name of the run

    Returns
    -------
    RunLog
        the stream imu with the channels of a driven run, without labels.

    Raises
    ------
    ConfigError
        if ``hold_s`` is not above zero, or a section of the robot's description is missing.

    Notes
    -----
    As in a driven run, each power-on has biases of its own about those of the description.  At rest the
    specific force is ``g`` times the vertical in body axes; what the hand accelerates is left out.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> run = six_positions_log(load_robot("agrimaro"), seed=0, hold_s=2.0)
    >>> sorted(run.streams), len(run.streams["imu"])
    (['imu'], 1950)
    """
    if not 0 < hold_s < math.inf:
        raise ConfigError(f"hold_s is {hold_s!r}, a time above zero is required")
    sensors = robot.equipment.sensors
    rng = np.random.default_rng(seed)
    crooked = CROOKED_RAD * rng.standard_normal((len(POSITIONS), 2))
    heading = rng.uniform(-math.pi, math.pi, len(POSITIONS))
    held = Rotation.from_euler("ZYX", np.column_stack([heading, (np.array(POSITIONS) + crooked)[:, ::-1]]))
    begin_s = np.arange(len(POSITIONS)) * (hold_s + TURN_S)
    knots_s = np.column_stack([begin_s, begin_s + hold_s]).ravel()
    attitude = Slerp(knots_s, held[np.repeat(np.arange(len(POSITIONS)), 2)])
    period_s = 1 / sensors.imu_rate_hz
    n = round(knots_s[-1] / period_s)
    time_s = np.arange(n) * period_s
    now, soon = attitude(time_s), attitude(np.minimum(time_s + period_s, knots_s[-1]))
    force = now.inv().apply([0.0, 0.0, GRAVITY_MPS2])
    rate = (now.inv() * soon).as_rotvec() / period_s
    turned = now.as_matrix()
    roll, pitch = (
        np.arctan2(turned[:, 2, 1], turned[:, 2, 2]),
        -np.arcsin(np.clip(turned[:, 2, 0], -1.0, 1.0)),
    )
    yaw = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    tilt = np.column_stack([roll, pitch])
    imu = imu_samples(sensors, time_s, force, rate, tilt, np.unwrap(yaw) - yaw[0], rng)
    return RunLog(run_id, robot.name, {"imu": imu}, source="simulated, six positions on a bench")


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
