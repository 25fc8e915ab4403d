"""Files of MATLAB and spreadsheets, receivers, and runs joined of several files: what is read, what is refused."""

import sys
from datetime import datetime, timedelta

import h5py
import numpy as np
import openpyxl
import pytest
import yaml
from scipy.io import savemat

from pipelines.data.datasets import load_runs
from terrain.errors import ConfigError, LogError
from terrain.logs.mapping import local_metres

TIME = {"column": "t", "unit": "s"}
T = 0.1 * np.arange(6)


def imu_of(file, column="wz", **more):
    channels = {"gyro_z_radps": {"column": column, "unit": "deg/s"}}
    return {"file": file, "time": TIME, "channels": channels} | more


def read(folder, streams, **options):
    described = {"robot": "husky", "run_id": "drive", "streams": streams}
    (folder / "map.yaml").write_text(yaml.safe_dump(described))
    (run,) = load_runs(folder, mapping=folder / "map.yaml", **options)
    return run


def write_hdf5(path, content):
    """Write a file as MATLAB 7.3 does: a struct is a group, columns come first."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in content.items():
            if isinstance(value, dict):
                for field, inner in value.items():
                    file[f"{name}/{field}"] = np.atleast_2d(inner)
            else:
                file[name] = np.atleast_2d(value) if np.ndim(value) < 2 else value.T
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")


@pytest.mark.parametrize(
    "write", [lambda path, content: savemat(path, content), write_hdf5], ids=["5", "7.3"]
)
@pytest.mark.parametrize("column", ["wz", "log.wz", "data[1]"])
def test_a_mat_file_is_read_by_variables_fields_and_columns(tmp_path, write, column):
    wz = np.linspace(0.0, 90.0, 6)
    matrix = np.column_stack([T, wz])
    write(tmp_path / "drive.mat", {"t": T, "wz": wz, "log": {"wz": wz, "note": T}, "data": matrix})
    run = read(tmp_path, {"imu": imu_of("drive.mat", column)})
    np.testing.assert_allclose(run.streams["imu"].channel("gyro_z_radps"), np.radians(wz), rtol=1e-12)
    np.testing.assert_array_equal(run.streams["imu"].time_s, T)


@pytest.mark.parametrize(
    ("column", "sentence"),
    [
        ("wx", "variable 'wx' is missing (there are "),
        ("log.wx", "variable 'log.wx' is missing (there are wz)"),
        ("log", "variable 'log' is a struct: name a field, as log.wz"),
        ("name", "variable 'name' holds no numbers"),
        ("data", "is 6 x 2, a vector is required: data[0] is its first column"),
        ("data[2]", "is 6 x 2, data[2] is not in it"),
        ("short", "variable 'short' has 3 values, 't' has 6"),
    ],
)
def test_a_mat_file_without_what_is_mapped_is_one_sentence(tmp_path, column, sentence):
    content = {"t": T, "log": {"wz": T}, "name": "husky", "data": np.ones((6, 2)), "short": T[:3]}
    savemat(tmp_path / "drive.mat", content)
    with pytest.raises(LogError) as raised:
        read(tmp_path, {"imu": imu_of("drive.mat", column)})
    assert sentence in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("content", [b"", b"no mat file at all" * 20, b"\x89HDF\r\n\x1a\n" + bytes(600)])
def test_a_damaged_mat_file_or_spreadsheet_is_one_sentence(tmp_path, content):
    for name in ("drive.mat", "drive.xlsx"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(LogError, match=name) as raised:
            read(tmp_path, {"imu": imu_of(name)})
        assert "\n" not in str(raised.value)


def write_sheet(path, rows, title="log", first=()):
    book = openpyxl.Workbook()
    if first:
        for row in first:
            book.active.append(row)
        sheet = book.create_sheet(title)
    else:
        sheet = book.active
        sheet.title = title
    for row in rows:
        sheet.append(row)
    book.save(path)


def test_a_spreadsheet_is_read_by_its_names_dates_and_sheet(tmp_path):
    begin = datetime(2024, 5, 1, 12)
    rows = [
        ("drive of May",),
        ("t", "wz"),
        *((begin + timedelta(seconds=float(t)), 90 * t) for t in T),
        (None, None),
    ]
    write_sheet(tmp_path / "drive.xlsx", rows[:-1], "second", first=[("nothing",)])
    run = read(tmp_path, {"imu": imu_of("drive.xlsx", sheet="second", skip_rows=1)})
    stream = run.streams["imu"]
    np.testing.assert_allclose(stream.time_s - stream.time_s[0], T, atol=1e-6)
    np.testing.assert_allclose(stream.channel("gyro_z_radps"), np.radians(90 * T), atol=1e-12)
    with pytest.raises(LogError, match=r"has no sheet 'third' \(it has Sheet, second\)"):
        read(tmp_path, {"imu": imu_of("drive.xlsx", sheet="third", skip_rows=1)})


def test_two_header_rows_of_a_spreadsheet_are_named_with_the_key_that_reads_them(tmp_path):
    write_sheet(tmp_path / "drive.xlsx", [("t", "wz"), ("s", "deg/s"), *zip(T, 90 * T, strict=True)])
    with pytest.raises(LogError, match=r"t at row 2 is 's'.*is read with 'header_rows: 2'"):
        read(tmp_path, {"imu": imu_of("drive.xlsx")})
    run = read(tmp_path, {"imu": imu_of("drive.xlsx", header_rows=2)})
    assert len(run.streams["imu"]) == 6


def test_cells_of_a_spreadsheet_that_are_no_numbers_are_refused_or_counted(tmp_path):
    rows = [("t", "wz"), *zip(T, 90 * T, strict=True)]
    rows[3] = (T[2], "wet")
    write_sheet(tmp_path / "drive.xlsx", rows)
    with pytest.raises(LogError, match="wz at row 4 is 'wet', which is no number"):
        read(tmp_path, {"imu": imu_of("drive.xlsx")})
    run = read(tmp_path, {"imu": imu_of("drive.xlsx")}, repair=True)
    assert np.isnan(run.streams["imu"].values[:, 0]).tolist() == [False, False, True, False, False, False]
    assert run.dropped == {"cells that are no number": 1}
    with pytest.raises(LogError, match=r"column 'wx' is missing \(the file has t, wz\)"):
        read(tmp_path, {"imu": imu_of("drive.xlsx", "wx")})


@pytest.mark.parametrize("package", ["h5py", "openpyxl", "pymap3d"])
def test_a_missing_package_is_one_sentence(tmp_path, monkeypatch, package):
    write_hdf5(tmp_path / "drive.mat", {"t": T, "wz": T})
    write_sheet(tmp_path / "drive.xlsx", [("t", "wz"), *zip(T, T, strict=True)])
    monkeypatch.setitem(sys.modules, package, None)
    stream = imu_of({"h5py": "drive.mat"}.get(package, "drive.xlsx"))
    if package == "pymap3d":
        stream["position"] = {"latitude": "t", "longitude": "t"}
    with pytest.raises(ConfigError, match=rf"{package}.*terrain-slip\[logs\]"):
        read(tmp_path, {"imu": stream})


def test_latitude_and_longitude_become_metres_of_the_first_fix_or_an_origin(tmp_path):
    """Known lengths: 111.13 km are a degree of latitude at 45 degrees, 78.85 km one of longitude."""
    (tmp_path / "gps.csv").write_text(
        "t,lat,lon,alt\n0,,,\n0.2,45.0,7.0,200\n0.4,45.0001,7.0,201\n0.6,45.0,7.0001,202\n0.8,45,7,200\n"
    )
    (tmp_path / "imu.csv").write_text("t,wz\n" + "".join(f"{t},1\n" for t in T))
    position = {"latitude": "lat", "longitude": "lon", "height": "alt"}
    gps = {"file": "gps.csv", "time": TIME, "position": position}
    run = read(tmp_path, {"imu": imu_of("imu.csv"), "gnss": gps})
    stream = run.streams["gnss"]
    assert stream.channels == ("position_x_m", "position_y_m", "position_z_m")
    assert np.isnan(stream.values[0]).all()
    np.testing.assert_allclose(
        stream.values[1:], [[0, 0, 0], [0, 11.113, 1], [7.885, 0, 2], [0, 0, 0]], atol=2e-3
    )
    del position["height"]
    stream = read(tmp_path, {"gnss": gps | {"position": position | {"origin": [45.0, 7.0001, 0.0]}}}).streams[
        "gnss"
    ]
    np.testing.assert_allclose(stream.values[1], [-7.885, 0.0], atol=2e-3)
    (tmp_path / "gps.csv").write_text("t,lat,lon\n0,145,7\n1,45,7\n")
    with pytest.raises(LogError, match=r"gps.csv: latitude reaches 145 deg"):
        read(tmp_path, {"gnss": gps})
    with pytest.raises(LogError, match="no latitude and longitude are known"):
        local_metres(np.array([np.nan]), np.array([0.0]))


def test_a_run_is_joined_of_files_of_different_formats_on_one_clock(tmp_path):
    savemat(tmp_path / "drive.mat", {"t": T, "wz": T})
    write_sheet(tmp_path / "wheels.xlsx", [("stamp", "v"), *zip(1000 * (T + 0.05), 3.6 + T, strict=True)])
    wheels = {
        "file": "wheels.xlsx",
        "time": {"column": "stamp", "unit": "ms", "offset": -50.0},
        "channels": {"speed_left_mps": {"column": "v", "unit": "km/h"}},
    }
    run = read(tmp_path, {"imu": imu_of("drive.mat"), "wheels": wheels})
    np.testing.assert_allclose(run.streams["wheels"].time_s, T, atol=1e-9)
    np.testing.assert_allclose(run.streams["wheels"].values[0], [1.0])


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"channels": {}}, "has no channels and no position"),
        ({"time": None}, "key 'streams.imu.time' is missing"),
        ({"position": {"latitude": "a"}}, "longitude' is missing"),
        (
            {
                "channels": {"position_x_m": {"column": "a", "unit": "m"}},
                "position": {"latitude": "a", "longitude": "b"},
            },
            "'position' gives the channel position_x_m too",
        ),
        ({"messages": {"topic": "/a"}}, "'messages' leave out time, channels and position"),
        ({"messages": {"topic": "/a"}, "time": None, "channels": {}}, "has no channels"),
        (
            {"messages": {"topic": "/a", "topics": "/a"}, "time": None, "channels": {}},
            "key 'topics' is unknown",
        ),
    ],
)
def test_a_mapping_that_contradicts_itself_is_one_sentence(tmp_path, change, sentence):
    savemat(tmp_path / "drive.mat", {"t": T, "wz": T})
    stream = {key: value for key, value in (imu_of("drive.mat") | change).items() if value is not None}
    with pytest.raises(ConfigError) as raised:
        read(tmp_path, {"imu": stream})
    assert sentence in str(raised.value)
