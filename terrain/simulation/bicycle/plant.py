"""A car-like robot as an extended dynamic bicycle, in steps of a millisecond.

With the speed u of the rear axle along the body, the lateral velocity w of the centre of mass, the yaw rate
r, the steering angle d and the roll a of the ground (left side up positive)::

    x' = u cos(yaw) - (w - L_R r) sin(yaw)        m w' = F_F cos d + F_R - m g sin a - m u r
    y' = u sin(yaw) + (w - L_R r) cos(yaw)        I_z r' = L_F F_F cos d - L_R F_R
    F = -mu N (1 - exp(-C |b| / (mu N))) sgn b    N_F = m g cos a L_R / L,  N_R = m g cos a L_F / L
    l t' = v_side - |v_ahead| t,  b = atan t      for each wheel, with the relaxation length l

The side force saturates at the grip mu times the load, less what the drive takes of the friction circle.  The
slip angle b of a tyre follows its contact over the relaxation length: at rest the tyre is a spring, nothing
is divided by a speed, and static friction holds the robot on a slope without creep.  A damping of the
carcass, which fades above 0.5 m/s, brings it to rest.  Speed follows its command at a bounded acceleration
and reaches 0 exactly; the steering is a dead time, a first-order lag, and limits of rate and angle.

The dynamics are (3) of Deremetz et al. 2017 with the sign of line 2 corrected, and forces that saturate
instead of (1).  Relaxation: Pacejka, Tyre and Vehicle Dynamics, chapter 7.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots.bicycle import BicycleRobot

STEP_S = 0.001
"""Length of a step."""
LONGEST_DELAY_S = 0.3
"""Of the dead time of the steering."""

N_OUT = 17
(
    X, Y, YAW, SPEED, SIDE_SPEED, YAW_RATE, STEER, DISTANCE, ROLL, ACCEL_X, ACCEL_Y,
    SLIP_FRONT, SLIP_REAR, SIDE_FRONT, SIDE_REAR, ROLL_RATE, YAW_ACCEL,
) = range(N_OUT)  # fmt: skip
"""Places in the state, SI units: pose of the rear axle, speed along the body, lateral velocity of the centre
of mass, yaw rate, steering angle, distance travelled, roll; acceleration along the body, lateral specific
force of the centre of mass; slip angle of the tyres' carcass and side force of the axles; rates."""

_COUNT = N_OUT
_QUEUE = N_OUT + 1
STATE_SIZE = _QUEUE + round(LONGEST_DELAY_S / STEP_S)

N_NUMBERS = 15
(
    _MASS, _INERTIA, _AHEAD, _BEHIND, _C_FRONT, _C_REAR, _STEER_MAX, _STEER_TAU, _STEER_RATE,
    _DELAY, _ACCEL_MAX, _RELAXATION, _DAMPING, _SPACING, _FADE,
) = range(N_NUMBERS)  # fmt: skip


class Ground(NamedTuple):
    """Ground along the drive.

    Parameters
    ----------
    distance_m : (n,) rising distances travelled; before the first and beyond the last, their values hold
    grip_ratio : (n,) largest side force over load, above 0
    roll_rad : (n,) side slope, left side up positive
    """

    distance_m: Array
    grip_ratio: Array
    roll_rad: Array


def level_ground(grip_ratio: float = 0.7, roll_rad: float = 0.0) -> Ground:
    """Return ground that is the same everywhere.

    Examples
    --------
    >>> level_ground(0.5).grip_ratio
    array([0.5])
    """
    return Ground(np.zeros(1), np.array([grip_ratio]), np.array([roll_rad]))


class PlantSettings(NamedTuple):
    """What a description of a robot does not have.

    Parameters
    ----------
    steering_delay_s : dead time of the steering, up to :data:`LONGEST_DELAY_S`
    acceleration_mps2 : bound of the acceleration of the drive
    relaxation_m : relaxation length of the tyres; about half to once a wheel's radius
    damping_ratio : of the tyre's carcass at rest
    """

    steering_delay_s: float = 0.05
    acceleration_mps2: float = 1.5
    relaxation_m: float = 0.3
    damping_ratio: float = 0.7


_GRID_M = 0.05
_FADE_MPS = 0.5


def plant_numbers(robot: BicycleRobot, settings: PlantSettings) -> Array:
    """Return the parameters (N_NUMBERS,) of :func:`advance`.

    Raises
    ------
    ConfigError
        if a setting is out of its range.
    """
    if not 0.0 <= settings.steering_delay_s <= LONGEST_DELAY_S:
        raise ConfigError(
            f"steering_delay_s is {settings.steering_delay_s:g}, 0 to {LONGEST_DELAY_S:g} s is accepted"
        )
    if not (settings.acceleration_mps2 > 0 and settings.relaxation_m > 0 and settings.damping_ratio >= 0):
        raise ConfigError(
            "acceleration and relaxation length above zero, and a damping from zero, are needed"
        )
    numbers = np.empty(N_NUMBERS)
    numbers[[_MASS, _INERTIA]] = robot.mass_kg, robot.yaw_inertia_kgm2
    numbers[[_AHEAD, _BEHIND]] = robot.com_ahead_m, robot.com_behind_front_m
    numbers[[_C_FRONT, _C_REAR]] = robot.front_cornering_npr, robot.rear_cornering_npr
    numbers[[_STEER_MAX, _STEER_RATE]] = robot.steering_max_rad, robot.steering_rate_radps
    numbers[_STEER_TAU] = robot.steering_time_constant_s
    numbers[_DELAY] = round(settings.steering_delay_s / STEP_S)
    numbers[_ACCEL_MAX], numbers[_RELAXATION] = settings.acceleration_mps2, settings.relaxation_m
    numbers[_DAMPING], numbers[_SPACING], numbers[_FADE] = settings.damping_ratio, _GRID_M, _FADE_MPS
    return numbers


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
    """Return the state (STATE_SIZE,) of a robot that drives straight at a pose."""
    state = np.zeros(STATE_SIZE)
    state[X], state[Y], state[YAW], state[SPEED] = x_m, y_m, yaw_rad, speed_mps
    return state


@njit(cache=True)
def side_force(slip_rad: float, stiffness_npr: float, limit_n: float) -> float:
    """Return the side force of an axle at a slip angle, opposed to it and never over its limit.

    Examples
    --------
    >>> round(side_force(0.001, 15000.0, 1400.0), 1), round(side_force(-1.0, 15000.0, 1400.0))
    (-14.9, 1400)
    """
    return -math.copysign(limit_n * -math.expm1(-stiffness_npr * abs(slip_rad) / limit_n), slip_rad)


@njit(cache=True)
def _axle(
    numbers: Array, slip: float, ahead: float, side: float, stiffness: float, limit: float, mass: float
) -> tuple[float, float]:
    """Return the next slip angle of the carcass, and the side force, of an axle."""
    length, carcass = numbers[_RELAXATION], math.tan(slip)
    carcass = (carcass + STEP_S * side / length) / (1.0 + STEP_S * abs(ahead) / length)
    slides = math.tan(min(8.0 * limit / stiffness, 1.4))
    carcass = min(max(carcass, -slides), slides)
    force = side_force(math.atan(carcass), stiffness, limit)
    damping = 2.0 * numbers[_DAMPING] * math.sqrt(stiffness / length * mass)
    force -= damping * side * math.exp(-((ahead / numbers[_FADE]) ** 2))
    return math.atan(carcass), min(max(force, -limit), limit)


@njit(cache=True)
def _step(numbers: Array, grid: Array, state: Array, steer_command: float, speed_command: float) -> None:
    """Advance the state in place by :data:`STEP_S`."""
    delay, place = int(numbers[_DELAY]), int(state[_COUNT])
    command = steer_command
    if delay > 0:
        command = state[_QUEUE + place]
        state[_QUEUE + place] = steer_command
        state[_COUNT] = (place + 1) % delay
    steer_max, rate = numbers[_STEER_MAX], numbers[_STEER_RATE] * STEP_S
    command = min(max(command, -steer_max), steer_max)
    turn = -math.expm1(-STEP_S / max(numbers[_STEER_TAU], 1e-6)) * (command - state[STEER])
    steer = state[STEER] + min(max(turn, -rate), rate)
    hardest = numbers[_ACCEL_MAX] * STEP_S
    gained = min(max(speed_command - state[SPEED], -hardest), hardest)
    speed = state[SPEED] + gained
    where = min(max(state[DISTANCE] / numbers[_SPACING], 0.0), grid.shape[0] - 1.001)
    cell = int(where)
    grip = grid[cell, 0] + (where - cell) * (grid[cell + 1, 0] - grid[cell, 0])
    roll = grid[cell, 1] + (where - cell) * (grid[cell + 1, 1] - grid[cell, 1])
    mass, ahead, behind = numbers[_MASS], numbers[_AHEAD], numbers[_BEHIND]
    base, press = ahead + behind, GRAVITY_MPS2 * math.cos(roll)
    drive = gained / STEP_S / press
    grip = math.sqrt(max(grip * grip - drive * drive, 0.01 * grip * grip))
    side, turning, cos, sin = state[SIDE_SPEED], state[YAW_RATE], math.cos(steer), math.sin(steer)
    at_front = side + behind * turning
    m_front, m_rear = mass * ahead / base, mass * behind / base
    v_side, v_ahead = at_front * cos - speed * sin, speed * cos + at_front * sin
    front, f_front = _axle(
        numbers, state[SLIP_FRONT], v_ahead, v_side, numbers[_C_FRONT], grip * m_front * press, m_front
    )
    at_rear, c_rear = side - ahead * turning, numbers[_C_REAR]
    rear, f_rear = _axle(numbers, state[SLIP_REAR], speed, at_rear, c_rear, grip * m_rear * press, m_rear)
    f_ahead = f_front * cos
    state[YAW_ACCEL] = (behind * f_ahead - ahead * f_rear) / numbers[_INERTIA]
    state[ACCEL_Y] = (f_ahead + f_rear) / mass
    state[SIDE_SPEED] += STEP_S * (state[ACCEL_Y] - GRAVITY_MPS2 * math.sin(roll) - speed * turning)
    state[YAW_RATE] += STEP_S * state[YAW_ACCEL]
    middle = state[YAW] + 0.5 * STEP_S * state[YAW_RATE]
    at_rear = state[SIDE_SPEED] - ahead * state[YAW_RATE]
    cos, sin = math.cos(middle), math.sin(middle)
    state[X] += STEP_S * (speed * cos - at_rear * sin)
    state[Y] += STEP_S * (speed * sin + at_rear * cos)
    state[YAW] += STEP_S * state[YAW_RATE]
    state[DISTANCE] += STEP_S * math.hypot(speed, at_rear)
    state[SPEED], state[STEER], state[ACCEL_X] = speed, steer, gained / STEP_S
    state[ROLL_RATE], state[ROLL] = (roll - state[ROLL]) / STEP_S, roll
    state[SLIP_FRONT], state[SLIP_REAR] = front, rear
    state[SIDE_FRONT], state[SIDE_REAR] = f_front, f_rear


@njit(cache=True)
def advance(
    numbers: Array, grid: Array, state: Array, steer_rad: float, speed_mps: float, rows: Array, each: int
) -> Array:
    """Return the state after steps under constant commands; compiled, the state is not changed.

    Parameters
    ----------
    numbers : of :func:`plant_numbers`
    grid : of :func:`ground_grid`
    state : (STATE_SIZE,)
    steer_rad, speed_mps : commanded
    rows : (k, N_OUT) that is filled with the state after every ``each`` steps
    each : steps a row

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> numbers = plant_numbers(load_robot("adap2e"), PlantSettings())
    >>> rows = np.empty((200, N_OUT))
    >>> after = advance(numbers, ground_grid(level_ground()), initial_state(), 0.1, 1.0, rows, 10)
    >>> float(after[SPEED]), round(float(after[STEER]), 3)
    (1.0, 0.1)
    """
    after = state.copy()
    for row in range(rows.shape[0]):
        for _ in range(each):
            _step(numbers, grid, after, steer_rad, speed_mps)
        rows[row] = after[:N_OUT]
    return after
