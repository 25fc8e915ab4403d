"""Logs of a CAN bus as runs: ASC and BLF of Vector's tools, candump's log, TRC; one run a file.

The frames of one instant have equal counters, and make one sample, which is stamped by the first of them.  A
sample is complete when all channels that the DBC has of its stream have come.  A frame that was lost leaves
NaN in its part of the sample, which ends with the first frame of the next; frames of a sample that has ended
are late, and those of a counter that stands still repeat an old measurement: both are dropped and counted.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.data.can_codec import (
    QUATERNION,
    RECEIVED,
    SIGNALS,
    Drop,
    Layout,
    Part,
    channels_of,
    decode,
    library,
)
from terrain.errors import LogError, one_line
from terrain.logs.borealtc import whole_run_label
from terrain.logs.samples import checked_stream
from terrain.records import Reading, RunLog, Stream

if TYPE_CHECKING:
    from can import Message as Frame

READERS = {
    ".asc": ("ASCReader", "r"),
    ".blf": ("BLFReader", "rb"),
    ".log": ("CanutilsLogReader", "r"),
    ".trc": ("TRCReader", "r"),
}
"""Reader of python-can for each kind of file, and how it is opened."""

USUAL = (Drop.UNKNOWN, Drop.ERROR, Drop.BUS_OFF, Drop.REMOTE)
"""What a log of any bus has besides the frames that are read: counted, and no fault of the log."""

QUEUE = 1000
"""Most samples of a stream between two readings: ten seconds of an IMU; the oldest are dropped."""

LONGEST = 1.02
"""Square of the length of a quaternion's vector part that rounding can explain."""

INCOMPLETE_S = 0.02
"""A sample whose other frames have not come for so long is used without them."""


class _Assembler:
    """Samples of one stream, of the columns that a DBC has; the oldest of more than ``most`` are dropped."""

    def __init__(self, stream: str, columns: frozenset[int], dropped: Counter[str], most: float) -> None:
        self._stream, self._needed, self._dropped, self._most = stream, columns, dropped, most
        self._width = len(channels_of(stream))
        self._adds_real_part = stream == "odometry" and QUATERNION[3] not in columns
        self._row: dict[int, float] = {}
        self._counter: int | None = None
        self._last: int | None = None
        self._time_s = math.nan
        self._done = array("d")  # of each sample its time and its row

    def take(self, time_s: float, part: Part) -> None:
        if part.counter is not None and part.counter == self._last:
            self._dropped[f"{self._stream}: repeated or late"] += 1
            return
        known = part.counter is not None and self._counter is not None
        if self._row and known and part.counter != self._counter:
            self.finish()
        elif not self._row.keys().isdisjoint(part.values):
            if known:
                self._dropped[f"{self._stream}: repeated or late"] += 1
                return
            self.finish()
        if not self._row:
            self._time_s = time_s
        if part.counter is not None:
            self._counter = part.counter
        self._row |= part.values
        if part.n_out_of_range:
            self._dropped[f"{self._stream}: out of range"] += part.n_out_of_range
        if self._row.keys() >= self._needed:
            self.finish()

    def finish(self) -> None:
        """End the sample, complete or not."""
        if not self._row:
            return
        if not self._row.keys() >= self._needed:
            self._dropped[f"{self._stream}: part missing"] += 1
        if self._adds_real_part:
            square = sum(self._row.get(column, math.nan) ** 2 for column in QUATERNION[:3])
            self._row[QUATERNION[3]] = math.sqrt(max(1.0 - square, 0.0)) if square <= LONGEST else math.nan
        if len(self._done) >= self._most * (1 + self._width):
            del self._done[: 1 + self._width]
            self._dropped[f"{self._stream}: queue full"] += 1
        self._done.extend((self._time_s, *(self._row.get(i, math.nan) for i in range(self._width))))
        self._row = {}
        self._last, self._counter = self._counter, None

    def reading(self, before_s: float) -> Reading | None:
        """Return the samples that are done or began before a time, and hold them no more; None without any."""
        if self._time_s < before_s:
            self.finish()
        if not self._done:
            return None
        rows = np.array(self._done).reshape(-1, 1 + self._width)
        self._done = array("d")
        return Reading(rows[:, 0].copy(), rows[:, 1:].copy())


class Receiver:
    """Samples from frames as they come; whatever comes, it does not raise.

    Parameters
    ----------
    layout : of the DBC
    streams : that are read; frames of others are left alone
    most : samples of a stream that are held between two readings; the oldest are dropped

    Attributes
    ----------
    dropped : what was not used, as counts by kind
    n_used : frames that were used

    Examples
    --------
    >>> from pipelines.data.can_codec import encode, load_layout
    >>> layout = load_layout()
    >>> receiver = Receiver(layout, ("wheels",))
    >>> for frame in encode(layout, "wheels", [10.0, 11.0, 12.0, 1.0, 2.0, 3.0], counter=0, time_s=4.0):
    ...     stream = receiver.take(frame)
    >>> receiver.readings(5.0)["wheels"].values
    array([[10., 11., 12.,  1.,  2.,  3.]])
    """

    def __init__(self, layout: Layout, streams: tuple[str, ...], most: float = QUEUE) -> None:
        self._layout = layout
        self.dropped: Counter[str] = Counter()
        self.n_used = 0
        self._streams = {
            name: _Assembler(name, layout.columns(name), self.dropped, most)
            for name in streams
            if name in layout.by_stream
        }

    def take(self, frame: Frame) -> str | None:
        """Take a frame; return the stream that it is of, None where it is not used."""
        part = decode(self._layout, frame)
        if isinstance(part, Drop):
            self.dropped[part.value] += 1
            return None
        assembler = self._streams.get(part.stream)
        if assembler is None:
            self.dropped[f"{part.stream}: not read here"] += 1
            return None
        assembler.take(frame.timestamp, part)
        self.n_used += 1
        return part.stream

    def readings(self, now_s: float) -> dict[str, Reading]:
        """Return the samples since the last call, by stream; of incomplete ones those that are old enough."""
        readings = {name: each.reading(now_s - INCOMPLETE_S) for name, each in self._streams.items()}
        return {name: reading for name, reading in readings.items() if reading is not None}


def find_runs(folder: Path, layout: Layout, robot: str) -> list[Callable[..., RunLog]]:
    """Return a function for each log under a folder, which reads it and takes ``repair=``.

    Parameters
    ----------
    folder : of the logs; one in a folder of its own is labelled with that folder's name as its terrain
    layout : of the DBC
    robot : of all runs
    """
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in READERS and path.is_file())
    return [partial(read_run, path, folder, layout, robot) for path in paths]


def read_run(path: Path, folder: Path, layout: Layout, robot: str, *, repair: bool = False) -> RunLog:
    """Return the run of a log; its time begins at the first frame.

    Parameters
    ----------
    path, folder : the log, and the folder that its name counts from
    layout : of the DBC
    robot : of the run
    repair : drop and count what is damaged or missing, which a strict read refuses

    Raises
    ------
    LogError
        if the log cannot be read, has none of the signals, or is damaged.
    """
    receiver = Receiver(layout, tuple(SIGNALS), most=math.inf)
    first_s: float | None = None
    for frame in _frames(path):
        first_s = frame.timestamp if first_s is None else first_s
        frame.timestamp -= first_s
        receiver.take(frame)
    readings, dropped = receiver.readings(math.inf), receiver.dropped
    faults = {kind: n for kind, n in dropped.items() if kind not in USUAL}
    if faults and not repair:
        kind, n = max(faults.items(), key=lambda fault: fault[1])
        raise LogError(f"{path}: {n} of kind {kind!r}; read it with --repair to leave them out")
    streams = {
        "commands" if name == "twist" else name: _stream(
            path, layout, name, reading, dropped if repair else None
        )
        for name, reading in readings.items()
        if name in RECEIVED
    }
    if not streams:
        raise LogError(f"{path}: has no frame of the messages of {layout.name}")
    place = path.relative_to(folder).with_suffix("").parts
    labels = (whole_run_label(streams, place[0]),) if len(place) > 1 else ()
    return RunLog("_".join(place), robot, streams, labels, source=str(path), dropped=dropped)


def _frames(path: Path) -> Iterator[Frame]:
    can = library("can")
    name, mode = READERS[path.suffix.lower()]
    try:
        with path.open(mode) as file:  # a reader that fails leaves a file of its own open
            yield from getattr(can, name)(file)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # whatever a parser does with a damaged file
        raise LogError(f"{path}: is no log of a CAN bus, or is damaged ({one_line(error)})") from error


def _stream(path: Path, layout: Layout, name: str, reading: Reading, repairs: Counter[str] | None) -> Stream:
    """Return a stream with the channels that the DBC has."""
    columns = sorted(layout.columns(name) | ({QUATERNION[3]} if name == "odometry" else set()))
    channels = channels_of(name)
    return checked_stream(
        f"{path}, {name}",
        reading.time_s,
        reading.values[:, columns],
        [channels[column] for column in columns],
        row_of=lambda sample: sample + 1,
        repairs=repairs,
    )
