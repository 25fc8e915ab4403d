"""The filter of a skid-steer robot that has wheels and a gyro, and nothing that sees the ground go by.

Wheels of a side turn together at v_left, v_right; v is their mean, D = v_right - v_left their difference, w
the yaw rate, B the effective track, b the gyro's bias::

    wheel_left = v - D / 2      wheel_right = v + D / 2      gyro = w + b      (at rest)  gyro = b

A skid-steer robot turns by sliding, so that B is not the distance of its wheels but 1.5 to 2 times that
(Mandow et al., Experimental kinematics for wheeled skid-steer mobile robots, IROS 2007).  D is measured, and
what it says of w is only as good as the slip of the sides.  So w is no function of D but follows it::

    dw/dt = a (D / B - w) / T + n

with the time T in which wheels turn a body, and white noise n of q rad/s a root second.  Solved for D / B,
the wheels measure the yaw rate with white noise of q T / a: a is how much they are believed.  It falls with

- the size of D, since slip is a part of it: q T / a has a part of q T and one that grows with D / B_0, where
  B_0 is the described track;
- the disagreement e of wheels and yaw rate: how far w is outside of D / (4 B_0) to D / B_0, which a track
  from B_0 to 4 B_0 explains::

    a = 1 / (1 + (e / e_0)^2) / sqrt(1 + (D / B_0 / w_0)^2)

a is taken as a constant of each step, as the weights of a robust regression are.  Wheels that spin without
turning the robot thus say nothing on the gyro's bias, which its own prior, driving straight and standing
still (:mod:`terrain.estimation.feed`) determine.  Without a gyro w still follows the wheels, as slowly as they
are believed.  What is missing is the slip that both sides share: v is the speed of the wheels,
``reference_age_s`` of the track is infinite, and slip is unknown, not zero.

Whether it moves
----------------
Sides that turn against each other turn a robot with D / B_0 where nothing slips, usually with half of it, and
where the robot is stuck not at all.  With s the standard deviation of b, and means over the last second
(low-passes)::

    stuck     |w| + 2 s < r |D| / B_0      with r = :data:`STUCK_RATIO`, for :data:`STUCK_AFTER_S`
    moving    |w| - 2 s > r |D| / B_0      and :data:`MOVING_RADPS`

of sides that turn against each other (``|v| <= |D| / 4``).  At rest are wheels that stand for a second on a
robot that does not turn; and whatever its wheels do, one that turns faster than any bias moves.  All else is
*unknown*: a robot that drives straight turns its wheels whether or not the ground stays below it; wheels of a
short turn, a yaw rate within two standard deviations of the limit, and all of it without a gyro.  Acceleration
and currents do not show it on the measured runs of a Husky on snow, ice, loam and asphalt: wheels that spin in
snow shake the body as travel does (0.2 to 8 m/s^2, driving 0.4 to 8), and their currents (1 to 20 A) are those
of driving too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from terrain.estimation.feed import REST_ROW, REST_S, SIDE_ROWS, STANDING_MPS, TICK_S
from terrain.estimation.filter import FilterModel
from terrain.kernels import filled, njit, numbers, record
from terrain.records import Array
from terrain.robots import Robot, SkidSteerRobot, as_drive

#: Wheels that differ by less, over the described track, show nothing of the effective one: D is noise.
MIN_TURN_RADPS = 0.15
#: Largest effective track over the described one; twice what is usual on firm ground (Mandow et al. 2007).
MAX_TRACK_RATIO = 4.0
#: Largest bias of a gyro, 3.4 degrees a second: seven times what makers of IMUs allow themselves.
MAX_BIAS_RADPS = 0.06
#: How little is known of the bias: a gyro of a robot's IMU repeats within 0.5 degrees a second from start to start
#: (Xsens, Bias repeatability of gyroscopes, knowledge base), 0.3 as a standard deviation.
BIAS_STD_RADPS = 0.005
#: T: times q it is what the wheels of a straight drive on firm ground are worth, 0.03 rad/s a root second.
FOLLOWS_S = 0.055
#: e_0: more than the gyro's noise, less than the yaw rates that bumps and ruts cause.
DISAGREEMENT_RADPS = 0.02
SLIP_TURN_RADPS = 0.15  #: w_0: where slip makes the wheels half as good as when driving straight.

_STATES = (
    *("position_x_m", "position_y_m", "yaw_rad", "speed_mps", "yaw_rate_radps"),
    *("effective_track_m", "gyro_bias_radps", "wheel_difference_mps"),
)
#: Rows of the table that the filter takes beside that of rest.
WHEELS_AND_GYRO = (*SIDE_ROWS, "gyro_z_radps")

_ROWS, _SENSORS = (*WHEELS_AND_GYRO, REST_ROW), ("wheel_left", "wheel_right", "gyro", "rest")
_X, _Y, _YAW, _V, _W, _TRACK, _BIAS, _DIFFERENCE = range(8)


@njit
def wheel_weight(yaw_rate_radps: float, difference_mps: float, track_m: float) -> float:
    """Return a, from 0 to 1: how much a difference D of the sides is believed beside a yaw rate w, of the track B_0.

    Examples
    --------
    >>> round(wheel_weight(0.0, 0.0, 0.57), 3), round(wheel_weight(0.0, 0.3, 0.57), 3)
    (1.0, 0.006)
    """
    turn = difference_mps / track_m
    least = turn / MAX_TRACK_RATIO
    apart = yaw_rate_radps - min(max(yaw_rate_radps, min(turn, least)), max(turn, least))
    slip = math.sqrt(1.0 + (turn / SLIP_TURN_RADPS) ** 2)
    return 1.0 / (1.0 + (apart / DISAGREEMENT_RADPS) ** 2) / slip


@njit
def _propagate(x: Array, dt: float, params: Array, x_next: Array, f: Array) -> None:
    cos, sin = math.cos(x[_YAW]), math.sin(x[_YAW])
    for i in range(x.size):
        x_next[i] = x[i]
        f[i, i] = 1.0
    x_next[_X] += dt * x[_V] * cos
    f[_X, _V], f[_X, _YAW] = dt * cos, -dt * x[_V] * sin
    x_next[_Y] += dt * x[_V] * sin
    f[_Y, _V], f[_Y, _YAW] = dt * sin, dt * x[_V] * cos
    x_next[_YAW] += dt * x[_W]
    f[_YAW, _W] = dt
    described = params[0]
    track = min(max(x[_TRACK], described), MAX_TRACK_RATIO * described)
    x_next[_TRACK] = track  # bounds move the mean, the covariance stays
    x_next[_BIAS] = min(max(x[_BIAS], -MAX_BIAS_RADPS), MAX_BIAS_RADPS)
    weight = wheel_weight(x[_W], x[_DIFFERENCE], described)
    near = 1.0 - math.exp(-weight * dt / FOLLOWS_S)
    x_next[_W] += near * (x[_DIFFERENCE] / track - x[_W])
    f[_W, _W], f[_W, _DIFFERENCE] = 1.0 - near, near / track
    if abs(x[_DIFFERENCE]) >= MIN_TURN_RADPS * described:
        f[_W, _TRACK] = -near * x[_DIFFERENCE] / track**2


@njit
def _observe(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    for row, side in ((0, -0.5), (1, 0.5)):
        z_hat[row] = x[_V] + side * x[_DIFFERENCE]
        h[row, _V], h[row, _DIFFERENCE] = 1.0, side
    z_hat[2] = x[_W] + x[_BIAS]
    h[2, _W], h[2, _BIAS] = 1.0, 1.0
    z_hat[3] = x[_BIAS]
    h[3, _BIAS] = 1.0


def within_bounds(mean: Array, track_m: float) -> Array:
    """Return states (..., 8), as a measurement left them, with track and bias in the bounds of the next prediction."""
    bounded = np.array(mean)
    bounded[..., _TRACK] = np.clip(mean[..., _TRACK], track_m, MAX_TRACK_RATIO * track_m)
    bounded[..., _BIAS] = np.clip(mean[..., _BIAS], -MAX_BIAS_RADPS, MAX_BIAS_RADPS)
    return bounded


def make_skid_filter(robot: Robot) -> FilterModel:
    """Return the filter of a skid-steer robot, with physical noise.

    The effective track starts as the described one, hardly known.  ``ConfigError`` where the robot is of another kind.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> make_skid_filter(load_robot("husky")).references
    ()
    """
    as_drive(SkidSteerRobot, robot, "robot {name} has the drive {drive!r}: this filter is for 'skid_steer'")
    track_m = robot.track_m
    walk_std = np.array([1e-2, 1e-2, 1e-3, 0.5, 0.6, 0.02, 2e-4, 1.0])
    return FilterModel(
        name="skid",
        states=_STATES,
        rows=_ROWS,
        sensors=tuple((name, (row,)) for name, row in zip(_SENSORS, _ROWS, strict=True)),
        propagate=_propagate,
        observe=_observe,
        params=np.array([track_m]),
        process_variance=walk_std**2,
        measurement_variance=np.square([0.06, 0.06, 0.01, 0.002]),
        initial_variance=np.square([1e-3, 1e-3, 1e-3, 1.0, 0.5, track_m, BIAS_STD_RADPS, 1.0]),
        initial_mean=np.array([0.0, 0.0, 0.0, 0.0, 0.0, track_m, 0.0, 0.0]),
        positions=_STATES[:2],
        angle_states=("yaw_rad",),
    )


#: Time constant of the means: longer than a wheel's measurement is late (0.3 s), shorter than a turn.
MEAN_S = 1.0
#: A robot that turns with less than a tenth of D / B_0: firm ground and ice have 0.5 to 0.7, snow 0.3.
STUCK_RATIO = 0.1
#: A turn has to have failed for so long: clocks of two loggers may be 1.3 s apart (BorealTC, SNOW_14).
STUCK_AFTER_S = 2.0
#: Wheels that would turn the robot slower show nothing: a tenth of it is a gyro's bias.
LEAST_TURN_RADPS = 0.1
#: A robot that turns faster moves, whatever its wheels do: what is left of a bias is not so large.
MOVING_RADPS = 0.03
OPPOSED_RATIO = 0.25  #: Largest mean of the sides over their difference of wheels that turn on the spot.
FASTEST_MPS = 50.0  #: A wheel that is read as faster is not read.
UNKNOWN_AFTER_S = 0.5  #: Without wheels or gyro for longer, nothing is known.


class Motion(IntEnum):
    """What is known of a robot's motion."""

    UNKNOWN = 0
    AT_REST = 1
    MOVING = 2
    STUCK = 3


@dataclass(frozen=True, slots=True)
class StuckInterval:
    """A time in which a robot was stuck, on the clock of its wheels."""

    start_s: float
    end_s: float


#: Memory of :func:`motion_at`: stamp of the last measurement; the means; since when a turn has failed, the wheels
#: have stood, and the means are taken; since when the robot is stuck, NaN where it is not; and its :class:`Motion`.
MOTION = record(
    numbers("last_s mean_mps difference_mps turn_radps failing_s standing_s start_s stuck_since_s")
    | {"status": int}
)


def motion_memory() -> Array:
    """Return the memory (1,) before the first sample."""
    return filled(MOTION, np.nan)


def motion_at(
    time_s: float,
    left_mps: float,
    right_mps: float,
    has_gyro: bool,
    yaw_rate_radps: float,
    bias_std_radps: float,
    track_m: float,
    memory: Array,
) -> Motion:
    """Return what is known of the motion at one instant.

    Parameters
    ----------
    time_s : of the wheels
    left_mps, right_mps : measured speeds of the sides, NaN where there is none
    has_gyro : whether the gyro was measured
    yaw_rate_radps, bias_std_radps : of the filter
    track_m : B_0, the described track
    memory : (1,) of :func:`motion_memory`, which is moved
    """
    m = memory[0]
    step_s = time_s - m["last_s"]
    if not (has_gyro and abs(left_mps) <= FASTEST_MPS and abs(right_mps) <= FASTEST_MPS):
        if not 0.0 < step_s <= UNKNOWN_AFTER_S:
            memory[:] = motion_memory()
        return Motion(m["status"])
    mean, difference = 0.5 * (left_mps + right_mps), right_mps - left_mps
    means = {"mean_mps": mean, "difference_mps": difference, "turn_radps": yaw_rate_radps}
    if not 0.0 < step_s <= MEAN_S:
        gain = 1.0
        m["start_s"], m["failing_s"], m["standing_s"] = time_s, math.nan, math.nan
    else:
        gain = 1.0 - math.exp(-step_s / MEAN_S)
    for name, value in means.items():
        m[name] = value if gain == 1.0 else m[name] + gain * (value - m[name])
    m["last_s"] = time_s
    ideal = abs(m["difference_mps"]) / track_m
    opposed = abs(m["mean_mps"]) <= OPPOSED_RATIO * abs(m["difference_mps"])
    turns = opposed and ideal >= LEAST_TURN_RADPS and abs(difference) >= LEAST_TURN_RADPS * track_m
    turn, limit, doubt = abs(m["turn_radps"]), STUCK_RATIO * ideal, 2.0 * bias_std_radps
    stands = abs(left_mps) < STANDING_MPS and abs(right_mps) < STANDING_MPS
    for name, holds in (("failing_s", turns and turn + doubt < limit), ("standing_s", stands)):
        if not holds:
            m[name] = math.nan
        elif math.isnan(m[name]):
            m[name] = time_s
    status = Motion.UNKNOWN
    if time_s - m["standing_s"] >= REST_S - TICK_S and turn - doubt <= MOVING_RADPS:
        status = Motion.AT_REST
    elif time_s - m["failing_s"] >= STUCK_AFTER_S - TICK_S and time_s - m["start_s"] >= MEAN_S:
        status = Motion.STUCK
    elif turn - doubt > MOVING_RADPS and not (turns and turn - doubt <= limit):
        status = Motion.MOVING
    if status != Motion.STUCK:
        m["stuck_since_s"] = math.nan
    elif math.isnan(m["stuck_since_s"]):
        m["stuck_since_s"] = time_s - STUCK_AFTER_S
    m["status"] = status
    return status


def motion_track(
    time_s: Array, wheels_and_gyro: Array, yaw_rate_radps: Array, bias_std_radps: Array, track_m: float
) -> Array:
    """Return the :class:`Motion` (n,) of a log: :func:`motion_at`, looped over left and right speed and gyro (n, 3).

    Examples
    --------
    >>> time_s = np.arange(0.0, 6.0, 0.1)
    >>> spinning, still = np.tile([-0.15, 0.15, 0.0], (60, 1)), np.zeros(60)
    >>> motion = motion_track(time_s, spinning, still, still + 0.002, 0.57)
    >>> stuck_intervals(time_s, motion)
    (StuckInterval(start_s=0.0, end_s=5.9),)
    """
    memory = motion_memory()
    columns = (column.tolist() for column in (time_s, wheels_and_gyro, yaw_rate_radps, bias_std_radps))
    ticks = zip(*columns, strict=True)
    return np.array(
        [
            motion_at(at_s, left, right, not math.isnan(gyro), turn, bias_std, track_m, memory)
            for at_s, (left, right, gyro), turn, bias_std in ticks
        ],
        dtype=np.int64,
    )


def stuck_intervals(time_s: Array, motion: Array) -> tuple[StuckInterval, ...]:
    """Return the times in which a robot was stuck, from when it became so, :data:`STUCK_AFTER_S` before it is known."""
    stuck = np.concatenate([[False], motion == Motion.STUCK, [False]])
    first, after = np.flatnonzero(stuck[1:] & ~stuck[:-1]), np.flatnonzero(stuck[:-1] & ~stuck[1:])
    begins = np.maximum(time_s[first] - STUCK_AFTER_S, time_s[:1])
    return tuple(map(StuckInterval, begins.tolist(), time_s[after - 1].tolist()))


def motion_seconds(time_s: Array, motion: Array) -> dict[str, float]:
    """Return the time spent in each :class:`Motion`, by its name in small letters, in seconds."""
    steps_s = np.diff(time_s, append=time_s[-1:])
    return {kind.name.lower(): float(steps_s[motion == kind].sum()) for kind in Motion}
