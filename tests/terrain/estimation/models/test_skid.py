"""The filter of a robot that skids: track and bias come back; stuck, moving, at rest or unknown is named."""

import numpy as np
import pytest

from pipelines.data.datasets import load_runs
from terrain.angles import wrapped
from terrain.estimation.estimate import estimate_run
from terrain.estimation.filter import run_filter
from terrain.estimation.models.skid import (
    FOLLOWS_S,
    MAX_BIAS_RADPS,
    MAX_TRACK_RATIO,
    MIN_TURN_RADPS,
    STUCK_AFTER_S,
    Motion,
    make_skid_filter,
    motion_seconds,
    motion_track,
    stuck_intervals,
    wheel_weight,
    within_bounds,
)
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

HUSKY = load_robot("husky")
MODEL = make_skid_filter(HUSKY)
RATE_HZ = 20.0


def drive(turn_radps, track_m=1.03, bias_radps=0.004, seed=0, speed_mps=0.7):
    """Wheels and gyro of a robot that turns as commanded; yaw is its truth."""
    n = len(turn_radps)
    rng = np.random.default_rng(seed)
    speed = speed_mps * np.minimum(np.arange(n) / RATE_HZ / 2, 1)
    turn = np.asarray(turn_radps)
    z = np.column_stack([speed - turn * track_m / 2, speed + turn * track_m / 2, turn + bias_radps])
    z += rng.normal(0, [0.02, 0.02, 0.005], z.shape)
    return np.arange(n) / RATE_HZ, np.column_stack([z, np.full(n, np.nan)])


SECONDS = np.arange(0, 60, 1 / RATE_HZ)
WINDING = 0.6 * np.sign(np.sin(SECONDS / 3)) * (np.abs(np.sin(SECONDS / 3)) > 0.4)


@pytest.mark.parametrize("hidden_m", [0.62, 0.9, 1.15])
def test_the_hidden_track_and_bias_come_back_from_a_drive_with_turns(hidden_m):
    time_s, z = drive(WINDING, hidden_m)
    track = run_filter(MODEL, time_s, z)
    for state, truth, widest in (("effective_track_m", hidden_m, 0.13), ("gyro_bias_radps", 0.004, 0.006)):
        std = track.std(state)[-1]
        assert abs(track.state(state)[-1] - truth) < 3 * std
        assert std < widest
    true_yaw = np.cumsum(np.append(0, WINDING[:-1])) / RATE_HZ
    error = np.angle(np.exp(1j * (track.state("yaw_rad") - true_yaw)))
    assert (np.abs(error)[1:] < 4 * track.std("yaw_rad")[1:]).all()
    assert sum(track.dropped.values()) < 0.02 * z.size


@pytest.mark.parametrize("difference_mps", [0.5, -0.3, 0.5 * MIN_TURN_RADPS])
@pytest.mark.parametrize("turns_radps", [0.3, 0.01])
def test_jacobians_are_those_of_finite_differences(difference_mps, turns_radps):
    """With the weight of the wheels as a constant, and without the track where wheels hardly differ."""
    difference_mps *= HUSKY.track_m
    x = np.array([1.0, 2.0, 0.4, 0.8, turns_radps, 0.9, 0.01, difference_mps])
    d, m, params = x.size, len(MODEL.rows), MODEL.params.copy()
    f, h, x_next, z_hat = np.zeros((d, d)), np.zeros((m, d)), np.zeros(d), np.zeros(m)
    MODEL.propagate(x, 0.1, params, x_next, f)
    MODEL.observe(x, params, z_hat, h)
    near = 1 - np.exp(-wheel_weight(turns_radps, difference_mps, HUSKY.track_m) * 0.1 / FOLLOWS_S)
    assert x_next[4] == pytest.approx(turns_radps + near * (difference_mps / 0.9 - turns_radps))
    for j in range(d):
        ends = []
        for step in (1e-6, -1e-6):
            moved, there, seen = x.copy(), np.zeros(d), np.zeros(m)
            moved[j] += step
            MODEL.propagate(moved, 0.1, params, there, np.zeros((d, d)))
            there[4] = moved[4] + near * (moved[7] / moved[5] - moved[4])
            MODEL.observe(moved, params, seen, np.zeros((m, d)))
            ends.append((there, seen))
        slope = (ends[0][0] - ends[1][0]) / 2e-6
        if MODEL.states[j] == "effective_track_m" and abs(difference_mps) < MIN_TURN_RADPS * HUSKY.track_m:
            slope[4] = 0.0
        np.testing.assert_allclose(f[:, j], slope, atol=1e-8)
        np.testing.assert_allclose(h[:, j], (ends[0][1] - ends[1][1]) / 2e-6, atol=1e-8)


@pytest.mark.parametrize("bias_radps", [-0.004, 0.006])
@pytest.mark.parametrize("difference_mps", [0.11, 0.3, -0.39])
def test_wheels_that_spin_without_turning_the_robot_leave_the_bias_alone(bias_radps, difference_mps):
    time_s, z = drive(np.zeros(SECONDS.size), bias_radps=bias_radps, seed=3, speed_mps=0.0)
    z[:, :2] += np.array([-0.5, 0.5]) * difference_mps
    track = run_filter(MODEL, time_s, z)
    bias, std = track.state("gyro_bias_radps"), track.std("gyro_bias_radps")
    assert (np.abs(bias - bias_radps) < 3 * std).all()
    assert np.abs(bias).max() < 0.003
    assert (np.abs(np.unwrap(track.state("yaw_rad"))) < 3 * track.std("yaw_rad")).all()


@pytest.mark.parametrize("sign", [-1, 1])
def test_track_and_bias_stay_within_their_bounds(sign):
    """Against a robot that turns faster than its wheels, or against them, and a gyro of a huge bias."""
    time_s, z = drive(0.4 * np.ones(SECONDS.size), 0.2, speed_mps=0.0)
    z[:, 2] = 5.0 * sign * z[:, 2] + 0.3
    z[::40, 3] = 0.3 * sign
    track = run_filter(MODEL, time_s, z)
    mean = within_bounds(track.mean, HUSKY.track_m)
    track_m, bias = mean[:, 5], mean[:, 6]
    assert (track_m >= HUSKY.track_m).all()
    assert (track_m <= MAX_TRACK_RATIO * HUSKY.track_m).all()
    assert (np.abs(bias) <= MAX_BIAS_RADPS).all()
    assert np.abs(bias).max() > 0.05
    assert np.isfinite(track.cov).all()
    np.testing.assert_array_equal(mean[:, [0, 1, 2, 3, 4, 7]], track.mean[:, [0, 1, 2, 3, 4, 7]])


@pytest.mark.parametrize(
    ("soil", "scenario", "seed"),
    [("grass", "survey", 21), ("tilled_loam", "complex", 22), ("snow", "straight", 24)],
)
def test_simulated_drives_are_within_their_stated_error(soil, scenario, seed):
    """Yaw, yaw rate and bias of 40 s: their mean squared error is that of their covariance, or less."""
    found = estimate_run(simulate_run(HUSKY, soil, scenario, seed, duration_s=40.0), HUSKY, "skid")
    track = found.track
    for state in ("yaw_rad", "yaw_rate_radps", "gyro_bias_radps"):
        j = track.states.index(state)
        error = wrapped(track.mean[:, j] - found.truth[:, j])
        assert np.nanmean(error**2 / track.cov[:, j, j]) < 2.0, state
    assert np.nanmax(np.abs(wrapped(track.state("yaw_rad") - found.truth[:, 2]))) < 0.1
    assert (found.motion != Motion.STUCK).all()


# -- stuck, moving, at rest or unknown ------------------------------------------------------------------------------

STD_RADPS = 0.002
TIME_S = np.arange(0.0, 30.0, 1 / 6.5)
NOISE = np.random.default_rng(11).normal(0.0, 0.02, TIME_S.size)


def motion(left_mps, right_mps, turn_radps, has_gyro=True, std_radps=STD_RADPS, time_s=TIME_S):
    turn = np.broadcast_to(turn_radps, time_s.shape)
    sides = [np.broadcast_to(side, time_s.shape) for side in (left_mps, right_mps)]
    measured = np.column_stack([*sides, np.where(has_gyro, turn, np.nan)])
    return motion_track(time_s, measured, turn, np.full(time_s.size, std_radps), HUSKY.track_m)


def during(first_s, last_s):
    return np.logical_and(first_s <= TIME_S, last_s >= TIME_S)


@pytest.mark.parametrize("side_mps", [0.1, -0.2, 0.5])
def test_wheels_that_turn_on_the_spot_are_stuck_on_a_robot_that_does_not_turn_and_move_one_that_does(
    side_mps,
):
    for turn_radps in (0.0, 0.01, -0.01):
        found = motion(-side_mps, side_mps, turn_radps + NOISE)
        assert (found[TIME_S > 5.0] == Motion.STUCK).mean() > 0.95
        assert (found[TIME_S < STUCK_AFTER_S] == Motion.UNKNOWN).all()
    for track_ratio in (1.0, 1.7, 4.0):  # from a turn without any slip to that of the largest effective track
        found = motion(-side_mps, side_mps, 2 * side_mps / (track_ratio * HUSKY.track_m) + NOISE)
        assert (found[TIME_S > 3.0] == Motion.MOVING).all()


def test_an_interval_of_a_drive_is_found_with_its_times():
    spins = during(8.0, 18.0)
    side_mps = np.where(during(2.0, 25.0), 0.2, 0.0)
    turn = np.where(spins, 0.0, side_mps / (0.8 * HUSKY.track_m))
    found = motion(-side_mps, side_mps, turn)
    (interval,) = stuck_intervals(TIME_S, found)
    assert interval.start_s == pytest.approx(8.0, abs=2.5)
    assert interval.end_s == pytest.approx(18.0, abs=0.5)
    assert (found[during(4.0, 7.5) | during(19.0, 24.5)] == Motion.MOVING).all()
    assert (found[during(29.0, 30.0)] == Motion.AT_REST).all()
    seconds = motion_seconds(TIME_S, found)
    assert sum(seconds.values()) == pytest.approx(TIME_S[-1] - TIME_S[0])
    assert seconds["stuck"] == pytest.approx(interval.end_s - interval.start_s - STUCK_AFTER_S, abs=0.2)


def test_what_wheels_and_gyro_cannot_show_is_unknown():
    short_turns = 0.3 * np.sign(np.sin(4 * TIME_S))
    for left_mps, right_mps, options in (
        (0.5, 0.5, {}),  # straight, an arc, one side, slow
        (-0.5, -0.4, {}),
        (0.0, 0.4, {}),
        (-0.02, 0.02, {}),
        (-0.2, 0.2, {"has_gyro": False}),
        (-0.2, 0.2, {"std_radps": 0.05}),  # of the bias
        (-0.2, np.nan, {}),
        (-np.inf, 0.2, {}),
        (-1e6, 1e6, {}),
        (short_turns, -short_turns, {}),
    ):
        assert (motion(left_mps, right_mps, 0.001, **options) == Motion.UNKNOWN).all(), (left_mps, right_mps)
    # gaps, and a clock that is set back, start anew
    later = TIME_S > 15.0
    first = int(later.argmax())
    for stamps in (TIME_S + 10.0 * later, TIME_S - 12.0 * later):
        found = motion(-0.2, 0.2, 0.0, time_s=stamps)
        assert (found[[first - 1, -1]] == Motion.STUCK).all()
        assert (found[first : first + 5] == Motion.UNKNOWN).all()


# -- measured runs

SPINNING = ("SNOW_03", "SNOW_05", "SNOW_14")
"""Runs on snow whose wheels spin for seconds without turning the robot."""

NOT_STUCK = ("ASPHALT", "FLOORING", "ICE", "SANDY_LOAM")


@pytest.fixture(scope="module")
def boreal(datasets_dir):
    runs = load_runs(datasets_dir / "borealtc")
    return {run.run_id: run for run in runs if run.run_id.startswith((*SPINNING, *NOT_STUCK))}


@pytest.mark.parametrize("run_id", SPINNING)
def test_on_snow_the_bias_is_that_at_rest_and_stuck_is_named(boreal, run_id):
    """At rest the gyro of these runs reads 0.000 rad/s, and the yaw is its integral."""
    found = estimate_run(boreal[run_id], HUSKY, "skid")
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
    others = [run for run in boreal.values() if run.run_id.startswith(NOT_STUCK)]
    assert len(others) >= 20
    for run in others:
        assert not (estimate_run(run, HUSKY, "skid").motion == Motion.STUCK).any(), run.run_id
