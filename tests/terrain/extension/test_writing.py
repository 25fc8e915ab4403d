"""Files of extended robots: what is written is read again, and what cannot be is refused."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import yaml

from terrain.errors import ConfigError
from terrain.extension import extended_yaml, write_extended
from terrain.files.names import data_folder
from terrain.robots import load_robot, robot_from

ROBOT = load_robot("agrimaro")
VALUES = {"wheel_radius_ratio": 0.031234567, "camera_yaw_rad": -0.012, "force_slip_ratio": 0.3}
ROOT = np.array([[2e-3, 0.0, 0.0], [1e-3, 5e-4, 0.0], [0.01, -0.02, 0.03]])
COV = ROOT @ ROOT.T
INTERVALS = {name: (value - 0.05, value + 0.05) for name, value in VALUES.items()}


def described(**changes):
    text = extended_yaml("agrimaro", VALUES, COV, INTERVALS, "terrain explain, 8 runs")
    content = yaml.safe_load(text)
    content["effects"] |= changes
    return {name: entry for name, entry in content.items() if entry is not None}


def test_an_extended_file_is_the_robots_own_with_effects_at_its_end(tmp_path):
    out = tmp_path / "mine.yaml"
    written = write_extended(out, "agrimaro", VALUES, COV, INTERVALS, "terrain explain, 8 runs")
    robot = load_robot(out)
    assert robot == written
    assert replace(robot, effects={}, effects_cov=np.empty((0, 0))) == ROBOT
    assert list(robot.effects) == list(VALUES)
    np.testing.assert_allclose(list(robot.effects.values()), list(VALUES.values()), rtol=1e-6)
    np.testing.assert_allclose(robot.effects_cov, COV, rtol=1e-6)
    own = (data_folder("robots") / "agrimaro.yaml").read_text()
    assert out.read_text().startswith(own.rstrip("\n"))
    again = extended_yaml(
        out, {"gyro_scale_ratio": 0.01}, np.eye(1), {"gyro_scale_ratio": (0.0, 0.02)}, "again"
    )
    assert again.startswith(own.rstrip("\n"))
    assert dict(robot_from("again", yaml.safe_load(again)).effects) == {"gyro_scale_ratio": 0.01}
    with pytest.raises(ConfigError, match="there already"):
        write_extended(out, "agrimaro", VALUES, COV, INTERVALS, "twice")


def test_a_file_that_is_one_line_is_not_extended(tmp_path):
    path = tmp_path / "flat.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load((data_folder("robots") / "husky.yaml").read_text())))
    value, interval = {"gyro_scale_ratio": 0.01}, {"gyro_scale_ratio": (0.0, 0.02)}
    assert robot_from("a", yaml.safe_load(extended_yaml(path, value, np.eye(1), interval, "a"))).effects
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()), default_flow_style=True))
    with pytest.raises(ConfigError, match="one section a line is required"):
        extended_yaml(path, value, np.eye(1), interval, "a")


def test_effects_cannot_be_changed_and_travel():
    robot = robot_from("mine.yaml", described())
    with pytest.raises(TypeError):
        robot.effects["wheel_radius_ratio"] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        robot.effects_cov[0, 0] = 1.0
    there = pickle.loads(pickle.dumps(robot))
    assert there == robot
    np.testing.assert_array_equal(there.effects_cov, robot.effects_cov)
    assert hash(there) == hash(robot)
    unknown = described()
    del unknown["effects"]["covariance"]
    assert np.isnan(robot_from("mine.yaml", unknown).effects_cov).all()


def entry(value, unit="ratio"):
    return {"value": value, "unit": unit, "source": "by hand"}


def spoiled(row, column, value):
    cov = described()["effects"]["covariance"]
    cov[row][column] = value
    return {"covariance": cov}


R, Y, F = VALUES


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": 2}, "schema 2 is newer than this version"),
        ({"schema": "one"}, "schema is 'one'"),
        ({"schema": 0}, "schema is 0"),
        ({"warp_ratio": entry(0.1)}, "warp_ratio is no parameter of an effect"),
        ({"pitch_offset_rad": entry(0.1, "rad")}, "pitch_offset_rad is no parameter"),
        ({"yaw_delay_s": entry(0.1, "s")}, "yaw_delay_s does not apply to a robot with the drive 'swerve'"),
        ({R: entry(math.nan)}, f"{R} is nan"),
        ({R: entry(math.inf)}, f"{R} is inf"),
        ({R: entry(0.5)}, f"{R} is 0.5, a number from -0.3 to 0.3"),
        ({R: entry(0.1, "m")}, f"{R} has the unit 'm'"),
        ({R: 0.1}, f"{R} is 0.1, a mapping"),
        ({"gyro_scale_ratio": entry(0.1)}, "covariance: key 'gyro_scale_ratio' is missing"),
        ({"covariance": {R: {R: 1.0}}}, f"covariance: key {Y!r} is missing"),
        ({"covariance": [[1.0]]}, r"covariance is [[1.0]], a mapping"),
        (spoiled(R, Y, 1.0), "is not symmetric"),
        (spoiled(R, R, -1.0), "not positive semi-definite"),
        (spoiled(R, R, 1e-9), "not positive semi-definite"),
        (spoiled(R, R, math.nan), f"{R}, {R} is nan"),
        (spoiled(R, R, "big"), f"{R}, {R} is 'big'"),
    ],
)
def test_effects_that_cannot_be_are_refused_in_one_sentence(changes, message):
    with pytest.raises(ConfigError, match=r"mine\.yaml: effects") as error:
        robot_from("mine.yaml", described(**changes))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("section", [None, [], {}, {R: entry(0.1)}])
def test_a_section_without_a_schema_is_refused(section):
    with pytest.raises(ConfigError, match="a mapping with schema"):
        robot_from("mine.yaml", described() | {"effects": section})


@pytest.mark.parametrize(
    ("values", "cov", "intervals", "message"),
    [
        ({"gyro_scale_ratio": 0.1}, np.eye(2), {"gyro_scale_ratio": (0.0, 0.2)}, "shape"),
        ({"gyro_scale_ratio": 0.1}, np.eye(1), {"gyro_scale_ratio": (0.2, 0.3)}, "must hold it"),
        ({"gyro_scale_ratio": 0.1}, np.eye(1), {}, "must hold it"),
        ({"yaw_delay_s": 0.1}, np.eye(1), {"yaw_delay_s": (0.0, 0.2)}, "does not apply to"),
        ({"gyro_scale_ratio": 0.1}, -np.eye(1), {"gyro_scale_ratio": (0.0, 0.2)}, "variance"),
    ],
)
def test_invalid_values_are_not_written(tmp_path, values, cov, intervals, message):
    with pytest.raises(ConfigError, match=message):
        write_extended(tmp_path / "mine.yaml", "agrimaro", values, cov, intervals, "a test")
    assert not list(tmp_path.iterdir())


def test_former_names_of_parameters_are_read_as_the_present_ones():
    interval = {"steering_backlash_rad": (0.0, 0.1), "camera_yaw_rad": (-0.1, 0.1)}
    values = {"steering_backlash_rad": 0.03, "camera_yaw_rad": 0.01}
    cov = 1e-6 * np.array([[2.0, 1.0], [1.0, 3.0]])
    text = extended_yaml("agrimaro", values, cov, interval, "a test")
    former = robot_from("old.yaml", yaml.safe_load(text.replace("steering_backlash", "steering_play")))
    assert former == robot_from("new.yaml", yaml.safe_load(text))
    np.testing.assert_allclose(former.effects_cov, cov)
    twice = described(steering_backlash_rad=entry(0.1, "rad"), steering_play_rad=entry(0.1, "rad"))
    with pytest.raises(ConfigError, match="steering_backlash_rad is given twice, once by its former name"):
        robot_from("mine.yaml", twice)
