"""Long runs cut into parts: nothing is lost, nothing is there twice, and several runs stay as they are."""

import numpy as np
import pytest

from terrain.logs.cuts import FEW, LONGEST_S, SHORTEST_S, cut_long, cut_note
from terrain.records import Label, RunLog, Stream


def run_of(length_s, name="a", rate_hz=20.0):
    time_s = 3.0 + np.arange(0.0, length_s, 1.0 / rate_hz)
    slow = time_s[::7] + 0.01
    streams = {
        "imu": Stream(time_s, time_s[:, None], ("gyro_z_radps",)),
        "pose": Stream(slow, slow[:, None], ("yaw_rad",)),
    }
    return RunLog(name, "husky", streams, (Label(3.0, 3.0 + length_s / 2, "grass"),), session="friday")


@pytest.mark.parametrize("length_s", [61.0, 200.0, 2000.0])
def test_parts_have_every_sample_once_and_are_no_longer_than_a_minute(length_s):
    run = run_of(length_s)
    parts = cut_long([run])
    for name, stream in run.streams.items():
        common = stream.time_s[(stream.time_s >= run.start_s) & (stream.time_s <= run.end_s)]
        assert np.array_equal(np.concatenate([part.streams[name].time_s for part in parts]), common)
    lengths = [part.end_s - part.start_s for part in parts]
    assert SHORTEST_S - 1.0 < min(lengths) <= max(lengths) < 2 * LONGEST_S
    assert len({part.run_id for part in parts}) == len(parts) > FEW
    assert {part.session for part in parts} == {"friday"}
    assert {part.terrains for part in parts} == {("grass",), ()}


def test_several_or_short_runs_stay_as_they_are():
    several = [run_of(90.0, name) for name in "abc"]
    assert cut_long(several) == several
    assert cut_long([run_of(20.0)])[0].run_id == "a"
    assert cut_note(several, several) == ()


def test_what_was_cut_is_stated():
    runs = [run_of(70.0)]
    (sentence,) = cut_note(runs, cut_long(runs))
    assert "1 long run cut into 11 parts of about 6 s" in sentence
