"""Frames of a CAN bus to values and back, by the DBC that a user has: cantools decodes and encodes.

A DBC with the names of :data:`SIGNALS` is read, whatever its frames.  A frame is eight bytes, so that the
channels of a stream come in several; those with equal ``Counter`` are of one instant.

What a controller needs beside it is here: which signal is which channel, in which unit; values that were not
measured; bounds; CRC and counter.  The lowest raw value of a signed signal, and the highest of an unsigned
one, stands for a value that was not measured; of a signal of floating point NaN does.  A value beyond what a
signal can hold is sent as the end of its range, never wrapped.  CRC-8 of SAE J1850 is over the identifier, 2
bytes or 4 of an extended one, high byte first, and the data with the CRC's own bits as 0.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from terrain import errors
from terrain.errors import ConfigError, one_line
from terrain.files.resources import data_folder
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.logs.mapping import check_unit
from terrain.logs.replay import TWIST
from terrain.logs.schema import (
    IMU_CHANNELS,
    STEERING_CHANNELS,
    UNIT_SCALES,
    WHEELS_CHANNELS,
    canonical_unit,
    unit_of,
)

if TYPE_CHECKING:
    from can import Message as Frame

DEFAULT_DBC = "agrimaro.dbc"
MAX_BYTES = 8
UNITLESS = ("", "-", "1")
"""Units of a code."""

library = partial(errors.library, need="CAN needs the packages python-can and cantools", extra="can")

BUS_OFF_BIT = 0x40
"""In the identifier of an error frame of socketcan."""

COUNTER, CRC = "Counter", "Crc8"
"""Signals that any message may have: rises by one a sample; CRC-8 over identifier and data."""

SIGNALS: Mapping[str, Mapping[str, str]] = {
    stream: dict(zip(channels, names.split(), strict=True))
    for stream, channels, names in (
        (
            "wheels",
            WHEELS_CHANNELS,
            "MotorRate1 MotorRate2 MotorRate3 MotorCurrent1 MotorCurrent2 MotorCurrent3",
        ),
        ("steering", STEERING_CHANNELS, "SteeringAngle1 SteeringAngle2 SteeringAngle3"),
        ("imu", IMU_CHANNELS, "GyroX GyroY GyroZ AccelX AccelY AccelZ Roll Pitch Yaw"),
        (
            "odometry",
            CAMERA_CHANNELS,
            "CameraPositionX CameraPositionY CameraPositionZ "
            "CameraQuaternionX CameraQuaternionY CameraQuaternionZ CameraQuaternionW "
            "CameraVelocityX CameraVelocityY CameraVelocityZ CameraRateX CameraRateY CameraRateZ CameraConfidence",
        ),
        ("twist", TWIST, "DesiredSpeedX DesiredSpeedY DesiredYawRate"),
        ("corrections", [f"correction_{i}_radps" for i in (1, 2, 3)], "Correction1 Correction2 Correction3"),
    )
} | {
    "status": {
        "terrain_code": "TerrainCode",
        "probability_ratio": "TerrainProbability",
        "target_ratio": "TargetSlip",
        "status_code": "ControlStatus",
        "bridge_code": "BridgeState",
        "sensor_code": "SensorCode",
        "health_code": "SensorHealth",
    }
}
"""Signal of each channel, by stream."""

RECEIVED = ("wheels", "steering", "imu", "odometry", "twist")
"""Streams that the bridge receives, the last of them desired and not measured; it sends the others."""

OPTIONAL = frozenset(
    (*(f"position_{axis}_m" for axis in "xyz"), "quaternion_w_ratio", "confidence_ratio", *SIGNALS["status"])
)
"""Channels that no controller needs, or that follow from others: a DBC may lack them."""

QUATERNION = tuple(CAMERA_CHANNELS.index(f"quaternion_{part}_ratio") for part in "xyzw")
"""Columns of the camera's quaternion; a real part that the DBC lacks is the one that is not negative."""


def channels_of(stream: str) -> tuple[str, ...]:
    """Return the channels of a stream, in the order of its columns.

    Examples
    --------
    >>> channels_of("twist")
    ('speed_x_mps', 'speed_y_mps', 'yaw_rate_radps')
    """
    return tuple(SIGNALS[stream])


class Drop(StrEnum):
    """Why a frame is not used."""

    BUS_OFF = "bus off"
    ERROR = "error frame"
    REMOTE = "remote frame"
    UNKNOWN = "unknown id"
    LENGTH = "wrong length"
    CHECKSUM = "wrong checksum"
    UNREADABLE = "unreadable"
    TIME = "time not finite"


class Part(NamedTuple):
    """What one frame has of a sample.

    Parameters
    ----------
    stream : that the sample belongs to
    counter : of the sample; None where the message has none
    values : by column of the stream, SI; NaN where nothing was measured
    n_out_of_range : values beyond the bounds of their signal, which are NaN too
    """

    stream: str
    counter: int | None
    values: Mapping[int, float]
    n_out_of_range: int = 0


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """One signal of a message that is used; values are in the unit of the DBC.

    Parameters
    ----------
    name : in the DBC
    column : of its channel in the stream
    factor : from the unit of the DBC to SI
    scale : one step of a raw value; 0 of floating point
    low, high : least and largest value that is a measurement
    absent : value that stands for one that was not measured
    """

    name: str
    column: int
    factor: float
    scale: float
    low: float
    high: float
    absent: float


@dataclass(frozen=True, slots=True, eq=False)
class MessagePlan:
    """One message that is used.

    Parameters
    ----------
    message : of cantools
    stream : that it carries
    signals : of the stream's channels
    counter_bits : of its counter; 0 without one
    crc_bits : bits of its CRC in the data, the first byte the highest; 0 without one
    others : value of each further signal when it is sent
    """

    message: Any
    stream: str
    signals: tuple[SignalPlan, ...]
    counter_bits: int
    crc_bits: int
    others: Mapping[str, int | float]


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """All messages that are used, by identifier and whether it is an extended one, and by stream."""

    name: str
    by_key: Mapping[tuple[int, bool], MessagePlan]
    by_stream: Mapping[str, Sequence[MessagePlan]]

    def columns(self, stream: str) -> frozenset[int]:
        """Return the columns of a stream that the DBC has."""
        return frozenset(signal.column for plan in self.by_stream.get(stream, ()) for signal in plan.signals)


def load_layout(path: str | Path | None = None, streams: Iterable[str] = SIGNALS) -> Layout:
    """Return what a DBC has of the signals that are used.

    Parameters
    ----------
    path : DBC file; AgriMaRo's by default
    streams : that it must have, without the channels that may be lacking

    Raises
    ------
    ConfigError
        if the file cannot be read, a signal is missing or ambiguous, or has a unit that does not fit.

    Examples
    --------
    >>> layout = load_layout()
    >>> [plan.message.name for plan in layout.by_stream["wheels"]]
    ['MotorRates', 'MotorCurrents']
    """
    path = data_folder("can") / DEFAULT_DBC if path is None else Path(path)
    places = {
        name: (stream, column, channel)
        for stream, names in SIGNALS.items()
        for column, (channel, name) in enumerate(names.items())
    }
    owner: dict[str, Any] = {}
    by_stream: dict[str, list[MessagePlan]] = {}
    for message in _read(path).messages:
        used = [signal for signal in message.signals if signal.name in places]
        for signal in used:
            if owner.setdefault(signal.name, message) is not message:
                both = f"{owner[signal.name].name!r} and {message.name!r}"
                raise ConfigError(
                    f"{path}: the signal {signal.name!r} is in the messages {both}; one is required"
                )
        signals = tuple(_signal_plan(path, signal, *places[signal.name][1:]) for signal in used)
        carried = list(dict.fromkeys(places[signal.name][0] for signal in used))
        if not carried:
            continue
        if len(carried) > 1:
            both = " and ".join(map(repr, carried[:2]))
            raise ConfigError(
                f"{path}: the message {message.name!r} has signals of {both}; each needs messages of its own"
            )
        if message.length > MAX_BYTES:
            raise ConfigError(
                f"{path}: the message {message.name!r} has {message.length} bytes; "
                f"a frame of classical CAN has at most {MAX_BYTES}"
            )
        by_stream.setdefault(carried[0], []).append(_message_plan(message, carried[0], signals))
    missing = [
        name
        for name, (stream, _, channel) in places.items()
        if name not in owner and stream in set(streams) and channel not in OPTIONAL
    ]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ConfigError(f"{path}: lacks the signal {missing[0]!r}{more}; docs/can.md lists those required")
    plans = [plan for of_stream in by_stream.values() for plan in of_stream]
    by_key = {(plan.message.frame_id, plan.message.is_extended_frame): plan for plan in plans}
    return Layout(path.name, by_key, by_stream)


def _read(path: Path) -> Any:
    cantools = library("cantools")
    try:
        return cantools.database.load_file(path, database_format="dbc", strict=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be opened ({error.strerror})") from error
    except Exception as error:  # whatever a parser does with a damaged file
        raise ConfigError(f"{path}: is no DBC ({one_line(error)})") from error


def _signal_plan(path: Path, signal: Any, column: int, channel: str) -> SignalPlan:
    scale, offset = float(signal.scale), float(signal.offset)
    if not (math.isfinite(scale) and scale and math.isfinite(offset)):
        raise ConfigError(f"{path}: the signal {signal.name!r} has the scale {scale:g}; 0 is not accepted")
    convert = signal.conversion.raw_to_scaled
    stated = [end for end in (signal.minimum, signal.maximum) if end is not None]
    if signal.is_float:
        largest = float(np.finfo(f"f{signal.length // 8}").max)
        ends, absent = sorted([convert(-largest, False), convert(largest, False)]), math.nan
        low, high = (max(ends[0], stated[0]), min(ends[1], stated[1])) if len(stated) == 2 else ends
    else:
        most = 2 ** (signal.length - signal.is_signed) - 1
        least = -most - 1 if signal.is_signed else 0
        absent = float(convert(least if signal.is_signed else most, False))
        least, most = (least + 1, most) if signal.is_signed else (least, most - 1)
        if len(stated) == 2:  # bounds are written in decimals
            first, last = sorted((end - offset) / scale for end in stated)
            least, most = max(least, math.ceil(first - 1e-6)), min(most, math.floor(last + 1e-6))
        low, high = sorted([convert(least, False), convert(most, False)]) if least <= most else (1.0, 0.0)
    if low > high:
        raise ConfigError(f"{path}: the signal {signal.name!r} has no value between its bounds")
    factor = _factor(path, signal, channel)
    step = 0.0 if signal.is_float else abs(scale)
    return SignalPlan(signal.name, column, factor, step, float(low), float(high), absent)


def _factor(path: Path, signal: Any, channel: str) -> float:
    """Return the factor from a signal's unit to that of its channel; a DBC has its own offsets."""
    given, required = signal.unit or "", unit_of(channel)
    if (required == "code" and given in UNITLESS) or (required == "ratio" and not given):
        return 1.0
    check_unit(f"{path}: the signal {signal.name!r} of {channel}", given, required)
    return UNIT_SCALES[canonical_unit(given)][1]


def _message_plan(message: Any, stream: str, signals: tuple[SignalPlan, ...]) -> MessagePlan:
    used = {signal.name for signal in signals}
    by_name = {signal.name: signal for signal in message.signals}
    others = {
        name: signal.conversion.raw_to_scaled(signal.raw_initial or 0, False)
        for name, signal in by_name.items()
        if name not in used
    }
    counter_bits = by_name[COUNTER].length if COUNTER in by_name else 0
    crc_bits = 0
    if CRC in by_name and by_name[CRC].length == 8:
        raw = dict.fromkeys(by_name, 0) | {CRC: 255}
        crc_bits = int.from_bytes(message.encode(raw, scaling=False, padding=False, strict=False), "big")
    return MessagePlan(message, stream, signals, counter_bits, crc_bits, others)


def _crc_of(plan: MessagePlan, data: bytes) -> int:
    """Return the CRC over the identifier and all bits of the data but its own, unused ones too."""
    from crccheck.crc import Crc8SaeJ1850

    width = 4 if plan.message.is_extended_frame else 2
    others = (int.from_bytes(data, "big") & ~plan.crc_bits).to_bytes(len(data), "big")
    return int(Crc8SaeJ1850.calc(plan.message.frame_id.to_bytes(width, "big") + others))


def decode(layout: Layout, frame: Frame) -> Part | Drop:
    """Return what a frame has of a sample, or why it is not used.

    The time of a frame is on the clock of the bus; the identifier of an error frame states its kinds.

    Examples
    --------
    >>> layout = load_layout()
    >>> frame, = encode(layout, "steering", [0.1, -0.2, math.nan], counter=7)
    >>> decode(layout, frame)
    Part(stream='steering', counter=7, values={0: 0.09999, 1: -0.20001, 2: nan}, n_out_of_range=0)
    >>> frame.data = frame.data[:5]
    >>> decode(layout, frame)
    <Drop.LENGTH: 'wrong length'>
    """
    if frame.is_error_frame:
        return Drop.BUS_OFF if frame.arbitration_id & BUS_OFF_BIT else Drop.ERROR
    if frame.is_remote_frame:
        return Drop.REMOTE
    plan = layout.by_key.get((frame.arbitration_id, frame.is_extended_id))
    if plan is None:
        return Drop.UNKNOWN
    if len(frame.data) != plan.message.length:
        return Drop.LENGTH
    if not math.isfinite(frame.timestamp):
        return Drop.TIME
    data = bytes(frame.data)
    try:
        decoded = plan.message.decode(data, decode_choices=False)
        if plan.crc_bits and decoded[CRC] != _crc_of(plan, data):
            return Drop.CHECKSUM
        counter = int(decoded[COUNTER]) if plan.counter_bits else None
    except Exception:  # whatever a DBC makes of bytes, as of a multiplexer that it does not describe
        return Drop.UNREADABLE
    values, n_out = dict[int, float](), 0
    for signal in plan.signals:
        value = decoded.get(signal.name)  # of a multiplexed message only some are there
        if value is None:
            continue
        values[signal.column] = math.nan
        if signal.low <= value <= signal.high and value != signal.absent:
            values[signal.column] = round(signal.factor * value, 12)
        elif value != signal.absent and not math.isnan(value):
            n_out += 1
    return Part(plan.stream, counter, values, n_out)


def encode(
    layout: Layout,
    stream: str,
    values: Sequence[float],
    counter: int,
    time_s: float = 0.0,
    clipped: Counter[str] | None = None,
) -> list[Frame]:
    """Return the frames of one sample; none where the DBC has no message of the stream.

    Parameters
    ----------
    layout : of the DBC
    stream : one of :data:`SIGNALS`
    values : of all its channels, SI; what is not finite is sent as not measured
    counter : of the sample; it wraps
    time_s : of the frames
    clipped : gets the number of values beyond their range, by signal
    """
    can = library("can")
    frames = []
    for plan in layout.by_stream.get(stream, ()):
        sent: dict[str, Any] = dict(plan.others)
        for signal in plan.signals:
            value = float(values[signal.column]) / signal.factor
            sent[signal.name] = signal.absent
            if math.isfinite(value):
                sent[signal.name] = min(max(value, signal.low), signal.high)
                if abs(value - sent[signal.name]) > 0.5 * signal.scale and clipped is not None:
                    clipped[signal.name] += 1
        if plan.counter_bits:
            sent[COUNTER] = counter % 2**plan.counter_bits
        data = bytes(plan.message.encode(sent, padding=False, strict=False))
        if plan.crc_bits:
            sent[CRC] = _crc_of(plan, data)
            data = bytes(plan.message.encode(sent, padding=False, strict=False))
        about = {"arbitration_id": plan.message.frame_id, "is_extended_id": plan.message.is_extended_frame}
        frames.append(can.Message(time_s, data=data, **about))
    return frames
