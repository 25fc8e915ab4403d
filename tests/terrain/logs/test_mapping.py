import unicodedata

import numpy as np
import pytest
import yaml

from pipelines.data.convert import Settings as ConvertSettings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import load_runs
from terrain.errors import ConfigError, LogError
from terrain.logs.digest import data_digest
from terrain.logs.mapping import find_runs, load_mapping
from terrain.logs.spelling import RESPELT


def like_borealtc():
    imu = {f"gyro_{a}_radps": {"column": f"w{a}", "unit": "rad/s"} for a in "xyz"}
    imu |= {f"accel_{a}_mps2": {"column": f"a{a}", "unit": "m/s^2"} for a in "xyz"}
    wheels = {f"speed_{s}_mps": {"column": f"vel{s[0].upper()}", "unit": "m/s"} for s in ("left", "right")}
    wheels |= {f"current_{s}_a": {"column": f"cur{s[0].upper()}", "unit": "A"} for s in ("left", "right")}
    time = {"column": "time", "unit": "s"}
    return {
        "robot": "husky",
        "terrain": "{class}",
        "streams": {
            "imu": {"file": "{class}/imu_{n}.csv", "time": time, "channels": imu},
            "wheels": {"file": "{class}/pro_{n}.csv", "time": dict(time), "channels": wheels},
        },
    }


@pytest.fixture
def save(tmp_path):
    def write(mapping):
        path = tmp_path / "map.yaml"
        path.write_text(mapping if isinstance(mapping, str) else yaml.safe_dump(mapping))
        return path

    return write


def test_units_scale_and_offset_become_si(tmp_path, save):
    (tmp_path / "drive.csv").write_text("stamp;yaw;v\n1000;90;36\n1500;-90;72\n2000;;0\n")
    mapping = {
        "robot": "husky",
        "run_id": "field trial",
        "terrain": "GRASS",
        "streams": {
            "imu": {
                "file": "drive.csv",
                "delimiter": ";",
                "time": {"column": "stamp", "unit": "ms"},
                "channels": {
                    "gyro_z_radps": {"column": "yaw", "unit": "deg/s", "scale": -1},
                    "speed_left_mps": {"column": "v", "unit": "km/h", "scale": 2.0, "offset": -36.0},
                },
            }
        },
    }
    (run,) = load_runs(tmp_path, mapping=save(mapping))
    assert (run.run_id, run.terrains) == ("field trial", ("GRASS",))
    assert run.streams["imu"].time_s.tolist() == [1.0, 1.5, 2.0]
    np.testing.assert_allclose(run.streams["imu"].channel("gyro_z_radps"), [-np.pi / 2, np.pi / 2, np.nan])
    np.testing.assert_allclose(run.streams["imu"].channel("speed_left_mps"), [10.0, 30.0, -10.0])


def deep(path, value):
    def change(mapping):
        *parents, last = path
        for key in parents:
            mapping = mapping[key]
        mapping[last] = value

    return change


GYRO = ("streams", "imu", "channels", "gyro_z_radps")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (deep(["colour"], "red"), "map.yaml: key 'colour' is unknown"),
        (deep([*GYRO, "units"], "rad/s"), "key 'streams.imu.channels.gyro_z_radps.units' is unknown"),
        (lambda m: m.pop("robot"), "key 'robot' is missing"),
        (lambda m: m["streams"]["imu"].pop("time"), "key 'streams.imu.time' is missing"),
        (deep([*GYRO, "unit"], "dps"),
         "imu: channel gyro_z_radps: unit 'dps' is unknown (accepted here: rad/s, deg/s, rpm)"),
        (deep([*GYRO, "unit"], "m/s"),
         "channel gyro_z_radps: unit 'm/s' does not suit it (accepted here: rad/s"),
        (deep(["streams", "imu", "time", "unit"], "min"),
         "time: unit 'min' is unknown (accepted here: s, ms, us, ns)"),
        (deep(["streams", "imu", "channels", "gyro_z"], {"column": "wz", "unit": "rad/s"}),
         "channel 'gyro_z' does not end in a known unit"),
        (deep([*GYRO, "scale"], "twice"), "scale is 'twice'"),
        (deep([*GYRO, "scale"], float("inf")), "scale is inf"),
        (deep(["streams", "imu", "file"], "{class}/imu.csv"),
         "imu and wheels do not have the same words in braces"),
        (deep(["terrain"], "{ground}"),
         "terrain '{ground}' uses a word that the files lack (they have {class}, {n})"),
        (deep(["streams", "imu", "file"], "../{class}/{n}.csv"), "must lie under the data folder"),
        (deep(["streams"], {}), "streams is {}"),
    ],
)  # fmt: skip
def test_a_wrong_mapping_is_refused_in_one_sentence(save, change, message):
    mapping = like_borealtc()
    change(mapping)
    with pytest.raises(ConfigError) as error:
        load_mapping(save(mapping))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"), [("a: [", "is no YAML"), ("", "the file is None"), ("- 1", "the file is")]
)
def test_a_file_that_is_no_mapping_is_refused(save, text, message):
    with pytest.raises(ConfigError, match=message) as error:
        load_mapping(save(text))
    assert "\n" not in str(error.value)


def test_a_missing_partner_and_an_empty_folder_are_named(borealtc_dir, save):
    mapping = load_mapping(save(like_borealtc()))
    (borealtc_dir / "ICE" / "pro_01.csv").unlink()
    readers = find_runs(borealtc_dir, mapping)
    with pytest.raises(LogError, match=r"ICE/pro_01\.csv: is missing"):
        [read() for read in readers]
    (borealtc_dir / "empty").mkdir()
    with pytest.raises(LogError, match="no file there fits the mapping"):
        find_runs(borealtc_dir / "empty", mapping)


def one_stream(channels, **keys):
    """Return a mapping of the file data.csv with one stream."""
    stream = {"file": "data.csv", "time": {"column": "t", "unit": "s"}, "channels": channels, **keys}
    return {"robot": "husky", "run_id": "r", "streams": {"logger": stream}}


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


@pytest.mark.parametrize(("channel", "unit", "cell", "si"), UNITS)
def test_units_of_a_lab_become_si(tmp_path, save, channel, unit, cell, si):
    (tmp_path / "data.csv").write_text(f"t,v\n0,{cell}\n1,{cell}\n")
    mapping = one_stream({channel: {"column": "v", "unit": unit}})
    (run,) = load_runs(tmp_path, mapping=save(mapping))
    assert run.streams["logger"].channel(channel) == pytest.approx(si, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9), ("\u00b5s", 1e-6)])
def test_times_in_any_unit_become_seconds(tmp_path, save, unit, factor):
    (tmp_path / "data.csv").write_text(f"t,v\n0,1\n{round(1 / factor)},2\n")
    mapping = one_stream(
        {"speed_left_mps": {"column": "v", "unit": "m/s"}}, time={"column": "t", "unit": unit}
    )
    (run,) = load_runs(tmp_path, mapping=save(mapping))
    assert run.streams["logger"].time_s.tolist() == pytest.approx([0.0, 1.0])


SPEED = {"speed_left_mps": {"column": "v", "unit": "m/s"}}
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
def test_headers_delimiters_and_decimals_of_instruments_are_read(tmp_path, save, monkeypatch, text, slow):
    """By pyarrow, and cell by cell."""
    if slow:
        monkeypatch.setattr("terrain.logs.tables._fast", lambda *_: None)
    content, keys = TEXTS[text]
    (tmp_path / "data.csv").write_text(content)
    (run,) = load_runs(tmp_path, mapping=save(one_stream(SPEED, **keys)))
    assert run.streams["logger"].time_s.tolist() == [0.0, 1.0]
    assert run.streams["logger"].channel("speed_left_mps").tolist() == [1.5, 2.5]


@pytest.mark.parametrize(
    ("content", "keys", "message"),
    [
        ("a\nt,v\n0,x\n1,2\n", {"skip_rows": 1}, "v at row 3 is 'x', which is no number"),
        ("t,v\n0,1\n", {"skip_rows": 9}, "has no names of columns in row 10"),
        (
            "t;v\n0;1.5\n1;2,5\n",
            {"delimiter": ";", "decimal": ","},
            "v at row 2 is '1.5', which is no number",
        ),
    ],
)
def test_what_does_not_fit_the_stated_layout_is_named_by_its_row(tmp_path, save, content, keys, message):
    (tmp_path / "data.csv").write_text(content)
    with pytest.raises(LogError, match=message):
        load_runs(tmp_path, mapping=save(one_stream(SPEED, **keys)))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"decimal": ","}, "delimiter and decimal are both ','"),
        ({"decimal": "'"}, 'streams.logger.decimal is "\'"'),
        ({"skip_rows": -1}, "streams.logger.skip_rows is -1"),
        ({"header_rows": 0}, "streams.logger.header_rows is 0"),
    ],
)
def test_a_layout_that_cannot_be_is_refused(save, keys, message):
    with pytest.raises(ConfigError) as error:
        load_mapping(save(one_stream(SPEED, **keys)))
    assert message in str(error.value)


def per_terrain():
    mapping = one_stream({"speed_left_mps": {"column": "geschw\u00e4ndigkeit", "unit": "m/s"}})
    mapping.pop("run_id")
    mapping["terrain"] = "{terrain}"
    mapping["streams"]["logger"]["file"] = "{terrain}/Fahrt \u00fcber {run}.csv"
    mapping["streams"]["copy"] = dict(mapping["streams"]["logger"])
    return mapping


@pytest.mark.parametrize(
    "terrain",
    [
        "\u8349\u5730",
        "Fels\u00f6l",
        "tr\u00e1va",
        "\u0433\u0440\u0430\u0432\u0438\u0439",
        "sable mouill\u00e9",
    ],
)
@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_in_any_language_and_form_are_read_imported_and_read_again(tmp_path, save, terrain, form):
    """macOS keeps names of files in form D; the mapping is written in form C."""
    data = tmp_path / "data"
    for run in ("1", "2"):
        path = data / unicodedata.normalize(form, f"{terrain}/Fahrt \u00fcber {run}.csv")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(unicodedata.normalize(form, "t,geschw\u00e4ndigkeit\n0,1\n1,2\n"), encoding="utf-8")
    mapping = save(per_terrain())
    runs = load_runs(data, mapping=mapping)
    assert [run.run_id for run in runs] == [f"{terrain}_1", f"{terrain}_2"]
    assert {run.terrains for run in runs} == {(terrain,)}
    convert(ConvertSettings(data=data, mapping=mapping, out=tmp_path / "out"))
    assert data_digest(load_runs(tmp_path / "out")) == data_digest(runs)


def test_one_terrain_in_two_unicode_forms_is_one_terrain(tmp_path, save):
    for run, form in (("1", "NFC"), ("2", "NFD")):
        path = tmp_path / unicodedata.normalize(form, f"Fels\u00f6l/Fahrt \u00fcber {run}.csv")
        path.parent.mkdir(exist_ok=True)
        path.write_text("t,geschw\u00e4ndigkeit\n0,1\n1,2\n", encoding="utf-8")
    runs = load_runs(tmp_path, mapping=save(per_terrain()))
    assert [run.terrains for run in runs] == [("Fels\u00f6l",)] * 2
    assert not any(run.dropped for run in runs)


def test_a_terrain_in_upper_and_lower_case_is_one_sentence_or_merged(borealtc_dir):
    (borealtc_dir / "ICE").rename(borealtc_dir / "Snow")
    with pytest.raises(LogError, match="'SNOW' and 'Snow' differ in upper and lower case only"):
        load_runs(borealtc_dir)
    runs = load_runs(borealtc_dir, repair=True)
    assert {run.terrains for run in runs} == {("SNOW",)}
    assert sum(run.dropped.get(RESPELT, 0) for run in runs) == 1
