import numpy as np
import pytest
from sklearn.metrics import accuracy_score, balanced_accuracy_score, f1_score

from terrain.classify.metrics import (
    ClassFigures,
    RunFigures,
    class_figures,
    per_run_figures,
    run_bootstrap,
    vote,
)


def test_class_figures_agree_with_counting_by_hand_and_with_scikit_learn():
    rng = np.random.default_rng(0)
    classes = np.array(["ice", "mud", "sand", "snow"])
    y = rng.choice(classes, 500, p=[0.5, 0.3, 0.15, 0.05])
    predicted = np.where(rng.random(500) < 0.6, y, rng.choice(classes, 500))
    figures = class_figures(y, predicted, classes)
    confusion = np.array([[np.sum((y == t) & (predicted == p)) for p in classes] for t in classes])
    np.testing.assert_array_equal(figures.confusion, confusion)
    hits = np.diag(confusion)
    recall, precision = hits / confusion.sum(axis=1), hits / confusion.sum(axis=0)
    f1 = 2 * recall * precision / (recall + precision)
    for i, name in enumerate(classes):
        row = figures.per_class[name]
        assert row.n_windows == np.sum(y == name)
        assert (row.recall, row.precision, row.f1) == pytest.approx((recall[i], precision[i], f1[i]))
    assert figures.accuracy == pytest.approx(accuracy_score(y, predicted))
    assert figures.balanced_accuracy == pytest.approx(balanced_accuracy_score(y, predicted))
    assert figures.macro_f1 == pytest.approx(f1_score(y, predicted, average="macro"))


def test_a_class_without_windows_does_not_count_against_the_means():
    y = np.array(["ice", "ice", "mud", "mud"])
    figures = class_figures(y, np.array(["ice", "snow", "mud", "mud"]), np.array(["ice", "mud", "snow"]))
    assert figures.balanced_accuracy == pytest.approx((0.5 + 1.0) / 2)
    assert figures.macro_f1 == pytest.approx((2 / 3 + 1.0) / 2)
    assert figures.per_class["snow"] == ClassFigures(0.0, 0.0, 0.0, 0)


def ballots(*votes):
    """Return probabilities of three classes in which ``a``, ``b`` or ``c`` gets that probability."""
    probability = np.array([[(1 - p) / 2] * 3 for _, p in votes])
    for row, (name, p) in zip(probability, votes, strict=True):
        row["abc".index(name)] = p
    return probability


def test_a_vote_counts_the_windows_of_the_last_five_seconds():
    votes = [("a", 0.9), ("b", 0.5), ("b", 0.5), ("b", 0.5), ("a", 0.9), ("a", 0.9), ("a", 0.9)]
    voted = vote(ballots(*votes), np.zeros(7), np.arange(7.0), 1.0)
    # At the end of window 4 the last 5 s hold a b b b a; of window 5: b b b a a; of window 6: b b a a a.
    assert "".join("abc"[i] for i in voted) == "aabbbba"
    # Windows of 2 s: only two lie wholly within 5 s; of one each the more probable wins, in either order.
    pairs = [("a", 0.9), ("b", 0.5), ("a", 0.6), ("c", 0.8)]
    assert vote(ballots(*pairs), np.zeros(4), 2.0 * np.arange(4), 2.0).tolist() == [0, 0, 0, 2]
    # A pause of the log does not stretch the five seconds, and a window longer than that votes alone.
    late = np.array([0.0, 1.0, 2.0, 30.0])
    assert vote(ballots(("a", 0.9), ("a", 0.9), ("a", 0.9), ("b", 0.5)), np.zeros(4), late, 1.0)[-1] == 1
    assert vote(ballots(*votes), np.zeros(7), np.arange(7.0), 6.0).tolist() == [0, 1, 1, 1, 0, 0, 0]


def test_votes_agree_with_a_slow_count_and_never_cross_segments():
    rng = np.random.default_rng(2)
    n, length_s = 300, 1.7
    probability = rng.dirichlet(np.ones(4), n)
    segment = rng.choice(["x", "y", "z"], n)
    start_s = np.round(rng.uniform(0, 60, n), 1)
    voted = vote(probability, segment, start_s, length_s)
    for row in range(n):
        back = start_s[row] + length_s - 5.0
        voters = (segment == segment[row]) & (start_s >= back - 1e-9) & (start_s <= start_s[row])
        sharing = voters & (start_s == start_s[row])
        if sharing.sum() > 1:
            continue  # two windows of one start: which is the last is a matter of their order
        count = np.bincount(probability[voters].argmax(axis=1), minlength=4)
        best = np.flatnonzero(count == count.max())
        assert voted[row] == best[probability[voters].sum(axis=0)[best].argmax()]
    alone = [
        vote(probability[segment == s], segment[segment == s], start_s[segment == s], length_s) for s in "xyz"
    ]
    for name, expected in zip("xyz", alone, strict=True):
        np.testing.assert_array_equal(voted[segment == name], expected)


def hierarchical(rng, n_runs=12, n_windows=20):
    """Return hits of windows whose run has an accuracy of its own; the mean over runs is 0.8."""
    terrain = np.repeat(["ice", "mud", "snow"], n_runs)
    of_run = rng.beta(2.4, 0.6, 3 * n_runs)
    run_id = np.repeat(np.arange(3 * n_runs), n_windows)
    return (rng.random(len(run_id)) < of_run[run_id]).astype(float), run_id.astype(str), terrain[run_id]


def test_the_interval_covers_the_truth_where_a_binomial_one_does_not():
    rng = np.random.default_rng(3)
    covered, naive = [], []
    for _ in range(250):
        hits, run_id, terrain = hierarchical(rng)
        low, high = run_bootstrap(hits, run_id, terrain, rng)
        covered.append(low <= 0.8 <= high)
        naive.append(abs(hits.mean() - 0.8) <= 1.96 * np.sqrt(hits.mean() * (1 - hits.mean()) / len(hits)))
    assert 0.90 <= np.mean(covered) <= 0.98  # 0.95 within three standard deviations of 250 tries
    assert np.mean(naive) < 0.75


def test_the_interval_is_that_of_independent_windows_when_they_are():
    rng = np.random.default_rng(4)
    hits = (rng.random(2000) < 0.8).astype(float)
    run_id = np.repeat(np.arange(100), 20).astype(str)
    low, high = run_bootstrap(hits, run_id, np.where(np.arange(2000) < 1000, "ice", "mud"), rng)
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt(0.16 / 2000), rel=0.25)
    assert low < hits.mean() < high


def test_the_interval_repeats_with_its_seed_and_ignores_the_order_of_windows():
    hits, run_id, terrain = hierarchical(np.random.default_rng(5))
    first = run_bootstrap(hits, run_id, terrain, np.random.default_rng(7))
    shuffled = np.random.default_rng(0).permutation(len(hits))
    again = run_bootstrap(hits[shuffled], run_id[shuffled], terrain[shuffled], np.random.default_rng(7))
    assert again == pytest.approx(first, abs=1e-12)
    assert run_bootstrap(hits, run_id, terrain, np.random.default_rng(8)) != first
    alone = np.array(["only"] * 5)
    assert run_bootstrap(np.array([1, 1, 0, 1, 0]), alone, alone, np.random.default_rng(0)) == (0.6, 0.6)


def test_figures_of_a_run_are_means_over_repeats_and_name_the_usual_mistake():
    run_id, terrain = np.array(["r1"] * 4 + ["r2"] * 2), np.array(["ice"] * 4 + ["mud"] * 2)
    predicted = np.array(["ice", "mud", "mud", "snow", "mud", "mud"])
    correct = np.array([predicted == terrain, np.ones(6, dtype=bool)])
    first, second = per_run_figures(correct, predicted, correct[:1], run_id, terrain)
    assert first == RunFigures("r1", "ice", 4, 0.625, 0.25, "mud")
    assert (second.accuracy, second.mistaken_for) == (1.0, None)
