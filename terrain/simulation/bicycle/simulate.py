"""Drives of a car-like robot, with a controller in the loop or open loop, as run logs.

At each tick of the wheels (50 Hz) a controller gets what the sensors measured and the speed that the drive
asks for, and commands a steering angle and a speed; the simulator knows no controller.  Sensors are as on the
robot of Deremetz et al. 2017: receiver and IMU above the middle of the rear axle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS
from terrain.records import Array, RunLog, Stream
from terrain.robots.bicycle import BicycleRobot
from terrain.simulation.bicycle import plant
from terrain.simulation.sensors import BODY_TRUTH
from terrain.slip import slip_angle

TICK_S, FIX_S, TRUTH_S = 0.02, 0.1, 0.01
"""Times between ticks of wheels and steering, between fixes, and between rows of the IMU and of the truth."""

CAR_ROWS: tuple[str, ...] = (
    *("speed_rear_mps", "steer_front_rad", "position_x_m", "position_y_m", "yaw_rad"),
    *("yaw_rate_radps", "roll_rad", "accel_y_mps2"),
)
"""Rows (8,) of :attr:`CarSample.measured`, as observers of sideslip take them."""

TRUTH_CHANNELS: tuple[str, ...] = (
    *BODY_TRUTH,
    *("slip_front_rad", "slip_rear_rad", "side_front_n", "side_rear_n", "steer_front_rad", "distance_m"),
)
"""Channels of the stream ``truth``: ``speed_y_mps``, ``accel_x_mps2`` and the specific force ``accel_y_mps2``
are of the centre of mass, the pose and ``speed_x_mps`` of the rear axle; slip is NaN at rest."""


class SensorNoise(NamedTuple):
    """Standard deviations of white noise of each sample."""

    speed_mps: float = 0.02
    steer_rad: float = 0.002
    gyro_radps: float = 0.003
    accel_mps2: float = 0.1
    tilt_rad: float = 0.003
    position_m: float = 0.02
    yaw_rad: float = 0.005


class SpeedProfile(NamedTuple):
    """Speed along a drive.

    Parameters
    ----------
    speed_mps : away from stops
    stops : (distance travelled in m, time to stand in s) of each, in their order
    """

    speed_mps: float
    stops: tuple[tuple[float, float], ...] = ()


class CarSample(NamedTuple):
    """What a controller is given at a tick.

    Parameters
    ----------
    time_s : of the tick
    measured : (8,) of :data:`CAR_ROWS`; NaN where a sensor gave nothing at this tick
    speed_desired_mps : by the profile, stops included
    """

    time_s: float
    measured: Array
    speed_desired_mps: float


class CarCommand(NamedTuple):
    """What a controller commands; ``finished`` ends the drive."""

    steer_rad: float
    speed_mps: float
    finished: bool = False


Controller = Callable[[CarSample], CarCommand]


class CarDrive(NamedTuple):
    """Where and how a car drives.

    Parameters
    ----------
    ground : along the drive
    profile : of its speed
    duration_s : longest time
    start : (x in m, y in m, yaw in rad) of the rear axle at rest
    """

    ground: plant.Ground
    profile: SpeedProfile
    duration_s: float = 60.0
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)


def open_loop(time_s: Array, steer_rad: Array) -> Controller:
    """Return a controller that plays a steering angle (n,) over time (n,), at the speed of the profile.

    Examples
    --------
    >>> straight = open_loop(np.zeros(1), np.zeros(1))
    >>> straight(CarSample(0.0, np.zeros(8), 2.0))
    CarCommand(steer_rad=0.0, speed_mps=2.0, finished=False)
    """
    return lambda sample: CarCommand(
        float(np.interp(sample.time_s, time_s, steer_rad)), sample.speed_desired_mps
    )


class _Stops:
    """The desired speed of a profile, of what was driven so far."""

    def __init__(self, profile: SpeedProfile, acceleration_mps2: float) -> None:
        self._profile, self._brakes, self._next, self._stood_s = profile, acceleration_mps2, 0, 0.0

    def desired(self, distance_m: float, speed_mps: float) -> float:
        stops = self._profile.stops
        if self._next < len(stops):
            where_m, stand_s = stops[self._next]
            if distance_m + speed_mps**2 / (2 * self._brakes) >= where_m:
                self._stood_s += TICK_S if speed_mps == 0.0 else 0.0
                if self._stood_s <= stand_s:
                    return 0.0
                self._next, self._stood_s = self._next + 1, 0.0
        return self._profile.speed_mps


def simulate_car(
    robot: BicycleRobot,
    drive: CarDrive,
    controller: Controller,
    rng: np.random.Generator,
    noise: SensorNoise = SensorNoise(),  # noqa: B008
    settings: plant.PlantSettings = plant.PlantSettings(),  # noqa: B008
    run_id: str = "car",
) -> RunLog:
    """Drive, and return the log with its truth.

    Parameters
    ----------
    robot : car-like
    drive : ground, speed, duration and start
    controller : called at each tick
    rng : of the noise
    noise : of the sensors
    settings : of the plant
    run_id : of the log

    Raises
    ------
    ConfigError
        if settings, ground or profile are not accepted, or the controller commands no finite numbers.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> drive = CarDrive(plant.level_ground(), SpeedProfile(2.0), duration_s=3.0)
    >>> straight = open_loop(np.zeros(1), np.zeros(1))
    >>> run = simulate_car(load_robot("adap2e"), drive, straight, np.random.default_rng(1))
    >>> sorted(run.streams)
    ['commands', 'compass', 'gnss', 'imu', 'steering', 'truth', 'wheels']
    """
    numbers, grid = plant.plant_numbers(robot, settings), plant.ground_grid(drive.ground)
    profile = drive.profile
    if not 0.0 <= profile.speed_mps <= robot.speed_max_mps:
        raise ConfigError(
            f"speed is {profile.speed_mps:g} m/s, 0 to {robot.speed_max_mps:g} is the robot's range"
        )
    stops, state = _Stops(profile, settings.acceleration_mps2), plant.initial_state(*drive.start)
    per_tick, n_ticks = round(TICK_S / TRUTH_S), max(2, int(drive.duration_s / TICK_S))
    rows = np.empty((1 + n_ticks * per_tick, plant.N_OUT))
    steps = round(TRUTH_S / plant.STEP_S)
    state[plant.ROLL] = grid[0, 1]
    rows[0] = state[: plant.N_OUT]
    ticks, commands = _Measured(rng, noise, n_ticks, robot.com_ahead_m), np.empty((n_ticks, 2))
    for k in range(n_ticks):
        desired = stops.desired(float(state[plant.DISTANCE]), float(state[plant.SPEED]))
        asked = controller(CarSample(k * TICK_S, ticks.measure(k, state), desired))
        if not np.isfinite(asked[:2]).all():
            raise ConfigError(f"the controller commands {asked[:2]} after {k * TICK_S:.2f} s")
        commands[k] = asked[:2]
        part = rows[1 + k * per_tick : 1 + (k + 1) * per_tick]
        state = plant.advance(numbers, grid, state, asked.steer_rad, asked.speed_mps, part, steps)
        if asked.finished and k:
            n_ticks = k + 1
            break
    time_s, measured = np.arange(n_ticks) * TICK_S, ticks.rows[:n_ticks]
    rows = rows[: n_ticks * per_tick]
    fixed = np.isfinite(measured[:, 2])
    streams = {
        "wheels": Stream(time_s, measured[:, :1], ("speed_rear_mps",)),
        "steering": Stream(time_s, measured[:, 1:2], ("angle_front_rad",)),
        "gnss": _gnss(time_s[fixed], measured[fixed], rows[::per_tick][fixed], robot, noise, rng),
        "compass": Stream(time_s[fixed], measured[fixed, 4:5], ("yaw_rad",)),
        "imu": _imu(rows, measured, per_tick, robot, noise, rng),
        "commands": Stream(time_s, commands[:n_ticks], ("steer_front_rad", "speed_x_mps")),
        "truth": _truth(rows, robot),
    }
    return RunLog(run_id, robot.name, streams, source="terrain.simulation.bicycle")


class _Measured:
    """Samples at the ticks; noise is drawn at first, so that it is the same for all controllers."""

    def __init__(
        self, rng: np.random.Generator, noise: SensorNoise, n_ticks: int, com_ahead_m: float
    ) -> None:
        std = [noise.speed_mps, noise.steer_rad, noise.position_m, noise.position_m, noise.yaw_rad]
        std += [noise.gyro_radps, noise.tilt_rad, noise.accel_mps2]
        self.rows, self._ahead = rng.standard_normal((n_ticks, len(CAR_ROWS))) * std, com_ahead_m

    def measure(self, tick: int, state: Array) -> Array:
        row = self.rows[tick]
        row += (
            *(state[plant.SPEED], state[plant.STEER], state[plant.X], state[plant.Y], state[plant.YAW]),
            *(state[plant.YAW_RATE], state[plant.ROLL], _lateral(state, self._ahead)),
        )
        if state[plant.SPEED] == 0.0:
            row[0] = 0.0  # the encoder of a wheel that stands counts nothing
        row[4] = wrapped(float(row[4]))
        if tick % round(FIX_S / TICK_S):
            row[2:5] = np.nan
        return np.array(row)


def _lateral(rows: Array, com_ahead_m: float) -> Array:
    """Return the lateral specific force above the rear axle."""
    return np.asarray(rows[..., plant.ACCEL_Y] - com_ahead_m * rows[..., plant.YAW_ACCEL])


def _rear_velocity(rows: Array, robot: BicycleRobot) -> Array:
    """Return the velocity (n, 2) of the rear axle, ahead and to the left."""
    return np.column_stack(
        [rows[:, plant.SPEED], rows[:, plant.SIDE_SPEED] - robot.com_ahead_m * rows[:, plant.YAW_RATE]]
    )


def _truth(rows: Array, robot: BicycleRobot) -> Stream:
    ahead, left = _rear_velocity(rows, robot).T
    at_front, steer = left + robot.wheelbase_m * rows[:, plant.YAW_RATE], rows[:, plant.STEER]
    cos, sin = np.cos(steer), np.sin(steer)
    columns = [
        *(rows[:, plant.X], rows[:, plant.Y], wrapped(rows[:, plant.YAW]), rows[:, plant.ROLL]),
        *(0.0 * ahead, ahead, rows[:, plant.SIDE_SPEED], rows[:, plant.YAW_RATE]),
        *(rows[:, plant.ACCEL_X], rows[:, plant.ACCEL_Y]),
        slip_angle(ahead * cos + at_front * sin, at_front * cos - ahead * sin),
        slip_angle(ahead, left),
        *(rows[:, plant.SIDE_FRONT], rows[:, plant.SIDE_REAR], steer, rows[:, plant.DISTANCE]),
    ]
    return Stream(np.arange(len(rows)) * TRUTH_S, np.column_stack(columns), TRUTH_CHANNELS)


def _imu(
    rows: Array,
    measured: Array,
    per_tick: int,
    robot: BicycleRobot,
    noise: SensorNoise,
    rng: np.random.Generator,
) -> Stream:
    """Return gyro, specific force and attitude; at the ticks they are what the controller got."""
    std = np.repeat([noise.gyro_radps, noise.accel_mps2, noise.tilt_rad], 3)
    values = rng.standard_normal((len(rows), len(IMU_CHANNELS))) * std
    roll = rows[:, plant.ROLL]
    values[:, 0] += rows[:, plant.ROLL_RATE]
    values[:, 2] += rows[:, plant.YAW_RATE]
    values[:, 3] += rows[:, plant.ACCEL_X] - rows[:, plant.SIDE_SPEED] * rows[:, plant.YAW_RATE]
    values[:, 4] += _lateral(rows, robot.com_ahead_m)
    values[:, 5] += GRAVITY_MPS2 * np.cos(roll)
    values[:, 6] += roll
    values[:, 8] = wrapped(values[:, 8] + rows[:, plant.YAW])
    values[::per_tick, [2, 6, 4]] = measured[:, 5:]
    return Stream(np.arange(len(rows)) * TRUTH_S, values, IMU_CHANNELS)


def _gnss(
    time_s: Array,
    measured: Array,
    rows: Array,
    robot: BicycleRobot,
    noise: SensorNoise,
    rng: np.random.Generator,
) -> Stream:
    """Return fixes: positions as the controller got them, velocity over ground, their accuracy."""
    ahead, left = _rear_velocity(rows, robot).T
    cos, sin = np.cos(rows[:, plant.YAW]), np.sin(rows[:, plant.YAW])
    velocity = np.column_stack([cos * ahead - sin * left, sin * ahead + cos * left])
    velocity += rng.standard_normal(velocity.shape) * noise.position_m / FIX_S
    known = np.ones((len(rows), 1))
    values = np.column_stack([measured[:, 2:4], velocity, noise.position_m * known, known])
    return Stream(time_s, values, GNSS_CHANNELS)
