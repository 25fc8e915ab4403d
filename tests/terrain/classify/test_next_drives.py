"""Next drives: the law of growth is found again, and the gain has the signs that it must have."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.classify.next_drives import Cells, Growth, expected_gain, fit_growth


@pytest.mark.parametrize("law", [Growth(0.05, 0.7, 1.0), Growth(0.0, 0.9, 0.5)])
def test_a_hidden_law_is_found(law):
    rng = np.random.default_rng(1)
    n_runs = rng.integers(0, 13, 60_000)
    right = rng.random(len(n_runs)) >= law.error(n_runs)
    found = fit_growth(n_runs, right)
    np.testing.assert_allclose(found.error(np.arange(13)), law.error(np.arange(13)), atol=0.03)


def test_two_numbers_of_runs_show_no_law():
    assert fit_growth(np.array([0, 0, 4, 4]), np.array([False, True, True, True])) is None


def cells(ratio=0.2, n_windows=50.0, n_errors=20.0, held_out=2.0, runs=2.5):
    return Cells(*(np.array([value]) for value in (ratio, n_windows, n_errors, held_out, runs)))


LAWS = st.builds(Growth, st.floats(0, 0.3), st.floats(0.05, 0.7), st.floats(0.1, 2))


@given(LAWS, st.floats(0, 20), st.integers(1, 6))
def test_a_gain_is_never_negative_nor_more_than_the_errors_of_its_cell(law, runs, added):
    gain = expected_gain(law, cells(runs=runs, held_out=runs), added)[0]
    assert 0 <= gain <= 0.2
    assert gain <= expected_gain(law, cells(runs=runs, held_out=runs), added + 1)[0]


@given(LAWS)
def test_errors_and_expected_driving_raise_a_gain_and_support_lowers_it(law):
    gain = expected_gain(law, cells())[0]
    assert expected_gain(law, cells(n_errors=40.0))[0] > gain
    assert expected_gain(law, cells(ratio=0.4))[0] == pytest.approx(2 * gain)
    assert expected_gain(law, cells(runs=9.0))[0] < gain
