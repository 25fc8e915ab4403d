"""The gain of an extension is the reduction of the residual on held-out runs; noise alone gives none."""

import math

import numpy as np
import pytest

from pipelines.report.results import as_json
from terrain.discrepancy.faults import Change, Column, Fault, FaultKind
from terrain.discrepancy.held_out import accuracy_change, gain, repair_held_out, split_runs
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.effects import CHANNELS, GYRO
from terrain.errors import ConfigError, DataError
from terrain.records import RunLog
from terrain.robots import load_robot
from terrain.simulation.planar.noise import load_noise, load_scatter
from terrain.simulation.planar.run import simulate_planar

HUSKY = load_robot("husky")
LONGER = {"wheel_radius_ratio": 0.03}


def twist(duration_s=30.0):
    """Forward, back and around, at several speeds."""
    time_s = np.arange(round(50 * duration_s)) / 50
    ahead = 0.5 * np.sin(0.5 * time_s) + 0.2 * np.sin(1.7 * time_s)
    return np.column_stack([ahead, np.zeros_like(ahead), 0.4 * np.sin(0.9 * time_s)])


def runs(n, effects):
    options = {"effects": effects, "scatter": load_scatter(), "noise": load_noise()}
    return [simulate_planar(HUSKY, twist(), i, run_id=f"r{i}", **options) for i in range(n)]


@pytest.fixture(scope="module")
def longer():
    return runs(7, LONGER)


def simulation(effects=None, scatter=True):
    return Simulation(HUSKY, effects=effects or {}, scatter=load_scatter()._asdict() if scatter else {})


def test_the_true_extension_leaves_noise_and_scatter(longer):
    found = gain(simulation(), simulation(LONGER), longer)
    ahead = found.channels["speed_x_mps"]
    assert not found.refused
    assert found.clusters == "runs"
    assert ahead.reduction.low > 0.5
    # what is left ahead: noise, and radii that scatter by 0.003 of 0.4 m/s
    assert ahead.rms_after < 0.006 < ahead.rms_before
    assert ahead.white_after < 1.3
    assert found.channels["turning_current_a"].reduction.refused


def test_no_gain_is_claimed_for_nothing_for_the_wrong_sign_or_where_nothing_is_hidden(longer):
    nothing = gain(simulation(), simulation(), longer)
    assert nothing.reduction == (0.0, 0.0, 0.0)
    assert nothing.refused
    wrong = gain(simulation(), simulation({"wheel_radius_ratio": -0.03}), longer)
    assert wrong.reduction.high < 0.0
    assert wrong.refused
    assert gain(simulation(), simulation(LONGER), runs(6, {})).refused


def test_without_scatter_the_gain_is_that_of_the_whitened_squares(longer):
    """Two routes: the form that has scatter integrated out, and plain sums over the channels."""
    found = gain(simulation(scatter=False), simulation(LONGER, scatter=False), longer)
    before, after = (
        sum(getattr(channel, key) ** 2 for channel in found.channels.values())
        for key in ("white_before", "white_after")
    )
    # channels have all the same rows here
    assert found.reduction.ratio == pytest.approx(1.0 - after / before, rel=1e-9)


def test_few_runs_are_cut_into_thirds_and_the_same_seed_gives_the_same_gain(longer):
    few = gain(simulation(), simulation(LONGER), longer[:2], seed=3)
    assert few.clusters == "thirds of runs"
    assert not few.refused
    assert as_json(few) == as_json(gain(simulation(), simulation(LONGER), longer[:2], seed=3))
    assert as_json(few)["ci"] != as_json(gain(simulation(), simulation(LONGER), longer[:2], seed=4))["ci"]


def test_a_gain_without_held_out_runs_or_of_another_robot_is_refused(longer):
    with pytest.raises(DataError, match="no run that was not used"):
        gain(simulation(), simulation(LONGER), [])
    with pytest.raises(ConfigError, match="'agrimaro', not of 'husky'"):
        gain(simulation(), Simulation(load_robot("agrimaro")), longer)


def test_the_interval_of_an_accuracy_is_over_runs():
    rng = np.random.default_rng(0)
    run_id = np.repeat([f"r{i}" for i in range(20)], 10)
    before = rng.random(200) < 0.6
    each = np.repeat(rng.random(20) < 0.5, 10)  # whole runs become correct
    change = accuracy_change(before, before | each, run_id, 0).change_ci
    gained = (before | each).mean() - before.mean()
    assert change[0] < gained < change[1]
    spread = np.array([(each & ~before)[run_id == name].mean() for name in np.unique(run_id)]).std()
    assert change[1] - change[0] == pytest.approx(2 * 1.96 * spread / np.sqrt(20), rel=0.2)


# -- Which runs are held out of a diagnosis, and which of them have the faults that were found in the others --


def test_every_terrain_is_held_out_in_proportion_and_the_seed_chooses_runs():
    runs = [RunLog(f"{name}{i}", "husky", {}, ((0.0, 1.0, name),)) for name in "ab" for i in range(8)]
    used, held = split_runs(runs, None, 0)
    assert sorted(run.terrains for run in held) == [("a",)] * 2 + [("b",)] * 2
    assert {run.run_id for run in used} | {run.run_id for run in held} == {run.run_id for run in runs}
    assert split_runs(runs, None, 0) == (used, held)
    assert any(split_runs(runs, None, seed)[1] != held for seed in range(1, 4))
    assert split_runs(runs[:5], None, 0) == (runs[:5], [])
    assert split_runs(runs, 0, 0) == (runs, [])
    with pytest.raises(DataError, match="--hold-out is 14 of 16"):
        split_runs(runs, 14, 0)


def test_a_fault_is_repaired_in_the_held_out_runs_that_have_it():
    robot = load_robot("husky")
    time_s = np.arange(1000) / 50
    twist = np.column_stack([0.5 * np.sin(0.6 * time_s), 0.0 * time_s, 0.5 * np.sin(0.9 * time_s)])
    right = signals_of(simulate_planar(robot, twist, 1, run_id="right"), robot)
    turned = Change(FaultKind.SIGN, Column.GYRO, -1.0)
    wrong = turned.applied(right)
    fault = Fault(turned, ("other",), "turned", "multiply")
    simulation, low_pass = Simulation(robot), low_pass_of([right])
    noise = dict.fromkeys(CHANNELS, 0.01)
    for given in (right, wrong):
        (fixed,) = repair_held_out([given], [fault], simulation, low_pass, noise)
        np.testing.assert_array_equal(fixed.measured, right.measured)
    unclear = Fault(turned._replace(factor=math.nan), ("other",), "?", "left out")
    (fixed,) = repair_held_out([right], [unclear], simulation, low_pass, noise)
    assert np.isnan(fixed.measured[:, CHANNELS.index(GYRO)]).all()
