"""What a learner reaches where no name fits, and what of it goes into the extended robot."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pipelines.explain.explain import explain
from pipelines.report.results import as_json
from terrain.discrepancy.compared import ComparedRun, compare_runs
from terrain.discrepancy.gain import gain_of
from terrain.discrepancy.learner import (
    DRIVEN,
    ENOUGH,
    _weights,
    cross_validated,
    fitted,
    folds_of,
    learn_terms,
    left_out_gain,
    predicted_residuals,
    scatter_square,
    size_of,
)
from terrain.effects import CHANNELS
from terrain.extension import extended_yaml
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground
from terrain.simulation.run import simulate

# -- A black-box reference finds what depends on the inputs, no more than is there, beside the names -----------

C, CHANNEL, STD = CHANNELS.index("speed_x_mps"), "speed_x_mps", 0.05
T = CHANNELS.index("turning_current_a")


def a_run(seed, hidden=0.0, named=None, late=0, n=300):
    """Measured minus simulated is ``hidden speed turn`` of some rows ago; ``named`` of it is built in."""
    rng, time_s = np.random.default_rng(seed), np.arange(n) / 6.25
    inputs = {name: np.zeros(n) for name in DRIVEN} | {"time_s": time_s}
    inputs["speed_mps"], inputs["turn_mps"] = np.sin(0.7 * time_s + seed), np.sin(1.1 * time_s + 2.0 * seed)
    shape = np.roll(inputs["speed_mps"] * inputs["turn_mps"], late)
    before, after, measured = np.full((3, n, len(CHANNELS)), np.nan)
    before[:, C], after[:, C] = 0.0, (named or 0.0) * shape
    measured[:, C] = hidden * shape + STD * rng.standard_normal(n)
    compared = measured, before, None if named is None else after
    return ComparedRun(f"r{seed}", "", False, time_s, np.ones(n), *compared, inputs)


def judged(hidden, named, late=0, n_judged=8):
    used, runs = (
        [a_run(seed, hidden, named, late) for seed in seeds]
        for seeds in (range(12), range(50, 50 + n_judged))
    )
    gain = gain_of(runs, predicted_residuals(used, runs), {CHANNEL: STD}, 0, "8 runs held out")
    return gain.channels[CHANNEL], gain


@pytest.mark.parametrize("late", [-1, 0, 1])
def test_it_finds_what_depends_on_the_inputs_also_if_sensors_are_late(late):
    channel, gain = judged(0.5, named=0.0, late=late)
    assert channel.learner_rms == pytest.approx(STD, rel=0.15)
    assert channel.learner_ci[0] > 0.85
    assert channel.left_ci[0] > 0.85
    assert gain.learner_reduction == pytest.approx(channel.learner_reduction)


def test_where_the_names_are_right_and_in_noise_little_is_left_and_one_run_has_no_interval():
    channel, _ = judged(0.5, named=0.5)
    assert channel.reduction == pytest.approx(channel.learner_reduction, abs=0.03)
    assert channel.left_ci[1] < 0.05
    channel, gain = judged(0.0, named=None)
    assert abs(channel.learner_reduction) < 0.05
    assert math.isnan(channel.reduction)
    assert (gain.refused, as_json(channel)["reduction"]) == (True, None)
    predicted = predicted_residuals([a_run(1)], [a_run(2)])
    assert np.isnan(np.delete(predicted[0], C, axis=1)).all()
    assert np.isnan(predicted_residuals([], [a_run(2)])[0]).all()


# -- Terms: selected where they are, none in noise, with a covariance that holds the truth ---------------------------


def sums_of(rng, truth, n_groups=10, n=60, level=0.0):
    """Return sums of products by group: residuals of a group share a disturbance along the first product."""
    tables = []
    for _ in range(n_groups):
        x = rng.standard_normal((n, len(truth)))
        y = x @ truth + 0.5 * rng.standard_normal(n) + level * rng.standard_normal() * x[:, 0]
        tables.append(np.column_stack([x, y]))
    return np.array([table.T @ table for table in tables])


def test_the_covariance_holds_the_truth_also_where_groups_differ():
    truth, distances = np.array([0.5, -0.3, 0.2]), []
    for seed in range(200):
        sums = sums_of(np.random.default_rng(seed), truth, n_groups=20, level=0.2)
        values, cov = fitted(sums, [0, 1, 2])
        distances.append((values - truth) @ np.linalg.solve(cov, values - truth) / 3)
    assert (
        0.8 < np.median(distances) / 0.79 < 1.5
    )  # chi-square over its 3 degrees; groups are few, so a little wide


def test_the_fewest_products_that_do_are_selected_and_none_in_noise():
    truth, sizes = np.zeros(12), []
    truth[[3, 7]] = 0.5, -0.5
    for seed in range(20):
        errors = cross_validated(sums_of(np.random.default_rng(seed), truth))
        sizes.append(size_of(errors, math.inf))
    assert np.mean(np.array(sizes) == 2) > 0.8
    nothing = [
        size_of(cross_validated(sums_of(np.random.default_rng(s), 0.0 * truth)), math.inf) for s in range(50)
    ]
    assert np.mean(np.array(nothing) > 0) <= 0.08


def test_runs_left_out_are_predicted_as_the_cross_validation_has_it():
    sums = sums_of(np.random.default_rng(3), np.array([0.5, 0.0, 0.0, -0.5, 0.2, 0.0]))
    errors, total = cross_validated(sums), sums.sum(axis=0)
    for own, expected in zip(sums, errors, strict=True):
        for n in (1, 2, 4):
            x = np.append(-_weights(total - own, n), 1.0)
            assert x @ own @ x == pytest.approx(expected[n])


def test_a_residual_that_few_products_do_not_reach_gets_as_many_as_have_the_least_error():
    errors = np.tile([10.0, 2.0, 1.0, 0.9], (8, 1)) + 0.3 * np.random.default_rng(0).standard_normal((8, 4))
    errors[:, 3] = errors[:, 2] - 0.1 + 0.4 * np.resize([1.0, -1.0], 8)
    assert (size_of(errors, math.inf), size_of(errors, 0.0)) == (2, 3)


def test_the_fewest_that_gain_clearly_are_selected_where_fewer_fail_in_some_groups():
    errors = np.tile([10.0, 1.0, 2.0], (12, 1))
    errors[:2, 1] = 19.0  # within a standard error of the least, and not clearly better than none
    assert (size_of(errors[:, :2], math.inf), size_of(errors, math.inf)) == (0, 2)


@pytest.mark.parametrize(("other", "gains"), [(0.5, True), (0.2, False), (-0.3, False)])
def test_of_two_sessions_the_term_of_each_has_to_gain_as_much_in_the_other(other, gains):
    """Runs of both, mixed, would show a level in each session as a law of them all."""
    rng, sessions = np.random.default_rng(0), ["a", "b"] * 8
    sums = [sums_of(rng, np.array([{"a": 0.5, "b": other}[name], 0.0, 0.0]), 1)[0] for name in sessions]
    runs, mixed = [SimpleNamespace(session=name) for name in sessions], np.arange(16) // 2
    folds = folds_of(runs, mixed)
    assert len(np.unique(folds)) == 2
    transferred, mixed_gain = (left_out_gain(np.array(sums), of, 1) for of in (folds, mixed))
    assert mixed_gain > 0.0
    assert (transferred >= ENOUGH * mixed_gain) == gains
    assert len(np.unique(folds_of([SimpleNamespace(session="")] * 16, mixed))) == 4


def test_what_runs_differ_by_at_random_is_no_law_of_them(hide, pose):
    """Six runs whose ground resists turns more: a law, unless runs differ by as much from one to the next."""
    problem = pose(hide({"turning_resistance_ratio": 0.3}, duration_s=20.0))
    simulation, low_pass = problem.simulation, problem.low_pass
    info = problem.at(simulation.vector)
    compared = compare_runs(simulation, None, problem.signals, low_pass)
    about = simulation, problem.signals, compared, low_pass
    square = scatter_square(info)
    assert square[T] > 0.0
    assert learn_terms(*about, square)["turning_current_a"].term is not None
    assert learn_terms(*about, 100.0 * square)["turning_current_a"].term is None


# -- A law that no name fits, from runs to a robot that moves by it -------------------------------------------------

LOST, FROM_RADPS = 0.35, 0.2


def lost_mps(speed, turn):
    """The robot loses speed in turns to the left; written into the log, not by a term."""
    return LOST * speed * np.maximum(turn - FROM_RADPS, 0.0)


def with_loss(run, robot):
    seen, wheels = run.streams["odometry"], run.streams["wheels"]
    left, right = (np.interp(seen.time_s, wheels.time_s, wheels.values[:, i]) for i in (0, 1))
    values = np.array(seen.values)
    values[:, 0] -= lost_mps(0.5 * (left + right), (right - left) / robot.track_m)
    return replace(run, streams={**run.streams, "odometry": replace(seen, values=values)})


@pytest.mark.slow
def test_a_law_outside_the_catalogue_comes_back_in_the_extended_robot_and_its_simulation(tmp_path, hide):
    robot = load_robot("husky")
    runs = [with_loss(run, robot) for run in hide({}, n=12)]
    found = explain(runs, robot, effects=("effective_track", "wheel_radius"), hold_out=3)
    (gain,) = [each for each in found.diagnosed.learned_gains if each.channel == "speed_x_mps"]
    assert gain.reduction > max(0.8, 0.9 * gain.learner_reduction)
    assert "speed lost" in gain.says
    assert "in turns to the left" in gain.says
    assert gain.says in found.report.answer
    effects = found.extended.effects, found.extended.effects_cov, {}
    text = extended_yaml("husky", *effects, "a test", found.extended.region, found.extended.learned)
    (tmp_path / "extended.yaml").write_text(text)
    extended = load_robot(tmp_path / "extended.yaml")
    time_s = np.arange(1500) / 50
    twist = np.column_stack([0.6 + 0.2 * np.sin(0.3 * time_s), 0.0 * time_s, 0.45 * np.sin(0.5 * time_s)])
    truth = [simulate(each, twist, Ground(), 0).streams["truth"] for each in (robot, extended)]
    speed, less = (each.channel("speed_x_mps") for each in truth)
    expected = lost_mps(speed, truth[0].channel("yaw_rate_radps"))
    assert np.sqrt(np.mean((speed - less - expected)[100:] ** 2)) < 0.15 * np.sqrt(np.mean(expected**2))
