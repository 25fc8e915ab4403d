"""Signals of a DBC by the channel that each becomes; a DBC with these names is read, whatever its frames.

A frame is eight bytes, so that the channels of a stream come in several; those with equal ``Counter`` are of
one instant.
"""

from __future__ import annotations

from collections.abc import Mapping

from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.logs.replay import TWIST
from terrain.logs.schema import IMU_CHANNELS, STEERING_CHANNELS, WHEELS_CHANNELS

COUNTER, CRC = "Counter", "Crc8"
"""Signals that any message may have: rises by one a sample; CRC-8 over identifier and data."""

_AXES = ("X", "Y", "Z")


def _named(channels: tuple[str, ...], *names: str) -> dict[str, str]:
    return dict(zip(channels, names, strict=True))


SIGNALS: Mapping[str, Mapping[str, str]] = {
    "wheels": _named(
        WHEELS_CHANNELS, *(f"{quantity}{i}" for quantity in ("MotorRate", "MotorCurrent") for i in (1, 2, 3))
    ),
    "steering": _named(STEERING_CHANNELS, *(f"SteeringAngle{i}" for i in (1, 2, 3))),
    "imu": _named(
        IMU_CHANNELS,
        *(f"{quantity}{axis}" for quantity in ("Gyro", "Accel") for axis in _AXES),
        *("Roll", "Pitch", "Yaw"),
    ),
    "odometry": _named(
        CAMERA_CHANNELS,
        *(f"CameraPosition{axis}" for axis in _AXES),
        *(f"CameraQuaternion{axis}" for axis in (*_AXES, "W")),
        *(f"CameraVelocity{axis}" for axis in _AXES),
        *(f"CameraRate{axis}" for axis in _AXES),
        "CameraConfidence",
    ),
    "twist": _named(TWIST, "DesiredSpeedX", "DesiredSpeedY", "DesiredYawRate"),
    "corrections": {f"correction_{i}_radps": f"Correction{i}" for i in (1, 2, 3)},
    "status": {
        "terrain_code": "TerrainCode",
        "probability_ratio": "TerrainProbability",
        "target_ratio": "TargetSlip",
        "status_code": "ControlStatus",
        "bridge_code": "BridgeState",
        "sensor_code": "SensorCode",
        "health_code": "SensorHealth",
    },
}
"""Signal of each channel, by stream."""

SENSORS = ("wheels", "steering", "imu", "odometry")
"""Streams that are measured."""

RECEIVED = (*SENSORS, "twist")
"""Streams that the bridge receives; it sends the others."""

OPTIONAL = frozenset(
    channel for channel in CAMERA_CHANNELS if channel.startswith(("position", "confidence"))
) | frozenset(SIGNALS["status"])
"""Channels that no controller needs: a DBC may lack them."""


def channels_of(stream: str) -> tuple[str, ...]:
    """Return the channels of a stream, in the order of its columns.

    Examples
    --------
    >>> channels_of("twist")
    ('speed_x_mps', 'speed_y_mps', 'yaw_rate_radps')
    """
    return tuple(SIGNALS[stream])
