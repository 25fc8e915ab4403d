import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from terrain.classify import unknown_figures
from terrain.classify.unknown_figures import Scored, left_out_folds
from terrain.errors import DataError

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


def test_two_terrains_and_few_runs_are_refused():
    two = TERRAIN != "tar"
    with pytest.raises(DataError, match=r"2 terrains \(ice, mud\).*at least 3"):
        left_out_folds(TERRAIN[two], RUN_ID[two], 5, 1, 0)
    few = two & np.isin(RUN_ID, ["ice_0", "ice_1", "mud_0", "mud_1"]) | ~two
    with pytest.raises(DataError, match=r"4 runs without tar are fewer than 5 folds"):
        left_out_folds(TERRAIN[few], RUN_ID[few], 5, 1, 0)


def test_area_by_runs_is_that_of_all_pairs():
    rng = np.random.default_rng(0)
    known, new = np.round(rng.normal(size=40), 1), np.round(rng.normal(0.7, 1, 30), 1)
    run_of = np.concatenate([np.repeat(np.arange(4), 10), np.repeat(np.arange(4, 7), 10)])
    part = Scored(np.arange(40), np.arange(40, 70), known, new, 0.0)
    won, pairs = unknown_figures._compare([part], run_of)
    expected = roc_auc_score(np.repeat([0, 1], [40, 30]), np.concatenate([known, new]))
    assert won.sum() / pairs.sum() == pytest.approx(expected)
    weights = np.ones((50, 7)) + np.random.default_rng(1).multinomial(7, np.full(7, 1 / 7), 50)
    low, high = unknown_figures._interval([(won, pairs)], weights)
    assert low < expected < high
