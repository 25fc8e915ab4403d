"""Bags as other programs write them, by rosbags and mcap; the messages are serialized by rosbags."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pipelines.data.datasets import load_runs
from pipelines.data.run_writers import setter, zero_message
from terrain.errors import ConfigError, LogError

STORE, ROS1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
START_NS = 1_700_000_000_123_456_789


def refused(fault, place, **options):
    """Assert that a folder or file is refused in one sentence that has a fault."""
    with pytest.raises((LogError, ConfigError), match=fault) as raised:
        load_runs(place, **options)
    assert "\n" not in str(raised.value)


def message(kind, stamp_ns=None, **fields):
    """Return a message whose fields are 0 or empty, but for some: a number, text or array, or x, y, z and w."""
    made = zero_message(STORE, kind)
    if stamp_ns is not None:
        made.header.stamp.sec, made.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    for path, value in fields.items():
        path = path.replace("__", ".")
        parts = zip("xyzw", value, strict=False) if isinstance(value, tuple) else [("", value)]
        for axis, number in parts:
            setter(made, f"{path}.{axis}".rstrip("."))(number)
    return made


def imu(stamp_ns, gyro, accel=(0.0, 0.0, 9.81)):
    fields = {"angular_velocity": tuple(gyro), "linear_acceleration": tuple(accel)}
    return message("sensor_msgs/msg/Imu", stamp_ns, orientation=(0.0, 0.0, 0.0, 1.0), **fields)


def text(content):
    return message("std_msgs/msg/String", data=content)


def write_messages(path, rows, **options):
    """Write ``(topic, log time in ns, content, kind, message encoding, schema encoding, definition)`` as MCAP."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer, channels = McapWriter(file, **options), {}
        writer.start(profile="ros2", library="test")
        for topic, log_ns, content, kind, encoding, *schema in rows:
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic, encoding, writer.register_schema(kind, *schema)
                )
            writer.add_message(channels[topic], log_ns, content, log_ns)
        writer.finish()
    return path


def write_mcap(path, rows, compression=CompressionType.ZSTD, chunk_size=20_000, **options):
    """Write ``(topic, log time in ns, message)`` as an MCAP file of one's own."""
    kinds = {each.__msgtype__ for _, _, each in rows}
    definitions = {kind: STORE.generate_msgdef(kind, ros_version=2)[0].encode() for kind in kinds}
    written = []
    for topic, log_ns, each in rows:
        kind = each.__msgtype__
        about = (kind, "cdr", "ros2msg", definitions[kind])
        written.append((topic, log_ns, bytes(STORE.serialize_cdr(each, kind)), *about))
    return write_messages(path, written, compression=compression, chunk_size=chunk_size, **options)


def write_by_rosbags(writer, store, serialize, rows):
    with writer:
        connections = {}
        for topic, log_ns, each in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, each.__msgtype__, typestore=store)
            writer.write(connections[topic], log_ns, serialize(each, each.__msgtype__))


def write_bag(folder, rows, storage="sqlite3"):
    """Write ``(topic, log time in ns, message)`` as a bag of rosbag2."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()])
    write_by_rosbags(writer, STORE, STORE.serialize_cdr, rows)
    return folder


def write_ros1(path, rows, compression=None):
    """Write ``(topic, log time in ns, message)`` as a bag of ROS 1, whose headers have a number."""

    def serialize(each, kind):
        if hasattr(each, "header"):
            header = ROS1.types["std_msgs/msg/Header"](0, each.header.stamp, each.header.frame_id)
            each = dataclasses.replace(each, header=header)
        return ROS1.serialize_ros1(each, kind)

    path.parent.mkdir(parents=True, exist_ok=True)
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(Ros1Writer.CompressionFormat[compression])
    write_by_rosbags(writer, ROS1, serialize, rows)
    return path


def husky_rows(n=200, start_ns=START_NS, late_ns=2_000_000):
    """Return a drive: IMU at 100 Hz, the others at 50 Hz; logged a little after its stamps."""
    rng = np.random.default_rng(3)
    rows = []
    for i in range(n):
        stamp = start_ns + 10_000_000 * i
        rows.append(("/imu/data", stamp + late_ns, imu(stamp, rng.normal(size=3), rng.normal(size=3))))
        if i % 2:
            continue
        names = [f"{place}_wheel_joint" for place in ("front_left", "front_right", "rear_left")]
        joints = {"name": names, "velocity": rng.normal(size=3), "position": np.zeros(3)}
        quaternion = rng.normal(size=4)
        moving = {
            "pose__pose__position": tuple(rng.normal(size=3)),
            "pose__pose__orientation": tuple(quaternion / np.linalg.norm(quaternion)),
            "twist__twist__linear": tuple(rng.normal(size=3)),
            "twist__twist__angular": tuple(rng.normal(size=3)),
        }
        desired = {"linear": (*rng.normal(size=2), 0.0), "angular": (0.0, 0.0, rng.normal())}
        for topic, each in (
            ("/joint_states", message("sensor_msgs/msg/JointState", stamp, **joints)),
            ("/odometry/filtered", message("nav_msgs/msg/Odometry", stamp, **moving)),
            ("/cmd_vel", message("geometry_msgs/msg/Twist", **desired)),
        ):
            rows.append((topic, stamp + late_ns, each))
    return sorted(rows, key=lambda row: row[1])
