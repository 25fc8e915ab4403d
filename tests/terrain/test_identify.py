"""One identification: plain algebra, priors, bounds, what nothing determines, and intervals that cover."""

import numpy as np
import pytest
from studies import intervals

from terrain.identify import Parameter, deal, folds, identify, select


def line(x, y, first, second, **options):
    parameters = [Parameter("a", *first), Parameter("b", *second)]
    return identify(lambda p: p[0] + p[1] * x - y, parameters, **options)


def test_a_linear_fit_with_priors_is_that_of_plain_algebra():
    rng = np.random.default_rng(0)
    x, inf = rng.normal(size=30), np.inf
    y = 1.0 + 2.0 * x + rng.normal(size=30)
    fit = line(x, y, (0.5, -inf, inf, 0.2), (0.0, -inf, inf))
    design = np.column_stack([np.ones(30), x])
    normal = design.T @ design + np.diag([25.0, 0.0])
    np.testing.assert_allclose(fit.value, np.linalg.solve(normal, design.T @ y + [12.5, 0.0]), rtol=1e-7)
    np.testing.assert_allclose(fit.cov, np.linalg.inv(normal), rtol=1e-6)
    clusters = np.arange(30) // 5
    clustered = line(x, y, (0.5, -inf, inf, 0.2), (0.0, -inf, inf), clusters=clusters)
    np.testing.assert_allclose(clustered.value, fit.value, rtol=1e-7)
    again = np.array([_left_out_line(design, y, clusters != g) for g in range(6)])
    np.testing.assert_allclose(clustered.influence, again - fit.value, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(clustered.cov, 5 / 6 * (again - fit.value).T @ (again - fit.value), rtol=1e-4)


def _left_out_line(design, y, kept):
    normal = design[kept].T @ design[kept] + np.diag([25.0, 0.0])
    return np.linalg.solve(normal, design[kept].T @ y[kept] + [12.5, 0.0])


def test_a_bound_and_a_parameter_that_nothing_depends_on_are_marked():
    x = np.arange(10.0)
    fit = line(x, 2.0 + 3.0 * x, (0.0, 0.0, 1.0), (0.0,))
    assert fit.at_bound.tolist() == [True, False]
    assert fit.identified.tolist() == [False, True]
    blind = line(np.zeros(10), np.full(10, 2.0), (0.0,), (0.7,))
    assert blind.value == pytest.approx([2.0, 0.7])
    assert blind.identified.tolist() == [True, False]
    assert np.isinf(blind.interval[:, 1]).all()


def test_the_best_of_several_starts_counts_and_outliers_weigh_less():
    t, wave = np.linspace(0.0, 1.0, 50), [Parameter("phase_rad", 0.0, -4.0, 4.0)]
    starts = [np.array([-1.0]), np.array([2.0])]
    fit = identify(lambda p: np.sin(6 * t + p[0]) - np.sin(6 * t + 2.5), wave, starts=starts)
    assert fit.value == pytest.approx([2.5])
    y = np.append(np.ones(20), [50.0, 60.0])
    fit = identify(lambda p: (p[0] - y) / 0.1, [Parameter("mean", 5.0)], robust=True)
    assert fit.value == pytest.approx([1.0], abs=0.02)


def test_folds_hold_whole_clusters_and_each_is_tested_once():
    clusters = np.repeat(np.arange(7), 3)
    fold = deal(clusters, 3, np.random.default_rng(0))
    assert all(len(set(fold[clusters == c])) == 1 for c in range(7))
    tested = np.concatenate([test for _, test in folds(fold)])
    assert sorted(tested.tolist()) == list(range(21))
    assert all(not set(train) & set(test) for train, test in folds(fold))


def test_a_richer_candidate_is_taken_where_it_predicts_better_by_more_than_chance():
    rng = np.random.default_rng(1)
    x = np.linspace(-1.0, 1.0, 40)

    def score(y):
        def of(degree, train, test):
            return -((np.polyval(np.polyfit(x[train], y[train], degree), x[test]) - y[test]) ** 2)

        return of

    noise = 0.1 * rng.normal(size=40)
    assert select(score(noise), [0, 1, 2], np.arange(40))[0] == 0
    assert select(score(x**2 + noise), [0, 1, 2], np.arange(40))[0] == 2


def test_the_jackknife_of_a_slope_is_about_its_scatter():
    rng, stds, slopes = np.random.default_rng(2), [], []
    for _ in range(100):
        x = rng.normal(size=20)
        y = x + rng.normal(size=20)
        fit = identify(lambda p, x=x, y=y: p[0] * x - y, [Parameter("slope_ratio", 1.0)], np.arange(20))
        stds.append(fit.std[0])
        slopes.append(x @ y / (x @ x))
    assert np.mean(stds) == pytest.approx(np.std(slopes), rel=0.2)


def test_a_prior_that_clusters_do_not_narrow_identifies_nothing():
    known = Parameter("unseen_m", 0.0, prior_std=1.0)
    fit = identify(
        lambda p: p[0] + 1e-9 * p[1] - np.sin(np.arange(40.0)),
        [Parameter("seen_m", 0.0), known],
        np.arange(40) // 4,
    )
    assert fit.identified.tolist() == [True, False]


@pytest.mark.parametrize(
    ("uses", "repeats", "least"), [("regression,six-positions", 40, 0.85), ("skid-steer", 12, 0.8)]
)
def test_intervals_contain_what_is_hidden_as_often_as_they_state(uses, repeats, least):
    """Of twelve at 95 % more than two are outside in one case of fifty."""
    rows = intervals.run(intervals.Settings(repeats=repeats, uses=uses)).rows
    assert all(row.coverage >= least for row in rows)
