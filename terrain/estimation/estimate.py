"""A filter run over a whole log: measurements, states, slip, and the truth where a log has one; and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.consistency import consistency_report, innovations, nees, true_slip_at, true_states
from terrain.estimation.feed import GNSS_ROWS, MeasurementTable, gnss_heading, measurement_table
from terrain.estimation.filter import (
    GATE_PROBABILITY,
    REOPEN_AFTER_S,
    FilterModel,
    FilterSettings,
    run_filter,
)
from terrain.estimation.models import swerve
from terrain.estimation.wheel_slip import SlipFigures, slip_figures, wheel_slip
from terrain.extension import check_corrected, correct
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs.schema import ESTIMATOR_CHANNELS
from terrain.records import GATED, USED, Array, RunLog, SlipTrack, StateTrack, Stream
from terrain.robots import Robot

FILTERS = swerve.FILTERS  #: Names of the filters, of swerve robots; the numbers are those of their states.
#: Noise in natural units; the thesis' own (6.13), (6.14), with its smoothing and without gates; process noise fitted
#: to chosen runs.
TUNINGS = ("physical", "thesis", "likelihood")
#: Tuning unless another is chosen: vio12 is the thesis' own filter, all others are physical.
OWN_TUNING: Mapping[str, str] = {"vio12": "thesis"}
THESIS_EMA_ALPHA = 0.2  #: Thesis (7.8): smoothing of the camera.
#: States whose error is judged (NEES): those that slip is computed from.
JUDGED_STATES = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "slip_speed_")


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """All that is known of one run after filtering it."""

    run: RunLog  #: the log, as measured
    robot: Robot  #: whose log it is, as the filter models it: without the effects of an extended one
    name: str  #: of the filter
    model: FilterModel  #: the filter
    #: what changes from instant to instant: variances (n, m), walks (n, d) and inputs (n, k), None where they do not
    scheduled: tuple[Array | None, ...]
    table: MeasurementTable  #: its measurements, of the log without the robot's effects
    track: StateTrack  #: its states
    slip: SlipTrack  #: NaN where the speed over ground is not observed
    #: the slip by the encoders and the filter's own speed; of a filter without a reference of the speed over ground
    #: that is no slip
    blind: SlipTrack
    figures: SlipFigures  #: of ``slip``, or of ``blind`` where there is no other
    truth: Array | None  #: (n, d) true states, or None
    observable: bool  #: whether the slip was observed at any time

    @property
    def innovations(self) -> dict[str, tuple[Array, Array]]:
        """By row the measurement minus the prediction at each instant (n,), and its expected standard deviation."""
        return innovations(self.model, self.track, self.table.columns(self.model.rows), *self.scheduled)


def estimate_run(
    run: RunLog,
    robot: Robot,
    name: str,
    *,
    tuning: str | None = None,
    process_variance: Array | None = None,
    model: FilterModel | None = None,
) -> Estimate:
    """Correct one run for the effects of its robot, and filter it.

    Parameters
    ----------
    run, robot : log of the robot, as measured, and its description; or both corrected
    name : one of :data:`FILTERS`
    tuning : one of :data:`TUNINGS`; the filter's own (:data:`OWN_TUNING`) by default
    process_variance : that of a tuning on chosen runs, which may have other sensors, in place of the physical
    model : with noise of its own, in place of the filter of that name

    Returns
    -------
    of the corrected robot, beside the run as measured.  The heading at the start in the frame of the GNSS, east 0, is
    found from the drive; where that does not determine it the GNSS is left out and counted

    Raises
    ------
    ConfigError
        if the filter does not fit the robot, or has no tuning of that name.
    DataError
        if the log has no wheels.
    """
    log, driven = correct(run, robot)
    tuning = tuning_of(name, tuning)
    is_physical = tuning == "physical" and process_variance is None and model is None
    model = model or model_of(log, driven, name, tuning)
    if process_variance is not None:
        model = replace(model, process_variance=process_variance)
    ema_alpha = THESIS_EMA_ALPHA if tuning == "thesis" and name == "vio12" else None
    table, yaw_rad = measurement_table(log, driven, ema_alpha=ema_alpha), 0.0
    if GNSS_ROWS[0] in model.rows:
        yaw_rad = gnss_heading(table, driven)
        if math.isnan(yaw_rad):
            streams = dict(run.streams)
            unused = {"gnss: heading not observable in this run": len(streams.pop("gnss"))}
            without = replace(run, streams=streams)
            found = estimate_run(without, robot, name, tuning=tuning, process_variance=process_variance)
            return replace(found, table=replace(found.table, dropped={**found.table.dropped, **unused}))
        table = measurement_table(log, driven, ema_alpha=ema_alpha, initial_yaw_rad=yaw_rad)
    samples = swerve.scheduled(model, table.z, table.gnss_variance, is_physical)
    settings = FilterSettings(1.0 if tuning == "thesis" else GATE_PROBABILITY, REOPEN_AFTER_S)
    track = run_filter(model, table.time_s, table.columns(model.rows), settings, *samples)
    speed_mps = np.hypot(track.state("speed_x_mps"), track.state("speed_y_mps"))
    kept = np.searchsorted(table.time_s, track.time_s)
    scheduled = tuple(None if part is None else part[kept] for part in samples)
    table = table.at(track.time_s)
    slip, blind = wheel_slip(track, table, driven), wheel_slip(track, table, driven, blind=True)
    rolling = np.where(table.columns(driven.wheel_rows) < 0.0, -1.0, 1.0)
    observable = bool(np.isfinite(slip.slip_ratio).any())
    figures = slip_figures(slip if observable else blind, speed_mps, track.time_s, rolling)
    truth = true_states(log, track, driven, driven.encoder_lag_s, yaw_rad)
    return Estimate(
        run, driven, name, model, scheduled, table, track, slip, blind, figures, truth, observable
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
    made of; and ``state``, of which no features are made: every state and ``std_<state>``,
    ``std_slip_<wheel>_ratio``, ``stale_ratio`` (1 where the speed over ground was not measured lately) and
    ``nis_<sensor>_ratio``; a column without any finite value is left out.
    """
    track, slip = estimate.track, estimate.slip
    columns = dict(zip(track.states, track.mean.T, strict=True))
    for state in track.states:
        columns[f"std_{state}"] = track.std(state)
    for wheel, std in zip(slip.wheels, slip.slip_std.T, strict=True):
        columns[f"std_slip_{wheel}_ratio"] = std
    columns["stale_ratio"] = slip.stale.astype(float)
    for sensor, nis in zip(track.sensors, track.nis.T, strict=True):
        columns[f"nis_{sensor}_ratio"] = nis
    return with_tracks(estimate.run, estimate.robot, estimate.name, track.time_s, columns, slip.as_stream())


def with_tracks(
    run: RunLog, robot: Robot, name: str, time_s: Array, columns: Mapping[str, Array], slip: Stream | None
) -> RunLog:
    """Return a run with wheel speeds and what a filter or observer found: ``slip``, ``estimator`` and ``state``.

    ``columns`` (n,) by name; those without any finite value are left out of ``state``.
    """
    run, moves, known = with_wheel_speeds(run, robot), {}, {}
    for channel in ESTIMATOR_CHANNELS:
        if channel in columns:
            moves[channel] = columns[channel]
    for channel, column in columns.items():
        if np.isfinite(column).any():
            known[channel] = column
    streams = dict(run.streams)
    if moves:
        streams["estimator"] = Stream(time_s, np.column_stack(list(moves.values())), tuple(moves))
    if slip is not None:
        streams["slip"] = slip
    streams["state"] = Stream(time_s, np.column_stack(list(known.values())), tuple(known))
    return replace(run, streams=streams, filter=name)


@dataclass(frozen=True, slots=True)
class EstimateSummary:
    """Figures of one run; NaN where something is not known."""

    run_id: str  #: which run and which filter
    filter: str
    #: in steady motion, positive in traction for both rolling directions; of a filter without a reference of the
    #: speed over ground it is the blind figure, and ``slip_observable`` is false
    slip_mean: float
    slip_std: float
    slip_true_mean: float  #: the true slip at the same instants
    slip_observable: bool  #: whether the speed over ground was measured
    slip_peak: float  #: largest of a wheel in transients
    steady_s: float  #: time of steady motion, and time without a recent speed over ground
    stale_s: float
    nis: Mapping[str, float]  #: mean squared innovation of each sensor a degree of freedom, of what was used
    nees: float  #: mean squared error of speeds, yaw rate and slip speeds over its covariance, a state
    #: by ``sensors`` (NIS) and, where there is a truth, by groups of ``states`` (NEES): whether the value is within
    #: its chi-square bounds
    consistency: Mapping[str, Mapping[str, str]]
    speed_rmse_mps: float  #: of the speed over ground
    n_dropped: int  #: samples left out, measurements rejected by a gate, and counts by kind
    n_gated: int
    dropped: Mapping[str, int]
    finite: bool  #: whether all states and covariances are finite


def summarize(estimate: Estimate) -> EstimateSummary:
    """Return the figures of an estimate."""
    track, slip, figures = estimate.track, estimate.slip, estimate.figures
    truth, used = estimate.truth, track.use == USED
    steps_s = np.diff(track.time_s, append=track.time_s[-1:])
    mean_nees = speed_rmse_mps = math.nan
    if truth is not None:
        judged = [state for state in track.states if state.startswith(JUDGED_STATES)]
        mean_nees = known_mean(nees(track, truth, judged)) / len(judged)
        speeds = np.isin(track.states, ("speed_x_mps", "speed_y_mps"))
        speed_rmse_mps = math.sqrt(known_mean((track.mean - truth)[:, speeds] ** 2) * speeds.sum())
    nis: dict[str, float] = {}
    consistency: dict[str, dict[str, str]] = {"sensors": {}, "states": {}}
    for k, sensor in enumerate(track.sensors):
        if dof := int(track.nis_dof[used[:, k], k].sum()):
            nis[sensor] = float(np.nansum(track.nis[used[:, k], k]) / dof)
    for kind, entries in consistency_report(track, truth).items():
        for entry in entries:
            consistency[kind][entry.name] = entry.verdict
    dropped = {**estimate.table.dropped, **track.dropped}
    n_dropped = sum(dropped.values())
    for kind, n in track.dropped.items():
        n_dropped -= n if kind.endswith(" gated") else 0
    return EstimateSummary(
        run_id=estimate.run.run_id,
        filter=estimate.name,
        slip_mean=figures.steady_mean,
        slip_std=known_mean(slip.slip_std[figures.steady]),
        slip_true_mean=known_mean(true_slip_at(estimate.run, estimate.robot, track.time_s)[figures.steady]),
        slip_observable=estimate.observable,
        slip_peak=figures.peak,
        steady_s=float(steps_s[figures.steady].sum()),
        stale_s=float(steps_s[slip.stale].sum()),
        nis=nis,
        nees=mean_nees,
        consistency=consistency,
        speed_rmse_mps=speed_rmse_mps,
        n_dropped=n_dropped,
        n_gated=int((track.use == GATED).sum()),
        dropped=dropped,
        finite=bool(np.isfinite(track.mean).all() and np.isfinite(track.cov).all()),
    )


def known_mean(values: Array) -> float:
    """Return the mean of what is finite; NaN of nothing."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan
