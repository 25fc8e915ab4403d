"""Whether the value of a cause is one number: by thirds of time, by halves of the runs, and by session.

Every statement is a size, not a test alone: with enough data any difference is significant, and a robot whose
track is 1.4 m early and 1.5 m late still has an effective track.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as fisher
from scipy.stats import t as student

from terrain.discrepancy.evidence import N_BLOCKS, Evidence
from terrain.discrepancy.robot_terms import value_in_robot_terms
from terrain.discrepancy.runs import Signals
from terrain.discrepancy.search import CauseFit
from terrain.discrepancy.selection import clustered_variance
from terrain.discrepancy.verdict import AGREE_P, INTERVAL_T, BySession, Cause, SessionValue, Value
from terrain.effects import Effect
from terrain.records import Array
from terrain.robots import Robot

VARIES_RATIO = 0.5
"""A value whose groups are further apart than that ratio of it, root mean square by their information, is no
value."""

GROWS_RATIO, GROWTH = 0.25, 2.0
"""Nor is one that is apart by the first and grows along runs by the second: a cause that starts from nothing,
as warmth and the rate of a clock do, has 0.54 between its thirds, and grows five times."""

CAVEAT_RATIO = 0.05  #: A value that differs by more than that ratio is given with what it depends on
CERTAIN_P = 1e-5  #: Chance of differences between groups by noise, below which they are stated
MIN_HALF_RUNS = 3  #: Least number of runs in half of them

THIRDS, HALVES = (
    ("first third", "second third", "last third"),
    ("first half of the runs", "second half"),
)


class Constancy(NamedTuple):
    """Values of a cause in parts of the data: in groups of one kind, or split.

    By ``time`` they are thirds of each run's time, the first first, by ``runs`` halves of the runs in the order
    given, where these are enough.
    """

    values: dict[str, Array]  #: by split (groups, p); NaN where a part shows nothing
    std: dict[str, Array]
    ratio: float
    """Root mean square difference of groups from their mean, each with the weight of its information, over the size
    of the value."""
    split: str  #: where that is largest
    certain: bool  #: whether differences are beyond the noise

    @property
    def varies(self) -> bool:
        """Whether the value differs so much that it is none."""
        first, middle, last = self._main("time")
        sign = 1.0 if last > 0 else -1.0
        grows = sign * last > GROWTH * abs(first) and sign * last > sign * middle > sign * first
        least = GROWS_RATIO if self.split == "time" and grows else VARIES_RATIO
        return self.certain and self.ratio > least

    @property
    def caveat(self) -> str:
        """What the value depends on, in words; empty where it is one number."""
        if not self.certain or self.ratio <= CAVEAT_RATIO:
            return ""
        on, names = ("time", THIRDS) if self.split == "time" else ("the run", HALVES)
        named = zip(self._main(self.split), names, strict=True)
        shown = ", ".join(f"{value:.3g} in the {name}" for value, name in named if math.isfinite(value))
        return f"its value depends on {on}: {shown}"

    def _main(self, split: str) -> list[float]:
        """Return the values of the parameter that is largest over all groups."""
        values = self.values[split]
        most: list[float] = values[:, int(np.argmax(np.nan_to_num(np.abs(values)).max(axis=0)))].tolist()
        return most


def constancy_of(
    info: Evidence, names: Sequence[str], own: Sequence[str], change: Array, inflation: float
) -> Constancy:
    """Return the values of some (``own``) of the parameters fitted together, to a change (k,), in parts of the data.

    Variances are those from the noise times ``inflation``.
    """
    n, half = len(info.a), len(info.a) // 2
    where = {"time": np.tile(np.arange(N_BLOCKS), (n, 1))}
    if half >= MIN_HALF_RUNS:
        where["runs"] = np.repeat((np.arange(n) >= half).astype(int)[:, None], N_BLOCKS, axis=1)
    others = [name for name in names if name not in own]
    every, std, apart = {}, {}, {}
    for split, group in where.items():
        values, cov = info.fit(own, others, group)
        cov = inflation * cov
        variance = np.einsum("gpgp->gp", cov)
        every[split] = values
        std[split] = np.where(np.isfinite(values), np.sqrt(np.maximum(variance, 0.0)), np.nan)
        apart[split] = _difference(values, cov)
    size = float(np.linalg.norm(change[[list(names).index(name) for name in own]]))
    certain = [split for split in where if apart[split][1]]
    most = max(certain, key=lambda split: apart[split][0], default="time")
    ratio = apart[most][0] / size if size > 0 else math.inf
    return Constancy(every, std, ratio, most, bool(certain))


def _difference(values: Array, cov: Array) -> tuple[float, bool]:
    """Return how far groups are apart, weighted by their information, and whether it is beyond the noise.

    A group counts for the parameters that it shows; a parameter that is apart by noise counts only where none
    is apart beyond it.
    """
    sizes: dict[bool, list[float]] = {False: [0.0], True: []}
    for p in range(values.shape[1]):
        known = np.flatnonzero(np.isfinite(values[:, p]))
        if known.size < 2:
            continue
        value, own = values[known, p], cov[known, p][:, known, p]
        precision = np.linalg.pinv(own, hermitian=True)
        ones = np.ones(known.size)
        off = value - (ones @ precision @ value) / (ones @ precision @ ones)
        certain = float(chi2.sf(float(off @ precision @ off), known.size - 1)) < CERTAIN_P
        weight = 1.0 / np.maximum(np.diag(own), 1e-30)
        mean = np.average(value, weights=weight)
        sizes[certain].append(math.sqrt(float(np.average((value - mean) ** 2, weights=weight))))
    return max(sizes[True] or sizes[False]), bool(sizes[True])


class PartValues(NamedTuple):
    """A value of a named cause, and those of parts of the data with half their 95 % interval, NaN where not shown."""

    value: Value
    names: tuple[str, ...]
    values: Array
    halves: Array


def part_values(info: Evidence, causes: Sequence[Cause]) -> tuple[PartValues, ...]:
    """Return the values of named causes in parts of the data, of evidence with the causes built in."""
    names = [value.name for cause in causes for value in cause.parameters]
    parts = []
    for cause in causes:
        inflation = max(cause.dispersion, 1.0) if math.isfinite(cause.dispersion) else 1.0
        own = [value.name for value in cause.parameters]
        constant = constancy_of(info, names, own, np.zeros(len(names)), inflation)
        off, std = (np.concatenate([*groups.values()]) for groups in (constant.values, constant.std))
        for k, value in enumerate(cause.parameters):
            parts.append(
                PartValues(
                    value, (*THIRDS, *HALVES)[: len(off)], value.value + off[:, k], INTERVAL_T * std[:, k]
                )
            )
    return tuple(parts)


# -- Values of named causes session by session, with the same causes in each, and whether sessions agree ---
# Of each session all causes that were found over all runs are fitted to its runs alone.  Fitted with sets of
# their own, sessions would not be comparable: a track beside a turning slip is another number than one without.
# The variance of a value is that of the scatter between the runs of its session, weighed with that of the noise
# as in :mod:`terrain.discrepancy.selection`.
#
# Sessions of one terrain are compared by Welch's test of equal means (Biometrika 1951), which is Cochran's Q
# for variances that are estimated themselves; the standard deviation between sessions beyond these variances is
# that of DerSimonian and Laird (Controlled Clinical Trials 1986).

MIN_RUNS = 3  #: Least number of runs of a session: fewer do not show their scatter

SHOWN_RATIO = 1e-4
"""A session shows a parameter if that ratio of its information is its own beside the others."""


def values_by_session(
    fit: CauseFit, signals: Sequence[Signals], named: Sequence[Effect], robot: Robot
) -> tuple[BySession, ...]:
    """Return the values of named causes by terrain and session; none where runs (of the fit) are of one session."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, run in enumerate(signals):
        if run.session:
            groups.setdefault((run.terrain, run.session), []).append(i)
    groups = {key: runs for key, runs in groups.items() if len(runs) >= MIN_RUNS}
    if len(groups) < 2:
        return ()
    tables = []
    for parameter in (p for effect in named for p in effect.parameters):
        for terrain in dict.fromkeys(terrain for terrain, _ in groups):
            sessions, fits = [], []
            for (label, session), runs in groups.items():
                own = _session_fit(fit, runs, parameter.name) if label == terrain else None
                if own is None:
                    continue
                value, std, dof = own
                half = float(student.ppf(0.975, dof)) * std
                text = value_in_robot_terms(parameter.name, value, value - half, value + half, robot)
                sessions.append(SessionValue(session, len(runs), value, (value - half, value + half), text))
                fits.append(own)
            if sessions:
                p, between = agreement(*np.array(fits).T)
                about = parameter.name, parameter.unit, terrain, tuple(sessions)
                tables.append(BySession(*about, p, between, not p < AGREE_P))
    return tuple(tables)


def _session_fit(fit: CauseFit, runs: Sequence[int], parameter: str) -> tuple[float, float, float] | None:
    """Return a parameter fitted to some runs beside the others, its standard deviation and degrees."""
    info = replace(fit.info, grams=fit.info.grams[list(runs)])
    own, (a, g) = fit.names.index(parameter), info.clusters(info.places(fit.names))
    total = a.sum(axis=0)
    unit = np.sqrt(np.maximum(np.diag(total), 1e-30))
    cov = np.linalg.pinv(total / np.outer(unit, unit), rcond=1e-10, hermitian=True) / np.outer(unit, unit)
    size = float(cov[own, own])
    if not size * total[own, own] < 1.0 / SHOWN_RATIO or not total[own, own] > 1e-12:
        return None
    x = cov @ g.sum(axis=0)
    variance, dof = clustered_variance(a, g, x, cov[own], size)
    return float(x[own]), math.sqrt(variance * size), dof


def agreement(value: Array, std: Array, dof: Array) -> tuple[float, float]:
    """Return the probability of such differences between sessions that agree, and their own deviation.

    Parameters
    ----------
    value, std, dof : (sessions,) values, their standard deviations, and the degrees of freedom of these

    Returns
    -------
    p : NaN for fewer than two sessions
    between_std : beyond the standard deviations; 0 where these explain the differences

    Examples
    --------
    >>> p, between = agreement(np.array([0.70, 0.71]), np.array([0.01, 0.01]), np.array([30.0, 30.0]))
    >>> p > 0.3, between
    (True, 0.0)
    >>> p, between = agreement(np.array([0.70, 0.90]), np.array([0.01, 0.01]), np.array([30.0, 30.0]))
    >>> p < 1e-6, round(between, 2)
    (True, 0.14)
    """
    k = len(value)
    if k < 2:
        return math.nan, math.nan
    weight = 1.0 / np.maximum(std, 1e-12) ** 2
    total = float(weight.sum())
    q = float((weight * (value - float((weight * value).sum()) / total) ** 2).sum())
    loose = float(((1.0 - weight / total) ** 2 / dof).sum())
    statistic = q / (k - 1) / (1.0 + 2.0 * (k - 2) / (k**2 - 1) * loose)
    p = float(fisher.sf(statistic, k - 1, (k**2 - 1) / (3.0 * loose)))
    spread = total - float((weight**2).sum()) / total
    return p, math.sqrt(max(q - (k - 1), 0.0) / spread)
