"""One run of the dynamic plant, in open loop or driven by a controller.

With a controller the loop is closed: it gets what the sensors have written so far, and commands the wheels.  At instant
``t_k`` of the scenario the step that starts there has run with the command in force, so a sample stamped ``t_k`` of a
sensor without latency is there; the command of the controller is in force from the step that starts a delay later, one
step at the least.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from terrain.effects import Stage, checked_effects, in_plant
from terrain.errors import ConfigError, DataError, LogError
from terrain.extension import apply_homes
from terrain.kernels import filled, is_finite
from terrain.kinematics.commands import wheel_motion
from terrain.logs.schema import unit_of
from terrain.records import Array, Command, Label, Sample, Stream
from terrain.robots import Robot, SwerveRobot, as_drive
from terrain.simulation.conditions import Conditions, Faults
from terrain.simulation.dynamic.plant import TerrainProfile, check_step, draw_profile, make_plant, start_state
from terrain.simulation.dynamic.step import advance, settle
from terrain.simulation.scenario import Scenario
from terrain.simulation.sensors import (
    BODY_ROW,
    STEP_S,
    Gnss,
    Motion,
    Sensor,
    camera_sensor,
    generators,
    gnss_sensor,
    imu_sensor,
    steering_sensor,
    wheel_sensor,
    wheels_truth,
)
from terrain.terramechanics.soil import Soil

MIN_LABEL_S = 0.5  # A shorter stay on one ground gets no label
# No wheel turns so many times as fast as its motor can: then the steps are too long for the robot, as with a load
# of 1000 t on 90 kg.
MAX_WHEEL_SPEEDS = 100.0
MAX_COMMAND_DELAY_S = 0.5  # longest delay of a command to the wheels; a later one is no control

_PURPOSES = ("terrain", "road", "start", "wheels", "steering", "imu", "camera", "gnss")

COMMAND_CHANNELS = (
    *("speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
    *(f"wheel_{i}_radps" for i in (1, 2, 3)),
    *(f"steer_{i}_rad" for i in (1, 2, 3)),
)
"""The admitted twist of the body, and what it asks of the wheels."""


def run_dynamic(
    robot: Robot,
    scenario: Scenario,
    soils: Mapping[str, Soil],
    seed: int | np.random.SeedSequence,
    *,
    conditions: Conditions,
    faults: Faults,
    effects: Mapping[str, float],
    gnss: Gnss | None = None,
    controller: Callable[[Sample], Command] | None = None,
    command_delay_s: float = 0.0,
) -> tuple[dict[str, Stream], tuple[Label, ...]]:
    """Return streams and labels of a scenario, for :func:`terrain.simulation.run.simulate`, which describes the rest.

    Parameters
    ----------
    robot : swerve robot with all sections
    soils : by the terrain names of the scenario
    gnss : receiver on board, if any
    controller : called once an instant of the scenario with the samples that arrived since the instant before, as the
        log has them; before its first command is in force, the wheels are commanded to stand and the steering to stay
        at 0.  Without one the wheels are commanded to follow the desired twists
    command_delay_s : from that instant to when the command is in force, in whole steps, one at least
    """
    robot = as_drive(SwerveRobot, robot, "robot {name}: drive {drive!r} is not simulated, only 'swerve' is")
    substeps, delay_steps = _substeps(robot, scenario), _delay_steps(command_delay_s)
    rngs = generators(seed, _PURPOSES)
    built = _built(robot, effects)
    profile = draw_profile(built, scenario, soils, conditions, rngs["terrain"])
    plant = make_plant(built, conditions)
    check_step(plant, profile, built.name)
    n_steps = len(scenario.time_s) * substeps
    state = start_state(plant["dead_band_rad"][0] * rngs["start"].uniform(-1.0, 1.0, 3))
    settle(plant, profile, state)
    road_noise = rngs["road"].standard_normal((n_steps, 3))
    motion = Motion(np.empty(n_steps, BODY_ROW), 0)
    sensors, gyro_bias_radps = _sensors(motion, built, faults, gnss, rngs)
    status: dict[str, Array] = {}
    if controller is None:
        wheels = wheel_motion(robot, scenario.twist, 1 / scenario.rate_hz)
        held = (wheels.wheel_radps, wheels.steer_rad, substeps)
        advance(plant, profile, state, *held, road_noise, motion.record)
        decided = np.hstack([wheels.twist, wheels.wheel_radps, wheels.steer_rad])
    else:
        drive = Drive(plant, profile, state, road_noise, motion.record)
        decided, status = _in_loop(controller, delay_steps, scenario, substeps, drive, motion, sensors)
    _check_motion(motion.record, robot)
    motion.grow(n_steps)
    for sensor in sensors.values():
        sensor.update()
    streams = {name: sensor.stream() for name, sensor in sensors.items() if len(sensor.time_s) > 1}
    streams["commands"] = Stream(scenario.time_s, decided, COMMAND_CHANNELS)
    if status:
        streams["control"] = Stream(scenario.time_s, np.column_stack(list(status.values())), tuple(status))
    streams["truth"] = wheels_truth(motion, gyro_bias_radps, sensors["imu"].time_s)
    return streams, _labels(motion.record, scenario)


def _substeps(robot: Robot, scenario: Scenario) -> int:
    """Return the steps from twist to twist, once robot and scenario are checked."""
    substeps = round(1 / (scenario.rate_hz * STEP_S))
    if abs(substeps * scenario.rate_hz * STEP_S - 1.0) > 1e-9:
        raise ConfigError(
            f"scenario {scenario.name}: rate_hz is {scenario.rate_hz:g}, it must divide {1 / STEP_S:g}"
        )
    _, _, _, camera, sensors = robot.equipment
    rates_hz = {"camera: rate_hz": camera.rate_hz} | {
        f"sensors: {name}": getattr(sensors, name)
        for name in ("wheels_rate_hz", "steering_rate_hz", "imu_rate_hz")
    }
    for name, rate_hz in rates_hz.items():
        if rate_hz > 1 / STEP_S:
            raise ConfigError(
                f"robot {robot.name}: {name} is {rate_hz:g}, at most {1 / STEP_S:g} is simulated"
            )
    return substeps


def _delay_steps(delay_s: float) -> int:
    number = isinstance(delay_s, int | float | np.integer | np.floating) and not isinstance(delay_s, bool)
    if not number or not 0 <= delay_s <= MAX_COMMAND_DELAY_S:
        raise ConfigError(
            f"command_delay_s is {delay_s!r}, a time from 0 to {MAX_COMMAND_DELAY_S:g} s is required"
        )
    return max(round(delay_s / STEP_S), 1)


def _sensors(
    motion: Motion, robot: Robot, faults: Faults, gnss: Gnss | None, rngs: Mapping[str, np.random.Generator]
) -> tuple[dict[str, Sensor], Array]:
    """Return the sensors on board, by stream, and the true bias of the yaw gyro."""
    imu, gyro_bias_radps = imu_sensor(motion, robot, rngs["imu"])
    sensors = {
        "wheels": wheel_sensor(motion, robot, rngs["wheels"]),
        "steering": steering_sensor(motion, robot, rngs["steering"]),
        "imu": imu,
        "odometry": camera_sensor(motion, robot, rngs["camera"], faults),
    }
    if gnss is not None:
        sensors["gnss"] = gnss_sensor(motion, gnss, rngs["gnss"], faults)
    for name, sensor in sensors.items():
        sensor.stamp(name, robot.effects)
    return sensors, gyro_bias_radps


def _built(robot: Robot, effects: Mapping[str, float]) -> Robot:
    """Return the robot with all its effects, of which the commanded one lacks some."""
    if not robot.effects and not effects:
        return robot
    acting = checked_effects("effects", {**robot.effects, **effects}, robot.drive)
    n = len(acting)
    extended = replace(robot, effects=acting, effects_cov=np.full((n, n), np.nan))
    return apply_homes(extended, in_plant(Stage.DESCRIPTION))


def _check_motion(rows: Array, robot: Robot) -> None:
    later = ("wheels", "roll_rad", "pitch_rad")
    finite = all(np.isfinite(rows[name]).all() for name in BODY_ROW.names or () if name not in later)
    fastest_radps = float(np.abs(rows["wheels"]["wheel_radps"]).max())
    limit_radps = MAX_WHEEL_SPEEDS * robot.equipment.motors.speed_max_radps
    if not finite or not fastest_radps <= limit_radps:
        raise ConfigError(
            f"robot {robot.name}: its motion cannot be integrated in steps of {STEP_S:g} s; a mass, an "
            "inertia, a stiffness, a gain or the load is out of scale with the rest"
        )


def _labels(rows: Array, scenario: Scenario) -> tuple[Label, ...]:
    """One label a stretch in which all three wheels are on the same ground."""
    patch = rows["wheels"]["patch_ratio"]
    one = np.where((patch == patch[:, :1]).all(axis=1), patch[:, 0], -1)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(one)) + 1, [len(one)]])
    labels: list[Label] = []
    for begin, end in pairwise(edges):
        start_s, end_s = float(begin * STEP_S), float(end * STEP_S)
        if one[begin] >= 0 and end_s - start_s >= MIN_LABEL_S:
            terrain = scenario.patches[int(one[begin])].terrain
            labels.append(Label(round(start_s, 3), round(end_s, 3), terrain))
    return tuple(labels)


class Drive:
    """A plant that is driven on and on, by commands that come into force one after the other.

    Parameters
    ----------
    plant, profile, state, road_noise, rows : as :func:`terrain.simulation.dynamic.step.advance` takes them, for all
        steps
    """

    def __init__(
        self, plant: Array, profile: TerrainProfile, state: Array, road_noise: Array, rows: Array
    ) -> None:
        self._driven, self._state, self._noise, self._rows = (plant, profile, state), state, road_noise, rows
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
            advance(*self._driven, *held)
            self._n_steps = end
        finite = is_finite(self._state)
        if not finite:
            self._rows[self._n_steps :] = filled(BODY_ROW, np.nan)[0]
            self._n_steps = len(self._rows)
        return finite


def _in_loop(
    controller: Callable[[Sample], Command],
    delay_steps: int,
    scenario: Scenario,
    substeps: int,
    drive: Drive,
    motion: Motion,
    sensors: Mapping[str, Sensor],
) -> tuple[Array, dict[str, Array]]:
    """Drive a scenario by a controller, to its last row; return commands (n, 9), and (n,) of their status by name."""
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
        drive.command(step + delay_steps, decided[k, 3:6], decided[k, 6:])
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
