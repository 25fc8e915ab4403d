"""Folds beside those of a protocol: fewer runs, a terrain left out, slow against fast; and which runs train in them."""

import numpy as np
import pytest

from terrain.classify.folds import Fold, split_runs
from terrain.classify.held_out import (
    CURVE_DRAWS,
    Applicability,
    Examples,
    drawn_folds,
    fit_fold,
    itself,
    left_out_folds,
    slow_fast_split,
)
from terrain.classify.limits import conformal_threshold, held_out_scores
from terrain.classify.svm import GroupedSVC
from terrain.errors import DataError


def test_the_curve_draws_that_many_runs_and_leaves_test_folds_alone():
    names = [f"{terrain}_{i}" for terrain, n in (("ICE", 5), ("MUD", 5), ("TAR", 1)) for i in range(n)]
    run_id = np.repeat(names, 10)
    terrain = np.array([name[:3] for name in run_id])
    rng = np.random.default_rng(0)
    folds = [Fold(0, i, *rows) for i, rows in enumerate(split_runs(terrain, run_id, 5, rng))]
    drawn_folds_, runs_per_class = drawn_folds(terrain, run_id, folds, 0)
    assert len(drawn_folds_) == 3 * CURVE_DRAWS * len(folds)  # 1, 2 and 3 of the 4 training runs of each fold
    for drawn in drawn_folds_:
        original = folds[drawn.number]
        assert np.array_equal(drawn.test, original.test)
        size = 1 + drawn.repeat // CURVE_DRAWS
        for name, n_runs in (("ICE", size), ("MUD", size), ("TAR", 1)):
            assert len(set(run_id[drawn.train][terrain[drawn.train] == name])) == n_runs
        whole = original.train[np.isin(run_id[original.train], run_id[drawn.train])]
        np.testing.assert_array_equal(drawn.train, whole)  # a run that is drawn is drawn whole
    first, second = ({tuple(fold.train) for fold in drawn_folds_ if fold.repeat == draw} for draw in range(2))
    assert first != second
    assert runs_per_class == pytest.approx([1.0, (2 + 2 + 1) / 3, (3 + 3 + 1) / 3, (4 + 4 + 1) / 3])


RUN_ID = np.repeat([f"{name}_{i}" for name in ("ice", "mud", "tar") for i in range(4)], 6)
TERRAIN = np.array([run[:3] for run in RUN_ID])


def test_no_run_of_the_left_out_terrain_and_no_tested_run_trains():
    folds = left_out_folds(TERRAIN, RUN_ID, 5, 1, 0)
    assert len(folds) == 15
    for train, test, unknown in folds:
        (left_out,) = set(TERRAIN[unknown])
        assert np.array_equal(unknown, np.flatnonzero(left_out == TERRAIN))
        assert len(set(TERRAIN[train])) == 2
        assert left_out not in {*TERRAIN[train], *TERRAIN[test]}
        assert not set(RUN_ID[train]) & set(RUN_ID[test])
        assert len(test)
    two = TERRAIN != "tar"
    with pytest.raises(DataError, match=r"2 terrains \(ice, mud\).*at least 3"):
        left_out_folds(TERRAIN[two], RUN_ID[two], 5, 1, 0)
    few = two & np.isin(RUN_ID, ["ice_0", "ice_1", "mud_0", "mud_1"]) | ~two
    with pytest.raises(DataError, match=r"4 runs without tar are fewer than 5 folds"):
        left_out_folds(TERRAIN[few], RUN_ID[few], 5, 1, 0)


PLAN = {"ASPHALT": (0.3, 0.4, 0.7, 0.8), "GRASS": (0.9, 0.5, 1.0, 0.6), "GRAVEL": (0.1, 0.2, 0.3, 0.4, 0.5)}


def windows_of(plan, duration_s=32.0, stride_s=2.0):
    """Return wheel speeds, run, terrain and start of windows of 2 s, one run ``TERRAIN_i`` a speed."""
    rng, rows = np.random.default_rng(0), []
    for terrain, speeds in plan.items():
        for i, speed in enumerate(speeds):
            for start_s in np.arange(0.0, duration_s - 1.9, stride_s):
                rows.append((speed + 0.005 * rng.normal(size=20), f"{terrain}_{i}", terrain, start_s))
    return [np.array(column) for column in zip(*rows, strict=True)]


def test_each_class_is_split_at_its_own_median_speed():
    fastest, run_id, terrain, start_s = windows_of(PLAN)
    side, split = slow_fast_split(fastest, run_id, terrain, start_s, 2.0)
    assert (split.left_out, split.status) == ({}, Applicability.APPLICABLE)
    slow, fast = (set(run_id[side == name].tolist()) for name in ("slow", "fast"))
    assert slow == {"ASPHALT_0", "ASPHALT_1", "GRASS_1", "GRASS_3", "GRAVEL_0", "GRAVEL_1", "GRAVEL_2"}
    assert fast == {"ASPHALT_2", "ASPHALT_3", "GRASS_0", "GRASS_2", "GRAVEL_3", "GRAVEL_4"}
    assert [*split.classes["GRASS"].values()] == pytest.approx([0.55, 0.95], abs=0.02)


def test_a_class_with_too_little_on_a_side_is_left_out_and_named():
    three = PLAN | {"GRAVEL": (0.3, 0.4, 0.8)}
    fastest, run_id, terrain, start_s = windows_of(three)
    side, split = slow_fast_split(fastest, run_id, terrain, start_s, 2.0)
    assert split.left_out == {"GRAVEL": "fast runs: 1"}
    assert split.status is Applicability.NOT_APPLICABLE  # three classes are needed
    assert set(side[terrain == "GRAVEL"]) == {""}
    for stride_s in (2.0, 0.5):  # windows that overlap cover no more, though they are more
        _, split = slow_fast_split(*windows_of(PLAN, 28.0, stride_s), 2.0)
        assert split.left_out["ASPHALT"] == "slow runs: 56 s"

    # A run that is slow on one class and fast on another is on no side: its windows would train and test at once.
    fastest, run_id, terrain, start_s = windows_of(PLAN)
    run_id = np.where(np.isin(run_id, ["GRASS_1", "GRAVEL_4"]), "mixed", run_id)
    side, _ = slow_fast_split(fastest, run_id, terrain, start_s, 2.0)
    assert set(side[run_id == "mixed"]) == {""}
    assert not set(run_id[side == "slow"]) & set(run_id[side == "fast"])


def test_sets_of_a_fold_are_calibrated_over_sessions():
    rng, session, run = np.random.default_rng(0), np.arange(240) // 20, np.arange(240) // 5
    terrain = np.where(session % 2, "ice", "mud")
    features = rng.normal(size=(240, 2)) + (terrain == "ice")[:, None] + rng.normal(size=(12, 2))[session]
    examples = Examples(features, terrain, np.stack([session, 100 + run], axis=1).astype(str))
    fold = Fold(0, 0, np.arange(240), np.zeros(0, dtype=int))
    found = fit_fold(GroupedSVC(), examples, np.unique(terrain), fold, itself)
    scores = held_out_scores(found.found, terrain)
    assert found.conformal == conformal_threshold(scores, session) != conformal_threshold(scores, run)
