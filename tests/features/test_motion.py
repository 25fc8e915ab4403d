"""The motion of a window: what a mirror or a direction changes nothing of, and what is not known."""

import numpy as np
import pytest

from features.motion import window_motion
from terrain.records import Windows

RNG = np.random.default_rng(5)
CHANNELS = {"imu": ("gyro_z_radps",), "wheels": ("speed_left_mps", "speed_right_mps", "current_left_a")}


def windows_of(values, channels=CHANNELS):
    n = len(next(iter(values.values())))
    rates = dict.fromkeys(channels, 10.0)
    return Windows(values, channels, rates, 1.0, np.arange(n), np.full(n, "a"), np.full(n, "ice"))


@pytest.fixture
def values():
    return {"imu": RNG.normal(0, 0.3, (20, 1, 10)), "wheels": RNG.normal(0.1, 0.3, (20, 3, 10))}


def test_left_and_right_forward_and_back_are_one_motion(values):
    motion = window_motion(windows_of(values))
    mirrored = {"imu": -values["imu"], "wheels": values["wheels"][:, [1, 0, 2]]}
    back = {"imu": values["imu"], "wheels": -values["wheels"]}
    for other in (mirrored, back):
        for found, expected in zip(window_motion(windows_of(other)), motion, strict=True):
            np.testing.assert_allclose(found, expected)


def test_currents_and_vibration_change_nothing(values):
    motion = window_motion(windows_of(values))
    shaken = {"imu": values["imu"] + np.tile([1.0, -1.0], 5), "wheels": values["wheels"] * [[1], [1], [7]]}
    for found, expected in zip(window_motion(windows_of(shaken)), motion, strict=True):
        np.testing.assert_allclose(found, expected)


def test_what_is_not_measured_is_nan_and_without_wheels_there_is_no_motion(values):
    wheels = {"wheels": ("speed_1_mps", "speed_2_mps", "speed_3_mps")}
    motion = window_motion(windows_of({"wheels": values["wheels"]}, wheels))
    np.testing.assert_allclose(motion.speed_mps, np.abs(values["wheels"]).mean(axis=2).max(axis=1))
    assert np.isnan(motion.yaw_rate_radps).all()
    assert np.isnan(motion.turn_ratio).all()
    assert window_motion(windows_of({"imu": values["imu"]}, {"imu": ("gyro_z_radps",)})) is None


def test_a_robot_that_stands_has_no_turn_ratio():
    motion = window_motion(windows_of({"imu": np.zeros((1, 1, 10)), "wheels": np.zeros((1, 3, 10))}))
    assert (motion.speed_mps[0], motion.yaw_rate_radps[0]) == (0, 0)
    assert np.isnan(motion.turn_ratio[0])
