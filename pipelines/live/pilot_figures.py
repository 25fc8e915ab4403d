"""Small decisions of the pilot's step, each a pure function."""

from __future__ import annotations

import math

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.estimation.live.clocks import numbers
from terrain.estimation.live.estimate import LiveEstimate
from terrain.estimation.live.health import SENSORS, SOUND, Health
from terrain.records import Array
from terrain.slip import MIN_SPEED_MPS

_SOUND = int(SOUND)  # a plain number compares in a tenth of the time
_LOST = int(Health.LOST)
_GYRO, _SEEN, _SEEN_YAW = (SENSORS.index(name) for name in ("gyro", "camera_speed", "camera_yaw"))


def pose_is_sound(health: list[int]) -> bool:
    """Say whether a pose can be built on: with a lost camera it is until it is stale."""
    turns, seen_yaw, seen = health[_GYRO], health[_SEEN_YAW], health[_SEEN]
    heading = turns <= _SOUND or seen_yaw <= _SOUND
    return heading and (seen <= _SOUND or seen == _LOST)


def finite_twist(given: object) -> Array:
    """Return a desired twist (3,); zeros where it is none."""
    twist = numbers(given)
    if twist is None or twist.shape != (3,) or not math.isfinite(sum(twist.tolist())):
        return np.zeros(3)
    return twist


def largest(values: list[float]) -> float:
    """Return the largest of some values; NaN where one is."""
    return math.nan if math.isnan(sum(values)) else max(values)


def largest_slip(slip_ratio: Array, wheel_radps: Array) -> float:
    """Return the largest slip of a wheel, positive in traction; NaN where it is not known."""
    return float(np.where(wheel_radps < 0.0, -slip_ratio, slip_ratio).max())


def uphill_mps2(estimate: LiveEstimate | None, roll_rad: float, pitch_rad: float) -> float:
    """Return the deceleration by gravity along the motion: positive uphill, 0 at rest."""
    speed_mps = 0.0 if estimate is None else math.hypot(estimate.speed_x_mps, estimate.speed_y_mps)
    if estimate is None or not speed_mps > MIN_SPEED_MPS:
        return 0.0
    along, across = estimate.speed_x_mps / speed_mps, estimate.speed_y_mps / speed_mps
    return GRAVITY_MPS2 * (-math.sin(pitch_rad) * along + math.sin(roll_rad) * across)
