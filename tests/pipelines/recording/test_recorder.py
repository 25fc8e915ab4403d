"""A session's recording is a whole run folder or a journal that becomes one, whatever happens to it."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import pipelines.live.recording as recorders
from pipelines.data.datasets import data_digest, load_runs
from pipelines.data.recorded_windows import WINDOWS_FILE, read_windows
from pipelines.live.classifying import WindowOutput
from pipelines.live.recording import (
    BAD_COMMAND,
    UNKNOWN_STREAM,
    UNREADABLE,
    RecordingLimits,
    SessionRecorder,
)
from pipelines.recording import journal as journals
from pipelines.recording.finishing import APART, SHORT_STREAM, recover_recordings
from pipelines.recording.thread import RecordingThread
from terrain.errors import LogError
from terrain.logs.read import read_run
from terrain.logs.replay import replay
from terrain.logs.samples import BAD_TIME, DEAD_CHANNEL
from terrain.records import Command, Reading

IMU, WHEELS = ("gyro_z_radps", "accel_z_mps2"), ("speed_left_mps", "speed_right_mps")
CHANNELS = {"imu": IMU, "wheels": WHEELS}


@pytest.fixture
def writer():
    thread = RecordingThread(flush_s=0.02)
    yield thread
    assert thread.stop()


def sample(time_s, n=1, period_s=0.02):
    stamps = time_s + period_s * np.arange(n)
    return {
        "imu": Reading(stamps, np.column_stack([np.sin(stamps), np.cos(stamps)])),
        "wheels": Reading(stamps, np.full((n, 2), 0.5)),
    }


def output(start_s, terrain="grass", probability=0.9, refused=""):
    probabilities = np.array([probability, 1 - probability])
    return WindowOutput(
        start_s, start_s + 2, terrain, probability, probabilities, ("grass", "a/b: c"), refused
    )


def recorded(recorder, n=50):
    for k in range(n):
        recorder.readings(sample(k / 50))


def until(condition, timeout_s=10.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "it did not happen"
        time.sleep(0.005)


def test_what_was_recorded_is_a_strict_run_folder_with_all_samples(writer, tmp_path):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, source="test", writer=writer)
    recorded(recorder)
    assert recorder.status == "recording"
    folder = recorder.close(10.0)
    assert folder == tmp_path / "field"
    assert recorder.status == "finished"
    run = read_run(folder)
    assert (run.run_id, run.robot, run.labels, run.source, dict(run.dropped)) == (
        "field",
        "husky",
        (),
        "test",
        {},
    )
    assert run.streams["imu"].channels == IMU
    np.testing.assert_array_equal(run.streams["imu"].time_s, np.arange(50) / 50)
    np.testing.assert_array_equal(run.streams["imu"].values[:, 1], np.cos(np.arange(50) / 50))
    assert [path.name for path in tmp_path.iterdir()] == ["field"]


def test_samples_that_come_while_others_are_written_are_in_the_run(writer, tmp_path, monkeypatch):
    """The session ends while the thread writes: what came since is written before the run is made."""
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    append, ended = journals.Journal.append, []

    def end_meanwhile(journal, records):
        append(journal, records)
        if records[0].blocks and not ended:
            recorder.readings(sample(7.0))
            ended.append(recorder.close())

    monkeypatch.setattr(journals.Journal, "append", end_meanwhile)
    recorded(recorder)
    until(lambda: recorder.settled)
    assert ended == [None]
    assert read_run(recorder.folder).streams["wheels"].time_s[-1] == 7.0


def test_commands_are_those_of_simulated_runs_and_replay_desires_the_same_motion(writer, tmp_path):
    recorder = SessionRecorder(tmp_path, "drive", "agrimaro", CHANNELS, ("1", "2", "3"), writer=writer)
    command = Command(np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]), np.zeros(3), {})
    for k in range(50):
        recorder.readings(sample(k / 50))
        status = {"status_code": 2.0, "slip_ratio": np.nan}
        recorder.command(k / 50, np.array([0.5, 0.0, k / 100]), command, status)
    recorder.command(1.0, [np.nan, 0, 0], command, status)
    recorder.command(1.02, None, command, {"another_code": 1.0})
    recorder.command(1.02, None, "no command", status)
    run = read_run(recorder.close(10.0))
    assert run.streams["commands"].channels == (
        *("speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
        *("wheel_1_radps", "wheel_2_radps", "wheel_3_radps", "steer_1_rad", "steer_2_rad", "steer_3_rad"),
    )
    assert run.streams["commands"].values[-1].tolist() == [0, 0, 0, 1, 2, 3, 0.1, 0.2, 0.3]
    assert run.streams["control"].channels == ("status_code", "slip_ratio")
    assert run.dropped == {BAD_COMMAND: 2}
    desired = [one.twist.tolist() for one in replay(run)]
    assert desired == [[0.5, 0.0, k / 100] for k in range(50)]


def test_windows_are_kept_beside_the_streams_and_do_not_change_the_run(writer, tmp_path):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    recorded(recorder)
    for one in (output(0.0), output(2.0, probability=0.4), output(4.0, "", np.nan, "NaN in it")):
        recorder.window(one)
    recorder.window("no output")
    folder = recorder.close(10.0)
    windows = read_windows(folder)
    assert [(w.start_s, w.end_s, w.terrain, w.doubtful, w.refused) for w in windows] == [
        (0.0, 2.0, "grass", False, ""),
        (2.0, 4.0, "grass", True, ""),
        (4.0, 6.0, "", True, "NaN in it"),
    ]
    assert windows[0].probabilities == {"grass": 0.9, "a/b: c": pytest.approx(0.1)}
    digest = data_digest(load_runs(tmp_path))
    (folder / WINDOWS_FILE).unlink()
    assert data_digest(load_runs(tmp_path)) == digest
    assert read_windows(folder) is None
    (folder / WINDOWS_FILE).write_text("[" * 100_000)
    with pytest.raises(LogError, match=r"field/windows.json: is damaged"):
        read_windows(folder)


def test_what_a_strict_folder_cannot_hold_is_dropped_and_counted(writer, tmp_path):
    channels = CHANNELS | {
        "odometry": ("speed_x_mps",),
        "gnss": ("position_x_m",),
        "steering": ("angle_1_rad",),
    }
    recorder = SessionRecorder(tmp_path, "rough", "husky", channels, writer=writer)
    for k in range(50):
        reading = sample(k / 50)
        recorder.readings(
            {"imu": Reading(reading["imu"].time_s, np.array([[np.nan, np.inf if k == 3 else 1.0]]))}
        )
        recorder.readings({"wheels": reading["wheels"]})
    recorder.readings({"wheels": Reading(np.array([0.5, np.nan, 99.0, 1.0]), np.ones((4, 2)))})
    recorder.readings({"odometry": Reading(np.array([0.1]), np.ones((1, 1)))})
    recorder.readings({"gnss": Reading(np.array([500.0, 500.1]), np.ones((2, 1)))})
    recorder.readings({"steering": Reading(np.array([0.0, 1.0]), np.full((2, 1), np.nan))})
    for broken in (None, {"imu": 3}, {"imu": Reading(np.array([1.0]), np.ones((1, 5)))}, {"x": 1}, {3: 4}):
        recorder.readings(broken)
    run = read_run(recorder.close(10.0))
    assert set(run.streams) == {"imu", "wheels"}
    assert run.streams["imu"].channels == ("accel_z_mps2",)
    assert np.isnan(run.streams["imu"].values[3, 0])
    assert len(run.streams["wheels"]) == 51
    assert run.dropped == {
        BAD_TIME: 3,
        DEAD_CHANNEL: 2,
        SHORT_STREAM: 1,
        APART: 1,
        "streams with nothing finite": 1,
        UNREADABLE: 3,
        UNKNOWN_STREAM: 2,
    }


def test_a_second_run_of_a_name_gets_another(writer, tmp_path):
    (tmp_path / "field_2").mkdir()
    one, other = (SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer) for _ in range(2))
    for recorder in (one, other):
        recorded(recorder)
    assert (one.close(10.0), other.close(10.0)) == (tmp_path / "field", tmp_path / "field_3")
    assert read_run(other.folder).run_id == "field_3"
    third = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    recorded(third)
    assert third.close(10.0) == tmp_path / "field_4"
    assert third.run_id == "field_4"


def test_nothing_is_kept_of_a_session_without_samples(writer, tmp_path):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    assert recorder.close(10.0) is None
    assert recorder.status == "finished: nothing to keep"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("run_id", "channels"),
    [
        ("../field", CHANNELS),
        ("field", {"../imu": IMU}),
        ("field", {"commands": IMU}),
        ("field", {"imu": ("gyro",)}),
        ("field", {"imu": ()}),
        ("field", {"imu": ("time_s",)}),
        ("field", {"imu": ("gyro_z_radps", "gyro_z_radps")}),
    ],
)
def test_names_that_are_not_accepted_are_refused_at_once(writer, tmp_path, run_id, channels):
    with pytest.raises(LogError):
        SessionRecorder(tmp_path, run_id, "husky", channels, writer=writer)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_stops_the_recording_and_keeps_what_was_written(writer, tmp_path, monkeypatch):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    recorded(recorder, 50)
    until(lambda: not recorder._waiting)
    until(lambda: (tmp_path / ".field.recording").stat().st_size > 2000)
    full, write = [True], os.write

    def short_write(descriptor, content):
        if not full[0]:
            return write(descriptor, content)
        if len(content) < 20:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(descriptor, bytes(content[: len(content) // 2]))

    def no_room(*_, **__):
        if full[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(journals.os, "write", short_write)
    monkeypatch.setattr("terrain.logs.write._write_parquet", no_room)
    for k in range(50, 60):
        recorder.readings(sample(k / 50))
    until(lambda: recorder.settled)
    assert recorder.status == "stopped: no space left on the disk"
    for k in range(60, 70):
        recorder.readings(sample(k / 50))
    assert recorder.close() is None
    assert [path.name for path in tmp_path.iterdir()] == [".field.recording"]
    monkeypatch.undo()
    (folder,) = recover_recordings(tmp_path)
    run = read_run(folder)
    assert len(run.streams["imu"]) == 50
    assert run.source == "recorded live, recovered after a stop"
    assert recover_recordings(tmp_path) == []


def test_a_disk_that_is_full_from_the_start_leaves_nothing(writer, tmp_path, monkeypatch):
    def no_room(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(journals.os, "write", no_room)
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    recorded(recorder)
    until(lambda: recorder.settled)
    assert (recorder.status, recorder.folder) == ("stopped: no space left on the disk", None)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_removed_stops_the_recording_and_no_other(writer, tmp_path):
    one = SessionRecorder(tmp_path / "one", "field", "husky", CHANNELS, writer=writer)
    other = SessionRecorder(tmp_path / "other", "field", "husky", CHANNELS, writer=writer)
    until(lambda: (tmp_path / "one" / ".field.recording").exists())
    shutil.rmtree(tmp_path / "one")
    for recorder in (one, other):
        recorded(recorder)
    until(lambda: one.settled)
    assert one.status == "stopped: the folder was removed"
    assert other.close(10.0) == tmp_path / "other" / "field"


def test_a_place_that_cannot_be_made_is_a_status(writer, tmp_path):
    (tmp_path / "file").write_text("")
    recorder = SessionRecorder(tmp_path / "file" / "runs", "field", "husky", CHANNELS, writer=writer)
    recorded(recorder)
    assert recorder.close(10.0) is None
    assert recorder.status == "stopped: cannot be written (Not a directory)"


@pytest.mark.parametrize(
    ("limits", "why"),
    [
        (RecordingLimits(max_bytes=2000), "stopped: limit of 0.00190735 MiB reached"),
        (RecordingLimits(max_hours=0.05 / 3600), "stopped: limit of 1.38889e-05 h reached"),
    ],
)
def test_a_limit_ends_a_recording_with_a_run_folder(writer, tmp_path, limits, why):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer, limits=limits)
    recorded(recorder)
    until(lambda: recorder.settled)
    assert recorder.status == why
    assert len(read_run(recorder.folder).streams["imu"]) >= 2


def test_memory_is_bounded_where_the_disk_hangs(writer, tmp_path, monkeypatch):
    hangs = threading.Event()
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    until(lambda: (tmp_path / ".field.recording").exists())
    monkeypatch.setattr(journals.os, "fsync", lambda _: hangs.wait(20.0))
    monkeypatch.setattr(recorders, "MAX_WAITING_BYTES", 100_000)
    for k in range(200):
        recorder.readings(sample(k, n=50))
        if k == 0:
            until(lambda: not recorder._waiting)
        if recorder.status != "recording":
            break
    assert recorder.status == "stopped: the disk is too slow"
    assert sum(rows.nbytes for _, rows in recorder._waiting) < 110_000
    hangs.set()
    folder = recorder.close(10.0)
    assert len(read_run(folder).streams["imu"]) == 50 * (k + 1)


KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
import numpy as np
from pipelines.live.recording import SessionRecorder
from pipelines.recording.thread import RecordingThread
from terrain.records import Reading
recorder = SessionRecorder(
    Path(sys.argv[1]), "field", "husky", {"imu": ("gyro_z_radps",)}, writer=RecordingThread(0.05)
)
for k in range(1_000_000):
    recorder.readings({"imu": Reading(np.array([k / 100]), np.array([[float(k)]]))})
    time.sleep(0.001)
"""


def test_a_killed_process_loses_only_what_was_not_written_yet(tmp_path):
    root = str(recorders.Path(recorders.__file__).parents[2])
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path), root])
    path = tmp_path / ".field.recording"
    try:
        until(lambda: path.exists() and path.stat().st_size > 5000, 60.0)
        assert recover_recordings(tmp_path) == [], "a recording that goes on is left to its process"
        assert path.exists()
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    with path.open("ab") as file:
        file.write(path.read_bytes()[:30])  # a record that was begun
    (folder,) = recover_recordings(tmp_path)
    values = read_run(folder).streams["imu"].values[:, 0]
    np.testing.assert_array_equal(values, np.arange(values.size))
    assert values.size > 50
    assert not path.exists()


@pytest.mark.parametrize("cut", [0, 5, 40, 200, 900, 1500])
def test_a_torn_journal_gives_what_is_whole_and_never_raises(writer, tmp_path, cut):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    for k in range(4):
        recorder.readings(sample(k / 5, n=10))
        until(lambda: not recorder._waiting)
    time.sleep(0.1)
    whole = (tmp_path / ".field.recording").read_bytes()
    recorder.close(10.0)
    shutil.rmtree(tmp_path / "field")
    torn = tmp_path / ".field.recording"
    torn.write_bytes(whole[:cut] if cut else b"")
    os.utime(torn, (1, 1))
    found = recover_recordings(tmp_path)
    assert len(found) == (cut > 500)
    if found:
        stamps = read_run(found[0]).streams["imu"].time_s
        assert len(stamps) % 10 == 0
        np.testing.assert_allclose(
            stamps, np.concatenate([k / 5 + np.arange(10) / 50 for k in range(4)])[: len(stamps)]
        )


def test_nothing_is_taken_from_a_record_that_was_spoilt(writer, tmp_path):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    path = tmp_path / ".field.recording"
    sizes = []
    for k in range(3):
        recorder.readings(sample(k / 5, n=10))
        until(lambda least=(k + 1) * 400: path.exists() and path.stat().st_size > least)
        sizes.append(path.stat().st_size)
    content = bytearray(path.read_bytes())
    content[sizes[1] - 40] ^= 1  # the last samples of the second of three
    recorder.close(10.0)
    shutil.rmtree(tmp_path / "field")
    path.write_bytes(content)
    (folder,) = recover_recordings(tmp_path)
    np.testing.assert_allclose(read_run(folder).streams["imu"].time_s, np.arange(10) / 50)


def test_foreign_files_stay_and_a_folder_that_is_not_there_is_empty(tmp_path):
    (tmp_path / ".odd.recording").write_text("not one of these")
    (tmp_path / ".new.recording").write_bytes(b"")
    assert recover_recordings(tmp_path) == []
    assert {path.name for path in tmp_path.iterdir()} == {".odd.recording", ".new.recording"}
    assert recover_recordings(tmp_path / "nowhere") == []


def test_stop_writes_what_was_not_closed(tmp_path):
    writer = RecordingThread(flush_s=60.0)
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    recorded(recorder)
    assert writer.stop()
    assert recorder.folder == tmp_path / "field"
    head = json.loads((recorder.folder / "run.json").read_text())
    assert list(head["streams"]) == ["imu", "wheels"]
