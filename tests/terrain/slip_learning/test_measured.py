from dataclasses import replace

import numpy as np
import pytest

from terrain.errors import ConfigError, DataError
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.signals import DelayStatus
from terrain.simulation.plants.planar import Ground
from terrain.simulation.run import simulate
from terrain.slip_learning.ground_changes import slip_step
from terrain.slip_learning.measured import (
    Measured,
    _misfit,
    estimate_delay,
    measured_slip,
    outside_source,
    spinning_wheels,
    surface_slips,
    travelled,
    wheel_speeds,
    window_rates,
)
from terrain.slip_learning.sessions import IntervalOf

HUSKY = load_robot("husky")


def test_a_window_across_two_parts_or_with_few_samples_has_no_rate():
    time_s = np.linspace(0.0, 4.0, 41)
    part = (time_s > 2.0).astype(np.int64)
    rates, _ = window_rates(
        time_s, time_s[:, None], part, np.array([0.0, 1.0, 2.1, 3.8]), np.array([2.0, 3.0, 4.0, 5.0]), 4, 0.8
    )
    np.testing.assert_allclose(rates[:, 0], [1.0, np.nan, 1.0, np.nan], equal_nan=True)


def test_a_jump_and_a_gap_begin_new_parts_and_add_nothing(make_omni_run, robotino):
    run = make_omni_run(noise_m=0.0, slip=0.0)
    pose = run.streams["pose"]
    values = pose.values.copy()
    values[100:, :2] += 3.0
    kept = np.r_[0:200, 240:320]
    broken = replace(
        run, streams={**run.streams, "pose": Stream(pose.time_s[kept], values[kept], pose.channels)}
    )
    found = travelled(broken, robotino)
    assert (found.n_jumps, found.n_gaps) == (1, 1)
    assert found.part[[0, 99, 100, 199, 200, -1]].tolist() == [0, 0, 1, 1, 2, 2]
    length_m = np.hypot(*found.values[-1, :2])
    assert length_m < 0.1 * 10.0  # what was driven in the gap is not made up


@pytest.mark.parametrize("slip", [0.0, 0.5, -0.2])
@pytest.mark.parametrize("twist", [(0.1, 0.0, 0.0), (-0.05, 0.0866, 0.0), (0.2, 0.1, 0.4), (0.0, -0.3, -0.8)])
def test_a_hidden_slip_of_an_omni_robot_comes_back(make_omni_run, robotino, slip, twist):
    found = measured_slip(make_omni_run(twist=twist, slip=slip, noise_m=0.0, start_s=-1.0), robotino)
    steady = found.steady
    assert steady.sum() >= 7
    expected = slip if slip >= 0 else slip / (1 - slip)  # relative to the faster, here the ground
    np.testing.assert_allclose(found.body_slip[steady], expected, atol=2e-3)
    known = np.isfinite(found.slip_ratio[steady])
    sign = np.where(found.wheel_speed_mps[steady] < 0, -1.0, 1.0)
    np.testing.assert_allclose((found.slip_ratio[steady] * sign)[known], expected, atol=5e-3)
    np.testing.assert_allclose(
        found.rolled_twist[steady], np.broadcast_to(twist, (steady.sum(), 3)), atol=1e-3
    )


def test_the_stated_std_of_a_slip_covers_its_error(make_omni_run, robotino):
    inside, errors = [], []
    for seed in range(8):
        run = make_omni_run(np.random.default_rng(seed), slip=0.3, noise_m=0.002)
        found = measured_slip(run, robotino)
        errors.append((found.body_slip - 0.3)[found.steady])
        inside.append(np.abs(errors[-1]) < 1.96 * found.body_slip_std[found.steady])
    assert 0.85 < np.mean(np.concatenate(inside)) <= 1.0
    assert np.std(np.concatenate(errors)) > 0.002


def test_skid_steer_slip_is_measured_against_a_speed_over_ground():
    twist = np.zeros((800, 3))
    twist[50:, 0] = 0.8
    run = simulate(HUSKY, twist, Ground(), 0, effects={"force_slip_ratio": 2.0, "wheel_radius_ratio": -0.1})
    found = measured_slip(run, HUSKY)
    truth = run.streams["truth"]
    true = 1.0 - np.median(truth.channel("speed_x_mps")[1000:]) / 0.8
    np.testing.assert_allclose(np.median(found.body_slip[found.steady]), true, atol=0.01)
    assert true > 0.1


def test_a_receiver_measures_the_slip_of_a_robot_that_cannot_drive_sideways(make_omni_run, robotino):
    rng = np.random.default_rng(0)
    time_s = np.arange(0.0, 10.0, 0.1)
    speeds = np.tile([-0.4, -0.6], (time_s.size, 1))
    course = 0.3 + 0.2 * time_s
    velocity = -0.4 * np.column_stack([np.cos(course), np.sin(course)]) + rng.normal(
        0.0, 0.01, (time_s.size, 2)
    )
    streams = {
        "wheels": Stream(time_s, speeds, ("speed_left_mps", "speed_right_mps")),
        "gnss": Stream(time_s, velocity, ("velocity_x_mps", "velocity_y_mps")),
        "imu": Stream(time_s, np.full((time_s.size, 1), 0.2), ("gyro_z_radps",)),
    }
    found = measured_slip(RunLog("field", "husky", streams), HUSKY)
    assert found.source == "gnss"
    np.testing.assert_allclose(found.body_slip, 0.2, atol=0.02)
    np.testing.assert_allclose(found.twist[:, 2], 0.2, atol=1e-9)
    # its positions alone show the same; those of no RTK fix and what is driven through a gap show nothing
    place = np.cumsum(velocity, axis=0) * 0.1 + rng.normal(0.0, 0.01, (time_s.size, 2))
    fix = (time_s < 7.0).astype(float)[:, None]
    place[time_s >= 7.0] += 1.0
    gnss = Stream(time_s, np.hstack([place, fix]), ("position_x_m", "position_y_m", "fix_ratio"))
    gap = (time_s < 2.0) | (time_s > 3.0)
    gnss = replace(gnss, time_s=time_s[gap], values=gnss.values[gap])
    placed = measured_slip(RunLog("field", "husky", {**streams, "gnss": gnss}), HUSKY)
    known = np.isfinite(placed.body_slip)
    np.testing.assert_allclose(placed.body_slip[known], 0.2, atol=0.04)
    assert known.any()
    assert not known[(placed.end_s > 7.0) | ((placed.start_s < 3.0) & (placed.end_s > 2.0))].any()
    run = make_omni_run()
    only = replace(run, streams={"wheels": run.streams["wheels"], "gnss": streams["gnss"]})
    with pytest.raises(DataError, match="has no heading, and robot robotino can drive sideways"):
        measured_slip(only, robotino)


def test_a_standing_robot_has_no_slip(make_omni_run, robotino):
    found = measured_slip(make_omni_run(start_s=7.0), robotino)
    standing = found.end_s < 6.9
    assert standing.sum() >= 4
    assert np.isnan(found.body_slip[standing]).all()
    assert np.isnan(found.slip_ratio[standing]).all()
    assert np.isfinite(found.body_slip[found.start_s > 7.4]).all()


def test_a_wheel_that_spins_is_named(make_omni_run, robotino):
    run = make_omni_run(twist=(0.1, 0.0, 0.0), slip=0.1)
    wheels = run.streams["wheels"]
    values = np.where(np.array(wheels.channels) == "speed_2_mps", 0.4, wheels.values)
    lifted = replace(run, streams={**run.streams, "wheels": replace(wheels, values=values)})
    for each, names in ((run, []), (lifted, ["2"])):
        assert list(spinning_wheels(measured_slip(each, robotino))) == names


@pytest.mark.parametrize("delay_s", [0.0, 0.4])
def test_a_hidden_delay_is_found_within_its_interval(make_omni_run, robotino, delay_s):
    rng, runs = np.random.default_rng(1), []
    for i in range(6):
        drive = {"start_s": 0.5 + 0.2 * i, "slip": 0.1 + 0.02 * i, "twist": (0.2, 0.1 * i, 0.0)}
        runs.append(make_omni_run(rng, delay_s=delay_s, **drive))
    found = estimate_delay(runs, robotino)
    assert found.status is DelayStatus.ESTIMATED
    assert abs(found.delay_s - delay_s) < max(3 * found.std_s, 0.02)


def test_a_robot_that_never_changes_its_speed_shows_no_delay(make_omni_run, robotino):
    runs = [make_omni_run(np.random.default_rng(i), start_s=-1.0) for i in range(3)]
    assert estimate_delay(runs, robotino).status is DelayStatus.UNDETERMINED
    assert estimate_delay([RunLog("a", "robotino", {})], robotino).applied_s == 0.0


def test_a_step_of_slip_is_dated(make_omni_run, robotino):
    assert slip_step(make_omni_run(slip=0.3, slip_after=0.3, change_s=6.0), robotino) is None
    for before, after in ((0.15, 0.5), (0.5, 0.15)):
        found = slip_step(make_omni_run(slip=before, slip_after=after, change_s=6.0), robotino)
        assert found.time_s == pytest.approx(6.0, abs=0.3)
        assert (found.before, found.after) == pytest.approx((before, after), abs=0.03)


def test_a_surface_counts_runs_and_states_how_its_median_carries_over(make_omni_run, robotino):
    rng = np.random.default_rng(2)
    slips = rng.normal(0.3, 0.02, 25)
    runs = [
        make_omni_run(rng, slip=s, twist=(0.1 * np.cos(i), 0.1 * np.sin(i), 0.0)) for i, s in enumerate(slips)
    ]
    measured = Measured(runs, [measured_slip(run, robotino) for run in runs], {}, [])
    found = surface_slips(measured, np.random.default_rng(0))["cork"]
    assert (found.n_sessions, found.interval_of) == (1, IntervalOf.ONE_SESSION)
    assert found.slip_ratio == pytest.approx(np.median(slips), abs=0.005)
    assert found.interval[0] < 0.3 < found.interval[1]
    assert 0.0 < found.held_out < 0.05
    assert (found.n_runs, found.spinning) == (25, ())
    sessions = [replace(run, session=f"session {i % 5}") for i, run in enumerate(runs)]
    found = surface_slips(measured._replace(runs=sessions), np.random.default_rng(0))["cork"]
    assert (found.n_sessions, found.interval_of) == (5, IntervalOf.NEW_SESSION)
    assert found.held_out == pytest.approx(
        max(
            abs(np.median(slips[np.arange(25) % 5 == i]) - np.median(slips[np.arange(25) % 5 != i]))
            for i in range(5)
        ),
        abs=0.005,
    )


def test_what_cannot_be_measured_is_refused_in_one_sentence(make_omni_run, robotino):
    run = make_omni_run()
    blind = replace(run, streams={"wheels": run.streams["wheels"]})
    with pytest.raises(DataError, match=r"run cork_1: nothing measured the motion from outside"):
        measured_slip(blind, robotino)
    assert outside_source(blind) is None
    with pytest.raises(DataError, match=r"run cork_1: has no wheel speeds"):
        measured_slip(replace(run, streams={"pose": run.streams["pose"]}), robotino)
    with pytest.raises(DataError, match=r"share 9\.9\d s, a window takes 20 s"):
        measured_slip(run, robotino, window_s=20.0)
    with pytest.raises(ConfigError, match="lengths above zero"):
        measured_slip(run, robotino, window_s=0.0)


def test_round_off_of_a_straight_drive_fits_nothing():
    rng = np.random.default_rng(0)
    wheels, outside = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    straight, rounded = wheels * [1.0, 0.0, 0.0], wheels * [1.0, 0.0, 1e-17]
    assert _misfit(rounded, outside) == _misfit(straight, outside)
    assert _misfit(wheels, outside) < _misfit(straight, outside)


@pytest.mark.parametrize("name", ["adap2e", "pallet_truck"])
def test_the_wheel_of_a_car_that_is_not_driven_rolls_with_the_other_and_has_no_slip(name):
    """Straight at 0.9 m/s over ground, driven at 1 m/s, and steered by 0.3 rad: the speeds of one rigid motion."""
    robot, time_s = load_robot(name), np.arange(0.0, 12.0, 0.02)
    (driven,) = robot.logged_wheels
    for steer_rad in (0.0, 0.3):
        streams = {
            "wheels": Stream(time_s, np.ones((time_s.size, 1)), robot.rate_channels),
            "steering": Stream(time_s, np.full((time_s.size, 1), steer_rad), robot.steer_channels),
            "odometry": Stream(time_s, np.tile([0.9, 0.0], (time_s.size, 1)), ("speed_x_mps", "speed_y_mps")),
        }
        _, speeds = wheel_speeds(RunLog("r", name, streams), robot)
        assert speeds[0, robot.wheels.index(driven)] == 1.0
        assert speeds[0, 0] * np.cos(steer_rad) == pytest.approx(speeds[0, 1])
        if steer_rad == 0.0:
            found = measured_slip(RunLog("r", name, streams), robot)
            assert found.body_slip == pytest.approx(0.1, abs=1e-6)
            is_driven = np.isin(robot.wheels, robot.logged_wheels)
            assert found.slip_ratio[:, is_driven] == pytest.approx(0.1, abs=1e-6)
            assert np.isnan(found.slip_ratio[:, ~is_driven]).all()


def test_short_windows_at_20_hz_are_judged_steady_by_their_halves():
    """The halves of half a second have five samples: steady driving is steady there, a change of speed is not."""
    time_s = np.arange(120) / 20.0
    speed = np.where(time_s < 3.0, 0.5, 1.0)
    wheels = Stream(time_s, np.column_stack([speed, speed]), ("speed_left_mps", "speed_right_mps"))
    twist = np.column_stack([0.9 * speed, 0.0 * speed, 0.0 * speed])
    lidar = Stream(time_s, twist, ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"))
    found = measured_slip(
        RunLog("a", "husky", {"wheels": wheels, "lidar": lidar}), HUSKY, window_s=0.5, stride_s=0.25
    )
    across = (found.start_s < 2.95) & (found.end_s > 3.05)
    assert found.steady[~across].all()
    assert not found.steady[across & (np.abs(found.time_s - 3.0) < 0.1)].any()
    np.testing.assert_allclose(found.body_slip[~across], 0.1, atol=1e-9)
