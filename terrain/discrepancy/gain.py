"""The gain of an extension: which part of the square of measured minus simulated it removes, on data held out.

There is one definition for the extension, for a cause of it, and for the black-box learner.  Measured minus simulated
are taken behind the common low-pass, on the same rows before and after:

    gain = 1 - sum_c(after_c^2 / noise_c^2) / sum_c(before_c^2 / noise_c^2)

over one channel ``c``, over some, or over all, each weighed by its noise.  Its 95 % interval is over clusters, of
which whole ones are drawn: sessions where three or more are judged, else runs, or thirds of runs where these are few;
of few clusters it is Student's t (:mod:`terrain.bootstrap`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import percentile_interval, stratified_counts
from terrain.discrepancy.compared import ComparedRun
from terrain.discrepancy.evidence import MIN_CLUSTERS, N_BLOCKS
from terrain.discrepancy.runs import Excluded, measured_channels
from terrain.effects import CHANNELS
from terrain.records import Array

N_BOOTSTRAP = 2000

MIN_SESSIONS = 3  #: Least number of sessions that are clusters: of two Student's t reaches 13 deviations

NONE = math.nan, (math.nan, math.nan)  #: What was not measured

THIRDS = "thirds of runs"  #: What clusters are called where runs are few

HALF = 0.5  #: Least part of the learner's gain that earns a name

Interval = tuple[float, float]


def ratio_of_sums(part: Array, whole: Array, seed: int) -> tuple[float, Interval]:
    """Return what a part (n,) is of the whole (n,) over clusters, and its 95 % interval by bootstrap over these.

    Examples
    --------
    >>> ratio, interval = ratio_of_sums(np.array([2.0, 1.8, 1.9]), np.array([2.0, 2.0, 2.0]), 0)
    >>> round(ratio, 2), [round(end, 1) for end in interval]
    (0.95, [0.8, 1.1])
    """
    n = len(part)
    if not n or not whole.sum() > 0.0:
        return NONE
    counts = stratified_counts(np.zeros(n), N_BOOTSTRAP, np.random.default_rng(seed))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = (counts @ part) / (counts @ whole)
    return float(part.sum() / whole.sum()), percentile_interval(ratios, freedom=n - 1)


def part_removed(removed: Array, square: Array, seed: int) -> tuple[float, Interval]:
    """Return which part of a square (clusters,) is removed, and its 95 % interval: of none more than all."""
    part, (low, high) = ratio_of_sums(removed, square, seed)
    return part, (min(low, 1.0), min(high, 1.0))


def earned(gain: ChannelGain | Gain) -> bool:
    """Return whether what is built in removes something, and at least half of what the learner does."""
    return gain.reduction > 0.0 and not gain.reduction < HALF * gain.learner_reduction


class ChannelGain(NamedTuple):
    """Measured minus simulated in one channel, before and after; NaN after where nothing was built in.

    Root mean squares are in the channel's unit, gains parts of the square, with 95 % intervals.
    """

    rms_before: float
    rms_after: float
    reduction: float  #: that the extension removes
    ci: Interval
    refused: bool  #: whether no gain can be claimed: the interval includes zero, or lies below
    learner_rms: float  #: behind the black-box learner
    learner_reduction: float
    learner_ci: Interval
    left_ci: Interval  #: what the learner removes beyond the extension


class Gain(NamedTuple):
    """What an extension and the black-box learner gain on the same runs, whose data neither was fitted to."""

    how: str  #: in which sense runs were held out, in words
    runs: tuple[str, ...]  #: ids of those on which it was measured
    excluded_runs: tuple[Excluded, ...]  #: that were given and are unfit
    clusters: str  #: of the intervals: ``sessions``, ``runs``, or ``thirds of runs``
    channels: dict[str, ChannelGain]
    reduction: float  #: over all channels
    ci: Interval
    refused: bool
    learner_reduction: float
    learner_ci: Interval


def gain_of(
    runs: Sequence[ComparedRun],
    learned: Sequence[Array],
    noise: Mapping[str, float],
    seed: int,
    how: str,
    excluded_runs: tuple[Excluded, ...] = (),
) -> Gain:
    """Return the gain of an extension on runs that it was not fitted to.

    Parameters
    ----------
    runs : beside the simulation, and the extended one if any
    learned : of each run what the learner predicts of measured minus simulated (m, channels)
    noise : standard deviation by channel, which weighs channels
    seed : of the bootstrap
    how : runs were held out, in words
    """
    total, n_rows, kind = squares_of(runs, learned)
    extended = bool(runs) and runs[0].after is not None
    channels = {}
    for name in measured_channels(runs):
        c = CHANNELS.index(name)
        if not n_rows[c]:
            continue
        rms = np.sqrt(total[:, :, c].sum(axis=0) / n_rows[c]).tolist()
        (own, ci), learner, (_, left_ci) = gains_of(total[:, :, c], extended, seed)
        after = rms[2] if extended else math.nan
        channels[name] = ChannelGain(rms[0], after, own, ci, not ci[0] > 0.0, rms[1], *learner, left_ci)
    (own, ci), learner, _ = gains_of(total @ weights_of(noise), extended, seed)
    ids = tuple(run.run_id for run in runs)
    return Gain(how, ids, excluded_runs, kind, channels, own, ci, not ci[0] > 0.0, *learner)


def squares_of(runs: Sequence[ComparedRun], learned: Sequence[Array]) -> tuple[Array, Array, str]:
    """Return squares (clusters, 3, channels) before, behind the learner, and after, rows (channels,), and the clusters.

    Rows count where all three are known.  Where nothing is built in, what is after is as before.
    """
    clusters, squares, n_rows = _clusters(runs), [], np.zeros(len(CHANNELS))
    for run, predicted in zip(runs, learned, strict=True):
        before = run.residual(False)
        after = before if run.after is None else run.residual(True)
        left = np.array([before, before - predicted, after])
        left[:, ~np.isfinite(left).all(axis=0)] = 0.0
        n_rows += (left != 0.0).any(axis=0).sum(axis=0)
        squares += [(part**2).sum(axis=1) for part in np.array_split(left, clusters.n_parts, axis=1)]
    total = np.zeros((clusters.of.max(initial=-1) + 1, 3, len(CHANNELS)))
    np.add.at(total, clusters.of, np.array(squares))
    return total, n_rows, clusters.kind


def gains_of(square: Array, extended: bool, seed: int) -> tuple[tuple[float, Interval], ...]:
    """Return what the extension, the learner, and the learner beyond the extension remove of squares (clusters, 3)."""
    before, learner, after = square.T
    own = part_removed(before - after, before, seed) if extended else NONE
    return own, part_removed(before - learner, before, seed), part_removed(after - learner, before, seed)


class Removed(NamedTuple):
    """What a cause removes beside the rest of an extension."""

    changes: Array  #: (channels,) root mean square of what it changes, over the noise
    #: (clusters, 3, channels) before the extension, with the rest, and with the cause beside it
    squares: Array

    def size(self, weights: Array) -> float:
        """Return the square of its change over the square before, of channels by their weights."""
        before = float((self.squares[:, 0] @ weights).sum())
        return float((self.changes**2)[weights > 0.0].sum()) / before if before > 0.0 else math.nan

    def gain(self, weights: Array, seed: int) -> tuple[float, Interval]:
        """Return the part of the square before that it removes, of channels by their weights (channels,)."""
        before, rest, beside = (self.squares @ weights).T
        return part_removed(rest - beside, before, seed)


def removed_by(runs: Sequence[ComparedRun], others: Sequence[ComparedRun], weights: Array) -> Removed:
    """Return what a cause removes beyond ``others``, the same runs without it, by weights (channels,) of squares."""
    clusters, squares = _clusters(runs), []
    for run, other in zip(runs, others, strict=True):
        left = np.array([run.residual(False), other.residual(True), run.residual(True)])
        left = np.concatenate([left, left[1:2] - left[2:]])
        left[:, ~np.isfinite(left).all(axis=0)] = 0.0
        squares += [(part**2).sum(axis=1) for part in np.array_split(left, clusters.n_parts, axis=1)]
    total = np.zeros((clusters.of.max(initial=-1) + 1, 4, len(CHANNELS)))
    np.add.at(total, clusters.of, np.array(squares))
    return Removed(np.sqrt(total[:, 3].sum(axis=0) * weights), total[:, :3])


def of_clusters(parts: Array, runs: Sequence[ComparedRun]) -> Array:
    """Return sums (clusters,) of what each third (runs, N_BLOCKS) of runs has."""
    clusters = _clusters(runs)
    return np.bincount(clusters.of, parts.ravel() if clusters.n_parts > 1 else parts.sum(axis=1))


def weights_of(noise: Mapping[str, float]) -> Array:
    """Return the weight (channels,) of squares: one over the variance of the noise, 0 where none is known."""
    size = np.array([noise.get(name) or math.nan for name in CHANNELS])
    return np.nan_to_num(1.0 / size**2)


class _Clusters(NamedTuple):
    kind: str
    n_parts: int  #: into which each run is divided
    of: Array  #: (runs * n_parts,) cluster of each part


def _clusters(runs: Sequence[ComparedRun]) -> _Clusters:
    sessions = {run.session: i for i, run in enumerate(runs) if run.session}
    if len(sessions) >= MIN_SESSIONS and all(run.session for run in runs):
        places = list(sessions)
        return _Clusters("sessions", 1, np.array([places.index(run.session) for run in runs]))
    if len(runs) >= MIN_CLUSTERS:
        return _Clusters("runs", 1, np.arange(len(runs)))
    return _Clusters(THIRDS, N_BLOCKS, np.arange(N_BLOCKS * len(runs)))
