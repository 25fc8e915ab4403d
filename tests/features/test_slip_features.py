import numpy as np
import pytest

from features.slip_features import SLIP_STATISTICS, slip_statistics


def draw_slip(n_samples=40):
    return np.random.default_rng(0).normal(0.1, 0.2, (5, 2, n_samples))


def test_statistics_are_those_of_the_samples_that_are_known():
    slip = draw_slip()
    slip[:, :, ::3] = np.nan
    known = slip[1, 1][np.isfinite(slip[1, 1])]
    expected = [known.mean(), known.std(), known.min(), known.max(), np.abs(known).mean(), np.median(known)]
    assert len(expected) == len(SLIP_STATISTICS)
    np.testing.assert_allclose(slip_statistics(slip)[1, 1], expected)


def test_unknown_samples_are_as_if_they_were_not_there_wherever_they_stand():
    slip = draw_slip()
    with_holes = np.concatenate([np.full((5, 2, 20), np.nan), slip], axis=2)
    np.testing.assert_allclose(slip_statistics(with_holes), slip_statistics(slip), rtol=1e-12)


@pytest.mark.parametrize("unknown", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("n_unknown", [19, 20, 21, 40])
def test_with_over_half_unknown_the_slip_is_not_known_rather_than_zero(n_unknown, unknown):
    slip = draw_slip()
    slip[0, 1, :n_unknown] = unknown
    found = slip_statistics(slip)
    assert np.isnan(found[0, 1]).all() == (n_unknown > 20)
    assert np.isfinite(found[0, 0]).all()
    assert np.isfinite(found[1:]).all()
    if n_unknown <= 20:
        np.testing.assert_allclose(found[0, 1, 0], slip[0, 1, n_unknown:].mean())


def test_no_windows_give_no_rows():
    assert slip_statistics(np.empty((0, 2, 10))).shape == (0, 2, len(SLIP_STATISTICS))
