"""Values of named causes session by session, with the same causes in each, and whether sessions agree.

Of each session ``s`` all causes that were found over all runs are fitted to its runs alone, by the quadratic
forms of the joint fit: ``x_s = A_s^-1 g_s``, ``A_s`` and ``g_s`` summed over its runs.  Fitted with sets of
their own, sessions would not be comparable: a track beside a turning slip is another number than one without.
The variance of a value is that of the scatter between the runs of its session, weighed with that of the noise
as in :mod:`terrain.discrepancy.selection`.

Sessions of one terrain are compared by Welch's test of equal means (Biometrika 1951), which is Cochran's Q
for variances that are estimated themselves; the standard deviation between sessions beyond these variances is
that of DerSimonian and Laird (Controlled Clinical Trials 1986).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import f as fisher
from scipy.stats import t as student

from terrain.discrepancy.robot_terms import value_in_robot_terms
from terrain.discrepancy.search import Found
from terrain.discrepancy.selection import pooled_variance
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.verdict import BySession, SessionValue
from terrain.effects import PARAMETER, Effect
from terrain.records import Array
from terrain.robots import Robot

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
    part = (g - a @ x) @ direction
    fraction = np.clip(np.einsum("i,kij,j->k", direction, a, direction) / size, 0.0, 0.9)
    variance, dof = pooled_variance(part, fraction, size)
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
