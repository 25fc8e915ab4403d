"""Signals of a DBC by the channel that each becomes; a DBC with these names is read, whatever its frames.

A frame is eight bytes, so that the channels of a stream come in several; those with equal ``Counter`` are of
one instant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from terrain.angles import wrapped
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.logs.replay import TWIST
from terrain.logs.schema import IMU_CHANNELS, STEERING_CHANNELS, WHEELS_CHANNELS

COUNTER, CRC = "Counter", "Crc8"
"""Signals that any message may have: rises by one a sample; CRC-8 over identifier and data."""

_AXES = ("X", "Y", "Z")
_TURNING = ("steering", "imu")


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
    (*(f"position_{axis}_m" for axis in "xyz"), "quaternion_w_ratio", "confidence_ratio", *SIGNALS["status"])
)
"""Channels that no controller needs, or that follow from others: a DBC may lack them."""

QUATERNION = tuple(CAMERA_CHANNELS.index(f"quaternion_{part}_ratio") for part in "xyzw")
"""Columns of the camera's quaternion; a real part that the DBC lacks is the one that is not negative."""

_LONGEST = 1.02
"""Square of the length of a vector part that rounding can explain."""


def channels_of(stream: str) -> tuple[str, ...]:
    """Return the channels of a stream, in the order of its columns.

    Examples
    --------
    >>> channels_of("twist")
    ('speed_x_mps', 'speed_y_mps', 'yaw_rate_radps')
    """
    return tuple(SIGNALS[stream])


def real_part(x: float, y: float, z: float) -> float:
    """Return the real part, not negative, of the unit quaternion with a vector part; NaN where there is none.

    Examples
    --------
    >>> real_part(0.6, 0.0, 0.0), real_part(1.0, 0.0, 0.001), real_part(1.0, 1.0, 0.0)
    (0.8, 0.0, nan)
    """
    square = x * x + y * y + z * z
    return math.sqrt(max(1.0 - square, 0.0)) if square <= _LONGEST else math.nan


def as_sent(stream: str, values: Sequence[float]) -> list[float]:
    """Return the values of a sample as they are sent: angles within half a turn, a real part not negative.

    Parameters
    ----------
    stream : one of :data:`SIGNALS`
    values : of all its channels, SI

    Examples
    --------
    >>> as_sent("steering", [3.5, 0.25, math.nan])
    [-2.7831853071795862, 0.25, nan]
    """
    sent = [float(value) for value in values]
    for column, channel in enumerate(SIGNALS[stream]):
        if stream in _TURNING and channel.endswith("_rad") and math.isfinite(sent[column]):
            sent[column] = float(wrapped(sent[column]))
    if stream == "odometry" and sent[QUATERNION[3]] < 0.0:
        for column in QUATERNION:
            sent[column] = -sent[column]
    return sent
