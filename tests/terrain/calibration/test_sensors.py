"""Sensors at rest: biases, scales and noise that are hidden in simulated logs come back within their intervals."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from terrain.calibration.sensors import (
    ACCEL,
    GYRO,
    MIN_POSITION_S,
    accelerometer,
    fit_gravity,
    measurement_variances,
    sensor_noise,
    standing,
)
from terrain.constants import GRAVITY_MPS2
from terrain.errors import DataError
from terrain.estimation.feed import ROWS
from terrain.records import RunLog, Stream


def with_imu(run, change):
    """Return a run whose IMU's values (n, channels) went through ``change(time_s, values)``."""
    imu = run.streams["imu"]
    changed = Stream(imu.time_s, change(imu.time_s, np.array(imu.values)), imu.channels)
    return RunLog(run.run_id, run.robot, {**run.streams, "imu": changed}, run.labels)


def noise_run(nominal, rng, smoothness, bias_radps=0.0, duration_s=20.0):
    """Return a standing IMU whose noise keeps ``smoothness`` of itself from sample to sample."""
    n, sensors = round(100 * duration_s), nominal.sensors
    white = rng.standard_normal((n + 200, 7)) * math.sqrt(1 - smoothness**2)
    std = np.repeat([sensors.gyro_std_radps, sensors.accel_std_mps2, 0.002], [3, 3, 1])
    values = lfilter([1.0], [1.0, -smoothness], white, axis=0)[200:] * std
    values += [bias_radps] * 3 + [0.0, 0.0, 9.80665, 0.0]
    return RunLog(
        "noise", nominal.name, {"imu": Stream(np.arange(n) / 100, values, (*GYRO, *ACCEL, "yaw_rad"))}
    )


def test_standing_stretches_contain_no_motion(drive, nominal):
    (whole,) = standing(drive("stand", 1), nominal)
    assert whole.start_s < 1.0
    assert whole.end_s > 19.0
    run = drive("straight", 1, duration_s=20.0)  # stands for a second
    assert standing(run, nominal) == []
    (short,) = standing(run, nominal, min_s=1.0)
    assert short.end_s <= 1.0
    starts = drive("starts", 1, duration_s=60.0)
    truth = starts.streams["truth"]
    for stretch in standing(starts, nominal, min_s=1.0):
        rows = (truth.time_s >= stretch.start_s) & (truth.time_s <= stretch.end_s)
        assert np.abs(truth.channel("speed_x_mps")[rows]).max() < 0.01


def test_a_knock_ends_a_stretch_and_a_dead_sensor_has_none(drive, nominal):
    run = drive("stand", 2)

    def knock(time_s, values):
        values[(time_s > 9.0) & (time_s < 9.3), 3] += 0.5 * (-1) ** np.arange(29)
        return values

    first, second = standing(with_imu(run, knock), nominal)
    assert first.end_s <= 9.0
    assert second.start_s >= 9.3
    frozen = with_imu(run, lambda _, values: np.tile(values[0], (len(values), 1)))
    assert standing(frozen, nominal) == []
    turned = with_imu(run, lambda _, values: values + np.eye(values.shape[1])[2] * 0.1)
    assert standing(turned, nominal) == []  # 6 deg/s is no bias
    assert standing(RunLog("r", "agrimaro", {"wheels": run.streams["wheels"]}), nominal) == []


def noise_of(runs, robot):
    found = sensor_noise([stretch for run in runs for stretch in standing(run, robot)], robot)
    return {finding.parameter: finding for finding in found}


def test_noise_is_separated_from_slow_drift_and_from_jumps(drive, nominal):
    biased = nominal.with_parts(sensors=replace(nominal.sensors, gyro_bias_z_radps=0.02))
    run = drive("stand", 1, robot=biased)
    plain = noise_of([run], nominal)
    assert plain["sensors.yaw_std_rad"].value == pytest.approx(nominal.sensors.yaw_std_rad, rel=0.05)
    odometry = run.streams["odometry"]
    values = np.array(odometry.values)
    values[1000:1004, 7:10] += 2.0
    jumped = RunLog(
        "r", run.robot, {**run.streams, "odometry": Stream(odometry.time_s, values, odometry.channels)}
    )
    for name, finding in noise_of([jumped], nominal).items():
        if finding.determined:
            assert finding.value == pytest.approx(plain[name].value, rel=0.01)


def test_the_interval_of_coloured_noise_is_wider(nominal):
    rng, imu = np.random.default_rng(1), {}
    for smoothness in (0.0, 0.6):
        found = [
            noise_of([noise_run(nominal, rng, smoothness)], nominal)["sensors.yaw_std_rad"] for _ in range(12)
        ]
        imu[smoothness] = np.mean([(f.low <= 0.002 <= f.high, f.high - f.low) for f in found], axis=0)
    assert min(imu[0.0][0], imu[0.6][0]) >= 0.8
    assert imu[0.6][1] > 1.3 * imu[0.0][1]


def test_variances_of_the_filters_rows(nominal):
    variances = measurement_variances(nominal)
    assert set(variances) == set(ROWS[:14])
    assert min(variances.values()) == 1e-5  # thesis 4.4.3
    bare = measurement_variances(nominal, floor=0.0)
    assert bare["wheel_2_radps"] == pytest.approx(0.005**2)
    assert bare["steer_1_rad"] == pytest.approx(0.001**2 + (2 * math.pi / 4096) ** 2 / 12)
    assert bare["camera_speed_y_mps"] == pytest.approx(3e-6, rel=0.01)  # thesis 6.1.1
    assert all(variances[row] == max(variance, 1e-5) for row, variance in bare.items())


def calibrated(runs, robot):
    return accelerometer([s for run in runs for s in standing(run, robot, MIN_POSITION_S)], robot)


def test_level_standing_alone_is_not_enough(drive, nominal, hidden):
    findings = calibrated([drive("stand", 1)], nominal)
    assert len(findings) == 7
    assert not any(finding.determined for finding in findings)
    assert all("like a tilt" in finding.note for finding in findings)
    up = GRAVITY_MPS2 * np.vstack([np.eye(3), -np.eye(3)])
    with pytest.raises(DataError, match="axis y was not turned both up and down"):
        fit_gravity(up[[0, 1, 2, 3, 5]], np.full((5, 3), 1e-6))
