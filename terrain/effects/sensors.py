"""Effects of sensors and clocks: bias, scale, mounting, latency, lag."""

from __future__ import annotations

from terrain.effects.types import (
    ACCEL,
    CURRENT,
    EVERY,
    GYRO,
    HEADING,
    MOTION,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
    WITH_IMU,
    Combine,
    Effect,
    Home,
    Inverse,
    Parameter,
    PlantPart,
    Wording,
)
from terrain.effects.wheels import KINEMATICS

OTHER_LOGGER = ("imu", "odometry", "gnss", "lidar")
"""Streams that are not stamped by the logger of the wheels."""

SENSORS: tuple[Effect, ...] = (
    Effect(
        "gyro_bias",
        (
            # 3 deg/s, the zero error of MEMS gyros as data sheets have it (Bosch BMI055: 1 deg/s)
            Parameter(
                "gyro_bias_radps",
                -0.05,
                0.05,
                0.001,
                homes=(Home("sensors", "gyro_bias_z_radps", Combine.ADDED),),
                inverse=Inverse(("imu",), "gyro - b where the description has no home; fused yaw - b t"),
                scatter_rank=1,
            ),
        ),
        "gyro = w + b",
        "IEEE Std 952",
        WITH_IMU,
        (GYRO,),
        "standstill; several runs, since every power-on has a bias of its own",
        sensed_only=True,
        plant=PlantPart.DESCRIPTION,
    ),
    Effect(
        "gyro_scale",
        (
            # data sheets of MEMS gyros have 1 to 4 %; a part that is off by more than 15 % is broken
            Parameter(
                "gyro_scale_ratio",
                -0.15,
                0.15,
                0.01,
                inverse=Inverse(("imu",), "(gyro - bias) / (1 + k) + bias; fused yaw / (1 + k)"),
                as_percent=True,
                is_error=True,
            ),
        ),
        "gyro = (1 + k) w",
        "IEEE Std 952",
        WITH_IMU,
        (GYRO,),
        "turns, and an absolute heading on a skid-steer robot",
        sensed_only=True,
        plant=PlantPart.SENSORS,
        twins=(("effective_track", HEADING),),
        wording=Wording.GYRO_SCALE,
    ),
    Effect(
        "accel_bias",
        (
            Parameter(
                "accel_bias_mps2",
                -2.0,
                2.0,
                0.02,
                homes=(Home("sensors", "accel_bias_x_mps2", Combine.ADDED, scaled_by="accel_scale_x_ratio"),),
                inverse=Inverse(("imu",), "accelerometer - b", without_home=True),
                scatter_rank=2,
            ),
        ),
        "accelerometer = a_x + g sin th + b",
        "IEEE Std 1293",
        WITH_IMU,
        (ACCEL,),
        "several runs, since every power-on has a bias of its own",
        sensed_only=True,
        plant=PlantPart.DESCRIPTION,
        aliases=("accelerometer_mounting_pitch",),
    ),
    Effect(
        "imu_latency",
        (
            # as much of it and of camera_latency is a clock_offset: logs determine two of the three
            Parameter(
                "imu_latency_s",
                0.0,
                0.5,
                0.005,
                homes=(Home("sensors", "imu_latency_s", Combine.ADDED),),
                inverse=Inverse(("imu",), "stamp t - T", without_home=True),
            ),
        ),
        "gyro, accelerometer and tilt(t) = what they measure at t - T",
        "pure delay; the samples of one IMU arrive together",
        WITH_IMU,
        (GYRO, ACCEL),
        "steps of the yaw rate, and a camera that is not late",
        plant=PlantPart.DESCRIPTION,
        wording=Wording.LATE,
        late=("the IMU", "the IMU"),
    ),
    Effect(
        "camera_latency",
        (
            # measured: 0.16 s (Husky) and 0.3 to 0.5 s (Warthog), poses of a lidar's scans, DRIVE
            Parameter(
                "camera_latency_s", 0.0, 1.0, 0.005, homes=(Home("camera", "latency_s", Combine.ADDED),)
            ),
        ),
        "camera(t) = what it sees at t - T",
        "pure delay",
        EVERY,
        (SPEED_X, SPEED_Y, HEADING),
        "accelerations at two frequencies",
        sensed_only=True,
        plant=PlantPart.DESCRIPTION,
        wording=Wording.LATE,
        late=("the camera or lidar", "the camera or lidar"),
    ),
    Effect(
        "camera_yaw",
        (
            Parameter(
                "camera_yaw_rad",
                -0.3,
                0.3,
                0.005,
                inverse=Inverse(
                    ("odometry", "lidar", "pose"), "R(a) of what the camera measured; yaw of a pose + a"
                ),
            ),
        ),
        "camera = R(-a) (v_x, v_y): mounted turned to the left by -a, v_y grows by a v",
        KINEMATICS,
        EVERY,
        (SPEED_X, SPEED_Y),
        "straight, on more than one side slope",
        sensed_only=True,
        plant=PlantPart.SENSORS,
        wording=Wording.CAMERA_YAW,
    ),
    Effect(
        "lever_arm",
        tuple(
            Parameter(
                f"lever_{axis}_m",
                -1.0,
                1.0,
                0.02,
                homes=(Home("camera", f"lever_{axis}_m", Combine.ADDED),),
                is_error=True,
            )
            for axis in ("x", "y")
        ),
        "v_x - l_y w, v_y + l_x w at the camera",
        KINEMATICS,
        EVERY,
        (SPEED_X, SPEED_Y),
        "turns to both sides",
        sensed_only=True,
        plant=PlantPart.DESCRIPTION,
        wording=Wording.MEASURED_POINT,
    ),
    Effect(
        "clock_offset",
        (Parameter("clock_offset_s", -0.5, 0.5, 0.005, inverse=Inverse(OTHER_LOGGER, "stamp t' - T")),),
        "IMU and camera stamp t' = t + T; wheels, currents and steering t: for T < 0 these are the late ones",
        "two loggers without a common clock",
        WITH_IMU,
        (*MOTION, HEADING),
        "switching manoeuvres",
        plant=PlantPart.SENSORS,
        wording=Wording.LATE,
        late=("the other sensors logged", "the wheels logged"),
    ),
    Effect(
        "clock_rate",
        (
            Parameter(
                "clock_rate_ratio",
                -0.02,
                0.02,
                0.0005,
                inverse=Inverse(OTHER_LOGGER, "stamp t' / (1 + r), from the first stamp of the wheels"),
                as_percent=True,
                is_error=True,
            ),
        ),
        "IMU and camera stamp t' = (1 + r) t",
        "two loggers without a common clock",
        WITH_IMU,
        (*MOTION, HEADING),
        "switching manoeuvres from the start of a run to its end",
        plant=PlantPart.SENSORS,
    ),
    Effect(
        "encoder_lag",
        (
            Parameter(
                "encoder_lag_s",
                0.0,
                0.5,
                0.005,
                homes=(Home("sensors", "encoder_time_constant_s", Combine.ADDED),),
            ),
        ),
        "T d(measured)/dt + measured = wheel rate",
        "first-order low-pass",
        WITH_IMU,
        (*MOTION, CURRENT, TURNING_CURRENT, HEADING),
        "accelerations",
        plant=PlantPart.DESCRIPTION,
    ),
)
"""They change what a log holds of a motion; most of them nothing else."""
