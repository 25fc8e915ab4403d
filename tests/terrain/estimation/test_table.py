"""Rows of measurements by whole logs: ideal sensors give the motion; faults; gyro and rest of robots that skid."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, DataError
from terrain.estimation.feed import (
    CAMERA_ROWS,
    GNSS_LATENCY_S,
    GNSS_ROWS,
    REST_ROW,
    REST_S,
    ROWS_OF_DRIVE,
    STEADY_RADPS,
    measurement_table,
    new_feed,
    rest_at,
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
    assert table.rows == ROWS_OF_DRIVE["swerve"]
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
    with pytest.raises(DataError, match="no channel 'speed_left_mps', which the robot husky should have"):
        measurement_table(RUN, HUSKY)
    for alpha in (-0.1, 1.0, np.nan):
        with pytest.raises(ConfigError, match=f"ema_alpha is {alpha:g}, a number from 0 to below 1"):
            measurement_table(RUN, ROBOT, ema_alpha=alpha)


# -- robots that skid: the gyro's mean between ticks, and what only looks like rest ---------------------------------

GYRO_S, WHEELS_S = np.arange(0.0, 40.0, 0.01), np.arange(0.0, 39.9, 2 / 13)
STILL = np.random.default_rng(7).normal(0.0, 0.002, GYRO_S.size)


def skid_run(gyro_radps, speed_mps=0.0, gnss=None):
    """Return a run by a gyro about z, and speeds of the wheels: one, or those of both sides (2, n)."""
    wheels = np.broadcast_to(speed_mps, (2, WHEELS_S.size)).T
    axes = np.column_stack([STILL, -STILL, gyro_radps])
    streams = {
        "wheels": Stream(WHEELS_S, wheels, ("speed_left_mps", "speed_right_mps")),
        "imu": Stream(GYRO_S, axes, [f"gyro_{axis}_radps" for axis in "xyz"]),
    }
    return RunLog("drive", "husky", streams | ({} if gnss is None else {"gnss": gnss}))


def rows_of(run):
    table = measurement_table(run, HUSKY)
    return table.time_s, *table.columns(["gyro_z_radps", REST_ROW]).T


def test_a_skid_steered_robot_has_sides_and_a_gyro():
    run = skid_run(0.3 + STILL, np.array([WHEELS_S, 2 * WHEELS_S]))
    table = measurement_table(run, HUSKY)
    assert table.rows == ("wheel_left_mps", "wheel_right_mps", "gyro_z_radps", *GNSS_ROWS, REST_ROW)
    np.testing.assert_allclose(table.z[:, :2], np.column_stack([table.time_s, 2 * table.time_s]))
    np.testing.assert_allclose(table.z[:, 2], 0.3, atol=6 * 0.002)
    assert np.isnan(table.z[:, 3:]).all()
    fixes = Stream(
        WHEELS_S[::2] + GNSS_LATENCY_S, np.column_stack([WHEELS_S] * 2)[::2], ("position_x_m", "position_y_m")
    )
    table = measurement_table(skid_run(STILL, 1.0, fixes), HUSKY)
    np.testing.assert_allclose(table.z[::2, 3], table.time_s[::2])
    assert np.isnan(table.z[:, 5:]).all()  # no speed in this stream
    np.testing.assert_allclose(table.gnss_variance[::2, 0], 0.25)  # no fix was reported


def test_the_gyro_row_is_the_mean_since_the_last_tick():
    gyro = np.sin(GYRO_S) + 0.2 * np.cos(2 * np.pi * 6.5 * GYRO_S) + STILL
    time_s, mean, _ = rows_of(skid_run(gyro, 0.5))
    angle = np.append(0.0, np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(GYRO_S)))
    last = np.searchsorted(GYRO_S, time_s + 1e-9) - 1
    plain = np.diff(angle[last]) / np.diff(GYRO_S[last])
    np.testing.assert_allclose(mean[1:], plain, atol=1e-12)
    heading = np.sum(mean[1:] * np.diff(GYRO_S[last]))
    assert heading == pytest.approx(angle[last[-1]], abs=1e-9)
    sampled = np.sum(gyro[last][1:] * np.diff(time_s))  # what one sample a tick would make of it
    assert abs(sampled - heading) > 1.0


def test_rest_gives_the_mean_of_each_second_and_a_turn_that_begins_in_one_is_no_part_of_it():
    _, _, rest = rows_of(skid_run(0.03 + STILL))
    known = rest[np.isfinite(rest)]
    assert known.size == pytest.approx(WHEELS_S[-1] / REST_S, rel=0.1)
    np.testing.assert_allclose(known, 0.03, atol=6 * 0.002 / np.sqrt(90))
    time_s, _, rest = rows_of(skid_run(STILL + 0.5 * np.clip(GYRO_S - 10.0, 0.0, 1.0)))
    assert np.nanmax(np.abs(rest)) < 0.002
    assert np.isnan(rest[(time_s > 10.3) & (time_s < 30.0)]).all()
    feed = new_feed()[0]  # a clock that is set back starts anew
    rows = [rest_at(at_s, 0.0, 0.0, 0.01, feed) for at_s in (5.0, 5.5, 2.0, 2.5, 3.0)]
    np.testing.assert_array_equal(rows, [np.nan] * 4 + [0.01])


@pytest.mark.parametrize(
    ("gyro_radps", "speed_mps"),
    [
        (STILL, 0.05),
        (STILL, -0.05),
        (STILL, np.nan),
        (0.5 + STILL, 0.0),
        (STILL + 2 * STEADY_RADPS * np.sign(np.sin(3 * GYRO_S)), 0.0),
        (np.where(np.arange(GYRO_S.size) % 90 < 60, np.nan, STILL), 0.0),
    ],
    ids=["forward", "backward", "no wheels", "towed in a turn", "shaken", "no gyro"],
)
def test_what_is_no_rest_gives_nothing(gyro_radps, speed_mps):
    assert np.isnan(rows_of(skid_run(gyro_radps, speed_mps))[2]).all()
