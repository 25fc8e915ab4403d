"""Metrics of drives whose truth is made up, and controllers compared seed by seed."""

import math

import numpy as np
import pytest

from terrain.control.drive_metrics import (
    LEAST_RAMP_MPS2,
    Comparison,
    Drive,
    adaptation_times,
    command_change,
    distance_within,
    drive_history,
    energy_at_equal_distance,
    energy_over,
    final_speed,
    immobilised,
    matching_ramp,
    slip_peak,
    steepest_grade,
    stopping_distance,
    turn_figures,
)
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.scenario import STAND, Leg, fastest_mps_of, from_legs
from terrain.slip import slip_ratio

ROBOT = load_robot("agrimaro")
STEP_S, RADIUS_M = 0.01, ROBOT.wheel_radius_m
EVEN = (1.0, 1.0, 1.0)


def time_of(duration_s=10.0):
    return np.arange(round(duration_s / STEP_S)) * STEP_S


def all_wheels(**values):
    """Channels of each wheel: ``torque_nm=3.0`` is ``torque_1_nm`` to ``torque_3_nm``."""
    return {name.replace("_", f"_{i}_", 1): value for name, value in values.items() for i in (1, 2, 3)}


def history(radius_factors=EVEN, duration_s=10.0, wheel_speed=1.0, **truth):
    """That of a truth given as numbers or rows (n,); wheel speeds, of nominal wheels, of each or all.

    Slip is what is true of the wheels as they are, along each; it is no channel where it nowhere is defined.
    """
    time_s = time_of(duration_s)
    columns = dict.fromkeys(("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "yaw_rad"), 0.0)
    columns |= all_wheels(steer_rad=0.0, torque_nm=0.0, traction_n=0.0, side_n=0.0, sinkage_m=0.0)
    speeds = wheel_speed if isinstance(wheel_speed, tuple) else (wheel_speed,) * 3
    columns |= {f"wheel_{i}_radps": np.asarray(row) / RADIUS_M for i, row in enumerate(speeds, 1)} | truth
    x, y, turn = (columns[name] for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"))
    for i, (factor, (x_m, y_m)) in enumerate(zip(radius_factors, ROBOT.wheel_positions_m, strict=True), 1):
        steer, rate = columns[f"steer_{i}_rad"], columns[f"wheel_{i}_radps"]
        ground = (x - turn * y_m) * np.cos(steer) + (y + turn * x_m) * np.sin(steer)
        slip = np.broadcast_to(slip_ratio(rate * factor * RADIUS_M, ground), time_s.shape)
        columns |= {f"slip_{i}_ratio": slip} if np.isfinite(slip).any() else {}
    values = np.column_stack([np.broadcast_to(column, time_s.shape) for column in columns.values()])
    run = RunLog("drive", "agrimaro", {"truth": Stream(time_s, values, tuple(columns))})
    return drive_history(run, ROBOT, radius_factors)


def test_energy_is_the_positive_work_of_the_motors():
    torques = {"torque_1_nm": 3.0, "torque_2_nm": -2.0, "torque_3_nm": 1.0}
    found = history(speed_x_mps=0.8, wheel_speed=(1.0, 1.0, -0.5), **torques)
    power_w = 3.0 * 1.0 / RADIUS_M  # the second drags, the third is turned against its torque
    assert found.energy_j[-1] == pytest.approx(10.0 * power_w)
    assert energy_over(found, 4.0, 2.0) == pytest.approx(4.0 / 0.8 * power_w, rel=0.01)
    assert math.isnan(energy_over(found, 8.1))
    assert math.isnan(energy_over(found, 7.0, 2.0))
    assert distance_within(found, 2.0, 5.0) == pytest.approx(4.0)
    assert distance_within(found, 8.0, 5.0) == pytest.approx(1.6, abs=0.01)


def test_backward_and_sideways_drives_have_the_metrics_of_forward_ones():
    pull, push = (all_wheels(traction_n=sign * 20.0, torque_nm=sign * 5.0) for sign in (1, -1))
    for found in (
        history(speed_x_mps=0.9, **pull),
        history(speed_x_mps=-0.9, wheel_speed=-1.0, **push),
        history(speed_y_mps=0.9, **pull, **all_wheels(steer_rad=math.pi / 2)),
    ):
        assert found.distance_m[-1] == pytest.approx(9.0)
        assert found.energy_j[-1] == pytest.approx(10 * 3 * 5.0 / RADIUS_M)
        assert found.scrub_j[-1] == pytest.approx(10 * 3 * 20.0 * 0.1)
        assert slip_peak(found) == pytest.approx(0.1, abs=1e-6)


def test_scrub_is_the_energy_dissipated_along_the_wheels_and_across():
    speeds = {"speed_x_mps": 1.0, "speed_y_mps": 0.1, "wheel_speed": (1.1, 1.0, 1.0)}
    found = history(traction_1_n=50.0, side_2_n=-30.0, **speeds)
    assert found.scrub_along_j[-1] == pytest.approx(10 * 50.0 * 0.1)
    assert found.scrub_j[-1] == pytest.approx(10 * (50.0 * 0.1 + 30.0 * 0.1))
    # one wheel 2 % larger, all at 5 rad/s: it pushes, the others drag, no other resistance
    forces = {"traction_1_n": 40.0, "traction_2_n": -20.0, "traction_3_n": -20.0}
    found = history((1.02, 1.0, 1.0), speed_x_mps=1.005, **forces)
    assert found.scrub_along_j[-1] == pytest.approx(10 * 40.0 * 0.02)
    # in a turn each wheel moves as of a rigid body
    at_wheel = tuple(0.4 * math.hypot(x, y) for x, y in ROBOT.wheel_positions_m)
    heads = {f"steer_{i}_rad": math.atan2(x, -y) for i, (x, y) in enumerate(ROBOT.wheel_positions_m, 1)}
    found = history(yaw_rate_radps=0.4, wheel_speed=at_wheel, side_1_n=9.0, traction_2_n=9.0, **heads)
    assert found.ground_mps[0] == pytest.approx(at_wheel)
    assert found.scrub_j[-1] == pytest.approx(0.0, abs=1e-9)
    control = Stream(time_of(), np.ones((1000, 1)), ("desired_mps",))
    slides_back = history(speed_x_mps=-0.5)
    assert (immobilised(found, control), immobilised(slides_back, control)) == (0, 1)


@pytest.mark.parametrize(
    ("speed_mps", "wheel_mps", "commanded_mps", "figures"),
    [
        (0.5, 0.6, 0.6, (0.1, 0.0)),
        (0.5, 0.6, fastest_mps_of(ROBOT), (math.nan, 1.0)),  # the motors give no more,
        (0.5, 0.6, 0.9, (math.nan, 1.0)),
        (0.25, 0.6, 0.6, (math.nan, 1.0)),  # the ground does not
    ],
)
def test_the_error_of_a_turn_counts_where_ground_and_motors_give_it(
    speed_mps, wheel_mps, commanded_mps, figures
):
    scenario = from_legs("turn", "grass", [STAND, Leg(np.array([0.5, 0.0, 0.3]), 8.0)])
    found = history(speed_x_mps=speed_mps, yaw_rad=0.27 * time_of(), wheel_speed=wheel_mps)
    rates = np.full((1000, 3), commanded_mps / RADIUS_M)
    run = RunLog("drive", "", {"commands": Stream(time_of(), rates, tuple(all_wheels(wheel_radps=0)))})
    assert turn_figures(run, found, ROBOT, scenario) == pytest.approx(figures, nan_ok=True)
    straight = from_legs("straight", "grass", [STAND, Leg(np.array([0.5, 0.0, 0.0]), 8.0)])
    assert turn_figures(run, found, ROBOT, straight) == pytest.approx((math.nan, math.nan), nan_ok=True)


def test_peak_slip_is_the_mean_over_wheels_above_a_speed_and_ignores_single_samples():
    time_s = time_of()
    speed = np.where(time_s < 2, 0.1, 0.5)
    wheel_speed = np.where(time_s < 2, 1.0, np.where(time_s < 4, 0.8, 0.5))
    wheel_speed[700] = 5.0  # one sample
    found = history(speed_x_mps=speed, wheel_speed=(wheel_speed, wheel_speed, np.full_like(wheel_speed, 0.5)))
    assert slip_peak(found, (time_s > 3) & (time_s < 4)) == pytest.approx(2 / 3 * (1 - 0.5 / 0.8), abs=1e-3)
    assert slip_peak(found, time_s > 6.9) < 0.45
    assert slip_peak(found, (time_s > 4.5) & (time_s < 6.9)) == pytest.approx(0.0, abs=1e-3)
    assert math.isnan(slip_peak(found, time_s < 2))


def test_a_robot_is_stuck_where_it_does_not_move_although_desired():
    time_s = time_of(20.0)
    speed = np.full_like(time_s, 0.5)
    for start_s, length_s in ((2.0, 2.1), (6.0, 1.9), (10.0, 5.0), (17.0, 3.0)):
        speed[(time_s >= start_s) & (time_s < start_s + length_s)] = 0.0
    desired = np.where((time_s > 9) & (time_s < 16), 0.15, 1.0)  # a low speed is desired the third time
    control = Stream(time_s[::2], desired[::2, None], ("desired_mps",))
    assert immobilised(history(duration_s=20.0, speed_x_mps=speed), control) == 2


def test_final_speed_stopping_distance_and_command_change():
    time_s = time_of(30.0)
    faster = history(duration_s=30.0, speed_x_mps=np.where(time_s < 20, 0.5, 0.8))
    assert final_speed(faster) == pytest.approx(0.8)
    found = history(duration_s=30.0, speed_x_mps=-np.clip(1.0 - (time_s - 10.0), 0.0, 1.0))
    stops_m = [stopping_distance(found, start_s) for start_s in (10.0, 9.0)]
    assert stops_m == pytest.approx([0.5, 1.5], abs=0.01)
    assert math.isnan(stopping_distance(history(speed_x_mps=0.5), 1.0))
    ramps = np.column_stack([2.0 * time_s, -2.0 * time_s, 2.0 * time_s])
    names = tuple(f"wheel_{i}_radps" for i in (1, 2, 3))
    assert command_change(Stream(time_s, ramps, names)) == pytest.approx(2.0)


def test_adaptation_lasts_until_the_target_is_close_to_that_of_the_new_terrain():
    time_s = np.arange(0, 30, 0.02)
    target = np.interp(time_s, [0, 12, 14, 30], [0.1, 0.1, 0.3, 0.3])
    control = Stream(time_s, target[:, None], ("target_ratio",))
    found = adaptation_times(control, [(10.0, 0.3), (20.0, 0.05), (25.0, 0.31)])
    assert found == pytest.approx([3.8, math.nan, 0.0], nan_ok=True, abs=0.03)
    assert adaptation_times(control, []) == []


def test_energy_is_compared_over_the_distance_that_all_travelled():
    energy = np.array([0.0, 100.0, 300.0])
    curves = [(np.array([0.0, end / 2, end]), energy) for end in (8.0, 6.0, 1.0)]  # the last is stuck
    expected = [200.0 / 6.0, 300.0 / 6.0, math.nan]
    assert energy_at_equal_distance(curves) == pytest.approx(expected, nan_ok=True)


def compared(scenario="starts", **values):
    """Controllers with the values of one metric at each seed."""
    return Comparison(scenario, {name: [{key: v} for v in each] for name, (key, each) in values.items()})


def test_a_difference_is_taken_seed_by_seed():
    plain, gain = np.array([1.0, 2.0, 3.0, 4.0]), np.array([-0.19, -0.21, -0.2, -0.2])
    both = compared(plain=("slip_peak", plain), fallback=("slip_peak", plain + gain))
    found = both.difference("fallback", "plain", "slip_peak")
    assert found.mean == pytest.approx(-0.08)
    assert found.is_significant
    half = 3.182 * gain.std(ddof=1) / 2  # Student's with three degrees of freedom
    assert found.ci[1] - found.ci[0] == pytest.approx(2 * half / plain.mean(), rel=1e-3)
    without = plain + gain + [math.nan, 0.0, 0.0, 0.0]
    found = compared(plain=("slip_peak", plain), fallback=("slip_peak", without))
    assert found.difference("fallback", "plain", "slip_peak").mean == pytest.approx(gain[1:].mean() / 3.0)
    one = compared(plain=("slip_peak", [1.0]), fallback=("slip_peak", [0.5]))
    assert not one.difference("fallback", "plain", "slip_peak").is_significant


def test_the_ramp_travels_as_far_as_the_first_reference():
    def drives(distance_m):
        return [Drive({"distance_m": distance_m}, None)]

    given = {"plain": drives(9.0), "fallback": drives(2.0), "true_terrain+track": drives(3.0)}
    found = matching_ramp(given, lambda ramp_mps2: drives(10.0 * ramp_mps2), "straight", 1.0)
    assert found == pytest.approx(0.3, rel=0.02)
    assert matching_ramp({"plain": drives(1.0)}, None, "straight", 1.0) is None
    none = matching_ramp(given, lambda ramp_mps2: drives(99.0), "straight", math.inf)
    assert none == pytest.approx(LEAST_RAMP_MPS2, rel=0.05)


@pytest.mark.parametrize("true_deg", [-3.0, 17.4])
def test_the_steepest_grade_is_that_at_which_climbing_ends(true_deg):
    def drive(grade_deg):
        speed = 0.5 if grade_deg < true_deg else 0.0
        truth = Stream(np.arange(200) / 100, np.full((200, 1), speed), ("speed_x_mps",))
        return RunLog("drive", "agrimaro", {"truth": truth}, ((0.0, 2.0, "grass"),))

    assert steepest_grade(drive) == pytest.approx(true_deg, abs=0.1)
