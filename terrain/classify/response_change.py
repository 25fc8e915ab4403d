r"""Change of the ground under a robot, found as it drives, from what its wheels answer.

Responses (motor currents) are averaged over blocks of :data:`BLOCK_S`.  Since the robot is driven in one
regime, blocks before and after an instant j differ in mean only where the ground does; with the covariance
S of a block's mean on one ground, n blocks so far and the means :math:`m_1` of the first j and :math:`m_2`
of the others, the generalised likelihood ratio

.. math:: G_n = \max_{n - w \le j \le n - k} \frac{j (n - j)}{n} (m_2 - m_1)^T S^{-1} (m_2 - m_1)

grows with every block after a change (Basseville and Nikiforov, Detection of Abrupt Changes, 1993, 2.4.3, for
a change of unknown size; here the mean before it is unknown too).  It is an alarm above a threshold, and the
most likely j is the change; from there on everything begins anew.

The threshold is what runs on one ground each exceed in a given share of the runs.  No label is needed, and
none is given: what the ground changed to is for the classifier.  A change of regime (speed or direction of
the wheels) also begins anew, since responses then change on any ground; a standing robot answers nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.records import Array

BLOCK_S = 0.25
"""Means over less hold few samples of a slow logger; over more, each block delays the alarm."""

MIN_BLOCKS = 3
"""Before and after a change: two blocks differ by chance too often."""

MAX_BLOCKS = 40
"""Back to which changes are looked for, 10 s: a ground that changed before is found already."""

SETTLING_S = 0.75
"""After a start or a change of regime, until motors have settled."""

MAX_REGIME_CHANGE = 0.15
"""Of the wheels' mean speeds, as a share of their norm: larger, it is another regime."""

MIN_SPEED_RATIO = 0.5
"""Of the regime's speed; slower, the robot stops."""

FALSE_ALARM_RATIO = 0.02
"""Share of the runs on one ground in which the threshold is exceeded, unless another is given."""


class DetectorSettings(NamedTuple):
    """What runs on one ground each show: the covariance (r, r) of a block's mean, and the threshold.

    ``n_runs`` is how many they were, ``false_alarm_ratio`` how many of them exceed the threshold.
    """

    covariance: Array
    threshold: float
    n_runs: int
    false_alarm_ratio: float


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


class ChangeDetector:
    """Finds changes of the ground sample by sample.

    Parameters
    ----------
    settings : as :func:`calibrate` returns them

    Examples
    --------
    >>> detector = ChangeDetector(DetectorSettings(np.eye(1) * 0.01, 30.0, 0, 0.0))
    >>> time_s = np.arange(0.0, 10.0, 0.05)
    >>> current_a = np.where(time_s < 5.0, 1.0, 2.0)
    >>> found = [detector.update(t, [a], [0.5]) for t, a in zip(time_s, current_a)]
    >>> [(float(each.change_s), float(each.alarm_s)) for each in found if each is not None]
    [(4.75, 5.5)]
    """

    def __init__(self, settings: DetectorSettings) -> None:
        self.settings = settings
        self._precision = np.linalg.inv(settings.covariance)
        self._blocks = _BlockMeans()
        self._regime: Array | None = None
        self._settled_s = -np.inf
        self._means: list[Block] = []

    def update(self, time_s: float, responses: Array, wheel_speed_mps: Array) -> GroundChange | None:
        """Take one sample; return a change where it makes one known.

        Parameters
        ----------
        time_s : of the sample, after those before
        responses : (r,) NaN where missing
        wheel_speed_mps : (w,)
        """
        block = self._blocks.add(time_s, np.asarray(responses, float), np.asarray(wheel_speed_mps, float))
        return None if block is None else self.take(block)

    def take(self, block: Block) -> GroundChange | None:
        """Take one block; return a change where it makes one known."""
        if not self._continues(block.wheel_speed_mps):
            self._regime, self._means = block.wheel_speed_mps, []
            self._settled_s = block.end_s - BLOCK_S + SETTLING_S
        settled = block.end_s - BLOCK_S >= self._settled_s - 1e-9
        if not settled:
            self._regime = block.wheel_speed_mps
        if not (settled and np.isfinite(block.responses).all()):
            return None
        self._means.append(block)
        self._regime = np.mean([each.wheel_speed_mps for each in self._means], axis=0)
        statistic, at = self._ratio()
        if statistic <= self.settings.threshold:
            return None
        before, after = self._means[:at], self._means[at:]
        self._means = after
        return GroundChange(
            block.end_s,
            before[-1].end_s,
            statistic,
            np.mean([each.responses for each in before], axis=0),
            np.mean([each.responses for each in after], axis=0),
        )

    @property
    def statistic(self) -> float:
        """G of the blocks so far."""
        return self._ratio()[0]

    @property
    def blocks(self) -> tuple[Block, ...]:
        """The blocks that are compared: of one regime and, as far as is known, one ground."""
        return tuple(self._means)

    def _continues(self, wheel_speed_mps: Array) -> bool:
        """Return whether a block's wheel speeds are of the regime so far."""
        if self._regime is None or not np.isfinite(wheel_speed_mps).all():
            return False
        norm = float(np.linalg.norm(self._regime))
        if norm == 0.0 or np.linalg.norm(wheel_speed_mps) < MIN_SPEED_RATIO * norm:
            return False
        return bool(np.linalg.norm(wheel_speed_mps - self._regime) <= MAX_REGIME_CHANGE * norm)

    def _ratio(self) -> tuple[float, int]:
        n = len(self._means)
        if n < 2 * MIN_BLOCKS:
            return 0.0, 0
        values = np.array([each.responses for each in self._means])
        sums = np.cumsum(values, axis=0)
        at = np.arange(max(MIN_BLOCKS, n - MAX_BLOCKS), n - MIN_BLOCKS + 1)
        apart = (sums[-1] - sums[at - 1]) / (n - at)[:, None] - sums[at - 1] / at[:, None]
        ratio = at * (n - at) / n * np.einsum("ji,ik,jk->j", apart, self._precision, apart)
        best = int(np.argmax(ratio))
        return float(ratio[best]), int(at[best])


class _BlockMeans:
    """Means over blocks on a grid of :data:`BLOCK_S` from the first sample."""

    def __init__(self) -> None:
        self._start_s = np.nan
        self._number = 0
        self._samples: list[tuple[Array, Array]] = []

    def add(self, time_s: float, responses: Array, wheel_speed_mps: Array) -> Block | None:
        if np.isnan(self._start_s):
            self._start_s = time_s
        number = int(np.floor((time_s - self._start_s) / BLOCK_S + 1e-9))
        block = None
        if number != self._number and self._samples:
            parts = [np.array(part) for part in zip(*self._samples, strict=True)]
            end_s = self._start_s + (self._number + 1) * BLOCK_S
            block = Block(end_s, *(_known_mean(part) for part in parts))
            self._samples = []
        self._number = number
        self._samples.append((responses, wheel_speed_mps))
        return block


def _known_mean(values: Array) -> Array:
    known = np.isfinite(values)
    n = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.asarray(np.divide(total, n, out=np.full(n.shape, np.nan), where=n > 0))


def changes_of(
    time_s: Array, responses: Array, wheel_speed_mps: Array, settings: DetectorSettings
) -> list[GroundChange]:
    """Return the changes of a whole log, as they are found sample by sample.

    Parameters
    ----------
    time_s, responses, wheel_speed_mps : (n,), (n, r), (n, w)
    settings : of the detector
    """
    detector = ChangeDetector(settings)
    found = (detector.update(*sample) for sample in zip(time_s, responses, wheel_speed_mps, strict=True))
    return [each for each in found if each is not None]


def calibrate(
    logs: Iterable[tuple[Array, Array, Array]], false_alarm_ratio: float = FALSE_ALARM_RATIO
) -> DetectorSettings:
    """Return the settings with which runs on one ground each give an alarm in a given share of them.

    Parameters
    ----------
    logs : of runs, times, responses and wheel speeds as :func:`changes_of` takes them
    false_alarm_ratio : above 0, below 1

    Raises
    ------
    DataError
        if no run is long enough.
    """
    blocks = [means for log in logs if len(means := steady_blocks(*log)) >= 2 * MIN_BLOCKS]
    if not blocks:
        raise DataError(
            f"no run is driven steadily for {2 * MIN_BLOCKS * BLOCK_S + SETTLING_S:g} s, as a threshold takes"
        )
    values = [np.array([each.responses for each in means]) for means in blocks]
    apart = np.concatenate([part - part.mean(axis=0) for part in values])
    freedom = len(apart) - len(values)
    covariance = apart.T @ apart / max(freedom, 1)
    covariance += np.eye(len(covariance)) * 1e-9 * max(float(np.trace(covariance)), 1e-12)
    largest = []
    for means in blocks:
        detector = ChangeDetector(DetectorSettings(covariance, np.inf, 0, 0.0))
        peak = 0.0
        for block in means:
            detector.take(block)
            peak = max(peak, detector.statistic)
        largest.append(peak)
    threshold = float(np.quantile(largest, 1.0 - false_alarm_ratio))
    exceeded = float(np.mean(np.array(largest) > threshold))
    return DetectorSettings(covariance, threshold, len(blocks), exceeded)


def steady_blocks(time_s: Array, responses: Array, wheel_speed_mps: Array) -> list[Block]:
    """Return the blocks of a log that a detector compares: of one regime, settled, with all responses."""
    detector = ChangeDetector(DetectorSettings(np.eye(responses.shape[1]), np.inf, 0, 0.0))
    for sample in zip(time_s, responses, wheel_speed_mps, strict=True):
        detector.update(*sample)
    return list(detector.blocks)
