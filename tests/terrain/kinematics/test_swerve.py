import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag

from terrain.errors import ConfigError
from terrain.kinematics.swerve import (
    FAR_RAD,
    STANDING_MPS,
    forward,
    inverse,
    wheel_command_step,
    wheel_commands,
    wheel_velocities,
)
from terrain.kinematics.swerve_limits import admissible_scale, admissible_yaw_rate, scaled
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
WHEELS_M = ROBOT.wheel_positions_m
RADIUS_M = ROBOT.wheel_radius_m
SPEED_MAX_RADPS = ROBOT.motors.speed_max_radps
RATE_MAX_RADPS = ROBOT.steering.rate_max_radps

SPEEDS = st.floats(-3.0, 3.0)
TWISTS = st.one_of(
    st.tuples(SPEEDS, SPEEDS, SPEEDS),
    st.tuples(st.just(0.0), st.just(0.0), SPEEDS),  # pure rotation
    st.tuples(st.just(0.0), SPEEDS, st.just(0.0)),  # crab
    st.tuples(st.floats(-3.0, -0.1), st.just(0.0), st.just(0.0)),  # reverse
)
STEERS = st.tuples(*[st.floats(-100.0, 100.0)] * 3)


@given(twist=TWISTS, steer=STEERS)
def test_forward_undoes_inverse_and_no_wheel_turns_more_than_a_quarter(twist, steer):
    wheel, aim = inverse(WHEELS_M, RADIUS_M, twist, steer)
    back, residual_mps = forward(WHEELS_M, RADIUS_M, wheel, aim)
    np.testing.assert_allclose(back, twist, atol=3 * STANDING_MPS)
    assert residual_mps < 3 * STANDING_MPS
    assert np.abs(aim - steer).max() <= math.pi / 2 + 1e-12
    standing = wheel == 0
    np.testing.assert_array_equal(aim[standing], np.array(steer)[standing])
    wheel_speed = RADIUS_M * wheel[:, None] * np.stack([np.cos(aim), np.sin(aim)], axis=-1)
    np.testing.assert_allclose(wheel_speed, wheel_velocities(WHEELS_M, twist), atol=STANDING_MPS)


def test_velocities_are_those_of_points_of_a_body_that_moves():
    twist, dt_s = np.array([0.7, -0.4, 0.9]), 1e-6
    turn = twist[2] * dt_s
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    moved = WHEELS_M @ rotation.T + twist[:2] * dt_s
    np.testing.assert_allclose(wheel_velocities(WHEELS_M, twist), (moved - WHEELS_M) / dt_s, atol=1e-5)


def test_pseudo_inverse_of_the_source_and_least_squares_agree_on_wheels_that_contradict_each_other():
    rng = np.random.default_rng(3)
    wheel, steer = rng.normal(0, 5, (20, 3)), rng.normal(0, 3, (20, 3))
    twist, residual_mps = forward(WHEELS_M, RADIUS_M, wheel, steer)
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
    right, residual_mps = forward(WHEELS_M, RADIUS_M, wheel, steer)
    wrong, contradiction_mps = forward(of_2_3, RADIUS_M, wheel, steer)
    np.testing.assert_allclose(right, twist, atol=1e-12)
    assert residual_mps < 1e-12
    assert abs(wrong[2] - twist[2]) > 0.3  # rad/s
    assert contradiction_mps > 0.1
    np.testing.assert_allclose(  # without yaw the order is of no account, which is how it stays unseen
        forward(of_2_3, RADIUS_M, *inverse(WHEELS_M, RADIUS_M, [0.5, 0.2, 0.0], np.zeros(3)))[0],
        [0.5, 0.2, 0.0],
        atol=1e-12,
    )


def test_a_missing_sample_is_no_twist_and_spoils_no_other():
    twist, residual_mps = forward(WHEELS_M, RADIUS_M, [[5, np.nan, 5], [5, 5, 5]], np.zeros(3))
    assert np.isnan(twist[0]).all()
    assert np.isnan(residual_mps[0])
    np.testing.assert_allclose(twist[1], [1, 0, 0], atol=1e-12)


@pytest.mark.parametrize("turns", [40, -40])
def test_steering_follows_over_many_turns_without_a_jump(turns):
    direction = np.linspace(0.0, turns * 2 * math.pi, 60 * abs(turns) + 1)
    twists = np.column_stack([np.cos(direction), np.sin(direction), np.zeros_like(direction)])
    _, wheel, steer = wheel_commands(WHEELS_M, RADIUS_M, SPEED_MAX_RADPS, 100.0, 0.02, twists, np.zeros(3))
    np.testing.assert_allclose(steer, np.repeat(direction[:, None], 3, axis=1), atol=1e-9)
    np.testing.assert_allclose(wheel, 1 / RADIUS_M)


def test_reverse_turns_the_wheels_round_and_not_the_steering():
    wheel, steer = inverse(WHEELS_M, RADIUS_M, [[1, 0, 0], [-1, 0, 0]], [0.1, -0.1, 8 * math.pi])
    np.testing.assert_allclose(wheel, [[5, 5, 5], [-5, -5, -5]])
    np.testing.assert_allclose(steer, [[0, 0, 8 * math.pi]] * 2, atol=1e-12)


@given(twist=TWISTS, stretch=st.floats(0.1, 50.0))
def test_no_wheel_saturates_and_the_direction_is_kept(twist, stretch):
    twist = np.array(twist) * stretch
    scale = admissible_scale(WHEELS_M, RADIUS_M, twist, SPEED_MAX_RADPS)
    admitted = scaled(WHEELS_M, RADIUS_M, twist, SPEED_MAX_RADPS)
    np.testing.assert_allclose(admitted, scale * twist)
    wheel, _ = inverse(WHEELS_M, RADIUS_M, admitted, np.zeros(3))
    fastest = np.abs(wheel).max()
    assert fastest <= SPEED_MAX_RADPS * (1 + 1e-12)
    assert 0 < scale <= 1
    assert scale == 1 or fastest == pytest.approx(SPEED_MAX_RADPS)  # no smaller than it has to be


@pytest.mark.parametrize("xi", [0.8, 1.0, 1.5, 2.0])
def test_boundary_of_the_admissible_region_against_brute_force(xi):
    """Figure 2.8, and sections with a lateral speed; dimensionless as (2.11), signs as corrected."""
    wheels = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -xi]])
    x, y = np.meshgrid(np.linspace(-1.1, 1.1, 44), np.linspace(-0.6, 0.6, 7))  # never a speed of exactly 1
    low, high = admissible_yaw_rate(wheels, 1.0, x, y, 1.0)
    yaw = np.linspace(-2, 2, 4001)[:, None, None]
    omega_1 = np.hypot(x, y - yaw)
    omega_2 = np.hypot(x, y + yaw)
    omega_3 = np.hypot(x + xi * yaw, y)
    inside = np.maximum(np.maximum(omega_1, omega_2), omega_3) <= 1
    some = inside.any(axis=0)
    assert some.sum() > 100
    lowest, highest = np.where(inside, yaw, 9).min(axis=0), np.where(inside, yaw, -9).max(axis=0)
    np.testing.assert_allclose(low[some], lowest[some], atol=1.1e-3)
    np.testing.assert_allclose(high[some], highest[some], atol=1.1e-3)
    thin = ~some & ~np.isnan(low)  # narrower than the raster, or nothing
    assert (high[thin] - low[thin] < 1e-3).all()
    assert np.isnan(low[np.hypot(x, y) > 1 + xi]).all()
    spot = admissible_yaw_rate(wheels, 1.0, 0.0, 0.0, 1.0)[1]
    assert spot == pytest.approx(1 / max(xi, 1.0))  # a wide track turns slower on the spot


def test_boundary_of_the_admissible_region_is_where_scaling_begins():
    speed_x, speed_y = np.meshgrid(np.linspace(-1.5, 1.5, 7), np.linspace(-1.0, 1.0, 5))
    for yaw in admissible_yaw_rate(WHEELS_M, RADIUS_M, speed_x, speed_y, SPEED_MAX_RADPS):
        twist = np.stack([speed_x, speed_y, yaw], axis=-1)
        fastest = np.linalg.norm(wheel_velocities(WHEELS_M, twist), axis=-1).max(axis=-1)
        np.testing.assert_allclose(fastest, SPEED_MAX_RADPS * RADIUS_M)
    at_origin = [[0.0, 0.0], [0.5, 0.0]]
    assert np.isnan(admissible_yaw_rate(at_origin, RADIUS_M, 2.1, 0.0, SPEED_MAX_RADPS)).all()
    assert admissible_yaw_rate(at_origin, RADIUS_M, 0.0, 0.0, SPEED_MAX_RADPS) == pytest.approx((-4, 4))


def plain_step(twist, steer, rate_max_radps, dt_s, far_rad):
    """The step in the words of its docstring: the oracle of the compiled one."""
    admitted = scaled(WHEELS_M, RADIUS_M, twist, SPEED_MAX_RADPS)
    wheel, aim = inverse(WHEELS_M, RADIUS_M, admitted, steer)
    commanded = steer + np.clip(aim - steer, -rate_max_radps * dt_s, rate_max_radps * dt_s)
    worst = np.abs(aim - commanded).max()
    return admitted, wheel * (max(0.0, math.cos(worst)) if worst > far_rad else 1.0), commanded


def random_twists(n, rng):
    twists = np.repeat(rng.normal(0, 1.5, (n // 20, 3)), 20, axis=0)
    twists[rng.random(n) < 0.1] = 0.0
    return twists


def test_compiled_commands_equal_the_plain_form_and_live_equals_batch():
    rng = np.random.default_rng(11)
    twists, start = random_twists(1000, rng), rng.normal(0, 4, 3)
    batch = wheel_commands(WHEELS_M, RADIUS_M, SPEED_MAX_RADPS, RATE_MAX_RADPS, 0.02, twists, start)
    live, oracle, steer, commanded = [], [], start, start
    for twist in twists:
        step = wheel_command_step(
            WHEELS_M, RADIUS_M, SPEED_MAX_RADPS, RATE_MAX_RADPS, 0.02, FAR_RAD, twist, steer
        )
        live.append(step)
        steer = step[2]
        oracle.append(plain_step(twist, commanded, RATE_MAX_RADPS, 0.02, FAR_RAD))
        commanded = oracle[-1][2]
    for together, one_by_one, plain in zip(
        batch, zip(*live, strict=True), zip(*oracle, strict=True), strict=True
    ):
        np.testing.assert_array_equal(together, np.array(one_by_one))
        np.testing.assert_allclose(together, np.array(plain), atol=1e-9)


def test_commands_keep_every_limit_and_drive_waits_for_steering():
    rng = np.random.default_rng(5)
    twists, start = random_twists(2000, rng), np.zeros(3)
    admitted, wheel, steer = wheel_commands(
        WHEELS_M, RADIUS_M, SPEED_MAX_RADPS, RATE_MAX_RADPS, 0.02, twists, start
    )
    assert np.abs(wheel).max() <= SPEED_MAX_RADPS * (1 + 1e-12)
    moves = np.abs(np.diff(np.vstack([start, steer]), axis=0))
    assert moves.max() <= RATE_MAX_RADPS * 0.02 + 1e-12
    velocity = wheel_velocities(WHEELS_M, admitted)
    moving = np.linalg.norm(velocity, axis=-1) > STANDING_MPS
    aim = np.arctan2(velocity[..., 1], velocity[..., 0])
    error = np.where(moving, np.abs((aim - steer + math.pi / 2) % math.pi - math.pi / 2), 0.0).max(axis=1)
    speed_mps = np.abs(wheel) * RADIUS_M
    full_mps = np.where(moving, np.linalg.norm(velocity, axis=-1), 0.0)
    factor = np.where(error > FAR_RAD, np.cos(error), 1.0)
    assert 0.1 < (error > FAR_RAD).mean() < 0.9
    clear = np.abs(error - FAR_RAD) > 1e-9
    np.testing.assert_allclose(speed_mps[clear], (full_mps * factor[:, None])[clear], atol=1e-9)
    settled = error < 1e-9
    twist, residual_mps = forward(WHEELS_M, RADIUS_M, wheel[settled], steer[settled])
    np.testing.assert_allclose(twist, admitted[settled], atol=1e-6)
    assert residual_mps.max() < 1e-6


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
        (lambda: forward(WHEELS_M, 0.0, np.ones(3), np.ones(3)), "radius_m is 0.0, a number above zero"),
        (lambda: forward(WHEELS_M, RADIUS_M, np.ones(2), np.ones(3)), r"wheel_radps has shape \(2,\)"),
        (lambda: forward(WHEELS_M, RADIUS_M, [1, np.inf, 1], np.ones(3)), "wheel_radps holds inf"),
        (
            lambda: forward(WHEELS_M, RADIUS_M, np.ones((5, 3)), np.ones((4, 3))),
            r"wheel_radps \(5, 3\) and steer_rad \(4, 3\)",
        ),
        (lambda: inverse(WHEELS_M, -0.2, [1, 0, 0], np.zeros(3)), "radius_m is -0.2"),
        (lambda: inverse(WHEELS_M, math.nan, [1, 0, 0], np.zeros(3)), "radius_m holds nan"),
        (lambda: inverse(WHEELS_M, RADIUS_M, [1, 0, 0], [0, 0, np.nan]), "steer_now_rad holds nan"),
        (lambda: inverse(WHEELS_M, RADIUS_M, [1, 0, 0], np.zeros(4)), r"steer_now_rad has shape \(4,\)"),
        (lambda: scaled(WHEELS_M, RADIUS_M, [1, 0, 0], 0.0), "speed_max_radps is 0.0"),
        (lambda: admissible_yaw_rate(WHEELS_M, [0.2], 0, 0, 1), r"radius_m is \[0.2\], a number above zero"),
        (lambda: admissible_yaw_rate(WHEELS_M, 0.2, [1, 2], [1, 2, 3], 1), r"speed_x_mps \(2,\) and speed_y"),
        (
            lambda: wheel_commands(WHEELS_M, 0.2, 10, 2, 0.02, np.zeros((2, 5, 3)), np.zeros(3)),
            r"twists have shape \(2, 5, 3\), \(n, 3\) is required",
        ),
        (
            lambda: wheel_commands(WHEELS_M, 0.2, 10, 2, 0.02, np.zeros((5, 3)), np.zeros((5, 3))),
            r"steer_0 has shape \(5, 3\), \(3,\) is required",
        ),
        (lambda: wheel_commands(WHEELS_M, 0.2, 10, 2, 0, np.zeros((5, 3)), np.zeros(3)), "dt_s is 0,"),
    ],
)
def test_invalid_robots_and_motions_are_refused_in_one_sentence(call, message):
    with pytest.raises(ConfigError, match=message) as error:
        call()
    assert "\n" not in str(error.value)
