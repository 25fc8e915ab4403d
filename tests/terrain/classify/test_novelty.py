from itertools import combinations

import numpy as np
import pytest

from terrain.classify.folds import inner_probabilities, inner_splits
from terrain.classify.novelty import (
    CLIP_STD,
    GAMMA,
    KNOWN_KEPT,
    check_novelty,
    largest_margin,
    learn_novelty,
)
from terrain.classify.svm import GroupedSVC
from terrain.errors import DataError


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
    known, _, _ = draw((0, 1, 2), seed=1, n_runs=20)
    hidden, _, _ = draw((4,), seed=2, n_runs=20)
    assert fitted.is_unknown(hidden).mean() > 0.8
    kept = 1.0 - fitted.is_unknown(known).mean()
    assert abs(kept - KNOWN_KEPT) < 0.04  # 60 runs whose windows are alike: 3 x sqrt(0.05 x 0.95 / 300)
    assert fitted.score(hidden).mean() > fitted.score(known).mean() + 2.0


def test_the_score_of_a_window_does_not_depend_on_the_others_nor_on_the_order_of_runs(fitted):
    X, y, runs = draw((0, 1, 2))
    scores = fitted.score(X)
    np.testing.assert_allclose(fitted.score(X[::-1]), scores[::-1], rtol=1e-9)
    np.testing.assert_allclose(fitted.score(X[7:8]), scores[7:8], rtol=1e-9)
    again = learn_novelty(X, y, runs, seed=1)
    assert all(np.array_equal(a, b) for a, b in zip(again, fitted, strict=True))


def test_terms_agree_with_their_equations(fitted):
    X, _, _ = draw((0, 3), seed=4)
    n = fitted
    x = np.clip((X[:, n.columns] - n.mean) / n.scale, -CLIP_STD, CLIP_STD)
    z = x @ n.components.T
    to_class = [np.square(z @ n.within.T - m).sum(axis=1) for m in n.means]
    relative = np.min(to_class, axis=0) - np.square(z @ n.background.T - n.centre).sum(axis=1)
    near = np.linalg.norm(z[:, np.newaxis, : n.prototypes.shape[1]] - n.prototypes, axis=2).min(axis=1)
    squares = np.square(x[:, np.newaxis] - n.vectors).sum(axis=2)
    margins = np.exp(-GAMMA * squares / len(n.columns)) @ n.weights + n.offsets
    wins = np.full((len(X), 3, 3), np.inf)
    for pair, (a, b) in enumerate(combinations(range(3), 2)):
        wins[:, a, b], wins[:, b, a] = margins[:, pair], -margins[:, pair]
    expected = np.stack([-wins.min(axis=2).max(axis=1), relative, near], axis=1)
    np.testing.assert_allclose(n.terms(X), expected, rtol=1e-5, atol=1e-6)


def test_pair_margins_are_those_of_scikit_learn():
    from sklearn.svm import SVC

    for classes in ((0, 1), (0, 1, 2)):
        X, y, runs = draw(classes)
        n = learn_novelty(X, y, runs)
        x = np.clip((X[:, n.columns] - n.mean) / n.scale, -CLIP_STD, CLIP_STD)
        svc = SVC(C=10.0, gamma=1.0 / x.shape[1], decision_function_shape="ovo").fit(x, y)
        margins = svc.decision_function(x)
        margins = -margins[:, np.newaxis] if margins.ndim == 1 else margins
        np.testing.assert_allclose(-n.terms(X)[:, 0], largest_margin(margins, len(classes)), atol=1e-5)


def test_broken_and_missing_features(fitted):
    X, _, _ = draw((0, 1, 2))
    X = X[:3].copy()
    X[0, :5], X[1, :4], X[2] = np.nan, np.inf, 1e200
    scores = fitted.score(X)
    assert np.isfinite(scores).tolist() == [True, False, True]
    assert fitted.is_unknown(X)[1]  # what cannot be compared is not known
    with pytest.raises(DataError, match=r"shape \(3, 29\), \(n, 30\)"):
        fitted.score(X[:, 1:])


def test_few_data():
    X, y, runs = draw((0, 1))
    alone = np.where(y == "terrain 1", "one run", runs)
    assert np.isfinite(learn_novelty(X, y, alone).score(X)).all()
    X[:, 3], X[:, 4] = np.nan, 7.0
    assert np.isfinite(learn_novelty(X, y, runs).score(X)).all()
    with pytest.raises(DataError, match="at least two classes"):
        learn_novelty(X, np.full(len(y), "ice"), runs)
    with pytest.raises(DataError, match="no feature varies"):
        learn_novelty(np.ones_like(X), y, runs)
    with pytest.raises(DataError, match="too few"):
        learn_novelty(X[[0, -1]], y[[0, -1]], runs[[0, -1]])


@pytest.mark.parametrize("name", ["columns", "within", "reference", "vectors"])
def test_numbers_that_do_not_fit_are_refused(fitted, name):
    numbers = fitted
    check_novelty(numbers, 3)
    wrong = getattr(numbers, name).copy()
    wrong[-1] = -1 if name == "columns" else np.nan
    with pytest.raises(DataError):
        check_novelty(numbers._replace(**{name: wrong}), 3)
    with pytest.raises(DataError):
        check_novelty(numbers, 4)
    assert len(numbers.score(np.zeros((0, 30)))) == 0


def test_inner_probabilities_are_of_other_runs():
    X, y, runs = draw((0, 1, 2), n_features=6)
    for train, test in inner_splits(y, runs, 3, 0):
        assert not set(runs[train]) & set(runs[test])
    classifier = GroupedSVC(candidates=((10.0, 0.4, 100.0),))
    found = inner_probabilities(classifier, X, y, runs, 3, 0)
    np.testing.assert_allclose(found.sum(axis=1), 1.0)
    own = classifier.fit(X, y, groups=runs).predict_proba(X)
    truth = np.searchsorted(classifier.classes_, y)
    rows = np.arange(len(y))
    assert found[rows, truth].mean() < own[rows, truth].mean()  # rows that it trained on look better
