"""Settings of the traction controller (:mod:`terrain.control.traction`): defaults, checks, motor drivers."""

from __future__ import annotations

import math
from typing import NamedTuple

from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot


class TractionSettings(NamedTuple):
    """Settings; the defaults were tuned on simulated starts whose seeds are used nowhere else.

    Parameters
    ----------
    launch_mps : v_l; at 0.2 m/s a speed error of 1 cm/s is 5 % of slip
    lead_s, lead_max_mps2 : time by which q is extrapolated, and the largest acceleration used for it: the lag
        of the filter, the delay of the command and half the response time of a motor driver; the acceleration
        that 4 % of the weight gives
    balance_margin_ratio : least s* above the slip that balances steady motion
    gain_least_mps2 : a robot that is held back accelerates at least by this, or the floor of s* rises
    floor_rate_ratio : rate at which the floor rises, per second
    fade_mps2 : rate at which d approaches w while no correction can be made
    droop_radps_per_nm, droop_max_ratio, droop_time_s : reduction of a wheel's speed per torque above the
        mean; its limit as a fraction of the wheel's speed; time constant of its low-pass
    std_max_ratio, stale_max_s : slip that is more uncertain, or older, is not used; below one and a half
        launch speeds, and in a controlled braking, the error of the speed counts as at that speed
    brake_lead_s : age of the ground speed during a braking
    charge_mps_per_mps2, charge_time_s : what a motor driver's integral needs to carry the torque of a
        braking, as a speed by its proportional gain, and its time constant; see :func:`with_motor_driver`
    """

    launch_mps: float = 0.22
    lead_s: float = 0.15
    lead_max_mps2: float = 0.3
    balance_margin_ratio: float = 0.03
    gain_least_mps2: float = 0.25
    floor_rate_ratio: float = 0.15
    fade_mps2: float = 1.0
    droop_radps_per_nm: float = 0.02
    droop_max_ratio: float = 0.1
    droop_time_s: float = 1.5
    std_max_ratio: float = 0.025
    stale_max_s: float = 3.0
    brake_lead_s: float = 0.15
    charge_mps_per_mps2: float = 0.0
    charge_time_s: float = 0.2


SETTINGS = TractionSettings()


class TractionTarget(NamedTuple):
    """Slip to aim for on the current terrain.

    Parameters
    ----------
    traction_ratio : s*, from 0 to below 1
    braking_ratio : magnitude of the slip of a controlled braking
    braking_mps2 : deceleration at that slip; 0 leaves braking to the motor drivers
    margin_ratio : slip above the balance that gives the working pull; at least the settings' own is used
    """

    traction_ratio: float
    braking_ratio: float = 0.0
    braking_mps2: float = 0.0
    margin_ratio: float = 0.0


class WheelMeasurements(NamedTuple):
    """Estimated state of the wheels, each an array (wheels,) of floats, contiguous.

    Parameters
    ----------
    speed_mps, accel_mps2 : speed and acceleration over ground along each wheel as it is steered, of the
        filter
    slip_ratio, slip_std : slip, signed along the wheel, and its standard deviation
    torque_nm : of the motors, at the wheels, signed along the wheel; NaN where it is not known
    """

    speed_mps: Array
    accel_mps2: Array
    slip_ratio: Array
    slip_std: Array
    torque_nm: Array


def check_settings(settings: TractionSettings) -> TractionSettings:
    """Return settings that can be used, as floats.

    Raises
    ------
    ConfigError
        if one is not finite or is negative, or a time constant or the launch speed is zero.

    Examples
    --------
    >>> check_settings(SETTINGS._replace(lead_s=-0.1))
    Traceback (most recent call last):
    terrain.errors.ConfigError: traction: lead_s is -0.1, a number from zero up is required
    """
    for name, value in settings._asdict().items():
        least, accepted = (
            (1e-6, "above zero")
            if name in ("launch_mps", "droop_time_s", "charge_time_s")
            else (0.0, "from zero up")
        )
        if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value < math.inf:
            raise ConfigError(f"traction: {name} is {value!r}, a number {accepted} is required")
    return TractionSettings(*(float(value) for value in settings))


def with_motor_driver(settings: TractionSettings, robot: Robot) -> TractionSettings:
    """Return the settings with what a robot's motor drivers need to change their torque.

    A PI speed loop carries a change of torque T by its error until its integral has taken it over: an error
    of ``T / K_P`` with the time constant ``K_P / K_I``.  At a deceleration a, each of n wheels carries
    ``T = a m r / n``.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> round(with_motor_driver(SETTINGS, load_robot("agrimaro")).charge_mps_per_mps2, 3)
    0.1
    """
    motors = robot.equipment.motors
    torque = robot.mass_kg * robot.wheel_radius_m / len(robot.wheels)
    integral = motors.speed_integral_nmpr
    return settings._replace(
        charge_mps_per_mps2=torque / motors.speed_gain_nmspr * robot.wheel_radius_m,
        charge_time_s=motors.speed_gain_nmspr / integral if integral > 0 else 1e6,
    )
