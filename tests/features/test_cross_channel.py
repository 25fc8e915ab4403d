import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from features.cross_channel import MIN_WHEEL_DIFFERENCE_MPS, derived_channels, left_right, speed_features

IMU = ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps", "accel_x_mps2", "accel_y_mps2", "accel_z_mps2")
WHEELS = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")


def by_name(imu, wheels, wheel_channels=WHEELS):
    features, table = speed_features({"imu": imu, "wheels": wheels}, {"imu": IMU, "wheels": wheel_channels})
    assert table.shape == (len(imu), len(features))
    return dict(zip([feature.name for feature in features], table.T, strict=True))


def test_speed_features_exclude_estimated_signals():
    values = {"imu": np.ones((2, 6, 50)), "estimator": np.ones((2, 2, 50))}
    channels = {"imu": IMU, "estimator": ("speed_x_mps", "accel_x_mps2")}
    assert speed_features(values, channels)[0] == []  # an estimated speed is none of the wheels'
    values["wheels"], channels["wheels"] = np.ones((2, 4, 13)), WHEELS
    names = [feature.name for feature in speed_features(values, channels)[0]]
    assert any(name.startswith("imu.accel_x") for name in names)
    assert not any(name.startswith("estimator") for name in names)


def turning_windows(track_m, n_windows=30, noise_radps=0.02, seed=0):
    """Windows of 2 s of a robot that follows random turns on an effective track width."""
    rng = np.random.default_rng(seed)
    phase, period_s = rng.uniform(0, 6.3, (n_windows, 1)), rng.uniform(1.0, 5.0, (n_windows, 1))

    def difference_mps(time_s):
        return 0.3 + 0.2 * np.sin(2 * np.pi * time_s / period_s + phase)

    imu = noise_radps * rng.standard_normal((n_windows, 6, 200))
    imu[:, 2] += difference_mps(np.arange(200) / 100) / track_m
    half = difference_mps(np.arange(13) / 6.5) / 2
    return imu, np.stack([0.5 - half, 0.5 + half, 1 + half, 1 + half], axis=1)


@pytest.mark.parametrize("track_m", [0.57, 0.9, 1.6])
def test_the_effective_track_width_is_recovered_from_streams_of_two_rates(track_m):
    gain = by_name(*turning_windows(track_m))["turning.yaw_per_wheel_difference"]
    # In the fastest turns the eighths of 13 wheel samples are not quite the eighths of 200 IMU samples.
    assert gain * track_m == pytest.approx(1.0, abs=0.1)
    assert np.mean(gain) * track_m == pytest.approx(1.0, abs=0.015)


def test_more_turning_slip_means_less_yaw_and_the_sense_of_the_turn_does_not_matter():
    imu, wheels = turning_windows(0.6, noise_radps=0.0)
    name = "turning.yaw_per_wheel_difference"
    np.testing.assert_allclose(by_name(0.5 * imu, wheels)[name], 0.5 * by_name(imu, wheels)[name])
    np.testing.assert_allclose(by_name(-imu, wheels[:, [1, 0, 2, 3]])[name], by_name(imu, wheels)[name])


def test_without_a_turn_there_is_no_turning_slip():
    imu, wheels = turning_windows(0.6)
    straight = wheels.copy()
    straight[:, 1] = straight[:, 0] + 0.9 * MIN_WHEEL_DIFFERENCE_MPS
    assert np.isnan(by_name(imu, straight)["turning.yaw_per_wheel_difference"]).all()
    one_sided = by_name(imu, wheels[:, [0, 2]], ("speed_front_mps", "current_front_a"))
    assert "turning.yaw_per_wheel_difference" not in one_sided


def test_per_speed_features_match_their_definitions():
    rng = np.random.default_rng(0)
    imu, wheels = rng.standard_normal((5, 6, 200)), rng.uniform(0.3, 0.6, (5, 4, 13))
    slow, fast = by_name(imu, wheels), by_name(imu, wheels * [[2.0], [2.0], [1.0], [1.0]])
    np.testing.assert_allclose(
        fast["wheels.current_left.per_speed"], slow["wheels.current_left.per_speed"] / 2
    )
    for name in ("imu.gyro_x.log_std_per_speed", "imu.accel_z.log_std_per_speed"):
        np.testing.assert_allclose(fast[name], slow[name] - np.log10(2))
    effort = "wheels.log_drive_effort"
    np.testing.assert_allclose(fast[effort], slow[effort] + np.log10(2), atol=1e-3)
    backwards = by_name(imu, wheels * [[-1.0], [-1.0], [1.0], [1.0]])
    for name in slow:
        if not name.startswith("turning"):
            np.testing.assert_allclose(backwards[name], slow[name])


def test_standing_still_divides_by_no_zero():
    imu, wheels = turning_windows(0.6)
    found = by_name(imu, 0 * wheels)
    del found["turning.yaw_per_wheel_difference"]
    assert all(np.isfinite(values).all() for values in found.values())


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_norms_do_not_see_how_the_sensor_is_mounted(seed):
    rng = np.random.default_rng(seed)
    imu = rng.standard_normal((3, 6, 40))
    rotation = np.kron(np.eye(2), Rotation.random(rng=rng).as_matrix())
    there, names = derived_channels(imu, IMU)
    turned, _ = derived_channels(rotation @ imu, IMU)
    assert names == ("gyro_norm_radps", "accel_norm_mps2")
    np.testing.assert_allclose(turned, there, rtol=1e-10)
    assert there[1, 1, 7] == pytest.approx(np.linalg.norm(imu[1, 3:, 7]))


def test_total_and_difference_of_currents():
    current = np.random.default_rng(0).standard_normal((3, 2, 10))
    channels = ("current_right_a", "current_left_a")
    derived, names = derived_channels(current, channels)
    assert names == ("current_total_a", "current_difference_a")
    np.testing.assert_allclose(
        derived, np.stack([current.sum(axis=1), current[:, 0] - current[:, 1]], axis=1)
    )
    assert left_right(channels, "current") == (1, 0)
    four = np.random.default_rng(0).standard_normal((3, 4, 10))
    derived, _ = derived_channels(four, tuple(f"current_{i}_a" for i in range(4)))
    np.testing.assert_allclose(derived[:, 1], four.max(axis=1) - four.min(axis=1))
