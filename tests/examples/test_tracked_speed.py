"""Compensation of slip: its algebra and limits; with the observer in the loop it is judged in the rows of Tazzari."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "papers"))

from tracked_speed import TrackSpeedSettings, TrackSpeedStatus, check_track_speed, track_speed_step

from terrain.errors import ConfigError
from terrain.robots import load_robot

ROBOT = load_robot("orchard_ugv")
D, DT_S = ROBOT.half_track_m, 0.02
SETTINGS = TrackSpeedSettings()
ONES, NONE = np.ones(2), np.zeros(2)


def command(eta, std=NONE, forward=0.5, turn=0.1, used=None, dt_s=DT_S, settings=SETTINGS):
    used = np.array(eta if used is None else used)
    return track_speed_step(ROBOT, settings, used, (forward, turn), np.array(eta), std, dt_s)


def motion(left, right, left_eta, right_eta):
    return (right_eta * right + left_eta * left) / 2, (right_eta * right - left_eta * left) / (2 * D)


@pytest.mark.parametrize("speeds", [(0.5, 0.1), (-0.5, 0.1), (0.0, 0.4), (0.0, 0.0)])
def test_known_efficiencies_give_the_desired_motion(speeds):
    left, right, _, status = command([1.2, 0.7], forward=speeds[0], turn=speeds[1])
    assert motion(left, right, 1.2, 0.7) == pytest.approx(speeds)
    assert status == TrackSpeedStatus.OK


def test_too_fast_a_motion_keeps_its_curvature():
    left, right, _, status = command([0.9, 0.6], forward=2.0, turn=0.8)
    forward, turn = motion(left, right, 0.9, 0.6)
    assert turn / forward == pytest.approx(0.4)
    assert max(left, right) == pytest.approx(TrackSpeedSettings().track_speed_max_mps)
    assert status == TrackSpeedStatus.SATURATED


def test_an_estimate_is_used_as_far_as_it_is_known():
    settled = {"dt_s": 0.5, "used": [0.8, 0.8]}
    slow = replace(SETTINGS, eta_rate_ps=10.0)
    used = [command([0.8, 0.8], np.full(2, std), settings=slow, **settled).eta[0] for std in (0.0, 0.2, 1e3)]
    np.testing.assert_allclose(used, [0.8, 0.9, 1.0], atol=1e-6)
    unknown = command([np.nan, 0.8], settings=slow, **settled)
    assert unknown.eta[0] == 1.0
    assert unknown.status == TrackSpeedStatus.UNESTIMATED


def test_limits_of_the_compensation_and_of_its_settings():
    floored = command([0.1, 1.0], used=[0.3, 1.0])
    assert (floored.eta[0], floored.status) == (0.3, TrackSpeedStatus.FLOORED)
    np.testing.assert_allclose(command([0.6, 1.0], used=ONES).eta, [1 - 0.2 * DT_S, 1.0])
    for name, value, message in (
        ("eta_rate_ps", 0.0, "eta_rate_ps is 0"),
        ("eta_floor_ratio", 1.5, "at most 1"),
    ):
        with pytest.raises(ConfigError, match=message):
            check_track_speed(replace(SETTINGS, **{name: value}))


def test_whatever_comes_in_the_speeds_are_finite_and_within_limits():
    rng, strange = np.random.default_rng(0), [math.nan, math.inf, -math.inf, 0.0, -1.0, 1e308, 0.5, 1e-320]
    for _ in range(1000):
        forward, turn, dt_s = rng.choice(strange, 3)
        found = command(
            rng.choice(strange, 2), rng.choice(strange, 2), forward, turn, rng.choice(strange, 2), dt_s
        )
        assert max(abs(found.left_mps), abs(found.right_mps)) <= 1.5 * (1 + 1e-12)
        assert np.isfinite(found.eta).all() or found.status == TrackSpeedStatus.BAD_INPUT
