import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from features.statistics import STATISTICS, channel_correlations, channel_statistics

NAMES = [name for name, _ in STATISTICS]
IN_SIGNAL_UNITS = [name for name, unit in STATISTICS if unit == "x"]
LEVELS = ["mean", "min", "max", "q05", "q25", "median", "q75", "q95"]
RATE_HZ = 25.0

seeds = st.integers(0, 2**32 - 1)


def table(values, rate_hz=RATE_HZ):
    """Return the statistics by name, each (n_windows, n_channels)."""
    return dict(zip(NAMES, np.moveaxis(channel_statistics(values, rate_hz), 2, 0), strict=True))


def by_numpy(x):
    """Return what each statistic of one channel in one window is defined to be."""
    x = x.astype(float)
    d = x - x.mean()
    q05, q25, median, q75, q95 = np.quantile(x, [0.05, 0.25, 0.5, 0.75, 0.95])
    steps = np.abs(np.diff(x)).mean()
    expected = {
        "mean": x.mean(),
        "std": x.std(),
        "log_std": np.log10(x.std() + 1e-4),
        "skewness": stats.skew(x),
        "kurtosis": stats.kurtosis(x),
        "min": x.min(),
        "max": x.max(),
        "q05": q05,
        "q25": q25,
        "median": median,
        "q75": q75,
        "q95": q95,
        "iqr": stats.iqr(x),
        "rms": np.sqrt(np.mean(x**2)),
        "mean_abs": np.abs(x).mean(),
        "crest": np.abs(d).max() / x.std(),
        "zero_crossings": np.count_nonzero(np.diff(d >= 0)) * RATE_HZ / x.size,
        "mean_abs_step": steps,
        "log_step_ratio": np.log10((steps + 1e-4) / x.std()),
    }
    for lag in (1, 2, 4, 8):
        expected[f"autocorrelation_{lag}"] = d[lag:] @ d[:-lag] / (d @ d) if lag < x.size else 0.0
    return expected


def draw_values(seed, n_samples):
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-2, 3, (3, 2, 1))
    values = rng.standard_t(4, (3, 2, n_samples)).cumsum(axis=2) * scale
    return values + scale * rng.uniform(-3, 3, (3, 2, 1))


@settings(deadline=None, max_examples=50)
@given(seeds, st.integers(4, 220))
def test_kernel_agrees_with_numpy_and_scipy(seed, n_samples):
    values = draw_values(seed, n_samples)
    found = table(values)
    for i, c in np.ndindex(3, 2):
        for name, expected in by_numpy(values[i, c]).items():
            assert found[name][i, c] == pytest.approx(expected, rel=1e-9, abs=1e-9), name


@settings(deadline=None, max_examples=30)
@given(seeds, st.floats(0.5, 20.0))
def test_scaling_a_signal_scales_its_levels_and_leaves_its_shape(seed, factor):
    values = draw_values(seed, 100)
    before, after = table(values), table(factor * values)
    for name in IN_SIGNAL_UNITS:
        np.testing.assert_allclose(after[name], factor * before[name], rtol=1e-9, atol=1e-9)
    for name in ("skewness", "kurtosis", "crest", "zero_crossings", *NAMES[-4:]):
        np.testing.assert_allclose(after[name], before[name], rtol=1e-7, atol=1e-7)


@settings(deadline=None, max_examples=30)
@given(seeds, st.floats(-50.0, 50.0))
def test_a_bias_moves_the_levels_and_nothing_else(seed, bias):
    values = draw_values(seed, 100)
    before, after = table(values), table(values + bias)
    for name in set(NAMES) - {"rms", "mean_abs"}:
        moved = bias if name in LEVELS else 0.0
        np.testing.assert_allclose(after[name], before[name] + moved, rtol=1e-6, atol=1e-7, err_msg=name)


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_time_run_backwards_changes_nothing(seed):
    values = draw_values(seed, 100)
    for name, before in table(values).items():
        np.testing.assert_allclose(table(values[:, :, ::-1])[name], before, rtol=1e-9, atol=1e-9)


def test_crossings_per_second_of_a_tone_are_twice_its_frequency_at_every_rate():
    for rate_hz in (40.0, 100.0, 333.0):
        x = np.sin(2 * np.pi * 3.0 * np.arange(4 * int(rate_hz)) / rate_hz + 0.1)[None, None]
        assert table(x, rate_hz)["zero_crossings"][0, 0] == pytest.approx(6.0, abs=0.3)


@pytest.mark.parametrize("level", [0.0, 9.81, -1e3])
def test_a_constant_channel_has_no_shape_features(level):
    found = table(np.full((1, 1, 50), level))
    for name in NAMES:
        expected = {"log_std": -4.0, "rms": abs(level), "mean_abs": abs(level)}.get(
            name, level if name in LEVELS else 0.0
        )
        assert found[name][0, 0] == pytest.approx(expected, abs=1e-9), name


@pytest.mark.parametrize("dtype", [np.float32, np.int64])
def test_layout_and_type_of_the_array_do_not_matter(dtype):
    values = (100 * draw_values(0, 60)).astype(dtype)
    strided = np.asfortranarray(values)
    np.testing.assert_array_equal(
        channel_statistics(strided, 10.0), channel_statistics(values.astype(float), 10.0)
    )
    np.testing.assert_array_equal(channel_correlations(strided), channel_correlations(values.astype(float)))


@settings(deadline=None, max_examples=30)
@given(seeds, st.integers(2, 7), st.integers(4, 100))
def test_correlations_agree_with_numpy_and_ignore_scale_and_bias(seed, n_channels, n_samples):
    rng = np.random.default_rng(seed)
    mixing = rng.standard_normal((n_channels, n_channels))
    values = mixing @ rng.standard_normal((3, n_channels, n_samples))
    pairs = np.triu_indices(n_channels, 1)
    expected = [np.corrcoef(window)[pairs] for window in values]
    np.testing.assert_allclose(channel_correlations(values), expected, atol=1e-10)
    scale, bias = rng.uniform(0.1, 10, (n_channels, 1)), rng.uniform(-5, 5, (n_channels, 1))
    np.testing.assert_allclose(channel_correlations(scale * values + bias), expected, atol=1e-10)


def test_a_flat_channel_correlates_with_nothing():
    values = np.stack([np.arange(20.0), np.full(20, 0.1)])[None]
    assert channel_correlations(values).tolist() == [[0.0]]
    assert channel_correlations(values[:, :1]).shape == (1, 0)
