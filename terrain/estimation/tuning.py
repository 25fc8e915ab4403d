"""Process noise of a filter from runs: the variances under which these are most likely.

The log likelihood of a filter is the sum of log N(nu; 0, S) over its innovations (Sarkka, Bayesian Filtering
and Smoothing, 2013, 12.3), so that noise can be fitted to runs without a truth.  Gates are off meanwhile:
otherwise it would pay to leave out what does not fit.  As s = h P h' + R is at least R, a constant less the sum of
squares of ``nu / sqrt(s)`` and of ``sqrt(log(s / R))`` is twice that likelihood, and
:func:`terrain.identify.identify` finds the scales.

Measurement noise stays: behind the common low-pass an error lasts longer than a sample, and a likelihood that
takes each for independent would drive the variances of the sensors to zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from terrain.errors import DataError
from terrain.estimation.estimate import model_of
from terrain.estimation.feed import measurement_table
from terrain.estimation.filter import Filter, FilterModel, FilterSettings
from terrain.extension import corrected, corrected_log
from terrain.identify import Parameter, identify
from terrain.records import Array, RunLog
from terrain.robots import Robot, robot_named

#: Number of runs to tune on unless they are named: the likelihood of each is evaluated a hundred times.
MAX_RUNS = 3
MAX_STEPS = 25  #: Of the search, each of which evaluates the likelihood once, and once a group.
WIDEST_SCALE = 1e4  #: No variance is scaled up or down by more than this.
#: A scale that is so near to that, as a logarithm, is at its bound: the likelihood is flat there.
AT_END = 0.1
#: A scale twice or half as large has to cost this much log likelihood, as an error of two standard deviations does;
#: otherwise the runs say nothing on it.
CLEAR_DROP = 2.0
#: States are tuned together whose names begin alike.
GROUPS = ("speed", "yaw_rate", "accel", "steer", "slip", "effective_track", "gyro_bias")


class TuningStatus(StrEnum):
    """What the runs say of a scale: determined, at the end of its range, or not determined."""

    FOUND = "found"
    AT_BOUND = "at bound"
    NOT_EXCITED = "not excited"


@dataclass(frozen=True, slots=True)
class TunedNoise:
    """Result of a tuning."""

    runs: tuple[str, ...]  #: ids of the runs tuned on
    log_likelihood_before: float  #: summed over them
    log_likelihood_after: float
    scales: Mapping[str, float]  #: of the variances, by group
    status: Mapping[str, TuningStatus]  #: of each scale, by group


def tuned_noise(
    runs: Sequence[RunLog], robot: Robot | None, name: str, names: Sequence[str] | None = None
) -> tuple[Array, TunedNoise]:
    """Return the process variance under which runs as measured are most likely, and what became of each group.

    Parameters
    ----------
    robot : whose they are; by default the one that the first names
    name : of the filter
    names : of the runs to tune on; the first few by default; ``DataError`` if there is no run of a name
    """
    by_id = {run.run_id: run for run in runs}
    names = list(by_id)[:MAX_RUNS] if names is None else names
    if not names:
        raise DataError("no run to tune on is named")
    for unknown in (each for each in names if each not in by_id):
        raise DataError(f"there is no run {unknown!r} to tune on; there are {', '.join(by_id)}")
    robot = robot or robot_named(by_id[names[0]].robot)
    logs, robot = [corrected_log(by_id[each], robot) for each in names], corrected(robot)
    model = model_of(logs[0], robot, name)
    tables = [measurement_table(run, robot) for run in logs]
    samples = [(table.time_s, table.columns(model.rows)) for table in tables]
    tuned, report = tune_noise(model, samples, tuple(names))
    return tuned.process_variance, report


def tune_noise(
    model: FilterModel, samples: Sequence[tuple[Array, Array]], runs: tuple[str, ...] = ()
) -> tuple[FilterModel, TunedNoise]:
    """Scale the process variances of each of :data:`GROUPS` so that samples become as likely as they can.

    ``samples`` are ``time_s (n,), z (n, m)`` of each run, by whose ids they are reported.
    """
    members = {name: [state.startswith(name) for state in model.states] for name in GROUPS}
    members = {name: states for name, states in members.items() if any(states)}

    def scaled(log_scales: Array) -> FilterModel:
        std = np.ones(len(model.states))
        for states, log_scale in zip(members.values(), log_scales.tolist(), strict=True):
            std[states] = math.exp(0.5 * log_scale)
        return replace(model, process_variance=model.process_variance * np.outer(std, std))

    def run(log_scales: Array) -> tuple[Array, Array]:
        """Return of each sensor at each sample its squared innovation, 0 where there is none, and its likelihood."""
        tried, ungated = scaled(log_scales), FilterSettings(gate_probability=1.0)
        columns = [Filter(tried, ungated).run(*sample, keep=False) for sample in samples]
        nis = np.nan_to_num(np.concatenate([each.nis for each in columns]))
        return nis, np.concatenate([each.likelihood for each in columns])

    log_r = np.log(2 * np.pi * model.measurement_variance)
    known = np.isfinite(np.concatenate([z for _, z in samples])) * log_r
    least = np.column_stack(
        [known[:, [model.rows.index(row) for row in rows]].sum(axis=1) for _, rows in model.sensors]
    )

    def residual(log_scales: Array) -> Array:
        nis, likelihoods = run(log_scales)
        wider = np.where(likelihoods == 0.0, 0.0, -2.0 * likelihoods - nis - least)
        return np.asarray(np.sqrt(np.concatenate([nis.ravel(), np.maximum(wider, 0.0).ravel()])))

    widest = math.log(WIDEST_SCALE)
    fit = identify(residual, [Parameter(name, 0.0, -widest, widest) for name in members], max_nfev=MAX_STEPS)
    before, after = (float(run(at)[1].sum()) for at in (np.zeros(len(members)), fit.value))
    status = {}
    for i, name in enumerate(members):
        shift = math.log(2) * np.eye(len(members))[i]
        drop = after - max(float(run(fit.value + side * shift)[1].sum()) for side in (1.0, -1.0))
        status[name] = TuningStatus.FOUND if drop > CLEAR_DROP else TuningStatus.NOT_EXCITED
        if abs(fit.value[i]) > widest - AT_END:
            status[name] = TuningStatus.AT_BOUND
    scales = dict(zip(members, np.exp(fit.value).tolist(), strict=True))
    return scaled(fit.value), TunedNoise(runs, before, after, scales, status)
