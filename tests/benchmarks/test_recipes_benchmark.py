"""How long one window takes a recipe, and 300 trees beside scikit-learn's own: ``--benchmark-enable``."""

import time

import numpy as np
import pytest
from sklearn.ensemble import ExtraTreesClassifier

from features.windows import cut_windows
from pipelines.learn.classifier import TerrainClassifier
from pipelines.live.assess import assess
from terrain.classify.trees import fitted_forest

MOST_MS = 2.0  #: Of a live window


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("recipe", ["svm", "trees", "response", "plain"])
def test_a_window_leaves_a_live_chain_its_time(benchmark, drive_all, recipe):
    windows = cut_windows(drive_all()).windows
    model = TerrainClassifier(recipe).fit(windows).model_
    window = windows[5]
    assess(model, window)  # compiles
    benchmark(assess, model, window)
    if benchmark.stats:
        assert 1e3 * benchmark.stats.stats.median < MOST_MS


@pytest.fixture(scope="module")
def rows():
    """Rows of as many windows and features as a data set of fifty runs has."""
    rng = np.random.default_rng(0)
    y = rng.integers(5, size=1600)
    X = rng.normal(size=(1600, 550)) + 0.5 * (y[:, None] == np.arange(550) % 40)
    return X.astype(np.float32).astype(float), y


@pytest.mark.benchmark(group="300 trees, one row", timer=time.process_time)
@pytest.mark.parametrize("peer", ["arrays", "scikit-learn"])
def test_trees_as_arrays_beside_scikit_learn(benchmark, rows, peer):
    X, y = rows
    forest = fitted_forest(X, y, False, 300, 0)
    oracle = ExtraTreesClassifier(300, random_state=0).fit(X, y).predict_proba
    np.testing.assert_allclose(forest.sums(X[:9]) / 300, oracle(X[:9]), atol=1e-12)
    benchmark(forest.sums if peer == "arrays" else oracle, X[:1])
    if benchmark.stats and peer == "arrays":
        assert 1e3 * benchmark.stats.stats.median < MOST_MS / 2
