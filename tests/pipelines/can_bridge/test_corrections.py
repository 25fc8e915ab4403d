"""What is added to the theoretical rates, where solutions, starts and steering angles differ."""

import numpy as np
import pytest

from pipelines.can_bridge.corrections import BridgeState, LowLevelKinematics, Theory, corrections
from terrain.records import Command
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
THEORY = Theory(np.full(3, 5.0), np.full(3, 0.2))


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 2, 3])
@pytest.mark.parametrize("measured", [-1, 0, 1, 4])
def test_the_velocity_of_the_wheel_is_the_one_that_is_commanded(turns, measured):
    """Two routes: the correction of the other solution adds up to the same velocity of the wheel's centre."""
    commanded = Command(
        (-1.0) ** turns * np.array([4.0, 5.0, 6.5]), THEORY.steer_rad + turns * np.pi, None, {}
    )
    angle_rad = THEORY.steer_rad + measured * np.pi + 0.1
    added, state = corrections(commanded, THEORY, angle_rad)
    assert state == BridgeState.ACTIVE
    low_level = (-1.0) ** measured * THEORY.wheel_radps
    along = np.cos(commanded.steer_rad) * commanded.wheel_radps
    assert np.cos(angle_rad - 0.1) * (low_level + added) == pytest.approx(along)


@pytest.mark.parametrize("angle_rad", [0.8, -0.4, np.pi / 2, np.pi + 0.8, np.nan, np.inf])
def test_elsewhere_nothing_is_added(angle_rad):
    command = Command(np.full(3, 4.0), THEORY.steer_rad, None, {})
    with np.errstate(invalid="ignore"):
        added, state = corrections(command, THEORY, np.array([0.2, angle_rad, 0.2]))
    assert state == BridgeState.STEERING
    assert not added.any()


def test_kinematics_begins_where_the_steering_is():
    """A crab from steering that is there already: the theoretical rate at once, and nothing is steered."""
    heading_rad = 1.3
    twist = 0.5 * np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
    kinematics = LowLevelKinematics(ROBOT)
    kinematics.start(np.full(3, heading_rad))
    theory = kinematics.step(twist, 0.02)
    assert theory.wheel_radps == pytest.approx(np.full(3, 0.5 / ROBOT.wheel_radius_m))
    assert theory.steer_rad == pytest.approx(np.full(3, heading_rad))
