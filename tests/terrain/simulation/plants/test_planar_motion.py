"""The planar plant of skid-steer and swerve robots: kinematics, slip, forces and sensors against their formulas."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.effects import (
    ACCEL,
    CHANNELS,
    CURRENT,
    GYRO,
    SPEED_X,
    SPEED_Y,
    TURNING_CURRENT,
    bent_rate,
    vector_of,
)
from terrain.extension import corrected_log
from terrain.kinematics.commands import wheel_command_step
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.plants.dynamic import DEFLECTION_DAMPING_S, shear_slip
from terrain.simulation.plants.planar import (
    ENDO_POWER,
    RESTING_MPS,
    ROLLING_MPS,
    Ground,
    direction,
    make_planar,
    move,
    replay,
)

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")
ROBOTS = {"skid_steer": HUSKY, "swerve": AGRIMARO}
FREE = Ground(slip_ratio=0.0, grip_ratio=0.5, rolling_ratio=0.0, scrub_ratio=0.0)
"""Ground that takes neither slip nor resistance: kinematics alone."""

DT = 0.02
N = 1500
TIME_S = DT * np.arange(N)
TWISTS = {
    "straight": (0.8, 0.0, 0.0),
    "backward": (-0.8, 0.0, 0.0),
    "crab": (0.0, 0.5, 0.0),
    "diagonal": (0.4, -0.3, 0.0),
    "arc": (0.6, 0.0, 0.3),
    "spot": (0.0, 0.0, 0.5),
}


def aimed(robot, twist, radius_m=None):
    """Return the rates and steering angles for a twist, without limits."""
    limits = (1e9, 1e9, 1.0)
    radius_m = radius_m or robot.wheel_radius_m
    _, wheel, steer = wheel_command_step(
        robot.wheel_positions_m, radius_m, *limits, np.array(twist, float), np.zeros(3)
    )
    return wheel, steer


def still(robot):
    """Return the robot with a camera over its origin that tells at once."""
    camera = {"lever_x_m": 0.0, "lever_y_m": 0.0, "latency_s": 0.0, "time_constant_s": 0.0}
    return robot.with_parts(camera=replace(robot.camera, **camera))


def at_rate(value, n=N):
    return np.tile(np.asarray(value, dtype=float), (n, 1))


def skid(robot, speed, turn):
    half = 0.5 * robot.track_m * np.asarray(turn)
    return np.column_stack([speed - half, speed + half])


def rich(robot, dt=DT, length_s=30.0):
    """Return wheel speeds, steering, grade and roll of a drive that shows most effects."""
    t = dt * np.arange(round(length_s / dt))
    speed = 0.5 * np.sin(0.9 * t) + 0.35 * np.sin(0.31 * t)
    turn = 0.5 * np.sin(0.53 * t + 1.0)
    grade, roll = 0.08 * np.sin(0.23 * t), 0.06 * np.cos(0.29 * t)
    if robot.drive == "skid_steer":
        return skid(robot, speed, turn), np.zeros((t.size, 2)), grade, roll
    steer = np.column_stack([0.5 * np.sin(0.7 * t), -0.4 * np.sin(0.6 * t), 0.2 * np.sin(0.8 * t)])
    return np.column_stack([speed, 0.9 * speed, 1.1 * speed]), steer, grade, roll


def replayed(robot, values, wheel_speed, steer=None, grade=0.0, roll=0.0, ground=FREE, dt=DT):
    """Return channels (n,) by name."""
    n = len(wheel_speed)
    steer = np.zeros((n, wheel_speed.shape[1])) if steer is None else steer
    tilt = (np.array(np.broadcast_to(angle, n), dtype=float) for angle in (grade, roll))
    shown = replay(make_planar(robot, ground), vector_of(values), dt, wheel_speed, steer, *tilt)
    return dict(zip(CHANNELS, shown.T, strict=True))


@pytest.mark.parametrize("twist", TWISTS.values(), ids=TWISTS)
def test_the_wheels_of_a_twist_move_the_robot_by_that_twist(twist):
    robot = still(AGRIMARO)
    wheel, steer = aimed(robot, twist)
    shown = replayed(robot, {}, at_rate(wheel * robot.wheel_radius_m), at_rate(steer))
    for channel, value in zip((SPEED_X, SPEED_Y, GYRO), twist, strict=True):
        np.testing.assert_allclose(shown[channel], value, atol=1e-7)  # no contact is quite rigid
    if not twist[1]:
        shown = replayed(still(HUSKY), {}, at_rate(skid(HUSKY, twist[0], twist[2])[0]))
        np.testing.assert_allclose([shown[SPEED_X][-1], shown[GYRO][-1]], [twist[0], twist[2]], atol=1e-12)


@pytest.mark.parametrize("drive", ROBOTS)
def test_the_answer_hardly_depends_on_the_step(drive):
    planar = make_planar(ROBOTS[drive], Ground())
    for values in ({}, {"force_slip_ratio": 0.5, "turning_slip_ratio": 0.3, "payload_ratio": 0.5}):
        runs = (replay(planar, vector_of(values), dt, *rich(planar.robot, dt)) for dt in (0.02, 0.005))
        coarse, fine = runs
        off = (fine[::4] - coarse)[5:-5].std(axis=0)
        assert (off <= 0.02 * fine.std(axis=0) + 1e-12).all(), dict(zip(CHANNELS, off, strict=True))


def test_slip_follows_its_equation_of_force():
    """v = u - |u| c f with f = (m v' + m g sin th + R) / (m g), integrated by Euler in small steps."""
    ground = Ground(slip_ratio=0.6, rolling_ratio=0.0)
    dt, n = 1e-3, 12000
    t = dt * np.arange(n)
    u, grade = 0.7 + 0.3 * np.sin(2.5 * t), 0.1 * np.sin(0.8 * t)
    v = np.empty(n)
    v[0] = u[0]
    for k in range(n - 1):
        accel = ((u[k] - v[k]) / (abs(u[k]) * 0.6) - math.sin(grade[k])) * GRAVITY_MPS2
        v[k + 1] = v[k] + dt * accel
    shown = replayed(still(HUSKY), {}, np.column_stack([u, u]), grade=grade, ground=ground, dt=dt)
    np.testing.assert_allclose(shown[SPEED_X][500:], v[500:], atol=1e-4)
    # the same compliance as an effect, or shared
    for c in ({"force_slip_ratio": 0.6}, {"force_slip_ratio": 0.6, "shear_slip_ratio": 0.0}):
        free = replayed(still(HUSKY), c, np.column_stack([u, u]), grade=grade, ground=FREE, dt=dt)
        np.testing.assert_allclose(free[SPEED_X], shown[SPEED_X])


def twists(truth):
    return np.column_stack([truth[name] for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")])


def a_contact_for_each_wheel(robot, ground, wheel_speed, steer, dt):
    """Return speeds and yaw rate (n, 3) of the origin: each wheel slips by itself, by Euler's small steps."""
    wheels, body = robot.wheel_positions_m, robot.body
    com = np.array([body.com_x_m, body.com_y_m])
    arm, load_n = wheels - com, robot.mass_kg * GRAVITY_MPS2 / 3
    sigma, slip = body.relaxation_length_m, np.zeros((3, 2))
    v, w = np.zeros(2), 0.0
    out = np.zeros((len(wheel_speed), 3))
    for k in range(len(wheel_speed)):
        heading = np.column_stack([np.cos(steer[k]), np.sin(steer[k])])
        over = v + w * np.column_stack([-arm[:, 1], arm[:, 0]])
        rate = (wheel_speed[k][:, None] * heading - over - np.abs(wheel_speed[k])[:, None] * slip) / sigma
        push = load_n / ground.slip_ratio * (slip + DEFLECTION_DAMPING_S * rate)
        along = (over * heading).sum(axis=1)
        resist = ground.rolling_ratio * load_n * along / np.hypot(along, ROLLING_MPS)
        force = push - resist[:, None] * heading
        moment = (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]).sum()
        slip = slip + dt * rate
        v = v + dt * (force.sum(axis=0) / robot.mass_kg - w * np.array([-v[1], v[0]]))
        w += dt * moment / body.yaw_inertia_kgm2
        out[k] = v[0] + w * com[1], v[1] - w * com[0], w
    return out


def test_three_wheels_that_slip_each_by_itself_move_as_one_twist_that_slips():
    robot, dt, n = still(AGRIMARO), 1e-3, 7000
    robot = robot.with_parts(sensors=replace(robot.sensors, encoder_time_constant_s=0.0, imu_latency_s=0.0))
    ground = Ground(slip_ratio=1.2, rolling_ratio=0.08)
    t = dt * np.arange(n)
    ramp = np.clip(t, 0.0, 1.0)
    twist = np.column_stack([0.6 * ramp, 0.2 * ramp * np.sin(0.8 * t), 0.3 * ramp * np.sin(1.1 * t)])
    rolled = [aimed(robot, desired, 1.0) for desired in twist]
    wheel_speed, steer = (np.array(part) for part in zip(*rolled, strict=True))
    wheel_speed, steer = np.ascontiguousarray(wheel_speed), np.unwrap(steer, axis=0)
    each = a_contact_for_each_wheel(robot, ground, wheel_speed, steer, dt)
    level = np.zeros(n)
    planar = make_planar(robot, ground)
    one = twists(move(planar, vector_of({}), dt, wheel_speed, steer, level, level))
    lost = np.abs(each - twist)[1000:].mean(axis=0)
    assert (np.abs(one - each)[1000:].mean(axis=0) < 0.1 * lost).all()
    coarse = [np.ascontiguousarray(x[::40]) for x in (wheel_speed, steer, level)]
    coarse = twists(move(planar, vector_of({}), 40 * dt, *coarse, coarse[-1]))
    assert (np.abs(coarse - one[::40])[25:].mean(axis=0) < 0.01 * lost).all()


@pytest.mark.parametrize("grade", [0.0, 0.05])
@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_a_bent_thrust_curve_slips_by_its_inverse_and_a_load_presses_as_much_as_it_weighs(robot, grade):
    share = 1 - (1 - np.exp(-3 * (s := np.linspace(1e-9, 1.0, 101)))) / (3 * s)
    ground = Ground(rolling_ratio=0.1, thrust_ratio=tuple(0.4 * share), load_ratio=1.0)
    shown, loaded = (
        replayed(still(robot), values, at_rate([0.5] * len(robot.wheels)), grade=grade, ground=ground)[
            SPEED_X
        ]
        for values in ({}, {"payload_ratio": 0.5})
    )
    speed = shown[-1]
    resists = direction(speed) if robot is HUSKY else speed / math.hypot(speed, ROLLING_MPS)
    slip = np.interp(0.1 * resists + math.sin(grade), 0.4 * share, s)
    assert 1 - speed / 0.5 == pytest.approx(slip, rel=2e-3)
    assert loaded[-1] == pytest.approx(speed, rel=1e-6)


def test_shear_slip_is_the_inverse_of_its_curve_and_starts_with_slope_one():
    for grip in (0.3, 0.8):
        for force in np.linspace(-0.9, 0.9, 37) * grip:
            slip = shear_slip(force, grip)
            x = 2 * abs(slip) / grip  # s l / K with K/l = f_max / 2
            mobilised = 1 - (1 - math.exp(-x)) / x if x > 1e-6 else 0.0
            assert math.copysign(grip * mobilised, slip) == pytest.approx(force, abs=1e-6)
        assert shear_slip(1e-4, grip) == pytest.approx(1e-4, rel=1e-3)
        assert math.isfinite(shear_slip(5.0, grip))


def speeds(wheel_speed_mps, values, **options):
    return replayed(still(HUSKY), values, at_rate(wheel_speed_mps), **options)


def test_kinematic_effects_match_their_formulas():
    b, dv, ahead = HUSKY.track_m, 0.2, [0.5, 0.5]
    lost = 0.3 * dv / (dv + 1.0) * dv  # k q dv
    right, left = 0.6 ** (1 - ENDO_POWER), 0.4 ** (1 - ENDO_POWER)
    shared = 0.5 * lost * (right - left) / (right + left)
    for wheels, values, speed_mps, turn_radps in (
        (ahead, {"wheel_radius_ratio": 0.1}, 0.55, 0.0),
        (ahead, {"one_sided_radius_ratio": 0.1}, 0.5, 0.1 * 0.5 / b),
        ([0.4, 0.6], {"effective_track_ratio": 0.6}, 0.5, dv / (1.6 * b)),
        ([0.4, 0.6], {"turning_slip_ratio": 0.3}, 0.5 - shared, (dv - lost) / b),
        ([-0.1, 0.1], {"turning_slip_ratio": 0.3}, 0.0, 0.7 * dv / b),
    ):
        shown = speeds(wheels, values)
        assert [shown[SPEED_X][-1], shown[GYRO][-1]] == pytest.approx([speed_mps, turn_radps], abs=1e-12)
    for roll, speed in product((0.1, -0.1), (0.5, -0.5)):
        aside = speeds([speed, speed], {"side_hill_slip_ratio": 0.4}, roll=roll)[SPEED_Y][-1]
        assert aside == pytest.approx(-0.4 * roll * 0.5)  # downhill, in both driving directions


def test_a_turning_robot_slips_to_the_outside_of_the_turn_and_slows_down():
    for speed, turn in product((0.5, -0.5), (0.8, -0.8)):
        wheels = skid(HUSKY, speed, turn)
        # the centripetal acceleration w v_x points to the inside, the slip to the outside
        aside = speeds(wheels, {"turn_side_slip_s": 0.15})
        assert aside[SPEED_Y][-1] == pytest.approx(-0.15 * speed * turn)
        np.testing.assert_array_equal(aside[GYRO], speeds(wheels, {})[GYRO])
        for drag, share in ((0.7, 1 / (1 + 0.7 * turn**2)), (-0.1, 1 + 0.1 * turn**2)):
            assert speeds(wheels, {"turn_drag_s2": drag})[SPEED_X][-1] == pytest.approx(speed * share)
    # the yaw rate is that of the robot: with three times the track it turns a third
    wide = {"effective_track_ratio": 2.0, "turn_drag_s2": 0.9, "turn_side_slip_s": 0.2}
    shown, slow = speeds(skid(HUSKY, 0.5, 0.9), wide), 0.5 / (1 + 0.9 * 0.3**2)
    assert [shown[SPEED_X][-1], shown[SPEED_Y][-1]] == pytest.approx([slow, -0.2 * slow * 0.3])
    # slip along the ground takes speed and nothing else
    before, after = (speeds(skid(HUSKY, 0.5, 0.9), {"ground_slip_ratio": slip}) for slip in (0.0, 0.2))
    assert after[SPEED_X][-1] == pytest.approx(0.8 * before[SPEED_X][-1])
    np.testing.assert_array_equal(after[GYRO], before[GYRO])
    # no drag turns the motion about
    assert (speeds(skid(HUSKY, 0.5, 4.0), {"turn_drag_s2": 3.0})[SPEED_X] > 0).all()


def test_steering_effects_match_their_formulas():
    robot = still(AGRIMARO)
    wheel, steer = aimed(robot, [0.6, 0.0, 0.2])
    wheel_speed, swing = at_rate(wheel * 0.2), at_rate(steer) + 0.1 * np.sin(2 * TIME_S)[:, None]
    right, moved = (replayed(robot, {}, wheel_speed, angle) for angle in (at_rate(steer), swing))
    offsets = {f"steering_offset_{i}_rad": 0.03 * i for i in (1, 2, 3)}
    put_off = replayed(robot, offsets, wheel_speed, at_rate(steer - 0.03 * np.arange(1, 4)))
    for channel in (GYRO, SPEED_X, SPEED_Y):
        np.testing.assert_allclose(put_off[channel], right[channel], atol=1e-9)
    late = replayed(robot, {"steering_delay_s": 0.1}, wheel_speed, swing)[SPEED_Y]
    earlier = np.vstack([np.repeat(swing[:1], 5, axis=0), swing[:-5]])
    np.testing.assert_allclose(late, replayed(robot, {}, wheel_speed, earlier)[SPEED_Y], atol=1e-12)
    wide, narrow = (  # the first wider than the swing
        replayed(robot, {"steering_backlash_rad": play}, wheel_speed, swing)[SPEED_Y] for play in (0.2, 0.02)
    )
    np.testing.assert_allclose(wide, right[SPEED_Y], atol=1e-9)
    assert 0.7 < np.ptp(narrow[N // 2 :]) / np.ptp(moved[SPEED_Y]) < 0.9


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_forces_and_currents_balance(robot):
    ground = Ground(slip_ratio=0.3, rolling_ratio=0.06, scrub_ratio=0.0)
    nm_per_a, n = make_planar(robot, ground).body["nm_per_a"][0], len(robot.wheels)
    weight, grade, speed = robot.mass_kg * GRAVITY_MPS2, 0.07, 0.5
    slow = ROLLING_MPS if robot is AGRIMARO else RESTING_MPS
    friction_n = n * robot.motors.friction_nm / robot.wheel_radius_m * speed / math.hypot(speed, slow)

    def steady(**values):
        """Return pull, both speeds over the wheel speed, and the accelerometer, of a steady climb."""
        shown = replayed(still(robot), values, at_rate([speed] * n), grade=grade, ground=ground)
        pull_n = shown[CURRENT][-1] * nm_per_a / robot.wheel_radius_m - friction_n
        return pull_n, shown[SPEED_X][-1] / speed, shown[ACCEL][-1]

    pull, share, accel = steady()
    sign = share * speed / math.hypot(share * speed, slow)
    assert pull == pytest.approx(weight * (math.sin(grade) + 0.06 * sign))
    assert share == pytest.approx(1 - 0.3 * pull / weight)
    assert accel == pytest.approx(GRAVITY_MPS2 * math.sin(grade))
    assert steady(motor_constant_ratio=0.1)[0] == pytest.approx(1.1 * pull + 0.1 * friction_n)
    drift = 0.1 * TIME_S[-1] / 60
    assert steady(motor_drift_ratio=0.1)[0] == pytest.approx(pull + drift * (pull + friction_n))
    # the direction at the standstill's scale applies to a slower drive
    (dragged, by_drag, _), (slipped, by_slip, _) = (
        steady(**values) for values in ({"viscous_drag_nspm": 50.0}, {"slip_resistance_ratio": 0.5})
    )
    bent = 0.2 * shear_slip(pull / weight, ground.grip_ratio)
    for found, expected in (
        (steady(payload_ratio=0.2)[0], 1.2 * pull),
        (steady(rolling_resistance_ratio=0.02)[0], pull + 0.02 * sign * weight),
        (dragged, pull + 50.0 * by_drag * speed),
        (slipped, pull + 0.5 * weight * (1 - by_slip) * sign),
        (steady(force_slip_ratio=0.2)[1], 1 - 0.5 * pull / weight),
        (steady(shear_slip_ratio=0.2)[1], 1 - 0.3 * pull / weight - bent),
    ):
        assert found == pytest.approx(expected, rel=1e-4)


def test_turning_takes_current_of_the_difference_of_the_sides():
    ground, robot = Ground(scrub_ratio=0.2, rolling_ratio=0.06), HUSKY
    planar = make_planar(robot, ground)
    n_per_a = planar.body["nm_per_a"][0] / robot.wheel_radius_m
    weight, speed = robot.mass_kg * GRAVITY_MPS2, 0.3
    # each side has its own rolling resistance and friction, of which in place nothing is left in the sum
    own_n = (0.06 * weight + 2.0 * robot.motors.friction_nm / robot.wheel_radius_m) * direction(speed)
    drag = {"viscous_drag_nspm": 40.0}
    for sign, given in product((1.0, -1.0), ({}, drag)):
        values = {"turning_resistance_ratio": 0.1, **given}
        spot = replayed(robot, values, at_rate([-speed * sign, speed * sign]), ground=ground)
        force = sign * (
            0.3 * weight * direction(2 * speed) + own_n + given.get("viscous_drag_nspm", 0.0) * speed
        )
        assert spot[TURNING_CURRENT][-1] * n_per_a == pytest.approx(force)
        assert spot[CURRENT][-1] == pytest.approx(0.0, abs=1e-9)
    # in arcs by Nikitin's formula, and no more in the sum than scrub; that takes nothing of the difference
    radius_m = np.array([0.5, 2.0, 8.0])
    arcs = [skid(robot, np.full(N, 0.5), 0.5 / r) for r in radius_m]
    by, more, scrubbed = (
        [replayed(robot, v, arc, ground=ground) for arc in arcs]
        for v in ({}, {"turning_resistance_ratio": 0.4}, {"scrub_ratio": 0.4})
    )
    force_n = (
        np.array([(m[TURNING_CURRENT] - b[TURNING_CURRENT])[-1] for m, b in zip(more, by, strict=True)])
        * n_per_a
    )
    dv = 0.5 * robot.track_m / radius_m
    nikitin = 0.925 / (0.925 + 0.15 * radius_m / robot.track_m)
    np.testing.assert_allclose(
        force_n / (0.4 * weight * np.array([direction(v) for v in dv])), nikitin, rtol=0.01
    )
    for b, m, s in zip(by, more, scrubbed, strict=True):
        assert m[CURRENT][-1] == b[CURRENT][-1] < s[CURRENT][-1]
        assert s[TURNING_CURRENT][-1] == pytest.approx(b[TURNING_CURRENT][-1], rel=1e-3)
    spin = 0.4 / TIME_S[-1]
    speeding = replayed(robot, {}, skid(robot, np.full(N, 5.0), spin * TIME_S))
    moment = planar.body["yaw_inertia_kgm2"][0] * spin
    assert speeding[TURNING_CURRENT][N // 2] * n_per_a == pytest.approx(2 * moment / robot.track_m, rel=1e-3)


def test_a_track_narrows_or_widens_with_the_turn_alone():
    for turn, k in product((0.3, -2.0), (0.4, -0.3)):
        shown = speeds(skid(HUSKY, 0.5, turn), {"track_narrowing_by_turn_ratio": k})[GYRO][-1]
        x = k * abs(turn) / (1.0 + abs(turn))
        assert shown == pytest.approx(turn * (1.0 + x / (1.0 + abs(x))))


def test_a_gyro_bends_and_saturates():
    for turn in (0.2, -1.5, 30.0):
        shown = speeds(skid(HUSKY, 0.0, turn), {"gyro_nonlinearity_s2": 0.08, "gyro_scale_ratio": 0.1})[GYRO][
            -1
        ]
        assert shown == pytest.approx(1.1 * bent_rate(turn, 0.08))
    assert shown < 1.1 / math.sqrt(0.16)


def test_a_wheel_follows_its_motor_through_play_and_a_dead_zone():
    """At a reversal the wheel stands until the motor has crossed the backlash."""
    speed = np.where(TIME_S < 10.0, 0.5, -0.5)[:, None] * np.minimum(np.abs(TIME_S - 10.0), 1.0)[:, None]
    both = np.hstack([speed, speed])
    played = replayed(still(HUSKY), {"drive_backlash_rad": 0.2}, both)[SPEED_X]
    lost_m = 0.2 * HUSKY.wheel_radius_m
    ahead = TIME_S < 10.0
    lost = speed[:, 0] - played
    assert np.trapezoid(lost[ahead], dx=DT) == pytest.approx(lost_m, rel=0.01)  # from its middle
    assert np.trapezoid(lost[~ahead], dx=DT) == pytest.approx(-2 * lost_m, rel=0.01)
    assert (played * speed[:, 0] > -1e-9).all()  # a wheel does not turn back in the play
    dead = speeds(at_rate([0.4, -0.4]), {"wheel_dead_zone_mps": 0.03})
    assert dead[GYRO][-1] == pytest.approx(-2 * (0.4 + 0.03 * direction(0.4)) / HUSKY.track_m)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("husky", {"drive_backlash_rad": 0.1, "wheel_dead_zone_mps": 0.02}),
        ("adap2e", {"drive_backlash_rad": 0.1, "wheel_dead_zone_mps": 0.02}),
        ("adap2e", {"steering_gain_ratio": -0.1}),
        ("adap2e", {"steering_dead_zone_rad": 0.03, "steering_gain_ratio": 0.1}),
        ("adap2e", {"steering_lag_s": 0.2, "steering_gain_ratio": 0.1, "steering_offset_front_rad": 0.02}),
        ("adap2e", {"steering_lag_s": 0.2, "steering_backlash_rad": 0.03}),
        ("agrimaro", {"steering_gain_ratio": 0.05, "steering_lag_s": 0.15}),
        ("robotino", {"drive_backlash_rad": 0.1}),
    ],
)
def test_what_comes_off_a_log_is_what_the_replay_puts_on(name, values):
    """Two routes: the replay of a log with effects, and that without of the corrected log."""
    robot = load_robot(name)
    wheels = 0.5 * np.sin(0.9 * TIME_S)[:, None] * np.linspace(1.0, 1.2, len(robot.wheels))
    wheels = wheels[:, -1:] if name == "adap2e" else wheels
    steer = 0.2 * np.sin(0.7 * TIME_S + 0.4)[:, None] * np.ones(max(len(robot.steer_channels), 2))
    logged = {}
    speed_names = [f"speed_{w}_mps" for w in robot.logged_wheels]
    logged["wheels"] = Stream(TIME_S, wheels, tuple(speed_names[-wheels.shape[1] :]))
    if robot.steered:
        zeros = robot.steering_zeros_rad[: len(robot.steer_channels)]
        logged["steering"] = Stream(TIME_S, steer[:, : len(zeros)] + zeros, robot.steer_channels)
    back = corrected_log(RunLog("a", name, logged), replace(robot, effects=values)).streams
    true_steer = steer.copy()
    if robot.steered:
        true_steer[:, : len(zeros)] = back["steering"].values - zeros
    planar = make_planar(robot, FREE)
    level = np.zeros(N)
    one = replay(planar, vector_of(values), DT, wheels, steer, level, level)
    other = replay(planar, vector_of({}), DT, back["wheels"].values, true_steer, level, level)
    np.testing.assert_allclose(one[5:], other[5:], atol=2e-3)
