"""Where an extended robot was validated, and the warning outside of it."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import yaml

from terrain.errors import ConfigError, OutsideRegionWarning
from terrain.estimation.estimate import estimate_run
from terrain.estimation.live import LiveFilter
from terrain.extension import correct_live, extended_yaml, region_of, warn_outside
from terrain.logs.replay import replay
from terrain.robots import Region, load_robot, robot_from
from terrain.simulation.run import simulate_run

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")
VALUES, COV, INTERVALS = {"gyro_scale_ratio": 0.02}, np.array([[4e-6]]), {"gyro_scale_ratio": (0.016, 0.024)}


def extended(name, region):
    text = extended_yaml(name, VALUES, COV, INTERVALS, "me", region)
    return robot_from("mine.yaml", yaml.safe_load(text))


@pytest.fixture(scope="module")
def husky_runs():
    return [simulate_run(HUSKY, "grass", "complex", 0, number, duration_s=30.0) for number in (1, 2)]


@pytest.mark.parametrize("robot", [HUSKY, AGRIMARO], ids=lambda robot: robot.name)
def test_a_region_holds_what_was_driven(robot):
    """Two routes: from the wheels as logged, and from the truth of the simulation."""
    run = simulate_run(robot, "asphalt", "complex", 0, 1, duration_s=30.0)
    region = region_of([run], robot)
    truth = run.streams["truth"]
    names = [name for name in truth.channels if name.startswith("wheel_") and name.endswith("radps")]
    speed = np.mean([truth.channel(name) for name in names], axis=0) * robot.wheel_radius_m
    np.testing.assert_allclose(region.wheel_speed_mps, np.percentile(speed, [1, 99]), atol=0.03)
    # asphalt hardly slips, but skidding takes nothing off the rate that the wheels would turn with
    np.testing.assert_allclose(
        region.yaw_rate_radps, np.percentile(truth.channel("yaw_rate_radps"), [1, 99]), atol=0.05
    )
    assert region.terrains == ("asphalt",)


def test_a_region_is_written_and_read(husky_runs):
    region = region_of(husky_runs, HUSKY)
    robot = extended("husky", region)
    assert robot.region.terrains == region.terrains == ("grass",)
    for found, stated in zip(robot.region[:3], region[:3], strict=True):
        np.testing.assert_allclose(found, stated, rtol=1e-6, atol=1e-12)
    assert extended("husky", None).region is None
    unknown = Region((0.0, 1.0), None, None, ())
    assert extended("husky", unknown).region == unknown


def test_a_slope_that_was_not_measured_is_no_slope_of_zero(husky_runs):
    bare = [
        replace(run, streams={name: run.streams[name] for name in ("wheels",)}, labels=())
        for run in husky_runs
    ]
    region = region_of(bare, HUSKY)
    assert (region.grade_rad, region.terrains) == (None, ())
    warn_outside(husky_runs[0], extended("husky", region))  # no warning: neither slope nor terrain is known


def test_runs_of_the_same_kind_are_inside(husky_runs):
    robot = extended("husky", region_of(husky_runs, HUSKY))
    for number in range(3, 9):
        simulate_run(robot, "grass", "complex", 0, number, duration_s=30.0)
    for run in husky_runs:
        estimate_run(run, robot, "skid")


def test_simulation_and_filter_warn_outside_once_with_the_numbers(husky_runs):
    robot = extended("husky", Region((-0.2, 0.2), (-5.0, 5.0), None, ("snow",)))
    sentence = (
        r"run grass_complex_01 leaves the region that the effects of robot husky were validated in: "
        r"wheel speed -0\.\d+ to 1 m/s \(validated: -0\.2 to 0\.2\), terrain 'grass' \(validated: snow\)"
    )
    for drive in (
        lambda: simulate_run(robot, "grass", "complex", 0, 1, duration_s=30.0),
        lambda: estimate_run(husky_runs[0], robot, "skid"),
    ):
        with pytest.warns(OutsideRegionWarning, match=sentence) as caught:
            drive()
        assert len(caught) == 1


@pytest.mark.parametrize(("fastest_mps", "n"), [(0.3, 1), (2.0, 0)])
def test_a_live_filter_warns_once(fastest_mps, n):
    run = simulate_run(AGRIMARO, "grass", "straight", 0, 1, duration_s=8.0)
    robot, correction = correct_live(
        extended("agrimaro", Region((-fastest_mps, fastest_mps), (-3.0, 3.0), None, ()))
    )
    estimator = LiveFilter(robot, correction=correction)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for sample in replay(run):
            estimator.step(sample.readings)
    found = [str(each.message) for each in caught if each.category is OutsideRegionWarning]
    assert len(found) == n
    assert all("leaves the region" in sentence and "wheel speed" in sentence for sentence in found)


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"speed": [0, 1]}, "effects: region: key 'speed' is unknown"),
        ({"grade_rad": [0.1, 0.0]}, "the lower edge comes first"),
        ({"grade_rad": [0.1]}, "two finite numbers are required"),
        ({"grade_rad": [0.0, float("nan")]}, "two finite numbers are required"),
        ({"terrains": "grass"}, "a list of words is required"),
        ([1], "region is \\[1\\], a mapping with"),
    ],
)
def test_a_region_that_is_none_is_refused(stated, message):
    content = yaml.safe_load(extended_yaml("husky", VALUES, COV, INTERVALS, "me"))
    content["effects"]["region"] = stated
    with pytest.raises(ConfigError, match=message):
        robot_from("mine.yaml", content)
