"""Noise of the standing robot, and the variances that a filter makes of it (Danzi, AgriMaRo thesis, 4.4.3).

Corrected: (4.39) takes the variance about the mean of ten minutes, so that a walking bias, and the heading
that it turns, pass for noise.  Here it is the variance within batches of a second about a straight line.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from terrain.angles import unwrapped
from terrain.calibration.finding import Finding, std_interval, undetermined
from terrain.calibration.motion import seen_motion
from terrain.calibration.standing import ACCEL, GYRO, NO_STANDING, Stretch, batches
from terrain.records import Array, Stream
from terrain.robots import Robot

NO_NOISE_SHARE = 0.01
"""Of the described standard deviation: a channel with less shows no noise at rest."""

MIN_NOISE_STEPS = 0.4
"""Noise under this share of an encoder's step hides in the step; above, step^2/12 taken off is right
(Sheppard)."""

LAGS = 10
"""Lags over which noise is looked at for colour."""

NOISE_FLOOR = 1e-5
"""Least variance of a measurement, in its squared natural unit: no filter shall take a sensor for perfect
(4.4.3)."""


def sensor_noise(stretches: Sequence[Stretch], robot: Robot) -> list[Finding]:
    """Return the standard deviation of the noise of each kind of sensor at rest.

    Parameters
    ----------
    stretches : standing, of any runs
    robot : swerve robot with all sections

    Notes
    -----
    The interval is that of chi square with ``n / (1 + 2 sum rho_k^2)`` degrees of freedom, ``rho_k`` the
    autocorrelation.  Of the steering angle, the variance of its steps, ``step^2/12``, is taken off: the
    description has the steps by themselves.
    """
    signals: dict[str, list[tuple[str, Stream]]] = {}
    for stretch in stretches:
        for parameter, stream in _signals(stretch, robot).items():
            signals.setdefault(parameter, []).append((stretch.run.run_id, stream))
    if not stretches:
        return undetermined(_PARAMETERS, NO_STANDING)
    return [_noise(parameter, signals.get(parameter, []), robot) for parameter in _PARAMETERS]


def measurement_variances(robot: Robot, floor: float = NOISE_FLOOR) -> dict[str, float]:
    """Return the variance of each row that a filter measures, in its squared natural unit.

    Parameters
    ----------
    robot : swerve robot with all sections
    floor : least variance

    Notes
    -----
    These are the sensors' own, sample by sample and at rest: thesis 4.4.3 with the floor of its (4.40).  A
    low-pass before the filter makes them smaller, driving over rough ground makes those of the
    accelerations larger.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> variances = measurement_variances(load_robot("agrimaro"))
    >>> variances["camera_speed_x_mps"], round(variances["accel_x_mps2"], 6)
    (1e-05, 0.000135)
    """
    _, motors, _, camera, sensors = robot.equipment
    steering = sensors.steering_std_rad**2 + (2 * math.pi / sensors.steering_steps_ratio) ** 2 / 12
    variances = {
        **{f"wheel_{i}_radps": (sensors.motor_std_radps / motors.reduction_ratio) ** 2 for i in robot.wheels},
        "accel_x_mps2": (sensors.accel_std_mps2 / sensors.accel_scale_x_ratio) ** 2,
        "accel_y_mps2": (sensors.accel_std_mps2 / sensors.accel_scale_y_ratio) ** 2,
        "gyro_z_radps": sensors.gyro_std_radps**2,
        "imu_yaw_rad": sensors.yaw_std_rad**2,
        **{f"steer_{i}_rad": steering for i in robot.wheels},
        "camera_speed_x_mps": camera.speed_std_mps**2,
        "camera_speed_y_mps": camera.speed_std_mps**2,
        "camera_yaw_rate_radps": camera.yaw_rate_std_radps**2,
        "camera_yaw_rad": camera.yaw_std_rad**2,
    }
    return {row: max(variance, floor) for row, variance in variances.items()}


_PARAMETERS = (
    "sensors.gyro_std_radps",
    "sensors.accel_std_mps2",
    "sensors.yaw_std_rad",
    "sensors.motor_std_radps",
    "sensors.current_std_a",
    "sensors.steering_std_rad",
    "camera.speed_std_mps",
    "camera.yaw_rate_std_radps",
    "camera.yaw_std_rad",
)


def _signals(stretch: Stretch, robot: Robot) -> dict[str, Stream]:
    """Return the signals of a standing stretch by the parameter that is their noise."""
    channels: Mapping[str, tuple[str, Sequence[str]]] = {
        "sensors.gyro_std_radps": ("imu", GYRO),
        "sensors.accel_std_mps2": ("imu", ACCEL),
        "sensors.yaw_std_rad": ("imu", ("yaw_rad",)),
        "sensors.motor_std_radps": ("wheels", [f"motor_{i}_radps" for i in robot.wheels]),
        "sensors.current_std_a": ("wheels", [f"current_{i}_a" for i in robot.wheels]),
        "sensors.steering_std_rad": ("steering", [f"angle_{i}_rad" for i in robot.wheels]),
    }
    found = {name: stream for name, place in channels.items() if (stream := stretch.of(*place))}
    for name, stream in found.items():
        if name.endswith("_rad"):
            turned = np.column_stack([unwrapped(column) for column in stream.values.T])
            found[name] = Stream(stream.time_s, turned, stream.channels)
    seen = seen_motion(stretch, robot)
    if seen is not None:
        for name, columns in (
            ("camera.speed_std_mps", [0, 1]),
            ("camera.yaw_rate_std_radps", [2]),
            ("camera.yaw_std_rad", [3]),
        ):
            found[name] = Stream(
                seen.time_s, seen.values[:, columns], tuple(seen.channels[i] for i in columns)
            )
    return found


def _noise(parameter: str, signals: Sequence[tuple[str, Stream]], robot: Robot) -> Finding:
    section, _, name = parameter.partition(".")
    described = getattr(getattr(robot.equipment, section), name)
    residuals = [_about_a_line(batch) for _, stream in signals for batch in batches(stream)]
    if not residuals:
        return undetermined([parameter], "no standing stretch has this signal")[0]
    squares = float(sum((part**2).sum() for part in residuals))
    if squares < sum(part.size for part in residuals) * (NO_NOISE_SHARE * described) ** 2:
        return undetermined([parameter], "no noise at rest")[0]
    correlation = np.array([_correlation(residuals, lag) for lag in range(1, LAGS + 1)])
    # A line takes two samples' worth of white noise with it, and more of coloured noise.
    taken = 2 * max(1 + 2 * correlation.sum(), 1.0)
    dof = sum((len(part) - taken) * part.shape[1] for part in residuals)
    variance = squares / dof
    dof /= 1 + 2 * (correlation**2).sum()
    low, high = std_interval(variance, dof)
    step_variance = 0.0
    if parameter == "sensors.steering_std_rad":
        step = 2 * math.pi / robot.equipment.sensors.steering_steps_ratio
        step_variance = step**2 / 12
        if variance - step_variance < (MIN_NOISE_STEPS * step) ** 2:
            return undetermined([parameter], f"the noise hides below the encoder's step of {step:.2g} rad")[0]
    value, low, high = (math.sqrt(max(x - step_variance, 0.0)) for x in (variance, low**2, high**2))
    n = sum(len(stream) for _, stream in signals)
    runs = tuple(dict.fromkeys(run_id for run_id, _ in signals))
    return Finding(parameter, value, low, high, n, "samples", runs)


def _about_a_line(batch: Array) -> Array:
    """Return a batch (k, channels) without the straight line that fits each channel best."""
    x = np.linspace(-1.0, 1.0, len(batch))[:, None]
    centred = batch - batch.mean(axis=0)
    return np.asarray(centred - x * (x * centred).sum(axis=0) / (x**2).sum())


def _correlation(residuals: Sequence[Array], lag: int) -> float:
    """Return the autocorrelation over all batches and channels at one lag."""
    together = sum(float((part[lag:] * part[:-lag]).sum()) for part in residuals if len(part) > lag)
    return together / sum(float((part**2).sum()) for part in residuals)
