"""An estimate in a few figures: its slip, its errors where there is a truth, and whether it is consistent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from terrain.estimation.consistency import consistency_report, nees
from terrain.estimation.estimate import Estimate
from terrain.estimation.reference import true_slip_at
from terrain.estimation.stuck import StuckInterval, motion_seconds, stuck_intervals
from terrain.records import GATED, USED, Array, StateTrack

JUDGED_STATES = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "slip_speed_")
"""States whose error is judged (NEES): those that slip is computed from."""


@dataclass(frozen=True, slots=True)
class EstimateSummary:
    """Figures of one run; NaN where something is not known.

    Parameters
    ----------
    run_id, filter : which run and which filter
    slip_mean, slip_std : in steady motion, positive in traction for both rolling directions; of a filter
        without a reference of the speed over ground it is the blind figure, and ``slip_observable`` is false
    slip_true_mean : the true slip at the same instants
    slip_observable : whether the speed over ground was measured
    slip_peak : largest of a wheel in transients
    steady_s, stale_s : time of steady motion, and time without a recent speed over ground
    nis : mean squared innovation of each sensor a degree of freedom, of what was used
    nees : mean squared error of speeds, yaw rate and slip speeds over its covariance, a state
    consistency : by ``sensors`` (NIS) and, where there is a truth, by groups of ``states`` (NEES): whether
        the value is within its chi-square bounds
    speed_rmse_mps : of the speed over ground
    n_dropped, n_gated, dropped : samples left out, measurements rejected by a gate, and counts by kind
    finite : whether all states and covariances are finite
    motion : time that the robot was at rest, moving, stuck, and neither is known; None of a filter that does
        not judge it
    stuck : when it was stuck, None as ``motion``
    """

    run_id: str
    filter: str
    slip_mean: float
    slip_std: float
    slip_true_mean: float
    slip_observable: bool
    slip_peak: float
    steady_s: float
    stale_s: float
    nis: Mapping[str, float]
    nees: float
    consistency: Mapping[str, Mapping[str, str]]
    speed_rmse_mps: float
    n_dropped: int
    n_gated: int
    dropped: Mapping[str, int]
    finite: bool
    motion: Mapping[str, float] | None
    stuck: tuple[StuckInterval, ...] | None

    @property
    def motion_text(self) -> str:
        """When the robot was stuck, and for how long nothing is known of its motion, in words."""
        motion = self.motion or {}
        times = ", ".join(f"{each.start_s:.1f} to {each.end_s:.1f} s" for each in self.stuck or ())
        return (
            f"{self.run_id}: {f'stuck from {times}' if times else 'not seen to be stuck'}; moving for "
            f"{motion['moving']:.1f} s, at rest for {motion['at_rest']:.1f} s, unknown for {motion['unknown']:.1f} s"
        )


def summarize(estimate: Estimate) -> EstimateSummary:
    """Return the figures of an estimate."""
    track, slip, figures = estimate.track, estimate.slip, estimate.figures
    steps_s = np.diff(track.time_s, append=track.time_s[-1:])
    true_slip = true_slip_at(estimate.run, estimate.robot, track.time_s)
    motion = estimate.motion
    n_refused = sum(n for kind, n in track.dropped.items() if not kind.endswith(" gated"))
    return EstimateSummary(
        run_id=estimate.run.run_id,
        filter=estimate.name,
        slip_mean=figures.steady_mean,
        slip_std=_known_mean(slip.slip_std[figures.steady]),
        slip_true_mean=_known_mean(true_slip[figures.steady]),
        slip_observable=estimate.observable,
        slip_peak=figures.peak,
        steady_s=float(steps_s[figures.steady].sum()),
        stale_s=float(steps_s[slip.stale].sum()),
        nis=_mean_nis(track),
        nees=_mean_nees(estimate),
        consistency={
            kind: {entry.name: entry.verdict for entry in entries}
            for kind, entries in consistency_report(track, estimate.truth)._asdict().items()
        },
        speed_rmse_mps=_speed_rmse_mps(estimate),
        n_dropped=sum(estimate.table.dropped.values()) + n_refused,
        n_gated=int((track.use == GATED).sum()),
        dropped={**estimate.table.dropped, **track.dropped},
        finite=bool(np.isfinite(track.mean).all() and np.isfinite(track.cov).all()),
        motion=None if motion is None else motion_seconds(track.time_s, motion),
        stuck=None if motion is None else stuck_intervals(track.time_s, motion),
    )


def _mean_nis(track: StateTrack) -> dict[str, float]:
    """Return the mean NIS a degree of freedom of each sensor of which something was used."""
    used = track.use == USED
    return {
        sensor: float(np.nansum(track.nis[used[:, k], k]) / dof)
        for k, sensor in enumerate(track.sensors)
        if (dof := int(track.nis_dof[used[:, k], k].sum()))
    }


def _mean_nees(estimate: Estimate) -> float:
    if estimate.truth is None:
        return math.nan
    states = estimate.track.states
    judged = [i for i, state in enumerate(states) if state.startswith(JUDGED_STATES)]
    squared = nees(estimate.track, estimate.truth[:, judged], [states[i] for i in judged])
    return _known_mean(squared) / len(judged)


def _speed_rmse_mps(estimate: Estimate) -> float:
    if estimate.truth is None:
        return math.nan
    chosen = [i for i, state in enumerate(estimate.track.states) if state in ("speed_x_mps", "speed_y_mps")]
    error = (estimate.track.mean - estimate.truth)[:, chosen]
    return math.sqrt(_known_mean(error**2) * len(chosen))


def _known_mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan
