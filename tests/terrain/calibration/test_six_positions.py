import numpy as np
import pytest

from terrain.calibration.six_positions import MIN_POSITION_S, accelerometer, fit_gravity
from terrain.calibration.standing import gyro_bias, standing
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, DataError
from terrain.simulation.bench import six_positions_log

N_SEEDS = 20


def calibrated(runs, robot):
    return accelerometer([s for run in runs for s in standing(run, robot, MIN_POSITION_S)], robot)


@pytest.mark.parametrize("n_logs", [1, 3])
def test_bias_and_scale_come_back(n_logs, nominal, hidden, coverage):
    found = [
        calibrated(
            [six_positions_log(hidden, 10 * s + i, hold_s=3.0, run_id=f"b{i}") for i in range(n_logs)],
            nominal,
        )
        for s in range(N_SEEDS)
    ]
    held = coverage(found)
    assert len(held) == (6 if n_logs == 1 else 7)
    assert min(held.values()) >= 0.8
    for finding in found[0]:
        if "scale" in finding.parameter:
            assert finding.high - finding.low < 0.001


def test_more_and_crooked_positions_fit_too():
    rng = np.random.default_rng(0)
    up = rng.standard_normal((14, 3))
    up = np.vstack([up / np.linalg.norm(up, axis=1)[:, None], np.eye(3), -np.eye(3)])
    bias, scale, std = np.array([0.3, -0.2, 0.5]), np.array([1.05, 0.96, 1.01]), 1e-3
    pulls = []
    for _ in range(60):
        seen = scale * GRAVITY_MPS2 * up + bias + std * rng.standard_normal(up.shape)
        b, k, cov = fit_gravity(seen, np.full(up.shape, std**2))
        pulls.append((np.concatenate([b - bias, k - scale])) / np.sqrt(np.diag(cov)))
    assert np.std(pulls) == pytest.approx(1.0, abs=0.15)
    assert np.abs(np.mean(pulls, axis=0)).max() < 4 / np.sqrt(60)


def test_square_positions_have_a_closed_form():
    up = GRAVITY_MPS2 * np.vstack([np.eye(3), -np.eye(3)])
    scale, bias = np.array([1.02, 0.97, 1.0]), np.array([0.1, -0.3, 0.0])
    seen = scale * up + bias
    b, k, _ = fit_gravity(seen, np.full((6, 3), 1e-6))
    np.testing.assert_allclose(b, (seen.max(axis=0) + seen.min(axis=0)) / 2, atol=0.02)
    np.testing.assert_allclose(np.abs(((seen - b) / k) ** 2).sum(axis=1), GRAVITY_MPS2**2, rtol=1e-9)


def test_level_standing_alone_is_not_enough(drive, nominal, hidden):
    findings = calibrated([drive("stand", 1)], nominal)
    assert len(findings) == 7
    assert not any(finding.determined for finding in findings)
    assert all("like a tilt" in finding.note for finding in findings)
    up = GRAVITY_MPS2 * np.vstack([np.eye(3), -np.eye(3)])
    with pytest.raises(DataError, match="axis y was not turned both up and down"):
        fit_gravity(up[[0, 1, 2, 3, 5]], np.full((5, 3), 1e-6))


def test_the_bench_is_a_power_on_like_any_other(nominal, hidden):
    log = six_positions_log(hidden, 3, hold_s=6.0)
    again = six_positions_log(hidden, 3, hold_s=6.0)
    assert log.streams["imu"].values.tobytes() == again.streams["imu"].values.tobytes()
    held = standing(log, nominal)
    assert len(held) == 6
    assert gyro_bias(held, nominal)[0].determined
    imu = log.streams["imu"]
    roll, pitch = (imu.channel(name) for name in ("roll_rad", "pitch_rad"))
    vertical = np.column_stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    scales = [getattr(hidden.sensors, f"accel_scale_{axis}_ratio") for axis in "xyz"]
    biases = [getattr(hidden.sensors, f"accel_bias_{axis}_mps2") for axis in "xyz"]
    error = imu.values[:, 3:6] - biases - scales * vertical * GRAVITY_MPS2
    assert np.abs(error.mean(axis=0)).max() < 4 * hidden.sensors.accel_bias_std_mps2
    with pytest.raises(ConfigError, match="hold_s is 0"):
        six_positions_log(hidden, 3, hold_s=0)
