"""One clock and one delay: signals of any rate behind a low-pass, at the ticks of another sensor."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numba import njit

from terrain.records import Array

MAX_AGE_PERIODS = 1.5
"""A value is held until the next one is due and half a period more, of the slower of sensor and clock."""

GAP_PERIODS = 5.0
"""After a longer gap the low-pass starts anew: what it remembers is not the past of what comes."""

TICK_S = 1e-9
"""Stamps that differ by less are the same instant, written by two clocks' arithmetic."""


def low_pass(time_s: Array, value: Array, time_constant_s: float, gap_s: float) -> Array:
    """Return a signal (n,) behind a first-order low-pass, exact if it runs straight from sample to sample.

    Parameters
    ----------
    time_s : (n,) strictly increasing, in any steps
    value : (n,) finite
    time_constant_s : tau; 0 gives the signal back
    gap_s : the filter starts anew at the first sample, and after every longer step

    Notes
    -----
    ``tau y' + y = x`` over a step dt from x_0 to x_1, with ``a = exp(-dt/tau)`` and m the slope::

        y_1 = x_1 - tau m + a (y_0 - x_0 + tau m)

    so that a ramp is delayed by tau at any rate.  (The usual ``y_1 = a y_0 + (1 - a) x_1`` falls short of it
    by half a step: 10 ms at 50 Hz.)

    Examples
    --------
    >>> time_s = np.array([0.0, 0.1, 0.3, 0.9])
    >>> (2.0 * time_s - low_pass(time_s, 2.0 * time_s, 0.05, 1.0)).round(4)  # on its way to 2.0 * 0.05
    array([0.    , 0.0865, 0.0998, 0.1   ])
    """
    return _low_pass(time_s, value, time_constant_s, gap_s) if time_constant_s > 0 else value


@njit(cache=True)
def _low_pass(time_s: Array, value: Array, time_constant_s: float, gap_s: float) -> Array:
    out = np.empty_like(value)
    for k in range(value.size):
        step_s = time_s[k] - time_s[k - 1]
        if k == 0 or step_s > gap_s:
            out[k] = value[k]
            continue
        lead = time_constant_s * (value[k] - value[k - 1]) / step_s
        out[k] = value[k] - lead + np.exp(-step_s / time_constant_s) * (out[k - 1] - value[k - 1] + lead)
    return out


def on_clock(
    clock: Array,
    time_s: Array,
    signals: Mapping[str, Array],
    time_constant_s: float,
    arrived_s: Array | None = None,
) -> dict[str, Array]:
    """Return each signal behind the low-pass, at the ticks of the clock.

    ``time_s`` (n,) is the instant that a sample tells of, ``arrived_s`` (n,) when it came: the same without.
    """
    period_s = float(np.median(np.diff(time_s))) if time_s.size > 1 else np.nan
    rows = {}
    for row, signal in signals.items():
        known = np.isfinite(signal)
        stamps, values = time_s[known], signal[known]
        held = _held(clock, stamps if arrived_s is None else arrived_s[known], period_s)
        taken = held[held >= 0]
        at_tick = values[taken]
        if time_constant_s > 0:
            behind = low_pass(stamps, values, time_constant_s, GAP_PERIODS * period_s)[taken] - at_tick
            at_tick = at_tick + behind * np.exp((stamps[taken] - clock[held >= 0]) / time_constant_s)
        rows[row] = np.full(clock.size, np.nan)
        rows[row][held >= 0] = at_tick
    return rows


def _held(clock: Array, time_s: Array, period_s: float) -> Array:
    """Return which sample (n,) each tick takes: the last at or before it, or -1 where that is too old."""
    tick_s = float(np.median(np.diff(clock))) if clock.size > 1 else np.nan
    held = np.searchsorted(time_s, clock + TICK_S, side="right") - 1
    taken = held >= 0
    age_s = clock[taken] - time_s[held[taken]]
    taken[taken] = age_s <= MAX_AGE_PERIODS * np.fmax(period_s, tick_s) + TICK_S
    if period_s > MAX_AGE_PERIODS * tick_s:
        taken[1:] &= held[1:] != held[:-1]
    return np.where(taken, held, -1)


def ema(value: Array, alpha: float) -> Array:
    """Smooth the known values (n,) one after the other, whatever the time between them (7.8)."""
    from scipy.signal import lfilter  # half a second of import, which only the thesis' smoothing needs

    out = np.array(value)
    known = np.isfinite(value)
    if known.any():
        start = [alpha * value[known][0]]
        out[known] = lfilter([1.0 - alpha], [1.0, -alpha], value[known], zi=start)[0]
    return out
