"""`terrain explain` from logs to the extended robot, and what it refuses."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from pipelines.explain.explain import EXTENDED_FILE, PAGE_FILE, explain
from pipelines.live.pilot import LivePilot
from pipelines.report.results import as_json, silent
from pipelines.report.terminal import terminal_text
from pipelines.slip import calibrate
from pipelines.slip.estimate import estimate_runs
from terrain.discrepancy.verdict import INTERVAL_T
from terrain.discrepancy.watch import read_watched
from terrain.effects import SPEED_X
from terrain.errors import ConfigError, TerrainError
from terrain.extension import extended_yaml
from terrain.learned_term import LearnedTerm
from terrain.logs.run_folders import write_run
from terrain.robots import description_file, load_robot
from terrain.simulation.plants.planar import DRIVE_S, Ground, spread_numbers
from terrain.simulation.run import simulate, simulate_run
from terrain.simulation.scenario import RATE_HZ as COMMANDS_HZ
from terrain.slip_learning.learn import terrain_runs

HUSKY = load_robot("husky")


@pytest.fixture(scope="module")
def data(a_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for i in range(7):
        write_run(a_run(i, terrain="field" if i < 4 else "yard"), folder)
    return folder


def test_the_hidden_cause_is_named_built_in_and_absent_when_tested_again(terrain, data, place):
    here = ("explain", "--data", data, "--robot", "husky", "--out")
    few = ("--effects", "camera_yaw,lever_arm,gyro_scale")
    code, out, err = terrain(*here, "found", "--json", "found.json", "--hold-out", 2, *few)
    assert code == 0, err
    found = json.loads((place / "found.json").read_text())
    assert [cause["name"] for cause in found["causes"]] == ["camera_yaw"]
    (value,) = found["causes"][0]["parameters"]
    std = (value["ci"][1] - value["ci"][0]) / (2 * INTERVAL_T)
    assert abs(value["value"] - 0.04) < 4 * std
    watched = read_watched(place / "found" / EXTENDED_FILE)
    assert "7 runs of" in watched.source
    assert ("yaw_rate_radps", "along") in watched.deviations
    lines = out.splitlines()
    assert "with the camera turned" in lines[0]
    assert "judged on 2 runs held out" in lines[0]
    assert len(lines) <= 25
    assert sorted(found["used"] + found["held_out"]) == [f"husky_{i}" for i in range(7)]
    assert len(found["held_out"]) == 2
    gain = found["gain"]
    assert (gain["refused"], gain["runs"], gain.get("built_in_before")) == (False, found["held_out"], None)
    assert gain["filter"]["errors"]["speed_mps"]["before"] > 0.0
    (statement,) = [each for each in found["statements"] if each["channel"] == "speed_y_mps"]
    assert statement["causes"] == ["camera_yaw"]
    assert "° to the right its error falls from" in statement["text"]
    assert statement["rms_after"] < 0.5 * statement["rms_before"]
    (channel,) = [each for each in found["channels"] if each["channel"] == "speed_y_mps"]
    assert (channel["tier"], channel["causes"]) == ("named", ["camera_yaw"])
    assert channel["gain"] == gain["channels"]["speed_y_mps"]["reduction"]
    assert channel["gain_ci"][0] > 0.5 * channel["learner_gain"] > 0.2

    late = {part["name"]: part for part in found["powertrain"]["parts"] if part["status"] == "found"}
    assert set(late) == {"delay_s", "time_constant_s"}
    late_s = sum(part["value"] for part in late.values())
    assert late_s == pytest.approx(2 * DRIVE_S - 0.5 / COMMANDS_HZ, abs=0.015)
    page = (place / "found" / PAGE_FILE).read_text()
    assert all(text in page for text in found["powertrain"]["sentences"])

    extended = place / "found" / EXTENDED_FILE
    assert load_robot(extended).effects == pytest.approx({"camera_yaw_rad": value["value"]}, rel=1e-6)
    words = ("--model", extended, *few, "--terrain", "field", "--hold-out", 1)
    code, out, err = terrain(*here, "again", *words, "--json", "again.json")
    assert code == 0, err
    again = json.loads((place / "again.json").read_text())
    assert (again["verdict"], again["causes"]) == (None, [])
    assert again["effects"] == ["gyro_scale", "camera_yaw", "lever_arm"]
    assert not (place / "again" / EXTENDED_FILE).exists()
    assert "nothing that the simulation of husky gets wrong" in out
    before = again["gain"]["built_in_before"]
    assert len(before["runs"]) == 4
    assert before["channels"]["speed_y_mps"]["ci"][0] > 0.5
    source = yaml.safe_load(extended.read_text())["effects"]["camera_yaw_rad"]["source"]
    assert "of the square where it acts, judged on 2 runs held out" in source


def test_runs_are_explained_without_files_and_the_extended_robot_is_simulated(a_run, few, tmp_path):
    assert few.extended.effects == few.diagnosis.values
    assert few.extended.region.terrains == ("field",)
    assert a_run(9, few.extended, effects={}).robot == "husky"
    assert few.report.save(tmp_path / "explained.html").stat().st_size > 10_000
    assert few.report.picture.panels
    text = terminal_text(few.report, details=True)
    assert "The wheel speeds are not compared with their commands: runs: 4 have" in text
    assert few.to_pandas()["name"].tolist() == ["camera_yaw_rad"]
    document = as_json(few)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert (document["page"], document["extended"]["file"]) == (None, None)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--effects gravity", "effect 'gravity' is unknown"),
        ("--effects ,", "--effects is ',': value should have at least 1 item"),
        ("--terrain sand", "no run is labelled 'sand' throughout; labels are field, yard"),
        ("--hold-out 5", "--hold-out is 5 of 7 runs; the diagnosis requires at least 3"),
        ("--model agrimaro", "--model is of the robot 'agrimaro', --robot is 'husky'"),
    ],
)
def test_a_users_mistake_is_one_sentence_and_nothing_is_written(refused, data, words, sentence):
    refused(sentence, "explain", "--data", data, "--robot", "husky", "--out", "out", *words.split())


def test_runs_that_cannot_be_compared_are_refused(a_run):
    runs = [a_run(i) for i in range(3)]
    wheels = runs[0].streams["wheels"]
    keep = ("speed_left_mps", "speed_right_mps")
    only = type(wheels)(wheels.time_s, np.column_stack([wheels.channel(name) for name in keep]), keep)
    about = {"noise": spread_numbers("noise"), "terrain": "field"}
    standing = [
        simulate(HUSKY, np.zeros((400, 3)), Ground(), i, run_id=f"stand_{i}", **about) for i in range(3)
    ]
    mower = [replace(run, robot="mower") for run in runs]
    for refused, sentence in (
        ([replace(run, streams={"wheels": only}) for run in runs], "none of its channels is simulated"),
        (runs[:2], "there are 2, at least 3"),
        ([], "there is no run to explain"),
        (mower, "3 of 3 runs are of the robot 'mower'; the simulation"),
        (standing, "in all 3 the wheels are at rest; runs that drive are required"),
    ):
        with pytest.raises(TerrainError, match=sentence):
            explain(refused, HUSKY)


def test_a_model_without_covariance_is_refused_and_an_extended_description_not_overwritten(
    refused, data, place, tmp_path
):
    text = description_file("husky").read_text(encoding="utf-8").rstrip() + "\neffects:\n"
    model = tmp_path / "model.yaml"
    for effects, sentence in (
        ("  schema: 99\n", "schema 99 is newer"),
        ("  schema: 1\n  camera_yaw_rad: {value: 0.01, unit: rad, source: me}\n", "have no covariance"),
    ):
        model.write_text(text + effects)
        refused(sentence, "explain", "--data", data, "--robot", "husky", "--out", "out", "--model", model)
    (place / "out").mkdir()
    (place / "out" / EXTENDED_FILE).write_text("mine")
    refused("is there already", "explain", "--data", data, "--robot", "husky", "--out", "out")


def test_an_extended_description_passes_through_the_commands(tmp_path):
    asked = {"wheel_radius_ratio": 0.04, "camera_yaw_rad": 0.05, "gyro_scale_ratio": 0.08}
    intervals = {name: (value - 0.01, value + 0.01) for name, value in asked.items()}
    out = tmp_path / "extended.yaml"
    out.write_text(extended_yaml("agrimaro", asked, 1e-6 * np.eye(len(asked)), intervals, "a test"))
    robot = load_robot(out)
    run = simulate_run(load_robot("agrimaro"), "grass", "straight", 1, 1, duration_s=8.0, effects=asked)
    (row,) = estimate_runs([run], robot, "vio15", tuning="physical").result.runs
    assert row.speed_rmse_mps < 0.006
    assert np.isfinite(terrain_runs(run, robot)[0].balance.mass_kg)
    assert LivePilot(robot).control._radius_m == pytest.approx(0.208)
    with pytest.raises(ConfigError, match="is extended by effects"):
        calibrate.run(calibrate.Settings(data=tmp_path, robot=str(out)), silent)
    term = LearnedTerm(SPEED_X, ("speed_mps",), np.array([0.1]), np.eye(1), {"speed_mps": (0.0, 1.0)})
    out.with_name("learned.yaml").write_text(
        extended_yaml("agrimaro", {}, np.zeros((0, 0)), {}, "", learned=[term])
    )
    with pytest.raises(ConfigError, match="is extended by learned terms"):
        calibrate.run(calibrate.Settings(data=tmp_path, robot=str(out.with_name("learned.yaml"))), silent)
    assert yaml.safe_load(out.read_text())["effects"]["schema"] == 1
