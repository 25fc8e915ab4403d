"""The command line on good and bad data: what strangers send, and what the commands write."""

import json

import numpy as np
import pytest

from terrain.files.names import data_folder
from terrain.logs.run_folders import write_run
from terrain.records import RunLog, Stream

DEEP = "[" * 100_000


@pytest.fixture
def files(place, drive):
    """The folder to work in, with a run in ``data``."""
    write_run(drive("r", "GRASS", 0, duration_s=4.0), place / "data")
    return place


def edit_robot(folder, robot):
    file = folder / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"robot": robot}))


def cut_short(folder):
    (folder / "imu.parquet").write_bytes((folder / "imu.parquet").read_bytes()[:-20])


def test_a_run_or_model_of_a_stranger_is_one_sentence(refused, files, model_dir):
    folder = files / "data" / "r"
    (files / "evil.yaml").write_text("secret: 1\n")
    (model_dir / "terrain_model.json").write_text(DEEP)
    refused("is nested deeper than 32 levels", "predict", "--data", "data", "--model", model_dir)
    for spoil, sentence in (
        (lambda: edit_robot(folder, "evil.yaml"), "robot 'evil.yaml' is unknown: a log names one of"),
        (lambda: cut_short(folder), "is no whole Parquet file"),
        (lambda: (folder / "run.json").write_text(DEEP), "is nested deeper than 32 levels"),
    ):
        spoil()
        refused(sentence, "estimate", "--data", "data", "--filter", "slip")


def test_a_robot_that_the_user_gives_may_be_a_file(files, terrain):
    text = (data_folder("robots") / "husky.yaml").read_text().replace("name: husky", "name: mule")
    (files / "mule.yaml").write_text(text)
    edit_robot(files / "data" / "r", "mule")
    code, out, _ = terrain("estimate", "--data", "data", "--filter", "slip", "--robot", "mule.yaml")
    assert (code, "slip" in out) == (0, True)


def test_from_simulated_logs_to_slip_on_the_command_line(terrain, place):
    words = ("--robot", "agrimaro", "--terrain", "grass", "--scenario", "straight", "--duration", "8")
    code, out, _ = terrain("simulate", *words, "--out", "logs", "--json", "sim.json")
    assert (code, out) == (0, "1 run of 8 s, written to logs.\nnext: terrain inspect logs --robot agrimaro\n")
    assert json.loads((place / "sim.json").read_text())["run_ids"] == ["grass_straight_01"]
    code, _, err = terrain("simulate", *words, "--out", "logs")
    assert code == 2
    assert "is there already, and is left as it is" in err

    ask = ("estimate", "--data", "logs", "--filter", "vio15", "--out", "runs", "--json", "est.json")
    code, out, err = terrain(*ask)
    assert code == 0, err
    (row,) = json.loads((place / "est.json").read_text())["runs"]
    assert f"{row['slip_mean']:+.4f}" in out
    assert (place / "runs" / "grass_straight_01" / "slip.parquet").is_file()
    code, out, _ = terrain("estimate", "--data", "logs", "--filter", "encoder12")
    assert code == 0
    assert "blind" in out


def test_a_fault_of_the_package_keeps_its_traceback(terrain, files, monkeypatch):
    monkeypatch.setattr("pipelines.learn.crossval.crossval", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        terrain("crossval", "--data", "data")


def test_predict_prints_terrain_probability_and_target_slip(terrain, place, drive, tracked):
    run = drive("r", "GRAVEL", 0, label="LAVA")
    imu = run.streams["imu"]
    values = imu.values.copy()
    values[:10] = np.nan
    streams = {**run.streams, "imu": Stream(imu.time_s, values, imu.channels)}
    for each in (RunLog("r", "husky", streams, run.labels), drive("s", "ASPHALT", 1, label=None)):
        write_run(each, place / "data")
    table = place / "own.yaml"
    entry = "{traction: {slip_ratio: 0.31, source: assumed}, braking: {slip_ratio: -0.32, source: assumed}, "
    entry += "steady: {slip_ratio: 0.07, source: assumed}}"
    table.write_text(f"name: own\nfallback: any\nterrains:\n  any: {entry}\n")
    words = ("predict", "--model", tracked[0] / "model", "--data", "data", "--table", table)
    code, out, err = terrain(*words, "--json", "p.json")
    assert (code, err) == (0, "")
    for words in (
        "+0.31", "−0.32", "+0.07", "the fallback is used", "are unestimated: not measured",
        "11 windows are labelled LAVA, which the model was not trained on", "windows left out: 1 not finite",
    ):  # fmt: skip
        assert words in out
    result = json.loads((place / "p.json").read_text())
    assert result["accuracy"] is None
    assert len(result["windows"]) == 23
    row = result["windows"][0]
    assert {"run_id", "start_s", "terrain", "probability", "target_slip"} <= set(row)
    assert row["target_slip"] == {"traction": 0.31, "braking": -0.32, "steady": 0.07}
