"""Settings of path tracking (:mod:`terrain.control.path_tracking`), and whether its loops are stable."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from terrain.control.pid import LONGEST_STEP_S
from terrain.control.stability import DELAY_S, SAMPLE_TIME_S, spectral_radius
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot

MOVING_MPS = 0.05
"""From this speed on a motion has a direction."""

N_SPEEDS = 12


class TrackSettings(NamedTuple):
    """Gains and limits of path tracking; tuned on simulated drives whose seeds are used nowhere else.

    Parameters
    ----------
    arm_m : L; half the wheelbase, so that a correction of the heading is that angle of the steering
    heading_pm, heading_integral_pm2 : k and k_I of the heading, rad of steering per m of L times heading
    cross_pm, cross_integral_pm2 : the same per m of cross-track error; slower, as it is less urgent
    heading_max_rad : clamp, as a steering angle: four times the backlash
    cross_max_rad : the same; a side slope of 5 degrees on grass takes 0.2, which no backlash does
    heading_fastest_ps, cross_fastest_ps : bandwidths above which the delays would matter
    lag_s : from a desired twist to the estimated motion: delay, speed loop, steering and filter
    yaw_std_max_rad : a heading that is less certain is not used; it is compared with changes of the heading,
        which are known better
    stale_max_s : without a measured speed over ground for longer, the position is not used
    """

    arm_m: float = 0.5075
    heading_pm: float = 3.0
    heading_integral_pm2: float = 0.7
    cross_pm: float = 1.0
    cross_integral_pm2: float = 0.2
    heading_max_rad: float = 0.08
    cross_max_rad: float = 0.3
    heading_fastest_ps: float = 3.0
    cross_fastest_ps: float = 1.5
    lag_s: float = 0.15
    yaw_std_max_rad: float = 0.1
    stale_max_s: float = 3.0


SETTINGS = TrackSettings()


def check_tracking(
    robot: Robot, settings: TrackSettings = SETTINGS, delay_s: float = DELAY_S, *, dt_s: float = SAMPLE_TIME_S
) -> TrackSettings:
    """Return settings that can be used, as floats.

    Parameters
    ----------
    robot : with its sections
    settings : to check
    delay_s : from the estimate to the wheels, beside the filter's lag
    dt_s : sample time

    Raises
    ------
    ConfigError
        if a setting is negative or not finite, one other than a gain or the lag is 0, or a loop is unstable
        at some speed of the robot.

    Notes
    -----
    Heading and position each, in metres x, behind the filter y, with the steering s and the side force f,
    both first-order lags, at speed v; the command u is held from sample to sample and is delayed::

        x' = v f,  f' = (s - f) v / sigma,  s' = (u - s) / tau_s,  y' = (x - y) / tau_encoder

    ``tau_s`` is half the time in which the steering's acceleration crosses its backlash.  The position
    follows the heading and not the reverse, so the loops are checked one by one.  Backlash is not modelled.
    With the default delay and integral, AgriMaRo's heading is stable up to a bandwidth of 9 rad/s; 3 is set.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> check_tracking(load_robot("agrimaro")) == SETTINGS
    True
    >>> check_tracking(load_robot("agrimaro"), SETTINGS._replace(heading_pm=12.0, heading_fastest_ps=12.0))
    Traceback (most recent call last):
    terrain.errors.ConfigError: path tracking: heading_pm 12 and heading_integral_pm2 0.7 with a delay of
    0.05 s are unstable from 1.02 to 2 m/s
    """
    for name, value in settings._asdict().items():
        zero = name in ("lag_s",) or "integral" in name or name.endswith("_pm")
        valid = not isinstance(value, bool) and isinstance(value, int | float) and math.isfinite(value)
        if not valid or not (value >= 0.0 if zero else value > 0.0):
            accepted = "a number from zero up" if zero else "a number above zero"
            raise ConfigError(f"path tracking: {name} is {value!r}, {accepted} is required")
    for name, value, least in (("delay_s", delay_s, 0.0), ("dt_s", dt_s, 1e-3)):
        if not least <= value <= LONGEST_STEP_S:
            raise ConfigError(
                f"path tracking: {name} is {value!r}, {least:g} to {LONGEST_STEP_S:g} s is required"
            )
    fastest_mps = robot.wheel_radius_m * robot.equipment.motors.speed_max_radps
    speeds_mps = np.geomspace(MOVING_MPS, fastest_mps, N_SPEEDS).tolist()
    for loop in ("heading", "cross"):
        k, k_i = getattr(settings, f"{loop}_pm"), getattr(settings, f"{loop}_integral_pm2")
        fastest_ps = getattr(settings, f"{loop}_fastest_ps")
        gains = (k, k_i, fastest_ps)
        radii = [spectral_radius(_loop_matrix(robot, gains, delay_s, dt_s, speed)) for speed in speeds_mps]
        bad = [speed for speed, radius in zip(speeds_mps, radii, strict=True) if radius >= 1.0 + 1e-9]
        if bad:
            raise ConfigError(
                f"path tracking: {loop}_pm {k:g} and {loop}_integral_pm2 {k_i:g} with a delay of "
                f"{delay_s:g} s are unstable from {bad[0]:.3g} to {bad[-1]:.3g} m/s"
            )
    return TrackSettings(*(float(value) for value in settings))


def _loop_matrix(
    robot: Robot, gains: tuple[float, float, float], delay_s: float, dt_s: float, speed_mps: float
) -> Array:
    """Return the loop from sample to sample: x, f, s, y, the integral, the delayed commands."""
    body, _, steering, _, sensors = robot.equipment
    n_delayed = max(math.ceil(delay_s / dt_s - 1e-9), 1)
    plant = np.zeros((5, 5))  # the fifth is the command, held
    plant[0, 1] = speed_mps
    plant[1, [2, 1]] = np.array([1.0, -1.0]) * speed_mps / body.relaxation_length_m
    steering_s = max(math.sqrt(steering.dead_band_rad / steering.accel_max_radps2), 1e-3)
    plant[2, [4, 2]] = np.array([1.0, -1.0]) / steering_s
    plant[3, [0, 3]] = np.array([1.0, -1.0]) / max(sensors.encoder_time_constant_s, 1e-3)
    over = expm(plant * dt_s)
    k, k_i, fastest_ps = gains
    slower = min(1.0, fastest_ps / max(k * speed_mps, 1e-9))
    one, loop = np.eye(5 + n_delayed), np.zeros((5 + n_delayed, 5 + n_delayed))
    loop[:4, :4] = over[:4, :4]
    loop[:4] += np.outer(over[:4, 4], one[-1])
    loop[4] = one[4] - slower * k_i * speed_mps * dt_s * one[3]
    loop[5] = loop[4] - slower * k * one[3]
    loop[6:] = one[5:-1]
    return loop
