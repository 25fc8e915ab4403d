"""One simulated run by names: robot, terrain, scenario and number in, a run log out.

This entry picks the plant by the robot's drive: swerve robots are simulated by the dynamic plant
(:mod:`terrain.simulation.dynamic.simulate`), tracked ones on ground that shears by the forces under their
tracks (:mod:`terrain.simulation.tracked`), all others, and whatever has effects, by the planar one
(:mod:`terrain.simulation.planar.run`).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from terrain.effects import NUISANCES, PARAMETER, SENSED_ONLY
from terrain.errors import ConfigError
from terrain.extension import warn_outside
from terrain.kinematics.commands import wheel_motion
from terrain.records import Array, RunLog, Stream
from terrain.robots import BicycleRobot, Robot, SwerveRobot, TrackedRobot, load_robot
from terrain.simulation.bench import POSITIONS, TURN_S, six_positions_log
from terrain.simulation.conditions import Conditions, Faults, draw_conditions, load_spread
from terrain.simulation.dynamic.simulate import simulate
from terrain.simulation.planar.model import planar_ground
from terrain.simulation.planar.noise import load_noise, load_scatter
from terrain.simulation.planar.run import Hills, simulate_planar
from terrain.simulation.scenario import make_scenario
from terrain.simulation.sensors import Gnss, is_lost, with_raw_fixes
from terrain.simulation.slip_sweep import learning_run
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
    """Refuse options of the drives of :mod:`terrain.simulation.slip_sweep`, which draw all conditions."""
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
