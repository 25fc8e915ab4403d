"""Noise from data: the variances under which the logs are most likely.

The log likelihood of a filter is the sum of log N(nu; 0, S) over its innovations (Sarkka, Bayesian Filtering
and Smoothing, 2013, 12.3), so that noise can be fitted to runs without a truth.  Gates are off meanwhile:
otherwise it would pay to leave out what does not fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from terrain.errors import ConfigError, DataError
from terrain.estimation.filter import FilterModel, Noise, log_likelihood
from terrain.records import Array

WIDEST_SCALE = 1e4
"""No variance is scaled up or down by more than this."""

CLEAR_DROP = 2.0
"""A scale twice or half as large has to cost this much log likelihood, as an error of two standard deviations
does; otherwise the runs say nothing on it."""


class NoiseGroup(NamedTuple):
    """Variances that share one scale: of the process, by states, and of the measurements, by rows."""

    name: str
    states: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()


class TuningStatus(StrEnum):
    """What the runs say of a scale: determined, at the end of its range, or not determined."""

    FOUND = "found"
    AT_BOUND = "at bound"
    NOT_EXCITED = "not excited"


class TunedGroup(NamedTuple):
    """The scale of a group's variances, and how well the runs determine it."""

    name: str
    scale: float
    status: TuningStatus


class TuningReport(NamedTuple):
    """What tuning did; log likelihoods are sums over all runs."""

    groups: tuple[TunedGroup, ...]
    log_likelihood_before: float
    log_likelihood_after: float
    n_evaluations: int
    converged: bool


def tune_noise(
    model: FilterModel,
    tables: Sequence[tuple[Array, Array]],
    noise: Noise,
    groups: Sequence[NoiseGroup],
    max_evaluations: int = 400,
) -> tuple[Noise, TuningReport]:
    """Scale groups of variances so that runs become as likely as they can.

    Parameters
    ----------
    model : the filter
    tables : ``time_s (n,), z (n, m)`` of each run
    noise : where to start, with variances of measurements that do not change from sample to sample
    groups : what is scaled together; what is in no group stays
    max_evaluations : of the summed likelihood; the check of each group comes on top, with two a group

    Returns
    -------
    Noise, TuningReport
        the search is L-BFGS-B on the logarithm of the scales, between 1 / :data:`WIDEST_SCALE` and that.

    Raises
    ------
    ConfigError
        where there is no group, or one names nothing, what the model does not have, or what another has.
    DataError
        where there is no run, or the noise changes from sample to sample.
    """
    if not groups:
        raise ConfigError("there is no group to tune")
    scaled = [_members(model, group) for group in groups]
    taken = [member for members in scaled for member in members]
    for twice in (member for member in taken if taken.count(member) > 1):
        raise ConfigError(f"{' '.join(twice)} is in two groups")
    if not tables:
        raise DataError("there is no run to tune on")
    if noise.measurement_variance.ndim > 1:
        raise DataError("measurement_variance changes from sample to sample: tune on one variance a row")
    n_samples = sum(len(time_s) for time_s, _ in tables)
    n_evaluations = 0

    def likelihood(log_scale: Array) -> float:
        nonlocal n_evaluations
        n_evaluations += 1
        tried = _scaled(model, noise, scaled, np.exp(log_scale))
        return math.fsum(log_likelihood(model, tried, time_s, z) for time_s, z in tables)

    widest, start = math.log(WIDEST_SCALE), np.zeros(len(groups))
    before = likelihood(start)
    found = minimize(
        lambda log_scale: -likelihood(log_scale) / n_samples,
        start,
        method="L-BFGS-B",
        bounds=[(-widest, widest)] * len(groups),
        options={"maxfun": max_evaluations, "eps": 1e-4, "ftol": 1e-9},
    )
    best = np.asarray(found.x)
    after = likelihood(best)
    report = []
    for i, group in enumerate(groups):
        drops = [
            after - likelihood(best + shift) for shift in math.log(2) * np.eye(len(groups))[i] * [[1], [-1]]
        ]
        status = TuningStatus.FOUND if min(drops) > CLEAR_DROP else TuningStatus.NOT_EXCITED
        if abs(best[i]) > widest - 1e-3:
            status = TuningStatus.AT_BOUND
        report.append(TunedGroup(group.name, float(np.exp(best[i])), status))
    tuned = _scaled(model, noise, scaled, np.exp(best))
    return tuned, TuningReport(tuple(report), before, after, n_evaluations, bool(found.success))


def _members(model: FilterModel, group: NoiseGroup) -> list[tuple[str, str]]:
    for what, names, known in (("state", group.states, model.states), ("row", group.rows, model.rows)):
        for unknown in (name for name in names if name not in known):
            raise ConfigError(f"group {group.name}: filter {model.name} has no {what} {unknown!r}")
    members = [("state", name) for name in group.states] + [("row", name) for name in group.rows]
    if not members:
        raise ConfigError(f"group {group.name} names neither states nor rows")
    return members


def _scaled(model: FilterModel, noise: Noise, groups: list[list[tuple[str, str]]], scales: Array) -> Noise:
    q, r = np.ones(len(model.states)), noise.measurement_variance.copy()
    for members, scale in zip(groups, scales.tolist(), strict=True):
        for what, name in members:
            if what == "state":
                q[model.states.index(name)] = math.sqrt(scale)
            else:
                r[model.rows.index(name)] *= scale
    return Noise(noise.process_variance * np.outer(q, q), r, noise.initial_variance)
