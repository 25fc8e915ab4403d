"""A replay gives what the live chain gives, at the speed that is asked for, and ends cleanly."""

import itertools
import json
import signal
import subprocess
import sys
from time import perf_counter

import numpy as np
import pytest
from rich.console import Console

from pipelines.classify.predict import predict
from pipelines.cli import main as cli
from pipelines.live.pilot import LivePilot
from pipelines.live.pilot_settings import PilotSettings
from pipelines.replay.replay import replay_run
from pipelines.replay.screen import live_view
from pipelines.replay.settings import ReplaySettings
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError, DataError
from terrain.logs.replay import replay
from terrain.logs.write import write_run
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


class Seen:
    def __init__(self, stop_at_s=np.inf):
        self.moments, self.windows, self._stop_at_s = [], [], stop_at_s

    def moment(self, moment):
        self.moments.append((perf_counter(), moment))
        if moment.time_s >= self._stop_at_s:
            raise KeyboardInterrupt

    def observed(self, run_id, window):
        self.windows.append((run_id, window))


def test_an_observer_gives_what_predict_gives(runs, husky_model):
    run, seen = runs[0], Seen()
    result = replay_run(run, husky_model, TABLE, ReplaySettings(), view=seen)
    rows = predict([run], husky_model, TABLE)
    assert result.chain == "observer"
    assert [(w.start_s, w.terrain, w.label) for w in result.windows] == [
        (row.start_s, row.terrain, row.label) for row in rows.windows
    ]
    np.testing.assert_allclose(
        [w.probability for w in result.windows], [row.probability for row in rows.windows], atol=1e-12
    )
    assert (result.accuracy, result.n_judged) == (rows.accuracy, rows.n_judged)
    assert result.n_windows > 8
    assert sum(result.terrains.values()) == pytest.approx(1.0)
    assert sum(result.believed.values()) == pytest.approx(1.0)
    assert [window for _, window in seen.windows] == list(result.windows)
    assert len(seen.moments) == result.n_steps
    assert result.duration_s == pytest.approx(24.0, abs=0.1)


def test_a_pilot_gives_what_predict_gives_though_another_controller_drove(grass, swerve_model):
    result = replay_run(grass, swerve_model, TABLE, ReplaySettings())
    rows = predict([grass], swerve_model, TABLE).windows
    assert result.chain == "pilot"
    assert [(w.start_s, w.terrain) for w in result.windows] == [(row.start_s, row.terrain) for row in rows]
    assert result.windows[-1].believed == "grass"
    assert result.windows[-1].target_ratio == pytest.approx(
        TABLE.lookup("grass")["traction"].slip_ratio, abs=0.05
    )


def test_wheels_of_a_log_are_not_compared_with_commands_that_nothing_drove(grass):
    """Where they are, as on a robot, wheels that do something else are found, and left out."""
    worst = {}
    for follows in (True, False):
        pilot = LivePilot(AGRIMARO, settings=PilotSettings(follows=follows))
        shaken = [sample._replace(twist=np.array([0.0, 0.0, 0.0])) for sample in replay(grass)]
        names = set()
        for sample in shaken:
            pilot.step(sample)
            names |= {name for name, health in pilot.health.items() if health == "disagrees"}
        worst[follows] = {name for name in names if name.startswith(("wheel", "motor"))}
    assert worst[True]
    assert not worst[False]


def test_a_pilot_needs_no_model_and_another_robot_does(grass, runs):
    result = replay_run(grass, None, TABLE, ReplaySettings())
    assert (result.n_windows, result.accuracy, dict(result.believed)) == (0, None, {"": 1.0})
    with pytest.raises(ConfigError, match=r"robot 'husky' has no pilot: give a model with --model"):
        replay_run(runs[0], None, TABLE, ReplaySettings())


def test_a_robot_without_a_description_is_replayed_where_the_model_needs_none(
    runs, husky_model, swerve_model
):
    run = RunLog("X", "nothing known", runs[0].streams, runs[0].labels)
    assert replay_run(run, husky_model, TABLE, ReplaySettings()).n_windows > 8
    with pytest.raises(ConfigError, match="nothing known"):
        replay_run(run, swerve_model, TABLE, ReplaySettings())


def test_a_run_that_lacks_what_is_needed_is_refused_in_a_sentence(grass, runs, husky_model):
    wheels = grass.streams["wheels"]
    lacking = {**grass.streams, "wheels": Stream(wheels.time_s, wheels.values[:, :5], wheels.channels[:5])}
    with pytest.raises(DataError, match="stream wheels has no channel 'current_3_a' for the pilot"):
        replay_run(RunLog("R", "agrimaro", lacking), None, TABLE, ReplaySettings())
    only = RunLog("R", "husky", {"imu": runs[0].streams["imu"]})
    with pytest.raises(DataError, match=r"run R: the model requires .* of the stream 'wheels'"):
        replay_run(only, husky_model, TABLE, ReplaySettings())


@pytest.mark.parametrize(("speed", "at_least_s"), [("20", 1.2), ("max", 0.0)])
def test_the_speed_is_that_of_the_clock(runs, husky_model, speed, at_least_s):
    seen = Seen()
    result = replay_run(runs[1], husky_model, TABLE, ReplaySettings(speed=speed), view=seen)
    assert result.elapsed_s >= at_least_s * (1.0 - 1e-6)
    if speed == "20":
        begin = seen.moments[0][0] - seen.moments[0][1].time_s / 20
        early = [wall - begin - moment.time_s / 20 for wall, moment in seen.moments]
        assert min(early) > -0.02
        assert result.times_real_time == pytest.approx(20.0, rel=0.2)


@pytest.mark.parametrize("speed", ["0", "-1", "inf", "nan", "fast", ""])
def test_a_speed_that_is_none_is_refused(speed):
    with pytest.raises(ConfigError, match="--speed is"):
        ReplaySettings(speed=speed)


def test_ctrl_c_ends_a_replay_with_what_was_found(runs, husky_model):
    result = replay_run(runs[0], husky_model, TABLE, ReplaySettings(), view=Seen(stop_at_s=9.0))
    assert result.interrupted
    assert result.duration_s == pytest.approx(9.0, abs=0.02)
    assert 2 <= result.n_windows <= 4


def test_a_terminal_shows_a_line_that_moves_and_a_file_lines_of_changes(runs, husky_model):
    printed = {}
    for terminal in (True, False):
        console = Console(record=True, force_terminal=terminal, width=110, file=sys.stdout)
        with live_view(console) as view:
            result = replay_run(runs[0], husky_model, TABLE, ReplaySettings(), view=view)
        printed[terminal] = [line for line in console.export_text().splitlines() if "believed" in line]
    changes = [key for key, _ in itertools.groupby((w.terrain, w.believed) for w in result.windows)]
    assert len(printed[False]) == len(changes)
    assert "believed unknown" in printed[False][0]
    assert len(printed[True]) > len(printed[False])
    assert any(" of 24.0 s" in line for line in printed[True])


@pytest.fixture
def logs(tmp_path, runs):
    for run in runs[:2]:
        write_run(run, tmp_path / "logs")
    return tmp_path / "logs"


def test_the_command_replays_all_runs_of_a_folder(logs, in_tracked, tmp_path, monkeypatch, capsys):
    words = ["replay", str(logs), "--model", "model", "--json", str(tmp_path / "out.json")]
    monkeypatch.setattr(sys, "argv", ["terrain", *words])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert not end.value.code
    found = json.loads((tmp_path / "out.json").read_text())
    assert [run["run_id"] for run in found["runs"]] == ["ASPHALT_1", "ASPHALT_2"]
    assert found["n_windows"] == sum(len(run["windows"]) for run in found["runs"]) > 16
    assert found["interrupted"] is False
    printed = capsys.readouterr().out
    assert "times real time" in printed
    assert "48.0 s of driving" in printed or "47.9 s of driving" in printed


@pytest.mark.slow
def test_a_signal_ends_the_command_with_a_summary(logs, in_tracked, tmp_path):
    code = "from pipelines.cli.main import main; main()"
    words = ["replay", logs, "--speed", "1", "--model", "model", "--json", tmp_path / "out.json"]
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", code, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert "believed" in process.stdout.readline()
    process.send_signal(signal.SIGINT)  # once, and whatever is compiled just then
    out, err = process.communicate(timeout=60.0)
    assert (process.returncode, err) == (130, "")
    assert "stopped before the end" in out
    assert 1.0 < json.loads((tmp_path / "out.json").read_text())["duration_s"] < 20.0
