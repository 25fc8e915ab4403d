"""Samples that are no readings: a channel that holds its value, and one that is at the end of its range.

That a sensor with noise repeats a value exactly for seconds, or stays at its extreme, needs no witness but the wheels,
by which it should change meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.health.agreement import LEAST, MOTION
from terrain.discrepancy.runs import Rows, Signals
from terrain.records import Array
from terrain.signals import agreement, true_stretches

#: A channel is held if it is constant for the first at a time, or exactly 0 for the second if it is of a motion, which
#: is never exactly 0 by a sensor that has noise, as the currents of idle motors are; it is clipped if it is at
#: its extreme for the third in all and the fourth of a run.
FROZEN_S, ZERO_S, CLIPPED_S, CLIPPED_RATIO = 2.0, 0.4, 1.0, 0.03
#: The end of a range is so far out at the least, over the largest size: idle currents rest at the other.
FAR_END = 0.5


def held(values: Array, dt_s: float, is_motion: bool = False) -> Array:
    """Return which samples (n,) repeat one value for too long for a sensor that has noise.

    Examples
    --------
    >>> held(np.array([0.1, 0.2, 0.2, 0.2, 0.3]), 1.0).tolist()
    [False, True, True, True, False]
    """
    mask = np.zeros(len(values), dtype=bool)
    for start, end in true_stretches(values[1:] == values[:-1]):
        least_s = ZERO_S if is_motion and values[start] == 0.0 else FROZEN_S
        mask[start : end + 1] = (end - start) * dt_s >= least_s
    return mask


def clipped(values: Array, dt_s: float) -> Array:
    """Return which samples (n,) are at an end of the range of a sensor, which is where many have one extreme value."""
    mask = np.zeros(len(values), dtype=bool)
    largest = np.nanmax(np.abs(values), initial=0.0)
    for end in (np.nanmax(values, initial=-np.inf), np.nanmin(values, initial=np.inf)):
        there = values == end
        if abs(end) >= FAR_END * largest > 0 and there.sum() >= max(
            CLIPPED_S / dt_s, CLIPPED_RATIO * len(values)
        ):
            mask |= there
    return mask


MARGIN_S = 0.6  #: Tolerance of the time at which a predicted change arrives.
#: Of what is expected meanwhile: range and spread over its spread in the run.
FROZEN_RANGE, CLIPPED_SPREAD = 0.5, 0.1
#: Correlation about zero with the prediction of the other samples, from which a channel that reads 0 is lost: a body
#: may be at rest.
FOLLOWS_ELSE = 0.7


class LostSamples(NamedTuple):
    """Samples of a channel of a run that are no readings."""

    channel: int
    is_clipped: bool  #: at the end of its range; held otherwise
    seconds: float
    value: float


def lost_samples(run: Signals, beside: Rows) -> Iterator[LostSamples]:
    """Yield the channels of a run that are held, or clipped, while the prediction varies, those held first."""
    for c in np.flatnonzero(np.isfinite(run.measured).any(axis=0)):
        values, expected = run.measured[:, c], beside.predicted[:, c]
        spread = float(np.std(expected)) if expected.size else 0.0
        if not spread > 0:
            continue
        end_mask = clipped(values, run.dt_s)
        mask, lost_s, at = held(values, run.dt_s, c in MOTION) & ~end_mask, 0.0, 0.0
        for start, end in true_stretches(mask):
            start_s, end_s, is_zero = start * run.dt_s, (end - 1) * run.dt_s, values[start] == 0.0
            margin_s = MARGIN_S if end_s - start_s >= FROZEN_S else 0.0
            inside = (beside.time_s > start_s + margin_s) & (beside.time_s < end_s - margin_s)
            should = (
                end_s - start_s >= FROZEN_S
                and inside.any()
                and np.ptp(expected[inside]) > FROZEN_RANGE * spread
            )
            if is_zero and not should and inside.any() and np.abs(expected[inside]).mean() > LEAST[c]:
                seen = np.interp(
                    beside.time_s, run.dt_s * np.arange(len(run)), np.where(mask, np.nan, values)
                )
                should = agreement(seen[:, None], expected[:, None])[0][0] > FOLLOWS_ELSE
            if should:
                lost_s, at = lost_s + end_s - start_s, float(values[start])
        if lost_s > 0.0:
            yield LostSamples(int(c), False, lost_s, at)
        at_end = np.flatnonzero(end_mask)
        if (
            at_end.size
            and np.std(np.interp(at_end * run.dt_s, beside.time_s, expected)) > CLIPPED_SPREAD * spread
        ):
            yield LostSamples(int(c), True, at_end.size * run.dt_s, float(values[at_end[0]]))
