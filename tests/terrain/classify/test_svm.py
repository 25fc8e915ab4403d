"""The support vector machine: pairwise coupling by its plain form, and a choice that never splits a run."""

import numpy as np
import pytest
from scipy.special import expit

from terrain.classify.svm import CANDIDATES, GroupedSVC, class_probabilities, fit_scale, pairs_of
from terrain.errors import DataError

TERRAINS = np.array(["ice", "sand", "snow"])


def coupled_plainly(margins, k, scale):
    """Solve the system of the minimum under its constraint, window by window."""
    found = []
    for row in margins:
        r = np.zeros((k, k))
        for (a, b), margin in zip(pairs_of(k), row, strict=True):
            r[a, b], r[b, a] = expit(scale * margin), expit(-scale * margin)
        Q = -r.T * r
        np.fill_diagonal(Q, (r**2).sum(axis=0))
        system = np.block([[Q, np.ones((k, 1))], [np.ones((1, k)), np.zeros((1, 1))]])
        found.append(np.linalg.solve(system, np.eye(k + 1)[-1])[:k])
    return np.array(found)


@pytest.mark.parametrize("k", [2, 3, 8])
def test_probabilities_are_those_of_the_plain_form(k):
    margins = np.random.default_rng(k).normal(0, 2, (60, k * (k - 1) // 2))
    found = class_probabilities(margins, k, 1.7)
    np.testing.assert_allclose(found, coupled_plainly(margins, k, 1.7), atol=1e-10)
    np.testing.assert_allclose(found.sum(axis=1), 1.0)
    assert (found >= 0).all()


def test_a_hidden_scale_is_recovered_from_several_classes():
    rng = np.random.default_rng(2)
    margins = rng.normal(0, 1, (6000, 6))
    p = class_probabilities(margins, 4, 2.5)
    drawn = (rng.random((6000, 1)) > p.cumsum(axis=1)).sum(axis=1)
    assert fit_scale(margins, drawn, 4) == pytest.approx(2.5, rel=0.06)


def test_a_class_that_was_not_there_to_train_on_gets_no_probability():
    rng = np.random.default_rng(3)
    margins = rng.normal(size=(20, 6))
    margins[:10, [0, 3, 4]] = np.nan  # all pairs of class 1
    found = class_probabilities(margins, 4, 1.3)
    np.testing.assert_array_equal(found[:10, 1], 0.0)
    without = class_probabilities(margins[:10][:, [1, 2, 5]], 3, 1.3)
    np.testing.assert_allclose(found[:10][:, [0, 2, 3]], without)
    np.testing.assert_allclose(found[10:], class_probabilities(margins[10:], 4, 1.3))
    truth = found.argmax(axis=1)
    truth[:3] = 1  # of the absent class: these rows do not count
    others = np.arange(20) >= 3
    assert fit_scale(margins, truth, 4) == pytest.approx(fit_scale(margins[others], truth[others], 4))


def draw_runs(n_runs=4, n_windows=12, run_std=0.3, seed=0, n_features=6):
    """Return features, classes and runs; a class has its own mean, and so has, less so, a run."""
    rng = np.random.default_rng(seed)
    terrain = np.repeat(np.arange(len(TERRAINS)), n_runs)
    centre = np.random.default_rng(99).normal(0, 1.5, (len(TERRAINS), n_features))
    of_run = centre[terrain] + rng.normal(0, run_std, (len(terrain), n_features))
    X = np.repeat(of_run, n_windows, axis=0) + rng.standard_normal((len(terrain) * n_windows, n_features))
    runs = np.repeat(np.arange(len(terrain)), n_windows)
    return X, TERRAINS[terrain[runs]], runs


EXPECTED_FAILURES = {
    "check_classifiers_one_label": "one class is refused, and a constant answer never given",
    "check_fit2d_1sample": "one class is refused with DataError, which the command line prints",
}


def test_contract_of_scikit_learn():
    from sklearn.utils.estimator_checks import check_estimator  # a second that other processes do not need

    estimator = GroupedSVC(candidates=((10.0, 0.4, 100.0),))
    check_estimator(estimator, expected_failed_checks=EXPECTED_FAILURES, on_skip=None)


def test_the_choice_is_the_best_held_out_candidate_and_costs_few_fits():
    X, y, runs = draw_runs()
    model = GroupedSVC().fit(X, y, groups=runs)
    assert model.n_inner_fits_ == 3 * len(CANDIDATES) <= 20
    assert model.best_ == CANDIDATES[int(model.inner_scores_.argmax())]
    hopeless = (1e-6, 1e-6, 100.0)
    for candidates in ([hopeless, CANDIDATES[3]], [CANDIDATES[3], hopeless]):
        assert GroupedSVC(candidates).fit(X, y, groups=runs).best_ == CANDIDATES[3]


def test_labels_that_only_identify_runs_give_scores_of_chance():
    scores, split = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        runs = np.repeat(np.arange(24), 8)
        y = np.array(["ice", "snow"])[rng.permutation(np.arange(24) % 2)][runs]
        X = rng.normal(0, 3, (24, 6))[runs] + 0.3 * rng.standard_normal((192, 6))
        candidates = CANDIDATES[3:4]  # the best of many would be above chance by luck
        scores.append(GroupedSVC(candidates, seed=seed).fit(X, y, groups=runs).inner_scores_[0])
        split.append(GroupedSVC(candidates, seed=seed).fit(X, y).inner_scores_[0])
    # 24 runs are 24 coin tosses: a standard deviation of 0.10 for one, of 0.05 for the mean of four.
    assert abs(np.mean(scores) - 0.5) < 0.16
    assert np.mean(split) > 0.95  # the test can fail: folds that split runs look perfect


def test_features_that_are_missing_constant_or_extreme_do_no_harm():
    X, y, runs = draw_runs()
    new, truth, _ = draw_runs(seed=1)
    quick = GroupedSVC(CANDIDATES[3:4])
    clean = np.mean(quick.fit(X, y, groups=runs).predict(new) == truth)
    extra = np.full((len(X), 2), [np.nan, 7.0])
    X[::7, 1] = np.nan
    model = quick.fit(np.hstack([X, extra]), y, groups=runs)
    faulty = np.hstack([new, extra])
    faulty[:, 2][::5] = np.nan
    faulty[3, 3] = 1e12
    assert np.mean(model.predict(faulty) == truth) > clean - 0.08
    assert np.isfinite(model.predict_proba(faulty)).all()


def test_too_few_classes_or_windows_are_refused():
    X, y, runs = draw_runs()
    with pytest.raises(DataError, match="all windows are 'ice': a classifier needs at least two classes"):
        GroupedSVC().fit(X[y == "ice"], y[y == "ice"])
    few = np.r_[np.flatnonzero(y == "ice"), np.flatnonzero(y == "snow")[:1]]
    with pytest.raises(DataError, match="there is one window of class 'snow'; at least 2 are needed"):
        GroupedSVC().fit(X[few], y[few], groups=runs[few])
    both = np.r_[np.flatnonzero(y == "ice")[:2], np.flatnonzero(y == "snow")[:2]]
    with pytest.raises(DataError, match="too few to hold some of them out"):
        GroupedSVC().fit(X[both], y[both], groups=np.array(list("aabb")))
