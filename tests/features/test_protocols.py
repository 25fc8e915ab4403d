import numpy as np
import pytest

from features.labelled import PARTITION_S, PUBLISHED_STRIDE_S
from features.protocols import N_FOLDS, folds_of, samples_of
from features.windows import WindowRule
from terrain.errors import DataError
from terrain.logs.regimes import driven_at
from terrain.records import Label, RunLog, Stream


def samples_under(protocol, runs, stride_s=None):
    return samples_of(runs, WindowRule(1.7 if protocol == "published" else 2.0, stride_s), protocol=protocol)


@pytest.fixture
def uneven_runs(drive):
    """Runs of unequal length: six on asphalt, four on grass, a single one on gravel."""
    plan = [("ASPHALT", 12 + 4 * i) for i in range(6)] + [("GRASS", 14 + 6 * i) for i in range(4)]
    runs = [drive(f"{t}_{i:02d}", t, i, duration_s=d) for i, (t, d) in enumerate(plan)]
    return [*runs, drive("GRAVEL_99", "GRAVEL", 99, duration_s=50.0)]


def assert_each_tested_once(folds, n, repeats):
    for repeat in range(repeats):
        tested = np.concatenate([fold.test for fold in folds if fold.repeat == repeat])
        np.testing.assert_array_equal(np.sort(tested), np.arange(n))


def nearest_other_side_s(windows, fold, terrain):
    """Return the least distance in s from a test window of a terrain to a training window of it."""
    train, test = (
        windows.start_s[rows][windows.terrain[rows] == terrain] for rows in (fold.train, fold.test)
    )
    return np.abs(train[:, None] - test).min() if len(train) and len(test) else np.inf


@pytest.mark.parametrize("stride_s", [None, 0.5])
def test_grouped_keeps_runs_whole_and_tests_every_window_once_a_repeat(uneven_runs, stride_s):
    samples = samples_under("grouped", uneven_runs, stride_s=stride_s)
    windows = samples.windows
    folds = folds_of(samples, "grouped", 3, seed=5)
    assert [(fold.repeat, fold.number) for fold in folds] == [
        (r, k) for r in range(3) for k in range(N_FOLDS)
    ]
    assert_each_tested_once(folds, len(windows), 3)
    for fold in folds:
        assert set(windows.run_id[fold.train]) & set(windows.run_id[fold.test]) <= {"GRAVEL_99"}
        assert set(windows.terrain[fold.train]) == {"ASPHALT", "GRASS", "GRAVEL"}
        n_runs = {
            t: len({r for r in windows.run_id[fold.test] if r.startswith(t)}) for t in ("ASPHALT", "GRASS")
        }
        assert n_runs["ASPHALT"] in (1, 2)
        assert n_runs["GRASS"] in (0, 1)
        # Of the run that had to be cut, no sample is on both sides, nor does one side touch the other.
        assert nearest_other_side_s(windows, fold, "GRAVEL") > windows.length_s
    deals = {
        tuple(tuple(sorted(set(windows.run_id[f.test]))) for f in folds if f.repeat == r) for r in range(3)
    }
    assert len(deals) == 3


def test_folds_repeat_with_their_seed_and_earlier_repeats_stay(uneven_runs):
    samples = samples_under("grouped", uneven_runs)
    one, three = folds_of(samples, "grouped", 1, 5), folds_of(samples, "grouped", 3, 5)
    other = folds_of(samples, "grouped", 1, 6)
    for fold, same in zip(one, three[:N_FOLDS], strict=True):
        np.testing.assert_array_equal(fold.test, same.test)
        np.testing.assert_array_equal(fold.train, same.train)
    assert any(not np.array_equal(a.test, b.test) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("stride_s", [None, 0.5])
def test_leave_one_run_out_holds_out_each_run_and_cuts_a_single_one_into_blocks(uneven_runs, stride_s):
    samples = samples_under("grouped", uneven_runs, stride_s=stride_s)
    windows = samples.windows
    folds = folds_of(samples, "leave-one-run-out", 7, seed=0)
    assert_each_tested_once(folds, len(windows), 1)
    held_out = [set(windows.run_id[fold.test]) for fold in folds]
    assert all(len(runs) == 1 for runs in held_out)
    assert len(folds) == 10 + N_FOLDS
    for fold in folds:
        (run,) = set(windows.run_id[fold.test])
        if run == "GRAVEL_99":
            rows = np.flatnonzero(windows.run_id == run)
            assert (np.diff(np.searchsorted(rows, fold.test)) == 1).all()
            assert nearest_other_side_s(windows, fold, "GRAVEL") > windows.length_s
        else:
            np.testing.assert_array_equal(fold.test, np.flatnonzero(windows.run_id == run))
            np.testing.assert_array_equal(fold.train, np.setdiff1d(np.arange(len(windows)), fold.test))


def test_published_windows_lie_inside_partitions_and_classes_are_balanced_by_stride(drive):
    plan = {"ASPHALT": (42.0, 31.0, 24.9), "GRASS": (29.0, 30.0), "GRAVEL": (26.0,)}
    runs = [
        drive(f"{terrain}_{i}", terrain, 10 * i + len(terrain), duration_s=duration_s, start_s=7.3 * i)
        for terrain, durations in plan.items()
        for i, duration_s in enumerate(durations)
    ]
    samples = samples_under("published", runs)
    windows, group = samples.windows, samples.group
    begin_s = {run.run_id: run.start_s for run in runs}
    n_parts = {t: sum(int(d // PARTITION_S) for d in durations) for t, durations in plan.items()}
    offset = windows.start_s - np.array([begin_s[run] for run in windows.run_id])
    part = np.floor((offset + 1e-6) / PARTITION_S).astype(int)
    np.testing.assert_array_equal(
        part, np.floor((offset + windows.length_s - 1e-6) / PARTITION_S), "a window straddles two partitions"
    )
    expected = [f"{run} part {number}" for run, number in zip(windows.run_id, part, strict=True)]
    np.testing.assert_array_equal(group, np.array(expected, dtype=object))
    for terrain, n in n_parts.items():
        of = windows.terrain == terrain
        assert len(set(group[of])) == n
        step_s = np.diff(windows.start_s[of])[group[of][1:] == group[of][:-1]]
        assert step_s == pytest.approx(PUBLISHED_STRIDE_S * n / min(n_parts.values()))
    counts = np.unique(windows.terrain.astype(str), return_counts=True)[1]
    assert max(counts) / min(counts) < 1.1  # the partitions alone are 17, 11 and 5
    folds = folds_of(samples, "published", 2, seed=1)
    assert_each_tested_once(folds, len(windows), 2)
    for fold in folds:
        assert not set(group[fold.train]) & set(group[fold.test])
        for terrain, n in n_parts.items():
            tested = len(set(group[fold.test][windows.terrain[fold.test] == terrain]))
            assert tested in (n // N_FOLDS, -(-n // N_FOLDS))
    assert not np.array_equal(folds[0].test, folds[N_FOLDS].test)


def test_published_has_no_rule_of_steady_motion_and_grouped_has(drive):
    still, driven = (
        [
            drive(f"{t}_{name}{i}", t, 10 * i + len(t) + len(name), speed_mps=speed)
            for t in ("ASPHALT", "GRASS")
            for i in range(3)
        ]
        for name, speed in (("still", 0.0), ("moved_", 0.6))
    )
    assert set(samples_under("published", still + driven).windows.run_id) == {
        run.run_id for run in still + driven
    }
    samples = samples_under("grouped", still + driven)
    assert set(samples.windows.run_id) == {run.run_id for run in driven}
    assert samples.dropped == {"not moving": 72}


def test_windows_without_one_label_are_left_out_and_counted(drive):
    run = drive("r", "GRASS", 0)
    halves = RunLog("r", "husky", run.streams, (Label(0.0, 11.0, "GRASS"), Label(11.0, 20.0, "GRAVEL")))
    samples = samples_under("grouped", [halves])
    # Of twelve windows of 2 s the one from 10 s lies under both, those from 20 and 22 s under none.
    assert samples.windows.terrain.tolist() == ["GRASS"] * 5 + ["GRAVEL"] * 4
    assert samples.dropped == {"no single label": 3}


def test_what_cannot_be_split_is_refused(drive, drive_all):
    unlabelled = [drive(f"r{i}", "GRASS", i, label=None) for i in range(6)]
    one_class, unnamed = drive_all(("GRASS",), 6), drive_all(n_runs=2)
    short = [drive("r", "GRASS", 0, duration_s=1.5)]
    few = drive_all(n_runs=2, duration_s=11.0)
    for protocol, runs, sentence in (
        ("grouped", one_class, "all windows are 'GRASS': a classifier needs at least two classes"),
        ("leave-one-run-out", one_class, "all windows are 'GRASS'"),
        ("published", one_class, "all windows are 'GRASS'"),
        ("grouped", drive_all(n_runs=2, terrains=("GRASS", "GRAVEL")), "4 runs are fewer than 5 folds"),
        ("grouped", drive_all(n_runs=1), "3 runs are fewer than 5 folds"),
        ("grouped", unlabelled, "no window has a terrain label"),
        ("published", unlabelled, "no partition of 5 s lies under one label"),
        ("published", few, r"fewer than 5 partitions of 5 s: ASPHALT \(4\), GRASS \(4\), GRAVEL \(4\)"),
        ("grouped", short, r"run r lasts 1\.50 s, shorter than a window of 2 s"),
        ("leave-sessions-out", unnamed, "name no sessions"),
        ("slow-fast", unnamed, r"^slow and fast runs are compared on 3 terrains .*GRASS: slow"),
    ):
        with pytest.raises(DataError, match=sentence):
            folds_of(samples_under(protocol, runs), protocol, 1, 0)


def commanded(run_id, terrain, speed_mps, number=0, session="", length_s=9.0):
    """Return a run at one commanded speed, with wheels that follow it."""
    rng = np.random.default_rng((number, len(terrain)))
    time_s = np.arange(0.0, length_s, 0.1)
    speeds = speed_mps + 0.01 * rng.normal(size=(time_s.size, 2))
    streams = {
        "wheels": Stream(time_s, speeds, ("speed_left_mps", "speed_right_mps")),
        "commands": Stream(time_s, np.full((time_s.size, 1), speed_mps), ("speed_x_mps",)),
    }
    return RunLog(run_id, "husky", streams, (Label(0.0, length_s, terrain),), session=session)


def test_regimes_are_on_one_side_whatever_the_terrain():
    speeds = [0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4]
    runs = [
        commanded(f"{terrain}_{i}", terrain, speed, i)
        for terrain in ("ICE", "SAND")
        for i, speed in enumerate(speeds)
    ]
    samples = samples_under("grouped", runs)
    regime = np.array([name.split("_")[1] for name in samples.windows.run_id])
    folds = folds_of(samples, "leave-regimes-out", 2, 0)
    assert len(folds) == 2 * N_FOLDS
    for fold in folds:
        assert not set(regime[fold.train]) & set(regime[fold.test])
    assert_each_tested_once(folds, len(regime), 2)


def test_sessions_are_held_out_whole_and_the_only_one_of_a_terrain_by_blocks_of_runs():
    runs = [commanded(f"a_{i}", "ICE", 0.5, i, session=f"monday_{i % 3}") for i in range(9)]
    runs += [commanded(f"b_{i}", "SAND", 0.5, i, session="only") for i in range(10)]
    samples = samples_under("grouped", runs)
    windows = samples.windows
    session = {run.run_id: run.session for run in runs}
    folds = folds_of(samples, "leave-sessions-out", 1, 0)
    assert len(folds) == 3 + N_FOLDS
    for fold in folds:
        assert not set(windows.run_id[fold.train]) & set(windows.run_id[fold.test])
        of_test = {session[name] for name in windows.run_id[fold.test]} - {"only"}
        assert not of_test & {session[name] for name in windows.run_id[fold.train]}
    assert_each_tested_once(folds, len(windows), 1)


def test_runs_are_chosen_by_their_commanded_speed():
    runs = [commanded("slow", "ICE", 0.1), commanded("fast", "ICE", 0.6)]
    bare = RunLog("bare", "husky", {"wheels": runs[1].streams["wheels"]})
    there = [driven_at(run, 0.0, 0.2) for run in (*runs, bare, RunLog("none", "husky", {}))]
    assert there == [True, False, False, False]
    assert driven_at(bare, 0.5, 0.7)
