"""Noise of the swerve filters: physical, the thesis' own, and its adaptive one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.feed import DERIVED_ROWS, UNSEEN_AFTER_S
from terrain.estimation.filter import FilterModel, Noise
from terrain.estimation.filters.swerve import LAYOUTS, MOTION, initial_std, kind_of, layout_of, rows_of
from terrain.estimation.filters.swerve_model import WHEELS
from terrain.estimation.table import MeasurementTable
from terrain.records import Array
from terrain.robots import Robot

# of how far a state walks within a second,
_WALK_STD = {
    "position_m": 3e-4,
    "yaw_rad": 3e-4,
    "speed_mps": 0.01,
    "yaw_rate_radps": 0.02,
    "accel_mps2": 2.0,
    "steer_rad": 0.1,
    "gyro_bias_radps": 2e-4,
    "slip_ratio": 0.05,
    "slip_speed_mps": 0.03,
    "imu_yaw_offset_rad": 3.5e-4,
    "accel_bias_mps2": 2e-3,
}
# and of what a sample scatters by on a robot that moves, with vibration and delays.  Chosen on simulated runs
# so that the errors of vio15 are on average those that it states; likelihood is no guide where a low-pass
# colours the noise of every sensor.
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


def _described_std(robot: Robot) -> dict[str, float]:
    """Return what the sensors scatter by as described; of n samples a tick, by 1 / sqrt(n) of it."""
    found = {}
    if robot.describes("sensors"):
        sensors = robot.sensors
        imu = math.sqrt(sensors.wheels_rate_hz / max(sensors.imu_rate_hz, sensors.wheels_rate_hz))
        found["accel_mps2"] = sensors.accel_std_mps2 * imu
        found["gyro_z_radps"] = sensors.gyro_std_radps * imu
        found["imu_yaw_rad"] = sensors.yaw_std_rad * imu
        found["steer_rad"] = sensors.steering_std_rad * _LOW_PASSED
    if robot.describes("sensors", "camera"):
        sensors, camera = robot.sensors, robot.camera
        seen = _LOW_PASSED * math.sqrt(sensors.wheels_rate_hz / max(camera.rate_hz, sensors.wheels_rate_hz))
        found["camera_speed_mps"] = camera.speed_std_mps * seen
        found["camera_yaw_rate_radps"] = camera.yaw_rate_std_radps * seen
        found["camera_yaw_rad"] = camera.yaw_std_rad * seen
    return found


# What a slip speed walks by beside _WALK_STD: within a second a part of the vibration, in s, and a part of
# what the speed of its wheel changes by.
_SHAKEN_S, _CHANGED_RATIO, _UNSEEN_RATIO, _SHAKEN_TURN_S = 0.09, 0.4, 1.0 / 3.0, 0.02


_SHAKEN_ACCEL_RATIO = 0.5  # scatter of an accelerometer by vibration, as a part of the vertical one
UNKNOWN_MPS2 = 1.4
"""Vibration where it is not known: that of rough ground."""


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

    def __init__(self, model: FilterModel, rows: Sequence[str]) -> None:
        self._derived = [rows.index(row) for row in (DERIVED_ROWS[0], *DERIVED_ROWS[4:7], *model.inputs)]
        self._camera_age = rows.index("camera_age_s")
        self._accels = [k for k, row in enumerate(model.rows) if kind_of(row) == "accel_mps2"]
        self._slips = [k for k, state in enumerate(model.states) if kind_of(state) == "slip_speed_mps"]
        self._turn, self._shape = model.states.index("yaw_rate_radps"), (len(model.rows), len(model.states))
        self._square_arms_m2 = float((model.params[WHEELS] ** 2).sum())

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
        variance[:, self._accels] += ((_SHAKEN_ACCEL_RATIO * vibration) ** 2)[:, None]
        unseen = ~(z[:, self._camera_age] <= UNSEEN_AFTER_S)
        shaken_s = _SHAKEN_S * (1.0 - (1.0 - _UNSEEN_RATIO) * unseen)
        walk[:, self._slips] = ((shaken_s * shaken) ** 2)[:, None] + 2.0 * _CHANGED_RATIO**2 * changed
        changes = changed[:, 0] + changed[:, 1] + changed[:, 2]
        turned = 3.0 * (_SHAKEN_TURN_S * shaken) ** 2 + 2.0 * _CHANGED_RATIO**2 * changes
        walk[:, self._turn] = turned / self._square_arms_m2
        return variance, walk, derived[:, 4:]


def scheduled(model: FilterModel, noise: Noise, table: MeasurementTable) -> tuple[Noise, Array | None]:
    """Return a noise with what changes from tick to tick, and the inputs (n, k) of the process.

    Parameters
    ----------
    model : a filter; one without inputs keeps its noise
    noise : physical
    table : the measurements
    """
    if not model.inputs:
        return noise, None
    variance, walk, inputs = Schedule(model, table.rows)(table.z, noise.measurement_variance)
    return replace(noise, measurement_variance=variance, walk_variance=walk), inputs


def _process_variance(states: tuple[str, ...], robot: Robot) -> Array:
    """Return the variances a second (d, d) by which states walk.

    An acceleration that walks by q a second moves the speed within a tick T, too: beside ``q T`` of its own
    it leaves ``q T^2 / 2`` in common with the speed, and ``q T^3 / 3`` there.  Without these the speed would
    follow a start half a tick late.
    """
    found = np.diag([_WALK_STD[kind_of(state)] ** 2 for state in states])
    tick_s = 1.0 / robot.sensors.wheels_rate_hz if robot.describes("sensors") else 0.0
    for axis in "xy":
        speed, accel = states.index(f"speed_{axis}_mps"), states.index(f"accel_{axis}_mps2")
        found[speed, accel] = found[accel, speed] = found[accel, accel] * tick_s / 2.0
        found[speed, speed] += found[accel, accel] * tick_s**2 / 3.0
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
    (17,)
    """
    layout = layout_of(name, robot)
    wheel_speed_std_mps = _SLIP_STD_MPS if name == "vio12" else _WHEEL_SPEED_STD_MPS
    sample_std = _SAMPLE_STD | {"wheel_radps": wheel_speed_std_mps / robot.wheel_radius_m}
    for kind, std in _described_std(robot).items():
        sample_std[kind] = max(sample_std[kind], std)
    return Noise(
        _process_variance(layout.states, robot),
        np.array([sample_std[kind_of(row)] ** 2 for row in rows_of(name, with_gnss)]),
        initial_std(name, with_gnss) ** 2,
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
    layout = layout_of(name, robot)
    if not 0 < sample_time_s < math.inf:
        raise ConfigError(f"sample_time_s is {sample_time_s}, seconds above zero are required")
    printed, r, q, p0 = LAYOUTS["slip14"].states, _SLIP_R, _SLIP_Q, _SLIP_P0
    if layout.has_camera:
        printed, r, q, p0 = LAYOUTS["vio12"].states, _VIO_R, _VIO_Q, _VIO_P0
    plain = default_noise(name, robot)
    walk, initial = plain.process_variance.diagonal().copy(), initial_std(name, False) ** 2
    for i, state in enumerate(layout.states):
        if state in printed:
            walk[i] = q[printed.index(state)] / sample_time_s
            initial[i] = p0[printed.index(state)]
    return Noise(walk, np.array(r), initial)


def adaptive_noise(robot: Robot, factor: float) -> Noise:
    """Return noise for encoder12 that trusts the wheels less and the IMU more, as thesis 4.6.1 tried in vain.

    The variance of the wheels is multiplied by the factor, that of accelerometer and gyro divided by it, and
    the walk of the yaw rate multiplied.  No factor will do: as long as the wheels hold the speed, it is
    theirs and slip reads zero; where they do not, it includes the integral of the accelerometer's
    bias.  The speed over ground has to be measured.

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
    walk[MOTION.index("yaw_rate_radps")] *= factor
    scales = [scale.get(kind_of(row), 1.0) for row in rows_of("encoder12", False)]
    return Noise(walk, plain.measurement_variance * np.array(scales), plain.initial_variance)
