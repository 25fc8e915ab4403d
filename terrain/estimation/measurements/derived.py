"""Rows of a tick that follow from others: vibration, acceleration of the wheels, and rest.

- ``vibration_mps2``: root mean square of the vertical acceleration over the last 0.3 s;
- ``wheel_<i>_growth_per_s`` and ``wheel_<i>_change_m2ps3``: ``w w' / (w^2 + w_0^2)`` and ``|w w'|`` of a
  wheel's circumferential speed w behind two low-passes of 0.15 s, with w_0 = 0.1 m/s: what keeps the ratio of
  a slip speed to w, and what w^2 changes by; without a camera the latter decays within 0.5 s, peaks held;
- ``camera_age_s``: since the camera last measured a speed;
- ``rest_*``: zero, where the robot is at rest: for half a second the wheels have stood, gyro and
  accelerometer have measured nothing, and a camera, if it measures, no speed.  Locked wheels that slide
  decelerate the robot: on ice (0.05 of its weight) by more than what counts as nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from terrain.records import Array

VIBRATION_S, CHANGE_S = 0.3, 0.15
"""Memory of the vibration; low-passes of the wheels' speeds.  Behind one of them, the change of a speed would
correlate with the noise of the speed itself, and slip speeds that grow by it would drift."""

MOVING_MPS = 0.05
"""A wheel that turns faster moves, and shakes what is mounted on the robot."""

RIPPLE_MPS = 0.03
"""A wheel's speed is that far from its low-passed one by the ripple of the Hall steps, a saw-tooth: what grew
by it would drift."""

WAVERING_MPS = 0.02
"""By so much the two low-passed speeds of a wheel differ in steady motion."""

CRAWL_MPS = 0.1
"""w_0: well below it a slip speed no longer follows the speed of its wheel."""

REST_AFTER_S = 0.5
"""Time for which nothing has to move."""

REST_WHEEL_MPS, REST_TURN_RADPS, REST_ACCEL_MPS2, REST_SEEN_MPS = 0.01, 0.03, 0.4, 0.05
"""What counts as nothing, of a wheel's low-passed speed, the gyro, the accelerometer and the camera: biases
and noise at rest stay below, as does a wheel that is held to and fro on soft ground."""

UNSEEN_AFTER_S = 0.15
"""Age of the camera's speed from which on there is none."""

HELD_S = 0.5
"""Without a camera a change of a wheel's speed counts for so long: the body, and slip, follow it late."""

N_DERIVED = 14
"""Length of the memory: mean square of the vibration, instant of its last sample; of each wheel the speed
behind one and two low-passes; the tick before; since when all is at rest;
when the camera measured last; of each wheel the change that is held."""

_SQUARE, _INSTANT, _ONCE, _TWICE, _TICK, _SINCE, _SEEN, _HELD = 0, 1, 2, 5, 8, 9, 10, 11


def derived_memory() -> Array:
    """Return the memory (14,) before the first sample."""
    return np.full(N_DERIVED, np.nan)


@njit(cache=True, error_model="numpy")
def take_vibration(accel_z_mps2: float, instant_s: float, memory: Array) -> None:
    """Take the vertical acceleration of an IMU sample, without gravity, into the mean square."""
    if math.isnan(accel_z_mps2):
        return
    step_s = instant_s - memory[_INSTANT]
    memory[_INSTANT] = instant_s
    square = accel_z_mps2 * accel_z_mps2
    if not step_s > 0.0 or math.isnan(memory[_SQUARE]):
        memory[_SQUARE] = square
        return
    memory[_SQUARE] += (square - memory[_SQUARE]) * -math.expm1(-step_s / VIBRATION_S)


@njit(cache=True, error_model="numpy")
def is_moving(memory: Array) -> bool:
    """Say whether a wheel turns faster than a crawl, by the low-passed speeds."""
    moving = False
    for i in range(3):
        moving |= abs(memory[_ONCE + i]) > MOVING_MPS
    return bool(moving)


@njit(cache=True, error_model="numpy")
def derive_rows(
    time_s: float, z: Array, radius_m: float, memory: Array, first: int, gyro: int, accel: int, camera: int
) -> None:
    """Write the derived rows of a tick from place ``first`` on; the others say where the rows stand."""
    step_s = time_s - memory[_TICK]
    memory[_TICK] = time_s
    z[first] = math.sqrt(memory[_SQUARE])
    still = True
    keep = math.exp(-step_s / CHANGE_S) if step_s > 0.0 else 0.0
    if not math.isnan(z[camera]):
        memory[_SEEN] = time_s
    unseen = not time_s - memory[_SEEN] <= UNSEEN_AFTER_S
    for i in range(3):
        speed, once, twice = z[i] * radius_m, memory[_ONCE + i], memory[_TWICE + i]
        still &= abs(twice) <= REST_WHEEL_MPS and abs(speed) <= MOVING_MPS
        rise = once - twice
        change = twice * math.copysign(max(abs(rise) - WAVERING_MPS, 0.0), rise) / CHANGE_S
        z[first + 1 + i] = change / (twice * twice + CRAWL_MPS * CRAWL_MPS)
        ahead = max(abs(speed - once) - RIPPLE_MPS, 0.0)
        change = (abs(speed) + CRAWL_MPS) * ahead / CHANGE_S
        held = memory[_HELD + i] * math.exp(-step_s / HELD_S) if step_s > 0.0 else np.nan
        memory[_HELD + i] = change if math.isnan(held) or change > held else held
        z[first + 4 + i] = memory[_HELD + i] if unseen else change
        if math.isnan(once) or not step_s > 0.0:
            memory[_ONCE + i] = memory[_TWICE + i] = speed
        elif not math.isnan(speed):
            memory[_TWICE + i] = once + (twice - once) * keep
            memory[_ONCE + i] = speed + (once - speed) * keep
    still &= abs(z[gyro]) <= REST_TURN_RADPS
    for i in range(2):
        still &= abs(z[accel + i]) <= REST_ACCEL_MPS2
        still &= not abs(z[camera + i]) > REST_SEEN_MPS
    if not still:
        memory[_SINCE] = np.nan
    elif math.isnan(memory[_SINCE]):
        memory[_SINCE] = time_s
    z[first + 7] = time_s - memory[_SEEN]
    rests = time_s - memory[_SINCE] >= REST_AFTER_S
    for i in range(3):
        z[first + 8 + i] = 0.0 if rests else np.nan
