"""Noise that is coloured and grows with speed comes out white, of size one."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from terrain.discrepancy.noise import LONGEST_MEMORY_S, ORDER, WHITE, noise_of, whiten

GROWTH = np.array([[0.2, 0.0, 0.8], [1e-4, 3e-4, 0.0]])
"""Coefficients of the variance in 1, v and v^2, of two channels."""

ROW_S = 0.2


def coloured(keep, n_runs=8, n_rows=400, seed=5):
    """Return noise of size one (n_rows, channels) of each run, which keeps so much from row to row."""
    rng, out = np.random.default_rng(seed), []
    for _ in range(n_runs):
        x = rng.standard_normal((n_rows, np.size(keep)))
        for k in range(1, n_rows):
            x[k] = np.asarray(keep) * x[k - 1] + np.sqrt(1 - np.square(keep)) * x[k]
        out.append(x)
    return out


def runs(n_runs, n_rows):
    """Return speeds and noise of runs: AR(1) times what speed makes of it."""
    speeds = [np.abs(0.6 * np.sin(0.01 * np.arange(n_rows) + i) + 0.3) for i in range(n_runs)]
    noise = zip(speeds, coloured([0.8, 0.3], n_runs, n_rows), strict=True)
    return speeds, [x * np.sqrt(np.column_stack([v**0, v, v**2]) @ GROWTH.T) for v, x in noise]


def test_coloured_noise_that_grows_with_speed_comes_out_white():
    speeds, residuals = runs(8, 1500)
    noise = noise_of(residuals, speeds, ROW_S)
    at = np.array([0.1, 0.4, 0.8])
    assert_allclose(noise.size(at), np.sqrt(np.column_stack([at**0, at, at**2]) @ GROWTH.T), rtol=0.12)
    assert_allclose(noise.size(-at), noise.size(at))
    assert_allclose(noise.std, np.std(np.concatenate(residuals), axis=0), rtol=0.02)
    scaled = [(r / noise.size(v))[None] for r, v in zip(residuals, speeds, strict=True)]
    white = np.concatenate([whiten(noise.filters, x)[0, ORDER:] for x in scaled])
    fast = np.concatenate([v[ORDER:] for v in speeds]) > 0.5
    for c in (0, 1):
        assert np.std(white[:, c]) == pytest.approx(1.0, abs=4 / np.sqrt(2 * len(white)))
        assert np.std(white[fast, c]) == pytest.approx(np.std(white[~fast, c]), rel=0.08)
        for lag in (1, 2, 5):
            assert abs(np.corrcoef(white[lag:, c], white[:-lag, c])[0, 1]) < 4 / np.sqrt(len(white)), (c, lag)


def test_fitted_effects_reduce_the_residuals():
    """A hundred numbers take a hundred degrees of freedom away, shared by the two channels."""
    speeds, residuals = runs(2, 300)
    plain, fitted = (noise_of(residuals, speeds, ROW_S, n) for n in (0, 100))
    grown = np.sqrt(1 / (1 - 100 / (2 * 2 * 300)))
    assert_allclose(fitted.std / plain.std, grown, rtol=0.005)
    assert_allclose(plain.filters[:, 0] / fitted.filters[:, 0], grown, rtol=0.005)


def test_the_filter_is_a_convolution_and_stops_where_something_is_unknown():
    rng = np.random.default_rng(1)
    x, filters = rng.standard_normal((3, 50, 2)), rng.standard_normal((2, ORDER + 1))
    x[1, 20, 0] = np.nan
    out = whiten(filters, x)
    for j in range(3):
        for c in range(2):
            expected = np.convolve(x[j, :, c], filters[c])[:50]
            expected[:ORDER] = 0.0
            assert_allclose(out[j, :, c], np.nan_to_num(expected), atol=1e-12)
    assert (out[1, 20 : 21 + ORDER, 0] == 0).all()


def test_a_channel_that_is_hardly_measured_or_never_differs_has_no_filter():
    speeds, residuals = runs(3, 300)
    few = np.arange(300) < 12
    gone = [np.column_stack([r[:, 0], np.where(few, r[:, 1], np.nan), 0 * r[:, 0]]) for r in residuals]
    noise = noise_of(gone, speeds, ROW_S)
    assert np.isfinite(noise.filters).all(axis=1).tolist() == [True, False, False]
    assert np.isfinite(noise.std).tolist() == [True, False, False]
    inside = (np.arange(300) >= 100) & (np.arange(300) < 140)
    holes = [np.where(inside[:, None], np.nan, r) for r in residuals]
    assert_allclose(noise_of(holes, speeds, ROW_S).std, noise_of(residuals, speeds, ROW_S).std, rtol=0.15)


def autoregression(residuals, order=ORDER):
    """Return the filter (order + 1,) of one-column residuals by plain least squares, white of size one."""
    table = np.concatenate([np.lib.stride_tricks.sliding_window_view(r[:, 0], order + 1) for r in residuals])
    weights, left, *_ = np.linalg.lstsq(table[:, -2::-1], table[:, -1], rcond=None)
    return np.concatenate([[1.0], -weights]) / np.sqrt(left[0] / len(table))


def at_zero_frequency(filters):
    """Return the gain of a filter that whitens noise of size one over that of the longest memory."""
    return abs(filters.sum()) / np.sqrt(ROW_S / (2 * LONGEST_MEMORY_S))


def test_memory_within_the_bound_is_that_of_least_squares_and_a_longer_one_is_drawn_in_to_it():
    speeds = [np.ones(400)] * 8
    for keep, orders in ((0.6, (1,)), (0.98, (ORDER, 3, 1))):
        residuals = coloured(keep)
        noise = noise_of(residuals, speeds, ROW_S, orders=orders)
        plain = autoregression([x / noise.size(np.ones(1))[0, 0] for x in residuals], orders[0])
        if keep == 0.6:
            assert_allclose(noise.filters[0, :2] / noise.filters[0, 0], plain / plain[0], rtol=1e-6)
            assert at_zero_frequency(plain) > 1.3
        else:
            assert at_zero_frequency(plain) < 0.7
            assert 0.98 < at_zero_frequency(noise.filters[0]) < 1.3


def test_levels_are_not_swallowed():
    """Steps that last leave the gain at zero frequency; weights that start white find a level ten times clearer."""
    rng = np.random.default_rng(6)
    steps = [np.repeat(rng.choice([-1.0, 1.0], 2), 100)[:, None] for _ in range(8)]
    noisy = [step + 0.02 * rng.standard_normal((200, 1)) for step in steps]
    assert at_zero_frequency(autoregression(noisy)) < 0.3
    assert at_zero_frequency(noise_of(noisy, [np.ones(200)] * 8, ROW_S).filters[0]) > 0.98
    levels, speeds = [1.0 + 0.1 * rng.standard_normal((40, 1)) for _ in range(40)], [np.ones(40)] * 40

    def mean_and_z(noise):
        size = noise.size(speeds[0])
        white = [whiten(noise.filters, np.stack([1.0 / size, r / size]))[:, ORDER:] for r in levels]
        power = sum((ones**2).sum() for ones, _ in white)
        cross = sum((ones * seen).sum() for ones, seen in white)
        return cross / power, cross / np.sqrt(power)

    mean, z = mean_and_z(noise_of(levels, speeds, ROW_S, orders=WHITE))
    assert z == pytest.approx(np.sqrt(40 * (40 - ORDER)), rel=0.02)
    mean, z = mean_and_z(noise_of([r - mean for r in levels], speeds, ROW_S, 1))
    assert mean == pytest.approx(1.0, abs=4 * 0.1 / np.sqrt(40 * (40 - ORDER)))
    assert z > 300
    # colour that is fitted to the level itself at once leaves a tenth of it, by the bound, but never nothing
    assert mean_and_z(noise_of(levels, speeds, ROW_S))[1] > 10
