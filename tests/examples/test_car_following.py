"""A car-like robot on the paths of the paper: bars of its controllers, lost fixes, grip, and the end."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from car_scenarios import STOP, Course, slope_course, stop_course

from terrain.control.car_following import (
    LOST_STOP_S,
    CarFollower,
    Grip,
    SlipSource,
    SteeringSettings,
    grip_step,
    preview_speed,
)
from terrain.control.paths import path_from_curvature
from terrain.robots import load_robot
from terrain.simulation.plants.car import Ground, level_ground, side_force
from terrain.simulation.run import simulate

ROBOT = load_robot("adap2e")


def lateral_errors(run, path):
    """Return true distance and lateral error (n, 2) at 50 Hz."""
    truth, s, found = run.streams["truth"], np.nan, []
    pose = np.column_stack([truth.channel(name) for name in ("position_x_m", "position_y_m", "yaw_rad")])
    for row in pose[::2]:
        s, lateral, *_ = path.locate(*row, s)
        found.append((s, lateral))
    return np.array(found)


@functools.cache
def follow(course_name, speed_mps, source, seed=0):
    course, stops = (slope_course()[0], ()) if course_name == "slope" else (stop_course(), STOP)
    follower = CarFollower(ROBOT, course.path, source)
    run = simulate(ROBOT, course.drive(speed_mps, stops), course.ground, seed, controller=follower)
    return follower, run, lateral_errors(run, course.path)


@pytest.mark.parametrize(("speed_mps", "source"), [(5.0, SlipSource.MULTI), (6.0, SlipSource.GRIP)])
def test_lateral_error_is_within_a_tenth_of_the_speed_and_larger_without_an_observer(speed_mps, source):
    _, run, lateral = follow("slope", speed_mps, source)
    assert lateral[-1, 0] > 0.99 * slope_course()[0].path.length_m
    largest_m = np.abs(lateral[:, 1]).max()
    assert largest_m < speed_mps / 10
    assert run.streams["truth"].channel("speed_x_mps").max() == speed_mps
    if source is SlipSource.MULTI:
        without_m = np.abs(follow("slope", speed_mps, SlipSource.NONE)[2][:, 1]).max()
        assert without_m > max(1.5 * largest_m, 0.5)


def test_a_stop_leaves_estimates_and_tracking_as_they_were():
    follower, run, lateral = follow("stop", 3.0, SlipSource.MULTI)
    slips = np.array([tick.estimate.slip for tick in follower.ticks])
    assert np.isfinite(slips[1:]).all()
    assert np.abs(slips[1:]).max() < np.radians(3.0)
    speed = run.streams["truth"].channel("speed_x_mps")[::2]
    stands = np.flatnonzero(speed[100:] == 0.0) + 100
    assert stands.size == pytest.approx(150, abs=5)
    before, after = np.abs(lateral[: stands[0], 1]).max(), np.abs(lateral[stands[-1] :, 1]).max()
    assert after < before + 0.02  # one standard deviation of a fix


def test_preview_slows_down_before_the_bend_and_knows_the_grip():
    follower, run, _ = follow("slope", 6.0, SlipSource.GRIP)
    speed, distance = run.streams["truth"].channel("speed_x_mps"), run.streams["truth"].channel("distance_m")
    bend = (distance > 66.0) & (distance < 88.0)
    assert 3.0 < speed[bend].min() < 5.5
    assert speed[distance > 110.0].max() == 6.0
    last = follower.ticks[-1]
    assert abs(last.grip.ratio - 0.7) < 3 * np.sqrt(last.grip.variance)


@pytest.mark.parametrize("true_grip", [0.35, 0.8])
def test_grip_comes_back_within_its_error(true_grip):
    """Forces of the tyre over a sweep of slip that reaches nine tenths of the grip, b with noise."""
    rng = np.random.default_rng(4)
    grip = Grip()
    load = ROBOT.mass_kg * 9.80665 / 2
    for k in range(1500):
        slip = -0.16 * abs(np.sin(k / 100))
        force = 2.0 * side_force(slip, ROBOT.front_cornering_npr, true_grip * load) / ROBOT.mass_kg
        seen = slip + rng.normal(0.0, 0.01, 2)
        grip = grip_step(ROBOT, grip, force, seen, np.full(2, 0.01), 0.02)
    assert abs(grip.ratio - true_grip) < 3 * np.sqrt(grip.variance)
    assert np.sqrt(grip.variance) < 0.1


def test_grip_stays_as_assumed_while_little_of_it_is_used_or_nothing_is_known():
    grip = Grip()
    for force, slip in ((0.5, -0.01), (np.nan, -0.1), (4.0, np.nan), (4.0, 0.1)):
        after = grip_step(ROBOT, grip, force, np.full(2, slip), np.full(2, 0.01), 0.02)
        assert after.ratio == grip.ratio
        assert after.variance >= grip.variance
    for dt_s in (0.0, np.nan, -1.0, 1e9):
        assert grip_step(ROBOT, grip, 4.0, np.full(2, -0.1), np.full(2, 0.01), dt_s) == grip


def test_allowed_speed_falls_with_slope_uphill_and_is_free_on_the_straight():
    grip = Grip()
    bend = path_from_curvature(np.array([0.0, 40.0]), np.array([0.1, 0.1]))
    level, uphill, downhill = (preview_speed(grip, bend, 5.0, roll) for roll in (0.0, 0.2, -0.2))
    assert uphill < downhill <= level
    straight = path_from_curvature(np.array([0.0, 40.0]), np.zeros(2))
    assert preview_speed(grip, straight, 5.0, 0.2) > 100.0


def test_robot_stops_when_fixes_are_lost():
    path = path_from_curvature(np.array([0.0, 60.0]), np.zeros(2))
    follower = CarFollower(ROBOT, path)

    def without_fixes(sample):
        if sample.time_s > 6.0:
            sample.measured[2:5] = np.nan
        return follower(sample)

    drive = Course(path, level_ground()).drive(3.0)._replace(duration_s=14.0)
    run = simulate(ROBOT, drive, level_ground(), 0, controller=without_fixes)
    speed = run.streams["truth"]
    assert (speed.channel("speed_x_mps")[speed.time_s > 6.0 + LOST_STOP_S + 2.5] == 0.0).all()
    assert (speed.channel("speed_x_mps")[(speed.time_s > 3.0) & (speed.time_s < 8.5)] == 3.0).all()


def test_an_offset_is_kept_to_the_left():
    path = path_from_curvature(np.array([0.0, 50.0]), np.zeros(2))
    follower = CarFollower(ROBOT, path, SlipSource.MULTI, SteeringSettings(offset_m=1.0))
    ground = Ground(np.zeros(1), np.array([0.7]), np.array([0.15]))
    run = simulate(ROBOT, Course(path, ground).drive(3.0), ground, 0, controller=follower)
    assert lateral_errors(run, path)[-100:, 1] == pytest.approx(1.0, abs=0.05)
