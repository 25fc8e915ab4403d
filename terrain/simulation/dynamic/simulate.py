"""One run of the dynamic plant: robot, scenario and soils in, an ordinary run log with its truth out.

With a controller the loop is closed: it gets what the sensors have written so far, and commands the wheels.  At
instant ``t_k`` of the scenario the step that starts there has run with the command in force, so a sample stamped
``t_k`` of a sensor without latency is there; the command of the controller is in force from the step that starts
a delay later, one step at the least.

Examples
--------
>>> from terrain.robots import load_robot
>>> from terrain.simulation.scenario import make_scenario
>>> from terrain.terramechanics.soil import load_soil
>>> robot = load_robot("agrimaro")
>>> drive = make_scenario("straight", robot, ["grass"], 5.0)
>>> run = simulate(robot, drive, {"grass": load_soil("grass")}, seed=0)
>>> sorted(run.streams), run.terrains
(['commands', 'imu', 'odometry', 'steering', 'truth', 'wheels'], ('grass',))
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from terrain.effects import OTHER_LOGGER, Stage, checked_effects, in_plant
from terrain.errors import ConfigError, DataError, LogError
from terrain.extension import apply_homes
from terrain.kernels import filled, is_finite
from terrain.kinematics.commands import wheel_commands
from terrain.logs.schema import unit_of
from terrain.records import Array, Command, Label, RunLog, Sample, Stream
from terrain.robots import Robot, SwerveRobot, as_drive
from terrain.simulation.conditions import NO_FAULTS, Conditions, Faults
from terrain.simulation.dynamic.plant import TerrainProfile, check_step, draw_profile, make_plant, start_state
from terrain.simulation.dynamic.step import advance, settle
from terrain.simulation.scenario import Scenario
from terrain.simulation.sensors import (
    BODY_ROW,
    STEP_S,
    CameraSensor,
    Gnss,
    GnssSensor,
    ImuSensor,
    Motion,
    Sensor,
    SteeringSensor,
    WheelSensor,
    truth_stream,
)
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
    effects : parameters of :mod:`terrain.effects` that act on this robot and its sensors, beside
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
    conditions = conditions or Conditions()
    profile = draw_profile(built, scenario, soils, conditions, rngs["terrain"])
    plant = make_plant(built, conditions)
    check_step(plant, profile, built.name)
    n_steps = len(scenario.time_s) * substeps
    state = start_state(plant["backlash_rad"][0] * rngs["start"].uniform(-1.0, 1.0, 3))
    settle(plant, profile, state)
    road_noise = rngs["road"].standard_normal((n_steps, 3))
    motion = Motion(np.empty(n_steps, BODY_ROW), 0)
    sensors = _sensors(motion, built, faults, gnss, rngs)
    status: dict[str, Array] = {}
    if controller is None:
        admitted, wheel_radps, steer_rad = _commands(robot, scenario)
        advance(plant, profile, state, wheel_radps, steer_rad, substeps, road_noise, motion.record)
        decided = np.hstack([admitted, wheel_radps, steer_rad])
    else:
        drive = Drive(plant, profile, state, road_noise, motion.record)
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
    motion: Motion, robot: Robot, faults: Faults, gnss: Gnss | None, rngs: Mapping[str, np.random.Generator]
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
    return apply_homes(extended, in_plant(Stage.DESCRIPTION))


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
    finite = all(np.isfinite(motion.record[name]).all() for name in BODY_ROW.names or () if name != "wheels")
    fastest_radps = float(np.abs(motion.wheel("wheel_radps")).max())
    limit_radps = MAX_WHEEL_SPEEDS * robot.equipment.motors.speed_max_radps
    if not finite or not fastest_radps <= limit_radps:
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


class Drive:
    """A plant that is driven on and on, by commands that come into force one after the other.

    Parameters
    ----------
    plant, profile, state, road_noise, rows : as :func:`terrain.simulation.dynamic.step.advance` takes them,
        for all steps
    """

    def __init__(
        self, plant: Array, profile: TerrainProfile, state: Array, road_noise: Array, rows: Array
    ) -> None:
        self._plant, self._profile, self._state, self._noise, self._rows = (
            plant,
            profile,
            state,
            road_noise,
            rows,
        )
        self._wheel, self._steer = np.zeros((1, 3)), np.zeros((1, 3))
        self._due: deque[tuple[int, Array, Array]] = deque()
        self._n_steps = 0

    def command(self, step: int, wheel_radps: Array, steer_rad: Array) -> None:
        """Let a command (3,), (3,) come into force with a step, not before those that were given before."""
        self._due.append((step, wheel_radps, steer_rad))

    def until(self, n_steps: int) -> bool:
        """Drive until so many steps are done; false where the state is not finite: the rest of it is NaN."""
        while self._n_steps < n_steps:
            first = self._n_steps
            if self._due and self._due[0][0] <= first:
                _, self._wheel[0], self._steer[0] = self._due.popleft()
                continue
            end = min(n_steps, self._due[0][0]) if self._due else n_steps
            held = (self._wheel, self._steer, end - first, self._noise[first:end], self._rows[first:end])
            advance(self._plant, self._profile, self._state, *held)
            self._n_steps = end
        finite = is_finite(self._state)
        if not finite:
            self._rows[self._n_steps :] = filled(BODY_ROW, np.nan)[0]
            self._n_steps = len(self._rows)
        return finite


def in_loop(
    controller: Callable[[Sample], Command],
    delay_steps: int,
    scenario: Scenario,
    substeps: int,
    drive: Drive,
    motion: Motion,
    sensors: Mapping[str, Sensor],
) -> tuple[Array, dict[str, Array]]:
    """Drive a scenario by a controller, to its last row.

    Parameters
    ----------
    controller : called once an instant of the scenario
    delay_steps : from an instant to when its command is in force; taken as one where it is none
    scenario, substeps : what is required, and how many steps pass from instant to instant
    drive, motion : over the same record, nothing driven yet; a motion that cannot be integrated ends in NaN
    sensors : of the motion, by stream

    Returns
    -------
    decided : (n, 9) twist, wheel rates and steering angles of each command
    status : (n,) by name

    Raises
    ------
    DataError
        if a command or its status is not what is required.
    """
    decided = np.empty((len(scenario.time_s), 9))
    status: list[Mapping[str, float]] = []
    for k, time_s in enumerate(scenario.time_s.tolist()):
        step = k * substeps
        if not drive.until(step + 1):
            break
        motion.grow(step + 1)
        for sensor in sensors.values():
            sensor.update()
        arrived = ((name, sensor.arrived(time_s)) for name, sensor in sensors.items())
        readings = {name: reading for name, reading in arrived if reading is not None}
        one, two, three = motion.record["wheels"]["patch_ratio"][step].tolist()
        terrain = scenario.patches[int(one)].terrain if one == two == three else ""
        command = controller(Sample(time_s, scenario.twist[k], readings, terrain))
        decided[k] = _numbers(command, time_s)
        status.append(_status(command, status[0] if status else None, time_s))
        drive.command(step + max(delay_steps, 1), decided[k, 3:6], decided[k, 6:])
    drive.until(len(motion.record))
    names = status[0] if status else ()
    return decided, {name: np.array([row[name] for row in status]) for name in names}


def _numbers(command: Command, time_s: float) -> Array:
    """Return twist, wheel rates and steering angles of a command in a row (9,)."""
    row = np.empty(9)
    for i, name in enumerate(("twist", "wheel_radps", "steer_rad")):
        given = getattr(command, name)
        try:
            values = np.asarray(given, dtype=float)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape != (3,) or not np.isfinite(values).all():
            shown = " ".join(repr(given).split())
            raise DataError(
                f"controller: {name} of its command at {time_s:g} s is {shown}, 3 finite numbers are required"
            )
        row[3 * i : 3 * i + 3] = values
    return row


def _status(command: Command, first: Mapping[str, float] | None, time_s: float) -> dict[str, float]:
    """Return the status of a command; ``first`` is that of the first one."""
    try:
        status = {name: float(value) for name, value in command.status.items()}
        if first is None:
            for name in status:
                unit_of(name)
    except (AttributeError, TypeError, ValueError, LogError) as error:
        raise DataError(f"controller: status of its command at {time_s:g} s: {error}") from None
    if first is not None and status.keys() != first.keys():
        raise DataError(
            f"controller: status of its command at {time_s:g} s has {', '.join(status) or 'nothing'}, "
            f"that of the first has {', '.join(first) or 'nothing'}: the same names are required"
        )
    return status
