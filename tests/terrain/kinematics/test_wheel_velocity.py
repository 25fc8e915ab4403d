import numpy as np
from numba import njit

from terrain.kinematics.swerve import wheel_velocities
from terrain.kinematics.wheel_velocity import in_wheel_frame, point_velocity, wheel_frame_velocities
from terrain.robots import load_robot

POSITIONS = load_robot("agrimaro").wheel_positions_m
TWIST = np.random.default_rng(0).normal(size=(50, 3))
STEER = np.random.default_rng(1).uniform(-4.0, 4.0, (50, 3))


@njit
def compiled(v_x, v_y, turn, x, y, steer):
    forward, left = point_velocity(v_x, v_y, turn, x, y)
    return in_wheel_frame(forward, left, np.cos(steer), np.sin(steer))


def test_numbers_arrays_and_compiled_code_agree():
    along, across = wheel_frame_velocities(TWIST, POSITIONS, STEER)
    for k in range(len(TWIST)):
        for i, (x, y) in enumerate(POSITIONS):
            one = compiled(*TWIST[k], x, y, STEER[k, i])
            np.testing.assert_allclose(one, (along[k, i], across[k, i]), rtol=0, atol=1e-14)


def test_a_wheel_frame_turns_the_velocity_and_keeps_its_size():
    velocity = wheel_velocities(POSITIONS, TWIST)
    along, across = wheel_frame_velocities(TWIST, POSITIONS, STEER)
    turned = (along + 1j * across) * np.exp(1j * STEER)
    np.testing.assert_allclose(turned, velocity[..., 0] + 1j * velocity[..., 1], atol=1e-12)


def test_the_velocity_of_a_camera_leads_back_to_that_of_the_origin():
    seen = point_velocity(1.0, -0.3, 0.7, 0.6, -0.2)
    np.testing.assert_allclose(point_velocity(*seen, 0.7, -0.6, 0.2), (1.0, -0.3), rtol=1e-14)
