"""Bags become the runs whose messages they hold; rosbags writes them."""

import json
import sqlite3
import struct

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format
from mcap.writer import CompressionType, IndexType
from scipy.spatial.transform import Rotation

from pipelines.data.datasets import load_runs
from terrain.errors import LogError
from terrain.kinematics.camera import body_motion
from terrain.logs.write import write_run
from terrain.robots import Camera, load_robot

from .foreign_bags import (
    START_NS,
    husky_rows,
    imu,
    joints,
    message,
    refused,
    text,
    twist,
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
    rows = husky_rows(60)
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


def read(folder, rows, lines, **options):
    path = write_mcap(folder / "drive.mcap", rows)
    (run,) = load_runs(path, mapping=mapping_of(folder, lines), **options)
    return run


IMU = "streams: {imu: {topic: /imu, kind: imu}}"


def imu_rows(stamps, kinds=None):
    kinds = kinds or [{}] * len(stamps)
    rows = enumerate(zip(stamps, kinds, strict=True))
    return [("/imu", START_NS + i, imu(stamp, (0.1 * i, 0.0, 1.0), **kind)) for i, (stamp, kind) in rows]


def test_the_attitude_is_that_of_the_quaternion_and_an_unknown_one_is_no_channel_or_nan(tmp_path):
    angles = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))
    known = [{"quaternion": tuple(each)} for each in Rotation.from_euler("ZYX", angles[:, ::-1]).as_quat()]
    unknown, zero = {"unknown": True}, {"quaternion": (0.0,) * 4}
    for kinds, n_known in (
        (known, 20),
        (known[:4] + [unknown] * 5 + [zero], 4),
        ([unknown] * 9, 0),
        ([zero] * 9, 0),
    ):
        rows = imu_rows([START_NS + i * 10**7 for i in range(len(kinds))], kinds)
        stream = read(tmp_path, rows, IMU).streams["imu"]
        assert len(stream.channels) == (9 if n_known else 6)
        if n_known:
            np.testing.assert_allclose(stream.values[:n_known, 6:], angles[:n_known], atol=1e-12)
            assert np.isnan(stream.values[n_known:, 6:]).all()


def test_stamps_are_refused_or_repaired_and_the_log_time_helps(tmp_path):
    stamps = [START_NS + 10_000_000 * i for i in range(20)]
    stamps[7], stamps[11] = stamps[9], stamps[10]
    path, mapping = tmp_path / "drive.mcap", mapping_of(tmp_path, IMU)
    for given, fault in (
        ([START_NS, START_NS + 5, START_NS + 5], "time repeats at row 3"),
        ([0, 0, 0], r"all headers are stamped 0; take the log times \(time: log\)"),
        (stamps, r"stream imu: time goes back at row 9 \(0\.08 s after 0\.09 s\)"),
    ):
        refused(fault, write_mcap(path, imu_rows(given)), mapping=mapping)
    run = read(tmp_path, imu_rows(stamps), IMU, repair=True)
    assert (len(run.streams["imu"]), dict(run.dropped)) == (18, {"rows with a bad time": 2})
    run = read(tmp_path, imu_rows(stamps), "time: log\n" + IMU)
    np.testing.assert_array_equal(run.streams["imu"].time_s, np.arange(20) / 1e9)


def test_messages_are_put_in_the_order_of_their_log_times_and_topics_of_one_frame_are_two_streams(tmp_path):
    stamps = [START_NS + 10_000_000 * i for i in range(50)]
    rows = imu_rows(stamps)
    back = [("/back", t, imu(t, (9.0, 0.0, 0.0))) for t in stamps]
    two = "streams: {imu: {topic: /imu, kind: imu}, back: {topic: /back, kind: imu}}"
    run = read(tmp_path, rows[25:] + back + rows[:25], two)
    assert run.streams["back"].channel("gyro_x_radps").tolist() == [9.0] * 50
    np.testing.assert_allclose(run.streams["imu"].channel("gyro_x_radps"), 0.1 * np.arange(50))


JOINTS = """\
streams:
  wheels:
    topic: /joints
    kind: joints
    wheel_radius: {value: 200, unit: mm, source: measured}
    channels:
      speed_left_mps: {joint: left, field: velocity, scale: -1}
      motor_2_radps: {joint: right, field: velocity, unit: rpm}
      current_1_a: {joint: left, field: effort, unit: mA}
      angle_1_rad: {joint: steer, field: position, unit: deg}
"""


def test_joints_are_found_by_name_in_any_order_and_in_several_messages(tmp_path):
    names = {"left": (0.0, 2.0, 500.0), "right": (0.0, 60.0, 0.0), "steer": (90.0, 0.0, 0.0)}
    orders = ["left right steer", "steer left right", "right gripper left", "gripper"]
    rows = []
    for i in range(40):
        order, stamp = orders[i % 4].split(), START_NS + i * 10**7
        position, velocity, effort = zip(*(names.get(name, (7.0, 7.0, 7.0)) for name in order), strict=True)
        rows.append(("/joints", stamp, joints(stamp, order, velocity, position, effort)))
    wheels = read(tmp_path, rows, JOINTS).streams["wheels"]
    assert len(wheels) == 30
    for channel, value in (("speed_left_mps", -0.4), ("motor_2_radps", 2 * np.pi), ("current_1_a", 0.5)):
        assert wheels.channel(channel) == pytest.approx(np.full(30, value))
    angle_rad = wheels.channel("angle_1_rad")
    assert np.isnan(angle_rad).sum() == 10
    assert np.nanmax(angle_rad) == pytest.approx(np.pi / 2)


FIELDS = """\
streams:
  wheels:
    topic: /a
    {join}
    channels:
      speed_left_mps: {{field: linear.x, unit: km/h, offset: 3.6}}
      speed_right_mps: {{topic: /b, field: linear.x, unit: m/s}}
"""


def test_topics_are_joined_by_equal_stamps_or_by_the_value_before(tmp_path):
    rows = [("/a", START_NS + 10 * i, twist(3.6 * i, 0, 0)) for i in range(6)]
    rows += [("/b", START_NS + 10 * i + (3 if i == 4 else 0), twist(i, 0, 0)) for i in range(1, 6)]
    with pytest.raises(LogError, match="wheels: 3 messages of '/a' and '/b' lack one of equal stamp"):
        read(tmp_path, rows, FIELDS.format(join=""))
    run = read(tmp_path, rows, FIELDS.format(join=""), repair=True)
    assert run.streams["wheels"].values == pytest.approx(np.array([[2, 1], [3, 2], [4, 3], [6, 5]]))
    run = read(tmp_path, rows, FIELDS.format(join="join: previous"))
    assert run.streams["wheels"].channel("speed_right_mps")[1:].tolist() == [1, 2, 3, 3, 5]
    assert np.isnan(run.streams["wheels"].channel("speed_right_mps")[0])


def test_terrains_of_a_topic_are_labels(tmp_path):
    stamps = [START_NS + 10**9 * i for i in range(11)]
    rows = [("/imu", stamp, each) for stamp, (_, _, each) in zip(stamps, imu_rows(stamps), strict=True)]
    changes = [(2.5, "ICE"), (3.0, "ICE"), (5.0, "SNOW"), (7.0, ""), (8.0, "ICE")]
    rows += [("/terrain_name", START_NS + int(t * 1e9), text(name)) for t, name in changes]
    run = read(tmp_path, rows, "labels: /terrain_name\n" + IMU)
    assert [*map(tuple, run.labels)] == [(2.5, 5.0, "ICE"), (5.0, 7.0, "SNOW"), (8.0, 11.0, "ICE")]
    assert read(tmp_path, rows, "terrain: MUD\n" + IMU).terrains == ("MUD",)


OF_TWIST = "streams: {a: {topic: /cmd_vel, channels: "
OF_IMU = "streams: {a: {topic: /imu/data, channels: "
OF_JOINTS = "streams: {a: {topic: /j, kind: joints, channels: "
OF_WHEELS = (
    "streams: {a: {topic: /joint_states, kind: joints, channels: {v_mps: {joint: b, field: velocity}}}}"
)


@pytest.mark.parametrize(
    ("lines", "fault"),
    [
        ("streams: {imu: {topic: /gyro, kind: imu}}", r"no topic '/gyro' \(there are /cmd_vel "),
        ("streams: {imu: {topic: /cmd_vel, kind: imu}}", "is of type geometry_msgs/msg/Twist, kind 'imu' is"),
        (OF_TWIST + "{v_mps: {field: linear.w, unit: m/s}}}}", "no 'w' .it has x, y, z"),
        (OF_TWIST + "{v_mps: {field: linear, unit: m/s}}}}", "a number is required"),
        (OF_TWIST + "{v_mps: {field: linear.x.y, unit: m/s}}}}", "'x' has no fields"),
        (OF_TWIST + "{v_mps: {field: 'linear[0]', unit: m/s}}}}", "is no array"),
        (OF_IMU + "{v_mps: {field: 'orientation_covariance[9]', unit: m/s}}}}", "nothing finite"),
        (OF_IMU + "{v_mps: {field: orientation_covariance, unit: m/s}}}}", "is an array: give an index"),
        ("labels: /cmd_vel\n" + IMU.replace("/imu", "/imu/data"), "std_msgs/String is required"),
        ("labels: /nothing\n" + IMU.replace("/imu", "/imu/data"), "labels: there is no topic '/nothing'"),
        (OF_TWIST + "{v_mps: {field: linear.x, unit: furlong}}}}", "'furlong' is unknown"),
        (OF_TWIST + "{v_mps: {field: linear.x, unit: rad}}}}", "does not suit it"),
        (OF_TWIST + "{speed: {field: linear.x, unit: rad}}}}", "known unit"),
        ("streams: {a: {topic: /a, kind: twist, channels: {v_mps: {field: a, unit: m/s}}}}", "of its own"),
        ("streams: {a: {topic: /cmd_vel}}", "has no channels"),
        ("streams: {a: {topic: /cmd_vel, kind: twist, colour: red}}", "key 'streams.a.colour' is unknown"),
        ("streams: {a: {topic: /cmd_vel, kind: video}}", "streams.a.kind is 'video'"),
        (OF_JOINTS + "{v_mps: {joint: b, field: speed}}}}", "none of velocity"),
        (OF_JOINTS + "{v_a: {joint: b, field: effort}}}}", "does not suit"),
        (OF_JOINTS + "{v_mps: {field: velocity}}}}", "'joint' is missing"),
        ("terrain: MUD\nlabels: /a\n" + IMU, "both 'terrain' and 'labels'"),
        ("streams: {}", "at least 1 item"),
        (OF_WHEELS, "'/joint_states' has no message with any of the joints"),
        ("robot: mine\n" + OF_WHEELS, "'wheel_radius' is missing, and the robot has no description"),
    ],
)
def test_a_mistake_in_a_mapping_is_one_sentence(tmp_path, lines, fault):
    path = write_mcap(tmp_path / "drive.mcap", husky_rows(20))
    refused(fault, path, mapping=mapping_of(tmp_path, lines))


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
        (CDR, "a/B", "string[20000] x", "more than 10000 fields or elements"),
        (CDR, "a/B", "\n".join(f"int8 x{i}" for i in range(10_001)), "more than 10000 fields"),
        (CDR, "a/B", "# all\n" * 99_999, "is longer than"),
        (CDR, "a/B:\n  pass\nprint(1)\nclass C", "float64 x", "its definition"),
        (("protobuf", "protobuf"), "own.Speeds", "no", "its definition is damaged"),
        (("protobuf", "other"), "own.Speeds", "", "has a definition in 'other', 'protobuf' is read"),
        (("json", "jsonschema"), "own.Speeds", "{}", r"own.Speeds has no 'speed' \(it has a\)"),
        (FLAT, "own.Speeds", "", "is encoded as 'flatbuffer'; cdr, ros1, protobuf and json are read"),
    ],
)
def test_a_definition_that_is_not_accepted_is_one_sentence(tmp_path, capsys, encodings, kind, text, fault):
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


def test_fixes_become_metres_and_poses_a_continuous_yaw(tmp_path):
    """A receiver goes 0.0001 degrees north a step, 11.113 m, and loses its fix; a robot turns round three times."""
    rows = []
    for i in range(20):
        stamp = START_NS + 10**8 * i
        fix = {"latitude": 45.0 + 1e-4 * i, "longitude": 7.0, "altitude": 200.0 + i}
        fix |= {"status__status": -(i == 5), "position_covariance": np.array([0.04, *np.zeros(8)])}
        turned = tuple(Rotation.from_euler("z", i).as_quat())
        pose = {"pose__position": (0.1 * i, 2.0, 0.0), "pose__orientation": turned}
        rows.append(("/fix", stamp, message("sensor_msgs/msg/NavSatFix", stamp, **fix)))
        rows.append(("/pose", stamp, message("geometry_msgs/msg/PoseStamped", stamp, **pose)))
    run = read(tmp_path, rows, "streams: {gnss: {topic: /fix, kind: gnss}, pose: {topic: /pose, kind: pose}}")
    gnss, pose = run.streams["gnss"], run.streams["pose"]
    assert gnss.channels == ("position_x_m", "position_y_m", "position_z_m", "std_position_m")
    assert np.isnan(gnss.values).any(axis=1).tolist() == [i == 5 for i in range(20)]
    known = np.arange(20) != 5
    np.testing.assert_allclose(gnss.channel("position_y_m")[known], 11.113 * np.arange(20)[known], atol=0.02)
    np.testing.assert_allclose(gnss.channel("std_position_m")[known], 0.2)
    np.testing.assert_allclose(pose.channel("yaw_rad"), np.arange(20), atol=1e-9)
    np.testing.assert_allclose(pose.channel("position_x_m"), 0.1 * np.arange(20))


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
    own = mapping_of(tmp_path, OF_IMU + "{gyro_x_radps: {field: angular_velocity.x, unit: rad/s}}}}")
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
    assert run.streams["imu"].time_s[0] == pytest.approx(begin_s, abs=1e-6)
    other = mapping_of(tmp_path, lines.replace("/imu/data", "/imu"))
    refused(r"stream imu: there is no topic '/imu' \(there are", tmp_path, mapping=other)


def test_other_layouts_come_first_and_bags_beside_them_are_passed_over(tmp_path, make_run):
    write_run(make_run("SNOW_01"), tmp_path)
    write_mcap(tmp_path / "notes" / "notes.mcap", [("/name", START_NS, text("a"))])
    (found,) = load_runs(tmp_path)
    assert found.run_id == "SNOW_01"


LISTED, BAG = "rosbag2_bagfile_information: {relative_file_paths: [%s]}", "bag/metadata.yaml"


@pytest.mark.parametrize(
    ("place", "content", "fault"),
    [
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
    ],
)
def test_what_is_no_bag_is_one_sentence(tmp_path, place, content, fault):
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / place).write_text(content)
    refused(fault, tmp_path, layout="bag", robot="husky")
    refused("does not exist", tmp_path / "nothing.mcap", layout="bag", robot="husky")
