"""Stuck: wheels that turn a robot on the spot which does not turn; what wheels and gyro cannot show is not."""

import numpy as np
import pytest

from pipelines.data.datasets import load_runs
from terrain.estimation.estimate import estimate_run
from terrain.estimation.models.observer import ObserverStatus
from terrain.estimation.stuck import STUCK_AFTER_S, Turns, next_turns
from terrain.robots import load_robot

HUSKY = load_robot("husky")
TIME_S = np.arange(0.0, 30.0, 1 / 6.5)
NOISE = np.random.default_rng(11).normal(0.0, 0.02, TIME_S.size)


def stuck(left_mps, right_mps, turn_radps, std_radps=0.002, time_s=TIME_S):
    turns, found = Turns(), []
    columns = np.broadcast_arrays(time_s, left_mps, right_mps, turn_radps)
    for at_s, left, right, turn in np.column_stack(columns).tolist():
        turns = next_turns(turns, at_s, (left, right), turn, std_radps, HUSKY.track_m)
        found.append(turns.is_stuck)
    return np.array(found)


@pytest.mark.parametrize("side_mps", [0.1, -0.2, 0.5])
def test_wheels_that_turn_on_the_spot_are_stuck_on_a_robot_that_does_not_turn_alone(side_mps):
    for turn_radps in (0.0, 0.01, -0.01):
        found = stuck(-side_mps, side_mps, turn_radps + NOISE)
        assert found[TIME_S > 5.0].mean() > 0.95
        assert not found[TIME_S < STUCK_AFTER_S].any()
    for track_ratio in (1.0, 1.7, 4.0):  # from a turn without any slip to that of the largest effective track
        assert not stuck(-side_mps, side_mps, 2 * side_mps / (track_ratio * HUSKY.track_m) + NOISE).any()


def test_it_is_stuck_while_it_spins():
    spins = (TIME_S >= 8.0) & (TIME_S <= 18.0)
    side_mps = np.where((TIME_S >= 2.0) & (TIME_S <= 25.0), 0.2, 0.0)
    times_s = TIME_S[stuck(-side_mps, side_mps, np.where(spins, 0.0, side_mps / (0.8 * HUSKY.track_m)))]
    assert 10.0 <= times_s[0] < 12.5
    assert times_s[-1] == pytest.approx(18.0, abs=0.5)
    assert np.diff(times_s).max() < 0.2


def test_what_wheels_and_gyro_cannot_show_is_not_stuck():
    short_turns = 0.3 * np.sign(np.sin(4 * TIME_S))
    for left_mps, right_mps, turn_radps, std_radps in (
        (0.5, 0.5, 0.001, 0.002),  # straight, an arc, one side, slow
        (-0.5, -0.4, 0.001, 0.002),
        (0.0, 0.4, 0.001, 0.002),
        (-0.02, 0.02, 0.001, 0.002),
        (-0.2, 0.2, np.nan, 0.002),  # no gyro, one whose bias is not known, no wheel
        (-0.2, 0.2, 0.001, 0.05),
        (-0.2, np.nan, 0.001, 0.002),
        (-np.inf, 0.2, 0.001, 0.002),
        (short_turns, -short_turns, 0.001, 0.002),
    ):
        assert not stuck(left_mps, right_mps, turn_radps, std_radps).any(), (left_mps, right_mps)
    later = TIME_S > 15.0  # gaps, and a clock that is set back, start anew
    first = int(later.argmax())
    for stamps in (TIME_S + 10.0 * later, TIME_S - 12.0 * later):
        found = stuck(-0.2, 0.2, 0.0, time_s=stamps)
        assert found[[first - 1, -1]].all()
        assert not found[first : first + 5].any()


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
    run = boreal[run_id]
    found = estimate_run(run, HUSKY, "slip")
    track, imu = found.track, run.streams["imu"]
    assert np.abs(track.state("gyro_bias_radps")).max() < 0.005
    gyro = imu.channel("gyro_z_radps")
    angle = np.append(0.0, np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(imu.time_s)))
    last = np.searchsorted(track.time_s, imu.time_s[-1]) - 1
    turned = np.interp(track.time_s[[0, last]], imu.time_s, angle)
    assert np.ptp(np.unwrap(track.state("yaw_rad"))[[0, last]] - turned) < 0.3
    assert (np.diff(track.time_s)[found.status[:-1] == ObserverStatus.STUCK]).sum() > 10.0


def test_no_run_on_other_ground_is_called_stuck(boreal):
    others = [run for run in boreal.values() if run.run_id.startswith(NOT_STUCK)]
    assert len(others) >= 20
    for run in others:
        assert not (estimate_run(run, HUSKY, "slip").status == ObserverStatus.STUCK).any(), run.run_id
