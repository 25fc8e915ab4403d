import math

import pytest
import yaml

from terrain.errors import ConfigError
from terrain.files.names import data_folder
from terrain.robots import load_robot


@pytest.fixture
def husky_yaml():
    return yaml.safe_load((data_folder("robots") / "husky.yaml").read_text())


def test_husky_is_the_makers_nominal_geometry():
    husky = load_robot("husky")
    assert (husky.wheel_radius_m, husky.track_m, husky.wheelbase_m, husky.mass_kg) == (
        0.165,
        0.5708,
        0.512,
        50.0,
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(wheels=4), "key 'wheels' is unknown"),
        (lambda d: d.pop("track_m"), "key 'track_m' is missing"),
        (lambda d: d["track_m"].update(value=0.0), "track_m is 0.0, a number above zero"),
        (lambda d: d["track_m"].update(value=math.inf), "track_m is inf"),
        (lambda d: d["track_m"].update(value="wide"), "track_m is 'wide'"),
        (lambda d: d["track_m"].update(value=True), "track_m is True"),
        (lambda d: d["track_m"].update(unit="mm"), "track_m has the unit 'mm', 'm' is required"),
        (lambda d: d["track_m"].pop("source"), "track_m: key 'source' is missing"),
        (lambda d: d["track_m"].update(source=" "), "track_m has no source"),
        (lambda d: d.update(track_m=0.57), "track_m is 0.57, a mapping with value, unit, source"),
        (lambda d: d.update(drive="legs"), "drive 'legs' is unknown"),
    ],
)
def test_an_impossible_robot_is_refused_in_one_sentence(tmp_path, husky_yaml, change, message):
    change(husky_yaml)
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(husky_yaml))
    with pytest.raises(ConfigError, match=r"mine\.yaml") as error:
        load_robot(path)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["rover", "../robots/husky", "none.yaml"])
def test_an_unknown_robot_is_named(name):
    with pytest.raises(ConfigError, match=name.replace(".", r"\.")):
        load_robot(name)


def test_a_key_given_twice_is_refused(tmp_path, husky_yaml):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(husky_yaml) + "drive: swerve\n")
    with pytest.raises(ConfigError, match="'drive' is given twice"):
        load_robot(path)


def test_yaml_cannot_run_code(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text(f"!!python/object/apply:pathlib.Path.touch [{tmp_path}/touched]")
    with pytest.raises(ConfigError, match="is no YAML"):
        load_robot(path)
    assert not (tmp_path / "touched").exists()
