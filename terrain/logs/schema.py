"""Names, units and signal sets of the channels of a run log.

A channel is named ``<quantity>_<place>_<unit>``: ``gyro_z_radps``, ``speed_left_mps``, ``current_3_a``.  The unit is
the last word; the quantity is the first and decides the signal set by which features are switched on and off.
"""

from __future__ import annotations

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, LogError

TIME_TOLERANCE_S = 1e-6
"""Stamps are compared to this; it covers the rounding of decimal stamps, far below any sample period."""

_SCALES: dict[str, dict[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3},
    "mps": {
        "m/s": 1.0,
        "cm/s": 1e-2,
        "mm/s": 1e-3,
        "km/h": 1.0 / 3.6,
        "mph": 0.44704,
        "knot": 1852.0 / 3600.0,
    },
    "mps2": {"m/s^2": 1.0, "mm/s^2": 1e-3, "g": GRAVITY_MPS2, "mg": 1e-3 * GRAVITY_MPS2},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295},
    "radps": {"rad/s": 1.0, "deg/s": 0.017453292519943295, "rpm": 0.10471975511965977},
    "a": {"A": 1.0, "mA": 1e-3},
    "v": {"V": 1.0, "mV": 1e-3, "kV": 1e3},
    "nm": {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3},
    "n": {"N": 1.0, "kN": 1e3},
    "ratio": {"1": 1.0, "%": 1e-2},
    "k": {"K": 1.0, "degC": 1.0, "degF": 5.0 / 9.0},
    "kg": {"kg": 1.0, "t": 1e3},
}
UNIT_SYMBOLS: dict[str, str] = {word: next(iter(units)) for word, units in _SCALES.items()}
UNIT_SYMBOLS |= {"m2": "m^2", "npr": "N/rad", "code": "-"}
"""Unit word at the end of a channel name, and how it is printed; ``code`` is the number of a status."""

UNIT_SCALES: dict[str, tuple[str, float]] = {
    unit: (word, factor) for word, units in _SCALES.items() for unit, factor in units.items()
}
"""Unit accepted in a mapping: the SI unit word it becomes, and the factor; ``g`` is standard gravity, ``t`` a tonne."""

UNIT_OFFSETS: dict[str, float] = {"degC": 273.15, "degF": 273.15 - 32.0 * 5.0 / 9.0}
"""What is added after the factor, where the zero of a unit is not that of the SI unit."""

_SPELLINGS = {
    "s": "sec, seconds",
    "ms": "msec",
    "us": "\u00b5s, \u03bcs",
    "m/s": "m s^-1, m/sec",
    "m/s^2": "m/s2, m/s\u00b2, m s^-2",
    "mm/s^2": "mm/s2, mm/s\u00b2",
    "km/h": "kmh, kph, km/hr",
    "knot": "knots, kn, kt, kts",
    "deg": "\u00b0, degree, degrees",
    "rad/s": "rad/sec",
    "deg/s": "\u00b0/s, deg/sec",
    "rpm": "1/min, r/min, U/min, RPM",
    "Nm": "N m, N*m, N\u00b7m",
    "degC": "\u00b0C",
    "degF": "\u00b0F",
    "%": "percent",
}
_ALIASES = {other: unit for unit, others in _SPELLINGS.items() for other in others.split(", ")}


def canonical_unit(unit: str) -> str:
    """Return a unit as :data:`UNIT_SCALES` spells it, however labs and instruments do; an unknown one as it is.

    Examples
    --------
    >>> canonical_unit("m/s\u00b2"), canonical_unit(" kmh "), canonical_unit("furlong")
    ('m/s^2', 'km/h', 'furlong')
    """
    text = unit.strip()
    return _ALIASES.get(text, text if text in UNIT_SCALES else unit)


def check_unit(place: str, unit: str, desired: str) -> None:
    """Raise ``ConfigError`` where a unit is unknown, or another than that of an SI unit word.

    Examples
    --------
    >>> check_unit("gyro_z_radps", "m", "radps")
    Traceback (most recent call last):
    terrain.errors.ConfigError: gyro_z_radps: unit 'm' does not suit it (accepted here: rad/s, deg/s, rpm)
    """
    unit = canonical_unit(unit)
    if UNIT_SCALES.get(unit, ("",))[0] != desired:
        fault = "does not suit it" if unit in UNIT_SCALES else "is unknown"
        suitable = ", ".join(name for name, (word, _) in UNIT_SCALES.items() if word == desired)
        raise ConfigError(f"{place}: unit {unit!r} {fault} (accepted here: {suitable})")


WHEELS_CHANNELS = (*(f"motor_{i}_radps" for i in (1, 2, 3)), *(f"current_{i}_a" for i in (1, 2, 3)))
"""Channels of the motor drivers of a swerve robot: motor rates and motor currents."""

STEERING_CHANNELS = tuple(f"angle_{i}_rad" for i in (1, 2, 3))  #: Channels of its steering encoders

IMU_CHANNELS = (
    *(f"gyro_{axis}_radps" for axis in "xyz"),
    *(f"accel_{axis}_mps2" for axis in "xyz"),
    *("roll_rad", "pitch_rad", "yaw_rad"),
)
"""Channels of an IMU that fuses its attitude; the accelerometer measures specific force."""

GNSS_CHANNELS = (
    *("position_x_m", "position_y_m", "velocity_x_mps", "velocity_y_mps"),
    *("std_position_m", "fix_ratio"),
)
"""Channels of a receiver: the antenna, east and north."""

POSE_CHANNELS = ("position_x_m", "position_y_m", "yaw_rad")
"""Of a stream of poses of the body's origin, in a frame that is fixed and right-handed."""

TWIST = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")  #: Of a stream of twists of the body

ESTIMATOR_CHANNELS = (*TWIST, "accel_x_mps2", "accel_y_mps2")
"""States of a filter that go into windows."""

ESTIMATED = ("estimator", "slip")
"""Streams that a filter adds to what is measured (:func:`terrain.estimation.estimate.enriched`)."""

SIGNAL_SETS: tuple[str, ...] = ("imu", "wheels", "currents", "slip", "estimator")
"""Groups of signals that can be switched off by name."""

NO_FEATURES = ("truth", "commands", "control", "odometry", "state", "lidar", "pose", "compass", "testbed")
"""Streams that no feature is made of."""

_SET_OF_QUANTITY = {"gyro": "imu", "accel": "imu", "speed": "wheels", "current": "currents", "slip": "slip"}


def check_signal_sets(names: tuple[str, ...]) -> tuple[str, ...]:
    """Raise ``ConfigError`` where no signal set is named, or one that is not known."""
    if not names:
        raise ConfigError(f"no signal set is named; there are {', '.join(SIGNAL_SETS)}")
    for name in names:
        if name not in SIGNAL_SETS:
            raise ConfigError(f"unknown signal set {name!r}; there are {', '.join(SIGNAL_SETS)}")
    return names


def unit_of(channel: str) -> str:
    """Return the SI unit word of a channel name, as ``mps2``; ``LogError`` where a name ends in none."""
    unit = channel.rpartition("_")[2]
    if unit not in UNIT_SYMBOLS:
        raise LogError(f"channel {channel!r} does not end in a known unit (one of {', '.join(UNIT_SYMBOLS)})")
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
    return stream if stream in ESTIMATED else _SET_OF_QUANTITY.get(channel.partition("_")[0])
