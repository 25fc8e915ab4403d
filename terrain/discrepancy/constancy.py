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
from scipy.stats import f as fisher
from scipy.stats import t as student

from terrain.discrepancy.evidence import N_BLOCKS, Evidence
from terrain.discrepancy.robot_terms import value_in_robot_terms
from terrain.discrepancy.search import Found
from terrain.discrepancy.selection import clustered_variance
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.verdict import INTERVAL_T, BySession, Cause, SessionValue, Value
from terrain.effects import PARAMETER, Effect
from terrain.records import Array
from terrain.robots import Robot

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


# -- Values of named causes in parts of the data: whether each is one number shows at a glance -------------


class Part(NamedTuple):
    """A value in a part of the data, and half its 95 % interval; NaN where that part does not show it."""

    name: str
    value: float
    half: float


class PartValues(NamedTuple):
    """A value of a named cause, and that of thirds of the time and halves of the runs."""

    value: Value
    parts: tuple[Part, ...]


def part_values(info: Evidence, causes: Sequence[Cause]) -> tuple[PartValues, ...]:
    """Return the values of named causes by thirds of the time and halves of the runs.

    Parameters
    ----------
    info : around the simulation with the causes built in
    causes : named
    """
    names = [value.name for cause in causes for value in cause.values]
    found = []
    for cause in causes:
        own = [value.name for value in cause.values]
        inflation = max(cause.dispersion, 1.0) if math.isfinite(cause.dispersion) else 1.0
        constant = constancy_of(info, names, own, np.zeros(len(names)), inflation)
        for k, value in enumerate(cause.values):
            found.append(
                PartValues(
                    value,
                    tuple(
                        Part(
                            group.name, value.value + float(group.values[k]), INTERVAL_T * float(group.std[k])
                        )
                        for group in (*constant.thirds, *constant.halves)
                    ),
                )
            )
    return tuple(found)


# -- Values of named causes session by session, with the same causes in each, and whether sessions agree ---
# Of each session ``s`` all causes that were found over all runs are fitted to its runs alone, by the quadratic
# forms of the joint fit: ``x_s = A_s^-1 g_s``, ``A_s`` and ``g_s`` summed over its runs.  Fitted with sets of
# their own, sessions would not be comparable: a track beside a turning slip is another number than one without.
# The variance of a value is that of the scatter between the runs of its session, weighed with that of the noise
# as in :mod:`terrain.discrepancy.selection`.
#
# Sessions of one terrain are compared by Welch's test of equal means (Biometrika 1951), which is Cochran's Q
# for variances that are estimated themselves; the standard deviation between sessions beyond these variances is
# that of DerSimonian and Laird (Controlled Clinical Trials 1986).

MIN_RUNS = 3
"""Least number of runs of a session: fewer do not show their scatter."""

SHOWN_RATIO = 1e-4
"""A session shows a parameter if that ratio of its information is its own beside the others."""


def values_by_session(
    found: Found, signals: Sequence[Signals], named: Sequence[Effect], robot: Robot
) -> tuple[BySession, ...]:
    """Return the values of named causes by terrain and session; none where runs are of one session.

    Parameters
    ----------
    found : the fit to all runs
    signals : of the same runs, in the same order
    named : causes whose values are compared
    robot : whose description values are stated by
    """
    groups: dict[tuple[str, str], list[int]] = {}
    for i, run in enumerate(signals):
        if run.session:
            groups.setdefault((run.terrain, run.session), []).append(i)
    groups = {key: runs for key, runs in groups.items() if len(runs) >= MIN_RUNS}
    if len(groups) < 2:
        return ()
    tables = []
    for parameter in (p.name for effect in named for p in effect.parameters):
        for terrain in dict.fromkeys(terrain for terrain, _ in groups):
            values, dofs = [], []
            for (label, session), runs in groups.items():
                fit = _fitted(found, runs, parameter) if label == terrain else None
                if fit is not None:
                    values.append(_session_value(session, len(runs), parameter, fit, robot))
                    dofs.append(fit[2])
            if values:
                stds = np.array([value.std for value in values])
                p, between = agreement(np.array([value.value for value in values]), stds, np.array(dofs))
                unit = PARAMETER[parameter].unit
                tables.append(BySession(parameter, unit, terrain, tuple(values), p, between))
    return tuple(tables)


def _fitted(found: Found, runs: Sequence[int], parameter: str) -> tuple[float, float, float] | None:
    """Return a parameter fitted to some runs beside the others, its standard deviation and degrees."""
    info, at = found.info, found.info.places(found.names)
    own = found.names.index(parameter)
    a, g = info.a[list(runs)][:, at][:, :, at], info.g[list(runs)][:, at]
    total = a.sum(axis=0)
    unit = np.sqrt(np.maximum(np.diag(total), 1e-30))
    cov = np.linalg.pinv(total / np.outer(unit, unit), rcond=1e-10, hermitian=True) / np.outer(unit, unit)
    if not cov[own, own] * total[own, own] < 1.0 / SHOWN_RATIO or not total[own, own] > 1e-12:
        return None
    x, direction, size = cov @ g.sum(axis=0), cov[own], float(cov[own, own])
    variance, dof = clustered_variance(a, g, x, direction, size)
    # changes of the fit are counted from the simulation that was given, as those of all runs together
    return float(x[own]), math.sqrt(variance * size), dof


def _session_value(
    session: str, n_runs: int, parameter: str, fit: tuple[float, float, float], robot: Robot
) -> SessionValue:
    value, std, dof = fit
    half = float(student.ppf(0.975, dof)) * std
    ends = (value, value - half, value + half)
    text = value_in_robot_terms(parameter, *ends, robot)
    return SessionValue(session, n_runs, *ends, std, text)


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
