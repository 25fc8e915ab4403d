import numpy as np
import pytest

from terrain.classify.conformal import conformal_sets, conformal_threshold
from terrain.classify.held_out import conformal_figures
from terrain.errors import DataError


def draw_scores(rng, n_runs):
    """Return scores of runs that are alike: each has its own level and its own number of windows."""
    n_windows = rng.integers(3, 60, n_runs)
    runs = np.repeat(np.arange(n_runs), n_windows)
    return np.clip(0.2 + 0.2 * rng.standard_normal(n_runs)[runs] + 0.1 * rng.random(len(runs)), 0, 1), runs


@pytest.mark.parametrize("level", [0.8, 0.9])
def test_coverage_of_runs_that_are_alike_is_the_level(level):
    rng = np.random.default_rng(0)
    coverage = []
    for _ in range(400):
        threshold = conformal_threshold(*draw_scores(rng, 30), level)
        scores, runs = draw_scores(rng, 20)
        coverage.append(np.mean([(scores[runs == r] <= threshold).mean() for r in range(20)]))
    error = np.std(coverage) / np.sqrt(len(coverage))
    assert level - 3 * error <= np.mean(coverage) <= level + 1 / 31 + 3 * error


def test_runs_weigh_alike_however_long():
    scores = np.concatenate([np.full(1000, 0.9), np.full(19, 0.1)])
    runs = np.concatenate([np.zeros(1000), np.arange(1, 20)])
    assert conformal_threshold(scores, runs, 0.9) == 0.1  # one run in twenty
    assert conformal_threshold(scores, np.arange(1019), 0.9) == 0.9


def test_sets_grow_with_the_threshold_and_hold_the_most_probable_class():
    probability = np.random.default_rng(0).dirichlet(np.ones(4), 50)
    before = conformal_sets(probability, 0.0)
    assert (before.sum(axis=1) == 1).all()
    for threshold in (0.3, 0.6, 0.9, 1.0):
        now = conformal_sets(probability, threshold)
        assert (now | before == now).all()
        before = now
    assert before.all()


def test_few_runs_and_no_scores():
    assert conformal_threshold(np.zeros(50), np.repeat(np.arange(5), 10), 0.9) == 1.0
    assert conformal_threshold(np.append(np.zeros(20), np.nan), np.arange(21), 0.9) == 0.0
    with pytest.raises(DataError, match="no held-out window"):
        conformal_threshold(np.full(3, np.nan), np.arange(3))


def test_figures_count_windows_runs_and_sizes():
    rng = np.random.default_rng(0)
    member = rng.random((3, 40, 4)) < 0.5
    truth = rng.integers(4, size=40)
    run = np.repeat(np.arange(8), 5).astype(str)
    found = conformal_figures(member, truth, run, np.array(["ice"] * 40), np.random.default_rng(0))
    held = member[:, np.arange(40), truth]
    of_run = [held[:, run == r].mean() for r in np.unique(run)]
    assert found.coverage == pytest.approx(held.mean())
    assert found.coverage_per_run == pytest.approx(np.mean(of_run))
    assert found.coverage_worst_run == pytest.approx(min(of_run))
    assert found.set_size == pytest.approx(member.sum() / 120)
    assert found.single_ratio == pytest.approx((member.sum(axis=2) == 1).mean())
    assert found.coverage_ci[0] < found.coverage < found.coverage_ci[1]
