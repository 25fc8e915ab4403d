r"""Changes of the ground: within a run, under a label, and as motors answer while it drives.

**Change points** of a sequence, without labels: the partition of least cost.
``sum over segments of sum_i |z_i - mean|^2 + penalty`` is minimised exactly by dynamic programming over the
last change (Jackson et al. 2005, "An algorithm for optimal partitioning of data on an interval"), with the
scatter of each column taken from its differences from one row to the next, which a change of the mean hardly
touches.

**Breakaways**: stretches of a run that look like another terrain than their label, while the rest of the run does not.
A robot that is stuck, a label that ends too late, or a patch of other ground shows as several held-out
windows in a row in which the label is improbable and one other class is probable throughout.  Single windows
are wrong now and then and are no stretch; a run that looks like another terrain as a whole is not recognised,
which accuracy tells, and does not break away from itself.

**Changes of response**, found as the robot drives.  Responses (motor currents) are averaged over blocks of
:data:`BLOCK_S`.  Since the robot is driven in one regime, blocks before and after an instant j differ in mean only
where the ground does; with the covariance S of a block's mean on one ground, n blocks so far and the means
:math:`m_1` of the first j and :math:`m_2` of the others, the generalised likelihood ratio

.. math:: G_n = \max_{n - w \le j \le n - k} \frac{j (n - j)}{n} (m_2 - m_1)^T S^{-1} (m_2 - m_1)

grows with every block after a change (Basseville and Nikiforov, Detection of Abrupt Changes, 1993, 2.4.3, for
a change of unknown size; here the mean before it is unknown too).  It is an alarm above a threshold, and the
most likely j is the change; from there on everything begins anew.  The threshold is what a run on one ground exceeds
with a given probability, and how often runs that were held out do so is measured.  No label is needed, and none is
given: what the ground changed to is for the classifier.
A change of regime (speed or direction of the wheels) also begins anew, since responses then change on any ground; a
standing robot answers nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from terrain.bootstrap import proportion_interval
from terrain.errors import DataError
from terrain.records import Array, Windows

if TYPE_CHECKING:
    from terrain.classify.held_out import HeldOut

#: A change costs this times the number of columns times the logarithm of the number of rows: three times what the
#: criterion of Schwarz asks, as neighbouring windows resemble each other.
PENALTY = 3.0
#: A segment that differs from the longest by so many times the scatter, in the root mean square of all columns, stands
#: out. Both were chosen with the runs of BorealTC and Vulpi in view: 10 of 69 have one.
SHIFT_LEAST = 4.0
LEAST_ROWS = 3
MIN_SCATTER = 0.05

#: Shortest stretch that breaks away: three windows of 2 s, as two wrong ones in a row are common in a class of 80 %
#: accuracy.
LEAST_S = 6.0
#: Mean probability of the label in the stretch, at most: that of a guess among five classes.
LABEL_MOST = 0.2
#: Probability of the other class in each window of the stretch, at least: above all others together.
OTHER_LEAST = 0.5
#: Mean probability of the label in the rest of the run, at least: otherwise nothing is broken away from.
REST_LEAST = 0.5
BLOCK_S = 0.25  #: Means over less hold few samples of a slow logger; over more, each block delays the alarm.
MIN_BLOCKS = 3  #: Before and after a change: two blocks differ by chance too often.
#: Back to which changes are looked for, 10 s: a ground that changed before is found already.
MAX_BLOCKS = 40
SETTLING_S = 0.75  #: After a start or a change of regime, until motors have settled.
#: Of the wheels' mean speeds, as a share of their norm: larger, it is another regime.
MAX_REGIME_CHANGE = 0.15
MIN_SPEED_RATIO = 0.5  #: Of the regime's speed; slower, the robot stops.
#: Share of the runs on one ground in which the threshold is exceeded, unless another is given.
FALSE_ALARM_RATIO = 0.02
N_FOLDS = 5  #: Parts of the runs that are held out of the calibration in turn


def change_points(values: Array) -> list[tuple[int, int, float]]:
    """Return the segments of rows (n, c) that stand out from the longest one: first row, end, shift over the scatter.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> rows = rng.standard_normal((60, 4))
    >>> rows[20:30] += 8.0
    >>> [(first, end) for first, end, _ in change_points(rows)], change_points(rng.standard_normal((60, 4)))
    ([(20, 30)], [])
    """
    n, c = values.shape
    if n < 2 * LEAST_ROWS:
        return []
    scatter = 1.4826 * np.median(np.abs(np.diff(values, axis=0)), axis=0) / np.sqrt(2.0)
    z = np.ascontiguousarray(values / np.maximum(scatter, MIN_SCATTER), dtype=np.float64)
    ends = partition(z - z.mean(axis=0), LEAST_ROWS, PENALTY * c * np.log(n))
    parts = list(zip([0, *ends[:-1]], ends, strict=True))
    usual = max(parts, key=lambda part: part[1] - part[0])
    centre = np.median(z[usual[0] : usual[1]], axis=0)
    shifts = [float(np.sqrt(np.square(z[a:b].mean(axis=0) - centre).mean())) for a, b in parts]
    found = zip(parts, shifts, strict=True)
    return [(*part, shift) for part, shift in found if part != usual and shift >= SHIFT_LEAST]


def partition(z: Array, least: int, penalty: float) -> list[int]:
    """Return the end of each segment, of so many rows at least, of the best partition of rows (n, c), in order."""
    n = len(z)
    sums = np.concatenate([np.zeros((1, z.shape[1])), np.cumsum(z, axis=0)])
    squares = np.concatenate([[0.0], np.cumsum(np.square(z).sum(axis=1))])
    best, origin = np.full(n + 1, np.inf), np.zeros(n + 1, dtype=int)
    best[0] = -penalty
    for end in range(least, n + 1):
        first = np.arange(end - least + 1)
        within = (
            squares[end] - squares[first] - np.square(sums[end] - sums[first]).sum(axis=1) / (end - first)
        )
        costs = best[first] + within + penalty
        origin[end] = costs.argmin()
        best[end] = costs[origin[end]]
    ends = [n]
    while origin[ends[-1]] > 0:
        ends.append(int(origin[ends[-1]]))
    return ends[::-1]


class Breakaway(NamedTuple):
    """A stretch of a run that looks like another terrain than its label, unlike the rest of the run.

    From its first window to its last; mean probabilities in it of the terrain that it looks like and of the label, and
    of the label over the rest of the run.
    """

    run_id: str
    start_s: float
    end_s: float
    label: str
    looks_like: str
    probability: float
    label_probability: float
    rest_probability: float


def breakaways(held_out: HeldOut, windows: Windows) -> tuple[Breakaway, ...]:
    """Return the stretches that break away by their mean held-out probabilities, the surest first."""
    run_id, mean, found = windows.run_id.astype(str), held_out.probability.mean(axis=0), []
    for run, label in sorted(set(zip(run_id.tolist(), held_out.truth.tolist(), strict=True))):
        of_run = np.flatnonzero((run_id == run) & (held_out.truth == label))
        of_run = of_run[np.argsort(windows.start_s[of_run], kind="stable")]
        probability, start_s = mean[of_run], windows.start_s[of_run]
        stated = probability[:, np.searchsorted(held_out.classes, label)]
        best = probability.argmax(axis=1)
        other = (held_out.classes[best] != label) & (probability.max(axis=1) >= OTHER_LEAST)
        state = np.where(other, best, -1)
        apart = np.diff(start_s) > 2.0 * windows.length_s  # windows on both sides of a pause are no stretch
        for rows in np.split(np.arange(len(state)), np.flatnonzero((np.diff(state) != 0) | apart) + 1):
            if len(rows) == len(state) or state[rows[0]] < 0:
                continue
            begin_s, end_s = float(start_s[rows[0]]), float(start_s[rows[-1]] + windows.length_s)
            label_ratio, rest_ratio = float(stated[rows].mean()), float(np.delete(stated, rows).mean())
            if end_s - begin_s >= LEAST_S - 1e-6 and label_ratio <= LABEL_MOST and rest_ratio >= REST_LEAST:
                terrain, ratio = state[rows[0]], float(probability[rows, state[rows[0]]].mean())
                looks_like = str(held_out.classes[terrain])
                found.append(
                    Breakaway(run, begin_s, end_s, label, looks_like, ratio, label_ratio, rest_ratio)
                )
    return tuple(sorted(found, key=lambda each: -each.probability * (each.end_s - each.start_s)))


class DetectorSettings(NamedTuple):
    """What runs on one ground each show: the covariance (r, r) of a block's mean, and the threshold.

    ``n_runs`` is how many they were; ``false_alarm_ratio``, with its 95 % interval over units, how many of them give an
    alarm when they are held out of the calibration, NaN where none can be, and ``false_alarms_a_minute`` in what time.
    """

    covariance: Array
    threshold: float
    n_runs: int
    false_alarm_ratio: float
    false_alarm_interval: tuple[float, float] = (math.nan, math.nan)
    false_alarms_a_minute: float = math.nan


class GroundChange(NamedTuple):
    """A change: when it is known, when it was, how clear it is, and the responses (r,) before and after."""

    alarm_s: float
    change_s: float
    statistic: float
    before: Array
    after: Array


class Block(NamedTuple):
    """Mean responses (r,) and wheel speeds (w,) of a block that ends at ``end_s``."""

    end_s: float
    responses: Array
    wheel_speed_mps: Array


def blocks_of(time_s: Array, responses: Array, wheel_speed_mps: Array) -> Iterator[Block]:
    """Yield the blocks of samples (n,), (n, r), (n, w), each once it is over, on a grid from the first sample."""
    number = np.floor((time_s - time_s[:1]) / BLOCK_S + 1e-9).astype(int)
    for rows in np.split(np.arange(len(time_s)), np.flatnonzero(np.diff(number) != 0) + 1)[:-1]:
        means = []
        for values in (responses[rows], wheel_speed_mps[rows]):
            known = np.isfinite(values)
            n, total = known.sum(axis=0), np.where(known, values, 0.0).sum(axis=0)
            means.append(np.divide(total, n, out=np.full(n.shape, np.nan), where=n > 0))
        yield Block(time_s[0] + (number[rows[0]] + 1) * BLOCK_S, *means)


def _ratios(
    blocks: Iterable[Block], covariance: Array, threshold: float
) -> Iterator[tuple[float, int, list[Block]]]:
    """Yield, block by block, G, the number of blocks before the most likely change, and the blocks that it is of.

    These are of one regime and, as far as is known, one ground.
    """
    precision, so_far, settled_s = np.linalg.inv(covariance), list[Block](), -np.inf
    regime: Array | None = None
    for block in blocks:
        begin_s, speed, ratio, at = block.end_s - BLOCK_S, block.wheel_speed_mps, 0.0, 0
        norm = 0.0 if regime is None else float(np.linalg.norm(regime))
        continues = norm > 0.0 and np.linalg.norm(speed) >= MIN_SPEED_RATIO * norm
        if not (continues and np.linalg.norm(speed - regime) <= MAX_REGIME_CHANGE * norm):
            so_far, settled_s = [], begin_s + SETTLING_S
        if begin_s < settled_s - 1e-9:
            regime = speed
        elif np.isfinite(block.responses).all():
            so_far.append(block)
            regime, n = np.mean([each.wheel_speed_mps for each in so_far], axis=0), len(so_far)
            if n >= 2 * MIN_BLOCKS:
                sums = np.cumsum(np.array([each.responses for each in so_far]), axis=0)
                places = np.arange(max(MIN_BLOCKS, n - MAX_BLOCKS), n - MIN_BLOCKS + 1)
                before = sums[places - 1]
                apart = (sums[-1] - before) / (n - places)[:, None] - before / places[:, None]
                g = places * (n - places) / n * np.einsum("ji,ik,jk->j", apart, precision, apart)
                ratio, at = float(g.max()), int(places[g.argmax()])
        yield ratio, at, so_far
        if ratio > threshold:
            so_far = so_far[at:]


def changes_of(
    time_s: Array, responses: Array, wheel_speed_mps: Array, settings: DetectorSettings
) -> list[GroundChange]:
    """Return the changes of a log of samples (n,), (n, r), (n, w), as they are found while it drives.

    Examples
    --------
    >>> time_s = np.arange(0.0, 10.0, 0.05)
    >>> current_a, speed_mps = np.where(time_s < 5.0, 1.0, 2.0)[:, None], np.full((200, 1), 0.5)
    >>> found = changes_of(time_s, current_a, speed_mps, DetectorSettings(np.eye(1) * 0.01, 30.0, 0, 0.0))
    >>> [(float(each.change_s), float(each.alarm_s)) for each in found]
    [(4.75, 5.5)]
    """
    blocks, found = blocks_of(time_s, responses, wheel_speed_mps), []
    for ratio, at, so_far in _ratios(blocks, settings.covariance, settings.threshold):
        if ratio > settings.threshold:
            means = (
                np.mean([each.responses for each in part], axis=0) for part in (so_far[:at], so_far[at:])
            )
            found.append(GroundChange(so_far[-1].end_s, so_far[at - 1].end_s, ratio, *means))
    return found


def calibrate(
    logs: Iterable[tuple[Array, Array, Array]],
    false_alarm_ratio: float = FALSE_ALARM_RATIO,
    units: Sequence[str] | None = None,
) -> DetectorSettings:
    """Return the settings with which runs on one ground each give an alarm in a given share of them.

    The threshold is the order statistic that a further run exceeds with that probability or a smaller one, where the
    runs suffice for one (Vovk et al. 2005); of fewer it is the largest.  The share that is stated is that of runs that
    were held out of the calibration, a fifth of the units at a time.

    Parameters
    ----------
    logs : as :func:`changes_of` takes them; ``DataError`` where none is long enough
    false_alarm_ratio : probability of an alarm in a run
    units : session or run of each log, which are held out whole; each log by default
    """
    runs, unit = [], []
    for number, log in enumerate(logs):
        blocks = list(blocks_of(*log))
        found = list(_ratios(blocks, np.eye(log[1].shape[1]), np.inf))
        if found and len(found[-1][2]) >= 2 * MIN_BLOCKS:  # of one regime, settled, with all responses
            settled = np.array([each.responses for each in found[-1][2]])
            runs.append((blocks, settled - settled.mean(axis=0)))
            unit.append(str(number) if units is None else units[number])
    if not runs:
        raise DataError(
            f"no run is driven steadily for {2 * MIN_BLOCKS * BLOCK_S + SETTLING_S:g} s, as a threshold takes"
        )
    names, place = np.unique(unit, return_inverse=True)
    held_out = np.full(len(runs), np.nan)
    for fold in range(N_FOLDS if len(names) > 1 else 0):
        test = np.flatnonzero(place % N_FOLDS == fold)
        train = np.flatnonzero(place % N_FOLDS != fold)
        if len(test) and len(train):
            covariance, threshold = _fitted([runs[i] for i in train], false_alarm_ratio)
            held_out[test] = [_largest(runs[i][0], covariance) > threshold for i in test]
    of_unit = np.bincount(place, held_out) / np.bincount(place)
    minutes = sum(len(blocks) for blocks, _ in runs) * BLOCK_S / 60.0
    ends = proportion_interval(float(of_unit.sum()), len(names))
    settings = _fitted(runs, false_alarm_ratio)
    return DetectorSettings(
        *settings, len(runs), float(of_unit.mean()), ends, float(held_out.sum() / minutes)
    )


def _fitted(runs: Sequence[tuple[list[Block], Array]], false_alarm_ratio: float) -> tuple[Array, float]:
    """Return the covariance of a block's mean, and the threshold, of blocks and settled deviations of runs."""
    apart = np.concatenate([each for _, each in runs])
    covariance = apart.T @ apart / max(len(apart) - len(runs), 1)
    covariance += np.eye(len(covariance)) * 1e-9 * max(float(np.trace(covariance)), 1e-12)
    largest = np.sort([_largest(blocks, covariance) for blocks, _ in runs])
    rank = math.ceil((len(runs) + 1) * (1.0 - false_alarm_ratio) - 1e-9)
    return covariance, float(largest[min(rank, len(runs)) - 1])


def _largest(blocks: Sequence[Block], covariance: Array) -> float:
    return max(ratio for ratio, *_ in _ratios(blocks, covariance, np.inf))
