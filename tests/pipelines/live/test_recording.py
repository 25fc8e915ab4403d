"""A recording is a log like any other, and whole at each flush: whatever happens to its process, disk or folder."""

import errno
import os
import shutil
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

import pipelines.live.recording as recording
from pipelines.data.bag_runs import recorded_windows
from pipelines.data.datasets import load_runs
from pipelines.learn.predict import predict
from pipelines.live.chain import Step
from pipelines.live.classifying import Classifier, WindowOutput
from pipelines.live.observer import Observer
from pipelines.live.pilot import LivePilot
from pipelines.live.recording import RecordingThread, SessionRecorder
from terrain.control.slip_table import load_slip_table
from terrain.errors import LogError
from terrain.estimation.live import CHANNELS as OF_SWERVE
from terrain.logs.replay import replay
from terrain.logs.run_topics import APART, DEAD_STREAM, SHORT_STREAM
from terrain.logs.samples import BAD_TIME, DEAD_CHANNEL
from terrain.records import Reading, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate
from terrain.simulation.scenario import make_scenario
from terrain.terramechanics.soil import load_soil

from . import until

AGRIMARO = load_robot("agrimaro")
IMU = ("gyro_z_radps", "accel_z_mps2")
CHANNELS = {"imu": IMU, "wheels": ("speed_left_mps", "speed_right_mps")}


@pytest.fixture
def writer(monkeypatch):
    monkeypatch.setattr(recording, "FLUSH_S", 0.05)
    thread = RecordingThread()
    yield thread
    thread.stop()


@pytest.fixture
def recorder(writer, tmp_path):
    return SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer)


def sample(time_s, n=1):
    stamps = time_s + np.arange(n) / 50
    values = np.column_stack([np.sin(stamps), np.cos(stamps)])
    return {"imu": Reading(stamps, values), "wheels": Reading(stamps, values)}


def recorded(recorder, n=50, start=0):
    for k in range(start, start + n):
        recorder.readings(sample(k / 50))
    return recorder


def closed(recorder):
    """The files of a recording that is ended."""
    recorder.close()
    assert recorder.settled.wait(10.0)
    return recorder.files


def read(path):
    (run,) = load_runs(path)
    return run


# A log like any other


def assert_predicted_as_live(path, model):
    """Predicted, a recorded run gives what the live chain gave; return it."""
    run, windows = read(path), recorded_windows(path)[1]
    rows = predict([run], model, load_slip_table()).windows
    assert not run.dropped
    assert len(rows) >= 4
    assert [(w.start_s, w.terrain) for w in windows] == [(row.start_s, row.terrain) for row in rows]
    assert [w.probability for w in windows] == pytest.approx([row.probability for row in rows], abs=1e-12)
    assert [w.doubtful for w in windows] == [row.probability < 0.5 for row in rows]
    return run


@pytest.mark.parametrize("begin_s", [{}, {"imu": 0.73}, {"wheels": 1.31}])
def test_a_recorded_observer_is_predicted_as_it_was_live(writer, tmp_path, mower_model, two_drives, begin_s):
    run = two_drives[4]
    kept = {name: stream.time_s >= begin_s.get(name, 0.0) for name, stream in run.streams.items()}
    streams = {n: Stream(s.time_s[kept[n]], s.values[kept[n]], s.channels) for n, s in run.streams.items()}
    channels = {name: stream.channels for name, stream in streams.items()}
    recorder = SessionRecorder(tmp_path / "new", "session", "mower", channels, writer=writer)
    observer = Observer(mower_model, channels=channels)
    for each in replay(replace(run, streams=streams), 20.0):
        recorder.readings(each.readings)
        recorder.step(each.time_s, each.twist, observer.take(each))
    assert recorder.status == "recording"
    (path,) = closed(recorder)
    assert (recorder.status, path) == ("finished", tmp_path / "new" / "session.mcap")
    again = assert_predicted_as_live(path, mower_model)
    assert (again.run_id, again.robot, again.session) == ("session", "mower", "session")
    for name, stream in streams.items():
        np.testing.assert_array_equal(again.streams[name].time_s, stream.time_s)
        np.testing.assert_array_equal(again.streams[name].values, stream.values)


def test_a_recorded_pilot_is_predicted_as_it_was_live_and_desires_the_same_motion(
    writer, tmp_path, swerve_model
):
    recorder = SessionRecorder(tmp_path, "drive", "agrimaro", OF_SWERVE, AGRIMARO.wheels, writer=writer)
    pilot = LivePilot(AGRIMARO, source=Classifier(swerve_model, AGRIMARO))
    twists, commands = [], []

    def session(each):
        recorder.readings(each.readings)
        twists.append(each.twist)
        done = pilot.take(each)
        commands.append(done.command)
        recorder.step(each.time_s, each.twist, done)
        return done.command

    drive = make_scenario("survey", AGRIMARO, "grass", 12.0, seed=5)
    simulate(AGRIMARO, drive, {"grass": load_soil("grass")}, 1, controller=session, command_delay_s=0.05)
    run = assert_predicted_as_live(closed(recorder)[0], swerve_model)
    wheels = [[*twist, *one.wheel_radps, *one.steer_rad] for twist, one in zip(twists, commands, strict=True)]
    assert run.streams["commands"].channels[:4] == (
        *("speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
        "wheel_1_radps",
    )
    np.testing.assert_array_equal(run.streams["commands"].values, wheels)
    np.testing.assert_array_equal([one.twist for one in replay(run)], twists)
    assert set(run.streams["control"].channels) == set(commands[0].status)


def test_stamps_of_any_clock_come_back_as_they_were(writer, tmp_path):
    for origin_s in (0.0, 1.7e9, -50.0, 5e9):
        recorder = SessionRecorder(tmp_path, f"of_{origin_s:g}", "husky", CHANNELS, writer=writer)
        stamps = origin_s + np.arange(20) / 50
        recorder.readings({name: Reading(stamps, np.ones((20, 2))) for name in CHANNELS})
        np.testing.assert_array_equal(read(closed(recorder)[0]).streams["imu"].time_s, stamps)


def test_windows_of_any_class_are_in_the_file(recorder):
    recorded(recorder)
    given = (("a/b: c", 0.9, "", False), ("a/b: c", 0.4, "", True), ("", np.nan, "NaN", True))
    for k, (terrain, probability, why, _) in enumerate(given):
        both, span_s = {"a/b: c": probability, "d": 1.0 - probability}, (2.0 * k, 2.0 * k + 2.0)
        output = WindowOutput(*span_s, terrain, probability, both, why)
        recorder.step(1.0, np.zeros(3), Step([output]))
    _, windows = recorded_windows(closed(recorder)[0])
    assert [(w.doubtful, w.refused) for w in windows] == [(doubtful, why) for *_, why, doubtful in given]
    assert windows[0].probabilities == {"a/b: c": 0.9, "d": pytest.approx(0.1)}


def test_what_a_run_cannot_hold_is_dropped_and_counted(writer, tmp_path):
    others = {"odometry": ("speed_x_mps",), "gnss": ("position_x_m",), "steering": ("angle_1_rad",)}
    recorder = SessionRecorder(tmp_path, "rough", "husky", CHANNELS | others, writer=writer)
    for k in range(50):
        time_s, values = np.array([k / 50]), np.array([[np.nan, np.inf if k == 3 else 1.0]])
        recorder.readings({"imu": Reading(time_s, values), "wheels": Reading(time_s, np.ones((1, 2)))})
    recorder.readings({"wheels": Reading(np.array([0.5, np.nan, 99.0, 1.0]), np.ones((4, 2)))})
    recorder.readings({"odometry": Reading(np.array([0.1]), np.ones((1, 1)))})
    recorder.readings({"gnss": Reading(np.array([500.0, 500.1]), np.ones((2, 1)))})
    recorder.readings({"steering": Reading(np.array([0.0, 1.0]), np.full((2, 1), np.nan))})
    run = read(closed(recorder)[0])
    assert set(run.streams) == {"imu", "wheels"}
    assert run.streams["imu"].channels == ("accel_z_mps2",)
    assert np.isnan(run.streams["imu"].values[3, 0])
    assert len(run.streams["wheels"]) == 51
    assert run.dropped == {BAD_TIME: 3, DEAD_CHANNEL: 2, SHORT_STREAM: 1, APART: 1, DEAD_STREAM: 1}


def test_names_that_are_not_accepted_are_refused_at_once(writer, tmp_path):
    channels = [("gyro",), (), ("time_s",), ("gyro_z_radps", "gyro_z_radps")]
    refused = [{"imu": names} for names in channels] + [{name: IMU} for name in ("../imu", "commands")]
    for run_id, given in (("../field", CHANNELS), *(("field", one) for one in refused)):
        with pytest.raises(LogError):
            SessionRecorder(tmp_path, run_id, "husky", given, writer=writer)
    assert list(tmp_path.iterdir()) == []


# Whole at each flush


def test_a_second_recording_of_a_name_gets_another_and_nothing_is_kept_of_one_without_samples(
    recorder, writer, tmp_path
):
    assert closed(recorder) == []
    assert recorder.status == "finished: nothing to keep"
    others = [SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer) for _ in range(2)]
    assert [closed(recorded(other))[0].name for other in others] == ["field.mcap", "field_2.mcap"]
    assert {read(path).run_id for path in tmp_path.iterdir()} == {"field", "field_2"}


def test_a_recording_goes_on_in_files_without_a_gap(recorder, monkeypatch):
    monkeypatch.setattr(recording, "PART_BYTES", 20_000)
    n = 0
    while len(recorder.files) < 3:
        recorded(recorder, 50, n)
        n += 50
        until(lambda: not recorder._waiting)
    closed(recorder)
    names = [path.name for path in recorder.files[:3]]
    assert names == ["field.mcap", "field_part2.mcap", "field_part3.mcap"]
    runs = [read(path) for path in recorder.files]
    assert {run.session for run in runs} == {"field"}
    assert [run.run_id for run in runs] == [path.stem for path in recorder.files]
    for name in CHANNELS:
        stamps = np.concatenate([run.streams[name].time_s for run in runs])
        np.testing.assert_array_equal(stamps, np.arange(n) / 50)


def test_samples_that_come_while_others_are_written_are_in_the_run(recorder, monkeypatch):
    """The session ends while the thread writes: what came since is written before the file ends."""
    fsync, ended = os.fsync, []

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


def test_a_full_disk_ends_a_recording_and_keeps_what_was_written(recorder, writer, tmp_path, monkeypatch):
    """Where little room is left, with a whole file; where there is none, with what it holds."""

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    recorded(recorder)
    until(lambda: recorder.files and recorder.files[0].stat().st_size)  # it is on the disk
    with monkeypatch.context() as patch:
        patch.setattr(recording.RunRecorder, "append", full)
        recorded(recorder, 10, 50)
        assert recorder.settled.wait(10.0)
    assert recorder.status == "stopped: no space left on the disk"
    assert len(read(closed(recorded(recorder, 10, 60))[0]).streams["imu"]) == 50
    monkeypatch.setattr(recording, "FREE_BYTES", 1 << 60)
    last = recorded(SessionRecorder(tmp_path, "last", "husky", CHANNELS, writer=writer))
    assert last.settled.wait(10.0)
    assert last.status.startswith("stopped: less than ")
    assert len(read(last.files[0]).streams["imu"]) == 50


def test_a_folder_that_is_removed_or_cannot_be_made_ends_its_recording_and_no_other(writer, tmp_path):
    (tmp_path / "file").write_text("")
    one, other, no_folder = (
        recorded(SessionRecorder(tmp_path / name, "field", "husky", CHANNELS, writer=writer))
        for name in ("one", "other", "file/runs")
    )
    until(lambda: one.files and not one._waiting)
    shutil.rmtree(tmp_path / "one")
    for recorder in (one, other):
        recorded(recorder, 50, 50)
    assert one.settled.wait(10.0)
    assert one.status == "stopped: the folder was removed"
    assert len(read(closed(other)[0]).streams["imu"]) == 100
    assert closed(no_folder) == []
    assert no_folder.status == "stopped: cannot be written (Not a directory)"


def test_memory_is_bounded_where_the_disk_hangs(recorder, monkeypatch):
    hangs = threading.Event()
    monkeypatch.setattr(recording.os, "fsync", lambda _: hangs.wait(20.0))
    monkeypatch.setattr(recording, "MAX_WAITING_BYTES", 100_000)
    for k in range(200):
        recorder.readings(sample(k, n=50))
        if k == 0:
            until(lambda: not recorder._waiting)
        if recorder.status != "recording":
            break
    assert recorder.status == "stopped: the disk is too slow"
    assert sum(rows.nbytes for _, rows in recorder._waiting) < 110_000
    hangs.set()
    assert len(read(closed(recorder)[0]).streams["imu"]) == 50 * (k + 1)


def test_a_file_that_ends_anywhere_gives_all_chunks_that_are_whole(recorder, tmp_path):
    sizes = []
    for k in range(4):
        recorder.readings(sample(k / 5, n=10))
        until(lambda: not recorder._waiting)
        time.sleep(0.1)
        sizes.append(recorder.files[0].stat().st_size)
    whole, torn = closed(recorder)[0].read_bytes(), tmp_path / "torn.mcap"
    for cut in sorted({*np.linspace(sizes[0], len(whole), 15).astype(int).tolist(), *sizes}):
        torn.write_bytes(whole[:cut])
        stamps = read(torn).streams["imu"].time_s
        assert len(stamps) >= 10 * sum(size <= cut for size in sizes)
        np.testing.assert_allclose(stamps, np.arange(40)[: len(stamps)] / 50, atol=1e-9)


def test_stop_ends_what_was_not_closed(tmp_path):
    writer = RecordingThread()
    recorder = recorded(SessionRecorder(tmp_path, "field", "husky", CHANNELS, writer=writer))
    assert writer.stop()
    assert recorder.status == "finished"
    assert list(read(recorder.files[0]).streams) == ["imu", "wheels"]
