"""From samples of a swerve robot to the row of measurements at each tick of its wheels, on one clock, with one delay.

The clock is that of the wheels, whose rates pass the low-pass of the motor driver.  A ground speed that
is ahead of them makes the slip of a start look negative (Danzi, AgriMaRo thesis, 7.2.2), so every other
signal goes through a low-pass too, and its own lag and the filter's together are the encoders'.  In order:

1. calibration, gravity and the camera's axes are removed, angles are unwrapped;
2. channels that repeat themselves to the last bit on a robot that moves are left out, and jumps;
3. a low-pass, at each sensor's own rate (:func:`terrain.signals.low_pass_step`);
4. at each tick the last sample at or before it, unless it is too old; the low-pass runs on to the tick with
   that sample as its input, which leaves no delay of the holding;
5. rows that follow from others: vibration, changes of the wheels' speeds, rest.

A whole log (:func:`measurement_table`) and the live chain (:mod:`terrain.estimation.models.swerve_live`) take one
compiled loop (:func:`run_feed`), live over one tick.  What looks ahead in a log is the cleaning, which leaves out and
counts samples that cannot be true, the median periods and, unless ``causal``, latencies, the yaw at the start and the
origin of positions.

Rows that follow from others
----------------------------
- ``vibration_mps2``: root mean square of the vertical acceleration over the last 0.3 s;
- ``wheel_<i>_growth_per_s`` and ``wheel_<i>_change_m2ps3``: ``w w' / (w^2 + w_0^2)`` and ``|w w'|`` of a
  wheel's circumferential speed w behind two low-passes of 0.15 s, with w_0 = 0.1 m/s: what keeps the ratio of
  a slip speed to w, and what w^2 changes by; without a camera the latter decays within 0.5 s, peaks held;
- ``camera_age_s``: since the camera last measured a speed;
- ``ground_slip_ratio``: root mean square of the slip of the wheels over the last seconds of driving with a camera:
  what slip of this ground is in proportion to when there is none;
- ``rest_speed_*``, ``rest_yaw_rate``: zero, where the robot is at rest: for a fifth of a second the wheels have
  stood behind their low-passes, gyro and accelerometer have measured nothing, and a camera, if it measures, no
  speed.  Locked wheels that slide decelerate the robot: on ice (0.05 of its weight) by more than what counts as
  nothing.

A yaw row is ``initial_yaw_rad`` on average while the robot is at rest at the start, or at its first sample.
A camera that starts late takes the IMU's yaw of that instant instead, and after a loss the turn nearest to
it.
"""

from __future__ import annotations

import cmath
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, DataError
from terrain.kernels import filled, inner, njit, numbers, record
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import QUATERNION_TOLERANCE
from terrain.kinematics.wheels import in_wheel_frame, no_slip_twist, point_velocity
from terrain.logs.samples import longest_rise
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS, STEERING_CHANNELS
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot
from terrain.signals import low_pass_step

TICK_S = 1e-9  #: Stamps that differ by less are the same instant, rounded differently by two clocks.
#: A value is held until the next one is due and half a period more, of the slower of sensor and clock.
MAX_AGE_PERIODS = 1.5
#: After a longer gap the low-pass starts anew: its memory is not the recent past of the next sample. Steps are whole
#: periods, so that half of one between two of them leaves nothing to how stamps are rounded, nor to whether the
#: period is that of a description (live) or the median of a log (batch).
GAP_PERIODS = 5.5
#: Over a gap of less than so many time constants, a low-pass runs on: what was measured before and after it, and a
#: straight line between, is the recent past.
BRIDGED_LAGS = 2.0
#: So many time constants after a start anew a low-pass has forgotten it: till then it is ahead of one that ran on, of a
#: yaw by the turn rate times the time constant, and gives nothing.
SETTLED_LAGS = 5.0
#: A value that has jumped and stays is accepted after this long: it is left to the filter's gate.
BELIEVED_S = 0.1
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
#: Slip of a ground before any is measured; driving for so long on another ground, most of it is forgotten; slower, a
#: wheel does not show it.
GROUND_SLIP_RATIO, GROUND_S, SHOWN_MPS = 0.2, 5.0, 0.2
CRAWL_MPS = 0.1  #: w_0: well below it a slip speed no longer follows the speed of its wheel.
REST_AFTER_S = 0.2  #: Time for which nothing has to move.
#: What counts as nothing, of a wheel's low-passed speed, the gyro, the accelerometer and the camera: biases and noise
#: at rest stay below, as does a wheel that is held to and fro on soft ground.
REST_WHEEL_MPS, REST_TURN_RADPS, REST_ACCEL_MPS2, REST_SEEN_MPS = 0.02, 0.03, 0.4, 0.05
UNSEEN_AFTER_S = 0.15  #: Age of the camera's speed from which on there is none.
#: Without a camera a change of a wheel's speed counts for so long: the body, and slip, follow it late.
HELD_S = 0.5
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
#: Channels that never repeat themselves all at once, of streams that are left out where they do.
NOISY = {"imu": slice(0, 6), "odometry": slice(3, 13)}
#: Noise of a log that repeats exactly for so long is none: 50 samples of the camera, 25 of the IMU.
FROZEN_S = 0.25
OFF_CLOCK_S = 1.0  #: A sample that is further from every tick is of no use to anyone: its clock jumped.
HEADING_SPEED_MPS = 0.2  #: Slower, a course is noise.
#: A heading that is known no better is not known: at 1 m/s it would be 5 cm/s of sideways speed.
MAX_HEADING_STD_RAD = 0.05

#: What becomes of a value that jumped: it is accepted after a while; it is left out until it jumps back, as a speed
#: over ground cannot have jumped; its jump is taken off, as a heading counts from anywhere.
PASSING, LATCHED, SUBTRACTED = range(3)


class Signal(NamedTuple):
    """What is measured by a stream, behind a low-pass and held; how far it may jump, and what becomes of it then."""

    stream: str
    #: largest change between two samples: noise, and a second what a robot can do
    jump: float = math.inf
    jump_per_s: float = math.inf
    policy: int = PASSING


CAMERA_ROWS = ("camera_speed_x_mps", "camera_speed_y_mps", "camera_yaw_rate_radps", "camera_yaw_rad")
GNSS_ROWS = ("gnss_position_x_m", "gnss_position_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps")
_WHEEL_ROWS = ("wheel_1_radps", "wheel_2_radps", "wheel_3_radps")
#: All signals, stream by stream, each a row but for roll and pitch, of which jumps are seen only. Half a g of speed,
#: two thirds of a turn, twice the fastest steering; an accelerometer on rough terrain sees several g; roll and pitch
#: turn by 3 rad/s at the most, and a jump tilts gravity.
SIGNALS: dict[str, Signal] = {
    **dict.fromkeys(("accel_x_mps2", "accel_y_mps2"), Signal("imu", 20.0, 1000.0)),
    "gyro_z_radps": Signal("imu", 0.5, 20.0),
    "imu_yaw_rad": Signal("imu", 0.1, 4.0),
    **dict.fromkeys(("steer_1_rad", "steer_2_rad", "steer_3_rad"), Signal("steering", 0.1, 5.0)),
    **dict.fromkeys(CAMERA_ROWS[:2], Signal("odometry", 0.1, 5.0, LATCHED)),
    "camera_yaw_rate_radps": Signal("odometry", 0.2, 20.0),
    "camera_yaw_rad": Signal("odometry", 0.1, 4.0, SUBTRACTED),
    **dict.fromkeys(GNSS_ROWS, Signal("gnss")),
    **dict.fromkeys(("roll_rad", "pitch_rad"), Signal("imu", 0.05, 3.0, LATCHED)),
}
DERIVED_ROWS = (
    "vibration_mps2",
    *("wheel_1_growth_per_s", "wheel_2_growth_per_s", "wheel_3_growth_per_s"),
    *("wheel_1_change_m2ps3", "wheel_2_change_m2ps3", "wheel_3_change_m2ps3"),
    *("camera_age_s", "ground_slip_ratio", "rest_speed_x_mps", "rest_speed_y_mps", "rest_yaw_rate_radps"),
)
ROWS = (*_WHEEL_ROWS, *list(SIGNALS)[:-2], *DERIVED_ROWS)
"""What is measured, in the order of (6.3).

Positions and GNSS speeds are in the world frame, east and north from where the antenna first was; yaw counts
from east once the heading at the start is given; all else is in body axes."""

#: Numbers of a row: behind the rows stand the variances of :data:`GNSS_ROWS`; NaN where nothing is measured.
N_NUMBERS = len(ROWS) + len(GNSS_ROWS)

#: Where signals stand among all of them, the signals among the rows, and the derived rows among these.
ACCEL, GYRO, IMU_YAW, STEER, SEEN, SEEN_TURN, SEEN_YAW, POSITION, TILT = map(
    list(SIGNALS).index,
    (
        *("accel_x_mps2", "gyro_z_radps", "imu_yaw_rad", "steer_1_rad", "camera_speed_x_mps"),
        *("camera_yaw_rate_radps", "camera_yaw_rad", "gnss_position_x_m", "roll_rad"),
    ),
)
FIRST_SIGNAL, VIBRATION, GROWTH, CHANGE, SEEN_AGE, GROUND_SLIP, REST_TWIST = map(
    ROWS.index,
    (
        *("accel_x_mps2", "vibration_mps2", "wheel_1_growth_per_s", "wheel_1_change_m2ps3", "camera_age_s"),
        *("ground_slip_ratio", "rest_speed_x_mps"),
    ),
)
_GYRO, _YAW, _SEEN, _SEEN_YAW = (FIRST_SIGNAL + np.array([GYRO, IMU_YAW, SEEN, SEEN_YAW])).tolist()
_POSITION, _VARIANCE = FIRST_SIGNAL + POSITION, len(ROWS)
#: First and last signal of each stream.
_SPANS = np.array([[STEER, SEEN], [ACCEL, STEER], [SEEN, POSITION], [POSITION, TILT]])

#: What is constant of a signal: low-pass, longest step, oldest value, the largest change between two samples (a
#: constant, and a part per second), whether a sample is given at one tick only, and what becomes of a jump.
LIMIT = record(numbers("time_constant_s gap_s age_s jump jump_per_s") | {"once": bool, "policy": int})
#: Memory of a signal: value, instant, arrival and low-pass output of the last sample, whether it was given at a tick;
#: value and instant that jumps are judged against, since when values have been jumping; and of a signal that is not
#: passing the last sample, taken or not, its instant, the sum of its jumps, since when that is not 0, and whether a
#: sample before it is known to be right.
LINE = record(
    numbers(
        "value instant_s came_s low_passed judged judged_s jumping_s raw raw_s jumped_by jumped_s settled_s"
    )
    | {"was_given": bool, "is_followed": bool}
)
#: Of a channel that may freeze: last value, number of repetitions, longest run, and whether this one began in motion.
CHANNEL = record(numbers("last repeated longest") | {"began_in_motion": bool})
#: Of an unwrapped angle the last one, and the turns so far.
_TURN = record(numbers("last_rad turned_rad"))

#: What is constant of a robot's feed: its signals, ages on arrival, its description; whether a sample counts from its
#: arrival, and is taken without a look at those after it; the smoothing of the thesis, 0 for none.
SETTINGS = record(
    {"limits": (LIMIT, len(SIGNALS)), "latency_s": (float, len(STREAMS))}
    | {"is_causal": bool, "is_live": bool}
    | numbers("reduction_ratio fastest_radps wheel_radius_m initial_yaw_rad gyro_bias_radps ema_alpha")
    | {"wheels_m": (float, (3, 2)), "camera_m": (float, 2)}
    | dict.fromkeys(("steering_zeros_rad", "accel_bias_mps2", "accel_scale_ratio"), (float, 3))
)

COUNTS = ("not_finite", "frozen", "low_confidence", "no_rotation", "jump")
#: What a clock that is set back makes worthless.
_OF_TIME = [
    *("lines", "before", "received_s", "wheel_once_mps", "wheel_twice_mps", "wheel_change_m2ps3"),
    *numbers("vibration_square vibration_s tick_s rest_since_s camera_s"),
]
FEED = record(
    {"lines": (LINE, len(SIGNALS)), "turns": (_TURN, 5), "channels": (CHANNEL, REPEATED.size)}
    | {"before": (float, (2, len(CAMERA_CHANNELS))), "camera_yaw_0_rad": float}
    | {"gnss_origin_m": (float, 2), "gnss_variance": float}
    | numbers("vibration_square vibration_s tick_s rest_since_s camera_s slip_square")
    | dict.fromkeys(("wheel_once_mps", "wheel_twice_mps", "wheel_change_m2ps3"), (float, 3))
    | {"received_s": (float, (2, 3)), "smooth": (float, len(CAMERA_ROWS))}
    | {"start_s": float, "has_moved": bool, "camera_has_started": bool, "camera_offset_rad": float}
    | {"yaw_sum_rad": (float, 2), "n_yaw": (int, 2)}
    | {"wheels_not_finite": int, "wheels_beyond": int}
    | dict.fromkeys(COUNTS, (int, len(STREAMS)))
)
"""All that is remembered of the samples: a copy is a snapshot.

The signals; turns of the steering, the IMU and the camera; channels that may freeze; the last complete sample of IMU
and camera; positions' origin and variance; what the derived rows need; when rate and angle of each wheel were measured
last; the thesis' smoothing; the yaw of IMU and camera at the start; and counts of what was left out."""

_kernel, _inner = njit(error_model="numpy"), inner(error_model="numpy")


def feed_settings(
    robot: Robot,
    period_s: Mapping[str, float],
    initial_yaw_rad: float,
    ema_alpha: float | None = None,
    **options: Any,
) -> Array:
    """Return what is constant of a robot's feed, with neutral values for what it does not have.

    Parameters
    ----------
    period_s : of the wheels, and of each stream that comes
    initial_yaw_rad : heading of the start
    ema_alpha : of the thesis' smoothing in place of the low-pass, that all but the wheels lack to the encoders
    options : other fields of :data:`SETTINGS`
    """
    if ema_alpha is not None and not 0 <= ema_alpha < 1:
        raise ConfigError(f"ema_alpha is {ema_alpha:g}, a number from 0 to below 1 is required")
    motors, sensors, camera = robot.completed.motors, robot.completed.sensors, robot.completed.camera
    settings = filled(
        SETTINGS,
        latency_s=[0.0, sensors.imu_latency_s, camera.latency_s, GNSS_LATENCY_S],
        reduction_ratio=motors.reduction_ratio,
        fastest_radps=MAX_RATE_FACTOR * motors.speed_max_radps,
        wheel_radius_m=robot.wheel_radius_m,
        initial_yaw_rad=initial_yaw_rad,
        wheels_m=np.resize(robot.wheel_positions_m, (3, 2)),
        camera_m=(camera.lever_x_m, camera.lever_y_m),
        steering_zeros_rad=(*robot.steering_zeros_rad, 0.0, 0.0, 0.0)[:3],
        gyro_bias_radps=sensors.gyro_bias_z_radps,
        accel_bias_mps2=(sensors.accel_bias_x_mps2, sensors.accel_bias_y_mps2, sensors.accel_bias_z_mps2),
        accel_scale_ratio=(
            sensors.accel_scale_x_ratio,
            sensors.accel_scale_y_ratio,
            sensors.accel_scale_z_ratio,
        ),
        ema_alpha=ema_alpha or 0.0,
        **options,
    )
    lag_s = robot.encoder_lag_s if ema_alpha is None else 0.0
    own_s = {"gyro_z_radps": sensors.imu_time_constants_s[0], "odometry": camera.time_constant_s}
    own_s |= dict.fromkeys(("accel_x_mps2", "accel_y_mps2"), sensors.imu_time_constants_s[1])
    for k, (name, signal) in enumerate(SIGNALS.items()):
        low_pass_s = max(lag_s - own_s.get(name, own_s.get(signal.stream, 0.0)), 0.0)
        limits = low_pass_s, period_s.get(signal.stream, math.nan), period_s["wheels"]
        if k >= TILT:
            limits = 0.0, 0.02, 0.0
        settings["limits"][0, k] = _limit(*limits, signal)
    return settings


def _limit(time_constant_s: float, period_s: float, tick_s: float, signal: Signal) -> tuple[Any, ...]:
    """Return the :data:`LIMIT` of a signal by its low-pass (0 for none), its sensor's period and the clock's."""
    once = period_s > MAX_AGE_PERIODS * tick_s + TICK_S
    age_s = MAX_AGE_PERIODS * np.fmax(period_s, tick_s)
    return time_constant_s, GAP_PERIODS * period_s, age_s, signal.jump, signal.jump_per_s, once, signal.policy


def new_feed() -> Array:
    """Return the memory before the first sample."""
    nothing = dict.fromkeys(("camera_offset_rad", "yaw_sum_rad"), 0.0)
    feed = filled(FEED, np.nan, received_s=-np.inf, slip_square=GROUND_SLIP_RATIO**2, **nothing)
    feed["channels"]["repeated"] = feed["channels"]["longest"] = 0.0
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
    longest_s = max(limit.gap_s, BRIDGED_LAGS * limit.time_constant_s)
    if step_s > longest_s:
        line.settled_s = instant_s + SETTLED_LAGS * limit.time_constant_s
    elif limit.time_constant_s > 0.0 and step_s <= longest_s:
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
    if given or line.instant_s < line.settled_s or not time_s - line.came_s <= limit.age_s + TICK_S:
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
def _repeats_whole(stream: int, sample: Array, feed: Any) -> bool:
    """Say whether a complete sample of the IMU or the camera repeats the noise of the one before, and count it."""
    first, last = (0, 6) if stream == IMU else (3, 13)
    before, same, n_known = feed.before[stream - IMU], True, 0
    for c in range(first, last):
        if not math.isnan(sample[c]):
            n_known += 1
            same &= sample[c] == before[c]
        before[c] = sample[c]
    if not same or n_known == 0:
        return False
    feed.frozen[stream] += 1
    for c in range(9 if stream == IMU else 14):
        feed.channels[c if stream == IMU else FIRST_CAMERA + c].repeated += 1.0
    return True


@_inner
def _take_sample(
    stream: int, sample: Array, is_whole: bool, stamp_s: float, settings: Any, feed: Any
) -> None:
    """Take a sample (channels,) of any stream but the wheels, as signals without calibration, gravity and axes.

    An accelerometer reads ``scale * truth + bias``.  The specific force at rest is g times the world's vertical in
    body axes, ``g (-sin pitch, sin roll cos pitch, cos roll cos pitch)``: with the nose up (pitch negative) it
    points forward too, with the left side up (roll positive) to the left.
    """
    instant_s = stamp_s - settings.latency_s[stream]
    came_s, moving, signals = stamp_s if settings.is_causal else instant_s, is_moving(feed), np.empty(TILT)
    if settings.is_live:
        feed.not_finite[stream] += not is_whole
        if is_whole and stream in (IMU, ODOMETRY) and _repeats_whole(stream, sample, feed):
            return
    if stream == ODOMETRY and sample[13] < MIN_CONFIDENCE_RATIO:
        feed.low_confidence[stream] += 1
        return
    if stream == STEERING:  # the first angle lies within half a turn
        for i in range(3):
            angle = wrapped(sample[i] - settings.steering_zeros_rad[i])
            signals[STEER + i] = _unwrap(angle, feed.turns[i])
    elif stream == IMU:
        sample = _mask_frozen(sample, np.int64(FIRST_IMU), moving, feed)
        roll, pitch = sample[6], sample[7]
        for i in range(2):
            line, limit, angle = feed.lines[TILT + i], settings.limits[TILT + i], sample[6 + i]
            if not math.isnan(angle) and _sum_of_jumps(angle, instant_s, line, limit) != 0.0:
                roll = pitch = np.nan
        bias, scale = settings.accel_bias_mps2, settings.accel_scale_ratio
        level_x, level_y = -GRAVITY_MPS2 * math.sin(pitch), GRAVITY_MPS2 * math.sin(roll) * math.cos(pitch)
        signals[ACCEL] = (sample[3] - bias[0]) / scale[0] - level_x
        signals[ACCEL + 1] = (sample[4] - bias[1]) / scale[1] - level_y
        signals[GYRO], signals[IMU_YAW] = (
            sample[2] - settings.gyro_bias_radps,
            _unwrap(sample[8], feed.turns[3]),
        )
        accel = (sample[5] - bias[2]) / scale[2] - GRAVITY_MPS2 * math.cos(roll) * math.cos(pitch)
        if not math.isnan(accel):
            step_s, square = instant_s - feed.vibration_s, accel * accel
            feed.vibration_s = instant_s
            if not step_s > 0.0 or math.isnan(feed.vibration_square):
                feed.vibration_square = square
            else:
                feed.vibration_square += (square - feed.vibration_square) * -math.expm1(-step_s / VIBRATION_S)
    elif stream == ODOMETRY:  # `kinematics.camera.body_motion` of one sample, of the camera's point
        sample = _mask_frozen(sample, np.int64(FIRST_CAMERA), moving, feed)
        # the camera's axes renamed to the body's: (-z, -x, y), of vectors and of the quaternion's vector alike
        x, y, z, w = -sample[5], -sample[3], sample[4], sample[6]
        v_x, v_y, v_z = -sample[9], -sample[7], sample[8]
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        if not abs(norm - 1.0) <= QUATERNION_TOLERANCE:
            feed.no_rotation[ODOMETRY] += not math.isnan(norm)
            return
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
        r_00, r_11 = x * x - y * y - z * z + w * w, -x * x + y * y - z * z + w * w
        r_01, r_10 = 2.0 * (x * y - z * w), 2.0 * (x * y + z * w)
        r_20, r_21 = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w)
        yaw = _unwrap(math.atan2(r_10, r_00), feed.turns[4])
        if math.isnan(feed.camera_yaw_0_rad):
            feed.camera_yaw_0_rad = yaw
        along, left = r_00 * v_x + r_10 * v_y + r_20 * v_z, r_01 * v_x + r_11 * v_y + r_21 * v_z
        signals[SEEN:SEEN_TURN] = _mask_frozen(np.array([along, left]), np.int64(FIRST_SPEED), moving, feed)
        signals[SEEN_TURN], signals[SEEN_YAW] = sample[11], yaw - feed.camera_yaw_0_rad
    else:  # positions from the origin, by default the first one
        known = not (math.isnan(sample[0]) or math.isnan(sample[1]))
        if known and math.isnan(feed.gnss_origin_m[0]):
            feed.gnss_origin_m[0], feed.gnss_origin_m[1] = sample[0], sample[1]
        if known:
            std = FIX_STD_M if sample[5] >= 0.5 else FLOAT_STD_M
            feed.gnss_variance = (sample[4] if sample[4] > 0.0 else std) ** 2
        for i in range(2):
            signals[POSITION + i] = sample[i] - feed.gnss_origin_m[i] if known else np.nan
            signals[POSITION + 2 + i] = sample[2 + i]
    jumped = False
    for k in range(_SPANS[stream, 1] - 1, _SPANS[stream, 0] - 1, -1):  # of the camera its yaw first
        line, limit = feed.lines[k], settings.limits[k]
        jumped_by = line.jumped_by
        jumped |= _take(signals[k], instant_s, came_s, line, limit)
        if (
            k == SEEN_YAW and line.jumped_by != jumped_by
        ):  # that turns the speeds: they have not jumped themselves
            feed.lines[SEEN].raw, feed.lines[SEEN + 1].raw = signals[SEEN], signals[SEEN + 1]
    feed.jump[stream] += jumped


@_inner
def _take_wheels(wheels: Array, settings: Any, feed: Any, row: Any) -> None:
    """Write the rates (3,) of the wheels; what is not finite, frozen, or faster than a motor turns is left out."""
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
        row[i] = np.nan if too_fast or not known or frozen else rate
    feed.wheels_beyond += beyond


@_inner
def _measure_slip(step_s: float, settings: Any, feed: Any, row: Any) -> None:
    """Write the slip of the ground, from wheels, camera and gyro."""
    turn = row[_GYRO]
    x, y = point_velocity(row[_SEEN], row[_SEEN + 1], turn, -settings.camera_m[0], -settings.camera_m[1])
    for i in range(3):
        forward, left = point_velocity(x, y, turn, settings.wheels_m[i, 0], settings.wheels_m[i, 1])
        steer, speed = row[FIRST_SIGNAL + STEER + i], row[i] * settings.wheel_radius_m
        along, _ = in_wheel_frame(forward, left, math.cos(steer), math.sin(steer))
        fastest = max(abs(speed), abs(along))
        if fastest > SHOWN_MPS and step_s > 0.0 and not math.isnan(speed - along):
            square = ((speed - along) / fastest) ** 2
            feed.slip_square += (square - feed.slip_square) * -math.expm1(-step_s / (3.0 * GROUND_S))
    row[GROUND_SLIP] = math.sqrt(feed.slip_square)


@_inner
def _derive(time_s: float, settings: Any, feed: Any, row: Any) -> None:
    """Write the rows that follow from others."""
    step_s = time_s - feed.tick_s
    feed.tick_s = time_s
    row[VIBRATION] = math.sqrt(feed.vibration_square)
    still = True
    keep = math.exp(-step_s / CHANGE_S) if step_s > 0.0 else 0.0
    if not math.isnan(row[_SEEN]):
        feed.camera_s = time_s
    row[SEEN_AGE] = time_s - feed.camera_s
    for i in range(3):
        speed = row[i] * settings.wheel_radius_m
        once, twice = feed.wheel_once_mps[i], feed.wheel_twice_mps[i]
        still &= abs(twice) <= REST_WHEEL_MPS and abs(speed) <= MOVING_MPS
        rise = once - twice
        change = twice * math.copysign(max(abs(rise) - WAVERING_MPS, 0.0), rise) / CHANGE_S
        row[GROWTH + i] = change / (twice * twice + CRAWL_MPS * CRAWL_MPS)
        change = (abs(speed) + CRAWL_MPS) * max(abs(speed - once) - RIPPLE_MPS, 0.0) / CHANGE_S
        held = feed.wheel_change_m2ps3[i] * math.exp(-step_s / HELD_S) if step_s > 0.0 else np.nan
        feed.wheel_change_m2ps3[i] = change if math.isnan(held) or change > held else held
        unseen = not row[SEEN_AGE] <= UNSEEN_AFTER_S
        row[CHANGE + i] = feed.wheel_change_m2ps3[i] if unseen else change
        if math.isnan(once) or not step_s > 0.0:
            feed.wheel_once_mps[i] = feed.wheel_twice_mps[i] = speed
        elif not math.isnan(speed):
            feed.wheel_twice_mps[i] = once + (twice - once) * keep
            feed.wheel_once_mps[i] = speed + (once - speed) * keep
    still &= abs(row[_GYRO]) <= REST_TURN_RADPS
    for i in range(2):
        still &= abs(row[FIRST_SIGNAL + ACCEL + i]) <= REST_ACCEL_MPS2
        still &= not abs(row[_SEEN + i]) > REST_SEEN_MPS
    if not still:
        feed.rest_since_s = np.nan
    elif math.isnan(feed.rest_since_s):
        feed.rest_since_s = time_s
    _measure_slip(step_s, settings, feed, row)
    if time_s - feed.rest_since_s >= REST_AFTER_S:
        row[REST_TWIST : REST_TWIST + 3] = 0.0
        for i in range(2):  # at rest a camera that measures none is right again
            line = feed.lines[SEEN + i]
            if abs(line.raw) <= REST_SEEN_MPS:
                line.jumped_by, line.jumped_s = 0.0, np.nan


@_inner
def _refer_yaw(time_s: float, settings: Any, feed: Any, row: Any) -> None:
    """Count the yaw rows from their averages at the start, and keep the camera's on the turn that the IMU is on."""
    if math.isnan(feed.start_s):
        feed.start_s = time_s
    if time_s > feed.start_s + STANDING_S:
        feed.has_moved = True
    for i in range(3):
        if abs(row[i] * settings.wheel_radius_m) > STANDING_SPEED_MPS:
            feed.has_moved = True
    initial = settings.initial_yaw_rad
    for i, place in enumerate((_YAW, _SEEN_YAW)):
        if not math.isnan(row[place]):
            if not feed.has_moved or feed.n_yaw[i] == 0:
                feed.yaw_sum_rad[i] += row[place]
                feed.n_yaw[i] += 1
            row[place] = row[place] - feed.yaw_sum_rad[i] / feed.n_yaw[i] + initial
    imu, seen = row[_YAW], row[_SEEN_YAW]
    if math.isnan(seen):
        return
    if not feed.camera_has_started:
        feed.camera_has_started = True
        if not math.isnan(imu) and time_s > feed.start_s + LATE_S:
            feed.camera_offset_rad = imu - initial
    seen += feed.camera_offset_rad
    if not math.isnan(imu):
        seen += 2 * np.pi * np.rint((imu - seen) / (2 * np.pi))
    row[_SEEN_YAW] = seen


@_inner
def _tick(time_s: float, wheels: Array, settings: Any, feed: Any, row: Any) -> None:
    """Write the row of a tick; ``wheels`` are the rates (3,) of the motors."""
    row[:] = np.nan
    _take_wheels(wheels, settings, feed, row)
    for k in range(TILT):
        row[FIRST_SIGNAL + k] = _at_tick(time_s, feed.lines[k], settings.limits[k])
    for i in range(3):
        if not math.isnan(row[i]):
            feed.received_s[0, i] = time_s
        if not math.isnan(row[FIRST_SIGNAL + STEER + i]):
            feed.received_s[1, i] = time_s
    for i in range(2):
        if not math.isnan(row[_POSITION + i]):
            row[_VARIANCE + i] = feed.gnss_variance
        if not math.isnan(row[_POSITION + 2 + i]):
            row[_VARIANCE + 2 + i] = GNSS_SPEED_STD_MPS**2
    _derive(time_s, settings, feed, row)
    if settings.ema_alpha > 0.0:  # (7.8)
        for i in range(feed.smooth.size):
            value = row[_SEEN + i]
            if not math.isnan(value) and not math.isnan(feed.smooth[i]):
                value = settings.ema_alpha * feed.smooth[i] + (1.0 - settings.ema_alpha) * value
            if not math.isnan(value):
                feed.smooth[i] = row[_SEEN + i] = value
    _refer_yaw(time_s, settings, feed, row)


@_kernel
def run_feed(
    clock: Array,
    wheels: Array,
    stamps: tuple[Array, ...],
    samples: tuple[Array, ...],
    are_whole: tuple[Array, ...],
    settings: Any,
    feed: Any,
    rows: Any,
) -> None:
    """Write the rows (n, :data:`N_NUMBERS`) of ticks, from the wheels and the samples by stream, as :data:`STREAMS`.

    Of a sample, ``are_whole`` says whether all channels that there are were finite.
    """
    settings, feed = settings[0], feed[0]
    due = np.zeros(len(stamps), np.int64)
    for n in range(clock.size + 1):
        time_s = clock[n] + TICK_S if n < clock.size else np.inf  # what comes after the last tick is counted
        for stream in range(len(stamps)):
            age_s = 0.0 if settings.is_causal else settings.latency_s[stream]
            k = due[stream]
            while k < stamps[stream].size and stamps[stream][k] - age_s <= time_s:
                stamp_s = stamps[stream][k]
                _take_sample(stream, samples[stream][k], are_whole[stream][k], stamp_s, settings, feed)
                k += 1
            due[stream] = k
        if n < clock.size:
            _tick(clock[n], wheels[n], settings, feed, rows[n])


def on_clock(
    clock: Array, time_s: Array, signals: Mapping[str, Array], time_constant_s: float
) -> dict[str, Array]:
    """Return each signal (n,) behind the low-pass, at the ticks of the clock.

    Instants of samples and ticks increase; a missing sample is NaN; a time constant of 0 is no low-pass.
    """
    limit, found = filled(LIMIT), {}
    limit[0] = _limit(time_constant_s, median_step_s(time_s), median_step_s(clock), Signal(""))
    for row, signal in signals.items():
        known = np.where(np.isfinite(signal), signal, np.nan)
        found[row] = _on_clock(clock, time_s, known, filled(LINE, np.nan), limit)
    return found


@_kernel
def _on_clock(clock: Array, time_s: Array, signal: Array, line: Array, limit: Array) -> Array:
    out, line, limit, k = np.empty(clock.size), line[0], limit[0], 0
    for n in range(clock.size):
        while k < time_s.size and time_s[k] <= clock[n] + TICK_S:
            _take(signal[k], time_s[k], time_s[k], line, limit)
            k += 1
        out[n] = _at_tick(clock[n], line, limit)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementTable:
    """What a filter measures at each tick of its clock; NaN where a sensor gave nothing."""

    time_s: Array  #: (n,) stamps of the wheels stream
    rows: tuple[str, ...]  #: name of each of the m measurements
    z: Array  #: (n, m)
    gnss_variance: Array  #: (n, 4) of :data:`GNSS_ROWS`, in their units squared; NaN where they are
    #: samples left out, as counts by stream and kind (``"imu: frozen"``)
    dropped: Mapping[str, int] = field(default_factory=dict)

    def at(self, time_s: Array) -> MeasurementTable:
        """Return the table of some of its own instants, as a filter's track has them that left rows out."""
        n = np.searchsorted(self.time_s, time_s)
        return MeasurementTable(self.time_s[n], self.rows, self.z[n], self.gnss_variance[n], self.dropped)

    def columns(self, names: Iterable[str]) -> Array:
        """Return the measurements (n, len(names)) in the order of a model's rows; ``DataError`` where one lacks."""
        places = []
        for name in names:
            if name not in self.rows:
                known = ", ".join(self.rows)
                raise DataError(f"there is no measurement {name!r}; this robot gives {known}")
            places.append(self.rows.index(name))
        return self.z[:, places]


def measurement_table(
    run: RunLog,
    robot: Robot,
    *,
    ema_alpha: float | None = None,
    initial_yaw_rad: float = 0.0,
    causal: bool = False,
) -> MeasurementTable:
    """Return the measurements of a run, ready for a filter.

    Parameters
    ----------
    run : with the stream ``wheels``; ``steering``, ``imu``, ``odometry`` and ``gnss`` are optional, whole or
        in parts, and give NaN where they are missing
    robot : a swerve robot with motors, steering and sensors described, and its camera with odometry
    ema_alpha : for the thesis' own smoothing in place of the low-pass, which is what each sensor lacks to the encoders'
        ``encoder_time_constant_s`` ((6.12) and (7.8) with a time constant for their alpha):
        ``z = a z_prev + (1 - a) z_raw`` a tick on the camera's rows (7.8), at 0.2 a delay of a quarter of a tick; the
        other rows stay raw
    initial_yaw_rad : heading of the start in the world frame, to which all yaw rows are referred
    causal : whether a tick takes only what had arrived by then, as a live filter has to; cleaning looks ahead
        all the same

    Raises
    ------
    DataError
        if there are no wheels to give the clock.
    ConfigError
        if an alpha is out of range, or a section of the description is missing.

    Notes
    -----
    With latencies subtracted, a row holds what the sensor measured at that instant, which arrives only later.
    ``causal``, it holds the last that had arrived, at most a latency and a period old: the low-pass runs on
    from the sample's own instant to the tick, and the average of the yaw at the start is that of the ticks so far.
    The origin of positions is the first with a fix, or the first of all where no fix ever comes, or if ``causal``.
    A sensor slower than the clock gives each of its samples once, so that no filter counts it several times.

    A simulated camera or IMU without noise looks frozen where nothing changes: give it noise.
    """
    if robot.drive != "swerve":
        raise ConfigError(
            f"robot {robot.name} has the drive {robot.drive!r}: these are rows of swerve robots"
        )
    robot.require("motors", "steering", "sensors", *(["camera"] if "odometry" in run.streams else []))
    streams, dropped = clean_streams(run, robot)
    clock, wheels = np.array(streams["wheels"].time_s), np.array(streams["wheels"].values)
    period_s, stamps, samples, are_whole = {"wheels": median_step_s(clock)}, [], [], []
    for name, channels in STREAMS.items():
        stream = streams.get(name, Stream(np.empty(0), np.empty((0, len(channels))), channels))
        period_s[name] = median_step_s(stream.time_s)
        stamps.append(np.array(stream.time_s))
        samples.append(np.array(stream.values))
        are_whole.append(np.ones(len(stream), np.bool_))
    came = tuple(stamps), tuple(samples), tuple(are_whole)
    settings = feed_settings(robot, period_s, initial_yaw_rad, ema_alpha, is_causal=causal)
    feed, rows = new_feed(), np.empty((clock.size, N_NUMBERS))
    if not causal:  # the origin, and over the whole log once before, the averages of the yaw at the start
        if len(samples[GNSS]):
            known = np.isfinite(samples[GNSS][:, :2]).all(axis=1)
            fixed = known & (samples[GNSS][:, 5] >= 0.5)
            if known.any():
                feed["gnss_origin_m"] = samples[GNSS][(fixed if fixed.any() else known).argmax(), :2]
        ahead = feed.copy()
        run_feed(clock, wheels, *came, settings, ahead, rows)
        feed["yaw_sum_rad"], feed["n_yaw"], feed["has_moved"] = ahead["yaw_sum_rad"], ahead["n_yaw"], True
    run_feed(clock, wheels, *came, settings, feed, rows)
    dropped["wheels: beyond the motors"] = int(feed["wheels_beyond"][0])
    dropped += counts_of(feed, streams)
    z = rows[:, : len(ROWS)].copy()
    return MeasurementTable(clock, ROWS, z, rows[:, len(ROWS) :].copy(), dict(+dropped))


def counts_of(feed: Array, streams: Iterable[str]) -> Counter[str]:
    """Return what a feed has left out of some streams, by stream and kind."""
    counts: Counter[str] = Counter()
    for stream, name in enumerate(STREAMS):
        if name in streams:
            for kind in COUNTS:
                counts[f"{name}: {kind.replace('_', ' ')}"] = int(feed[kind][0, stream])
    return counts


def clean_streams(run: RunLog, robot: Robot) -> tuple[dict[str, Stream], Counter[str]]:
    """Return wheels, and the streams that the robot's other rows are measured by, without what cannot be true.

    Stamps increase strictly (one far ahead costs itself only), numbers are finite or NaN, channels that the log
    lacks are NaN.  A camera or IMU all of whose noisy channels repeat is left out from the first repetition on.
    What is left out is counted; a stream of which nothing is left is none.
    """
    place, streams, dropped = f"run {run.run_id}: ", {}, Counter[str]()
    if "wheels" not in run.streams:
        raise DataError(f"{place}there is no stream 'wheels', which gives the clock")
    read: dict[str, Sequence[str]] = {"wheels": robot.rate_channels, **STREAMS}
    lacks = {"steering": not robot.describes("steering"), "odometry": not robot.describes("camera")}
    clock_s = run.streams["wheels"].time_s[np.isfinite(run.streams["wheels"].time_s)]
    for name, channels in read.items():
        stream = run.streams.get(name)
        if stream is None:
            continue
        values, there = np.full((len(stream), len(channels)), np.nan), []
        for k, channel in enumerate(channels):
            if channel in stream.channels:
                values[:, k] = stream.channel(channel)
                there.append(k)
            elif name == "wheels":
                raise DataError(
                    f"{place}the stream 'wheels' has no channel {channel!r}, which the robot {robot.name} should have"
                )
        kept = np.flatnonzero(np.isfinite(stream.time_s))
        if not (np.diff(stream.time_s[kept]) > 0).all():
            kept = kept[longest_rise(stream.time_s[kept])]
        dropped[f"{name}: stamp does not increase"] += len(stream) - len(kept)
        time_s, values = stream.time_s[kept], values[kept]
        if clock_s.size:
            off = (time_s < clock_s.min() - OFF_CLOCK_S) | (time_s > clock_s.max() + OFF_CLOCK_S)
            dropped[f"{name}: off the clock"] += int(off.sum())
        finite = np.isfinite(values[:, there]).all(axis=1)
        dropped[f"{name}: not finite"] += int((~finite).sum())
        values[~np.isfinite(values)] = np.nan
        noisy = sorted(set(there) & set(range(len(channels))[NOISY[name]])) if name in NOISY else []
        if noisy and finite.any():  # what repeats the one before, in stretches that last
            known_s, noise = time_s[finite], values[np.ix_(finite, noisy)]
            same = np.append(False, (noise[1:] == noise[:-1]).all(axis=1))
            first = np.flatnonzero(~same)
            last = np.append(first[1:], len(same)) - 1
            lasting = known_s[last] - known_s[first] >= FROZEN_S - TICK_S
            frozen = np.flatnonzero(finite)[same & np.repeat(lasting, last - first + 1)]
            dropped[f"{name}: frozen"] += len(frozen)
            time_s, values = np.delete(time_s, frozen), np.delete(values, frozen, axis=0)
        if time_s.size and not lacks.get(name, False):
            streams[name] = Stream(time_s, values, tuple(channels))
    if "wheels" not in streams:
        raise DataError(f"{place}the stream 'wheels', which gives the clock, is empty")
    return streams, dropped


def median_step_s(time_s: Array) -> float:
    """Return the median step of a clock; NaN of fewer than two stamps."""
    return float(np.median(np.diff(time_s))) if time_s.size > 1 else math.nan


def places_among(names: Sequence[str], among: Sequence[str]) -> Array:
    """Return the place of each name among others, -1 where it is not there."""
    return np.array([list(among).index(name) if name in among else -1 for name in names])


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
        x, y, turn, _ = table.columns(CAMERA_ROWS).T
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


def forget_times(feed: Array) -> None:
    """Begin anew after a clock was set back: what is remembered of its other time is of no use."""
    feed[_OF_TIME] = new_feed()[_OF_TIME]
    feed["channels"]["repeated"] = 0.0
