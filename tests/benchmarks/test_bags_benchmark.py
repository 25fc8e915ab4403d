"""How long a bag takes to read, beside other readers: ``pytest tests/benchmarks --benchmark-enable``.

This package, rosbags and mcap's decoder each read the same minute of an IMU at 100 Hz and of joints at 50 Hz
into arrays.
"""

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from pipelines.data.bag_runs import find_runs

DURATION_S = 60.0

STORE = get_typestore(Stores.ROS2_HUMBLE)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Return an MCAP file of a minute."""
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    rng = np.random.default_rng(0)
    with path.open("wb") as file:
        writer = Writer(file)
        imu, joints = (
            writer.register_msgdef(kind, STORE.generate_msgdef(kind, ros_version=2)[0])
            for kind in ("sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState")
        )
        for i in range(int(100 * DURATION_S)):
            stamp = 1_700_000_000 * 10**9 + i * 10**7
            head = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "imu_link"}
            gyro, accel = (dict(zip("xyz", rng.normal(size=3).tolist(), strict=True)) for _ in range(2))
            content = {"header": head, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
            content |= {"angular_velocity": gyro, "linear_acceleration": accel}
            zeros = [0.0] * 9
            content |= dict.fromkeys(
                (f"{name}_covariance" for name in ("orientation", *list(content)[2:])), zeros
            )
            writer.write_message("/imu", imu, content, stamp, stamp)
            if i % 2 == 0:
                names = [f"wheel_{k}" for k in range(4)]
                speeds = rng.normal(size=4).tolist()
                content = {"header": head, "name": names, "position": [], "velocity": speeds, "effort": []}
                writer.write_message("/joints", joints, content, stamp, stamp)
        writer.finish()
    mapping = path.with_name("mapping.yaml")
    mapping.write_text(
        "robot: husky\nstreams:\n  imu: {topic: /imu, kind: imu}\n"
        "  wheels:\n    topic: /joints\n    kind: joints\n    channels:\n"
        + "".join(f"      wheel_{k}_radps: {{joint: wheel_{k}, field: velocity}}\n" for k in range(4))
    )
    return path, mapping


def by_this_package(path, mapping):
    (read,) = find_runs(path, mapping, None)
    run = read()
    return run.streams["imu"].values[:, :6], run.streams["wheels"].values


def of_messages(messages):
    """Return the numbers of decoded messages, each with its topic."""
    imu, wheels = [], []
    for topic, m in messages:
        if topic == "/imu":
            w, a = m.angular_velocity, m.linear_acceleration
            imu.append((w.x, w.y, w.z, a.x, a.y, a.z))
        else:
            wheels.append(m.velocity)
    return np.array(imu), np.array(wheels)


def by_rosbags(path, _):
    with AnyReader([path]) as reader:
        return of_messages(
            (connection.topic, reader.deserialize(content, connection.msgtype))
            for connection, _, content in reader.messages()
        )


def by_mcap(path, _):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return of_messages((channel.topic, m) for _, channel, _, m in reader.iter_decoded_messages())


@pytest.mark.parametrize("read", [by_this_package, by_rosbags, by_mcap])
@pytest.mark.benchmark(group="a minute of a bag")
def test_reading_a_minute(benchmark, drive, read):
    imu, wheels = benchmark(read, *drive)
    expected_imu, expected_wheels = by_this_package(*drive)
    np.testing.assert_array_equal(imu, expected_imu)
    np.testing.assert_array_equal(wheels, expected_wheels)
    if benchmark.stats:  # absent where benchmarks are off
        benchmark.extra_info["times_real_time"] = DURATION_S / benchmark.stats.stats.median
