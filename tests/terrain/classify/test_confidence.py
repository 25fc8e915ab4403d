"""Figures of confidence: two routes to each, laws, and intervals that hold the truth."""

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from terrain.classify.metrics import (
    CALIBRATION_BINS,
    accuracy_at_coverage,
    calibration_error,
    confidence_auc,
    confidence_figures,
    reliability_bins,
    run_weights,
)


def once(n):
    return np.ones((1, n))


def ece(confidence, right, n_bins=CALIBRATION_BINS):
    return calibration_error(confidence, right.astype(float), once(len(right)), n_bins)[0]


def test_calibration_error_of_known_cases():
    # 15 bins of 100: in bin b the confidence is c_b and exactly c_b of 100 are right.
    confidence = np.repeat(np.arange(60, 90, 2) / 100, 100)
    right = np.concatenate([np.arange(100) < round(100 * c) for c in np.arange(60, 90, 2) / 100])
    assert ece(confidence, right) == pytest.approx(0.0, abs=1e-12)
    assert ece(confidence, np.ones(1500, dtype=bool)) == pytest.approx(1 - confidence.mean())
    # Too bold in one half and too shy in the other: the signs must not cancel.
    half = np.repeat([0.6, 0.9], 750)
    assert ece(half, np.arange(1500) % 4 < 3) == pytest.approx(0.15, abs=0.01)
    assert ece(half, np.arange(1500) % 4 < 3, n_bins=1) == pytest.approx(0.0, abs=1e-9)


def test_calibration_bins_are_of_equal_mass_whatever_the_order():
    rng = np.random.default_rng(1)
    confidence = rng.beta(8, 1, 1003)  # crowded near 1: bins of equal width would be empty
    right = rng.random(1003) < confidence**2
    table = reliability_bins(confidence[None], right[None], once(1003), CALIBRATION_BINS)
    counts = [row.n_windows for row in table]
    assert len(table) == CALIBRATION_BINS
    assert sum(counts) == 1003
    assert max(counts) - min(counts) <= 1
    assert np.all(np.diff([row.confidence for row in table]) > 0)
    expected = (
        sum(n * abs(row.accuracy - row.confidence) for n, row in zip(counts, table, strict=True)) / 1003
    )
    assert ece(confidence, right) == pytest.approx(expected)
    shuffled = rng.permutation(1003)
    assert ece(confidence[shuffled], right[shuffled]) == pytest.approx(expected)
    few = reliability_bins(confidence[None, :4], right[None, :4], once(4), CALIBRATION_BINS)
    assert [row.n_windows for row in few] == [1] * 4


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
        copied = accuracy_at_coverage(confidence[rows], right[rows], once(len(rows)), coverage)[0]
        assert weighted == pytest.approx(copied)
    assert accuracy_at_coverage(confidence, right, once(200), 1.0)[0] == pytest.approx(right.mean())


def test_runs_are_drawn_whole_and_within_their_classes():
    run_id = np.repeat(["a", "b", "c", "d"], 5)
    terrain = np.repeat(["ice", "ice", "sand", "sand"], 5)
    weights = run_weights(run_id, terrain, 200, np.random.default_rng(4)).reshape(200, 4, 5)
    assert (weights == weights[:, :, :1]).all()
    per_run = weights[:, :, 0]
    assert (per_run[:, :2].sum(axis=1) == 2).all()
    assert (per_run[:, 2:].sum(axis=1) == 2).all()
    assert len(np.unique(per_run[:, 0])) == 3


@pytest.mark.slow
def test_intervals_hold_the_truth_where_runs_differ_and_those_over_windows_would_not():
    """Each run is right or wrong as a whole more often than by windows: 95 % have to hold in most trials."""
    held, widths = 0, []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        of_run = np.clip(0.8 + 0.15 * rng.standard_normal(30), 0, 1).repeat(20)
        confidence = np.full(600, 0.8) + 1e-6 * rng.random(600)
        right = rng.random(600) < of_run
        found = confidence_figures(
            confidence[None], right[None], np.arange(30).repeat(20), np.zeros(600), rng
        )
        low, high = found.at_coverage[0].accuracy_ci
        held += low <= 0.79 <= high  # the mean of the clipped normal
        widths.append(high - low)
    assert held >= 33
    assert np.mean(widths) > 1.5 * 2 * 1.96 * np.sqrt(0.8 * 0.2 / 480)


def test_where_all_are_right_the_area_is_not_known():
    runs = np.arange(40) // 10
    found = confidence_figures(
        np.full((2, 40), 0.9), np.ones((2, 40), dtype=bool), runs, np.zeros(40), np.random.default_rng(0)
    )
    assert np.isnan(found.auc)
    assert np.isnan(found.auc_ci).all()
    assert found.at_coverage[0].accuracy == 1.0
    assert found.ece == pytest.approx(0.1)
