"""One clock and one delay: signals of any rate behind a low-pass, at the ticks of another sensor."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from terrain.estimation.feed import LINE, TICK_S, at_tick, low_pass_step, signal_limits, take
from terrain.estimation.table import median_step_s
from terrain.kernels import filled, njit
from terrain.records import Array


def low_pass(time_s: Array, value: Array, time_constant_s: float, gap_s: float) -> Array:
    """Return a signal (n,) behind a first-order low-pass, exact if it runs straight from sample to sample.

    Parameters
    ----------
    time_s : (n,) strictly increasing, in any steps
    value : (n,) finite
    time_constant_s : tau; 0 gives the signal back
    gap_s : the filter starts anew at the first sample, and after every longer step

    Examples
    --------
    >>> time_s = np.array([0.0, 0.1, 0.3, 0.9])
    >>> (2.0 * time_s - low_pass(time_s, 2.0 * time_s, 0.05, 1.0)).round(4)  # tends to 2.0 * 0.05
    array([0.    , 0.0865, 0.0998, 0.1   ])
    """
    return _low_pass(time_s, value, time_constant_s, gap_s) if time_constant_s > 0 else value


@njit
def _low_pass(time_s: Array, value: Array, time_constant_s: float, gap_s: float) -> Array:
    out = np.empty_like(value)
    for k in range(value.size):
        step_s = time_s[k] - time_s[k - 1]
        out[k] = value[k]
        if k > 0 and not step_s > gap_s:
            out[k] = low_pass_step(value[k], value[k - 1], out[k - 1], step_s, time_constant_s)
    return out


def on_clock(
    clock: Array, time_s: Array, signals: Mapping[str, Array], time_constant_s: float
) -> dict[str, Array]:
    """Return each signal behind the low-pass, at the ticks of the clock.

    Parameters
    ----------
    clock : (n_ticks,) increasing
    time_s : (n,) increasing instants of the samples
    signals : each (n,), NaN where a sample is missing
    time_constant_s : of the low-pass; 0 for none
    """
    period_s, tick_s = median_step_s(time_s), median_step_s(clock)
    limits = signal_limits(time_constant_s, period_s, tick_s)
    return {
        row: _on_clock(
            clock, time_s, np.where(np.isfinite(signal), signal, np.nan), filled(LINE, np.nan), limits
        )
        for row, signal in signals.items()
    }


@njit(error_model="numpy")
def _on_clock(clock: Array, time_s: Array, signal: Array, line: Array, limit: Array) -> Array:
    out, line, limit, k = np.empty(clock.size), line[0], limit[0], 0
    for n in range(clock.size):
        while k < time_s.size and time_s[k] <= clock[n] + TICK_S:
            take(signal[k], time_s[k], time_s[k], line, limit)
            k += 1
        out[n] = at_tick(clock[n], line, limit)
    return out
