from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError, DataError
from terrain.estimation.feed import CAMERA_ROWS, GNSS_ROWS, REST_ROW, ROWS_OF_DRIVE, measurement_table
from terrain.kinematics.camera import odometry_stream
from terrain.records import RunLog, Stream
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")
HUSKY = load_robot("husky")
NOISE = 1e-4
"""On all of camera and IMU: small, so that answers are plain; never none, so that nothing is frozen."""


def bare(robot=ROBOT, *, camera=None, sensors=None, steering=None):
    """Return the robot with ideal sensors except for the given values."""
    ideal = {"latency_s": 0.0, "time_constant_s": 0.0}
    return robot.with_parts(
        camera=replace(robot.camera, **ideal | (camera or {})),
        sensors=replace(
            robot.sensors, **{"encoder_time_constant_s": 0.0, "imu_latency_s": 0.0} | (sensors or {})
        ),
        steering=replace(robot.steering, **steering or {}),
    )


def turning_run(duration_s=6.0, *, yaw_0=0.0, rate=0.4, speed=0.5, roll=0.0, pitch=0.0, seed=0):
    """Return a run that drives an arc at constant rates; its sensors are ideal but for :data:`NOISE`."""
    rng = np.random.default_rng(seed)

    def clock(rate_hz):
        return np.arange(round(duration_s * rate_hz)) / rate_hz

    def noisy(columns):
        plain = np.column_stack(np.broadcast_arrays(*columns))
        return plain + NOISE * rng.standard_normal(plain.shape)

    streams = {}
    t = clock(50.0)
    motor = np.full((t.size, 3), speed / ROBOT.wheel_radius_m * ROBOT.motors.reduction_ratio)
    streams["wheels"] = Stream(t, motor, [f"motor_{i}_radps" for i in (1, 2, 3)])
    steer = np.broadcast_to([0.1, -0.2, 3.1], (t.size, 3)) + 0.1 * np.sin(t)[:, None]
    streams["steering"] = Stream(t, np.angle(np.exp(1j * steer)), [f"angle_{i}_rad" for i in (1, 2, 3)])
    t = clock(100.0)
    up = Rotation.from_euler("ZYX", [0.0, pitch, roll]).inv().apply([0.0, 0.0, GRAVITY_MPS2])
    gyro = noisy([0 * t, 0.0, rate])
    force = noisy([up[0] + 0 * t, up[1] + rate * speed, up[2]])
    fused = noisy([roll + 0 * t, pitch, 0.7 + rate * t])
    fused[:, 2] = np.angle(np.exp(1j * fused[:, 2]))
    names = [f"gyro_{a}_radps" for a in "xyz"] + [f"accel_{a}_mps2" for a in "xyz"]
    streams["imu"] = Stream(t, np.hstack([gyro, force, fused]), [*names, "roll_rad", "pitch_rad", "yaw_rad"])
    t = clock(200.0)
    yaw = yaw_0 + rate * t
    position = speed / rate * np.column_stack([np.sin(yaw) - np.sin(yaw_0), np.cos(yaw_0) - np.cos(yaw)])
    plain = noisy([*position.T, yaw, roll, pitch, speed, 0.0, rate]).T
    streams["odometry"] = odometry_stream(
        t, plain[:2].T, plain[[3, 4, 2]].T, plain[5:8].T, ROBOT.camera, yaw_0
    )
    t = clock(10.0)
    yaw = yaw_0 + rate * t
    position = speed / rate * np.column_stack([np.sin(yaw) - np.sin(yaw_0), np.cos(yaw_0) - np.cos(yaw)])
    velocity = speed * np.column_stack([np.cos(yaw), np.sin(yaw)])
    place = position + np.array([500.0, -80.0])
    gnss = np.column_stack([place, velocity, np.zeros(t.size), np.ones(t.size)])
    names = [
        "position_x_m",
        "position_y_m",
        "velocity_x_mps",
        "velocity_y_mps",
        "std_position_m",
        "fix_ratio",
    ]
    streams["gnss"] = Stream(t, gnss, names)
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


def without(run, *names):
    return replace(run, streams={name: s for name, s in run.streams.items() if name not in names})


def rows_of(table, *names):
    return table.columns(names)


RUN = turning_run()


def test_ideal_sensors_give_the_motion():
    table = measurement_table(RUN, bare(), gnss_latency_s=0.0)
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
        np.testing.assert_allclose(rows_of(table, name)[:, 0], value, atol=within, err_msg=name)
    fresh = np.arange(t.size) % 5 == 0  # a sensor slower than the clock gives each sample once
    gnss = rows_of(table, *GNSS_ROWS)
    assert np.isnan(gnss[~fresh]).all()
    arc = np.column_stack([1.25 * np.sin(0.4 * t), 1.25 - 1.25 * np.cos(0.4 * t)])
    np.testing.assert_allclose(gnss[fresh, :2], arc[fresh], atol=1e-9)
    np.testing.assert_allclose(
        gnss[fresh, 2:], 0.5 * np.column_stack([np.cos(0.4 * t), np.sin(0.4 * t)])[fresh], atol=1e-9
    )
    np.testing.assert_array_equal(np.isnan(table.gnss_variance), np.isnan(gnss))
    np.testing.assert_allclose(table.gnss_variance[fresh, 0], 0.02**2)


# the low-pass


def test_smoothing_of_the_thesis_is_there_to_be_compared():
    alpha = 0.2
    raw = measurement_table(RUN, bare(), time_constant_s=0.0)
    smooth = measurement_table(RUN, bare(sensors={"encoder_time_constant_s": 0.05}), ema_alpha=alpha)
    expected = np.array(rows_of(raw, *CAMERA_ROWS))
    for k in range(1, len(expected)):
        expected[k] = alpha * expected[k - 1] + (1 - alpha) * expected[k]
    # yaw is counted from its first row, which is the same here
    np.testing.assert_allclose(rows_of(smooth, *CAMERA_ROWS), expected, atol=1e-12)
    others = [row for row in raw.rows if row not in CAMERA_ROWS]
    np.testing.assert_array_equal(smooth.columns(others), raw.columns(others))


# faults


def test_samples_that_are_no_numbers_are_left_out_and_counted():
    run = change(RUN, "imu", set_rows([10, 11, 200], np.inf, "gyro_z_radps"))
    run = change(run, "odometry", set_rows(lambda t: (t > 2) & (t < 3), np.nan))
    run = change(run, "wheels", set_rows([7], np.nan, "motor_2_radps"))
    table = measurement_table(run, bare())
    assert table.dropped == {"imu: not finite": 3, "odometry: not finite": 199, "wheels: not finite": 1}
    plain = measurement_table(RUN, bare())
    changed = (table.z != plain.z) & ~(np.isnan(table.z) & np.isnan(plain.z))
    assert set(np.array(table.rows)[changed.any(axis=0)]) == {
        *("gyro_z_radps", "wheel_2_radps", "wheel_2_change_m2ps3", "camera_age_s"),
        *CAMERA_ROWS,
    }
    assert np.flatnonzero(np.isnan(rows_of(table, "wheel_2_radps")[:, 0])).tolist() == [7]
    assert np.isfinite(rows_of(table, "gyro_z_radps")).all()  # held over the two
    lost = (table.time_s > 2.03) & (table.time_s < 2.99)
    assert np.isnan(rows_of(table, *CAMERA_ROWS)[lost]).all()


def test_an_invalid_quaternion_is_left_out_and_counted():
    run = change(RUN, "odometry", set_rows(lambda t: t >= 4.0, 0.0, "quaternion_w_ratio"))
    table = measurement_table(run, bare())
    assert table.dropped == {"odometry: no rotation": 20}  # then the channel is frozen
    assert np.isnan(rows_of(table, *CAMERA_ROWS)[table.time_s > 4.03]).all()


def test_camera_samples_of_low_confidence_are_dropped():
    run = change(RUN, "odometry", set_rows(lambda t: (t >= 2) & (t < 3), 1 / 3, "confidence_ratio"))
    table = measurement_table(run, bare())
    assert table.dropped == {"odometry: low confidence": 200}
    assert np.isnan(rows_of(table, *CAMERA_ROWS)[(table.time_s > 2.03) & (table.time_s < 3)]).all()


def test_stamps_that_do_not_increase_cost_their_sample_only():
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


def test_a_clock_that_starts_anew_keeps_the_longer_part():
    def reset(time_s, values, _):
        time_s[200:] -= time_s[200]  # 4 s, then 2 s from zero again
        return time_s, values

    table = measurement_table(change(RUN, "wheels", reset), bare())
    assert table.dropped["wheels: stamp does not increase"] == 100
    assert table.time_s[-1] == pytest.approx(3.98)


# yaw and position of the start


# robots that skid, bad input


def husky_run(*, gnss=False):
    rng = np.random.default_rng(0)
    t = np.arange(100) / 10
    streams = {
        "wheels": Stream(t, np.column_stack([t, 2 * t]), ("speed_left_mps", "speed_right_mps")),
        "imu": Stream(
            np.arange(1000) / 100,
            0.3 + NOISE * rng.standard_normal((1000, 3)),
            [f"gyro_{axis}_radps" for axis in "xyz"],
        ),
    }
    if gnss:
        streams["gnss"] = Stream(t[::2], np.column_stack([t, t])[::2], ("position_x_m", "position_y_m"))
    return RunLog("skid", "husky", streams)


def test_a_skid_steered_robot_has_sides_and_a_gyro():
    table = measurement_table(husky_run(), HUSKY)
    assert table.rows == ("wheel_left_mps", "wheel_right_mps", "gyro_z_radps", *GNSS_ROWS, REST_ROW)
    np.testing.assert_allclose(table.z[:, :2], np.column_stack([table.time_s, 2 * table.time_s]))
    np.testing.assert_allclose(table.z[:, 2], 0.3, atol=6 * NOISE)
    assert np.isnan(table.z[:, 3:]).all()
    with_gnss = measurement_table(husky_run(gnss=True), HUSKY, gnss_latency_s=0.0)
    np.testing.assert_allclose(with_gnss.z[::2, 3], with_gnss.time_s[::2])
    assert np.isnan(with_gnss.z[:, 5:]).all()  # no speed in this stream
    np.testing.assert_allclose(with_gnss.gnss_variance[::2, 0], 0.25)  # no fix was reported


def test_logs_without_a_clock_are_refused():
    with pytest.raises(DataError, match="run run: there is no stream 'wheels', which gives the clock"):
        measurement_table(without(RUN, "wheels"), ROBOT)
    with pytest.raises(DataError, match="the stream 'wheels', which gives the clock, is empty"):
        measurement_table(change(RUN, "wheels", lambda t, v, c: (t[:0], v[:0])), ROBOT)
    with pytest.raises(DataError, match="no channel 'speed_left_mps', which the robot husky should have"):
        measurement_table(RUN, HUSKY)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time_constant_s": -0.1}, "time_constant_s is -0.1"),
        ({"time_constant_s": np.nan}, "time_constant_s is nan"),
        ({"ema_alpha": 1.0}, "ema_alpha is 1, a number from 0 to below 1"),
        ({"ema_alpha": 0.2, "time_constant_s": 0.1}, "not both"),
        ({"gnss_latency_s": -1.0}, "gnss_latency_s is -1"),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        measurement_table(RUN, ROBOT, **options)
