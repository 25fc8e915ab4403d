"""Regimes: ranges between commanded speeds, and manoeuvres by gyroscope or by wheels."""

import numpy as np
import pytest

from terrain.classify.regimes import (
    EDGE_STEP_MPS,
    MAX_SPEEDS,
    MIN_WIDTH_MPS,
    Manoeuvre,
    Regimes,
    learn_regimes,
    manoeuvres,
)

NAN = np.nan


@pytest.mark.parametrize("speeds", [(0.2, 0.4, 0.6, 0.8), (0.24, 0.39, 0.63, 0.79), (0.5,), (0.3, 2.0)])
def test_a_commanded_speed_is_not_cut_in_two(speeds):
    rng = np.random.default_rng(0)
    driven = np.concatenate([speed + rng.normal(0, 0.01, 200) for speed in speeds])
    regimes = learn_regimes(driven)
    number = regimes.numbers(driven, np.zeros(len(driven)), np.zeros(len(driven)))
    each = number.reshape(len(speeds), 200)
    assert all(np.mean(row == np.bincount(row).argmax()) > 0.98 for row in each)
    edges = np.array(regimes.edges_mps)
    assert len(edges) <= MAX_SPEEDS + 1
    assert (np.diff(edges) >= EDGE_STEP_MPS - 1e-9).all()
    assert len(edges) == 2 or np.ptp(driven) > MIN_WIDTH_MPS


def test_windows_beyond_the_outer_edges_are_in_the_range_beside():
    regimes = Regimes((0.2, 0.4, 0.6))
    found = regimes.numbers(np.array([0.0, 0.3, 0.4, 9.0]), np.zeros(4), np.zeros(4))
    assert found.tolist() == [0, 0, 3, 3]


def test_robots_that_stand_have_a_regime():
    assert learn_regimes(np.zeros(5)).edges_mps == (0.0, EDGE_STEP_MPS)


@pytest.mark.parametrize(
    ("speed", "yaw", "ratio", "expected"),
    [
        (0.5, 0.0, 0.0, Manoeuvre.STRAIGHT),
        (0.5, 0.3, 0.2, Manoeuvre.CURVE),
        (0.3, 0.05, 1.0, Manoeuvre.SPIN),
        (0.5, NAN, 0.05, Manoeuvre.STRAIGHT),
        (0.5, NAN, 0.4, Manoeuvre.CURVE),
        (0.1, 1.0, NAN, Manoeuvre.SPIN),
        (0.5, 1.0, NAN, Manoeuvre.CURVE),
        (0.5, NAN, NAN, Manoeuvre.STRAIGHT),
    ],
)
def test_what_a_robot_does(speed, yaw, ratio, expected):
    assert manoeuvres(*(np.array([value]) for value in (speed, yaw, ratio)))[0] == expected
