"""An extended dynamic bicycle in steps of a millisecond, and one run of a car-like robot with its controller.

At each tick of the wheels (50 Hz) a controller gets what the sensors measured and the speed that the drive asks for,
and commands a steering angle and a speed; the plant knows no controller.  Sensors are as on the robot of Deremetz et
al. 2017: receiver and IMU above the middle of the rear axle.

With the speed u of the rear axle along the body, the lateral velocity w of the centre of mass, the yaw rate r, the
steering angle d and the roll a of the ground (left side up positive)::

    x' = u cos(yaw) - (w - L_R r) sin(yaw)        m w' = F_F cos d + F_R - m g sin a - m u r
    y' = u sin(yaw) + (w - L_R r) cos(yaw)        I_z r' = L_F F_F cos d - L_R F_R
    F = -mu N (1 - exp(-C |b| / (mu N))) sgn b    N_F = m g cos a L_R / L,  N_R = m g cos a L_F / L
    l t' = v_side - |v_ahead| t,  b = atan t      for each wheel, with the relaxation length l

The side force saturates at the grip mu times the load, less what the drive takes of the friction circle.  The slip
angle b of a tyre follows its contact over the relaxation length: at rest the tyre is a spring, nothing is divided by
a speed, and static friction holds the robot on a slope without creep.  A damping of the carcass, which fades above
0.5 m/s, brings it to rest.  Speed follows its command at a bounded acceleration and reaches 0 exactly; the steering
is a dead time, a first-order lag, and limits of rate and angle.

The dynamics are (3) of Deremetz et al. 2017 with the sign of line 2 corrected, and forces that saturate instead of (1).
Relaxation: Pacejka, Tyre and Vehicle Dynamics, chapter 7.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.kernels import filled, inner, njit, numbers, record
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS
from terrain.records import Array, Label, Stream
from terrain.robots import BicycleRobot, Robot, as_drive
from terrain.simulation.scenario import Conditions
from terrain.simulation.sensors import BODY, fixes, imu_values, tilted_imu, truth_stream
from terrain.slip import slip_angle

STEP_S, LONGEST_DELAY_S = 0.001, 0.3  # length of a step, and the longest dead time of the steering
# Times between ticks of wheels and steering, between fixes, and between rows of the IMU and of the truth.
TICK_S, FIX_S, TRUTH_S = 0.02, 0.1, 0.01

CAR_ROWS: tuple[str, ...] = (
    *("speed_rear_mps", "steer_front_rad", "position_x_m", "position_y_m", "yaw_rad"),
    *("yaw_rate_radps", "roll_rad", "accel_y_mps2"),
)
"""Rows (8,) of :attr:`CarSample.measured`, as observers of sideslip take them."""

_MEASURED = ("speed_mps", "steer_rad", *CAR_ROWS[2:7])

CAR = record(
    numbers(
        "mass_kg yaw_inertia_kgm2 com_ahead_m com_behind_front_m front_cornering_npr "
        "rear_cornering_npr steering_max_rad steering_rate_radps steering_time_constant_s "
        "acceleration_mps2 relaxation_m damping_ratio"
    )
    | {"delay_steps": int}
)
"""A robot with its :data:`SETTINGS`."""

CAR_BODY = record(
    numbers(
        "position_x_m position_y_m yaw_rad speed_mps side_speed_mps yaw_rate_radps steer_rad "
        "distance_m roll_rad accel_x_mps2 accel_y_mps2 slip_front_rad slip_rear_rad side_front_n "
        "side_rear_n roll_rate_radps yaw_accel_radps2"
    )
)
"""Pose of the rear axle, speed along the body, lateral velocity of the centre of mass, yaw rate, steering angle,
distance travelled, roll; acceleration along the body, lateral specific force of the centre of mass; slip angle of the
tyres' carcass and side force of the axles; rates."""

# A body, and the commands of the steering that are still to come.
CAR_STATE = record({"body": CAR_BODY, "place": int, "commands_rad": (float, round(LONGEST_DELAY_S / STEP_S))})


class Ground(NamedTuple):
    """Ground along the drive."""

    # (n,) rising distances travelled; before the first and beyond the last, their values hold
    distance_m: Array
    grip_ratio: Array  # (n,) largest side force over load, above 0
    roll_rad: Array  # (n,) side slope, left side up positive


def level_ground(grip_ratio: float = 0.7, roll_rad: float = 0.0) -> Ground:
    """Return ground that is the same everywhere."""
    return Ground(np.zeros(1), np.array([grip_ratio]), np.array([roll_rad]))


# What a description of a robot does not have: bound of the acceleration of the drive, relaxation length of the tyres
# (about half to once a wheel's radius), damping of the tyre's carcass at rest, dead time of the steering in steps.
SETTINGS = {"acceleration_mps2": 1.5, "relaxation_m": 0.3, "damping_ratio": 0.7, "delay_steps": 50}
_GRID_M, _FADE_MPS = 0.05, 0.5


def car_record(robot: BicycleRobot, **changed: float) -> Array:
    """Return the parameters of :func:`advance`, (1,) of :data:`CAR`, with changed :data:`SETTINGS`, if any."""
    described = {name: getattr(robot, name) for name in CAR.names or () if hasattr(robot, name)}
    return filled(CAR, **(described | SETTINGS | changed))


def ground_grid(ground: Ground) -> Array:
    """Return grip and roll (n, 2) on the grid that :func:`advance` looks them up on.

    Raises
    ------
    ConfigError
        if arrays differ in length, distances do not rise, or grip or roll cannot be.
    """
    distance, grip, roll = (np.atleast_1d(np.asarray(values, float)) for values in ground)
    if not distance.shape == grip.shape == roll.shape or distance.ndim != 1 or not distance.size:
        raise ConfigError("ground: distance, grip and roll are needed in equal numbers")
    if not np.isfinite([distance, grip, roll]).all() or (np.diff(distance) <= 0).any():
        raise ConfigError("ground: distances have to rise, and all numbers to be finite")
    if grip.min() <= 0 or np.abs(roll).max() > np.deg2rad(45.0):
        raise ConfigError("ground: a grip above 0 and a roll of at most 45 degrees are accepted")
    at = np.arange(0.0, max(distance[-1], 0.0) + 2 * _GRID_M, _GRID_M)
    return np.column_stack([np.interp(at, distance, grip), np.interp(at, distance, roll)])


def initial_state(x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float = 0.0, speed_mps: float = 0.0) -> Array:
    """Return the state, (1,) of :data:`CAR_STATE`, of a robot that drives straight at a pose."""
    body = filled(CAR_BODY, position_x_m=x_m, position_y_m=y_m, yaw_rad=yaw_rad, speed_mps=speed_mps)
    return filled(CAR_STATE, body=body)


@njit
def side_force(slip_rad: float, stiffness_npr: float, limit_n: float) -> float:
    """Return the side force of an axle at a slip angle, opposed to it and never over its limit.

    Examples
    --------
    >>> round(side_force(0.001, 15000.0, 1400.0), 1), round(side_force(-1.0, 15000.0, 1400.0))
    (-14.9, 1400)
    """
    return -math.copysign(limit_n * -math.expm1(-stiffness_npr * abs(slip_rad) / limit_n), slip_rad)


@inner
def _axle(
    car: Any, slip: float, ahead: float, side: float, stiffness: float, limit: float, mass: float
) -> tuple[float, float]:
    """Return the next slip angle of the carcass, and the side force, of an axle."""
    length, carcass = car.relaxation_m, math.tan(slip)
    carcass = (carcass + STEP_S * side / length) / (1.0 + STEP_S * abs(ahead) / length)
    slides = math.tan(min(8.0 * limit / stiffness, 1.4))
    carcass = min(max(carcass, -slides), slides)
    force = side_force(math.atan(carcass), stiffness, limit)
    damping = 2.0 * car.damping_ratio * math.sqrt(stiffness / length * mass)
    force -= damping * side * math.exp(-((ahead / _FADE_MPS) ** 2))
    return math.atan(carcass), min(max(force, -limit), limit)


@inner
def step(car: Any, grid: Array, state: Any, steer_command: float, speed_command: float) -> None:
    """Advance the state in place by :data:`STEP_S`."""
    body, command = state.body, steer_command
    if car.delay_steps > 0:
        command = state.commands_rad[state.place]
        state.commands_rad[state.place] = steer_command
        state.place = (state.place + 1) % car.delay_steps
    steer_max, rate = car.steering_max_rad, car.steering_rate_radps * STEP_S
    command = min(max(command, -steer_max), steer_max)
    turn = -math.expm1(-STEP_S / max(car.steering_time_constant_s, 1e-6)) * (command - body.steer_rad)
    steer = body.steer_rad + min(max(turn, -rate), rate)
    hardest = car.acceleration_mps2 * STEP_S
    gained = min(max(speed_command - body.speed_mps, -hardest), hardest)
    speed = body.speed_mps + gained
    where = min(max(body.distance_m / _GRID_M, 0.0), grid.shape[0] - 1.001)
    cell = int(where)
    grip = grid[cell, 0] + (where - cell) * (grid[cell + 1, 0] - grid[cell, 0])
    roll = grid[cell, 1] + (where - cell) * (grid[cell + 1, 1] - grid[cell, 1])
    mass, ahead, behind = car.mass_kg, car.com_ahead_m, car.com_behind_front_m
    base, press = ahead + behind, GRAVITY_MPS2 * math.cos(roll)
    drive = gained / STEP_S / press
    grip = math.sqrt(max(grip * grip - drive * drive, 0.01 * grip * grip))
    side, turning, cos, sin = body.side_speed_mps, body.yaw_rate_radps, math.cos(steer), math.sin(steer)
    at_front = side + behind * turning
    m_front, m_rear = mass * ahead / base, mass * behind / base
    v_side, v_ahead = at_front * cos - speed * sin, speed * cos + at_front * sin
    front, f_front = _axle(
        car, body.slip_front_rad, v_ahead, v_side, car.front_cornering_npr, grip * m_front * press, m_front
    )
    at_rear, c_rear = side - ahead * turning, car.rear_cornering_npr
    rear, f_rear = _axle(car, body.slip_rear_rad, speed, at_rear, c_rear, grip * m_rear * press, m_rear)
    f_ahead = f_front * cos
    body.yaw_accel_radps2 = (behind * f_ahead - ahead * f_rear) / car.yaw_inertia_kgm2
    body.accel_y_mps2 = (f_ahead + f_rear) / mass
    body.side_speed_mps += STEP_S * (body.accel_y_mps2 - GRAVITY_MPS2 * math.sin(roll) - speed * turning)
    body.yaw_rate_radps += STEP_S * body.yaw_accel_radps2
    middle = body.yaw_rad + 0.5 * STEP_S * body.yaw_rate_radps
    at_rear = body.side_speed_mps - ahead * body.yaw_rate_radps
    cos, sin = math.cos(middle), math.sin(middle)
    body.position_x_m += STEP_S * (speed * cos - at_rear * sin)
    body.position_y_m += STEP_S * (speed * sin + at_rear * cos)
    body.yaw_rad += STEP_S * body.yaw_rate_radps
    body.distance_m += STEP_S * math.hypot(speed, at_rear)
    body.speed_mps, body.steer_rad, body.accel_x_mps2 = speed, steer, gained / STEP_S
    body.roll_rate_radps, body.roll_rad = (roll - body.roll_rad) / STEP_S, roll
    body.slip_front_rad, body.slip_rear_rad = front, rear
    body.side_front_n, body.side_rear_n = f_front, f_rear


@njit
def advance(
    car: Array, grid: Array, state: Array, steer_rad: float, speed_mps: float, rows: Array, each: int
) -> None:
    """Advance the state in place under constant commands; the rows (k,) are the body after every ``each`` steps.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> car, state = car_record(load_robot("adap2e")), initial_state()
    >>> rows = np.empty(200, CAR_BODY)
    >>> advance(car, ground_grid(level_ground()), state, 0.1, 1.0, rows, 10)
    >>> float(state["body"]["speed_mps"][0]), round(float(state["body"]["steer_rad"][0]), 3)
    (1.0, 0.1)
    """
    for row in range(rows.shape[0]):
        for _ in range(each):
            step(car[0], grid, state[0], steer_rad, speed_mps)
        rows[row] = state[0].body


# Standard deviations of white noise of each sample: of the IMU's rates, force and tilt, of fixes and compass, and of
# speed and steering.
GYRO_RADPS, ACCEL_MPS2, TILT_RAD, FIX_M, COMPASS_RAD = 0.003, 0.1, 0.003, 0.02, 0.005
SPEED_MPS, STEER_RAD = 0.02, 0.002


class CarDrive(NamedTuple):
    """How a car is driven."""

    speed_mps: float  # away from stops
    # (distance travelled in m, time to stand in s) of each, in their order
    stops: tuple[tuple[float, float], ...] = ()
    duration_s: float = 60.0  # longest time
    # (x in m, y in m, yaw in rad) of the rear axle at rest
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)


class CarSample(NamedTuple):
    """What a controller is given at a tick."""

    time_s: float  # of the tick
    measured: Array  # (8,) of :data:`CAR_ROWS`; NaN where a sensor gave nothing at this tick
    speed_desired_mps: float  # by the drive, stops included


class CarCommand(NamedTuple):
    """What a controller commands; ``finished`` ends the drive."""

    steer_rad: float
    speed_mps: float
    finished: bool = False


Controller = Callable[[CarSample], CarCommand]


def run_car(
    robot: Robot,
    drive: CarDrive,
    ground: Ground,
    seed: int | np.random.SeedSequence,
    *,
    conditions: Conditions,
    effects: Mapping[str, float],
    controller: Controller,
) -> tuple[dict[str, Stream], tuple[Label, ...]]:
    """Return streams and labels of a drive, for :func:`terrain.simulation.run.simulate`, which describes the rest.

    Noise of the ticks is drawn at first, so that it is the same for all controllers.

    Raises
    ------
    ConfigError
        if ground or speed are not accepted, there are conditions or effects, or the controller commands no
        finite numbers.
    """
    robot = as_drive(BicycleRobot, robot, "robot {name}: drive {drive!r} is no car for this ground")
    if effects or conditions != Conditions():
        raise ConfigError(
            f"robot {robot.name}: on ground along its drive it has neither conditions nor effects"
        )
    car, grid, rng = car_record(robot), ground_grid(ground), np.random.default_rng(seed)
    if not 0.0 <= drive.speed_mps <= robot.speed_max_mps:
        raise ConfigError(
            f"speed is {drive.speed_mps:g} m/s, 0 to {robot.speed_max_mps:g} is the robot's range"
        )
    state, stops, stood_s = initial_state(*drive.start), list(drive.stops), 0.0
    per_tick, n_ticks = round(TICK_S / TRUTH_S), max(2, int(drive.duration_s / TICK_S))
    rows, steps, body = np.empty(1 + n_ticks * per_tick, CAR_BODY), round(TRUTH_S / STEP_S), state["body"][0]
    body["roll_rad"] = grid[0, 1]
    rows[0] = body
    std = [SPEED_MPS, STEER_RAD, FIX_M, FIX_M, COMPASS_RAD, GYRO_RADPS, TILT_RAD, ACCEL_MPS2]
    measured, commands = rng.standard_normal((n_ticks, len(CAR_ROWS))) * std, np.empty((n_ticks, 2))

    def lateral(of: Array) -> Array:
        """Return the lateral specific force above the rear axle."""
        return np.asarray(of["accel_y_mps2"] - robot.com_ahead_m * of["yaw_accel_radps2"])

    for k in range(n_ticks):
        desired, speed = drive.speed_mps, float(body["speed_mps"])
        if stops and body["distance_m"] + speed**2 / (2 * SETTINGS["acceleration_mps2"]) >= stops[0][0]:
            stood_s += TICK_S if speed == 0.0 else 0.0
            if stood_s <= stops[0][1]:
                desired = 0.0
            else:
                stops, stood_s = stops[1:], 0.0
        row = measured[k]
        row += (*(body[name] for name in _MEASURED), lateral(body))
        row[0] = row[0] if speed else 0.0  # the encoder of a wheel that stands counts nothing
        row[4] = wrapped(float(row[4]))
        if k % round(FIX_S / TICK_S):
            row[2:5] = np.nan
        asked = controller(CarSample(k * TICK_S, row.copy(), desired))
        if not np.isfinite(asked[:2]).all():
            raise ConfigError(f"the controller commands {asked[:2]} after {k * TICK_S:.2f} s")
        commands[k] = asked[:2]
        part = rows[1 + k * per_tick : 1 + (k + 1) * per_tick]
        advance(car, grid, state, asked.steer_rad, asked.speed_mps, part, steps)
        if asked.finished and k:
            n_ticks = k + 1
            break
    time_s, measured, rows = np.arange(n_ticks) * TICK_S, measured[:n_ticks], rows[: n_ticks * per_tick]
    truth_s, none = np.arange(len(rows)) * TRUTH_S, np.zeros(len(rows))
    turn, roll = rows["yaw_rate_radps"], rows["roll_rad"]
    at_rear = np.zeros(len(rows), BODY)
    for name in set(BODY.names or ()) & set(CAR_BODY.names or ()):
        at_rear[name] = rows[name]
    at_rear["speed_x_mps"] = ahead = rows["speed_mps"]
    at_rear["speed_y_mps"] = left = rows["side_speed_mps"] - robot.com_ahead_m * turn
    fixed = np.isfinite(measured[:, 2])
    noise = rng.standard_normal((int(fixed.sum()), 2)) * FIX_M / FIX_S
    located = fixes(at_rear[::per_tick][fixed], np.hstack([np.zeros_like(noise), noise]), FIX_M)
    located[:, :2] = measured[fixed, 2:4]
    pushed = rows["accel_x_mps2"] - rows["side_speed_mps"] * turn, lateral(rows) - GRAVITY_MPS2 * np.sin(roll)
    true = tilted_imu(
        np.column_stack([rows["roll_rate_radps"], none, turn]),
        np.column_stack(pushed),
        np.column_stack([roll, none, rows["yaw_rad"]]),
    )
    drawn = rng.standard_normal((len(rows), 9)) * np.repeat([GYRO_RADPS, ACCEL_MPS2, TILT_RAD], 3)
    imu = imu_values(true, 1.0, 0.0, drawn)
    imu[::per_tick, [2, 6, 4]] = measured[:, 5:]  # at the ticks what the controller got
    at_front, cos, sin = left + robot.wheelbase_m * turn, np.cos(rows["steer_rad"]), np.sin(rows["steer_rad"])
    # pose and speed ahead are of the rear axle, all else of the centre of mass, slip NaN at rest
    more = {
        "yaw_rad": wrapped(rows["yaw_rad"]),
        "speed_y_mps": rows["side_speed_mps"],
        "slip_front_rad": slip_angle(ahead * cos + at_front * sin, at_front * cos - ahead * sin),
        "slip_rear_rad": slip_angle(ahead, left),
        **{name: rows[name] for name in ("side_front_n", "side_rear_n")},
        "steer_front_rad": rows["steer_rad"],
        "distance_m": rows["distance_m"],
    }
    streams = {
        "wheels": Stream(time_s, measured[:, :1], ("speed_rear_mps",)),
        "steering": Stream(time_s, measured[:, 1:2], ("angle_front_rad",)),
        "gnss": Stream(time_s[fixed], located, GNSS_CHANNELS),
        "compass": Stream(time_s[fixed], measured[fixed, 4:5], ("yaw_rad",)),
        "imu": Stream(truth_s, imu, IMU_CHANNELS),
        "commands": Stream(time_s, commands[:n_ticks], ("steer_front_rad", "speed_x_mps")),
        "truth": truth_stream(truth_s, at_rear, (), {}, more),
    }
    return streams, ()
