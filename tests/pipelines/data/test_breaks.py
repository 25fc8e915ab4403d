import numpy as np

from features.breaks import odd_stretches
from terrain.records import RunLog, Stream


def test_a_stretch_of_another_vibration_is_found_and_a_plain_run_has_none(drive):
    run = drive("a", "GRASS", 21, duration_s=60.0)
    assert odd_stretches(run) == ()
    imu = run.streams["imu"]
    still = (imu.time_s - imu.time_s[0] >= 20) & (imu.time_s - imu.time_s[0] < 34)
    values = imu.values.copy()
    values[still] = values[still].mean(axis=0) + 0.02 * (values[still] - values[still].mean(axis=0))
    stuck = RunLog("b", run.robot, {**run.streams, "imu": Stream(imu.time_s, values, imu.channels)})
    (found,) = odd_stretches(stuck)
    assert abs(found.start_s - run.streams["imu"].time_s[0] - 20) <= 2
    assert abs(found.end_s - run.streams["imu"].time_s[0] - 34) <= 2
    assert found.speed_mps > 0.1  # the wheels turn on


def test_a_run_without_wheels_or_imu_has_none(drive):
    run = drive("a", "GRASS", 21)
    for name in ("imu", "wheels"):
        rest = {stream: each for stream, each in run.streams.items() if stream != name}
        assert odd_stretches(RunLog("b", run.robot, rest)) == ()
    wheels = run.streams["wheels"]
    stopped = Stream(wheels.time_s, np.zeros_like(wheels.values), wheels.channels)
    assert odd_stretches(RunLog("c", run.robot, {**run.streams, "wheels": stopped})) == ()
