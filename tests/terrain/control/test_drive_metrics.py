import math

import numpy as np
import pytest

from terrain.control.drive_metrics import (
    adapt_times,
    course_of,
    distance_after,
    energy_to,
    final_speed,
    immobilised,
    lock_s,
    roughness,
    slip_peak,
    stop_distance,
)
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.slip import slip_ratio

ROBOT = load_robot("agrimaro")
STEP_S = 0.01
RADIUS_M = ROBOT.wheel_radius_m


def drive(radius_factors, duration_s=10.0, wheel_speed=1.0, **truth):
    """A log whose truth is what is given, as numbers or rows (n,); rims, of nominal wheels, of each or all.

    Slip is what is true of the wheels as they are, along each; it is no channel where it nowhere is defined.
    """
    time_s = np.arange(round(duration_s / STEP_S)) * STEP_S
    body = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "yaw_rad")
    wheel = ("steer_{}_rad", "torque_{}_nm", "traction_{}_n", "side_{}_n", "sinkage_{}_m")
    columns = dict.fromkeys(body, 0.0) | {name.format(i): 0.0 for name in wheel for i in (1, 2, 3)}
    wheel_speeds = wheel_speed if isinstance(wheel_speed, tuple) else (wheel_speed,) * 3
    columns |= {
        f"wheel_{i}_radps": np.asarray(row) / RADIUS_M for i, row in enumerate(wheel_speeds, 1)
    } | truth
    x, y, turn = (columns[name] for name in body[:3])
    for i, (factor, (x_m, y_m)) in enumerate(zip(radius_factors, ROBOT.wheel_positions_m, strict=True), 1):
        steer, rate = columns[f"steer_{i}_rad"], columns[f"wheel_{i}_radps"]
        ground = (x - turn * y_m) * np.cos(steer) + (y + turn * x_m) * np.sin(steer)
        slip = np.broadcast_to(slip_ratio(rate * factor * RADIUS_M, ground), time_s.shape)
        columns |= {f"slip_{i}_ratio": slip} if np.isfinite(slip).any() else {}
    values = np.column_stack([np.broadcast_to(column, time_s.shape) for column in columns.values()])
    return RunLog("drive", "agrimaro", {"truth": Stream(time_s, values, tuple(columns))})


def course(radius_factors=(1.0, 1.0, 1.0), **truth):
    return course_of(drive(radius_factors, **truth), ROBOT, radius_factors)


def time_of(duration_s=10.0):
    return np.arange(round(duration_s / STEP_S)) * STEP_S


def test_energy_is_what_motors_put_in_and_none_comes_back():
    torques = {"torque_1_nm": 3.0, "torque_2_nm": -2.0, "torque_3_nm": 1.0}
    found = course(speed_x_mps=0.8, wheel_speed=(1.0, 1.0, -0.5), **torques)
    power_w = 3.0 * 1.0 / RADIUS_M  # the second drags, the third is turned against its torque
    assert found.energy_j[-1] == pytest.approx(10.0 * power_w)
    assert found.distance_m[-1] == pytest.approx(8.0)
    assert energy_to(found, 4.0, 2.0) == pytest.approx(4.0 / 0.8 * power_w, rel=0.01)
    assert math.isnan(energy_to(found, 8.1))
    assert math.isnan(energy_to(found, 7.0, 2.0))
    assert distance_after(found, 2.0, 5.0) == pytest.approx(4.0)
    assert distance_after(found, 8.0, 5.0) == pytest.approx(1.6, abs=0.01)


def test_backward_and_sideways_cost_what_forward_does():
    crab = {f"steer_{i}_rad": math.pi / 2 for i in (1, 2, 3)}
    pull = {f"traction_{i}_n": 20.0 for i in (1, 2, 3)} | {f"torque_{i}_nm": 5.0 for i in (1, 2, 3)}
    push = {name: -value for name, value in pull.items()}
    forward = course(speed_x_mps=0.9, **pull)
    backward = course(speed_x_mps=-0.9, wheel_speed=-1.0, **push)
    left = course(speed_y_mps=0.9, **pull, **crab)
    for found in (forward, backward, left):
        assert found.distance_m[-1] == pytest.approx(9.0)
        assert found.energy_j[-1] == pytest.approx(10 * 3 * 5.0 / RADIUS_M)
        assert found.scrub_j[-1] == pytest.approx(10 * 3 * 20.0 * 0.1)
        assert slip_peak(found) == pytest.approx(0.1, abs=1e-6)


def test_scrub_is_what_contacts_take_up_along_the_wheels_and_across():
    found = course(
        speed_x_mps=1.0, speed_y_mps=0.1, traction_1_n=50.0, wheel_speed=(1.1, 1.0, 1.0), side_2_n=-30.0
    )
    assert found.scrub_along_j[-1] == pytest.approx(10 * 50.0 * 0.1)
    assert found.scrub_j[-1] == pytest.approx(10 * (50.0 * 0.1 + 30.0 * 0.1))


def test_wheels_that_fight_by_their_radii_take_energy_and_give_none():
    """One wheel 2 % larger, all told 5 rad/s: it pushes, the others drag, nothing else resists."""
    forces = {"traction_1_n": 40.0, "traction_2_n": -20.0, "traction_3_n": -20.0}
    found = course((1.02, 1.0, 1.0), speed_x_mps=1.005, **forces)
    assert found.wheel_speed_mps[0] == pytest.approx([1.02, 1.0, 1.0])
    assert found.scrub_along_j[-1] == pytest.approx(10 * 40.0 * 0.02)


def test_a_turning_robot_moves_at_each_wheel_as_a_rigid_body_does():
    turn = 0.4
    at_wheel = [math.hypot(-turn * y, turn * x) for x, y in ROBOT.wheel_positions_m]
    heads = {
        f"steer_{i}_rad": math.atan2(turn * x, -turn * y)
        for i, (x, y) in enumerate(ROBOT.wheel_positions_m, 1)
    }
    found = course(yaw_rate_radps=turn, wheel_speed=tuple(at_wheel), side_1_n=9.0, traction_2_n=9.0, **heads)
    assert found.ground_mps[0] == pytest.approx(at_wheel)
    assert found.scrub_j[-1] == pytest.approx(0.0, abs=1e-9)


def test_the_peak_of_slip_is_the_robots_while_it_is_fast_enough_and_no_bump_of_a_sample():
    time_s = time_of()
    speed = np.where(time_s < 2, 0.1, 0.5)
    wheel_speed = np.where(time_s < 2, 1.0, np.where(time_s < 4, 0.8, 0.5))
    wheel_speed[700] = 5.0  # one sample
    found = course(speed_x_mps=speed, wheel_speed=(wheel_speed, wheel_speed, np.full_like(wheel_speed, 0.5)))
    after = time_s > 3
    assert slip_peak(found, after & (time_s < 4)) == pytest.approx(2 / 3 * (1 - 0.5 / 0.8), abs=1e-3)
    assert slip_peak(found, time_s > 6.9) < 0.45
    assert slip_peak(found, (time_s > 4.5) & (time_s < 6.9)) == pytest.approx(0.0, abs=1e-3)
    assert math.isnan(slip_peak(found, time_s < 2))
    assert math.isnan(slip_peak(course(speed_x_mps=0.0, wheel_speed=0.0)))


def test_a_wheel_is_locked_where_it_hardly_turns_or_turns_against_its_way():
    time_s = time_of()
    early = time_s < 1.5
    found = course(
        speed_x_mps=-0.5,
        wheel_speed=(
            np.where(early, -0.04, -0.5),
            np.where(time_s < 0.5, 0.5, -0.5),
            np.full_like(time_s, -0.06),
        ),
    )
    assert lock_s(found) == pytest.approx(1.5)
    assert lock_s(course(speed_x_mps=0.09, wheel_speed=0.0)) == 0.0


def test_stuck_is_to_go_and_not_to_go_for_long_whatever_the_wheels_are_told():
    time_s = time_of(20.0)
    speed = np.full_like(time_s, 0.5)
    for start_s, length_s in ((2.0, 2.1), (6.0, 1.9), (10.0, 5.0), (17.0, 3.0)):
        speed[(time_s >= start_s) & (time_s < start_s + length_s)] = 0.0
    desired = np.where((time_s > 9) & (time_s < 16), 0.15, 1.0)  # nobody asks for much the third time
    control = Stream(time_s[::2], desired[::2, None], ("desired_mps",))
    assert immobilised(course(duration_s=20.0, speed_x_mps=speed), control) == 2


def test_to_turn_on_the_spot_is_to_go_and_to_slide_back_is_not():
    control = Stream(time_of(5.0), np.ones((500, 1)), ("desired_mps",))
    steer = {
        f"steer_{i}_rad": math.atan2(x_m, -y_m) for i, (x_m, y_m) in enumerate(ROBOT.wheel_positions_m, 1)
    }
    assert immobilised(course(duration_s=5.0, yaw_rate_radps=1.0, **steer), control) == 0
    assert immobilised(course(duration_s=5.0, speed_x_mps=-0.5), control) == 1


def test_final_speed_and_stopping_distance():
    time_s = time_of(30.0)
    speed = np.where(time_s < 20, 0.5, 0.8)
    found = course(duration_s=30.0, speed_x_mps=speed)
    assert final_speed(found) == pytest.approx(0.8, rel=1e-3)
    braked = np.clip(1.0 - (time_s - 10.0), 0.0, 1.0)
    found = course(duration_s=30.0, speed_x_mps=-braked)
    assert stop_distance(found, 10.0) == pytest.approx(0.5, abs=0.01)
    assert stop_distance(found, 9.0) == pytest.approx(1.5, abs=0.01)
    assert math.isnan(stop_distance(course(speed_x_mps=0.5), 1.0))


def test_adapting_lasts_until_the_target_is_near_that_of_the_new_ground():
    time_s = np.arange(0, 30, 0.02)
    target = np.interp(time_s, [0, 12, 14, 30], [0.1, 0.1, 0.3, 0.3])
    control = Stream(time_s, target[:, None], ("target_ratio",))
    found = adapt_times(control, [(10.0, 0.3), (20.0, 0.05), (25.0, 0.31)])
    assert found == pytest.approx([3.8, math.nan, 0.0], nan_ok=True, abs=0.03)
    assert adapt_times(control, []) == []


def test_roughness_is_the_rms_change_of_the_commands():
    time_s = np.arange(0, 10, 0.02)
    ramps = np.column_stack([2.0 * time_s, -2.0 * time_s, 2.0 * time_s])
    names = tuple(f"wheel_{i}_radps" for i in (1, 2, 3))
    assert roughness(Stream(time_s, ramps, names)) == pytest.approx(2.0)
