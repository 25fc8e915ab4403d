"""A filter or an observer run over a whole log: states, slip, the truth where a log has one; and the figures of a run.

Any filter or observer of any drive gives the same record, :class:`Estimate`, and the same figures,
:class:`EstimateSummary`; what one does not have is None, NaN or empty.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.errors import ConfigError
from terrain.estimation.consistency import (
    consistency_report,
    innovations,
    lagged_slip_at,
    nees,
    true_slip_at,
    true_states,
)
from terrain.estimation.feed import DERIVED_ROWS, GNSS_ROWS, MeasurementTable, gnss_heading, measurement_table
from terrain.estimation.filter import (
    GATE_PROBABILITY,
    REOPEN_AFTER_S,
    FilterModel,
    FilterSettings,
    run_filter,
)
from terrain.estimation.models import swerve
from terrain.estimation.models.observer import ObserverStatus, observe, rows_of
from terrain.estimation.wheel_slip import SlipFigures, slip_figures, wheel_slip
from terrain.extension import Correction, check_corrected, correct
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs.schema import ESTIMATOR_CHANNELS
from terrain.records import USED, Array, RunLog, SlipTrack, StateTrack, Stream
from terrain.robots import Robot

if TYPE_CHECKING:
    from terrain.estimation.models.slip_model import SlipModel

FILTERS = swerve.FILTERS  #: Names of the filters, of swerve robots; the numbers are those of their states.
#: Noise in natural units; the thesis' own (6.13), (6.14), with its smoothing and without gates; process noise fitted
#: to chosen runs.
TUNINGS = ("physical", "thesis", "likelihood")
#: Tuning unless another is chosen: vio12 is the thesis' own filter, all others are physical.
OWN_TUNING: Mapping[str, str] = {"vio12": "thesis"}
THESIS_EMA_ALPHA = 0.2  #: Thesis (7.8): smoothing of the camera.
SPEEDS = ("speed_x_mps", "speed_y_mps")
#: States whose error is judged (NEES): those that slip is computed from.
JUDGED_STATES = (*SPEEDS, "yaw_rate_radps", "slip_speed_")
#: Statuses in which slip is judged; a part that is not excited may be the cornering stiffness alone.
SETTLED = (ObserverStatus.OK, ObserverStatus.UNEXCITED)
#: Statuses in which the speed over ground was not measured lately.
UNSEEN = (ObserverStatus.STARTING, ObserverStatus.PREDICTED)


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """All that is known of one run after a filter or an observer."""

    run: RunLog  #: the log, as measured
    robot: Robot  #: whose log it is, as the filter models it: without the effects of an extended one
    name: str  #: of the filter or observer
    track: StateTrack  #: its states; of an observer with their variances alone
    slip: SlipTrack  #: NaN where the speed over ground is not observed
    status: Array  #: (n,) numbers of :class:`~terrain.estimation.models.observer.ObserverStatus`
    rolling: Array  #: (n, ratios) -1 where a wheel rolls backward, else 1
    in_world: bool  #: whether positions are in the frame of what measures them, and not from where the robot started
    dropped: Mapping[
        str, int
    ]  #: samples left out, and measurements that the filter did not accept, as counts by kind
    missing: tuple[str, ...]  #: what it takes and the log never has
    reason: str  #: why slip is not known in all of it, in a sentence; empty where it is
    truth: Array | None = None  #: (n, d) true states, or None; none of an observer
    model: FilterModel | None = None  #: the filter
    #: what changes from instant to instant: variances (n, m), walks (n, d) and inputs (n, k), None where they do not
    scheduled: tuple[Array | None, ...] = (None, None, None)
    table: MeasurementTable | None = None  #: its measurements, of the log without the robot's effects
    #: the slip by the encoders and the filter's own speed; of a filter without a reference of the speed over ground
    #: that is no slip
    blind: SlipTrack | None = None
    figures: SlipFigures = field(init=False)  #: of slip ratios, of ``blind`` where there is no other

    def __post_init__(self) -> None:
        shown = self.slip if self.observable or self.blind is None else self.blind
        speeds = [self.track.state(name) for name in SPEEDS if name in self.track.states]
        speed_mps = np.hypot.reduce(speeds) if speeds else np.full(len(self.track.time_s), np.nan)
        figures = slip_figures(shown.ratios, speed_mps, shown.time_s, self.rolling)
        object.__setattr__(self, "figures", figures)

    @property
    def observable(self) -> bool:
        """Whether the slip was observed at any time."""
        return bool(np.isfinite(self.slip.mean).any())

    @property
    def innovations(self) -> dict[str, tuple[Array, Array]]:
        """By row the measurement minus the prediction at each instant (n,), and its expected standard deviation."""
        if self.model is None or self.table is None:
            return {}
        return innovations(self.model, self.track, self.table.columns(self.model.rows), *self.scheduled)

    def true(self, channel: str) -> Array | None:
        """Return a quantity (n,) of the truth at the instants; None where the log has none of that name.

        A slip ratio comes behind the low-pass of the encoders, as the wheels' speeds do.
        """
        truth, ratios = self.run.streams.get("truth"), self.slip.ratios
        if truth is None or channel not in truth.channels:
            return None
        if channel in ratios.channels and self.robot.encoder_lag_s > 0.0:
            wheel = ratios.wheels[ratios.channels.index(channel)]
            with suppress(KeyError):  # a truth that has no more than the slip gives it as it is
                slips = lagged_slip_at(self.run, self.robot, self.track.time_s)
                return np.asarray(slips[:, self.robot.wheels.index(wheel)])
        values = truth.channel(channel)
        if channel == "yaw_rad":
            return np.asarray(wrapped(np.interp(self.track.time_s, truth.time_s, np.unwrap(values))))
        return np.interp(self.track.time_s, truth.time_s, values)

    def true_state(self, name: str) -> Array | None:
        """Return the truth (n,) of a state, behind the encoders' low-pass where ``truth`` is known; or None."""
        return self.true(name) if self.truth is None else self.truth[:, self.track.states.index(name)]

    def path(self) -> tuple[Array, Array | None]:
        """Return the estimated and the true position (n,), x + i y; NaN and None where they are not known.

        Of a filter that does not know where it begins, the path begins at the true pose.
        """
        if not {"position_x_m", "position_y_m"} <= set(self.track.states):
            return np.full(len(self.track.time_s), np.nan + 0j), None
        own = self.track.state("position_x_m") + 1j * self.track.state("position_y_m")
        x, y, yaw = (self.true(name) for name in ("position_x_m", "position_y_m", "yaw_rad"))
        if x is None or y is None or yaw is None:
            return own, None
        if not self.in_world:
            own = own * np.exp(1j * yaw[0]) + x[0] + 1j * y[0]
        return own, x + 1j * y


def estimate_run(
    run: RunLog,
    robot: Robot,
    name: str,
    *,
    tuning: str | None = None,
    process_variance: Array | None = None,
    model: FilterModel | None = None,
    slip_model: SlipModel | None = None,
) -> Estimate:
    """Correct one run for the effects of its robot, and run a filter or an observer over it.

    Parameters
    ----------
    run, robot : log of the robot, as measured, and its description; or both corrected
    name : one of :data:`FILTERS`, of swerve robots, or of the observers of the robot
        (:func:`terrain.estimation.models.choice.observers_of`)
    tuning : of a filter, one of :data:`TUNINGS`; its own (:data:`OWN_TUNING`) by default
    process_variance : that of a tuning on chosen runs, which may have other sensors, in place of the physical
    model : with noise of its own, in place of the filter of that name
    slip_model : of a tracked robot on its ground, for the observers that take one

    Returns
    -------
    of the corrected robot, beside the run as measured.  The heading at the start of a filter in the frame of the GNSS,
    east 0, is found from the drive; where that does not determine it the GNSS is left out and counted

    Raises
    ------
    ConfigError
        if the filter does not fit the robot, has no tuning of that name, or the wheels have no speed that it takes.
    DataError
        if the log has no wheels.
    """
    if name not in FILTERS:
        return _observed(run, robot, name, slip_model)
    log, driven = correct(run, robot)
    tuning = tuning_of(name, tuning)
    is_physical = tuning == "physical" and process_variance is None and model is None
    model = model or model_of(log, driven, name, tuning)
    if process_variance is not None:
        model = replace(model, process_variance=process_variance)
    ema_alpha = THESIS_EMA_ALPHA if tuning == "thesis" and name == "vio12" else None
    table, yaw_rad = measurement_table(log, driven, ema_alpha=ema_alpha), 0.0
    has_gnss = GNSS_ROWS[0] in model.rows
    if has_gnss:
        yaw_rad = gnss_heading(table, driven)
        if math.isnan(yaw_rad):
            streams = dict(run.streams)
            unused = {"gnss: heading not observable in this run": len(streams.pop("gnss"))}
            without = replace(run, streams=streams)
            found = estimate_run(without, robot, name, tuning=tuning, process_variance=process_variance)
            return replace(found, dropped={**found.dropped, **unused})
        table = measurement_table(log, driven, ema_alpha=ema_alpha, initial_yaw_rad=yaw_rad)
    samples = swerve.scheduled(model, table.z, table.gnss_variance, is_physical)
    settings = FilterSettings(1.0 if tuning == "thesis" else GATE_PROBABILITY, REOPEN_AFTER_S)
    track = run_filter(model, table.time_s, table.columns(model.rows), settings, *samples)
    kept = np.searchsorted(table.time_s, track.time_s)
    table = table.at(track.time_s)
    slip = wheel_slip(track, table, driven)
    missing = [row for row in model.rows if not np.isfinite(table.columns([row])).any()]
    return Estimate(
        run,
        driven,
        name,
        track,
        slip,
        swerve.statuses(model, track.use, table.z, track.reference_age_s),
        np.where(table.columns(driven.wheel_rows) < 0.0, -1.0, 1.0),
        has_gnss,
        {**table.dropped, **track.dropped},
        tuple(row for row in missing if row not in DERIVED_ROWS),
        "" if np.isfinite(slip.mean).any() else "no speed over ground has come yet",
        true_states(log, track, driven, driven.encoder_lag_s, yaw_rad),
        model,
        tuple(None if part is None else part[kept] for part in samples),
        table,
        wheel_slip(track, table, driven, blind=True),
    )


def _observed(run: RunLog, robot: Robot, name: str, slip_model: SlipModel | None) -> Estimate:
    """Return the estimate of an observer, as :func:`estimate_run`."""
    from terrain.estimation.models.choice import make_observer  # has kernels that filters do not need

    log, driven = correct(with_wheel_speeds(run, robot), robot)
    observer = make_observer(name, driven, slip_model)
    time_s, rows, dropped = rows_of(log, driven, observer.rows, Correction(robot).axle_terms)
    found = observe(observer, time_s, rows)
    track = StateTrack(found.time_s, found.mean, found.std**2, found.states)
    slip = SlipTrack(found.time_s, found.slip, found.slip_std, found.slips, np.isin(found.status, UNSEEN))
    rolling = np.ones((len(time_s), len(slip.ratios.channels)))
    for k, wheel in enumerate(slip.ratios.wheels):
        if f"speed_{wheel}_mps" in observer.rows:
            rolling[rows[:, observer.rows.index(f"speed_{wheel}_mps")] < 0.0, k] = -1.0
    return Estimate(
        run,
        driven,
        observer.name,
        track,
        slip,
        found.status,
        rolling,
        "position_x_m" in observer.rows or observer.in_world,
        {**dropped, **observer.dropped},
        tuple(row for k, row in enumerate(observer.rows) if not np.isfinite(rows[:, k]).any()),
        "" if np.isfinite(slip.mean).any() else observer.reason,
    )


def model_of(run: RunLog, robot: Robot, name: str, tuning: str | None = None) -> FilterModel:
    """Return the filter for a corrected run, with the noise that it starts from; errors as :func:`estimate_run`."""
    check_corrected(robot)
    if name in FILTERS and (robot.drive != "swerve" or (robot.filters and name not in robot.filters)):
        from terrain.estimation.models.choice import observers_of  # has kernels that filters do not need

        own = FILTERS if robot.drive == "swerve" else ()
        fits = ", ".join((*(each for each in own if each in robot.filters), *observers_of(robot)))
        raise ConfigError(
            f"filter {name!r} is not for robot {robot.name}, whose drive is {robot.drive}: use {fits}"
        )
    is_thesis = tuning_of(name, tuning) == "thesis"
    has_gnss = not is_thesis and "gnss" in run.streams and len(run.streams["gnss"]) > 0
    return swerve.make_filter(name, robot, has_gnss, is_thesis)


def tuning_of(name: str, tuning: str | None) -> str:
    """Return the tuning of a filter: the one chosen, or its own; ``ConfigError`` if there is no such tuning."""
    tuning = tuning or OWN_TUNING.get(name, "physical")
    if tuning not in TUNINGS:
        raise ConfigError(f"there is no tuning {tuning!r}; there are {', '.join(TUNINGS)}")
    return tuning


def enriched(estimate: Estimate) -> RunLog:
    """Return the run with its estimate.

    Wheel speeds join the stream ``wheels``.  New are ``slip``; ``estimator``, the states that windows are
    made of; and ``state``, of which no features are made: every state and ``std_<state>``, ``std_<slip>``,
    ``stale_ratio`` (1 where the speed over ground was not measured lately), ``observer_code``, the number of an
    :class:`~terrain.estimation.models.observer.ObserverStatus`, and ``nis_<sensor>_ratio``; a column without any
    finite value is left out.
    """
    from terrain.estimation.models.slip_model import PARAMETERS  # has kernels that filters do not need

    # states that are numbers of a model, without a unit of their own
    without_unit = {name for name in PARAMETERS if not name.endswith(("_ratio", "_m"))}
    run, track, slip = with_wheel_speeds(estimate.run, estimate.robot), estimate.track, estimate.slip
    names = [f"{state}{'_ratio' * (state in without_unit)}" for state in track.states]
    columns = dict(zip(names, track.mean.T, strict=True))
    columns |= {f"std_{name}": track.std(state) for name, state in zip(names, track.states, strict=True)}
    columns |= {f"std_{name}": std for name, std in zip(slip.channels, slip.std.T, strict=True)}
    columns |= {"stale_ratio": slip.stale.astype(float), "observer_code": estimate.status.astype(float)}
    columns |= {f"nis_{sensor}_ratio": nis for sensor, nis in zip(track.sensors, track.nis.T, strict=True)}
    moves = [name for name in ESTIMATOR_CHANNELS if name in columns]
    known = [name for name, column in columns.items() if np.isfinite(column).any()]
    streams = dict(run.streams)
    for stream, channels in (("estimator", moves), ("state", known)):
        if channels:
            values = np.column_stack([columns[name] for name in channels])
            streams[stream] = Stream(track.time_s, values, tuple(channels))
    if slip.channels:
        streams["slip"] = slip.as_stream()
    return replace(run, streams=streams, filter=estimate.name)


class ObservedSlip(NamedTuple):
    """One slip of a run; NaN where something is not known."""

    mean: float  #: while the robot moves and is observed: mean of the slip, and of its standard deviation
    std: float
    true_mean: float  #: of the truth, and of the error
    rmse: float
    nees: float  #: mean squared error over the variance stated, 1 where that is right


@dataclass(frozen=True, slots=True)
class EstimateSummary:
    """Figures of one run; NaN, None or empty where something is not known."""

    run_id: str  #: which run and which filter or observer
    filter: str
    #: in steady motion over all wheels, positive in traction for both rolling directions; of a filter without a
    #: reference of the speed over ground it is the blind figure, and ``slip_observable`` is false
    slip_mean: float
    slip_std: float
    slip_true_mean: float  #: the true slip at the same instants
    slip_observable: bool  #: whether the speed over ground was measured
    slip_peak: float  #: largest of a wheel in transients
    steady_s: float  #: time of steady motion, and time without a recent speed over ground
    stale_s: float
    slip: Mapping[str, ObservedSlip]  #: of each slip, by channel
    nis: Mapping[str, float]  #: mean squared innovation of each sensor a degree of freedom, of what was used
    nees: float  #: mean squared error of speeds, yaw rate and slip speeds over its covariance, a state
    #: by ``sensors`` (NIS) and, where there is a truth, by groups of ``states`` (NEES): whether the value is within
    #: its chi-square bounds
    consistency: Mapping[str, Mapping[str, str]]
    speed_rmse_mps: float  #: of the speed over ground
    position_rmse_m: float  #: error of the position over the run, and at its end
    position_end_m: float
    status_s: Mapping[str, float]  #: how long it had each status
    n_dropped: int  #: samples left out, measurements rejected by a gate, and counts by kind
    n_gated: int
    dropped: Mapping[str, int]
    missing: tuple[str, ...]  #: what it takes and the run never has
    reason: str  #: why slip is not known in all of it, in a sentence; empty where it is
    finite: bool  #: whether positions are finite once it has started, and nothing is infinite


def summarize(estimate: Estimate) -> EstimateSummary:
    """Return the figures of an estimate."""
    track, slip, figures, status = estimate.track, estimate.slip, estimate.figures, estimate.status
    truth, used = estimate.truth, track.use == USED
    started, settled = status != ObserverStatus.STARTING, np.isin(status, SETTLED)
    steps_s = np.diff(track.time_s, append=track.time_s[-1:])
    mean_nees = speed_rmse_mps = math.nan
    if truth is not None:
        judged = [state for state in track.states if state.startswith(JUDGED_STATES)]
        mean_nees = known_mean(nees(track, truth, judged)) / len(judged)
    of_speeds = [(track.state(name), estimate.true_state(name)) for name in SPEEDS if name in track.states]
    errors = [speed - true for speed, true in of_speeds if true is not None]
    if errors:
        speed_rmse_mps = math.sqrt(known_mean(np.column_stack(errors) ** 2) * len(errors))
    slips = {}
    for k, name in enumerate(slip.channels):
        mean, std, true = slip.mean[settled, k], slip.std[settled, k], estimate.true(name)
        error = mean - (np.nan if true is None else true[settled])
        with np.errstate(divide="ignore", invalid="ignore"):
            slip_nees = known_mean(np.where(std > 0.0, (error / std) ** 2, np.nan))
        true_mean = math.nan if true is None else known_mean(true[settled])
        slips[name] = ObservedSlip(
            known_mean(mean), _root_mean_square(std), true_mean, _root_mean_square(error), slip_nees
        )
    true_slip = true_slip_at(estimate.run, slip.ratios.wheels, track.time_s)
    nis: dict[str, float] = {}
    consistency: dict[str, dict[str, str]] = {"sensors": {}, "states": {}}
    for k, sensor in enumerate(track.sensors):
        if dof := int(track.nis_dof[used[:, k], k].sum()):
            nis[sensor] = float(np.nansum(track.nis[used[:, k], k]) / dof)
    for kind, entries in consistency_report(track, truth).items():
        for entry in entries:
            consistency[kind][entry.name] = entry.verdict
    own, place = estimate.path()  # odometry begins at the true pose
    error_m = (np.full(len(own), np.nan) if place is None else np.abs(own - place))[started]
    parts = track.mean, track.cov, slip.mean, slip.std
    n_gated = sum(n for kind, n in estimate.dropped.items() if kind.endswith(" gated"))
    return EstimateSummary(
        run_id=estimate.run.run_id,
        filter=estimate.name,
        slip_mean=figures.steady_mean,
        slip_std=known_mean(slip.ratios.std[figures.steady]),
        slip_true_mean=known_mean(true_slip[figures.steady]),
        slip_observable=estimate.observable,
        slip_peak=figures.peak,
        steady_s=float(steps_s[figures.steady].sum()),
        stale_s=float(steps_s[slip.stale].sum()),
        slip=slips,
        nis=nis,
        nees=mean_nees,
        consistency=consistency,
        speed_rmse_mps=speed_rmse_mps,
        position_rmse_m=_root_mean_square(error_m),
        position_end_m=float(error_m[-1]) if len(error_m) else math.nan,
        status_s={
            ObserverStatus(code).label: float(steps_s[status == code].sum())
            for code in np.unique(status).tolist()
        },
        n_dropped=sum(estimate.dropped.values()) - n_gated,
        n_gated=n_gated,
        dropped=dict(estimate.dropped),
        missing=estimate.missing,
        reason=estimate.reason,
        finite=bool(np.isfinite(track.mean[started][:, :2]).all())
        and not any(np.isinf(part).any() for part in parts),
    )


def known_mean(values: Array) -> float:
    """Return the mean of what is finite; NaN of nothing."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


def _root_mean_square(values: Array) -> float:
    return math.sqrt(known_mean(values**2))
