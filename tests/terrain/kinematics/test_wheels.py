"""Wheels of every drive: one direction undoes the other, geometry by other routes, the source's equations."""

import gzip
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import block_diag

from terrain.errors import ConfigError
from terrain.kernels import njit
from terrain.kinematics.commands import inverse
from terrain.kinematics.wheels import (
    in_wheel_frame,
    no_slip_twist,
    point_velocity,
    rolling_matrix,
    wheel_frame_velocities,
    wheel_velocities,
)
from terrain.robots import load_robot

ROBOT, ROBOTINO = load_robot("agrimaro"), load_robot("robotino")
WHEELS_M, RADIUS_M = ROBOT.wheel_positions_m, ROBOT.wheel_radius_m
PLACE = ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad
TWIST = np.random.default_rng(0).normal(size=(50, 3))
STEER = np.random.default_rng(1).uniform(-4.0, 4.0, (50, 3))


def circle(distance_m, angle_rad):
    """Positions and directions of wheels on a circle that all turn the robot to the left."""
    return distance_m * np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1), angle_rad + np.pi / 2


FOUR = circle(0.3, np.radians([45.0, 135.0, 225.0, 315.0]))
twists = arrays(float, (5, 3), elements=st.floats(-3.0, 3.0))


def by_rates(wheel, steer, positions_m=WHEELS_M):
    return no_slip_twist(positions_m, steer, RADIUS_M * np.asarray(wheel))


@njit
def compiled(v_x, v_y, turn, x, y, steer):
    forward, left = point_velocity(v_x, v_y, turn, x, y)
    return in_wheel_frame(forward, left, np.cos(steer), np.sin(steer))


@given(twists, st.sampled_from([PLACE, FOUR]))
def test_the_twist_of_omni_wheels_undoes_their_speeds(twist, place):
    found, residual_mps = no_slip_twist(*place, twist @ rolling_matrix(*place).T, True)
    np.testing.assert_allclose(found, twist, atol=1e-12)
    np.testing.assert_allclose(residual_mps, 0.0, atol=1e-12)


@given(twists, st.sampled_from([PLACE, (WHEELS_M, np.array([0.3, -2.0, 9.0]))]))
def test_speeds_are_those_of_points_of_a_body_that_moves(twist, place):
    """Numeric derivative of the places of the wheels, in the axes of the body."""
    positions_m, direction_rad = place
    along_mps, across_mps = wheel_frame_velocities(twist, positions_m, direction_rad)
    step_s = 1e-6
    for k, (vx, vy, rate) in enumerate(twist):
        places = []
        for t in (-step_s, step_s):
            turn = np.array([[np.cos(rate * t), -np.sin(rate * t)], [np.sin(rate * t), np.cos(rate * t)]])
            places.append(np.array([vx, vy]) * t + positions_m @ turn.T)
        velocity = (places[1] - places[0]) / (2 * step_s)
        ahead = np.stack([np.cos(direction_rad), np.sin(direction_rad)], axis=1)
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        np.testing.assert_allclose(along_mps[k], (velocity * ahead).sum(axis=1), atol=1e-8)
        np.testing.assert_allclose(across_mps[k], (velocity * left).sum(axis=1), atol=1e-8)
    np.testing.assert_allclose(along_mps, twist @ rolling_matrix(*place).T, atol=1e-12)


def test_numbers_arrays_and_compiled_code_agree():
    along, across = wheel_frame_velocities(TWIST, WHEELS_M, STEER)
    for k in range(len(TWIST)):
        for i, (x, y) in enumerate(WHEELS_M):
            one = compiled(*TWIST[k], x, y, STEER[k, i])
            np.testing.assert_allclose(one, (along[k, i], across[k, i]), rtol=0, atol=1e-14)


@given(st.floats(0.05, 2.0), st.floats(-np.pi, np.pi), st.floats(0.1, 2.0))
def test_a_robot_that_is_turned_drives_equally_well_in_its_own_axes(distance_m, turned_rad, speed_mps):
    """Three equal wheels drive equally well in all directions: J'J does not depend on how they are turned."""
    rows = rolling_matrix(*circle(distance_m, turned_rad + np.radians([0.0, 120.0, 240.0])))
    np.testing.assert_allclose(rows.T @ rows, np.diag([1.5, 1.5, 3 * distance_m**2]), atol=1e-12)
    assert np.abs(rows[:, :2]).max() * speed_mps <= speed_mps * (1 + 1e-12)


def test_wheels_that_contradict_each_other_have_a_residual():
    speed_mps = rolling_matrix(*FOUR) @ [0.5, 0.0, 0.0]
    speed_mps[1] *= 1.2
    twist, residual_mps = no_slip_twist(*FOUR, speed_mps, True)
    assert residual_mps > 0.03
    others, _ = no_slip_twist(FOUR[0][[0, 2, 3]], FOUR[1][[0, 2, 3]], speed_mps[[0, 2, 3]], True)
    np.testing.assert_allclose(others, [0.5, 0.0, 0.0], atol=1e-12)
    assert abs(twist[0] - 0.5) > 0.01


def test_pseudo_inverse_of_the_source_and_least_squares_agree_on_wheels_that_contradict_each_other():
    rng = np.random.default_rng(3)
    wheel, steer = rng.normal(0, 5, (20, 3)), rng.normal(0, 3, (20, 3))
    twist, residual_mps = by_rates(wheel, steer)
    x, y = WHEELS_M.T
    rows = np.array([row for i in range(3) for row in ([-y[i], 1, 0], [x[i], 0, 1])])  # (2.3): yaw rate first
    for k in range(20):
        spread = block_diag(*[[[RADIUS_M * math.cos(d)], [RADIUS_M * math.sin(d)]] for d in steer[k]])
        assert spread.shape == (6, 3)
        by_pinv = np.linalg.pinv(rows) @ spread @ wheel[k]
        by_lstsq, square, *_ = np.linalg.lstsq(rows, spread @ wheel[k])
        np.testing.assert_allclose(twist[k], by_pinv[[1, 2, 0]], atol=1e-12)
        np.testing.assert_allclose(twist[k], by_lstsq[[1, 2, 0]], atol=1e-12)
        assert residual_mps[k] == pytest.approx(math.sqrt(square[0]), rel=1e-9)
    assert residual_mps.min() > 0.1


def test_the_wheel_order_of_equation_2_3_does_not_fit_the_geometry_of_7_2():
    """The erratum: (2.3) puts wheel 1 at +w/2, 7.2 puts it at -w/2."""
    of_2_3 = WHEELS_M[[1, 0, 2]]
    twist = np.array([0.5, 0.0, 0.6])
    wheel, steer = inverse(WHEELS_M, RADIUS_M, twist, np.zeros(3))
    right, residual_mps = by_rates(wheel, steer)
    wrong, contradiction_mps = by_rates(wheel, steer, of_2_3)
    np.testing.assert_allclose(right, twist, atol=1e-12)
    assert residual_mps < 1e-12
    assert abs(wrong[2] - twist[2]) > 0.3  # rad/s
    assert contradiction_mps > 0.1
    np.testing.assert_allclose(  # without yaw the order is of no account, which is how it stays unseen
        by_rates(*inverse(WHEELS_M, RADIUS_M, [0.5, 0.2, 0.0], np.zeros(3)), of_2_3)[0],
        [0.5, 0.2, 0.0],
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("place", "rolls_across", "twist"),
    [((WHEELS_M, np.zeros(3)), False, [0.1, 0, 0]), (PLACE, True, [0, 0, 0.8])],
)
def test_a_missing_sample_is_no_twist_and_spoils_no_other(place, rolls_across, twist):
    found, residual_mps = no_slip_twist(*place, [[0.1, np.nan, 0.1], [0.1, 0.1, 0.1]], rolls_across)
    assert np.isnan(found[0]).all()
    assert np.isnan(residual_mps[0])
    np.testing.assert_allclose(found[1], twist, atol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: wheel_velocities([0.5, 0.0], [1, 0, 0]), r"positions_m has shape \(2,\)"),
        (lambda: wheel_velocities([[0.5, 0.0]], [1, 0, 0]), r"positions_m has shape \(1, 2\)"),
        (lambda: wheel_velocities([[0.5, 0.0]] * 3, [1, 0, 0]), "positions_m holds one place only"),
        (lambda: wheel_velocities([[0, np.inf], [1, 0]], [1, 0, 0]), "positions_m holds inf, finite"),
        (lambda: wheel_velocities(WHEELS_M, [1, 0]), r"twist has shape \(2,\), \(\.\.\., 3\) is required"),
        (lambda: wheel_velocities(WHEELS_M, [1, 0, np.nan]), "twist holds nan, finite numbers"),
        (lambda: wheel_velocities(WHEELS_M, ["left", 0, 0]), "twist cannot be read as an array of numbers"),
        (lambda: rolling_matrix(PLACE[0], [0.0, 1.0]), "direction_rad has shape"),
        (lambda: rolling_matrix(PLACE[0], [0.0, 1.0, np.nan]), "direction_rad holds nan"),
        (lambda: no_slip_twist(WHEELS_M, np.ones(3), np.ones(2)), r"wheel_speed_mps has shape \(2,\)"),
        (lambda: no_slip_twist(*PLACE, [1.0, np.inf, 0.0], True), "wheel_speed_mps holds inf"),
        (
            lambda: no_slip_twist(WHEELS_M, np.ones((4, 3)), np.ones((5, 3))),
            r"direction_rad \(4, 3\) and wheel_speed_mps \(5, 3\)",
        ),
        (lambda: no_slip_twist(WHEELS_M[:2], np.zeros(2), np.ones(2), True), "do not determine"),
        (lambda: no_slip_twist(PLACE[0], np.zeros(3), np.ones(3), True), "do not determine"),
        (lambda: no_slip_twist(PLACE[0], np.radians([0.0, 180.0, 0.0]), np.ones(3), True), "determine"),
    ],
)
def test_what_is_no_robot_is_refused_in_one_sentence(call, message):
    with pytest.raises(ConfigError, match=message) as refusal:
        call()
    assert "\n" not in str(refusal.value)


def test_the_commands_of_a_measured_robot_are_those_of_its_wheels(measured):
    """Robotino: motor speeds set for a speed in one of many directions; 16 turns to one of the wheel."""
    files = sorted(measured("robotino").glob("one_surface/*/*.csv.gz"))[::7]
    assert len(files) > 30
    for file in files:
        with gzip.open(file, "rt", encoding="utf-8") as lines:
            names = [line.strip().split(";") for line, _ in zip(lines, range(3), strict=False)][2]
            row = dict(zip(names, next(lines).strip().split(";"), strict=True))
        twist = [float(row[name]) for name in ("xsetspeed", "ysetspeed", "setvel")]
        motor_radps = rolling_matrix(*PLACE) @ twist * 16.0 / 0.040
        np.testing.assert_allclose(motor_radps, [float(row[f"m{i}setvel"]) for i in (1, 2, 3)], atol=0.01)
