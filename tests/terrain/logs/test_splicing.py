from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from terrain.errors import DataError
from terrain.logs.splicing import Part, order_stretches, splice_runs, stretches_of
from terrain.records import RunLog, Stream

CHANNELS = {"imu": ("gyro_z_radps",), "wheels": ("speed_left_mps",)}


def run_of(name, value, imu_hz=100.0, wheels_hz=6.5, duration_s=40.0):
    def stream(rate_hz, channel):
        time_s = 0.01 * value + np.arange(int(duration_s * rate_hz)) / rate_hz
        return Stream(time_s, np.full((len(time_s), 1), value), (channel,))

    return RunLog(
        name, "husky", {"imu": stream(imu_hz, "gyro_z_radps"), "wheels": stream(wheels_hz, "speed_left_mps")}
    )


def test_a_splice_keeps_every_stream_at_its_rate_and_every_sample_on_its_ground():
    rng = np.random.default_rng(0)
    runs = [run_of("a", 1.0), run_of("b", 2.0, imu_hz=100.4, wheels_hz=6.4)]
    for _ in range(50):
        begins_s = rng.uniform(1.0, 15.0, 6)
        parts = [
            Part(runs[i % 2], begin_s, begin_s + rng.uniform(3.0, 20.0), f"ground {i % 2}")
            for i, begin_s in enumerate(begins_s)
        ]
        course = splice_runs(parts, CHANNELS, "course")
        assert [label.terrain for label in course.labels] == [part.terrain for part in parts]
        lengths_s = [label.end_s - label.start_s for label in course.labels]
        np.testing.assert_allclose(lengths_s, [part.end_s - part.start_s for part in parts])
        for stream, rate_hz in ((course.streams["imu"], 100.0), (course.streams["wheels"], 6.5)):
            periods = np.diff(stream.time_s) * rate_hz
            assert periods.min() > 0.45
            assert periods.max() < 1.6
            for i, label in enumerate(course.labels):
                inside = (stream.time_s >= label.start_s) & (stream.time_s < label.end_s)
                assert np.mean(stream.values[inside, 0] == 1.0 + i % 2) > 0.9
            at_splice = np.searchsorted(stream.time_s, [label.start_s for label in course.labels[1:]])
            changes = np.flatnonzero(np.diff(stream.values[:, 0]))
            assert np.abs(changes - at_splice).max() <= 2


def test_a_splice_of_one_run_with_itself_is_that_run():
    run = run_of("a", 1.0)
    parts = [Part(run, 1.01, 11.01, "grass"), Part(run, 11.01, 21.01, "grass")]
    course = splice_runs(parts, CHANNELS, "course")
    for name, stream in course.streams.items():
        original = run.streams[name].time_s
        kept = original[(original >= 1.01 - 1e-6) & (original < 21.01 - 1e-6)] - 1.01
        np.testing.assert_allclose(stream.time_s, kept, atol=1e-9)


def test_nothing_to_splice_is_refused():
    with pytest.raises(DataError, match="no part to splice"):
        splice_runs([], CHANNELS, "course")
    with pytest.raises(DataError, match="run a: no sample of stream 'imu' from 50 to 60 s"):
        splice_runs([Part(run_of("a", 1.0), 50.0, 60.0, "grass")], CHANNELS, "course")


def test_stretches_of_a_run_are_cut_without_remainder_or_overlap():
    rng = np.random.default_rng(0)
    for _ in range(200):
        part = Part(None, 3.0, 3.0 + rng.uniform(5.0, 120.0), "grass")
        found = stretches_of(part, rng)
        lengths_s = [each.end_s - each.start_s for each in found]
        if part.end_s - part.start_s < 10.0:
            assert found == []
            continue
        assert min(lengths_s) >= 10.0 - 1e-9
        assert max(lengths_s) <= 30.0 + 1e-9
        assert found[0].start_s == 3.0
        assert found[-1].end_s == pytest.approx(part.end_s)
        assert all(a.end_s == b.start_s for a, b in pairwise(found))


def test_grounds_of_a_sequence_alternate_and_as_few_as_possible_are_left_out():
    rng = np.random.default_rng(1)
    for _ in range(200):
        terrains = rng.choice(["ice", "snow", "grass"], rng.integers(2, 20), p=[0.5, 0.3, 0.2])
        found = order_stretches([Part(None, 0.0, 1.0, str(name)) for name in terrains], rng)
        names = [each.terrain for each in found]
        assert all(a != b for a, b in pairwise(names))
        most = max(Counter(terrains.tolist()).values())
        assert len(names) >= min(len(terrains), 2 * (len(terrains) - most) + 1)
