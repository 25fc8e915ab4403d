"""Frames of a CAN bus to values and back, by the DBC that a user has: cantools decodes and encodes.

What a controller needs beside it is here: which signal is which channel, in which unit; values that were not
measured; bounds; CRC and counter.  The lowest raw value of a signed signal, and the highest of an unsigned
one, stands for a value that was not measured; of a signal of floating point NaN does.  A value beyond what a
signal can hold is sent as the end of its range, never wrapped.  CRC-8 of SAE J1850 is over the identifier, 2
bytes or 4 of an extended one, high byte first, and the data with the CRC's own bits as 0.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

from pipelines.data.can_signals import COUNTER, CRC, OPTIONAL, SENSORS, SIGNALS, as_sent, channels_of
from terrain.errors import ConfigError
from terrain.files.resources import data_folder
from terrain.logs.replay import TWIST
from terrain.logs.schema import UNIT_OFFSETS, UNIT_SCALES, unit_of
from terrain.records import RunLog, Stream

DEFAULT_DBC = "agrimaro.dbc"
MAX_BYTES = 8
UNITLESS = ("", "-", "1")
"""Units of a code; the empty one also of a ratio."""

MISSING_PACKAGE = "CAN needs the packages python-can and cantools: pip install 'terrain-slip[can]'"

BUS_OFF_BIT = 0x40
"""In the identifier of an error frame of socketcan."""


class Frame(NamedTuple):
    """One frame of a bus.

    Parameters
    ----------
    time_s : its time on the clock of the bus
    arbitration_id : identifier; of an error frame its kinds
    data : up to 8 bytes
    is_extended, is_remote, is_error : kinds of frames
    """

    time_s: float
    arbitration_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    is_error: bool = False


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
    columns, values : of the stream, SI; NaN where nothing was measured
    n_out_of_range : values beyond the bounds of their signal, which are NaN too
    """

    stream: str
    counter: int | None
    columns: tuple[int, ...]
    values: tuple[float, ...]
    n_out_of_range: int = 0


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """One signal of a message that is used; values are in the unit of the DBC.

    Parameters
    ----------
    name : in the DBC
    column : of its channel in the stream
    factor : from the unit of the DBC to SI
    scale : one step of a raw value
    low, high : least and largest value that is a measurement
    absent : value that stands for one that was not measured
    rounding : the most by which a value may be changed when it is sent
    """

    name: str
    column: int
    factor: float
    scale: float
    low: float
    high: float
    absent: float
    rounding: float


@dataclass(frozen=True, slots=True, eq=False)
class MessagePlan:
    """One message that is used.

    Parameters
    ----------
    message : of cantools
    stream : that it carries
    signals : of the stream's channels
    has_counter : whether it has a counter
    crc_bits : bits of its CRC in the data, the first byte the highest; 0 without one
    others : value of each further signal when it is sent
    """

    message: Any
    stream: str
    signals: tuple[SignalPlan, ...]
    has_counter: bool
    crc_bits: int
    others: Mapping[str, int | float]

    @property
    def key(self) -> tuple[int, bool]:
        """Identifier, and whether it is an extended one."""
        return self.message.frame_id, self.message.is_extended_frame


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """All messages that are used, by identifier and by stream."""

    name: str
    by_key: Mapping[tuple[int, bool], MessagePlan]
    by_stream: Mapping[str, tuple[MessagePlan, ...]]

    def columns(self, stream: str) -> frozenset[int]:
        """Return the columns of a stream that the DBC has."""
        return frozenset(signal.column for plan in self.by_stream.get(stream, ()) for signal in plan.signals)

    def lacking(self, stream: str) -> list[str]:
        """Return the channels of a stream that the DBC lacks."""
        there = self.columns(stream)
        return [channel for column, channel in enumerate(channels_of(stream)) if column not in there]


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
    database = _read(path)
    places: dict[str, list[Any]] = defaultdict(list)
    for message in database.messages:
        for signal in message.signals:
            places[signal.name].append(message)
    _refuse_missing(path, places, set(streams))
    found: dict[str, dict[str, list[SignalPlan]]] = {stream: defaultdict(list) for stream in SIGNALS}
    owner: dict[str, str] = {}
    for stream, names in SIGNALS.items():
        for column, (channel, name) in enumerate(names.items()):
            if name not in places:
                continue
            if len(places[name]) > 1:
                both = " and ".join(repr(message.name) for message in places[name][:2])
                raise ConfigError(f"{path}: the signal {name!r} is in the messages {both}; one is required")
            (message,) = places[name]
            if owner.setdefault(message.name, stream) != stream:
                raise ConfigError(
                    f"{path}: the message {message.name!r} has signals of {owner[message.name]!r} and "
                    f"{stream!r}; each needs messages of its own"
                )
            signal = message.get_signal_by_name(name)
            found[stream][message.name].append(_signal_plan(path, signal, channel, column))
    by_stream = {
        stream: tuple(
            _message_plan(database.get_message_by_name(name), stream, signals)
            for name, signals in messages.items()
        )
        for stream, messages in found.items()
        if messages
    }
    plans = [plan for plans in by_stream.values() for plan in plans]
    for plan in plans:
        if plan.message.length > MAX_BYTES:
            raise ConfigError(
                f"{path}: the message {plan.message.name!r} has {plan.message.length} bytes; "
                f"a frame of classical CAN has at most {MAX_BYTES}"
            )
    return Layout(path.name, {plan.key: plan for plan in plans}, by_stream)


def _read(path: Path) -> Any:
    try:
        import cantools
    except ImportError as error:
        raise ConfigError(MISSING_PACKAGE) from error
    try:
        return cantools.database.load_file(path, database_format="dbc", strict=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be opened ({error.strerror})") from error
    except Exception as error:  # whatever a parser does with a damaged file
        raise ConfigError(f"{path}: is no DBC ({' '.join(str(error).split())[:160]})") from error


def _refuse_missing(path: Path, places: Mapping[str, list[Any]], streams: set[str]) -> None:
    missing = [
        name
        for stream in SIGNALS
        if stream in streams
        for channel, name in SIGNALS[stream].items()
        if name not in places and channel not in OPTIONAL
    ]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ConfigError(f"{path}: lacks the signal {missing[0]!r}{more}; docs/can.md lists those required")


def _signal_plan(path: Path, signal: Any, channel: str, column: int) -> SignalPlan:
    scale, offset = float(signal.scale), float(signal.offset)
    if not (math.isfinite(scale) and scale and math.isfinite(offset)):
        raise ConfigError(f"{path}: the signal {signal.name!r} has the scale {scale:g}; 0 is not accepted")
    convert = signal.conversion.raw_to_scaled
    stated = [end for end in (signal.minimum, signal.maximum) if end is not None]
    if signal.is_float:
        largest = {16: 65504.0, 32: 3.4028234663852886e38}.get(signal.length, 1.7976931348623157e308)
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
    rounding = 0.0 if signal.is_float else 0.5 * abs(scale)
    return SignalPlan(signal.name, column, factor, abs(scale), float(low), float(high), absent, rounding)


def _factor(path: Path, signal: Any, channel: str) -> float:
    """Return the factor from a signal's unit to that of its channel."""
    given, required = signal.unit or "", unit_of(channel)
    if required == "code" or (required == "ratio" and given == ""):
        known = ("", 1.0) if given in UNITLESS else None
    else:
        known = None if given in UNIT_OFFSETS else UNIT_SCALES.get(given)  # a DBC has offsets of its own
        known = known if known is not None and known[0] == required else None
    if known is None:
        fitting = [repr(unit) for unit, (word, _) in UNIT_SCALES.items() if word == required] or ["none"]
        raise ConfigError(
            f"{path}: the signal {signal.name!r} has the unit {given!r}, which does not fit {channel}; "
            f"accepted: {', '.join(fitting)}"
        )
    return known[1]


def _message_plan(message: Any, stream: str, signals: list[SignalPlan]) -> MessagePlan:
    used = {signal.name for signal in signals}
    by_name = {signal.name: signal for signal in message.signals}
    others = {
        name: signal.conversion.raw_to_scaled(signal.raw_initial or 0, False)
        for name, signal in by_name.items()
        if name not in used
    }
    crc_bits = 0
    if CRC in by_name and by_name[CRC].length == 8:
        raw = dict.fromkeys(by_name, 0) | {CRC: 255}
        crc_bits = int.from_bytes(message.encode(raw, scaling=False, padding=False, strict=False), "big")
    return MessagePlan(message, stream, tuple(signals), COUNTER in by_name, crc_bits, others)


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = (value << 1) ^ 0x1D if value & 0x80 else value << 1
        table.append(value & 0xFF)
    return tuple(table)


_TABLE = _crc_table()


def crc8(content: bytes) -> int:
    """Return the CRC-8 of SAE J1850: polynomial 0x1D, start 0xFF, result inverted.

    Examples
    --------
    >>> hex(crc8(b"123456789"))
    '0x4b'
    """
    value = 0xFF
    for byte in content:
        value = _TABLE[value ^ byte]
    return value ^ 0xFF


def _crc_of(plan: MessagePlan, data: bytes) -> int:
    """Return the CRC over the identifier and all bits of the data but its own, unused ones too."""
    width = 4 if plan.message.is_extended_frame else 2
    others = (int.from_bytes(data, "big") & ~plan.crc_bits).to_bytes(len(data), "big")
    return crc8(plan.message.frame_id.to_bytes(width, "big") + others)


def decode(layout: Layout, frame: Frame) -> Part | Drop:
    """Return what a frame has of a sample, or why it is not used.

    Examples
    --------
    >>> layout = load_layout()
    >>> frame, = encode(layout, "steering", [0.1, -0.2, math.nan], counter=7)
    >>> decode(layout, frame)
    Part(stream='steering', counter=7, columns=(0, 1, 2), values=(0.09999, -0.20001, nan), n_out_of_range=0)
    >>> decode(layout, frame._replace(data=frame.data[:5]))
    <Drop.LENGTH: 'wrong length'>
    """
    if frame.is_error:
        return Drop.BUS_OFF if frame.arbitration_id & BUS_OFF_BIT else Drop.ERROR
    if frame.is_remote:
        return Drop.REMOTE
    plan = layout.by_key.get((frame.arbitration_id, frame.is_extended))
    if plan is None:
        return Drop.UNKNOWN
    if len(frame.data) != plan.message.length:
        return Drop.LENGTH
    if not math.isfinite(frame.time_s):
        return Drop.TIME
    try:
        decoded = plan.message.decode(frame.data, decode_choices=False)
        if plan.crc_bits and decoded[CRC] != _crc_of(plan, frame.data):
            return Drop.CHECKSUM
        counter = int(decoded[COUNTER]) if plan.has_counter else None
    except Exception:  # whatever a DBC makes of bytes, as of a multiplexer that it does not describe
        return Drop.UNREADABLE
    columns, values, n_out = [], [], 0
    for signal in plan.signals:
        value = decoded.get(signal.name)  # of a multiplexed message only some are there
        if value is None:
            continue
        columns.append(signal.column)
        if value == signal.absent or math.isnan(value):
            values.append(math.nan)
        elif signal.low <= value <= signal.high:
            values.append(round(signal.factor * value, 12))
        else:
            n_out += 1
            values.append(math.nan)
    return Part(plan.stream, counter, tuple(columns), tuple(values), n_out)


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
    stream : one of :data:`pipelines.data.can_signals.SIGNALS`
    values : of all its channels, SI; what is not finite is sent as not measured
    counter : of the sample; it wraps
    time_s : of the frames
    clipped : gets the number of values beyond their range, by signal
    """
    return [_encode(plan, values, counter, time_s, clipped) for plan in layout.by_stream.get(stream, ())]


def _encode(
    plan: MessagePlan, values: Sequence[float], counter: int, time_s: float, clipped: Counter[str] | None
) -> Frame:
    sent: dict[str, Any] = dict(plan.others)
    for signal in plan.signals:
        value = float(values[signal.column]) / signal.factor
        sent[signal.name] = signal.absent
        if math.isfinite(value):
            sent[signal.name] = min(max(value, signal.low), signal.high)
            if abs(value - sent[signal.name]) > signal.rounding and clipped is not None:
                clipped[signal.name] += 1
    if plan.has_counter:
        sent[COUNTER] = counter % 2 ** plan.message.get_signal_by_name(COUNTER).length
    data = bytes(plan.message.encode(sent, padding=False, strict=False))
    if plan.crc_bits:
        sent[CRC] = _crc_of(plan, data)
        data = bytes(plan.message.encode(sent, padding=False, strict=False))
    return Frame(time_s, plan.message.frame_id, data, plan.message.is_extended_frame)


def run_frames(layout: Layout, run: RunLog) -> Iterator[Frame]:
    """Yield the frames that carry a run's sensors and its desired twist, in the order of their stamps.

    Parameters
    ----------
    layout : of the DBC
    run : with any of the streams of :data:`pipelines.data.can_signals.SENSORS`, and ``commands``
    """
    sources = {name: run.streams[name] for name in SENSORS if name in run.streams}
    commands = run.streams.get("commands")
    if commands is not None and set(TWIST) <= set(commands.channels):
        sources["twist"] = commands
    frames = [_stream_frames(layout, name, stream) for name, stream in sources.items()]
    return heapq.merge(*frames, key=lambda frame: frame.time_s)


def _stream_frames(layout: Layout, name: str, stream: Stream) -> Iterator[Frame]:
    channels = channels_of(name)
    columns = [stream.channels.index(channel) if channel in stream.channels else -1 for channel in channels]
    for number, (time_s, row) in enumerate(zip(stream.time_s.tolist(), stream.values.tolist(), strict=True)):
        values = [math.nan if column < 0 else row[column] for column in columns]
        yield from encode(layout, name, as_sent(name, values), number, time_s)
