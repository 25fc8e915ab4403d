"""Which runs are held out of a diagnosis, and which of them have the faults that were found in the others."""

import math

import numpy as np
import pytest

from terrain.discrepancy.faults import Change, Column, Fault, FaultKind
from terrain.discrepancy.held_out import repair_held_out, split_runs
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.effects import CHANNELS, GYRO
from terrain.errors import DataError
from terrain.records import RunLog
from terrain.robots import load_robot
from terrain.simulation.planar.run import simulate_planar


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
