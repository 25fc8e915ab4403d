"""The equations of the swerve filters, as :mod:`terrain.estimation.filters.swerve` writes and sources them.

Compiled for :class:`~terrain.estimation.filter.FilterModel`: each writes the predicted values and their
Jacobian.
"""

from __future__ import annotations

import math

from terrain.estimation.filter import OBSERVE, PROPAGATE
from terrain.kernels import njit
from terrain.kinematics.wheels import in_wheel_frame, point_velocity
from terrain.records import Array

LARGEST_SLIP_RATIO = 0.95
"""slip14's wheel row has a pole at 1: it is evaluated no nearer."""

# Places in `params`: radius, places of the wheels, of camera and antenna, which of the latter there are, how
# fast acceleration, gyro bias and accelerometer biases fade, in 1/s, and
# as inputs the growth of each wheel's speed, in 1/s.
_RADIUS, _WHEELS, _CAMERA_X, _CAMERA_Y, _ANTENNA_X, _ANTENNA_Y = 0, 1, 7, 8, 9, 10
_HAS_CAMERA, _HAS_GNSS, _FADING, _BIAS_FADING, _ACCEL_BIAS_FADING = range(11, 16)
_GROWTH = 16
WHEELS = slice(_WHEELS, _CAMERA_X)
"""Places of the wheels in the parameters of a model: x_1, y_1, x_2 ..."""

# Places in the state that all filters share, and those of vio15.
_X, _Y, _YAW, _VX, _VY, _W, _AX, _AY = range(8)
_STEER, _BIAS, _SLIP, _OFFSET, _ACCEL_BIAS = 8, 11, 12, 15, 16


@njit(PROPAGATE)
def propagate(x: Array, dt: float, params: Array, x_next: Array, f: Array) -> None:
    """(4.30)-(4.35): the motion, accelerations that fade; what comes behind these eight is a random walk."""
    cos, sin = math.cos(x[_YAW]), math.sin(x[_YAW])
    east, north = x[_VX] * cos - x[_VY] * sin, x[_VX] * sin + x[_VY] * cos
    for i in range(x.size):
        x_next[i] = x[i]
        f[i, i] = 1.0
    left = math.exp(-dt * params[_FADING])
    for i in (_AX, _AY):
        x_next[i] = left * x[i]
        f[i, i] = left
    x_next[_X] += dt * east
    f[_X, _YAW], f[_X, _VX], f[_X, _VY] = -dt * north, dt * cos, -dt * sin
    x_next[_Y] += dt * north
    f[_Y, _YAW], f[_Y, _VX], f[_Y, _VY] = dt * east, dt * sin, dt * cos
    x_next[_YAW] += dt * x[_W]
    f[_YAW, _W] = dt
    x_next[_VX] += dt * (x[_AX] + x[_W] * x[_VY])
    f[_VX, _AX], f[_VX, _W], f[_VX, _VY] = dt, dt * x[_VY], dt * x[_W]
    x_next[_VY] += dt * (x[_AY] - x[_W] * x[_VX])
    f[_VY, _AY], f[_VY, _W], f[_VY, _VX] = dt, -dt * x[_VX], -dt * x[_W]


@njit(PROPAGATE)
def propagate_slip_speed(x: Array, dt: float, params: Array, x_next: Array, f: Array) -> None:
    """vio15: slip speeds grow as their wheels' speeds, biases fade, the gyro's moves the IMU's yaw."""
    propagate(x, dt, params, x_next, f)
    for state, fading in (
        (_BIAS, params[_BIAS_FADING]),
        (_ACCEL_BIAS, params[_ACCEL_BIAS_FADING]),
        (_ACCEL_BIAS + 1, params[_ACCEL_BIAS_FADING]),
    ):
        left = math.exp(-dt * fading)
        x_next[state] = left * x[state]
        f[state, state] = left
    x_next[_OFFSET] += dt * x[_BIAS]
    f[_OFFSET, _BIAS] = dt
    for i in range(3):
        grown = math.exp(dt * params[_GROWTH + i])
        x_next[_SLIP + i] = grown * x[_SLIP + i]
        f[_SLIP + i, _SLIP + i] = grown


@njit
def _observe_wheel(
    x: Array, params: Array, wheel: int, steer: int, scale: float, z_hat: Array, h: Array
) -> None:
    """(4.20): the wheel's own speed along it, times a scale."""
    place_x, place_y = params[_WHEELS + 2 * wheel], params[_WHEELS + 2 * wheel + 1]
    cos, sin = math.cos(x[steer]), math.sin(x[steer])
    forward, left = point_velocity(x[_VX], x[_VY], x[_W], place_x, place_y)
    along, across = in_wheel_frame(forward, left, cos, sin)
    z_hat[wheel] = scale * along
    h[wheel, _VX], h[wheel, _VY] = scale * cos, scale * sin
    h[wheel, _W] = scale * (place_x * sin - place_y * cos)
    h[wheel, steer] = scale * across


@njit
def _observe_direct(z_hat: Array, h: Array, row: int, x: Array, state: int) -> None:
    z_hat[row] = x[state]
    h[row, state] = 1.0


@njit
def _observe_body(
    x: Array, params: Array, steer: int, bias: int, at_rest: bool, z_hat: Array, h: Array
) -> None:
    """All rows but those of the wheels; `bias` is negative without one, `at_rest` says that of vio15."""
    _observe_direct(z_hat, h, 3, x, _AX)
    _observe_direct(z_hat, h, 4, x, _AY)
    _observe_direct(z_hat, h, 5, x, _W)
    if bias >= 0:
        z_hat[5] += x[bias]
        h[5, bias] = 1.0
    _observe_direct(z_hat, h, 6, x, _YAW)
    for i in range(3):
        _observe_direct(z_hat, h, 7 + i, x, steer + i)
    row = 10
    if params[_HAS_CAMERA] > 0.0:
        camera_x, camera_y = params[_CAMERA_X], params[_CAMERA_Y]
        z_hat[row], z_hat[row + 1] = point_velocity(x[_VX], x[_VY], x[_W], camera_x, camera_y)
        h[row, _VX], h[row, _W] = 1.0, -camera_y
        h[row + 1, _VY], h[row + 1, _W] = 1.0, camera_x
        _observe_direct(z_hat, h, row + 2, x, _W)
        _observe_direct(z_hat, h, row + 3, x, _YAW)
        row += 4
    if at_rest:
        _observe_direct(z_hat, h, row, x, _VX)
        _observe_direct(z_hat, h, row + 1, x, _VY)
        _observe_direct(z_hat, h, row + 2, x, _W)
        row += 3
    if params[_HAS_GNSS] > 0.0:
        _observe_gnss(x, params[_ANTENNA_X], params[_ANTENNA_Y], row, z_hat, h)


@njit
def _observe_gnss(x: Array, antenna_x: float, antenna_y: float, row: int, z_hat: Array, h: Array) -> None:
    """Position and velocity of the antenna in the world."""
    cos, sin = math.cos(x[_YAW]), math.sin(x[_YAW])
    east, north = antenna_x * cos - antenna_y * sin, antenna_x * sin + antenna_y * cos
    z_hat[row], z_hat[row + 1] = x[_X] + east, x[_Y] + north
    h[row, _X], h[row, _YAW] = 1.0, -north
    h[row + 1, _Y], h[row + 1, _YAW] = 1.0, east
    forward, left = point_velocity(x[_VX], x[_VY], x[_W], antenna_x, antenna_y)
    speed_east, speed_north = forward * cos - left * sin, forward * sin + left * cos
    z_hat[row + 2], z_hat[row + 3] = speed_east, speed_north
    h[row + 2, _VX], h[row + 2, _VY], h[row + 2, _W], h[row + 2, _YAW] = cos, -sin, -north, -speed_north
    h[row + 3, _VX], h[row + 3, _VY], h[row + 3, _W], h[row + 3, _YAW] = sin, cos, east, speed_east


@njit(OBSERVE)
def observe_without_slip(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    """(4.48) and (6.6): 12 states."""
    for i in range(3):
        _observe_wheel(x, params, i, 8 + i, 1.0 / params[_RADIUS], z_hat, h)
    _observe_body(x, params, 8, 11, False, z_hat, h)


@njit(OBSERVE)
def observe_slip_ratio(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    """(4.28): 14 states."""
    for i in range(3):
        left = 1.0 - min(x[8 + i], LARGEST_SLIP_RATIO)
        _observe_wheel(x, params, i, 11 + i, 1.0 / (params[_RADIUS] * left), z_hat, h)
        h[i, 8 + i] = z_hat[i] / left
    _observe_body(x, params, 11, -1, False, z_hat, h)


@njit(OBSERVE)
def observe_slip_speed(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    """vio15: slip speeds, and the offset of the IMU's yaw."""
    for i in range(3):
        _observe_wheel(x, params, i, _STEER + i, 1.0 / params[_RADIUS], z_hat, h)
        z_hat[i] += x[_SLIP + i] / params[_RADIUS]
        h[i, _SLIP + i] = 1.0 / params[_RADIUS]
    _observe_body(x, params, _STEER, _BIAS, True, z_hat, h)
    z_hat[6] += x[_OFFSET]
    h[6, _OFFSET] = 1.0
    for i in range(2):
        z_hat[3 + i] += x[_ACCEL_BIAS + i]
        h[3 + i, _ACCEL_BIAS + i] = 1.0
