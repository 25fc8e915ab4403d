from itertools import pairwise

import numpy as np
import pytest

from terrain.errors import ConfigError, DataError
from terrain.logs.replay import replay
from terrain.records import Label, RunLog, Stream


def run_of(**streams):
    made = {name: Stream(t, np.asarray(v, float), c) for name, (t, v, c) in streams.items()}
    return RunLog("a", "agrimaro", made, labels=(Label(0.0, 0.05, "grass"), Label(0.05, 9.0, "sand")))


def imu(time_s):
    return (time_s, np.arange(float(len(time_s)))[:, None], ("gyro_z_radps",))


def commands(time_s, twist):
    return (time_s, twist, ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"))


def test_every_sample_arrives_once_in_order_and_not_before_its_stamp():
    rng = np.random.default_rng(0)
    wheels, fast = np.arange(100) / 50.0 + 0.003, np.cumsum(rng.uniform(0.001, 0.02, 300)) - 0.1
    run = run_of(wheels=imu(wheels), imu=imu(fast), truth=imu(fast))
    samples = list(replay(run))
    assert samples[0].time_s == wheels[0]
    for name in ("wheels", "imu"):
        parts = [s.readings[name] for s in samples if name in s.readings]
        np.testing.assert_array_equal(np.concatenate([p.time_s for p in parts]), run.streams[name].time_s)
        np.testing.assert_array_equal(np.concatenate([p.values for p in parts]), run.streams[name].values)
    assert all(set(s.readings) <= {"wheels", "imu"} for s in samples)
    for before, sample in pairwise(samples):
        for reading in sample.readings.values():
            assert reading.time_s.size
            assert (reading.time_s <= sample.time_s + 1e-9).all()
            assert (reading.time_s > before.time_s).all()
    assert sum("wheels" in s.readings for s in samples) == 100  # one a step, on their own clock


def test_samples_out_of_order_are_delivered_with_the_next_in_order():
    time_s = np.array([0.0, 0.02, 50.0, 0.04, 0.01, np.nan, 0.06, 0.08, -3.0])
    samples = list(replay(run_of(imu=imu(time_s))))
    came = {int(v): s.time_s for s in samples for v in s.readings["imu"].values[:, 0]}
    np.testing.assert_allclose(
        [came[k] for k in range(9)], [0, 0.02, 0.04, 0.04, 0.06, 0.06, 0.06, 0.08, 0.08]
    )


def test_the_twist_is_the_last_command_and_the_terrain_is_the_label():
    run = run_of(imu=imu(np.arange(6) / 50.0), commands=commands([0.02, 0.07], [[1, 2, 3], [4, 5, 6]]))
    samples = list(replay(run))
    np.testing.assert_array_equal([s.twist[0] for s in samples], [0, 1, 1, 1, 4, 4])
    assert [s.terrain for s in samples] == ["grass"] * 3 + ["sand"] * 3
    assert not any(s.twist.any() for s in replay(run_of(imu=imu([0.0, 0.1]))))


def test_what_cannot_be_replayed_is_refused():
    late = run_of(imu=imu(np.array([0.0, 1.0, 1.7e9])))
    for run, options, error, sentence in (
        (run_of(imu=imu([0.0])), (0.0,), ConfigError, "rate_hz is 0"),
        (run_of(truth=imu([0.0])), (), DataError, "no sensor to replay"),
        (late, (), DataError, r"472222\.2 h apart, its clock was set; at most 111\.1 h"),
    ):
        with pytest.raises(error, match=sentence):
            replay(run, *options)


def test_what_a_log_has_of_the_desired_twist_is_given():
    run = run_of(imu=imu([0.0, 0.02]), commands=([0.0], [[0.5, 0.2]], ("speed_x_mps", "yaw_rate_radps")))
    assert [sample.twist.tolist() for sample in replay(run)] == [[0.5, 0.0, 0.2]] * 2
