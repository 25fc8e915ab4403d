"""A DBC as it is used: for each message its channels, their scales to SI, and what was not measured.

The lowest raw value of a signed signal, and the highest of an unsigned one, stands for a value that was not
measured; of a signal of floating point NaN does.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.can.signals import COUNTER, CRC, OPTIONAL, SIGNALS, channels_of
from terrain.errors import ConfigError
from terrain.files.resources import data_folder
from terrain.logs.schema import UNIT_OFFSETS, UNIT_SCALES, unit_of

DEFAULT_DBC = "agrimaro.dbc"
MAX_BYTES = 8
UNITLESS = ("", "-", "1")
"""Units of a code; the empty one also of a ratio."""

MISSING_PACKAGE = "CAN needs the packages python-can and cantools: pip install 'terrain-slip[can]'"


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """One signal of a message that is used.

    Parameters
    ----------
    name : in the DBC
    column : of its channel in the stream
    scale, offset : from raw to SI: ``scale * raw + offset``
    low, high : least and largest raw value that is a measurement
    absent : raw value of what was not measured
    is_float : raw values are of floating point
    """

    name: str
    column: int
    scale: float
    offset: float
    low: float
    high: float
    absent: float
    is_float: bool


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
    others : raw value of each further signal when it is sent
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


def _refuse_missing(path: Path, places: Mapping[str, object], streams: set[str]) -> None:
    missing = [
        name
        for stream in SIGNALS
        if stream in streams
        for channel, name in SIGNALS[stream].items()
        if channel not in OPTIONAL and name not in places
    ]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ConfigError(f"{path}: lacks the signal {missing[0]!r}{more}; docs/can.md lists those required")


def _signal_plan(path: Path, signal: Any, channel: str, column: int) -> SignalPlan:
    factor = _factor(path, signal, channel)
    scale, offset = float(signal.scale), float(signal.offset)
    if not (math.isfinite(scale) and scale and math.isfinite(offset)):
        raise ConfigError(f"{path}: the signal {signal.name!r} has the scale {scale:g}; 0 is not accepted")
    least, most = _raw_range(signal)
    absent = math.nan if signal.is_float else (least if signal.is_signed else most)
    if not signal.is_float:
        least, most = (least + 1, most) if signal.is_signed else (least, most - 1)
    ends = [(end - offset) / scale for end in (signal.minimum, signal.maximum) if end is not None]
    if len(ends) == 2:
        slack = 0.0 if signal.is_float else 1e-6  # bounds are written in decimals
        least = max(least, math.ceil(min(ends) - slack) if slack else min(ends))
        most = min(most, math.floor(max(ends) + slack) if slack else max(ends))
    if least > most:
        raise ConfigError(f"{path}: the signal {signal.name!r} has no value between its bounds")
    return SignalPlan(
        signal.name, column, factor * scale, factor * offset, least, most, absent, bool(signal.is_float)
    )


def _raw_range(signal: Any) -> tuple[float, float]:
    if signal.is_float:
        largest = {16: 65504.0, 32: 3.4028234663852886e38}.get(signal.length, 1.7976931348623157e308)
        return -largest, largest
    if signal.is_signed:
        return -(2 ** (signal.length - 1)), 2 ** (signal.length - 1) - 1
    return 0, 2**signal.length - 1


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
    names = {signal.name: signal for signal in message.signals}
    others = {name: signal.raw_initial or 0 for name, signal in names.items() if name not in used}
    has_crc = CRC in names and names[CRC].length == 8
    crc_bits = _bits_of_crc(message) if has_crc else 0
    return MessagePlan(message, stream, tuple(signals), COUNTER in names, crc_bits, others)


def _bits_of_crc(message: Any) -> int:
    zeros = dict.fromkeys((signal.name for signal in message.signals), 0)
    with_crc = message.encode(zeros | {CRC: 255}, scaling=False, padding=False, strict=False)
    return int.from_bytes(with_crc, "big")


def lacking(layout: Layout, stream: str) -> list[str]:
    """Return the channels of a stream that a DBC lacks."""
    there = layout.columns(stream)
    return [channel for column, channel in enumerate(channels_of(stream)) if column not in there]
