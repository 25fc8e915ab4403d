"""Files of strangers on the command line: exit code 2, one line on stderr, no traceback."""

import json
import os
import shutil

import pytest
from pyarrow import parquet

from terrain.files.resources import data_folder
from terrain.logs.write import write_run

DEEP = "[" * 100_000
LAUGHS = b"0: &a0 [x, x]\n" + b"".join(
    b"%d: &a%d [%s]\n" % (i, i, b"*a%d, " % (i - 1) * 9) for i in range(1, 9)
)


@pytest.fixture
def place(place, drive):
    """The folder to work in, with a run in ``data``."""
    write_run(drive("r", "GRASS", 0, duration_s=4.0), place / "data")
    return place


def edit(place, **changed):
    file = place / "data" / "r" / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changed))


def test_a_log_never_makes_a_command_read_a_file(refused, place):
    (place / "evil.yaml").write_text("secret: 1\n")
    ask = ("estimate", "--data", "data", "--filter", "skid")
    for name in (str(place / "evil.yaml"), "../evil"):
        edit(place, robot=name)
        refused("is no plain name", *ask)
    edit(place, robot="evil.yaml")  # a name; not of the package, though such a file lies here
    refused("robot 'evil.yaml' is unknown: a log names one of adap2e", *ask)
    refused("robot 'evil.yaml' is unknown", "crossval", "--data", "data", "--align")


def test_a_robot_that_the_user_gives_may_be_a_file(place, terrain):
    text = (data_folder("robots") / "husky.yaml").read_text().replace("name: husky", "name: mule")
    (place / "mule.yaml").write_text(text)
    edit(place, robot="mule")
    code, out, _ = terrain("estimate", "--data", "data", "--filter", "skid", "--robot", "mule.yaml")
    assert code == 0
    assert "skid" in out


def test_names_of_a_log_do_not_reach_the_terminal_as_they_are(refused, place):
    for changed, sentence in (
        ({"run_id": "../../etc"}, "begins with a dot"),
        ({"session": "a\x1b[2Jb"}, "holds a control character"),
        ({"robot": "r" * 10**6}, "is longer than 128 characters"),
        ({"streams": {"a\n\x1b[2J": 1}}, "is 1: input should be a valid dictionary"),
        ({"labels": "x" * 10**6}, "input should be a valid list"),
    ):
        before = (place / "data" / "r" / "run.json").read_text()
        edit(place, **changed)
        refused(sentence, "inspect", "data")
        (place / "data" / "r" / "run.json").write_text(before)


@pytest.mark.parametrize("name", ["run.json", "imu.parquet"])
def test_what_is_no_file_of_the_run_is_one_line(refused, place, name):
    file = place / "data" / "r" / name
    shutil.move(file, place / name)
    file.symlink_to(place / name)
    refused("is a link that leads out of", "inspect", "data")
    file.unlink()
    os.mkfifo(file)
    refused("is a pipe, a socket or a device", "inspect", "data")
    file.unlink()
    file.mkdir()
    refused("is a folder, a regular file is required", "inspect", "data")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (DEEP.encode(), "is nested deeper than 32 levels"),
        (b'{"schema_version": 1' + b"0" * 5000 + b"}", "more than 64 bits"),
        (b'{"schema_version": NaN}', "holds NaN"),
        (b"\xff\xfe{\x00", "is no JSON"),
        (b"\x00", "is no JSON"),
    ],
)
def test_json_of_a_stranger_is_one_line(refused, place, content, sentence):
    (place / "data" / "r" / "run.json").write_bytes(content)
    refused(sentence, "inspect", "data")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (DEEP.encode(), "is nested deeper than 32 levels"),
        (LAUGHS, "those of aliases counted each time"),
        (b"a: 2026-13-45", "is no YAML"),
        (b"a: \x00", "is no YAML"),
        (b"\xff\xfe", "is no YAML"),
        (b"#" * 2**21, "is larger than 1 MiB"),
    ],
)
def test_yaml_of_a_stranger_is_one_line(refused, place, content, sentence):
    (place / "it.yaml").write_bytes(content)
    simulate = ("simulate", "--robot", "agrimaro", "--scenario", "straight", "--out", "out")
    refused(sentence, *simulate, "--terrain", "it.yaml")
    refused(sentence, "estimate", "--data", "data", "--filter", "skid", "--robot", "it.yaml")
    refused(sentence, "inspect", "data", "--format", "csv", "--mapping", "it.yaml")
    refused(sentence, "drive", "--robot", "agrimaro", "--terrain", "grass", "--table", "it.yaml")


def test_a_parquet_file_of_a_stranger_is_one_line(refused, place):
    file = place / "data" / "r" / "imu.parquet"
    table = parquet.read_table(file)
    parquet.write_table(table.rename_columns(["time_s", *(f"\x1b[2J{i}" for i in range(6))]), file)
    refused("column 'gyro_x_radps' is missing", "inspect", "data")
    file.write_bytes(file.read_bytes()[:-20])
    refused("is no whole Parquet file", "inspect", "data")


def test_a_model_of_a_stranger_is_one_line(refused, place, tracked):
    model = shutil.copytree(tracked[0] / "model", place / "model")
    ask = ("predict", "--data", "data", "--model", "model")
    whole = (model / "terrain_model.json").read_bytes()
    (model / "terrain_model.json").write_text(DEEP)
    refused("is nested deeper than 32 levels", *ask)
    (model / "terrain_model.json").write_bytes(whole)
    shutil.move(model / "model.skops", place / "model.skops")
    (model / "model.skops").symlink_to("../model.skops")
    refused("model.skops: is a link that leads out of", *ask)
