"""All simulated runs: one by objects (:func:`simulate`), one by names (:func:`simulate_run`), and what is learned from.

A plant (:mod:`terrain.simulation.plants`) goes with the ground that it is given: soils by the terrains of a scenario
are driven by the dynamic plant, a planar ground by the planar one, a soil that shears, or prescribed slip, by tracks,
and ground along a drive by a car with its controller.  By names, robots of every drive are simulated by the dynamic
plant, and what has effects, but for swerve robots, by the planar plant.

**Bench**: a simulated IMU, held still in six positions in turn (Danzi, AgriMaRo thesis, 3.3.3).

**Slip**: drives that take the wheels through a range of slips, for learning the curve of a terrain.  Each covers a
part: *starts* at several accelerations, down to a step of the command in which the wheels spin and the robot
accelerates through the whole curve; *climbs* over terrain that rises and falls, slowly; *sweeps* in which one wheel
of the long side turns ever faster than the robot drives and the others hold it back: they show the curve on terrain
so hard that no start would, without load transfer and slowly.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from terrain.constants import GRAVITY_MPS2
from terrain.effects import NUISANCES, PARAMETER, SENSED_ONLY
from terrain.errors import ConfigError
from terrain.extension import warn_outside
from terrain.logs.schema import IMU_CHANNELS
from terrain.records import Array, Command, RunLog, Sample, Stream
from terrain.robots import BicycleRobot, Robot, SwerveRobot, TrackedRobot, load_robot
from terrain.simulation.assumed import with_assumed
from terrain.simulation.scenario import (
    NO_FAULTS,
    RATE_HZ,
    Conditions,
    Faults,
    Patch,
    Scenario,
    draw_conditions,
    make_scenario,
)
from terrain.simulation.sensors import (
    FIELD_CAMERAS,
    RAW_FIXES,
    Gnss,
    Poses,
    draw_imu_errors,
    imu_values,
    is_lost,
    poses_of,
)
from terrain.terramechanics.soil import Soil, load_soil, scattered, soil_names

if TYPE_CHECKING:
    from terrain.simulation.plants.car import CarDrive
    from terrain.simulation.plants.car import Ground as CarGround
    from terrain.simulation.plants.planar import Ground
    from terrain.simulation.plants.tracks import TrackedGround

COURSE = "course"  # A path over all terrains, in place of the name of one
# Word for the IMU alone on a bench, in place of a scenario, and the terrain that goes with it.
BENCH, BENCH_TERRAIN = "six_positions", "bench"
SLIP = "slip"  # word for drives that take the wheels through their slips, for ``terrain learn-slip``


def simulate(
    robot: Robot,
    drive: Scenario | Array | CarDrive,
    ground: Mapping[str, Soil] | Ground | TrackedGround | CarGround,
    seed: int | np.random.SeedSequence,
    *,
    run_id: str = "run",
    conditions: Conditions | None = None,
    faults: Faults = NO_FAULTS,
    effects: Mapping[str, float] | None = None,
    **options: Any,
) -> RunLog:
    """Drive a robot on a ground, and return what its loggers wrote with the truth beside it.

    Parameters
    ----------
    robot : sections that it lacks are assumed by the dynamic plant (:mod:`~terrain.simulation.assumed`); in the others
        they do not act, but for swerve robots, of which the planar plant needs all
    drive : a scenario, or for the planar plant twists (n, 3), for tracks speeds (n, 2) of left and right, at 50 Hz; of
        a car its speed, stops and start
    ground : soils by the terrain names of the scenario (dynamic plant); a planar ground (planar plant); a soil that
        shears, prescribed slip, or stretches of them (tracks); a ground along the drive (car)
    seed : of everything that is drawn; the same seed gives the same log, and a sequence is not advanced
    run_id : name of the run
    conditions : load, slope, tyres, roughness; level and nominal by default
    faults : faults of the sensors
    effects : parameters of :mod:`terrain.effects` that act on this robot and its sensors, beside those of its
        description or in place of them; the commands and the log do not contain them.  In the dynamic plant of swerve
        robots alone
    options : of the plant: :func:`~terrain.simulation.plants.dynamic.run_dynamic` (gnss, poses, compass, controller,
        command_delay_s),
        :func:`~terrain.simulation.plants.planar.run_planar` (scatter, noise, outside, heading, fixes, terrain),
        :func:`~terrain.simulation.plants.tracks.run_tracked` (slope, yaw_rad, sensors),
        :func:`~terrain.simulation.plants.car.run_car` (controller, noise)

    Returns
    -------
    RunLog
        streams wheels, imu, commands and truth, and steering where there is any; odometry (of a swerve robot the pose
        of a tracking camera, of others the speed of the camera's point in body axes), pose (of cameras around the
        field), gnss and compass; and control, the status of a controller.  An omni robot of the planar plant has
        wheels, pose, commands and truth.  None that was lost throughout.  Labels where a ground has a name.

    Raises
    ------
    ConfigError
        if robot, ground and drive do not go together, the robot lacks a section, is tipped over by its load or has
        numbers so far out of scale that its motion cannot be integrated, a sensor is faster than the plant's steps, a
        terrain of the scenario has no soil, or an effect or option does not apply or is out of its bounds.
    DataError
        if a command is not one finite number a wheel, or its status not numbers by names that end in a unit, the same
        names throughout.

    Examples
    --------
    >>> from terrain.simulation.plants.planar import Ground
    >>> twist = np.zeros((501, 3))
    >>> twist[50:, 0] = 0.5
    >>> run = simulate(load_robot("husky"), twist, Ground(), 0, effects={"wheel_radius_ratio": -0.1})
    >>> run.streams["wheels"].values[-1, :2].round(3), run.streams["odometry"].values[-1].round(3)
    (array([0.5, 0.5]), array([0.443, 0.   ]))
    """
    plant: Any
    if isinstance(ground, Mapping):  # a run does not load the kernels of other plants
        from terrain.simulation.plants.dynamic import run_dynamic

        plant, source = run_dynamic, f"simulated, {getattr(drive, 'name', '')}"
        options["faults"] = faults
    else:
        from terrain.simulation.plants import car, planar, tracks

        plant, source = tracks.run_tracked, "simulated, tracked"
        if isinstance(ground, planar.Ground):
            plant, source = planar.run_planar, "simulated, planar"
        elif isinstance(ground, car.Ground):
            plant, source = car.run_car, "simulated, car"
    options |= {"conditions": conditions or Conditions(), "effects": effects or {}}
    streams, labels = plant(robot, drive, ground, seed, **options)
    for name in ("odometry", "pose") if faults.camera_lost_s else ():  # a closed loop has lost them already
        if name in streams:
            stream = streams[name]
            seen = ~is_lost(stream.time_s, faults.camera_lost_s)
            streams[name] = Stream(stream.time_s[seen], stream.values[seen], stream.channels)
    return RunLog(run_id, robot.name, {n: s for n, s in streams.items() if len(s) > 1}, labels, source)


def simulate_run(
    robot: Robot | str | Path,
    terrain: str,
    scenario: str | Scenario,
    seed: int = 0,
    number: int = 1,
    *,
    duration_s: float | None = None,
    vary: bool = False,
    conditions: Conditions | None = None,
    faults: Faults | None = None,
    gnss: Gnss | None = None,
    poses: Poses | None = None,
    effects: Mapping[str, float] | None = None,
) -> RunLog:
    """Return one simulated run by names.

    What is drawn depends on ``seed``, ``terrain``, ``scenario`` and ``number`` alone: a run is the same whatever is
    simulated beside it.

    Parameters
    ----------
    robot : any, or its name or YAML file; sections that it lacks are assumed
    terrain : name of a soil or path of its YAML file, or ``course`` for all soils in one run
    scenario : name of a scenario; ``course`` goes with the terrain ``course``, ``six_positions`` (the IMU alone, for
        calibration) with ``bench``; ``slip`` sweeps the slip of the wheels under varied conditions; or what is to be
        driven, as of :func:`~terrain.simulation.scenario.from_commands`
    seed, number : of what is drawn
    duration_s : length; the scenario's own by default
    vary : draw soil, slope, load, tyres and roughness for this run by ``data/soils`` and ``data/spread``
    conditions, faults, effects : as :func:`simulate` has them, conditions about which they vary.  With effects, be it
        none of them, other than swerve robots are simulated by the planar plant, which has none of the wheels' own
    gnss, poses : receiver on board, and what sees its pose from outside, beside what :func:`instruments` has

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
    dynamic = _dynamic(robot, effects)
    robot = with_assumed(robot) if dynamic else robot
    commands = scenario if isinstance(scenario, Scenario) else None
    scenario = scenario.name if isinstance(scenario, Scenario) else scenario
    if commands is not None and duration_s is not None:
        raise ConfigError(f"scenario {scenario!r} is as long as its commands: leave the duration out")
    if effects and scenario in (BENCH, SLIP):
        raise ConfigError(f"scenario {scenario!r} is simulated without effects: leave them out")
    if scenario == BENCH:
        if terrain != BENCH_TERRAIN:
            raise ConfigError(
                f"scenario {BENCH!r} is done on a bench: give the terrain {BENCH_TERRAIN!r}, not {terrain!r}"
            )
        hold_s = 5.0 if duration_s is None else duration_s / len(POSITIONS) - TURN_S
        held = np.random.SeedSequence([seed, zlib.crc32(BENCH.encode()), number])
        return six_positions_log(robot, held, hold_s=hold_s, run_id=run_id_of(terrain, BENCH, number))
    if scenario == SLIP:
        if terrain == COURSE:
            raise ConfigError(f"scenario {SLIP!r} is driven on one terrain, not on 'course'")
        if (duration_s, gnss, poses) != (None, None, None) or conditions not in (None, Conditions()):
            raise ConfigError(
                f"scenario {SLIP!r} draws its conditions: leave duration, grade, payload, gnss and pose out"
            )
        if faults not in (None, NO_FAULTS):
            raise ConfigError(f"scenario {SLIP!r} has no faults on purpose: leave the camera's loss out")
        run_id = run_id_of(load_soil(terrain).name, SLIP, number)
        return learning_run(robot, terrain, seed, number, run_id=run_id)
    if (terrain == COURSE) != (scenario == COURSE):
        raise ConfigError("terrain 'course' and scenario 'course' go together: give both or neither")
    soils = {soil.name: soil for soil in map(load_soil, soil_names() if terrain == COURSE else (terrain,))}
    terrain = terrain if terrain == COURSE else next(iter(soils))
    key = [seed, zlib.crc32(terrain.encode()), zlib.crc32(scenario.encode()), number]
    drawn, driven, simulated = np.random.SeedSequence(key).spawn(3)
    if vary:
        rng = np.random.default_rng(drawn)
        soils = {name: scattered(soil, rng) for name, soil in soils.items()}
        conditions = draw_conditions(rng, conditions, robot if dynamic else None)
    if not dynamic and terrain == COURSE:
        raise ConfigError(f"robot {robot.name}: scenario {COURSE!r} is driven without effects")
    drive_seed = int(driven.generate_state(1)[0])
    drive = commands or make_scenario(scenario, robot, list(soils), duration_s, seed=drive_seed)
    ground: Any = soils
    options: dict[str, Any] = instruments(robot, gnss, poses)
    effects = effects or {}
    if not dynamic:
        from terrain.simulation.plants.planar import planar_ground, spread_numbers

        if gnss is not None or poses is not None:
            raise ConfigError(
                f"robot {robot.name}: with effects no receiver or pose is simulated, leave them out"
            )
        scatter = spread_numbers("scatter")
        if not vary:  # the scatter of its sensors stays
            scatter |= {name: 0.0 for name in NUISANCES if name in PARAMETER and name not in SENSED_ONLY}
        ground, options = planar_ground(robot, soils[terrain]), {"scatter": scatter}
        options |= {"noise": spread_numbers("noise"), "fixes": isinstance(robot, BicycleRobot)}
    options |= {"conditions": conditions, "faults": faults or NO_FAULTS, "effects": effects}
    run_id = run_id_of(terrain, scenario, number)
    run = simulate(robot, drive, ground, simulated, run_id=run_id, **options)
    warn_outside(run, robot)
    return run


def _dynamic(robot: Robot, effects: Mapping[str, float] | None) -> bool:
    """Return whether the dynamic plant simulates a robot by names; of effects, those of swerve robots alone."""
    return isinstance(robot, SwerveRobot) or not (effects is not None or robot.effects or robot.learned)


def instruments(robot: Robot, gnss: Gnss | None = None, poses: Poses | None = None) -> dict[str, Any]:
    """Return what measures a robot from outside: what is asked for, and what its drive has in the papers of it.

    Tracked robots have cameras around the field, raw fixes and a compass, car-like ones the last two, and robots on
    omni wheels a camera above.
    """
    tracked, car = isinstance(robot, TrackedRobot), isinstance(robot, BicycleRobot)
    if poses is None and (tracked or robot.on_omni_wheels):
        poses = FIELD_CAMERAS if tracked else poses_of(robot)
    if gnss is None and (tracked or car):
        gnss = RAW_FIXES
    return {"gnss": gnss, "poses": poses, "compass": tracked or car}


def run_id_of(terrain: str, scenario: str, number: int) -> str:
    """Return the name of a simulated run.

    Examples
    --------
    >>> run_id_of("grass", "straight", 3), run_id_of("course", "course", 12)
    ('grass_straight_03', 'course_12')
    """
    return f"{terrain}_{number:02d}" if terrain == scenario else f"{terrain}_{scenario}_{number:02d}"


# Time by hand from one position to the next, and standard deviation of how far a position is from its axis;
# assumed.
TURN_S, CROOKED_RAD = 1.5, 0.03

# Roll and pitch of the six positions: turns about body axes that bring z, -z, x, -x, y and -y up.
POSITIONS = math.pi / 2 * np.array([(0, 0), (2, 0), (0, -1), (0, 1), (1, 0), (-1, 0)])


def six_positions_log(
    robot: Robot, seed: int | np.random.SeedSequence, *, hold_s: float = 5.0, run_id: str = "bench"
) -> RunLog:
    """Return the log of an IMU alone, held still in six positions and turned by hand between them.

    It has the stream imu with the channels of a driven run, without labels.  As in a driven run, each power-on has
    biases of its own about those of the description.  At rest the specific force is ``g`` times the vertical in body
    axes; what the hand accelerates is left out.

    Raises
    ------
    ConfigError
        if ``hold_s`` is not above zero, or a section of the robot's description is missing.

    Examples
    --------
    >>> run = six_positions_log(load_robot("agrimaro"), seed=0, hold_s=2.0)
    >>> sorted(run.streams), len(run.streams["imu"])
    (['imu'], 1950)
    """
    if not 0 < hold_s < math.inf:
        raise ConfigError(f"hold_s is {hold_s!r}, a time above zero is required")
    sensors = robot.sensors
    rng = np.random.default_rng(seed)
    crooked = CROOKED_RAD * rng.standard_normal((len(POSITIONS), 2))
    heading = rng.uniform(-math.pi, math.pi, len(POSITIONS))
    held = Rotation.from_euler("ZYX", np.column_stack([heading, (POSITIONS + crooked)[:, ::-1]]))
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
    roll = np.arctan2(turned[:, 2, 1], turned[:, 2, 2])
    pitch = -np.arcsin(np.clip(turned[:, 2, 0], -1.0, 1.0))
    yaw = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    true = np.column_stack([rate, force, roll, pitch, np.unwrap(yaw) - yaw[0]])
    streams = {"imu": Stream(time_s, imu_values(true, *draw_imu_errors(sensors, n, rng)), IMU_CHANNELS)}
    return RunLog(run_id, robot.name, streams, source="simulated, six positions on a bench")


# Largest slip of the swept wheel, time from no slip to the largest and back, and time before the first sweep.
SWEEP_SLIP, SWEEP_S, STEADY_S = 0.75, 6.0, 3.0
SWEEP_SPEED_MPS = 0.8  # of a sweep: the swept wheel stays within its motor's speed up to a slip of 0.6


class Drive(NamedTuple):
    """Kind of a drive (``starts``, ``climb``, ``sweep``), acceleration, speed and the terrain's gradient."""

    kind: str
    accel_mps2: float
    speed_mps: float
    duration_s: float = 30.0
    grade_ratio: float = 0.0
    undulation_ratio: float = 0.0


LEARNING_DRIVES: tuple[Drive, ...] = (
    *(Drive("sweep", 1.0, SWEEP_SPEED_MPS, 40.0),) * 5,
    Drive("starts", 1.5, 1.2),
    Drive("starts", 40.0, 1.8),
    Drive("climb", 2.0, 1.2, 30.0, 0.1, 0.08),
)
"""Eight runs of a swerve robot that together cover slips from 0 to over 0.5 on every soil."""


def learning_drives(robot: Robot) -> tuple[Drive, ...]:
    """Return what a robot drives for learning slip, each run of it once.

    Where no wheel can be driven against the others, as where sides share theirs, steady motion shows the slip at which
    thrust balances resistance, and starts and climbs that above it; all within 0.8 of the motors' speed.
    """
    if isinstance(robot, SwerveRobot):
        return LEARNING_DRIVES
    limit_mps = getattr(robot, "speed_max_mps", robot.wheel_radius_m * robot.motors.speed_max_radps)
    fast_mps = min(0.8 * limit_mps, 1.2)
    steady = (Drive("steady", 1.0, part * fast_mps) for part in (0.6, 0.8, 1.0))
    starts = (Drive("starts", accel_mps2, fast_mps) for accel_mps2 in (1.5, 40.0))
    return *steady, *starts, Drive("climb", 2.0, fast_mps, 30.0, 0.05, 0.04)


def learning_runs(
    robot: Robot, terrain: str, seed: int, drives: tuple[Drive, ...] | None = None
) -> list[RunLog]:
    """Return one run a drive, with soil, load, slope, tyres and roughness drawn for each.

    Drives are those of :func:`learning_drives` by default.
    """
    robot = with_assumed(robot)
    drives = learning_drives(robot) if drives is None else drives
    return [learning_run(robot, terrain, seed, number, drive) for number, drive in enumerate(drives, start=1)]


def learning_run(
    robot: Robot, terrain: str, seed: int, number: int, drive: Drive | None = None, run_id: str | None = None
) -> RunLog:
    """Return one run, ``number`` from 1 on; its drive is by default one of :func:`learning_drives` in turn.

    Robots of other drives than swerve have a satellite receiver, beside a camera where one is described; those on omni
    wheels, which may head anywhere, are seen from outside.
    """
    robot = with_assumed(robot)
    if drive is None:
        drives = learning_drives(robot)
        drive = drives[(number - 1) % len(drives)]
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
        conditions=draw_conditions(rng, ground, robot),
        controller=SlipSweep(robot) if drive.kind == "sweep" else None,
        gnss=None if isinstance(robot, SwerveRobot) else Gnss(),
        poses=poses_of(robot) if robot.on_omni_wheels else None,
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
        self._limit_radps = robot.motors.speed_max_radps
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
