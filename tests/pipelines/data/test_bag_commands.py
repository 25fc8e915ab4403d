"""Commands that take runs take bags: replay of a file, of a folder, without an attitude or a confidence."""

import json
import sys

import numpy as np
import pytest

from pipelines.data.convert import Settings
from pipelines.data.convert import run as convert
from pipelines.data.datasets import load_runs
from pipelines.data.recorded_windows import WINDOWS_FILE, read_windows, windows_text
from pipelines.serve.replay import run as replay_log
from pipelines.serve.settings import Settings as ServeSettings
from terrain.errors import ConfigError, LogError
from terrain.logs.write import write_run
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

from .foreign_bags import START_NS, husky_rows, text, write_bag, write_mcap

TOPICS = """\
robot: agrimaro
streams:
  imu: {topic: /imu, kind: imu}
  odometry: {topic: /odometry, kind: odometry}
  commands: {topic: /cmd_vel, kind: twist}
  wheels:
    topic: /joint_states
    kind: joints
    channels:
      motor_1_radps: {joint: motor_1, field: velocity}
      motor_2_radps: {joint: motor_2, field: velocity}
      motor_3_radps: {joint: motor_3, field: velocity}
      current_1_a: {joint: motor_1, field: velocity, unit: A}
      current_2_a: {joint: motor_2, field: velocity, unit: A}
      current_3_a: {joint: motor_3, field: velocity, unit: A}
  steering:
    topic: /joint_states
    kind: joints
    channels:
      angle_1_rad: {joint: angle_1, field: position}
      angle_2_rad: {joint: angle_2, field: position}
      angle_3_rad: {joint: angle_3, field: position}
"""


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    """Return a folder with a simulated run, and one with its export."""
    folder = tmp_path_factory.mktemp("raw")
    run = simulate_run(load_robot("agrimaro"), "grass", "starts", 7, duration_s=8.0)
    write_run(run, folder / "raw")
    convert(Settings(data=folder / "raw", out=folder / "mcap", to="mcap"))
    return folder, run.run_id


def replayed(place, **options):
    return replay_log(ServeSettings(**options), place)


def test_a_file_is_replayed_as_its_run(raw):
    folder, run_id = raw
    (by_file,) = replayed(folder / "mcap" / f"{run_id}.mcap").runs
    (by_folder,) = replayed(folder / "raw").runs
    assert (by_file.run_id, by_file.chain) == (run_id, "pilot")
    assert by_file.n_steps == by_folder.n_steps
    assert by_file.dropped == by_folder.dropped


def test_a_swerve_robots_standard_messages_are_replayed_by_the_pilot(raw, tmp_path):
    folder, run_id = raw
    (tmp_path / "topics.yaml").write_text(TOPICS)
    path = folder / "mcap" / f"{run_id}.mcap"
    (run,) = replayed(path, mapping=tmp_path / "topics.yaml").runs
    assert run.chain == "pilot"
    assert run.n_steps > 250
    (read,) = load_runs(path, mapping=tmp_path / "topics.yaml")
    assert "confidence_ratio" not in read.streams["odometry"].channels
    assert len(read.streams["steering"]) == len(read.streams["wheels"])


def test_a_bags_folder_is_the_same_run_as_its_file(tmp_path):
    rows = husky_rows(80)
    runs = []
    for storage in ("sqlite3", "mcap"):
        bag = write_bag(tmp_path / storage, rows, storage)
        runs += load_runs(bag, layout="bag", mapping="husky_topics")
        (single,) = (path for path in bag.iterdir() if path.suffix != ".yaml")
        runs += load_runs(single, mapping="husky_topics")
    assert [run.run_id for run in runs] == ["sqlite3", "sqlite3", "mcap", "mcap"]
    contents = {tuple(stream.values.tobytes() for stream in run.streams.values()) for run in runs}
    assert len(contents) == 1


def test_recorded_windows_are_exported(tmp_path, raw):
    folder, run_id = raw
    (run,) = load_runs(folder / "raw")
    entries = [
        {"start_s": 1.0, "end_s": 3.0, "terrain": "ICE", "probability": 0.75, "probabilities": {"ICE": 0.75},
         "doubtful": False, "refused": ""},
        {"start_s": 2.0, "end_s": 4.5, "terrain": "", "probability": None, "probabilities": {},
         "doubtful": True, "refused": "not finite"},
    ]  # fmt: skip
    place = write_run(run, tmp_path / "raw", beside={WINDOWS_FILE: windows_text(entries)})
    assert len(read_windows(place)) == 2
    result = convert(Settings(data=tmp_path / "raw", out=tmp_path / "out", to="mcap"))
    assert result.topics["/terrain/window"] == 2
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with (tmp_path / "out" / f"{run_id}.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        seen = [
            (message.log_time, json.loads(content.data))
            for _, _, message, content in reader.iter_decoded_messages(topics=["/terrain/window"])
        ]
        assert [(each.name, each.metadata["run_id"]) for each in reader.iter_metadata()] == [
            ("terrain_run", run_id)
        ]
    assert seen == [(3_000_000_000, entries[0]), (4_500_000_000, entries[1])]
    for damage in ('{"version": 1}', '{"windows": [3]}', '{"windows": [{"end_s": "x"}]}'):
        (place / WINDOWS_FILE).write_text(damage)
        with pytest.raises(LogError, match="is damaged"):
            convert(Settings(data=tmp_path / "raw", out=tmp_path / "other", to="mcap"))


@pytest.mark.parametrize("package", ["mcap", "rosbags", "zstandard"])
def test_a_missing_package_is_named_in_one_sentence(raw, tmp_path, monkeypatch, package):
    folder, run_id = raw
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    source = folder / "mcap" / f"{run_id}.mcap" if package == "zstandard" else folder / "raw"
    with pytest.raises(ConfigError, match=r"pip install 'terrain-slip\[logs\]'"):
        convert(Settings(data=source, out=tmp_path / "out", to="mcap"))
    assert not list(tmp_path.rglob("*.mcap"))


def test_other_layouts_come_first_and_bags_beside_them_are_passed_over(raw, tmp_path):
    folder, run_id = raw
    (run,) = load_runs(folder / "raw")
    write_run(run, tmp_path)
    write_mcap(tmp_path / "notes" / "notes.mcap", [("/name", START_NS, text("a"))])
    (found,) = load_runs(tmp_path)
    assert found.run_id == run_id
    np.testing.assert_array_equal(found.streams["imu"].values, run.streams["imu"].values)


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ("rosbag2_bagfile_information: 3", "does not list the files"),
        ("rosbag2_bagfile_information: {relative_file_paths: [3]}", "does not list the files"),
        ("rosbag2_bagfile_information: {relative_file_paths: []}", "are required"),
        ("rosbag2_bagfile_information: {relative_file_paths: [metadata.yaml]}", "are required"),
        ("rosbag2_bagfile_information: {relative_file_paths: [a.mcap]}", "is missing"),
        ("rosbag2_bagfile_information: [", "is no YAML"),
    ],
)
def test_a_damaged_description_of_a_bag_is_one_sentence(tmp_path, content, fault):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text(content)
    with pytest.raises((LogError, ConfigError), match=fault) as raised:
        load_runs(tmp_path, layout="bag", robot="husky")
    assert "\n" not in str(raised.value)
