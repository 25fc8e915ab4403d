"""The motion of a window, which a mirror or a direction does not change, and stretches that differ."""

import numpy as np
import pytest

from features.motion import odd_stretches, window_motion
from terrain.records import RunLog, Stream, Windows

RNG = np.random.default_rng(5)
CHANNELS = {"imu": ("gyro_z_radps",), "wheels": ("speed_left_mps", "speed_right_mps", "current_left_a")}


def windows_of(values, channels=CHANNELS):
    n = len(next(iter(values.values())))
    rates = dict.fromkeys(channels, 10.0)
    return Windows(values, channels, rates, 1.0, np.arange(n), np.full(n, "a"), np.full(n, "ice"))


@pytest.fixture
def values():
    return {"imu": RNG.normal(0, 0.3, (20, 1, 10)), "wheels": RNG.normal(0.1, 0.3, (20, 3, 10))}


def test_a_mirror_a_direction_currents_and_vibration_change_no_motion(values):
    imu, speeds = values["imu"], values["wheels"]
    motion = window_motion(windows_of(values))
    for other in (
        {"imu": -imu, "wheels": speeds[:, [1, 0, 2]]},
        {"imu": imu, "wheels": -speeds},
        {"imu": imu + np.tile([1.0, -1.0], 5), "wheels": speeds * [[1], [1], [7]]},
    ):
        for found, expected in zip(window_motion(windows_of(other)), motion, strict=True):
            np.testing.assert_allclose(found, expected)
    # What is not measured is NaN, and without wheels there is no motion.
    wheels = {"wheels": ("speed_1_mps", "speed_2_mps", "speed_3_mps")}
    motion = window_motion(windows_of({"wheels": speeds}, wheels))
    np.testing.assert_allclose(motion.speed_mps, np.abs(speeds).mean(axis=2).max(axis=1))
    assert np.isnan(motion.yaw_rate_radps).all()
    assert np.isnan(motion.turn_ratio).all()
    assert window_motion(windows_of({"imu": imu}, {"imu": ("gyro_z_radps",)})) is None


def test_a_stretch_of_another_vibration_is_found_and_a_plain_run_has_none(drive):
    """Nor has one that stands, or that has no wheels or no IMU."""
    imu, wheels = (drive("a", "GRASS", 21, duration_s=60.0).streams[name] for name in ("imu", "wheels"))
    stopped = Stream(wheels.time_s, np.zeros_like(wheels.values), wheels.channels)
    both = {"imu": imu, "wheels": wheels}
    for streams in (both, {"imu": imu}, {"wheels": wheels}, both | {"wheels": stopped}):
        assert odd_stretches(RunLog("a", "husky", streams)) == ()
    still = (imu.time_s - imu.time_s[0] >= 20) & (imu.time_s - imu.time_s[0] < 34)
    values = imu.values.copy()
    values[still] = values[still].mean(axis=0) + 0.02 * (values[still] - values[still].mean(axis=0))
    stuck = Stream(imu.time_s, values, imu.channels)
    (found,) = odd_stretches(RunLog("b", "husky", both | {"imu": stuck}))
    assert abs(found.start_s - imu.time_s[0] - 20) <= 2
    assert abs(found.end_s - imu.time_s[0] - 34) <= 2
    assert found.speed_mps > 0.1  # the wheels turn on
