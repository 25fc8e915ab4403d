"""Fingerprints of a run: the order of the heights of consecutive peaks, and the bytes of its samples.

What they are, and what they withstand, is stated in :mod:`terrain.logs.duplicates`, which compares them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from terrain.logs.plausible import MAX_MAGNITUDE
from terrain.logs.schema import signal_set_of
from terrain.records import Array, RunLog, Stream

N_PEAKS = 16
"""Peaks of a fingerprint: 42 comparisons, of which some 30 are independent."""

LAGS = (1, 2, 3)
"""A peak is compared with so many that follow it."""

SMOOTHING_S = 0.04
"""Standard deviation of the low-pass filter: some five peaks a second, whatever the sampling rate."""

MEASURED_SETS = ("imu", "wheels", "currents")
"""Signal sets whose channels are measured; what a filter makes of them adds nothing."""

MIN_SPREAD_RATIO = 0.1
"""Heights that differ by less than this part of the channel's standard deviation are those of a periodic
signal or of noise in the last digit, which repeats from run to run."""

MIN_LEVELS = 10
"""Different heights of a stretch: channels that go back and forth between a few values repeat themselves."""

MIN_DISTINCT = 64
"""Values that a stream must have taken for its bytes to identify it."""


class Peaks(NamedTuple):
    """Peaks of all channels of all runs, one after the other; ``spread`` is that of the channel."""

    run: Array
    time_s: Array
    height: Array
    spread: Array
    period_s: Array


def measured_streams(run: RunLog) -> list[tuple[Stream, list[int]]]:
    """Return the streams that were measured, with the places of the channels that features are made of."""
    chosen = []
    for name, stream in run.streams.items():
        places = _measured_places(name, tuple(stream.channels))
        if places and len(stream) > 1:
            chosen.append((stream, list(places)))
    return chosen


@lru_cache(maxsize=1024)
def _measured_places(stream: str, channels: tuple[str, ...]) -> tuple[int, ...]:
    """Return the places of the measured channels of a stream; all runs of a data set ask for the same."""
    return tuple(i for i, each in enumerate(channels) if signal_set_of(stream, each) in MEASURED_SETS)


def fingerprints(runs: Sequence[RunLog]) -> tuple[Array, Array, Peaks]:
    """Return the fingerprints (n,), the place (n,) of their first peak, and all peaks."""
    parts: list[tuple[Array, ...]] = []
    codes: list[Array] = []
    starts: list[Array] = []
    n_peaks = 0
    for number, run in enumerate(runs):
        for stream, places in measured_streams(run):
            period_s = 1.0 / stream.rate_hz
            for place in places:
                smooth = _low_pass(stream.values[:, place], SMOOTHING_S / period_s)
                at = 1 + np.flatnonzero((smooth[1:-1] > smooth[:-2]) & (smooth[1:-1] >= smooth[2:]))
                if len(at) < N_PEAKS:
                    continue
                height = smooth[at]
                codes.append(_codes(height))
                starts.append(n_peaks + np.arange(len(codes[-1])))
                spread = float(np.nanstd(smooth))
                constant = (np.full(len(at), each) for each in (number, spread, period_s))
                of_run, of_spread, of_period = constant
                parts.append((of_run.astype(int), stream.time_s[at], height, of_spread, of_period))
                n_peaks += len(at)
    if not parts:
        nothing = np.empty(0)
        return np.empty(0, np.int64), np.empty(0, int), Peaks(*[nothing] * 5)
    peaks = Peaks(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    return np.concatenate(codes), np.concatenate(starts), peaks


def _low_pass(values: Array, std_samples: float) -> Array:
    """Return values (n,) behind a Gaussian filter; NaN where one is near, and at both ends."""
    values = np.where(np.abs(values) <= MAX_MAGNITUDE, values, np.nan)
    half = min(int(np.ceil(3.0 * std_samples)), (len(values) - 1) // 2)
    if std_samples < 0.5 or half < 1:
        return values
    weights = np.exp(-0.5 * (np.arange(-half, half + 1) / std_samples) ** 2)
    smooth = np.convolve(values, weights / weights.sum(), mode="same")
    smooth[:half] = smooth[len(smooth) - half :] = np.nan
    return smooth


def _codes(height: Array) -> Array:
    """Return the fingerprint (n - N_PEAKS + 1,) that begins with each peak of a channel."""
    n = len(height) - N_PEAKS + 1
    codes = np.zeros(n, dtype=np.int64)
    for lag in LAGS:
        higher = (height[:-lag] < height[lag:]).astype(np.int64)
        for i in range(N_PEAKS - lag):
            codes <<= 1
            codes |= higher[i : i + n]
    return codes


def scaled_heights(height: Array, spread: Array) -> tuple[Array, Array]:
    """Return heights (m, N_PEAKS) less their mean over their norm, and where (m,) they vary enough."""
    centred = height - height.mean(axis=1, keepdims=True)
    norm = np.sqrt(np.einsum("ij,ij->i", centred, centred))
    varies = norm > MIN_SPREAD_RATIO * spread * np.sqrt(N_PEAKS)
    varies &= norm > 1e-9 * np.abs(height).max(axis=1)  # rounding
    steps = np.diff(np.sort(centred, axis=1), axis=1)
    varies &= 1 + (steps > 1e-6 * norm[:, None]).sum(axis=1) >= MIN_LEVELS
    return centred / np.where(norm > 0.0, norm, 1.0)[:, None], varies


def samples_digest(run: RunLog) -> bytes:
    """Return what identifies the samples of the fastest measured stream; empty where they may repeat."""
    measured = measured_streams(run)
    if not measured:
        return b""
    stream, places = max(measured, key=lambda each: each[0].rate_hz)
    with np.errstate(over="ignore"):
        values = stream.values[:, places].astype(np.float32)
    if max(len(np.unique(column)) for column in values.T) < min(MIN_DISTINCT, len(values)):
        return b""
    return hashlib.blake2b(np.ascontiguousarray(values + np.float32(0.0)).tobytes()).digest()


class RunPrint(NamedTuple):
    """What of a run shows whether another one may hold a stretch of it.

    Parameters
    ----------
    codes, time_s : (n,) fingerprints of peaks whose heights vary, and the times of their first peaks
    digest : of the fastest stream; empty where its samples may repeat
    """

    codes: Array
    time_s: Array
    digest: bytes


def run_print(run: RunLog) -> RunPrint:
    """Return the fingerprints of a run."""
    codes, start, peaks = fingerprints([run])
    if len(codes):
        varies = scaled_heights(peaks.height[start[:, None] + np.arange(N_PEAKS)], peaks.spread[start])[1]
        codes, start = codes[varies], start[varies]
    return RunPrint(codes, peaks.time_s[start], samples_digest(run))
