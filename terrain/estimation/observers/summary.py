"""Estimates of an observer in a few figures, beside the truth where there is one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from terrain.estimation.observers.estimate import ObserverEstimate, seconds_by_status
from terrain.estimation.observers.family import ObserverStatus, ObserverTrack
from terrain.records import Array

SETTLED = (ObserverStatus.OK, ObserverStatus.UNEXCITED)
"""Statuses in which slip is judged; a part that is not excited may be the cornering stiffness alone."""


@dataclass(frozen=True, slots=True)
class ObservedSlip:
    """One slip of a run; NaN where something is not known.

    Parameters
    ----------
    mean, std : while the robot moves and is observed: mean of the slip, and of its standard deviation
    true_mean, rmse : of the truth, and of the error
    nees : mean squared error over the variance stated, 1 where that is right
    """

    mean: float
    std: float
    true_mean: float
    rmse: float
    nees: float


@dataclass(frozen=True, slots=True)
class ObserverSummary:
    """Figures of one run; NaN where something is not known.

    Parameters
    ----------
    run_id, filter : which run and which observer
    slip : of each slip, by channel
    position_rmse_m, position_end_m : error of the position over the run, and at its end
    status_s : how long it had each status
    dropped : samples left out, as counts by kind
    missing : what the observer takes and the run never has
    finite : whether positions are finite once the observer has started, and nothing is infinite
    """

    run_id: str
    filter: str
    slip: Mapping[str, ObservedSlip]
    position_rmse_m: float
    position_end_m: float
    status_s: Mapping[str, float]
    dropped: Mapping[str, int]
    missing: tuple[str, ...]
    finite: bool

    @property
    def status_text(self) -> str:
        """How long the observer had which status, what was left out and what was not measured, in words."""
        times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in self.status_s.items())
        dropped = f"; left out: {sum(self.dropped.values())} samples" if self.dropped else ""
        missing = f"; not measured: {', '.join(self.missing)}" if self.missing else ""
        return f"{self.run_id}: {times}{dropped}{missing}"


def summarize_observer(found: ObserverEstimate) -> ObserverSummary:
    """Return the figures of an estimate."""
    track = found.track
    started = track.status != ObserverStatus.STARTING
    settled = np.isin(track.status, SETTLED)
    slips = {
        name: _slip(track.slip[settled, k], track.slip_std[settled, k], found.true(name), settled)
        for k, name in enumerate(track.slips)
    }
    error_m = _position_error(found)[started]
    position = [k for k, name in enumerate(track.states) if name.startswith("position_")]
    return ObserverSummary(
        run_id=found.run.run_id,
        filter=found.observer.name,
        slip=slips,
        position_rmse_m=_root_mean_square(error_m),
        position_end_m=float(error_m[-1]) if len(error_m) else math.nan,
        status_s=seconds_by_status(track),
        dropped=dict(found.dropped),
        missing=found.missing,
        finite=bool(np.isfinite(track.mean[started][:, position]).all()) and not _infinite(track),
    )


def _infinite(track: ObserverTrack) -> bool:
    return any(np.isinf(part).any() for part in (track.mean, track.std, track.slip, track.slip_std))


def _slip(slip: Array, std: Array, true: Array | None, settled: Array) -> ObservedSlip:
    true = np.full(len(slip), np.nan) if true is None else true[settled]
    error = slip - true
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.where(std > 0.0, (error / std) ** 2, np.nan)
    return ObservedSlip(
        _mean(slip), _root_mean_square(std), _mean(true), _root_mean_square(error), _mean(squares)
    )


def _position_error(found: ObserverEstimate) -> Array:
    """Return the distance (n,) from the true position; odometry begins at the true pose."""
    if "position_x_m" in found.track.states:
        own, true = found.path()
        if true is not None:
            return np.asarray(np.abs(own - true))
    return np.full(len(found.track.time_s), np.nan)


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


def _root_mean_square(values: Array) -> float:
    return math.sqrt(_mean(values**2))
