"""Novelty, support and sets of classes: their plain forms, laws, hidden truth, and what is refused."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.svm import SVC

from terrain.classify.limits import (
    CLIP_STD,
    KNOWN_KEPT,
    REACH,
    SPEED_STEP_MPS,
    YAW_STEP_RADPS,
    check_novelty,
    check_support,
    conformal_threshold,
    learn_novelty,
    learn_support,
)
from terrain.errors import DataError

CLASSES = ["ice", "mud", "snow"]


def draw(centres, n_runs=6, n_windows=15, seed=0, run_std=0.3, n_features=30):
    """Return features, classes and runs: centres are numbers of random directions, apart from each other."""
    rng = np.random.default_rng(seed)
    directions = np.random.default_rng(5).standard_normal((8, n_features))
    of_run = 1.2 * np.repeat(directions[list(centres)], n_runs, axis=0)
    of_run = of_run + run_std * rng.standard_normal(of_run.shape)
    X = np.repeat(of_run, n_windows, axis=0)
    runs = np.repeat([f"{c} run {r} of {seed}" for c in centres for r in range(n_runs)], n_windows)
    y = np.repeat([f"terrain {c}" for c in centres], n_runs * n_windows)
    return X + rng.standard_normal(X.shape), y, runs


@pytest.fixture(scope="module")
def fitted():
    return learn_novelty(*draw((0, 1, 2)), seed=1)


def test_a_terrain_that_was_hidden_is_found_and_held_out_runs_of_known_ones_are_kept(fitted):
    known = fitted.score(draw((0, 1, 2), seed=1, n_runs=20)[0])
    hidden = fitted.score(draw((4,), seed=2, n_runs=20)[0])
    assert (hidden > fitted.threshold).mean() > 0.8
    # 60 runs whose windows are alike: 3 x sqrt(0.05 x 0.95 / 300)
    assert (known <= fitted.threshold).mean() == pytest.approx(KNOWN_KEPT, abs=0.04)
    assert hidden.mean() > known.mean() + 2.0


def test_terms_agree_with_their_equations(fitted):
    """Those of pairs of classes are compared with scikit-learn's below."""
    X, n = draw((0, 3), seed=4)[0], fitted
    x = np.clip((X[:, n.columns] - n.mean) / n.scale, -CLIP_STD, CLIP_STD)
    z = x @ n.components.T
    to_class = [np.square(z @ n.within.T - m).sum(axis=1) for m in n.means]
    relative = np.min(to_class, axis=0) - np.square(z @ n.background.T - n.centre).sum(axis=1)
    near = np.linalg.norm(z[:, np.newaxis, : n.prototypes.shape[1]] - n.prototypes, axis=2).min(axis=1)
    np.testing.assert_allclose(n.terms(X)[:, 1:], np.stack([relative, near], axis=1), rtol=1e-5, atol=1e-6)


def test_pair_margins_are_those_of_scikit_learn():
    for classes in ((0, 1), (0, 1, 2)):
        X, y, runs = draw(classes)
        n = learn_novelty(X, y, runs)
        x = np.clip((X[:, n.columns] - n.mean) / n.scale, -CLIP_STD, CLIP_STD)
        svc = SVC(C=10.0, gamma=1.0 / x.shape[1], decision_function_shape="ovo").fit(x, y)
        margins = svc.decision_function(x)
        margins = -margins[:, np.newaxis] if margins.ndim == 1 else margins
        wins = np.full((len(X), len(classes), len(classes)), np.inf)
        for pair, (a, b) in enumerate(combinations(range(len(classes)), 2)):
            wins[:, a, b], wins[:, b, a] = margins[:, pair], -margins[:, pair]
        np.testing.assert_allclose(n.terms(X)[:, 0], -wins.min(axis=2).max(axis=1), atol=1e-5)


def test_broken_and_missing_features_and_few_data(fitted):
    X, _, _ = draw((0, 1, 2))
    X = X[:3].copy()
    X[0, :5], X[1, :4], X[2] = np.nan, np.inf, 1e200
    scores = fitted.score(X)
    assert np.isfinite(scores).tolist() == [True, False, True]  # what cannot be compared has no score
    with pytest.raises(DataError, match=r"shape \(3, 29\), \(n, 30\)"):
        fitted.score(X[:, 1:])
    assert len(fitted.score(np.zeros((0, 30)))) == 0
    X, y, runs = draw((0, 1))
    alone = np.where(y == "terrain 1", "one run", runs)
    assert np.isfinite(learn_novelty(X, y, alone).score(X)).all()
    X[:, 3], X[:, 4] = np.nan, 7.0
    assert np.isfinite(learn_novelty(X, y, runs).score(X)).all()
    with pytest.raises(DataError, match="no feature varies"):
        learn_novelty(np.ones_like(X), y, runs)
    with pytest.raises(DataError, match="too few"):
        learn_novelty(X[[0, -1]], y[[0, -1]], runs[[0, -1]])


def test_numbers_that_do_not_fit_are_refused(fitted):
    check_novelty(fitted, 3)
    for name, value in {"columns": -1, "within": np.nan, "reference": np.nan, "vectors": np.inf}.items():
        wrong = getattr(fitted, name).copy()
        wrong[-1] = value
        with pytest.raises(DataError, match="the novelty score's "):
            check_novelty(fitted._replace(**{name: wrong}), 3)
    with pytest.raises(DataError, match="the novelty score's "):
        check_novelty(fitted, 4)
    table = learn_support(*windows(1), CLASSES)
    check_support(table, CLASSES)
    counts = [None, [[1]], np.full((3, 1, 1), 0.5), np.full((3, 1, 1), -1)]
    counts += [np.zeros(shape, dtype=int) for shape in ((3, 0, 1), (2, 1, 1), (3, 1))]
    for changed in ({"classes": ("ice", "mud", "sand")}, *({"n_runs": each} for each in counts)):
        with pytest.raises(DataError, match=r"^the table of support [^.]*$"):
            check_support(replace(table, **changed), CLASSES)


def windows(seed, n=60):
    rng = np.random.default_rng(seed)
    terrain = rng.choice(CLASSES[:2], n)
    return rng.uniform(0, 1, n), rng.uniform(0, 1.5, n), terrain, rng.choice(list("abcdef"), n)


def counted(training, speed, yaw):
    """Count one by one the runs with a window at most REACH cells away."""
    found = np.zeros((len(speed), len(CLASSES)), dtype=int)
    for i, (v, w) in enumerate(zip(speed, yaw, strict=True)):
        for j, name in enumerate(CLASSES):
            runs = {
                run
                for other_v, other_w, terrain, run in zip(*training, strict=True)
                if terrain == name
                and abs(int(v / SPEED_STEP_MPS) - int(other_v / SPEED_STEP_MPS)) <= REACH
                and abs(int(w / YAW_STEP_RADPS) - int(other_w / YAW_STEP_RADPS)) <= REACH
            }
            found[i, j] = len(runs)
    return found


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_the_table_counts_the_runs_that_are_near(seed):
    training = windows(seed)
    speed, yaw, *_ = windows(seed + 1, 20)
    table = learn_support(*training, CLASSES)
    np.testing.assert_array_equal(table.near_runs(speed, yaw), counted(training, speed, yaw))


def draw_scores(rng, n_runs):
    """Return scores of runs that are alike: each has its own level and its own number of windows."""
    n_windows = rng.integers(3, 60, n_runs)
    runs = np.repeat(np.arange(n_runs), n_windows)
    return np.clip(0.2 + 0.2 * rng.standard_normal(n_runs)[runs] + 0.1 * rng.random(len(runs)), 0, 1), runs


def test_coverage_of_runs_that_are_alike_is_the_level():
    rng, level, coverage = np.random.default_rng(0), 0.8, []
    for _ in range(400):
        threshold = conformal_threshold(*draw_scores(rng, 30), level)
        scores, runs = draw_scores(rng, 20)
        coverage.append(np.mean([(scores[runs == r] <= threshold).mean() for r in range(20)]))
    error = np.std(coverage) / np.sqrt(len(coverage))
    assert level - 3 * error <= np.mean(coverage) <= level + 1 / 31 + 3 * error


def test_sets_over_few_sessions_hold_what_so_few_can_show():
    """These differ more between sessions than within: the largest score of five is above five of six new ones."""
    rng, coverage = np.random.default_rng(1), []
    for _ in range(400):
        threshold = conformal_threshold(*draw_scores(rng, 5), 0.9)
        scores, runs = draw_scores(rng, 20)
        coverage.append(np.mean([(scores[runs == r] <= threshold).mean() for r in range(20)]))
    assert 5 / 6 <= np.mean(coverage) <= 0.97
    scores, runs = np.r_[np.full(18, 0.1), 0.5, 0.6], np.repeat([0, 1], 10)
    assert conformal_threshold(scores, runs, 0.9) == 0.6  # at 0.1 the mean is 0.9, its bound is not


def test_runs_weigh_alike_however_long_and_one_of_them_holds_all_classes():
    scores = np.concatenate([np.full(1000, 0.9), np.full(19, 0.1)])
    runs = np.concatenate([np.zeros(1000), np.arange(1, 20)])
    assert conformal_threshold(scores, runs, 0.9) == 0.1  # one run in twenty
    assert conformal_threshold(scores, np.arange(1019), 0.9) == 0.9
    assert conformal_threshold(np.zeros(50), np.zeros(50), 0.9) == 1.0
    assert conformal_threshold(np.arange(10) / 10, np.arange(10), 0.9) == 0.9  # the new run is one of eleven
    assert conformal_threshold(np.append(np.zeros(20), np.nan), np.arange(21), 0.9) == 0.0
    with pytest.raises(DataError, match="no held-out window"):
        conformal_threshold(np.full(3, np.nan), np.arange(3))
