"""Names, units and signal sets of the channels of a run log.

A channel is named ``<quantity>_<place>_<unit>``: ``gyro_z_radps``, ``speed_left_mps``, ``current_3_a``.
The unit is the last word; the quantity is the first and decides the signal set by which features are
switched on and off.
"""

from __future__ import annotations

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, LogError

SCHEMA_VERSION = 1

TIME_TOLERANCE_S = 1e-6
"""Stamps are compared to this; it covers the rounding of decimal stamps, far below any sample period."""

UNIT_SYMBOLS: dict[str, str] = {
    "s": "s",
    "m": "m",
    "m2": "m^2",
    "mps": "m/s",
    "mps2": "m/s^2",
    "rad": "rad",
    "radps": "rad/s",
    "a": "A",
    "v": "V",
    "nm": "Nm",
    "n": "N",
    "npr": "N/rad",
    "ratio": "1",
    "code": "-",
    "k": "K",
    "kg": "kg",
}
"""Unit word at the end of a channel name, and how it is printed; ``code`` is the number of a status."""

UNIT_SCALES: dict[str, tuple[str, float]] = {
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "km": ("m", 1e3),
    "m/s": ("mps", 1.0),
    "cm/s": ("mps", 1e-2),
    "mm/s": ("mps", 1e-3),
    "km/h": ("mps", 1.0 / 3.6),
    "mph": ("mps", 0.44704),
    "m/s^2": ("mps2", 1.0),
    "mm/s^2": ("mps2", 1e-3),
    "g": ("mps2", GRAVITY_MPS2),
    "mg": ("mps2", 1e-3 * GRAVITY_MPS2),
    "rad": ("rad", 1.0),
    "mrad": ("rad", 1e-3),
    "deg": ("rad", 0.017453292519943295),
    "rad/s": ("radps", 1.0),
    "deg/s": ("radps", 0.017453292519943295),
    "rpm": ("radps", 0.10471975511965977),
    "A": ("a", 1.0),
    "mA": ("a", 1e-3),
    "V": ("v", 1.0),
    "mV": ("v", 1e-3),
    "kV": ("v", 1e3),
    "Nm": ("nm", 1.0),
    "mNm": ("nm", 1e-3),
    "kNm": ("nm", 1e3),
    "N": ("n", 1.0),
    "kN": ("n", 1e3),
    "1": ("ratio", 1.0),
    "%": ("ratio", 1e-2),
    "K": ("k", 1.0),
    "degC": ("k", 1.0),
    "degF": ("k", 5.0 / 9.0),
    "kg": ("kg", 1.0),
    "t": ("kg", 1e3),
}
"""Unit accepted in a mapping file: the SI unit word it becomes, and the factor.

``g`` is standard gravity, ``t`` a tonne."""

UNIT_OFFSETS: dict[str, float] = {"degC": 273.15, "degF": 273.15 - 32.0 * 5.0 / 9.0}
"""What is added after the factor, where the zero of a unit is not that of the SI unit."""

UNIT_ALIASES: dict[str, str] = {
    "sec": "s",
    "seconds": "s",
    "msec": "ms",
    "\u00b5s": "us",
    "\u03bcs": "us",
    "m/s2": "m/s^2",
    "m/s\u00b2": "m/s^2",
    "m s^-2": "m/s^2",
    "mm/s2": "mm/s^2",
    "mm/s\u00b2": "mm/s^2",
    "kmh": "km/h",
    "kph": "km/h",
    "km/hr": "km/h",
    "m s^-1": "m/s",
    "m/sec": "m/s",
    "\u00b0": "deg",
    "degree": "deg",
    "degrees": "deg",
    "\u00b0/s": "deg/s",
    "deg/sec": "deg/s",
    "rad/sec": "rad/s",
    "1/min": "rpm",
    "r/min": "rpm",
    "U/min": "rpm",
    "RPM": "rpm",
    "N m": "Nm",
    "N*m": "Nm",
    "N\u00b7m": "Nm",
    "\u00b0C": "degC",
    "\u00b0F": "degF",
    "percent": "%",
}
"""Other spellings of units, as labs and instruments write them."""


def canonical_unit(unit: str) -> str:
    """Return a unit as :data:`UNIT_SCALES` spells it; one that is unknown as it is.

    Examples
    --------
    >>> canonical_unit("m/s\u00b2"), canonical_unit(" kmh "), canonical_unit("furlong")
    ('m/s^2', 'km/h', 'furlong')
    """
    text = unit.strip()
    return UNIT_ALIASES.get(text, text if text in UNIT_SCALES else unit)


WHEELS_CHANNELS: tuple[str, ...] = (
    *(f"motor_{i}_radps" for i in (1, 2, 3)),
    *(f"current_{i}_a" for i in (1, 2, 3)),
)
"""Channels of the motor drivers of a swerve robot: motor rates and motor currents."""

STEERING_CHANNELS: tuple[str, ...] = tuple(f"angle_{i}_rad" for i in (1, 2, 3))
"""Channels of its steering encoders."""

IMU_CHANNELS: tuple[str, ...] = (
    *(f"gyro_{axis}_radps" for axis in "xyz"),
    *(f"accel_{axis}_mps2" for axis in "xyz"),
    *("roll_rad", "pitch_rad", "yaw_rad"),
)
"""Channels of an IMU that fuses its attitude; the accelerometer tells specific force."""

GNSS_CHANNELS: tuple[str, ...] = (
    *("position_x_m", "position_y_m", "velocity_x_mps", "velocity_y_mps"),
    *("std_position_m", "fix_ratio"),
)
"""Channels of a receiver: the antenna, east and north."""

POSE_CHANNELS: tuple[str, ...] = ("position_x_m", "position_y_m", "yaw_rad")
"""Of a stream of poses of the body's origin, in a frame that is fixed and right-handed."""

ESTIMATOR_CHANNELS: tuple[str, ...] = (
    *("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2"),
)
"""States of a filter that go into windows."""

ESTIMATED = ("estimator", "slip")
"""Streams that a filter adds to what is measured (:func:`terrain.estimation.enriched.enriched`)."""

SIGNAL_SETS: tuple[str, ...] = ("imu", "wheels", "currents", "slip", "estimator")
"""Groups of signals that can be switched off by name."""


def check_signal_sets(names: tuple[str, ...]) -> tuple[str, ...]:
    """Raise ``ConfigError`` where no signal set is named, or one that is not known."""
    if not names:
        raise ConfigError(f"no signal set is named; there are {', '.join(SIGNAL_SETS)}")
    for name in names:
        if name not in SIGNAL_SETS:
            raise ConfigError(f"unknown signal set {name!r}; there are {', '.join(SIGNAL_SETS)}")
    return names


NO_FEATURES: tuple[str, ...] = (
    *("truth", "commands", "control", "odometry", "state", "lidar", "pose", "compass", "testbed"),
)
"""Streams that no feature is made of."""

_SET_OF_QUANTITY: dict[str, str] = {
    "gyro": "imu",
    "accel": "imu",
    "speed": "wheels",
    "current": "currents",
    "slip": "slip",
}
_SET_OF_STREAM: dict[str, str] = {"estimator": "estimator", "slip": "slip"}


def unit_of(channel: str) -> str:
    """Return the SI unit word of a channel name.

    Raises
    ------
    LogError
        if the name does not end in a known unit.

    Examples
    --------
    >>> unit_of("accel_z_mps2")
    'mps2'
    """
    unit = channel.rpartition("_")[2]
    if unit not in UNIT_SYMBOLS:
        known = ", ".join(UNIT_SYMBOLS)
        raise LogError(f"channel {channel!r} does not end in a known unit (one of {known})")
    return unit


def signal_set_of(stream: str, channel: str) -> str | None:
    """Return the signal set a channel belongs to, None when no feature is made of it.

    Examples
    --------
    >>> signal_set_of("wheels", "current_left_a"), signal_set_of("truth", "speed_x_mps")
    ('currents', None)
    """
    if stream in NO_FEATURES:
        return None
    return _SET_OF_STREAM.get(stream) or _SET_OF_QUANTITY.get(channel.partition("_")[0])
