"""The command line on good and bad data: what is refused in one sentence, and what the commands write."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from pipelines.cli.table import COMMANDS
from pipelines.learn.model_file import MODEL_FILE
from pipelines.report.numbers import format_value
from terrain.files.names import data_folder
from terrain.logs.write import write_run
from terrain.records import RunLog, Stream

DEEP = "[" * 100_000
LAUGHS = "0: &a0 [x, x]\n" + "".join(f"{i}: &a{i} [{f'*a{i - 1}, ' * 9}]\n" for i in range(1, 9))
MAPPING = """robot: husky
streams:
  imu: {file: "{run}.csv", time: {column: t, unit: s}, channels: {gyro_z_radps: {column: wz, unit: furlong}}}
"""


def keep(runs, place):
    for run in runs:
        write_run(run, place / "data")
    return place / "data"


@pytest.fixture
def files(place, drive):
    """The folder to work in, with a run in ``data`` and files that are none of what commands read."""
    keep([drive("r", "GRASS", 0, duration_s=4.0)], place)
    (place / "empty").mkdir()
    written = {"file": "an obstacle", "laughs.yaml": LAUGHS, "map.yaml": MAPPING, "evil.yaml": "secret: 1\n"}
    written |= {"a.csv": "t,wz\n0,1\n0.1,2\n", "mine.yaml": "name: mine\ndrive: swerve\nwheels: 3\n"}
    for name, text in written.items():
        (place / name).write_text(text)
    return place


SIMULATE, STRAIGHT = "simulate --out runs", "--terrain grass --scenario straight"
LAUGHED = "those of aliases counted each time"
ESTIMATE, PREDICT = "estimate --data data --filter", "predict --data data --model"


@pytest.mark.parametrize(
    ("sentence", "words"),
    [
        ("furlong", "inspect . --format csv --mapping map.yaml"),
        ("nowhere: does not exist; accepted are", "inspect nowhere"),
        ("empty: holds no run; accepted are", "train --name m --data empty"),
        ("all windows are 'GRASS': a classifier needs at least two classes", "crossval --data data"),
        ("run r lasts 4.00 s, shorter than a window of 5 s", "crossval --data data --window 5"),
        ("window length_s is 0.0; it must be positive and finite", "crossval --data data --window 0"),
        ("no signal set is named", "crossval --data data --signals ,"),
        ("unknown signal set 'sonar'", "crossval --data data --signals imu,sonar"),
        ("neither a folder nor a model URI", f"{PREDICT} nothing"),
        ("soil 'lava' is unknown", f"{SIMULATE} --robot agrimaro --scenario straight --terrain lava"),
        ("scenario 'loop' is unknown", f"{SIMULATE} --robot agrimaro --terrain grass --scenario loop"),
        ("too short for 'straight'", f"{SIMULATE} {STRAIGHT} --robot agrimaro --duration 2"),
        ("--camera-lost is '9:4'; START:END", f"{SIMULATE} {STRAIGHT} --robot agrimaro --camera-lost 9:4"),
        ("effect 'magic' is unknown", f"{SIMULATE} {STRAIGHT} --robot husky --effect magic=1"),
        ("key 'wheels' is unknown", f"{SIMULATE} {STRAIGHT} --robot mine.yaml"),
        ("filter 'vio15' is not for robot husky", f"{ESTIMATE} vio15"),
        ("is there already", f"{ESTIMATE} skid --out data"),
        ("is one of robot 'husky'", "calibrate --data data --robot agrimaro"),
        (LAUGHED, f"{SIMULATE} --robot agrimaro --scenario straight --terrain laughs.yaml"),
        (LAUGHED, f"{ESTIMATE} skid --robot laughs.yaml"),
        (LAUGHED, "inspect data --format csv --mapping laughs.yaml"),
        (LAUGHED, "drive --robot agrimaro --terrain grass --table laughs.yaml"),
        ("cannot be written", "convert data --out file/out"),
        ("cannot be written", "crossval --data data --json file/report.json"),
        ("is a folder; --json names a file", "crossval --data data --json data"),
        ("cannot be written", "quickstart --data data --out file/out"),
        ("cannot be written", f"{PREDICT} m --json file/p.json"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_sentence(refused, files, sentence, words):
    refused(sentence, *words.split())


def edit_run(folder, **changed):
    file = folder / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changed))


def link_out(folder):
    shutil.move(folder / "imu.parquet", folder.parents[1])
    (folder / "imu.parquet").symlink_to(folder.parents[1] / "imu.parquet")


def pipe(folder):
    (folder / "run.json").unlink()
    os.mkfifo(folder / "run.json")


def cut_short(folder):
    (folder / "imu.parquet").write_bytes((folder / "imu.parquet").read_bytes()[:-20])


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda folder: shutil.copytree(folder, folder.parent / "copy"), "2 runs have the id 'r'"),
        (lambda folder: (folder / "run.json").write_text(DEEP), "is nested deeper than 32 levels"),
        (lambda folder: (folder / "run.json").write_bytes(b"\xff\xfe{\x00"), "is no JSON"),
        (lambda folder: edit_run(folder, run_id="../../etc"), "begins with a dot"),
        (lambda folder: edit_run(folder, session="a\x1b[2Jb"), "holds a control character"),
        (lambda folder: edit_run(folder, robot="r" * 10**6), "is longer than 128 characters"),
        (lambda folder: edit_run(folder, robot="../evil"), "is no plain name"),
        (lambda folder: edit_run(folder, robot="evil.yaml"), "robot 'evil.yaml' is unknown: a log names one of"),
        (link_out, "is a link that leads out of"),
        (pipe, "is a pipe, a socket or a device"),
        (cut_short, "is no whole Parquet file"),
    ],
)  # fmt: skip
def test_a_run_of_a_stranger_is_one_sentence(refused, files, spoil, sentence):
    spoil(files / "data" / "r")
    refused(sentence, "estimate", "--data", "data", "--filter", "skid")


def test_a_column_that_is_missing_is_one_sentence(refused, borealtc_dir, place, edit):
    shutil.copytree(borealtc_dir, place / "logs")
    edit(place / "logs" / "SNOW" / "imu_01.csv", lambda lines: [line.rpartition(",")[0] for line in lines])
    refused("imu_01.csv: column 'az' is missing", "convert", "logs", "--out", "out")
    refused("imu_01.csv: column 'az' is missing", "crossval", "--data", "logs", "--json", "report.json")


def test_a_store_that_cannot_be_written_is_reported_before_the_work(refused, place, drive_all):
    data = keep(drive_all(n_runs=2, duration_s=4.0), place)
    (place / "mlruns").write_text("an obstacle")
    refused("cannot be written", "train", "--data", data, "--name", "m")


def test_a_model_of_a_stranger_is_one_sentence(refused, files, tracked):
    model = shutil.copytree(tracked[0] / "model", files / "model")
    whole = (model / MODEL_FILE).read_bytes()
    (model / MODEL_FILE).write_bytes(whole[:-4] + bytes([whole[-4] ^ 4]) + whole[-3:])
    refused("model.skops: is damaged (SHA-256", *PREDICT.split(), model)
    (model / MODEL_FILE).unlink()
    (model / MODEL_FILE).symlink_to("../file")
    refused("model.skops: is a link that leads out of", *PREDICT.split(), model)
    (model / "terrain_model.json").write_text(DEEP)
    refused("is nested deeper than 32 levels", *PREDICT.split(), model)


def test_a_robot_that_the_user_gives_may_be_a_file(files, terrain):
    text = (data_folder("robots") / "husky.yaml").read_text().replace("name: husky", "name: mule")
    (files / "mule.yaml").write_text(text)
    edit_run(files / "data" / "r", robot="mule")
    code, out, _ = terrain(*ESTIMATE.split(), "skid", "--robot", "mule.yaml")
    assert (code, "skid" in out) == (0, True)


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
