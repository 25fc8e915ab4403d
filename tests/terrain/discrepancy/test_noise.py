"""Noise that is coloured and grows with speed comes out white, of size one."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from terrain.discrepancy.noise import LONGEST_MEMORY_S, ORDER, WHITE, noise_of, whiten

GROWTH = np.array([[0.2, 0.0, 0.8], [1e-4, 3e-4, 0.0]])
"""Coefficients of the variance in 1, v and v^2, of two channels."""

KEEP = np.array([0.8, 0.3])
"""Of each channel's noise, from row to row."""

ROW_S = 0.2


def runs(n_runs, n_rows, seed=0):
    """Return speeds and noise of runs: AR(1) times what speed makes of it."""
    rng = np.random.default_rng(seed)
    speeds, residuals = [], []
    for _ in range(n_runs):
        speed = np.abs(0.6 * np.sin(0.01 * np.arange(n_rows) + rng.uniform(0, 6)) + 0.3)
        x = np.zeros((n_rows, 2))
        x[0] = rng.standard_normal(2)
        for k in range(1, n_rows):
            x[k] = KEEP * x[k - 1] + np.sqrt(1 - KEEP**2) * rng.standard_normal(2)
        speeds.append(speed)
        residuals.append(x * np.sqrt(np.column_stack([speed**0, speed, speed**2]) @ GROWTH.T))
    return speeds, residuals


def test_coloured_noise_that_grows_with_speed_comes_out_white():
    speeds, residuals = runs(8, 1500)
    noise = noise_of(residuals, speeds, 0.2, 0)
    at = np.array([0.1, 0.4, 0.8])
    expected = np.sqrt(np.column_stack([at**0, at, at**2]) @ GROWTH.T)
    assert_allclose(noise.size(at), expected, rtol=0.12)
    assert_allclose(noise.size(-at), noise.size(at))
    assert_allclose(
        noise.std, [np.std(np.concatenate([r[:, c] for r in residuals])) for c in (0, 1)], rtol=0.02
    )
    white = np.concatenate(
        [
            whiten(noise.filters, (r / noise.size(v))[None])[0, ORDER:]
            for r, v in zip(residuals, speeds, strict=True)
        ]
    )
    fast = np.concatenate([v[ORDER:] for v in speeds]) > 0.5
    std = 1 / np.sqrt(2 * len(white))
    for c in (0, 1):
        assert np.std(white[:, c]) == pytest.approx(1.0, abs=4 * std)
        assert np.std(white[fast, c]) == pytest.approx(np.std(white[~fast, c]), rel=0.08)
        for lag in (1, 2, 5):
            correlation = np.corrcoef(white[lag:, c], white[:-lag, c])[0, 1]
            assert abs(correlation) < 4 / np.sqrt(len(white)), (c, lag)


def test_fitted_effects_reduce_the_residuals():
    """A hundred numbers take a hundred degrees of freedom away, shared by the two channels."""
    speeds, residuals = runs(2, 300)
    plain, fitted = (noise_of(residuals, speeds, 0.2, n) for n in (0, 100))
    grown = np.sqrt(1 / (1 - 100 / (2 * 2 * 300)))
    assert_allclose(fitted.std / plain.std, grown, rtol=0.005)
    assert_allclose(plain.filters[:, 0] / fitted.filters[:, 0], grown, rtol=0.005)


def test_the_filter_is_a_convolution_and_stops_where_something_is_unknown():
    rng = np.random.default_rng(1)
    x = rng.standard_normal((3, 50, 2))
    x[1, 20, 0] = np.nan
    filters = rng.standard_normal((2, ORDER + 1))
    out = whiten(filters, x)
    for j in range(3):
        for c in range(2):
            expected = np.convolve(x[j, :, c], filters[c])[:50]
            expected[:ORDER] = 0.0
            expected[np.isnan(expected)] = 0.0
            assert_allclose(out[j, :, c], expected, atol=1e-12)
    assert (out[1, 20 : 21 + ORDER, 0] == 0).all()


def test_a_channel_that_is_hardly_measured_or_never_differs_has_no_filter():
    speeds, residuals = runs(3, 300)
    gone = [
        np.column_stack([r[:, 0], np.where(np.arange(300) < 12, r[:, 1], np.nan), 0 * r[:, 0]])
        for r in residuals
    ]
    noise = noise_of(gone, speeds, 0.2, 0)
    assert np.isfinite(noise.filters).all(axis=1).tolist() == [True, False, False]
    assert np.isfinite(noise.std).tolist() == [True, False, False]
    holes = [r.copy() for r in residuals]
    for r in holes:
        r[100:140] = np.nan
    assert_allclose(noise_of(holes, speeds, 0.2, 0).std, noise_of(residuals, speeds, 0.2, 0).std, rtol=0.15)


def autoregression(residuals, order=ORDER):
    """Return the filter (order + 1,) of one-column residuals by plain least squares, white of size one."""
    table = np.concatenate([np.lib.stride_tricks.sliding_window_view(r[:, 0], order + 1) for r in residuals])
    weights, left, *_ = np.linalg.lstsq(table[:, -2::-1], table[:, -1], rcond=None)
    return np.concatenate([[1.0], -weights]) / np.sqrt(left[0] / len(table))


def at_zero_frequency(filters):
    """Return the gain of a filter that whitens noise of size one over that of the longest memory."""
    return abs(filters.sum()) / np.sqrt(ROW_S / (2 * LONGEST_MEMORY_S))


def coloured(keep, n_runs=8, n_rows=400):
    """Return noise of size one of runs that move at 1 m/s."""
    rng = np.random.default_rng(5)
    out = []
    for _ in range(n_runs):
        x = rng.standard_normal((n_rows, 1))
        for k in range(1, n_rows):
            x[k] = keep * x[k - 1] + np.sqrt(1 - keep**2) * x[k]
        out.append(x)
    return out, [np.ones(n_rows)] * n_runs


def test_memory_within_the_bound_is_that_of_least_squares_and_a_longer_one_is_drawn_in_to_it():
    short, speeds = coloured(0.6)
    noise = noise_of(short, speeds, ROW_S, 0, (1,))
    size = noise.size(np.ones(1))[0, 0]
    plain = autoregression([x / size for x in short], 1)
    assert_allclose(noise.filters[0, :2] / noise.filters[0, 0], plain / plain[0], rtol=1e-6)
    assert at_zero_frequency(plain) > 1.3
    long, speeds = coloured(0.98)
    noise = noise_of(long, speeds, ROW_S, 0)
    plain = autoregression([x / noise.size(np.ones(1))[0, 0] for x in long])
    assert at_zero_frequency(plain) < 0.7
    assert 0.98 < at_zero_frequency(noise.filters[0]) < 1.3


def test_steps_that_last_do_not_take_the_gain_at_zero_frequency_away():
    """A robot that turns less than it should leaves a residual of one level a command."""
    rng = np.random.default_rng(6)
    levels = [
        np.repeat(rng.choice([-1.0, 1.0], 2), 100)[:, None] + 0.02 * rng.standard_normal((200, 1))
        for _ in range(8)
    ]
    noise = noise_of(levels, [np.ones(200)] * 8, ROW_S)
    assert at_zero_frequency(autoregression(levels)) < 0.3
    assert at_zero_frequency(noise.filters[0]) > 0.98


def test_a_level_is_not_swallowed():
    """Weights that start white find a level of 1 in 40 runs of 8 s, and those behind it ten times clearer."""
    rng = np.random.default_rng(7)
    levels = [1.0 + 0.1 * rng.standard_normal((40, 1)) for _ in range(40)]
    speeds = [np.ones(40)] * 40

    def mean_and_z(noise):
        ones = np.ones((40, 1)) / noise.size(speeds[0])
        white = [whiten(noise.filters, np.stack([ones, r / noise.size(speeds[0])])) for r in levels]
        power = sum((both[0, ORDER:] ** 2).sum() for both in white)
        cross = sum((both[0, ORDER:] * both[1, ORDER:]).sum() for both in white)
        return cross / power, cross / np.sqrt(power)

    mean, z = mean_and_z(noise_of(levels, speeds, ROW_S, orders=WHITE))
    assert z == pytest.approx(np.sqrt(40 * (40 - ORDER)), rel=0.02)
    left = noise_of([r - mean for r in levels], speeds, ROW_S, 1)
    mean, z = mean_and_z(left)
    assert mean == pytest.approx(1.0, abs=4 * 0.1 / np.sqrt(40 * (40 - ORDER)))
    assert z > 300
    # colour that is fitted to the level itself at once leaves a tenth of it, by the bound, but never nothing
    _, z = mean_and_z(noise_of(levels, speeds, ROW_S))
    assert z > 10
