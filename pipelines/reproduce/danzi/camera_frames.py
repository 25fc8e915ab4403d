"""Section 5.2.3 of Danzi, AgriMaRo thesis: from the orientation of the camera to that of the robot."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.reproduce.danzi.runs import ROBOT
from pipelines.reproduce.results import Finding, Row, equation_verdict
from terrain.kinematics.camera import BodyMotion, body_motion, odometry_stream, to_camera
from terrain.records import Stream
from terrain.robots import load_robot

YAW_DEG, SPEED_MPS = 30.0, 1.0
"""True motion: a turn between two samples, at a constant forward speed."""
PRINTED_ALIGNMENT = Rotation.from_euler("XZ", [-90.0, -90.0], degrees=True)
"""q_align of (5.5)."""


def camera_frames(seed: int, quick: bool) -> Finding:
    """Compare yaw and speed from the stream of the camera with those of the printed equations."""
    camera = load_robot(ROBOT).equipment.camera
    nothing, yaw_rad = np.zeros(2), np.radians([0.0, YAW_DEG])
    speed = np.array([[SPEED_MPS, 0.0], [SPEED_MPS, 0.0]])
    stream = odometry_stream(
        np.array([0.0, 1.0]),
        np.zeros((2, 2)),
        np.column_stack([nothing, nothing, yaw_rad]),
        np.column_stack([speed, nothing]),
        camera,
        yaw_0=0.0,
    )
    motion = body_motion(stream, camera)
    return Finding([_yaw(motion, stream), _forward_speed(motion)])


def _yaw(motion: BodyMotion, stream: Stream) -> Row:
    sensor = Rotation.from_quat([stream.channel(f"quaternion_{axis}_ratio")[1] for axis in "xyzw"])
    yaw, pitch, roll = (
        float(round(angle)) for angle in (PRINTED_ALIGNMENT * sensor).as_euler("ZYX", degrees=True)
    )
    simulated_deg = float(np.degrees(motion.yaw_rad[1]))
    return Row(
        what=f"Yaw from the camera, true {YAW_DEG:g} deg",
        where="(5.6)",
        printed=f"(5.6) gives roll {roll:.0f}, pitch {pitch:.0f}, yaw {yaw:.0f} deg",
        printed_interval=(yaw, yaw),
        simulated=simulated_deg,
        unit="deg",
        verdict=equation_verdict(simulated_deg, YAW_DEG, yaw),
        why="A change of axes acts on both sides of an orientation: q_align⁻¹ ⊗ q_sensor ⊗ q_align; (5.6) "
        "has the left factor only.",
        beside={"pitch by (5.6)": pitch, "roll by (5.6)": roll},
    )


def _forward_speed(motion: BodyMotion) -> Row:
    printed_mps = float(PRINTED_ALIGNMENT.inv().apply(to_camera(np.array([SPEED_MPS, 0.0, 0.0])))[0])
    simulated_mps = float(motion.speed_mps[1, 0])
    return Row(
        what=f"Forward speed from the camera, true {SPEED_MPS:g} m/s",
        where="5.2.3, (5.5)",
        printed=f"{printed_mps:.0f} m/s with the q_align of (5.5)",
        printed_interval=(printed_mps, printed_mps),
        simulated=simulated_mps,
        unit="m/s",
        verdict=equation_verdict(simulated_mps, SPEED_MPS, printed_mps),
        why="The printed q_align is that of the IMU inside the camera. The pose stream has x right, y up, z "
        "back: -90 deg about x, then +90 deg about z.",
    )
