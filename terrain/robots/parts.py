"""Sections of a robot's description: body, motors, steering, camera and sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, NamedTuple, TypeAlias

Signed = Annotated[float, -math.inf]
"""A number of a description that may have any value; a plain ``float`` has to be above zero."""

NotNegative = Annotated[float, 0.0]
"""A number that may be zero."""


@dataclass(frozen=True, slots=True)
class Body:
    """Masses, tyres, and how far the track can be adjusted."""

    footprint_min_m: float
    footprint_max_m: float
    tyre_width_m: float
    yaw_inertia_kgm2: float
    com_x_m: Signed
    com_y_m: Signed
    com_height_m: NotNegative
    wheel_inertia_kgm2: float
    contact_length_m: float
    relaxation_length_m: float
    tyre_stiffness_npm: float
    tyre_damping_nspm: float


@dataclass(frozen=True, slots=True)
class Motors:
    """Motors behind a reduction, and the speed loop of the motor drivers; torques and gains at the wheel."""

    reduction_ratio: float
    torque_constant_nmpa: float
    efficiency_ratio: float
    torque_max_nm: float
    supply_v: float
    speed_max_radps: float
    torque_time_constant_s: NotNegative
    friction_nm: NotNegative
    speed_gain_nmspr: float
    speed_integral_nmpr: NotNegative
    speed_estimate_time_constant_s: NotNegative


@dataclass(frozen=True, slots=True)
class Steering:
    """Steering of each wheel: its limits, its dead band, and the zero of its encoder."""

    rate_max_radps: float
    accel_max_radps2: float
    dead_band_rad: NotNegative
    torque_max_nm: float
    zero_1_rad: Signed
    zero_2_rad: Signed
    zero_3_rad: Signed


@dataclass(frozen=True, slots=True)
class Camera:
    """Tracking camera: where it is mounted on the body, and the errors of its pose stream."""

    lever_x_m: Signed
    lever_y_m: Signed
    lever_z_m: Signed
    rate_hz: float
    latency_s: NotNegative
    time_constant_s: NotNegative
    speed_std_mps: float
    yaw_rate_std_radps: float
    yaw_std_rad: float
    position_std_m: float
    dropout_rate_hz: NotNegative
    dropout_length_s: float
    jump_rate_hz: NotNegative
    jump_std_m: NotNegative


@dataclass(frozen=True, slots=True)
class Sensors:
    """Rates, noise, bias and delay of all sensors but the camera.

    ``*_std`` are standard deviations of a sample while the robot stands still; ``*_bias_std`` of a bias from
    one power-on to the next; ``*_walk`` the random walk of a bias (per root second).
    """

    wheels_rate_hz: float
    hall_steps_ratio: float
    encoder_time_constant_s: NotNegative
    motor_std_radps: float
    current_std_a: float
    steering_rate_hz: float
    steering_steps_ratio: float
    steering_std_rad: float
    imu_rate_hz: float
    imu_latency_s: NotNegative
    gyro_std_radps: float
    gyro_bias_x_radps: Signed
    gyro_bias_y_radps: Signed
    gyro_bias_z_radps: Signed
    gyro_bias_std_radps: NotNegative
    gyro_walk_radps: NotNegative
    accel_std_mps2: float
    accel_bias_x_mps2: Signed
    accel_bias_y_mps2: Signed
    accel_bias_z_mps2: Signed
    accel_bias_std_mps2: NotNegative
    accel_scale_x_ratio: float
    accel_scale_y_ratio: float
    accel_scale_z_ratio: float
    tilt_std_rad: float
    yaw_std_rad: float


Part: TypeAlias = Body | Motors | Steering | Camera | Sensors
"""Any section of a description."""


class Equipment(NamedTuple):
    """Every section of a description."""

    body: Body
    motors: Motors
    steering: Steering
    camera: Camera
    sensors: Sensors


KIND_OF_SECTION: Mapping[str, type[Part]] = {
    "body": Body,
    "motors": Motors,
    "steering": Steering,
    "camera": Camera,
    "sensors": Sensors,
}
"""What each section of a description is read into, by its key in the file."""

IDENTIFIED: Mapping[str, float | None] = {
    "rolling_radius_m": None,
    "effective_track_m": None,
    "lidar_delay_s": -math.inf,
    "wheels_delay_s": -math.inf,
    "wheel_distance_m": None,
}
"""Numbers of the section ``identified``, which logs of one robot showed and no nominal figure is: the least
value of each, None for above zero (:mod:`terrain.calibration.skid_steer`,
:mod:`terrain.calibration.omni`)."""
