"""Tracking camera: from its pose stream to the robot's motion, and back (Danzi, AgriMaRo thesis, 5.2.3).

The camera's axes are x right, y up, z backward; its fixed frame is that of its power-on.  Velocities come in
the fixed frame, angular rates in the camera's.  With ``q_align = qx(-90 deg) (x) qz(+90 deg)``, which turns
vectors of the body's axes into vectors of the camera's::

    q_robot = q_align^-1 (x) q_sensor (x) q_align

The printed (5.6) leaves the right factor out and turns a yaw of 30 deg into (0, -60, -90) deg; the printed
q_align is that of the camera's inner IMU.  All of ``q_align`` amounts to renaming axes, of vectors and of a
quaternion's vector part alike: forward is -z, left is -x, up is y.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.angles import unwrapped
from terrain.records import Array, Stream
from terrain.robots import Camera

#: Quaternions further from length 1 than this are no rotation; four written digits stay well within.
QUATERNION_TOLERANCE = 0.01
#: Channels of the stream ``odometry``.
CHANNELS: tuple[str, ...] = (
    *(f"position_{axis}_m" for axis in "xyz"),
    *(f"quaternion_{axis}_ratio" for axis in "xyzw"),
    *(f"velocity_{axis}_mps" for axis in "xyz"),
    *(f"rate_{axis}_radps" for axis in "xyz"),
    "confidence_ratio",
)


class BodyMotion(NamedTuple):
    """Motion of the robot as its camera saw it; NaN where it saw nothing."""

    time_s: Array  #: (n,) stamps of the stream
    #: (n, 2) of the CAMERA point, forward and left in body axes: ``v_B + w x r`` (6.5, corrected)
    speed_mps: Array
    yaw_rate_radps: Array  #: (n,) about the body's z axis
    roll_rad: Array  #: (n,) against the fixed frame; left side up positive
    pitch_rad: Array  #: (n,) the same; nose down positive
    yaw_rad: Array  #: (n,) unwrapped, 0 at the first valid sample
    position_m: Array  #: (n, 2) of the ROBOT'S ORIGIN, from 0 with heading 0 at the first valid sample


def body_motion(odometry: Stream, camera: Camera) -> BodyMotion:
    """Return the motion of the robot from a pose stream.

    Parameters
    ----------
    odometry : with the channels of :data:`CHANNELS`; the confidence is not looked at
    camera : where it sits on the body

    Raises
    ------
    KeyError
        if the stream lacks a channel.

    Notes
    -----
    The lever arm stays in the speed, where a filter weighs it with the yaw rate's own uncertainty (5.2.3).
    It is taken off the position: ``P = P_camera - R_robot r`` (5.8 with the robot's rotation for the printed
    camera's, 5.9), zeroed at the start (5.10).
    """
    from scipy.spatial.transform import Rotation  # long to import, and no live chain needs it

    position, velocity, rate = (
        to_body(odometry.columns(f"{quantity}_{axis}_{unit}" for axis in "xyz"))
        for quantity, unit in (("position", "m"), ("velocity", "mps"), ("rate", "radps"))
    )
    quaternion = odometry.columns(f"quaternion_{axis}_ratio" for axis in "xyzw")
    valid = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) <= QUATERNION_TOLERANCE
    rotation = np.full((len(odometry), 3, 3), np.nan)
    if valid.any():
        vector = to_body(quaternion[valid, :3])
        rotation[valid] = Rotation.from_quat(np.column_stack([vector, quaternion[valid, 3]])).as_matrix()
    lever_m = np.array([camera.lever_x_m, camera.lever_y_m, camera.lever_z_m])
    yaw = unwrapped(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    place = position - rotation @ lever_m
    placed = np.isfinite(place).all(axis=1)
    if placed.any():
        place = place - place[placed.argmax()]
    if valid.any():
        yaw_0 = yaw[valid.argmax()]
        yaw = yaw - yaw_0
        place = place @ Rotation.from_euler("Z", yaw_0).as_matrix()
    return BodyMotion(
        time_s=odometry.time_s,
        speed_mps=np.einsum("nij,ni->nj", rotation, velocity)[:, :2],
        yaw_rate_radps=np.where(valid, rate[:, 2], np.nan),
        roll_rad=np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2]),
        pitch_rad=-np.arcsin(np.clip(rotation[:, 2, 0], -1.0, 1.0)),
        yaw_rad=yaw,
        position_m=place[:, :2],
    )


def odometry_stream(
    time_s: Array,
    position_m: Array,
    attitude_rad: Array,
    twist: Array,
    camera: Camera,
    yaw_0: float,
    confidence: Array | float = 1.0,
) -> Stream:
    """Return the pose stream, without noise, of a camera on a body that moves in a plane.

    Parameters
    ----------
    time_s : (n,) stamps
    position_m : (n, 2) of the body's origin
    attitude_rad : (n, 3) roll, pitch and yaw
    twist : (n, 3) velocity of the body's origin in body axes in m/s, and yaw rate in rad/s; rates of roll and
        pitch are left out
    camera : where it sits on the body
    yaw_0 : heading at power-on in rad, which happens with the body level at position (0, 0)
    confidence : (n,) or one number

    Notes
    -----
    The inverse of :func:`body_motion`.  Nothing is differentiated, so that any of the arrays may hold noise.
    """
    from scipy.spatial.transform import Rotation

    n = len(time_s)
    rotation = Rotation.from_euler("ZYX", attitude_rad[:, ::-1] - [yaw_0, 0.0, 0.0])
    lever_m = np.array([camera.lever_x_m, camera.lever_y_m, camera.lever_z_m])
    ground = np.column_stack([position_m, np.zeros(n)])
    place = Rotation.from_euler("Z", -yaw_0).apply(ground) + rotation.apply(lever_m) - lever_m
    rate = np.column_stack([np.zeros((n, 2)), twist[:, 2]])
    velocity = np.column_stack([twist[:, :2], np.zeros(n)]) + np.cross(rate, lever_m)
    quaternion = rotation.as_quat()
    values = [
        to_camera(place),
        to_camera(quaternion[:, :3]),
        quaternion[:, 3],
        to_camera(rotation.apply(velocity)),
        to_camera(rate),
        np.broadcast_to(confidence, n),
    ]
    return Stream(time_s, np.column_stack(values), CHANNELS)


def to_body(vectors: Array) -> Array:
    """Return vectors (..., 3) given in the camera's axes in the body's.

    Examples
    --------
    >>> to_body(np.array([0.0, 0.0, -2.0])) + 0.0  # two ahead
    array([2., 0., 0.])
    """
    turned: Array = vectors[..., [2, 0, 1]] * [-1.0, -1.0, 1.0]
    return turned


def to_camera(vectors: Array) -> Array:
    """Return vectors (..., 3) given in the body's axes in the camera's."""
    turned: Array = vectors[..., [1, 2, 0]] * [-1.0, 1.0, -1.0]
    return turned
