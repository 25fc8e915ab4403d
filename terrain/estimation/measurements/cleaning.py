"""Samples that cannot be true: taken out of a log's streams, and counted, before anything smears them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from terrain.estimation.measurements.sample_hold import TICK_S
from terrain.logs.samples import longest_rise
from terrain.records import Array, RunLog, Stream

FROZEN_S = 0.25
"""Noise that repeats exactly for so long is none: 50 samples of the camera, 25 of the IMU."""

MIN_CONFIDENCE_RATIO = 0.34
"""The camera tells 0, 1/3, 2/3 or 1; at 1/3 (low) and below it has lost its features."""

OFF_CLOCK_S = 1.0
"""A sample that is further from every tick is of no use to anyone: its clock leapt."""


def clean_stream(
    run: RunLog, name: str, channels: Sequence[str], dropped: Counter[str], frozen: Sequence[str] = ()
) -> Stream | None:
    """Return the channels named of a stream without what cannot be true, or None where nothing is left.

    Stamps increase strictly, numbers are finite or NaN, channels that the log lacks are NaN.  A camera or IMU
    all of whose noisy channels (``frozen``) repeat is left out from the first repetition on.
    """
    stream = run.streams.get(name)
    if stream is None:
        return None
    clock_s = run.streams["wheels"].time_s if "wheels" in run.streams else stream.time_s
    known_s = clock_s[np.isfinite(clock_s)]
    present = [channel for channel in channels if channel in stream.channels]
    values = np.full((len(stream), len(channels)), np.nan)
    for channel in present:
        values[:, channels.index(channel)] = stream.channel(channel)
    kept = _increasing(stream.time_s)
    dropped[f"{name}: stamp does not increase"] += len(stream) - len(kept)
    time_s, values = stream.time_s[kept], values[kept]
    if known_s.size:
        off = (time_s < known_s.min() - OFF_CLOCK_S) | (time_s > known_s.max() + OFF_CLOCK_S)
        dropped[f"{name}: off the clock"] += int(off.sum())
    there = [channels.index(channel) for channel in present]
    finite = np.isfinite(values[:, there]).all(axis=1)
    dropped[f"{name}: not finite"] += int((~finite).sum())
    values[~np.isfinite(values)] = np.nan
    kept = np.ones(len(time_s), dtype=bool)
    noisy = [channels.index(channel) for channel in frozen if channel in present]
    if noisy and finite.any():
        kept[finite] = ~_frozen(time_s[finite], values[finite][:, noisy])
        dropped[f"{name}: frozen"] += int((~kept).sum())
    if "confidence_ratio" in present:
        low_confidence = kept & (values[:, channels.index("confidence_ratio")] < MIN_CONFIDENCE_RATIO)
        dropped[f"{name}: low confidence"] += int(low_confidence.sum())
        kept &= ~low_confidence
    return Stream(time_s[kept], values[kept], tuple(channels)) if kept.any() else None


def _increasing(time_s: Array) -> Array:
    """Return the most rows whose stamps are finite and increase: one far ahead costs itself only."""
    rows = np.flatnonzero(np.isfinite(time_s))
    return rows if (np.diff(time_s[rows]) > 0).all() else rows[longest_rise(time_s[rows])]


def _frozen(time_s: Array, values: Array) -> Array:
    """Return which rows (n,) repeat the one before, in stretches of at least :data:`FROZEN_S`."""
    same = np.zeros(len(time_s), dtype=bool)
    same[1:] = (values[1:] == values[:-1]).all(axis=1)
    first = np.flatnonzero(~same)
    last = np.append(first[1:], len(time_s)) - 1
    lasting = np.repeat(time_s[last] - time_s[first] >= FROZEN_S - TICK_S, last - first + 1)
    return np.asarray(same & lasting)
