"""Logs of a CAN bus as runs: ASC and BLF of Vector's tools, candump's log, TRC; one run a file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from pipelines.can.assemble import QUEUE, Receiver
from pipelines.can.codec import Drop, Frame
from pipelines.can.dbc import MISSING_PACKAGE, Layout
from pipelines.can.signals import QUATERNION, RECEIVED, SIGNALS, channels_of
from terrain.errors import ConfigError, LogError
from terrain.logs.borealtc import whole_run_label
from terrain.logs.samples import checked_stream
from terrain.records import Reading, RunLog, Stream

READERS = {
    ".asc": ("ASCReader", "r"),
    ".blf": ("BLFReader", "rb"),
    ".log": ("CanutilsLogReader", "r"),
    ".trc": ("TRCReader", "r"),
}
"""Reader of python-can for each kind of file, and how it is opened."""

USUAL = (Drop.UNKNOWN, Drop.ERROR, Drop.BUS_OFF, Drop.REMOTE)
"""What a log of any bus has besides the frames that are read: counted, and no fault of the log."""


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
    receiver = Receiver(layout, tuple(SIGNALS))
    parts: dict[str, list[Reading]] = {name: [] for name in RECEIVED}
    first_s: float | None = None
    for number, frame in enumerate(_frames(path)):
        first_s = frame.time_s if first_s is None else first_s
        receiver.take(frame._replace(time_s=frame.time_s - first_s))
        if number % QUEUE == QUEUE - 1:
            _collect(receiver, frame.time_s - first_s, parts)
    _collect(receiver, np.inf, parts)
    dropped = Counter(receiver.dropped)
    faults = {kind: n for kind, n in dropped.items() if kind not in USUAL}
    if faults and not repair:
        kind, n = max(faults.items(), key=lambda fault: fault[1])
        raise LogError(f"{path}: {n} of kind {kind!r}; read it with --repair to leave them out")
    repairs: Counter[str] | None = Counter() if repair else None
    streams = {
        "commands" if name == "twist" else name: _stream(path, layout, name, readings, repairs)
        for name, readings in parts.items()
        if readings
    }
    if not streams:
        raise LogError(f"{path}: has no frame of the messages of {layout.name}")
    place = path.relative_to(folder).with_suffix("").parts
    labels = (whole_run_label(streams, place[0]),) if len(place) > 1 else ()
    counts = dropped + (repairs or Counter())
    return RunLog("_".join(place), robot, streams, labels, source=str(path), dropped=counts)


def _frames(path: Path) -> Iterator[Frame]:
    try:
        import can
    except ImportError as error:
        raise ConfigError(MISSING_PACKAGE) from error
    name, mode = READERS[path.suffix.lower()]
    try:
        with path.open(mode) as file:  # a reader that fails leaves a file of its own open
            for message in getattr(can, name)(file):
                yield Frame(
                    message.timestamp,
                    message.arbitration_id,
                    bytes(message.data),
                    message.is_extended_id,
                    message.is_remote_frame,
                    message.is_error_frame,
                )
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # whatever a parser does with a damaged file
        text = " ".join(str(error).split()) or type(error).__name__
        raise LogError(f"{path}: is no log of a CAN bus, or is damaged ({text[:160]})") from error


def _collect(receiver: Receiver, now_s: float, parts: dict[str, list[Reading]]) -> None:
    for name, reading in receiver.readings(now_s).items():
        if name in parts:
            parts[name].append(reading)


def _stream(
    path: Path, layout: Layout, name: str, readings: list[Reading], repairs: Counter[str] | None
) -> Stream:
    """Return a stream with the channels that the DBC has."""
    there = layout.columns(name)
    if name == "odometry":
        there |= {QUATERNION[3]}
    columns = sorted(there)
    channels = channels_of(name)
    return checked_stream(
        f"{path}, {name}",
        np.concatenate([reading.time_s for reading in readings]),
        np.concatenate([reading.values for reading in readings])[:, columns],
        [channels[column] for column in columns],
        row_of=lambda sample: sample + 1,
        repairs=repairs,
    )
