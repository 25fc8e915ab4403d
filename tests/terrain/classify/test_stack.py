"""The stack: whichever of SVM and network knows more, and the same numbers by both routes."""

import numpy as np
import pytest

from terrain.classify.network import SampleColumns
from terrain.classify.stack import GroupedStack, chosen_of, cross_joined, fit_weights, joined
from terrain.errors import DataError

COLUMNS = (SampleColumns("imu", ("accel_z_mps2",), 50.0, 50),)
N_FEATURES = 4


def draw(informed, n_runs=5, n_windows=10, seed=0):
    """Return rows of features and samples of which one, both or none shows the terrain."""
    rng = np.random.default_rng(seed)
    y = np.repeat(["ice", "sand"], n_runs * n_windows)
    run = np.repeat(np.arange(2 * n_runs), n_windows)
    ice = (y == "ice")[:, None]
    features = rng.standard_normal((len(y), N_FEATURES)) + (3.0 * ice if "features" in informed else 0.0)
    hz = np.where(ice, 8.0, 18.0) if "samples" in informed else 8.0
    phase = rng.uniform(0, 2 * np.pi, (len(y), 1))
    samples = 2 * np.sin(2 * np.pi * hz * np.arange(50) / 50 + phase) + 2.0 * rng.standard_normal(
        (len(y), 50)
    )
    return np.concatenate([features, samples], axis=1), y, run


def quick(**changed):
    settings = {"candidates": ((10.0, 0.4, 100.0),), "n_members": 2, "epochs": 8, "trial_epochs": 0}
    return GroupedStack(COLUMNS, **(settings | changed))


def test_the_one_that_knows_has_the_weight_and_is_chosen():
    X, y, run = draw("samples")
    stack, (test, truth, _) = quick().fit(X, y, run), draw("samples", seed=1)
    assert stack.best_.weight_cnn > stack.best_.weight_svm
    assert np.mean(stack.predict(test) == truth) > 0.9
    X, y, run = draw("features")
    best, (test, truth, _) = quick(choose=True).fit(X, y, run), draw("features", seed=1)
    assert best.best_.used in ("svm", "trees")
    assert best.network_ is None
    assert np.mean(best.predict(test) == truth) > 0.9


def test_weights_are_those_of_a_search_over_a_grid():
    rng = np.random.default_rng(0)
    truth = rng.integers(3, size=300)
    both = np.stack([rng.dirichlet(np.ones(3), 300) for _ in range(2)])
    both[0, np.arange(300), truth] += 1.0
    both /= both.sum(axis=2, keepdims=True)

    def loss(w):
        p = joined(both, np.array(w))[np.arange(300), truth]
        return -np.log(p).mean() + 0.1 * ((np.array(w) - 0.5) ** 2).sum()

    grid = [(a, b) for a in np.linspace(0, 3, 31) for b in np.linspace(0, 3, 31)]
    np.testing.assert_allclose(fit_weights(both, truth), min(grid, key=loss), atol=0.11)
    assert (fit_weights(both[::-1], truth) >= 0).all()


def test_the_choice_needs_more_than_the_noise_between_runs():
    run = np.repeat(np.arange(10), 5)
    rng = np.random.default_rng(0)
    svm = np.full(50, 0.5)
    noisy = np.repeat(0.49 + 2.0 * rng.standard_normal(10), 5)
    even = {"svm": svm, "cnn": noisy, "stack": noisy}
    assert chosen_of(even, run) == "svm"
    assert chosen_of(even | {"trees": svm - 0.1}, run) == "trees"
    assert chosen_of({"svm": svm, "cnn": svm - 0.1, "stack": svm - 0.2}, run) == "stack"
    assert chosen_of({"svm": svm, "cnn": svm - 0.2, "stack": svm - 0.1}, run) == "cnn"
    level = {"svm": svm, "trees": svm - 0.2, "cnn": noisy - 0.2, "stack": svm - 0.2}
    assert chosen_of(level, run) == "trees"  # what costs more is not lower than the trees
    assert chosen_of({"svm": svm, "stack": svm - 9}, np.zeros(50)) == "svm"  # one run says nothing


def test_without_torch_the_best_is_of_svm_and_trees(monkeypatch):
    monkeypatch.setattr("terrain.classify.stack.can_fit", lambda: False)
    X, y, run = draw("features")
    X[:, :N_FEATURES] = np.random.default_rng(1).uniform(-1, 1, (len(y), N_FEATURES))
    boxed = np.abs(X[:, :N_FEATURES]) < 0.63  # inside or outside of a box in two of three coordinates
    y = np.where(boxed[:, :3].sum(axis=1) > 1, "ice", "sand")
    best = quick(choose=True).fit(X, y, run)
    assert (best.best_.used, best.best_.loss_cnn, best.network_) == ("trees", None, None)
    assert np.mean(best.predict(X) == y) > 0.9
    alone = best.trees_.predict_proba(X[:, :N_FEATURES])
    assert np.array_equal(best.predict_proba(X), alone)


def test_rows_without_features_are_refused():
    X, y, run = draw("features")
    with pytest.raises(DataError, match="are not features and 50 samples"):
        quick().fit(X[:, N_FEATURES:], y, run)


def test_the_loss_of_a_stack_is_by_weights_of_other_runs():
    rng = np.random.default_rng(0)
    both, truth, run = rng.dirichlet(np.ones(3), (2, 60)), rng.integers(3, size=60), np.arange(60) // 20
    crossed = cross_joined(both, truth, run, 0)
    for other in range(3):
        weights = fit_weights(both[:, run != other], truth[run != other])
        np.testing.assert_allclose(crossed[run == other], joined(both[:, run == other], weights))
