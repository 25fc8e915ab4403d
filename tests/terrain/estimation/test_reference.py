"""The truth of a simulated run, expressed in the states of each filter."""

import numpy as np
import pytest

from terrain.errors import DataError
from terrain.estimation.consistency import lagged_slip, true_states
from terrain.kinematics.logged_wheels import wheel_and_ground_speed
from terrain.records import RunLog, StateTrack, Stream
from terrain.robots import load_robot
from terrain.signals import low_passed
from terrain.simulation.run import simulate_run

ROBOT = load_robot("agrimaro")
STATES = ("yaw_rad", "speed_x_mps", "steer_2_rad", "gyro_bias_radps", "slip_speed_3_mps", "effective_track_m")


@pytest.fixture(scope="module")
def run():
    return simulate_run(ROBOT, "grass", "arc", 0, duration_s=10.0)


def empty_track(states, time_s):
    n, d = len(time_s), len(states)
    none = np.zeros((n, 1))
    return StateTrack(
        time_s,
        np.zeros((n, d)),
        np.tile(np.eye(d), (n, 1, 1)),
        states,
        none,
        none,
        none,
        ("s",),
        np.zeros(n),
        0.0,
    )


def test_truth_passes_the_low_pass_of_the_filter_inputs(run):
    time_s = np.arange(0.5, 9.0, 0.02)
    truth = run.streams["truth"]
    found = true_states(run, empty_track(STATES, time_s), ROBOT, 0.05)
    speed = low_passed(truth.time_s, truth.channel("speed_x_mps"), 0.05, 1.0)
    np.testing.assert_allclose(found[:, 1], np.interp(time_s, truth.time_s, speed), atol=1e-9)
    plain = true_states(run, empty_track(STATES, time_s), ROBOT, 0.0)
    rising = (time_s > 1.3) & (time_s < 1.7)
    lag_s = (plain - found)[rising, 1].mean() / np.gradient(plain[rising, 1], time_s[rising]).mean()
    assert lag_s == pytest.approx(0.05, abs=0.01)
    assert found[0, 0] == pytest.approx(0.0, abs=0.02)
    assert np.isnan(found[:, 5]).all()  # there is no true effective track


def test_slip_speed_and_slip_ratio_of_the_truth_agree(run):
    truth = run.streams["truth"]
    wheel_speed, ground = wheel_and_ground_speed(truth, ROBOT)
    for i in range(3):
        slip = truth.channel(f"slip_{i + 1}_ratio")
        fastest = np.maximum(np.abs(wheel_speed[:, i]), np.abs(ground[:, i]))
        moving = np.isfinite(slip) & (fastest > 0.2)
        np.testing.assert_allclose(
            (wheel_speed - ground)[moving, i] / fastest[moving], slip[moving], atol=0.01
        )


def test_slip_behind_the_low_pass_is_the_slip_where_driving_is_steady(run):
    truth = run.streams["truth"]
    slip, ground = lagged_slip(truth, ROBOT, 0.05)
    np.testing.assert_array_equal(lagged_slip(truth, ROBOT, 0.0)[1], wheel_and_ground_speed(truth, ROBOT)[1])
    steady = (truth.time_s > 4.0) & (truth.time_s < 7.0)
    true_slip = np.column_stack([truth.channel(f"slip_{i}_ratio") for i in (1, 2, 3)])
    assert np.abs(slip[steady].mean(axis=0) - true_slip[steady].mean(axis=0)).max() < 0.002
    assert np.isnan(slip[truth.time_s < 0.9]).all()  # it stands
    assert (ground[steady] > 0.5).all()


def test_a_run_without_truth_gives_none_and_an_extra_wheel_is_refused(run):
    streams = {name: stream for name, stream in run.streams.items() if name != "truth"}
    track = empty_track(("speed_x_mps",), np.arange(0.0, 1.0, 0.1))
    assert true_states(RunLog("a", "agrimaro", streams), track, ROBOT, 0.05) is None
    nothing = Stream(
        run.streams["truth"].time_s, np.full((len(run.streams["truth"]), 1), np.nan), ("speed_x_mps",)
    )
    assert np.isnan(true_states(RunLog("a", "agrimaro", {"truth": nothing}), track, ROBOT, 0.05)).all()
    with pytest.raises(DataError, match="slip_speed_4_mps"):
        true_states(run, empty_track(("slip_speed_4_mps",), np.arange(0.0, 1.0, 0.1)), ROBOT, 0.05)
