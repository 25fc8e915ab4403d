"""Bags become the runs whose messages they hold; rosbags writes them."""

import json
import sqlite3
import struct

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format
from mcap.writer import CompressionType, IndexType

from pipelines.data.datasets import load_runs
from terrain.kinematics.camera import body_motion
from terrain.logs.run_folders import write_run
from terrain.robots import Camera, load_robot

from .foreign_bags import (
    START_NS,
    husky_rows,
    imu,
    refused,
    text,
    write_bag,
    write_mcap,
    write_messages,
    write_ros1,
)

HUSKY = "husky_topics"


def in_mcap(**options):
    return lambda folder, rows: write_mcap(folder / "drive.mcap", rows, **options)


@pytest.mark.parametrize(
    "write",
    [
        *(in_mcap(compression=each) for each in CompressionType),
        in_mcap(compression=CompressionType.NONE, use_chunking=False),
        in_mcap(index_types=IndexType.NONE, repeat_channels=False),
        *(
            lambda folder, rows, each=each: write_ros1(folder / "drive.bag", rows, each)
            for each in (None, "BZ2", "LZ4")
        ),
        lambda folder, rows: write_bag(folder / "drive", rows, "sqlite3"),
        lambda folder, rows: write_bag(folder / "drive", rows, "mcap"),
    ],
)
def test_a_bag_is_the_run_of_its_messages(tmp_path, write):
    """A file, the folder of a bag, or the file in it; in a folder of its own it has that one's terrain."""
    rows = husky_rows(40)
    place = write(tmp_path / "GRASS", rows)
    (run,) = load_runs(tmp_path, layout="bag", mapping=HUSKY)
    assert (run.run_id, run.robot, run.terrains) == ("GRASS_drive", "husky", ("GRASS",))
    assert set(run.streams) == {"imu", "wheels", "odometry", "commands"}
    check_husky(run, rows)
    for path in (place, *place.glob("drive.*")):
        (alone,) = load_runs(path, layout="bag", mapping=HUSKY)
        assert (alone.run_id, alone.labels) == ("drive", ())
        for name, stream in alone.streams.items():
            assert stream.values.tobytes() == run.streams[name].values.tobytes()


def check_husky(run, rows):
    """Compare a run with the messages that it was written from."""

    def sent(topic):
        return [message for name, _, message in rows if name == topic]

    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec - START_NS for m in sent("/imu/data")]
    np.testing.assert_array_equal(run.streams["imu"].time_s, np.array(stamps) / 1e9)
    radius_m = load_robot("husky").wheel_radius_m
    motion = body_motion(run.streams["odometry"], Camera(*[0.0] * len(Camera.__dataclass_fields__)))
    moved = [m.twist.twist for m in sent("/odometry/filtered")]
    for seen, numbers in (
        (run.streams["imu"].channel("gyro_y_radps"), [m.angular_velocity.y for m in sent("/imu/data")]),
        (run.streams["imu"].channel("accel_z_mps2"), [m.linear_acceleration.z for m in sent("/imu/data")]),
        (run.streams["imu"].channel("yaw_rad"), np.zeros(len(stamps))),
        (run.streams["wheels"].channel("speed_left_mps") / radius_m, [m.velocity[0] for m in sent("/joint_states")]),
        (run.streams["commands"].channel("yaw_rate_radps"), [m.angular.z for m in sent("/cmd_vel")]),
        (motion.speed_mps[:, 0], [m.linear.x for m in moved]),
        (motion.yaw_rate_radps, [m.angular.z for m in moved]),
    ):  # fmt: skip
        np.testing.assert_allclose(seen, numbers, rtol=1e-15, atol=1e-12)


def test_without_a_mapping_topics_are_read_by_their_types(tmp_path):
    path = write_mcap(tmp_path / "drive.mcap", husky_rows(60))
    (run,) = load_runs(path, robot="husky")
    assert set(run.streams) == {"imu", "odometry", "commands"}
    (by_folder,) = load_runs(tmp_path, robot="husky")
    assert by_folder.streams["imu"].values.tobytes() == run.streams["imu"].values.tobytes()
    refused("does not name its robot", path)
    rows = [*husky_rows(60), *(("/imu/other", START_NS + i, imu(START_NS + i, (0, 0, 0))) for i in (1, 2))]
    two = write_mcap(tmp_path / "two.mcap", rows)
    refused("/imu/data, /imu/other are all of type sensor_msgs/Imu", two, robot="husky")
    names = write_mcap(tmp_path / "none.mcap", [("/name", START_NS, text("a"))])
    refused(r"needs a mapping.*/name \(std_msgs/msg/String\)", names, robot="husky")


def mapping_of(folder, lines):
    path = folder / "mapping.yaml"
    path.write_text(lines if "robot: " in lines else "robot: husky\n" + lines, encoding="utf-8")
    return path


def write_speeds(path, encodings, definition, contents, kind):
    """Write messages of any encoding, 10 ms apart."""
    about = (kind, *encodings, definition)
    rows = [("/speeds", START_NS + 10**7 * i, content, *about) for i, content in enumerate(contents)]
    return write_messages(path, rows)


OF_SPEEDS = """streams:
  w:
    topic: /speeds
    channels:
      speed_left_mps: {field: "speed[0]", unit: km/h}
      position_x_m: {field: place.x, unit: m}
"""


PROTO = """name: "speeds.proto" package: "own" syntax: "proto3"
message_type { name: "Stamp"
  field { name: "seconds" number: 1 type: TYPE_INT64 } field { name: "nanos" number: 2 type: TYPE_INT32 } }
message_type { name: "Place" field { name: "x" number: 1 type: TYPE_DOUBLE } }
message_type { name: "Speeds"
  field { name: "timestamp" number: 1 type: TYPE_MESSAGE type_name: ".own.Stamp" }
  field { name: "speed" number: 2 type: TYPE_FLOAT label: LABEL_REPEATED }
  field { name: "place" number: 3 type: TYPE_MESSAGE type_name: ".own.Place" } }
"""


def protobuf_speeds():
    """Return the class of a message with a time, speeds of wheels and a position within, and its file."""
    file = text_format.Parse(PROTO, descriptor_pb2.FileDescriptorProto())
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kinds = message_factory.GetMessageClassesForFiles(["speeds.proto"], pool)
    return kinds["own.Speeds"], descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()


RULE = "=" * 80 + "\n"
IDL = f"""{RULE}IDL: own/msg/Speeds
module own {{ module msg {{ struct Speeds {{ sequence<float> speed; own::msg::Place place; }}; }}; }};
{RULE}IDL: own/msg/Place
module own {{ module msg {{ struct Place {{ double x; }}; }}; }};
"""
MSG = f"float32[] speed\nPlace place\n{RULE}MSG: own/Place\nfloat64 x\n"
SPEEDS, PROTO_FILE = protobuf_speeds()


def fields_of(number, **stamp):
    return {"timestamp": stamp, "speed": [3.6 * number, 1.0], "place": {"x": -number}}


@pytest.mark.parametrize(
    ("encodings", "definition", "content", "step_s"),
    [
        (
            ("protobuf", "protobuf"),
            PROTO_FILE,
            lambda i, s, ns: SPEEDS(**fields_of(i, seconds=s, nanos=ns)).SerializeToString(),
            0.02,
        ),
        (("json", "jsonschema"), b"{}", lambda i, s, ns: json.dumps(fields_of(i, sec=s, nsec=ns)).encode(), 0.02),
        (("cdr", "ros2idl"), IDL.encode(), lambda i, *_: b"\0\1\0\0" + struct.pack("<I2f4xd", 2, 3.6 * i, 1, -i), 0.01),
        (("ros1", "ros1msg"), MSG.encode(), lambda i, *_: struct.pack("<I2fd", 2, 3.6 * i, 1, -i), 0.01),
    ],
)  # fmt: skip
def test_messages_of_any_encoding_are_read_by_their_fields_and_stamps(
    tmp_path, encodings, definition, content, step_s
):
    """Without a header the log times are the stamps; a message that is damaged is refused or left out."""
    stamps = [divmod(START_NS - 10**9 + 2 * 10**7 * number, 10**9) for number in range(5)]
    contents = [content(number, *stamp) for number, stamp in enumerate(stamps)]
    kind = "own.Speeds" if encodings[0] in ("json", "protobuf") else "own/msg/Speeds"
    mapping = mapping_of(tmp_path, OF_SPEEDS)
    path = write_speeds(tmp_path / "a.mcap", encodings, definition, contents, kind)
    (run,) = load_runs(path, mapping=mapping)
    stream = run.streams["w"]
    np.testing.assert_allclose(stream.time_s, step_s * np.arange(5), atol=1e-9)
    np.testing.assert_allclose(stream.values, [[i, -i] for i in range(5)], atol=1e-6)
    changed = [*contents[:2], b"{broken", *contents[3:]]
    path = write_speeds(tmp_path / "a.mcap", encodings, definition, changed, kind)
    refused("not as defined", path, mapping=mapping)
    (run,) = load_runs(path, mapping=mapping, repair=True)
    assert (len(run.streams["w"]), run.dropped["damaged messages"]) == (4, 1)


CDR, FLAT = ("cdr", "ros2msg"), ("flatbuffer", "flatbuffer")


@pytest.mark.parametrize(
    ("encodings", "kind", "text", "fault"),
    [
        (CDR, "a/B", "float64 x\nbanana", "its definition is damaged"),
        (CDR, "a/B", "Other other", "its definition is damaged"),
        (CDR, "a/B", "B own", "holds itself"),
        (CDR, "a/B", "string[200] x", "more than 100 fields or elements"),
        (CDR, "a/B", "\n".join(f"int8 x{i}" for i in range(101)), "more than 100 fields or elements"),
        (CDR, "a/B", "# all\n" * 99_999, "is longer than"),
        (CDR, "a/B:\n  pass\nprint(1)\nclass C", "float64 x", "its definition"),
        (("protobuf", "protobuf"), "own.Speeds", "no", "its definition is damaged"),
        (("protobuf", "other"), "own.Speeds", "", "has a definition in 'other', 'protobuf' is read"),
        (("json", "jsonschema"), "own.Speeds", "{}", r"own.Speeds has no 'speed' \(it has a\)"),
        (FLAT, "own.Speeds", "", "is encoded as 'flatbuffer'; cdr, ros1, protobuf and json are read"),
    ],
)
def test_a_definition_that_is_not_accepted_is_one_sentence(
    tmp_path, monkeypatch, capsys, encodings, kind, text, fault
):
    monkeypatch.setattr("pipelines.data.bag_files.MAX_ELEMENTS", 100)
    contents = [b'{"a": 1}'] * 2 if encodings[0] == "json" else [bytes(12)] * 2
    path = write_speeds(tmp_path / "a.mcap", encodings, text.encode(), contents, kind)
    refused(fault, path, mapping=mapping_of(tmp_path, OF_SPEEDS))
    assert capsys.readouterr().out == ""


def test_a_measured_bag_of_ros_1_is_read(datasets_dir, tmp_path):
    """Two drives of a mecanum platform: the wheels, and poses of a motion-capture system."""
    lines = (
        "robot: mecanum\nstreams:\n  pose: {topic: /robot/pose, kind: pose}\n  wheels: {topic: /wheel_states, "
        "kind: joints, channels: {wheel_1_radps: {joint: front_left, field: velocity}}}"
    )
    runs = load_runs(datasets_dir / "mecanum", layout="bag", mapping=mapping_of(tmp_path, lines))
    assert [(run.run_id, len(run.streams["wheels"]), len(run.streams["pose"])) for run in runs] == [
        ("bag1", 2871, 9924),
        ("bag2", 5054, 17448),
    ]
    pose = runs[0].streams["pose"]
    assert pose.channels == ("position_x_m", "position_y_m", "yaw_rad")
    assert np.abs(np.diff(pose.channel("yaw_rad"))).max() < 0.2
    assert np.hypot(*np.diff(pose.values[:, :2], axis=0).T).max() < 0.05


def changed_store(bag, statement):
    with sqlite3.connect(bag / "bag.db3") as store:
        store.execute(statement)
    store.close()


def test_a_bag_without_definitions_is_read_by_those_of_its_release(tmp_path):
    rows = husky_rows(40)
    bag = write_bag(tmp_path / "bag", rows)
    changed_store(bag, "delete from message_definitions")
    (run,) = load_runs(bag, layout="bag", mapping=HUSKY)
    check_husky(run, rows)
    assert run.run_id == "bag"
    changed_store(bag, "update topics set type = 'own_msgs/msg/Imu' where name = '/imu/data'")
    own = mapping_of(
        tmp_path,
        "streams: {a: {topic: /imu/data, channels: {gyro_x_radps: {field: angular_velocity.x, unit: rad/s}}}}",
    )
    refused("'own_msgs/msg/Imu', which is not defined", bag, layout="bag", mapping=own)


def test_a_bag_in_parts_is_one_run_and_its_files_are_not_read_twice(tmp_path):
    rows = husky_rows(100)
    bag = write_bag(tmp_path / "bag", rows[:120], "mcap")
    write_bag(tmp_path / "rest", rows[120:], "mcap")
    (tmp_path / "rest" / "rest.mcap").rename(bag / "bag_1.mcap")
    (tmp_path / "rest" / "metadata.yaml").unlink()
    description = bag / "metadata.yaml"
    description.write_text(description.read_text().replace("  - bag.mcap", "  - bag.mcap\n  - bag_1.mcap", 1))
    (run,) = load_runs(tmp_path, layout="bag", mapping=HUSKY)
    check_husky(run, rows)


def test_a_bag_is_joined_with_other_files_of_its_run(tmp_path):
    """Stamps of a bag are seconds since 1970; the times of the other file are brought onto that clock."""
    rows = husky_rows(60)
    write_bag(tmp_path / "drive", rows, "mcap")
    write_mcap(tmp_path / "1.mcap", rows)
    begin_s = START_NS / 1e9
    (tmp_path / "1.csv").write_text("t,amps\n" + "".join(f"{0.05 * i},{i}\n" for i in range(10)))
    lines = f"""streams:
  imu: {{file: "{{n}}.mcap", messages: {{topic: /imu/data, kind: imu}}}}
  power:
    file: "{{n}}.csv"
    time: {{column: t, unit: s, offset: {begin_s}}}
    channels: {{current_left_a: {{column: amps, unit: A}}}}
"""
    (run,) = load_runs(tmp_path, mapping=mapping_of(tmp_path, lines))
    assert (run.run_id, len(run.streams["imu"]), len(run.streams["power"])) == ("1", 60, 10)
    assert {name: run.streams[name].time_s[0] for name in run.streams} == pytest.approx(
        {"imu": 0.0, "power": 0.0}, abs=1e-6
    )  # of the run, no more of the clock
    other = mapping_of(tmp_path, lines.replace("/imu/data", "/imu"))
    refused(r"stream imu: there is no topic '/imu' \(there are", tmp_path, mapping=other)


def test_other_layouts_come_first_and_bags_beside_them_are_passed_over(tmp_path, make_run):
    write_run(make_run("SNOW_01"), tmp_path)
    write_mcap(tmp_path / "notes" / "notes.mcap", [("/name", START_NS, text("a"))])
    (found,) = load_runs(tmp_path)
    assert found.run_id == "SNOW_01"


LISTED, BAG = "rosbag2_bagfile_information: {relative_file_paths: [%s]}", "bag/metadata.yaml"


def test_what_is_no_bag_is_one_sentence(tmp_path):
    (tmp_path / "bag").mkdir()
    for place, content, fault in (
        (BAG, "rosbag2_bagfile_information: 3", "does not list the files"),
        (BAG, LISTED % 3, "does not list the files"),
        (BAG, LISTED % "", "are required"),
        (BAG, LISTED % "metadata.yaml", "are required"),
        (BAG, LISTED % "a.mcap", "is missing"),
        (BAG, LISTED % "../a.mcap", r"is missing|leads out"),
        (BAG, LISTED.replace("}", ", compression_mode: file}") % "a", "is compressed by 'file'"),
        (BAG, "rosbag2_bagfile_information: [", "is no YAML"),
        ("notes.txt", "no bag", "holds no run"),
        ("notes.mcap", "no bag", "no bag of a known type"),
        ("notes.mcap", "", "is empty, which is no bag"),
        ("notes.db3", "no bag", r"begins with b'no bag'.*bags of ROS 1"),
    ):
        (tmp_path / place).write_text(content)
        refused(fault, tmp_path, layout="bag", robot="husky")
        (tmp_path / place).unlink()
    refused("does not exist", tmp_path / "nothing.mcap", layout="bag", robot="husky")
