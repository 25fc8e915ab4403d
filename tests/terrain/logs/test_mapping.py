"""Tables of labs by a mapping: formats, units, headers, names in any language, positions; and mistakes in mappings."""

import sys
import unicodedata
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pytest
import yaml
from pymap3d import enu2geodetic
from scipy.io import savemat

from pipelines.data.convert import Settings as ConvertSettings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import load_runs, verdict
from terrain.errors import ConfigError, LogError
from terrain.logs.mapping import local_metres
from terrain.logs.run_folders import data_digest
from terrain.logs.samples import RESPELT
from terrain.logs.schema import GNSS_CHANNELS
from terrain.robots import load_robot

ROOT = Path(__file__).resolve().parents[3]
T, TIME = 0.1 * np.arange(6), {"column": "t", "unit": "s"}
SPEED = {"speed_left_mps": {"column": "v", "unit": "m/s"}}
GYRO = {"gyro_z_radps": {"column": "wz", "unit": "deg/s"}}


def imu_of(file, column="wz", **more):
    channels = {"gyro_z_radps": {"column": column, "unit": "deg/s"}}
    return {"file": file, "time": TIME, "channels": channels} | more


@pytest.fixture
def read(tmp_path):
    """Return what reads the run of streams in the folder, or of a text in ``data.csv``."""

    def apply(streams=None, text=None, keys=None, **options):
        if text is not None:
            (tmp_path / "data.csv").write_text(text)
            streams = {"logger": {"file": "data.csv", "time": TIME, "channels": SPEED} | (keys or {})}
        described = {"robot": "husky", "run_id": "drive", "terrain": "GRASS", "streams": streams}
        (tmp_path / "map.yaml").write_text(yaml.safe_dump(described))
        (run,) = load_runs(tmp_path, mapping=tmp_path / "map.yaml", **options)
        return run

    return apply


UNITS = [
    *(("angle_1_rad", "deg", 180.0, np.pi), ("angle_1_rad", "mrad", 500.0, 0.5)),
    *(("angle_1_rad", "\u00b0", 90.0, np.pi / 2), ("gyro_z_radps", "\u00b0/s", 90.0, np.pi / 2)),
    *(("gyro_z_radps", "deg/s", 180.0, np.pi), ("motor_1_radps", "rpm", 60.0, 2 * np.pi)),
    *(("motor_1_radps", "1/min", 30.0, np.pi), ("speed_left_mps", "km/h", 36.0, 10.0)),
    *(("speed_left_mps", "kmh", 3.6, 1.0), ("speed_left_mps", "mm/s", 250.0, 0.25)),
    *(("speed_left_mps", "mph", 1.0, 0.44704), ("accel_z_mps2", "g", 1.0, 9.80665)),
    *(("accel_z_mps2", "mg", 1000.0, 9.80665), ("accel_z_mps2", "m/s\u00b2", 2.0, 2.0)),
    *(("accel_z_mps2", "m/s2", 2.0, 2.0), ("current_left_a", "mA", 1500.0, 1.5)),
    *(("voltage_left_v", "mV", 24000.0, 24.0), ("torque_1_nm", "kNm", 0.5, 500.0)),
    *(("torque_1_nm", "mNm", 50.0, 0.05), ("force_x_n", "kN", 1.2, 1200.0)),
    *(("temperature_k", "degC", 20.0, 293.15), ("temperature_k", "\u00b0C", -273.15, 0.0)),
    *(("temperature_k", "degF", 32.0, 273.15), ("position_x_m", "km", 0.5, 500.0)),
    *(("position_x_m", "cm", 5.0, 0.05), ("slip_ratio", "%", 12.0, 0.12), ("load_kg", "t", 0.2, 200.0)),
]


def test_units_of_a_lab_with_scale_and_offset_become_si(read):
    header = ",".join(f"c{i}" for i in range(len(UNITS)))
    cells = ",".join(f"{2 * cell - 1}" for *_, cell, _ in UNITS)
    channels = {f"a{i}_{name}": {"column": f"c{i}", "unit": unit} for i, (name, unit, *_) in enumerate(UNITS)}
    for entry in channels.values():
        entry |= {"scale": 0.5, "offset": 0.5}
    text = f"t,{header}\n0,{cells}\n1,{cells}\n2,{',' * (len(UNITS) - 1)}\n"
    stream = read(text=text, keys={"channels": channels}).streams["logger"]
    for i, (name, *_, si) in enumerate(UNITS):
        values = stream.channel(f"a{i}_{name}")
        assert values == pytest.approx([si, si, np.nan], rel=1e-9, abs=1e-9, nan_ok=True), UNITS[i]


TEXTS = {
    "lines above the names": ("Logger 3\nstarted 8:15, by hand\nt,v\n0,1.5\n1,2.5\n", {"skip_rows": 2}),
    "units below the names": ("t,v\ns,m/s\n0,1.5\n1,2.5\n", {"header_rows": 2}),
    "long names, units, names": (
        "time;speed;\ns;m/s;\nt;v;\n0;1.5;\n1;2.5;\n",
        {"skip_rows": 2, "delimiter": ";"},
    ),
    "a delimiter at the end of the rows only": ("t,v\n0,1.5,\n1,2.5,\n", {}),
    "a delimiter at the end of the header only": ("t,v,\n0,1.5\n1,2.5\n", {}),
    "a comma between digits": ("t;v\n0,0;1,5\n1,0;2,5\n", {"delimiter": ";", "decimal": ","}),
    "tabs": ("t\tv\n0\t1.5\n1\t2.5\n", {"delimiter": "\t"}),
}


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("slow", [False, True])
def test_headers_delimiters_and_decimals_of_instruments_are_read(read, monkeypatch, text, slow):
    """By pyarrow, and cell by cell."""
    if slow:
        monkeypatch.setattr("terrain.logs.tables._fast", lambda *_: None)
    stream = read(text=TEXTS[text][0], keys=TEXTS[text][1]).streams["logger"]
    assert stream.time_s.tolist() == [0.0, 1.0]
    assert stream.channel("speed_left_mps").tolist() == [1.5, 2.5]


def test_rows_of_other_sensors_in_a_merged_file_are_no_samples_and_a_clock_is_counted_from_the_start(
    tmp_path, read
):
    text = "t,v,wz,ax\n0,1.0,,\n0.01,,0.1,\n0.01,2.0,,\n0.02,,,0.5\n0.02,3.0,,\n"
    imu = {
        "gyro_z_radps": {"column": "wz", "unit": "rad/s"},
        "accel_x_mps2": {"column": "ax", "unit": "m/s^2"},
    }
    for start_s in (0.0, 1.7e9):
        time = {"column": "t", "unit": "s", "offset": start_s}
        shared = {"file": "merged.csv", "time": time}
        (tmp_path / "merged.csv").write_text(text)
        run = read(streams={"wheels": {**shared, "channels": SPEED}, "imu": {**shared, "channels": imu}})
        assert run.streams["wheels"].time_s == pytest.approx([0.0, 0.01, 0.02], abs=1e-6)
        assert run.streams["wheels"].channel("speed_left_mps").tolist() == [1.0, 2.0, 3.0]
        assert run.streams["imu"].time_s == pytest.approx([0.01, 0.02], abs=1e-6)
        assert run.streams["imu"].channel("accel_x_mps2") == pytest.approx([np.nan, 0.5], nan_ok=True)
        assert run.labels[0].start_s == 0.0


COMMA = {"delimiter": ";", "decimal": ","}


def test_what_does_not_fit_the_stated_layout_is_named_by_its_row(read):
    too_large = {"channels": {"v_mps": SPEED["speed_left_mps"] | {"scale": 1e300}}}
    for content, keys, message in (
        ("a\nt,v\n0,x\n1,2\n", {"skip_rows": 1}, "v at row 3 is 'x', which is no number"),
        ("t,v\n0,1\n", {"skip_rows": 9}, "has no names of columns in row 10"),
        ("t;v\n0;1.5\n1;2,5\n", {"delimiter": ";", "decimal": ","}, "v at row 2 is '1.5', which is no"),
        ("t,v\n0,1e300\n1,2e300\n", too_large, "nothing finite"),
    ):
        with pytest.raises(LogError, match=message):
            read(text=content, keys=keys)


def write_hdf5(path, content):
    """Write a file as MATLAB 7.3 does: a struct is a group, columns come first."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in content.items():
            for field, inner in value.items() if isinstance(value, dict) else ():
                file[f"{name}/{field}"] = np.atleast_2d(inner)
            if not isinstance(value, dict):
                file[name] = np.atleast_2d(value) if np.ndim(value) < 2 else value.T
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")


@pytest.mark.parametrize("write", [savemat, write_hdf5], ids=["5", "7.3"])
def test_a_mat_file_is_read_by_variables_fields_and_columns(tmp_path, read, write):
    wz = np.linspace(0.0, 90.0, 6)
    content = {"t": T, "wz": wz, "log": {"wz": wz, "note": T}, "data": np.column_stack([T, wz])}
    write(tmp_path / "drive.mat", content)
    for column in ("wz", "log.wz", "data[1]"):
        stream = read({"imu": imu_of("drive.mat", column)}).streams["imu"]
        np.testing.assert_allclose(stream.channel("gyro_z_radps"), np.radians(wz), rtol=1e-12)
        np.testing.assert_array_equal(stream.time_s, T)


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
def test_a_mat_file_without_what_is_mapped_is_one_sentence(tmp_path, read, column, sentence):
    content = {"t": T, "log": {"wz": T}, "name": "husky", "data": np.ones((6, 2)), "short": T[:3]}
    savemat(tmp_path / "drive.mat", content)
    with pytest.raises(LogError) as raised:
        read({"imu": imu_of("drive.mat", column)})
    assert sentence in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("content", [b"", b"no mat file at all" * 20, b"\x89HDF\r\n\x1a\n" + bytes(600)])
def test_a_damaged_mat_file_or_spreadsheet_is_one_sentence(tmp_path, read, content):
    for name in ("drive.mat", "drive.xlsx"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(LogError, match=name) as raised:
            read({"imu": imu_of(name)})
        assert "\n" not in str(raised.value)


def write_sheet(path, rows, title="log", first=()):
    book = openpyxl.Workbook()
    for row in first:
        book.active.append(row)
    sheet = book.create_sheet(title) if first else book.active
    for row in rows:
        sheet.append(row)
    book.save(path)


def test_a_spreadsheet_is_read_by_its_names_dates_and_sheet(tmp_path, read):
    dates = [datetime(2024, 5, 1, 12) + timedelta(seconds=float(t)) for t in T]
    rows = [("drive of May",), ("t", "wz"), *zip(dates, 90 * T, strict=True)]
    write_sheet(tmp_path / "drive.xlsx", rows, "second", first=[("nothing",)])
    stream = read({"imu": imu_of("drive.xlsx", sheet="second", skip_rows=1)}).streams["imu"]
    np.testing.assert_allclose(stream.time_s - stream.time_s[0], T, atol=1e-6)
    np.testing.assert_allclose(stream.channel("gyro_z_radps"), np.radians(90 * T), atol=1e-12)
    with pytest.raises(LogError, match=r"has no sheet 'third' \(it has Sheet, second\)"):
        read({"imu": imu_of("drive.xlsx", sheet="third", skip_rows=1)})


def test_cells_of_a_spreadsheet_that_are_no_numbers_are_refused_or_counted(tmp_path, read):
    rows = [("t", "wz"), ("s", "deg/s"), *zip(T, 90 * T, strict=True)]
    rows[4] = (T[2], "wet")
    write_sheet(tmp_path / "drive.xlsx", rows)
    with pytest.raises(LogError, match=r"t at row 2 is 's'.*is read with 'header_rows: 2'"):
        read({"imu": imu_of("drive.xlsx")})
    two = imu_of("drive.xlsx", header_rows=2)
    with pytest.raises(LogError, match="wz at row 5 is 'wet', which is no number"):
        read({"imu": two})
    run = read({"imu": two}, repair=True)
    assert np.isnan(run.streams["imu"].values[:, 0]).tolist() == [False, False, True, False, False, False]
    assert run.dropped == {"cells that are no number": 1}
    with pytest.raises(LogError, match=r"column 'wx' is missing \(the file has t, wz\)"):
        read({"imu": imu_of("drive.xlsx", "wx")})


def test_a_missing_package_is_one_sentence(tmp_path, read, monkeypatch):
    write_hdf5(tmp_path / "drive.mat", {"t": T, "wz": T})
    write_sheet(tmp_path / "drive.xlsx", [("t", "wz"), *zip(T, T, strict=True)])
    for package, stream in (
        ("h5py", imu_of("drive.mat")),
        ("openpyxl", imu_of("drive.xlsx")),
    ):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ConfigError, match=rf"{package}.*terrain-slip\[logs\]"):
            read({"imu": stream})


def test_latitude_and_longitude_become_metres_of_the_first_fix_or_an_origin(tmp_path, read):
    """Known lengths: 111.13 km are a degree of latitude at 45 degrees, 78.85 km one of longitude."""
    (tmp_path / "gps.csv").write_text(
        "t,lat,lon,alt\n0,,,\n0.2,45.0,7.0,200\n0.4,45.0001,7.0,201\n0.6,45.0,7.0001,202\n0.8,45,7,200\n"
    )
    position = {"latitude": "lat", "longitude": "lon", "height": "alt"}
    gps = {"file": "gps.csv", "time": TIME, "position": position}
    stream = read({"gnss": gps}).streams["gnss"]
    assert stream.channels == ("position_x_m", "position_y_m", "position_z_m")
    assert np.isnan(stream.values[0]).all()
    np.testing.assert_allclose(
        stream.values[1:], [[0, 0, 0], [0, 11.113, 1], [7.885, 0, 2], [0, 0, 0]], atol=2e-3
    )
    del position["height"]
    moved = gps | {"position": position | {"origin": [45.0, 7.0001, 0.0]}}
    np.testing.assert_allclose(read({"gnss": moved}).streams["gnss"].values[1], [-7.885, 0.0], atol=2e-3)
    (tmp_path / "gps.csv").write_text("t,lat,lon\n0,145,7\n1,45,7\n")
    with pytest.raises(LogError, match=r"gps.csv: latitude reaches 145 deg"):
        read({"gnss": gps})
    with pytest.raises(LogError, match="no latitude and longitude are known"):
        local_metres(np.array([np.nan]), np.array([0.0]))


def test_the_worked_mapping_of_an_rtk_log_in_the_docs_reads_one(tmp_path):
    """Truth of a drive, written as a receiver, an IMU and encoders write it, comes back; codes are fixes."""
    document = (ROOT / "docs" / "mapping.md").read_text().partition("## A log of an RTK receiver")[2]
    (tmp_path / "rtk.yaml").write_text(document.split("```yaml\n")[1].partition("```")[0])
    t = np.arange(0.0, 40.0, 0.1)
    yaw_rate = 0.3 * np.sin(0.3 * t)
    yaw, speed = np.cumsum(yaw_rate) * 0.1, 0.8 + 0.3 * np.sin(0.5 * t)
    v = np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw)])
    p = np.cumsum(v, axis=0) * 0.1
    latitude, longitude, _ = enu2geodetic(p[:, 0], p[:, 1], 0.0, 48.1, 11.5, 0.0)
    code = np.where(t < 1.0, 0, np.where(t < 2.0, 1, np.where(t < 3.0, 5, 4)))
    drive = tmp_path / "logs" / "field_1"
    drive.mkdir(parents=True)
    still, course_deg = np.zeros(len(t)), np.degrees(np.pi / 2 - yaw) % 360.0
    rtk = (t, latitude, longitude, still + 200.0, code, still + 0.8, speed * 3600 / 1852, course_deg)
    for name, header, columns in (
        ("rtk", "time,lat,lon,alt,quality,hdop,sog,cog", rtk),
        ("imu", "time,wz,ax,ay,az", (t, np.degrees(yaw_rate), still, still, still + 1.0)),
        ("wheels", "time,left,right", (t, speed - 0.3 * yaw_rate, speed + 0.3 * yaw_rate)),
    ):
        table = np.column_stack(columns)
        np.savetxt(drive / f"{name}.csv", table, "%.12g", ",", header=header, comments="")
    (run,) = load_runs(tmp_path / "logs", mapping=tmp_path / "rtk.yaml")
    gnss, known = run.streams["gnss"], code > 0
    assert set(gnss.channels) == set(GNSS_CHANNELS)
    position_m = gnss.columns(("position_x_m", "position_y_m"))
    np.testing.assert_allclose(position_m[known], p[known] - p[known][0], atol=1e-3)
    assert np.isnan(position_m[~known]).all()
    np.testing.assert_allclose(gnss.columns(("velocity_x_mps", "velocity_y_mps")), v, atol=1e-6)
    assert gnss.channel("fix_ratio")[[15, 25, 35]].tolist() == [0.0, 0.0, 1.0]
    np.testing.assert_allclose(gnss.channel("std_position_m")[[15, 25, 35]], [2.4, 0.4, 0.016])
    robot = replace(load_robot("husky"), name="field_robot", track_m=0.6)
    checks = [check for check in verdict(run, robot) if check.check in ("speed", "turns", "yaw rate")]
    found = {(check.check, str(check.level)) for check in checks}
    assert found == {("speed", "ok"), ("turns", "ok"), ("yaw rate", "ok")}


def test_a_run_is_joined_of_files_of_different_formats_on_one_clock(tmp_path, read):
    savemat(tmp_path / "drive.mat", {"t": T, "wz": T})
    write_sheet(tmp_path / "wheels.xlsx", [("stamp", "v"), *zip(1000 * (T + 0.05), 3.6 + T, strict=True)])
    time = {"column": "stamp", "unit": "ms", "offset": -50.0}
    speed = {"speed_left_mps": {"column": "v", "unit": "km/h"}}
    wheels = {"file": "wheels.xlsx", "time": time, "channels": speed}
    run = read({"imu": imu_of("drive.mat"), "wheels": wheels})
    np.testing.assert_allclose(run.streams["wheels"].time_s, T, atol=1e-9)
    np.testing.assert_allclose(run.streams["wheels"].values[0], [1.0])
    assert (run.run_id, run.terrains) == ("drive", ("GRASS",))


MAPPING = {
    "robot": "husky",
    "terrain": "{class}",
    "streams": {
        "imu": {"file": "{class}/imu_{n}.csv", "time": TIME, "channels": GYRO},
        "wheels": {"file": "{class}/pro_{n}.csv", "time": TIME, "channels": SPEED},
    },
}
AT, IN = ("streams", "imu"), ("streams", "imu", "channels", "gyro_z_radps")
NO_TABLE = {"messages": {"topic": "/a"}, "time": None, "channels": {}}


@pytest.mark.parametrize(
    ("place", "change", "message"),
    [
        ((), {"colour": "red"}, "map.yaml: key 'colour' is unknown"),
        ((), {"robot": None}, "key 'robot' is missing"),
        ((), {"robot": "../husky.yaml"}, "map.yaml: robot '../husky.yaml' is no plain name"),
        (AT, {"time": None}, "key 'streams.imu.time' is missing"),
        (IN, {"unit": "dps"}, "imu: channel gyro_z_radps: unit 'dps' is unknown (accepted here: rad/s, deg/s, rpm)"),
        (IN, {"unit": "m/s"}, "channel gyro_z_radps: unit 'm/s' does not suit it (accepted here: rad/s"),
        (AT, {"time": {"column": "t", "unit": "min"}}, "time: unit 'min' is unknown (accepted here: s, ms, us, ns)"),
        (AT, {"channels": {"gyro_z": GYRO["gyro_z_radps"]}}, "channel 'gyro_z' does not end in a known unit"),
        (IN, {"scale": float("inf")}, "scale is inf"),
        (AT, {"file": "{class}/imu.csv"}, "imu and wheels do not have the same words in braces"),
        (AT, {"file": "{class}/{n}/{0}.csv"}, "has a brace without its partner"),
        (AT, {"file": "{class}{n}/a\0b"}, "names no file"),
        (AT, {"file": "../{class}/{n}.csv"}, "must lie under the data folder"),
        ((), {"terrain": "{ground}"}, "terrain '{ground}' uses a word that the files lack (they have {class}, {n})"),
        (AT, {"decimal": ","}, "delimiter and decimal are both ','"),
        (AT, {"channels": {}}, "has no channels and no position"),
        (AT, {"ground": {"speed": {"column": "v", "unit": "m"}, "course": {"column": "c", "unit": "deg"}}},
         "ground: speed: unit 'm' does not suit it"),
        (AT, {"position": {"latitude": "a", "longitude": "b", "hdop": "h"}}, "'hdop' is for positions with 'quality'"),
        (AT, {"channels": {"position_x_m": {"column": "a", "unit": "m"}},
              "position": {"latitude": "a", "longitude": "b"}}, "'position' gives the channel position_x_m too"),
        (AT, {"messages": {"topic": "/a"}}, "'messages' leave out time, channels and position"),
        (AT, NO_TABLE, "has no channels"),
        (None, "{robot: r, run_id: a, streams: {imu: {file: ., "
               "time: {column: t, unit: s}, channels: {a_m: {column: a, unit: m}}}}}", "names no file"),
        (None, "a: [", "is no YAML"),
        (None, "", "the file is None"),
    ],
)  # fmt: skip
def test_a_wrong_mapping_is_refused_in_one_sentence(tmp_path, place, change, message):
    if place is None:
        text = change
    else:
        mapping = yaml.safe_load(yaml.safe_dump(MAPPING))
        inner = mapping
        for key in place:
            inner = inner[key]
        inner |= change
        for key in [key for key, value in inner.items() if value is None]:
            del inner[key]
        text = yaml.safe_dump(mapping)
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(ConfigError) as error:
        load_runs(tmp_path, mapping=tmp_path / "map.yaml")
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(MAPPING))
    with pytest.raises(LogError, match="no file there fits the mapping"):
        load_runs(tmp_path, mapping=tmp_path / "map.yaml")


@pytest.fixture
def per_terrain(tmp_path):
    """Return what writes a run of a terrain with names of files in a form of Unicode, and the mapping's file."""
    channels = {"speed_left_mps": {"column": "geschw\u00e4ndigkeit", "unit": "m/s"}}
    stream = {"file": "{terrain}/Fahrt \u00fcber {run}.csv", "time": TIME, "channels": channels}
    mapping = {"robot": "husky", "terrain": "{terrain}", "streams": {"logger": stream, "copy": dict(stream)}}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(mapping))

    def write(terrain, run, form):
        path = tmp_path / "data" / unicodedata.normalize(form, f"{terrain}/Fahrt \u00fcber {run}.csv")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(unicodedata.normalize(form, "t,geschw\u00e4ndigkeit\n0,1\n1,2\n"), encoding="utf-8")
        return {"data": tmp_path / "data", "mapping": tmp_path / "map.yaml"}

    return write


@pytest.mark.parametrize("terrain", ["\u8349\u5730", "Fels\u00f6l"])
@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_in_any_language_and_form_are_read_imported_and_read_again(
    tmp_path, per_terrain, terrain, form
):
    """macOS keeps names of files in form D; the mapping is written in form C."""
    per_terrain(terrain, "1", form)
    where = per_terrain(terrain, "2", form)
    runs = load_runs(where["data"], mapping=where["mapping"])
    assert [run.run_id for run in runs] == [f"{terrain}_1", f"{terrain}_2"]
    assert {run.terrains for run in runs} == {(terrain,)}
    convert(ConvertSettings(**where, out=tmp_path / "out"))
    assert data_digest(load_runs(tmp_path / "out")) == data_digest(runs)
    per_terrain(terrain, "3", "NFD" if form == "NFC" else "NFC")  # the other form is the same terrain
    assert {run.terrains for run in load_runs(where["data"], mapping=where["mapping"])} == {(terrain,)}
    if terrain.upper() != terrain:
        per_terrain(terrain.upper(), "4", form)
        with pytest.raises(LogError, match="differ in upper and lower case only"):
            load_runs(where["data"], mapping=where["mapping"])
        runs = load_runs(where["data"], mapping=where["mapping"], repair=True)
        assert {run.terrains for run in runs} == {(terrain,)}
        assert sum(run.dropped.get(RESPELT, 0) for run in runs) == 1
