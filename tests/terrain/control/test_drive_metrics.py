import math

import numpy as np
import pytest

from terrain.control.drive_metrics import (
    adaptation_times,
    command_change,
    distance_within,
    drive_history,
    energy_over,
    final_speed,
    immobilised,
    lock_s,
    slip_peak,
    stopping_distance,
)
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.slip import slip_ratio

ROBOT = load_robot("agrimaro")
STEP_S = 0.01
RADIUS_M = ROBOT.wheel_radius_m


def drive(radius_factors, duration_s=10.0, wheel_speed=1.0, **truth):
    """A log whose truth is given as numbers or rows (n,); wheel speeds, of nominal wheels, of each or all.

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


def history(radius_factors=(1.0, 1.0, 1.0), **truth):
    return drive_history(drive(radius_factors, **truth), ROBOT, radius_factors)


def time_of(duration_s=10.0):
    return np.arange(round(duration_s / STEP_S)) * STEP_S


def test_energy_is_the_positive_work_of_the_motors():
    torques = {"torque_1_nm": 3.0, "torque_2_nm": -2.0, "torque_3_nm": 1.0}
    found = history(speed_x_mps=0.8, wheel_speed=(1.0, 1.0, -0.5), **torques)
    power_w = 3.0 * 1.0 / RADIUS_M  # the second drags, the third is turned against its torque
    assert found.energy_j[-1] == pytest.approx(10.0 * power_w)
    assert found.distance_m[-1] == pytest.approx(8.0)
    assert energy_over(found, 4.0, 2.0) == pytest.approx(4.0 / 0.8 * power_w, rel=0.01)
    assert math.isnan(energy_over(found, 8.1))
    assert math.isnan(energy_over(found, 7.0, 2.0))
    assert distance_within(found, 2.0, 5.0) == pytest.approx(4.0)
    assert distance_within(found, 8.0, 5.0) == pytest.approx(1.6, abs=0.01)


def test_backward_and_sideways_drives_have_the_metrics_of_forward_ones():
    crab = {f"steer_{i}_rad": math.pi / 2 for i in (1, 2, 3)}
    pull = {f"traction_{i}_n": 20.0 for i in (1, 2, 3)} | {f"torque_{i}_nm": 5.0 for i in (1, 2, 3)}
    push = {name: -value for name, value in pull.items()}
    forward = history(speed_x_mps=0.9, **pull)
    backward = history(speed_x_mps=-0.9, wheel_speed=-1.0, **push)
    left = history(speed_y_mps=0.9, **pull, **crab)
    for found in (forward, backward, left):
        assert found.distance_m[-1] == pytest.approx(9.0)
        assert found.energy_j[-1] == pytest.approx(10 * 3 * 5.0 / RADIUS_M)
        assert found.scrub_j[-1] == pytest.approx(10 * 3 * 20.0 * 0.1)
        assert slip_peak(found) == pytest.approx(0.1, abs=1e-6)


def test_scrub_is_the_energy_dissipated_along_the_wheels_and_across():
    found = history(
        speed_x_mps=1.0, speed_y_mps=0.1, traction_1_n=50.0, wheel_speed=(1.1, 1.0, 1.0), side_2_n=-30.0
    )
    assert found.scrub_along_j[-1] == pytest.approx(10 * 50.0 * 0.1)
    assert found.scrub_j[-1] == pytest.approx(10 * (50.0 * 0.1 + 30.0 * 0.1))


def test_wheels_of_different_radii_dissipate_energy():
    """One wheel 2 % larger, all at 5 rad/s: it pushes, the others drag, no other resistance."""
    forces = {"traction_1_n": 40.0, "traction_2_n": -20.0, "traction_3_n": -20.0}
    found = history((1.02, 1.0, 1.0), speed_x_mps=1.005, **forces)
    assert found.wheel_speed_mps[0] == pytest.approx([1.02, 1.0, 1.0])
    assert found.scrub_along_j[-1] == pytest.approx(10 * 40.0 * 0.02)


def test_a_turning_robot_moves_at_each_wheel_as_a_rigid_body():
    turn = 0.4
    at_wheel = [math.hypot(-turn * y, turn * x) for x, y in ROBOT.wheel_positions_m]
    heads = {
        f"steer_{i}_rad": math.atan2(turn * x, -turn * y)
        for i, (x, y) in enumerate(ROBOT.wheel_positions_m, 1)
    }
    found = history(yaw_rate_radps=turn, wheel_speed=tuple(at_wheel), side_1_n=9.0, traction_2_n=9.0, **heads)
    assert found.ground_mps[0] == pytest.approx(at_wheel)
    assert found.scrub_j[-1] == pytest.approx(0.0, abs=1e-9)


def test_peak_slip_is_the_mean_over_wheels_above_a_speed_and_ignores_single_samples():
    time_s = time_of()
    speed = np.where(time_s < 2, 0.1, 0.5)
    wheel_speed = np.where(time_s < 2, 1.0, np.where(time_s < 4, 0.8, 0.5))
    wheel_speed[700] = 5.0  # one sample
    found = history(speed_x_mps=speed, wheel_speed=(wheel_speed, wheel_speed, np.full_like(wheel_speed, 0.5)))
    after = time_s > 3
    assert slip_peak(found, after & (time_s < 4)) == pytest.approx(2 / 3 * (1 - 0.5 / 0.8), abs=1e-3)
    assert slip_peak(found, time_s > 6.9) < 0.45
    assert slip_peak(found, (time_s > 4.5) & (time_s < 6.9)) == pytest.approx(0.0, abs=1e-3)
    assert math.isnan(slip_peak(found, time_s < 2))
    assert math.isnan(slip_peak(history(speed_x_mps=0.0, wheel_speed=0.0)))


def test_a_wheel_is_locked_where_it_hardly_turns_or_turns_backwards():
    time_s = time_of()
    early = time_s < 1.5
    found = history(
        speed_x_mps=-0.5,
        wheel_speed=(
            np.where(early, -0.04, -0.5),
            np.where(time_s < 0.5, 0.5, -0.5),
            np.full_like(time_s, -0.06),
        ),
    )
    assert lock_s(found) == pytest.approx(1.5)
    assert lock_s(history(speed_x_mps=0.09, wheel_speed=0.0)) == 0.0


def test_a_robot_is_stuck_where_it_does_not_move_although_desired():
    time_s = time_of(20.0)
    speed = np.full_like(time_s, 0.5)
    for start_s, length_s in ((2.0, 2.1), (6.0, 1.9), (10.0, 5.0), (17.0, 3.0)):
        speed[(time_s >= start_s) & (time_s < start_s + length_s)] = 0.0
    desired = np.where((time_s > 9) & (time_s < 16), 0.15, 1.0)  # a low speed is desired the third time
    control = Stream(time_s[::2], desired[::2, None], ("desired_mps",))
    assert immobilised(history(duration_s=20.0, speed_x_mps=speed), control) == 2


def test_turning_on_the_spot_is_not_stuck_and_sliding_back_is():
    control = Stream(time_of(5.0), np.ones((500, 1)), ("desired_mps",))
    steer = {
        f"steer_{i}_rad": math.atan2(x_m, -y_m) for i, (x_m, y_m) in enumerate(ROBOT.wheel_positions_m, 1)
    }
    assert immobilised(history(duration_s=5.0, yaw_rate_radps=1.0, **steer), control) == 0
    assert immobilised(history(duration_s=5.0, speed_x_mps=-0.5), control) == 1


def test_final_speed_and_stopping_distance():
    time_s = time_of(30.0)
    speed = np.where(time_s < 20, 0.5, 0.8)
    found = history(duration_s=30.0, speed_x_mps=speed)
    assert final_speed(found) == pytest.approx(0.8, rel=1e-3)
    braked = np.clip(1.0 - (time_s - 10.0), 0.0, 1.0)
    found = history(duration_s=30.0, speed_x_mps=-braked)
    assert stopping_distance(found, 10.0) == pytest.approx(0.5, abs=0.01)
    assert stopping_distance(found, 9.0) == pytest.approx(1.5, abs=0.01)
    assert math.isnan(stopping_distance(history(speed_x_mps=0.5), 1.0))


def test_adaptation_lasts_until_the_target_is_close_to_that_of_the_new_terrain():
    time_s = np.arange(0, 30, 0.02)
    target = np.interp(time_s, [0, 12, 14, 30], [0.1, 0.1, 0.3, 0.3])
    control = Stream(time_s, target[:, None], ("target_ratio",))
    found = adaptation_times(control, [(10.0, 0.3), (20.0, 0.05), (25.0, 0.31)])
    assert found == pytest.approx([3.8, math.nan, 0.0], nan_ok=True, abs=0.03)
    assert adaptation_times(control, []) == []


def test_command_change_is_the_rms_rate_of_change():
    time_s = np.arange(0, 10, 0.02)
    ramps = np.column_stack([2.0 * time_s, -2.0 * time_s, 2.0 * time_s])
    names = tuple(f"wheel_{i}_radps" for i in (1, 2, 3))
    assert command_change(Stream(time_s, ramps, names)) == pytest.approx(2.0)
