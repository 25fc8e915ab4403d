"""Whether the value of a cause is one number: by thirds of time, by halves of the runs, and run by run.

Every statement is a size, not a test alone: with enough data any difference is significant, and a robot whose
track is 1.4 m early and 1.5 m late still has an effective track.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from terrain.discrepancy.information import N_BLOCKS, Information
from terrain.records import Array

VARIES_RATIO = 0.25
"""A value whose groups are further apart than that ratio of it, root mean square by their information, is no
value: a cause that grows from nothing along a run, seen as a constant one, has 0.54 between its thirds."""

CAVEAT_RATIO = 0.05
"""A value that differs by more than that ratio is given with what it depends on."""

CERTAIN_P = 1e-5
"""Chance of differences between groups by noise, below which they are stated."""

MIN_HALF_RUNS = 3
"""Least number of runs in half of them."""


class Group(NamedTuple):
    """Values (p,) of an effect in a part of the data, and their standard deviations."""

    name: str
    values: Array
    std: Array


class Constancy(NamedTuple):
    """Values of a cause in parts of the data.

    Parameters
    ----------
    thirds : of the time of each run, the first first
    halves : of the runs, in the order given
    ratio : root mean square difference of groups of one kind from their mean, each with the weight of its
        information, over the size of the value
    split : ``time`` or ``runs``, where that is largest
    certain : whether differences are beyond the noise
    """

    thirds: tuple[Group, ...]
    halves: tuple[Group, ...]
    ratio: float
    split: str
    certain: bool

    @property
    def varies(self) -> bool:
        """Whether the value differs so much that it is none."""
        return self.certain and self.ratio > VARIES_RATIO

    @property
    def caveat(self) -> str:
        """What the value depends on, in words; empty where it is one number."""
        if not self.certain or self.ratio <= CAVEAT_RATIO:
            return ""
        groups = self.thirds if self.split == "time" else self.halves
        named = [(group.values[_main(groups)], group.name) for group in groups]
        shown = ", ".join(f"{value:.3g} in the {name}" for value, name in named if math.isfinite(value))
        return f"its value depends on {'time' if self.split == 'time' else 'the run'}: {shown}"


def constancy_of(
    info: Information, names: Sequence[str], own: Sequence[str], change: Array, inflation: float
) -> Constancy:
    """Return the values of some of the fitted parameters in parts of the data.

    Parameters
    ----------
    info : at the fit, changes counted from any point
    names, change : parameters fitted together, (k,), and their values
    own : those of one effect
    inflation : of the variances over those from the noise
    """
    at, mine = info.places(names), [list(names).index(name) for name in own]
    by_time = [
        (info.a_blocks[:, b][:, at][:, :, at].sum(axis=0), info.g_blocks[:, b][:, at].sum(axis=0))
        for b in range(N_BLOCKS)
    ]
    half = len(info.a) // 2
    by_run = []
    if half >= MIN_HALF_RUNS:
        for part in (slice(0, half), slice(half, None)):
            by_run.append((info.a[part][:, at][:, :, at].sum(axis=0), info.g[part][:, at].sum(axis=0)))
    thirds = _groups(("first third", "second third", "last third"), by_time, mine, change, inflation)
    halves = _groups(("first half of the runs", "second half"), by_run, mine, change, inflation)
    size = float(np.linalg.norm(change[mine]))
    found = [(_difference(groups), split) for groups, split in ((thirds, "time"), (halves, "runs"))]
    certain = [(ratio, split) for (ratio, beyond), split in found if beyond]
    ratio, split = max(certain, default=(max(ratio for (ratio, _), _ in found), "time"))
    return Constancy(thirds, halves, ratio / size if size > 0 else math.inf, split, bool(certain))


def _groups(
    labels: Sequence[str],
    forms: Sequence[tuple[Array, Array]],
    mine: list[int],
    change: Array,
    inflation: float,
) -> tuple[Group, ...]:
    """Return the values in each group, all that is fitted free; NaN where a group shows nothing of them.

    Other parameters are held near their common fit by the information of all groups together.
    """
    total = sum((a for a, _ in forms), np.zeros((len(change), len(change))))
    others = np.array([i not in mine for i in range(len(change))])
    hold = np.where(others, np.diag(total), 0.0)
    groups = []
    for label, (a, g) in zip(labels, forms, strict=False):
        cov = np.linalg.pinv(a + np.diag(hold), hermitian=True)
        values = (cov @ (g + hold * change))[mine]
        std = np.sqrt(np.maximum(np.diag(cov)[mine], 0.0) * inflation)
        shown = np.diag(a)[mine] > 1e-9 * np.diag(total)[mine]
        groups.append(Group(label, np.where(shown, values, np.nan), np.where(shown, std, np.nan)))
    return tuple(groups)


def _difference(groups: Sequence[Group]) -> tuple[float, bool]:
    """Return how far groups are apart, weighted by their information, and whether it is beyond the noise.

    A group counts for the parameters that it shows; a parameter that is apart by noise counts only where none
    is apart beyond it.
    """
    if len(groups) < 2:
        return 0.0, False
    values, std = np.array([g.values for g in groups]), np.array([g.std for g in groups])
    known = np.isfinite(values) & (std > 0)
    known &= known.sum(axis=0) > 1
    weight = np.where(known, 1.0 / np.where(known, std, 1.0) ** 2, 0.0)
    total = np.maximum(weight.sum(axis=0), 1e-30)
    values = np.where(known, values, 0.0)
    statistic = (weight * (values - (weight * values).sum(axis=0) / total) ** 2).sum(axis=0)
    certain = chi2.sf(statistic, np.maximum(known.sum(axis=0) - 1, 1)) < CERTAIN_P
    apart = np.sqrt(statistic / total)
    return float(apart[certain].max() if certain.any() else apart.max()), bool(certain.any())


def _main(groups: Sequence[Group]) -> int:
    """Return the parameter that is largest over all groups."""
    return int(np.argmax(np.nan_to_num([np.abs(group.values) for group in groups]).max(axis=0)))
