r"""Distance travelled by the body along its own axes, from whatever measured its motion from outside.

A pose that is measured from outside (a camera above, a lidar, motion capture) gives, from one sample to the
next, an arc: with the chord :math:`\Delta p` and the turn :math:`\Delta\psi`,

.. math:: \Delta s = \frac{\Delta\psi / 2}{\sin(\Delta\psi / 2)} R(-\bar\psi)\,\Delta p ,

along the axes of the body at the mean heading of the two.  The sums of a steady motion are straight lines in
time, however tight the turn, so that a slope over a window is the mean twist of it
(:mod:`~terrain.measured_slip.rates`).  A stream of speeds over ground is integrated.  A receiver of
satellites measures a velocity without a heading: of a robot that cannot drive sideways it is taken along its
x axis, forward where the wheels roll forward, and the turn by the gyro where there is one.

Where a measurement pauses or jumps (a camera that loses the robot, a scan that is matched elsewhere) nothing
is known of what was driven meanwhile: a new part begins, and no window reaches across.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrain.errors import DataError
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.camera import body_motion
from terrain.kinematics.wheel_velocity import TWIST, point_velocity
from terrain.logs.schema import POSE_CHANNELS
from terrain.records import Array, RunLog, Stream, read_only
from terrain.robots import Robot

SOURCES: tuple[str, ...] = ("pose", "lidar", "odometry", "gnss")
"""Streams that measure motion from outside, the most direct first."""

VELOCITY: tuple[str, ...] = ("velocity_x_mps", "velocity_y_mps")
"""Channels of a receiver's velocity, east and north."""

MAX_GAP_S = 0.5
"""Longer without a sample, what was driven meanwhile is not known well enough to be summed."""

MAX_SPEED_RATIO, MAX_JUMP_M = 3.0, 0.05
"""A pose that is further from the one before than so many times what the fastest wheel rolled, and this, has
jumped; a robot that slides is not faster than its wheels were."""


@dataclass(frozen=True, slots=True, eq=False)
class Travelled:
    """Distances travelled forward and to the left, and the angle turned.

    Parameters
    ----------
    source : stream that measured it
    time_s : (n,) of the samples
    values : (n, 3) in m, m and rad, from 0 at the first sample of each part
    part : (n,) number of the part that a sample is in; distances of two parts are not related
    n_jumps, n_gaps : why parts begin
    """

    source: str
    time_s: Array
    values: Array
    part: Array
    n_jumps: int
    n_gaps: int

    def __post_init__(self) -> None:
        for name, dtype in (("time_s", float), ("values", float), ("part", np.int64)):
            object.__setattr__(self, name, read_only(getattr(self, name), dtype))


def outside_source(run: RunLog) -> str | None:
    """Return the name of the stream that measured a run's motion from outside; None where none did.

    Examples
    --------
    >>> outside_source(RunLog("a", "husky", {}))
    """
    for name in SOURCES:
        stream = run.streams.get(name)
        if stream is None or len(stream) < 2:
            continue
        needed = {
            "pose": (POSE_CHANNELS,),
            "lidar": (TWIST,),
            "odometry": (CAMERA_CHANNELS[:-1], TWIST[:2]),
            "gnss": (VELOCITY,),
        }[name]
        if any(set(channels) <= set(stream.channels) for channels in needed):
            return name
    return None


def travelled(run: RunLog, robot: Robot, delay_s: float = 0.0) -> Travelled:
    """Return what a run's body travelled, as measured from outside.

    Parameters
    ----------
    run : with one of :data:`SOURCES`
    robot : whose log it is; where its camera sits, if the odometry is one's
    delay_s : of the outside measurement behind the wheels; it is taken off its stamps

    Raises
    ------
    DataError
        if nothing measured the motion from outside, or only a receiver whose velocity has no heading did.

    Examples
    --------
    A quarter circle of 1 m radius to the left, in 2 s:

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
            f"{', '.join(SOURCES[:-1])} or {SOURCES[-1]} is needed"
        )
    stream = run.streams[name]
    if name == "pose":
        found = _of_poses(stream, _fastest_mps(run, robot))
    elif name == "gnss":
        found = _of_twists(name, _receiver_twist(run, robot))
    else:
        found = _of_twists(name, _twist_stream(stream, robot))
    if delay_s == 0.0:
        return found
    return Travelled(name, found.time_s - delay_s, found.values, found.part, found.n_jumps, found.n_gaps)


def _fastest_mps(run: RunLog, robot: Robot) -> float:
    """Return the speed of the fastest wheel; infinite where no wheel is known."""
    wheels = run.streams.get("wheels")
    if wheels is None:
        return float("inf")
    scales = {"speed": 1.0}
    if robot.describes("motors"):
        scales["motor"] = robot.wheel_radius_m / robot.motors.reduction_ratio
    for quantity, scale in scales.items():
        columns = [wheels.channel(c) for c in wheels.channels if c.startswith(f"{quantity}_")]
        values = np.column_stack(columns) if columns else np.empty(0)
        known = np.abs(values[np.isfinite(values)])
        if known.size:
            return float(known.max()) * scale
    return float("inf")


def _of_poses(stream: Stream, fastest_mps: float) -> Travelled:
    pose = np.column_stack([stream.channel(channel) for channel in POSE_CHANNELS])
    known = np.isfinite(pose).all(axis=1)
    time_s, pose = stream.time_s[known], pose[known]
    if len(time_s) < 2:
        return Travelled("pose", time_s, np.zeros((len(time_s), 3)), np.zeros(len(time_s)), 0, 0)
    yaw = np.unwrap(pose[:, 2])
    turned, chord, step_s = np.diff(yaw), np.diff(pose[:, :2], axis=0), np.diff(time_s)
    heading = yaw[:-1] + turned / 2
    cos, sin = np.cos(heading), np.sin(heading)
    arc = chord / np.sinc(turned / (2 * np.pi))[:, None]
    steps = np.column_stack([cos * arc[:, 0] + sin * arc[:, 1], cos * arc[:, 1] - sin * arc[:, 0], turned])
    gap = step_s > MAX_GAP_S
    jumped = ~gap & (np.linalg.norm(chord, axis=1) > MAX_SPEED_RATIO * fastest_mps * step_s + MAX_JUMP_M)
    return _summed("pose", time_s, steps, gap, jumped)


def _of_twists(name: str, stream: Stream) -> Travelled:
    known = np.isfinite(stream.values).all(axis=1)
    time_s, twist = stream.time_s[known], stream.values[known]
    usual_s = float(np.median(np.diff(stream.time_s)))
    steps = np.diff(time_s)[:, None] * (twist[1:] + twist[:-1]) / 2.0
    return _summed(
        name, time_s, steps, np.diff(time_s) > max(1.5 * usual_s, 1e-3), np.zeros(len(steps), dtype=bool)
    )


def _summed(name: str, time_s: Array, steps: Array, gap: Array, jumped: Array) -> Travelled:
    broken = gap | jumped
    part = np.concatenate([[0], np.cumsum(broken)])
    values = np.concatenate([np.zeros((1, 3)), np.cumsum(np.where(broken[:, None], 0.0, steps), axis=0)])
    return Travelled(name, time_s, values, part, int(jumped.sum()), int(gap.sum()))


def _receiver_twist(run: RunLog, robot: Robot) -> Stream:
    """Return the twist of a body that moves along its x axis, by a receiver's velocity and the gyro."""
    if robot.sideways:
        raise DataError(
            f"run {run.run_id}: the velocity of its receiver has no heading, and robot {robot.name} can "
            "drive sideways; poses are needed"
        )
    gnss, imu = run.streams["gnss"], run.streams.get("imu")
    speed_mps = np.hypot(*(gnss.channel(name) for name in VELOCITY))
    wheels = run.streams.get("wheels")
    if wheels is not None:
        speeds = [wheels.channel(c) for c in wheels.channels if c.startswith("speed_")]
        if speeds:
            speed_mps = speed_mps * np.sign(np.interp(gnss.time_s, wheels.time_s, np.mean(speeds, axis=0)))
    turn_radps = np.zeros(len(gnss))
    if imu is not None and "gyro_z_radps" in imu.channels:
        gyro = imu.channel("gyro_z_radps")
        known = np.isfinite(gyro)
        turn_radps = np.interp(gnss.time_s, imu.time_s[known], gyro[known]) if known.any() else turn_radps
    return Stream(gnss.time_s, np.column_stack([speed_mps, np.zeros(len(gnss)), turn_radps]), TWIST)


def _twist_stream(stream: Stream, robot: Robot) -> Stream:
    """Return the twist of the body's origin."""
    if set(TWIST) <= set(stream.channels):
        return Stream(stream.time_s, np.column_stack([stream.channel(name) for name in TWIST]), TWIST)
    camera = robot.completed.camera
    if set(CAMERA_CHANNELS[:-1]) <= set(stream.channels):
        seen = body_motion(stream, camera)
        ahead_mps, left_mps, turn_radps = *seen.speed_mps.T, seen.yaw_rate_radps
    else:  # a speed alone: the point that it is of turns with the body by a rate that is not measured
        ahead_mps, left_mps = (stream.channel(name) for name in TWIST[:2])
        turn_radps = np.zeros(len(stream))
    origin = point_velocity(ahead_mps, left_mps, turn_radps, -camera.lever_x_m, -camera.lever_y_m)
    return Stream(stream.time_s, np.column_stack([*origin, turn_radps]), TWIST)
