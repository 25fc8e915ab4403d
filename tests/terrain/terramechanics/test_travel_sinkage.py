"""Sinkage by travel: limits, symmetry and order."""

from __future__ import annotations

import numpy as np
import pytest

from terrain.terramechanics.travel_sinkage import TRAVEL, travel_sinkage

START = np.array([value for value, _ in TRAVEL.values()])
V = np.array([0.01])


def depth(wheel_mps, angle_rad, parameters=START):
    return float(travel_sinkage(parameters, np.array([wheel_mps]), V, np.array([angle_rad]), 0.058)[0])


def test_a_wheel_that_rolls_straight_stands_at_its_rolling_depth():
    assert depth(0.01, 0.0) == pytest.approx(TRAVEL["rolling_m"][0])


def test_a_locked_wheel_dragged_along_its_axle_sinks_to_its_axle():
    assert depth(0.0, np.pi / 2) == pytest.approx(0.058)


@pytest.mark.parametrize("wheel_mps", [0.0, 0.01, 0.05])
def test_the_sign_of_the_angle_does_not_matter_and_more_of_it_sinks_deeper(wheel_mps):
    assert depth(wheel_mps, 0.6) == depth(wheel_mps, -0.6)
    depths = [depth(wheel_mps, angle) for angle in np.linspace(0.2, 1.5, 9)]
    assert (np.diff(depths) > 0.0).all()


def test_slip_and_skid_sink_deeper():
    assert depth(0.0, 0.0) > depth(0.005, 0.0) > depth(0.01, 0.0) < depth(0.02, 0.0) < depth(0.1, 0.0)
