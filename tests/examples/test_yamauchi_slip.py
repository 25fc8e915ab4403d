"""Slip of a tracked robot from runs with poses: hidden numbers come back; regression and plain algebra."""

import math

import numpy as np
import pytest
from scipy import stats
from yamauchi_slip import (
    fit_runs,
    fit_turning,
    identify_slip_model,
    local_polynomial,
    slip_samples,
)

from terrain.errors import DataError
from terrain.estimation.models.slip_model import PARAMETERS
from terrain.identify import Parameter, identify
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import LEVEL, PrescribedSlip, Slope
from terrain.simulation.run import simulate
from terrain.terramechanics.soil import load_soil

ROBOT = load_robot("patako")
D = ROBOT.half_track_m


def turns(ground, seed, rates_dps=(10, 20, 30), slope=LEVEL, speed_mps=0.05):
    """Turns by about a quarter, left and right."""
    runs = []
    for k, rate in enumerate(rates_dps):
        w = math.radians(rate) * (1 if (k + seed) % 2 == 0 else -1)
        n = int(50 * (1.0 + math.pi / 2 / abs(w) / 0.65))
        belts = np.tile([speed_mps - D * w, speed_mps + D * w], (n, 1))
        runs.append(simulate(ROBOT, belts, ground, seed * 100 + k, slope=slope))
    return runs


def straights(ground, seed, slopes_rad=(0.0, 0.1, 0.2, 0.3)):
    return [
        simulate(ROBOT, np.full((400, 2), 0.05), ground, seed * 100 + k, slope=Slope(slope, up))
        for k, (slope, up) in enumerate((s, u) for s in slopes_rad for u in (0.0, math.pi / 2))
    ]


@pytest.mark.parametrize("n", [0.3, 1.3])
def test_the_exponent_is_found_within_two_hundredths(n):
    ground = PrescribedSlip(turning_loss_ratio=0.36, turning_exponent=n)
    runs = [run for seed in range(2) for run in turns(ground, 10 * seed + 1, (10, 16, 20, 30))]
    found = fit_turning(slip_samples(runs, ROBOT).turning, D)
    assert found.exponent == pytest.approx(n, abs=0.02)
    assert abs(found.exponent - n) < 4 * found.exponent_std + 0.005  # smoothing sees arcs 0.3 % too slow
    assert found.exponent_std < 0.02


def test_all_numbers_of_given_slip_come_back_within_their_intervals():
    ground = PrescribedSlip(1.0, 1.0, 0.08, 0.4, 0.6, 0.35, 0.8)
    runs = straights(ground, 1)
    for k, slope in enumerate((0.0, 0.09, 0.26)):
        runs += turns(ground, 20 + k, (10, 16, 20), Slope(slope, math.pi / 2 * (-1) ** k))
    found = identify_slip_model(runs, ROBOT, drift=False)
    assert found.notes == ()
    std = np.sqrt(np.diag(found.model.covariance))
    hidden = {"compaction_slip_ratio": 0.08, "grade_slip_ratio": 0.4, "side_slip_ratio": 0.6}
    for name, true in (hidden | {"angle_roll_rad": -0.6}).items():
        place = PARAMETERS.index(name)
        assert abs(found.model.vector[place] - true) < 3 * std[place] + 0.01
    wider = identify_slip_model(runs, ROBOT).model  # terms that nothing in these runs asks for stay small
    for name in ("turn_grade_m", "turn_side_m", "turn_shift_m"):
        assert abs(wider.vector[PARAMETERS.index(name)]) < 0.05
    assert found.model.track_ratio == pytest.approx(1 / (0.65 * 0.92), rel=0.02)
    assert found.straight is not None
    assert found.straight.r2_ratio > 0.8
    assert found.straight.n_runs == 8


def test_what_was_not_driven_is_named_and_stays_wide():
    ground = load_soil("toyoura_sand")
    found = identify_slip_model(straights(ground, 3, (0.0, 0.1)), ROBOT)
    assert found.turning is None
    assert found.angle is None
    assert len(found.notes) == 3
    assert found.model.covariance[0, 0] == pytest.approx(0.09)
    with pytest.raises(DataError, match="poses of a moving robot"):
        identify_slip_model([], ROBOT)


def test_the_fit_is_least_squares_with_the_sandwich_of_runs():
    rng, run = np.random.default_rng(0), np.repeat(np.arange(15), 20)
    x = np.column_stack([np.ones(300), np.repeat(rng.normal(size=15), 20)])
    y = x @ [0.5, -2.0] + 0.3 * np.repeat(rng.normal(size=15), 20) + 0.1 * rng.normal(size=300)
    found = fit_runs(x, y, run, ("intercept", "slope"))
    assert found.coefficient == pytest.approx(np.linalg.lstsq(x, y, rcond=None)[0])
    assert found.p_value == pytest.approx(2 * stats.t.sf(np.abs(found.coefficient / found.std), 14))
    assert found.residual_std == pytest.approx(0.1, rel=0.15)
    other = identify(lambda p: x @ p - y, [Parameter("intercept", 0.0), Parameter("slope", 0.0)], run)
    assert found.interval == pytest.approx(other.interval, rel=1e-6)


def test_parabolas_are_numpys():
    rng = np.random.default_rng(2)
    time_s = np.sort(rng.uniform(0, 2, 200))
    values = rng.normal(size=(200, 2))
    values[rng.random((200, 2)) < 0.1] = np.nan
    found = local_polynomial(time_s, values, np.array([0.05, 1.0, 1.3, 1.95]), 0.3)
    assert np.isnan(found[[0, 3]]).all()
    for row, at in ((1, 1.0), (2, 1.3)):
        for column in range(2):
            own = (np.abs(time_s - at) <= 0.3) & np.isfinite(values[:, column])
            _, slope, value = np.polyfit(time_s[own] - at, values[own, column], 2)
            assert found[row, column] == pytest.approx([value, slope])
