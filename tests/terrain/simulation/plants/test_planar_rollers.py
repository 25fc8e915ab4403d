"""Robots on mecanum wheels, and tricycles: the laws of their kinematics, in the plant and by matrices."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.effects import vector_of
from terrain.errors import ConfigError
from terrain.kinematics.commands import wheel_motion
from terrain.kinematics.wheels import no_slip_twist, rolling_matrix
from terrain.robots import MecanumRobot, TricycleRobot, load_robot
from terrain.simulation.plants.planar import Ground, make_planar, move

CART = MecanumRobot("cart", 0.05, 0.3, 0.4, 20.0)
TRUCK = TricycleRobot("truck", 0.1, 0.7, 1.4, 300.0, com_ahead_m=0.7, yaw_inertia_kgm2=100.0)
STIFF = Ground(slip_ratio=1e-4, rolling_ratio=0.0, scrub_ratio=0.0)
DT = 0.01


def driven(robot, wheels, steer=None, ground=STIFF, **effects):
    """Return the twist at the end of two seconds at the same wheel speeds."""
    n = 200
    still = np.zeros(n)
    angles = np.zeros((n, len(robot.wheels))) if steer is None else np.tile([steer, 0.0], (n, 1))
    inputs = np.tile(np.asarray(wheels, float), (n, 1)), angles, still, still
    truth = move(make_planar(robot, ground), vector_of(effects), DT, *inputs)[-1]
    return np.array([truth["speed_x_mps"], truth["speed_y_mps"], truth["yaw_rate_radps"]])


def matrix(robot):
    return rolling_matrix(robot.wheel_positions_m, robot.wheel_directions_rad, robot.roller_angles_rad)


def test_mecanum_wheels_have_the_matrix_of_the_textbook():
    """Muir and Neuman: with a + b, the sum of half lengths, the rows are (1, -+1, -+(a + b))."""
    sum_m = 0.35
    expected = [[1, -1, -sum_m], [1, 1, sum_m], [1, 1, -sum_m], [1, -1, sum_m]]
    assert np.allclose(matrix(CART), expected)
    assert np.isclose(CART.wheel_distance_m, sum_m)


@pytest.mark.parametrize("angle", [0.4, np.pi / 4, 1.2])
def test_wheel_speeds_of_a_twist_give_it_back(angle):
    robot, twists = replace(CART, roller_rad=angle), np.random.default_rng(0).normal(size=(9, 3))
    speeds = wheel_motion(robot, twists, 0.02).wheel_speed_mps
    place = robot.wheel_positions_m, robot.wheel_directions_rad
    back, residual = no_slip_twist(*place, speeds, True, robot.roller_angles_rad)
    assert np.allclose(back, twists)
    assert np.allclose(residual, 0.0)
    fighting = np.array([1.0, 1.0, -1.0, -1.0])
    against, contradiction = no_slip_twist(*place, fighting, True, robot.roller_angles_rad)
    assert np.allclose(against, 0.0)  # wheels that turn against each other
    assert contradiction > 1.0


@pytest.mark.parametrize("twist", [(0.3, 0.0, 0.0), (0.0, 0.2, 0.0), (0.1, -0.2, 0.5)])
def test_the_plant_drives_what_its_wheels_roll(twist):
    assert np.allclose(driven(CART, matrix(CART) @ twist), twist, atol=2e-4)


def test_rollers_that_resist_brake_sideways_and_not_ahead():
    """Straight ahead mecanum rollers stand still; sideways they turn at sqrt(2) of the speed."""
    ground = Ground(slip_ratio=0.3, rolling_ratio=0.0, roller_ratio=0.3)
    ahead, left = (driven(CART, matrix(CART) @ twist, ground=ground) for twist in ((0.3, 0, 0), (0, 0.3, 0)))
    assert np.allclose(ahead, [0.3, 0.0, 0.0], atol=1e-3)
    assert 0.1 < left[1] < 0.28


def test_distance_of_the_wheels_scales_the_turn_alone():
    wheels = matrix(CART) @ (0.1, 0.1, 0.5)
    moved = driven(CART, wheels, wheel_distance_ratio=0.05)
    assert np.allclose(moved, [0.1, 0.1, 0.5 / 1.05], atol=5e-4)


def test_four_wheels_share_the_load_about_the_centre_of_mass():
    planar = make_planar(load_robot("omnirobot"), STIFF)
    load, place = planar.params[0]["wheel_load_ratio"], planar.params[0]["place_m"]
    assert np.allclose(load.sum(), 1.0)
    assert np.allclose(load @ place, 0.0)


@pytest.mark.parametrize("steer", [-0.8, 0.0, 0.3, 1.1])
def test_a_tricycle_drives_by_its_front_wheel(steer):
    """``v = u cos d``, ``w = u sin d / L``, slowly, so that no axle yields."""
    u = 0.02
    v, _, w = driven(TRUCK, [u, np.nan], steer)
    assert np.isclose(v, u * np.cos(steer), atol=1e-4)
    assert np.isclose(w, u * np.sin(steer) / 1.4, atol=1e-4)
    back = wheel_motion(TRUCK, np.array([[v, 0.0, w]]), 0.02)
    if abs(steer) < TRUCK.steering_max_rad:
        assert np.isclose(back.wheel_speed_mps[0, 0], u, atol=1e-4)
        assert np.isclose(back.steer_rad[0, 0], steer, atol=1e-2)


def test_gain_offset_and_wheelbase_act_as_they_say():
    u, steer = 0.02, 0.4
    effects = {"steering_gain_ratio": 0.2, "steering_offset_front_rad": -0.05, "wheelbase_ratio": 0.1}
    v, _, w = driven(TRUCK, [u, u], steer, **effects)
    angle = 1.2 * steer - 0.05
    assert np.allclose([v, w], [u * np.cos(angle), u * np.sin(angle) / 1.54], atol=1e-4)


def test_rollers_across_or_along_are_refused():
    with pytest.raises(ConfigError, match=r"a\.yaml: roller_rad is 2, between 0 and pi/2 is required"):
        replace(CART, roller_rad=2.0).check_geometry("a.yaml")
