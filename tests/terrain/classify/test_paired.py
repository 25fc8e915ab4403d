"""Paired differences: a hidden difference is found with an interval that holds it, and none where none is."""

import numpy as np
import pytest

from terrain.classify.paired import Outcome, Verdict, compare_outcomes
from terrain.errors import DataError


def outcomes(gain, seed, n_runs=24, n_windows=25, run_std=0.2):
    """Return two outcomes on runs of unequal difficulty; b is right more often by ``gain``."""
    rng = np.random.default_rng(seed)
    difficulty = np.clip(0.65 + run_std * rng.standard_normal(n_runs), 0.1, 0.9).repeat(n_windows)
    run = np.arange(n_runs).repeat(n_windows).astype(str)
    terrain = np.where(np.arange(n_runs).repeat(n_windows) % 2, "ice", "mud")

    def outcome(accuracy):
        confidence = rng.uniform(0.5, 1.0, (1, len(run)))
        return Outcome(run, terrain, rng.random((1, len(run))) < accuracy, confidence)

    return outcome(difficulty), outcome(difficulty + gain)


@pytest.mark.slow
def test_intervals_hold_the_hidden_difference_and_are_narrower_than_unpaired_ones():
    held, widths, found_better = 0, [], 0
    for seed in range(30):
        a, b = outcomes(0.08, seed)
        row = compare_outcomes(a, b, np.random.default_rng(seed)).accuracy
        held += row.interval[0] <= 0.08 <= row.interval[1]
        found_better += row.verdict is Verdict.BETTER
        widths.append(row.interval[1] - row.interval[0])
    assert held >= 25
    assert found_better >= 20
    unpaired = 2 * 1.96 * np.sqrt(2 * 0.2**2 / 24)
    assert np.mean(widths) < 0.7 * unpaired


def test_no_difference_is_not_called_one():
    verdicts = [
        compare_outcomes(*outcomes(0.0, seed), np.random.default_rng(seed)).accuracy.verdict
        for seed in range(30)
    ]
    assert sum(verdict is not Verdict.NOT_DISTINGUISHED for verdict in verdicts) <= 5


def test_a_classifier_does_not_differ_from_itself_and_the_sign_follows_the_order():
    a, b = outcomes(0.1, 0)
    same = compare_outcomes(a, a, np.random.default_rng(0))
    assert same.accuracy.difference == 0.0
    assert same.accuracy.interval == (0.0, 0.0)
    assert same.accuracy.verdict is Verdict.NOT_DISTINGUISHED
    forward, back = (compare_outcomes(*pair, np.random.default_rng(0)) for pair in ((a, b), (b, a)))
    assert forward.accuracy.difference == pytest.approx(-back.accuracy.difference)
    assert forward.accuracy.interval == pytest.approx([-end for end in back.accuracy.interval[::-1]])
    assert back.accuracy.verdict is Verdict.WORSE


def test_figures_are_those_of_counting():
    a, b = outcomes(0.1, 3)
    found = compare_outcomes(a, b, np.random.default_rng(0))
    assert found.accuracy.a == pytest.approx(a.correct.mean())
    assert found.by_class["ice"].b == pytest.approx(b.correct[:, b.terrain == "ice"].mean())
    assert found.by_class["ice"].n_runs == 12
    by_run = {row.run_id: row.a for row in found.by_run}
    assert by_run["7"] == pytest.approx(a.correct[:, a.run_id == "7"].mean())
    per_class = [np.mean([row.b for row in found.by_run if row.terrain == name]) for name in ("ice", "mud")]
    assert found.macro_run_accuracy.b == pytest.approx(np.mean(per_class))


def test_one_run_gives_no_interval():
    a, b = outcomes(0.5, 2)
    alone = [each._replace(terrain=np.where(each.run_id == "3", "sand", each.terrain)) for each in (a, b)]
    row = compare_outcomes(*alone, np.random.default_rng(0)).by_class["sand"]
    assert row.n_runs == 1
    assert row.difference > 0
    assert np.isnan(row.interval).all()
    assert row.verdict is Verdict.NOT_DISTINGUISHED


def test_windows_may_differ_but_runs_may_not():
    a, b = outcomes(0.0, 1)
    half = np.arange(len(b.run_id)) % 2 == 0
    fewer = Outcome(b.run_id[half], b.terrain[half], b.correct[:, half], b.confidence[:, half])
    assert compare_outcomes(a, fewer, np.random.default_rng(0)).accuracy.n_runs == 24
    others = b.run_id != "5"
    missing = Outcome(b.run_id[others], b.terrain[others], b.correct[:, others], b.confidence[:, others])
    with pytest.raises(DataError, match=r"run 5 \(ice\) was judged by one of the two only"):
        compare_outcomes(a, missing, np.random.default_rng(0))
