"""The gain of an extension is the reduction of the residual on held-out runs; noise alone gives none."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from terrain.discrepancy.compared import compare_runs
from terrain.discrepancy.diagnosed_runs import extended_effects
from terrain.discrepancy.gain import gain_of
from terrain.discrepancy.health.fault import Change, Column, Fault, FaultKind
from terrain.discrepancy.held_out import repair_held_out, split_runs
from terrain.discrepancy.runs import Simulation, low_pass_of, signals_of
from terrain.discrepancy.verdict import INTERVAL_T
from terrain.effects import CHANNELS, CURRENT, GYRO, TURNING_CURRENT
from terrain.errors import ConfigError, DataError
from terrain.records import RunLog
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, spread_numbers
from terrain.simulation.run import simulate

HUSKY = load_robot("husky")
LONGER = {"wheel_radius_ratio": 0.03}
TIME_S = np.arange(1500) / 50
TWIST = np.column_stack(
    [0.5 * np.sin(0.5 * TIME_S) + 0.2 * np.sin(1.7 * TIME_S), 0.0 * TIME_S, 0.4 * np.sin(0.9 * TIME_S)]
)
"""Forward, back and around, at several speeds."""


def signals(n, effects):
    options = {"effects": effects, "scatter": spread_numbers("scatter"), "noise": spread_numbers("noise")}
    return [
        signals_of(simulate(HUSKY, TWIST, Ground(), i, run_id=f"r{i}", **options), HUSKY) for i in range(n)
    ]


@pytest.fixture(scope="module")
def longer():
    return signals(7, LONGER)


def gain(runs, effects, seed=0):
    simulation = Simulation(HUSKY, scatter=spread_numbers("scatter"))
    low_pass = low_pass_of(runs)
    compared = compare_runs(simulation, simulation.with_effects(effects), runs, low_pass)
    none = [np.zeros_like(run.measured) for run in compared]
    return gain_of(
        compared,
        none,
        dict.fromkeys(CHANNELS, 0.01) | {CURRENT: 1.0, TURNING_CURRENT: 1.0},
        seed,
        "7 runs held out",
    )


def test_the_true_extension_leaves_noise_and_scatter(longer):
    found = gain(longer, LONGER)
    ahead = found.channels["speed_x_mps"]
    assert (found.refused, found.clusters) == (False, "runs")
    assert ahead.ci[0] > 0.5
    # what is left ahead: noise, and radii that scatter by 0.003 of 0.4 m/s
    assert ahead.rms_after < 0.006 < ahead.rms_before
    assert ahead.reduction == pytest.approx(1.0 - (ahead.rms_after / ahead.rms_before) ** 2)
    assert found.channels["speed_y_mps"].refused
    assert (ahead.learner_reduction, ahead.learner_rms) == (0.0, ahead.rms_before)
    assert gain(longer[:2], LONGER).clusters == "thirds of runs"


def test_no_gain_is_claimed_for_nothing_for_the_wrong_sign_or_where_nothing_is_hidden(longer):
    nothing = gain(longer, {})
    assert (nothing.reduction, nothing.ci, nothing.refused) == (0.0, (0.0, 0.0), True)
    wrong = gain(longer, {"wheel_radius_ratio": -0.03}).channels["speed_x_mps"]
    assert wrong.refused
    assert wrong.ci[1] < 0.0
    assert gain(signals(6, {}), LONGER).refused


# -- Which runs are held out of a diagnosis, and which of them have the faults that were found in the others --


def test_the_seed_chooses_the_runs_held_out_and_no_label_does():
    runs = [RunLog(f"{name}{i}", "husky", {}, ((0.0, 1.0, name),)) for name in "ab" for i in range(12)]
    used, held = split_runs(runs, None, 0)
    assert len(held) == 6
    for labels in ((), ((0.0, 1.0, "grass"),)):
        others = [replace(run, labels=labels if i % 3 else ()) for i, run in enumerate(runs)]
        assert [run.run_id for run in split_runs(others, None, 0)[1]] == [run.run_id for run in held]
    assert {run.run_id for run in used} | {run.run_id for run in held} == {run.run_id for run in runs}
    assert split_runs(runs, None, 0) == (used, held)
    assert any(split_runs(runs, None, seed)[1] != held for seed in range(1, 4))
    assert split_runs(runs[:23], None, 0) == (runs[:23], [])
    assert split_runs(runs, 0, 0) == (runs, [])
    with pytest.raises(DataError, match="--hold-out is 22 of 24"):
        split_runs(runs, 22, 0)


@pytest.mark.parametrize("n_sessions", [2, 3, 8])
@pytest.mark.parametrize("hold_out", [None, 3])
def test_whole_sessions_are_held_out_where_several_are_named(n_sessions, hold_out):
    runs = [
        RunLog(f"r{i}", "husky", {}, ((0.0, 1.0, "ab"[i % 2]),), session=f"session {i % n_sessions}")
        for i in range(24)
    ]
    used, held = split_runs(runs, hold_out, 1)
    assert {run.session for run in used}.isdisjoint(run.session for run in held)
    assert len(held) >= (hold_out or 2)
    assert len(used) + len(held) == 24


def test_a_fault_is_repaired_in_the_held_out_runs_that_have_it():
    (right,) = signals(1, {})
    turned = Change(FaultKind.SIGN, Column.GYRO, -1.0)
    fault = Fault(turned, ("other",), "turned", "multiply")
    about = Simulation(HUSKY), low_pass_of([right]), dict.fromkeys(CHANNELS, 0.01)
    for given in (right, turned.applied(right)):
        (fixed,) = repair_held_out([given], [fault], *about)
        np.testing.assert_array_equal(fixed.measured, right.measured)
    unclear = Fault(turned._replace(factor=math.nan), ("other",), "?", "left out")
    (fixed,) = repair_held_out([right], [unclear], *about)
    assert np.isnan(fixed.measured[:, CHANNELS.index(GYRO)]).all()


# -- What is named is built in -------------------------------------------------------------------------------


def test_the_covariance_of_what_is_found_again_replaces_the_known_one():
    found = {"lever_x_m": 0.1, "lever_y_m": -0.05}
    covariance = [*found], np.array([[4.0, 1.0], [1.0, 9.0]]) * 1e-6
    again = SimpleNamespace(values=found, covariance=covariance, latest=())
    known = {"lever_x_m": 0.2, "payload_ratio": 0.1}
    robot = replace(HUSKY, effects=known, effects_cov=np.array([[1.0, 0.5], [0.5, 16.0]]) * 1e-4)
    values, cov, intervals = extended_effects(robot, again)
    assert values == pytest.approx({"lever_x_m": 0.3, "payload_ratio": 0.1, "lever_y_m": -0.05})
    np.testing.assert_allclose(cov, [[4e-6, 0, 1e-6], [0, 16e-4, 0], [1e-6, 0, 9e-6]])
    assert intervals["payload_ratio"] == pytest.approx((0.1 - INTERVAL_T * 0.04, 0.1 + INTERVAL_T * 0.04))
    with pytest.raises(ConfigError, match="no covariance"):
        extended_effects(replace(HUSKY, effects=known), again)
