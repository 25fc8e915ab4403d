from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from terrain.errors import ConfigError, DataError
from terrain.estimation.feed import GNSS_ROWS, ROWS, MeasurementTable, measurement_table
from terrain.estimation.wheel_slip import STALE_AFTER_S, slip_figures, wheel_slip
from terrain.kinematics.camera import odometry_stream
from terrain.records import ABSENT, RunLog, SlipTrack, StateTrack, Stream
from terrain.robots import load_robot
from terrain.signals import low_pass
from terrain.slip import slip_angle, slip_ratio

ROBOT = load_robot("agrimaro")
MOTION = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
STEER = tuple(f"steer_{i}_rad" for i in (1, 2, 3))
SLIP_SPEED = tuple(f"slip_speed_{i}_mps" for i in (1, 2, 3))
WITH_SLIP = (*MOTION, *STEER, *SLIP_SPEED)
WITHOUT = (*MOTION, *STEER)


def make_track(mean, states, cov=None, age_s=0.0, dt_s=0.02):
    mean = np.atleast_2d(mean)
    n, d = mean.shape
    cov, none = np.broadcast_to(np.zeros((d, d)) if cov is None else cov, (n, d, d)), np.zeros((n, 1))
    used = none, none, none + ABSENT, ("camera_speed",)
    return StateTrack(np.arange(n) * dt_s, mean, cov, states, *used, np.broadcast_to(age_s, n), 0.0)


def make_table(track, wheel_speed_mps, rows=ROWS):
    """Return measurements of which only the wheels, and how they are steered, are known."""
    z = np.full((track.time_s.size, len(rows)), np.nan)
    z[:, :3] = np.array(wheel_speed_mps) / ROBOT.wheel_radius_m
    z[:, [row.startswith("steer") for row in rows]] = 0.0
    return MeasurementTable(track.time_s, rows, z, np.full((track.time_s.size, len(GNSS_ROWS)), np.nan))


# definitions

speeds = st.floats(-5, 5, allow_subnormal=False)


@given(wheel_speed=speeds, ground=speeds)
def test_laws_of_the_slip_ratio(wheel_speed, ground):
    slip = slip_ratio(wheel_speed, ground)
    if max(abs(wheel_speed), abs(ground)) < 0.05:
        assert np.isnan(slip)
        assert slip_ratio(wheel_speed, ground, stationary=0.0) == 0.0
        return
    assert -1 <= slip <= 1
    assert slip == slip_ratio(wheel_speed, ground, stationary=0.0)
    assert slip == -slip_ratio(ground, wheel_speed)  # what drives the one brakes the other
    assert slip == -slip_ratio(-wheel_speed, -ground)
    assert slip * (wheel_speed - ground) >= 0
    if wheel_speed > ground > 0:
        assert slip == pytest.approx((wheel_speed - ground) / wheel_speed)  # (7.1)
    if ground > wheel_speed > 0:
        assert slip == pytest.approx((wheel_speed - ground) / ground)  # (7.2)


def test_singular_points_of_the_slip_ratio():
    inf, nan = np.inf, np.nan
    wheel_speed = np.array([0.0, 1.0, 0.0, 0.05, 0.0499, 1.0, nan, 0.0, inf, 0.0])
    ground = np.array([0.0, 0.0, 1.0, 0.0, 0.0499, -1.0, 1.0, nan, 1.0, 1e-320])
    expected = np.array([nan, 1.0, -1.0, 1.0, nan, 1.0, nan, nan, nan, nan])
    np.testing.assert_array_equal(slip_ratio(wheel_speed, ground), expected)
    for_control = np.array([0.0, 1.0, -1.0, 1.0, 0.0, 1.0, nan, nan, nan, 0.0])
    np.testing.assert_array_equal(slip_ratio(wheel_speed, ground, stationary=0.0), for_control)
    assert slip_ratio(np.ones((4, 1)), np.zeros(3)).shape == (4, 3)
    for least in (0.0, -1.0, nan):
        with pytest.raises(ConfigError, match="a speed above zero is required"):
            slip_ratio(wheel_speed, ground, min_speed_mps=least)


def test_slip_angle_is_positive_to_the_left_for_both_rolling_directions():
    np.testing.assert_allclose(
        slip_angle([1.0, -1.0, 1.0], [0.2, 0.2, -0.2]), np.arctan(0.2) * np.array([1, 1, -1])
    )
    np.testing.assert_allclose(slip_angle(0.0, [1.0, -1.0]), [np.pi / 2, -np.pi / 2])
    assert np.isnan(slip_angle([0.01, np.nan], [0.02, 1.0])).all()


# from a filter's track


def test_uncertainty_of_wheel_speeds_is_by_default_the_robots_own_and_encoders_alone_have_no_slip():
    track = make_track([0.8, *[0.0] * 5], WITHOUT)
    table = make_table(track, 1.0)
    wheel_speed_std = wheel_slip(track, table, ROBOT).std[0, 0] / 0.8
    # the ripple of Hall steps behind the low-pass, drawn step by step
    dt, step = 1e-4, 2 * np.pi / 900
    count = np.floor(np.arange(0, 4, dt) * 5.0 / step)
    seen = lfilter([1 - np.exp(-dt / 0.05)], [1, -np.exp(-dt / 0.05)], np.diff(count) * step / dt)
    assert wheel_speed_std == pytest.approx(seen[5000:].std() * ROBOT.wheel_radius_m, rel=0.03)
    without_scatter = wheel_slip(track, table, ROBOT.without("sensors"))
    assert np.isnan(without_scatter.std).all()
    np.testing.assert_allclose(without_scatter.mean, 0.2)
    # a filter of encoders believes the wheels, at whatever speed the robot goes: a figure to show, and no slip
    track = make_track(np.tile([1.0, *[0.0] * 5], (5, 1)), WITHOUT, age_s=np.inf)
    table = make_table(track, 1.001)
    slip = wheel_slip(track, table, ROBOT)
    assert np.isnan([slip.mean, slip.std]).all()
    np.testing.assert_allclose(wheel_slip(track, table, ROBOT, blind=True).mean, 0.001, atol=1e-6)
    # with a slip ratio for a state too: nothing determines it
    states = np.tile([1.0, *[0.0] * 5, *[0.4] * 3], (5, 1))
    more = make_track(states, (*WITHOUT, "slip_1_ratio", "b", "c"), age_s=np.inf)
    assert np.isnan(wheel_slip(more, table, ROBOT).mean).all()


def test_slip_is_unknown_where_the_ground_was_never_seen_and_stale_where_not_lately():
    age = np.array([np.inf, np.inf, 0.0, 0.02, 0.15, 0.151, 3.0, 0.0])
    never, stale = age == np.inf, age > STALE_AFTER_S
    mean = np.tile([0.875, *[0.0] * 5, *[0.125] * 3], (8, 1))
    cov = np.eye(9) * 1e-4 * np.arange(1, 9)[:, None, None]
    track = make_track(mean, WITH_SLIP, cov, age)
    table = make_table(track, 1.0)
    slip = wheel_slip(track, table, ROBOT)
    # a filter that leans on the wheels then would say 0
    leaning = wheel_slip(make_track(mean[:, :6], WITHOUT, cov[:, :6, :6], age), table, ROBOT)
    for found, unknown in ((slip, never), (leaning, stale)):
        np.testing.assert_array_equal(np.isnan(found.mean).all(axis=1), unknown)
        np.testing.assert_array_equal(np.isnan(found.std).any(axis=1), unknown)
        np.testing.assert_array_equal(found.stale, stale)
    np.testing.assert_allclose(slip.mean[~never], 0.125)
    assert (np.diff(slip.std[2:, 0]) > 0).all()  # as the state's does


def test_tracks_and_tables_that_do_not_match_are_refused():
    track = make_track(np.zeros((3, 9)), WITH_SLIP)
    with pytest.raises(DataError, match="are not on one clock"):
        wheel_slip(track, make_table(make_track(np.zeros((4, 9)), WITH_SLIP), 1.0), ROBOT)
    with pytest.raises(DataError, match="no state 'steer_2_rad', only speed_x_mps, "):
        wheel_slip(make_track(np.zeros((3, 4)), WITHOUT[:4]), make_table(track, 1.0), ROBOT)
    with pytest.raises(DataError, match="no measurement 'wheel_1_radps'"):
        wheel_slip(make_track(np.zeros((3, 6)), WITHOUT), make_table(track, 1.0, ROWS[1:]), ROBOT)


# through the measurements: a start as in thesis 7.2.2


def start_of_a_run(slip, camera_s=0.0):
    """Return a 1 m/s^2 start to 1 m/s: encoders behind 50 ms, a camera behind by ``camera_s``."""
    rng = np.random.default_rng(0)
    fine = np.arange(0, 4.0, 0.001)
    speed = np.clip(fine - 0.5, 0.0, 1.0)
    wheel_speed = low_pass(speed / (1 - slip), 0.001, 0.05)
    t = np.arange(200) / 50
    motor = np.interp(t, fine, wheel_speed) / ROBOT.wheel_radius_m * ROBOT.motors.reduction_ratio
    motor = motor + ROBOT.sensors.motor_std_radps * rng.standard_normal(motor.size)
    wheels = Stream(t, np.tile(motor[:, None], 3), [f"motor_{i}_radps" for i in (1, 2, 3)])
    t = np.arange(800) / 200
    seen = np.interp(t - 0.006, fine, low_pass(speed, 0.001, camera_s))
    seen = np.column_stack([seen, 0 * t]) + 0.001 * rng.standard_normal((t.size, 2))
    zero, attitude = np.zeros(t.size), 1e-5 * rng.standard_normal((t.size, 3))
    twist = np.column_stack([seen, zero])
    pose = odometry_stream(t, np.zeros((t.size, 2)), attitude, twist, ROBOT.camera, 0.0)
    return RunLog("start", "agrimaro", {"wheels": wheels, "odometry": pose})


def raw_slip(run, robot, **options):
    """Slip of wheel 1 by what the table holds: encoders against the camera."""
    table = measurement_table(run, robot, **options)
    wheel_speed, ground = table.columns(["wheel_1_radps", "camera_speed_x_mps"]).T
    return slip_ratio(wheel_speed * robot.wheel_radius_m, ground)


@pytest.mark.parametrize("camera_s", [0.0, 0.02])
def test_a_start_has_no_false_braking_once_the_delays_match(camera_s):
    robot = ROBOT.with_parts(camera=replace(ROBOT.camera, time_constant_s=camera_s))
    run = start_of_a_run(0.125, camera_s)
    apart, matched = raw_slip(run, robot, ema_alpha=0.0), raw_slip(run, robot)
    assert np.nanmin(apart) < -0.05
    assert np.nanmin(matched) > -0.01
    assert np.nanmin(raw_slip(run, robot, ema_alpha=0.2)) < -0.05  # a quarter of a tick is no 50 ms
    # not only is there no dip: the slip is right from the first tick that has one
    fast = np.isfinite(matched)
    assert np.abs(matched[fast] - 0.125).max() < 0.06
    assert np.abs(matched[60:] - 0.125).max() < 0.01


# figures of a run


def drive(slip, dt=0.02):
    """Return a track and its speed: a 1 m/s^2 start, 5 s steady, a stop, and 5 s of standing."""
    time = np.arange(0, 12, dt)
    speed = np.clip(np.minimum(time, 7.0 - time), 0.0, 1.0)
    steady, transient = (time > 1.0) & (time < 6.0), (time <= 1.0) | (time >= 6.0)
    ratio = np.where(steady[:, None], slip, np.nan)
    ratio[transient] = np.where(time[transient, None] < 2, 0.4, -0.6)
    ratio[speed < 0.05] = np.nan
    return SlipTrack(time, ratio, np.full_like(ratio, 0.01), ("1", "2", "3")), speed, time


def test_figures_of_a_run_come_from_its_steady_and_its_transient_parts():
    rng = np.random.default_rng(2)
    mean, noise = np.array([0.11, 0.125, 0.14]), 0.02
    slip, speed, time = drive(mean + noise * rng.standard_normal((600, 3)))
    figures = slip_figures(slip, speed + 0.005 * rng.standard_normal(600), time)
    n = figures.steady.sum()
    # the start's last 0.1 m/s and the second after it; the end of steady driving is seen coming
    assert n / 50 == pytest.approx(5.0 - 1.0 + 0.1 - 0.25 + 0.1, abs=0.1)
    assert figures.steady_mean == pytest.approx(0.125, abs=4 * noise / np.sqrt(3 * n))
    assert figures.peak == 0.6
    assert not figures.steady[(time < 1.5) | (time > 6.0)].any()
    # the speed may come from another clock
    coarse = slip_figures(slip, speed[::5], time[::5])
    assert coarse.steady_mean == pytest.approx(figures.steady_mean, abs=0.002)


def test_figures_without_steady_or_moving_samples_are_nan():
    slip, speed, time = drive(np.full((600, 3), 0.1))
    few = SlipTrack(time[:20], slip.mean[:20], slip.std[:20], slip.channels)
    for some, speed_mps in ((slip, np.zeros(600)), (few, speed), (slip, np.full(600, np.nan))):
        figures = slip_figures(some, speed_mps, time)
        assert np.isnan(figures.steady_mean)
        assert not figures.steady.any()
        assert np.isnan(figures.peak) or some is few
    one_lost = np.array(slip.mean)
    one_lost[:, 1] = np.nan
    figures = slip_figures(SlipTrack(time, one_lost, one_lost, slip.channels), speed, time)
    assert figures.steady_mean == pytest.approx(0.1)
    assert figures.peak == 0.6


@pytest.mark.parametrize("states", [WITH_SLIP, WITHOUT])
def test_slip_and_its_uncertainty_are_those_of_its_plain_form(states, monkeypatch):
    """Slip by its definition; its variance by numerical differences of all that it depends on."""
    rng = np.random.default_rng(0)
    n, d = 300, len(states)
    mean = rng.normal(0.0, 1.0, (n, d)) * rng.choice([0.0, 0.02, 1.0], (n, 1))
    root = rng.normal(0.0, 0.1, (d, d))
    wheel_speed_mps = rng.normal(0.0, 1.0, (n, 3)) * rng.choice([0.0, 0.02, 1.0, np.nan], (n, 3))
    track = make_track(mean, states, root @ root.T)
    monkeypatch.setattr(f"{wheel_slip.__module__}.wheel_speed_scatter_mps", lambda _: 0.05)
    slip = wheel_slip(track, make_table(track, wheel_speed_mps), ROBOT)

    def plain(numbers, wheel):
        x, y = ROBOT.wheel_positions_m[wheel]
        v_x, v_y, turn, steer = numbers[[0, 1, 2, 3 + wheel]]
        ground = (v_x - turn * y) * np.cos(steer) + (v_y + turn * x) * np.sin(steer)
        speed = ground + numbers[6 + wheel] if states is WITH_SLIP else numbers[-1]
        return float(slip_ratio(speed, ground)), max(abs(speed), abs(ground)), abs(abs(speed) - abs(ground))

    n_compared = 0
    for k, wheel in np.argwhere(np.isfinite(slip.mean)):
        numbers = np.append(mean[k], wheel_speed_mps[k, wheel])
        ratio, fastest, apart = plain(numbers, wheel)
        assert slip.mean[k, wheel] == pytest.approx(ratio, abs=1e-12)
        if abs(ratio) == 1.0 or min(fastest - 0.05, apart) < 1e-3:  # clipped, or beside a kink
            continue
        steps = 1e-6 * np.eye(d + 1)
        slope = [(plain(numbers + e, wheel)[0] - plain(numbers - e, wheel)[0]) / 2e-6 for e in steps]
        slope = np.nan_to_num(slope)
        variance = slope[:d] @ root @ root.T @ slope[:d] + (slope[d] * 0.05) ** 2
        assert slip.std[k, wheel] == pytest.approx(np.sqrt(variance), rel=1e-5)
        n_compared += 1
    assert n_compared > 100
    assert np.isnan(slip.mean).any()
