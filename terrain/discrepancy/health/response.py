"""Runs against the common response of the others: those that stall, and those of another robot."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from terrain.discrepancy.health.agreement import LEAST, MOTION, Agreement, G, H, X, Y, medians
from terrain.discrepancy.runs import UNLIKE, Rows, Signals
from terrain.records import Array
from terrain.signals import true_stretches

# The common response is a gain of each channel over the simulation's prediction, which may be wrong by any
# factor.  How far runs scatter about it is estimated from them.

#: Correlation about zero of a channel with its prediction, from which a run shows the common response: a body that
#: sticks and comes free follows its wheels less.
FOLLOWS = 0.85
MIN_RUNS = 3  #: Least number of runs that show it.
#: Ratio of the common response below which a body stalls, and of the prediction where none is known: slip of the
#: catalogue goes to 0.1 of what is predicted.
STALLED_RATIO, NOMINAL_RATIO = 0.25, 0.05
#: A run stalls that does so for the first in all, or for the third of the time that it should move, in stretches of the
#: second at the least, and far longer than the others.
STALLED_S, STRETCH_S, ALL_RATIO = 2.0, 1.0, 0.8
MEAN_S = 0.5  #: Time over which the motion of a body is averaged: noise at rest has no mean.
MIN_SHOWN_RATIO = (
    1 / 3
)  #: Ratio of a stretch in which the body has to be seen at rest, or for a stretch at the least.
FLOOR = np.array(
    [0.02, 0.015, 0.02]
)  #: What sensors measure of the motion of a body at rest (rad/s, m/s, rad/s).
#: Of rows in which no turn is predicted, and so many at the least, the median of the gyro is its bias.
STRAIGHT_RADPS, MIN_STRAIGHT = 0.02, 10
#: A run is of another robot or terrain if its gain is off by so many times the scatter of the runs and its own error,
#: times one plus the second over their number, since few runs measure their scatter badly: of normal gains at most one
#: set of 500 has such a run.  It is off by the third, too, in the logarithm: radii of one robot differ by less.
SIGMAS, FEW_RUNS, LEAST_OFF = 4.5, 8.0, 0.15
MIN_COMPARED = 6  #: Of fewer runs with a gain, one in a hundred sets has such a run.
#: Scatter comes from that ratio of the runs, the nearest to the median, and what it is of a normal law: the rest may be
#: of other robots.
INNER, INNER_SIGMAS = 2 / 3, 0.967
MIN_SCATTER = 0.02  #: Scatter of a robot's runs at the least, in the logarithm.
#: More runs than that are no outliers: runs then differ in groups, which is for the diagnosis to say.
MAX_ODD_RATIO = 1 / 3
#: Channels by which runs are compared: gains of the others depend on what was driven.
ODD_CHANNELS = {G: "yaw rate", H: "heading rate", X: "speed"}
#: What wheels make of a body in the common response, and what it does.
STALLS = {
    G: "its wheels turn it at {:.2f} rad/s by the other runs, its body turns at {:.2f} rad/s",
    H: "its wheels turn it at {:.2f} rad/s by the other runs, its heading changes at {:.2f} rad/s",
    X: "its wheels drive it at {:.2f} m/s by the other runs, its body moves at {:.2f} m/s",
}


def common_gains(follows: Agreement) -> Array:
    """Return the common response (channels,): the median gain of runs that follow; NaN for too few."""
    shown = np.where((follows.correlation > FOLLOWS) & (follows.gain > 0), follows.gain, np.nan)
    return np.where(np.isfinite(shown).sum(axis=0) >= MIN_RUNS, medians(shown), np.nan)


def stalled_runs(
    signals: Sequence[Signals],
    runs: Sequence[Rows],
    follows: Agreement,
    has_clock: Sequence[bool],
    extra_s: float,
) -> dict[int, str]:
    """Return runs whose wheels turn while the body hardly responds, far longer than in the others, and why.

    What the body does is the mean of its samples over a time, as far as they are known: noise at rest has no mean,
    and a lidar's windows have holes, which a low-pass widens.

    Stretches have to be longer by ``extra_s`` where the clock of a run is not known and the run does not follow the
    wheels on the clock of all: a clock of its own looks like a short stall at the start or the end of a motion.
    """
    if len(runs) < 2:
        return {}
    common = common_gains(follows)
    least_ratio = np.where(np.isfinite(common), STALLED_RATIO, NOMINAL_RATIO)[MOTION]
    common = np.where(np.isfinite(common), common, 1.0)
    stalls, time_s, asked_s = [], [], []
    for log, run, clock, fit in zip(signals, runs, has_clock, follows.correlation, strict=True):
        expected, seen = run.predicted * common, _means_about(log, run.time_s)
        straight = np.isfinite(seen[:, G]) & (np.abs(expected[:, G]) < STRAIGHT_RADPS)
        if straight.sum() >= MIN_STRAIGHT:
            seen[:, G] -= np.median(seen[straight, G])
        size, should = np.abs(seen[:, MOTION]), np.abs(expected[:, MOTION])
        sideways = np.where(np.isfinite(seen[:, Y]), seen[:, Y], 0.0)  # the body may slide
        size[:, 1] = np.hypot(size[:, 1], sideways)
        known, asks = np.isfinite(size), should > LEAST[MOTION]
        moves = (known & (size >= np.where(asks, least_ratio * should + FLOOR, LEAST[MOTION]))).any(axis=1)
        shows = (known & asks).any(axis=1)
        # a stall goes on through holes
        stalled = (asks & known.any(axis=0)).any(axis=1) & ~moves
        of_all = clock or (fit[MOTION] > FOLLOWS).any()
        follows, shows_s = moves & asks.any(axis=1), run.period_s * shows
        for start, end in true_stretches(stalled):
            # a clock of its own delays the start of a motion, or its end: not what is between two parts of one
            between = start > 0 and end < len(stalled) and follows[start - 1] and follows[end]
            least_s = STRETCH_S + (0.0 if of_all or between else extra_s)
            length_s, shown_s = run.period_s * (end - start), shows_s[start:end].sum()
            stalled[start:end] = length_s >= least_s and shown_s >= min(MIN_SHOWN_RATIO * length_s, STRETCH_S)
        stalls.append((expected, seen, stalled))
        time_s.append(run.period_s * stalled.sum())
        asked_s.append(run.period_s * shows.sum())
    reasons = {}
    for i, (expected, seen, stalled) in enumerate(stalls):
        least_s = min(STALLED_S, max(ALL_RATIO * asked_s[i], STRETCH_S))
        if time_s[i] < least_s + 3.0 * float(np.median(np.delete(time_s, i))):
            continue
        words = []
        for c, text in STALLS.items():
            moves, does = np.abs(expected[stalled, c]), np.abs(seen[stalled, c])
            there = np.isfinite(does)
            if there.any() and moves[there].mean() > LEAST[c]:
                words.append(text.format(moves[there].mean(), does[there].mean()))
        words.append("its wheels turn, its body is at rest")
        reasons[i] = f"it is stalled for {time_s[i]:.1f} s in all: {words[0]}"
    return reasons


def _means_about(log: Signals, time_s: Array) -> Array:
    """Return the means (m, channels) of what is known of channels about some times; NaN for too little."""
    half = max(round(0.5 * MEAN_S / log.dt_s), 1)
    at = np.round(time_s / log.dt_s).astype(int)
    first, end = np.maximum(at - half, 0), np.minimum(at + half + 1, len(log))
    known = np.isfinite(log.measured)
    total, n = (
        np.concatenate([np.zeros((1, known.shape[1])), np.cumsum(each, axis=0)])
        for each in (np.where(known, log.measured, 0.0), known)
    )
    some = n[end] - n[first]
    return np.where(some >= half, (total[end] - total[first]) / np.maximum(some, 1), np.nan)


def odd_runs(runs: Sequence[Rows], follows: Agreement, among: Sequence[int]) -> dict[int, str]:
    """Return runs, among those at some places, that respond to their wheels unlike the others of their terrain.

    Their gain is an outlier of all runs'; none is where there are too many.
    """
    reasons: dict[int, str] = {}
    for terrain in dict.fromkeys(runs[i].terrain for i in among):
        of_terrain = [i for i in among if runs[i].terrain == terrain]
        for c, name in ODD_CHANNELS.items():
            gain, fit = follows.gain[:, c], follows.correlation[:, c]
            places = [i for i in of_terrain if gain[i] > 0 and fit[i] > FOLLOWS]
            turned = [i for i in of_terrain if gain[i] < 0 and fit[i] < -FOLLOWS]
            for i in turned if len(turned) <= MAX_ODD_RATIO * len(places) else ():
                reasons.setdefault(
                    i, f"{UNLIKE} runs: its {name} is opposite to what they make of the same wheels"
                )
            if len(places) < MIN_COMPARED:
                continue
            seconds = [np.isfinite(runs[i].measured[:, c]).sum() * min(runs[i].period_s, 1.0) for i in places]
            error = np.sqrt(np.maximum(1.0 / fit[places] ** 2 - 1.0, 0.0) / np.maximum(seconds, 1.0))
            logs = np.log(gain[places])
            off = logs - np.median(logs)
            inner = float(np.quantile(np.abs(off), INNER, method="higher"))
            scatter = max(inner / INNER_SIGMAS, MIN_SCATTER)
            sigmas = SIGMAS * (1.0 + FEW_RUNS / len(places))
            far = np.flatnonzero(np.abs(off) > np.maximum(sigmas * np.hypot(scatter, error), LEAST_OFF))
            for k in far if len(far) <= MAX_ODD_RATIO * len(places) else ():
                text = f"its {name} is {math.exp(off[k]):.2f} times what they make of the same wheels"
                reason = f"{UNLIKE} runs: {text}, and they scatter by {scatter:.0%}"
                reasons.setdefault(places[k], reason)
    return reasons
