"""What an extension gains on held-out runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.discrepancy.evidence import N_BLOCKS, Evidence, evidence_at
from terrain.discrepancy.fitting import names_of
from terrain.discrepancy.health import unfit_runs
from terrain.discrepancy.health.runs import Excluded
from terrain.discrepancy.residuals import low_pass_of, measured_channels
from terrain.discrepancy.selection import MIN_CLUSTERS
from terrain.discrepancy.signals import Signals, signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.verdict import finite
from terrain.effects import CHANNELS
from terrain.errors import ConfigError, DataError
from terrain.records import Array, RunLog

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
        """Return the gain as JSON has it; what is not known is null."""
        return {
            "runs": list(self.run_ids),
            "excluded_runs": [run._asdict() for run in self.excluded],
            "clusters": self.clusters,
            **_reduction_json(self.reduction),
            "channels": {
                name: {
                    key: finite(getattr(found, key))
                    for key in ("rms_before", "rms_after", "white_before", "white_after")
                }
                | _reduction_json(found.reduction)
                for name, found in self.channels.items()
            },
        }


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


def _reduction_json(found: Reduction) -> dict[str, Any]:
    return {
        "reduction": finite(found.ratio),
        "ci": [finite(found.low), finite(found.high)],
        "refused": found.refused,
    }
