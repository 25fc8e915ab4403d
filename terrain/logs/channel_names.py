"""Names of channels: whether a feature is made of them, and which known name a misspelt one is near to."""

from __future__ import annotations

import difflib
import math

from terrain.errors import LogError
from terrain.logs.checks import Check, Level
from terrain.logs.schema import NO_FEATURES, signal_set_of, unit_of
from terrain.records import Stream

FEATURE_UNITS: dict[str, str] = {
    "gyro": "radps",
    "accel": "mps2",
    "speed": "mps",
    "current": "a",
}
"""Unit of each quantity that features are made of by name."""

IMU = ("gyro", "accel")

OTHER_QUANTITIES: tuple[str, ...] = (
    *("motor", "angle", "roll", "pitch", "yaw", "voltage", "position", "velocity", "quaternion", "rate"),
    *("std", "fix", "confidence", "torque", "temperature", "wheel", "steer", "status", "force", "load"),
    *(
        "sinkage",
        "slip",
        "traction",
        "side",
        "normal",
        "heading",
        "power",
        "pressure",
        "magnetic",
        "height",
        "tick",
        "pulse",
    ),
)
"""Quantities that logs have and no feature is made of."""

AXES = ("x", "y", "z")

NEAR = 0.75
"""Similarity (:mod:`difflib`) from which a name is taken for a misspelt one: two letters that changed places
in ``gyor`` make 0.75, and no two known quantities are nearer than 0.67."""


def check_names(name: str, stream: Stream) -> list[Check]:
    """Return what is odd about the names of a stream's channels; one ok where nothing is.

    Examples
    --------
    >>> [check] = check_names("imu", Stream([0.0, 1.0], [[0.0], [0.0]], ("gyor_z_radps",)))
    >>> check.sentence
    "channel 'gyor_z_radps' of stream 'imu': no feature is made of 'gyor'; is it 'gyro_z_radps'?"
    """
    if name in NO_FEATURES or name in ("estimator", "slip"):
        return [_check(Level.OK, name, f"stream {name!r}: no feature is made of its channels by name")]
    found = [check for channel in stream.channels if (check := _odd(name, channel)) is not None]
    return found or [_check(Level.OK, name, f"stream {name!r}: all quantities are known")]


def _odd(stream: str, channel: str) -> Check | None:
    quantity, _, rest = channel.partition("_")
    place = f"channel {channel!r} of stream {stream!r}"
    known = tuple(dict.fromkeys((*FEATURE_UNITS, *OTHER_QUANTITIES)))
    if quantity not in known:
        near = difflib.get_close_matches(quantity, known, 1, NEAR)
        if near:
            return _check(
                Level.IMPLAUSIBLE if near[0] in FEATURE_UNITS else Level.DOUBTFUL,
                channel,
                f"{place}: no feature is made of {quantity!r}; is it {f'{near[0]}_{rest}'!r}?",
            )
        of_features = ", ".join(FEATURE_UNITS)
        return _check(
            Level.DOUBTFUL,
            channel,
            f"{place}: no feature is made of {quantity!r} (features are made of {of_features})",
        )
    if signal_set_of(stream, channel) is None or quantity not in FEATURE_UNITS:
        return None
    try:
        unit = unit_of(channel)
    except LogError as error:
        return _check(Level.DOUBTFUL, channel, str(error))
    expected = FEATURE_UNITS[quantity]
    if unit != expected:
        return _check(
            Level.IMPLAUSIBLE if quantity in IMU else Level.DOUBTFUL,
            channel,
            f"{place}: {quantity} is in {unit!r}, {expected!r} is expected (a name ends in its unit)",
        )
    axis = rest.rpartition("_")[0]
    if quantity in IMU and axis not in AXES:
        return _check(
            Level.DOUBTFUL, channel, f"{place}: {axis!r} is no axis, one of {', '.join(AXES)} is expected"
        )
    return None


def _check(level: Level, place: str, sentence: str) -> Check:
    return Check("channel names", level, place, math.nan, sentence)
