import json
import tempfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from terrain.errors import LogError, TerrainError
from terrain.logs.digest import data_digest
from terrain.logs.read import find_runs, read_run
from terrain.logs.write import write_run
from terrain.records import Label, RunLog, Stream

TIMES = st.lists(st.floats(0.0, 1e9, width=64), min_size=2, max_size=8, unique=True).map(sorted)
VALUES = npst.arrays(
    np.float64, (8, 2), elements=st.one_of(st.just(np.nan), st.floats(allow_nan=False, allow_infinity=False))
)

NAMES = st.text(
    st.characters(exclude_categories=["C", "Zl", "Zp"], exclude_characters="/\\"), min_size=1, max_size=8
).filter(lambda name: name.strip() and not name.startswith("."))
KINDS = st.text(st.characters(exclude_categories=["C", "Zl", "Zp"]), max_size=5)


@settings(max_examples=30, deadline=None)
@given(
    TIMES,
    VALUES,
    NAMES,
    st.text(st.characters(exclude_categories=["Cs"]), max_size=8),
    st.dictionaries(KINDS, st.integers(0, 9), max_size=2),
)
def test_a_written_log_is_read_back_unchanged(time_s, values, name, words, dropped):
    values[0] = 1.0
    stream = Stream(time_s, values[: len(time_s)], ("gyro_z_radps", "accel_x_mps2"))
    run = RunLog("A_1", name, {"imu": stream}, (Label(0.1, 0.3, name),), words, dropped)
    with tempfile.TemporaryDirectory() as folder:
        back = read_run(write_run(run, folder))
    assert (back.run_id, back.robot, back.labels, back.source) == (run.run_id, name, run.labels, words)
    assert dict(back.dropped) == dropped
    assert back.streams["imu"].channels == stream.channels
    np.testing.assert_array_equal(back.streams["imu"].time_s, stream.time_s)
    np.testing.assert_array_equal(back.streams["imu"].values, stream.values)


def test_the_same_run_gives_the_same_bytes(tmp_path, make_run):
    one, other = (write_run(make_run(), tmp_path / name) for name in ("one", "other"))
    files = sorted(path.name for path in one.iterdir())
    assert files == ["imu.parquet", "run.json", "wheels.parquet"]
    assert all((one / name).read_bytes() == (other / name).read_bytes() for name in files)


def test_an_existing_run_is_replaced_only_when_asked(tmp_path, make_run):
    write_run(make_run(seed=1), tmp_path)
    with pytest.raises(LogError, match="a run folder is there already, and is left as it is"):
        write_run(make_run(seed=2), tmp_path)
    assert (
        read_run(tmp_path / "SNOW_01").streams["imu"].values[0, 0]
        == make_run(seed=1).streams["imu"].values[0, 0]
    )
    write_run(make_run(seed=2), tmp_path, replace=True)
    assert (
        read_run(tmp_path / "SNOW_01").streams["imu"].values[0, 0]
        == make_run(seed=2).streams["imu"].values[0, 0]
    )
    assert [path.name for path in tmp_path.iterdir()] == ["SNOW_01"]


def test_a_folder_that_is_no_run_is_never_replaced(tmp_path, make_run):
    (tmp_path / "SNOW_01").mkdir()
    (tmp_path / "SNOW_01" / "thesis.tex").write_text("precious")
    with pytest.raises(LogError, match="something else is there already"):
        write_run(make_run(), tmp_path, replace=True)
    assert (tmp_path / "SNOW_01" / "thesis.tex").exists()


def test_a_failed_write_leaves_nothing_behind(tmp_path, make_run, monkeypatch):
    def full(*args, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pyarrow.parquet.write_table", full)
    with pytest.raises(TerrainError, match=r"SNOW_01: cannot be written \(No space left on device\)"):
        write_run(make_run(), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("run_id", ["../escape", "", ".hidden", "a/b"])
def test_an_id_that_leaves_the_folder_is_refused(tmp_path, make_run, run_id):
    with pytest.raises(LogError, match="cannot name a folder"):
        write_run(make_run(run_id), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_unfinished_writes_are_no_runs(tmp_path, make_run):
    folder = write_run(make_run(), tmp_path)
    folder.rename(tmp_path / ".SNOW_01.1234")
    assert find_runs(tmp_path) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(schema_version=99),
         "SNOW_01/run.json: schema version 99 is unknown, this package reads 1"),
        (lambda d: d.pop("schema_version"), "key 'schema_version' is missing"),
        (lambda d: d.pop("labels"), "SNOW_01/run.json: key 'labels' is missing"),
        (lambda d: d.update(streams={}), "the run has no stream"),
        (lambda d: d["streams"]["imu"].update(file="../imu.parquet"),
         "is not the name of a file in the run folder"),
        (lambda d: d["streams"]["imu"].update(file="gps.parquet"), "SNOW_01/gps.parquet: is missing"),
        (lambda d: d["streams"]["imu"]["channels"].update(gyro_z_radps="deg"),
         "'gyro_z_radps' is declared in 'deg'"),
        (lambda d: d["streams"]["imu"]["channels"].update(gyro_z_dps="dps"), "does not end in a known unit"),
        (lambda d: d["streams"]["imu"]["channels"].update(gyro_w_radps="radps"),
         "column 'gyro_w_radps' is missing"),
        (lambda d: d["labels"].append({"start_s": 1.0, "end_s": 2.0, "terrain": "ICE"}), "overlap at 1.0 s"),
        (lambda d: d["labels"][0].update(end_s=-1.0), "label 'SNOW' ends at -1.0 s and starts at 0.0 s"),
        (lambda d: d["labels"][0].update(end_s="late"), "labels.0.end_s is 'late': input should be a valid number"),
        (lambda d: d.update(dropped={"rows": -1}), "dropped.rows is -1: input should be greater than or equal to 0"),
    ],
)  # fmt: skip
def test_a_wrong_run_json_is_refused_in_one_sentence(tmp_path, make_run, change, message):
    path = write_run(make_run(), tmp_path) / "run.json"
    head = json.loads(path.read_text())
    change(head)
    path.write_text(json.dumps(head))
    with pytest.raises(LogError) as error:
        read_run(path.parent)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_damaged_files_are_refused_in_one_sentence(tmp_path, make_run):
    folder = write_run(make_run(), tmp_path)
    whole = (folder / "imu.parquet").read_bytes()
    for content in (b"", whole[: len(whole) // 2], b"time_s,gyro\n"):
        (folder / "imu.parquet").write_bytes(content)
        with pytest.raises(LogError, match=r"^SNOW_01/imu\.parquet: is no whole Parquet file .*$"):
            read_run(folder)
    (folder / "run.json").write_text('{"run_id": ')
    with pytest.raises(LogError, match=r"SNOW_01/run\.json: is no JSON"):
        read_run(folder)
    with pytest.raises(LogError, match=r"nowhere/run\.json: is missing"):
        read_run(tmp_path / "nowhere")


def test_the_digest_sees_content_and_nothing_else(make_run):
    run, other = make_run(), make_run("SNOW_02", seed=1)
    imu = run.streams["imu"]

    def digest(stream=imu, **changes):
        return data_digest(
            [replace(run, streams={"wheels": run.streams["wheels"], "imu": stream}, **changes)]
        )

    values = imu.values.copy()
    values[7, 2] = np.nextafter(values[7, 2], 9.0)
    swapped = Stream(imu.time_s, imu.values[:, ::-1], imu.channels[::-1])
    assert digest() == digest(source="elsewhere", dropped={"rows": 1}) == digest(swapped)
    changed = [
        digest(Stream(imu.time_s, values, imu.channels)),
        digest(Stream(imu.time_s + 1e-9, imu.values, imu.channels)),
        digest(Stream(imu.time_s, imu.values, imu.channels[::-1])),
        digest(run_id="SNOW_09"),
        digest(robot="jackal"),
        digest(labels=(Label(0.0, 4.0, "ICE"),)),
    ]
    assert len({digest(), *changed}) == 7
    assert data_digest([run, other]) == data_digest([other, run]) != digest()
