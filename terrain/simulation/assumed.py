"""What is assumed of a robot where its description has no figures: sections from geometry and mass.

With the mass m, the wheel radius r, the wheelbase L, n wheels that a motor turns each and k contacts with the ground::

    inertia        a box of the wheelbase and track with the wheels around them, m (l^2 + w^2) / 12; of a wheel and
                   its rotor a fifth of its share of the mass at its radius
    height         r + L / 10 of the centre of mass, in the middle of the contacts
    tyres          0.6 r wide, a contact as long (a roller's of r / 4), relaxed over half of it; they sag by 0.025 r
                   under m g / k, with 0.15 of the critical damping
    motors         a torque of m g r / n, which slips every wheel, times 1 + L / B with the track B of robots that skid,
                   which have to turn, too; the top speed of a Froude number v^2 / (g L) of 0.25,
                   that of a brisk walk; 3000 turns a minute there, at 5/6 of no load: k_t = V / w_0, with 24 V, from
                   100 kg on 48 V, and 400 V where that took over 500 A; a speed loop of 100 rad/s on a wheel that
                   spins freely, integrating over 0.2 s, which damps the robot by 0.7 to 1 of the critical damping, the
                   described ones by 0.7 to 1.2
    steering       2 rad/s, of a car-like robot as it is described
    sensors        those of a common MEMS unit and of encoders on the motors

Of the described robots of the package (0.04 to 0.2 m, 12 to 90 kg) inertias, tyres, torque, top speed and the torque of
an ampere are within a factor of two of these, dampers, friction and the gain of the speed loop within three.
"""

from __future__ import annotations

import math
from dataclasses import MISSING, replace
from typing import Any

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.robots import KIND_OF_SECTION, BicycleRobot, Robot, TrackedRobot
from terrain.simulation.contacts import TRACK_PATCHES, contacts_of

# That a simulation needs; a camera is on board or is not.
SECTIONS = ("body", "motors", "steering", "sensors")
SAG_RATIO, DAMPING_RATIO, FROUDE = 0.025, 0.15, 0.25
MOST_A = 500.0
ROTOR_SHARE, MOTOR_RADPS, NO_LOAD_RATIO, HEAVY_KG = 0.2, 314.0, 1.2, 100.0
FREE_RADPS, INTEGRAL_S = 100.0, 0.2
# Friction of motors and reductions over the largest torque, and noise of a current over the largest.
FRICTION_RATIO, CURRENT_STD_RATIO = 0.025, 0.005

_INSTRUMENTS = {
    "wheels_rate_hz": 50.0,
    "hall_steps_ratio": 1024.0,
    "encoder_time_constant_s": 0.0,
    "motor_std_radps": 0.2,
    "steering_rate_hz": 50.0,
    "steering_steps_ratio": 4096.0,
    "steering_std_rad": 0.001,
    "imu_rate_hz": 100.0,
    "imu_latency_s": 0.0,
    "gyro_std_radps": 0.002,
    "gyro_bias_std_radps": 0.002,
    "gyro_walk_radps": 0.0001,
    "accel_std_mps2": 0.02,
    "accel_bias_std_mps2": 0.02,
    "tilt_std_rad": 0.002,
    "yaw_std_rad": 0.002,
}


def with_assumed(robot: Robot) -> Robot:
    """Return a robot with all sections that a simulation needs; those that it lacks are in its ``assumed``.

    Examples
    --------
    >>> from terrain.robots import SkidSteerRobot
    >>> robot = with_assumed(SkidSteerRobot("mine", 0.165, 0.57, 0.512, 50.0))
    >>> round(robot.motors.torque_max_nm), round(robot.body.tyre_stiffness_npm), "body.com_x_m" in robot.assumed
    (77, 29717, True)
    """
    for name in SECTIONS:
        if robot.describes(name) or (name == "steering" and not robot.steered):
            continue
        kind = KIND_OF_SECTION[name]
        keys = kind.__dataclass_fields__
        defaults = {key: 0.0 if item.default is MISSING else item.default for key, item in keys.items()}
        values = defaults | _NUMBERS[name](robot)
        part: Any = kind(**{key: values[key] for key in keys})
        assumed = robot.assumed | {f"{name}.{key}" for key in keys}
        robot = replace(robot, parts={**robot.parts, name: part}, assumed=assumed)
    return robot


def _body(robot: Robot) -> dict[str, float]:
    """Return the numbers of the section ``body``."""
    radius_m, mass_kg, contacts = robot.wheel_radius_m, robot.mass_kg, contacts_of(robot)
    places_m = np.array([contact[1:3] for contact in contacts])
    com_x_m, com_y_m = places_m.mean(axis=0).tolist()
    length_m, width_m = np.ptp(places_m, axis=0) + 2.0 * radius_m
    share_kg, sag_m = mass_kg / len(contacts), SAG_RATIO * radius_m
    stiffness_npm = share_kg * GRAVITY_MPS2 / sag_m
    contact_m, tyre_m = (0.25 if robot.on_omni_wheels else 0.6) * radius_m, 0.6 * radius_m
    numbers = {
        "yaw_inertia_kgm2": mass_kg * (length_m**2 + width_m**2) / 12.0,
        "com_height_m": radius_m + 0.1 * robot.wheelbase_m,
        "contact_length_m": contact_m,
        "tyre_width_m": tyre_m,
    }
    if isinstance(robot, TrackedRobot):
        of_track = {
            "contact_length_m": robot.wheelbase_m / TRACK_PATCHES,
            "tyre_width_m": robot.track_width_m,
        }
        numbers |= of_track | {"com_height_m": robot.com_height_m}
    if isinstance(robot, BicycleRobot):
        com_x_m = robot.com_ahead_m
        numbers |= {"yaw_inertia_kgm2": robot.yaw_inertia_kgm2, "com_height_m": robot.com_height_m}
    return numbers | {
        "footprint_min_m": robot.track_m + numbers["tyre_width_m"],
        "footprint_max_m": robot.track_m + numbers["tyre_width_m"],
        "com_x_m": com_x_m,
        "com_y_m": com_y_m,
        "wheel_inertia_kgm2": ROTOR_SHARE * mass_kg / len(robot.wheels) * radius_m**2,
        "relaxation_length_m": numbers["contact_length_m"] / 2.0,
        "tyre_stiffness_npm": stiffness_npm,
        "tyre_damping_nspm": 2.0 * DAMPING_RATIO * math.sqrt(stiffness_npm * share_kg),
    }


def _motors(robot: Robot) -> dict[str, float]:
    """Return the numbers of the section ``motors``."""
    radius_m, n = robot.wheel_radius_m, len(robot.logged_wheels)
    torque_nm = robot.mass_kg * GRAVITY_MPS2 * radius_m / n
    if robot.skids:
        torque_nm *= 1.0 + robot.wheelbase_m / robot.track_m
    speed_mps = math.sqrt(FROUDE * GRAVITY_MPS2 * robot.wheelbase_m)
    speed_radps = getattr(robot, "speed_max_mps", speed_mps) / radius_m
    supply_v = 24.0 if robot.mass_kg < HEAVY_KG else 48.0
    if torque_nm * speed_radps > MOST_A * supply_v:
        supply_v = 400.0
    gain = FREE_RADPS * robot.body.wheel_inertia_kgm2
    # a log of rates of motors has those of the wheels where the description has no reduction
    ratio = MOTOR_RADPS / speed_radps
    reduction_ratio, behind = (1.0, ratio) if robot.by_motor else (ratio, 1.0)
    return {
        "reduction_ratio": reduction_ratio,
        "torque_constant_nmpa": behind * supply_v / (NO_LOAD_RATIO * MOTOR_RADPS),
        "efficiency_ratio": 0.75,
        "torque_max_nm": torque_nm,
        "supply_v": supply_v,
        "speed_max_radps": speed_radps,
        "torque_time_constant_s": 0.005,
        "friction_nm": FRICTION_RATIO * torque_nm,
        "speed_gain_nmspr": gain,
        "speed_integral_nmpr": gain / INTEGRAL_S,
        "speed_estimate_time_constant_s": 0.008,
    }


def _steering(robot: Robot) -> dict[str, float]:
    """Return the numbers of the section ``steering``."""
    rate_radps = robot.steering_rate_radps if isinstance(robot, BicycleRobot) else 2.0
    lag_s = robot.steering_time_constant_s if isinstance(robot, BicycleRobot) else 0.1
    accel_radps2 = rate_radps / max(lag_s, 0.01)
    return {
        "rate_max_radps": rate_radps,
        "accel_max_radps2": accel_radps2,
        "torque_max_nm": robot.motors.torque_max_nm,
    }


def _sensors(robot: Robot) -> dict[str, float]:
    """Return the numbers of the section ``sensors``."""
    most_a = robot.motors.torque_max_nm / robot.motors.nm_per_a
    own = {f"accel_scale_{axis}_ratio": 1.0 for axis in "xyz"} | {"current_std_a": CURRENT_STD_RATIO * most_a}
    if robot.by_motor and robot.reduction_ratio == 1.0:  # encoders on motors, stated behind the reduction
        ratio = MOTOR_RADPS / robot.motors.speed_max_radps
        own |= {"motor_std_radps": _INSTRUMENTS["motor_std_radps"] / ratio}
        own |= {"hall_steps_ratio": _INSTRUMENTS["hall_steps_ratio"] * ratio}
    return _INSTRUMENTS | own


_NUMBERS = {"body": _body, "motors": _motors, "steering": _steering, "sensors": _sensors}
