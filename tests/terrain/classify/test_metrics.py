"""Figures of held-out windows: two routes to each, laws, and intervals that hold the truth."""

from types import SimpleNamespace

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from terrain.classify import metrics
from terrain.classify.folds import Fold
from terrain.classify.held_out import FoldResult, HeldOut, Scored
from terrain.classify.metrics import (
    STRIDE_S,
    Draws,
    Outcome,
    Verdict,
    accuracy_at_coverage,
    accuracy_interval,
    class_figures,
    compare_outcomes,
    confidence_auc,
    enough_runs,
    held_out_figures,
    last_class,
    paired_accuracy,
    refusal_figures,
    sequence_figures,
    track_of,
    vote,
)
from terrain.errors import DataError
from terrain.records import Label, Windows

NONE = np.empty(0, dtype=int)


def test_a_class_without_windows_does_not_count_in_the_means():
    y = np.array(["ice", "ice", "ice", "mud", "mud"])
    predicted = np.array(["ice", "snow", "mud", "mud", "mud"])
    found = class_figures(y, predicted, np.array(["ice", "mud", "snow"]))
    assert found["confusion"] == ((1, 1, 1), (0, 2, 0), (0, 0, 0))
    assert found["per_class"]["mud"] == pytest.approx((2 / 3, 1.0, 0.8, 2))
    assert found["per_class"]["snow"] == (0.0, 0.0, 0.0, 0)
    assert found["balanced_accuracy"] == pytest.approx((1 / 3 + 1.0) / 2)
    assert found["macro_f1"] == pytest.approx((0.5 + 0.8) / 2)


def test_votes_agree_with_a_slow_count_and_never_cross_segments():
    rng = np.random.default_rng(2)
    n, length_s = 300, 1.7
    probability = rng.dirichlet(np.ones(4), n)
    segment = rng.choice(["x", "y", "z"], n)
    start_s = np.round(rng.uniform(0, 60, n), 1)
    voted, _ = vote(probability, segment, start_s, length_s)
    for row in range(n):
        back = start_s[row] + length_s - 5.0
        voters = (segment == segment[row]) & (start_s >= back - 1e-9) & (start_s <= start_s[row])
        sharing = voters & (start_s == start_s[row])
        if sharing.sum() > 1:
            continue  # two windows of one start: which is the last is a matter of their order
        count = np.bincount(probability[voters].argmax(axis=1), minlength=4)
        best = np.flatnonzero(count == count.max())
        assert voted[row] == best[probability[voters].sum(axis=0)[best].argmax()]
    for name in "xyz":
        mine = segment == name
        alone, _ = vote(probability[mine], segment[mine], start_s[mine], length_s)
        np.testing.assert_array_equal(voted[mine], alone)


def test_the_interval_covers_the_truth_where_a_binomial_one_does_not():
    """Each run has an accuracy of its own; the mean over runs is 0.8."""
    rng, run = np.random.default_rng(3), np.repeat(np.arange(36), 20)
    run_id, terrain = run.astype(str), np.repeat(["ice", "mud", "snow"], 12)[run]
    covered, naive = [], []
    for _ in range(150):
        hits = (rng.random(len(run)) < rng.beta(2.4, 0.6, 36)[run]).astype(float)
        low, high = accuracy_interval(hits, run_id, terrain, rng)
        covered.append(low <= 0.8 <= high)
        naive.append(abs(hits.mean() - 0.8) <= 1.96 * np.sqrt(hits.mean() * (1 - hits.mean()) / len(hits)))
    assert np.mean(covered) >= 0.89  # 0.95 within three standard deviations of 150 tries
    assert np.mean(naive) < 0.75


def test_the_interval_over_few_sessions_covers_the_accuracy_of_others():
    """Six sessions of three terrains with an accuracy of their own; percentiles of a plain bootstrap cover less."""
    rng, session = np.random.default_rng(4), np.repeat(np.arange(9), 40)
    terrain = np.repeat(["ice", "mud", "snow"], 3)[session]
    covered, plain = [], []
    for _ in range(200):
        hits = (rng.random(len(session)) < rng.beta(8.0, 2.0, 9)[session]).astype(float)
        low, high = accuracy_interval(hits, session.astype(str), terrain, rng)
        covered.append(low <= 0.8 <= high)
        draws = stratified_resamples(hits, session, rng)
        plain.append(draws[0] <= 0.8 <= draws[1])
    assert 0.90 <= np.mean(covered) <= 0.99
    assert np.mean(plain) < np.mean(covered) - 0.05


def stratified_resamples(hits, session, rng):
    """Return the percentiles of means over sessions of which three of three are drawn in each of three terrains."""
    means = hits.reshape(3, 3, 40).mean(axis=2)
    drawn = rng.integers(3, size=(2000, 3, 3))
    return np.quantile(np.take_along_axis(means[None], drawn, axis=2).mean(axis=(1, 2)), [0.025, 0.975])


def test_units_are_counted_by_class():
    run, terrain = np.repeat(["a", "b", "c"], 10), np.repeat(["ice", "mud", "sand"], 10)
    right = [np.arange(30)[None] % n > 0 for n in (2, 3)]
    one_a_class = [Outcome(run, terrain, each, np.full((1, 30), 0.9)) for each in right]
    found = compare_outcomes(*one_a_class, np.random.default_rng(0)).accuracy
    assert np.isnan(found.interval).all()
    assert found.verdict is Verdict.NOT_DISTINGUISHED
    assert np.isnan(accuracy_interval(right[0][0] * 1.0, run, terrain, np.random.default_rng(0))).all()


def figures(run_ids, start_s, y, answers, folds):
    """Return figures of windows of 1 s, of which ``answers`` (repeats, n) are predicted, at 0.8."""
    names, classes, results = np.array(run_ids, dtype=object), np.array(["ice", "mud"]), []
    windows = Windows({}, {}, {}, 1.0, np.asarray(start_s, float), names, np.array(y))
    for fold in folds:
        predicted = np.asarray(answers)[fold.repeat][fold.test]
        results.append(FoldResult(fold, np.where(predicted[:, None] == classes, 0.8, 0.2), {}))
    held_out = HeldOut.of_folds(results, np.array(y))
    return SimpleNamespace(**held_out_figures(held_out, windows, windows.run_id, windows.run_id, 0))


def test_figures_of_hand_made_predictions():
    y = ["ice"] * 4 + ["mud"] * 4
    runs, start_s = ["a", "a", "b", "b", "c", "c", "d", "d"], [0, 1] * 4
    answers = [
        ["ice", "ice", "ice", "mud", "mud", "mud", "mud", "mud"],  # 7 of 8
        ["ice", "ice", "mud", "mud", "mud", "mud", "ice", "mud"],  # 5 of 8
    ]
    folds = [Fold(r, k, NONE, np.arange(8)[k * 4 : k * 4 + 4]) for r in range(2) for k in range(2)]
    found = figures(runs, start_s, y, answers, folds)
    assert found.accuracy_per_repeat == (7 / 8, 5 / 8)
    assert found.accuracy == 0.75
    assert found.accuracy_spread == pytest.approx(np.std([7 / 8, 5 / 8], ddof=1))
    assert (found.n_windows, found.n_runs, found.repeats) == (8, 4, 2)
    assert found.confusion == ((5, 3), (1, 7))
    assert found.per_class["ice"].recall == 5 / 8
    assert [fold.accuracy for fold in found.folds] == [0.75, 1.0, 0.5, 0.75]
    # All are equally confident: 0.8 stated, 7/8 and 5/8 right; every window its own bin of mass one.
    assert found.ece == pytest.approx(np.mean([(7 * 0.2 + 1 * 0.8) / 8, (5 * 0.2 + 3 * 0.8) / 8]))
    # Votes are of one or two windows of equal weight: only 'd' could be outvoted, in the second repeat.
    per_run = {row.run_id: row for row in found.per_run}
    assert (per_run["b"].accuracy, per_run["b"].mistaken_for) == (0.25, "mud")
    low, high = found.accuracy_ci
    assert 0.0 <= low < found.accuracy < high <= 1.0
    assert figures(runs, start_s, y, answers[:1], folds[:2]).accuracy_spread is None


def test_the_area_is_that_of_scikit_learn_with_ties_and_with_weights():
    rng = np.random.default_rng(2)
    confidence = rng.integers(5, 11, 300) / 10  # many ties
    right = rng.random(300) < confidence
    drawn = rng.integers(0, 4, (6, 300)).astype(float)
    found = confidence_auc(confidence, right.astype(float), drawn)
    expected = [roc_auc_score(right, confidence, sample_weight=weights) for weights in drawn]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert np.isnan(confidence_auc(confidence, np.ones(300), drawn)).all()


def test_a_weight_is_as_good_as_a_copy():
    rng = np.random.default_rng(3)
    confidence, right = rng.random(200), rng.integers(0, 2, 200).astype(float)
    copies = rng.integers(0, 4, 200)
    rows = np.repeat(np.arange(200), copies)
    for coverage in (0.3, 0.8, 1.0):
        weighted = accuracy_at_coverage(confidence, right, copies[None].astype(float), coverage)[0]
        copied = accuracy_at_coverage(confidence[rows], right[rows], np.ones((1, len(rows))), coverage)[0]
        assert weighted == pytest.approx(copied)
    every = accuracy_at_coverage(confidence, right, np.ones((1, 200)), 1.0)[0]
    assert every == pytest.approx(right.mean())


def outcomes(gain, seed):
    """Return two outcomes on 24 runs of unequal difficulty; b is right more often by ``gain``."""
    rng, number = np.random.default_rng(seed), np.arange(24).repeat(25)
    difficulty = np.clip(0.65 + 0.2 * rng.standard_normal(24), 0.1, 0.9)[number]
    run, terrain = number.astype(str), np.where(number % 2, "ice", "mud")

    def outcome(accuracy):
        confidence = rng.uniform(0.5, 1.0, (1, len(run)))
        return Outcome(run, terrain, rng.random((1, len(run))) < accuracy, confidence)

    return outcome(difficulty), outcome(difficulty + gain)


@pytest.mark.slow
def test_intervals_hold_the_hidden_difference_and_are_narrower_than_unpaired_ones():
    held, widths, found_better = 0, [], 0
    for seed in range(20):
        a, b = outcomes(0.08, seed)
        row = compare_outcomes(a, b, np.random.default_rng(seed)).accuracy
        held += row.interval[0] <= 0.08 <= row.interval[1]
        found_better += row.verdict is Verdict.BETTER
        widths.append(row.interval[1] - row.interval[0])
    assert held >= 16
    assert found_better >= 13
    unpaired = 2 * 1.96 * np.sqrt(2 * 0.2**2 / 24)
    assert np.mean(widths) < 0.7 * unpaired


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
    found = forward  # whose figures are those of counting
    assert found.accuracy.a == pytest.approx(a.correct.mean())
    assert found.by_class["ice"].b == pytest.approx(b.correct[:, b.terrain == "ice"].mean())
    assert found.by_class["ice"].n_units == 12
    by_unit = {row.unit: row.a for row in found.by_unit}
    assert by_unit["7"] == pytest.approx(a.correct[:, a.unit == "7"].mean())
    per_class = [np.mean([row.b for row in found.by_unit if row.terrain == name]) for name in ("ice", "mud")]
    assert found.macro_run_accuracy.b == pytest.approx(np.mean(per_class))


def test_a_difference_in_single_runs_of_classes_is_no_verdict_however_many_agree_elsewhere():
    unit = np.repeat(np.arange(14).astype(str), 10)
    terrain = np.repeat(["ice", "mud", *["sand"] * 12], 10)
    right = np.ones((1, 140), dtype=bool)
    wrong = right & ~np.isin(unit, ["0", "1"])
    a, b = (Outcome(unit, terrain, each, np.full((1, 140), 0.9)) for each in (right, wrong))
    found = compare_outcomes(a, b, np.random.default_rng(0))
    for row in (found.accuracy, found.macro_run_accuracy, found.by_class["ice"]):
        assert row.difference < 0.0
        assert np.isnan(row.interval).all()
        assert row.verdict is Verdict.NOT_DISTINGUISHED
    assert found.accuracy.reason == "too few runs or sessions where they differ (ice 1, mud 1)"
    assert found.by_class["sand"].interval == (0.0, 0.0)
    runs = [np.arange(14).astype(str), terrain[::10], np.full(14, 10)]
    paired = paired_accuracy(
        *runs, *(each[0, ::10] * 1.0 for each in (right, wrong)), np.random.default_rng(0)
    )
    assert (paired.reason, paired.difference) == (found.accuracy.reason, found.accuracy.difference)


def test_each_draw_keeps_the_number_of_units_of_a_class():
    """Every window of a class is right and of the other wrong: any draw within classes has the same accuracy."""
    unit = np.repeat(
        [f"{i}" for i in range(24)], 5
    )  # "10" sorts before "2", and runs of the two classes alternate
    terrain = np.where(np.arange(120) // 5 % 2, "ice", "mud")
    a, b = (
        Outcome(unit, terrain, right[None], np.full((1, 120), 0.9))
        for right in (terrain == "ice", terrain == "x")
    )
    found = compare_outcomes(a, b, np.random.default_rng(0))
    assert found.accuracy.interval == pytest.approx((-0.5, -0.5))
    assert found.by_class["ice"].interval == pytest.approx((-1.0, -1.0))


def test_windows_may_differ_but_runs_may_not():
    a, b = outcomes(0.0, 1)
    half = np.arange(len(b.unit)) % 2 == 0
    assert compare_outcomes(a, b.at(half), np.random.default_rng(0)).accuracy.n_units == 24
    with pytest.raises(DataError, match=r"5 \(ice\) was judged by one of the two only"):
        compare_outcomes(a, b.at(b.unit != "5"), np.random.default_rng(0))


def test_area_by_runs_is_that_of_all_pairs():
    rng = np.random.default_rng(0)
    known, new = np.round(rng.normal(size=40), 1), np.round(rng.normal(0.7, 1, 30), 1)
    run_of = np.concatenate([np.repeat(np.arange(4), 10), np.repeat(np.arange(4, 7), 10)])
    part = Scored(np.arange(40), np.arange(40, 70), known, new, 0.0)
    won, pairs = metrics._compare([part], run_of)
    expected = roc_auc_score(np.repeat([0, 1], [40, 30]), np.concatenate([known, new]))
    assert won.sum() / pairs.sum() == pytest.approx(expected)
    drawn = Draws.of(run_of, np.repeat(["known", "new"], [40, 30]), 50, np.random.default_rng(1))
    low, high = metrics._area_interval([(won, pairs)], drawn)
    assert low < expected < high


TRUE = np.repeat([0, 1, 0], 80)
STARTS_S = STRIDE_S * np.arange(1, 241) - 2.0


def track(filtered, single, runs=("run 0", "run 1", "run 2")):
    """Return a track of three grounds of 20 s each."""
    labels = [Label(20.0 * i, 20.0 * (i + 1), "ab"[i % 2]) for i in range(3)]
    return track_of(labels, runs, STARTS_S, 2.0, filtered, single, np.array(["a", "b"]), True)


def test_accuracy_delay_and_flips_are_those_that_were_put_in():
    late = np.concatenate((TRUE[:1].repeat(10), TRUE[:-10]))  # every change 2.5 s late
    noisy = TRUE.copy()
    noisy[[40, 120, 200]] = 2
    figures = sequence_figures([track(late, noisy)], 0)
    delay = figures.filter_delay_s
    assert (delay.p50, delay.p90, delay.n_changes, delay.n_missed) == (2.75, 2.75, 2, 0)
    assert figures.single_accuracy == pytest.approx(1 - 3 / 219)
    assert figures.filtered_accuracy == pytest.approx(1 - 6 / 219)
    assert figures.flips_per_minute == 0.0
    assert figures.single_flips_per_minute == pytest.approx(6.0)


def test_a_change_that_is_never_found_is_counted_and_not_averaged():
    never = np.zeros(240, dtype=int)
    delay = sequence_figures([track(never, never)], 0).filter_delay_s
    assert (delay.n_changes, delay.n_missed, delay.p90_of_all) == (2, 1, None)
    assert delay.p90 == 0.25  # back on the ground that it never left
    figures = sequence_figures([track(never - 1, never - 1)], 0)
    assert (figures.unknown_ratio, figures.filtered_accuracy) == (1.0, 0.0)
    assert np.isnan(figures.filter_delay_s.p90)
    assert sequence_figures([], 0) is None


def test_the_last_class_holds_through_refused_windows():
    rng = np.random.default_rng(3)
    probability = rng.dirichlet(np.ones(3), 50)
    probability[rng.random(50) < 0.4] = np.nan
    now, expected = -1, []
    for row in probability:
        now = now if np.isnan(row).any() else int(row.argmax())
        expected.append(now)
    assert last_class(probability).tolist() == expected


def test_enough_runs_of_a_known_law_and_none_of_a_curve_that_still_climbs():
    m = np.array([1.0, 2.0, 3.0, 5.0, 8.0, 12.0])
    for scale, power in ((0.3, 1.0), (0.2, 0.6), (0.4, 1.5)):
        n_runs, statement = enough_runs(m, 0.95 - scale * m**-power)
        # Doubling m gains scale m^-power (1 - 2^-power); solved for a gain of one per cent.
        law = (100 * scale * (1 - 2.0**-power)) ** (1 / power)
        assert n_runs == pytest.approx(law, abs=1.05)
        assert statement.startswith("enough:" if n_runs <= 12 else "not enough yet:")
    m = np.array([1.0, 2.0, 3.0, 4.0])
    n_runs, statement = enough_runs(m, 0.1 + 0.1 * np.log2(m))
    assert n_runs is None
    assert statement.startswith("not enough yet: doubling the 4.0 runs per class would still gain")
    few = enough_runs(m[:3], m[:3] / 4)
    assert few == (None, "3 sizes are too few to estimate how many runs are enough")
    assert enough_runs(m, np.full(4, 0.8))[0] == 1


def test_a_session_on_several_terrains_is_one_unit():
    session, terrain = (
        np.repeat(["monday", "tuesday", "wednesday"], 40),
        np.tile(np.repeat(["ice", "mud"], 20), 3),
    )
    drawn = Draws.of(session, terrain, 50, np.random.default_rng(0))
    assert drawn.freedom == 2
    np.testing.assert_array_equal(drawn.weights[:, :3], drawn.weights[:, 3:])  # of its ice as of its mud
    right = np.arange(120) % 5 > np.repeat([0, 1, 2], 40)
    a, b = (Outcome(session, terrain, each[None], np.full((1, 120), 0.9)) for each in (right, ~right))
    found = compare_outcomes(a, b, np.random.default_rng(0))
    assert (found.accuracy.n_units, found.by_class["ice"].n_units) == (3, 3)


def test_a_run_of_few_windows_is_not_the_worst_one():
    run = np.repeat(["a", "b", "c", "d", "e"], [10, 10, 10, 10, metrics.MIN_UNIT_WINDOWS - 1])
    refused, terrain = (
        (run == "e") | (np.arange(len(run)) == 3),
        np.where(np.isin(run, ["a", "b"]), "ice", "mud"),
    )
    assert refusal_figures(refused, ~refused, terrain, run, 0).worst_unit == 0.1
    few = refusal_figures(refused[-4:], ~refused[-4:], terrain[-4:], run[-4:], 0)
    assert np.isnan(few.worst_unit)
