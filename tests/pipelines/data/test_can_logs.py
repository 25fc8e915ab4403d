"""Logs of a bus become the runs whose frames they hold; damaged ones are refused, or repaired and counted."""

import can
import numpy as np
import pytest

from pipelines.data.can_codec import encode, load_layout, run_frames
from pipelines.data.can_logs import READERS
from pipelines.data.datasets import load_runs
from terrain.errors import ConfigError, LogError
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

LAYOUT = load_layout()


@pytest.fixture(scope="module")
def run():
    return simulate_run(load_robot("agrimaro"), "grass", "starts", 7, duration_s=8.0)


def write(path, frames, start_s=1.7e9):
    """Write frames as a log, with frames of other devices between them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with can.Logger(path) as log:
        for number, frame in enumerate(frames):
            message = {"timestamp": start_s + frame.time_s, "is_extended_id": False}
            log(can.Message(arbitration_id=frame.arbitration_id, data=frame.data, **message))
            if number % 100 == 0:
                log(can.Message(arbitration_id=0x7F0, data=b"other", **message))


@pytest.mark.parametrize("suffix", [suffix for suffix in READERS if suffix != ".trc"])
def test_a_log_is_the_run_that_was_sent(tmp_path, run, suffix):
    write(tmp_path / "GRASS" / f"one{suffix}", run_frames(LAYOUT, run))
    (found,) = load_runs(tmp_path, layout="can")
    assert (found.run_id, found.robot, found.terrains) == ("GRASS_one", "agrimaro", ("GRASS",))
    assert set(found.streams) == {"wheels", "steering", "imu", "odometry", "commands"}
    assert set(found.dropped) == {"unknown id"}
    for name in ("wheels", "steering", "imu", "odometry"):
        sent, read = run.streams[name], found.streams[name]
        np.testing.assert_allclose(read.time_s, sent.time_s, atol=2e-4)
        for channel in sent.channels:
            if channel != "confidence_ratio":
                plan = next(
                    (s.scale for p in LAYOUT.by_stream[name] for s in p.signals
                     if read.channels[s.column] == channel), 1e-5)  # fmt: skip
                np.testing.assert_allclose(read.channel(channel), sent.channel(channel), atol=plan)


def test_lost_and_damaged_frames_are_refused_or_counted(tmp_path, run):
    frames = list(run_frames(LAYOUT, run))
    imu = [place for place, frame in enumerate(frames) if frame.arbitration_id == 0x141]
    twist = [place for place, frame in enumerate(frames) if frame.arbitration_id == 0x110]
    frames[twist[9]] = frames[twist[9]]._replace(data=bytes(8))
    del frames[imu[20]]
    write(tmp_path / "drive.log", frames)
    with pytest.raises(LogError, match=r"drive\.log.*--repair"):
        load_runs(tmp_path, layout="can")
    (found,) = load_runs(tmp_path, layout="can", repair=True)
    assert dict(found.dropped) == {"unknown id": 105, "wrong checksum": 1, "imu: part missing": 1}
    assert np.isnan(found.streams["imu"].channel("accel_x_mps2")).sum() == 1
    assert not found.labels


def test_a_log_without_the_messages_or_of_another_kind_is_one_sentence(tmp_path):
    (tmp_path / "a").mkdir()
    write(tmp_path / "a" / "other.asc", encode(LAYOUT, "corrections", [0.0] * 3, 0))
    with pytest.raises(LogError, match="no frame of the messages"):
        load_runs(tmp_path / "a", layout="can")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "text.blf").write_bytes(b"no log at all" * 50)
    with pytest.raises(LogError, match="is no log of a CAN bus") as raised:
        load_runs(tmp_path / "b", layout="can")
    assert "\n" not in str(raised.value)
    (tmp_path / "c").mkdir()
    with pytest.raises(LogError, match="holds no run"):
        load_runs(tmp_path / "c", layout="can")
    with pytest.raises(ConfigError, match="is no DBC"):
        load_runs(tmp_path / "a", layout="can", mapping=tmp_path / "a" / "other.asc")
