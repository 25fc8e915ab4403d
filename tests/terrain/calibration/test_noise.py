import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from terrain.calibration.noise import measurement_variances, sensor_noise
from terrain.calibration.standing import standing
from terrain.estimation.measurements.table import ROWS_OF_DRIVE
from terrain.records import RunLog, Stream

N_SEEDS = 20


def noise_of(runs, robot):
    found = sensor_noise([stretch for run in runs for stretch in standing(run, robot)], robot)
    return {finding.parameter: finding for finding in found}


def test_noise_comes_back(drive, nominal, coverage):
    found = [noise_of([drive("stand", seed, duration_s=15.0)], nominal) for seed in range(N_SEEDS)]
    held = coverage([findings.values() for findings in found])
    assert len(held) == 8
    assert min(held.values()) >= 0.8
    for finding in found[0].values():  # and narrow: 5 % of each
        assert not finding.determined or finding.high - finding.low < 0.1 * finding.value
    motor = found[0]["sensors.motor_std_radps"]
    assert not motor.determined
    assert motor.note == "no noise at rest"  # a Hall sensor that sees no step


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
    rng = np.random.default_rng(1)
    imu = {}
    for smoothness in (0.0, 0.6):
        hits, n = [], 2000
        for _ in range(40):
            white = rng.standard_normal((n + 50, 7)) * math.sqrt(1 - smoothness**2)
            noise = lfilter([1.0], [1.0, -smoothness], white, axis=0)[50:]
            values = noise * ([0.0017] * 3 + [0.0116] * 3 + [0.002])
            channels = [
                *(f"gyro_{a}_radps" for a in "xyz"),
                *(f"accel_{a}_mps2" for a in "xyz"),
                "yaw_rad",
            ]
            run = RunLog("r", "agrimaro", {"imu": Stream(np.arange(n) / 100, values, channels)})
            finding = noise_of([run], nominal)["sensors.yaw_std_rad"]
            hits.append((finding.low <= 0.002 <= finding.high, finding.high - finding.low))
        imu[smoothness] = np.mean(hits, axis=0)
    assert imu[0.0][0] >= 0.85
    assert imu[0.6][0] >= 0.8
    assert imu[0.6][1] > 1.3 * imu[0.0][1]


def test_noise_below_the_encoder_step_is_undetermined(drive, nominal):
    fine = nominal.with_parts(sensors=replace(nominal.sensors, steering_std_rad=0.0004))
    finding = noise_of([drive("stand", 1, robot=fine)], nominal)["sensors.steering_std_rad"]
    assert not finding.determined
    assert "step" in finding.note or finding.note == "no noise at rest"


def test_a_missing_sensor_has_undetermined_noise(drive, nominal):
    run = drive("stand", 1)
    bare = RunLog("r", run.robot, {name: run.streams[name] for name in ("imu", "wheels")})
    found = noise_of([bare], nominal)
    assert found["sensors.gyro_std_radps"].determined
    assert found["camera.speed_std_mps"].note == "no standing stretch has this signal"
    assert not any(finding.determined for finding in sensor_noise([], nominal))


def test_variances_of_the_filters_rows(nominal):
    variances = measurement_variances(nominal)
    assert set(variances) == set(ROWS_OF_DRIVE["swerve"][:14])
    assert min(variances.values()) == 1e-5  # thesis 4.4.3
    bare = measurement_variances(nominal, floor=0.0)
    assert bare["wheel_2_radps"] == pytest.approx(0.005**2)
    assert bare["steer_1_rad"] == pytest.approx(0.001**2 + (2 * math.pi / 4096) ** 2 / 12)
    assert bare["camera_speed_y_mps"] == pytest.approx(3e-6, rel=0.01)  # thesis 6.1.1
    assert all(variances[row] == max(variance, 1e-5) for row, variance in bare.items())
