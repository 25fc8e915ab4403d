"""The filters of a swerve robot: three wheels, driven and steered each, an IMU, and a camera or GNSS.

========= ====== ==== ================================================================================
filter    states rows what it can know
========= ====== ==== ================================================================================
encoder12 12     10   the speed of the wheels, which it takes for the speed over ground: slip reads 0
slip14    14     10   that, and a slip ratio of each wheel, which nothing determines as long as it drives
                      straight: an example of what cannot be observed
vio12     12     14   the speed that the camera sees, drawn to that of the wheels: slip reads low
vio15     15     14   the speed that the camera sees, and how fast each wheel slips: **the one to use**
========= ====== ==== ================================================================================

Each can be made with four rows of GNSS more, another source of absolute speed and position.

Process, with T the step, psi the yaw and w its rate, v and a in the body frame.  All else is a random walk,
but that the acceleration of vio15 fades, a <- a exp(-3 T): kept for ever, as in the thesis, it would let a
truth that is drawn from the model reach hundreds of metres a second::

    p_x <- p_x + T (v_x cos psi - v_y sin psi)        v_x <- v_x + T (a_x + w v_y)
    p_y <- p_y + T (v_x sin psi + v_y cos psi)        v_y <- v_y + T (a_y - w v_x)        psi <- psi + T w

Measurements, of wheel i at (x_i, y_i) steered by d_i, the camera at (r_x, r_y) and the antenna at l::

    v_i = (v_x - w y_i) cos d_i + (v_y + w x_i) sin d_i     wheel_i = v_i / r               encoder12, vio12
                                                            wheel_i = v_i / ((1 - s_i) r)   slip14
                                                            wheel_i = (v_i + l_i) / r       vio15
    accel = a        gyro = w + b        imu_yaw = camera_yaw = psi        steer_i = d_i
    camera_speed = (v_x - w r_y, v_y + w r_x)        camera_yaw_rate = w
    gnss_position = p + R(psi) l        gnss_speed = R(psi) (v + w x l)        in the world frame

Source: Danzi, AgriMaRo thesis, 4.3-4.5 and 6.1.  Corrected:

- (2.3) against 7.2: one geometry, that of 7.2, from the robot's description;
- (4.28), (4.48) rows 4 and 5: -w v_y and w v_x leave the acceleration, a state, without a measurement, and
  the filter diverges on a straight run; they are a_x and a_y, as in (6.6);
- (4.36), (4.44): the yaw rate stands after the accelerations; here states go by name, in the order of (6.1);
- (4.42), (4.46): place and angle of wheel 1 stand for every wheel; each has its own;
- 4.5.1 blames the nonlinearity of the 14 states: it is observability, no row measures the speed over ground;
- (6.2): the signs of the Coriolis terms are flipped; those of (4.33), (4.34) are right;
- (6.5): v - w x r; it is v + w x r, as in (6.6);
- (4.38), (4.40), (6.8), (6.9)-(6.14): see :func:`thesis_noise`;
- 6.1: beside a camera, wheel rows without slip draw the speed to that of the wheels, wholly once the camera
  is lost.  A slip speed l_i = wheel_i r - v_i of each wheel, a slow random walk, frees them and stays linear
  (vio15).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.ekf import FilterModel, Noise
from terrain.estimation.swerve_model import (
    observe_slip_ratio,
    observe_slip_speed,
    observe_without_slip,
    propagate,
)
from terrain.records import Array
from terrain.robots import Robot

_WHEELS = ("1", "2", "3")
_FADING_PER_S = 3.0  # of the acceleration of vio15: a third of a second, shorter than a start and a stop
_POSITION = ("position_x_m", "position_y_m")
_MOTION = (
    *(*_POSITION, "yaw_rad", "speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
    *("accel_x_mps2", "accel_y_mps2"),
)
_STEER = tuple(f"steer_{i}_rad" for i in _WHEELS)
_BIAS = ("gyro_bias_radps",)


class _Layout(NamedTuple):
    states: tuple[str, ...]
    observe: Any
    has_camera: bool


_LAYOUTS = {
    "encoder12": _Layout((*_MOTION, *_STEER, *_BIAS), observe_without_slip, False),
    "slip14": _Layout((*_MOTION, *(f"slip_{i}_ratio" for i in _WHEELS), *_STEER), observe_slip_ratio, False),
    "vio12": _Layout((*_MOTION, *_STEER, *_BIAS), observe_without_slip, True),
    "vio15": _Layout(
        (*_MOTION, *_STEER, *_BIAS, *(f"slip_speed_{i}_mps" for i in _WHEELS)), observe_slip_speed, True
    ),
}

FILTERS = tuple(_LAYOUTS)
"""Names of the filters."""

_CAMERA_ROWS = ("camera_speed_x_mps", "camera_speed_y_mps", "camera_yaw_rate_radps", "camera_yaw_rad")
_GNSS_ROWS = ("gnss_position_x_m", "gnss_position_y_m", "gnss_speed_x_mps", "gnss_speed_y_mps")
_ROWS = (
    *(f"wheel_{i}_radps" for i in _WHEELS),
    *("accel_x_mps2", "accel_y_mps2", "gyro_z_radps", "imu_yaw_rad"),
    *_STEER,
)
# In the order in which they are judged, each after those that it rests on: turning, speed, and last the
# wheels, which may slip.
_SENSORS = {
    "camera_yaw_rate": _CAMERA_ROWS[2:3],
    "camera_yaw": _CAMERA_ROWS[3:],
    "gyro": ("gyro_z_radps",),
    "imu_yaw": ("imu_yaw_rad",),
    "camera_speed": _CAMERA_ROWS[:2],
    "gnss_position": _GNSS_ROWS[:2],
    "gnss_speed": _GNSS_ROWS[2:],
    "accel": ("accel_x_mps2", "accel_y_mps2"),
    **{f"steer_{i}": (f"steer_{i}_rad",) for i in _WHEELS},
    **{f"wheel_{i}": (f"wheel_{i}_radps",) for i in _WHEELS},
}
_REFERENCES = ("camera_speed", "gnss_speed")
_ANGLES = ("yaw_rad", *_STEER, "imu_yaw_rad", "camera_yaw_rad")


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
    (15, 14, ('camera_speed',))
    """
    layout = _layout(name, robot)
    camera = robot.camera if layout.has_camera else None
    lever_m = (camera.lever_x_m, camera.lever_y_m) if camera else (0.0, 0.0)
    rows = _rows(name, with_gnss)
    sensors = tuple((sensor, group) for sensor, group in _SENSORS.items() if group[0] in rows)
    has = (float(layout.has_camera), float(with_gnss))
    places_m = (*robot.wheel_positions_m.ravel(), *lever_m, *antenna_m)
    return FilterModel(
        name=f"{name} with GNSS" if with_gnss else name,
        states=layout.states,
        rows=rows,
        sensors=sensors,
        propagate=propagate,
        observe=layout.observe,
        params=np.array([robot.wheel_radius_m, *places_m, *has, _FADING_PER_S if name == "vio15" else 0.0]),
        initial_std=_initial_std(name, with_gnss),
        references=tuple(sensor for sensor, _ in sensors if sensor in _REFERENCES),
        positions=_POSITION,
        angle_states=tuple(state for state in layout.states if state in _ANGLES),
        angle_rows=tuple(row for row in rows if row in _ANGLES),
    )


def _layout(name: str, robot: Robot) -> _Layout:
    if name not in _LAYOUTS:
        raise ConfigError(f"filter {name!r} is unknown: use one of {', '.join(FILTERS)}")
    if robot.drive != "swerve":
        raise ConfigError(f"robot {robot.name} has the drive {robot.drive!r}: filter {name} is for 'swerve'")
    if _LAYOUTS[name].has_camera:
        robot.has("camera")
    return _LAYOUTS[name]


def _rows(name: str, with_gnss: bool) -> tuple[str, ...]:
    """Return the rows in the order of (6.3)."""
    return (*_ROWS, *_CAMERA_ROWS * _LAYOUTS[name].has_camera, *_GNSS_ROWS * with_gnss)


# Standard deviations by name without axis and wheel: of what is known of a robot that was just switched on,
_INITIAL_STD = {
    "position_m": 1e-3,  # without GNSS the origin is where that was; with it: _SITE_STD_M
    "yaw_rad": 1.0,
    "speed_mps": 0.5,
    "yaw_rate_radps": 0.5,
    "accel_mps2": 1.0,
    "steer_rad": 0.3,
    "gyro_bias_radps": 0.01,
    "slip_ratio": 0.3,
    "slip_speed_mps": 0.2,
}
# of how far a state walks within a second,
_WALK_STD = {
    "position_m": 1e-3,
    "yaw_rad": 1e-4,
    "speed_mps": 0.03,
    "yaw_rate_radps": 0.1,
    "accel_mps2": 2.0,
    "steer_rad": 0.1,
    "gyro_bias_radps": 2e-4,
    "slip_ratio": 0.05,
    "slip_speed_mps": 0.03,
}
# and of what a sample scatters by on a robot that moves, with vibration and delays.  Chosen on simulated runs
# so that the errors of vio15 are on average those that it states; likelihood is no guide where a low-pass
# colours the noise of every sensor.
_SAMPLE_STD = {
    "accel_mps2": 0.7,
    "gyro_z_radps": 0.01,
    "imu_yaw_rad": 0.05,
    "steer_rad": 0.003,
    "camera_speed_mps": 0.003,
    "camera_yaw_rate_radps": 0.01,
    "camera_yaw_rad": 0.005,
    "gnss_position_m": 0.02,
    "gnss_speed_mps": 0.03,
}
_SITE_STD_M = 100.0
_WHEEL_SPEED_STD_MPS = 0.007  # of a wheel's rim, mostly the ripple of the Hall steps
_SLIP_STD_MPS = 0.15  # how far rim and ground differ, where both are measured and no state stands for it


def _kind(name: str) -> str:
    """Return a name without axis and wheel: ``accel_x_mps2`` is an ``accel_mps2``."""
    return "_".join(word for word in name.split("_") if word not in ("x", "y", *_WHEELS))


def _initial_std(name: str, with_gnss: bool) -> Array:
    stds = _INITIAL_STD | ({"position_m": _SITE_STD_M} if with_gnss else {})
    return np.array([stds[_kind(state)] for state in _LAYOUTS[name].states])


def _described_std(robot: Robot) -> dict[str, float]:
    """Return what the sensors scatter by as described; of n samples a tick, by 1 / sqrt(n) of it."""
    sensors, camera = robot.sensors, robot.camera
    found = {}
    if sensors is not None:
        imu = math.sqrt(sensors.wheels_rate_hz / max(sensors.imu_rate_hz, sensors.wheels_rate_hz))
        found["accel_mps2"] = sensors.accel_std_mps2 * imu
        found["gyro_z_radps"] = sensors.gyro_std_radps * imu
        found["imu_yaw_rad"] = sensors.yaw_std_rad * imu
        found["steer_rad"] = sensors.steering_std_rad
    if sensors is not None and camera is not None:
        seen = math.sqrt(sensors.wheels_rate_hz / max(camera.rate_hz, sensors.wheels_rate_hz))
        found["camera_speed_mps"] = camera.speed_std_mps * seen
        found["camera_yaw_rate_radps"] = camera.yaw_rate_std_radps * seen
        found["camera_yaw_rad"] = camera.yaw_std_rad * seen
    return found


def default_noise(name: str, robot: Robot, with_gnss: bool = False) -> Noise:
    """Return physical noise for a filter: how fast a robot changes and what its sensors scatter by.

    A sensor scatters by what vibration and delays do to it on any robot, or by what the description says of
    it, whichever is more.

    Raises
    ------
    ConfigError
        as :func:`make_filter` does.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> default_noise("vio15", load_robot("agrimaro")).measurement_variance.shape
    (14,)
    """
    layout = _layout(name, robot)
    wheel_speed_std_mps = _SLIP_STD_MPS if name == "vio12" else _WHEEL_SPEED_STD_MPS
    sample_std = _SAMPLE_STD | {"wheel_radps": wheel_speed_std_mps / robot.wheel_radius_m}
    for kind, std in _described_std(robot).items():
        sample_std[kind] = max(sample_std[kind], std)
    return Noise(
        np.array([_WALK_STD[_kind(state)] ** 2 for state in layout.states]),
        np.array([sample_std[_kind(row)] ** 2 for row in _rows(name, with_gnss)]),
        _initial_std(name, with_gnss) ** 2,
    )


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
    layout = _layout(name, robot)
    if not 0 < sample_time_s < math.inf:
        raise ConfigError(f"sample_time_s is {sample_time_s}, seconds above zero are required")
    printed, r, q, p0 = _LAYOUTS["slip14"].states, _SLIP_R, _SLIP_Q, _SLIP_P0
    if layout.has_camera:
        printed, r, q, p0 = _LAYOUTS["vio12"].states, _VIO_R, _VIO_Q, _VIO_P0
    plain = default_noise(name, robot)
    walk, initial = plain.process_variance.diagonal().copy(), _initial_std(name, False) ** 2
    for i, state in enumerate(layout.states):
        if state in printed:
            walk[i] = q[printed.index(state)] / sample_time_s
            initial[i] = p0[printed.index(state)]
    return Noise(walk, np.array(r), initial)


def adaptive_noise(robot: Robot, factor: float) -> Noise:
    """Return noise for encoder12 that trusts the wheels less and the IMU more, as thesis 4.6.1 tried in vain.

    The variance of the wheels is multiplied by the factor, that of accelerometer and gyro divided by it, and
    the walk of the yaw rate multiplied.  No factor will do: as long as the wheels hold the speed, it is
    theirs and slip reads zero; where they let go of it, it is the integral of the accelerometer's
    bias too.  The speed over ground has to be measured.

    Raises
    ------
    ConfigError
        where the robot is no swerve robot, or the factor is not above zero.
    """
    if not 0 < factor < math.inf:
        raise ConfigError(f"factor is {factor}, a number above zero is required")
    plain = default_noise("encoder12", robot)
    scale = {"wheel_radps": factor, "accel_mps2": 1 / factor, "gyro_z_radps": 1 / factor}
    walk = plain.process_variance.diagonal().copy()
    walk[_MOTION.index("yaw_rate_radps")] *= factor
    scales = [scale.get(_kind(row), 1.0) for row in _rows("encoder12", False)]
    return Noise(walk, plain.measurement_variance * np.array(scales), plain.initial_variance)
