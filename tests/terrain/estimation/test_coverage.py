"""NEES by group and coverage of slip: right for errors of the stated variance, and for nothing else."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from terrain.estimation.coverage import nees_by_group, slip_coverage
from terrain.estimation.estimate import estimate_run
from terrain.estimation.reference import lagged_slip_at
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

ROBOT = load_robot("agrimaro")
VIO15 = [
    *("position", "yaw", "speed", "yaw_rate", "accel", "steer", "gyro_bias", "slip_speed"),
    "imu_yaw_offset",
]


@cache
def estimate():
    return estimate_run(simulate_run(ROBOT, "grass", "survey", 31, duration_s=60.0), ROBOT, "vio15")


def true_slip():
    return lagged_slip_at(estimate().run, ROBOT, estimate().slip.time_s)


@pytest.mark.parametrize(("factor", "coverage"), [(0.5, 1.0), (1.0, 0.95), (1.96, 0.683)])
def test_errors_of_a_known_spread_are_covered_as_often_as_their_distribution_says(factor, coverage):
    std = np.full(true_slip().shape, 0.02)
    error = factor * std * np.random.default_rng(32).standard_normal(std.shape)
    slip = replace(estimate().slip, slip_ratio=true_slip() + error, slip_std=std)
    known = np.isfinite(error + true_slip()).sum()
    found = slip_coverage(replace(estimate(), slip=slip))
    assert found == pytest.approx(coverage, abs=4 * np.sqrt(coverage * (1 - coverage) / known) + 1e-3)


def test_slip_that_is_not_known_is_not_counted():
    slip = estimate().slip
    ratio = np.array(slip.slip_ratio)
    ratio[::2] = np.nan
    some = slip_coverage(replace(estimate(), slip=replace(slip, slip_ratio=ratio)))
    assert some == pytest.approx(slip_coverage(estimate()), abs=0.02)
    none = replace(slip, slip_ratio=np.full(ratio.shape, np.nan))
    assert np.isnan(slip_coverage(replace(estimate(), slip=none)))
    run = estimate().run
    measured = replace(run, streams={name: s for name, s in run.streams.items() if name != "truth"})
    assert np.isnan(slip_coverage(replace(estimate(), run=measured)))
    assert nees_by_group(replace(estimate(), truth=None)) == {}


@pytest.mark.parametrize("group", VIO15)
def test_an_error_of_one_group_is_seen_in_that_group_alone(group):
    """A truth that is off by another two standard deviations, in each of its states."""
    track, truth = estimate().track, np.array(estimate().truth)
    states = [
        i for i, state in enumerate(track.states) if state.startswith(group) and "accel_bias" not in state
    ]
    if group == "yaw":
        states = [track.states.index("yaw_rad")]
    root = np.linalg.cholesky(track.cov[:, states][:, :, states])
    truth[:, states] = track.mean[:, states] + 2.0 * (root @ np.ones(len(states)))
    before, after = nees_by_group(estimate()), nees_by_group(replace(estimate(), truth=truth))
    assert list(before) == VIO15
    assert after.pop(group) == pytest.approx(4.0)
    assert after == {name: value for name, value in before.items() if name != group}


def test_a_larger_variance_lowers_nees_and_raises_coverage():
    wide = replace(estimate().track, cov=4.0 * estimate().track.cov)
    found = nees_by_group(replace(estimate(), track=wide))
    assert found == pytest.approx({name: value / 4.0 for name, value in nees_by_group(estimate()).items()})
    slip = replace(estimate().slip, slip_std=2.0 * estimate().slip.slip_std)
    assert slip_coverage(replace(estimate(), slip=slip)) >= slip_coverage(estimate())
