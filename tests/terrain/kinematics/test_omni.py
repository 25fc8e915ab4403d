"""Omni wheels: one direction undoes the other, geometry by other routes, commands of a measured robot."""

import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from terrain.errors import ConfigError
from terrain.kinematics.omni import forward, inverse, rolling_matrix, wheels_on_circle
from terrain.kinematics.wheel_velocity import wheel_frame_velocities

PLACE = wheels_on_circle(0.125, np.radians([60.0, 180.0, 300.0]))
FOUR = wheels_on_circle(0.3, np.radians([45.0, 135.0, 225.0, 315.0]))

twists = arrays(float, (5, 3), elements=st.floats(-3.0, 3.0))


@given(twists, st.sampled_from([PLACE, FOUR]))
def test_forward_undoes_inverse(twist, place):
    found, residual_mps = forward(*place, inverse(*place, twist))
    np.testing.assert_allclose(found, twist, atol=1e-12)
    np.testing.assert_allclose(residual_mps, 0.0, atol=1e-12)


@given(twists)
def test_speeds_are_those_of_points_of_a_body_that_moves(twist):
    """Numeric derivative of the places of the wheels, in the axes of the body."""
    positions_m, direction_rad = PLACE
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
    np.testing.assert_allclose(along_mps, inverse(*PLACE, twist), atol=1e-12)


@given(st.floats(0.05, 2.0), st.floats(-np.pi, np.pi), st.floats(0.1, 2.0))
def test_a_robot_that_is_turned_drives_equally_well_in_its_own_axes(distance_m, turned_rad, speed_mps):
    """Three equal wheels drive equally well in all directions: J'J does not depend on how they are turned."""
    rows = rolling_matrix(*wheels_on_circle(distance_m, turned_rad + np.radians([0.0, 120.0, 240.0])))
    np.testing.assert_allclose(rows.T @ rows, np.diag([1.5, 1.5, 3 * distance_m**2]), atol=1e-12)
    assert np.abs(rows[:, :2]).max() * speed_mps <= speed_mps * (1 + 1e-12)


def test_wheels_that_contradict_each_other_have_a_residual():
    speed_mps = inverse(*FOUR, [0.5, 0.0, 0.0])
    speed_mps[1] *= 1.2
    twist, residual_mps = forward(*FOUR, speed_mps)
    assert residual_mps > 0.03
    others, _ = forward(FOUR[0][[0, 2, 3]], FOUR[1][[0, 2, 3]], speed_mps[[0, 2, 3]])
    np.testing.assert_allclose(others, [0.5, 0.0, 0.0], atol=1e-12)
    assert abs(twist[0] - 0.5) > 0.01


def test_a_missing_sample_is_no_twist_and_spoils_no_other():
    twist, residual_mps = forward(*PLACE, [[0.1, np.nan, 0.1], [0.1, 0.1, 0.1]])
    assert np.isnan(twist[0]).all()
    assert np.isnan(residual_mps[0])
    np.testing.assert_allclose(twist[1], [0.0, 0.0, 0.8], atol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rolling_matrix([[0.1, 0.0], [0.0, 0.1]], [0.0, 1.0]), "three wheels or more"),
        (lambda: rolling_matrix(PLACE[0], [0.0, 1.0]), "direction_rad has shape"),
        (lambda: rolling_matrix(PLACE[0], [0.0, 1.0, np.nan]), "direction_rad holds nan"),
        (lambda: inverse(*PLACE, [1.0, 2.0]), "twist has shape"),
        (lambda: forward(*PLACE, [1.0, np.inf, 0.0]), "wheel_speed_mps holds inf"),
        (
            lambda: forward([[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0]], [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]),
            "do not determine",
        ),
        (
            lambda: forward([[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0]], np.radians([0.0, 90.0, 0.0]), np.ones(3)),
            "determine",
        ),
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
        motor_radps = inverse(*PLACE, twist) * 16.0 / 0.040
        np.testing.assert_allclose(motor_radps, [float(row[f"m{i}setvel"]) for i in (1, 2, 3)], atol=0.01)
