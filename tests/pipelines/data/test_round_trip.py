"""What was exported is imported as the same run, bit for bit; other libraries read the same numbers."""

import json
import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from pipelines.data.convert import Settings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import load_runs
from terrain.errors import ConfigError, LogError
from terrain.logs.run_folders import WINDOWS_FILE, RecordedWindow, data_digest, windows_text, write_run
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

TARGETS = ("mcap", "ros2", "ros2-mcap")


def exported(source, out, target="mcap", **options):
    return convert(Settings(data=source, out=out, to=target, **options))


@pytest.fixture(scope="module")
def raw(tmp_path_factory, estimated_run):
    """Return a folder with a simulated run of each robot, one of them with its estimates."""
    folder = tmp_path_factory.mktemp("raw")
    write_run(estimated_run, folder)
    write_run(simulate_run(load_robot("husky"), "clay", "arc", 2, duration_s=6.0), folder)
    return folder


@pytest.fixture(scope="module")
def vulpi(tmp_path_factory, datasets_dir):
    """Return a folder with a run of a measured data set."""
    folder = tmp_path_factory.mktemp("vulpi")
    write_run(load_runs(datasets_dir / "vulpi")[0], folder)
    return folder


@pytest.mark.parametrize("target", [*TARGETS, "csv"])
def test_an_export_is_imported_as_the_same_runs(raw, vulpi, tmp_path, target):
    """Simulated and measured runs, one with its estimates; a CSV file has no more than streams."""
    for source in (vulpi,) if target == "csv" else (raw, vulpi):
        out = tmp_path / "out" / source.name
        before, result = load_runs(source), exported(source, out, target)
        read = {"mapping": out / "mapping.yaml"} if target == "csv" else {"layout": "bag"}
        after = load_runs(out, **read)
        for one, other in zip(before, after, strict=True):
            assert set(one.streams) == set(other.streams)
            for name, stream in one.streams.items():
                again = other.streams[name]
                assert again.time_s.tobytes() == stream.time_s.tobytes()
                for channel in stream.channels:
                    assert again.channel(channel).tobytes() == stream.channel(channel).tobytes()
            if target != "csv":
                assert data_digest([other]) == data_digest([one])
                for name in ("run_id", "robot", "labels", "session", "filter", "source", "dropped"):
                    assert getattr(one, name) == getattr(other, name)
        assert target == "csv" or data_digest(after) == result.digest
    if target == "csv":
        assert result.topics["imu.csv"] == len(one.streams["imu"])


@pytest.mark.slow
def test_other_libraries_read_the_same_numbers(raw, estimated_run, tmp_path):
    run = estimated_run
    for target in TARGETS:
        exported(raw, tmp_path / target, target)
    path = tmp_path / "mcap" / f"{run.run_id}.mcap"
    with path.open("rb") as file:
        by_mcap = decoded(make_reader(file, decoder_factories=[DecoderFactory()]))
    assert {"/imu", "/joint_states", "/odometry", "/cmd_vel", "/terrain/imu", "/terrain/run"} <= set(by_mcap)
    for target in TARGETS[1:]:
        with AnyReader([tmp_path / target / run.run_id]) as reader:
            by_rosbags = [
                (connection.topic, log_ns, reader.deserialize(content, connection.msgtype))
                for connection, log_ns, content in reader.messages()
            ]
        assert [log_ns for _, log_ns, _ in by_rosbags] == sorted(log_ns for _, log_ns, _ in by_rosbags)
        check(run, {topic: [m for name, _, m in by_rosbags if name == topic] for topic in by_mcap})
    check(run, by_mcap)


def decoded(reader):
    found = {}
    for _, channel, message, content in reader.iter_decoded_messages():
        stamp = getattr(content, "header", None)
        if stamp is not None:
            assert message.log_time == stamp.stamp.sec * 10**9 + stamp.stamp.nanosec
        found.setdefault(channel.topic, []).append(content)
    return found


def check(run, messages):
    """Compare a run with the messages that a library decoded."""
    for name, stream in run.streams.items():
        seen = messages[f"/terrain/{name}"]
        assert [each.time_s for each in seen] == stream.time_s.tolist()
        for channel in stream.channels:
            np.testing.assert_array_equal([getattr(m, channel) for m in seen], stream.channel(channel))
    imu, streams = messages["/imu"], run.streams
    quaternions = [[getattr(m.orientation, axis) for axis in "xyzw"] for m in imu]
    driven = [m for m in messages["/joint_states"] if m.name[0] == "motor_1"]
    for seen, sent in (
        ([m.linear_acceleration.z for m in imu], streams["imu"].channel("accel_z_mps2")),
        (Rotation.from_quat(quaternions).as_euler("ZYX")[:, 2], streams["imu"].channel("roll_rad")),
        ([m.velocity[2] for m in driven], streams["wheels"].channel("motor_3_radps")),
        ([m.twist.angular.z for m in messages["/cmd_vel"]], streams["commands"].channel("yaw_rate_radps")),
    ):
        np.testing.assert_allclose(seen, sent, rtol=0.0, atol=1e-12)
    assert messages["/terrain/label"][0].data == run.labels[0].terrain
    assert json.loads(messages["/terrain/run"][0].data)["run_id"] == run.run_id


def test_standard_messages_of_an_export_are_a_run_by_a_mapping_too(estimated_run, tmp_path):
    run = estimated_run
    write_run(run, tmp_path / "runs")
    exported(tmp_path / "runs", tmp_path)
    (tmp_path / "own.yaml").write_text(
        "robot: agrimaro\nstreams:\n  imu: {topic: /imu, kind: imu}\n"
        "  odometry: {topic: /odometry, kind: odometry}\n"
        "  commands: {topic: /cmd_vel, kind: twist}\n  wheels:\n    topic: /joint_states\n    kind: joints\n"
        "    channels: {motor_1_radps: {joint: motor_1, field: velocity}}\n"
    )
    (again,) = load_runs(tmp_path / f"{run.run_id}.mcap", mapping=tmp_path / "own.yaml")
    for name, tolerance in (("imu", 1e-12), ("odometry", 1e-9), ("commands", 0.0)):
        for channel in again.streams[name].channels:
            sent = run.streams[name].channel(channel)
            np.testing.assert_allclose(again.streams[name].channel(channel), sent, atol=tolerance)


def test_recorded_windows_go_with_their_run_out_and_in(make_run, tmp_path):
    of_window = {
        "start_s": 1.0,
        "end_s": 3.0,
        "terrain": "ICE",
        "probabilities": {"ICE": 0.75},
        "doubtful": False,
    }
    windows = [RecordedWindow(**of_window, probability=0.75, refused="")]
    windows += [RecordedWindow(**of_window, probability=None, refused="not finite")]
    place = write_run(make_run("a"), tmp_path / "raw", beside={WINDOWS_FILE: windows_text(windows)})
    for target in TARGETS:
        assert exported(tmp_path / "raw", tmp_path / target, target).topics["/terrain/window"] == 2
        exported(tmp_path / target, tmp_path / f"{target}_again", "runs")
        again = tmp_path / f"{target}_again" / "a" / WINDOWS_FILE
        assert again.read_text() == (place / WINDOWS_FILE).read_text()
    for damage in ('{"version": 1}', '{"windows": [3]}', '{"version": 1, "windows": [{"end_s": "x"}]}'):
        (place / WINDOWS_FILE).write_text(damage)
        with pytest.raises(LogError, match="is damaged"):
            exported(tmp_path / "raw", tmp_path / "other")


@pytest.mark.parametrize("package", ["mcap", "rosbags", "zstandard"])
def test_a_missing_package_is_named_in_one_sentence(make_run, tmp_path, monkeypatch, package):
    write_run(make_run("a"), tmp_path / "raw")
    exported(tmp_path / "raw", tmp_path / "mcap")
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=r"pip install 'terrain-slip\[logs\]'"):
        exported(tmp_path / ("mcap" if package == "zstandard" else "raw"), tmp_path / "out")
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())
