"""Rows of measurements by whole logs: ideal sensors give the motion; faults."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, DataError
from terrain.estimation.feed import (
    CAMERA_ROWS,
    GNSS_LATENCY_S,
    GNSS_ROWS,
    ROWS,
    measurement_table,
)
from terrain.kinematics.camera import odometry_stream
from terrain.logs.schema import GNSS_CHANNELS, IMU_CHANNELS
from terrain.records import RunLog, Stream
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
HUSKY = load_robot("husky")
NOISE = 1e-4
"""On all of camera and IMU: small, so that answers are plain; never none, so that nothing is frozen."""


def bare(encoder_time_constant_s=0.0):
    """Return the robot with ideal sensors but for the lag of its encoders."""
    return ROBOT.with_parts(
        camera=replace(ROBOT.camera, latency_s=0.0, time_constant_s=0.0),
        sensors=replace(ROBOT.sensors, encoder_time_constant_s=encoder_time_constant_s, imu_latency_s=0.0),
    )


def turning_run():
    """Return a run on an arc at 0.5 m/s and 0.4 rad/s; its sensors are ideal but for :data:`NOISE`."""
    rng, clocks = np.random.default_rng(0), [np.arange(6 * hz) / hz for hz in (50, 100, 200, 10)]

    def noisy(*columns):
        plain = np.column_stack(np.broadcast_arrays(*columns))
        return plain + NOISE * rng.standard_normal(plain.shape)

    def arc(t):
        return 1.25 * np.sin(0.4 * t), 1.25 - 1.25 * np.cos(0.4 * t)

    t, imu_s, camera_s, gnss_s = clocks
    motor = np.full((t.size, 3), 0.5 / ROBOT.wheel_radius_m * ROBOT.motors.reduction_ratio)
    steer = np.array([0.1, -0.2, 3.1]) + 0.1 * np.sin(t)[:, None]
    imu = noisy(0 * imu_s, 0.0, 0.4, 0.0, 0.2, GRAVITY_MPS2, 0.0, 0.0, 0.7 + 0.4 * imu_s)
    imu[:, 8] = np.angle(np.exp(1j * imu[:, 8]))
    seen = noisy(*arc(camera_s), 0.0, 0.0, 0.4 * camera_s, 0.5, 0.0, 0.4)
    speeds = 0.5 * np.cos(0.4 * gnss_s), 0.5 * np.sin(0.4 * gnss_s)
    places = np.add(np.column_stack(arc(gnss_s)), [500.0, -80.0])
    fixes = np.column_stack([places, *speeds, 0 * gnss_s, np.ones(gnss_s.size)])
    streams = {
        "wheels": Stream(t, motor, [f"motor_{i}_radps" for i in (1, 2, 3)]),
        "steering": Stream(t, np.angle(np.exp(1j * steer)), [f"angle_{i}_rad" for i in (1, 2, 3)]),
        "imu": Stream(imu_s, imu, IMU_CHANNELS),
        "odometry": odometry_stream(camera_s, seen[:, :2], seen[:, 2:5], seen[:, 5:], ROBOT.camera, 0.0),
        "gnss": Stream(gnss_s + GNSS_LATENCY_S, fixes, GNSS_CHANNELS),
    }
    return RunLog("run", "agrimaro", streams)


def change(run, name, edit):
    """Return the run with one stream edited: ``edit(time_s, values, channels) -> (time_s, values)``."""
    stream = run.streams[name]
    time_s, values = edit(np.array(stream.time_s), np.array(stream.values), list(stream.channels))
    return replace(run, streams={**run.streams, name: Stream(time_s, values, stream.channels)})


def set_rows(rows, value, channel=None):
    def edit(time_s, values, channels):
        where = rows(time_s) if callable(rows) else rows
        values[where, slice(None) if channel is None else channels.index(channel)] = value
        return time_s, values

    return edit


RUN = turning_run()


def test_ideal_sensors_give_the_motion():
    table = measurement_table(RUN, bare())
    assert table.rows == ROWS
    assert table.dropped == {}
    np.testing.assert_array_equal(table.time_s, RUN.streams["wheels"].time_s)
    t = table.time_s
    lever = np.array([ROBOT.camera.lever_x_m, ROBOT.camera.lever_y_m])
    expected = {
        **{f"wheel_{i}_radps": 0.5 / 0.2 for i in (1, 2, 3)},
        "accel_x_mps2": 0.0,
        "accel_y_mps2": 0.2,
        "gyro_z_radps": 0.4,
        "imu_yaw_rad": 0.4 * t,
        "steer_1_rad": 0.1 + 0.1 * np.sin(t),
        "steer_2_rad": -0.2 + 0.1 * np.sin(t),
        "steer_3_rad": 3.1 + 0.1 * np.sin(t),
        "camera_speed_x_mps": 0.5 - 0.4 * lever[1],
        "camera_speed_y_mps": 0.4 * lever[0],
        "camera_yaw_rate_radps": 0.4,
        "camera_yaw_rad": 0.4 * t,
    }
    for name, value in expected.items():
        within = 8 * NOISE * (GRAVITY_MPS2 if "accel" in name else 1)  # tilt moves gravity
        np.testing.assert_allclose(table.columns([name])[:, 0], value, atol=within, err_msg=name)
    fresh = np.arange(t.size) % 5 == 0  # a sensor slower than the clock gives each sample once
    gnss = table.columns(GNSS_ROWS)
    assert np.isnan(gnss[~fresh]).all()
    arc = np.column_stack([1.25 * np.sin(0.4 * t), 1.25 - 1.25 * np.cos(0.4 * t)])
    np.testing.assert_allclose(gnss[fresh, :2], arc[fresh], atol=1e-9)
    np.testing.assert_allclose(
        gnss[fresh, 2:], 0.5 * np.column_stack([np.cos(0.4 * t), np.sin(0.4 * t)])[fresh], atol=1e-9
    )
    np.testing.assert_array_equal(np.isnan(table.gnss_variance), np.isnan(gnss))
    np.testing.assert_allclose(table.gnss_variance[fresh, 0], 0.02**2)


def test_smoothing_of_the_thesis_is_there_to_be_compared():
    alpha = 0.2
    raw = measurement_table(RUN, bare())
    smooth = measurement_table(RUN, bare(0.05), ema_alpha=alpha)
    expected = np.array(raw.columns(CAMERA_ROWS))
    for k in range(1, len(expected)):
        expected[k] = alpha * expected[k - 1] + (1 - alpha) * expected[k]
    # yaw is counted from its first row, which is the same here
    np.testing.assert_allclose(smooth.columns(CAMERA_ROWS), expected, atol=1e-12)
    others = [row for row in raw.rows if row not in CAMERA_ROWS]
    np.testing.assert_array_equal(smooth.columns(others), raw.columns(others))


def test_samples_that_are_no_numbers_are_left_out_and_counted():
    run = change(RUN, "imu", set_rows([10, 11, 200], np.inf, "gyro_z_radps"))
    run = change(run, "odometry", set_rows(lambda t: (t > 2) & (t < 3), np.nan))
    run = change(run, "wheels", set_rows([7], np.nan, "motor_2_radps"))
    table, plain = measurement_table(run, bare()), measurement_table(RUN, bare())
    assert table.dropped == {"imu: not finite": 3, "odometry: not finite": 199, "wheels: not finite": 1}
    changed = np.array(table.rows)[~np.isclose(table.z, plain.z, rtol=0, atol=0, equal_nan=True).all(axis=0)]
    others = {"gyro_z_radps", "wheel_2_radps", "wheel_2_change_m2ps3", "camera_age_s", "ground_slip_ratio"}
    assert set(changed) == {*others, *CAMERA_ROWS}
    assert np.flatnonzero(np.isnan(table.columns(["wheel_2_radps"])[:, 0])).tolist() == [7]
    assert np.isfinite(table.columns(["gyro_z_radps"])).all()  # held over the two
    assert np.isnan(table.columns(CAMERA_ROWS)[(table.time_s > 2.03) & (table.time_s < 2.99)]).all()


def test_a_camera_without_rotation_or_confidence_is_left_out_and_counted():
    for start_s, end_s, value, channel, dropped in (
        (4.0, 6.0, 0.0, "quaternion_w_ratio", {"odometry: no rotation": 20}),  # then the channel is frozen
        (2.0, 3.0, 1 / 3, "confidence_ratio", {"odometry: low confidence": 200}),
    ):
        run = change(
            RUN, "odometry", set_rows(lambda t, a=start_s, b=end_s: (t >= a) & (t < b), value, channel)
        )
        table = measurement_table(run, bare())
        assert table.dropped == dropped
        lost = (table.time_s > start_s + 0.03) & (table.time_s < end_s)
        assert np.isnan(table.columns(CAMERA_ROWS)[lost]).all()


@pytest.mark.parametrize(("end_s", "back_s"), [(3.0, 3.3), (2.06, 2.06)])
def test_rows_after_a_gap_are_behind_the_same_low_pass_as_ever(end_s, back_s):
    """What starts anew would be 20 mrad of yaw ahead: it counts when that is forgotten; over a short gap it runs on."""
    run = change(RUN, "odometry", set_rows(lambda t: (t >= 2.0) & (t < end_s), np.nan))
    plain, table = (measurement_table(each, bare(0.05)).columns(CAMERA_ROWS) for each in (RUN, run))
    time_s = RUN.streams["wheels"].time_s
    known = np.isfinite(table).all(axis=1) & (time_s >= end_s)
    assert known[time_s >= back_s].all()
    np.testing.assert_allclose(table[known], plain[known], rtol=0, atol=5 * NOISE)


def test_stamps_that_do_not_increase_cost_their_sample_only_and_a_clock_set_back_its_shorter_part():
    def spoil(time_s, values, _):
        time_s[100] = time_s[99]  # a repeat
        time_s[200] = time_s[150]  # back
        time_s[250] = 1e6  # far ahead
        time_s[270] = np.nan
        return time_s, values

    plain = measurement_table(RUN, bare())
    for stream in ("imu", "odometry", "steering"):
        table = measurement_table(change(RUN, stream, spoil), bare())
        assert table.dropped == {f"{stream}: stamp does not increase": 4}
        np.testing.assert_allclose(table.z, plain.z, atol=0.02)
    table = measurement_table(change(RUN, "wheels", spoil), bare())
    assert table.dropped == {"wheels: stamp does not increase": 4}
    kept = np.isin(plain.time_s, table.time_s)
    assert kept.sum() == plain.time_s.size - 4
    np.testing.assert_array_equal(table.z[:, :3], plain.z[kept, :3])
    anew = change(
        RUN, "wheels", lambda t, v, c: (np.where(t < 4.0, t, t - 4.0), v)
    )  # 4 s, then 2 s from zero again
    table = measurement_table(anew, bare())
    assert table.dropped["wheels: stamp does not increase"] == 100
    assert table.time_s[-1] == pytest.approx(3.98)


def test_logs_without_a_clock_are_refused():
    empty = change(RUN, "wheels", lambda t, v, c: (t[:0], v[:0]))
    with pytest.raises(DataError, match="run run: there is no stream 'wheels', which gives the clock"):
        measurement_table(replace(RUN, streams={"imu": RUN.streams["imu"]}), ROBOT)
    with pytest.raises(DataError, match="the stream 'wheels', which gives the clock, is empty"):
        measurement_table(empty, ROBOT)
    few = RUN.streams["wheels"]
    few = replace(RUN, streams={"wheels": replace(few, values=few.values[:, 1:], channels=few.channels[1:])})
    with pytest.raises(DataError, match=f"no channel {RUN.streams['wheels'].channels[0]!r}, which the robot"):
        measurement_table(few, ROBOT)
    with pytest.raises(ConfigError, match="'skid_steer': these are rows of swerve robots"):
        measurement_table(RUN, HUSKY)
    for alpha in (-0.1, 1.0, np.nan):
        with pytest.raises(ConfigError, match=f"ema_alpha is {alpha:g}, a number from 0 to below 1"):
            measurement_table(RUN, ROBOT, ema_alpha=alpha)
