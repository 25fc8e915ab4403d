"""Runs against the common response of the others: those that stall, and those of another robot.

The common response is a gain of each channel over the simulation's prediction, which may be wrong by any
factor.  How far runs scatter about it is estimated from them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from terrain.discrepancy.health.response import LEAST, MOTION, G, H, Response, X, Y, gains_of
from terrain.records import Array

FOLLOWS = 0.85
"""Correlation about zero of a channel with its prediction, from which a run shows the common response: a body
that sticks and comes free follows its wheels less."""

MIN_RUNS = 3
"""Least number of runs that show it."""

STALLED_RATIO, NOMINAL_RATIO = 0.25, 0.05
"""Ratio of the common response below which a body stalls, and of the prediction where none is known: slip
of the catalogue goes to 0.1 of what is predicted."""

STALLED_S, STRETCH_S, ALL_RATIO = 2.0, 1.0, 0.8
"""A run stalls that does so for the first in all, or for the third of the time that it should move, in
stretches of the second at the least, and far longer than the others."""

FLOOR = {G: 0.02, H: 0.02, X: 0.015}
"""What sensors measure of a body at rest (rad/s, m/s)."""

STRAIGHT_RADPS, MIN_STRAIGHT = 0.02, 10
"""Of rows in which no turn is predicted, and so many at the least, the median of the gyro is its bias."""

SIGMAS, FEW_RUNS, LEAST_OFF = 4.5, 8.0, 0.15
"""A run is of another robot or terrain if its gain is off by so many times the scatter of the runs and its
own error, times one plus the second over their number, since few runs measure their scatter badly: of normal
gains at most one set of 500 has such a run.  It is off by the third, too, in the logarithm: radii of one
robot differ by less."""

MIN_COMPARED = 6
"""Of fewer runs with a gain, one in a hundred sets has such a run."""

INNER, INNER_SIGMAS = 2 / 3, 0.967
"""Scatter comes from that ratio of the runs, the nearest to the median, and what it is of a normal law: the
rest may be of other robots."""

MIN_SCATTER = 0.02
"""Scatter of a robot's runs at the least, in the logarithm."""

MAX_ODD_RATIO = 1 / 3
"""More runs than that are no outliers: runs then differ in groups, which is for the diagnosis to say."""

MIN_FAULTY_RATIO = 0.05
"""A fault of a logger is in that ratio of the runs at the least: units and zeros are set once, and a run in a
hundred that is off is one whose sensor failed, which is no reason to repair it."""

ODD_CHANNELS = {G: "yaw rate", H: "heading rate", X: "speed"}
"""Channels by which runs are compared: gains of the others depend on what was driven."""


def common_gains(responses: Sequence[Response]) -> Array:
    """Return the common response (channels,): the median gain of runs that follow; NaN for too few."""
    gain, correlation = (np.array(each) for each in zip(*(gains_of(run) for run in responses), strict=True))
    common = np.full(gain.shape[1], np.nan)
    for c in range(gain.shape[1]):
        shown = gain[(correlation[:, c] > FOLLOWS) & (gain[:, c] > 0), c]
        if shown.size >= MIN_RUNS:
            common[c] = float(np.median(shown))
    return common


def stalled_runs(responses: Sequence[Response], has_clock: Sequence[bool], extra_s: float) -> dict[int, str]:
    """Return runs whose wheels turn while the body hardly responds, far longer than in the others, and why.

    Parameters
    ----------
    responses : of all runs
    has_clock : whether the clock of each is known
    extra_s : by how much longer stretches have to be where it is not, and where the run does not follow the
        wheels on the clock of all: a clock of its own looks like a short stall
    """
    if len(responses) < 2:
        return {}
    common = common_gains(responses)
    pairs = [
        _stalled_rows(run, common, STRETCH_S + (0.0 if known or _follows(run) else extra_s))
        for run, known in zip(responses, has_clock, strict=True)
    ]
    time_s, asked_s = (
        np.array([run.period_s * each[k].sum() for run, each in zip(responses, pairs, strict=True)])
        for k in (0, 1)
    )
    reasons = {}
    for i, run in enumerate(responses):
        least_s = min(STALLED_S, max(ALL_RATIO * asked_s[i], STRETCH_S))
        if time_s[i] >= least_s + 3.0 * float(np.median(np.delete(time_s, i))):
            words = _stall_words(run, common, pairs[i][0])
            reasons[i] = f"it is stalled for {time_s[i]:.1f} s in all: {words}"
    return reasons


def _follows(run: Response) -> bool:
    return bool((gains_of(run)[1][list(MOTION)] > FOLLOWS).any())


def _expected(run: Response, common: Array) -> tuple[Array, Array]:
    """Return what the common response makes of the wheels (m, channels), and the ratio of it at a stall."""
    known = np.isfinite(common)
    expected = run.predicted * np.where(known, common, 1.0)
    return expected, np.where(known, STALLED_RATIO, NOMINAL_RATIO)


def _stalled_rows(run: Response, common: Array, least_s: float) -> tuple[Array, Array]:
    """Return where (m,) a body should move and does not, in stretches, and where it should."""
    expected, ratio = _expected(run, common)
    n = len(expected)
    seen = run.measured.copy()
    straight = np.isfinite(seen[:, G]) & (np.abs(expected[:, G]) < STRAIGHT_RADPS)
    if straight.sum() >= MIN_STRAIGHT:
        seen[:, G] -= np.median(seen[straight, G])
    asked, rests, moves = np.zeros((3, n), dtype=bool)
    for c in MOTION:
        size = np.abs(seen[:, c])
        if c == X:  # the body may slide sideways
            size = np.hypot(size, np.where(np.isfinite(seen[:, Y]), seen[:, Y], 0.0))
        known = np.isfinite(size)
        still = size < ratio[c] * np.abs(expected[:, c]) + FLOOR[c]
        asked |= known & (np.abs(expected[:, c]) > LEAST[c])
        rests |= known & still
        moves |= known & ~still
    stays = asked & rests & ~moves
    kept = np.zeros(n, dtype=bool)
    for start, end in stretches(stays):
        kept[start:end] = (end - start) * run.period_s >= least_s
    return kept, asked


def _stall_words(run: Response, common: Array, stay: Array) -> str:
    """Return how fast the wheels would move a body in the common response, and how fast it moves."""
    expected = _expected(run, common)[0]
    words = []
    for c, text in (
        (G, "its wheels turn it at {:.2f} rad/s by the other runs, its body turns at {:.2f} rad/s"),
        (H, "its wheels turn it at {:.2f} rad/s by the other runs, its heading changes at {:.2f} rad/s"),
        (X, "its wheels drive it at {:.2f} m/s by the other runs, its body moves at {:.2f} m/s"),
    ):
        should, does = np.abs(expected[stay, c]), np.abs(run.measured[stay, c])
        known = np.isfinite(does)
        if known.any() and should[known].mean() > LEAST[c]:
            words.append(text.format(should[known].mean(), does[known].mean()))
    return words[0] if words else "its wheels turn, its body is at rest"


def odd_runs(responses: Sequence[Response], among: Sequence[int]) -> dict[int, str]:
    """Return runs that respond to their wheels unlike the others of their terrain, and why.

    Parameters
    ----------
    responses : of all runs
    among : places of those that are compared
    """
    reasons: dict[int, str] = {}
    for terrain in dict.fromkeys(responses[i].terrain for i in among):
        places = [i for i in among if responses[i].terrain == terrain]
        for c, name in ODD_CHANNELS.items():
            for i, text in _outliers([responses[i] for i in places], c, name).items():
                reasons.setdefault(places[i], text)
    return reasons


def _outliers(responses: Sequence[Response], c: int, name: str) -> dict[int, str]:
    """Return the runs whose gain is an outlier of all runs', none if there are too many."""
    logs, error = np.full((2, len(responses)), np.nan)
    for i, run in enumerate(responses):
        gain, correlation = (each[c] for each in gains_of(run))
        if math.isfinite(gain) and gain > 0 and correlation > FOLLOWS:
            logs[i] = math.log(gain)
            rows = np.isfinite(run.measured[:, c]).sum()
            error[i] = math.sqrt(
                max(1.0 / correlation**2 - 1.0, 0.0) / max(rows * min(run.period_s, 1.0), 1.0)
            )
    known = np.isfinite(logs)
    if known.sum() < MIN_COMPARED:
        return {}
    off = logs - np.median(logs[known])
    inner = float(np.quantile(np.abs(off[known]), INNER, method="higher"))
    scatter = max(inner / INNER_SIGMAS, MIN_SCATTER)
    sigmas = SIGMAS * (1.0 + FEW_RUNS / known.sum())
    far = np.abs(off) > np.maximum(sigmas * np.hypot(scatter, error), LEAST_OFF)
    if far.sum() > MAX_ODD_RATIO * known.sum():
        return {}
    return {
        int(i): f"it is unlike the other runs: its {name} is {math.exp(off[i]):.2f} times what they "
        f"make of the same wheels, and they scatter by {scatter:.0%}"
        for i in np.flatnonzero(far)
    }


def stretches(where: Array) -> list[tuple[int, int]]:
    """Return starts and ends, not included, of the stretches in which something holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
