r"""Slip of each wheel, and of the body, over windows of a run: what was rolled against what was travelled.

**Travelled.**  A pose that is measured from outside (a camera above, a lidar, motion capture) gives, from one sample
to the next, an arc (:func:`terrain.angles.arcs`), whose sums are straight lines in time while the motion is steady, so
that a slope over a window is the mean twist of it.  A stream of speeds over ground
is integrated.  A receiver of satellites measures a velocity without a heading: of a robot that cannot drive sideways
it is taken along its x axis, forward where the wheels roll forward, and the turn by the gyro where there is one.
Where a measurement pauses or jumps (a camera that loses the robot, a scan that is matched elsewhere) nothing
is known of what was driven meanwhile: a new part begins, and no window reaches across.

**Rates.**  Over a window of samples ``t_k`` of a sum ``y_k`` that grows steadily,

    r = sum (t_k - t) y_k / S,    S = sum (t_k - t)^2,    var r = s^2 / S (1 + q) / (1 - q)

with the variance s^2 of the residuals about the straight line and their correlation q from sample to sample:
noise of a filtered or matched measurement is not white (first-order correction of an autocorrelated error,
Bence, Ecology 76, 1995).  A motion that is not steady shows in s, so that its rate is stated as less certain.

**Slip.**  With the mean circumferential speed u_i of wheel i over a window, and the mean twist V of the body as
measured from outside, the speed of the wheel's centre along its drive direction is ``v_i`` (2.2, 7.3 to 7.5 of Danzi,
AgriMaRo thesis) and its slip

    s_i = (u_i - v_i) / max(|u_i|, |v_i|)

The *slip of the body* compares the twist that the wheels would roll without slip, V_w, with V along the
direction d of V_w: ``s = (|V_w| - V . d) / max``.  It is what a desired speed is missed by, is defined where
a single wheel stands still, and on omni wheels differs from all of the wheels' own.  ``side`` is the speed
across d over the same denominator: what drives off the desired course.

Standard deviations are those of the two slopes, to first order.  What is common to all windows of a robot,
an error of the wheels' radius or of the outside measurement's scale, is not in them: 1 % of it is 0.01 times
(1 - s) of slip.

**Delay.**  Of an outside measurement behind the wheels, from changes of speed in many runs: twists over short windows
by the wheels, :math:`V_w(t)`, and from outside, :math:`V(t + \tau)`, are compared with a gain a run and a component
that slip makes free,

.. math:: \min_\tau \sum_{runs} \sum_c \min_g \sum_t \left(V_c(t + \tau) - g\,V_{w,c}(t)\right)^2 .

A robot that drives steadily shows no delay at all; starts, stops and turns do.  The interval is that of draws of
runs with replacement (of thirds of a single run), :func:`terrain.signals.common_delay`.

**Surfaces.**  Windows of one run are not independent: a run counts by the median of its windows, and intervals are
those of draws of whole runs.  How well a median carries over is what that of a fifth of the runs, held out, differs
by from that of the others; every fifth run is held out in the order of how they were driven (speed, then
direction), so that slip that depends on the direction is compared over the same directions.

**Operating point** of wheels at constant speed: their slip beside the current and, where motors are known, the
thrust.  Of a wheel with the current I (its magnitude, or positive where it drives),

    F = (kt n eta I - T_friction) / r,    F / N with N = m g / wheels

is the thrust over its share of the weight.  A run at constant speed has one such point; points that differ in slip
on one surface differ in how the robot was driven, and are no curve of thrust over slip.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from terrain.angles import arcs
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, DataError
from terrain.kernels import njit
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import body_motion
from terrain.kinematics.logged_wheels import speed_columns
from terrain.kinematics.wheels import no_slip_twist, point_velocity, rolling_matrix
from terrain.logs.schema import POSE_CHANNELS, TWIST
from terrain.records import Array, RunLog, SlipTrack, Stream
from terrain.robots import BicycleRobot, Robot, robot_named
from terrain.signals import Delay, DelayStatus, common_delay
from terrain.slip import slip_ratio
from terrain.slip_learning.sessions import IntervalOf, SessionSlip, session_slips

VELOCITY: tuple[str, ...] = ("velocity_x_mps", "velocity_y_mps")
"""Channels of a receiver's velocity, east and north."""

SOURCES: dict[str, tuple[tuple[str, ...], ...]] = {
    "pose": (POSE_CHANNELS,),
    "lidar": (TWIST,),
    "odometry": (CAMERA_CHANNELS[:-1], TWIST[:2]),
    "gnss": (VELOCITY, POSE_CHANNELS[:2]),
}
"""Streams that measure motion from outside, the most direct first, and the channels of which each needs one set."""

MAX_GAP_S = 0.5  #: Longer without a sample, what was driven meanwhile is not known well enough to be summed

BASE_S = 1.0  #: Over which positions of a receiver are differenced: noise of 2 cm is then 3 cm/s

MAX_SPEED_RATIO, MAX_JUMP_M = 3.0, 0.05
"""A pose that is further from the one before than so many times what the fastest wheel rolled, and this, has
jumped; a robot that slides is not faster than its wheels were."""


class Travelled(NamedTuple):
    """Distances travelled forward and to the left, and the angle turned."""

    source: str  #: stream that measured it
    time_s: Array  #: (n,) of the samples
    values: Array  #: (n, 3) in m, m and rad, from 0 at the first sample of each part
    part: Array  #: (n,) number of the part that a sample is in; distances of two parts are not related
    n_jumps: int  #: n_jumps, n_gaps: why parts begin
    n_gaps: int


def outside_source(run: RunLog) -> str | None:
    """Return the name of the stream that measured a run's motion from outside; None where none did.

    Examples
    --------
    >>> outside_source(RunLog("a", "husky", {}))
    """
    for name, needed in SOURCES.items():
        stream = run.streams.get(name)
        present = set() if stream is None or len(stream) < 2 else set(stream.channels)
        if any(set(channels) <= present for channels in needed):
            return name
    return None


def travelled(run: RunLog, robot: Robot, delay_s: float = 0.0) -> Travelled:
    """Return what a run's body travelled, as measured from outside, ``delay_s`` before its stamps.

    Raises
    ------
    DataError
        if nothing measured the motion from outside, or only a receiver whose velocity has no heading did.

    Examples
    --------
    A quarter circle of 1 m radius to the left, in 2 s:

    >>> from terrain.records import Stream
    >>> from terrain.robots import load_robot
    >>> turn = np.linspace(0.0, np.pi / 2, 21)
    >>> pose = np.column_stack([np.sin(turn), 1.0 - np.cos(turn), turn])
    >>> run = RunLog("a", "robotino", {"pose": Stream(np.linspace(0.0, 2.0, 21), pose, POSE_CHANNELS)})
    >>> travelled(run, load_robot("robotino")).values[-1].round(4) + 0.0
    array([1.5708, 0.    , 1.5708])
    """
    name = outside_source(run)
    if name is None:
        raise DataError(
            f"run {run.run_id}: nothing measured the motion from outside; a stream "
            f"{', '.join(list(SOURCES)[:-1])} or {list(SOURCES)[-1]} is needed"
        )
    stream, by_pose = run.streams[name], name == "pose"
    usual_s = float(np.median(np.diff(stream.time_s)))
    values = stream.columns(POSE_CHANNELS) if by_pose else _twists(run, robot, name)
    known = np.isfinite(values).all(axis=1)
    time_s, values = stream.time_s[known], values[known]
    if len(time_s) < 2:
        return Travelled(name, time_s, np.zeros((len(time_s), 3)), np.zeros(len(time_s), np.int64), 0, 0)
    step_s = np.diff(time_s)
    if by_pose:
        steps, gap = arcs(values[:, :2], np.unwrap(values[:, 2])), step_s > MAX_GAP_S
        far_m = MAX_SPEED_RATIO * _fastest_mps(run, robot) * step_s + MAX_JUMP_M
        jumped = ~gap & (np.linalg.norm(np.diff(values[:, :2], axis=0), axis=1) > far_m)
    else:
        steps, gap = step_s[:, None] * (values[1:] + values[:-1]) / 2.0, step_s > max(1.5 * usual_s, 1e-3)
        jumped = np.zeros(len(gap), dtype=bool)
    broken = gap | jumped
    part = np.concatenate([[0], np.cumsum(broken)]).astype(np.int64)
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(np.where(broken[:, None], 0.0, steps), axis=0)])
    return Travelled(name, time_s - delay_s, sums, part, int(jumped.sum()), int(gap.sum()))


def _fastest_mps(run: RunLog, robot: Robot) -> float:
    """Return the speed of the fastest wheel; infinite where no wheel is known."""
    if (wheels := run.streams.get("wheels")) is None:
        return float("inf")
    columns, scale = speed_columns(wheels.channels, robot)
    speeds = np.abs(wheels.values[:, columns])
    return float(speeds[np.isfinite(speeds)].max(initial=0.0)) * scale or float("inf")


def _velocity_of_receiver(stream: Stream) -> Array:
    """Return the velocity (n, 2) of a receiver; without a measured one the change of its positions over a second.

    That is NaN at gaps, and where positions are of no RTK fix, which a receiver that states its fixes has.
    """
    if set(VELOCITY) <= set(stream.channels):
        return stream.columns(VELOCITY)
    place = stream.columns(POSE_CHANNELS[:2])
    known = np.isfinite(place).all(axis=1)
    if "fix_ratio" in stream.channels:
        known &= stream.channel("fix_ratio") > 0.5
    if known.sum() < 2:
        return np.full(place.shape, np.nan)
    time_s, place = stream.time_s[known], place[known]
    ends, there = [], np.ones(len(stream), dtype=bool)
    for end_s in (stream.time_s - BASE_S / 2, stream.time_s + BASE_S / 2):
        after = np.clip(np.searchsorted(time_s, end_s), 1, len(time_s) - 1)
        there &= (
            (end_s >= time_s[0]) & (end_s <= time_s[-1]) & (time_s[after] - time_s[after - 1] <= MAX_GAP_S)
        )
        ends.append(np.column_stack([np.interp(end_s, time_s, column) for column in place.T]))
    return np.where(there[:, None], (ends[1] - ends[0]) / BASE_S, np.nan)


def _twists(run: RunLog, robot: Robot, name: str) -> Array:
    """Return the twists (n, 3) of the body's origin by a stream of speeds."""
    stream, still = run.streams[name], np.zeros(len(run.streams[name]))
    if name == "gnss":  # of a body that moves along its x axis, by a receiver's velocity and the gyro
        if robot.sideways:
            raise DataError(
                f"run {run.run_id}: the velocity of its receiver has no heading, and robot {robot.name} can "
                "drive sideways; poses are needed"
            )
        wheels, imu, turn = run.streams.get("wheels"), run.streams.get("imu"), still
        ahead = np.hypot(*_velocity_of_receiver(stream).T)
        names = [] if wheels is None else [c for c in wheels.channels if c.startswith("speed_")]
        if wheels is not None and names:
            rolled = np.mean([wheels.channel(channel) for channel in names], axis=0)
            ahead = ahead * np.sign(np.interp(stream.time_s, wheels.time_s, rolled))
        if imu is not None and "gyro_z_radps" in imu.channels:
            gyro = imu.channel("gyro_z_radps")
            known = np.isfinite(gyro)
            turn = np.interp(stream.time_s, imu.time_s[known], gyro[known]) if known.any() else still
        return np.column_stack([ahead, still, turn])
    if set(TWIST) <= set(stream.channels):
        return stream.columns(TWIST)
    camera = robot.completed.camera
    if set(CAMERA_CHANNELS[:-1]) <= set(stream.channels):
        seen = body_motion(stream, camera)
        ahead, left, turn = *seen.speed_mps.T, seen.yaw_rate_radps
    else:  # a speed alone: the point that it is of turns with the body by a rate that is not measured
        ahead, left, turn = *(stream.channel(channel) for channel in TWIST[:2]), still
    origin = point_velocity(ahead, left, turn, -camera.lever_x_m, -camera.lever_y_m)
    return np.column_stack([*origin, turn])


MAX_CORRELATION = 0.95  #: Of residuals; beyond, too few independent samples are left for a variance


@njit
def window_rates(
    time_s: Array, sums: Array, part: Array, start_s: Array, end_s: Array, min_samples: int, coverage: float
) -> tuple[Array, Array]:
    """Return rates (k, c) and their standard deviations (k, c); NaN where a window has too little.

    Parameters
    ----------
    time_s : (n,) increasing
    sums : (n, c)
    part : (n,) integers; a window across two parts has no rate
    start_s, end_s : (k,) of the windows, the end included
    min_samples : fewest samples of a window, three or more
    coverage : least share of a window that its samples span

    Examples
    --------
    >>> time_s = np.arange(5.0)
    >>> rates, std = window_rates(time_s, 2.0 * time_s[:, None], np.zeros(5, np.int64), np.zeros(1),
    ...                           np.full(1, 4.0), 3, 0.5)
    >>> float(rates[0, 0]), float(std[0, 0])
    (2.0, 0.0)
    """
    k, c = start_s.size, sums.shape[1]
    rate, std = np.full((k, c), np.nan), np.full((k, c), np.nan)
    for w in range(k):
        first = np.searchsorted(time_s, start_s[w] - 1e-9)
        last = np.searchsorted(time_s, end_s[w] + 1e-9)
        n = last - first
        if n < max(min_samples, 3) or part[first] != part[last - 1]:
            continue
        if time_s[last - 1] - time_s[first] < coverage * (end_s[w] - start_s[w]):
            continue
        middle_s = time_s[first:last].mean()
        size = ((time_s[first:last] - middle_s) ** 2).sum()
        for j in range(c):
            mean = sums[first:last, j].mean()
            slope = ((time_s[first:last] - middle_s) * (sums[first:last, j] - mean)).sum() / size
            before, squared, crossed = 0.0, 0.0, 0.0
            for i in range(first, last):
                left = sums[i, j] - mean - slope * (time_s[i] - middle_s)
                squared += left * left
                if i > first:
                    crossed += left * before
                before = left
            rate[w, j] = slope
            q = min(max(crossed / squared, 0.0), MAX_CORRELATION) if squared > 0.0 else 0.0
            std[w, j] = np.sqrt(squared / (n - 2) / size * (1.0 + q) / (1.0 - q))
    return rate, std


WINDOW_S = 2.0
STRIDE_S = 1.0

MIN_SPEED_MPS = 0.03
"""Wheel speed and ground speed both lower: standing.  A camera's noise over 2 s is 0.1 % of it, so that the
smallest robots are judged too; slip over shorter windows has the larger error that it states."""

MAX_SLIP_STD = 0.2  #: A slip that is less certain is not stated

STEADY_RATIO, STEADY_STD = 0.1, 3.0
"""Speeds of the halves of a window that differ by more than this share of it, and by more than so many
standard deviations, are no steady motion."""

MIN_SAMPLES = 6
COVERAGE = 0.8  #: Of a window, by samples of either stream
#: Of the short windows of a stream of slip: a lidar that misses half of its scans leaves parts of 0.25 s.
STREAM_SAMPLES, STREAM_COVERAGE = 3, 0.3


#: Slip of the body, its speed across the direction of the wheels over the faster of both speeds, and its yaw rate over
#: that of the wheels, NaN where these do not turn it.
BODY_CHANNELS = ("slip_body_ratio", "slip_side_ratio", "slip_turn_ratio")


class MeasuredSlip(NamedTuple):
    """Slip over k windows of a run; NaN where it is not known."""

    run_id: str  #: of the run
    source: str  #: stream that measured the motion from outside
    wheels: tuple[str, ...]  #: their names
    start_s: Array  #: start_s, end_s: (k,) of the windows, on the clock of the wheels
    end_s: Array
    #: wheel_speed_mps, ground_speed_mps: (k, wheels) circumferential speed, and speed of its centre along it
    wheel_speed_mps: Array
    ground_speed_mps: Array
    slip_ratio: Array  #: slip_ratio, slip_std: (k, wheels)
    slip_std: Array
    twist: Array  #: twist, twist_std: (k, 3) as measured from outside
    twist_std: Array
    rolled_twist: Array  #: (k, 3) of wheels that would not slip
    body_slip: Array  #: body_slip, body_slip_std, body_side: (k,)
    body_slip_std: Array
    body_side: Array
    steady: Array  #: (k,) whether both halves of a window have one speed
    n_jumps: int = 0  #: n_jumps, n_gaps: of the outside measurement
    n_gaps: int = 0

    @property
    def time_s(self) -> Array:
        """Middle (k,) of each window."""
        return (self.start_s + self.end_s) / 2

    @property
    def known(self) -> Array:
        """Places (j,) of the windows in steady motion that have a slip of the body."""
        return np.flatnonzero(self.steady & np.isfinite(self.body_slip))

    @property
    def track(self) -> SlipTrack:
        """The slips of the wheels, at the middle of each window."""
        channels = tuple(map("slip_{}_ratio".format, self.wheels))
        return SlipTrack(self.time_s, self.slip_ratio, self.slip_std, channels)

    @property
    def stream(self) -> Stream:
        """The stream ``slip`` of a run log: of the wheels, and :data:`BODY_CHANNELS`, at the middle of each window."""
        turned, rolled = self.twist[:, 2], self.rolled_twist[:, 2]
        turns = np.abs(rolled) >= MIN_TURN_RADPS  # False for NaN
        ratio = np.divide(turned, rolled, out=np.full(turned.shape, np.nan), where=turns)
        of_wheels = self.track.as_stream()
        values = [of_wheels.values, np.column_stack([self.body_slip, self.body_side, ratio])]
        return Stream(self.time_s, np.hstack(values), (*of_wheels.channels, *BODY_CHANNELS))


def measured_slip(
    run: RunLog,
    robot: Robot,
    *,
    window_s: float = WINDOW_S,
    stride_s: float = STRIDE_S,
    delay_s: float = 0.0,
    whole: bool = False,
) -> MeasuredSlip:
    """Return the slip of a run over windows, from wheel speeds and a measurement from outside.

    Parameters
    ----------
    run : with wheel speeds (``speed_<wheel>_mps``) and a stream that measured the motion from outside
    robot : whose log it is, of any drive
    window_s, stride_s : length of the windows, and from one to the next
    delay_s : of the outside measurement behind the wheels
    whole : windows about each time from the first to the last sample of the wheels, as a stream of slip has them, NaN
        where the motion was not measured; by default they begin and end where both were

    Raises
    ------
    ConfigError
        if a length is not above zero.
    DataError
        if the run has no wheel speeds, no measurement from outside, or no window that both cover.
    """
    if not (window_s > 0 and stride_s > 0):
        raise ConfigError(f"window and stride are {window_s:g} and {stride_s:g} s, lengths above zero needed")
    time_s, speeds = wheel_speeds(run, robot)
    path = travelled(run, robot, delay_s)
    outside_s = time_s if whole else path.time_s
    if len(outside_s) < 2:
        raise DataError(
            f"run {run.run_id}: has {len(outside_s)} samples measured from outside, two are needed"
        )
    begin_s, last_s = max(time_s[0], outside_s[0]), min(time_s[-1], outside_s[-1]) - window_s
    if whole:
        begin_s, last_s = begin_s - window_s / 2, last_s + window_s / 2
    if last_s < begin_s - 0.02 * window_s:
        raise DataError(
            f"run {run.run_id}: wheels and outside measurement share {max(last_s + window_s - begin_s, 0.0):.2f} "
            f"s, a window takes {window_s:g} s"
        )
    n = max(int(np.floor((last_s - begin_s) / stride_s + 1e-6)) + 1, 1)
    start_s = begin_s + stride_s * np.arange(n)
    end_s, rolled = start_s + window_s, _rolled(time_s, speeds)
    enough = (STREAM_SAMPLES, STREAM_COVERAGE) if whole else (MIN_SAMPLES, COVERAGE)
    u, u_std = window_rates(*rolled, start_s, end_s, *enough)
    twist, twist_std = window_rates(path.time_s, path.values, path.part, start_s, end_s, *enough)
    place_m, direction = robot.wheel_positions_m, wheel_directions(run, robot, start_s, end_s)
    rolling = rolling_matrix(place_m, direction, robot.roller_angles_rad)
    along = (rolling * twist[:, None, :]).sum(axis=-1)
    along_std = np.sqrt(((rolling * twist_std[:, None, :]) ** 2).sum(axis=-1))
    slip, slip_std = _slip(u, u_std, along, along_std)
    slip[:, ~np.isin(robot.wheels, robot.logged_wheels)] = np.nan
    rollers = robot.on_omni_wheels, robot.roller_angles_rad
    rolled_twist, _ = no_slip_twist(place_m, direction, u, *rollers)
    speed = np.linalg.norm(rolled_twist[:, :2], axis=1)
    ahead = rolled_twist[:, :2] / np.where(speed > 0.0, speed, np.nan)[:, None]
    body = (twist[:, :2] * ahead).sum(axis=1)
    body_std = np.sqrt(((ahead * twist_std[:, :2]) ** 2).sum(axis=1))
    body_slip, body_slip_std = _slip(speed, np.sqrt((u_std**2).mean(axis=1)), body, body_std)
    across = ahead[:, 0] * twist[:, 1] - ahead[:, 1] * twist[:, 0]
    side = np.where(np.isnan(body_slip), np.nan, across / np.maximum(speed, np.abs(body)))
    middle_s = (start_s + end_s) / 2
    half = (STREAM_SAMPLES, enough[1])  # of a short window at 20 Hz it has five samples
    first, first_std = window_rates(*rolled, start_s, middle_s, *half)
    second, second_std = window_rates(*rolled, middle_s, end_s, *half)
    least = STEADY_RATIO * np.abs(u).max(axis=1, keepdims=True)
    allowed = np.maximum(least, STEADY_STD * np.hypot(first_std, second_std))
    return MeasuredSlip(
        run_id=run.run_id,
        source=path.source,
        wheels=robot.wheels,
        start_s=start_s,
        end_s=end_s,
        wheel_speed_mps=u,
        ground_speed_mps=along,
        slip_ratio=slip,
        slip_std=slip_std,
        twist=twist,
        twist_std=twist_std,
        rolled_twist=rolled_twist,
        body_slip=body_slip,
        body_slip_std=body_slip_std,
        body_side=side,
        steady=(np.abs(second - first) <= allowed).all(axis=1),
        n_jumps=path.n_jumps,
        n_gaps=path.n_gaps,
    )


def _rolled(time_s: Array, speeds_mps: Array) -> tuple[Array, Array, Array]:
    """Return stamps, what wheels rolled up to each, and the one part that they are of."""
    steps = np.diff(time_s)[:, None] * (speeds_mps[1:] + speeds_mps[:-1]) / 2
    rolled = np.concatenate([np.zeros((1, speeds_mps.shape[1])), np.cumsum(steps, axis=0)])
    known = np.isfinite(rolled).all(axis=1)
    return time_s[known], rolled[known], np.zeros(int(known.sum()), dtype=np.int64)


def wheel_speeds(run: RunLog, robot: Robot) -> tuple[Array, Array]:
    """Return times (n,) and circumferential speeds (n, wheels) of a run's wheels.

    The wheel of a car-like robot that is not driven, and not logged, rolls with the other one.

    Raises
    ------
    DataError
        if the run has none, or fewer than two samples.
    """
    names = [f"speed_{wheel}_mps" for wheel in robot.logged_wheels]
    wheels, steering = run.streams.get("wheels"), run.streams.get("steering")
    if wheels is None or not set(names) <= set(wheels.channels) or len(wheels) < 2:
        raise DataError(f"run {run.run_id}: has no wheel speeds ({', '.join(names)}) of two samples or more")
    speeds = wheels.columns(names)
    if isinstance(robot, BicycleRobot):
        cos = np.ones(len(wheels))
        if steering is not None and robot.steer_channels[0] in steering.channels:
            angle = np.interp(wheels.time_s, steering.time_s, steering.channel(robot.steer_channels[0]))
            cos = np.cos(angle - robot.steering_zeros_rad[0])
        driven = speeds[:, 0]
        both = (driven, driven * cos) if robot.front_driven else (driven / cos, driven)
        return wheels.time_s, np.column_stack(both)
    return wheels.time_s, speeds


def wheel_directions(run: RunLog, robot: Robot, start_s: Array, end_s: Array) -> Array:
    """Return the mean direction (k, wheels) that each wheel drives along over windows.

    Raises
    ------
    DataError
        if wheels are steered and the run has no steering angles.
    """
    if not robot.steered:
        return np.broadcast_to(robot.wheel_directions_rad, (len(start_s), len(robot.wheels)))
    steering = run.streams.get("steering")
    names = robot.steer_channels
    if steering is None or not set(names) <= set(steering.channels):
        raise DataError(f"run {run.run_id}: has no steering angles ({', '.join(names)})")
    angles = np.zeros((len(steering), len(robot.wheels)))  # those that are not steered point ahead
    angles[:, : len(names)] = steering.columns(names)
    angles -= robot.steering_zeros_rad
    means = np.full((len(start_s), len(robot.wheels)), np.nan)
    for i, (first_s, last_s) in enumerate(zip(start_s, end_s, strict=True)):
        inside = (steering.time_s >= first_s) & (steering.time_s <= last_s)
        if inside.any():
            means[i] = np.angle(np.nanmean(np.exp(1j * angles[inside]), axis=0))
    return means


SPIN_RATIO, GRIP_RATIO = 0.9, 0.5  #: Slip of a wheel that spins, and that one of the others stays below.


def spinning_wheels(found: MeasuredSlip) -> list[str]:
    """Return the wheels that spin or lift in any window: nearly all their speed is slip, others grip."""
    with np.errstate(invalid="ignore"):
        magnitude = np.abs(found.slip_ratio)
        grips = magnitude < GRIP_RATIO
        others = grips.sum(axis=1, keepdims=True) > grips
        alone = (magnitude > SPIN_RATIO) & others & (found.slip_std < 1.0 - SPIN_RATIO)
    return [wheel for wheel, spins in zip(found.wheels, alone.any(axis=0), strict=True) if spins]


def _slip(u: Array, u_std: Array, v: Array, v_std: Array) -> tuple[Array, Array]:
    """Return slip and its standard deviation; NaN where standing or too uncertain."""
    slip = slip_ratio(u, v, MIN_SPEED_MPS)
    fastest = np.maximum(np.maximum(np.abs(u), np.abs(v)), MIN_SPEED_MPS)
    slower = np.minimum(np.abs(u), np.abs(v))
    driven = np.abs(u) >= np.abs(v)
    by_fastest, by_slowest = slower / fastest**2, 1.0 / fastest
    std = np.hypot(
        np.where(driven, by_fastest, by_slowest) * u_std, np.where(driven, by_slowest, by_fastest) * v_std
    )
    unknown = np.isnan(slip) | ~(std <= MAX_SLIP_STD)
    return np.where(unknown, np.nan, slip), np.where(unknown, np.nan, std)


DELAY_SEARCH_S = (-0.4, 1.2)
"""Bounds of the search: a lidar that matches scans comes out up to 0.7 s late; beyond a second it is no delay
but two clocks."""

DELAY_STEP_S = 0.02
DELAY_WINDOW_S = 0.3  #: Over which twists are taken: a start takes 0.2 to 0.5 s

REST_S = 1.0
"""A log whose wheels stand at its first sample is taken to be of a robot at rest for so long before it: most
recordings begin with the start that shows the delay."""

MIN_KNOWN = 0.3  #: Of the windows of a run, with every delay of the search
MAX_DELAY_STD_S = 0.1  #: A delay that is less certain is not applied


ROUND_OFF = 1e-20  #: Of the squares of a component of the wheels' twist, over those of the largest.


def delay_sentence(delay: Delay) -> str:
    """Return by how much the outside measurement is late, in words."""
    if delay.status is not DelayStatus.ESTIMATED:
        return "the delay of the outside measurement was not found, and none is taken off."
    return (
        f"the outside measurement is {delay.delay_s:+.3f} s behind the wheels "
        f"(± {1.96 * delay.std_s:.3f}), which is taken off."
    )


def estimate_delay(runs: Sequence[RunLog], robot: Robot, seed: int = 0) -> Delay:
    """Return by how much the outside measurement of runs of one robot and one outside sensor lags behind their wheels.

    Runs without either are passed over; ``seed`` is of the draws that the interval is from.
    """
    lags_s = np.arange(DELAY_SEARCH_S[0], DELAY_SEARCH_S[1] + DELAY_STEP_S / 2, DELAY_STEP_S)
    curves = []
    for run in runs:
        try:
            curves += _misfits(run, robot, lags_s, 3 if len(runs) == 1 else 1)
        except DataError:
            continue
    return common_delay(lags_s, [-curve for curve in curves], MAX_DELAY_STD_S, seed)


def _misfits(run: RunLog, robot: Robot, lags_s: Array, n_parts: int) -> list[Array]:
    """Return the misfit (lags,) of each part of a run, relative to what its wheels vary by."""
    time_s, speeds = wheel_speeds(run, robot)
    _, times_s, values, part, *_ = travelled(run, robot)
    if len(times_s) < 2:
        return []
    if not np.abs(speeds[0]).max() > 0.0:
        rest_s = np.arange(-REST_S, -DELAY_STEP_S / 2, DELAY_STEP_S)
        time_s, times_s = np.r_[time_s[0] + rest_s, time_s], np.r_[times_s[0] + rest_s, times_s]
        speeds, values = (np.pad(each, ((rest_s.size, 0), (0, 0)), mode="edge") for each in (speeds, values))
        part = np.pad(part, (rest_s.size, 0), mode="edge")
    start_s = np.arange(time_s[0], time_s[-1] - DELAY_WINDOW_S, DELAY_WINDOW_S / 6)
    if start_s.size < 8 * n_parts:
        return []
    end_s = start_s + DELAY_WINDOW_S
    u, _ = window_rates(*_rolled(time_s, speeds), start_s, end_s, 3, 0.4)
    directions = wheel_directions(run, robot, start_s, end_s)
    rollers = robot.on_omni_wheels, robot.roller_angles_rad
    rolled, _ = no_slip_twist(robot.wheel_positions_m, directions, u, *rollers)
    scale = np.array([1.0, 1.0, float(np.linalg.norm(robot.wheel_positions_m, axis=1).max())])
    rates = (
        window_rates(times_s, values, part, start_s + lag_s, end_s + lag_s, 3, 0.4)[0] for lag_s in lags_s
    )
    x, y = rolled * scale, np.array(list(rates)) * scale
    known = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=2)
    curves = []
    for rows in np.array_split(np.arange(start_s.size), n_parts):
        if known[:, rows].sum(axis=1).min() >= max(8, MIN_KNOWN * rows.size):
            parts = ((x[rows][k], lag[rows][k]) for lag, k in zip(y, known[:, rows], strict=True))
            curves.append(np.array([_misfit(wheels, outside) for wheels, outside in parts]))
    return curves


def _misfit(x: Array, y: Array) -> float:
    """Return the mean square of what a gain for each component leaves of y (k, 3) beside x (k, 3)."""
    power = (x**2).sum(axis=0)
    moves = power > ROUND_OFF * power.max()  # of a straight drive the turn of the wheels is round-off
    gain = np.where(moves, (y * x).sum(axis=0) / np.where(moves, power, 1.0), 0.0)
    return float(((y - gain * x) ** 2).sum() / len(x))


WINDOWS_S = (2.0, 0.5)
"""Windows of steady motion; short ones where the outside measurement does not cover longer ones, as a lidar's
twist."""


class Measured(NamedTuple):
    """Runs beside their slip, the delays by session, and a sentence for each run without a slip."""

    runs: list[RunLog]
    slips: list[MeasuredSlip]
    delays: dict[str, Delay]
    failed: list[str]

    def by_terrain(self) -> dict[str, Measured]:
        """Return the runs of each single terrain, sorted by its name, with those on several or none last."""
        names = [single_terrain(run) for run in self.runs]
        found = {}
        for name in sorted(set(names), key=lambda name: (name == "", name)):
            own = [i for i, each in enumerate(names) if each == name]
            found[name] = self._replace(runs=[self.runs[i] for i in own], slips=[self.slips[i] for i in own])
        return found


def single_terrain(run: RunLog) -> str:
    """Return the terrain that a run is labelled with; empty where it is on several or none."""
    return run.terrains[0] if len(run.terrains) == 1 else ""


def one_robot(runs: Sequence[RunLog], given: Robot | None) -> Robot:
    """Return the robot of runs: the one that is passed, where it has the name that they state.

    Raises
    ------
    DataError
        if they are of several.
    ConfigError
        if it is unknown.
    """
    names = sorted({run.robot for run in runs})
    if len(names) > 1:
        raise DataError(f"the runs are of the robots {', '.join(names)}: measure those of one at a time")
    return robot_named(names[0], given)


def measure(
    runs: Sequence[RunLog],
    robot: Robot,
    *,
    window_s: float,
    stride_s: float,
    delay_s: float | None = None,
    seed: int = 0,
    progress: Callable[[str, int, int], None] = lambda task, done, total: None,
) -> Measured:
    """Return the slip of each run, with the delay of its session taken off.

    Parameters
    ----------
    runs : of the robot
    window_s, stride_s : of the slips
    delay_s : of the outside measurement; found, a session at a time, by default
    seed : of the intervals of delays
    progress : gets the task, how many of its steps are done, and how many there are
    """
    delays: dict[str, Delay] = {}
    sessions = sorted({run.session for run in runs})
    for done, session in enumerate(sessions, start=1):
        members = [run for run in runs if run.session == session]
        if delay_s is None:
            delays[session] = estimate_delay(members, robot, seed)
        else:
            delays[session] = Delay(delay_s, 0.0, len(members), DelayStatus.ESTIMATED)
        progress("delay", done, len(sessions))
    measured, slips, failed = [], [], []
    for done, run in enumerate(runs, start=1):
        late_s = delays[run.session].applied_s
        try:
            slips.append(measured_slip(run, robot, window_s=window_s, stride_s=stride_s, delay_s=late_s))
            measured.append(run)
        except DataError as error:
            failed.append(str(error))
        progress("slip", done, len(runs))
    return Measured(measured, slips, delays, failed)


def measure_steady(
    runs: Sequence[RunLog],
    robot: Robot,
    seed: int,
    progress: Callable[[str, int, int], None] = lambda task, done, total: None,
) -> tuple[float, Measured]:
    """Return slips over :data:`WINDOWS_S`, the first in which a robot drives steadily, and that length.

    Raises
    ------
    DataError
        if there is no slip in steady motion.
    """
    first = ""
    for window_s in WINDOWS_S:
        found = measure(runs, robot, window_s=window_s, stride_s=window_s / 2, seed=seed, progress=progress)
        if any(slip.known.size for slip in found.slips):
            return window_s, found
        first = first or (found.failed[0] if found.failed else "no window is driven steadily")
    raise DataError(f"none of {len(runs)} runs has a slip; the first for this: {first}")


N_FOLDS = 5

MIN_TURN_RADPS = 0.2  #: Of wheels, from which their yaw rate is compared with that measured from outside


@dataclass(frozen=True, slots=True)
class SurfaceSlip:
    """Slip of a robot on a surface; NaN where it is not known."""

    terrain: str  #: name of the surface; empty for runs without a label
    n_sessions: int  #: n_sessions, n_runs, n_windows: with a slip in steady motion
    n_runs: int
    n_windows: int
    n_standing: int  #: windows without a slip because the robot stood, or because it was too uncertain
    #: slip_ratio, interval, interval_of, interval_std: of the body, as of :class:`SessionSlip`
    slip_ratio: float
    interval: tuple[float, float]
    interval_of: IntervalOf
    interval_std: float
    spread: tuple[float, float]  #: quartiles of the windows
    std: float  #: median standard deviation of a window's slip
    held_out: float  #: largest difference of the median of a session, or a fifth of the runs of one, from the others
    wheel_slip: tuple[
        float, ...
    ]  #: median of each wheel, positive in traction whichever direction it rolls in
    turn_ratio: float  #: median yaw rate measured from outside over that of wheels without slip
    spinning: tuple[str, ...]  #: runs with a wheel that spins or lifts, and which


def surface_slips(measured: Measured, rng: np.random.Generator) -> dict[str, SurfaceSlip]:
    """Return what runs on each surface measured, by its name, of their windows in steady motion."""
    by_terrain, of_runs = measured.by_terrain(), dict[str, tuple[Array, Array]]()
    for terrain, own in by_terrain.items():
        known = [i for i, slip in enumerate(own.slips) if slip.known.size]
        medians = [np.median(own.slips[i].body_slip[own.slips[i].known]) for i in known]
        of_runs[terrain] = np.array(medians), np.array([own.runs[i].session for i in known], dtype=str)
    slips = session_slips(of_runs, rng)
    return {
        name: _surface_slip(name, own.slips, of_runs[name], slips[name]) for name, own in by_terrain.items()
    }


def _surface_slip(
    terrain: str, runs: Sequence[MeasuredSlip], of_runs: tuple[Array, Array], found: SessionSlip
) -> SurfaceSlip:
    some = [run for run in runs if run.known.size]
    windows = np.concatenate([[], *(run.body_slip[run.known] for run in some)])
    low, high = np.quantile(windows, [0.25, 0.75]).tolist() if windows.size else (np.nan, np.nan)
    driven = [run.slip_ratio * np.where(run.wheel_speed_mps < 0.0, -1.0, 1.0) for run in runs]
    wheels = np.concatenate([slip[run.steady] for slip, run in zip(driven, runs, strict=True)])
    turns = np.concatenate(
        [np.column_stack([run.rolled_twist, run.twist])[run.steady][:, [2, 5]] for run in runs]
    )
    with np.errstate(invalid="ignore"):
        turns = turns[np.abs(turns[:, 0]) >= MIN_TURN_RADPS]
    return SurfaceSlip(
        terrain=terrain,
        n_sessions=found.n_sessions,
        n_runs=len(some),
        n_windows=int(windows.size),
        n_standing=int(sum((~np.isfinite(run.body_slip)).sum() for run in runs)),
        slip_ratio=found.slip_ratio,
        interval=found.interval,
        interval_of=found.interval_of,
        interval_std=found.std,
        spread=(low, high),
        std=_median(np.concatenate([run.body_slip_std[run.steady] for run in runs])),
        held_out=_held_out(*of_runs, some),
        wheel_slip=tuple(_median(wheel) for wheel in wheels.T),
        turn_ratio=_median(turns[:, 1] / turns[:, 0]),
        spinning=tuple(
            f"{run.run_id} ({', '.join(names)})" for run in runs if (names := spinning_wheels(run))
        ),
    )


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _held_out(medians: Array, session: Array, runs: Sequence[MeasuredSlip]) -> float:
    """Return the largest difference of a fold's median from that of the rest; NaN with too few runs.

    Folds are sessions; those of one session are dealt in the order of the speed that wheels roll at, then of direction.
    """
    if len(names := np.unique(session)) > 1:
        apart = (session == name for name in names)
        return max(float(abs(np.median(medians[own]) - np.median(medians[~own]))) for own in apart)
    if medians.size < N_FOLDS:
        return float("nan")
    twist = np.array([np.nanmedian(run.rolled_twist, axis=0) for run in runs])
    speed = np.round(np.linalg.norm(twist[:, :2], axis=1), 1)
    order = np.lexsort((np.arctan2(twist[:, 1], twist[:, 0]), speed))
    parts = (order[k::N_FOLDS] for k in range(N_FOLDS))
    return max(float(abs(np.median(medians[part]) - np.median(np.delete(medians, part)))) for part in parts)


class OperatingPoints(NamedTuple):
    """Points of runs, (n,) each; NaN where it is not known."""

    slip_ratio: Array  #: median of the body over a run's windows in steady motion
    current_a: Array  #: median over these of the mean of the wheels
    thrust_ratio: Array  #: mean thrust of a wheel over its share of the weight


def operating_points(runs: Sequence[RunLog], slips: Sequence[MeasuredSlip], robot: Robot) -> OperatingPoints:
    """Return the operating point of each run."""
    names = [f"current_{wheel}_a" for wheel in robot.wheels]
    points = np.full((len(runs), 3), np.nan)
    for point, run, slip in zip(points, runs, slips, strict=True):
        wheels = run.streams["wheels"]
        if not slip.known.size:
            continue
        point[0] = np.median(slip.body_slip[slip.known])
        if not set(names) <= set(wheels.channels):
            continue
        current = np.abs(wheels.columns(names))
        ends = zip(slip.start_s[slip.known], slip.end_s[slip.known], strict=True)
        inside = np.any([(wheels.time_s >= a) & (wheels.time_s <= b) for a, b in ends], axis=0)
        known = np.isfinite(current).all(axis=1) & inside
        if not known.any():
            continue
        point[1] = current[known].mean()
        if robot.describes("motors"):
            load_n = robot.mass_kg * GRAVITY_MPS2 / len(robot.wheels)
            thrust_n = (point[1] * robot.motors.nm_per_a - robot.motors.friction_nm) / robot.wheel_radius_m
            point[2] = thrust_n / load_n
    return OperatingPoints(*points.T)
