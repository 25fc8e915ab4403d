"""The chain on measured runs: whole runs are held out, what it cannot know is stated, commands are sound."""

import importlib.util
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import terrain
from terrain.control.slip_table import load_slip_table
from terrain.logs.run_folders import write_run
from terrain.records import Label, RunLog
from terrain.robots import load_robot
from terrain.simulation.run import Poses


@pytest.fixture(scope="module")
def script():
    path = Path(__file__).parents[2] / "examples" / "chain.py"
    spec = importlib.util.spec_from_file_location("chain", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def simulated(name, number, duration_s=16.0):
    options = {"duration_s": duration_s, "vary": True, "poses": Poses()}
    return terrain.simulate(load_robot("husky"), name, "survey", seed=7, number=number, **options)


def test_whole_runs_are_held_out_and_of_several_sessions_the_last(script):
    runs = [
        RunLog(f"{ground}_{session}_{i:02}", "husky", {}, (Label(0.0, 1.0, ground),), session=session)
        for ground, session in (("ice", "one"), ("sand", "a"), ("sand", "b"))
        for i in range(24)
    ]
    learn, held = script.deal(runs, 1000)
    names = [run.run_id for run in (*learn, *held)]
    assert sorted(names) == [run.run_id for run in runs]
    assert {run.session for run in held if run.terrains == ("sand",)} == {"b"}
    assert sum(run.terrains == ("ice",) for run in held) == 8
    assert [[run.run_id for run in part] for part in script.deal(runs, 1000)] == [
        [run.run_id for run in part] for part in (learn, held)
    ]
    few = Counter(run.terrains for part in script.deal(runs, 20) for run in part)
    assert few == {("ice",): 10, ("sand",): 10}


def test_a_replayed_run_gives_commands_within_limits_beside_what_was_driven(script):
    run, answer, robot = simulated("grass", 1), script.Answer(), load_robot("husky")
    (found,) = script.replayed([run], robot, load_slip_table(), None, answer)
    time_s, *series = found.T
    assert np.isfinite(found).all()
    assert time_s[0] == run.streams["wheels"].time_s[0]
    assert np.abs(series[:2]).max() <= robot.motors.speed_max_radps + 1e-9
    rates = run.streams["wheels"].columns(["speed_left_mps", "speed_right_mps"]) / robot.wheel_radius_m
    np.testing.assert_allclose(np.array(series[2:])[:, 0], rates[0])
    assert "are finite, and within the motors' limit" in answer.lead[0]
    assert "The loop is open" in answer.parts[0].note


def test_runs_without_commands_say_so(script):
    run, answer = simulated("grass", 1, 9.0), script.Answer()
    streams = {name: stream for name, stream in run.streams.items() if name != "commands"}
    bare = RunLog(run.run_id, run.robot, streams)
    assert script.replayed([bare], load_robot("husky"), load_slip_table(), None, answer) == []
    assert answer.unknown == ["commands: no run that was held out drives and has the stream 'commands'"]


def test_mistakes_are_one_sentence(script, capsys, monkeypatch):
    monkeypatch.delenv("TERRAIN_DATA", raising=False)
    with pytest.raises(SystemExit):
        script.main(["robotino"])
    assert "TERRAIN_DATA" in capsys.readouterr().err.splitlines()[-1]
    with pytest.raises(terrain.errors.TerrainError, match="nowhere"):
        script.main(["husky", "--data", "nowhere"])


@pytest.mark.slow
def test_a_stand_in_of_two_grounds_goes_through_the_whole_chain(script, tmp_path, capsys):
    for name in ("grass", "tiles"):
        for number in range(1, 8):
            write_run(simulated(name, number), tmp_path / "runs")
    (report,) = script.main(["husky", "--data", str(tmp_path / "runs"), "--out", str(tmp_path / "pages")])
    assert "commands of 4 replayed runs are finite, and within the motors' limit" in report.answer
    assert "target slips are off by at most 0.0" in report.answer
    assert (tmp_path / "pages" / "husky_runs.html").stat().st_size > 10_000
    assert "Not known: what the commands would have done" in capsys.readouterr().out


UNKNOWN = {
    "robotino": ("currents have no sign", "on another day"),
    "warthog": ("no motor currents", "mean over its scans"),
    "husky": ("has a label", "currents have no sign"),
    "marmotte": ("its publishers say so", "no motor currents", "no fastest speed"),
}


@pytest.mark.slow
@pytest.mark.parametrize("robot", UNKNOWN)
def test_each_robot_goes_from_log_to_commands(script, measured, monkeypatch, robot):
    folders = [measured(name) for name in script.DATA[robot]]
    monkeypatch.setenv("TERRAIN_DATA", str(measured("")))
    reports = script.main([robot])
    assert len(reports) == len(folders)
    for report in reports:
        assert re.search(r"slips by [-−]?\d\.\d{3} on", report.answer)
        assert re.search(r"commands of 6 replayed runs are finite", report.answer)
        assert "NOT" not in report.answer
    stated = " ".join(part.text for report in reports for part in report.parts if hasattr(part, "text"))
    assert all(words in stated for words in (*UNKNOWN[robot], "no correction shows its effect")), stated


@pytest.mark.slow
def test_slip_of_robotino_is_predicted_without_the_camera_as_well_as_it_was(script, measured):
    report = script.chain(measured("robotino") / "one_surface", "robotino", every=True)
    rms, inside = re.search(r"is off by (\d\.\d+) rms, (\d+).%", report.answer).groups()
    assert float(rms) <= 0.045
    assert 90 <= int(inside) <= 98
    assert float(re.search(r"off by at most (\d\.\d+)", report.answer).group(1)) <= 0.03
