import numpy as np
import pytest
import yaml

from pipelines.runs.datasets import data_digest, load_runs
from terrain.errors import ConfigError, LogError
from terrain.logs.mapping import find_runs, load_mapping


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


def test_a_mapping_reads_the_borealtc_layout_as_its_own_reader_does(borealtc_dir, save):
    mapped = load_runs(borealtc_dir, mapping=save(like_borealtc()))
    assert [run.run_id for run in mapped] == ["ICE_01", "SNOW_01", "SNOW_02"]
    assert data_digest(mapped) == data_digest(load_runs(borealtc_dir))


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
