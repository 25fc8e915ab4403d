"""A recording is a file that is whole at each flush: whatever happens to its process, disk or folder."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import pipelines.live.recording as recording
from pipelines.data.bag_runs import recorded_windows
from pipelines.data.datasets import load_runs
from pipelines.live.classifying import WindowOutput
from pipelines.live.recording import RecordingThread, SessionRecorder
from terrain.errors import LogError
from terrain.logs.replay import replay
from terrain.logs.run_topics import APART, DEAD_STREAM, SHORT_STREAM
from terrain.logs.samples import BAD_TIME, DEAD_CHANNEL
from terrain.records import Command, Reading

IMU = ("gyro_z_radps", "accel_z_mps2")
CHANNELS = {"imu": IMU, "wheels": ("speed_left_mps", "speed_right_mps")}


@pytest.fixture
def writer():
    thread = RecordingThread(flush_s=0.05)
    yield thread
    thread.stop()


def sample(time_s, n=1):
    stamps = time_s + np.arange(n) / 50
    values = np.column_stack([np.sin(stamps), np.cos(stamps)])
    return {"imu": Reading(stamps, values), "wheels": Reading(stamps, values)}


def recorded(recorder, n=50, start=0):
    for k in range(start, start + n):
        recorder.readings(sample(k / 50))
    return recorder


def until(done, timeout_s=10.0):
    end_s = time.monotonic() + timeout_s
    while not done() and time.monotonic() < end_s:
        time.sleep(0.005)
    assert done()


def output(start_s, terrain="grass", probability=0.9, refused=""):
    probabilities = np.array([probability, 1.0 - probability])
    return WindowOutput(
        start_s, start_s + 2.0, terrain, probability, probabilities, ("grass", "a/b: c"), refused
    )


def read(path):
    (run,) = load_runs(path)
    return run


def test_what_was_recorded_is_the_run_that_it_was(writer, tmp_path):
    recorder = SessionRecorder(tmp_path / "new", "field", "husky", CHANNELS, source="test", writer=writer)
    assert recorder.status == "recording"
    (path,) = recorded(recorder).close(10.0)
    assert (recorder.status, path) == ("finished", tmp_path / "new" / "field.mcap")
    run = read(path)
    assert (run.run_id, run.robot, run.session, run.labels, run.source) == (
        "field",
        "husky",
        "field",
        (),
        "test",
    )
    assert dict(run.dropped) == {}
    assert run.streams["imu"].channels == IMU
    np.testing.assert_array_equal(run.streams["imu"].time_s, np.arange(50) / 50)
    np.testing.assert_array_equal(run.streams["imu"].values[:, 1], np.cos(np.arange(50) / 50))


@pytest.mark.parametrize("origin_s", [0.0, 1.7e9, -50.0, 5e9])
def test_stamps_of_any_clock_come_back_as_they_were(writer, tmp_path, origin_s):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    stamps = origin_s + np.arange(20) / 50
    recorder.readings({name: Reading(stamps, np.ones((20, 2))) for name in CHANNELS})
    run = read(recorder.close(10.0)[0])
    np.testing.assert_array_equal(run.streams["imu"].time_s, stamps)


def test_samples_that_come_while_others_are_written_are_in_the_run(writer, tmp_path, monkeypatch):
    """The session ends while the thread writes: what came since is written before the file ends."""
    recorder, fsync, ended = SessionRecorder(tmp_path, "f", "husky", CHANNELS, writer=writer), os.fsync, []

    def end_meanwhile(descriptor):
        if not ended:
            ended.append(True)
            recorder.readings(sample(7.0))
            recorder.close()
        fsync(descriptor)

    monkeypatch.setattr(recording.os, "fsync", end_meanwhile)
    recorded(recorder)
    assert recorder.settled.wait(10.0)
    assert read(recorder.files[0]).streams["wheels"].time_s[-1] == 7.0


def test_commands_are_those_of_simulated_runs_and_replay_desires_the_same_motion(writer, tmp_path):
    recorder = SessionRecorder(tmp_path, "drive", "agrimaro", CHANNELS, ("1", "2", "3"), writer=writer)
    figures = {"status_code": 2.0, "slip_ratio": np.nan}
    command = Command(np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]), np.zeros(3), figures)
    for k in range(50):
        recorder.readings(sample(k / 50))
        recorder.command(k / 50, np.array([0.5, 0.0, k / 100]), command)
    run = read(recorder.close(10.0)[0])
    assert run.streams["commands"].channels == (
        *("speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
        *("wheel_1_radps", "wheel_2_radps", "wheel_3_radps", "steer_1_rad", "steer_2_rad", "steer_3_rad"),
    )
    assert run.streams["commands"].values[-1].tolist() == [0.5, 0, 0.49, 1, 2, 3, 0.1, 0.2, 0.3]
    assert run.streams["control"].channels == ("status_code", "slip_ratio")
    assert [one.twist.tolist() for one in replay(run)] == [[0.5, 0.0, k / 100] for k in range(50)]


def test_windows_are_in_the_file(writer, tmp_path):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    recorded(recorder)
    for one in (output(0.0), output(2.0, probability=0.4), output(4.0, "", np.nan, "NaN in it")):
        recorder.window(one)
    run_id, windows = recorded_windows(recorder.close(10.0)[0])
    assert run_id == "field"
    assert [(w.start_s, w.end_s, w.terrain, w.doubtful, w.refused) for w in windows] == [
        (0.0, 2.0, "grass", False, ""),
        (2.0, 4.0, "grass", True, ""),
        (4.0, 6.0, "", True, "NaN in it"),
    ]
    assert windows[0].probabilities == {"grass": 0.9, "a/b: c": pytest.approx(0.1)}


def test_what_a_run_cannot_hold_is_dropped_and_counted(writer, tmp_path):
    others = {"odometry": ("speed_x_mps",), "gnss": ("position_x_m",), "steering": ("angle_1_rad",)}
    recorder = SessionRecorder(tmp_path, "rough", "husky", CHANNELS | others, writer=writer)
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
    run = read(recorder.close(10.0)[0])
    assert set(run.streams) == {"imu", "wheels"}
    assert run.streams["imu"].channels == ("accel_z_mps2",)
    assert np.isnan(run.streams["imu"].values[3, 0])
    assert len(run.streams["wheels"]) == 51
    assert run.dropped == {BAD_TIME: 3, DEAD_CHANNEL: 2, SHORT_STREAM: 1, APART: 1, DEAD_STREAM: 1}


def test_a_second_recording_of_a_name_gets_another(writer, tmp_path):
    one, other = (SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer) for _ in range(2))
    for recorder in (one, other):
        recorded(recorder).close(10.0)
    assert [one.files, other.files] == [[tmp_path / "field.mcap"], [tmp_path / "field_2.mcap"]]
    assert read(other.files[0]).run_id == "field_2"


def test_nothing_is_kept_of_a_session_without_samples(writer, tmp_path):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    assert recorder.close(10.0) == []
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


def test_a_recording_goes_on_in_files_without_a_gap(writer, tmp_path):
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer, part_bytes=20_000)
    n = 0
    while len(recorder.files) < 4:
        recorded(recorder, 50, n)
        n += 50
        until(lambda: not recorder._waiting)
    recorder.close(10.0)
    assert [path.name for path in recorder.files[:3]] == [
        "field.mcap",
        "field_part2.mcap",
        "field_part3.mcap",
    ]
    runs = [read(path) for path in recorder.files]
    assert {run.session for run in runs} == {"field"}
    assert [run.run_id for run in runs] == [path.stem for path in recorder.files]
    for name in CHANNELS:
        stamps = np.concatenate([run.streams[name].time_s for run in runs])
        np.testing.assert_array_equal(stamps, np.arange(n) / 50)


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_ends_a_recording_and_keeps_what_was_written(writer, tmp_path, monkeypatch):
    recorder = recorded(SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer))
    until(lambda: not recorder._waiting)
    monkeypatch.setattr(recording.RunRecorder, "append", full)
    recorded(recorder, 10, 50)
    assert recorder.settled.wait(10.0)
    assert recorder.status == "stopped: no space left on the disk"
    assert len(read(recorded(recorder, 10, 60).close()[0]).streams["imu"]) == 50


def test_little_room_on_the_disk_ends_a_recording_with_a_whole_file(writer, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "FREE_BYTES", 1 << 60)
    recorder = recorded(SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer))
    assert recorder.settled.wait(10.0)
    assert recorder.status.startswith("stopped: less than ")
    assert len(read(recorder.files[0]).streams["imu"]) == 50


def test_a_folder_that_is_removed_ends_the_recording_and_no_other(writer, tmp_path):
    one, other = (
        recorded(SessionRecorder(tmp_path / name, "field", "husky", CHANNELS, writer=writer))
        for name in ("one", "other")
    )
    until(lambda: one.files and not one._waiting)
    shutil.rmtree(tmp_path / "one")
    for recorder in (one, other):
        recorded(recorder, 50, 50)
    assert one.settled.wait(10.0)
    assert one.status == "stopped: the folder was removed"
    assert len(read(other.close(10.0)[0]).streams["imu"]) == 100


def test_a_place_that_cannot_be_made_is_a_status(writer, tmp_path):
    (tmp_path / "file").write_text("")
    recorder = SessionRecorder(tmp_path / "file" / "runs", "field", "husky", CHANNELS, writer=writer)
    assert recorded(recorder).close(10.0) == []
    assert recorder.status == "stopped: cannot be written (Not a directory)"


def test_memory_is_bounded_where_the_disk_hangs(writer, tmp_path, monkeypatch):
    hangs = threading.Event()
    monkeypatch.setattr(recording.os, "fsync", lambda _: hangs.wait(20.0))
    monkeypatch.setattr(recording, "MAX_WAITING_BYTES", 100_000)
    recorder = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)
    for k in range(200):
        recorder.readings(sample(k, n=50))
        if k == 0:
            until(lambda: not recorder._waiting)
        if recorder.status != "recording":
            break
    assert recorder.status == "stopped: the disk is too slow"
    assert sum(rows.nbytes for _, rows in recorder._waiting) < 110_000
    hangs.set()
    assert len(read(recorder.close(10.0)[0]).streams["imu"]) == 50 * (k + 1)


KILLED = """
import sys, time
from pathlib import Path
import numpy as np
from pipelines.live.recording import RecordingThread, SessionRecorder
from terrain.records import Reading
recorder = SessionRecorder(Path(sys.argv[1]), "f", "husky", {"imu": ("gyro_z_radps",)}, writer=RecordingThread())
for k in range(1_000_000):
    recorder.readings({"imu": Reading(np.array([time.monotonic()]), np.array([[float(k)]]))})
    time.sleep(0.005)
"""


def test_a_killed_process_loses_at_most_two_seconds(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)])
    path = tmp_path / "f.mcap"
    try:
        until(lambda: path.exists() and path.stat().st_size > 2000, 60.0)
        time.sleep(2.6)
    finally:
        killed_s = time.monotonic()
        process.send_signal(signal.SIGKILL)
        process.wait()
    imu = read(path).streams["imu"]
    np.testing.assert_array_equal(imu.values[:, 0], np.arange(len(imu)))
    assert killed_s - imu.time_s[-1] < 2.0


def test_a_file_that_ends_anywhere_gives_all_chunks_that_are_whole(writer, tmp_path):
    recorder, sizes = SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer), []
    for k in range(4):
        recorder.readings(sample(k / 5, n=10))
        until(lambda: not recorder._waiting)
        time.sleep(0.1)
        sizes.append(recorder.files[0].stat().st_size)
    whole = recorder.close(10.0)[0].read_bytes()
    torn = tmp_path / "torn.mcap"
    for cut in sorted({*np.linspace(sizes[0], len(whole), 25).astype(int).tolist(), *sizes}):
        torn.write_bytes(whole[:cut])
        stamps = read(torn).streams["imu"].time_s
        n_whole = 10 * sum(size <= cut for size in sizes)
        assert len(stamps) >= n_whole
        np.testing.assert_array_equal(
            stamps, (np.arange(40) // 10 / 5 + np.arange(40) % 10 / 50)[: len(stamps)]
        )


def test_stop_ends_what_was_not_closed(tmp_path):
    writer = RecordingThread(flush_s=60.0)
    recorder = recorded(SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer))
    assert writer.stop()
    assert recorder.status == "finished"
    assert list(read(recorder.files[0]).streams) == ["imu", "wheels"]
