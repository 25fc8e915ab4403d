"""Frames to values and values to frames, each by itself: no state, no bus.

A value beyond what a signal can hold is sent as the end of its range, never wrapped; one that is not finite
as *not measured*.  CRC-8 of SAE J1850 is over the identifier, 2 bytes or 4 of an extended one, high byte
first, and the data with the CRC's own bits as 0.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

from pipelines.can.dbc import Layout, MessagePlan
from pipelines.can.signals import COUNTER, CRC


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


BUS_OFF_BIT = 0x40
"""In the identifier of an error frame of socketcan."""

_POLYNOMIAL, _INITIAL, _FINAL = 0x1D, 0xFF, 0xFF


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = (value << 1) ^ _POLYNOMIAL if value & 0x80 else value << 1
        table.append(value & 0xFF)
    return tuple(table)


_TABLE = _crc_table()


def crc8(content: bytes) -> int:
    """Return the CRC-8 of SAE J1850.

    Examples
    --------
    >>> hex(crc8(b"123456789"))
    '0x4b'
    """
    value = _INITIAL
    for byte in content:
        value = _TABLE[value ^ byte]
    return value ^ _FINAL


def decode(layout: Layout, frame: Frame) -> Part | Drop:
    """Return what a frame has of a sample, or why it is not used.

    Examples
    --------
    >>> from pipelines.can.dbc import load_layout
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
        raw = plan.message.decode(frame.data, decode_choices=False, scaling=False)
        if plan.crc_bits and raw[CRC] != _crc_of(plan, frame.data):
            return Drop.CHECKSUM
    except Exception:  # whatever a DBC makes of bytes, as of a multiplexer that it does not describe
        return Drop.UNREADABLE
    columns, values, n_out = [], [], 0
    for signal in plan.signals:
        value = raw.get(signal.name)  # of a multiplexed message only some are there
        if value is None:
            continue
        columns.append(signal.column)
        if value == signal.absent or math.isnan(value):
            values.append(math.nan)
        elif signal.low <= value <= signal.high:
            values.append(round(signal.scale * value + signal.offset, 12))
        else:
            n_out += 1
            values.append(math.nan)
    counter = int(raw[COUNTER]) if plan.has_counter else None
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
    stream : one of :data:`pipelines.can.signals.SIGNALS`
    values : of all its channels, SI; what is not finite is sent as not measured
    counter : of the sample; it wraps
    time_s : of the frames
    clipped : gets the number of values beyond their range, by signal
    """
    return [_encode(plan, values, counter, time_s, clipped) for plan in layout.by_stream.get(stream, ())]


def _encode(
    plan: MessagePlan, values: Sequence[float], counter: int, time_s: float, clipped: Counter[str] | None
) -> Frame:
    raw = dict(plan.others)
    for signal in plan.signals:
        value = float(values[signal.column])
        if not math.isfinite(value):
            raw[signal.name] = signal.absent
            continue
        desired = (value - signal.offset) / signal.scale
        if not signal.is_float:
            # a half is the most that rounding may go beyond an end
            desired = float(round(desired)) if abs(desired) < 2.0**63 else desired
        held = min(max(desired, signal.low), signal.high)
        if held != desired and clipped is not None:
            clipped[signal.name] += 1
        raw[signal.name] = held if signal.is_float else int(held)
    if plan.has_counter:
        length = plan.message.get_signal_by_name(COUNTER).length
        raw[COUNTER] = counter % 2**length
    data = bytes(plan.message.encode(raw, scaling=False, padding=False, strict=False))
    if plan.crc_bits:
        raw[CRC] = _crc_of(plan, data)
        data = bytes(plan.message.encode(raw, scaling=False, padding=False, strict=False))
    return Frame(time_s, plan.message.frame_id, data, plan.message.is_extended_frame)


def _crc_of(plan: MessagePlan, data: bytes) -> int:
    """Return the CRC over the identifier and all bits of the data but its own, unused ones too."""
    width = 4 if plan.message.is_extended_frame else 2
    others = (int.from_bytes(data, "big") & ~plan.crc_bits).to_bytes(len(data), "big")
    return crc8(plan.message.frame_id.to_bytes(width, "big") + others)
