"""A replay gives what the live chain gives, at the speed that is asked for, and ends cleanly."""

import itertools
import json
import os
import signal
import threading
from dataclasses import replace
from time import perf_counter

import numpy as np
import pytest

from pipelines.learn.model_file import write_model
from pipelines.learn.predict import predict
from pipelines.live.pilot import LivePilot
from pipelines.serve import replay
from pipelines.serve.replay import chain_of_run, replay_run
from pipelines.serve.serve import Settings
from pipelines.serve.serve import run as serve
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError, DataError
from terrain.logs.run_folders import write_run
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

AGRIMARO, TABLE = load_robot("agrimaro"), load_slip_table()


@pytest.fixture(scope="module")
def husky_model(trained, runs):
    return trained(runs)


@pytest.fixture(scope="module")
def grass():
    return simulate_run(AGRIMARO, "grass", "survey", 5, 7, duration_s=20.0)


def replayed(run, model, stop_at_s=np.inf, **settings):
    """The replayed run, and when each second of it was passed."""
    moments, stop = [], threading.Event()

    def progress(task, done, total):
        moments.append((perf_counter(), done))
        if done >= stop_at_s:
            stop.set()

    chain = chain_of_run(run, model, TABLE)
    return replay_run(run, chain, Settings(replay="a log", **settings), progress, stop), moments


def test_a_pilot_gives_what_predict_gives_though_another_controller_drove(grass, runs, swerve_model):
    result, _ = replayed(grass, swerve_model)
    rows = predict([grass], swerve_model, TABLE).windows
    assert result.chain == "pilot"
    assert [(w.start_s, w.terrain) for w in result.windows] == [(row.start_s, row.terrain) for row in rows]
    assert result.windows[-1].believed == "grass"
    grass_ratio = TABLE.lookup("grass")["traction"].slip_ratio
    assert result.windows[-1].target_ratio == pytest.approx(grass_ratio, abs=0.05)
    result, _ = replayed(grass, None)
    assert (result.n_windows, result.accuracy, dict(result.believed)) == (0, None, {"": 1.0})
    assert replayed(runs[0], None)[0].chain == "pilot"
    with pytest.raises(DataError, match="must be among them"):
        replayed(RunLog("R", "husky", {"imu": runs[0].streams["imu"]}), None)


def test_a_run_that_lacks_what_is_needed_is_refused_in_a_sentence(grass, runs, husky_model, swerve_model):
    wheels = grass.streams["wheels"]
    lacking = {**grass.streams, "wheels": Stream(wheels.time_s, wheels.values[:, :5], wheels.channels[:5])}
    with pytest.raises(DataError, match="stream wheels has no channel 'current_3_a' for the pilot"):
        replayed(RunLog("R", "agrimaro", lacking), None)
    assert replayed(RunLog("X", "nothing known", runs[0].streams), husky_model)[0].n_windows > 8
    with pytest.raises(ConfigError, match="nothing known"):
        replayed(RunLog("X", "nothing known", runs[0].streams), swerve_model)
    only = RunLog("R", "husky", {"imu": runs[0].streams["imu"]})
    with pytest.raises(DataError, match=r"run R: the model requires .* of the stream 'wheels'"):
        replayed(only, husky_model)


def test_the_speed_is_that_of_the_clock_until_it_is_to_end(runs, husky_model):
    result, moments = replayed(runs[1], husky_model, stop_at_s=18.0, speed=20.0)
    assert [done for _, done in moments] == list(range(1, len(moments) + 1))
    begin_s = moments[0][0] - moments[0][1] / 20
    assert min(wall_s - begin_s - done / 20 for wall_s, done in moments) > -0.06
    assert result.times_real_time == pytest.approx(20.0, rel=0.2)
    assert (result.interrupted, result.duration_s) == (True, pytest.approx(18.0, abs=0.05))
    assert 6 <= result.n_windows <= 9


@pytest.fixture(scope="module")
def husky_folder(husky_model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("husky")
    write_model(folder, husky_model)
    return folder


@pytest.fixture
def logs(tmp_path, runs):
    for run in runs[:2]:
        write_run(run, tmp_path / "logs")
    return tmp_path / "logs"


def test_serve_replays_all_runs_of_a_folder_as_predict_and_prints_changes(
    runs, husky_model, logs, husky_folder, capsys
):
    result = serve(Settings(replay=logs, model=str(husky_folder)))
    rows = predict(runs[:2], husky_model, TABLE)
    windows = [window for run in result.runs for window in run.windows]
    assert [(w.start_s, w.terrain, w.label) for w in windows] == [
        (row.start_s, row.terrain, row.label) for row in rows.windows
    ]
    found, expected = ([one.probability for one in each] for each in (windows, rows.windows))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    for name in ("accuracy", "n_judged", "training_runs", "training_accuracy", "n_judged_training"):
        assert getattr(result, name) == getattr(rows, name)
    assert len(rows.training_runs) == 2
    assert result.n_windows == len(windows) > 16
    assert not result.interrupted
    printed, changes = capsys.readouterr().out.splitlines(), []
    for run in result.runs:
        assert run.chain == "observer"
        assert run.duration_s == pytest.approx(24.0, abs=0.1)
        for found in (run.terrains, run.believed):
            assert sum(found.values()) == pytest.approx(1.0)
        changes += [run.run_id for _ in itertools.groupby((w.terrain, w.believed) for w in run.windows)]
    assert [run.run_id for run in result.runs] == ["ASPHALT_1", "ASPHALT_2"]
    assert [line.split()[0] for line in printed] == changes
    assert "believed unknown" in printed[0]
    assert len(result.to_pandas()) == result.n_windows
    assert f"{result.n_windows} windows in 4" in str(result.report)


def test_a_pilot_is_given_the_motion_that_commanded_wheels_desire(runs, tmp_path, monkeypatch):
    """A log of DRIVE's layout commands wheels and no twist."""
    rates = Stream([0.0, 20.0], [[2.0, 4.0]] * 2, ["wheel_left_radps", "wheel_right_radps"])
    write_run(replace(runs[0], streams={**runs[0].streams, "commands": rates}), tmp_path / "logs")
    desired, take = [], LivePilot.take

    def seen(pilot, sample):
        desired.append(sample.twist)
        return take(pilot, sample)

    monkeypatch.setattr(LivePilot, "take", seen)
    result = serve(Settings(replay=tmp_path / "logs"))
    assert [run.chain for run in result.runs] == ["pilot"]
    husky = load_robot("husky")
    radius_m, track_m = husky.wheel_radius_m, husky.track_m
    np.testing.assert_allclose(desired[-1], [3.0 * radius_m, 0.0, 2.0 * radius_m / track_m])


def test_a_signal_ends_the_command_with_a_summary(logs, husky_folder, tmp_path, terrain, monkeypatch):
    def begun(*given):
        threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
        return replay_run(*given)

    monkeypatch.setattr(replay, "replay_run", begun)
    file = tmp_path / "out.json"
    words = f"serve --replay {logs} --speed 1 --model {husky_folder} --json {file}"
    code, out, _ = terrain(*words.split())
    assert code == 130
    assert "stopped before the end" in out
    assert 0.1 < json.loads(file.read_text())["duration_s"] < 20.0
