"""Stuck, moving, at rest or unknown: what is hidden in a drive is named, and nothing else is."""

import numpy as np
import pytest

from terrain.estimation.models.skid import (
    STUCK_AFTER_S,
    Motion,
    motion_seconds,
    motion_track,
    stuck_intervals,
)
from terrain.robots import load_robot

TRACK_M = load_robot("husky").track_m
STD_RADPS = 0.002
RATE_HZ = 6.5
TIME_S = np.arange(0.0, 30.0, 1 / RATE_HZ)
NOISE = np.random.default_rng(11).normal(0.0, 0.02, TIME_S.size)


def motion(left_mps, right_mps, turn_radps, has_gyro=True, std_radps=STD_RADPS, time_s=TIME_S):
    turn = np.broadcast_to(turn_radps, time_s.shape)
    sides = [np.broadcast_to(side, time_s.shape) for side in (left_mps, right_mps)]
    measured = np.column_stack([*sides, np.where(has_gyro, turn, np.nan)])
    return motion_track(time_s, measured, turn, np.full(time_s.size, std_radps), TRACK_M)


def during(first_s, last_s):
    return np.logical_and(first_s <= TIME_S, last_s >= TIME_S)


@pytest.mark.parametrize("side_mps", [0.1, -0.2, 0.5])
@pytest.mark.parametrize("turn_radps", [0.0, 0.01, -0.01])
def test_wheels_that_turn_on_the_spot_a_robot_that_does_not_turn_are_stuck(side_mps, turn_radps):
    found = motion(-side_mps, side_mps, turn_radps + NOISE)
    assert (found[TIME_S > 5.0] == Motion.STUCK).mean() > 0.95
    assert (found[TIME_S < STUCK_AFTER_S] == Motion.UNKNOWN).all()


@pytest.mark.parametrize("track_ratio", [1.0, 1.7, 4.0])
@pytest.mark.parametrize("side_mps", [0.1, -0.2, 0.5])
def test_a_robot_that_turns_moves(track_ratio, side_mps):
    """From a turn without any slip to that of the largest effective track."""
    found = motion(-side_mps, side_mps, 2 * side_mps / (track_ratio * TRACK_M) + NOISE)
    assert (found[TIME_S > 3.0] == Motion.MOVING).all()


def test_an_interval_of_a_drive_is_found_with_its_times():
    spins = during(8.0, 18.0)
    side_mps = np.where(during(2.0, 25.0), 0.2, 0.0)
    turn = np.where(spins, 0.0, side_mps / (0.8 * TRACK_M))
    found = motion(-side_mps, side_mps, turn)
    (interval,) = stuck_intervals(TIME_S, found)
    assert interval.start_s == pytest.approx(8.0, abs=2.5)
    assert interval.end_s == pytest.approx(18.0, abs=0.5)
    assert (found[during(4.0, 7.5) | during(19.0, 24.5)] == Motion.MOVING).all()
    assert (found[during(29.0, 30.0)] == Motion.AT_REST).all()
    seconds = motion_seconds(TIME_S, found)
    assert sum(seconds.values()) == pytest.approx(TIME_S[-1] - TIME_S[0])
    assert seconds["stuck"] == pytest.approx(interval.end_s - interval.start_s - STUCK_AFTER_S, abs=0.2)


@pytest.mark.parametrize(
    ("left_mps", "right_mps", "options"),
    [
        (0.5, 0.5, {}),
        (-0.5, -0.4, {}),
        (0.0, 0.4, {}),
        (-0.02, 0.02, {}),
        (-0.2, 0.2, {"has_gyro": False}),
        (-0.2, 0.2, {"std_radps": 0.05}),
        (-0.2, np.nan, {}),
        (-np.inf, 0.2, {}),
        (-1e6, 1e6, {}),
        (0.3 * np.sign(np.sin(4 * TIME_S)), -0.3 * np.sign(np.sin(4 * TIME_S)), {}),
    ],
    ids=["straight", "arc", "one side", "slow", "no gyro", "bias", "a side", "inf", "1e6", "short turns"],
)
def test_what_wheels_and_gyro_cannot_show_is_unknown(left_mps, right_mps, options):
    assert (motion(left_mps, right_mps, 0.001, **options) == Motion.UNKNOWN).all()


def test_gaps_and_a_clock_set_back_start_anew():
    gap = TIME_S + 10.0 * (TIME_S > 15.0)
    found = motion(-0.2, 0.2, 0.0, time_s=gap)
    first = int(np.argmax(gap > 15.0))
    assert found[first - 1] == Motion.STUCK
    assert (found[first : first + 5] == Motion.UNKNOWN).all()
    assert found[-1] == Motion.STUCK
    back = np.where(TIME_S > 15.0, TIME_S - 12.0, TIME_S)
    assert (motion(-0.2, 0.2, 0.0, time_s=back)[first : first + 5] == Motion.UNKNOWN).all()


# measured runs


SPINNING = ("SNOW_03", "SNOW_05", "SNOW_14")
"""Runs on snow whose wheels spin for seconds without turning the robot."""

NOT_STUCK = ("ASPHALT", "FLOORING", "ICE", "SANDY_LOAM")


@pytest.fixture(scope="module")
def boreal(datasets_dir):
    from pipelines.data.datasets import load_runs
    from terrain.estimation.estimate import estimate_run

    husky = load_robot("husky")
    runs = load_runs(datasets_dir / "borealtc")
    return {run.run_id: estimate_run(run, husky, "skid") for run in runs}


@pytest.mark.parametrize("run_id", SPINNING)
def test_on_snow_the_bias_is_that_at_rest_and_stuck_is_named(boreal, run_id):
    """At rest the gyro of these runs reads 0.000 rad/s, and the yaw is its integral."""
    found = boreal[run_id]
    track, imu = found.track, found.run.streams["imu"]
    assert np.abs(track.state("gyro_bias_radps")).max() < 0.005
    gyro = imu.channel("gyro_z_radps")
    angle = np.append(0.0, np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(imu.time_s)))
    last = np.searchsorted(track.time_s, imu.time_s[-1]) - 1
    yaw = np.unwrap(track.state("yaw_rad"))
    turned = np.interp(track.time_s[[0, last]], imu.time_s, angle)
    assert yaw[last] - yaw[0] == pytest.approx(turned[1] - turned[0], abs=0.1)
    intervals = stuck_intervals(track.time_s, found.motion)
    assert max(interval.end_s - interval.start_s for interval in intervals) > 10.0


def test_no_run_on_other_ground_is_called_stuck(boreal):
    others = {run_id: found for run_id, found in boreal.items() if run_id.startswith(NOT_STUCK)}
    assert len(others) >= 20
    stuck = [run_id for run_id, found in others.items() if (found.motion == Motion.STUCK).any()]
    assert stuck == []
