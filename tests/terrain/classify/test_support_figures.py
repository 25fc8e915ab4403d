"""Accuracy by support: parts that add up, and intervals over runs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.classify.next_drives import HeldOutSupport, support_accuracy


def drawn(seed, n=80, repeats=3):
    rng = np.random.default_rng(seed)
    runs = rng.integers(0, 8, (2, repeats, n))
    probability = rng.random((repeats, n))
    right = rng.random((repeats, n)) < 0.3 + 0.6 * runs[0] / 8
    place = np.sort(rng.integers(0, 10, n))
    return (
        HeldOutSupport(right, runs[0], runs[1], probability, probability > 0.5),
        place.astype(str),
        np.where(place < 5, "ice", "mud"),
    )


@given(st.integers(0, 1000))
def test_levels_and_marks_divide_windows_and_errors(seed):
    held_out, run_id, terrain = drawn(seed)
    found = support_accuracy(held_out, run_id, terrain, np.random.default_rng(0))
    for parts in (list(found.by_true_terrain.values()), [found.unsupported, found.supported]):
        assert sum(part.windows_ratio for part in parts) == pytest.approx(1)
        assert sum(part.errors_ratio for part in parts) == pytest.approx(1)
        mean = sum(part.windows_ratio * (part.accuracy or 0) for part in parts)
        assert mean == pytest.approx(held_out.correct.mean())
        for part in parts:
            low, high = part.windows_ratio_ci
            assert low <= high


def test_the_interval_covers_the_accuracy_that_runs_are_drawn_from():
    held_out, run_id, terrain = drawn(7, n=4000)
    found = support_accuracy(held_out, run_id, terrain, np.random.default_rng(0)).supported
    low, high = found.accuracy_ci
    assert low < found.accuracy < high
    assert high - low < 0.1


def test_a_part_without_windows_has_no_accuracy_and_no_errors_have_no_ratio():
    ones = np.ones((1, 6), dtype=int)
    held_out = HeldOutSupport(ones > 0, 9 * ones, 9 * ones, 0.9 * ones, ones > 0)
    found = support_accuracy(held_out, np.array(list("aabbcc")), np.full(6, "ice"), np.random.default_rng(0))
    assert found.unsupported == (0.0, (0.0, 0.0), None, None, None, None)
    assert found.supported.accuracy == 1.0
    assert found.auc is None


def test_the_same_source_gives_the_same_intervals():
    results = [support_accuracy(*drawn(3), np.random.default_rng(1)) for _ in range(2)]
    assert results[0] == results[1]
