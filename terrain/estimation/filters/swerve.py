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

Each can be made with four rows of GNSS more, another source of absolute speed and position.

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
acceleration is believed, follows vibration and changes of the wheels' speeds:
:func:`~terrain.estimation.filters.swerve_noise.slip_walk`.  Camera, IMU and rest are held: what disagrees for
less than two seconds is not believed, as these sensors fail rather than show the ground's doing.

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
- 4.5.1 blames the nonlinearity of the 14 states: it is observability, no row measures the speed over ground;
- (6.2): the signs of the Coriolis terms are flipped; those of (4.33), (4.34) are right;
- (6.5): v - w x r; it is v + w x r, as in (6.6);
- (4.38), (4.40), (6.8), (6.9)-(6.14): see :func:`thesis_noise`;
- 6.1: beside a camera, wheel rows without slip draw the speed to that of the wheels, wholly once the camera
  is lost.  A slip speed l_i = wheel_i r - v_i of each wheel, a random walk, frees them and stays linear
  (vio15).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.feed import CAMERA_ROWS, DERIVED_ROWS, GNSS_ROWS
from terrain.estimation.filter import FilterModel
from terrain.estimation.filters.swerve_model import (
    observe_slip_ratio,
    observe_slip_speed,
    observe_without_slip,
    propagate,
    propagate_slip_speed,
)
from terrain.records import Array
from terrain.robots import Robot, SwerveRobot, as_drive

_WHEELS = ("1", "2", "3")
_FADING_PER_S = 3.0  # of the acceleration of vio15: a third of a second, shorter than a start and a stop
_BIAS_FADING_PER_S = (2e-4, 8e-4)  # of gyro and accelerometer: with their walks, as uncertain as at first
_POSITION = ("position_x_m", "position_y_m")
MOTION = (
    *(*_POSITION, "yaw_rad", "speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
    *("accel_x_mps2", "accel_y_mps2"),
)
_STEER = tuple(f"steer_{i}_rad" for i in _WHEELS)
_BIAS = ("gyro_bias_radps",)
_ACCEL_BIAS = ("accel_bias_x_mps2", "accel_bias_y_mps2")


class Layout(NamedTuple):
    """States of a filter, process and measurement, whether it needs a camera, and held sensors."""

    states: tuple[str, ...]
    functions: tuple[Any, Any]
    has_camera: bool
    held: tuple[str, ...] = ()


GROWTH_INPUTS = tuple(f"wheel_{i}_growth_per_s" for i in _WHEELS)
_SLIP_SPEED = tuple(f"slip_speed_{i}_mps" for i in _WHEELS)
_HELD = ("camera_yaw_rate", "camera_yaw", "gyro", "camera_speed", "accel", "rest")

_WITHOUT_SLIP = (propagate, observe_without_slip)
_SLIP_RATIO = (propagate, observe_slip_ratio)
_WITH_SLIP_SPEED = (propagate_slip_speed, observe_slip_speed)
LAYOUTS = {
    "encoder12": Layout((*MOTION, *_STEER, *_BIAS), _WITHOUT_SLIP, False),
    "slip14": Layout((*MOTION, *(f"slip_{i}_ratio" for i in _WHEELS), *_STEER), _SLIP_RATIO, False),
    "vio12": Layout((*MOTION, *_STEER, *_BIAS), _WITHOUT_SLIP, True),
    "vio15": Layout(
        (*MOTION, *_STEER, *_BIAS, *_SLIP_SPEED, "imu_yaw_offset_rad", *_ACCEL_BIAS),
        _WITH_SLIP_SPEED,
        True,
        _HELD,
    ),
}

FILTERS = tuple(LAYOUTS)
"""Names of the filters."""

REST_ROWS = DERIVED_ROWS[-3:]
_ROWS = (
    *(f"wheel_{i}_radps" for i in _WHEELS),
    *("accel_x_mps2", "accel_y_mps2", "gyro_z_radps", "imu_yaw_rad"),
    *_STEER,
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
    "rest": REST_ROWS,
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
    (18, 17, ('camera_speed',))
    """
    layout = layout_of(name, robot)
    lever_m = (robot.camera.lever_x_m, robot.camera.lever_y_m) if layout.has_camera else (0.0, 0.0)
    rows = rows_of(name, with_gnss)
    sensors = tuple((sensor, group) for sensor, group in _SENSORS.items() if group[0] in rows)
    has = (float(layout.has_camera), float(with_gnss))
    fading = (_FADING_PER_S, *_BIAS_FADING_PER_S) if name == "vio15" else (0.0,) * 3
    places_m = (*robot.wheel_positions_m.ravel(), *lever_m, *antenna_m)
    return FilterModel(
        name=f"{name} with GNSS" if with_gnss else name,
        states=layout.states,
        rows=rows,
        sensors=sensors,
        propagate=layout.functions[0],
        observe=layout.functions[1],
        inputs=GROWTH_INPUTS if name == "vio15" else (),
        params=np.array([robot.wheel_radius_m, *places_m, *has, *fading]),
        initial_std=initial_std(name, with_gnss),
        references=tuple(sensor for sensor, _ in sensors if sensor in _REFERENCES),
        held=tuple(sensor for sensor, _ in sensors if sensor in layout.held),
        positions=_POSITION,
        angle_states=tuple(state for state in layout.states if state in _ANGLES),
        angle_rows=tuple(row for row in rows if row in _ANGLES),
    )


def layout_of(name: str, robot: Robot) -> Layout:
    """Return the layout of a filter that fits the robot."""
    if name not in LAYOUTS:
        raise ConfigError(f"filter {name!r} is unknown: use one of {', '.join(FILTERS)}")
    as_drive(SwerveRobot, robot, f"robot {{name}} has the drive {{drive!r}}: filter {name} is for 'swerve'")
    if LAYOUTS[name].has_camera:
        robot.require("camera")
    return LAYOUTS[name]


def rows_of(name: str, with_gnss: bool) -> tuple[str, ...]:
    """Return the rows in the order of (6.3), and rest."""
    has_camera = LAYOUTS[name].has_camera
    return (*_ROWS, *CAMERA_ROWS * has_camera, *REST_ROWS * (name == "vio15"), *GNSS_ROWS * with_gnss)


# Standard deviations by name without axis and wheel: of what is known of a robot that was just switched on,
_INITIAL_STD = {
    "position_m": 4e-3,  # without GNSS the origin is where that was, but for what low-passes displace
    "yaw_rad": 1.0,
    "speed_mps": 0.5,
    "yaw_rate_radps": 0.5,
    "accel_mps2": 1.0,
    "steer_rad": 0.3,
    "gyro_bias_radps": 0.01,
    "slip_ratio": 0.3,
    "slip_speed_mps": 0.2,
    "imu_yaw_offset_rad": 0.01,
    "accel_bias_mps2": 0.05,
}
_SITE_STD_M = 100.0


def kind_of(name: str) -> str:
    """Return a name without axis and wheel: ``accel_x_mps2`` is an ``accel_mps2``."""
    return "_".join(word for word in name.split("_") if word not in ("x", "y", *_WHEELS))


def initial_std(name: str, with_gnss: bool) -> Array:
    """Return the standard deviation (d,) of each state before the first sample."""
    stds = _INITIAL_STD | ({"position_m": _SITE_STD_M} if with_gnss else {})
    return np.array([stds[kind_of(state)] for state in LAYOUTS[name].states])
