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

from terrain.discrepancy.evidence import N_BLOCKS, Evidence
from terrain.records import Array

VARIES_RATIO = 0.5
"""A value whose groups are further apart than that ratio of it, root mean square by their information, is no
value."""

GROWS_RATIO, GROWTH = 0.25, 2.0
"""Nor is one that is apart by the first and grows along runs by the second: a cause that starts from nothing,
as warmth and the rate of a clock do, has 0.54 between its thirds, and grows five times."""

CAVEAT_RATIO = 0.05
"""A value that differs by more than that ratio is given with what it depends on."""

CERTAIN_P = 1e-5
"""Chance of differences between groups by noise, below which they are stated."""

MIN_HALF_RUNS = 3
"""Least number of runs in half of them."""


THIRDS = ("first third", "second third", "last third")

HALVES = ("first half of the runs", "second half")


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
        least = GROWS_RATIO if self.split == "time" and self._grows else VARIES_RATIO
        return self.certain and self.ratio > least

    @property
    def _grows(self) -> bool:
        """Whether the value has one sign and grows from the first third to the last."""
        first, middle, last = (float(group.values[_main(self.thirds)]) for group in self.thirds)
        sign = 1.0 if last > 0 else -1.0
        return sign * last > GROWTH * abs(first) and sign * last > sign * middle > sign * first

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
    info: Evidence, names: Sequence[str], own: Sequence[str], change: Array, inflation: float
) -> Constancy:
    """Return the values of some of the fitted parameters in parts of the data.

    Parameters
    ----------
    info : at the fit, changes counted from any point
    names, change : parameters fitted together, (k,), and their values
    own : those of one effect
    inflation : of the variances over those from the noise
    """
    n, half = len(info.rows), len(info.rows) // 2
    by_time = np.tile(np.arange(N_BLOCKS), (n, 1))
    by_run = np.repeat((np.arange(n) >= half).astype(int)[:, None], N_BLOCKS, axis=1)
    others = [name for name in names if name not in own]
    where = {"time": by_time, "runs": by_run} if half >= MIN_HALF_RUNS else {"time": by_time}
    split = {}
    for kind, group in where.items():
        values, cov = info.fit(own, others, group)
        split[kind] = values, inflation * cov
    found = {kind: _difference(*fit) for kind, fit in split.items()}
    size = float(np.linalg.norm(change[[list(names).index(name) for name in own]]))
    certain = {kind: ratio for kind, (ratio, beyond) in found.items() if beyond}
    kind = max(certain, key=lambda each: certain[each]) if certain else "time"
    labels = {"time": THIRDS, "runs": HALVES}
    groups = {
        each: tuple(
            Group(label, *pair)
            for label, pair in zip(labels[each], zip(*_by_group(*fit), strict=True), strict=True)
        )
        for each, fit in split.items()
    }
    ratio = found[kind][0] / size if size > 0 else math.inf
    return Constancy(groups["time"], groups.get("runs", ()), ratio, kind, bool(certain))


def _by_group(values: Array, cov: Array) -> tuple[Array, Array]:
    """Return values (groups, p) and their standard deviations."""
    variance = np.einsum("gpgp->gp", cov)
    return values, np.where(np.isfinite(values), np.sqrt(np.maximum(variance, 0.0)), np.nan)


def _difference(values: Array, cov: Array) -> tuple[float, bool]:
    """Return how far groups are apart, weighted by their information, and whether it is beyond the noise.

    A group counts for the parameters that it shows; a parameter that is apart by noise counts only where none
    is apart beyond it.
    """
    sizes, certain = [], []
    for p in range(values.shape[1]):
        known = np.flatnonzero(np.isfinite(values[:, p]))
        if known.size < 2:
            continue
        value, own = values[known, p], cov[known, p][:, known, p]
        precision = np.linalg.pinv(own, hermitian=True)
        ones = np.ones(known.size)
        off = value - (ones @ precision @ value) / (ones @ precision @ ones)
        statistic = float(off @ precision @ off)
        certain.append(float(chi2.sf(statistic, known.size - 1)) < CERTAIN_P)
        weight = 1.0 / np.maximum(np.diag(own), 1e-30)
        sizes.append(
            math.sqrt(float(np.average((value - np.average(value, weights=weight)) ** 2, weights=weight)))
        )
    if not sizes:
        return 0.0, False
    clear = [size for size, yes in zip(sizes, certain, strict=True) if yes]
    return max(clear or sizes), bool(clear)


def _main(groups: Sequence[Group]) -> int:
    """Return the parameter that is largest over all groups."""
    return int(np.argmax(np.nan_to_num([np.abs(group.values) for group in groups]).max(axis=0)))
