import numpy as np
import pytest

from terrain.bootstrap import (
    bootstrap_counts,
    bootstrap_rows,
    percentile_interval,
    shared_strata,
    stratified_counts,
)


def test_a_sample_has_as_many_runs_as_there_are_and_draws_each_alike():
    counts = bootstrap_counts(5, 4000, 0)
    assert counts.shape == (4000, 5)
    assert (counts.sum(axis=1) == 5).all()
    rows = bootstrap_rows(5, 4000, np.random.default_rng(0))
    drawn = np.bincount(rows.ravel(), minlength=5)
    for total in (counts.sum(axis=0), drawn):
        np.testing.assert_allclose(total, 4000, atol=5 * np.sqrt(20_000 * 0.2 * 0.8))


def test_the_interval_of_a_mean_is_that_of_its_standard_error():
    rng = np.random.default_rng(1)
    values = rng.standard_normal(200)
    low, high = percentile_interval(bootstrap_counts(200, 4000, 2) @ values / 200)
    half = 1.96 * values.std() / np.sqrt(200)
    assert low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_a_draw_without_a_value_is_skipped():
    assert percentile_interval(np.array([np.nan, 0.0, 1.0]), 0.5) == (0.25, 0.75)


def test_classes_that_units_link_through_others_are_one_stratum():
    unit, terrain = np.array(list("aabbccd")), np.array(list("vwwxxyz"))
    assert shared_strata(unit, terrain).tolist() == ["v, w, x, y"] * 6 + ["z"]


@pytest.mark.parametrize("n_units", [(3,), (2, 2), (2, 2, 2), (4, 3), (12,)])
def test_the_interval_of_few_units_holds_the_truth_as_often_as_it_says(n_units):
    rng, stratum = np.random.default_rng(0), np.repeat(np.arange(len(n_units)), n_units)
    weights, freedom = stratified_counts(stratum, 400, rng), len(stratum) - len(n_units)
    found = (
        percentile_interval(weights @ rng.standard_normal(len(stratum)), freedom=freedom) for _ in range(400)
    )
    assert 0.92 < np.mean([low <= 0.0 <= high for low, high in found]) < 0.98
