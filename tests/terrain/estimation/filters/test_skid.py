import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.estimation.ekf.filter import run_filter
from terrain.estimation.filters.skid import MIN_TURN_RADPS, make_skid_filter, skid_noise
from terrain.robots import load_robot

HUSKY = load_robot("husky")
MODEL, NOISE = make_skid_filter(HUSKY), skid_noise(HUSKY)
RATE_HZ = 20.0


def drive(turn_radps, track_m=1.03, bias_radps=0.004, seed=0, speed_mps=0.7):
    """Wheels and gyro of a robot that turns as commanded; yaw is its truth."""
    n = len(turn_radps)
    rng = np.random.default_rng(seed)
    speed = speed_mps * np.minimum(np.arange(n) / RATE_HZ / 2, 1)
    turn = np.asarray(turn_radps)
    z = np.column_stack([speed - turn * track_m / 2, speed + turn * track_m / 2, turn + bias_radps])
    return np.arange(n) / RATE_HZ, z + rng.normal(0, [0.02, 0.02, 0.005], z.shape)


SECONDS = np.arange(0, 60, 1 / RATE_HZ)
WINDING = 0.6 * np.sign(np.sin(SECONDS / 3)) * (np.abs(np.sin(SECONDS / 3)) > 0.4)


@pytest.mark.parametrize("hidden_m", [0.62, 0.9, 1.15])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_hidden_track_and_bias_come_back_from_a_drive_with_turns(hidden_m, seed):
    time_s, z = drive(WINDING, hidden_m, seed=seed)
    track = run_filter(MODEL, NOISE, time_s, z)
    for state, truth, widest in (("effective_track_m", hidden_m, 0.06), ("gyro_bias_radps", 0.004, 0.006)):
        std = track.std(state)[-1]
        assert abs(track.state(state)[-1] - truth) < 3 * std
        assert std < widest
    true_yaw = np.cumsum(np.append(0, WINDING[:-1])) / RATE_HZ
    error = np.angle(np.exp(1j * (track.state("yaw_rad") - true_yaw)))
    assert (np.abs(error)[1:] < 4 * track.std("yaw_rad")[1:]).all()
    assert sum(track.dropped.values()) < 0.02 * z.size


def test_without_turns_the_track_is_as_unknown_as_before():
    time_s, z = drive(np.zeros(SECONDS.size))
    track = run_filter(MODEL, NOISE, time_s, z)
    assert track.std("effective_track_m")[-1] > 0.95 * HUSKY.track_m
    assert track.state("effective_track_m")[-1] == pytest.approx(HUSKY.track_m, abs=0.05)
    assert abs(track.state("gyro_bias_radps")[-1] - 0.004) < 3 * track.std("gyro_bias_radps")[-1]


def test_it_has_no_speed_over_ground():
    time_s, z = drive(WINDING)
    track = run_filter(MODEL, NOISE, time_s, z)
    assert np.isinf(track.reference_age_s).all()


@pytest.mark.parametrize("turns_radps", [0.5 * MIN_TURN_RADPS, 2 * MIN_TURN_RADPS])
def test_jacobians_are_those_of_finite_differences(turns_radps):
    """Below the least turn the row of the track is left out of them on purpose."""
    x = np.array([1.0, 2.0, 0.4, 0.8, turns_radps, 0.9, 0.01])
    d, m = x.size, 3
    f, h, x_next, z_hat = np.zeros((d, d)), np.zeros((m, d)), np.zeros(d), np.zeros(m)
    MODEL.propagate(x, 0.1, np.zeros(1), x_next, f)
    MODEL.observe(x, np.zeros(1), z_hat, h)
    for j in range(d):
        ends = []
        for step in (1e-6, -1e-6):
            moved, there, seen = x.copy(), np.zeros(d), np.zeros(m)
            moved[j] += step
            MODEL.propagate(moved, 0.1, np.zeros(1), there, np.zeros((d, d)))
            MODEL.observe(moved, np.zeros(1), seen, np.zeros((m, d)))
            ends.append((there, seen))
        np.testing.assert_allclose(f[:, j], (ends[0][0] - ends[1][0]) / 2e-6, atol=1e-8)
        slope = (ends[0][1] - ends[1][1]) / 2e-6
        if MODEL.states[j] == "effective_track_m" and turns_radps < MIN_TURN_RADPS:
            slope[:] = 0.0
        np.testing.assert_allclose(h[:, j], slope, atol=1e-8)


def test_a_swerve_robot_is_refused():
    with pytest.raises(
        ConfigError, match="robot agrimaro has the drive 'swerve': this filter is for 'skid_steer'"
    ):
        make_skid_filter(load_robot("agrimaro"))
