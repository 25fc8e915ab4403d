"""What each protocol holds out is on one side of a split, and every window is tested once a repeat."""

from dataclasses import replace
from zlib import crc32

import numpy as np
import pytest

from features.protocols import PARTITION_S, PUBLISHED_STRIDE_S, folds_of, samples_of
from features.windows import WindowRule
from terrain.classify.folds import N_FOLDS
from terrain.errors import DataError
from terrain.records import Label, RunLog, Stream


def samples_under(protocol, runs, stride_s=None):
    return samples_of(runs, WindowRule(1.7 if protocol == "published" else 2.0, stride_s), protocol=protocol)


def commanded(run_id, terrain, speed_mps=0.5, session="", length_s=12.0, start_s=0.0):
    """Return a run at one commanded speed, with wheels that follow it."""
    time_s = start_s + np.arange(0.0, length_s, 0.1)
    speeds = speed_mps + 0.01 * np.random.default_rng(crc32(run_id.encode())).normal(size=(time_s.size, 2))
    streams = {
        "wheels": Stream(time_s, speeds, ("speed_left_mps", "speed_right_mps")),
        "commands": Stream(time_s, np.full((time_s.size, 1), speed_mps), ("speed_x_mps",)),
    }
    return RunLog(run_id, "husky", streams, (Label(start_s, start_s + length_s, terrain),), session=session)


SPEEDS = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2)
RUNS = [
    *(commanded(f"ICE_{i}", "ICE", v, f"session {i % 3}", 12.0 + 4.0 * i) for i, v in enumerate(SPEEDS)),
    *(commanded(f"SAND_{i}", "SAND", v, "alone", 14.0 + 6.0 * i) for i, v in enumerate(SPEEDS[:5])),
    commanded("MUD", "MUD", 1.4, session="other", length_s=50.0),
]
"""Six runs in three sessions, five in one session, a single run; of unequal length."""


def session_or_run(run):
    return run.run_id if run.session == "alone" else run.session


UNIT = {
    "grouped": session_or_run,
    "grouped-by-run": lambda run: run.run_id,
    "leave-terrain-out": session_or_run,
    "leave-one-run-out": lambda run: run.run_id,
    "leave-sessions-out": session_or_run,
    "leave-regimes-out": lambda run: str(run.streams["commands"].values[0, 0]),
}
"""What a protocol holds out together; of a terrain with one session, its runs."""
N_SINGLE = {"leave-one-run-out": 11 + N_FOLDS, "leave-sessions-out": 3 + N_FOLDS + N_FOLDS}
"""Folds of a protocol with one assignment: a single run and a single session are cut into blocks."""


@pytest.mark.parametrize(
    ("protocol", "stride_s"), [*((protocol, 0.5) for protocol in UNIT), ("grouped", None)]
)
def test_what_is_held_out_is_whole_and_every_window_is_tested_once_a_repeat(protocol, stride_s):
    samples = samples_under(protocol, RUNS, stride_s=stride_s)
    windows, of_run = samples.windows, {run.run_id: UNIT[protocol](run) for run in RUNS}
    unit = np.array([of_run[name] for name in windows.run_id])
    n_repeats = 1 if protocol in N_SINGLE else 2
    folds = folds_of(samples, protocol, n_repeats, seed=5)
    n_folds = N_SINGLE.get(protocol, N_FOLDS)
    assert [(fold.repeat, fold.number) for fold in folds] == [*np.ndindex(n_repeats, n_folds)]
    for repeat in range(n_repeats):
        tested = np.concatenate([fold.test for fold in folds if fold.repeat == repeat])
        np.testing.assert_array_equal(np.sort(tested), np.arange(len(windows)))
    for fold in folds:
        assert not set(fold.train) & set(fold.test)
        assert set(unit[fold.train]) & set(unit[fold.test]) <= {of_run["MUD"]}
        assert set(windows.terrain[fold.train]) == {"ICE", "SAND", "MUD"}
        # Of the run that had to be cut, no sample is on both sides, nor does one side touch the other.
        single = windows.terrain == "MUD"
        train, test = (windows.start_s[rows[single[rows]]] for rows in (fold.train, fold.test))
        assert np.abs(train[:, None] - test).min(initial=np.inf) > windows.length_s


def test_few_sessions_are_held_out_one_at_a_time_whatever_the_seed():
    runs = [
        commanded(f"{name}_{i}", name, v, f"{name} {i // 2}")
        for name in ("ICE", "MUD")
        for i, v in enumerate(SPEEDS)
    ]
    samples = samples_under("grouped", runs)
    assert len(folds_of(samples, "grouped", 5, 0)) == len(folds_of(samples, "leave-sessions-out", 1, 1)) == 6
    assert set(samples.unit) == {f"{name} {i}" for name in ("ICE", "MUD") for i in range(3)}
    of_one = samples_under("grouped", [replace(run, session="today") for run in runs])
    assert set(of_one.unit) == {run.run_id for run in runs}


def test_folds_repeat_with_their_seed_and_earlier_repeats_stay():
    samples = samples_under("grouped", RUNS)
    one, three = folds_of(samples, "grouped", 1, 5), folds_of(samples, "grouped", 3, 5)
    other = folds_of(samples, "grouped", 1, 6)
    for fold, same in zip(one, three[:N_FOLDS], strict=True):
        np.testing.assert_array_equal(fold.test, same.test)
        np.testing.assert_array_equal(fold.train, same.train)
    deals = [tuple(fold.test.tobytes() for fold in each) for each in (one, three[5:10], three[10:], other)]
    assert len(set(deals)) == 4


def test_published_windows_lie_inside_partitions_and_classes_are_balanced_by_stride():
    plan = {"ASPHALT": (42.0, 31.0, 24.9), "GRASS": (29.0, 30.0), "GRAVEL": (26.0,)}
    runs = [
        commanded(f"{terrain}_{i}", terrain, length_s=length_s, start_s=7.3 * i)
        for terrain, lengths_s in plan.items()
        for i, length_s in enumerate(lengths_s)
    ]
    samples = samples_under("published", runs)
    windows, group = samples.windows, samples.group
    begin_s = {run.run_id: run.start_s for run in runs}
    offset = windows.start_s - np.array([begin_s[run] for run in windows.run_id])
    part, end = (
        np.floor((offset + inside) / PARTITION_S).astype(int) for inside in (1e-6, windows.length_s - 1e-6)
    )
    np.testing.assert_array_equal(part, end, "a window straddles two partitions")
    assert group.tolist() == [f"{run} part {i}" for run, i in zip(windows.run_id, part, strict=True)]
    n_parts = {"ASPHALT": 8 + 6 + 4, "GRASS": 5 + 6, "GRAVEL": 5}
    folds = folds_of(samples, "published", 2, seed=1)
    for terrain, n in n_parts.items():
        of = windows.terrain == terrain
        assert len(set(group[of])) == n
        step_s = np.diff(windows.start_s[of])[group[of][1:] == group[of][:-1]]
        assert step_s == pytest.approx(PUBLISHED_STRIDE_S * n / min(n_parts.values()))
        for fold in folds:
            tested = len(set(group[fold.test][windows.terrain[fold.test] == terrain]))
            assert tested in (n // N_FOLDS, -(-n // N_FOLDS))
    counts = np.unique(windows.terrain.astype(str), return_counts=True)[1]
    assert max(counts) / min(counts) < 1.1  # the partitions alone are 18, 11 and 5
    assert not any(set(group[fold.train]) & set(group[fold.test]) for fold in folds)
    assert not np.array_equal(folds[0].test, folds[N_FOLDS].test)


def test_what_cannot_be_split_is_refused(drive, drive_all):
    unlabelled = [drive(f"r{i}", "GRASS", i, label=None) for i in range(6)]
    one_class, unnamed = drive_all(("GRASS",), 6, duration_s=12.0), drive_all(n_runs=2, duration_s=12.0)
    short = [drive("r", "GRASS", 0, duration_s=1.5)]
    few = drive_all(n_runs=2, duration_s=11.0)
    for protocol, runs, sentence in (
        ("grouped", one_class, "all windows are 'GRASS': a classifier needs at least two classes"),
        ("published", one_class, "all windows are 'GRASS'"),
        ("grouped", drive_all(("GRASS", "GRAVEL"), 2, duration_s=12.0), "4 runs are fewer than 5 folds"),
        ("grouped", unlabelled, "no window has a terrain label"),
        ("published", unlabelled, "no partition of 5 s lies under one label"),
        ("published", few, r"fewer than 5 partitions of 5 s: ASPHALT \(4\), GRASS \(4\), GRAVEL \(4\)"),
        ("grouped", short, r"run r lasts 1\.50 s, shorter than a window of 2 s"),
        ("leave-sessions-out", unnamed, "no terrain has several sessions"),
        ("slow-fast", unnamed, r"^slow and fast runs are compared on 3 terrains .*GRASS: slow"),
    ):
        with pytest.raises(DataError, match=sentence):
            folds_of(samples_under(protocol, runs), protocol, 1, 0)
