"""Hidden copies come back, and no two measured runs are taken for copies."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.errors import DataError
from terrain.logs.duplicates import merge_runs, possible_pairs, run_print, shared_stretches
from terrain.records import Label, RunLog, Stream


@pytest.fixture(scope="module")
def runs():
    """Eight runs of two terrains, all noise."""
    rng = np.random.default_rng(0)
    return [
        noise_run(f"{terrain}_{number}", terrain, rng)
        for terrain in ("ASPHALT", "GRASS")
        for number in range(1, 5)
    ]


def noise_run(run_id, terrain, rng, duration_s=24.0):
    streams = {}
    for name, rate_hz, channels in (
        ("imu", 50.0, ("gyro_x_radps", "gyro_z_radps", "accel_x_mps2", "accel_z_mps2")),
        ("wheels", 10.0, ("speed_left_mps", "speed_right_mps", "current_left_a")),
    ):
        n = round(duration_s * rate_hz)
        streams[name] = Stream(np.arange(n) / rate_hz, rng.standard_normal((n, len(channels))), channels)
    return RunLog(run_id, "husky", streams, (Label(0.0, duration_s, terrain),))


def changed(run, change, run_id="copy"):
    """Return the run under another name, its streams changed."""
    return replace(run, run_id=run_id, streams={name: change(each) for name, each in run.streams.items()})


def cut(run, start_s, end_s, run_id="piece"):
    def inside(stream):
        rows = (stream.time_s >= start_s) & (stream.time_s < end_s)
        return Stream(stream.time_s[rows] - start_s, stream.values[rows], stream.channels)

    labels = tuple(Label(0.0, end_s - start_s, name) for name in run.terrains)
    return replace(changed(run, inside, run_id), labels=labels)


def resampled(stream, ratio, phase):
    time_s = np.arange(stream.time_s[0] + phase / stream.rate_hz, stream.time_s[-1], ratio / stream.rate_hz)
    values = [np.interp(time_s, stream.time_s, column) for column in stream.values.T]
    return Stream(time_s, np.column_stack(values), stream.channels)


CHANGES = {
    "name alone": lambda each: each,
    "clock offset": lambda each: Stream(each.time_s + 1e6, each.values, each.channels),
    "clock 3 % faster": lambda each: Stream(each.time_s * 1.03, each.values, each.channels),
    "float32": lambda each: Stream(each.time_s, each.values.astype(np.float32), each.channels),
    "two decimals": lambda each: Stream(each.time_s.round(3), each.values.round(2), each.channels),
    "other units and zero": lambda each: Stream(each.time_s, 57.3 * each.values + 4.0, each.channels),
    "channels exchanged": lambda each: Stream(each.time_s, each.values, each.channels[::-1]),
    "half a sample later": lambda each: resampled(each, 1.0, 0.5),
    "other rate": lambda each: resampled(each, 0.97, 0.3),
    "one channel lost": lambda each: Stream(each.time_s, each.values[:, 1:], each.channels[1:]),
    "one channel mirrored": lambda each: Stream(
        each.time_s, each.values * np.where(np.arange(each.values.shape[1]) == 1, -1.0, 1.0), each.channels
    ),
}


def pairs_by_prints(runs):
    return possible_pairs([run_print(run) for run in runs])


@pytest.mark.parametrize("kind", CHANGES)
def test_a_copy_is_found_whatever_was_done_to_it_and_by_the_prints_of_runs_alone(runs, kind):
    hidden = changed(runs[5], CHANGES[kind])
    (found,) = shared_stretches([*runs, hidden])
    assert (found.first, found.second) == (runs[5].run_id, "copy")
    assert found.duration_s == pytest.approx(24.0, abs=1.0)
    assert pairs_by_prints([*runs, hidden, cut(runs[2], 6.0, 12.0)]) == [(2, 9), (5, 8)]


def test_short_runs_of_the_same_samples_are_found_by_their_bytes_and_missing_channels_have_none(runs):
    short = [cut(runs[0], 0.0, 2.0, name) for name in "ab"]
    assert len(run_print(short[0]).codes) < 6
    assert pairs_by_prints([*short, runs[1]]) == [(0, 1)]
    (found,) = shared_stretches(short)
    assert (found.first, found.second) == ("a", "b")
    assert pairs_by_prints(runs) == []
    still, lost = (
        changed(runs[0], lambda each, value=value: Stream(each.time_s, each.values * value, each.channels))
        for value in (0.0, np.nan)
    )
    assert pairs_by_prints([still, still, lost, lost]) == pairs_by_prints([]) == []


@pytest.mark.parametrize("length_s", [6.0, 10.0, 18.0])
def test_a_piece_is_found_where_it_was_cut(runs, length_s):
    for seed in range(2):
        start_s = np.random.default_rng(seed).uniform(0.0, 24.0 - length_s)
        (found,) = shared_stretches([*runs, cut(runs[3], start_s, start_s + length_s)])
        assert found.first == runs[3].run_id
        assert found.first_start_s - found.second_start_s == pytest.approx(start_s, abs=0.05)
        assert found.duration_s == pytest.approx(length_s, abs=1.5)


def test_runs_that_stand_or_repeat_themselves_are_no_copies():
    time_s = np.arange(3000) / 50.0
    rng = np.random.default_rng(0)
    signals = {
        "constant": lambda: np.full(3000, 9.81),
        "zero": lambda: np.zeros(3000),
        "last digit": lambda: 9.81 + 0.01 * (rng.random(3000) < 0.3),
        "sine": lambda: np.sin(40.0 * time_s + rng.random()),
        "ramp": lambda: time_s + rng.random(),
        "square": lambda: np.sign(np.sin(3.0 * time_s)),
        "missing": lambda: np.full(3000, np.nan),
        "denormal": lambda: 1e-310 * rng.random(3000),
        "huge": lambda: 1e300 * rng.random(3000),
        "one impulse": lambda: 1e9 * (np.arange(3000) == 7) + 1e-9 * rng.random(3000),
    }
    runs = [
        RunLog(f"{name} {i}", "husky", {"imu": Stream(time_s, make()[:, None], ("accel_z_mps2",))})
        for name, make in signals.items()
        for i in range(3)
    ]
    assert shared_stretches(runs) == ()
    assert shared_stretches([]) == ()


def test_no_two_measured_runs_are_copies_and_copies_among_them_are_found(measured_runs):
    for name in ("borealtc", "vulpi", "drive_husky"):
        assert shared_stretches(measured_runs(name)) == (), name
    runs = measured_runs("vulpi")
    coarse = [
        changed(run, lambda each: replace(each, values=each.values.round(1)), run.run_id) for run in runs
    ]
    assert shared_stretches(coarse) == ()
    copies = [changed(run, CHANGES["two decimals"], f"copy of {run.run_id}") for run in runs]
    found = {(each.first, each.second) for each in shared_stretches([*runs, *copies])}
    assert found == {(run.run_id, f"copy of {run.run_id}") for run in runs}


def test_merged_runs_hold_each_stretch_once(runs):
    early, late = cut(runs[0], 0.0, 14.0, "early"), cut(runs[0], 6.0, 24.0, "late")
    data = [early, late, *runs[1:]]
    merged = merge_runs(data, shared_stretches(data))
    assert [run.run_id for run in merged] == ["early", *(run.run_id for run in runs[1:])]
    imu = merged[0].streams["imu"]
    assert len(imu) == pytest.approx(24 * 50, abs=50)
    assert (np.diff(imu.time_s) > 0).all()
    assert merged[0].terrains == runs[0].terrains
    assert shared_stretches(merged) == ()
    known = {row.tobytes() for row in runs[0].streams["imu"].values}
    assert all(row.tobytes() in known for row in imu.values)


def test_a_copy_without_a_label_takes_none_away_and_one_with_another_is_named(runs):
    bare = replace(changed(runs[0], CHANGES["name alone"], "A bare copy"), labels=())
    for data in ([bare, *runs], [*runs, bare]):
        merged = merge_runs(data, shared_stretches(data))
        assert sorted(run.run_id for run in merged) == sorted(run.run_id for run in runs)
    data = [*runs, replace(bare, run_id="copy", labels=(Label(0.0, 24.0, "LAVA"),))]
    with pytest.raises(DataError, match=r"ASPHALT_1 and copy hold the same .* labels ASPHALT and LAVA"):
        merge_runs(data, shared_stretches(data))
