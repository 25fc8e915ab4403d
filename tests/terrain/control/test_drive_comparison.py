"""Controllers compared seed by seed, and the searches that need drives."""

import math

import numpy as np
import pytest

from terrain.control.drive_comparison import (
    LEAST_RAMP_MPS2,
    Comparison,
    Drive,
    matching_ramp,
    steepest_grade,
)
from terrain.records import RunLog, Stream


def compared(scenario="starts", **values):
    """Controllers with the values of one metric at each seed."""
    return Comparison(scenario, {name: [{key: v} for v in each] for name, (key, each) in values.items()})


def test_a_difference_is_taken_seed_by_seed():
    plain, gain = np.array([1.0, 2.0, 3.0, 4.0]), np.array([-0.19, -0.21, -0.2, -0.2])
    both = compared(plain=("slip_peak", plain), fallback=("slip_peak", plain + gain))
    found = both.difference("fallback", "plain", "slip_peak")
    assert found.mean == pytest.approx(-0.08)
    assert found.is_significant
    half = 3.182 * gain.std(ddof=1) / 2  # Student's with three degrees of freedom
    assert found.high - found.low == pytest.approx(2 * half / plain.mean(), rel=1e-3)
    without = plain + gain + [math.nan, 0.0, 0.0, 0.0]
    found = compared(plain=("slip_peak", plain), fallback=("slip_peak", without))
    assert found.difference("fallback", "plain", "slip_peak").mean == pytest.approx(gain[1:].mean() / 3.0)
    one = compared(plain=("slip_peak", [1.0]), fallback=("slip_peak", [0.5]))
    assert not one.difference("fallback", "plain", "slip_peak").is_significant


def test_only_controllers_that_use_the_terrain_adapt_to_it():
    names = ("plain", "true_terrain", "true_terrain+track")
    both = compared("course", **{name: ("adapt_s", [1.0, 2.0]) for name in names})
    assert [both.value(name, "adapt_s").mean for name in names] == [None, 1.5, 1.5]
    assert both.difference("true_terrain", "plain", "adapt_s") is None
    assert both.shown == ["adapt_s"]
    assert compared(true_terrain=("adapt_s", [1.0, 2.0])).shown == []


def test_a_classifier_that_was_hardly_believed_is_known():
    both = compared(classified=("believed_ratio", [0.05, 0.1]), true_terrain=("believed_ratio", [0.0, 0.0]))
    assert [both.is_hardly_believed(name) for name in both.rows] == [True, False]
    assert not compared(classified=("believed_ratio", [0.2, 0.3])).is_hardly_believed("classified")


def test_the_ramp_travels_as_far_as_the_first_reference():
    def drives(distance_m):
        return [Drive({"distance_m": distance_m}, None, None)]

    given = {"plain": drives(9.0), "fallback": drives(2.0), "true_terrain+track": drives(3.0)}
    found = matching_ramp(given, lambda ramp_mps2: drives(10.0 * ramp_mps2), "straight", 1.0)
    assert found == pytest.approx(0.3, rel=0.02)
    assert matching_ramp({"plain": drives(1.0)}, None, "straight", 1.0) is None
    none = matching_ramp(given, lambda ramp_mps2: drives(99.0), "straight", math.inf)
    assert none == pytest.approx(LEAST_RAMP_MPS2, rel=0.05)


@pytest.mark.parametrize("true_deg", [-3.0, 0.2, 17.4])
def test_the_steepest_grade_is_that_at_which_climbing_ends(true_deg):
    def drive(grade_deg):
        speed = 0.5 if grade_deg < true_deg else 0.0
        truth = Stream(np.arange(200) / 100, np.full((200, 1), speed), ("speed_x_mps",))
        return RunLog("drive", "agrimaro", {"truth": truth}, ((0.0, 2.0, "grass"),))

    assert steepest_grade(drive) == pytest.approx(true_deg, abs=0.1)
