"""Bags as other programs write them, by rosbags and mcap; the messages are serialized by rosbags."""

from __future__ import annotations

import dataclasses

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
START_NS = 1_700_000_000_123_456_789


def message(kind, stamp_ns=None, **fields):
    """Return a message whose fields are 0 or empty, but for some: a number, text or array, or x, y, z and w."""
    values = {}
    for name, (node, about) in STORE.fielddefs[kind][1]:
        if node == Nodetype.NAME:
            values[name] = message(about)
        elif node == Nodetype.BASE:
            values[name] = "" if about[0] == "string" else 0
        else:
            values[name] = np.zeros(about[1] if node == Nodetype.ARRAY else 0)
    made = TYPES[kind](**values)
    if stamp_ns is not None:
        made.header.stamp.sec, made.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    for path, value in fields.items():
        *parents, last = path.split("__")
        owner = made
        for name in parents:
            owner = getattr(owner, name)
        if isinstance(value, tuple):
            for axis, number in zip("xyzw", value, strict=False):
                setattr(getattr(owner, last), axis, number)
        else:
            setattr(owner, last, value)
    return made


def imu(stamp_ns, gyro, accel=(0.0, 0.0, 9.81), quaternion=(0.0, 0.0, 0.0, 1.0), unknown=False):
    return message(
        "sensor_msgs/msg/Imu",
        stamp_ns,
        angular_velocity=tuple(gyro),
        linear_acceleration=tuple(accel),
        orientation=tuple(quaternion),
        orientation_covariance=np.array([-1.0 if unknown else 0.0, *np.zeros(8)]),
    )


def joints(stamp_ns, names, velocity, position=(), effort=()):
    numbers = {"velocity": velocity, "position": position, "effort": effort}
    arrays = {field: np.array(each, dtype=np.float64) for field, each in numbers.items()}
    return message("sensor_msgs/msg/JointState", stamp_ns, name=list(names), **arrays)


def twist(x, y, yaw_rate):
    return message("geometry_msgs/msg/Twist", linear=(x, y, 0.0), angular=(0.0, 0.0, yaw_rate))


def odometry(stamp_ns, position, quaternion, linear, angular):
    pose = {"pose__pose__position": tuple(position), "pose__pose__orientation": tuple(quaternion)}
    rates = {"twist__twist__linear": tuple(linear), "twist__twist__angular": tuple(angular)}
    return message("nav_msgs/msg/Odometry", stamp_ns, **pose, **rates)


def text(content):
    return message("std_msgs/msg/String", data=content)


def write_bag(folder, rows, storage="sqlite3"):
    """Write ``(topic, log time in ns, message)`` as a bag of rosbag2."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connections = {}
        for topic, log_ns, message in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            content = STORE.serialize_cdr(message, message.__msgtype__)
            writer.write(connections[topic], log_ns, content)
    return folder


def write_mcap(path, rows, compression=CompressionType.ZSTD, chunk_size=20_000, **options):
    """Write ``(topic, log time in ns, message)`` as an MCAP file of one's own."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer = McapWriter(file, compression=compression, chunk_size=chunk_size, **options)
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, log_ns, message in rows:
            kind = message.__msgtype__
            if topic not in channels:
                definition = STORE.generate_msgdef(kind, ros_version=2)[0]
                schema = writer.register_schema(kind, "ros2msg", definition.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            content = bytes(STORE.serialize_cdr(message, kind))
            writer.add_message(channels[topic], log_ns, content, log_ns)
        writer.finish()
    return path


def write_ros1(path, rows, compression=None):
    """Write ``(topic, log time in ns, message)`` as a bag of ROS 1."""
    from rosbags.rosbag1 import Writer

    path.parent.mkdir(parents=True, exist_ok=True)
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer(path)
    if compression is not None:
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        connections = {}
        for topic, log_ns, message in rows:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            header = getattr(message, "header", None)
            if header is not None:
                stamped = store.types["std_msgs/msg/Header"](0, header.stamp, header.frame_id)
                message = dataclasses.replace(message, header=stamped)
            writer.write(connections[topic], log_ns, store.serialize_ros1(message, kind))
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
        names = ("front_left_wheel_joint", "front_right_wheel_joint", "rear_left_wheel_joint")
        rows.append(("/joint_states", stamp + late_ns, joints(stamp, names, rng.normal(size=3), np.zeros(3))))
        quaternion = rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        moving = (rng.normal(size=3), quaternion, rng.normal(size=3), rng.normal(size=3))
        rows.append(("/odometry/filtered", stamp + late_ns, odometry(stamp, *moving)))
        rows.append(("/cmd_vel", stamp + late_ns, twist(*rng.normal(size=3))))
    return sorted(rows, key=lambda row: row[1])
