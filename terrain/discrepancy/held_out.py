"""Runs held out of a diagnosis: which, their repair, and what an extension gains on them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.discrepancy.diagnose import MIN_RUNS
from terrain.discrepancy.evidence import MIN_CLUSTERS, N_BLOCKS, Evidence, evidence_at
from terrain.discrepancy.health.fault import Fault
from terrain.discrepancy.health.unfit import unfit_runs
from terrain.discrepancy.runs import (
    Excluded,
    LowPass,
    Signals,
    Simulation,
    low_pass_of,
    measured_channels,
    rows_of,
)
from terrain.discrepancy.search import names_of
from terrain.effects import CHANNELS
from terrain.errors import DataError, TerrainError
from terrain.estimation.estimate import Estimate, estimate_run, summarize
from terrain.records import Array, RunLog
from terrain.robots import Robot

HOLD_OUT_FROM, HOLD_OUT_EVERY = 6, 4  #: With so many runs or more, one in every so many is held out

N_BOOTSTRAP = 2000

MIN_JUDGED = 3  #: Least number of runs among which an unfit one can be found


def split_runs(runs: Sequence[RunLog], hold_out: int | None, seed: int) -> tuple[list[RunLog], list[RunLog]]:
    """Return the runs for the diagnosis and those held out.

    Runs are put in a random order, terrain after terrain, and of ``n`` that are held out every
    ``len(runs) / n``-th is taken, so that each terrain contributes in proportion.

    Parameters
    ----------
    hold_out : number of runs held out; by default a quarter of six or more
    seed : of the order

    Raises
    ------
    DataError
        if too few would be left for the diagnosis.
    """
    n = hold_out
    if n is None:
        n = math.ceil(len(runs) / HOLD_OUT_EVERY) if len(runs) >= HOLD_OUT_FROM else 0
    elif n and len(runs) - n < MIN_RUNS:
        raise DataError(f"--hold-out is {n} of {len(runs)} runs; the diagnosis requires at least {MIN_RUNS}")
    drawn = np.random.default_rng(seed).permutation(len(runs))
    order = sorted(drawn, key=lambda i: runs[i].terrains)
    held_out = {order[k * len(runs) // n] for k in range(n)}
    used = [run for i, run in enumerate(runs) if i not in held_out]
    return used, [run for i, run in enumerate(runs) if i in held_out]


def repair_held_out(
    signals: Sequence[Signals],
    faults: Sequence[Fault],
    simulation: Simulation,
    low_pass: LowPass,
    noise: Mapping[str, float],
) -> tuple[Signals, ...]:
    """Return runs held out without the faults that were found in the others, in the order of their repair.

    A run has a fault if it is nearer to the simulation, with the causes built in, without it: by squares over the
    ``noise`` of each channel.  A channel whose readings could not be distinguished is left out of all of them.
    """
    size = np.array([noise.get(name) or math.nan for name in CHANNELS])

    def misfit(run: Signals) -> float:
        planar = simulation.planar_on(run.terrain)
        residual = rows_of(run, planar, simulation.vector, (), low_pass).residual
        return float(np.nansum((residual / size) ** 2))

    fixed = []
    for run in signals:
        for fault in faults:
            right = fault.change.applied(run)
            run = right if math.isnan(fault.change.factor) else min(run, right, key=misfit)
        fixed.append(run)
    return tuple(fixed)


def ratio_of_sums(part: Array, whole: Array, seed: int) -> tuple[float, tuple[float, float]]:
    """Return what a part (n,) is of the whole (n,) over clusters, and its 95 % interval by bootstrap over these.

    Examples
    --------
    >>> ratio_of_sums(np.array([2.0, 0.0]), np.array([2.0, 2.0]), 0)
    (0.5, (0.0, 1.0))
    """
    weights = bootstrap_counts(len(part), N_BOOTSTRAP, seed)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios, ratio = (weights @ part) / (weights @ whole), float(part.sum() / whole.sum())
    if not np.isfinite(ratios).any():
        return math.nan, (math.nan, math.nan)
    return ratio, percentile_interval(ratios)


# -- What an extension gains: the part of the square that it removes, by bootstrap over clusters -----------


class ChannelGain(NamedTuple):
    """Measured minus simulated in one channel, before and after."""

    rms_before: float  #: behind the common low-pass, in the channel's unit
    rms_after: float
    white_before: float  #: behind the whitening filter, too; noise alone has 1
    white_after: float
    reduction: float  #: ratio of the square behind the low-pass that is removed
    ci: tuple[float, float]  #: its 95 % interval
    refused: bool  #: whether no gain can be claimed: the interval includes zero, or lies below


class Gain(NamedTuple):
    """What an extension gains."""

    runs: tuple[str, ...]  #: ids of those on which it was measured
    excluded_runs: tuple[Excluded, ...]  #: that were given and are unfit
    clusters: str  #: ``runs``, or ``thirds of runs`` where runs are few
    channels: dict[str, ChannelGain]
    reduction: float  #: of the whitened square of all channels, with variations from run to run marginalised
    ci: tuple[float, float]
    refused: bool


def gain_of_signals(
    simulation: Simulation, extended: Simulation, runs: Sequence[Signals], seed: int = 0
) -> Gain:
    """Return by how much an extension reduces the residual of runs that were not used to find it.

    One low-pass and one whitening filter serve before and after: fitted to the residual that
    remains with the whole library freed around the extension.
    """
    signals, excluded, after = fit_to_judge(extended, runs)
    given = simulation, simulation.vector, (), low_pass_of(signals), after.noise, after.scatter
    infos, n_parts = (evidence_at(signals, *given), after), 1 if len(signals) >= MIN_CLUSTERS else N_BLOCKS
    channels = {}
    for name in measured_channels(after.rows):
        c, rms, squares = CHANNELS.index(name), [], []
        for info in infos:
            white = [np.where(run[-1, :, c] == 0.0, np.nan, run[-1, :, c]) for run in info.white]
            for residuals in ([run.residual[:, c] for run in info.rows], white):
                parts = [part for values in residuals for part in np.array_split(values, n_parts)]
                squares.append(np.array([np.nansum(part**2) for part in parts]))
                known = int(np.isfinite(np.concatenate(residuals)).sum())
                rms.append(float(np.sqrt(squares[-1].sum() / known)) if known else math.nan)
        reduction, ci = ratio_of_sums(squares[0] - squares[2], squares[0], seed)
        channels[name] = ChannelGain(rms[0], rms[2], rms[1], rms[3], reduction, ci, not ci[0] > 0.0)
    costs: list[list[float]] = []  # what each cluster adds to minus twice the log-likelihood
    for info in infos:
        # its own scatter integrated out: of each third of a run, since parts of a common one need not be positive
        prior = np.diag(1.0 / info.nuisance_std**2)
        costs.append([])
        for run in info.white:
            for third in np.array_split(run[[*info.nuisances, -1]], n_parts, axis=1):
                gram = np.einsum("qmc,pmc->qp", third, third)
                shown = gram[:-1, -1]
                costs[-1].append(float(gram[-1, -1] - shown @ np.linalg.solve(gram[:-1, :-1] + prior, shown)))
    before, extended_costs = np.array(costs)
    reduction, ci = ratio_of_sums(before - extended_costs, before, seed)
    ids, clusters = tuple([run.run_id for run in signals]), "runs" if n_parts == 1 else "thirds of runs"
    return Gain(ids, excluded, clusters, channels, reduction, ci, not ci[0] > 0.0)


def fit_to_judge(
    simulation: Simulation, runs: Sequence[Signals]
) -> tuple[tuple[Signals, ...], tuple[Excluded, ...], Evidence]:
    """Return the runs that are fit to be judged on, those that are not, and the evidence of the first.

    Raises
    ------
    DataError
        if there is no run, or none is fit.
    """
    signals = tuple(runs)
    if not signals:
        raise DataError("gain: there is no run that was not used in the diagnosis")
    about = simulation, simulation.vector, names_of(simulation.library), low_pass_of(signals)
    info = evidence_at(signals, *about)
    excluded = unfit_runs(signals, info) if len(signals) >= MIN_JUDGED else ()
    if excluded:
        gone = [run.run_id for run in excluded]
        signals = tuple([run for run in signals if run.run_id not in gone])
        if not signals:
            raise DataError(f"gain: none of {len(runs)} runs is fit to be compared ({excluded[0].reason})")
        info = evidence_at(signals, *about)
    return signals, tuple(excluded), info


# -- What an extension gains for the robot's filter, against the truth of runs that have one ---------------

FILTERS = {"swerve": "vio12", "skid_steer": "skid", "tracked": "skid"}
"""By kind of drive, the filter whose errors are compared."""

ERRORS = ("speed_mps", "yaw_rate_radps", "slip_ratio")
"""Errors that are compared: root mean squares of speed and yaw rate, and the error of the mean slip."""


class Change(NamedTuple):
    """A figure before and after an extension, and the 95 % interval of its change (None for one run)."""

    before: float
    after: float
    change_ci: tuple[float, float] | None


class Comparison(NamedTuple):
    """What an extension changes for a filter or a classifier (recipe) on held-out runs."""

    name: str
    reason: str | None  #: why there are no errors; None where there are
    n_runs: int  #: that were compared
    errors: Mapping[str, Change]  #: by figure
    terrains: tuple[str, ...] | None = None  #: of the runs; None where they do not matter

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as JSON has it."""
        return {key: value for key, value in self._asdict().items() if key != "terrains" or value is not None}


def filter_gain(runs: Sequence[RunLog], robot: Robot, extended: Simulation, seed: int) -> Comparison | None:
    """Return the errors of the robot's filter before and after, on runs with a truth; None without any.

    Errors are means over runs; the interval is that of the difference, by bootstrap over runs.
    """
    name = FILTERS.get(robot.drive)
    known = [run for run in runs if "truth" in run.streams]
    if name is None or not known:
        return None
    better = replace(robot, effects=dict(extended.effects), effects_cov=np.empty((0, 0)))
    try:
        rows = [[_errors(estimate_run(run, one, name)) for one in (robot, better)] for run in known]
    except TerrainError as error:
        return Comparison(name, str(error), len(known), {})
    errors = {}
    for key, (before, after) in zip(ERRORS, np.array(rows).transpose(2, 1, 0), strict=True):
        if np.isfinite(before + after).all():
            interval = ratio_of_sums(after - before, np.ones(len(rows)), seed)[1]
            of_means = float(before.mean()), float(after.mean())
            errors[key] = Change(*of_means, interval if len(rows) > 1 else None)
    return Comparison(name, None, len(rows), errors)


def _errors(estimate: Estimate) -> tuple[float, ...]:
    """Return the errors of a run, in the order of :data:`ERRORS`."""
    summary, track, truth = summarize(estimate), estimate.track, estimate.run.streams["truth"]
    squares = dict.fromkeys(("speed", "yaw_rate"), np.zeros(len(track.time_s)))
    for state in track.states:
        kind = state.removesuffix("_mps").removesuffix("_radps").removesuffix("_x").removesuffix("_y")
        if kind in squares:
            true = truth.channel("speed_x_mps" if state == "speed_mps" else state)
            error = track.state(state) - np.interp(track.time_s, truth.time_s, true)
            squares[kind] = squares[kind] + error**2
    rms = [math.sqrt(float(np.nanmean(square))) for square in squares.values()]
    slip_error = abs(summary.slip_mean - summary.slip_true_mean)
    return (*rms, slip_error if summary.slip_observable else math.nan)


def accuracy_change(before: Array, after: Array, run_id: Array, seed: int) -> Change:
    """Return accuracies before and after (n,), and the 95 % interval of their difference by bootstrap over runs (n,).

    Examples
    --------
    >>> before, after = np.array([0, 0, 1, 1]), np.array([1, 1, 1, 1])
    >>> accuracy_change(before, after, np.array(["a", "a", "b", "b"]), 0)
    Change(before=0.5, after=1.0, change_ci=(0.0, 1.0))
    """
    runs, of = np.unique(run_id, return_inverse=True)
    change = np.bincount(of, weights=after.astype(float) - before.astype(float), minlength=len(runs))
    interval = ratio_of_sums(change, np.bincount(of, minlength=len(runs)), seed)[1]
    return Change(float(before.mean()), float(after.mean()), interval)
