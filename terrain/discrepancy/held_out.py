"""Which runs are held out of a diagnosis, to measure on them what an extension gains, and their repair."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.discrepancy.diagnose import MIN_RUNS
from terrain.discrepancy.evidence import N_BLOCKS, Evidence, evidence_at
from terrain.discrepancy.faults import Fault
from terrain.discrepancy.residuals import LowPass, low_pass_of, measured_channels, rows_of
from terrain.discrepancy.search import names_of
from terrain.discrepancy.selection import MIN_CLUSTERS
from terrain.discrepancy.signals import Signals, signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.unfit import unfit_runs
from terrain.discrepancy.verdict import Excluded
from terrain.effects import CHANNELS
from terrain.errors import ConfigError, DataError, TerrainError
from terrain.estimation.estimate import Estimate, estimate_run, summarize
from terrain.records import Array, RunLog
from terrain.robots import Robot

HOLD_OUT_FROM, HOLD_OUT_EVERY = 6, 4
"""With so many runs or more, one in every so many is held out."""


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
    if not n:
        return list(runs), []
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
    """Return runs held out without the faults that were found in the others.

    A run has a fault if it is nearer to the simulation without it; a channel whose readings could not be
    distinguished is left out of all of them.

    Parameters
    ----------
    signals : of the runs held out
    faults : found in the runs behind the diagnosis, in the order in which they are repaired
    simulation : with the causes built in
    low_pass : of the comparison
    noise : by channel, over which squares are added
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


# -- What an extension gains on held-out runs --------------------------------------------------------------

N_BOOTSTRAP = 2000

MIN_JUDGED = 3
"""Least number of runs among which an unfit one can be found."""


class Reduction(NamedTuple):
    """Ratio of the square that an extension removes, and its 95 % interval by bootstrap over clusters.

    Examples
    --------
    >>> Reduction(0.4, 0.1, 0.6).refused, Reduction(0.4, -0.1, 0.6).refused
    (False, True)
    """

    ratio: float
    low: float
    high: float

    @property
    def refused(self) -> bool:
        """Whether no gain can be claimed: the interval includes zero, or lies below."""
        return not self.low > 0.0

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        return {"reduction": self.ratio, "ci": (self.low, self.high), "refused": self.refused}


class ChannelGain(NamedTuple):
    """Measured minus simulated in one channel, before and after.

    Parameters
    ----------
    rms_before, rms_after : behind the common low-pass, in the channel's unit
    white_before, white_after : behind the whitening filter, too; noise alone has 1
    reduction : of the square behind the low-pass
    """

    rms_before: float
    rms_after: float
    white_before: float
    white_after: float
    reduction: Reduction

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        named = self._asdict()
        return {**named.pop("reduction").as_json(), **named}


class Gain(NamedTuple):
    """What an extension gains.

    Parameters
    ----------
    run_ids : of the runs on which it was measured
    excluded : runs that were given and are unfit
    clusters : ``runs``, or ``thirds of runs`` where runs are few
    channels : by name
    reduction : of the whitened square of all channels, with variations from run to run marginalised
    """

    run_ids: tuple[str, ...]
    excluded: tuple[Excluded, ...]
    clusters: str
    channels: dict[str, ChannelGain]
    reduction: Reduction

    @property
    def refused(self) -> bool:
        """Whether no gain can be claimed."""
        return self.reduction.refused

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        own = {"runs": self.run_ids, "excluded_runs": self.excluded, "clusters": self.clusters}
        return {**own, **self.reduction.as_json(), "channels": self.channels}


def gain(simulation: Simulation, extended: Simulation, runs: Sequence[RunLog], seed: int = 0) -> Gain:
    """Return by how much an extension reduces the residual of runs that were not used to find it.

    One low-pass and one whitening filter serve before and after: fitted to the residual that
    remains with the whole library freed around the extension.

    Parameters
    ----------
    simulation, extended : before and after
    runs : held out of the diagnosis
    seed : of the bootstrap

    Raises
    ------
    ConfigError
        if the two are of different robots.
    DataError
        if there is no run, or none is fit.
    """
    if simulation.robot.name != extended.robot.name:
        raise ConfigError(
            f"the extension is of the robot {extended.robot.name!r}, not of {simulation.robot.name!r}"
        )
    return gain_of_signals(simulation, extended, [signals_of(run, simulation.robot) for run in runs], seed)


def gain_of_signals(
    simulation: Simulation, extended: Simulation, runs: Sequence[Signals], seed: int = 0
) -> Gain:
    """Return the same for runs that are on one clock already; see :func:`gain`."""
    signals, excluded, after = fit_to_judge(extended, runs)
    low_pass = low_pass_of(signals)
    before = evidence_at(signals, simulation, simulation.vector, (), low_pass, after.statistics)
    by_run = len(signals) >= MIN_CLUSTERS
    weights = bootstrap_counts(len(signals) * (1 if by_run else N_BLOCKS), N_BOOTSTRAP, seed)
    channels = {}
    for name in measured_channels(after.rows):
        c = CHANNELS.index(name)
        plain = [_squares([run.residual[:, c] for run in info.rows], by_run) for info in (before, after)]
        white = [
            _squares([np.where(r[:, c] == 0.0, np.nan, r[:, c]) for r in info.white_residual], by_run)
            for info in (before, after)
        ]
        channels[name] = ChannelGain(
            _rms(plain[0]),
            _rms(plain[1]),
            _rms(white[0]),
            _rms(white[1]),
            _reduction(plain[0][:, 0], plain[1][:, 0], weights),
        )
    cost = [_costs(info, by_run) for info in (before, after)]
    return Gain(
        tuple(run.run_id for run in signals),
        tuple(excluded),
        "runs" if by_run else "thirds of runs",
        channels,
        _reduction(cost[0], cost[1], weights),
    )


def fit_to_judge(
    simulation: Simulation, runs: Sequence[Signals]
) -> tuple[tuple[Signals, ...], tuple[Excluded, ...], Evidence]:
    """Return the runs that are fit to be judged on, those that are not, and the information of the first.

    Parameters
    ----------
    simulation : with the causes built in, if there are any
    runs : that were not used in the diagnosis

    Raises
    ------
    DataError
        if there is no run, or none is fit.
    """
    signals = tuple(runs)
    if not signals:
        raise DataError("gain: there is no run that was not used in the diagnosis")
    low_pass, names = low_pass_of(signals), names_of(simulation.library)
    info = evidence_at(signals, simulation, simulation.vector, names, low_pass)
    excluded = unfit_runs(signals, info) if len(signals) >= MIN_JUDGED else ()
    if excluded:
        gone = {run.run_id for run in excluded}
        signals = tuple(run for run in signals if run.run_id not in gone)
        if not signals:
            raise DataError(f"gain: none of {len(runs)} runs is fit to be compared ({excluded[0].reason})")
        info = evidence_at(signals, simulation, simulation.vector, names, low_pass)
    return signals, tuple(excluded), info


def _squares(residuals: Sequence[Array], by_run: bool) -> Array:
    """Return sum of squares and count (clusters, 2), a cluster a run or a third of one."""
    out = []
    for values in residuals:
        for part in _clusters(values, by_run):
            known = part[np.isfinite(part)]
            out.append((float(known @ known), known.size))
    return np.array(out)


def _costs(info: Evidence, by_run: bool) -> Array:
    """Return what each cluster (n,) adds to minus twice the log-likelihood, its own scatter integrated out.

    Each third of a run has a scatter of its own, since parts of a common one need not be positive.
    """
    prior = np.diag(1.0 / info.nuisance_std**2)
    costs = []
    for residual, change in zip(info.white_residual, info.white_change, strict=True):
        scatter = change[info.nuisances].transpose(1, 0, 2)  # rows first, so that clusters are cut of both
        for r, n in zip(_clusters(residual, by_run), _clusters(scatter, by_run), strict=True):
            shown = np.einsum("mqc,mc->q", n, r)
            inner = np.einsum("mqc,mpc->qp", n, n) + prior
            costs.append(float((r**2).sum() - shown @ np.linalg.solve(inner, shown)))
    return np.array(costs)


def _clusters(values: Array, by_run: bool) -> list[Array]:
    return [values] if by_run else np.array_split(values, N_BLOCKS)


def _rms(squares: Array) -> float:
    total, count = squares.sum(axis=0)
    return float(np.sqrt(total / count)) if count else float("nan")


def _reduction(before: Array, after: Array, weights: Array) -> Reduction:
    drawn, left = weights @ before, weights @ after
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = 1.0 - left / drawn
        ratio = 1.0 - after.sum() / before.sum()
    if not np.isfinite(ratios).any():
        return Reduction(float("nan"), float("nan"), float("nan"))
    return Reduction(float(ratio), *percentile_interval(ratios))


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
    """What an extension changes for a filter or a classifier on held-out runs.

    Parameters
    ----------
    name : of the filter or the recipe
    reason : why there are no errors; None where there are
    n_runs : that were compared
    errors : by figure
    terrains : of the runs; None where they do not matter
    """

    name: str
    reason: str | None
    n_runs: int
    errors: Mapping[str, Change]
    terrains: tuple[str, ...] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as JSON has it."""
        shown = self._asdict()
        if self.terrains is None:
            del shown["terrains"]
        return shown


def filter_gain(runs: Sequence[RunLog], robot: Robot, extended: Simulation, seed: int) -> Comparison | None:
    """Return the errors of the robot's filter before and after, on runs with a truth; None without any.

    Errors are means over runs; the interval is that of the difference, by bootstrap over runs.
    """
    name = FILTERS.get(robot.drive)
    known = [run for run in runs if "truth" in run.streams]
    if name is None or not known:
        return None
    better = replace(robot, effects=dict(extended.effects), effects_cov=np.empty((0, 0)))
    rows: list[list[tuple[float, ...]]] = []
    try:
        for run in known:
            rows.append([_errors(estimate_run(run, one, name)) for one in (robot, better)])
    except TerrainError as error:
        return Comparison(name, str(error), len(known), {})
    table = np.array(rows)  # (runs, 2, errors)
    counts = bootstrap_counts(len(rows), N_BOOTSTRAP, seed)
    errors = {}
    for k, key in enumerate(ERRORS):
        both = table[:, :, k]
        if np.isfinite(both).all():
            changes = counts @ (both[:, 1] - both[:, 0]) / len(rows)
            interval = percentile_interval(changes) if len(rows) > 1 else None
            errors[key] = Change(float(both[:, 0].mean()), float(both[:, 1].mean()), interval)
    return Comparison(name, None, len(rows), errors)


def _errors(found: Estimate) -> tuple[float, ...]:
    """Return the errors of a run, in the order of :data:`ERRORS`."""
    summary, track, truth = summarize(found), found.track, found.run.streams["truth"]
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
    """Return accuracies before and after, and the 95 % interval of their difference.

    Parameters
    ----------
    before, after : (n,) whether each window is classified correctly
    run_id : (n,) run of each window
    seed : of the bootstrap over runs

    Examples
    --------
    >>> before, after = np.array([0, 0, 1, 1]), np.array([1, 1, 1, 1])
    >>> accuracy_change(before, after, np.array(["a", "a", "b", "b"]), 0)
    Change(before=0.5, after=1.0, change_ci=(0.0, 1.0))
    """
    runs, of = np.unique(run_id, return_inverse=True)
    n = len(runs)
    windows = np.bincount(of, minlength=n)
    change = np.bincount(of, weights=after.astype(float) - before.astype(float), minlength=n)
    counts = bootstrap_counts(n, N_BOOTSTRAP, seed)
    interval = percentile_interval((counts @ change) / (counts @ windows))
    return Change(float(before.mean()), float(after.mean()), interval)
