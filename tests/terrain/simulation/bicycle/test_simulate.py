"""Drives of a car-like robot: streams, noise as stated, stops, determinism."""

from __future__ import annotations

import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS, unit_of
from terrain.robots import load_robot
from terrain.simulation.car import (
    CarCommand,
    CarDrive,
    SensorNoise,
    SpeedProfile,
    level_ground,
    open_loop,
    simulate_car,
)

ROBOT = load_robot("adap2e")
WEAVE = open_loop(np.arange(0.0, 30.0, 0.1), 0.1 * np.sin(np.arange(0.0, 30.0, 0.1)))
DRIVE = CarDrive(level_ground(0.7, 0.1), SpeedProfile(3.0, ((15.0, 2.0),)), duration_s=20.0)


def run(seed=1, controller=WEAVE, drive=DRIVE, noise=None):
    return simulate_car(ROBOT, drive, controller, np.random.default_rng(seed), noise or SensorNoise())


def test_streams_have_the_channels_of_run_logs_at_their_rates():
    log = run()
    assert log.streams["imu"].channels == IMU_CHANNELS
    assert log.streams["gnss"].channels == GNSS_CHANNELS
    rates = {"wheels": 50, "steering": 50, "imu": 100, "gnss": 10, "compass": 10, "truth": 100}
    for name, rate in rates.items():
        assert log.streams[name].rate_hz == pytest.approx(rate)
        assert [unit_of(channel) for channel in log.streams[name].channels]


def test_noise_is_as_stated():
    log, noise = run(), SensorNoise()
    truth = log.streams["truth"]
    moves = truth.channel("speed_x_mps")[::2] > 0
    speed = (log.streams["wheels"].values[:, 0] - truth.channel("speed_x_mps")[::2])[moves]
    x = log.streams["gnss"].channel("position_x_m") - truth.channel("position_x_m")[::10]
    gyro = log.streams["imu"].channel("gyro_z_radps") - truth.channel("yaw_rate_radps")
    assert speed.std() == pytest.approx(noise.speed_mps, rel=0.15)
    assert x.std() == pytest.approx(noise.position_m, rel=0.2)
    assert gyro.std() == pytest.approx(noise.gyro_radps, rel=0.1)


def test_specific_force_of_a_robot_at_rest_on_a_slope_is_gravity():
    log = run(drive=CarDrive(level_ground(0.7, 0.2), SpeedProfile(0.0), duration_s=4.0))
    accel = log.streams["imu"].values[200:, 3:6].mean(axis=0)
    assert accel == pytest.approx(9.80665 * np.array([0.0, np.sin(0.2), np.cos(0.2)]), abs=0.05)
    assert np.isnan(log.streams["truth"].channel("slip_rear_rad")[200:]).all()


def test_robot_stops_where_the_profile_says_for_as_long():
    log = run()
    truth = log.streams["truth"]
    stands = (truth.channel("speed_x_mps") == 0.0) & (truth.time_s > 1.0)
    assert truth.channel("distance_m")[stands] == pytest.approx(15.0, abs=0.1)
    assert stands.sum() / 100 == pytest.approx(2.0, abs=0.1)
    assert (log.streams["wheels"].values[stands[::2], 0] == 0.0).all()


def test_same_seed_gives_the_same_bytes_and_a_controller_what_was_logged():
    seen = []

    def controller(sample):
        seen.append(sample.measured)
        return WEAVE(sample)

    log, again = run(3, controller), run(3)
    for name, stream in log.streams.items():
        assert stream.values.tobytes() == again.streams[name].values.tobytes()
    rows = np.array(seen)
    assert rows[:, 0] == pytest.approx(log.streams["wheels"].values[:, 0])
    assert rows[:, 5] == pytest.approx(log.streams["imu"].channel("gyro_z_radps")[::2])
    assert rows[::5, 2] == pytest.approx(log.streams["gnss"].channel("position_x_m"))


def test_commands_that_are_no_numbers_and_speeds_beyond_the_robot_are_refused():
    with pytest.raises(ConfigError, match="controller commands"):
        run(controller=lambda sample: CarCommand(float("nan"), 1.0))
    with pytest.raises(ConfigError, match="range"):
        run(drive=CarDrive(level_ground(), SpeedProfile(20.0)))
