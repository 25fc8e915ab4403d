import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.errors import ConfigError
from terrain.kinematics.commands import (
    FAR_RAD,
    STANDING_MPS,
    admissible_scale,
    admissible_yaw_rate,
    inverse,
    scaled,
    wheel_command_step,
    wheel_commands,
    wheel_motion,
)
from terrain.kinematics.wheels import no_slip_twist, wheel_velocities
from terrain.robots import load_robot

ROBOT, HUSKY, ROBOTINO = (load_robot(name) for name in ("agrimaro", "husky", "robotino"))
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
    back, residual_mps = no_slip_twist(WHEELS_M, aim, RADIUS_M * wheel)
    np.testing.assert_allclose(back, twist, atol=3 * STANDING_MPS)
    assert residual_mps < 3 * STANDING_MPS
    assert np.abs(aim - steer).max() <= math.pi / 2 + 1e-12
    standing = wheel == 0
    np.testing.assert_array_equal(aim[standing], np.array(steer)[standing])
    wheel_speed = RADIUS_M * wheel[:, None] * np.stack([np.cos(aim), np.sin(aim)], axis=-1)
    np.testing.assert_allclose(wheel_speed, wheel_velocities(WHEELS_M, twist), atol=STANDING_MPS)


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
    twist, residual_mps = no_slip_twist(WHEELS_M, steer[settled], RADIUS_M * wheel[settled])
    np.testing.assert_allclose(twist, admitted[settled], atol=1e-6)
    assert residual_mps.max() < 1e-6


@pytest.mark.parametrize(
    ("call", "message"),
    [
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


@pytest.mark.parametrize("robot", [ROBOT, HUSKY], ids=lambda robot: robot.name)
def test_wheels_that_follow_their_commands_drive_the_twist(robot):
    desired = np.tile([0.5, 0.0, 0.3], (100, 1))
    motion = wheel_motion(robot, desired, 0.02)
    np.testing.assert_allclose(motion.wheel_speed_mps, motion.wheel_radps * robot.wheel_radius_m)
    rates, steer = motion.wheel_radps[-1], motion.steer_rad[-1]
    twist, _ = no_slip_twist(robot.wheel_positions_m, steer, robot.wheel_radius_m * rates)
    np.testing.assert_allclose(twist, desired[-1], atol=1e-9)


@pytest.mark.parametrize("robot", [ROBOT, HUSKY, ROBOTINO], ids=lambda robot: robot.name)
def test_no_wheel_turns_faster_than_its_motor_can(robot):
    motion = wheel_motion(robot, np.tile([50.0, 0.0, 9.0], (50, 1)), 0.02)
    assert np.abs(motion.wheel_radps).max() <= robot.motors.speed_max_radps * (1 + 1e-12)


def test_a_robot_without_motors_is_named():
    with pytest.raises(ConfigError, match=r"robot agrimaro: .* no section 'motors'"):
        wheel_motion(ROBOT.without("motors"), np.zeros((2, 3)), 0.02)


def test_a_skid_steer_robot_without_motors_has_no_fastest_speed():
    motion = wheel_motion(HUSKY.without("motors"), np.array([[50.0, 0.0, 9.0]]), 0.02)
    turn_mps = 9.0 * HUSKY.track_m / 2
    np.testing.assert_allclose(motion.wheel_speed_mps, [[50.0 - turn_mps, 50.0 + turn_mps]])


def test_an_omni_robot_keeps_its_direction_where_a_wheel_is_at_its_limit():
    desired = np.array([[0.1, 0.05, 0.2], [5.0, 2.5, 10.0]])
    motion = wheel_motion(ROBOTINO, desired, 0.02)
    back, _ = no_slip_twist(
        ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad, motion.wheel_speed_mps, True
    )
    np.testing.assert_allclose(back[0], desired[0], atol=1e-12)
    np.testing.assert_allclose(back[1] / back[1, 0], desired[1] / desired[1, 0], rtol=1e-9)
    np.testing.assert_allclose(motion.twist, back, atol=1e-12)
