"""One run of the dynamic plant: robot, scenario and soils in, an ordinary run log with its truth out.

Examples
--------
>>> from terrain.robots import load_robot
>>> from terrain.simulation.scenario.make import make_scenario
>>> from terrain.terramechanics.soil import load_soil
>>> robot = load_robot("agrimaro")
>>> drive = make_scenario("straight", robot, ["grass"], 5.0)
>>> run = simulate(robot, drive, {"grass": load_soil("grass")}, seed=0)
>>> sorted(run.streams), run.terrains
(['commands', 'imu', 'odometry', 'steering', 'truth', 'wheels'], ('grass',))
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from terrain.effects import OTHER_LOGGER, PlantPart, checked_effects, in_plant
from terrain.errors import ConfigError
from terrain.extension import apply_homes
from terrain.kinematics.swerve import wheel_commands
from terrain.records import Array, Command, Label, RunLog, Sample, Stream
from terrain.robots import Robot, SwerveRobot, as_drive
from terrain.simulation.conditions import NO_FAULTS, Conditions, Faults
from terrain.simulation.dynamic.loop import Drive, in_loop
from terrain.simulation.dynamic.plant import Plant, make_plant, record_width
from terrain.simulation.dynamic.profile import draw_profile
from terrain.simulation.dynamic.states import start_state
from terrain.simulation.dynamic.step import advance, settle
from terrain.simulation.dynamic.step_limit import check_step
from terrain.simulation.scenario.scenario import Scenario
from terrain.simulation.sensors.camera import CameraSensor
from terrain.simulation.sensors.gnss import Gnss, GnssSensor
from terrain.simulation.sensors.imu import ImuSensor
from terrain.simulation.sensors.motion import BODY_RECORD, STEP_S, Motion
from terrain.simulation.sensors.sensor import Sensor
from terrain.simulation.sensors.steering import SteeringSensor
from terrain.simulation.sensors.truth import truth_stream
from terrain.simulation.sensors.wheels import WheelSensor
from terrain.terramechanics.soil import Soil

MIN_LABEL_S = 0.5
"""A shorter stay on one ground gets no label."""

MAX_WHEEL_SPEEDS = 100.0
"""No wheel turns so many times as fast as its motor can: then the steps are too long for the robot, as with a
load of 1000 t on 90 kg."""

MAX_COMMAND_DELAY_S = 0.5
"""Longest delay of a command to the wheels; a later one is no control."""

_PURPOSES = ("terrain", "road", "start", "wheels", "steering", "imu", "camera", "gnss")

_SENSOR_RATES = ("wheels_rate_hz", "steering_rate_hz", "imu_rate_hz")

COMMAND_CHANNELS = (
    "speed_x_mps",
    "speed_y_mps",
    "yaw_rate_radps",
    *(f"wheel_{i}_radps" for i in (1, 2, 3)),
    *(f"steer_{i}_rad" for i in (1, 2, 3)),
)
"""The admitted twist of the body, and what it asks of the wheels."""


def simulate(
    robot: Robot,
    scenario: Scenario,
    soils: Mapping[str, Soil],
    seed: int | np.random.SeedSequence,
    *,
    run_id: str = "run",
    conditions: Conditions | None = None,
    faults: Faults = NO_FAULTS,
    gnss: Gnss | None = None,
    controller: Callable[[Sample], Command] | None = None,
    command_delay_s: float = 0.0,
    effects: Mapping[str, float] | None = None,
) -> RunLog:
    """Drive a scenario and return what the loggers wrote, with the truth beside it.

    Without a controller the wheels are commanded to follow the desired twists.  With one the loop is closed:
    at each instant of the scenario it gets the samples that arrived since the instant before, as the log has
    them, and its output is the command.

    Parameters
    ----------
    robot : swerve robot with all sections
    scenario : twists and terrains
    soils : by the terrain names of the scenario
    seed : of everything that is drawn; the same seed gives the same log, and a sequence is not advanced
    run_id : name of the run
    conditions : load, slope, tyres, roughness; level and nominal by default
    faults : faults of the sensors
    gnss : receiver on board, if any
    controller : called once an instant of the scenario; before its first command is in force, the wheels are
        commanded to stand and the steering to stay at 0
    command_delay_s : from that instant to when the command is in force, in whole steps, one at least
    effects : parameters of :mod:`terrain.effects.catalogue` that act on this robot and its sensors, beside
        those of its description or in place of them; the commands and the log do not contain them

    Returns
    -------
    RunLog
        streams wheels, steering, imu, odometry, commands as decided at each instant, truth, gnss where there
        is a receiver, and control, the status of the controller's commands, where there is any; none that was
        lost throughout.  A label for each stretch in which all wheels are on one terrain.

    Raises
    ------
    ConfigError
        if the robot is no swerve robot, lacks a section, is tipped over by its load or has a number so far
        out of scale that its motion cannot be integrated, a sensor is faster than the simulation's steps, a
        terrain of the scenario has no soil, its twists do not come every so many whole steps, the delay is
        not from 0 to 0.5 s, or an effect does not apply to the robot or is out of its bounds.
    DataError
        if a command is not one finite number a wheel, or its status not numbers by names that end in a unit,
        the same names throughout.
    """
    robot = as_drive(SwerveRobot, robot, "robot {name}: drive {drive!r} is not simulated, only 'swerve' is")
    substeps, delay_steps = _substeps(robot, scenario), _delay_steps(command_delay_s)
    rngs = _generators(seed)
    built = _built(robot, effects or {})
    plant = _plant(built, scenario, soils, conditions or Conditions(), rngs["terrain"])
    n_steps = len(scenario.time_s) * substeps
    state = start_state(plant, plant.backlash_rad * rngs["start"].uniform(-1.0, 1.0, 3))
    settle(plant, state)
    road_noise = rngs["road"].standard_normal((n_steps, 3))
    motion = Motion(np.empty((n_steps, record_width(plant))), 0)
    sensors = _sensors(motion, built, faults, gnss, rngs)
    status: dict[str, Array] = {}
    if controller is None:
        admitted, wheel_radps, steer_rad = _commands(robot, scenario)
        advance(plant, state, wheel_radps, steer_rad, substeps, road_noise, motion.record)
        decided = np.hstack([admitted, wheel_radps, steer_rad])
    else:
        drive = Drive(plant, state, road_noise, motion.record)
        decided, status = in_loop(controller, delay_steps, scenario, substeps, drive, motion, sensors)
    _check_motion(motion, robot)
    motion.grow(n_steps)
    streams = _streams(sensors) | {"commands": Stream(scenario.time_s, decided, COMMAND_CHANNELS)}
    if status:
        streams["control"] = Stream(scenario.time_s, np.column_stack(list(status.values())), tuple(status))
    streams["truth"] = _truth(motion, sensors["imu"])
    return RunLog(run_id, robot.name, streams, _labels(motion, scenario), f"simulated, {scenario.name}")


def _substeps(robot: Robot, scenario: Scenario) -> int:
    """Return the steps from twist to twist, once robot and scenario are checked."""
    substeps = round(1 / (scenario.rate_hz * STEP_S))
    if abs(substeps * scenario.rate_hz * STEP_S - 1.0) > 1e-9:
        raise ConfigError(
            f"scenario {scenario.name}: rate_hz is {scenario.rate_hz:g}, it must divide {1 / STEP_S:g}"
        )
    _check_rates(robot)
    return substeps


def _generators(seed: int | np.random.SeedSequence) -> dict[str, np.random.Generator]:
    """Return a generator for each purpose: one sensor more or less does not change the others."""
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return {
        purpose: np.random.default_rng(np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, i)))
        for i, purpose in enumerate(_PURPOSES)
    }


def _sensors(
    motion: Motion,
    robot: Robot,
    faults: Faults,
    gnss: Gnss | None,
    rngs: Mapping[str, np.random.Generator],
) -> dict[str, Sensor]:
    """Return the sensors on board, by stream."""
    sensors: dict[str, Sensor] = {
        "wheels": WheelSensor(motion, robot, rngs["wheels"]),
        "steering": SteeringSensor(motion, robot, rngs["steering"]),
        "imu": ImuSensor(motion, robot, rngs["imu"]),
        "odometry": CameraSensor(motion, robot, rngs["camera"], faults),
    }
    if gnss is not None:
        sensors["gnss"] = GnssSensor(motion, gnss, rngs["gnss"], faults)
    offset_s, rate = (robot.effects.get(name, 0.0) for name in ("clock_offset_s", "clock_rate_ratio"))
    if offset_s or rate:
        for name in sensors.keys() & set(OTHER_LOGGER):
            sensors[name].stamp(offset_s, rate)
    return sensors


def _streams(sensors: Mapping[str, Sensor]) -> dict[str, Stream]:
    """Return the streams of the sensors; those without samples are left out."""
    for sensor in sensors.values():
        sensor.update()
    streams = {name: sensor.stream() for name, sensor in sensors.items()}
    return {name: stream for name, stream in streams.items() if len(stream) > 1}


def _truth(motion: Motion, imu: Sensor) -> Stream:
    assert isinstance(imu, ImuSensor)
    return truth_stream(motion, imu.yaw_bias_radps, imu.time_s)


def _built(robot: Robot, effects: Mapping[str, float]) -> Robot:
    """Return the robot with all its effects, of which the commanded one lacks some."""
    if not robot.effects and not effects:
        return robot
    acting = checked_effects("effects", {**robot.effects, **effects}, robot.drive)
    n = len(acting)
    extended = replace(robot, effects=acting, effects_cov=np.full((n, n), np.nan))
    return apply_homes(extended, in_plant(PlantPart.DESCRIPTION))


def _delay_steps(delay_s: float) -> int:
    if (
        isinstance(delay_s, bool)
        or not isinstance(delay_s, int | float | np.integer | np.floating)
        or not 0 <= delay_s <= MAX_COMMAND_DELAY_S
    ):
        raise ConfigError(
            f"command_delay_s is {delay_s!r}, a time from 0 to {MAX_COMMAND_DELAY_S:g} s is required"
        )
    return round(delay_s / STEP_S)


def _check_rates(robot: Robot) -> None:
    _, _, _, camera, sensors = robot.equipment
    rates_hz = {
        "camera: rate_hz": camera.rate_hz,
        **{f"sensors: {name}": getattr(sensors, name) for name in _SENSOR_RATES},
    }
    for name, rate_hz in rates_hz.items():
        if rate_hz > 1 / STEP_S:
            raise ConfigError(
                f"robot {robot.name}: {name} is {rate_hz:g}, at most {1 / STEP_S:g} is simulated"
            )


def _check_motion(motion: Motion, robot: Robot) -> None:
    lost = [name for name in BODY_RECORD if not np.isfinite(motion.body(name)).all()]
    fastest_radps = float(np.abs(motion.wheel("wheel_radps")).max())
    limit_radps = MAX_WHEEL_SPEEDS * robot.equipment.motors.speed_max_radps
    if lost or not fastest_radps <= limit_radps:
        raise ConfigError(
            f"robot {robot.name}: its motion cannot be integrated in steps of {STEP_S:g} s; a mass, an "
            "inertia, a stiffness, a gain or the load is out of scale with the rest"
        )


def _commands(robot: Robot, scenario: Scenario) -> tuple[Array, Array, Array]:
    _, motors, steering, _, _ = robot.equipment
    return wheel_commands(
        robot.wheel_positions_m,
        robot.wheel_radius_m,
        motors.speed_max_radps,
        steering.rate_max_radps,
        1 / scenario.rate_hz,
        scenario.twist,
        np.zeros(3),
    )


def _plant(
    robot: Robot,
    scenario: Scenario,
    soils: Mapping[str, Soil],
    conditions: Conditions,
    rng: np.random.Generator,
) -> Plant:
    plant = make_plant(robot, conditions, draw_profile(robot, scenario, soils, conditions, rng))
    check_step(plant, robot.name)
    return plant


def _labels(motion: Motion, scenario: Scenario) -> tuple[Label, ...]:
    """One label a stretch in which all three wheels are on the same ground."""
    patch = motion.wheel("patch_ratio")
    one = np.where((patch == patch[:, :1]).all(axis=1), patch[:, 0], -1)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(one)) + 1, [len(one)]])
    labels: list[Label] = []
    for begin, end in pairwise(edges):
        start_s, end_s = float(begin * STEP_S), float(end * STEP_S)
        if one[begin] < 0 or end_s - start_s < MIN_LABEL_S:
            continue
        labels.append(Label(round(start_s, 3), round(end_s, 3), scenario.patches[int(one[begin])].terrain))
    return tuple(labels)
