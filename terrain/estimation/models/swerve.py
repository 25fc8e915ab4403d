"""The filters of a swerve robot: three wheels, driven and steered each, an IMU, and a camera or GNSS.

========= ====== ==== ================================================================================
filter    states rows what it can know
========= ====== ==== ================================================================================
encoder12 12     10   the speed of the wheels, which it takes for the speed over ground: slip reads 0
slip14    14     10   that, and a slip ratio of each wheel, which nothing determines as long as it drives
                      straight: an example of what cannot be observed
vio12     12     14   the speed that the camera sees, drawn to that of the wheels: slip reads low
vio15     18     17   the speed that the camera sees, and how fast each wheel slips: **the one to use**;
                      15 states of the thesis' kind, and what else its sensors have: the offset of the IMU's
                      yaw and the biases of the accelerometer; and three rows that hold at rest
========= ====== ==== ================================================================================

They are one model of which slip and sensors are settings.  Each can have four rows of GNSS more, another
source of absolute speed and position.

Process, with T the step, psi the yaw and w its rate, v and a in the body frame.  All else is a random walk::

    p_x <- p_x + T (v_x cos psi - v_y sin psi)        v_x <- v_x + T (a_x + w v_y)
    p_y <- p_y + T (v_x sin psi + v_y cos psi)        v_y <- v_y + T (a_y - w v_x)        psi <- psi + T w

vio15 has more than that, with the slip speed l_i, the growth g_i of the wheel's speed (an input), the gyro's
bias b, the offset o of the IMU's yaw and the accelerometer's biases c::

    a <- a exp(-3 T)        l_i <- l_i exp(g_i T)        o <- o + T b
    b <- b exp(-T / 5000 s)        c <- c exp(-T / 1250 s)

An acceleration kept for ever, as in the thesis, would let a truth that is drawn from the model reach hundreds
of metres a second.  Slip speeds grow and shrink with the speed of their wheels, which keeps the slip ratio of
a wheel when the camera is lost.  Biases fade to a prior.  How far slip speeds and the yaw rate walk, and an
acceleration is believed, follows vibration and changes of the wheels' speeds: :class:`Schedule`.  Camera, IMU
and rest are held: what disagrees for less than two seconds is not believed, as these sensors fail rather than
show the ground's doing.

Measurements, of wheel i at (x_i, y_i) steered by d_i, the camera at (r_x, r_y) and the antenna at l::

    v_i = (v_x - w y_i) cos d_i + (v_y + w x_i) sin d_i     wheel_i = v_i / r               encoder12, vio12
                                                            wheel_i = v_i / ((1 - s_i) r)   slip14
                                                            wheel_i = (v_i + l_i) / r       vio15
    accel = a (+ c)      gyro = w + b      camera_yaw = psi      imu_yaw = psi (+ o)      steer_i = d_i
    rest = (v_x, v_y, w), zero where the robot stands                                       vio15
    camera_speed = (v_x - w r_y, v_y + w r_x)        camera_yaw_rate = w
    gnss_position = p + R(psi) l        gnss_speed = R(psi) (v + w x l)        in the world frame

Source: Danzi, AgriMaRo thesis, 4.3-4.5 and 6.1.  Corrected:

- (2.3) against 7.2: one geometry, that of 7.2, from the robot's description;
- (4.28), (4.48) rows 4 and 5: -w v_y and w v_x leave the acceleration, a state, without a measurement, and
  the filter diverges on a straight run; they are a_x and a_y, as in (6.6);
- (4.36), (4.44): the yaw rate stands after the accelerations; here states go by name, in the order of (6.1);
- (4.42), (4.46): place and angle of wheel 1 stand for every wheel; each has its own;
- 4.5.1 names the nonlinearity of the 14 states: it is observability, no row measures the speed over ground;
- (6.2): the signs of the Coriolis terms are flipped; those of (4.33), (4.34) are right;
- (6.5): v - w x r; it is v + w x r, as in (6.6);
- (4.38), (4.40), (6.8), (6.9)-(6.14): see :func:`thesis_noise`;
- 6.1: beside a camera, wheel rows without slip draw the speed to that of the wheels, wholly once the camera
  is lost.  A slip speed l_i = wheel_i r - v_i of each wheel, a random walk, frees them and stays linear
  (vio15).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.feed import CAMERA_ROWS, DERIVED_ROWS, GNSS_ROWS, UNSEEN_AFTER_S, MeasurementTable
from terrain.estimation.filter import FilterModel, Noise
from terrain.kernels import inner, njit
from terrain.kinematics.wheels import in_wheel_frame, point_velocity
from terrain.records import Array
from terrain.robots import Robot, SwerveRobot, as_drive

LARGEST_SLIP_RATIO = 0.95  #: slip14's wheel row has a pole at 1: it is evaluated no nearer.
UNKNOWN_MPS2 = 1.4  #: Vibration where it is not known: that of rough ground.
NO_SLIP, SLIP_RATIO, SLIP_SPEED = 0.0, 1.0, 2.0  #: What a model has as slip of a wheel.

_WHEELS = ("1", "2", "3")
_FADING_PER_S = 3.0  # of the acceleration of vio15: a third of a second, shorter than a start and a stop
_BIAS_FADING_PER_S = (2e-4, 8e-4)  # of gyro and accelerometer: with their walks, as uncertain as at first
_POSITION = ("position_x_m", "position_y_m")
_MOTION = (
    *(*_POSITION, "yaw_rad", "speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
    *("accel_x_mps2", "accel_y_mps2"),
)
_STEER_STATES = tuple(f"steer_{i}_rad" for i in _WHEELS)
_WITHOUT_SLIP = (*_MOTION, *_STEER_STATES, "gyro_bias_radps")
_WITH_SLIP_SPEED = (
    *_WITHOUT_SLIP,
    *(f"slip_speed_{i}_mps" for i in _WHEELS),
    *("imu_yaw_offset_rad", "accel_bias_x_mps2", "accel_bias_y_mps2"),
)


class _Layout(NamedTuple):
    states: tuple[str, ...]
    slip: float
    has_camera: bool


_LAYOUTS = {
    "encoder12": _Layout(_WITHOUT_SLIP, NO_SLIP, False),
    "slip14": _Layout((*_MOTION, *(f"slip_{i}_ratio" for i in _WHEELS), *_STEER_STATES), SLIP_RATIO, False),
    "vio12": _Layout(_WITHOUT_SLIP, NO_SLIP, True),
    "vio15": _Layout(_WITH_SLIP_SPEED, SLIP_SPEED, True),
}

FILTERS = tuple(_LAYOUTS)  #: Names of the filters.

_REST_ROWS = DERIVED_ROWS[-3:]
_ROWS = (
    *(f"wheel_{i}_radps" for i in _WHEELS),
    *("accel_x_mps2", "accel_y_mps2", "gyro_z_radps", "imu_yaw_rad"),
    *_STEER_STATES,
)
# In the order in which they are judged, each after those that it rests on: turning, speed, and last the
# wheels, which may slip.
_SENSORS = {
    "camera_yaw_rate": CAMERA_ROWS[2:3],
    "camera_yaw": CAMERA_ROWS[3:],
    "gyro": ("gyro_z_radps",),
    "imu_yaw": ("imu_yaw_rad",),
    "camera_speed": CAMERA_ROWS[:2],
    "gnss_position": GNSS_ROWS[:2],
    "gnss_speed": GNSS_ROWS[2:],
    "accel": ("accel_x_mps2", "accel_y_mps2"),
    **{f"steer_{i}": (f"steer_{i}_rad",) for i in _WHEELS},
    **{f"wheel_{i}": (f"wheel_{i}_radps",) for i in _WHEELS},
    "rest": _REST_ROWS,
}
_REFERENCES = ("camera_speed", "gnss_speed")
_HELD = ("camera_yaw_rate", "camera_yaw", "gyro", "camera_speed", "accel", "rest")
_ANGLES = ("yaw_rad", *_STEER_STATES, "imu_yaw_rad", "camera_yaw_rad")

# Standard deviations by name without axis and wheel: what is known of a state of a robot that was just switched on,
# and how far it walks within a second;
_STATE_STD = {
    "position_m": (4e-3, 3e-4),  # without GNSS the origin is where that was, but for what low-passes displace
    "yaw_rad": (1.0, 3e-4),
    "speed_mps": (0.5, 0.01),
    "yaw_rate_radps": (0.5, 0.02),
    "accel_mps2": (1.0, 2.0),
    "steer_rad": (0.3, 0.1),
    "gyro_bias_radps": (0.01, 2e-4),
    "slip_ratio": (0.3, 0.05),
    "slip_speed_mps": (0.2, 0.03),
    "imu_yaw_offset_rad": (0.01, 3.5e-4),
    "accel_bias_mps2": (0.05, 2e-3),
}
_SITE_STD_M = 100.0
# and what a sample scatters by on a robot that moves, with vibration and delays.  Chosen on simulated runs so that the
# errors of vio15 are on average those that it states; likelihood is no guide where a low-pass colours the noise of
# every sensor.
_SAMPLE_STD = {
    "accel_mps2": 0.03,
    "gyro_z_radps": 0.0012,
    "imu_yaw_rad": 0.05,
    "steer_rad": 0.0005,
    "camera_speed_mps": 0.0006,
    "camera_yaw_rate_radps": 0.0012,
    "camera_yaw_rad": 0.005,
    "gnss_position_m": 0.02,
    "gnss_speed_mps": 0.03,
    "rest_speed_mps": 0.005,
    "rest_yaw_rate_radps": 0.002,
}
_WHEEL_SPEED_STD_MPS = 0.007  # circumferential speed of a wheel, mostly the ripple of the Hall steps
_SLIP_STD_MPS = 0.15  # wheel speed minus ground speed, where both are measured and slip is no state
# Behind the low-pass of the encoders' rates, 0.1 s, a sample scatters by a third of what it did; it counts as
# half, as then the scatter of one tick is much like that of the tick before.
_LOW_PASSED = 0.5

# Places in `params`: radius, places of the wheels, of camera and antenna, which of the latter there are, how fast
# acceleration, gyro bias and accelerometer biases fade, in 1/s, what slip is, and as inputs the growth of each wheel's
# speed, in 1/s.
_RADIUS, _PLACES, _CAMERA_X, _CAMERA_Y, _ANTENNA_X, _ANTENNA_Y = 0, 1, 7, 8, 9, 10
_HAS_CAMERA, _HAS_GNSS, _FADING, _BIAS_FADING, _ACCEL_BIAS_FADING, _SLIP_KIND, _GROWTH = range(11, 18)

# Places in the state that all filters share but for slip14, whose slip ratios stand before the steering, and those of
# vio15.
_X, _Y, _YAW, _VX, _VY, _W, _AX, _AY = range(8)
_STEER, _BIAS, _SLIP, _OFFSET, _ACCEL_BIAS = 8, 11, 12, 15, 16


@njit
def propagate(x: Array, dt: float, params: Array, x_next: Array, f: Array) -> None:
    """(4.30)-(4.35): the motion, accelerations that fade; and what vio15 has beside random walks."""
    cos, sin = math.cos(x[_YAW]), math.sin(x[_YAW])
    east, north = x[_VX] * cos - x[_VY] * sin, x[_VX] * sin + x[_VY] * cos
    for i in range(x.size):
        x_next[i] = x[i]
        f[i, i] = 1.0
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
    for state, rate in ((_AX, -params[_FADING]), (_AY, -params[_FADING])):
        _scale(state, math.exp(dt * rate), x, x_next, f)
    if params[_SLIP_KIND] == SLIP_SPEED:
        _scale(_BIAS, math.exp(-dt * params[_BIAS_FADING]), x, x_next, f)
        for i in range(2):
            _scale(_ACCEL_BIAS + i, math.exp(-dt * params[_ACCEL_BIAS_FADING]), x, x_next, f)
        for i in range(3):
            _scale(_SLIP + i, math.exp(dt * params[_GROWTH + i]), x, x_next, f)
        x_next[_OFFSET] += dt * x[_BIAS]
        f[_OFFSET, _BIAS] = dt


@inner
def _scale(state: int, ratio: float, x: Array, x_next: Array, f: Array) -> None:
    x_next[state] = ratio * x[state]
    f[state, state] = ratio


@njit
def observe(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    """(4.20), (4.28), (4.48) and (6.6): what all sensors measure."""
    slip, radius = params[_SLIP_KIND], params[_RADIUS]
    steer = _STEER + 3 if slip == SLIP_RATIO else _STEER
    for i in range(3):
        rolls = 1.0 - min(x[_STEER + i], LARGEST_SLIP_RATIO) if slip == SLIP_RATIO else 1.0
        scale = 1.0 / (radius * rolls)
        place_x, place_y = params[_PLACES + 2 * i], params[_PLACES + 2 * i + 1]
        cos, sin = math.cos(x[steer + i]), math.sin(x[steer + i])
        forward, left = point_velocity(x[_VX], x[_VY], x[_W], place_x, place_y)
        along, across = in_wheel_frame(forward, left, cos, sin)
        z_hat[i] = scale * along
        h[i, _VX], h[i, _VY] = scale * cos, scale * sin
        h[i, _W] = scale * (place_x * sin - place_y * cos)
        h[i, steer + i] = scale * across
        if slip == SLIP_RATIO:
            h[i, _STEER + i] = z_hat[i] / rolls
        elif slip == SLIP_SPEED:
            z_hat[i] += x[_SLIP + i] / radius
            h[i, _SLIP + i] = 1.0 / radius
    for row, state in ((3, _AX), (4, _AY), (5, _W), (6, _YAW), (7, steer), (8, steer + 1), (9, steer + 2)):
        z_hat[row] = 0.0
        _add(row, state, x, z_hat, h)
    if slip != SLIP_RATIO:
        _add(5, _BIAS, x, z_hat, h)
    if slip == SLIP_SPEED:
        for row, state in ((3, _ACCEL_BIAS), (4, _ACCEL_BIAS + 1), (6, _OFFSET)):
            _add(row, state, x, z_hat, h)
    row = 10
    if params[_HAS_CAMERA] > 0.0:
        camera_x, camera_y = params[_CAMERA_X], params[_CAMERA_Y]
        z_hat[row], z_hat[row + 1] = point_velocity(x[_VX], x[_VY], x[_W], camera_x, camera_y)
        h[row, _VX], h[row, _W] = 1.0, -camera_y
        h[row + 1, _VY], h[row + 1, _W] = 1.0, camera_x
        z_hat[row + 2], z_hat[row + 3] = x[_W], x[_YAW]
        h[row + 2, _W], h[row + 3, _YAW] = 1.0, 1.0
        row += 4
    if slip == SLIP_SPEED:  # at rest
        for i in range(3):
            z_hat[row + i] = x[_VX + i]
            h[row + i, _VX + i] = 1.0
        row += 3
    if params[_HAS_GNSS] > 0.0:
        _observe_gnss(x, params[_ANTENNA_X], params[_ANTENNA_Y], row, z_hat, h)


@inner
def _add(row: int, state: int, x: Array, z_hat: Array, h: Array) -> None:
    z_hat[row] += x[state]
    h[row, state] = 1.0


@inner
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


def make_filter(
    name: str, robot: Robot, with_gnss: bool = False, antenna_m: tuple[float, float] = (0.0, 0.0)
) -> FilterModel:
    """Return one of the filters for a robot.

    Parameters
    ----------
    name : one of :data:`FILTERS`
    robot : a swerve robot, with a camera for vio12 and vio15
    with_gnss : whether it has the four rows of GNSS; yaw is that of the world then, and ``imu_yaw_rad`` and
        ``camera_yaw_rad`` have to be turned to it, or left NaN
    antenna_m : where on the body the antenna sits

    Raises
    ------
    ConfigError
        where there is no such filter, or it is none for the robot.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> model = make_filter("vio15", load_robot("agrimaro"))
    >>> len(model.states), len(model.rows), model.references
    (18, 17, ('camera_speed',))
    """
    layout = _layout_of(name, robot)
    lever_m = (robot.camera.lever_x_m, robot.camera.lever_y_m) if layout.has_camera else (0.0, 0.0)
    rows = _rows_of(name, with_gnss)
    sensors = tuple((sensor, group) for sensor, group in _SENSORS.items() if group[0] in rows)
    is_vio15 = layout.slip == SLIP_SPEED
    has = (float(layout.has_camera), float(with_gnss))
    fading = (_FADING_PER_S, *_BIAS_FADING_PER_S) if is_vio15 else (0.0,) * 3
    places_m = (*robot.wheel_positions_m.ravel(), *lever_m, *antenna_m)
    return FilterModel(
        name=f"{name} with GNSS" if with_gnss else name,
        states=layout.states,
        rows=rows,
        sensors=sensors,
        propagate=propagate,
        observe=observe,
        inputs=tuple(f"wheel_{i}_growth_per_s" for i in _WHEELS) if is_vio15 else (),
        params=np.array([robot.wheel_radius_m, *places_m, *has, *fading, layout.slip]),
        initial_std=_initial_std(name, with_gnss),
        references=tuple(sensor for sensor, _ in sensors if sensor in _REFERENCES),
        held=tuple(sensor for sensor, _ in sensors if is_vio15 and sensor in _HELD),
        positions=_POSITION,
        angle_states=tuple(state for state in layout.states if state in _ANGLES),
        angle_rows=tuple(row for row in rows if row in _ANGLES),
    )


def _layout_of(name: str, robot: Robot) -> _Layout:
    if name not in _LAYOUTS:
        raise ConfigError(f"filter {name!r} is unknown: use one of {', '.join(FILTERS)}")
    as_drive(SwerveRobot, robot, f"robot {{name}} has the drive {{drive!r}}: filter {name} is for 'swerve'")
    if _LAYOUTS[name].has_camera:
        robot.require("camera")
    return _LAYOUTS[name]


def _rows_of(name: str, with_gnss: bool) -> tuple[str, ...]:
    """Return the rows in the order of (6.3), and rest."""
    layout = _LAYOUTS[name]
    at_rest = layout.slip == SLIP_SPEED
    return (*_ROWS, *CAMERA_ROWS * layout.has_camera, *_REST_ROWS * at_rest, *GNSS_ROWS * with_gnss)


def _kind_of(name: str) -> str:
    """Return a name without axis and wheel: ``accel_x_mps2`` is an ``accel_mps2``."""
    return "_".join(word for word in name.split("_") if word not in ("x", "y", *_WHEELS))


def _initial_std(name: str, with_gnss: bool) -> Array:
    std = np.array([_STATE_STD[_kind_of(state)][0] for state in _LAYOUTS[name].states])
    if with_gnss:
        std[:2] = _SITE_STD_M
    return std


class Schedule:
    """What changes from tick to tick of a filter with slip speeds: noise and inputs by the derived rows.

    The slip of a wheel changes with the ground under it, which shows as vibration a_z, and with its thrust,
    which shows as a change of the wheel's speed w.  The latter is written so that a start from rest leaves a
    slip ratio of 0 +- 0.4, fast or slow: slip speeds walk by, in a second::

        q = (0.09 s a_z)^2 + 0.4^2 |d(w^2)/dt|

    Rough ground, and wheels that change their speed while they are still being steered, turn the robot, too:
    the yaw rate walks by the mean of ``(0.02 s a_z)^2 + 0.4^2 |d(w^2)/dt|`` over the squared distance of a
    wheel from the origin.  What vibration does to slip goes back and forth: it leads nowhere over seconds
    without a camera, and there 0.03 s stands for 0.09 s.

    An accelerometer has ``R = R_quiet + (0.5 a_z)^2``; as on rough ground where the vibration is unknown.

    Parameters
    ----------
    model : filter with inputs
    rows : names of the measurements, in the order of the columns that it is called with
    """

    SHAKEN_S, CHANGED_RATIO, UNSEEN_RATIO, SHAKEN_TURN_S, SHAKEN_ACCEL_RATIO = 0.09, 0.4, 1.0 / 3.0, 0.02, 0.5

    def __init__(self, model: FilterModel, rows: Sequence[str]) -> None:
        self._derived = [rows.index(row) for row in (DERIVED_ROWS[0], *DERIVED_ROWS[4:7], *model.inputs)]
        self._camera_age = rows.index("camera_age_s")
        self._accels = [k for k, row in enumerate(model.rows) if _kind_of(row) == "accel_mps2"]
        self._slips = [k for k, state in enumerate(model.states) if _kind_of(state) == "slip_speed_mps"]
        self._turn, self._shape = model.states.index("yaw_rate_radps"), (len(model.rows), len(model.states))
        self._square_arms_m2 = float((model.params[_PLACES:_CAMERA_X] ** 2).sum())

    def __call__(self, z: Array, measurement_variance: Array) -> tuple[Array, Array, Array]:
        """Return variances (n, m), walks (n, d) and inputs (n, k) for measurements (n, rows).

        Parameters
        ----------
        z : measurements; derived rows that are NaN count as nothing
        measurement_variance : (m,) or (n, m), physical
        """
        derived = z[:, self._derived]
        unknown = np.isnan(derived)
        vibration = np.where(unknown[:, 0], UNKNOWN_MPS2, derived[:, 0])
        derived[unknown] = 0.0
        shaken, changed = derived[:, 0], derived[:, 1:4]
        variance, walk = np.empty((len(z), self._shape[0])), np.zeros((len(z), self._shape[1]))
        variance[:] = measurement_variance
        variance[:, self._accels] += ((self.SHAKEN_ACCEL_RATIO * vibration) ** 2)[:, None]
        unseen = ~(z[:, self._camera_age] <= UNSEEN_AFTER_S)
        shaken_s = self.SHAKEN_S * (1.0 - (1.0 - self.UNSEEN_RATIO) * unseen)
        walk[:, self._slips] = ((shaken_s * shaken) ** 2)[:, None] + 2.0 * self.CHANGED_RATIO**2 * changed
        changes = changed[:, 0] + changed[:, 1] + changed[:, 2]
        turned = 3.0 * (self.SHAKEN_TURN_S * shaken) ** 2 + 2.0 * self.CHANGED_RATIO**2 * changes
        walk[:, self._turn] = turned / self._square_arms_m2
        return variance, walk, derived[:, 4:]


def scheduled(model: FilterModel, noise: Noise, table: MeasurementTable) -> tuple[Noise, Array | None]:
    """Return a physical noise with what changes from tick to tick, and the inputs (n, k); as it is without inputs."""
    if not model.inputs:
        return noise, None
    variance, walk, inputs = Schedule(model, table.rows)(table.z, noise.measurement_variance)
    return replace(noise, measurement_variance=variance, walk_variance=walk), inputs


def default_noise(name: str, robot: Robot, with_gnss: bool = False) -> Noise:
    """Return physical noise for a filter: how fast a robot changes and what its sensors scatter by.

    A sensor scatters by what vibration and delays do to it on any robot, or by what the description says of
    it, whichever is more; of n samples a tick, by 1 / sqrt(n) of that.  An acceleration that walks by q a
    second moves the speed within a tick T, too: beside ``q T`` of its own it leaves ``q T^2 / 2`` in common
    with the speed, and ``q T^3 / 3`` there.  Without these the speed would follow a start half a tick late.

    Raises
    ------
    ConfigError
        as :func:`make_filter` does.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> default_noise("vio15", load_robot("agrimaro")).measurement_variance.shape
    (17,)
    """
    states, rows = _layout_of(name, robot).states, _rows_of(name, with_gnss)
    std = dict(_SAMPLE_STD)
    wheel_speed_std_mps = _SLIP_STD_MPS if name == "vio12" else _WHEEL_SPEED_STD_MPS
    std["wheel_radps"] = wheel_speed_std_mps / robot.wheel_radius_m
    process = np.diag([_STATE_STD[_kind_of(state)][1] ** 2 for state in states])
    if robot.describes("sensors"):
        sensors = robot.sensors

        def averaged(rate_hz: float) -> float:
            return math.sqrt(sensors.wheels_rate_hz / max(rate_hz, sensors.wheels_rate_hz))

        imu = averaged(sensors.imu_rate_hz)
        described = {
            "accel_mps2": sensors.accel_std_mps2 * imu,
            "gyro_z_radps": sensors.gyro_std_radps * imu,
            "imu_yaw_rad": sensors.yaw_std_rad * imu,
            "steer_rad": sensors.steering_std_rad * _LOW_PASSED,
        }
        if robot.describes("camera"):
            camera = robot.camera
            seen = _LOW_PASSED * averaged(camera.rate_hz)
            described["camera_speed_mps"] = camera.speed_std_mps * seen
            described["camera_yaw_rate_radps"] = camera.yaw_rate_std_radps * seen
            described["camera_yaw_rad"] = camera.yaw_std_rad * seen
        std |= {kind: max(std[kind], value) for kind, value in described.items()}
        tick_s = 1.0 / sensors.wheels_rate_hz
        for axis in "xy":
            speed, accel = states.index(f"speed_{axis}_mps"), states.index(f"accel_{axis}_mps2")
            walk = process[accel, accel]
            process[speed, accel] = process[accel, speed] = walk * tick_s / 2.0
            process[speed, speed] += walk * tick_s**2 / 3.0
    variance = np.array([std[_kind_of(row)] ** 2 for row in rows])
    return Noise(process, variance, _initial_std(name, with_gnss) ** 2)


# (6.13), (6.14), (6.9), and (4.40), (4.41), (4.38), with their entries in the order of (6.1)
_VIO_R = (*[0.05] * 3, *[0.001] * 2, 0.001, 0.01, *[1e-5] * 3, *[5e-5] * 2, 0.001, 0.0005)
_VIO_Q = (*[0.5] * 2, 0.08, *[0.08] * 2, 0.15, *[0.12] * 2, *[0.002] * 3, 0.002)
_VIO_P0 = (*[1e-5] * 8, *[1.5e-4] * 3, 1e-4)
_SLIP_R = (*[1e-5] * 7, *[7.2e-5] * 3)
_SLIP_Q = (*[1e-8] * 3, *[1e-6] * 2, 1e-5, *[1e-3] * 2, *[1e-5] * 3, *[7.2e-5] * 3)
_SLIP_P0 = (*[1e-6] * 6, *[1e-3] * 2, *[1e-6] * 3, *[1e-1] * 3)


def thesis_noise(name: str, robot: Robot, sample_time_s: float = 0.02) -> Noise:
    """Return the noise that the thesis prints, to compare with.

    Parameters
    ----------
    name : vio12 and vio15 take (6.13), (6.14) and (6.9); encoder12 and slip14 take (4.38)-(4.41)
    robot : a swerve robot
    sample_time_s : the thesis gives Q a step, and no rate: per second it is Q / sample_time_s

    Raises
    ------
    ConfigError
        as :func:`make_filter` does, or where the sample time is not above zero.

    Notes
    -----
    Corrected: (4.38) has 13 entries for 14 states and (4.40) 11 for 10 measurements; here six 1e-6, two 1e-3,
    three 1e-6, three 1e-1, and seven 1e-5, three 7.2e-5.  (6.8) is 1.47e-4, not 1.35e-4; the 1.5e-4 of (6.9)
    stands.  The thesis gives encoder12 no values for the gyro's bias, and knows no slip speeds: those are of
    :func:`default_noise`.
    """
    layout = _layout_of(name, robot)
    if not 0 < sample_time_s < math.inf:
        raise ConfigError(f"sample_time_s is {sample_time_s}, seconds above zero are required")
    printed, r, q, p0 = _LAYOUTS["slip14"].states, _SLIP_R, _SLIP_Q, _SLIP_P0
    if layout.has_camera:
        printed, r, q, p0 = _LAYOUTS["vio12"].states, _VIO_R, _VIO_Q, _VIO_P0
    walk = default_noise(name, robot).process_variance.diagonal().copy()
    initial = _initial_std(name, False) ** 2
    for i, state in enumerate(layout.states):
        if state in printed:
            walk[i] = q[printed.index(state)] / sample_time_s
            initial[i] = p0[printed.index(state)]
    return Noise(walk, np.array(r), initial)
