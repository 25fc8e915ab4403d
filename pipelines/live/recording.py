"""Recording of live sessions as MCAP files that are written as the samples come.

The event loop of a session only appends to lists; one thread writes all recordings, each at least once a
second, so that a killed process loses at most two.  The files have the topics of an exported run
(:mod:`terrain.logs.run_topics`): Foxglove and PlotJuggler open them while they grow, and ``terrain convert``
makes runs of them.  A recording goes on in files of a bounded size, each a run of the same session, the next
one beginning with the sample after the last.
"""

from __future__ import annotations

import errno
import os
import shutil
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from itertools import chain, count
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pipelines.data.bag_files import McapWriter
from pipelines.live.chain import CommandStatus, Step
from pipelines.live.classifying import WindowOutput
from terrain.control.switching import SWITCHING
from terrain.logs.run_folders import RecordedWindow, RunHead, run_folder
from terrain.logs.run_topics import LATEST_S, WINDOW_TOPIC, RunRecorder, check_recordable
from terrain.logs.samples import BAD_TIME
from terrain.logs.schema import TWIST
from terrain.records import Array, Reading

FLUSH_S = 1.0
"""Time between two writings of a recording: with the time that one takes, what a killed process loses."""

PART_BYTES = 128 << 20
"""Size of a file above which the recording goes on in another: an hour or two of a robot's samples."""

FREE_BYTES = 256 << 20
"""A recording ends where less is free on the disk: the states of the robots are to be saved there, too."""

MAX_WAITING_BYTES = 4 << 20  #: Memory of one session that may wait for the disk: minutes of its samples
_OVERHEAD_BYTES = 200  #: What an array takes beside its numbers

NOT_DECIDED = (CommandStatus.NO_SAMPLES, CommandStatus.FAILED)
"""Statuses of commands that no controller has decided on."""

RECORDING, FINISHED, NOTHING_KEPT = "recording", "finished", "finished: nothing to keep"

WINDOW = "a window"  #: Takes the place of a stream's name for outputs of the model


class SessionRecorder:
    """The recording of one session; none of its methods waits or raises.

    Parameters
    ----------
    folder : of the files; made when missing
    run_id : of the run; gets a number behind it where a file of the name is there, and ``_part2``, ``_part3``
        where the recording goes on in further files
    robot : name
    channels : of each stream that is recorded, in the order of the columns of its readings
    wheels : names of the wheels that are commanded
    writer : thread that writes; shared by all recordings

    Attributes
    ----------
    files : that were begun, in order
    settled : set when the thread is done with the recording
    status : ``recording``, ``finished``, or ``stopped:`` and why

    Raises
    ------
    LogError
        if the run id, a stream or a channel has a name that is not accepted.

    Notes
    -----
    Samples are kept raw and in the order in which they came, but for stamps that no header can hold.  What a
    run cannot hold is dropped and counted when the file is read: stamps that repeat or go back, channels
    without a finite value, streams of fewer than two samples or apart in time from the others.
    """

    def __init__(
        self,
        folder: Path,
        run_id: str,
        robot: str,
        channels: Mapping[str, Sequence[str]],
        wheels: Sequence[str] = (),
        *,
        writer: RecordingThread,
    ) -> None:
        run_folder(run_id, folder)
        self._channels = {name: tuple(each) for name, each in channels.items()}
        check_recordable(self._channels)
        commanded = (*TWIST, *(f"wheel_{w}_radps" for w in wheels), *(f"steer_{w}_rad" for w in wheels))
        self._channels["commands"] = commanded
        self._n_wheels = len(wheels)
        self._folder, self._writer = Path(folder), writer
        self._head = RunHead(run_id=run_id, robot=robot, session=run_id, source="recorded live", labels=[])
        self._lock = threading.Lock()
        self._waiting: list[tuple[str, Array | WindowOutput]] = []
        self._dropped: Counter[str] = Counter()
        self._n_waiting = 0
        self._file: BinaryIO | None = None  # that is written, and its run
        self._run: RunRecorder
        self._origin_s = np.nan
        self.status = RECORDING
        self.settled = threading.Event()
        self.files: list[Path] = []
        writer.add(self)

    def readings(self, readings: Mapping[str, Reading]) -> None:
        """Record what was measured, by stream, in the columns of its channels."""
        for name, (time_s, values) in readings.items():
            self._put(name, np.column_stack([time_s, values]))

    def step(self, time_s: float, twist: Array, done: Step) -> None:
        """Record what a step gave at a time: the command where a controller decided on it, and windows.

        Parameters
        ----------
        time_s : of the step
        twist : (3,) desired
        done : its command has figures of the decision, always of the same names
        """
        command = None if done.status in NOT_DECIDED else done.command
        if command is not None:
            wheels = (*command.wheel_radps, *command.steer_rad) if self._n_wheels else ()
            self._put("commands", np.array([[time_s, *twist, *wheels]]))
            self._channels.setdefault("control", tuple(command.status))
            self._put("control", np.array([[time_s, *command.status.values()]]))
        for output in done.windows:
            self._put(WINDOW, output)

    def close(self) -> None:
        """End the recording; its files are whole when the thread has settled it."""
        self._end(FINISHED)

    def _put(self, stream: str, content: Array | WindowOutput) -> None:
        if self.status != RECORDING:
            return
        n_bytes = _OVERHEAD_BYTES + getattr(content, "nbytes", 5 * _OVERHEAD_BYTES)
        with self._lock:
            self._waiting.append((stream, content))
            self._n_waiting += n_bytes
        if self._n_waiting > MAX_WAITING_BYTES:
            self._end("stopped: the disk is too slow")

    def _end(self, why: str) -> None:
        if self.status == RECORDING:
            self.status = why
        self._writer.wake()

    def work(self) -> bool:
        """Write what waits; say whether there is more to come.  Called by the thread, and by nothing else."""
        ended = self.status != RECORDING  # seen before the samples are taken, so that all of them are
        try:
            self._flush()
            if self._file is not None and (ended or self._file.tell() > PART_BYTES):
                self._run.finish(dropped=+self._dropped)
                os.fsync(self._file.fileno())
                self._file.close()
                self._file, self._dropped = None, Counter()
            if ended and not self.files and self.status == FINISHED:
                self.status = NOTHING_KEPT
        except OSError as error:
            ended, reason = True, f"cannot be written ({error.strerror or error})"
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                reason = "no space left on the disk"
            elif isinstance(error, FileNotFoundError):
                reason = "the folder was removed"
            self.status = f"stopped: {reason}"
        except Exception as error:  # of this recording: the thread serves the others
            ended, self.status = True, f"stopped: {type(error).__name__}: {error}"
        if ended:
            if self._file is not None:
                with suppress(OSError):  # a full disk: what was written before stays readable
                    self._file.close()
            self._waiting = []
            self.settled.set()
        return not ended

    def _flush(self) -> None:
        """Write what waits to the file, and wait until it is on the disk."""
        with self._lock:
            waiting, self._waiting, self._n_waiting = self._waiting, [], 0
        by_stream: dict[str, list[Any]] = {}
        for name, content in waiting:
            by_stream.setdefault(name, []).append(content)
        windows = by_stream.pop(WINDOW, [])
        blocks = {name: self._stampable(np.concatenate(rows)) for name, rows in by_stream.items()}
        if not any(map(len, blocks.values())) and (self._file is None or not windows):
            return
        file = self._file or self._begin()
        for name, rows in blocks.items():
            if len(rows):
                self._run.append(name, self._channels[name], rows[:, 0], rows[:, 1:])
        for output in windows:
            if 0.0 <= output.end_s - self._origin_s < LATEST_S:
                accepted = output.terrain and output.probability >= SWITCHING.probability_least
                window = RecordedWindow(**output._asdict(), doubtful=not accepted)
                self._run.append_text(WINDOW_TOPIC, output.end_s, window.model_dump_json())
        self._run.flush()
        os.fsync(file.fileno())
        if not os.fstat(file.fileno()).st_nlink:
            raise FileNotFoundError(f"{self.files[-1]} was removed")
        if shutil.disk_usage(self._folder).free < FREE_BYTES:
            self._end(f"stopped: less than {FREE_BYTES >> 20} MiB are free on the disk")

    def _stampable(self, rows: Array) -> Array:
        """Return the rows whose times the stamps of messages can hold, and count the others."""
        time_s = rows[:, 0]
        finite = np.isfinite(time_s)
        if np.isnan(self._origin_s) and finite.any():
            first_s = float(time_s[finite][0])
            self._origin_s = 0.0 if 0.0 <= first_s < LATEST_S / 2 else np.floor(first_s) - 3600.0
        held = finite & (time_s >= self._origin_s) & (time_s < self._origin_s + LATEST_S)
        self._dropped[BAD_TIME] += int((~held).sum())
        return rows[held]

    def _begin(self) -> BinaryIO:
        """Begin a file that no other recording has."""
        self._folder.mkdir(parents=True, exist_ok=True)
        first = self.files[0].stem if self.files else ""
        base = f"{first}_part{len(self.files) + 1}" if first else self._head.run_id
        for name in chain([base], (f"{base}_{number}" for number in count(2))):
            path = self._folder / f"{name}.mcap"
            with suppress(FileExistsError):
                file = self._file = path.open("xb")
                break
        head = self._head.model_copy(update={"run_id": name, "session": first or name})
        self._run = RunRecorder(McapWriter(file, head), head, self._origin_s)
        self.files.append(path)
        return file


class RecordingThread:
    """A thread that writes any number of recordings, one after the other.

    Raises
    ------
    ConfigError
        if mcap is not installed.

    Examples
    --------
    >>> writer = RecordingThread()
    >>> writer.stop()
    True
    """

    def __init__(self) -> None:
        # imports now what would hold up the sessions later
        McapWriter(BytesIO(), RunHead(run_id="", robot="", source="", labels=[]))
        self._stopped = False
        self._recordings: list[SessionRecorder] = []
        self._woken = threading.Event()
        self._thread = threading.Thread(target=self._write, name="recording", daemon=True)
        self._thread.start()

    def add(self, recording: SessionRecorder) -> None:
        """Write a recording from now on."""
        self._recordings.append(recording)

    def wake(self) -> None:
        """Write now: a recording has ended."""
        self._woken.set()

    def stop(self, timeout_s: float = 10.0) -> bool:
        """Close and write all recordings, and end; say whether there was time for it."""
        self._stopped = True
        self.wake()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _write(self) -> None:
        while not self._stopped or self._recordings:
            self._woken.wait(FLUSH_S)
            self._woken.clear()
            for one in tuple(self._recordings):
                if self._stopped:
                    one.close()
                if not one.work():
                    self._recordings.remove(one)
