import numpy as np

from features.breaks import odd_stretches
from terrain.records import RunLog, Stream


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
