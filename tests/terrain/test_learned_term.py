"""Learned terms: read as written, off outside their region, and the same sample by sample and in a simulation."""

from dataclasses import replace
from functools import cache
from itertools import islice, pairwise

import numpy as np
import pytest
import yaml

from terrain.effects import HEADING, SPEED_X, SPEED_Y
from terrain.errors import ConfigError, NotTakenWarning
from terrain.estimation.estimate import estimate_run
from terrain.estimation.live import make_live_filter
from terrain.extension import correct, correct_live, extended_yaml, rolling_axle
from terrain.learned_term import INPUTS, LearnedTerm, factors_of, learned_lines, read_learned
from terrain.logs.replay import replay
from terrain.records import Command, RunLog
from terrain.robots import load_robot, robot_from
from terrain.simulation.plants.planar import Ground
from terrain.simulation.run import simulate, simulate_run
from terrain.simulation.scenario import Patch, Scenario
from terrain.terramechanics.soil import load_soil

HUSKY = load_robot("husky")
TIME_S = np.arange(1000) / 50
TWIST = np.column_stack([0.5 + 0.3 * np.sin(0.5 * TIME_S), 0.0 * TIME_S, 0.6 * np.sin(0.9 * TIME_S)])
WIDE = {"speed_mps": (-2.0, 2.0), "turn_radps": (-2.0, 2.0)}


def term(channel, products, values, region=WIDE, std=0.01):
    cov = std**2 * np.eye(len(products))
    return LearnedTerm(channel, tuple(products), np.array(values), cov, region, "what it does", "a test")


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


def test_the_filter_of_a_robot_that_has_it_finds_no_slip_where_it_takes_it_off():
    estimates = [estimate_run(driven(LEARNED), robot, "slip") for robot in (LEARNED, HUSKY)]
    found, plain = (np.sqrt(np.nanmean(each.slip.mean[100:] ** 2)) for each in estimates)
    assert 2.0 * found < plain
    found, plain = (abs(each.track.state("turn_loss_ratio")[-1]) for each in estimates)
    assert 5.0 * found < plain


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


def test_live_is_the_filter_of_the_corrected_log():
    run = driven(LEARNED)
    corrected_run, robot = correct(run, LEARNED)
    live = live_track(run, "slip", *correct_live(LEARNED))
    np.testing.assert_array_equal(live, live_track(corrected_run, "slip", robot, None))
    assert len(live) > 900


# -- Robots that steer: their wheels, or the axle, roll as they move ------------------------------------------------

STEERS = load_robot("agrimaro")
SIDEWAYS = {**WIDE, "sideways_mps": (-1.0, 1.0)}
MOVES = (
    LOSS,
    TURN,
    term(SPEED_Y, ["sideways_mps", "speed_mps * turn_radps"], [0.2, 0.1], SIDEWAYS),
)
SLIDES = replace(STEERS, learned=MOVES)
CAR = load_robot("adap2e")
FAST = {"speed_mps": (-9.0, 9.0), "turn_radps": (-2.0, 2.0)}
N_SAMPLES = 3000  #: That are replayed.
DRIFTS = replace(
    CAR,
    learned=(
        term(SPEED_X, ["speed_mps * abs(turn_radps)", "change(speed_mps, 0.3)"], [-0.2, 0.1], FAST),
        term(HEADING, ["turn_radps"], [-0.3], {"turn_radps": (-2.0, 2.0)}),
    ),
)


@cache
def steered():
    left = 0.15 * np.sin(0.7 * TIME_S)
    return simulate(SLIDES, np.column_stack([TWIST[:, 0], left, TWIST[:, 2]]), Ground(slip_ratio=0.0), 0)


@cache
def car_run():
    return simulate_run(DRIFTS, "grass", "survey", 3, duration_s=20.0)


def error_of(track, run, names):
    true = run.streams["truth"]
    apart = [track.state(name) - np.interp(track.time_s, true.time_s, true.channel(name)) for name in names]
    return np.sqrt(np.mean(np.square(apart)[:, 100:]))


@pytest.mark.parametrize(("name", "factor"), [("encoder12", 10.0), ("vio12", 2.0), ("vio15", 2.0)])
def test_filters_of_a_robot_that_steers_are_nearer_to_how_it_moves(name, factor):
    found, plain = (estimate_run(steered(), robot, name) for robot in (SLIDES, STEERS))
    speeds = "speed_x_mps", "speed_y_mps"
    assert factor * error_of(found.track, steered(), speeds) < error_of(plain.track, steered(), speeds)
    slips = [np.sqrt(np.nanmean(each.blind.mean[100:] ** 2)) for each in (found, plain)]
    assert 2.0 * slips[0] < slips[1]


@pytest.mark.parametrize("name", ["sideslip-kinematic", "sideslip-dynamic", "sideslip-multi"])
def test_observers_of_a_car_take_its_axle_and_steering_to_roll_so(name):
    found, plain = (estimate_run(car_run(), robot, name) for robot in (DRIFTS, CAR))
    slips = [np.sqrt(np.nanmean(each.slip.mean[100:] ** 2)) for each in (found, plain)]
    assert 1.8 * slips[0] < slips[1]


def test_an_axle_that_rolls_so_moves_by_the_law_and_stands_as_it_is_measured():
    about = DRIFTS, DRIFTS.learned[1:], 2.0, 0.2, 0.02
    speed, angle = rolling_axle(*about, [{}])
    assert speed == 2.0
    assert np.tan(angle) == pytest.approx(0.7 * np.tan(0.2))
    assert rolling_axle(*about[:2], 0.01, 0.2, 0.02, [{}]) == (0.01, 0.2)
    assert np.isnan(rolling_axle(*about[:2], np.nan, 0.2, 0.02, [{}])[0])


def test_wheels_that_are_steered_are_corrected_alike_block_by_block():
    run = steered()
    log, _ = correct(run, SLIDES)
    _, correction = correct_live(SLIDES)
    edges, rows = [-np.inf, 0.5, 0.51, 0.9, 7.0, np.inf], []
    for start_s, end_s in pairwise(edges):
        for name in ("steering", "wheels"):
            stream = run.streams[name]
            own = (stream.time_s > start_s) & (stream.time_s <= end_s)
            got = correction(name, stream.channels, stream.time_s[own], stream.values[own].copy())[1]
            rows += [got] if name == "wheels" else []
    np.testing.assert_array_equal(np.vstack(rows), log.streams["wheels"].values)


def live_track(run, name, robot, correction):
    channels = {each: stream.channels for each, stream in run.streams.items()}
    live = make_live_filter(name, robot, channels, correction)
    samples = islice(replay(run), N_SAMPLES)
    return np.array([each.mean for sample in samples for each in live.step(sample.readings)])


def test_live_is_the_log_of_robots_that_steer():
    log, robot = correct(steered(), SLIDES)
    live = live_track(steered(), "vio15", *correct_live(SLIDES))
    np.testing.assert_array_equal(live, live_track(log, "vio15", robot, None))
    live = live_track(car_run(), "sideslip-multi", *correct_live(DRIFTS))
    whole = estimate_run(car_run(), DRIFTS, "sideslip-multi").track.mean
    np.testing.assert_array_equal(live, whole[: len(live)])
    assert len(live) > 200


@pytest.mark.parametrize(
    ("robot", "channel", "words"),
    [
        (HUSKY, SPEED_Y, "sideways speed"),
        (CAR, SPEED_Y, "sideways speed"),
        (STEERS, "yaw_rate_radps", "gyro"),
        (HUSKY, "accel_x_mps2", "accelerometer"),
    ],
)
def test_what_filters_do_not_take_is_said_in_one_sentence(robot, channel, words):
    given = replace(robot, learned=(term(channel, ["speed_mps"], [0.1], {"speed_mps": (-2.0, 2.0)}),))
    sentence = f"filters of robot {robot.name} do not take what was learned of its {words}, which its simulation does"
    with pytest.warns(NotTakenWarning, match=f"^{sentence}$"):
        correct_live(given)
    with pytest.warns(NotTakenWarning, match=f"^{sentence}$"):
        correct(driven(HUSKY), given)


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
        assert dict(one.region) == dict(other.region)
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
