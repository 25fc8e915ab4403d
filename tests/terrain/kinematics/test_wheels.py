"""Wheels of every drive: one direction undoes the other, geometry by other routes, commands within every limit."""

import gzip
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import block_diag

from terrain.errors import ConfigError
from terrain.kernels import njit
from terrain.kinematics.commands import (
    FAR_RAD,
    STANDING_MPS,
    scaled,
    wheel_command_step,
    wheel_commands,
    wheel_motion,
)
from terrain.kinematics.logged_wheels import true_slip, wheel_and_ground_speed, with_desired_twist
from terrain.kinematics.wheels import (
    in_wheel_frame,
    no_slip_twist,
    point_velocity,
    rolling_matrix,
    velocity_matrix,
    wheel_frame_velocities,
)
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate, simulate_run
from terrain.simulation.scenario import Scenario
from terrain.slip import slip_ratio
from terrain.terramechanics.soil import load_soil

ROBOT, HUSKY, ROBOTINO = (load_robot(name) for name in ("agrimaro", "husky", "robotino"))
WHEELS_M, RADIUS_M = ROBOT.wheel_positions_m, ROBOT.wheel_radius_m
LIMITS = (ROBOT.motors.speed_max_radps, ROBOT.steering.rate_max_radps, 0.02)
PLACE = ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad


def circle(distance_m, angle_rad):
    """Positions and directions of wheels on a circle that all turn the robot to the left."""
    return distance_m * np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1), angle_rad + np.pi / 2


FOUR = circle(0.3, np.radians([45.0, 135.0, 225.0, 315.0]))
twists = arrays(float, (5, 3), elements=st.floats(-3.0, 3.0))
SPEEDS = st.floats(-3.0, 3.0)
TWISTS = st.one_of(
    st.tuples(SPEEDS, SPEEDS, SPEEDS),
    st.tuples(st.just(0.0), st.just(0.0), SPEEDS),  # pure rotation
    st.tuples(st.just(0.0), SPEEDS, st.just(0.0)),  # crab
    st.tuples(st.floats(-3.0, -0.1), st.just(0.0), st.just(0.0)),  # reverse
)


@njit
def compiled(v_x, v_y, turn, x, y, steer):
    forward, left = point_velocity(v_x, v_y, turn, x, y)
    return in_wheel_frame(forward, left, np.cos(steer), np.sin(steer))


@given(twists, st.sampled_from([PLACE, FOUR, (WHEELS_M, np.array([0.3, -2.0, 9.0]))]))
@settings(max_examples=50)
def test_speeds_are_those_of_points_of_a_body_that_moves_and_the_twist_undoes_them(twist, place):
    """Numeric derivative of the places of the wheels, in the axes of the body; and in compiled code."""
    positions_m, direction_rad = place
    found, residual_mps = no_slip_twist(*place, twist @ rolling_matrix(*place).T, True)
    np.testing.assert_allclose(found, twist, atol=1e-11)
    np.testing.assert_allclose(residual_mps, 0.0, atol=1e-12)
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
    one = compiled(*twist[0], *positions_m[0], direction_rad[0])
    np.testing.assert_allclose(one, (along_mps[0, 0], across_mps[0, 0]), rtol=0, atol=1e-14)


def test_wheels_that_contradict_each_other_are_fitted_and_have_a_residual():
    """Least squares over all rows is the pseudo-inverse of the source, (2.3) and (2.4)."""
    rng = np.random.default_rng(3)
    wheel, steer = rng.normal(0, 5, (20, 3)), rng.normal(0, 3, (20, 3))
    twist, residual_mps = no_slip_twist(WHEELS_M, steer, RADIUS_M * wheel)
    x, y = WHEELS_M.T
    rows = np.array([row for i in range(3) for row in ([-y[i], 1, 0], [x[i], 0, 1])])  # (2.3): yaw rate first
    for k in range(20):
        spread = block_diag(*[[[RADIUS_M * math.cos(d)], [RADIUS_M * math.sin(d)]] for d in steer[k]])
        by_lstsq, square, *_ = np.linalg.lstsq(rows, spread @ wheel[k])
        np.testing.assert_allclose(twist[k], by_lstsq[[1, 2, 0]], atol=1e-12)
        assert residual_mps[k] == pytest.approx(math.sqrt(square[0]), rel=1e-9)
    speed_mps = rolling_matrix(*FOUR) @ [0.5, 0.0, 0.0] * [1.0, 1.2, 1.0, 1.0]
    twist, residual_mps = no_slip_twist(*FOUR, speed_mps, True)
    assert residual_mps > 0.03
    assert abs(twist[0] - 0.5) > 0.01


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
        (lambda: rolling_matrix(PLACE[0], [0.0, 1.0]), r"direction_rad has shape \(2,\), \(\.\.\., 3\) is"),
        (lambda: rolling_matrix(PLACE[0], ["left", 0, 0]), "direction_rad cannot be read as an array of"),
        (lambda: no_slip_twist(*PLACE, [1.0, np.inf, 0.0], True), "wheel_speed_mps holds inf"),
        (lambda: no_slip_twist([[0.5, 0.0]] * 3, np.zeros(3), np.ones(3)), "do not determine"),
        (lambda: no_slip_twist(WHEELS_M[:2], np.zeros(2), np.ones(2), True), "do not determine"),
        (lambda: no_slip_twist(PLACE[0], np.radians([0.0, 180.0, 0.0]), np.ones(3), True), "determine"),
    ],
)
def test_what_is_no_robot_is_refused(call, message):
    with pytest.raises(ConfigError, match=message):
        call()


# -- commands -------------------------------------------------------------------------------------------------------


def inverse(twist, steer):
    """Wheel rates and steering angles for twists, (2.5): of two solutions that which moves the steering least."""
    along, across = np.moveaxis(
        (twist @ velocity_matrix(WHEELS_M).T).reshape(*np.shape(twist)[:-1], 3, 2), -1, 0
    )
    speed, heading = np.hypot(along, across), np.arctan2(across, along)
    k = np.rint((heading - steer) / np.pi)
    standing, sign = speed < STANDING_MPS, np.where(k % 2 == 0, 1.0, -1.0)
    return np.where(standing, 0.0, sign * speed / RADIUS_M), np.where(standing, steer, heading - k * np.pi)


@given(twist=TWISTS, steer=st.tuples(*[st.floats(-100.0, 100.0)] * 3))
def test_forward_undoes_inverse_and_no_wheel_turns_more_than_a_quarter(twist, steer):
    wheel, aim = inverse(twist, steer)
    back, residual_mps = no_slip_twist(WHEELS_M, aim, RADIUS_M * wheel)
    np.testing.assert_allclose(back, twist, atol=3 * STANDING_MPS)
    assert residual_mps < 3 * STANDING_MPS
    assert np.abs(aim - steer).max() <= math.pi / 2 + 1e-12
    standing = wheel == 0
    np.testing.assert_array_equal(aim[standing], np.array(steer)[standing])


def test_steering_follows_over_many_turns():
    direction = np.linspace(0.0, 80 * math.pi, 2401)
    courses = np.column_stack([np.cos(direction), np.sin(direction), np.zeros_like(direction)])
    _, wheel, steer = wheel_commands(WHEELS_M, RADIUS_M, LIMITS[0], 100.0, 0.02, courses, np.zeros(3))
    np.testing.assert_allclose(steer, np.repeat(direction[:, None], 3, axis=1), atol=1e-9)
    np.testing.assert_allclose(wheel, 1 / RADIUS_M)


@given(twist=TWISTS, stretch=st.floats(0.1, 50.0))
def test_no_wheel_saturates_and_the_direction_is_kept(twist, stretch):
    twist = np.array(twist) * stretch
    admitted = scaled(WHEELS_M, RADIUS_M, twist, LIMITS[0])
    np.testing.assert_allclose(np.cross(admitted, twist), 0.0, atol=1e-9)
    fastest = np.abs(inverse(admitted, np.zeros(3))[0]).max()
    assert fastest <= LIMITS[0] * (1 + 1e-12)
    assert (admitted == twist).all() or fastest == pytest.approx(LIMITS[0])  # no smaller than it has to be


def plain_step(twist, steer):
    """The step in the words of its docstring: the oracle of the compiled one."""
    admitted = scaled(WHEELS_M, RADIUS_M, twist, LIMITS[0])
    wheel, aim = inverse(admitted, steer)
    commanded = steer + np.clip(aim - steer, -LIMITS[1] * LIMITS[2], LIMITS[1] * LIMITS[2])
    worst = np.abs(aim - commanded).max()
    return admitted, wheel * (max(0.0, math.cos(worst)) if worst > FAR_RAD else 1.0), commanded


def test_compiled_commands_are_the_plain_form_and_keep_every_limit_live_as_in_a_batch():
    rng = np.random.default_rng(11)
    desired = np.repeat(rng.normal(0, 1.5, (50, 3)), 20, axis=0)
    desired[rng.random(1000) < 0.1] = 0.0
    start = rng.normal(0, 4, 3)
    batch = wheel_commands(WHEELS_M, RADIUS_M, *LIMITS, desired, start)
    live, oracle, steer, commanded = [], [], start, start
    for twist in desired:
        live.append(wheel_command_step(WHEELS_M, RADIUS_M, *LIMITS, twist, steer))
        oracle.append(plain_step(twist, commanded))
        steer, commanded = live[-1][2], oracle[-1][2]
    for together, one_by_one, plain in zip(
        batch, zip(*live, strict=True), zip(*oracle, strict=True), strict=True
    ):
        np.testing.assert_array_equal(together, np.array(one_by_one))
        np.testing.assert_allclose(together, np.array(plain), atol=1e-9)
    _, wheel, steers = batch
    assert np.abs(wheel).max() <= LIMITS[0] * (1 + 1e-12)
    assert np.abs(np.diff(np.vstack([start, steers]), axis=0)).max() <= LIMITS[1] * LIMITS[2] + 1e-12


@pytest.mark.parametrize("robot", [ROBOT, HUSKY, ROBOTINO], ids=lambda robot: robot.name)
def test_wheels_that_follow_their_commands_drive_the_twist_within_what_motors_can(robot):
    """Omni wheels keep its direction where one of them is at its limit."""
    desired = np.tile([0.2, 0.0, 0.3], (100, 1))
    motion = wheel_motion(robot, desired, 0.02)
    np.testing.assert_allclose(motion.wheel_speed_mps, motion.wheel_radps * robot.wheel_radius_m)
    direction = motion.steer_rad[-1] + robot.wheel_directions_rad
    place = robot.wheel_positions_m, direction
    twist, _ = no_slip_twist(*place, motion.wheel_speed_mps[-1], robot.on_omni_wheels)
    np.testing.assert_allclose(twist, desired[-1], atol=1e-9)
    fast = wheel_motion(robot, np.tile([50.0, 25.0 * robot.on_omni_wheels, 9.0], (50, 1)), 0.02)
    assert np.abs(fast.wheel_radps).max() <= robot.motors.speed_max_radps * (1 + 1e-12)
    if robot.on_omni_wheels:
        twist, _ = no_slip_twist(*place, fast.wheel_speed_mps[-1], True)
        np.testing.assert_allclose(twist / twist[0], [1.0, 0.5, 0.18], rtol=1e-9)
        np.testing.assert_allclose(fast.twist[-1], twist, atol=1e-12)


def test_motors_that_are_not_described_are_named_or_have_no_limit():
    with pytest.raises(ConfigError, match=r"robot agrimaro: .* no section 'motors'"):
        wheel_motion(ROBOT.without("motors"), np.zeros((2, 3)), 0.02)
    motion = wheel_motion(HUSKY.without("motors"), np.array([[50.0, 0.0, 9.0]]), 0.02)
    turn_mps = 9.0 * HUSKY.track_m / 2
    np.testing.assert_allclose(motion.wheel_speed_mps, [[50.0 - turn_mps, 50.0 + turn_mps]])


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


def test_the_sign_of_a_simulated_slip_is_that_of_traction_in_both_directions():
    truth = simulate_run(ROBOT, "grass", "complex", 0, duration_s=30.0).streams["truth"]
    wheel_speed, ground = wheel_and_ground_speed(truth, ROBOT)
    slip = true_slip(truth, ROBOT.wheels)
    clear = np.isfinite(slip) & (np.abs(slip) > 0.05) & (np.abs(ground) > 0.1)
    assert clear.any()
    np.testing.assert_array_equal(slip[clear] > 0.0, ((wheel_speed - ground) * np.sign(ground) > 0.0)[clear])
    rates = Stream(np.arange(2.0), np.zeros((2, 3)), [f"wheel_{i}_radps" for i in (1, 2, 3)])
    assert np.isnan(true_slip(rates, ROBOT.wheels)).all()  # never defined


@pytest.mark.parametrize("robot", [ROBOTINO, load_robot("omnirobot")])
def test_a_wheel_slips_along_the_axis_of_its_rollers(robot):
    twist = np.zeros((151, 3))
    twist[20:, 1] = 0.3  # to the left
    drive = Scenario("left", 50.0, 0.02 * np.arange(151), twist, ((0.0, "asphalt"),))
    truth = simulate(robot, drive, {"asphalt": load_soil("asphalt")}, 0).streams["truth"]
    wheel_speed, ground = wheel_and_ground_speed(truth, robot)
    fast = np.abs(wheel_speed) > 0.1
    recorded = truth.columns(f"slip_{wheel}_ratio" for wheel in robot.wheels)
    np.testing.assert_allclose(recorded[fast], slip_ratio(wheel_speed, ground)[fast], atol=1e-9)
    assert np.abs(recorded[truth.time_s > 1.5][:, fast.any(axis=0)]).max() < 0.05


@pytest.mark.parametrize("robot", [HUSKY, ROBOTINO, load_robot("marmotte"), load_robot("omnirobot")])
def test_a_log_of_commanded_wheels_says_what_twist_was_desired(robot):
    twist = np.array([[0.2, 0.0, 0.0], [-0.1, 0.05 * robot.sideways, 0.3]])
    names = [f"wheel_{wheel}_radps" for wheel in robot.wheels]
    commands = Stream([0.0, 1.0], wheel_motion(robot, twist, 0.02).wheel_radps, names)
    run = RunLog("a", robot.name, {"commands": commands})
    found = with_desired_twist(run, robot)
    given = found.streams["commands"].columns(("speed_x_mps", "speed_y_mps", "yaw_rate_radps"))
    np.testing.assert_allclose(given, twist, atol=1e-12)
    assert with_desired_twist(found, robot) is found
    assert with_desired_twist(run, ROBOT) is run
