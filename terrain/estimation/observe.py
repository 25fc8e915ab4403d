"""An observer of slip run over a log: its estimates beside the run, the streams that windows take, and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from terrain.angles import wrapped
from terrain.estimation.estimate import known_mean, with_tracks
from terrain.estimation.models.choice import make_observer
from terrain.estimation.models.observer import Observer, ObserverStatus, ObserverTrack, observe, rows_of
from terrain.estimation.models.slip_model import PARAMETERS, SlipModel
from terrain.extension import Correction, correct
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot

WITHOUT_UNIT = frozenset(name for name in PARAMETERS if not name.endswith(("_ratio", "_m")))
"""States that are numbers of a model, without a unit of their own."""


@dataclass(frozen=True, slots=True, eq=False)
class ObserverEstimate:
    """Estimates of an observer over one run."""

    run: RunLog  #: the log, as measured
    robot: Robot  #: as the observer takes it, corrected
    observer: Observer  #: that was run
    track: ObserverTrack  #: its estimates
    dropped: Mapping[str, int]  #: samples left out, as counts by stream and kind
    missing: tuple[str, ...]  #: channels that the observer takes and the log never has

    def true(self, channel: str) -> Array | None:
        """Return a quantity (n,) of the truth at the ticks; None where the log has none of that name."""
        truth = self.run.streams.get("truth")
        if truth is None or channel not in truth.channels:
            return None
        values = truth.channel(channel)
        if channel == "yaw_rad":
            return np.asarray(wrapped(np.interp(self.track.time_s, truth.time_s, np.unwrap(values))))
        return np.interp(self.track.time_s, truth.time_s, values)

    def path(self) -> tuple[Array, Array | None]:
        """Return the estimated and the true position (n,), x + i y; the true one None where it is not known.

        Of an observer that does not know where it begins, the path begins at the true pose.
        """
        own = self.track.state("position_x_m") + 1j * self.track.state("position_y_m")
        x, y, yaw = (self.true(name) for name in ("position_x_m", "position_y_m", "yaw_rad"))
        if x is None or y is None or yaw is None:
            return own, None
        if not ("position_x_m" in self.observer.rows or self.observer.in_world):
            own = own * np.exp(1j * yaw[0]) + x[0] + 1j * y[0]
        return own, x + 1j * y


def observe_run(
    run: RunLog, robot: Robot, name: str, slip_model: SlipModel | None = None
) -> ObserverEstimate:
    """Correct one run for the effects of its robot, and run an observer over it.

    Raises
    ------
    ConfigError
        if the robot has no observer of that name, or the wheels have no speed that it takes.
    DataError
        if the log has no wheels.
    """
    log, driven = correct(with_wheel_speeds(run, robot), robot)
    terms = Correction(robot).axle_terms
    observer = make_observer(name, driven, slip_model)
    time_s, rows, dropped = rows_of(log, driven, observer.rows, terms)
    missing = tuple(name for k, name in enumerate(observer.rows) if not np.isfinite(rows[:, k]).any())
    track = observe(observer, time_s, rows)
    return ObserverEstimate(run, driven, observer, track, {**dropped, **observer.dropped}, missing)


def with_estimates(found: ObserverEstimate) -> RunLog:
    """Return the run with its estimates: streams ``slip``, ``estimator`` and ``state``.

    ``estimator`` has the states that windows are made of; ``state``, of which no features are made, every
    state, ``std_<state>``, ``std_<slip>`` and ``observer_code``, the number of an
    :class:`~terrain.estimation.models.observer.ObserverStatus`.
    """
    track, columns = found.track, {}
    for prefix, values in (("", track.mean), ("std_", track.std)):
        for state, column in zip(track.states, values.T, strict=True):
            columns[f"{prefix}{state}{'_ratio' * (state in WITHOUT_UNIT)}"] = column
    for name, std in zip(track.slips, track.slip_std.T, strict=True):
        columns[f"std_{name}"] = std
    columns["observer_code"] = track.status.astype(float)
    slip = Stream(track.time_s, track.slip, track.slips) if track.slips else None
    return with_tracks(found.run, found.robot, found.observer.name, track.time_s, columns, slip)


SETTLED = (ObserverStatus.OK, ObserverStatus.UNEXCITED)
"""Statuses in which slip is judged; a part that is not excited may be the cornering stiffness alone."""


@dataclass(frozen=True, slots=True)
class ObservedSlip:
    """One slip of a run; NaN where something is not known."""

    mean: float  #: while the robot moves and is observed: mean of the slip, and of its standard deviation
    std: float
    true_mean: float  #: of the truth, and of the error
    rmse: float
    nees: float  #: mean squared error over the variance stated, 1 where that is right


@dataclass(frozen=True, slots=True)
class ObserverSummary:
    """Figures of one run; NaN where something is not known."""

    run_id: str  #: which run and which observer
    filter: str
    slip: Mapping[str, ObservedSlip]  #: of each slip, by channel
    position_rmse_m: float  #: error of the position over the run, and at its end
    position_end_m: float
    status_s: Mapping[str, float]  #: how long it had each status
    dropped: Mapping[str, int]  #: samples left out, as counts by kind
    missing: tuple[str, ...]  #: what the observer takes and the run never has
    reason: str  #: why slip is not known in all of it, in a sentence; empty where it is
    finite: bool  #: whether positions are finite once the observer has started, and nothing is infinite


def summarize_observer(found: ObserverEstimate) -> ObserverSummary:
    """Return the figures of an estimate."""
    track, slips = found.track, {}
    started, settled = track.status != ObserverStatus.STARTING, np.isin(track.status, SETTLED)
    steps_s = np.diff(track.time_s, append=track.time_s[-1:])
    for k, name in enumerate(track.slips):
        slip, std, true = track.slip[settled, k], track.slip_std[settled, k], found.true(name)
        true = np.full(len(slip), np.nan) if true is None else true[settled]
        error = slip - true
        with np.errstate(divide="ignore", invalid="ignore"):
            nees = known_mean(np.where(std > 0.0, (error / std) ** 2, np.nan))
        figures = known_mean(slip), _root_mean_square(std), known_mean(true), _root_mean_square(error), nees
        slips[name] = ObservedSlip(*figures)
    own, place = found.path()  # odometry begins at the true pose
    error_m = (np.full(len(own), np.nan) if place is None else np.abs(own - place))[started]
    return ObserverSummary(
        run_id=found.run.run_id,
        filter=found.observer.name,
        slip=slips,
        position_rmse_m=_root_mean_square(error_m),
        position_end_m=float(error_m[-1]) if len(error_m) else math.nan,
        status_s={
            ObserverStatus(code).label: float(steps_s[track.status == code].sum())
            for code in np.unique(track.status).tolist()
        },
        dropped=dict(found.dropped),
        missing=found.missing,
        reason="" if np.isfinite(track.slip).any() else found.observer.reason,
        finite=bool(np.isfinite(track.mean[started][:, :2]).all())
        and not any(np.isinf(part).any() for part in track[3:7]),
    )


def _root_mean_square(values: Array) -> float:
    return math.sqrt(known_mean(values**2))
