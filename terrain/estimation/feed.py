"""From samples of sensors to the row of measurements at each tick of the wheels, on one clock and with one delay.

The clock is that of the wheels, whose rates pass the low-pass of the motor driver.  A ground speed that
is ahead of them makes the slip of a start look negative (Danzi, AgriMaRo thesis, 7.2.2), so every other
signal goes through a low-pass too, and its own lag and the filter's together are the encoders'.  In order:

1. calibration, gravity and the camera's axes are removed, angles are unwrapped;
2. channels that repeat themselves to the last bit on a robot that moves are left out, and jumps;
3. a low-pass, at each sensor's own rate (:func:`terrain.signals.low_pass_step`);
4. at each tick the last sample at or before it, unless it is too old; the low-pass runs on to the tick with
   that sample as its input, which leaves no delay of the holding;
5. rows that follow from others: vibration, changes of the wheels' speeds, rest; of a robot that skids the
   gyro's mean since the last tick.

A whole log (:func:`measurement_table`) and the live chain (:mod:`terrain.estimation.live`) take the same compiled
steps, one for each sample and one for each tick.  What looks ahead in a log is the cleaning, which leaves out and
counts samples that cannot be true, the median periods and, unless ``causal``, latencies, the yaw at the start and the
origin of positions.

Rows that follow from others
----------------------------
- ``vibration_mps2``: root mean square of the vertical acceleration over the last 0.3 s;
- ``wheel_<i>_growth_per_s`` and ``wheel_<i>_change_m2ps3``: ``w w' / (w^2 + w_0^2)`` and ``|w w'|`` of a
  wheel's circumferential speed w behind two low-passes of 0.15 s, with w_0 = 0.1 m/s: what keeps the ratio of
  a slip speed to w, and what w^2 changes by; without a camera the latter decays within 0.5 s, peaks held;
- ``camera_age_s``: since the camera last measured a speed;
- ``rest_speed_*``, ``rest_yaw_rate``: zero, where the robot is at rest: for half a second the wheels have
  stood, gyro and accelerometer have measured nothing, and a camera, if it measures, no speed.  Locked wheels
  that slide decelerate the robot: on ice (0.05 of its weight) by more than what counts as nothing.

Of a robot that skids, wheels at 6 Hz leave 15 samples of a gyro at 100 Hz between two ticks.  One of them is
the yaw rate with all of its vibration; their mean is what the heading changed by.  So the row is the integral
of the low-passed samples, straight from one to the next, over its time; and where no sample came since, the
value held.  At rest the yaw rate is zero, and a gyro reads its bias.  Rest is wheels that stand for
:data:`REST_S` and a gyro that is steady all the while: that of a robot that slides, or is towed with its
wheels held, is not.  ``rest_gyro`` is its mean over all of that time, once, so that a turn that just begins is
a small part of it.

A yaw row is ``initial_yaw_rad`` on average while the robot is at rest at the start, or at its first sample.
A camera that starts late takes the IMU's yaw of that instant instead, and after a loss the turn nearest to
it.
"""

from __future__ import annotations

import cmath
import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from types import MappingProxyType
from typing import Any

import numpy as np

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, DataError
from terrain.estimation.clocks import REWIND_S
from terrain.kernels import filled, inner, njit, numbers, record
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import QUATERNION_TOLERANCE
from terrain.kinematics.wheels import no_slip_twist, point_velocity
from terrain.logs.samples import longest_rise
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS, STEERING_CHANNELS
from terrain.records import Array, RunLog, Stream, read_only
from terrain.robots import Robot
from terrain.signals import low_pass_step

TICK_S = 1e-9  #: Stamps that differ by less are the same instant, rounded differently by two clocks.
#: A value is held until the next one is due and half a period more, of the slower of sensor and clock.
MAX_AGE_PERIODS = 1.5
#: After a longer gap the low-pass starts anew: its memory is not the recent past of the next sample. Steps are whole
#: periods, so that half of one between two of them leaves nothing to how stamps are rounded, nor to whether the
#: period is that of a description (live) or the median of a log (batch).
GAP_PERIODS = 5.5
#: A value that has jumped and stays is accepted after this long: it is left to the filter's gate.
BELIEVED_S = 0.1
#: What becomes of a value that jumped: it is accepted after a while; it is left out until it jumps back, as a speed
#: over ground cannot have jumped; its jump is taken off, as a heading counts from anywhere.
PASSING, LATCHED, SUBTRACTED = range(3)
#: Largest change of a row between two samples: noise, and a second what a robot can do: half a g of speed, two thirds
#: of a turn, twice the fastest steering; an accelerometer on rough terrain sees several g; roll and pitch turn by 3
#: rad/s at the most, and a jump tilts gravity. Then what becomes of a value that jumped.
JUMPS: dict[str, tuple[float, float, int]] = {
    "accel_mps2": (20.0, 1000.0, PASSING),
    "gyro_z_radps": (0.5, 20.0, PASSING),
    "imu_yaw_rad": (0.1, 4.0, PASSING),
    "steer_rad": (0.1, 5.0, PASSING),
    "camera_speed_mps": (0.1, 5.0, LATCHED),
    "camera_yaw_rate_radps": (0.2, 20.0, PASSING),
    "camera_yaw_rad": (0.1, 4.0, SUBTRACTED),
    "tilt_rad": (0.05, 3.0, LATCHED),
}
NO_JUMP = (math.inf, math.inf, PASSING)  #: Of a row whose changes are not judged.
#: The camera tells 0, 1/3, 2/3 or 1; at 1/3 (low) and below it has lost its features.
MIN_CONFIDENCE_RATIO = 0.34
MAX_RATE_FACTOR = 2.0  #: Wheel rates above this multiple of the motor's maximum are discarded.
LATE_S = 0.5  #: A camera whose first sample comes later than this after the clock's may have missed a turn.
STANDING_S = 1.0  #: Longest stretch, before the wheels turn, over which the heading at the start is averaged.
#: Wheel circumferential speed below which a wheel counts as standing (thesis 7.2.1).
STANDING_SPEED_MPS = 0.05
GNSS_LATENCY_S = 0.1  #: Age of a position when it arrives; assumed, as in the simulated receiver.
#: Position's standard deviation with a fix (RTK, thesis 5.1.1) and with a float solution (assumed).
FIX_STD_M, FLOAT_STD_M = 0.02, 0.5
GNSS_SPEED_STD_MPS = 0.03  #: Of the Doppler speed; assumed, as in the simulated receiver.
GNSS_PERIOD_S = 0.1  #: Between two positions; no robot's description tells it.
#: Memory of the vibration; low-passes of the wheels' speeds. Behind one of them, the change of a speed would
#: correlate with the noise of the speed itself, and slip speeds that grow by it would drift.
VIBRATION_S, CHANGE_S = 0.3, 0.15
MOVING_MPS = 0.05  #: A wheel that turns faster moves, and shakes what is mounted on the robot.
#: A wheel's speed is that far from its low-passed one by the ripple of the Hall steps, a saw-tooth: what grew by it
#: would drift.
RIPPLE_MPS = 0.03
WAVERING_MPS = 0.02  #: By so much the two low-passed speeds of a wheel differ in steady motion.
CRAWL_MPS = 0.1  #: w_0: well below it a slip speed no longer follows the speed of its wheel.
REST_AFTER_S = 0.5  #: Time for which nothing has to move.
#: What counts as nothing, of a wheel's low-passed speed, the gyro, the accelerometer and the camera: biases and noise
#: at rest stay below, as does a wheel that is held to and fro on soft ground.
REST_WHEEL_MPS, REST_TURN_RADPS, REST_ACCEL_MPS2, REST_SEEN_MPS = 0.01, 0.03, 0.4, 0.05
UNSEEN_AFTER_S = 0.15  #: Age of the camera's speed from which on there is none.
#: Without a camera a change of a wheel's speed counts for so long: the body, and slip, follow it late.
HELD_S = 0.5
REST_S = 1.0  #: So long wheels and gyro have to be steady: a robot that stops still rocks for half of it.
#: Wheel circumferential speed below which a side stands: a few steps of an encoder in a sample.
STANDING_MPS = 0.01
#: Largest range of a gyro that is at rest. Measured at rest its samples scatter by 0.002 rad/s (Husky on snow); an
#: engine or wind that shakes the robot by more makes it unknown whether it rests.
STEADY_RADPS = 0.02
MAX_READING_RADPS = 0.1  #: No gyro has a larger bias: a robot on a turntable is not at rest.
#: Where the channels of the IMU, the camera, its speed in the body's axes and the motors begin among those that may
#: freeze.
FIRST_IMU, FIRST_CAMERA, FIRST_SPEED, FIRST_WHEEL = 0, 9, 23, 25
#: Repetitions from which on a channel counts as frozen: of the IMU 0.1 s of a rate, 0.15 s of an attitude; of the
#: camera, at 200 Hz, 0.1 s of the quaternion, 0.05 s of a velocity (its position is not used); of a motor 0.1 s.
REPEATED = np.array(
    [10.0] * 6 + [15.0] * 3 + [np.inf] * 3 + [20.0] * 4 + [10.0] * 6 + [np.inf] + [10.0] * 2 + [5.0] * 3
)
#: A coarse channel repeats itself by nature: what counts as frozen is four times the longest run that has ended in
#: motion. Wheels are compared with each other: where all of them turn evenly, their rates may be rounded; one is
#: frozen while another has repeated itself twice at most.
LONGER, LIVELY = 4.0, 2.0
SAME = 1e-12  #: Values that differ by less are the same, turned into other axes and back.
UNMEASURED_AFTER_S = 0.5  #: After this time without a rate or an angle, the motion of a wheel is unknown.
#: Channels of each stream but the wheels, in the order in which the kernels know streams and channels.
STREAMS = {
    "steering": STEERING_CHANNELS,
    "imu": IMU_CHANNELS,
    "odometry": CAMERA_CHANNELS,
    "gnss": GNSS_CHANNELS,
}
STEERING, IMU, ODOMETRY, GNSS = range(len(STREAMS))  #: Number of each stream.

N_CHANNELS = max(map(len, STREAMS.values()))

#: Channels that never repeat themselves all at once, of streams that are left out where they do.
NOISY = {"imu": slice(0, 6), "odometry": slice(3, 13)}
#: Noise of a log that repeats exactly for so long is none: 50 samples of the camera, 25 of the IMU.
FROZEN_S = 0.25
OFF_CLOCK_S = 1.0  #: A sample that is further from every tick is of no use to anyone: its clock jumped.
HEADING_SPEED_MPS = 0.2  #: Slower, a course is noise.
#: A heading that is known no better is not known: at 1 m/s it would be 5 cm/s of sideways speed.
MAX_HEADING_STD_RAD = 0.05

CAMERA_ROWS = ("camera_speed_x_mps", "camera_speed_y_mps", "camera_yaw_rate_radps", "camera_yaw_rad")
GNSS_ROWS = ("gnss_position_x_m", "gnss_position_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps")
SIDE_ROWS = ("wheel_left_mps", "wheel_right_mps")
REST_ROW = "rest_gyro_radps"
_ROWS = {
    "wheel_radps": tuple(f"wheel_{i}_radps" for i in (1, 2, 3)),
    "accel_mps2": ("accel_x_mps2", "accel_y_mps2"),
    "gyro_z_radps": ("gyro_z_radps",),
    "imu_yaw_rad": ("imu_yaw_rad",),
    "steer_rad": tuple(f"steer_{i}_rad" for i in (1, 2, 3)),
    "camera_speed_mps": CAMERA_ROWS[:2],
    "camera_yaw_rate_radps": CAMERA_ROWS[2:3],
    "camera_yaw_rad": CAMERA_ROWS[3:],
    "gnss_position_m": GNSS_ROWS[:2],
    "gnss_speed_mps": GNSS_ROWS[2:],
    "vibration_mps2": ("vibration_mps2",),
    "growth_per_s": tuple(f"wheel_{i}_growth_per_s" for i in (1, 2, 3)),
    "change_m2ps3": tuple(f"wheel_{i}_change_m2ps3" for i in (1, 2, 3)),
    "camera_age_s": ("camera_age_s",),
    "rest_twist": ("rest_speed_x_mps", "rest_speed_y_mps", "rest_yaw_rate_radps"),
    "side_mps": SIDE_ROWS,
    "rest_gyro_radps": (REST_ROW,),
}
#: Names of all numbers of a :data:`ROW`, in its order.
ROWS = tuple(name for names in _ROWS.values() for name in names)

DERIVED_ROWS = ROWS[ROWS.index("vibration_mps2") : ROWS.index(SIDE_ROWS[0])]
_SIDES = (*SIDE_ROWS, "gyro_z_radps", *GNSS_ROWS, REST_ROW)
ROWS_OF_DRIVE: dict[str, tuple[str, ...]] = {"swerve": ROWS[:-3], "skid_steer": _SIDES, "tracked": _SIDES}
"""Rows that a drive measures, of a swerve robot in the order of (6.3).

Positions and GNSS speeds are in the world frame, east and north from where the antenna first was; yaw counts
from east once the heading at the start is given; all else is in body axes."""


def _sized(kind: Any, n: int) -> Any:
    return kind if n == 1 else (kind, n)


#: What is measured at a tick, NaN where nothing is: the numbers of :data:`ROWS`, and the variances of
#: :data:`GNSS_ROWS`.
ROW = record(
    {name: _sized(float, len(names)) for name, names in _ROWS.items()} | {"gnss_variance": (float, 4)}
)
#: What is behind a low-pass and held, by the stream that measures it; of the tilt jumps are seen only.
_SIGNALS = {
    "steer_rad": "steering",
    **dict.fromkeys(("accel_mps2", "gyro_z_radps", "imu_yaw_rad", "tilt_rad"), "imu"),
    **dict.fromkeys(("camera_speed_mps", "camera_yaw_rate_radps", "camera_yaw_rad"), "odometry"),
    **dict.fromkeys(("gnss_position_m", "gnss_speed_mps"), "gnss"),
}
#: What is constant of a signal: low-pass, longest step, oldest value, the largest change between two samples (a
#: constant, and a part per second), whether a sample is given at one tick only, and what becomes of a jump.
LIMIT = record(numbers("time_constant_s gap_s age_s jump jump_per_s") | {"once": bool, "policy": int})
#: Memory of a signal: value, instant, arrival and low-pass output of the last sample, whether it was given at a tick;
#: value and instant that jumps are judged against, since when values have been jumping; and of a signal that is not
#: passing the last sample, taken or not, its instant, the sum of its jumps, since when that is not 0, and whether a
#: sample before it is known to be right.
LINE = record(
    numbers("value instant_s came_s low_passed judged judged_s jumping_s raw raw_s jumped_by jumped_s")
    | {"was_given": bool, "is_followed": bool}
)
#: Of a channel that may freeze: last value, number of repetitions, longest run, and whether this one began in motion.
CHANNEL = record(numbers("last repeated longest") | {"began_in_motion": bool})

_TURN = record(numbers("last_rad turned_rad"))  # of an unwrapped angle the last one, and the turns so far
_AVERAGE = record({"sum": float, "n": int, "mean": float})
_SIZES = {name: len(_ROWS.get(name, "xy")) for name in _SIGNALS}

#: What is constant of a robot's feed.
SETTINGS = record(
    {name: _sized(LIMIT, n) for name, n in _SIZES.items()}
    | {"latency_s": (float, len(STREAMS)), "is_steered": bool}
    | numbers("reduction_ratio fastest_radps wheel_radius_m initial_yaw_rad gyro_bias_radps")
    | dict.fromkeys(("steering_zeros_rad", "accel_bias_mps2", "accel_scale_ratio"), (float, 3))
)

COUNTS = ("not_finite", "frozen", "low_confidence", "no_rotation", "jump")
FEED = record(
    {name: _sized(LINE, n) for name, n in _SIZES.items()}
    | {"steer_turns": (_TURN, 3), "imu_turns": _TURN, "camera_turns": _TURN, "camera_yaw_0_rad": float}
    | {"channels": (CHANNEL, REPEATED.size)}
    | {"before": (float, (2, N_CHANNELS)), "last_s": (float, len(STREAMS))}
    | {"gnss_origin_m": (float, 2), "gnss_variance": float}
    | numbers("vibration_square vibration_s tick_s rest_since_s camera_s")
    | dict.fromkeys(("wheel_once_mps", "wheel_twice_mps", "wheel_change_m2ps3"), (float, 3))
    | dict.fromkeys(("rate_received_s", "steer_received_s"), (float, 3))
    | {"start_s": float, "has_moved": bool, "camera_has_started": bool, "camera_offset_rad": float}
    | {"imu_yaw_start": _AVERAGE, "camera_yaw_start": _AVERAGE}
    | numbers("gyro_angle_rad gyro_time_s standing_s gyro_low_radps gyro_high_radps gyro_sum_radps")
    | {"n_gyro": int, "wheels_not_finite": int, "wheels_beyond": int}
    | dict.fromkeys(COUNTS, (int, len(STREAMS)))
)
"""All that is remembered of the samples: a copy is a snapshot.

The signals; turns of angles; channels that may freeze; the last complete sample of IMU and camera, and of each
stream the last stamp taken; positions' origin and variance; what the derived rows need; what each wheel was
measured by last; the yaw at the start; the gyro since the last tick, and at rest; and counts of what was left
out."""

_kernel, _inner = njit(error_model="numpy"), inner(error_model="numpy")


def feed_settings(
    robot: Robot,
    period_s: Mapping[str, float],
    initial_yaw_rad: float,
    gnss_latency_s: float,
    time_constant_s: float | None = None,
) -> Array:
    """Return what is constant of a robot's feed, with neutral values for what it does not have.

    Parameters
    ----------
    period_s : of the wheels, and of each stream that comes
    initial_yaw_rad : heading of the start
    gnss_latency_s : age of a position when it arrives
    time_constant_s : of the low-pass on all but the wheels; by default what each sensor lacks to the encoders'
    """
    for name, value in (("time_constant_s", time_constant_s), ("gnss_latency_s", gnss_latency_s)):
        if value is not None and not 0 <= value < np.inf:
            raise ConfigError(f"{name} is {value:g}, a time from zero up is required")
    motors, sensors, camera = robot.completed.motors, robot.completed.sensors, robot.completed.camera
    zeros = robot.steering_zeros_rad.tolist()
    settings = filled(
        SETTINGS,
        latency_s=[0.0, sensors.imu_latency_s, camera.latency_s, gnss_latency_s],
        is_steered=robot.steered,
        reduction_ratio=motors.reduction_ratio,
        fastest_radps=MAX_RATE_FACTOR * motors.speed_max_radps,
        wheel_radius_m=robot.wheel_radius_m,
        initial_yaw_rad=initial_yaw_rad,
        steering_zeros_rad=(zeros + [0.0] * 3)[:3],
        gyro_bias_radps=sensors.gyro_bias_z_radps,
        accel_bias_mps2=[getattr(sensors, f"accel_bias_{axis}_mps2") for axis in "xyz"],
        accel_scale_ratio=[getattr(sensors, f"accel_scale_{axis}_ratio") for axis in "xyz"],
    )
    lag_s = dict.fromkeys(STREAMS, robot.encoder_lag_s if time_constant_s is None else time_constant_s)
    if robot.describes("camera") and time_constant_s is None:
        lag_s["odometry"] = max(robot.encoder_lag_s - camera.time_constant_s, 0.0)
    for name, stream in _SIGNALS.items():
        judged = robot.steered or name in ("gyro_z_radps", "tilt_rad")
        jump = JUMPS.get(name, NO_JUMP) if judged else NO_JUMP
        limits = lag_s[stream], period_s.get(stream, math.nan), period_s["wheels"]
        settings[name] = signal_limits(*((0.0, 0.02, 0.0) if name == "tilt_rad" else limits), jump)
    return settings


def signal_limits(
    time_constant_s: float, period_s: float, tick_s: float, jump: tuple[float, float, int] = NO_JUMP
) -> Array:
    """Return the :data:`LIMIT` (1,) of a signal by its low-pass (0 for none), its sensor's period and the clock's."""
    return filled(
        LIMIT,
        time_constant_s=time_constant_s,
        gap_s=GAP_PERIODS * period_s,
        age_s=MAX_AGE_PERIODS * np.fmax(period_s, tick_s),
        once=period_s > MAX_AGE_PERIODS * tick_s + TICK_S,
        jump=jump[0],
        jump_per_s=jump[1],
        policy=jump[2],
    )


def new_feed() -> Array:
    """Return the memory before the first sample."""
    feed = filled(
        FEED, np.nan, last_s=-np.inf, rate_received_s=-np.inf, steer_received_s=-np.inf, camera_offset_rad=0.0
    )
    feed["gyro_angle_rad"] = feed["gyro_time_s"] = 0.0
    feed["channels"]["repeated"] = feed["channels"]["longest"] = 0.0
    for name in ("imu_yaw_start", "camera_yaw_start"):
        feed[name] = 0
    return feed


@_inner
def _sum_of_jumps(value: float, instant_s: float, line: Any, limit: Any) -> float:
    """Return the sum of a signal's jumps: 0 after one that jumped back, and for a latched one after a gap."""
    step_s, change, before = instant_s - line.raw_s, value - line.raw, line.jumped_by
    line.raw, line.raw_s = value, instant_s
    if math.isnan(step_s) or (limit.policy == LATCHED and step_s > limit.gap_s):
        line.jumped_by, line.is_followed = 0.0, False
    else:
        if abs(change) > limit.jump + limit.jump_per_s * step_s and line.is_followed:
            line.jumped_by += change  # of the first sample after a gap it was that one that was wrong
            if abs(line.jumped_by) <= 0.5 * limit.jump:
                line.jumped_by = 0.0
        line.is_followed = True
    if line.jumped_by == 0.0:
        line.jumped_s = np.nan
    elif before == 0.0:
        line.jumped_s = instant_s
    return float(line.jumped_by)


@_inner
def _take(value: float, instant_s: float, came_s: float, line: Any, limit: Any) -> bool:
    """Put a sample behind the low-pass of its signal; return True, and do not, where it jumped."""
    if math.isnan(value):
        return False
    if limit.policy != PASSING:
        jumped_by = _sum_of_jumps(value, instant_s, line, limit)
        if limit.policy == LATCHED and jumped_by != 0.0:
            return True
        value -= jumped_by
    elif abs(value - line.judged) > limit.jump + limit.jump_per_s * (instant_s - line.judged_s):
        if math.isnan(line.jumping_s):
            line.jumping_s = instant_s
        if instant_s - line.jumping_s < BELIEVED_S - TICK_S:
            return True
    line.judged, line.judged_s, line.jumping_s = value, instant_s, np.nan
    step_s, smooth = instant_s - line.instant_s, value
    if limit.time_constant_s > 0.0 and step_s <= limit.gap_s:
        smooth = low_pass_step(value, line.value, line.low_passed, step_s, limit.time_constant_s)
    line.value, line.instant_s, line.came_s, line.low_passed = value, instant_s, came_s, smooth
    line.was_given = False
    return False


@_inner
def _at_tick(time_s: float, line: Any, limit: Any) -> float:
    """Return a signal's value at a tick, the low-pass run on to it; NaN where too old or given before.

    From the sample to the tick its input is held, and the held value adds no delay: the tick's value is the
    sample's plus what the low-pass is still behind it, ``(y - x) exp(-dt/tau)``.
    """
    given = limit.once and line.was_given
    line.was_given = True
    if given or not time_s - line.came_s <= limit.age_s + TICK_S:
        return np.nan
    behind = line.low_passed - line.value
    if limit.time_constant_s > 0.0:
        behind *= math.exp((line.instant_s - time_s) / limit.time_constant_s)
    return float(line.value + behind)


@_inner
def repeats(feed: Any, c: int) -> bool:
    """Say whether a channel has repeated itself for longer than it does by nature."""
    channel = feed.channels[c]
    return bool(channel.repeated >= max(REPEATED[c], LONGER * channel.longest))


@_inner
def _mask_frozen(sample: Array, first: int, moving: bool, feed: Any) -> Array:
    """Return a sample (c,) with NaN where a channel, counted from the first, is frozen; count its repetitions.

    A first place that is a literal would be a type, and a compilation, of its own.
    """
    masked = sample.copy()
    for c in range(sample.size):
        channel = feed.channels[first + c]
        if abs(sample[c] - channel.last) <= SAME:
            channel.repeated += 1.0
        elif not np.isnan(sample[c]):
            if moving and channel.began_in_motion:
                channel.longest = max(channel.longest, channel.repeated)
            channel.repeated, channel.began_in_motion = 0.0, moving
        if not np.isnan(sample[c]):
            channel.last = sample[c]
        if moving and repeats(feed, first + c):
            masked[c] = np.nan
    return masked


@_inner
def is_moving(feed: Any) -> bool:
    """Say whether a wheel turns faster than a crawl, by the low-passed speeds."""
    moving = False
    for i in range(3):
        moving |= abs(feed.wheel_once_mps[i]) > MOVING_MPS
    return bool(moving)


@_inner
def _unwrap(angle_rad: float, turn: Any) -> float:
    """Return the angle without jumps of a turn."""
    if math.isnan(angle_rad):
        return np.nan
    step = angle_rad - turn.last_rad
    if math.isnan(step):
        turn.turned_rad = 0.0
    elif abs(step) >= np.pi:
        short = (step + np.pi) % (2 * np.pi) - np.pi
        turn.turned_rad += (np.pi if short == -np.pi and step > 0 else short) - step
    turn.last_rad = angle_rad
    return float(angle_rad + turn.turned_rad)


@_inner
def _take_steering(sample: Array, came_s: float, settings: Any, feed: Any) -> bool:
    """Steering angles without their zeros; the first one lies within half a turn."""
    jumped = False
    for i in range(3):
        angle = _unwrap(wrapped(sample[i] - settings.steering_zeros_rad[i]), feed.steer_turns[i])
        jumped |= _take(angle, came_s, came_s, feed.steer_rad[i], settings.steer_rad[i])
    return bool(jumped)


@_inner
def _take_imu(sample: Array, instant_s: float, came_s: float, settings: Any, feed: Any) -> bool:
    """Calibrated yaw rate, acceleration of the body without gravity, yaw, and mean square of the vibration.

    A sample is ``scale * truth + bias``.  The specific force at rest is g times the world's vertical in body
    axes, ``g (-sin pitch, sin roll cos pitch, cos roll cos pitch)``: with the nose up (pitch negative) it
    points forward too, with the left side up (roll positive) to the left.
    """
    roll, pitch = sample[6], sample[7]
    for i in range(2):
        line, limit, angle = feed.tilt_rad[i], settings.tilt_rad[i], sample[6 + i]
        if not math.isnan(angle) and _sum_of_jumps(angle, instant_s, line, limit) != 0.0:
            roll = pitch = np.nan
    level_x, level_y = -GRAVITY_MPS2 * math.sin(pitch), GRAVITY_MPS2 * math.sin(roll) * math.cos(pitch)
    bias, scale, jumped = settings.accel_bias_mps2, settings.accel_scale_ratio, False
    for i, level in ((0, level_x), (1, level_y)):
        accel = (sample[3 + i] - bias[i]) / scale[i] - level
        jumped |= _take(accel, instant_s, came_s, feed.accel_mps2[i], settings.accel_mps2[i])
    gyro, limit = feed.gyro_z_radps, settings.gyro_z_radps
    before_s, before_radps = gyro.instant_s, gyro.low_passed
    if _take(sample[2] - settings.gyro_bias_radps, instant_s, came_s, gyro, limit):
        jumped = True
    else:  # the angle since the last tick
        step_s = gyro.instant_s - before_s
        if 0.0 < step_s <= limit.gap_s:
            feed.gyro_angle_rad += 0.5 * (before_radps + gyro.low_passed) * step_s
            feed.gyro_time_s += step_s
    yaw = _unwrap(sample[8], feed.imu_turns)
    jumped |= _take(yaw, instant_s, came_s, feed.imu_yaw_rad, settings.imu_yaw_rad)
    accel = (sample[5] - bias[2]) / scale[2] - GRAVITY_MPS2 * math.cos(roll) * math.cos(pitch)
    if not math.isnan(accel):
        step_s, square = instant_s - feed.vibration_s, accel * accel
        feed.vibration_s = instant_s
        if not step_s > 0.0 or math.isnan(feed.vibration_square):
            feed.vibration_square = square
        else:
            feed.vibration_square += (square - feed.vibration_square) * -math.expm1(-step_s / VIBRATION_S)
    return bool(jumped)


@_inner
def _take_odometry(
    sample: Array, instant_s: float, came_s: float, settings: Any, feed: Any, moving: bool
) -> bool:
    """Speed of the camera point, yaw rate and yaw: ``kinematics.camera.body_motion`` of one sample."""
    # the camera's axes renamed to the body's: (-z, -x, y), of vectors and of the quaternion's vector alike
    x, y, z, w = -sample[5], -sample[3], sample[4], sample[6]
    v_x, v_y, v_z = -sample[9], -sample[7], sample[8]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1.0) <= QUATERNION_TOLERANCE:
        feed.no_rotation[ODOMETRY] += not math.isnan(norm)
        return False
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    r_00, r_11 = x * x - y * y - z * z + w * w, -x * x + y * y - z * z + w * w
    r_01, r_10 = 2.0 * (x * y - z * w), 2.0 * (x * y + z * w)
    r_20, r_21 = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w)
    yaw = _unwrap(math.atan2(r_10, r_00), feed.camera_turns)
    if math.isnan(feed.camera_yaw_0_rad):
        feed.camera_yaw_0_rad = yaw
    along, left = r_00 * v_x + r_10 * v_y + r_20 * v_z, r_01 * v_x + r_11 * v_y + r_21 * v_z
    speed = _mask_frozen(np.array([along, left]), np.int64(FIRST_SPEED), moving, feed)
    line, turned_by = feed.camera_yaw_rad, feed.camera_yaw_rad.jumped_by
    jumped = _take(yaw - feed.camera_yaw_0_rad, instant_s, came_s, line, settings.camera_yaw_rad)
    turned = line.jumped_by != turned_by  # that turns the speeds: they have not jumped themselves
    for i in range(2):
        if turned:
            feed.camera_speed_mps[i].raw = speed[i]
        jumped |= _take(speed[i], instant_s, came_s, feed.camera_speed_mps[i], settings.camera_speed_mps[i])
    rate, limit = feed.camera_yaw_rate_radps, settings.camera_yaw_rate_radps
    jumped |= _take(sample[11], instant_s, came_s, rate, limit)
    return bool(jumped)


@_inner
def _take_gnss(sample: Array, instant_s: float, came_s: float, settings: Any, feed: Any) -> None:
    """Position from the origin, by default the first one, and speed; the position's variance is kept."""
    std = sample[4]
    if not std > 0.0:
        std = FIX_STD_M if sample[5] >= 0.5 else FLOAT_STD_M
    known = not (math.isnan(sample[0]) or math.isnan(sample[1]))
    if known and math.isnan(feed.gnss_origin_m[0]):
        feed.gnss_origin_m[0], feed.gnss_origin_m[1] = sample[0], sample[1]
    if known:
        feed.gnss_variance = std * std
    for i in range(2):
        place = sample[i] - feed.gnss_origin_m[i] if known else np.nan
        _take(place, instant_s, came_s, feed.gnss_position_m[i], settings.gnss_position_m[i])
        _take(sample[2 + i], instant_s, came_s, feed.gnss_speed_mps[i], settings.gnss_speed_mps[i])


@_inner
def _take_sample(
    stream: int, sample: Array, instant_s: float, came_s: float, settings: Any, feed: Any
) -> None:
    """Take a sample (channels,) of any stream but the wheels, that was measured and arrived at two instants."""
    moving, jumped = is_moving(feed), False
    if stream == STEERING:
        jumped = _take_steering(sample, came_s, settings, feed)
    elif stream == IMU:
        sample = _mask_frozen(sample, np.int64(FIRST_IMU), moving, feed)
        jumped = _take_imu(sample, instant_s, came_s, settings, feed)
    elif stream == ODOMETRY:
        sample = _mask_frozen(sample, np.int64(FIRST_CAMERA), moving, feed)
        jumped = _take_odometry(sample, instant_s, came_s, settings, feed, moving)
    else:
        _take_gnss(sample, instant_s, came_s, settings, feed)
    feed.jump[stream] += jumped


@_inner
def _take_wheels(wheels: Array, settings: Any, feed: Any, row: Any) -> None:
    """Write the rates (3,) of the wheels, or the speeds (2,) of the sides."""
    for i in range(3):
        row.wheel_radps[i] = np.nan
    if not settings.is_steered:
        row.side_mps[0], row.side_mps[1] = wheels[0], wheels[1]
        return
    moving, lively, beyond = is_moving(feed), False, False
    _mask_frozen(wheels, np.int64(FIRST_WHEEL), moving, feed)
    for i in range(3):
        lively |= feed.channels[FIRST_WHEEL + i].repeated <= LIVELY
    for i in range(3):
        frozen = moving and lively and repeats(feed, FIRST_WHEEL + i)
        rate = wheels[i] / settings.reduction_ratio
        known = math.isfinite(rate)
        too_fast = known and abs(rate) > settings.fastest_radps
        beyond |= too_fast
        row.wheel_radps[i] = np.nan if too_fast or not known or frozen else rate
    feed.wheels_beyond += beyond


@_inner
def _derive(time_s: float, settings: Any, feed: Any, row: Any) -> None:
    """Write the rows that follow from others."""
    step_s = time_s - feed.tick_s
    feed.tick_s = time_s
    row.vibration_mps2 = math.sqrt(feed.vibration_square)
    still = True
    keep = math.exp(-step_s / CHANGE_S) if step_s > 0.0 else 0.0
    if not math.isnan(row.camera_speed_mps[0]):
        feed.camera_s = time_s
    row.camera_age_s = time_s - feed.camera_s
    for i in range(3):
        speed = row.wheel_radps[i] * settings.wheel_radius_m
        once, twice = feed.wheel_once_mps[i], feed.wheel_twice_mps[i]
        still &= abs(twice) <= REST_WHEEL_MPS and abs(speed) <= MOVING_MPS
        rise = once - twice
        change = twice * math.copysign(max(abs(rise) - WAVERING_MPS, 0.0), rise) / CHANGE_S
        row.growth_per_s[i] = change / (twice * twice + CRAWL_MPS * CRAWL_MPS)
        change = (abs(speed) + CRAWL_MPS) * max(abs(speed - once) - RIPPLE_MPS, 0.0) / CHANGE_S
        held = feed.wheel_change_m2ps3[i] * math.exp(-step_s / HELD_S) if step_s > 0.0 else np.nan
        feed.wheel_change_m2ps3[i] = change if math.isnan(held) or change > held else held
        unseen = not row.camera_age_s <= UNSEEN_AFTER_S
        row.change_m2ps3[i] = feed.wheel_change_m2ps3[i] if unseen else change
        if math.isnan(once) or not step_s > 0.0:
            feed.wheel_once_mps[i] = feed.wheel_twice_mps[i] = speed
        elif not math.isnan(speed):
            feed.wheel_twice_mps[i] = once + (twice - once) * keep
            feed.wheel_once_mps[i] = speed + (once - speed) * keep
    still &= abs(row.gyro_z_radps) <= REST_TURN_RADPS
    for i in range(2):
        still &= abs(row.accel_mps2[i]) <= REST_ACCEL_MPS2
        still &= not abs(row.camera_speed_mps[i]) > REST_SEEN_MPS
    if not still:
        feed.rest_since_s = np.nan
    elif math.isnan(feed.rest_since_s):
        feed.rest_since_s = time_s
    rests = time_s - feed.rest_since_s >= REST_AFTER_S
    for i in range(3):
        row.rest_twist[i] = 0.0 if rests else np.nan
    if rests:
        for i in range(2):  # at rest a camera that measures none is right again
            line = feed.camera_speed_mps[i]
            if abs(line.raw) <= REST_SEEN_MPS:
                line.jumped_by, line.jumped_s = 0.0, np.nan


@_kernel
def rest_at(time_s: float, left_mps: float, right_mps: float, gyro_radps: float, feed: Any) -> float:
    """Return the mean of the gyro over the last :data:`REST_S` at rest, once for each such time; else NaN.

    A stamp that was set back starts anew; measurements are NaN where there is none.
    """
    stands = abs(left_mps) < STANDING_MPS and abs(right_mps) < STANDING_MPS
    if not (stands and abs(gyro_radps) < MAX_READING_RADPS):
        feed.standing_s = np.nan
        return np.nan
    low, high = min(feed.gyro_low_radps, gyro_radps), max(feed.gyro_high_radps, gyro_radps)
    if not (high - low <= STEADY_RADPS and time_s > feed.standing_s):
        feed.standing_s, feed.n_gyro = time_s, 1
        feed.gyro_low_radps = feed.gyro_high_radps = feed.gyro_sum_radps = gyro_radps
        return np.nan
    feed.gyro_low_radps, feed.gyro_high_radps = low, high
    feed.gyro_sum_radps += gyro_radps
    feed.n_gyro += 1
    if time_s - feed.standing_s < REST_S - TICK_S:
        return np.nan
    mean_radps = feed.gyro_sum_radps / feed.n_gyro
    feed.standing_s, feed.gyro_sum_radps, feed.n_gyro = time_s, 0.0, 0
    return float(mean_radps)


@_inner
def _take_tick(time_s: float, wheels: Array, settings: Any, feed: Any, row: Any) -> None:
    """Write the row of a tick but for its yaw, which :func:`refer_yaw` counts from the start.

    ``wheels`` are the rates (3,) of the motors, or the speeds (2,) of the sides.
    """
    row.side_mps[0] = row.side_mps[1] = row.rest_gyro_radps = np.nan
    _take_wheels(wheels, settings, feed, row)
    for i in range(3):
        row.steer_rad[i] = _at_tick(time_s, feed.steer_rad[i], settings.steer_rad[i])
        if not math.isnan(row.wheel_radps[i]):
            feed.rate_received_s[i] = time_s
        if not math.isnan(row.steer_rad[i]):
            feed.steer_received_s[i] = time_s
    for i in range(2):
        row.accel_mps2[i] = _at_tick(time_s, feed.accel_mps2[i], settings.accel_mps2[i])
        row.camera_speed_mps[i] = _at_tick(time_s, feed.camera_speed_mps[i], settings.camera_speed_mps[i])
        row.gnss_position_m[i] = _at_tick(time_s, feed.gnss_position_m[i], settings.gnss_position_m[i])
        row.gnss_speed_mps[i] = _at_tick(time_s, feed.gnss_speed_mps[i], settings.gnss_speed_mps[i])
        row.gnss_variance[i] = np.nan if math.isnan(row.gnss_position_m[i]) else feed.gnss_variance
        row.gnss_variance[2 + i] = np.nan if math.isnan(row.gnss_speed_mps[i]) else GNSS_SPEED_STD_MPS**2
    row.gyro_z_radps = _at_tick(time_s, feed.gyro_z_radps, settings.gyro_z_radps)
    row.imu_yaw_rad = _at_tick(time_s, feed.imu_yaw_rad, settings.imu_yaw_rad)
    line, limit = feed.camera_yaw_rate_radps, settings.camera_yaw_rate_radps
    row.camera_yaw_rate_radps = _at_tick(time_s, line, limit)
    row.camera_yaw_rad = _at_tick(time_s, feed.camera_yaw_rad, settings.camera_yaw_rad)
    if not settings.is_steered and not math.isnan(row.gyro_z_radps) and feed.gyro_time_s > 0.0:
        row.gyro_z_radps = feed.gyro_angle_rad / feed.gyro_time_s
    feed.gyro_angle_rad = feed.gyro_time_s = 0.0
    _derive(time_s, settings, feed, row)
    if not settings.is_steered:
        row.rest_gyro_radps = rest_at(time_s, row.side_mps[0], row.side_mps[1], row.gyro_z_radps, feed)


@_inner
def _average_yaw(time_s: float, settings: Any, feed: Any, row: Any) -> None:
    """Take a tick into the averages of the yaw rows at the start."""
    if math.isnan(feed.start_s):
        feed.start_s = time_s
    if time_s > feed.start_s + STANDING_S:
        feed.has_moved = True
    for i in range(3):
        if abs(row.wheel_radps[i] * settings.wheel_radius_m) > STANDING_SPEED_MPS:
            feed.has_moved = True
    for yaw_rad, average in (
        (row.imu_yaw_rad, feed.imu_yaw_start),
        (row.camera_yaw_rad, feed.camera_yaw_start),
    ):
        if not math.isnan(yaw_rad) and (not feed.has_moved or average.n == 0):
            average.sum += yaw_rad
            average.n += 1
            average.mean = average.sum / average.n


@_inner
def _refer_yaw(time_s: float, settings: Any, feed: Any, row: Any) -> None:
    """Count the yaw rows of a tick from the averages."""
    initial = settings.initial_yaw_rad
    row.imu_yaw_rad = imu = row.imu_yaw_rad - feed.imu_yaw_start.mean + initial
    row.camera_yaw_rad = seen = row.camera_yaw_rad - feed.camera_yaw_start.mean + initial
    if math.isnan(seen):
        return
    if not feed.camera_has_started:
        feed.camera_has_started = True
        if not math.isnan(imu) and time_s > feed.start_s + LATE_S:
            feed.camera_offset_rad = imu - initial
    seen += feed.camera_offset_rad
    if not math.isnan(imu):
        seen += 2 * np.pi * np.rint((imu - seen) / (2 * np.pi))
    row.camera_yaw_rad = seen


@_kernel
def take_live(stream: int, sample: Array, complete: bool, came_s: float, settings: Any, feed: Any) -> None:
    """Take a sample as it came, without a look ahead: unless it repeats the one before, or is not confident."""
    settings, feed = settings[0], feed[0]
    feed.last_s[stream] = came_s
    feed.not_finite[stream] += not complete
    first, last = (0, 6) if stream == IMU else (3, 13)
    if complete and stream in (IMU, ODOMETRY):
        before, same, n_known = feed.before[stream - IMU], True, 0
        for c in range(first, last):
            if not math.isnan(sample[c]):
                n_known += 1
                same &= sample[c] == before[c]
            before[c] = sample[c]
        if same and n_known > 0:
            feed.frozen[stream] += 1
            for c in range(9 if stream == IMU else 14):
                feed.channels[c if stream == IMU else FIRST_CAMERA + c].repeated += 1.0
            return
    if stream == ODOMETRY and sample[13] < MIN_CONFIDENCE_RATIO:
        feed.low_confidence[stream] += 1
        return
    _take_sample(stream, sample, came_s - settings.latency_s[stream], came_s, settings, feed)


@_kernel
def tick_live(time_s: float, wheels: Array, settings: Any, feed: Any, row: Any) -> None:
    """Write the row of a tick, yaw counted from the averages so far."""
    settings, feed, row = settings[0], feed[0], row[0]
    _take_tick(time_s, wheels, settings, feed, row)
    if settings.is_steered:
        _average_yaw(time_s, settings, feed, row)
        _refer_yaw(time_s, settings, feed, row)


@_kernel
def _run(
    clock: Array,
    wheels: Array,
    came_s: tuple[Array, ...],
    instant_s: tuple[Array, ...],
    samples: tuple[Array, ...],
    settings: Any,
    feed: Any,
    rows: Any,
) -> None:
    """Write the rows (n,) of all ticks of a log but for their yaw; samples by stream, as :data:`STREAMS`."""
    settings, feed = settings[0], feed[0]
    due = np.zeros(len(came_s), np.int64)
    for n in range(clock.size + 1):
        time_s = clock[n] + TICK_S if n < clock.size else np.inf  # what comes after the last tick is counted
        for stream in range(len(came_s)):
            k = due[stream]
            while k < came_s[stream].size and came_s[stream][k] <= time_s:
                instant = instant_s[stream][k]
                _take_sample(stream, samples[stream][k], instant, came_s[stream][k], settings, feed)
                k += 1
            due[stream] = k
        if n < clock.size:
            _take_tick(clock[n], wheels[n], settings, feed, rows[n])


@_kernel
def _refer_all(clock: Array, causal: bool, settings: Any, feed: Any, rows: Any) -> None:
    """Count the yaw rows from the start: from the averages of all ticks, or ``causal`` of those so far."""
    settings, feed = settings[0], feed[0]
    if not causal:
        for n in range(clock.size):
            _average_yaw(clock[n], settings, feed, rows[n])
    for n in range(clock.size):
        if causal:
            _average_yaw(clock[n], settings, feed, rows[n])
        _refer_yaw(clock[n], settings, feed, rows[n])


def forget_times(feed: Any) -> None:
    """Begin anew after a clock was set back: what is remembered of its other time is of no use."""
    fresh = new_feed()
    names = set(_SIGNALS) | {"before", "last_s", "rate_received_s", "steer_received_s"}
    names |= {"vibration_square", "vibration_s", "tick_s", "rest_since_s", "camera_s"}
    names |= {"wheel_once_mps", "wheel_twice_mps", "wheel_change_m2ps3", "gyro_angle_rad", "gyro_time_s"}
    for name in names:
        feed[name] = fresh[name]
    feed["channels"]["repeated"] = 0.0


def measurements(rows: Any) -> Array:
    """Return rows (n,) as numbers (n, m) in the order of :data:`ROWS`; a view."""
    values: Array = rows.view(np.float64).reshape(len(rows), -1)[:, : len(ROWS)]
    return values


def on_clock(
    clock: Array, time_s: Array, signals: Mapping[str, Array], time_constant_s: float
) -> dict[str, Array]:
    """Return each signal (n,) behind the low-pass, at the ticks of the clock.

    Instants of samples and ticks increase; a missing sample is NaN; a time constant of 0 is no low-pass.
    """
    limits = signal_limits(time_constant_s, median_step_s(time_s), median_step_s(clock))
    return {
        row: _on_clock(
            clock, time_s, np.where(np.isfinite(signal), signal, np.nan), filled(LINE, np.nan), limits
        )
        for row, signal in signals.items()
    }


@_kernel
def _on_clock(clock: Array, time_s: Array, signal: Array, line: Array, limit: Array) -> Array:
    out, line, limit, k = np.empty(clock.size), line[0], limit[0], 0
    for n in range(clock.size):
        while k < time_s.size and time_s[k] <= clock[n] + TICK_S:
            _take(signal[k], time_s[k], time_s[k], line, limit)
            k += 1
        out[n] = _at_tick(clock[n], line, limit)
    return out


#: Samples of a stream that wait for the wheels; five seconds of a camera.
QUEUE = 1024
CLOCK_SET_S = 1.0  #: Samples that are so far behind, many in a row, are of a clock that was set back.
Due = list[tuple[float, bool, Array]]
"""Of samples their stamp, whether all of their numbers are finite, and those, NaN where they are not."""


def places_among(names: Sequence[str], among: Sequence[str]) -> Array:
    """Return the place of each name among others, -1 where it is not there."""
    return np.array([list(among).index(name) if name in among else -1 for name in names])


def check_channels(stream: str, names: Iterable[str], known: Sequence[str]) -> None:
    """Raise ``ConfigError`` where a stream that is read sample by sample lacks a channel."""
    for lacking in (name for name in names if name not in known):
        raise ConfigError(f"channels of {stream!r} are {list(known)}: {lacking!r} must be among them")


class SampleQueue:
    """Samples of a stream that are not due, by stamp: late ones go where they belong.

    Of two of which one is further ahead than any is late, the one goes that the other shows to be wrong.

    ``columns`` say where each channel of the schema stands in the readings, -1 where it does not.
    """

    def __init__(self, columns: Array) -> None:
        self._columns, self._is_lacking = columns, columns < 0
        self.waiting: Due = []
        self.counts: Counter[str] = Counter()
        self.n_behind = 0  # samples in a row that are stamped long before the last that was taken

    def push(self, time_s: Array, values: Array, last_s: float) -> None:
        """Queue samples; ``last_s`` is the stamp of the last that was taken out."""
        samples = np.ascontiguousarray(values[:, self._columns])  # one layout: one compiled form
        samples[:, self._is_lacking] = np.nan
        finite = np.isfinite(samples)
        samples[~finite] = np.nan
        finite[:, self._is_lacking] = True
        waiting, complete = self.waiting, np.all(finite, axis=1).tolist()
        for stamp_s, whole, sample in zip(time_s.tolist(), complete, samples, strict=True):
            place = bisect_left(waiting, stamp_s, key=itemgetter(0))
            if not last_s < stamp_s < math.inf or (place < len(waiting) and waiting[place][0] == stamp_s):
                self.counts["stamp does not increase"] += 1
                self.n_behind = self.n_behind + 1 if stamp_s <= last_s - CLOCK_SET_S else 0
                continue
            if waiting and waiting[-1][0] - stamp_s > REWIND_S:  # one of the two has a wrong stamp
                self.counts["stamp does not increase"] += 1
                if len(waiting) > 1 and waiting[-2][0] - stamp_s > REWIND_S:
                    continue
                waiting.pop()
            if len(waiting) == QUEUE:
                self.counts["waited too long"] += QUEUE // 2
                del waiting[: QUEUE // 2]
                place = max(place - QUEUE // 2, 0)
            waiting.insert(place, (stamp_s, whole, sample))
            self.n_behind = 0

    def take(self, time_s: float) -> Due:
        """Take out what came by a tick; what is stamped far ahead of it goes."""
        waiting = self.waiting
        n = next((k for k, (stamp_s, _, _) in enumerate(waiting) if stamp_s > time_s + TICK_S), len(waiting))
        due = waiting[:n]
        del waiting[:n]
        while waiting and waiting[-1][0] > time_s + OFF_CLOCK_S:
            self.counts["off the clock"] += 1
            waiting.pop()
        return due


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementTable:
    """What a filter measures at each tick of its clock; NaN where a sensor gave nothing."""

    time_s: Array  #: (n,) stamps of the wheels stream
    rows: tuple[str, ...]  #: name of each of the m measurements
    z: Array  #: (n, m)
    gnss_variance: Array  #: (n, 4) of :data:`GNSS_ROWS`, in their units squared; NaN where they are
    #: samples left out, as counts by stream and kind (``"imu: frozen"``)
    dropped: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, n_columns in (("time_s", None), ("z", len(self.rows)), ("gnss_variance", len(GNSS_ROWS))):
            array = read_only(getattr(self, name))
            object.__setattr__(self, name, array)
            shape = (self.time_s.size,) if n_columns is None else (self.time_s.size, n_columns)
            if array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, {shape} is needed")
        object.__setattr__(self, "rows", tuple(self.rows))
        object.__setattr__(self, "dropped", MappingProxyType(dict(self.dropped)))

    def at(self, time_s: Array) -> MeasurementTable:
        """Return the table of some of its own instants, as a filter's track has them that left rows out."""
        if np.array_equal(time_s, self.time_s):
            return self
        n = np.searchsorted(self.time_s, time_s)
        return MeasurementTable(self.time_s[n], self.rows, self.z[n], self.gnss_variance[n], self.dropped)

    def columns(self, names: Iterable[str]) -> Array:
        """Return the measurements (n, len(names)) in the order of a model's rows.

        Raises
        ------
        DataError
            if the table has no such row.
        """
        names = list(names)
        for lacking in (name for name in names if name not in self.rows):
            known = ", ".join(self.rows)
            raise DataError(f"there is no measurement {lacking!r}; this robot gives {known}")
        return self.z[:, [self.rows.index(name) for name in names]]


def measurement_table(
    run: RunLog,
    robot: Robot,
    *,
    time_constant_s: float | None = None,
    ema_alpha: float | None = None,
    initial_yaw_rad: float = 0.0,
    gnss_latency_s: float = GNSS_LATENCY_S,
    causal: bool = False,
) -> MeasurementTable:
    """Return the measurements of a run, ready for a filter.

    Parameters
    ----------
    run : with the stream ``wheels``; ``steering``, ``imu``, ``odometry`` and ``gnss`` are optional, whole or
        in parts, and give NaN where they are missing
    robot : a swerve robot needs its motors, steering and sensors described, and its camera with odometry
    time_constant_s : of the low-pass on all but the wheels; 0 for none.  By default what each sensor lacks to
        the encoders' ``encoder_time_constant_s`` ((6.12) and (7.8) with a time constant for their alpha)
    ema_alpha : for the thesis' own smoothing in place of the low-pass: ``z = a z_prev + (1 - a) z_raw`` a
        tick on the camera's rows (7.8), at 0.2 a delay of a quarter of a tick; the other rows stay raw
    initial_yaw_rad : heading of the start in the world frame, to which all yaw rows are referred
    gnss_latency_s : age of a position when it arrives
    causal : whether a tick takes only what had arrived by then, as a live filter has to; cleaning looks ahead
        all the same

    Raises
    ------
    DataError
        if there are no wheels to give the clock.
    ConfigError
        if a time constant or an alpha is out of range, or a section of the description is missing.

    Notes
    -----
    With latencies subtracted, a row holds what the sensor measured at that instant, which arrives only later.
    ``causal``, it holds the last that had arrived, at most a latency and a period old: the low-pass runs on
    from the sample's own instant to the tick, and the average of the yaw at the start is that of the ticks so far.
    The origin of positions is the first with a fix, or the first of all where no fix ever comes, or if ``causal``.
    A sensor slower than the clock gives each of its samples once, so that no filter counts it several times.

    A simulated camera or IMU without noise looks frozen where nothing changes: give it noise.
    """
    if ema_alpha is not None:
        if not 0 <= ema_alpha < 1:
            raise ConfigError(f"ema_alpha is {ema_alpha:g}, a number from 0 to below 1 is required")
        if time_constant_s is not None:
            raise ConfigError("give time_constant_s or ema_alpha, not both: one of them smooths the camera")
        time_constant_s = 0.0
    if robot.steered:
        robot.require("motors", "steering", "sensors", *(["camera"] if "odometry" in run.streams else []))
    dropped: Counter[str] = Counter()
    wheels, streams = _clean_streams(run, robot, dropped)
    clock, period_s = np.array(wheels.time_s), {"wheels": median_step_s(wheels.time_s)}
    period_s |= {name: median_step_s(stream.time_s) for name, stream in streams.items()}
    settings = feed_settings(robot, period_s, initial_yaw_rad, gnss_latency_s, time_constant_s)
    memory = new_feed()
    if "gnss" in streams and not causal:
        memory["gnss_origin_m"] = _gnss_origin(streams["gnss"])
    came_s, instant_s, values = [], [], []
    for (name, channels), age_s in zip(STREAMS.items(), settings["latency_s"][0].tolist(), strict=True):
        nothing = Stream(np.empty(0), np.empty((0, len(channels))), channels)
        stream = streams.get(name, nothing)
        instant_s.append(np.array(stream.time_s) - age_s)
        came_s.append(np.array(stream.time_s) if causal else instant_s[-1])
        values.append(np.array(stream.values))
    rows = np.zeros(clock.size, ROW)
    samples = tuple(came_s), tuple(instant_s), tuple(values)
    _run(clock, np.array(wheels.values), *samples, settings, memory, rows)
    counts = {"wheels: beyond the motors": int(memory["wheels_beyond"][0])}
    for number, name in enumerate(STREAMS):
        counts[f"{name}: jump"] = int(memory["jump"][0, number])
        counts[f"{name}: no rotation"] = int(memory["no_rotation"][0, number])
    dropped += Counter(counts)  # a Counter, so that zeros fall out
    z = measurements(rows)
    if ema_alpha is not None:
        for row in CAMERA_ROWS:
            z[:, ROWS.index(row)] = _ema(z[:, ROWS.index(row)], ema_alpha)
    if robot.steered:
        _refer_all(clock, causal, settings, memory, rows)
    names = ROWS_OF_DRIVE[robot.drive]
    return MeasurementTable(
        clock, names, z[:, [ROWS.index(name) for name in names]], rows["gnss_variance"], dropped
    )


def _clean_streams(run: RunLog, robot: Robot, dropped: Counter[str]) -> tuple[Stream, dict[str, Stream]]:
    """Return the wheels, and the streams that the robot's other rows are measured by, cleaned."""
    place = f"run {run.run_id}: "
    if "wheels" not in run.streams:
        raise DataError(f"{place}there is no stream 'wheels', which gives the clock")
    for lacking in (name for name in robot.rate_channels if name not in run.streams["wheels"].channels):
        raise DataError(
            f"{place}the stream 'wheels' has no channel {lacking!r}, which the robot {robot.name} should have"
        )
    wheels = clean_stream(run, "wheels", list(robot.rate_channels), dropped)
    if wheels is None:
        raise DataError(f"{place}the stream 'wheels', which gives the clock, is empty")
    has = {"steering": robot.describes("steering"), "odometry": robot.describes("camera")}
    streams = {}
    for name, channels in STREAMS.items():
        names = [f"angle_{wheel}_rad" for wheel in robot.wheels] if name == "steering" else channels
        stream = clean_stream(run, name, names, dropped, channels[NOISY[name]] if name in NOISY else ())
        if stream is not None and has.get(name, True):
            streams[name] = stream
    return wheels, streams


def _gnss_origin(gnss: Stream) -> Array:
    """Return the first position with a fix, or the first where there is none; NaN without any."""
    position = gnss.values[:, :2]
    known = np.isfinite(position).all(axis=1)
    fixed = known & (gnss.channel("fix_ratio") >= 0.5)
    first = fixed if fixed.any() else known
    return np.asarray(position[first.argmax()]) if first.any() else np.full(2, np.nan)


def clean_stream(
    run: RunLog, name: str, channels: Sequence[str], dropped: Counter[str], frozen: Sequence[str] = ()
) -> Stream | None:
    """Return the channels named of a stream without what cannot be true, or None where nothing is left.

    Stamps increase strictly (one far ahead costs itself only), numbers are finite or NaN, channels that the log
    lacks are NaN.  A camera or IMU all of whose noisy channels (``frozen``) repeat is left out from the first
    repetition on.
    """
    stream = run.streams.get(name)
    if stream is None:
        return None
    clock_s = run.streams["wheels"].time_s if "wheels" in run.streams else stream.time_s
    known_s = clock_s[np.isfinite(clock_s)]
    there = [k for k, channel in enumerate(channels) if channel in stream.channels]
    values = np.full((len(stream), len(channels)), np.nan)
    for k in there:
        values[:, k] = stream.channel(channels[k])
    increasing = np.flatnonzero(np.isfinite(stream.time_s))
    if not (np.diff(stream.time_s[increasing]) > 0).all():
        increasing = increasing[longest_rise(stream.time_s[increasing])]
    dropped[f"{name}: stamp does not increase"] += len(stream) - len(increasing)
    time_s, values = stream.time_s[increasing], values[increasing]
    if known_s.size:
        off = (time_s < known_s.min() - OFF_CLOCK_S) | (time_s > known_s.max() + OFF_CLOCK_S)
        dropped[f"{name}: off the clock"] += int(off.sum())
    finite = np.isfinite(values[:, there]).all(axis=1)
    dropped[f"{name}: not finite"] += int((~finite).sum())
    values[~np.isfinite(values)] = np.nan
    kept = np.ones(len(time_s), dtype=bool)
    noisy = [k for k in there if channels[k] in frozen]
    if noisy and finite.any():
        kept[finite] = ~_frozen(time_s[finite], values[finite][:, noisy])
        dropped[f"{name}: frozen"] += int((~kept).sum())
    if "confidence_ratio" in stream.channels and "confidence_ratio" in channels:
        confidence = values[:, list(channels).index("confidence_ratio")]
        low_confidence = kept & (confidence < MIN_CONFIDENCE_RATIO)
        dropped[f"{name}: low confidence"] += int(low_confidence.sum())
        kept &= ~low_confidence
    return Stream(time_s[kept], values[kept], tuple(channels)) if kept.any() else None


def _frozen(time_s: Array, values: Array) -> Array:
    """Return which rows (n,) repeat the one before, in stretches of at least :data:`FROZEN_S`."""
    same = np.zeros(len(time_s), dtype=bool)
    same[1:] = (values[1:] == values[:-1]).all(axis=1)
    first = np.flatnonzero(~same)
    last = np.append(first[1:], len(time_s)) - 1
    lasting = np.repeat(time_s[last] - time_s[first] >= FROZEN_S - TICK_S, last - first + 1)
    return np.asarray(same & lasting)


def median_step_s(time_s: Array) -> float:
    """Return the median step of a clock; NaN of fewer than two stamps."""
    return float(np.median(np.diff(time_s))) if time_s.size > 1 else math.nan


def _ema(value: Array, alpha: float) -> Array:
    """Smooth the finite values (n,) one after the other, whatever the time between them (7.8)."""
    from scipy.signal import lfilter  # half a second of import, which only the thesis' smoothing needs

    out, known = np.array(value), np.isfinite(value)
    if known.any():
        out[known] = lfilter([1.0 - alpha], [1.0, -alpha], value[known], zi=[alpha * value[known][0]])[0]
    return out


def gnss_heading(table: MeasurementTable, robot: Robot) -> float:
    """Return the world's heading in rad of what the yaw rows call 0; NaN where the drive does not tell.

    Parameters
    ----------
    table : measurements with yaw rows that are 0 at the start
    robot : a swerve robot

    Notes
    -----
    The rotation that brings the speeds over ground v, by the camera or else by the wheels, onto those of
    the receiver u with the least squared error, both as complex numbers: the angle of
    ``sum u conj(v e^(i yaw))``.  Its standard deviation is ``speed_std / sqrt(sum |v|^2)``.
    """
    rates, steer = table.columns(robot.wheel_rows), table.columns(robot.steer_rows)
    twist, _ = no_slip_twist(robot.wheel_positions_m, steer, robot.wheel_radius_m * rates)
    speed = twist[:, 0] + 1j * twist[:, 1]
    if robot.describes("camera"):
        camera = robot.camera
        x, y, turn = table.columns(["camera_speed_x_mps", "camera_speed_y_mps", "camera_yaw_rate_radps"]).T
        origin_x, origin_y = point_velocity(x, y, turn, -camera.lever_x_m, -camera.lever_y_m)
        by_camera = origin_x + 1j * origin_y
        speed = np.where(np.isfinite(by_camera), by_camera, speed)
    yaw = table.columns(["camera_yaw_rad", "imu_yaw_rad"])
    speed = speed * np.exp(1j * np.where(np.isfinite(yaw[:, 0]), yaw[:, 0], yaw[:, 1]))
    received = table.columns(GNSS_ROWS[2:]) @ np.array([1.0, 1.0j])
    good = np.isfinite(received) & np.isfinite(speed) & (np.abs(speed) > HEADING_SPEED_MPS)
    weight = float(np.sum(np.abs(speed[good]) ** 2))
    if weight == 0.0 or GNSS_SPEED_STD_MPS / math.sqrt(weight) > MAX_HEADING_STD_RAD:
        return math.nan
    return cmath.phase(complex(np.sum(received[good] * np.conj(speed[good]))))
