"""A correction keeps the velocity that is commanded, and is added only where the steering was computed."""

import numpy as np
import pytest

from terrain.control.wheel_corrections import BridgeState, LastSample, corrections
from terrain.records import Command, Reading

RADPS, STEER_RAD = np.full(3, 5.0), np.full(3, 0.2)


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 2, 3])
@pytest.mark.parametrize("measured", [-1, 0, 1, 4])
def test_the_velocity_of_the_wheel_is_the_one_that_is_commanded(turns, measured):
    """Two routes: the correction of the other solution adds up to the same velocity of the wheel's centre."""
    commanded = Command((-1.0) ** turns * np.array([4.0, 5.0, 6.5]), STEER_RAD + turns * np.pi, None, {})
    angle_rad = STEER_RAD + measured * np.pi + 0.1
    added, state = corrections(commanded, RADPS, STEER_RAD, angle_rad)
    assert state == BridgeState.ACTIVE
    low_level = (-1.0) ** measured * RADPS
    along = np.cos(commanded.steer_rad) * commanded.wheel_radps
    assert np.cos(angle_rad - 0.1) * (low_level + added) == pytest.approx(along)


def test_elsewhere_nothing_is_added():
    command = Command(np.full(3, 4.0), STEER_RAD, None, {})
    for angle_rad in (0.8, -0.4, np.pi / 2, np.pi + 0.8, np.nan, np.inf):
        with np.errstate(invalid="ignore"):
            added, state = corrections(command, RADPS, STEER_RAD, np.array([0.2, angle_rad, 0.2]))
        assert state == BridgeState.STEERING
        assert not added.any()


@pytest.mark.parametrize(
    ("now_s", "read_s", "fresh"),
    [(5.05, 9.05, True), (5.15, 9.05, False), (5.05, 9.15, False), (4.95, 9.0, True), (4.8, 9.0, False)],
)
def test_a_sample_is_fresh_on_both_clocks_and_not_of_the_future(now_s, read_s, fresh):
    last = LastSample(0.1, BridgeState.NO_TWIST, BridgeState.STALE_TWIST)
    assert last.state(5.0, 9.0) == BridgeState.NO_TWIST
    assert not last.take(Reading(np.array([5.0]), np.array([[1.0, np.nan, 1.0]])), 9.0)
    assert last.take(Reading(np.array([5.0]), np.ones((1, 3))), 9.0)
    assert last.state(now_s, read_s) == (BridgeState.ACTIVE if fresh else BridgeState.STALE_TWIST)
