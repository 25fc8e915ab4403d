"""Delays that were put in come back within their own errors; a low-pass and a resampling have plain forms."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from terrain.signals import (
    DelayStatus,
    Pair,
    at_times,
    common_delay,
    delay,
    low_pass,
    peak,
    refine_delay,
    resampled,
)

STEP_S = 0.02
LAGS_S = np.arange(-1.0, 2.0 + 1e-9, 0.1)


def hidden_pair(seed, lag_s, rate, gain=0.7):
    """Random motion on a fine grid, and its noisy samples on another clock, one of ten missing."""
    rng = np.random.default_rng(seed)
    motion = gaussian_filter1d(rng.standard_normal(4000), 20)
    motion /= motion.std()
    fine_s, time_s = STEP_S * np.arange(motion.size), np.arange(3.0, 76.0, 0.1)
    middle_s = float(time_s.mean())
    late = np.interp(time_s - lag_s - rate * (time_s - middle_s), fine_s, motion)
    measured = gain * late + 0.3 + 0.05 * rng.standard_normal(time_s.size)
    measured[rng.random(time_s.size) < 0.1] = np.nan
    return Pair(time_s, measured, STEP_S, motion, np.gradient(motion, STEP_S), middle_s)


@pytest.mark.parametrize(("from_hz", "to_hz"), [(200.0, 100.0), (100.0, 65.0), (15.0, 6.5), (50.0, 100.0)])
def test_a_resampling_keeps_waves_below_both_nyquist_frequencies_and_no_others(from_hz, to_hz):
    """A low wave is that wave at the other instants, a ramp goes on to the ends, and a high one leaves nothing."""
    from_s, to_s = np.arange(0.0, 20.0, 1.0 / from_hz), np.arange(0.0, 20.0 - 1e-9, 1.0 / to_hz)
    lower_hz, inside = min(from_hz, to_hz) / 2.0, (to_s > 4.0) & (to_s < 16.0)

    def through(signal):
        return resampled(signal(from_s), from_hz, to_s.size, to_hz), signal(to_s)

    for ratio in (0.1, 0.5, 0.85):
        found, wave = through(lambda s, f=ratio * lower_hz: np.sin(2 * np.pi * f * s + 0.3))
        assert np.abs(found - wave)[inside].max() < 0.02
    found, ramp = through(lambda s: 3.0 - 0.2 * s)
    np.testing.assert_allclose(found, ramp, atol=1e-5)
    if to_hz < 0.7 * from_hz:
        found, _ = through(lambda s: np.sin(2 * np.pi * 1.25 * lower_hz * s))
        assert np.abs(found[inside]).max() < 0.02
    holed = np.where(np.arange(from_s.size) // 20 % 3 == 1, np.nan, np.cos(from_s))
    known = np.isfinite(resampled(np.stack([holed, np.cos(from_s)]), from_hz, to_s.size, to_hz))
    assert known[1].all()
    nearest = holed[np.round(to_s * from_hz).astype(int).clip(max=holed.size - 1)]
    assert (known[0] == np.isfinite(nearest)).mean() > 0.9  # half of the weight is on either side


@pytest.mark.parametrize(("lag_s", "rate"), [(0.3, 0.0), (-0.4, 0.004), (1.2, -0.003)])
def test_a_hidden_delay_and_rate_come_back_within_their_errors(lag_s, rate):
    scores = []
    for seed in range(6):
        pair = hidden_pair(seed, lag_s, rate)
        found = delay(pair, LAGS_S, same_peak_s=0.5, floor=0.02, rate_max=0.03)
        assert found.status is DelayStatus.ESTIMATED
        fit = found.fit
        scores.append((np.array([fit.lag_s, fit.rate]) - [lag_s, rate]) / np.sqrt(np.diag(fit.cov)))
        assert fit.gain == pytest.approx(0.7, abs=5 * fit.gain_std)
    assert np.abs(scores).max() < 4.0
    assert 0.4 < np.sqrt(np.mean(np.square(scores))) < 1.8


def test_compiled_correlations_equal_the_plain_form():
    pair = hidden_pair(3, 0.3, 0.0)
    found = pair.correlations(LAGS_S, 0.002)
    for lag_s, value in zip(LAGS_S, found, strict=True):
        seen = pair.at(pair.time_s - lag_s - 0.002 * (pair.time_s - pair.middle_s))
        both = np.isfinite(seen + pair.measured)
        assert value == pytest.approx(np.corrcoef(seen[both], pair.measured[both])[0, 1], abs=1e-9)


def test_a_periodic_signal_has_a_rival_and_what_diverges_is_no_delay():
    fine_s, time_s = STEP_S * np.arange(4000), np.arange(3.0, 76.0, 0.1)
    wave, slope = np.sin(2 * np.pi * fine_s), 2 * np.pi * np.cos(2 * np.pi * fine_s)
    pair = Pair(time_s, np.sin(2 * np.pi * (time_s - 0.3)), STEP_S, wave, slope, 0.0)
    assert delay(pair, LAGS_S, same_peak_s=0.5, floor=0.02, rate_max=0.03).status is DelayStatus.AMBIGUOUS
    assert refine_delay(pair, 0.8, 0.0, near_s=0.1, rate_max=0.03) is None  # the gain would be negative


def test_a_common_delay_is_the_peak_of_all_runs():
    rng = np.random.default_rng(2)
    lags_s = np.arange(-0.4, 1.2, 0.02)
    runs = [-((lags_s - 0.31 - 0.05 * rng.standard_normal()) ** 2) for _ in range(40)]
    found = common_delay(lags_s, runs)
    assert found.status is DelayStatus.ESTIMATED
    assert abs(found.delay_s - 0.31) < 3 * found.std_s
    assert found.std_s == pytest.approx(0.05 / np.sqrt(40), rel=0.4)
    assert common_delay(lags_s, runs, max_std_s=1e-3).applied_s == 0.0
    assert common_delay(lags_s, [lags_s] * 5).status is DelayStatus.UNDETERMINED  # highest at the end
    assert common_delay(lags_s, []).n_runs == 0
    assert peak(lags_s, lags_s) == lags_s[-1]


def test_a_low_pass_reaches_its_input_and_begins_as_asked():
    values = np.column_stack([np.ones(200), np.arange(200.0)])
    smooth = low_pass(values, 0.01, 0.1)
    np.testing.assert_allclose(smooth[:, 0], 1.0 - np.exp(-0.1 * np.arange(1, 201)), atol=1e-12)
    np.testing.assert_array_equal(low_pass(values, 0.01, 0.1, at_first=True)[:, 0], 1.0)
    np.testing.assert_array_equal(low_pass(values, 0.01, 0.0), values)


def test_nothing_is_interpolated_outside_or_over_a_gap():
    time_s, values = np.array([0.0, 1.0, 2.0, 9.0]), np.array([[0.0], [10.0], [20.0], [90.0]])
    found = at_times(time_s, values, np.array([-1.0, 0.5, 1.25, 5.0, 10.0]), 2.0)[:, 0]
    np.testing.assert_array_equal(found, [np.nan, 5.0, 12.5, np.nan, np.nan])
