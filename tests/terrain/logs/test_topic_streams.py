"""Messages of topics become streams, as a mapping describes them; the messages are dictionaries, as of JSON."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from terrain.errors import ConfigError, LogError
from terrain.kinematics.standard_messages import KINDS
from terrain.logs.mapping import Faults, Topic, load_topics, mapped_streams

START_NS = 1_700_000_000_123_456_789
TYPES = {
    "/imu": "sensor_msgs/msg/Imu",
    "/back": "sensor_msgs/msg/Imu",
    "/joints": "sensor_msgs/msg/JointState",
    "/terrain_name": "std_msgs/msg/String",
    "/fix": "sensor_msgs/msg/NavSatFix",
    "/pose": "geometry_msgs/msg/PoseStamped",
}
IMU = "streams: {imu: {topic: /imu, kind: imu}}"


def vector(*numbers):
    return dict(zip("xyzw", numbers, strict=False))


def stamped(stamp_ns, **fields):
    return {"header": {"stamp": dict(zip(("sec", "nanosec"), divmod(stamp_ns, 10**9), strict=True))}} | fields


def imu(stamp_ns, gyro, quaternion=(0.0, 0.0, 0.0, 1.0), covariance=0.0):
    fields = {"angular_velocity": gyro, "linear_acceleration": (0.0, 0.0, 9.81), "orientation": quaternion}
    unknown = {f"{name}_covariance": [covariance if name == "orientation" else 0.0] * 9 for name in fields}
    return stamped(stamp_ns, **{name: vector(*numbers) for name, numbers in fields.items()}, **unknown)


def imu_rows(stamps, kinds=None):
    rows = enumerate(zip(stamps, kinds or [{}] * len(stamps), strict=True))
    return [("/imu", START_NS + i, imu(stamp, (0.1 * i, 0.0, 1.0), **kind)) for i, (stamp, kind) in rows]


def twist_rows(topic, numbers, late_ns=lambda _: 0):
    speeds = (
        (i, {"linear": vector(x, 0.0, 0.0), "angular": vector(0.0, 0.0, 0.0)}) for i, x in numbers.items()
    )
    return [(topic, START_NS + 10 * i + late_ns(i), speed) for i, speed in speeds]


@pytest.fixture
def mapped(tmp_path):
    """Return what makes streams and labels of messages ``(topic, log time in ns, message)`` by a mapping's lines."""

    def apply(lines, rows, repairs=None, wheel_radius_m=0.2):
        (tmp_path / "mapping.yaml").write_text(lines)
        types = {name: TYPES.get(name, "geometry_msgs/msg/Twist") for name, *_ in rows}
        topics = {name: Topic(name, kind, "json", "", "") for name, kind in types.items()}
        about = load_topics(tmp_path / "mapping.yaml"), topics, KINDS, lambda _: lambda message: message
        found = (lambda names: [row for row in rows if row[0] in names]), wheel_radius_m, Faults(repairs)
        return mapped_streams("a.mcap", *about, *found)

    return apply


@pytest.fixture
def streams(mapped):
    return lambda *given, **options: mapped(*given, **options)[0]


def test_the_attitude_is_that_of_the_quaternion_and_an_unknown_one_is_no_channel_or_nan(streams):
    angles = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))
    known = [{"quaternion": each} for each in Rotation.from_euler("ZYX", angles[:, ::-1]).as_quat().tolist()]
    unknown, zero = {"covariance": -1.0}, {"quaternion": (0.0,) * 4}
    for kinds, n_known in (
        (known, 20),
        (known[:4] + [unknown] * 5 + [zero], 4),
        ([unknown] * 9, 0),
        ([zero] * 9, 0),
    ):
        stream = streams(IMU, imu_rows([START_NS + i * 10**7 for i in range(len(kinds))], kinds))["imu"]
        assert len(stream.channels) == (9 if n_known else 6)
        if n_known:
            np.testing.assert_allclose(stream.values[:n_known, 6:], angles[:n_known], atol=1e-12)
            assert np.isnan(stream.values[n_known:, 6:]).all()


def test_stamps_are_refused_or_repaired_and_the_log_time_helps(streams):
    stamps = [START_NS + 10_000_000 * i for i in range(20)]
    stamps[7], stamps[11] = stamps[9], stamps[10]
    for given, fault in (
        ([START_NS, START_NS + 5, START_NS + 5], "time repeats at row 3"),
        ([0, 0, 0], r"all headers are stamped 0; take the log times \(time: log\)"),
        (stamps, r"stream imu: time goes back at row 9 \(0\.08 s after 0\.09 s\)"),
    ):
        with pytest.raises(LogError, match=fault):
            streams(IMU, imu_rows(given))
    repairs = Counter()
    assert len(streams(IMU, imu_rows(stamps), repairs)["imu"]) == 18
    assert repairs == {"rows with a bad time": 2}
    by_log = streams("time: log\n" + IMU, imu_rows(stamps))["imu"]
    np.testing.assert_array_equal(by_log.time_s, np.arange(20) / 1e9)


def test_messages_are_put_in_the_order_of_their_log_times_and_topics_of_one_frame_are_two_streams(streams):
    stamps = [START_NS + 10_000_000 * i for i in range(50)]
    rows, back = imu_rows(stamps), [("/back", t, imu(t, (9.0, 0.0, 0.0))) for t in stamps]
    two = "streams: {imu: {topic: /imu, kind: imu}, back: {topic: /back, kind: imu}}"
    found = streams(two, rows[25:] + back + rows[:25])
    assert found["back"].channel("gyro_x_radps").tolist() == [9.0] * 50
    np.testing.assert_allclose(found["imu"].channel("gyro_x_radps"), 0.1 * np.arange(50))


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


def joints(stamp_ns, names, **numbers):
    return "/joints", stamp_ns, stamped(stamp_ns, name=names, **numbers)


def test_joints_are_found_by_name_in_any_order_and_in_several_messages(streams):
    numbers = {"left": (0.0, 2.0, 500.0), "right": (0.0, 60.0, 0.0), "steer": (90.0, 0.0, 0.0)}
    orders = ["left right steer", "steer left right", "right gripper left", "gripper"]
    rows = []
    for i in range(40):
        names = orders[i % 4].split()
        columns = zip(*(numbers.get(name, (7.0, 7.0, 7.0)) for name in names), strict=True)
        fields = dict(zip(("position", "velocity", "effort"), columns, strict=True))
        rows.append(joints(START_NS + i * 10**7, names, **fields))
    wheels = streams(JOINTS, rows)["wheels"]
    assert len(wheels) == 30
    for channel, value in (("speed_left_mps", -0.4), ("motor_2_radps", 2 * np.pi), ("current_1_a", 0.5)):
        assert wheels.channel(channel) == pytest.approx(np.full(30, value))
    angle_rad = wheels.channel("angle_1_rad")
    assert (np.isnan(angle_rad).sum(), np.nanmax(angle_rad)) == (10, pytest.approx(np.pi / 2))


FIELDS = """\
streams:
  wheels:
    topic: /a
    {join}
    channels:
      speed_left_mps: {{field: linear.x, unit: km/h, offset: 3.6}}
      speed_right_mps: {{topic: /b, field: linear.x, unit: m/s}}
"""


def test_topics_are_joined_by_equal_stamps_or_by_the_value_before(streams):
    rows = twist_rows("/a", {i: 3.6 * i for i in range(6)})
    rows += twist_rows("/b", {i: i for i in range(1, 6)}, lambda i: 3 * (i == 4))
    with pytest.raises(LogError, match="wheels: 3 messages of '/a' and '/b' lack one of equal stamp"):
        streams(FIELDS.format(join=""), rows)
    wheels = streams(FIELDS.format(join=""), rows, Counter())["wheels"]
    assert wheels.values == pytest.approx(np.array([[2, 1], [3, 2], [4, 3], [6, 5]]))
    right_mps = streams(FIELDS.format(join="join: previous"), rows)["wheels"].channel("speed_right_mps")
    np.testing.assert_array_equal(right_mps, [np.nan, 1, 2, 3, 3, 5])


def test_terrains_of_a_topic_are_labels(mapped):
    changes = [(2.5, "ICE"), (3.0, "ICE"), (5.0, "SNOW"), (7.0, ""), (8.0, "ICE")]
    names = [("/terrain_name", START_NS + int(t * 1e9), SimpleNamespace(data=name)) for t, name in changes]
    rows = imu_rows([START_NS + 10**9 * i for i in range(11)]) + names
    _, labels = mapped("labels: /terrain_name\n" + IMU, rows)
    assert [*map(tuple, labels)] == [(2.5, 5.0, "ICE"), (5.0, 7.0, "SNOW"), (8.0, 11.0, "ICE")]


def test_fixes_become_metres_and_poses_a_continuous_yaw(streams):
    """A receiver goes 0.0001 degrees north a step, 11.113 m, and loses its fix; a robot turns round three times."""
    rows = []
    for i in range(20):
        stamp, turned = START_NS + 10**8 * i, vector(*Rotation.from_euler("z", i).as_quat())
        fix = {"latitude": 45.0 + 1e-4 * i, "longitude": 7.0, "altitude": 200.0 + i}
        fix |= {"status": {"status": -(i == 5)}, "position_covariance": [0.04] + [0.0] * 8}
        rows.append(("/fix", stamp, stamped(stamp, **fix)))
        pose = {"position": vector(0.1 * i, 2.0, 0.0), "orientation": turned}
        rows.append(("/pose", stamp, stamped(stamp, pose=pose)))
    found = streams("streams: {gnss: {topic: /fix, kind: gnss}, pose: {topic: /pose, kind: pose}}", rows)
    gnss, pose = found["gnss"], found["pose"]
    assert gnss.channels == ("position_x_m", "position_y_m", "position_z_m", "std_position_m")
    assert np.isnan(gnss.values).any(axis=1).tolist() == [i == 5 for i in range(20)]
    known = np.arange(20) != 5
    np.testing.assert_allclose(gnss.channel("position_y_m")[known], 11.113 * np.arange(20)[known], atol=0.02)
    np.testing.assert_allclose(gnss.channel("std_position_m")[known], 0.2)
    np.testing.assert_allclose(pose.channel("yaw_rad"), np.arange(20), atol=1e-9)
    np.testing.assert_allclose(pose.channel("position_x_m"), 0.1 * np.arange(20))


OF_TWIST = "streams: {a: {topic: /cmd_vel, channels: "
OF_IMU = "streams: {a: {topic: /imu, channels: "
OF_JOINTS = "streams: {a: {topic: /joints, kind: joints, channels: "
OF_SPEED = OF_JOINTS + "{v_mps: {joint: b, field: velocity}}}}"


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
        ("labels: /cmd_vel\n" + IMU, "std_msgs/String is required"),
        ("labels: /nothing\n" + IMU, "labels: there is no topic '/nothing'"),
        (OF_TWIST + "{v_mps: {field: linear.x, unit: furlong}}}}", "'furlong' is unknown"),
        (OF_TWIST + "{v_mps: {field: linear.x, unit: rad}}}}", "does not suit it"),
        (OF_TWIST + "{speed: {field: linear.x, unit: rad}}}}", "known unit"),
        ("streams: {a: {topic: /a, kind: twist, channels: {v_mps: {field: a, unit: m/s}}}}", "of its own"),
        ("streams: {a: {topic: /cmd_vel}}", "has no channels"),
        (OF_JOINTS + "{v_mps: {joint: b, field: speed}}}}", "none of velocity"),
        (OF_JOINTS + "{v_a: {joint: b, field: effort}}}}", "does not suit"),
        (OF_JOINTS + "{v_mps: {field: velocity}}}}", "'joint' is missing"),
        ("terrain: MUD\nlabels: /a\n" + IMU, "both 'terrain' and 'labels'"),
        (OF_SPEED, "'/joints' has no message with any of the joints"),
        ("robot: mine\n" + OF_SPEED, "'wheel_radius' is missing, and the robot has no description"),
    ],
)
def test_a_mistake_in_a_mapping_is_one_sentence(streams, lines, fault):
    rows = imu_rows([START_NS, START_NS + 10]) + twist_rows("/cmd_vel", {1: 1.0, 2: 2.0})
    rows += [joints(START_NS + i, ["a"], velocity=[1.0], position=[0.0], effort=[0.0]) for i in (1, 2)]
    with pytest.raises((ConfigError, LogError), match=fault) as raised:
        streams(lines, rows, wheel_radius_m=None if "mine" in lines else 0.2)
    assert "\n" not in str(raised.value)
