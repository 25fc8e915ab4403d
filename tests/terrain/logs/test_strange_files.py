"""Logs that strangers wrote: every fault is one sentence, and nothing outside of the log is read."""

import json
import os
import shutil
from functools import cache

import numpy as np
import pyarrow
import pytest
import yaml
from pyarrow import parquet

from pipelines.data.datasets import load_runs
from terrain.control.slip_table import load_slip_table
from terrain.errors import LogError, TerrainError
from terrain.files.names import data_folder
from terrain.logs import tables
from terrain.logs.run_folders import read_run, write_run
from terrain.robots import load_robot, robot_named


@pytest.fixture
def folder(tmp_path, make_run):
    return write_run(make_run(), tmp_path / "data")


def refusal(call, *given):
    with pytest.raises(TerrainError) as error:
        call(*given)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_log_names_a_robot_of_the_package_or_the_one_that_is_given(tmp_path, monkeypatch):
    text = (data_folder("robots") / "husky.yaml").read_text().replace("name: husky", "name: mule")
    (tmp_path / "mule.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    assert load_robot("mule.yaml").name == "mule"
    for name in ("mule.yaml", str(tmp_path / "mule.yaml"), "mule", "../robots/husky", "x" * 10**5):
        assert "is unknown: a log names one of adap2e, agrimaro" in refusal(robot_named, name)
    (tmp_path / "mule.yaml").write_text(text.replace("name: mule", "name: a/b"))
    assert "mule.yaml: name 'a/b' is no plain name" in refusal(load_robot, "mule.yaml")


@pytest.mark.parametrize("name", ["run.json", "imu.parquet"])
def test_a_link_out_of_the_run_folder_is_refused(tmp_path, folder, name):
    shutil.move(folder / name, tmp_path / name)
    (folder / name).symlink_to(tmp_path / name)
    assert f"SNOW_01/{name}: is a link that leads out of" in refusal(read_run, folder)
    (folder / name).unlink()
    (folder / name).symlink_to(name)
    assert f"SNOW_01/{name}: cannot be opened (a link that leads nowhere)" in refusal(read_run, folder)


def test_folders_may_be_links_and_so_may_files_within(tmp_path, folder):
    (folder / "imu.parquet").rename(folder / "first.parquet")
    (folder / "imu.parquet").symlink_to("first.parquet")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "SNOW_01").symlink_to(folder)
    (tmp_path / "link").symlink_to(tmp_path / "other")
    assert [run.run_id for run in load_runs(tmp_path / "link")] == ["SNOW_01"]


def test_links_out_of_a_folder_of_csv_files_are_refused(tmp_path, borealtc_dir):
    shutil.move(borealtc_dir / "ICE" / "imu_01.csv", tmp_path / "imu_01.csv")
    (borealtc_dir / "ICE" / "imu_01.csv").symlink_to(tmp_path / "imu_01.csv")
    message = "ICE/imu_01.csv: is a link that leads out of"
    assert message in refusal(load_runs, borealtc_dir)
    time = {"column": "time", "unit": "s"}
    gyro = {"gyro_z_radps": {"column": "wz", "unit": "rad/s"}}
    imu = {"file": "{class}/imu_{n}.csv", "time": time, "channels": gyro}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({"robot": "husky", "streams": {"imu": imu}}))
    assert message in refusal(lambda: load_runs(borealtc_dir, mapping=tmp_path / "map.yaml"))
    (tmp_path / "elsewhere").mkdir()
    shutil.move(borealtc_dir / "SNOW", tmp_path / "elsewhere")
    shutil.rmtree(borealtc_dir / "ICE")
    (borealtc_dir / "SNOW").symlink_to(tmp_path / "elsewhere" / "SNOW")
    assert "SNOW/imu_01.csv: is a link" in refusal(
        lambda: load_runs(borealtc_dir, mapping=tmp_path / "map.yaml")
    )
    assert len(load_runs(borealtc_dir)) == 2  # a folder of runs may be a link, as for run folders


def test_a_pipe_is_no_log(folder, borealtc_dir):
    for file, read in (
        (folder / "imu.parquet", lambda: read_run(folder)),
        (folder / "run.json", lambda: read_run(folder)),
        (borealtc_dir / "ICE" / "imu_01.csv", lambda: load_runs(borealtc_dir)),
    ):
        file.unlink()
        os.mkfifo(file)
        assert f"{file.name}: is a pipe, a socket or a device" in refusal(read)


def test_a_parquet_file_is_judged_before_it_is_read(folder, monkeypatch):
    file = folder / "imu.parquet"
    whole = parquet.read_table(file)
    wide = pyarrow.table({f"c{i}_m": [0.0, 1.0] for i in range(5000)})
    parquet.write_table(wide, file)
    assert "imu.parquet: has 5000 columns, at most 4096 are read" in refusal(read_run, folder)
    parquet.write_table(wide.select(range(4000)), file)
    message = refusal(read_run, folder)
    assert "column 'time_s' is missing (the file has c0_m, c1_m" in message
    assert message.endswith("c19_m and 3980 more)")
    nested = pyarrow.array([[1.0]] * whole.num_rows)
    gyro = whole.column_names.index("gyro_z_radps")
    parquet.write_table(whole.set_column(gyro, "gyro_z_radps", nested), file)
    assert "column 'gyro_z_radps' holds list<" in refusal(read_run, folder)
    parquet.write_table(whole, file)
    monkeypatch.setattr(tables, "MAX_VALUES", 100)
    assert "has 200 rows of 7 columns, at most 100 values are read" in refusal(read_run, folder)
    monkeypatch.undo()
    monkeypatch.setattr(tables, "MAX_FOOTER_BYTES", 100)
    assert "imu.parquet: describes itself in" in refusal(read_run, folder)


def test_a_packed_csv_file_that_grows_too_large_is_refused(tmp_path, monkeypatch):
    import gzip

    path = tmp_path / "samples.csv.gz"
    path.write_bytes(gzip.compress(b"a\n" + b"0\n" * 2_000_000))
    assert len(tables.read_table(path, ["a"])) == 2_000_000
    monkeypatch.setattr(tables, "MAX_UNPACKED_BYTES", 2**20)
    with pytest.raises(LogError, match="unpacks to more than 1 MiB"):
        tables.read_table(path, ["a"])


def fuzzed(whole, rng):
    """Return bytes cut short, with a piece left out, or with some bytes changed."""
    content = bytearray(whole)
    if (draw := rng.random()) < 0.2:
        return bytes(content[: rng.integers(len(content))])
    if draw < 0.3:
        start, end = sorted(rng.integers(len(content), size=2))
        return bytes(content[:start] + content[end:])
    for place in rng.integers(len(content), size=rng.integers(1, 6)):
        content[place] = rng.integers(256)
    return bytes(content)


READERS = {
    "run.json": (lambda path: read_run(path.parent), None),
    "imu.parquet": (lambda path: read_run(path.parent), None),
    "robot.yaml": (load_robot, ("robots", "husky.yaml")),
    "table.yaml": (load_slip_table, ("target_slip", "default.yaml")),
}
ODD = [[], {}, None, True, -1, 0, 1e308, 5e-324, "x" * 1000, "", "../x", "a\0", "\n", 2**62, [[1]], {"a": 1}]


@cache
def as_json(whole):
    return json.dumps(yaml.safe_load(whole))


def odd_values(whole, rng):
    """Return a document in which a value anywhere is an odd one; JSON is YAML."""
    document, places = json.loads(as_json(whole)), []

    def walk(inner):
        for key, value in inner.items() if isinstance(inner, dict) else enumerate(inner):
            places.append((inner, key))
            if isinstance(value, dict | list):
                walk(value)

    walk(document)
    holder, key = places[rng.integers(len(places))]
    holder[key] = ODD[rng.integers(len(ODD))]
    return json.dumps(document).encode()


@pytest.mark.parametrize(
    ("name", "spoil"),
    [*((name, fuzzed) for name in READERS), *((n, odd_values) for n in READERS if n != "imu.parquet")],
)
def test_what_is_damaged_or_odd_is_one_sentence(folder, name, spoil):
    read, packaged = READERS[name]
    path = data_folder(packaged[0]) / packaged[1] if packaged else folder / name
    whole = b"".join(line for line in path.read_bytes().splitlines(keepends=True) if line[:1] != b"#")
    rng, messages = np.random.default_rng(0), []
    for _ in range(40 if packaged else 150):
        (folder / name).write_bytes(spoil(whole, rng))
        try:
            read(folder / name)
        except TerrainError as error:
            messages.append(str(error))
    assert len(messages) > (5 if packaged else 30)
    assert all(message.isprintable() and len(message) < 3000 for message in messages)
