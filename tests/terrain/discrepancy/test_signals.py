"""From streams to one clock: what a run says comes through, what it does not say stays unknown."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from terrain.discrepancy.runs import PARALLEL, signals_of
from terrain.effects import ACCEL, CHANNELS, CURRENT, GYRO, HEADING, SPEED_X, SPEED_Y, TURNING_CURRENT
from terrain.errors import DataError
from terrain.records import Label, Stream
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Conditions

HUSKY, AGRIMARO = load_robot("husky"), load_robot("agrimaro")


def drive(robot, **options):
    t = np.arange(1001) / 50
    twist = np.column_stack([0.4 * np.sin(0.8 * t), np.zeros_like(t), 0.3 * np.sin(1.1 * t)])
    if robot is AGRIMARO:
        twist[:, 1] = 0.2 * np.sin(0.5 * t)
    return simulate(
        robot,
        twist,
        Ground(),
        1,
        terrain="grass",
        conditions=Conditions(grade_ratio=(0.05, 0.0), undulation_ratio=0.02),
        **options,
    )


@pytest.fixture(scope="module")
def husky():
    return drive(HUSKY, heading=True)


@pytest.fixture(scope="module")
def agrimaro():
    return drive(AGRIMARO)


def channel(signals, name):
    return signals.measured[:, CHANNELS.index(name)]


def with_stream(run, name, stream):
    streams = {key: value for key, value in run.streams.items() if key != name}
    return replace(run, streams=streams if stream is None else {**streams, name: stream})


def kept(stream, rows):
    return Stream(stream.time_s[rows], stream.values[rows], stream.channels)


def test_streams_of_a_skid_steer_robot_are_resampled_to_one_clock(husky):
    signals = signals_of(husky, HUSKY)
    wheels, imu, seen = (husky.streams[name] for name in ("wheels", "imu", "odometry"))
    assert (signals.run_id, signals.terrain, signals.dt_s, len(signals)) == ("run", "grass", 0.02, 1001)
    assert_allclose(signals.time_s, wheels.time_s)
    assert_array_equal(signals.wheel_speed_mps, wheels.values[:, :2])
    assert not signals.steer_rad.any()
    left, right = wheels.values[:, 2:].T
    for shown, logged in (
        (signals.grade_rad, -imu.channel("pitch_rad")[::2]),
        (signals.roll_rad, imu.channel("roll_rad")[::2]),
        (channel(signals, GYRO), imu.channel("gyro_z_radps")[::2]),
        (channel(signals, ACCEL), imu.channel("accel_x_mps2")[::2]),
        (channel(signals, SPEED_X), seen.values[:, 0]),
        (channel(signals, SPEED_Y), seen.values[:, 1]),
        (channel(signals, HEADING), husky.streams["lidar"].values[:, 0]),
        (channel(signals, CURRENT), left + right),
        (channel(signals, TURNING_CURRENT), right - left),
    ):
        assert_allclose(shown, logged, atol=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        signals.measured[0, 0] = 1.0


def test_a_tracking_camera_measures_the_speed_of_its_own_point_in_body_axes(agrimaro):
    signals, truth, camera = signals_of(agrimaro, AGRIMARO), agrimaro.streams["truth"], AGRIMARO.camera
    late_s = signals.time_s - camera.latency_s - camera.time_constant_s
    x, y, turn = (
        np.interp(late_s, truth.time_s, truth.channel(name))
        for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    )
    # straight lines between samples of the truth
    assert_allclose(channel(signals, SPEED_X), x - camera.lever_y_m * turn, atol=2e-3)
    assert_allclose(channel(signals, SPEED_Y), y + camera.lever_x_m * turn, atol=2e-3)
    assert np.isnan(channel(signals, HEADING)).all()


def test_steering_zeros_and_turns_are_subtracted_and_motor_rates_become_wheel_speeds(agrimaro):
    signals, truth = signals_of(agrimaro, AGRIMARO), agrimaro.streams["truth"]
    wheels, steering = agrimaro.streams["wheels"], agrimaro.streams["steering"]
    expected = np.column_stack([truth.channel(f"steer_{i}_rad")[::2] for i in (1, 2, 3)])
    per_motor = AGRIMARO.wheel_radius_m / AGRIMARO.motors.reduction_ratio
    turned = replace(steering, values=np.angle(np.exp(1j * (steering.values + 2 * np.pi))))
    for run in (agrimaro, with_stream(agrimaro, "steering", turned)):
        assert_allclose(signals_of(run, AGRIMARO).steer_rad, expected, atol=1e-9)
    assert_allclose(signals.wheel_speed_mps, wheels.values[:, :3] * per_motor)
    parallel = (
        np.abs(np.exp(1j * signals.steer_rad).mean(axis=1)) > PARALLEL
    )  # else no sum of currents counts
    assert 0.1 < parallel.mean() < 0.9
    assert_array_equal(np.isfinite(channel(signals, CURRENT)), parallel)
    assert np.isnan(channel(signals, TURNING_CURRENT)).all()


def test_current_magnitudes_get_the_sign_of_their_wheel_and_signed_ones_stay():
    # on the spot: the sides turn against each other, and both motors drive
    t = np.arange(1001) / 50
    twist = np.column_stack([np.zeros_like(t), np.zeros_like(t), 0.8 * np.minimum(t, 1.0)])
    run = simulate(HUSKY, twist, Ground(), 1, terrain="grass")
    wheels = run.streams["wheels"]
    values = np.array(wheels.values)
    at = [wheels.channels.index(f"current_{side}_a") for side in ("left", "right")]
    values[:, at] = np.abs(values[:, at])
    sizes = with_stream(run, "wheels", Stream(wheels.time_s, values, wheels.channels))
    signed, restored = signals_of(run, HUSKY), signals_of(sizes, HUSKY)
    steady = signed.time_s > 2.0
    assert_allclose(channel(restored, TURNING_CURRENT)[steady], channel(signed, TURNING_CURRENT)[steady])
    assert channel(restored, TURNING_CURRENT)[steady].mean() > 1.0
    braked = np.array(values)
    braked[500, at[0]] = -0.1  # one sample below zero: the motor driver logs signs
    logged = signals_of(with_stream(run, "wheels", Stream(wheels.time_s, braked, wheels.channels)), HUSKY)
    assert abs(channel(logged, TURNING_CURRENT)[steady].mean()) < 0.1


def test_long_holes_stay_holes_and_short_ones_are_bridged(husky):
    seen, wheels, imu = (husky.streams[name] for name in ("odometry", "wheels", "imu"))
    lost = (seen.time_s > 5.0) & (seen.time_s < 7.0)
    short = (seen.time_s > 9.995) & (seen.time_s < 10.025)
    blank = wheels.values.copy()
    blank[(wheels.time_s > 12.0) & (wheels.time_s < 13.0), 0] = np.nan
    run = with_stream(husky, "odometry", kept(seen, ~lost & ~short))
    run = with_stream(run, "wheels", replace(wheels, values=blank))
    signals = signals_of(
        with_stream(run, "imu", replace(imu, values=np.full_like(imu.values, np.nan))), HUSKY
    )
    time_s, known = signals.time_s, np.isfinite(channel(signals, SPEED_X))
    assert_array_equal(known, ~((time_s > 5.0 + 1e-9) & (time_s < 7.0 - 1e-9)))
    assert_allclose(channel(signals, SPEED_X)[known], seen.values[known, 0], atol=1e-3)
    silent = (time_s > 12.0) & (time_s < 13.0 - 1e-9)
    assert_array_equal(np.isfinite(signals.wheel_speed_mps), np.column_stack([~silent, silent | True]))
    assert np.isnan(channel(signals, GYRO)).all()


def test_what_is_slow_late_or_not_there_sets_the_clock_and_what_is_known(husky):
    slow, imu = kept(husky.streams["wheels"], slice(None, None, 5)), husky.streams["imu"]
    late = kept(imu, slice(300, 1500))
    signals = signals_of(with_stream(with_stream(husky, "wheels", slow), "imu", late), HUSKY)
    assert (signals.dt_s, signals.start_s, len(signals)) == pytest.approx((0.1, 3.0, 120))
    gyro = Stream(imu.time_s, imu.values[:, 2:4], imu.channels[2:4])
    labels = Label(0.0, 9.0, "grass"), Label(9.0, 20.0, "gravel")
    signals = signals_of(replace(with_stream(husky, "imu", gyro), labels=labels), HUSKY)
    assert signals.terrain == ""
    assert np.isnan(channel(signals, ACCEL)).all()
    assert np.isfinite(channel(signals, GYRO)).all()
    assert not signals.grade_rad.any()


def test_a_run_that_cannot_be_compared_is_refused_in_one_sentence(husky, agrimaro):
    wheels, imu = husky.streams["wheels"], husky.streams["imu"]
    short = replace(husky, streams={name: kept(s, s.time_s < 3.0) for name, s in husky.streams.items()})
    apart = with_stream(husky, "imu", replace(imu, time_s=imu.time_s + 30.0))
    side, speeds = (Stream(wheels.time_s, wheels.values[:, :n], wheels.channels[:n]) for n in (1, 2))
    for run, robot, message in (
        (husky, AGRIMARO, "is of the robot 'husky', the simulation is of 'agrimaro'"),
        (with_stream(husky, "wheels", None), HUSKY, "no stream 'wheels'"),
        (with_stream(agrimaro, "steering", None), AGRIMARO, "no stream 'steering'"),
        (with_stream(husky, "wheels", side), HUSKY, "a speed of each of left, right is required"),
        (short, HUSKY, "have 3.0 s in common, at least 4 s"),
        (apart, HUSKY, "have 0.0 s in common"),
        (replace(husky, streams={"wheels": speeds}), HUSKY, "none of its channels is simulated"),
    ):
        with pytest.raises(DataError) as error:
            signals_of(run, robot)
        assert message in str(error.value)
        assert "\n" not in str(error.value)
