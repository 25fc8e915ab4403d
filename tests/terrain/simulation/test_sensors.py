"""The motions are made by hand: what a sensor says is held against what is known to have happened."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import chi2, poisson

from terrain.constants import GRAVITY_MPS2
from terrain.kinematics.camera import body_motion, odometry_stream
from terrain.robots import load_robot
from terrain.simulation.plants.dynamic import dynamic_truth
from terrain.simulation.scenario import NO_FAULTS, Faults
from terrain.simulation.sensors import (
    BODY_ROW,
    STEP_S,
    TILT_NOISE_RAD,
    Gnss,
    Motion,
    camera_sensor,
    gnss_sensor,
    imu_sensor,
    steering_sensor,
    wheel_sensor,
)

ROBOT = load_robot("agrimaro")
QUIET = Faults(by_chance=False)
G = GRAVITY_MPS2


def with_changes(section, **changes):
    return ROBOT.with_parts(**{section: dataclasses.replace(getattr(ROBOT, section), **changes)})


def silenced(section):
    """Return the robot with all noise, scatter and drift of a section at 0."""
    part = getattr(ROBOT, section)
    names = [item.name for item in dataclasses.fields(part)]
    return with_changes(section, **{name: 0.0 for name in names if "_std_" in name or "_walk_" in name})


SILENT_IMU, SILENT_CAMERA = silenced("sensors"), silenced("camera")


def motion_of(duration_s, **columns):
    """Return a motion that is 0 but for the columns given: numbers, (n,) or, for wheels, (n, 3) arrays."""
    record = np.zeros(round(duration_s / STEP_S), BODY_ROW)
    for name, values in columns.items():
        if name in BODY_ROW.names:
            record[name] = values
        else:
            record["wheels"][name][:, :3] = values
        if name == "steer_rad":
            record["encoder_rad"][:, :3] = values
    return Motion(record)


def stream_of(sensor):
    sensor.update()
    return sensor.stream()


def wheels_stream(*given):
    return stream_of(wheel_sensor(*given))


def steering_stream(*given):
    return stream_of(steering_sensor(*given))


def imu_stream(*given):
    sensor, bias = imu_sensor(*given)
    return stream_of(sensor), bias


def camera_stream(*given):
    return stream_of(camera_sensor(*given))


def gnss_stream(motion, *given):
    return stream_of(gnss_sensor(motion, ROBOT, *given))


def clock(duration_s):
    return np.arange(round(duration_s / STEP_S)) * STEP_S


def assert_std(values, std, centre=None):
    """Noise (n, ...) is of the std put in, to one in 1e5 a channel, and of the mean put in."""
    values = np.atleast_2d(np.asarray(values).T).T
    n = len(values)
    low, high = np.sqrt(chi2.ppf([1e-5, 1 - 1e-5], n - 1) / (n - 1))
    ratio = values.std(axis=0, ddof=1) / std
    assert ((ratio > low) & (ratio < high)).all(), ratio
    if centre is not None:
        assert (np.abs(values.mean(axis=0) - centre) < 4.5 * np.asarray(std) / math.sqrt(n)).all()


def delay_s(time_s, values, frequency_hz):
    """Return by how much a sampled sine lags, from its phase."""
    turn = 2 * math.pi * frequency_hz * time_s
    sine, cosine, _ = np.linalg.lstsq(
        np.column_stack([np.sin(turn), np.cos(turn), np.ones_like(turn)]), values, rcond=None
    )[0]
    return -math.atan2(cosine, sine) / (2 * math.pi * frequency_hz)


def rng(seed=0):
    return np.random.default_rng(seed)


def columns_of(stream, pattern, names):
    return np.column_stack([stream.channel(pattern.format(name)) for name in names])


def random_motion(n=700):
    """A motion in which nothing stands still."""
    draw = rng(11)
    numbers = 0.05 * draw.standard_normal((n, BODY_ROW.itemsize // 8)).cumsum(axis=0)
    record = numbers.view(BODY_ROW)[:, 0]
    record["grade_x_ratio"] = 0.2 * np.sin(np.arange(n) / 50)
    return record


@pytest.mark.parametrize("cuts", [range(1, 700), range(1, 700, 20), [1, 2, 3, 250, 251, 699]])
def test_a_motion_in_blocks_gives_the_bytes_of_the_motion_in_one(cuts):
    often = {"dropout_rate_hz": 3.0, "dropout_length_s": 0.02, "jump_rate_hz": 4.0}
    odd = with_changes("sensors", imu_rate_hz=128.0, imu_latency_s=0.0, wheels_rate_hz=30.0).with_parts(
        camera=dataclasses.replace(ROBOT.camera, **often)
    )
    faults, receiver = Faults(camera_lost_s=((0.1, 0.2),)), Gnss(rate_hz=70.0, latency_s=0.02)
    whole, parts = Motion(random_motion()), Motion(random_motion(), 0)
    for robot in (ROBOT, odd):
        at_once, in_blocks = (
            [
                *(make(motion, robot, rng()) for make in (wheel_sensor, steering_sensor)),
                imu_sensor(motion, robot, rng())[0],
                camera_sensor(motion, robot, rng(), faults),
                gnss_sensor(motion, ROBOT, receiver, rng()),
            ]
            for motion in (whole, parts)
        )
        parts.n_rows = 0
        for n_rows in (*cuts, 700):
            parts.grow(n_rows)
            for sensor in in_blocks:
                sensor.update()
        for one, other in zip(at_once, in_blocks, strict=True):
            batch, blocks = stream_of(one), other.stream()
            assert len(batch) > 20
            assert np.isfinite(batch.values).all()
            assert batch.time_s.tobytes() == blocks.time_s.tobytes()
            assert batch.values.tobytes() == blocks.values.tobytes(), one.channels


def test_noise_at_rest_is_that_of_the_description():
    motion, sensors, camera = motion_of(60.0), ROBOT.sensors, ROBOT.camera
    unbiased = dict.fromkeys(
        ("gyro_bias_std_radps", "gyro_walk_radps", "accel_bias_std_mps2", "tilt_std_rad"), 0.0
    )
    imu, bias = imu_stream(motion, with_changes("sensors", **unbiased), rng())
    assert not bias.any()
    seen = camera_stream(motion, ROBOT, rng(), QUIET)
    assert (seen.channel("confidence_ratio") == 1.0).all()
    fixed = gnss_stream(motion_of(200.0), Gnss(fix_length_s=1e9), rng())
    wheels = wheels_stream(motion, ROBOT, rng())
    assert not columns_of(wheels, "motor_{}_radps", "123").any()  # no Hall step, no rate
    rolling = wheels_stream(motion_of(60.0, reported_radps=2.0), ROBOT, rng())
    step_rad = 2 * math.pi / sensors.steering_steps_ratio
    steering = steering_stream(motion, ROBOT, rng())
    for stream, pattern, names, std, centre in (
        (imu, "gyro_{}_radps", "xyz", sensors.gyro_std_radps, 0.0),
        (imu, "accel_{}_mps2", "xyz", sensors.accel_std_mps2, [0.0, 0.0, G]),
        (imu, "{}_rad", ["roll", "pitch"], TILT_NOISE_RAD, 0.0),
        (imu, "{}_rad", ["yaw"], sensors.yaw_std_rad, 0.0),
        (seen, "velocity_{}_mps", "xyz", camera.speed_std_mps, 0.0),
        (seen, "rate_{}_radps", "xyz", camera.yaw_rate_std_radps, 0.0),
        (fixed, "position_{}_m", "xy", 0.02, 0.0),
        (fixed, "velocity_{}_mps", "xy", 0.03, 0.0),
        (wheels, "current_{}_a", "123", sensors.current_std_a, 0.0),
        (rolling, "motor_{}_radps", "123", sensors.motor_std_radps, 20.0),
        (
            steering,
            "angle_{}_rad",
            "123",
            math.hypot(sensors.steering_std_rad, step_rad / math.sqrt(12)),
            0.0,
        ),
    ):
        assert_std(columns_of(stream, pattern, names), std, centre)
    # of the camera's heading, and in the plane of its fixed frame (x right, z back): from sample to sample both
    # hardly drift
    assert_std(np.diff(body_motion(seen, camera).yaw_rad)[::2], math.sqrt(2) * camera.yaw_std_rad, 0.0)
    steady = camera_stream(motion, with_changes("camera", yaw_std_rad=0.0), rng(), QUIET)
    steps = np.diff(columns_of(steady, "position_{}_m", "xz"), axis=0)
    assert_std(steps[::2], math.sqrt(2) * camera.position_std_m, 0.0)


def test_a_bias_walks_and_the_yaw_drifts_with_it():
    sensors = ROBOT.sensors
    imu, bias = imu_stream(motion_of(100.0, yaw_rad=0.7), ROBOT, rng(4))
    assert_std(np.diff(bias), sensors.gyro_walk_radps / math.sqrt(100), 0.0)
    drift = np.concatenate([[0.0], np.cumsum(bias[1:])]) / 100
    assert abs(drift[-1]) > 0.05
    # it begins at 0, whatever the heading
    assert_std(imu.channel("yaw_rad") - drift, sensors.yaw_std_rad, 0.0)
    truth = dynamic_truth(motion_of(100.0), ROBOT, bias, imu.time_s)
    np.testing.assert_allclose(truth.channel("gyro_bias_z_radps"), bias, rtol=0, atol=1e-15)


def test_latency_and_lag_come_back_from_the_phase_of_a_sine():
    frequency_hz, time_s, sensors, camera = 3.0, clock(30.0), ROBOT.sensors, ROBOT.camera
    sine, turn = np.sin(2 * math.pi * frequency_hz * time_s), 2 * math.pi * frequency_hz
    moving = ("yaw_rate_radps", "accel_x_mps2", "ride_z_mps2", "speed_x_mps", "position_y_m")
    motion = motion_of(30.0, **dict.fromkeys(moving, sine), steer_rad=sine[:, None])

    def lag_s(time_constant_s, latency_s=0.0):
        return latency_s + math.atan(turn * time_constant_s) / turn

    gyro_s, accel_s = (
        lag_s(time_constant_s, sensors.imu_latency_s) for time_constant_s in sensors.imu_time_constants_s
    )
    speed_s = lag_s(camera.time_constant_s, camera.latency_s)
    imu, _ = imu_stream(motion, ROBOT, rng())
    seen = camera_stream(motion, with_changes("camera", lever_x_m=0.0, lever_y_m=0.0), rng(), QUIET)
    for stream, channel, sign, expected_s, within_s in (
        (imu, "gyro_z_radps", 1, gyro_s, 6e-4),  # the low-pass works in steps of 1 ms: half a step early
        (imu, "accel_x_mps2", 1, accel_s, 6e-4),
        (imu, "accel_z_mps2", 1, accel_s, 6e-4),
        (seen, "velocity_z_mps", -1, speed_s, 6e-4),
        (seen, "rate_y_radps", 1, speed_s, 6e-4),
        (seen, "position_x_m", -1, camera.latency_s, 1e-4),
        (gnss_stream(motion, Gnss(rate_hz=20.0), rng()), "position_y_m", 1, 0.1, 5e-4),
        (steering_stream(motion, ROBOT, rng()), "angle_2_rad", 1, 0.0, 1e-4),
    ):
        late = stream.time_s > 1.0
        found_s = delay_s(stream.time_s[late], sign * stream.channel(channel)[late], frequency_hz)
        assert found_s == pytest.approx(expected_s, abs=within_s), channel


def test_steering_is_seen_in_whole_steps_with_its_zero_and_wrapped():
    angle = np.linspace(-7.0, 7.0, 20_000)
    robot = with_changes("steering", zero_1_rad=0.5, zero_3_rad=-3.0)
    seen = columns_of(
        steering_stream(motion_of(20.0, steer_rad=angle[:, None]), robot, rng()), "angle_{}_rad", "123"
    )
    step_rad = 2 * math.pi / 4096
    place = (seen - step_rad / 2) / step_rad
    np.testing.assert_allclose(place, np.round(place), atol=1e-6)
    assert (seen > -math.pi).all()
    assert (seen <= math.pi).all()
    assert np.ptp(seen, axis=0).min() > 2 * math.pi - 0.02
    error = np.angle(np.exp(1j * (seen - angle[::20, None] - [0.5, 0.0, -3.0])))
    assert np.abs(error).max() < step_rad / 2 + 5 * ROBOT.sensors.steering_std_rad
    assert np.abs(error.mean(axis=0)).max() < 4.5 * 0.0011 / math.sqrt(1000)


def test_the_gyro_follows_the_tilt_on_an_even_slope_and_on_undulation():
    time_s = clock(10.0)
    yaw = 0.5 * time_s
    uphill = {"grade_x_ratio": 0.1 * np.cos(yaw), "grade_y_ratio": -0.1 * np.sin(yaw)}
    turning = motion_of(10.0, yaw_rad=yaw, yaw_rate_radps=0.5, **uphill)
    gyro = columns_of(imu_stream(turning, SILENT_IMU, rng())[0], "gyro_{}_radps", "xyz")[10:]
    np.testing.assert_allclose(gyro, [[0.0, 0.0, 0.5]] * len(gyro), atol=1e-6)  # 0.05 were it Euler's angles
    undulation = motion_of(10.0, grade_x_ratio=0.05 * np.sin(time_s), grade_y_ratio=0.03 * np.sin(2 * time_s))
    imu, _ = imu_stream(undulation, SILENT_IMU, rng())
    for axis, angle in (("x", "roll"), ("y", "pitch")):
        turned = np.cumsum(imu.channel(f"gyro_{axis}_radps")) / 100
        tilt = imu.channel(f"{angle}_rad")
        assert np.abs(turned - (tilt - tilt[0])).max() < 8 * TILT_NOISE_RAD
        assert np.ptp(tilt) > 0.05


def circle(duration_s, radius_m=2.0, speed_mps=0.8, lateral_mps=0.1):
    """A circle driven at a constant drift angle, from the origin with heading 0."""
    turn = speed_mps / radius_m
    yaw = turn * clock(duration_s)
    step = (speed_mps + 1j * lateral_mps) / (1j * turn) * (np.exp(1j * yaw) - 1)
    place = {"yaw_rad": yaw, "position_x_m": step.real, "position_y_m": step.imag}
    twist = {"yaw_rate_radps": turn, "speed_x_mps": speed_mps, "speed_y_mps": lateral_mps}
    return motion_of(duration_s, **place, **twist)


def test_the_camera_without_noise_gives_the_ideal_odometry_stream():
    camera = dataclasses.replace(SILENT_CAMERA.camera, time_constant_s=0.0, lever_z_m=0.3)
    motion = Motion(random_motion())
    found = camera_stream(motion, SILENT_CAMERA.with_parts(camera=camera), rng(), QUIET)
    at = motion.record[motion.at(camera.rate_hz, camera.latency_s)[1]]
    place, attitude, twist = (
        np.column_stack([at[name] for name in names.split()])
        for names in (
            "position_x_m position_y_m",
            "roll_rad pitch_rad yaw_rad",
            "speed_x_mps speed_y_mps yaw_rate_radps",
        )
    )
    yaw_0 = motion.record["yaw_rad"][0]
    seen = odometry_stream(found.time_s, place, attitude, twist, camera, yaw_0=yaw_0)
    assert found.channels == seen.channels
    np.testing.assert_allclose(found.values, seen.values, rtol=0, atol=1e-12)


def test_dropouts_and_jumps_come_by_chance_at_their_rates():
    rates = {"dropout_rate_hz": 0.2, "dropout_length_s": 0.25, "jump_rate_hz": 0.3, "jump_std_m": 0.2}
    robot = SILENT_CAMERA.with_parts(camera=dataclasses.replace(SILENT_CAMERA.camera, **rates))
    motion = motion_of(50.0)
    dropouts, lengths, jumps = 0, [], []
    for seed in range(12):
        stream = camera_stream(motion, robot, rng(seed), NO_FAULTS)
        gap = np.diff(stream.time_s) - 1 / 200
        dropouts += (gap > 1e-6).sum()
        lengths += gap[gap > 1e-6].tolist()
        no_loss = dataclasses.replace(robot.camera, dropout_rate_hz=0.0)
        whole = camera_stream(motion, robot.with_parts(camera=no_loss), rng(seed), NO_FAULTS)
        assert len(whole) == 10_000
        steps = np.diff(columns_of(whole, "position_{}_m", "xyz"), axis=0)
        jumped = steps[np.abs(steps).max(axis=1) > 1e-9]
        jumps += jumped.tolist()
        # a jump is a wrong speed for four samples: it shows in the plane, and its integral is the step
        shown = columns_of(whole, "velocity_{}_mps", "xyz")
        assert (np.abs(shown) > 1e-9).any(axis=1).sum() <= 4 * len(jumped) + 4
        np.testing.assert_allclose(shown[:-4].sum(axis=0) / 200, jumped.sum(axis=0), atol=1e-9)
    low, high = poisson.ppf([1e-4, 1 - 1e-4], [[0.2 * 600], [0.3 * 600]]).T
    assert low[0] * 0.9 <= dropouts <= high[0]  # some run into each other
    assert low[1] <= len(jumps) <= high[1]
    assert np.mean(lengths) == pytest.approx(0.25, rel=0.45)
    right, up, back = np.array(jumps).T
    assert not up.any()
    assert_std(np.column_stack([right, back]), 0.2, 0.0)
    assert len(camera_stream(motion, robot, rng(1), QUIET)) == 10_000


def test_gnss_reports_delayed_positions_with_their_accuracy():
    motion, receiver = circle(60.0), Gnss(fix_length_s=3.0, float_length_s=1.0)
    seen = [gnss_stream(motion, receiver, rng(seed)) for seed in range(10)]
    fixed = np.concatenate([stream.channel("fix_ratio") for stream in seen]).astype(bool)
    assert fixed.mean() == pytest.approx(0.75, abs=0.12)  # 150 stretches of either kind
    lost = (np.diff(fixed.astype(int)) == -1).sum()
    assert poisson.cdf(lost, fixed.sum() / 10 / 3.0) == pytest.approx(0.5, abs=0.4999)
    std = np.concatenate([stream.channel("std_position_m") for stream in seen])
    np.testing.assert_array_equal(std, np.where(fixed, 0.02, 0.5))
    then = motion.record[np.maximum(np.round((seen[0].time_s - 0.1) / STEP_S).astype(int), 0)]
    cos, sin = np.cos(then["yaw_rad"]), np.sin(then["yaw_rad"])
    position = np.column_stack([then["position_x_m"], then["position_y_m"]])
    velocity = np.column_stack([0.8 * cos - 0.1 * sin, 0.8 * sin + 0.1 * cos])
    errors = np.vstack([columns_of(stream, "position_{}_m", "xy") - position for stream in seen])
    assert_std(errors[fixed], 0.02, 0.0)
    assert_std(errors[~fixed], 0.5, 0.0)
    of_speeds = [columns_of(stream, "velocity_{}_mps", "xy") - velocity for stream in seen]
    assert_std(np.vstack(of_speeds), 0.03, 0.0)


def test_the_truth_is_what_happened_and_a_slip_that_never_was_is_no_channel():
    slip = np.column_stack([np.full(500, np.nan), np.linspace(0.0, 0.5, 500), np.full(500, 0.1)])
    tilt = {"ride_roll_rad": 0.01, "grade_y_ratio": 0.1, "accel_y_mps2": 0.3}
    motion = motion_of(0.5, slip_ratio=slip, normal_n=[[1.0, 2.0, 3.0]], torque_nm=[[6.0, 0.0, -6.0]], **tilt)
    truth = dynamic_truth(motion, ROBOT, np.array([0.1, 0.2]), np.array([0.0, 0.5]))
    assert "slip_1_ratio" not in truth.channels
    np.testing.assert_array_equal(truth.channel("slip_2_ratio"), slip[::10, 1])
    assert [truth.channel(f"normal_{i}_n")[7] for i in (1, 2, 3)] == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(truth.channel("roll_rad"), math.atan(0.1) + 0.01)
    np.testing.assert_allclose(truth.channel("gyro_bias_z_radps")[25], 0.15)
    assert np.isfinite(truth.values).all()
    silent = with_changes("sensors", current_std_a=0.0)
    current = columns_of(wheels_stream(motion, silent, rng()), "current_{}_a", "123")
    np.testing.assert_allclose(current * ROBOT.motors.nm_per_a, [[6.0, 0.0, -6.0]] * 25, atol=1e-12)
