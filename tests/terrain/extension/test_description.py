"""Files of extended robots: what is written is read again, what it rests on, and the region that it holds in."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import yaml

from terrain.effects import PARAMETER, parameters_of
from terrain.errors import ConfigError, OutsideRegionWarning
from terrain.estimation.estimate import estimate_run
from terrain.estimation.live import CHANNELS, make_live_filter
from terrain.extension import (
    Origin,
    apply_homes,
    basis_of,
    correct_live,
    extended_yaml,
    region_of,
    warn_outside,
)
from terrain.files.names import data_folder
from terrain.logs.replay import replay
from terrain.robots import Region, load_robot, robot_from
from terrain.simulation.run import simulate_run

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")
VALUES = {"wheel_radius_ratio": 0.031234567, "camera_yaw_rad": -0.012, "force_slip_ratio": 0.3}
R, Y, F = VALUES
ROOT = np.array([[2e-3, 0.0, 0.0], [1e-3, 5e-4, 0.0], [0.01, -0.02, 0.03]])
COV = ROOT @ ROOT.T
INTERVALS = {name: (value - 0.05, value + 0.05) for name, value in VALUES.items()}
ONE = {"gyro_scale_ratio": 0.02}, np.array([[4e-6]]), {"gyro_scale_ratio": (0.016, 0.024)}, "me"


WRITTEN = extended_yaml("agrimaro", VALUES, COV, INTERVALS, "terrain explain, 8 runs")


def described():
    return yaml.load(WRITTEN, yaml.CSafeLoader)


def test_an_extended_file_is_the_robots_own_with_effects_at_its_end_which_may_have_former_names(tmp_path):
    out, own = tmp_path / "mine.yaml", (data_folder("robots") / "agrimaro.yaml").read_text().rstrip("\n")
    out.write_text(WRITTEN)
    robot = load_robot(out)
    assert replace(robot, effects={}, effects_cov=np.empty((0, 0))) == AGRIMARO
    assert list(robot.effects) == list(VALUES)
    np.testing.assert_allclose(list(robot.effects.values()), list(VALUES.values()), rtol=1e-6)
    np.testing.assert_allclose(robot.effects_cov, COV, rtol=1e-6)
    again = extended_yaml(out, *ONE)
    assert out.read_text().startswith(own)
    assert again.startswith(own)
    assert dict(robot_from("again", yaml.safe_load(again)).effects) == ONE[0]
    values, cov = (
        {"steering_backlash_rad": 0.03, "camera_yaw_rad": 0.01},
        1e-6 * np.array([[2.0, 1.0], [1.0, 3.0]]),
    )
    text = extended_yaml("agrimaro", values, cov, dict.fromkeys(values, (-0.1, 0.1)), "a test")
    former = robot_from("old.yaml", yaml.safe_load(text.replace("steering_backlash", "steering_play")))
    assert former == robot_from("new.yaml", yaml.safe_load(text))
    np.testing.assert_allclose(former.effects_cov, cov)
    content = yaml.safe_load((data_folder("robots") / "husky.yaml").read_text())
    out.write_text(yaml.safe_dump(content))
    assert robot_from("a", yaml.safe_load(extended_yaml(out, *ONE))).effects
    out.write_text(yaml.safe_dump(content, default_flow_style=True))
    with pytest.raises(ConfigError, match="one section a line is required"):
        extended_yaml(out, *ONE)


def entry(value, unit="ratio"):
    return {"value": value, "unit": unit, "source": "by hand"}


def spoiled(row, column, value):
    cov = described()["effects"]["covariance"]
    cov[row][column] = value
    return {"covariance": cov}


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
        ({R: entry(0.5)}, f"{R} is 0.5, a number from -0.3 to 0.3"),
        ({R: entry(0.1, "m")}, f"{R} has the unit 'm'"),
        ({R: 0.1}, f"{R} is 0.1, a mapping"),
        ({"gyro_scale_ratio": entry(0.1)}, "covariance: key 'gyro_scale_ratio' is missing"),
        ({"covariance": {R: {R: 1.0}}}, f"covariance: keys {Y!r}, "),
        ({"covariance": [[1.0]]}, "covariance is [[1.0]], a mapping"),
        (spoiled(R, Y, 1.0), "is not symmetric"),
        (spoiled(R, R, -1.0), "not positive semi-definite"),
        (spoiled(R, R, 1e-9), "not positive semi-definite"),
        (spoiled(R, R, math.nan), f"{R}, {R} is nan"),
        (spoiled(R, R, "big"), f"{R}, {R} is 'big'"),
        (
            {"steering_backlash_rad": entry(0.1, "rad"), "steering_play_rad": entry(0.1, "rad")},
            "steering_backlash_rad is given twice, once by its former name",
        ),
        ({"region": {"speed": [0, 1]}}, "effects: region: key 'speed' is unknown"),
        ({"region": {"grade_rad": [0.1, 0.0]}}, "the lower edge comes first"),
        ({"region": {"grade_rad": [0.1]}}, "two finite numbers are required"),
        ({"region": {"grade_rad": [0.0, math.nan]}}, "two finite numbers are required"),
        ({"region": {"terrains": "grass"}}, "a list of words is required"),
        ({"region": [1]}, "region is [1], a mapping with"),
        *(([section], "a mapping with schema") for section in (None, [], {}, {R: entry(0.1)})),
    ],
)
def test_effects_that_cannot_be_are_refused_in_one_sentence(changes, message):
    content = described()
    content["effects"] = content["effects"] | changes if isinstance(changes, dict) else changes[0]
    with pytest.raises(ConfigError, match=r"mine\.yaml: effects") as error:
        robot_from("mine.yaml", content)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "cov", "interval", "message"),
    [
        ("gyro_scale_ratio", np.eye(2), (0.0, 0.2), "shape"),
        ("gyro_scale_ratio", np.eye(1), (0.2, 0.3), "must hold it"),
        ("gyro_scale_ratio", np.eye(1), (math.nan, math.nan), "must hold it"),
        ("yaw_delay_s", np.eye(1), (0.0, 0.2), "does not apply to"),
        ("gyro_scale_ratio", -np.eye(1), (0.0, 0.2), "variance"),
    ],
)
def test_invalid_values_are_not_written(name, cov, interval, message):
    with pytest.raises(ConfigError, match=message):
        extended_yaml("agrimaro", {name: 0.1}, cov, {name: interval}, "a test")


# -- What a value rests on: the described number, and whether somebody measured it ----------------------------


def test_the_extended_number_is_the_one_that_filters_take():
    """Two routes: the number that is reported, and the description with the effect applied."""
    for robot in map(load_robot, ("agrimaro", "husky", "warthog", "marmotte", "robotino")):
        for parameter in parameters_of(robot.drive):
            extended = apply_homes(replace(robot, effects={parameter: 0.05}))
            for basis in basis_of(robot, parameter, 0.05):
                if basis.origin is not Origin.LEFT_OUT and parameter not in extended.effects:
                    part = extended.parts[basis.section] if basis.section else extended
                    assert getattr(part, basis.field) == basis.extended
            assert len(basis_of(robot, parameter)) == len(PARAMETER[parameter].homes)


def test_a_lever_arm_rests_on_what_was_assumed_and_effects_of_the_robot_are_not_applied_twice():
    content = yaml.safe_load((data_folder("robots") / "husky.yaml").read_text())

    def lever():
        (basis,) = basis_of(robot_from("husky.yaml", content), "lever_x_m", -0.23)
        return basis.name, basis.origin, basis.described, round(basis.extended, 6)

    assert lever() == ("camera.lever_x_m", Origin.ASSUMED, 0.35, 0.12)
    content["camera"]["lever_x_m"]["source"] = "measured with a ruler, not assumed"
    assert lever()[1] is Origin.SOURCED
    del content["camera"]
    assert lever() == ("camera.lever_x_m", Origin.LEFT_OUT, 0.0, -0.23)
    extended = replace(HUSKY, effects={"effective_track_ratio": 1.5})
    (basis,) = basis_of(extended, "effective_track_ratio", 1.5)
    assert (basis.described, basis.extended) == (0.5708, pytest.approx(2.5 * 0.5708))


# -- Where an extended robot was validated, and the warning outside of it -------------------------------------


def within(name, region):
    return robot_from("mine.yaml", yaml.safe_load(extended_yaml(name, *ONE, region)))


@pytest.fixture(scope="module")
def husky_runs():
    return [simulate_run(HUSKY, "grass", "complex", 0, number, duration_s=30.0) for number in (1, 2)]


@pytest.mark.parametrize("robot", [HUSKY, AGRIMARO], ids=lambda robot: robot.name)
def test_a_region_holds_what_was_driven(robot):
    """Two routes: from the wheels as logged, and from the truth of the simulation."""
    run = simulate_run(robot, "asphalt", "complex", 0, 1, duration_s=30.0)
    region, truth = region_of([run], robot), run.streams["truth"]
    names = [name for name in truth.channels if name.startswith("wheel_") and name.endswith("radps")]
    speed = np.mean([truth.channel(name) for name in names], axis=0) * robot.wheel_radius_m
    turn = truth.channel("yaw_rate_radps")  # asphalt hardly slips, but what turns by skidding turns slower
    if robot is HUSKY:
        left, right = (truth.channel(f"wheel_{side}_radps") for side in ("left", "right"))
        turn = robot.wheel_radius_m * (right - left) / robot.track_m
    np.testing.assert_allclose(region.wheel_speed_mps, np.percentile(speed, [1, 99]), atol=0.03)
    np.testing.assert_allclose(region.yaw_rate_radps, np.percentile(turn, [1, 99]), atol=0.05)
    assert region.terrains == ("asphalt",)


def test_a_region_is_written_and_read_and_a_slope_that_was_not_measured_is_none(husky_runs):
    region = region_of(husky_runs, HUSKY)
    robot = within("husky", region)
    assert robot.region.terrains == region.terrains == ("grass",)
    np.testing.assert_allclose(robot.region[:3], region[:3], rtol=1e-6, atol=1e-12)
    assert within("husky", None).region is None
    bare = [replace(run, streams={"wheels": run.streams["wheels"]}, labels=()) for run in husky_runs]
    unknown = region_of(bare, HUSKY)
    assert (unknown.grade_rad, unknown.terrains) == (None, ())
    warn_outside(husky_runs[0], within("husky", unknown))  # no warning: neither slope nor terrain is known
    simulate_run(robot, "grass", "complex", 0, 3, duration_s=30.0)  # of the same kind, and inside
    estimate_run(husky_runs[0], robot, "slip")


def test_simulation_and_filter_warn_outside_once_with_the_numbers(husky_runs):
    robot = within("husky", Region((-0.2, 0.2), (-5.0, 5.0), None, ("snow",)))
    sentence = (
        r"run grass_complex_01 leaves the region that the effects of robot husky were validated in: "
        r"wheel speed -0\.\d+ to 1 m/s \(validated: -0\.2 to 0\.2\), terrain 'grass' \(validated: snow\)"
    )
    for drive in (
        lambda: simulate_run(robot, "grass", "complex", 0, 1, duration_s=30.0),
        lambda: estimate_run(husky_runs[0], robot, "slip"),
    ):
        with pytest.warns(OutsideRegionWarning, match=sentence) as caught:
            drive()
        assert len(caught) == 1


@pytest.mark.parametrize(("fastest_mps", "n"), [(0.3, 1), (2.0, 0)])
def test_a_live_filter_warns_once(fastest_mps, n):
    run = simulate_run(AGRIMARO, "grass", "straight", 0, 1, duration_s=8.0)
    region = Region((-fastest_mps, fastest_mps), (-3.0, 3.0), None, ())
    robot, correction = correct_live(within("agrimaro", region))
    estimator = make_live_filter("vio15", robot, CHANNELS, correction)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for sample in replay(run):
            estimator.step(sample.readings)
    found = [str(each.message) for each in caught if each.category is OutsideRegionWarning]
    assert len(found) == n
    assert all("leaves the region" in sentence and "wheel speed" in sentence for sentence in found)
