"""A recorded session is a log like any other: predicted, it gives what the live chain gave."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.data.bag_runs import recorded_windows
from pipelines.data.datasets import load_runs
from pipelines.data.inspect import Settings as InspectSettings
from pipelines.data.inspect import run as inspect_runs
from pipelines.learn.crossval import EvaluationSettings
from pipelines.learn.predict import predict
from pipelines.learn.protocols import samples_of
from pipelines.live.observer import Observer
from pipelines.live.pilot import LivePilot
from pipelines.live.recording import RecordingThread, SessionRecorder
from pipelines.live.terrain_source import Classifier
from terrain.control.slip_table import load_slip_table
from terrain.estimation.live.estimator import CHANNELS
from terrain.logs.replay import replay
from terrain.records import Command, Label, RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.dynamic.simulate import simulate
from terrain.simulation.scenario.make import make_scenario
from terrain.terramechanics.soil import load_soil

AGRIMARO = load_robot("agrimaro")


@pytest.fixture
def writer():
    thread = RecordingThread(flush_s=0.05)
    yield thread
    thread.stop()


def cut_at_the_start(run, begin_s):
    """Return a run whose streams begin at different times."""
    streams = {}
    for name, stream in run.streams.items():
        kept = stream.time_s >= begin_s.get(name, 0.0)
        streams[name] = Stream(stream.time_s[kept], stream.values[kept], stream.channels)
    return replace(run, streams=streams)


def assert_same(windows, rows):
    assert [(w.start_s, w.terrain) for w in windows] == [(row.start_s, row.terrain) for row in rows]
    assert [w.probability for w in windows] == pytest.approx([row.probability for row in rows], abs=1e-12)
    assert [w.doubtful for w in windows] == [row.probability < 0.5 for row in rows]


@pytest.mark.parametrize("begin_s", [{}, {"imu": 0.73}, {"wheels": 1.31}])
def test_a_recorded_observer_is_predicted_as_it_was_live(writer, tmp_path, mower_model, two_drives, begin_s):
    run = cut_at_the_start(two_drives[4], begin_s)
    channels = {name: stream.channels for name, stream in run.streams.items()}
    recorder = SessionRecorder(tmp_path, "session", "mower", channels, writer=writer)
    observer = Observer(mower_model, channels=channels)
    for sample in replay(run, 20.0):
        recorder.readings(sample.readings)
        for output in observer.update(sample.readings):
            recorder.window(output)
    (path,) = recorder.close(10.0)
    (again,) = load_runs(path)
    assert not again.dropped
    rows = predict([again], mower_model, load_slip_table()).windows
    assert len(rows) >= 4
    assert_same(recorded_windows(path)[1], rows)


@pytest.mark.parametrize(
    "begin_s",
    [
        {},
        pytest.param({"imu": 0.73, "odometry": 1.9}, marks=pytest.mark.slow),
        pytest.param({"wheels": 1.31, "steering": 0.4}, marks=pytest.mark.slow),
    ],
)
def test_a_recorded_pilot_is_predicted_as_it_was_live(writer, tmp_path, swerve_model, begin_s):
    recorder = SessionRecorder(tmp_path, "drive", "agrimaro", CHANNELS, AGRIMARO.wheels, writer=writer)
    source = Classifier(swerve_model, AGRIMARO)
    pilot = LivePilot(AGRIMARO, source=source)
    commands = []

    def session(sample):
        readings = {
            name: each for name, each in sample.readings.items() if sample.time_s >= begin_s.get(name, 0.0)
        }
        recorder.readings(readings)
        commands.append(pilot.step(sample._replace(readings=readings)))
        recorder.command(sample.time_s, sample.twist, commands[-1])
        for output in source.outputs:
            recorder.window(output)
        return commands[-1]

    drive = make_scenario("survey", AGRIMARO, "grass", 24.0, seed=5)
    simulate(AGRIMARO, drive, {"grass": load_soil("grass")}, 1, controller=session, command_delay_s=0.05)
    (path,) = recorder.close(10.0)
    (again,) = load_runs(path)
    assert not again.dropped
    rows = predict([again], swerve_model, load_slip_table()).windows
    assert len(rows) >= 4
    assert_same(recorded_windows(path)[1], rows)
    wheel_radps = [again.streams["commands"].channel(f"wheel_{wheel}_radps") for wheel in AGRIMARO.wheels]
    np.testing.assert_array_equal(np.column_stack(wheel_radps), [one.wheel_radps for one in commands])
    assert set(again.streams["control"].channels) == set(commands[0].status)


def test_a_recorded_run_is_inspected_and_trained_on_once_it_is_labelled(writer, tmp_path, two_drives):
    for run in two_drives:
        channels = {name: stream.channels for name, stream in run.streams.items()}
        recorder = SessionRecorder(tmp_path, run.run_id, "mower", channels, writer=writer)
        for sample in replay(run):
            recorder.readings(sample.readings)
            recorder.command(sample.time_s, sample.twist, Command((), (), (), {"probability_ratio": 0.5}))
        recorder.close(10.0)
    assert inspect_runs(InspectSettings(data=tmp_path)).n_runs == len(two_drives)
    labelled = [
        RunLog(run.run_id, run.robot, run.streams, (Label(0.0, 12.0, run.run_id[0]),))
        for run in load_runs(tmp_path)
    ]
    windows = samples_of(labelled, EvaluationSettings()).windows
    assert set(windows.values) == {"imu", "wheels"}
    plain = samples_of(two_drives, EvaluationSettings()).windows
    np.testing.assert_array_equal(windows.values["imu"], plain.values["imu"])
    assert windows.terrain.tolist() == plain.terrain.tolist()
