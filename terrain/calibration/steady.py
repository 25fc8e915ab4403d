"""Stretches of steady driving on hard ground: what camera, steering encoders and motors say of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.calibration.motion import at_times, origin_twist
from terrain.calibration.standing import Stretch
from terrain.kinematics.swerve import wheel_velocities
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot

STEADY_S = 0.5
"""Steady driving: the means over this time before and after an instant differ by no more than the two
below."""

MAX_SPEED_CHANGE_MPS = 0.02
MAX_STEER_CHANGE_RAD = 0.003

MAX_YAW_RATE_RADPS = 0.1
"""In bends, side forces turn the wheels' travel away from where they point."""

MIN_SPEED_MPS = 0.2
"""Of each wheel's centre: below, the camera's noise shows in the direction."""

MIN_LENGTH_S = 0.8


class Steady(NamedTuple):
    """Means over a steady stretch, or over consecutive ones with the wheels steered alike.

    Parameters
    ----------
    run_id : of its run
    travel : (3, 2) unit vectors along which the wheel centres travel, body axes
    speed_mps : (3,) of the wheel centres
    off_rad : (3,) raw steering angle minus the direction in which the wheel rolls
    motor_radps, current_a : (3,) positive where they move the wheel along its travel
    steering_rad, forward : (3,) unwrapped raw angle, and whether the motor turns forward
    n : samples
    """

    run_id: str
    travel: Array
    speed_mps: Array
    off_rad: Array
    motor_radps: Array
    current_a: Array
    steering_rad: Array
    forward: Array
    n: int


def steady_stretches(run: RunLog, robot: Robot, hard: Sequence[str]) -> list[Steady]:
    """Return the steady stretches of a run where it is labelled as hard ground; none without a camera.

    Parameters
    ----------
    run : with the streams wheels, steering and odometry
    robot : swerve robot with all sections
    hard : terrain labels of hard ground

    Notes
    -----
    A wheel rolls along its centre's travel when its motor turns forward, and against it otherwise: the full
    turn is known, and not only half of it.  Consecutive stretches with the wheels steered alike are one,
    because the steering backlash is unchanged.
    """
    found: list[Steady] = []
    for label in run.labels:
        if label.terrain not in hard:
            continue
        for steady in _within(Stretch(run, label.start_s, label.end_s), robot):
            last = found[-1] if found else None
            if last is not None and _alike(last, steady):
                found[-1] = _mean(last, steady)
            else:
                found.append(steady)
    return found


def why_none(runs: Sequence[RunLog], robot: Robot, hard: Sequence[str]) -> str:
    """Return why runs have neither steady stretches nor starts and stops."""
    if not any("odometry" in run.streams for run in runs):
        return "no run has a camera (stream 'odometry')"
    on_hard = [run for run in runs if any(label.terrain in hard for label in run.labels)]
    if not on_hard:
        return f"no run is labelled with hard ground ({', '.join(hard)})"
    slow_radps = MIN_SPEED_MPS / robot.wheel_radius_m * robot.equipment.motors.reduction_ratio
    channels = [f"motor_{i}_radps" for i in robot.wheels]
    wheels = [stream for run in on_hard if (stream := Stretch(run).of("wheels", channels))]
    if not wheels:
        return "no run on hard ground has the wheels' motor rates"
    if not any((np.abs(stream.values) > slow_radps).any() for stream in wheels):
        return f"the wheels never move at {MIN_SPEED_MPS:g} m/s on hard ground"
    return "no straight driving on hard ground with camera, IMU, wheels, currents and steering all there"


def _within(stretch: Stretch, robot: Robot) -> list[Steady]:
    wheels = stretch.of("wheels", [f"{kind}_{i}_{unit}" for kind, unit in _WHEELS for i in robot.wheels])
    steering = stretch.of("steering", [f"angle_{i}_rad" for i in robot.wheels])
    seen = origin_twist(stretch, robot)
    if wheels is None or steering is None or seen is None:
        return []
    time_s = wheels.time_s
    twist = at_times(seen, time_s)
    unwrapped = Stream(steering.time_s, np.unwrap(steering.values, axis=0), steering.channels)
    angle = at_times(unwrapped, time_s)
    motor, current = wheels.values[:, :3], wheels.values[:, 3:]
    wheel_speed = motor / robot.equipment.motors.reduction_ratio * robot.wheel_radius_m
    known = np.isfinite(twist).all(axis=1) & np.isfinite(angle).all(axis=1)
    centre = np.full((len(time_s), 3, 2), np.nan)
    centre[known] = wheel_velocities(robot.wheel_positions_m, twist[known])
    sign = np.sign(motor)
    direction = np.arctan2(sign * centre[..., 1], sign * centre[..., 0])
    n = max(round(STEADY_S * wheels.rate_hz), 2)
    steady = known & (np.abs(twist[:, 2]) <= MAX_YAW_RATE_RADPS)
    steady &= (np.linalg.norm(centre, axis=2) >= MIN_SPEED_MPS).all(axis=1)
    steady &= _change(np.nan_to_num(angle), n) <= MAX_STEER_CHANGE_RAD
    steady &= _change(wheel_speed, n) <= MAX_SPEED_CHANGE_MPS
    edges = np.flatnonzero(np.diff(np.concatenate([[0], steady.astype(int), [0]]))).reshape(-1, 2)
    found = []
    for first, end in edges:
        if time_s[end - 1] - time_s[first] < MIN_LENGTH_S:
            continue
        rows = slice(first, end)
        mean = centre[rows].mean(axis=0)
        forward = sign[rows].mean(axis=0) > 0
        along = np.where(forward, 1.0, -1.0)
        found.append(
            Steady(
                stretch.run.run_id,
                mean / np.linalg.norm(mean, axis=1)[:, None],
                np.linalg.norm(mean, axis=1),
                np.angle(np.exp(1j * (angle - direction)[rows]).mean(axis=0)),
                along * motor[rows].mean(axis=0),
                along * current[rows].mean(axis=0),
                angle[rows].mean(axis=0),
                forward,
                int(end - first),
            )
        )
    return found


_WHEELS = (("motor", "radps"), ("current", "a"))


def _change(values: Array, n: int) -> Array:
    """Return by how much (k,) the means of ``n`` samples before and after differ; infinite near the ends."""
    total = np.concatenate([np.zeros((1, values.shape[1])), values.cumsum(axis=0)])
    change = np.full(len(values), np.inf)
    if len(values) > 2 * n:
        means = (total[n:] - total[:-n]) / n
        change[n : len(values) - n + 1] = np.abs(means[n:] - means[:-n]).max(axis=1)
    return change


def direction_of(steady: Steady) -> str:
    """Return in which direction of the body a stretch was driven, in a word."""
    x, y = steady.travel.mean(axis=0)
    if abs(x) > 2 * abs(y):
        return "forward" if x > 0 else "backward"
    if abs(y) > 2 * abs(x):
        return "left" if y > 0 else "right"
    return "diagonally"


def _alike(one: Steady, other: Steady) -> bool:
    turned = np.abs(one.steering_rad - other.steering_rad).max()
    return bool(turned <= MAX_STEER_CHANGE_RAD and (one.forward == other.forward).all())


def _mean(one: Steady, other: Steady) -> Steady:
    n = one.n + other.n
    mixed = {
        name: (one.n * getattr(one, name) + other.n * getattr(other, name)) / n
        for name in ("travel", "speed_mps", "motor_radps", "current_a", "steering_rad")
    }
    off = np.angle(one.n * np.exp(1j * one.off_rad) + other.n * np.exp(1j * other.off_rad))
    travel = mixed["travel"] / np.linalg.norm(mixed["travel"], axis=1)[:, None]
    return one._replace(**mixed | {"travel": travel, "off_rad": off, "n": n})
