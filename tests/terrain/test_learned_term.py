"""Learned terms: read as written, off outside their region, and the same sample by sample and in a simulation."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from terrain.effects import HEADING, SPEED_X
from terrain.errors import ConfigError
from terrain.estimation.estimate import estimate_run
from terrain.estimation.live import LiveFilter
from terrain.extension import correct, correct_live, extended_yaml
from terrain.learned_term import INPUTS, LearnedTerm, factors_of, learned_lines, read_learned
from terrain.logs.replay import replay
from terrain.records import Command, RunLog
from terrain.robots import load_robot, robot_from
from terrain.simulation.plants.planar import Ground
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Patch, Scenario
from terrain.terramechanics.soil import load_soil

HUSKY = load_robot("husky")
TIME_S = np.arange(1000) / 50
TWIST = np.column_stack([0.5 + 0.3 * np.sin(0.5 * TIME_S), 0.0 * TIME_S, 0.6 * np.sin(0.9 * TIME_S)])
WIDE = {"speed_mps": (-2.0, 2.0), "turn_radps": (-2.0, 2.0)}


def term(channel, products, values, region=WIDE, std=0.01):
    cov = std**2 * np.eye(len(products))
    return LearnedTerm(
        channel, tuple(products), np.array(values), cov, region, 0.02, "what it does", "a test"
    )


LOSS = term(SPEED_X, ["speed_mps * max(turn_radps, 0)", "change(speed_mps, 0.3)"], [-0.4, 0.1])
TURN = term(HEADING, ["turn_radps"], [-0.3], {"turn_radps": (-2.0, 2.0)})
LEARNED = replace(HUSKY, learned=(LOSS, TURN))


def driven(robot, noise=None):
    return simulate(robot, TWIST, Ground(slip_ratio=0.0), 0, noise=noise)


# -- The simulated robot moves by it, the wheels do not ------------------------------------------------------------


def test_the_simulated_robot_moves_by_the_law_and_its_wheels_do_not():
    plain, learned = driven(HUSKY), driven(LEARNED)
    wheels, truth = plain.streams["wheels"].values, learned.streams["truth"]
    np.testing.assert_array_equal(learned.streams["wheels"].values[:, :2], wheels[:, :2])
    speed, turn = (plain.streams["truth"].channel(name) for name in ("speed_x_mps", "yaw_rate_radps"))
    np.testing.assert_allclose(truth.channel("yaw_rate_radps"), 0.7 * turn, atol=1e-9)
    lost = speed - truth.channel("speed_x_mps") - 0.4 * speed * np.maximum(turn, 0.0)
    steady = np.abs(np.gradient(speed)) < 2e-3
    assert (
        np.abs(lost)[steady][50:].max() < 0.02
    )  # what is left is the change of speed, some tenths of a second long
    gyro = np.interp(
        truth.time_s, learned.streams["imu"].time_s, learned.streams["imu"].channel("gyro_z_radps")
    )
    np.testing.assert_allclose(gyro, truth.channel("yaw_rate_radps"), atol=0.01)


def test_it_is_off_outside_its_region_and_smooth_at_its_edge():
    only = term(SPEED_X, ["speed_mps"], [-0.5], {"speed_mps": (0.0, 1.0)})
    inputs = np.zeros((2001, len(INPUTS)))
    inputs[:, 0] = np.linspace(-1.0, 3.0, 2001)
    added, std = only.predict(inputs, np.full(2001, 0.01))
    inside = (inputs[:, 0] >= 0.0) & (inputs[:, 0] <= 1.0)
    np.testing.assert_allclose(added[inside], -0.5 * inputs[inside, 0])
    assert not added[(inputs[:, 0] < -0.1) | (inputs[:, 0] > 1.1)].any()
    assert np.abs(np.diff(added)).max() < 0.02
    np.testing.assert_allclose(std[inside], 0.01 * inputs[inside, 0])


# -- Filters take it with the wheels, live as in a batch -----------------------------------------------------------


def test_the_filter_of_a_robot_that_has_it_is_as_good_as_without():
    run = driven(LEARNED)
    found, plain = (estimate_run(run, robot, "skid") for robot in (LEARNED, HUSKY))
    true = run.streams["truth"]
    errors = []
    for each in (found, plain):
        speed = np.interp(each.track.time_s, true.time_s, true.channel("speed_x_mps"))
        errors.append(np.sqrt(np.mean((each.track.state("speed_mps") - speed)[100:] ** 2)))
    assert errors[0] < 0.01
    assert errors[1] > 5.0 * errors[0]


def test_block_by_block_is_the_whole_run_and_a_missing_sample_stays_one():
    run = driven(LEARNED)
    values = np.array(run.streams["wheels"].values)
    values[40, 0] = np.nan
    wheels = replace(run.streams["wheels"], values=values)
    whole = correct(RunLog("a", "husky", {"wheels": wheels}), LEARNED)[0].streams["wheels"].values
    _, correction = correct_live(LEARNED)
    rows = [
        correction("wheels", wheels.channels, wheels.time_s[i : i + n], values[i : i + n].copy())[1]
        for i, n in [(0, 1), (1, 6), (7, 50), (57, 1), (58, len(values))]
    ]
    np.testing.assert_array_equal(np.vstack(rows), whole)
    assert np.isnan(whole[40, 0])
    assert np.isfinite(whole[41]).all()


def live_means(run, robot, correction):
    channels = {name: run.streams[name].channels for name in ("wheels", "imu")}
    live = LiveFilter(robot, "skid", channels, correction=correction)
    return np.array([each.mean for sample in replay(run) for each in live.step(sample.readings)])


def test_live_is_the_filter_of_the_corrected_log():
    run = driven(LEARNED)
    corrected_run, robot = correct(run, LEARNED)
    live = live_means(run, *correct_live(LEARNED))
    np.testing.assert_array_equal(live, live_means(corrected_run, robot, None))
    assert len(live) > 900


# -- The section of a description ----------------------------------------------------------------------------------


def test_a_robot_is_written_and_read_with_its_terms(tmp_path):
    text = extended_yaml("husky", {}, np.empty((0, 0)), {}, "me", learned=(LOSS, TURN))
    read = robot_from("mine.yaml", yaml.safe_load(text))
    for one, other in zip(read.learned, (LOSS, TURN), strict=True):
        assert (one.channel, one.products, one.says, one.source) == (
            other.channel,
            other.products,
            other.says,
            other.source,
        )
        np.testing.assert_allclose(one.coefficients, other.coefficients)
        np.testing.assert_allclose(one.covariance, other.covariance)
        assert (dict(one.region), one.left_std) == (dict(other.region), other.left_std)
    (tmp_path / "mine.yaml").write_text(text)
    again = extended_yaml(tmp_path / "mine.yaml", {}, np.empty((0, 0)), {}, "me")
    assert "learned:" not in again
    assert not load_robot("husky").learned


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"channel": "speed"}, "the channel is unknown"),
        ({"says": ""}, "says is '', words are required"),
        ({"coefficients": {"abs(speed)": 1.0}}, "is no product of"),
        ({"coefficients": {"change(speed_mps, 0)": 1.0}}, "is no product of"),
        ({"coefficients": {}}, "0 products, 1 to 64"),
        ({"coefficients": {"turn_radps": float("nan")}}, "nan is no finite number"),
        (
            {"coefficients": {"grade_rad": 1.0}, "region": {"grade_rad": [0.0, 1.0]}},
            "depends on the wheels alone",
        ),
        ({"covariance": [[1.0, 0.0]]}, "rows of as many numbers"),
        ({"covariance": [[1.0, 0.0], [0.0, 1.0]]}, r"shape \(2, 2\), \(1, 1\) is required"),
        ({"covariance": [[-1.0]]}, "not positive semi-definite"),
        ({"region": {}}, "no range, turn_radps is required"),
        ({"region": {"turn_radps": [1.0, -1.0]}}, "not two rising finite numbers"),
        ({"region": {"turn_radps": [1.0]}}, "two numbers by input"),
        ({"left_std": -1.0}, "left_std is -1.0"),
        ({"gain": 1.0}, "key 'gain' is unknown"),
    ],
)
def test_terms_that_cannot_be_are_refused_in_one_sentence(changes, message):
    section = yaml.safe_load("\n".join(learned_lines([TURN])))["learned"]
    section["terms"][0] |= changes
    with pytest.raises(ConfigError, match=message) as refused:
        read_learned("mine.yaml: learned", section)
    assert str(refused.value).startswith("mine.yaml: learned: term 1")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "section", [{"schema": 2, "terms": []}, {"schema": 1, "terms": {}}, {"schema": 1}, []]
)
def test_a_section_that_cannot_be_is_refused(section):
    with pytest.raises(ConfigError, match=r"mine\.yaml: learned"):
        read_learned("mine.yaml: learned", section)


def test_a_product_is_read_in_each_of_its_forms():
    text = "1 * moving * speed_mps * abs(turn_radps) * sign(speed_mps) * max(-turn_radps - 0.8, 0)"
    text += " * change(speed_mps, 0.3)"
    kinds = [factor.kind for factor in factors_of(text)]
    assert kinds == ["1", "moving", "plain", "abs", "sign", "max", "change"]


# -- The dynamic plant, in open and in closed loop -------------------------------------------------------------------


@pytest.mark.parametrize("closed", [False, True])
def test_contacts_of_the_dynamic_plant_move_by_it(closed):
    robot, soil = load_robot("agrimaro"), load_soil("asphalt")
    slower = term(SPEED_X, ["speed_mps"], [-0.2], {"speed_mps": (-2.0, 2.0)})
    twist = np.zeros((300, 3))
    twist[50:, 0] = 0.6
    drive = Scenario("straight", 50.0, np.arange(300) / 50.0, twist, (Patch(0.0, soil.name),))
    given = Command(np.full(3, 0.6 / robot.wheel_radius_m), np.zeros(3), np.array([0.6, 0.0, 0.0]), {})
    options = {"controller": lambda sample: given} if closed else {}
    robots = robot, replace(robot, learned=(slower,))
    truth = [simulate(each, drive, {soil.name: soil}, 0, **options).streams["truth"] for each in robots]
    plain, learned = (each.channel("speed_x_mps")[-100:].mean() for each in truth)
    assert learned == pytest.approx(0.8 * plain, rel=0.02)
    slip = [each.channel("slip_1_ratio")[-100:].mean() for each in truth]
    assert slip[1] - slip[0] == pytest.approx(
        0.2, abs=0.02
    )  # the wheels turn on, and the robot is behind them
