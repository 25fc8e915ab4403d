"""Recording of one live session: its event loop only appends to lists, a thread does the writing.

The samples of a session go to a hidden journal every few seconds (:mod:`pipelines.recording.journal`), and
from there, when the session ends, to a run folder (:mod:`pipelines.recording.finishing`).  A process that is
killed loses those seconds at most.
"""

from __future__ import annotations

import errno
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipelines.data.recorded_windows import WindowResult, window_entry
from pipelines.recording.finishing import finish
from pipelines.recording.journal import VERSION, Block, Journal, Record, journal_path
from terrain.errors import LogError, TerrainError
from terrain.estimation.live.clocks import number, numbers, readable
from terrain.files.names import plain_name
from terrain.logs.replay import TWIST
from terrain.logs.schema import unit_of
from terrain.logs.write import run_folder
from terrain.records import Array, Command, Reading

if TYPE_CHECKING:
    from pipelines.recording.thread import RecordingThread

MAX_WAITING_BYTES = 4 << 20
"""Memory of one session that may wait for the disk: minutes of its samples."""

_OVERHEAD_BYTES = 200
"""What an array takes beside its numbers."""

RECORDING = "recording"
FINISHED = "finished"
NOTHING_KEPT = "finished: nothing to keep"

UNREADABLE = "readings that cannot be read"
UNKNOWN_STREAM = "readings of unknown streams"
BAD_COMMAND = "commands that cannot be read"
BAD_WINDOW = "windows that cannot be read"


class RecordingLimits(NamedTuple):
    """When a recording ends by itself.

    Parameters
    ----------
    max_bytes : of the journal; the run is built in memory at the end, and takes up to three times as much
    max_hours : of recording
    """

    max_bytes: int = 128 << 20
    max_hours: float = 4.0


DEFAULT_LIMITS = RecordingLimits()


class SessionRecorder:
    """The recording of one session; none of its methods waits or raises.

    Parameters
    ----------
    folder : of the run folders; made when missing
    run_id : of the run; gets a number behind it where a run of the name is there at the end
    robot : name
    channels : of each stream that is recorded, in the order of the columns of its readings
    wheels : names of the wheels that are commanded
    source : of the run, as text
    writer : thread that writes; shared by all recordings
    limits : when the recording ends by itself

    Raises
    ------
    LogError
        if the run id, a stream or a channel has a name that is not accepted.

    Notes
    -----
    Samples are kept raw and in the order in which they came.  What a strict run folder cannot hold is dropped
    and counted when the run is written: stamps that repeat or go back, channels without a finite value,
    streams of fewer than two samples or apart in time from the others.
    """

    def __init__(
        self,
        folder: Path,
        run_id: str,
        robot: str,
        channels: Mapping[str, Sequence[str]],
        wheels: Sequence[str] = (),
        source: str = "recorded live",
        *,
        writer: RecordingThread,
        limits: RecordingLimits = DEFAULT_LIMITS,
    ) -> None:
        run_folder(run_id, folder)
        self._channels = {name: tuple(each) for name, each in channels.items()}
        _check_channels(self._channels)
        commanded = (*TWIST, *(f"wheel_{w}_radps" for w in wheels), *(f"steer_{w}_rad" for w in wheels))
        self._decided = {"commands": commanded}
        self._n_wheels = len(wheels)
        self._place, self._limits, self._writer = Path(folder), limits, writer
        self._head = {"version": VERSION, "run_id": run_id, "robot": robot, "source": source}
        self._lock = threading.Lock()
        self._waiting: list[tuple[str, Array]] = []
        self._outputs: list[WindowResult] = []
        self._dropped: Counter[str] = Counter()
        self._n_waiting = 0
        self._begin_s = monotonic()
        self._journal: Journal | None = None
        self._ended = ""  # why no more is taken; empty while it is
        self._settled = threading.Event()
        self.folder: Path | None = None
        writer.add(self)

    @property
    def status(self) -> str:
        """``recording``, ``finished``, or ``stopped:`` and why."""
        return self._ended or RECORDING

    @property
    def run_id(self) -> str:
        """Name of the run; as long as its folder is not there, the one that was asked for."""
        return str(self._head["run_id"]) if self.folder is None else self.folder.name

    @property
    def settled(self) -> bool:
        """Whether the thread is done with it: a run folder is there, or there will be none."""
        return self._settled.is_set()

    def readings(self, readings: Mapping[str, Reading]) -> None:
        """Record what was measured, by stream; what cannot be read is counted."""
        if self._ended:
            return
        try:
            items = list(readings.items())
        except Exception:  # whatever was given
            self._count(UNREADABLE)
            return
        for name, given in items:
            channels = self._channels.get(name) if isinstance(name, str) else None
            if channels is None:
                self._count(UNKNOWN_STREAM)
                continue
            reading = readable(given)
            if reading is None or reading.values.shape[1] != len(channels):
                self._count(UNREADABLE)
                continue
            rows = np.empty((reading.time_s.size, 1 + len(channels)))
            rows[:, 0] = reading.time_s
            rows[:, 1:] = reading.values
            self._put(name, rows)

    def command(self, time_s: float, twist: Any, command: Command, status: Mapping[str, float]) -> None:
        """Record a command.

        Parameters
        ----------
        time_s : of the step
        twist : (3,) desired; zeros are recorded, as they are driven, where it is no finite twist
        command : of the wheels
        status : figures of the decision, always of the same names
        """
        if self._ended:
            return
        desired = numbers(twist)
        if desired is None or desired.shape != (3,) or not np.isfinite(desired).all():
            desired = np.zeros(3)
        try:
            wheels: list[float] = [*command.wheel_radps, *command.steer_rad] if self._n_wheels else []
            row = np.array([[number(time_s), *desired, *wheels]], dtype=np.float64)
            names = tuple(status)
            figures = np.array([[number(time_s), *(number(each) for each in status.values())]])
        except Exception:  # whatever was given
            self._count(BAD_COMMAND)
            return
        if names and "control" not in self._decided and _accepted(names):
            self._decided["control"] = names
        fits = row.shape[1] == 1 + len(self._decided["commands"])
        if not fits or (names and names != self._decided.get("control")):
            self._count(BAD_COMMAND)
            return
        self._put("commands", row)
        if names:
            self._put("control", figures)

    def window(self, output: WindowResult) -> None:
        """Record the output of the model for a window."""
        if self._ended:
            return
        with self._lock:
            self._outputs.append(output)
            self._n_waiting += 1000
        self._bound()

    def close(self, timeout_s: float = 0.0) -> Path | None:
        """End the recording; return the run folder where the thread has written it within a time.

        Parameters
        ----------
        timeout_s : how long is waited for the thread; not at all by default
        """
        self._end(FINISHED)
        if timeout_s > 0.0:
            self._settled.wait(timeout_s)
        return self.folder

    def _count(self, kind: str) -> None:
        with self._lock:
            self._dropped[kind] += 1

    def _put(self, stream: str, rows: Array) -> None:
        with self._lock:
            self._waiting.append((stream, rows))
            self._n_waiting += rows.nbytes + _OVERHEAD_BYTES
        self._bound()

    def _bound(self) -> None:
        if self._n_waiting > MAX_WAITING_BYTES:
            self._end("stopped: the disk is too slow")

    def _end(self, why: str) -> None:
        if not self._ended:
            self._ended = why
            self._writer.due(self)

    def work(self) -> bool:
        """Write what waits; say whether there is more to come.  Called by the thread, and by nothing else."""
        if self.settled:
            return False
        closed = bool(self._ended)  # seen before the samples are taken, so that all of them are
        stopped = ""
        try:
            self._flush()
            stopped = "" if closed else self._limit()
        except OSError as error:
            stopped = f"stopped: {_reason(error)}"
        except Exception as error:  # of this recording: the thread serves the others
            stopped = f"stopped: {type(error).__name__}: {error}"
        self._ended = stopped or self._ended
        if not (stopped or closed):
            return True
        self._finish()
        return False

    def _flush(self) -> None:
        journal = self._journal or self._begin()
        with self._lock:
            waiting, self._waiting = self._waiting, []
            outputs, self._outputs = self._outputs, []
            dropped, self._dropped = self._dropped, Counter()
            self._n_waiting = 0
        if not (waiting or outputs or dropped):
            return
        by_stream: dict[str, list[Array]] = {}
        for name, rows in waiting:
            by_stream.setdefault(name, []).append(rows)
        channels = self._channels | self._decided
        blocks = [Block(name, channels[name], np.concatenate(rows)) for name, rows in by_stream.items()]
        entries = []
        for output in outputs:
            try:
                entries.append(window_entry(output))
            except (TypeError, ValueError, AttributeError):
                dropped[BAD_WINDOW] += 1
        journal.append([Record({"windows": entries, "dropped": dropped}, tuple(blocks))])

    def _begin(self) -> Journal:
        """Make a journal that no other recording has, and write its first record."""
        self._place.mkdir(parents=True, exist_ok=True)
        name, count = str(self._head["run_id"]), 1
        while self._journal is None:
            try:
                self._journal = Journal(journal_path(self._place, name))
            except FileExistsError:
                count += 1
                name = f"{self._head['run_id']}_{count}"
        try:
            self._journal.append([Record(self._head)])
        except OSError:
            self._journal.path.unlink(missing_ok=True)  # nothing is in it
            raise
        return self._journal

    def _limit(self) -> str:
        if self._journal is not None and self._journal.n_bytes > self._limits.max_bytes:
            return f"stopped: limit of {self._limits.max_bytes / 2**20:g} MiB reached"
        if monotonic() - self._begin_s > 3600.0 * self._limits.max_hours:
            return f"stopped: limit of {self._limits.max_hours:g} h reached"
        return ""

    def _finish(self) -> None:
        try:
            if self._journal is not None:
                self.folder = finish(self._journal.path)
                if self.folder is None and self._ended == FINISHED:
                    self._ended = NOTHING_KEPT
        except (TerrainError, OSError) as error:
            if self._ended == FINISHED:
                self._ended = f"stopped: {_reason(error)}"
        except Exception as error:  # the journal is kept
            self._ended = f"stopped: {type(error).__name__}: {error}"
        finally:
            if self._journal is not None:
                self._journal.close()
            self._waiting, self._outputs = [], []
            self._settled.set()


def _check_channels(channels: Mapping[str, Sequence[str]]) -> None:
    for name, each in channels.items():
        if not plain_name(name) or name in ("commands", "control"):
            raise LogError(f"stream {name!r} cannot be recorded as a sensor's")
        if not each or len(set(each)) < len(each) or "time_s" in each:
            raise LogError(f"stream {name!r}: channels {', '.join(each)!r} are no list of different names")
        for channel in each:
            unit_of(channel)


def _accepted(names: Sequence[str]) -> bool:
    try:
        return all(isinstance(name, str) and unit_of(name) for name in names)
    except LogError:
        return False


def _reason(error: Exception) -> str:
    """Return in words why nothing could be written."""
    cause = error if isinstance(error, OSError) else error.__cause__
    if not isinstance(cause, OSError):
        return str(error)
    if cause.errno in (errno.ENOSPC, errno.EDQUOT):
        return "no space left on the disk"
    if isinstance(cause, FileNotFoundError):
        return "the folder was removed"
    return f"cannot be written ({cause.strerror or cause})"
