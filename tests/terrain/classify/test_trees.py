"""Trees as arrays: scikit-learn's own numbers, held-out probabilities of whole runs, and no walk into nowhere."""

import numpy as np
import pytest
from scipy.special import log_softmax
from sklearn.ensemble import ExtraTreesClassifier, HistGradientBoostingClassifier

from terrain.classify.grouped import fit_preparation
from terrain.classify.trees import GroupedTrees, check_forest, fit_scale, fitted_forest
from terrain.errors import DataError


def draw(n_classes=3, n_runs=12, seed=0, n_features=6):
    """Return features, classes and runs; a class has its own mean, and so has, less so, a run."""
    rng = np.random.default_rng(seed)
    run = np.repeat(np.arange(n_runs), 15)
    y = np.array(["ice", "mud", "sand"])[run % n_classes]
    X = rng.normal(size=(len(y), n_features)) + 0.8 * rng.normal(size=(n_runs, n_features))[run]
    X[:, 0] += 2.0 * (run % n_classes)
    return X.astype(np.float32).astype(float), y, run


@pytest.mark.parametrize("n_classes", [2, 3])
def test_the_kernel_gives_what_scikit_learn_gives(n_classes):
    X, y, _ = draw(n_classes)
    forest = fitted_forest(X[::2], y[::2], False, 40, seed=3)
    oracle = ExtraTreesClassifier(40, random_state=3).fit(X[::2], y[::2])
    np.testing.assert_allclose(forest.sums(X) / 40, oracle.predict_proba(X), rtol=0.0, atol=1e-12)
    boosted = fitted_forest(X[::2], y[::2], True, 0, seed=3)
    oracle = HistGradientBoostingClassifier(random_state=3).fit(X[::2], y[::2])
    found = np.exp(log_softmax(boosted.sums(X), axis=1))
    np.testing.assert_allclose(found, oracle.predict_proba(X), rtol=0.0, atol=1e-12)
    for each in (forest, boosted):
        check_forest(each, 6, n_classes)


@pytest.mark.parametrize("boosted", [False, True])
def test_held_out_probabilities_are_of_whole_runs_and_calibrated(boosted):
    X, y, run = draw(n_runs=30)
    X[::7, 1] = np.nan
    trees = GroupedTrees(boosted, n_trees=60).fit(X, y, run)
    place = np.searchsorted(trees.classes_, y)
    held_out = trees.inner_probability_[np.arange(len(y)), place]
    assert np.isfinite(held_out).all()
    np.testing.assert_allclose(trees.inner_probability_.sum(axis=1), 1.0, atol=1e-12)
    if not boosted:
        logs = trees._logs(trees.preparation_, trees.forest_, X)
        assert logs.min() == pytest.approx(np.log(0.5 / 60))  # of a class that no tree gives
    assert held_out.mean() < trees.predict_proba(X)[np.arange(len(y)), place].mean() - 0.05
    new, truth, _ = draw(n_runs=60, seed=9)
    found = trees.predict_proba(new)
    right = found.argmax(axis=1) == np.searchsorted(trees.classes_, truth)
    assert right.mean() == pytest.approx(found.max(axis=1).mean(), abs=0.1)
    again = GroupedTrees(boosted, n_trees=60).fit(X, y, run)
    assert np.array_equal(again.predict_proba(new), found)
    order = [2, 0, 1]  # a class has the same probability whatever it is called
    named = dict(zip(trees.classes_, np.array(["a", "b", "c"])[order], strict=True))
    other = GroupedTrees(boosted, n_trees=60).fit(X, np.array([named[name] for name in y]), run)
    assert np.abs(other.predict_proba(new)[:, order] - found).mean() < 0.1


def test_a_class_that_a_fold_lacks_and_too_few_rows():
    X, y, _ = draw(n_runs=6)
    y[:] = np.where(np.arange(len(y)) < 80, "ice", "mud")
    y[-4:] = "sand"
    few = GroupedTrees(n_trees=5, gap=9).fit(X, y, np.arange(len(y)) // 5)
    assert few.inner_probability_.shape == (len(y), 3)
    with pytest.raises(DataError, match="too few to hold some of them out"):
        GroupedTrees().fit(X[:2], np.array(["ice", "mud"]), np.arange(2))


def test_the_scale_of_drawn_probabilities_is_found_again():
    rng = np.random.default_rng(0)
    logs = rng.normal(size=(4000, 3))
    truth = np.array([rng.choice(3, p=row) for row in np.exp(log_softmax(2.5 * logs, axis=1))])
    assert fit_scale(logs, truth) == pytest.approx(2.5, rel=0.1)


def test_numbers_that_lead_out_of_the_arrays_are_refused():
    X, y, _ = draw()
    preparation = fit_preparation(X, y, 100.0)
    forest = fitted_forest(preparation.of(X), y, False, 4, seed=0)
    inner, leaf = np.flatnonzero(forest.feature >= 0)[-1], np.flatnonzero(forest.feature < 0)[0]
    for name, place, value, sentence in (
        ("feature", inner, 6, "asks for a feature beyond its 6"),
        ("left", inner, len(forest.left), "a child that is not there, or that leads back"),
        ("right", inner, inner, "that leads back"),
        ("right", inner, -1, "that leads back"),
        ("left", leaf, len(forest.outputs), "a root or a leaf that is not there"),
        ("left", leaf, -1, "a root or a leaf that is not there"),
        ("roots", 0, len(forest.left), "a root or a leaf that is not there"),
        ("threshold", 0, np.nan, "the threshold of its trees is not a number"),
        ("outputs", 0, np.nan, "the outputs of its trees is not a number"),
    ):
        array = getattr(forest, name).copy()
        array[place] = value
        with pytest.raises(DataError, match=sentence):
            check_forest(forest._replace(**{name: array}), 6, 3)
    for change in (
        {"left": forest.left[:-1]},
        {"left": forest.left.astype(np.int64)},
        {"outputs": forest.outputs[:, :2]},
        {"roots": [0]},
        {"start": np.zeros(2)},
    ):
        with pytest.raises(DataError, match=r"is no array \(.*\) of (int32|float64)"):
            check_forest(forest._replace(**change), 6, 3)
    with pytest.raises(DataError, match="a root or a leaf that is not there"):
        check_forest(forest._replace(roots=forest.roots[:0]), 6, 3)


def test_a_class_that_no_fold_could_learn_does_not_flatten_the_others():
    rng = np.random.default_rng(0)
    y, runs = np.repeat(["ice", "mud", "sand"], [100, 100, 6]), np.r_[np.arange(200) // 10, np.full(6, 99)]
    X = rng.normal(size=(206, 3)) + 3.0 * (y == "mud")[:, None] - 4.0 * (y == "sand")[:, None]
    trees = GroupedTrees(n_trees=50, gap=4).fit(
        X, y, groups=runs
    )  # the gap takes what a block of sand leaves
    assert trees.predict_proba(X).max(axis=1).mean() > 0.95
