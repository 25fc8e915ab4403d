from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from terrain.kinematics.camera import body_motion, odometry_stream, to_body, to_camera
from terrain.records import Stream
from terrain.robots import load_robot

CAMERA = load_robot("agrimaro").camera
LEVER_M = np.array([CAMERA.lever_x_m, CAMERA.lever_y_m])
Q_ALIGN = Rotation.from_euler("X", -90, degrees=True) * Rotation.from_euler("Z", 90, degrees=True)


def drive(speed_x, speed_y, yaw_rate, *, yaw_0=0.0, pitch=0.0, n=1001, dt=0.005):
    """Return the stream of plain motion of constant rates."""
    time = np.arange(n) * dt
    speed, rate, yaw = np.tile([speed_x, speed_y], (n, 1)), np.full(n, yaw_rate), yaw_0 + yaw_rate * time
    velocity = turn(speed, yaw)
    position = np.vstack([np.zeros(2), np.cumsum((velocity[1:] + velocity[:-1]) / 2 * dt, axis=0)])
    attitude = np.column_stack([np.zeros(n), np.full(n, pitch), yaw])
    return odometry_stream(time, position, attitude, np.column_stack([speed, rate]), CAMERA, 0.0)


def turn(vectors, yaw):
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack(
        [cos * vectors[..., 0] - sin * vectors[..., 1], sin * vectors[..., 0] + cos * vectors[..., 1]],
        axis=-1,
    )


@given(
    seed=st.integers(0, 2**32 - 1),
    yaw_0=st.floats(-10, 10),
    tilt=st.sampled_from([0.0, 0.05, 0.4]),
    lever_z=st.sampled_from([0.0, 0.7]),
)
def test_a_stream_gives_back_the_motion_it_was_made_of(seed, yaw_0, tilt, lever_z):
    camera = replace(CAMERA, lever_z_m=lever_z)
    rng = np.random.default_rng(seed)
    n = 60  # rough steps, as noise in every array would make them; each turn stays under half a circle
    yaw = yaw_0 + np.cumsum(rng.uniform(-2, 2, n))
    roll, pitch = tilt * rng.standard_normal((2, n)).clip(-2, 2)
    position, speed = rng.standard_normal((n, 2)).cumsum(axis=0), rng.standard_normal((n, 2))
    rate = rng.standard_normal(n)
    attitude, twist = np.column_stack([roll, pitch, yaw]), np.column_stack([speed, rate])
    start = float(rng.uniform(-4, 4))
    stream = odometry_stream(np.arange(n) / 200, position, attitude, twist, camera, start)
    seen = body_motion(stream, camera)
    lever = np.column_stack([-rate * LEVER_M[1], rate * LEVER_M[0]])
    np.testing.assert_allclose(seen.speed_mps, speed + lever, atol=1e-9)
    np.testing.assert_allclose(seen.yaw_rate_radps, rate, atol=1e-12)
    np.testing.assert_allclose(seen.roll_rad, roll, atol=1e-9)
    np.testing.assert_allclose(seen.pitch_rad, pitch, atol=1e-9)
    np.testing.assert_allclose(seen.yaw_rad, yaw - yaw[0], atol=1e-9)
    np.testing.assert_allclose(seen.position_m, turn(position - position[0], -yaw[0]), atol=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
def test_renaming_axes_is_the_quaternion_product_of_the_thesis_and_its_matrices(seed):
    rng = np.random.default_rng(seed)
    sensor = Rotation.random(20, rng=rng)
    vectors = rng.standard_normal((20, 3))
    # the columns of the body's axes in the camera's: forward -z, left -x, up y
    matrix = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_allclose(Q_ALIGN.as_matrix(), matrix, atol=1e-15)
    np.testing.assert_allclose(to_camera(vectors), vectors @ matrix.T, atol=1e-15)
    np.testing.assert_allclose(to_body(to_camera(vectors)), vectors)
    by_product = (Q_ALIGN.inv() * sensor * Q_ALIGN).as_quat()
    by_name = np.column_stack([to_body(sensor.as_quat()[:, :3]), sensor.as_quat()[:, 3]])
    np.testing.assert_allclose(np.abs((by_product * by_name).sum(axis=1)), 1.0)
    np.testing.assert_allclose(
        Rotation.from_quat(by_name).as_matrix(), matrix.T @ sensor.as_matrix() @ matrix, atol=1e-12
    )


def test_signs_of_camera_motion():
    nose_up = body_motion(drive(1.0, 0.0, 0.0, pitch=-0.1), CAMERA)
    np.testing.assert_allclose(nose_up.pitch_rad, -0.1)
    np.testing.assert_allclose(nose_up.speed_mps, np.broadcast_to([1.0, 0.0], (1001, 2)), atol=1e-12)
    seen = body_motion(drive(0.7, 0.2, 0.0, yaw_0=np.radians(-135.0)), CAMERA)
    np.testing.assert_allclose(seen.speed_mps, np.broadcast_to([0.7, 0.2], (1001, 2)), atol=1e-12)
    np.testing.assert_allclose(seen.position_m[-1], [3.5, 1.0], atol=1e-9)
    ahead, left = drive(0.7, 0.0, 0.0), drive(0.0, 0.0, 0.5)
    np.testing.assert_allclose(ahead.channel("velocity_z_mps"), -0.7)  # z points backward
    np.testing.assert_allclose(left.channel("rate_y_radps"), 0.5)  # y points up
    seen = body_motion(left, CAMERA)
    np.testing.assert_allclose(seen.yaw_rate_radps, 0.5)
    np.testing.assert_allclose(seen.yaw_rad[-1], 2.5)
    # ahead of the origin and to its right: a left turn carries the camera forward and to the left
    assert (seen.speed_mps > 0).all()


@pytest.mark.parametrize(
    "quaternion", [(0, 0, 0, 0), (0, 0, 0, np.nan), (0.5, 0.5, 0.5, 0.9), (np.inf, 0, 0, 0)]
)
def test_poses_without_a_valid_quaternion_are_nan(quaternion):
    good = drive(1.0, 0.0, 0.5, yaw_0=0.3)
    rows, values = np.isin(np.arange(1001), [0, 1, 500]), np.array(good.values)
    columns = [good.channels.index(f"quaternion_{axis}_ratio") for axis in "xyzw"]
    values[np.ix_(rows, columns)] = quaternion
    seen, whole = body_motion(Stream(good.time_s, values, good.channels), CAMERA), body_motion(good, CAMERA)
    for name in ("speed_mps", "yaw_rate_radps", "roll_rad", "pitch_rad", "yaw_rad", "position_m"):
        value = getattr(seen, name)
        assert np.isnan(value[rows]).all()
        assert np.isfinite(value[~rows]).all()
    np.testing.assert_allclose(seen.speed_mps[~rows], whole.speed_mps[~rows])
    # zero is the first sample that is one
    np.testing.assert_allclose(seen.yaw_rad[~rows], whole.yaw_rad[~rows] - whole.yaw_rad[2], atol=1e-12)
    np.testing.assert_allclose(seen.position_m[2], 0.0, atol=1e-12)
