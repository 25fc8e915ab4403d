r"""Slip of a robot of any drive, from whatever measures its motion: satellites, poses, a camera or a lidar.

The body moves with V = (v_x, v_y, w) at its origin, heading psi.  Row i of the wheels, with the direction and place of
a wheel in :math:`D_i` (:func:`terrain.kinematics.wheels.rolling_matrix`), its circumferential speed :math:`u_i` and the
root mean square U of all of them, is

.. math:: D_i V = u_i (1 - m_i) - \chi\, t_i - c |u_i| \dot u_i - d_i U .

- **m**, the slip of this ground, of each side of a robot that skids and each wheel that rolls across, else of all
  wheels: a random walk while the robot moves, the same forward and backward, and through standstill.
- **chi**, what is lost in turning.  Robots that skid: :math:`t = \mp (u_r - u_l) / 2` left and right, so that straight
  motion does not show it, m counts the less the tighter the turn is, and in a turn on the spot the effective track is
  :math:`B / (1 - \chi)` (Mandow et al., Experimental kinematics for wheeled skid-steer mobile robots, IROS 2007).
  Robots that steer: a row across the front wheel, which does not slide, with :math:`t = u \sin \delta`, so that chi is
  what understeer takes of the curvature.
- **c**, the slip that traction takes, by an acceleration of the wheels: of the order of 0.05 on asphalt and 0.2 on sand
  for 1 m/s^2, as the slope of a traction curve is.
- **d**, what slip deviates by for moments, as traction and turning change: forgotten within :data:`FAST_S`, with a
  deviation that grows with the acceleration of the wheels and how tight the turn is.

So slip is linear in V, m, chi, c and d at every speed, singular nowhere, and a wheel that stands says that the ground
stands below it, and nothing of its slip.  The slip ratio that comes out is that of its definition, of :math:`u_i` and
:math:`D_i V` (:mod:`terrain.slip`).

The speed ahead follows the accelerometer where there is one, without gravity by the measured pitch, with a bias that
walks; sideways speed of robots that cannot drive sideways returns to 0.  A gyro measures w and its bias.

**Ages.**  A fix is of an instant before its tick.  It is not moved to it: what the filter expects of it is that of its
own instant, by its state, so that a receiver that is late leaves no error in the speed to first order.

**Scatter of poses and wheel speeds.**  Nothing states it, and it differs by a hundred between systems: it is that of
third differences of four samples that follow each other evenly, over the root of 20, their gain on white noise; motion
adds its jerk times the cube of the period.

**Frames.**  Poses and satellites are each of a frame of their own: the filter stays in the one that it began in, and
takes the other where that one has been silent for :data:`LOST_S`.

**Jumps.**  A pose or position that is rejected for :data:`terrain.estimation.filter.REOPEN_AFTER_S` is elsewhere: the
position follows it, and speed and slip stay as they are, which what positions change by from there on measures.

**Heading.**  Without pose or compass the heading follows from the motion.  Until it is known the filter runs in a frame
that begins at 0; the angle between the travel by wheels and gyro and that of the receiver, and its deviation, then turn
it to the receiver's frame: fixes are used from there on.  Driving backward is no exception.

**What is not observed.**  Slip is NaN before the first reference of the speed over ground, and where its standard
deviation passes :data:`UNKNOWN_RATIO`: then nothing is known of it.  Without a reference m walks on, so that slip of
the ground is remembered through standstill and over seconds without one, with a deviation that grows.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.estimation.feed import FLOAT_STD_M
from terrain.estimation.filter import (
    GATE_PROBABILITY,
    LARGEST,
    LONGEST_GAP_S,
    REOPEN_AFTER_S,
    FilterModel,
    FilterSettings,
    differentiate,
)
from terrain.estimation.models.observer import FilterObserver, ObserverOutput, ObserverStatus
from terrain.estimation.stuck import Turns, next_turns
from terrain.estimation.wheel_slip import wheel_speed_scatter_mps
from terrain.kernels import njit
from terrain.kinematics.wheels import rolling_matrix
from terrain.records import Array
from terrain.robots import BicycleRobot, Robot
from terrain.slip import MIN_SPEED_MPS, slip_ratio

FAST_S, ACROSS_S = 0.5, 5.0
"""Over which d, and sideways speed of a robot that cannot drive sideways, are forgotten."""
FAST_RATIO, FAST_PER_MPS2, FAST_TURNING = 0.01, 0.12, 0.06
"""Standard deviation of d in steady straight motion; what an acceleration of the wheels of 1 m/s^2, a tenth of the
weight in traction, adds; and what turning on the spot does."""
STEEPER_RATIO = 0.2
"""m at which the same acceleration takes twice the slip: traction curves flatten."""
PULL_PER_MPS2, PULL_STD_PER_MPS2, PULL_WALK = 0.1, 0.1, 0.01
"""Of c at first: from asphalt to sand; and its walk within a second of driving."""
YIELDING_RATIO = 0.3
"""Length over the radius of a wheel that it rolls from rest until the contact pulls: tyre and soil yield first, a track
and a gear have slack; d is then of the order of 1."""
FIRST_RATIO, SLOW_RATIO, SLOW_WALK = 0.5, 0.2, 0.015
"""Of m at first, about 0, when it may be up to 1; that up to which it walks, and its walk in a second of driving."""
TURN_WALK, GYRO_TURN_WALK, DIRECTION_RATIO = 0.02, 0.1, 0.1
"""Walk of chi within a second of turning, and that of a robot that skids beside a gyro, whose bias wheels that slip
would pull; and deviation of m where the wheels begin to turn otherwise, in reverse or about a tighter turn, by a radian
in the space of their speeds; half of m adds to it: what slips uphill may not slip back down."""
SLOPE_RATIO2, SLOPE_S = 0.1, 1.0
"""Variance of m for a slope that changes by 1: a tenth of slope is a deviation of a tenth, as on loam; its low-pass."""
LEAST_CHANGE = 0.03
"""Least change of slope and of how the wheels turn, in radians: what is less is noise, which would add up."""
ACROSS_RATIO, ACROSS_M = 0.03, 0.05
"""Sideways speed over the speed of the wheels, and over the yaw rate: of a robot that skids, and in turns."""
WHEEL_STD_MPS, LEAST_WHEEL_STD_MPS, REST_STD_MPS, GYRO_STD_RADPS, YAW_ACCEL = 0.01, 0.006, 0.001, 0.005, 1.0
"""Of a wheel's speed at first and at least, of the ground's below wheels that stand, and of a gyro's rate; walk of the
yaw rate within a second."""
APART_STDS = 2.0
"""Deviation of the sides of a robot that skids, over what they differ by from the gyro: a robot that begins to turn
follows its wheels late, and by wheels that spin the gyro's bias would run off."""
BIAS_STD_RADPS, BIAS_WALK = 0.005, 2e-4
ACCEL_WALK, FREE_WALK = 0.02, 1.0
"""Walk of the speed within a second beside an accelerometer, to which its vibration adds as white noise, and without
one."""
ACCEL_BIAS_STD, TILTED_WALK, UNTILTED_WALK = 0.6, 0.05, 0.3
"""Of the accelerometer's bias at first, and its walk within a second with a measured pitch, and without one, where it
is the slope's gravity."""
POSE_STD_M, POSE_STD_RAD, COMPASS_STD_RAD, CAMERA_STD_MPS, GNSS_SPEED_STD_MPS = 0.02, 0.02, 0.05, 0.03, 0.03
"""Of measurements whose own deviation is not given; of poses at first."""
LEAST_POSE_STD_M, LEAST_POSE_STD_RAD = 5e-4, 5e-4
N_POSES, N_SPEEDS, N_REMEMBERED = 5, 100, 100
"""Of what scatters: how many samples the first value counts as, and how many are remembered."""
DELAY_S, DELAY_STD_S, KNOWN_STD_S = 0.07, 0.07, 0.02
"""Of fixes behind their stamps, at first: some are stamped when they are measured, some when they arrive; and deviation
of one that a description has by logs."""
ALIGNED_RAD, CRAB_RAD, LOST_RAD = 0.05, 0.05, 0.6
"""Deviation at which a heading by the motion is used; that of the motion from the heading; and one that is lost."""
LEAST_TRAVEL_M = 0.5
"""Least travel by the wheels that shows a heading."""
DELAY_BOUNDS_S, SLIP_BOUNDS, LARGEST_BIAS_MPS2 = (-0.2, 0.8), (-3.0, 3.0), 3.0
"""Bounds of delay and of m, chi and d, far from what they are, which move the mean; and a bias beyond which an
accelerometer is left out: its units or axes are others."""
JUMP_M = 10.0
"""How far a pose that is matched elsewhere, or a receiver by other satellites, may jump."""
OLDEST_S = 1.0
"""Age of a fix beyond which there is none."""
LOST_S, LOST_RATIO = 2.0, 0.9
"""Time without a reference, and slip of all wheels, from which on the filter begins anew."""
PREDICTED_S = 0.5
"""Time without a reference from which on slip is predicted."""
UNKNOWN_RATIO = 0.25
"""Standard deviation of a slip that is not known."""
LEAST_MPS, STANDING_MPS, VIBRATION_S, CHANGE_S, MEAN_S = 0.2, 0.01, 0.3, 0.1, 0.2
"""Least speed that shows a heading, that of wheels that stand; low-passes of vibration, of how the wheels' speeds
change, and of what their slip is multiplied by, which has two in a row."""
LEAST_SLOW = 0.01
"""Of m, below which it does not matter how far behind what it is multiplied by is."""
N_JUDGED = 7
"""Number of sensors beside the wheels: the status tells what becomes of these alone."""
MOST_MPS, MOST_RADPS, MOST_MPS2 = 60.0, 30.0, 100.0
"""More than wheels, gyro and accelerometer of a ground robot measure."""

_MOTION = (
    *("position_x_m", "position_y_m", "yaw_rad", "speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
    *("gyro_bias_radps", "accel_bias_x_mps2", "gnss_delay_s", "pose_delay_s"),
)
_X, _Y, _YAW, _VX, _VY, _W, _GYRO_BIAS, _ACCEL_BIAS, _GNSS_DELAY, _POSE_DELAY, _SLOW = range(11)
MOST_ROWS = 6  # of a swerve robot: along and across each wheel
# Places in `params`: counts and levers, the slow state of each row; and as inputs D, u, its mean, t, |u| du/dt,
# U, the acceleration, ages.
_N_ROWS, _N_SLOW, _TURNS, _FREE_ACROSS, _ANTENNA, _POSED, _SEEN, _GROUP = 0, 1, 2, 3, 4, 6, 8, 10
_D = _GROUP + MOST_ROWS
_U, _S, _T, _PULL, _SIZE = (_D + k * MOST_ROWS for k in (3, 4, 5, 6, 7))
_ACCEL, _MEAN_ACCEL, _AGES = _SIZE + 1, _SIZE + 2, _SIZE + 3
_SPEEDS, _SMOOTH, _TURNING, _PULLING = (
    slice(a - _D, a - _D + MOST_ROWS) for a in (_U, _S, _T, _PULL)
)  # of the inputs
_INPUTS = (
    *(f"d_{i}" for i in range(3 * MOST_ROWS)),
    *(f"{name}_{i}" for name in "ustp" for i in range(MOST_ROWS)),
    *("size", "accel", "mean_accel", "gnss_age", "pose_age", "camera_age"),
)

_REFERENCES = (
    *("gnss_x_m", "gnss_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps"),
    *("pose_x_m", "pose_y_m", "pose_yaw_rad", "compass_rad", "camera_x_mps", "camera_y_mps"),
)
# Row that begins to measure, state, names in a description.
_DELAYS: tuple[tuple[int, int, tuple[str, ...]], ...] = (
    (0, _GNSS_DELAY, ("gnss_delay_s",)),
    (2, _GNSS_DELAY, ("gnss_delay_s",)),
    (4, _POSE_DELAY, ("pose_delay_s", "lidar_delay_s")),
    (8, _POSE_DELAY, ("odometry_delay_s", "lidar_delay_s")),
)
# Places among the references of satellites with a compass, and of poses.
_OF_FIXES, _OF_POSES = [0, 1, 2, 3, 7], [4, 5, 6]
_AGE_ROWS = ("gnss_age_s", "pose_age_s", "camera_age_s")
_INERTIAL = ("yaw_rate_radps", "accel_x_mps2", "pitch_rad")


@njit
def _move(x: Array, dt: float, params: Array, x_next: Array) -> None:
    accel = params[_ACCEL] - x[_ACCEL_BIAS] if math.isfinite(params[_ACCEL]) else 0.0
    middle = x[_YAW] + 0.5 * dt * x[_W]
    cos, sin = math.cos(middle), math.sin(middle)
    along, across = x[_VX] + 0.5 * dt * accel, x[_VY]
    x_next[:] = x
    x_next[_X] += dt * (along * cos - across * sin)
    x_next[_Y] += dt * (along * sin + across * cos)
    x_next[_YAW] += dt * x[_W]
    x_next[_VX] += dt * (accel + x[_W] * across)
    if params[_FREE_ACROSS] == 0.0:
        x_next[_VY] *= math.exp(-dt / ACROSS_S)
    else:
        x_next[_VY] -= dt * x[_W] * x[_VX]
    fast = _SLOW + int(params[_N_SLOW] + params[_TURNS]) + 1
    for i in range(int(params[_N_ROWS])):
        x_next[fast + i] *= math.exp(-dt / FAST_S)


@njit
def _propagate(x: Array, dt: float, params: Array, x_next: Array, f: Array) -> None:
    differentiate(_move, x, dt, params, x_next, f)


@njit
def _wheels(x: Array, params: Array, z: Array) -> None:
    n_slow, turns = int(params[_N_SLOW]), int(params[_TURNS])
    for i in range(int(params[_N_ROWS])):
        d = _D + 3 * i
        ground = params[d] * x[_VX] + params[d + 1] * x[_VY] + params[d + 2] * x[_W]
        z[i] = ground - params[_U + i] + params[_S + i] * x[_SLOW + int(params[_GROUP + i])]
        if turns > 0:
            z[i] += params[_T + i] * x[_SLOW + n_slow]
        z[i] += params[_PULL + i] * x[_SLOW + n_slow + turns]
        z[i] += params[_SIZE] * x[_SLOW + n_slow + turns + 1 + i]


@njit
def _placed(x: Array, sensor: int, lever_x: float, lever_y: float, params: Array, z: Array) -> None:
    """Write position and velocity in the world of a point of the body, an age ago."""
    age, accel = params[_AGES + sensor] + x[_GNSS_DELAY + min(sensor, 1)], params[_MEAN_ACCEL]
    along, across = x[_VX] - age * (accel + x[_W] * x[_VY]), x[_VY]
    middle, then = x[_YAW] - 0.5 * age * x[_W], x[_YAW] - age * x[_W]
    mean = 0.5 * (along + x[_VX])
    z[0] = x[_X] - age * (mean * math.cos(middle) - across * math.sin(middle))
    z[1] = x[_Y] - age * (mean * math.sin(middle) + across * math.cos(middle))
    cos, sin = math.cos(then), math.sin(then)
    z[0] += cos * lever_x - sin * lever_y
    z[1] += sin * lever_x + cos * lever_y
    ahead, left = along - x[_W] * lever_y, across + x[_W] * lever_x
    z[2], z[3] = cos * ahead - sin * left, sin * ahead + cos * left


@njit
def _measure(x: Array, _dt: float, params: Array, z: Array) -> None:
    z[:] = 0.0
    _wheels(x, params, z)
    z[MOST_ROWS] = x[_W] + x[_GYRO_BIAS]
    _placed(x, 0, params[_ANTENNA], params[_ANTENNA + 1], params, z[MOST_ROWS + 1 : MOST_ROWS + 5])
    pose = np.zeros(4)
    _placed(x, 1, params[_POSED], params[_POSED + 1], params, pose)
    fix = z[MOST_ROWS + 5 :]
    fix[0], fix[1], fix[2] = pose[0], pose[1], x[_YAW] - (params[_AGES + 1] + x[_POSE_DELAY]) * x[_W]
    fix[3] = x[_YAW]
    fix[4] = x[_VX] - x[_W] * params[_SEEN + 1]
    fix[5] = x[_VY] + x[_W] * params[_SEEN]
    fix[4] -= (params[_AGES + 2] + x[_POSE_DELAY]) * params[_MEAN_ACCEL]


@njit
def _observe(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    differentiate(_measure, x, 0.0, params, z_hat, h)


@njit
def _speed_below(x: Array, _dt: float, params: Array, y: Array) -> None:
    for i in range(MOST_ROWS):
        d = _D + 3 * i
        y[i] = params[d] * x[_VX] + params[d + 1] * x[_VY] + params[d + 2] * x[_W]


@njit
def _ground(x: Array, params: Array) -> tuple[Array, Array]:
    y, by_x = np.empty(MOST_ROWS), np.empty((MOST_ROWS, x.size))
    differentiate(_speed_below, x, 0.0, params, y, by_x)
    return y, by_x


class WheelRows(NamedTuple):
    """Rows of the wheels of a robot: along each that is logged, and across each that is steered."""

    logged: Array  #: (n,) place of each logged wheel among the robot's
    across: Array  #: (k,) and of each steered one
    groups: tuple[int, ...]  #: slow state of each row

    @property
    def n_slow(self) -> int:
        """Number of slow states."""
        return 1 + max(self.groups)


def rows_of_wheels(robot: Robot) -> WheelRows:
    """Return the rows of a robot's wheels.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> rows_of_wheels(load_robot("adap2e"))
    WheelRows(logged=array([1]), across=array([0]), groups=(0, 0))
    """
    logged = np.flatnonzero(np.isin(robot.wheels, robot.logged_wheels))
    across = np.flatnonzero(np.isin(robot.wheels, robot.steered_wheels))
    n = len(logged) + len(across)
    return WheelRows(logged, across, tuple(range(n)) if robot.skids or robot.on_omni_wheels else (0,) * n)


class Scatter(NamedTuple):
    """Standard deviation of the white noise of what moves smoothly, by third differences of what was measured."""

    last: Array  #: (up to 4, 1 + k) time and values of the last samples
    square: Array  #: (k,) of each value
    n: int  #: how many samples it counts as

    @classmethod
    def of(cls, std: Sequence[float], n: int) -> Scatter:
        """Return what is believed before any sample, and how many samples it counts as.

        Examples
        --------
        >>> scatter, rng = Scatter.of([0.1], 20), np.random.default_rng(0)
        >>> for k in range(500):
        ...     scatter = scatter.after(0.1 * k, np.sin([0.1 * k]) + 0.02 * rng.standard_normal(1), 1e-3)
        >>> scatter.std.round(2)
        array([0.02])
        """
        return cls(np.zeros((0, 1 + len(std))), np.square(std), n)

    @property
    def std(self) -> Array:
        """Standard deviation of each value (k,)."""
        return np.sqrt(self.square)

    def after(self, time_s: float, values: Array, least_std: Array | float) -> Scatter:
        """Return what is believed after a sample; one that is missing or not even with others shows nothing."""
        last = np.vstack([self.last[-3:], [time_s, *values]])
        steps_s = np.diff(last[:, 0])
        if len(steps_s) < 3 or steps_s.min() <= 0.8 * steps_s.max():
            return self._replace(last=last)
        squares = np.diff(last[:, 1:], 3, axis=0)[0] ** 2 / 20.0
        squares = np.fmin(squares, 9.0 * self.square)  # a jump is no scatter
        n = min(self.n + 1, N_REMEMBERED)
        learnt = np.where(
            np.isnan(last).any(axis=0)[1:], self.square, self.square + (squares - self.square) / n
        )
        return Scatter(last, np.maximum(learnt, np.square(least_std)), n)


class SlipFilter(FilterObserver):
    """The slip of a robot of any drive.

    Parameters
    ----------
    robot : with at most :data:`MOST_ROWS` rows of wheels, as every drive has

    Examples
    --------
    >>> from terrain.estimation.models.observer import observe
    >>> from terrain.robots import load_robot
    >>> filter_, time_s = SlipFilter(load_robot("husky")), np.arange(0.0, 20.0, 0.1)
    >>> rows = np.full((len(time_s), len(filter_.rows)), np.nan)
    >>> rows[:, [filter_.rows.index(name) for name in ("speed_left_mps", "speed_right_mps")]] = 1.0
    >>> rows[:, filter_.rows.index("gnss_x_m")] = 0.9 * time_s
    >>> rows[:, filter_.rows.index("gnss_y_m")] = rows[:, filter_.rows.index("gnss_age_s")] = 0.0
    >>> rows[:, filter_.rows.index("gnss_std_m")] = 0.02
    >>> track = observe(filter_, time_s, rows)
    >>> track.slip[-1].round(2)
    array([0.1, 0.1])
    """

    in_world = True
    name = "slip"

    def __init__(self, robot: Robot) -> None:
        self._robot, self._wheels = robot, rows_of_wheels(robot)
        logged, _, groups = self._wheels
        n_slow, n_rows = self._wheels.n_slow, len(groups)
        turns = robot.skids or isinstance(robot, BicycleRobot)
        names = [robot.wheels[i] for i in logged.tolist()]
        slow = [f"ground_slip_{name}_ratio" for name in names] if n_slow > 1 else ["ground_slip_ratio"]
        self.states = (*_MOTION, *slow, *["turn_loss_ratio"] * turns, "slip_per_mps2")
        self.slips = tuple(f"slip_{name}_ratio" for name in names)
        self._speeds = tuple(f"speed_{name}_mps" for name in names)
        steer = tuple(f"steer_{name}_rad" for name in robot.steered_wheels)
        self.rows = (*self._speeds, *steer, *_INERTIAL, *_REFERENCES, *_AGE_ROWS, "gnss_std_m")
        scatter_mps = float(np.fmax(wheel_speed_scatter_mps(robot), WHEEL_STD_MPS))
        effective_m = robot.identified.get("effective_track_m")
        loss, loss_std = (0.4, 0.25) if robot.skids else (0.0, 0.15)
        if robot.skids and effective_m is not None:
            loss, loss_std = 1.0 - robot.track_m / max(effective_m, robot.track_m), 0.1
        wheel_rows = tuple(f"wheel_{i}_mps" for i in range(MOST_ROWS))
        levers = (
            *_lever(robot, "antenna"),
            *_identified(robot, "pose_x_m", "pose_y_m"),
            *_lever(robot, "camera"),
        )
        counts = n_rows, n_slow, turns, robot.sideways
        model = FilterModel(
            name=self.name,
            states=(*self.states, *(f"passing_slip_{i}_ratio" for i in range(n_rows))),
            rows=(*wheel_rows, "gyro_z_radps", *_REFERENCES),
            sensors=(
                ("gyro", ("gyro_z_radps",)),
                ("pose_yaw", _REFERENCES[6:7]),
                ("compass", _REFERENCES[7:8]),
                ("pose", _REFERENCES[4:6]),
                ("gnss_position", _REFERENCES[:2]),
                ("gnss_speed", _REFERENCES[2:4]),
                ("camera", _REFERENCES[8:]),
                *((name, (name,)) for name in wheel_rows),
            ),
            propagate=_propagate,
            observe=_observe,
            params=np.array([*counts, *levers, *groups, *[0] * (MOST_ROWS - n_rows)], dtype=float),
            process_variance=np.zeros(len(self.states) + n_rows),
            measurement_variance=np.ones(MOST_ROWS + 1 + len(_REFERENCES)),
            initial_variance=np.square(
                [
                    JUMP_M,
                    JUMP_M,
                    1e-3,
                    1.0,
                    0.1,
                    0.5,
                    BIAS_STD_RADPS,
                    ACCEL_BIAS_STD,
                    DELAY_STD_S,
                    DELAY_STD_S,
                ]
                + [FIRST_RATIO] * n_slow
                + [loss_std] * turns
                + [PULL_STD_PER_MPS2]
                + [FAST_RATIO] * n_rows
            ),
            initial_mean=np.array(
                [0.0] * _GNSS_DELAY
                + [DELAY_S] * 2
                + [0.0] * n_slow
                + [loss] * turns
                + [PULL_PER_MPS2]
                + [0.0] * n_rows
            ),
            inputs=_INPUTS,
            references=("pose", "gnss_position", "gnss_speed", "camera"),
            # a reference that jumps is elsewhere, and shows no speed; a wheel that does slips for a moment
            jumps=(
                *((sensor, place) for sensor in ("pose", "gnss_position") for place in _MOTION[:2]),
                *((f"wheel_{i}_mps", f"passing_slip_{i}_ratio") for i in range(n_rows)),
            ),
            positions=_MOTION[:2],
            integrals=(("yaw_rad", "yaw_rate_radps"),),
            angle_states=("yaw_rad",),
            angle_rows=("pose_yaw_rad", "compass_rad"),
        )
        super().__init__(model, FilterSettings(GATE_PROBABILITY, REOPEN_AFTER_S, LONGEST_GAP_S))
        place = robot.wheel_positions_m, robot.wheel_directions_rad, robot.roller_angles_rad
        self._rolling, self._steer = rolling_matrix(*place)[logged], steer
        self._smooth_mps, self._accel_mps2, self._shaken_square = np.full(len(logged), np.nan), math.nan, 0.0
        self._pulls, self._accel_is_wrong, self._rolled_m = np.zeros(len(logged)), False, 0.0
        self._mean_mps = np.full((2, len(logged)), np.nan)
        self._has_delays: tuple[int, ...] = ()
        self._uphill, self._asked, self._apart_mps2 = 0.0, 0.0, 0.0
        self._turns = Turns()
        bounds = [DELAY_BOUNDS_S, DELAY_BOUNDS_S, *[SLIP_BOUNDS] * (n_slow + turns + 1 + n_rows)]
        self._bounds = np.array(bounds)
        self._speed_scatter = Scatter.of([scatter_mps] * len(logged), N_SPEEDS)
        self._pose_scatter = Scatter.of([POSE_STD_M, POSE_STD_M, POSE_STD_RAD], N_POSES)
        self._by_pose = False
        self._leave_frame()

    def step(self, row: Array, dt_s: float) -> ObserverOutput:
        """Take a row of :attr:`rows`; the frame begins at the first pose, or where the heading becomes known."""
        given = {
            name: value if abs(value) <= LARGEST else math.nan
            for name, value in zip(self.rows, row.tolist(), strict=True)
        }
        dt_s = min(dt_s, LONGEST_GAP_S) if 0.0 <= dt_s < math.inf else 0.0
        speeds = np.array([given[name] for name in self._speeds])
        speeds[~(np.abs(speeds) <= MOST_MPS)] = np.nan
        angles, (logged, across, _) = np.array([given[name] for name in self._steer]), self._wheels
        speeds[np.isin(logged, across[np.isnan(angles)])] = np.nan  # of a wheel that drives who knows where
        self._speed_scatter = self._speed_scatter.after(self._time_s + dt_s, speeds, LEAST_WHEEL_STD_MPS)
        means_mps = np.where(np.isfinite(self._mean_mps), self._mean_mps, _or_zero(speeds))
        slow = self._slow_of(speeds.size)
        behind_mps = np.fmin(3.0 * self._speed_scatter.std / np.maximum(slow, LEAST_SLOW), np.abs(speeds))
        held = [_or_zero(speeds) + sign * behind_mps for sign in (-1.0, 1.0)]
        means_mps = np.where(np.isfinite(speeds), np.clip(means_mps, *held), means_mps)
        gain, before_mps = -math.expm1(-dt_s / MEAN_S), means_mps[1]
        means_mps[0] += gain * _or_zero(speeds - means_mps[0])
        self._mean_mps = np.array([means_mps[0], before_mps + gain * (means_mps[0] - before_mps)])
        rates_mps2 = self._rates(speeds, dt_s)
        inputs = self._inputs(given, speeds, rates_mps2, before_mps, angles, dt_s)
        z = np.full(MOST_ROWS, np.nan)
        z[: logged.size] = 0.0 * speeds
        if np.isfinite(speeds).any():
            z[logged.size : logged.size + across.size] = 0.0 * angles
        if isinstance(self._robot, BicycleRobot):
            z[logged.size] += math.sin(float(_or_zero(angles[0]))) * float(self.filter.mean[_VX])
        gyro = given["yaw_rate_radps"]
        self._begin_delays(given)
        self._take_pose(given, dt_s)
        references = self._place(given, inputs, dt_s)
        z = np.concatenate([z, [gyro if abs(gyro) <= MOST_RADPS else np.nan], references])
        variance = self._variance(given, rates_mps2, inputs, dt_s)
        fix = self.advance(dt_s, z, inputs, self._walk(given, inputs, rates_mps2, dt_s), variance, N_JUDGED)
        mean = self.filter.mean
        np.clip(mean[_GNSS_DELAY:], *self._bounds.T, out=mean[_GNSS_DELAY:])
        self._accel_is_wrong |= abs(float(mean[_ACCEL_BIAS])) > LARGEST_BIAS_MPS2
        if self._robot.skids:
            turn_radps = float(mean[_W]) if math.isfinite(gyro) else math.nan
            bias_std = math.sqrt(max(float(self.filter.cov[_GYRO_BIAS, _GYRO_BIAS]), 0.0))
            sides = float(speeds[0]), float(speeds[1])
            self._turns = next_turns(
                self._turns, self._time_s, sides, turn_radps, bias_std, self._robot.track_m
            )
        output = self._output(speeds, inputs, fix)
        is_lost = self.filter.reference_age_s > LOST_S and (np.abs(output.slip) > LOST_RATIO).all()
        if is_lost:  # what it believes of the motion follows from nothing that is measured
            self.filter.mean[:], self.filter.cov[:] = (
                self.filter.model.initial_mean,
                self.filter.model.initial_variance,
            )
            self.filter.state["reference_age_s"], self._has_delays, self._accel_is_wrong = math.inf, (), False
            output = output._replace(status=int(ObserverStatus.RESET))
        if is_lost or (self._is_placed and self.filter.cov[_YAW, _YAW] > LOST_RAD**2):
            self._leave_frame()
        return output

    def _leave_frame(self) -> None:
        self._is_placed, self._seen, self._weight, self._frame_age_s = False, 0j, 0.0, 0.0
        self._first = np.full(2, np.nan, complex)

    def _slow_of(self, n: int) -> Array:
        """Return the size (n,) of m of each logged wheel."""
        return np.asarray(np.abs(self.filter.mean[[_SLOW + group for group in self._wheels.groups[:n]]]))

    def _rates(self, speeds: Array, dt_s: float) -> Array:
        """Return how fast the speeds of the wheels change, behind a low-pass; 0 where it is not known."""
        behind = _or_zero(speeds - self._smooth_mps)
        gain = -math.expm1(-dt_s / CHANGE_S)
        moved = np.where(np.isfinite(self._smooth_mps), self._smooth_mps + gain * behind, speeds)
        self._smooth_mps = np.where(np.isfinite(speeds), moved, self._smooth_mps)
        return np.asarray(behind / CHANGE_S)

    def _inputs(
        self,
        given: Mapping[str, float],
        speeds: Array,
        rates_mps2: Array,
        before_mps: Array,
        angles: Array,
        dt_s: float,
    ) -> Array:
        """Return the inputs of a tick; a steered wheel's direction is that of its angle.

        What m and chi are multiplied by are the low-passed speeds of before: by those of the tick, whose ripple the
        body does not follow, m would grow by its covariance with the innovation, the ratio of an error in variables.
        But times m they are behind by three deviations of a wheel's speed at most: where m is near 1 and wheels start
        or stop, it would be a speed over ground.
        """
        n, inputs, (logged, across, _) = speeds.size, np.zeros(len(_INPUTS)), self._wheels
        known, rolling, turning = _or_zero(speeds), np.zeros((MOST_ROWS, 3)), np.zeros(MOST_ROWS)
        smooth_mps = _or_zero(self._smooth_mps)
        sharp_mps = np.maximum(np.abs(known) - 3.0 * self._speed_scatter.std, 0.0)
        size = math.sqrt(max(float(np.mean(sharp_mps**2)), float(np.mean(smooth_mps**2))))
        rolling[:n] = self._rolling
        if self._steer:
            directions, positions_m = (
                np.array(self._robot.wheel_directions_rad),
                self._robot.wheel_positions_m,
            )
            directions[across] += _or_zero(angles)
            rolling[:n] = rolling_matrix(positions_m, directions)[logged]
            rolling[n : n + across.size] = rolling_matrix(positions_m, directions + 0.5 * math.pi)[across]
        if self._robot.skids:
            turning[:2] = np.array([-0.5, 0.5]) * (before_mps[1] - before_mps[0])
        elif isinstance(self._robot, BicycleRobot):
            # what it drives ahead is given, not inferred: by a small turn a steering that is off would be a speed
            turning[n], rolling[n, 0] = rolling[0, 0] * before_mps[0] * math.sin(float(directions[0])), 0.0
        accel = given["accel_x_mps2"]
        if math.isfinite(given["pitch_rad"]):  # the specific force at rest is -g sin(pitch)
            accel += GRAVITY_MPS2 * math.sin(given["pitch_rad"])
        accel = accel if abs(accel) <= MOST_MPS2 and not self._accel_is_wrong else math.nan
        if math.isfinite(accel):
            if math.isnan(self._accel_mps2):
                self._accel_mps2 = accel
            gain, apart = -math.expm1(-dt_s / VIBRATION_S), accel - self._accel_mps2
            self._accel_mps2 += gain * apart
            self._shaken_square += gain * (apart * apart - self._shaken_square)
        ages = [given[name] if 0.0 <= given[name] <= OLDEST_S else 0.0 for name in _AGE_ROWS]
        inputs[: 3 * MOST_ROWS], inputs[_SPEEDS][:n], inputs[_TURNING] = rolling.ravel(), known, turning
        if self._robot.skids and size > 0.0:  # turning on the spot says nothing of slip straight ahead
            before_mps = before_mps * (1.0 - min(abs(float(turning[0])) / size, 1.0) ** 2)
        inputs[_SMOOTH][:n], inputs[_PULLING][:n] = before_mps, np.abs(before_mps) * rates_mps2
        inputs[_SIZE - _D :] = size, accel, self._since_fix(rates_mps2, rolling[:n, 0]), *ages
        self.accel_mps2 = accel - float(self.filter.mean[_ACCEL_BIAS])
        return inputs

    def _since_fix(self, rates_mps2: Array, ahead: Array) -> float:
        """Return the acceleration ahead by which fixes that are old are brought to their instant.

        It is what low-passed accelerometer and wheels both show: a ground that shakes the one and wheels that spin are
        none, and a delay that was multiplied by their noise would come out short.
        """
        weight = float(ahead @ ahead)
        by_wheels = float(ahead @ rates_mps2) / weight if weight > 0.0 else 0.0
        if math.isnan(self._accel_mps2) or self._accel_is_wrong:
            self._apart_mps2 = 0.5 * abs(by_wheels)
            return by_wheels
        measured = self._accel_mps2 - float(self.filter.mean[_ACCEL_BIAS])
        both = (
            math.copysign(min(abs(measured), abs(by_wheels)), by_wheels)
            if measured * by_wheels > 0.0
            else 0.0
        )
        self._apart_mps2 = 0.5 * abs(measured - by_wheels)
        return both

    def _variance(self, given: Mapping[str, float], rates_mps2: Array, inputs: Array, dt_s: float) -> Array:
        """Return the variance of each measurement.

        A wheel's speed is a mean over a tick, half of one late.  A measured speed is of an age ago; what it has changed
        by since is uncertain by what wheels and accelerometer do not agree on.
        """
        scatter_mps = self._speed_scatter.std
        std = np.full(MOST_ROWS + 1 + len(_REFERENCES), scatter_mps.max())
        std[: rates_mps2.size] = np.hypot(scatter_mps, 0.29 * dt_s * rates_mps2)
        if float(inputs[_SIZE - _D]) < STANDING_MPS:
            std[:MOST_ROWS] = REST_STD_MPS
        if self._robot.skids:
            left, right = (given[name] for name in self._speeds)
            rolls = 1.0 - float(self.filter.mean[_SLOW + self._wheels.n_slow])
            turn_radps = given["yaw_rate_radps"] - float(self.filter.mean[_GYRO_BIAS])
            apart_mps = 0.5 * abs((right - left) * rolls - turn_radps * self._robot.track_m)
            if math.isfinite(apart_mps):
                std[:2] = np.hypot(std[:2], APART_STDS * min(apart_mps, MOST_MPS))
        late_mps = (given["gnss_age_s"] + float(self.filter.mean[_GNSS_DELAY])) * self._apart_mps2
        fix_m = given["gnss_std_m"] if given["gnss_std_m"] > 0.0 else FLOAT_STD_M
        std[MOST_ROWS:] = (
            *(GYRO_STD_RADPS, fix_m, fix_m, *[math.hypot(GNSS_SPEED_STD_MPS, late_mps)] * 2),
            *self._pose_scatter.std,
            *(COMPASS_STD_RAD, CAMERA_STD_MPS, CAMERA_STD_MPS),
        )
        return np.where(np.isfinite(std), std, GNSS_SPEED_STD_MPS) ** 2

    def _walk(self, given: Mapping[str, float], inputs: Array, rates_mps2: Array, dt_s: float) -> Array:
        """Return what the variance of each state grows by in a second, up to this tick."""
        n_rows, size = len(self._wheels.groups), float(inputs[_SIZE - _D])
        n_slow = self._wheels.n_slow
        slow = self.filter.mean[_SLOW : _SLOW + n_slow]
        dt_s, walk = max(dt_s, 1e-6), np.zeros(len(self.filter.model.states))
        has_accel, has_pitch = math.isfinite(inputs[_ACCEL - _D]), math.isfinite(given["pitch_rad"])
        shaken = math.sqrt(self._shaken_square * dt_s)
        walk[_VX] = (ACCEL_WALK + shaken if has_accel else FREE_WALK) ** 2
        turn_radps = abs(float(self.filter.mean[_W]))
        across = (ACROSS_RATIO * size + ACROSS_M * turn_radps) ** 2
        walk[_VY] = FREE_WALK**2 if self._robot.sideways else _fading(across, ACROSS_S, dt_s)
        walk[_W], walk[_GYRO_BIAS] = YAW_ACCEL**2, BIAS_WALK**2
        walk[_ACCEL_BIAS] = (TILTED_WALK if has_pitch else UNTILTED_WALK) ** 2
        tight = float(np.abs(inputs[_TURNING]).max()) / size if size > STANDING_MPS else 0.0
        if size > STANDING_MPS:
            smooth = _or_zero(self._smooth_mps)
            pulls = smooth / max(float(np.linalg.norm(smooth)), STANDING_MPS)
            turned = float(np.linalg.norm(pulls - self._pulls))
            if has_pitch:  # what gravity asks of the wheels, in the direction that they turn
                self._uphill += -math.expm1(-dt_s / SLOPE_S) * (-math.sin(given["pitch_rad"]) - self._uphill)
            asked = self._uphill * math.copysign(1.0, float(inputs[_SPEEDS].sum()))
            changed = np.zeros(n_slow)
            if turned > LEAST_CHANGE:
                changed, self._pulls = turned * (DIRECTION_RATIO**2 + np.square(0.5 * slow)), pulls
            if abs(asked - self._asked) > LEAST_CHANGE:
                changed, self._asked = changed + SLOPE_RATIO2 * abs(asked - self._asked), asked
            unknown = (
                np.square(np.maximum(SLOW_RATIO, np.abs(slow)))
                - self.filter.cov.diagonal()[_SLOW : _SLOW + n_slow]
            )
            walk[_SLOW : _SLOW + n_slow] = np.clip(unknown / dt_s, 0.0, SLOW_WALK**2 + changed / dt_s)
            by_gyro = self._robot.skids and math.isfinite(given["yaw_rate_radps"])
            turn_walk = GYRO_TURN_WALK if by_gyro else TURN_WALK
            walk[_SLOW + n_slow : len(self.states) - 1] = (turn_walk * tight) ** 2
            walk[len(self.states) - 1] = PULL_WALK**2
        self._rolled_m = self._rolled_m + size * dt_s if size > STANDING_MPS else 0.0
        yields = math.exp(-self._rolled_m / (YIELDING_RATIO * self._robot.wheel_radius_m))
        shown = np.square(rates_mps2) - np.square(
            2.0 * self._speed_scatter.std / CHANGE_S
        )  # more than scatter
        pulled = math.sqrt(max(float(shown.max()), 0.0)) * (1.0 + float(np.abs(slow).max()) / STEEPER_RATIO)
        fast = FAST_RATIO + FAST_PER_MPS2 * pulled + FAST_TURNING * tight + yields
        walk[-n_rows:] = _fading(fast**2, FAST_S, dt_s)
        return walk

    def _begin_delays(self, given: Mapping[str, float]) -> None:
        """Begin with the delays that the description has of what begins to measure."""
        for first, state, names in _DELAYS:
            if state not in self._has_delays and math.isfinite(given[_REFERENCES[first]]):
                self._has_delays = (*self._has_delays, state)
                if known := [
                    self._robot.identified[name] for name in names if name in self._robot.identified
                ]:
                    self.filter.cov[state, :], self.filter.cov[:, state] = 0.0, 0.0
                    self.filter.mean[state], self.filter.cov[state, state] = known[0], KNOWN_STD_S**2

    def _take_pose(self, given: Mapping[str, float], dt_s: float) -> None:
        """Learn how much poses scatter."""
        pose = np.array([given[name] for name in _REFERENCES[4:7]])
        if np.isfinite(pose).all():
            at_s = self._time_s + dt_s - (given["pose_age_s"] if math.isfinite(given["pose_age_s"]) else 0.0)
            last_rad = self._pose_scatter.last[-1, 3] if len(self._pose_scatter.last) else 0.0
            pose[2] = last_rad + wrapped(pose[2] - last_rad)
            least = np.array([LEAST_POSE_STD_M, LEAST_POSE_STD_M, LEAST_POSE_STD_RAD])
            self._pose_scatter = self._pose_scatter.after(at_s, pose, least)

    def _place(self, given: Mapping[str, float], inputs: Array, dt_s: float) -> Array:
        """Return the references that are used at a tick, and begin their frame where that becomes possible."""
        z = np.array([given[name] for name in _REFERENCES])
        for known in (slice(0, 2), slice(2, 4), slice(4, 6)):  # a half of a position or a velocity is none
            z[known] += 0.0 * z[known].sum()
        if self._is_placed:  # poses and satellites need not be of one frame: the one that it began in counts
            own, other = (_OF_POSES, _OF_FIXES) if self._by_pose else (_OF_FIXES, _OF_POSES)
            self._frame_age_s = 0.0 if np.isfinite(z[own]).any() else self._frame_age_s + dt_s
            if self._frame_age_s <= LOST_S or np.isnan(z[other]).all():
                z[other] = math.nan
                return z
            self._leave_frame()
        mean, cov, params, ages_s = (
            self.filter.mean,
            self.filter.cov,
            self.filter.model.params,
            inputs[_AGES - _D :],
        )
        yaw, turn_radps = float(mean[_YAW]), float(mean[_W])
        fix, pose = complex(z[0], z[1]), complex(z[4], z[5])
        lever, late = complex(*params[_ANTENNA:_POSED]), _GNSS_DELAY
        age_s = float(ages_s[0]) + float(mean[late])
        std_m = given["gnss_std_m"]
        place, turned, std = fix, math.nan, math.inf
        if math.isfinite(z[6]) and not cmath.isnan(pose):
            place, lever, std_m = pose, complex(*params[_POSED:_SEEN]), POSE_STD_M
            late = _POSE_DELAY
            age_s = float(ages_s[1]) + float(mean[late])
            turned, std = z[6] - yaw + age_s * turn_radps, POSE_STD_RAD
        elif math.isfinite(z[7]) and not cmath.isnan(fix):
            turned, std = z[7] - yaw, COMPASS_STD_RAD
        forward = cmath.exp(1j * yaw)
        velocity = complex(mean[_VX], mean[_VY]) * forward
        if std == math.inf:
            at = complex(mean[_X], mean[_Y]) - age_s * velocity + lever * forward
            moving = velocity + 1j * turn_radps * lever * forward
            turned, std = self._turned(fix, complex(z[2], z[3]), at, moving, std_m)
        z[:8] = math.nan
        if not std <= math.hypot(ALIGNED_RAD, CRAB_RAD):
            return z
        cov[:3, :], cov[:, :3] = 0.0, 0.0
        mean[_YAW], cov[_YAW, _YAW] = wrapped(yaw + turned), std**2
        moved = velocity * cmath.exp(1j * turned)
        cov[_X, _X] = cov[_Y, _Y] = (std_m if std_m > 0.0 else POSE_STD_M) ** 2 + (abs(lever) * std) ** 2
        if not cmath.isnan(place):  # of an instant that is as uncertain as the delay
            origin = place + age_s * moved - lever * forward * cmath.exp(1j * turned)
            mean[_X], mean[_Y] = origin.real, origin.imag
            along = np.array([moved.real, moved.imag])
            cov[:2, :2] += cov[late, late] * np.outer(along, along)
            cov[:2, _VX:] = np.outer(along, cov[late, _VX:])
            cov[_VX:, :2] = cov[:2, _VX:].T
        self._is_placed, self._by_pose = True, late == _POSE_DELAY
        z[_OF_FIXES if self._by_pose else _OF_POSES] = math.nan
        return z

    def _turned(
        self, fix: complex, speed: complex, at: complex, velocity: complex, fix_std_m: float
    ) -> tuple[float, float]:
        """Return the angle from the filter's own frame to the receiver's, and its deviation; infinite where unknown.

        By the travel since the first fix, and by the receiver's speeds; ``at`` and ``velocity`` are those of the
        antenna in the filter's own frame.  Wheels that spin show no heading: what has not moved scatters.
        """
        angle, std = math.nan, math.inf
        if not cmath.isnan(speed) and min(abs(speed), abs(velocity)) >= LEAST_MPS:
            self._seen += speed * velocity.conjugate()
            self._weight += abs(speed) ** 2
            angle, std = cmath.phase(self._seen), GNSS_SPEED_STD_MPS / math.sqrt(self._weight)
        if not cmath.isnan(fix):
            if np.isnan(self._first[0]):
                self._first[:] = fix, at
            seen, travelled = fix - complex(self._first[0]), at - complex(self._first[1])
            scatter = math.sqrt(2.0) * fix_std_m / max(abs(seen), 1e-9)
            if abs(travelled) >= LEAST_TRAVEL_M and scatter < std:
                angle, std = cmath.phase(seen * travelled.conjugate()), scatter
        return angle, math.hypot(std, CRAB_RAD)

    def _output(self, speeds: Array, inputs: Array, fix: ObserverStatus) -> ObserverOutput:
        """Return states and slip ratios of the wheels, NaN where they are not observed."""
        ground, std = self.read(_ground, inputs)
        n, age_s, mean = speeds.size, self.filter.reference_age_s, self.filter.mean
        slip = slip_ratio(speeds, ground[:n])
        fastest = np.fmax(np.abs(speeds), np.abs(ground[:n]))
        # by the speed over ground, and by that of the wheel, in traction and in braking
        slower = np.fmin(np.abs(speeds), np.abs(ground[:n])) / np.fmax(fastest, MIN_SPEED_MPS)
        traction = np.abs(speeds) >= np.abs(ground[:n])
        by_ground, by_wheel = np.where(traction, 1.0, slower), np.where(traction, slower, 1.0)
        deviation = np.hypot(by_ground * std[:n], by_wheel * self._speed_scatter.std) / np.fmax(
            fastest, MIN_SPEED_MPS
        )
        unknown = np.isnan(slip) | (deviation > UNKNOWN_RATIO) | (age_s == math.inf)
        slip[unknown] = deviation[unknown] = math.nan
        d = len(self.states)
        status = fix
        if self._turns.is_stuck:
            status = ObserverStatus.STUCK
        elif age_s == math.inf:
            status = ObserverStatus.STARTING
        elif not np.isfinite(speeds).any():
            status = ObserverStatus.BAD_INPUT
        elif fix is ObserverStatus.OK and float(inputs[_SIZE - _D]) < STANDING_MPS:
            status = ObserverStatus.STANDING
        elif fix is ObserverStatus.OK and age_s > PREDICTED_S:
            status = ObserverStatus.PREDICTED
        self.reference_age_s, self.reason = age_s, self._reason(age_s, slip, speeds, fastest)
        std = np.sqrt(np.maximum(self.filter.cov.diagonal()[:d], 0.0))
        return ObserverOutput(mean[:d].copy(), std, slip, deviation, int(status))

    def _reason(self, age_s: float, slip: Array, speeds: Array, fastest_mps: Array) -> str:
        """Return why no slip is known, in a sentence; empty where one is."""
        if np.isfinite(slip).any():
            return ""
        if self._turns.is_stuck:
            return "the robot is stuck: its wheels turn against each other, and it does not turn"
        if age_s == math.inf and (self._weight > 0.0 or not np.isnan(self._first[0])):
            return (
                f"the heading is not known yet: it follows from a motion of {LEAST_TRAVEL_M:g} m with fixes"
            )
        if age_s == math.inf:
            return "no position, pose or speed over ground has come yet"
        if np.isnan(speeds).all():
            return "no speed of a wheel comes, or no angle of a steered one"
        if np.nanmax(fastest_mps) < MIN_SPEED_MPS:
            return "the wheels stand"
        after = f", {age_s:.0f} s after the last speed over ground" if age_s >= 1.0 else ""
        return f"it is uncertain by more than {UNKNOWN_RATIO:g}{after}"


def _or_zero(values: Any) -> Any:
    return np.where(np.isfinite(values), values, 0.0)


def _fading(variance: float, time_s: float, dt_s: float) -> float:
    """Return what the variance of a state that fades within a time grows by in a second, so that it stays the same."""
    return -variance * math.expm1(-2.0 * dt_s / time_s) / dt_s


def _lever(robot: Robot, section: str) -> tuple[float, float]:
    """Return where a sensor is mounted; the body's origin where the description does not say."""
    part = robot.parts.get(section)
    return getattr(part, "lever_x_m", 0.0), getattr(part, "lever_y_m", 0.0)


def _identified(robot: Robot, *names: str) -> tuple[float, ...]:
    return tuple(robot.identified.get(name, 0.0) for name in names)
