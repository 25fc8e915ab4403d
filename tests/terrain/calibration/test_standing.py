import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from terrain.calibration.standing import GYRO, gyro_bias, standing
from terrain.records import RunLog, Stream

N_SEEDS = 20


def with_imu(run, change):
    """Return a run whose IMU's values (n, channels) went through ``change(time_s, values)``."""
    imu = run.streams["imu"]
    changed = Stream(imu.time_s, change(imu.time_s, np.array(imu.values)), imu.channels)
    return RunLog(run.run_id, run.robot, {**run.streams, "imu": changed}, run.labels)


def noise_run(nominal, rng, smoothness, bias_radps=0.0, duration_s=20.0):
    """Return a standing IMU whose noise keeps ``smoothness`` of itself from sample to sample."""
    n = round(100 * duration_s)
    white = rng.standard_normal((n + 200, 6)) * math.sqrt(1 - smoothness**2)
    noise = lfilter([1.0], [1.0, -smoothness], white, axis=0)[200:]
    sensors = nominal.sensors
    values = noise * np.repeat([sensors.gyro_std_radps, sensors.accel_std_mps2], 3)
    values += [bias_radps] * 3 + [0.0, 0.0, 9.80665]
    channels = (*GYRO, "accel_x_mps2", "accel_y_mps2", "accel_z_mps2")
    return RunLog("noise", nominal.name, {"imu": Stream(np.arange(n) / 100, values, channels)})


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


def test_wheels_that_turn_slowly_do_not_stand(drive, nominal):
    run = drive("stand", 3)
    wheels = run.streams["wheels"]
    values = np.array(wheels.values)
    values[500:, 1] = 1.0  # 2 cm/s
    creeping = RunLog(
        "r", run.robot, {**run.streams, "wheels": Stream(wheels.time_s, values, wheels.channels)}
    )
    (stretch,) = standing(creeping, nominal)
    assert stretch.end_s <= 10.0


@pytest.mark.parametrize("n_runs", [1, 4])
def test_gyro_biases_come_back(n_runs, drive, nominal, hidden, coverage):
    # One power-on leans on the described scatter, so that has to be the true one.
    described = nominal.with_parts(
        sensors=replace(nominal.sensors, gyro_bias_std_radps=hidden.sensors.gyro_bias_std_radps)
        if n_runs == 1
        else nominal.sensors,
    )
    found = []
    for seed in range(N_SEEDS):
        runs = [drive("stand", 10 * seed + i, duration_s=6.0) for i in range(n_runs)]
        found.append(gyro_bias([s for run in runs for s in standing(run, described)], described))
    held = coverage(found)
    assert len(held) == (3 if n_runs == 1 else 4)  # the scatter too
    assert min(held.values()) >= 0.8
    if n_runs == 1:
        assert "power-ons" in found[0][3].note


def test_coloured_noise_widens_the_interval(nominal):
    still = nominal.with_parts(sensors=replace(nominal.sensors, gyro_bias_std_radps=0.0))
    rng = np.random.default_rng(0)
    inside, naive = [], []
    for _ in range(30):
        stretches = standing(noise_run(still, rng, 0.95, bias_radps=0.003), still)
        finding = gyro_bias(stretches, still)[2]
        inside.append(finding.low <= 0.003 <= finding.high)
        naive.append(abs(finding.value - 0.003) < 1.96 * still.sensors.gyro_std_radps / np.sqrt(finding.n))
    assert np.mean(inside) >= 0.8
    assert np.mean(naive) < 0.6  # what independent samples would have had


def test_without_a_standing_stretch_no_bias_is_determined(nominal):
    findings = gyro_bias([], nominal)
    assert len(findings) == 4
    assert not any(finding.determined for finding in findings)
    assert {finding.note for finding in findings} == {
        "no run has a standing stretch of 5 s: let the robot stand, switched on"
    }
