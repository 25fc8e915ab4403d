"""What a drive cost and how well it went, from the truth of its log.

Energy is what the wheels' motors put in, ``max(T w, 0)`` summed over wheels: a driver that is dragged gives
nothing back.  It is compared at equal distance, since at equal time a controller that gets further looks
thrifty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from terrain.kinematics.wheel_velocity import wheel_frame_velocities
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot

PEAK_ABOVE_MPS = 0.2
"""Slip counts while the robot is faster: slower, the ratio is one of two small speeds."""

SMOOTH_S = 0.05
"""Slip is behind the low-pass that its estimate is behind: a bump is no start."""

LOCKED_SHARE, LOCKED_ABOVE_MPS = 0.1, 0.1
"""A wheel is locked where its rim does less than this share of its way over ground, above this speed."""

STOOD_MPS = 0.02
"""A robot that goes slower than this stands."""

STUCK_MPS, STUCK_S, WANTED_MPS = 0.03, 2.0, 0.2
"""A robot that is to go faster than the last, and is slower than the first for so long, is stuck."""

FINAL_S = 20.0
"""The final speed is the mean over so long, or the last third of the run: ground differs along the way."""


class Course(NamedTuple):
    """The truth of a drive, evenly spaced.

    Parameters
    ----------
    time_s, speed_mps, velocity_mps : (n,), (n,), (n, 2); speed over ground whichever way, velocity in body
        axes
    progress_mps : (n,) along what is required; negative where the robot slides back
    distance_m, energy_j, scrub_j, scrub_along_j : (n,) summed up; scrub is what the contacts take up, and the
        part of it along the wheels
    wheel_speed_mps, ground_mps, slip_ratio : (n, wheels) along each wheel; slip positive in traction
        whichever way, behind the low-pass, NaN at rest
    sinkage_m : (n,) the deepest wheel's
    yaw_rad : (n,)
    """

    time_s: Array
    speed_mps: Array
    velocity_mps: Array
    progress_mps: Array
    distance_m: Array
    energy_j: Array
    scrub_j: Array
    scrub_along_j: Array
    wheel_speed_mps: Array
    ground_mps: Array
    slip_ratio: Array
    sinkage_m: Array
    yaw_rad: Array


def course_of(
    run: RunLog, robot: Robot, radius_factors: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Course:
    """Return what happened in a simulated run.

    Parameters
    ----------
    run : with its truth
    robot : the one that drove
    radius_factors : true radius of each wheel over the nominal one (``Conditions``); without them, wheels
        that fight each other by their radii seem to win energy from the ground
    """
    truth = run.streams["truth"]
    wheels = robot.wheels
    step_s = float(np.median(np.diff(truth.time_s)))
    twist = [truth.channel(name) for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")]
    along, across, _ = twist
    rate = np.column_stack([truth.channel(f"wheel_{wheel}_radps") for wheel in wheels])
    steer = np.column_stack([truth.channel(f"steer_{wheel}_rad") for wheel in wheels])
    ground, sideways = wheel_frame_velocities(*twist, robot.wheel_positions_m, steer)
    torque = np.column_stack([truth.channel(f"torque_{wheel}_nm") for wheel in wheels])
    power_w = np.maximum(torque * rate, 0.0).sum(axis=1)
    wheel_speed = rate * robot.wheel_radius_m * np.asarray(radius_factors)
    traction = np.column_stack([truth.channel(f"traction_{wheel}_n") for wheel in wheels])
    side = np.column_stack([truth.channel(f"side_{wheel}_n") for wheel in wheels])
    along_w = (traction * (wheel_speed - ground)).sum(axis=1)
    lost_w = along_w - (side * sideways).sum(axis=1)
    speed = np.hypot(along, across)
    progress = _progress(truth.time_s, np.column_stack([along, across]), run.streams.get("commands"))
    signed = np.full(wheel_speed.shape, math.nan)
    for i, wheel in enumerate(wheels):
        if f"slip_{wheel}_ratio" in truth.channels:  # a slip that no instant has is no channel
            signed[:, i] = truth.channel(f"slip_{wheel}_ratio")
    slip = _smooth(np.nan_to_num(signed * np.sign(ground)), step_s)
    slip[np.isnan(signed)] = np.nan
    sinkage = np.column_stack([truth.channel(f"sinkage_{wheel}_m") for wheel in wheels])
    return Course(
        truth.time_s,
        speed,
        np.column_stack([along, across]),
        progress,
        np.cumsum(progress) * step_s,
        np.cumsum(power_w) * step_s,
        np.cumsum(lost_w) * step_s,
        np.cumsum(along_w) * step_s,
        wheel_speed,
        ground,
        slip,
        sinkage.max(axis=1),
        truth.channel("yaw_rad"),
    )


def _progress(time_s: Array, velocity: Array, commands: Stream | None) -> Array:
    """Return the speed (n,) along what is required, or was last: to slide back down a slope is no way made.

    Where no translation was wanted yet, as in a turn on the spot, or nobody says what is, it is the speed
    whichever way.
    """
    if commands is None:
        return np.asarray(np.linalg.norm(velocity, axis=1))
    desired = np.column_stack([commands.channel("speed_x_mps"), commands.channel("speed_y_mps")])
    size = np.linalg.norm(desired, axis=1)
    last = np.maximum.accumulate(np.where(size > 0.0, np.arange(size.size), -1))
    at = last[np.clip(np.searchsorted(commands.time_s, time_s, side="right") - 1, 0, size.size - 1)]
    way = desired[at] / np.maximum(size[at], 1e-9)[:, None]
    along = np.where(at < 0, np.linalg.norm(velocity, axis=1), np.einsum("ij,ij->i", velocity, way))
    return np.asarray(along)


def _smooth(values: Array, step_s: float) -> Array:
    keep = math.exp(-step_s / SMOOTH_S)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], values, axis=0))


def slip_peak(course: Course, within: Array | None = None) -> float:
    """Return the largest slip of the robot, the mean over its wheels, above :data:`PEAK_ABOVE_MPS`; or NaN.

    Parameters
    ----------
    course : of the drive
    within : (n,) where to look; everywhere by default
    """
    looked = course.speed_mps > PEAK_ABOVE_MPS
    looked &= np.isfinite(course.slip_ratio).any(axis=1)
    if within is not None:
        looked &= within
    return float(np.nanmean(course.slip_ratio[looked], axis=1).max()) if looked.any() else math.nan


def energy_to(course: Course, distance_m: float, start_s: float = 0.0) -> float:
    """Return the energy in J of the first metres after an instant; NaN where the robot did not get so far."""
    first = int(np.searchsorted(course.time_s, start_s))
    way = course.distance_m - course.distance_m[first]
    if way[-1] < distance_m:
        return math.nan
    return float(np.interp(distance_m, way[first:], course.energy_j[first:]) - course.energy_j[first])


def distance_after(course: Course, start_s: float, length_s: float) -> float:
    """Return how far in m the robot got from an instant on, in so long."""
    first, last = np.searchsorted(course.time_s, [start_s, start_s + length_s])
    return float(course.distance_m[min(last, len(course.distance_m) - 1)] - course.distance_m[first])


def lock_s(course: Course, start_s: float = 0.0, end_s: float = math.inf) -> float:
    """Return for how long in s, of a stretch, the wheel that was locked longest was."""
    within = (course.time_s >= start_s) & (course.time_s <= end_s)
    step_s = course.time_s[1] - course.time_s[0]
    moving = np.abs(course.ground_mps) > LOCKED_ABOVE_MPS
    locked = moving & (
        course.wheel_speed_mps * np.sign(course.ground_mps) < LOCKED_SHARE * np.abs(course.ground_mps)
    )
    return float(locked[within].sum(axis=0).max() * step_s)


def immobilised(course: Course, control: Stream) -> int:
    """Return how often the robot was stuck: to go, and not going, for :data:`STUCK_S`.

    It is to go by the pilot's ``desired_mps``, and not by what wheels are told: a controller that stops the
    robot is no excuse.  It goes where a wheel makes way in the direction that it turns: one that turns on the
    spot is not stuck, one that slides back down a slope is.
    """
    desired = np.interp(course.time_s, control.time_s, control.channel("desired_mps"))
    going_mps = (course.ground_mps * np.sign(course.wheel_speed_mps)).max(axis=1)
    stuck = (desired > WANTED_MPS) & (going_mps < STUCK_MPS)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], stuck, [False]]).astype(int)))
    step_s = course.time_s[1] - course.time_s[0]
    return int(((edges[1::2] - edges[::2]) * step_s >= STUCK_S).sum())


def final_speed(course: Course) -> float:
    """Return the mean speed in m/s at the end of a drive."""
    length_s = min(FINAL_S, course.time_s[-1] / 3)
    return float(course.progress_mps[course.time_s > course.time_s[-1] - length_s].mean())


def standing_from(course: Course, start_s: float) -> float:
    """Return when the robot first stood, or turned round, after an instant at which it drove; NaN if never.

    A robot that is braked hard may swing back: what counts is the first standstill.
    """
    first = int(np.searchsorted(course.time_s, start_s - 1e-9))
    way = course.velocity_mps[first] / max(course.speed_mps[first], 1e-9)
    stood = np.flatnonzero(course.velocity_mps[first:] @ way < STOOD_MPS)
    return float(course.time_s[first + stood[0]]) if stood.size else math.nan


def stop_distance(course: Course, start_s: float) -> float:
    """Return how far in m the robot went from an instant on until it stood; NaN where it did not."""
    end_s = standing_from(course, start_s)
    return distance_after(course, start_s, end_s - start_s) if math.isfinite(end_s) else math.nan


def adapt_times(control: Stream, changes: Sequence[tuple[float, float]], close: float = 0.02) -> list[float]:
    """Return how long after each change of ground the target came close to the new ground's own.

    Parameters
    ----------
    control : the pilot's status
    changes : instant of each change, and the target of the new ground
    close : how near counts

    Returns
    -------
    list of float
        in s; NaN where it did not before the next change
    """
    target, found = control.channel("target_ratio"), []
    for i, (change_s, desired) in enumerate(changes):
        end_s = changes[i + 1][0] if i + 1 < len(changes) else math.inf
        near = (control.time_s >= change_s) & (control.time_s < end_s) & (np.abs(target - desired) <= close)
        found.append(float(control.time_s[near.argmax()] - change_s) if near.any() else math.nan)
    return found


def roughness(commands: Stream) -> float:
    """Return the rms change of the wheels' commands in rad/s^2: smooth is small."""
    wheels = np.column_stack([commands.channel(f"wheel_{i}_radps") for i in (1, 2, 3)])
    return float(np.sqrt(np.mean((np.diff(wheels, axis=0) / np.diff(commands.time_s)[:, None]) ** 2)))
