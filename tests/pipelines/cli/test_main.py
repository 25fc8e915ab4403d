"""The command line on good and bad data: what is refused in one sentence, and what the commands write."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from pipelines.cli.table import COMMANDS
from pipelines.learn.model_file import MODEL_FILE
from pipelines.report import format_value
from terrain.logs.write import write_run
from terrain.records import RunLog, Stream


def keep(runs, place):
    for run in runs:
        write_run(run, place / "data")
    return place / "data"


SPOILT_FILES = {
    "missing column": (
        lambda lines: [line.rpartition(",")[0] for line in lines],
        "imu_01.csv: column 'az' is missing",
    ),
    "time goes back": (
        lambda lines: [*lines[:9], "0.01" + lines[9][lines[9].index(",") :], *lines[10:]],
        "imu_01.csv: time goes back at row 10 (0.01 s after 0.14 s)",
    ),
    "dead channel": (
        lambda lines: [lines[0], *(line.rpartition(",")[0] + ",nan" for line in lines[1:])],
        "imu_01.csv: channel accel_z_mps2 (column az) has nothing finite in its 200 rows",
    ),
    "streams apart": (
        lambda lines: [
            lines[0],
            *(str(900 + i / 50) + line[line.index(",") :] for i, line in enumerate(lines[1:])),
        ],
        "SNOW_01: the streams do not overlap in time",
    ),
}


@pytest.mark.parametrize("fault", SPOILT_FILES)
def test_a_spoilt_log_is_one_sentence(refused, borealtc_dir, place, edit, fault):
    change, sentence = SPOILT_FILES[fault]
    shutil.copytree(borealtc_dir, place / "logs")
    edit(place / "logs" / "SNOW" / "imu_01.csv", change)
    refused(sentence, "convert", "logs", "--out", "out")
    if fault == "missing column":
        refused(sentence, "crossval", "--data", "logs", "--json", "report.json")


def test_two_runs_with_one_id_are_one_sentence(refused, place, make_run):
    data = keep([make_run("SNOW_01")], place)
    shutil.copytree(data / "SNOW_01", data / "copy")
    refused("2 runs have the id 'SNOW_01'", "inspect", data)


def test_a_unit_that_is_unknown_is_one_sentence(refused, place):
    (place / "map.yaml").write_text(
        "robot: husky\nstreams:\n  imu:\n    file: '{run}.csv'\n    time: {column: t, unit: s}\n"
        "    channels:\n      gyro_z_radps: {column: wz, unit: furlong}\n"
    )
    (place / "a.csv").write_text("t,wz\n0,1\n0.1,2\n")
    refused("furlong", "inspect", place, "--format", "csv", "--mapping", "map.yaml")


def test_data_that_cannot_answer_are_one_sentence(refused, place, drive, drive_all):
    keep(drive_all(("GRASS",), 5, duration_s=6.0), place)
    quick = ("--data", place / "data", "--jobs", 1)
    for command in (("crossval",), ("train", "--name", "m")):
        refused("all windows are 'GRASS': a classifier needs at least two classes", *command, *quick)
    keep([drive("GRASS_9", "GRASS", 0, duration_s=1.2)], place)
    refused("run GRASS_9 lasts 1.20 s, shorter than a window of 2 s", "crossval", *quick)
    refused("window length_s is 0.0; it must be positive and finite", "crossval", *quick, "--window", 0)
    refused("no signal set is named", "crossval", *quick, "--signals", ",")
    refused("unknown signal set 'sonar'", "crossval", *quick, "--signals", "imu,sonar")


def test_a_folder_without_runs_is_one_sentence(refused, place):
    refused("nowhere: does not exist; accepted are", "inspect", place / "nowhere")
    (place / "empty").mkdir()
    for command in (("crossval",), ("train", "--name", "m"), ("predict", "--model", "m")):
        refused("empty: holds no run; accepted are", *command, "--data", place / "empty")


def test_a_model_that_cannot_be_trusted_is_one_sentence(refused, place, drive, tracked):
    data = keep([drive("r", "GRASS", 0)], place)
    model = shutil.copytree(tracked[0] / "model", place / "model")
    ask = ("predict", "--data", data, "--model")
    refused("neither a folder nor a model URI", *ask, "nothing")
    content = bytearray((model / MODEL_FILE).read_bytes())
    content[len(content) // 2] ^= 4
    (model / MODEL_FILE).write_bytes(content)
    refused("model.skops: is damaged (SHA-256", *ask, model)


def test_an_output_that_cannot_be_written_is_reported_before_the_work(refused, place, drive_all, monkeypatch):
    data = keep(drive_all(n_runs=2, duration_s=4.0), place)
    (place / "file").write_text("an obstacle")
    (place / "mlruns").write_text("an obstacle")
    monkeypatch.setattr("pipelines.learn.evaluate.evaluate", lambda *_: pytest.fail("the work was begun"))
    cannot = "cannot be written"
    refused(cannot, "convert", data, "--out", place / "file" / "out")
    refused(cannot, "crossval", "--data", data, "--json", place / "file" / "report.json")
    refused("is a folder; --json names a file", "crossval", "--data", data, "--json", data)
    refused(cannot, "train", "--data", data, "--name", "m")
    refused(cannot, "quickstart", "--data", data, "--out", place / "file" / "out")
    refused(cannot, "predict", "--data", data, "--model", "m", "--json", place / "file" / "p.json")


@pytest.mark.parametrize(
    ("sentence", "words"),
    [
        ("soil 'lava' is unknown", "--robot agrimaro --terrain lava"),
        ("scenario 'loop' is unknown", "--robot agrimaro --scenario loop"),
        ("go together", "--robot agrimaro --terrain course"),
        ("too short for 'straight'", "--robot agrimaro --duration 2"),
        ("--grade is 60", "--robot agrimaro --grade 60"),
        ("--camera-lost is '9'; START:END", "--robot agrimaro --camera-lost 9"),
        ("--camera-lost is '9:4'; START:END", "--robot agrimaro --camera-lost 9:4"),
        ("scenario 'crab' is not for robot husky", "--robot husky --scenario crab"),
        ("effect 'magic' is unknown", "--robot husky --effect magic=1"),
        ("key 'wheels' is unknown", "--robot mine.yaml"),
    ],
)
def test_what_cannot_be_simulated_is_one_sentence(refused, place, sentence, words):
    (place / "mine.yaml").write_text("name: mine\ndrive: swerve\nwheels: 3\n")
    given = words.split()
    for option, value in (("--terrain", "grass"), ("--scenario", "straight"), ("--out", "runs")):
        given += [option, value] if option not in given else []
    refused(sentence, "simulate", *given)


def test_what_cannot_be_estimated_is_one_sentence(refused, place, drive):
    data = keep([drive("r", "GRASS", 0, 4.0)], place)
    refused("filter 'vio15' is not for robot husky", "estimate", "--data", data, "--filter", "vio15")
    refused("is there already", "estimate", "--data", data, "--filter", "skid", "--out", data)
    refused("husky", "calibrate", "--data", data, "--robot", "husky")
    refused("is one of robot 'husky'", "calibrate", "--data", data, "--robot", "agrimaro")


def test_from_simulated_logs_to_slip_on_the_command_line(terrain, place):
    words = ("--robot", "agrimaro", "--terrain", "grass", "--scenario", "straight", "--duration", "8")
    code, out, _ = terrain("simulate", *words, "--out", "logs", "--json", "sim.json")
    assert (code, out) == (0, "1 run of 8 s, written to logs.\nnext: terrain inspect logs\n")
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


def test_a_fault_of_the_package_keeps_its_traceback(terrain, place, drive, monkeypatch):
    data = keep([drive("r", "GRASS", 0, 4.0)], place)
    monkeypatch.setattr("pipelines.learn.crossval.crossval", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        terrain("crossval", "--data", data)


def test_crossval_writes_what_it_prints(terrain, place, drive_all):
    data = keep(drive_all(duration_s=12.0), place)
    words = ("crossval", "--data", data, "--repeats", 1, "--no-extras", "--jobs", 1, "--seed", 4)
    code, out, _ = terrain(*words, "--json", place / "new" / "report.json")
    assert code == 0
    report = json.loads((place / "new" / "report.json").read_text())
    assert (report["dataset"], report["seed"], report["n_windows"]) == ("data", 4, 72)
    assert out.startswith(format_value(report["accuracy"], ".1%"))
    assert "72 windows of 2 s from 12 runs" in out
    assert sorted(path.name for path in place.iterdir()) == ["data", "new"]  # no tracking without training


def test_predict_prints_terrain_probability_and_target_slip(terrain, place, drive, tracked):
    run = drive("r", "GRAVEL", 0, label="LAVA")
    imu = run.streams["imu"]
    values = imu.values.copy()
    values[:10] = np.nan
    streams = {**run.streams, "imu": Stream(imu.time_s, values, imu.channels)}
    data = keep([RunLog("r", "husky", streams, run.labels), drive("s", "ASPHALT", 1, label=None)], place)
    table = place / "own.yaml"
    entry = "{traction: {slip_ratio: 0.31, source: assumed}, braking: {slip_ratio: -0.32, source: assumed}, "
    entry += "steady: {slip_ratio: 0.07, source: assumed}}"
    table.write_text(f"name: own\nfallback: any\nterrains:\n  any: {entry}\n")
    words = ("predict", "--model", tracked[0] / "model", "--data", data, "--table", table)
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


def test_help_is_one_screen_with_every_command(terrain):
    code, out, _ = terrain("--help")
    assert code == 0
    assert len(out.splitlines()) <= 40
    assert [command.name for command in COMMANDS if f"\n  {command.name} " not in out] == []


def test_the_command_itself_ends_with_code_2_and_one_line(tmp_path):
    command = "from pipelines.cli.main import main; main()"
    found = subprocess.run(
        [sys.executable, "-c", command, "inspect", tmp_path], capture_output=True, text=True, check=False
    )
    assert (found.returncode, found.stdout) == (2, "")
    assert found.stderr.startswith(f"error: {tmp_path}: holds no run")
    assert found.stderr.count("\n") == 1


def test_the_choices_of_the_command_line_are_those_that_there_are():
    """They are written twice, so that help need not load what offers them."""
    from typing import get_args

    from pipelines.slip.estimate import Filter, Tuning
    from terrain.estimation.estimate import FILTERS, TUNINGS
    from terrain.estimation.observers.choice import OBSERVERS

    assert get_args(Filter) == (*FILTERS, *OBSERVERS, "pose")
    assert get_args(Tuning) == TUNINGS
