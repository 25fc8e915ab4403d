import numpy as np
import pytest

from terrain.angles import wrapped
from terrain.estimation.estimate import estimate_run
from terrain.estimation.filter import run_filter
from terrain.estimation.models.skid import (
    FOLLOWS_S,
    MAX_BIAS_RADPS,
    MAX_TRACK_RATIO,
    MIN_TURN_RADPS,
    Motion,
    make_skid_filter,
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
@pytest.mark.parametrize("seed", [0, 1])
def test_the_hidden_track_and_bias_come_back_from_a_drive_with_turns(hidden_m, seed):
    time_s, z = drive(WINDING, hidden_m, seed=seed)
    track = run_filter(MODEL, time_s, z)
    for state, truth, widest in (("effective_track_m", hidden_m, 0.13), ("gyro_bias_radps", 0.004, 0.006)):
        std = track.std(state)[-1]
        assert abs(track.state(state)[-1] - truth) < 3 * std
        assert std < widest
    true_yaw = np.cumsum(np.append(0, WINDING[:-1])) / RATE_HZ
    error = np.angle(np.exp(1j * (track.state("yaw_rad") - true_yaw)))
    assert (np.abs(error)[1:] < 4 * track.std("yaw_rad")[1:]).all()
    assert sum(track.dropped.values()) < 0.02 * z.size


@pytest.mark.parametrize("difference_mps", [0.5, -0.3, 2 * MIN_TURN_RADPS, 0.5 * MIN_TURN_RADPS])
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
    [
        ("grass", "survey", 21),
        ("tilled_loam", "complex", 22),
        ("snow", "survey", 23),
        ("snow", "straight", 24),
    ],
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
