r"""Axes of an IMU and signs of motor currents from what the robot did, of logs that do not document them.

A robot that speeds up has a specific force forward, one that turns left at speed a specific force to the
left, one on the ground a specific force upwards, and its gyro agrees with the sides of its wheels::

    a_x ~ dv/dt,    a_y ~ v w,    a_z ~ g,    w_z ~ (v_right - v_left) / track

An axis whose correlation is clearly negative is read turned.  A mounting is a rotation, so that of the
signs :math:`(s_x, s_y, s_z)` the product is 1: where one is uncertain, it follows from the other two, and
the gyro's x and y go with the accelerometer's.  The yaw rate has a sign of its own, because some logs turn
it alone.

A current of this package is positive where its torque drives the robot forward.  Motor drivers log that, or a
magnitude, or a current that is positive where it drives the wheel in either direction and negative where the
wheel is braked: the sign of the power.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d

from terrain.records import Array

#: Width of the low-pass under which signals are compared: lags of 0.1 s and vibration hardly matter.
SIGMA_S = 0.2
#: Under it no sign is read from a signal.  Measured, of eleven sessions and recordings: 0.4 to 0.9 along x and y (0.3
#: of a Marmotte along x, on snow), 0.95 to 1.00 of the gyro.
MIN_CORRELATION = 0.2

#: The gyro has no slip in it, and agrees with wheels of its own robot by far more.
MIN_GYRO_CORRELATION = 0.5
MIN_SAMPLES = 200  #: Ten seconds at 20 Hz: fewer show no sign.
MIN_SIGN_GRAVITY_MPS2 = 5.0  #: Half of gravity: less along z is no upright IMU, nor one upside down.
#: Yaw rate for each m/s of difference of the sides, in rad/m: the inverse of the track, which is wider than 0.1 m.
#: 57 times as much is a gyro in degrees.
MAX_TURN_PER_M = 10.0

TURNED = "imu axes turned"
GYRO_TURNED = "yaw rates with their sign turned"
GYRO_IN_DEGREES = "yaw rates in deg/s"


class ImuAxes(NamedTuple):
    """Factors that bring an IMU into the robot's axes."""

    accel: tuple[float, float, float]  #: signs of the accelerometer's axes, x, y and z
    gyro_z: float  #: sign of the yaw rate, times the radian of a degree where it is in deg/s

    def gyro(self) -> tuple[float, float, float]:
        """Return the factors of the gyro's axes."""
        scale = abs(self.gyro_z)
        return self.accel[0] * scale, self.accel[1] * scale, self.gyro_z

    def repairs(self) -> dict[str, int]:
        """Return what is changed, as counts by kind: the axes of the accelerometer, and the yaw rate."""
        counts = {
            TURNED: sum(sign < 0 for sign in self.accel),
            GYRO_TURNED: int(self.gyro_z < 0),
            GYRO_IN_DEGREES: int(abs(self.gyro_z) < 1.0),
        }
        return {kind: n for kind, n in counts.items() if n}


AS_LOGGED = ImuAxes((1.0, 1.0, 1.0), 1.0)


def find_axes(
    stretches: Sequence[tuple[Array, Array, Array, Array]], period_s: float, *, default: ImuAxes = AS_LOGGED
) -> ImuAxes:
    """Return the axes of an IMU that is mounted alike in some stretches of driving.

    Parameters
    ----------
    stretches : of each the wheel circumferential speed (n,) in m/s, left and right, the yaw rate (n,) and the
        accelerometer (n, 3) in m/s^2
    period_s : from sample to sample
    default : signs where the data show none

    Examples
    --------
    A robot that speeds up and slows down, and an IMU that lies upside down:

    >>> t = np.arange(0.0, 60.0, 0.05)
    >>> speed, turn = np.sin(t), 0.2 * np.sin(0.7 * t)
    >>> accel = np.column_stack([np.cos(t), speed * turn, np.full_like(t, 9.81)])
    >>> find_axes([(speed - turn / 2, speed + turn / 2, -turn, accel * [1.0, -1.0, -1.0])], 0.05)
    ImuAxes(accel=(1.0, -1.0, -1.0), gyro_z=-1.0)
    """
    sigma = SIGMA_S / period_s
    parts = []
    for left_mps, right_mps, gyro_radps, accel_mps2 in stretches:
        columns = np.column_stack([left_mps, right_mps, gyro_radps, accel_mps2])
        if len(columns) < 3 or not np.isfinite(columns).all():
            continue
        left, right, gyro, x, y, z = gaussian_filter1d(columns, sigma, axis=0, mode="nearest").T
        speed = (left + right) / 2
        gained = np.gradient(speed, period_s)
        parts.append(np.column_stack([right - left, gyro, gained, x, speed * (right - left), y, z]))
    if not parts:
        return default
    turn, gyro, gained, x, across, y, z = np.concatenate(parts).T
    if len(turn) < MIN_SAMPLES:
        return default
    of_gyro, gyro_z = _correlation(turn, gyro), default.gyro_z
    if abs(of_gyro) >= MIN_GYRO_CORRELATION:
        per_m = float(np.abs(turn @ gyro) / (turn @ turn))
        gyro_z = float(np.copysign(np.deg2rad(1.0) if per_m > MAX_TURN_PER_M else 1.0, of_gyro))
    along, sideways, level = _correlation(gained, x), _correlation(across, y), float(np.median(z))
    one = float(np.sign(along)) if abs(along) >= MIN_CORRELATION else 0.0
    other = float(np.sign(sideways)) if abs(sideways) >= MIN_CORRELATION else 0.0
    up = float(np.sign(level)) if abs(level) >= MIN_SIGN_GRAVITY_MPS2 else 0.0
    if one * other * up < 0:  # no rotation: what is less certain follows
        one, other = (one, 0.0) if abs(along) > abs(sideways) else (0.0, other)
    if (one, other, up).count(0.0) > 1:
        return ImuAxes(default.accel, gyro_z)
    return ImuAxes((one or other * up, other or one * up, up or one * other), gyro_z)


def _correlation(one: Array, other: Array) -> float:
    if np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])


MIN_MOVING_RADPS = 0.05  #: Slower wheels stand.
MIN_CURRENT_A = 1.0  #: Smaller currents show no sign.
#: A wheel that stands turns, if at all, as it does within so long of that: it starts, or has just stopped.
SENSE_S = 0.5

NO_SIGN = "currents without a sign"
POWER_SIGN = "currents turned from the sign of the power"


def current_sign(current_a: Array, speed_radps: Array) -> str:
    """Return how currents (n, sides) are signed, where not by direction: as a magnitude, or as the power; else empty.

    Examples
    --------
    >>> speed = np.array([[1.0], [1.0], [-1.0], [-1.0]])
    >>> current_sign(np.array([[5.0], [4.0], [5.0], [6.0]]), speed)
    'currents without a sign'
    >>> current_sign(np.array([[5.0], [-4.0], [5.0], [6.0]]), speed)
    'currents turned from the sign of the power'
    >>> current_sign(np.array([[5.0], [4.0], [-5.0], [-6.0]]), speed)
    ''
    """
    backward = (speed_radps <= -MIN_MOVING_RADPS) & (np.abs(current_a) >= MIN_CURRENT_A)
    if not (current_a <= -MIN_CURRENT_A).any():
        return NO_SIGN
    return POWER_SIGN if backward.any() and np.mean(current_a[backward] > 0) > 0.5 else ""


def with_sign_of_torque(current_a: Array, speed_radps: Array, period_s: float) -> Array:
    """Return a held current (n,) that has the sign of the power, with that of the torque instead.

    NaN where the current is of a wheel that stands for longer: what it pushes against is not to be seen.

    Examples
    --------
    >>> with_sign_of_torque(np.array([5.0, 5.0, -2.0, 6.0]), np.array([1.0, 1.0, 1.0, -1.0]), 0.05).tolist()
    [5.0, 5.0, -2.0, -6.0]
    """
    sense = np.where(np.abs(speed_radps) >= MIN_MOVING_RADPS, np.sign(speed_radps), 0.0)
    width = 2 * round(SENSE_S / period_s) + 1
    most, least = maximum_filter1d(speed_radps, width), minimum_filter1d(speed_radps, width)
    fastest = np.where(most > -least, most, least)
    nearby = np.where(np.abs(fastest) >= MIN_MOVING_RADPS, np.sign(fastest), np.nan)
    sense = np.where(sense == 0.0, nearby, sense)
    sense = np.where(np.isnan(sense) & (np.abs(current_a) < MIN_CURRENT_A), 1.0, sense)
    new = np.maximum.accumulate(
        np.where(np.diff(current_a, prepend=np.nan) != 0.0, np.arange(current_a.size), 0)
    )
    return np.asarray(current_a * sense[new])
