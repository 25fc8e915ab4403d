"""Runs as frames, as the robot would send them, and files of frames as runs."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator

from pipelines.can.codec import Frame, encode
from pipelines.can.dbc import Layout
from pipelines.can.signals import SENSORS, as_sent, channels_of
from terrain.logs.replay import TWIST
from terrain.records import RunLog, Stream


def run_frames(layout: Layout, run: RunLog) -> Iterator[Frame]:
    """Yield the frames that carry a run's sensors and its desired twist, in the order of their stamps.

    Parameters
    ----------
    layout : of the DBC
    run : with any of the streams of :data:`pipelines.can.signals.SENSORS`, and ``commands``
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
