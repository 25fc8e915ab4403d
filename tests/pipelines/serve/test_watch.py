"""A service and a replay compare a robot with its extended model, and say alike where it departs."""

import json

import numpy as np
import pytest
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.trial import hidden_runs

from pipelines.serve import replay
from pipelines.serve.hub import Limits
from pipelines.serve.serve import Settings
from pipelines.serve.service import Service
from terrain.discrepancy.watch import watch_lines, watched_on
from terrain.errors import ConfigError
from terrain.logs.run_folders import write_run
from terrain.robots import description_file, load_robot

from .strangers import ask, hello, messages, running

HUSKY = load_robot("husky")


def runs_with(hidden, n, seed, duration_s=30.0):
    drives = rich_drives(np.random.default_rng(seed), n, duration_s)
    return hidden_runs(HUSKY, drives, np.random.SeedSequence(seed), hidden)


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    """The file of a husky with the deviations of quiet runs."""
    path = tmp_path_factory.mktemp("watch") / "extended.yaml"
    watched = watched_on(runs_with({}, 8, 1), HUSKY, "a test")
    path.write_text(description_file("husky").read_text() + "\n".join(watch_lines(watched)) + "\n")
    return path


@pytest.fixture(scope="module")
def changed():
    """A run of a robot whose gyro reads a fifth too much."""
    (run,) = runs_with({"gyro_scale_ratio": 0.2}, 1, 2, duration_s=90.0)
    return run


@pytest.fixture(scope="module")
def replayed(extended, changed, tmp_path_factory):
    folder = tmp_path_factory.mktemp("log")
    write_run(changed, folder)
    return replay.run(Settings(replay=folder, watch=extended, rate_hz=5.0))


def test_a_replay_tells_the_departures_over_time(replayed, extended):
    assert {(alarm.channel, alarm.kind) for alarm in replayed.alarms} >= {("yaw_rate_radps", "along")}
    alarm = next(alarm for alarm in replayed.alarms if alarm.kind == "along")
    assert alarm.size == pytest.approx(0.2, abs=0.06)  # runs differ by some hundredths
    assert "more than its model by the gyro since" in alarm.text
    assert f"{len(replayed.alarms)} departure" in replayed.report.answer
    assert f"from {extended} in 87 s of driving that could be compared" in replayed.report.answer
    assert len(replayed.blocks) >= 27
    assert max(block.levels["yaw_rate_radps"] for block in replayed.blocks) == 1.0
    assert json.dumps(replayed.as_json())


def test_a_service_says_what_the_replay_says(extended, changed, replayed, capfd):
    streams = {name: stream.channels for name, stream in changed.streams.items() if name != "truth"}
    seen = []
    faster_than_real_time = Limits()._replace(rows_per_s=1e6, messages_per_s=1e6, bytes_per_s=1e9)
    with running(faster_than_real_time, watch=str(extended)) as service, service.socket() as robot:
        assert ask(robot, hello("mine", robot="husky", streams=streams))["served"]["model"] is None
        for message in messages(changed, 5.0):
            seen.append(ask(robot, message)["observation"]["watch"])
        trouble = json.loads(service.get("/ready")[1])["trouble"]["watch of mine"]
        figures = service.get("/metrics")[1]
        assert json.loads(service.get("/state")[1])["session"]["step"]["observation"]["watch"] == seen[-1]
    texts = [alarm["text"] for alarm in seen[-1]["alarms"]]
    assert texts == [alarm.text.rpartition(" of ")[0] for alarm in replayed.alarms]
    assert trouble == f"mine {'; '.join(texts)}"
    assert 'terrain_watch_alarms_total{channel="yaw_rate_radps"} ' in figures
    assert f'terrain_watch_departures{{session="mine"}} {len(texts):.1f}' in figures
    assert "mine: turns" in capfd.readouterr().err
    assert seen[-1]["channels"]["yaw rate (gyro)"] == "departs from its model"
    assert seen[0]["channels"]["yaw rate (gyro)"] == "not known yet"


def test_another_robot_is_not_watched(extended, model_folder):
    with running(watch=str(extended), model=str(model_folder)) as service, service.socket() as robot:
        ask(robot, hello("other"))
        assert ask(robot, {"type": "samples", "streams": {}, "step": True})["observation"]["watch"] is None


def test_a_file_of_another_robot_is_refused(extended, changed, tmp_path):
    other = tmp_path / "other.yaml"
    other.write_text(extended.read_text().replace("name: husky", "name: lynx"))
    write_run(changed, tmp_path / "log")
    with pytest.raises(ConfigError, match=r"is of the robot 'husky', .*other\.yaml of 'lynx'"):
        replay.run(Settings(replay=tmp_path / "log", watch=other))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [(None, "none.yaml"), ("a: 1\n", "unknown"), ("[", "yaml"), ("plain", "has no section 'watch'")],
)
def test_what_is_no_extended_robot_is_one_sentence(tmp_path, content, sentence):
    path = tmp_path / "none.yaml"
    if content is not None:
        path.write_text(description_file("husky").read_text() if content == "plain" else content)
    with pytest.raises(ConfigError) as refused:
        Service(Settings(watch=path, port=0))
    assert sentence in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_bus_is_not_watched(extended):
    with pytest.raises(ConfigError, match="--watch is an option of the WebSocket service and of --replay"):
        Settings(watch=extended, can="can0")
