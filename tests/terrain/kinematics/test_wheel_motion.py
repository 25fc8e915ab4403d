import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.kinematics import omni
from terrain.kinematics.swerve import forward
from terrain.kinematics.wheel_motion import wheel_motion
from terrain.robots import load_robot

AGRIMARO, HUSKY, ROBOTINO = (load_robot(name) for name in ("agrimaro", "husky", "robotino"))


@pytest.mark.parametrize("robot", [AGRIMARO, HUSKY], ids=lambda robot: robot.name)
def test_wheels_that_follow_their_commands_drive_the_twist(robot):
    desired = np.tile([0.5, 0.0, 0.3], (100, 1))
    motion = wheel_motion(robot, desired, 0.02)
    np.testing.assert_allclose(motion.wheel_speed_mps, motion.wheel_radps * robot.wheel_radius_m)
    rates, steer = motion.wheel_radps[-1], motion.steer_rad[-1]
    twist, _ = forward(robot.wheel_positions_m, robot.wheel_radius_m, rates, steer)
    np.testing.assert_allclose(twist, desired[-1], atol=1e-9)


@pytest.mark.parametrize("robot", [AGRIMARO, HUSKY, ROBOTINO], ids=lambda robot: robot.name)
def test_no_wheel_turns_faster_than_its_motor_can(robot):
    motion = wheel_motion(robot, np.tile([50.0, 0.0, 9.0], (50, 1)), 0.02)
    assert np.abs(motion.wheel_radps).max() <= robot.motors.speed_max_radps * (1 + 1e-12)


def test_a_robot_without_motors_is_named():
    with pytest.raises(ConfigError, match=r"robot agrimaro: .* no section 'motors'"):
        wheel_motion(AGRIMARO.without("motors"), np.zeros((2, 3)), 0.02)


def test_a_skid_steer_robot_without_motors_has_no_fastest_speed():
    motion = wheel_motion(HUSKY.without("motors"), np.array([[50.0, 0.0, 9.0]]), 0.02)
    turn_mps = 9.0 * HUSKY.track_m / 2
    np.testing.assert_allclose(motion.wheel_speed_mps, [[50.0 - turn_mps, 50.0 + turn_mps]])


def test_an_omni_robot_keeps_its_direction_where_a_wheel_is_at_its_limit():
    desired = np.array([[0.1, 0.05, 0.2], [5.0, 2.5, 10.0]])
    motion = wheel_motion(ROBOTINO, desired, 0.02)
    back, _ = omni.forward(ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad, motion.wheel_speed_mps)
    np.testing.assert_allclose(back[0], desired[0], atol=1e-12)
    np.testing.assert_allclose(back[1] / back[1, 0], desired[1] / desired[1, 0], rtol=1e-9)
    np.testing.assert_allclose(motion.twist, back, atol=1e-12)
