"""Folds: their laws, that they differ by seed, and how much is left to train on."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrain.classify.folds import (
    divided_units,
    fold_numbers,
    has_sessions,
    hold_out_runs,
    inner_splits,
    single_run_classes,
    split_runs,
    units_of,
)
from terrain.errors import DataError


def draw_runs(n_runs, rng, dtype=str):
    """Return the class and the run of each window; runs are of unequal length and stand in any order."""
    y, groups = [], []
    names = [(terrain, run) for terrain, n in n_runs.items() for run in range(n)]
    for i in rng.permutation(len(names)):
        terrain, run = names[i]
        n = int(rng.integers(8, 60))
        y += [terrain] * n
        groups += [f"{terrain}_{run}"] * n
    return np.array(y, dtype=dtype), np.array(groups, dtype=dtype)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_runs=st.lists(st.integers(1, 9), min_size=2, max_size=5),
    n_folds=st.integers(2, 5),
    gap=st.integers(0, 2),
    dtype=st.sampled_from([str, object]),
)
def test_laws_of_folds(seed, n_runs, n_folds, gap, dtype):
    rng = np.random.default_rng(seed)
    y, groups = draw_runs({f"class {i}": n for i, n in enumerate(n_runs)}, rng, dtype)
    if len(np.unique(divided_units(y, groups, n_folds))) < n_folds:
        return
    alone = single_run_classes(y, groups)
    assert alone == [f"class {i}" for i, n in enumerate(n_runs) if n == 1]
    tested = np.zeros(len(y), dtype=int)
    runs_of_class = {c: [] for c in np.unique(y)}
    for train, test in split_runs(y, groups, n_folds, rng, gap):
        tested[test] += 1
        shared = set(groups[train]) & set(groups[test])
        assert shared <= {f"{c}_0" for c in alone}
        left_out = np.setdiff1d(np.arange(len(y)), np.union1d(train, test))
        assert set(y[left_out]) <= set(alone)
        assert set(y[train]) == set(y)
        for c in alone:
            rows = np.flatnonzero(y == c)
            place = np.searchsorted(rows, test[y[test] == c])
            assert (np.diff(place) == 1).all()  # one contiguous block
            expected = set(range(place[0] - gap, place[-1] + gap + 1)) - set(place)
            expected &= set(range(len(rows)))
            assert {int(np.searchsorted(rows, row)) for row in left_out[y[left_out] == c]} == expected
        for c, counts in runs_of_class.items():
            counts.append(len(set(groups[test][y[test] == c])))
    assert (tested == 1).all()
    for counts in runs_of_class.values():
        assert max(counts) - min(counts) <= 1  # every class is dealt evenly


def test_a_session_is_never_divided_where_its_class_has_several():
    """Ice has three sessions of two runs, mud one of three, sand one run, and one session has ice and mud."""
    plan = [
        ("mon", "a", "ice"),
        ("mon", "b", "ice"),
        ("tue", "c", "ice"),
        ("tue", "d", "ice"),
        ("wed", "e", "ice"),
    ]
    plan += [("wed", "f", "mud"), ("wed", "g", "mud"), ("wed", "h", "mud"), ("s", "s", "sand")]
    session, run, y = (np.repeat(names, 10) for names in zip(*plan, strict=True))
    groups = np.stack([session, run], axis=1)
    of_ice = y == "ice"
    assert (units_of(y, groups) == session).all()
    assert (units_of(y[~of_ice], groups[~of_ice]) == run[~of_ice]).all()  # no class has two sessions
    assert (units_of(y, run) == run).all()
    unit = divided_units(y, groups, 5)
    assert (unit[of_ice] == session[of_ice]).all()
    assert len(set(zip(unit[y == "mud"], run[y == "mud"], strict=True))) == 3  # whole runs
    assert len(set(unit[y == "sand"])) == 5
    for train, test in inner_splits(y, groups, 3, 0, 1):
        assert not set(session[train][of_ice[train]]) & set(session[test][of_ice[test]])
        assert set(run[train]) & set(run[test]) <= {"s"}


def test_different_seeds_give_different_folds_though_runs_are_of_unequal_length():
    y, groups = draw_runs({"ice": 9, "snow": 11, "sand": 7}, np.random.default_rng(0))
    runs = np.unique(groups)
    together = np.zeros((40, len(runs), len(runs)), dtype=bool)
    for seed in range(40):
        fold = fold_numbers(y, groups, 5, np.random.default_rng(seed))
        of_run = np.array([fold[groups == run][0] for run in runs])
        together[seed] = of_run[:, None] == of_run
    assert len({t.tobytes() for t in together}) == 40
    together_ratio = together.mean(axis=0)[np.triu_indices(len(runs), 1)]
    assert together_ratio.max() < 0.6  # no two runs always meet


def test_enough_is_left_of_every_terrain(make_run):
    for counts, held_out in (
        ({"ice": 6, "mud": 7, "sand": 2}, ["ice_5", "mud_6"]),
        ({"ice": 5, "mud": 4}, ["ice_4"]),
        ({"ice": 3, "mud": 2}, []),  # five runs are needed for five folds
        ({"ice": 2, "mud": 2, "sand": 2}, []),
        ({}, []),
    ):
        runs = [
            make_run(f"{name}_{i}", name, i, duration_s=1.0) for name, n in counts.items() for i in range(n)
        ]
        training, out = hold_out_runs(runs)
        assert [each.run_id for each in out] == held_out
        assert sorted(each.run_id for each in (*training, *out)) == sorted(each.run_id for each in runs)


@pytest.mark.parametrize("lacking", [False, True])
def test_inner_folds_keep_runs_whole_and_leave_out_what_shares_samples_with_a_test_block(lacking):
    y = np.repeat(["ice", "snow"], 60)
    groups = np.where(y == "ice", "only", np.repeat([f"r{i}" for i in range(12)], 10))
    splits = list(inner_splits(y, groups, 3, 0, 4, lacking=lacking))
    assert len(splits) == 3
    for train, test in splits:
        assert set(groups[train]) & set(groups[test]) == {"only"}
        assert np.abs(train[train < 60][:, None] - test[test < 60]).min() == 5
    short = np.r_[0:4, 60:120]  # the gap beside each block leaves out all of its class
    assert list(inner_splits(y[short], groups[short], 3, 0, 4, lacking=lacking)) == []
    with pytest.raises(DataError, match="too few to hold some of them out"):
        list(inner_splits(y[:61], groups[:61], 3, 0))


def test_a_run_over_two_terrains_stays_whole_where_one_of_them_has_one_session():
    plan = [("monday", f"m{i}", name) for i in range(5) for name in ("mud", "ice")]
    plan += [("tuesday", f"t{i}", "mud") for i in range(5)]
    plan += [(name, name, "grass") for name in ("tuesday", "wednesday")]
    session, run, y = (np.repeat(names, 4) for names in zip(*plan, strict=True))
    for train, test in split_runs(y, np.stack([session, run], axis=1), 4, np.random.default_rng(0)):
        assert not set(run[train]) & set(run[test])


def test_runs_without_a_session_are_no_sessions_of_their_terrain():
    plan = [(f"i{i}", f"i{i}", "ice") for i in range(4)] + [("monday", f"m{i}", "mud") for i in range(4)]
    session, run, y = map(np.array, zip(*plan, strict=True))
    groups = np.stack([session, run], axis=1)
    assert not has_sessions(y, groups)  # neither has a second one
    assert (units_of(y, groups) == run).all()
    groups[0, 0] = "tuesday"
    assert has_sessions(y, groups)
