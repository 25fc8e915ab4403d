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
    Noise,
    run_filter,
)
from terrain.estimation.models import swerve
from terrain.estimation.models.skid import (
    WHEELS_AND_GYRO,
    Motion,
    StuckInterval,
    make_skid_filter,
    motion_seconds,
    motion_track,
    skid_noise,
    stuck_intervals,
    within_bounds,
)
from terrain.estimation.wheel_slip import SlipFigures, blind_slip, slip_figures, wheel_slip
from terrain.extension import check_corrected, correct
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs.schema import ESTIMATOR_CHANNELS
from terrain.records import GATED, USED, Array, RunLog, SlipTrack, StateTrack, Stream
from terrain.robots import Robot

FILTERS = (*swerve.FILTERS, "skid")  #: Names of the filters; the numbers are those of their states.
#: Filters of each drive.
FILTERS_OF_DRIVE: Mapping[str, tuple[str, ...]] = {
    "swerve": swerve.FILTERS,
    "skid_steer": ("skid",),
    "tracked": ("skid",),
    "omni": (),
    "bicycle": (),
}
#: Noise in natural units; the thesis' own (6.13), (6.14), with its smoothing and without gates; process noise fitted
#: to chosen runs.
TUNINGS = ("physical", "thesis", "likelihood")
#: Tuning unless another is chosen: vio12 is the thesis' own filter, all others are physical.
OWN_TUNING: Mapping[str, str] = {"vio12": "thesis"}
#: Q of the thesis is per step; the sample time, which it does not print, is that of the wheels stream.
THESIS_SAMPLE_TIME_S = 0.02
THESIS_EMA_ALPHA = 0.2  #: Thesis (7.8): smoothing of the camera.
#: States whose error is judged (NEES): those that slip is computed from.
JUDGED_STATES = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "slip_speed_")


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """All that is known of one run after filtering it."""

    run: RunLog  #: the log, as measured
    robot: Robot  #: whose log it is, as the filter models it: without the effects of an extended one
    name: str  #: of the filter
    model: FilterModel  #: the filter, and of its process and its measurements
    noise: Noise
    table: MeasurementTable  #: its measurements, of the log without the robot's effects
    track: StateTrack  #: its states
    slip: SlipTrack  #: NaN where the speed over ground is not observed
    #: the slip by the encoders and the filter's own speed; of a filter without a reference of the speed over ground
    #: that is no slip
    blind: SlipTrack
    figures: SlipFigures  #: of ``slip``, or of ``blind`` where there is no other
    truth: Array | None  #: (n, d) true states, or None

    @property
    def innovations(self) -> dict[str, tuple[Array, Array]]:
        """By row the measurement minus the prediction at each instant (n,), and its expected standard deviation."""
        inputs = np.nan_to_num(self.table.columns(self.model.inputs))
        z = self.table.columns(self.model.rows)
        return innovations(self.model, self.noise, self.track, z, inputs=inputs)

    @property
    def motion(self) -> Array | None:
        """The :class:`~terrain.estimation.models.skid.Motion` (n,) at each instant; None of robots that steer."""
        if self.name != "skid":
            return None
        turn, bias_std = self.track.state("yaw_rate_radps"), self.track.std("gyro_bias_radps")
        measured = self.table.columns(WHEELS_AND_GYRO)
        return motion_track(self.track.time_s, measured, turn, bias_std, self.robot.track_m)

    @property
    def observable(self) -> bool:
        """Whether the slip was observed at any time."""
        return bool(np.isfinite(self.slip.slip_ratio).any())


def estimate_run(
    run: RunLog,
    robot: Robot,
    name: str,
    *,
    tuning: str | None = None,
    noise: Noise | None = None,
    initial_yaw_rad: float | None = None,
    tuned: Noise | None = None,
) -> Estimate:
    """Correct one run for the effects of its robot, and filter it.

    Parameters
    ----------
    run, robot : log of the robot, as measured, and its description
    name, tuning, noise, initial_yaw_rad : as :func:`filter_run` takes them
    tuned : noise of other runs, which may have other sensors; only its process variance is taken

    Returns
    -------
    of the corrected robot, beside the run as measured, less the GNSS that was left out

    Raises
    ------
    ConfigError
        if the filter does not fit the robot, or has no tuning of that name.
    DataError
        if the log has no wheels.
    """
    log, robot = correct(run, robot)
    if tuned is not None:
        usual = model_and_noise(log, robot, name, tuning)[1]
        noise = replace(usual, process_variance=tuned.process_variance)
    estimate = filter_run(log, robot, name, tuning=tuning, noise=noise, initial_yaw_rad=initial_yaw_rad)
    left_out = "gnss" in run.streams and "gnss" not in estimate.run.streams
    return replace(estimate, run=_without_gnss(run) if left_out else run)


def filter_run(
    run: RunLog,
    robot: Robot,
    name: str,
    *,
    tuning: str | None = None,
    noise: Noise | None = None,
    initial_yaw_rad: float | None = None,
) -> Estimate:
    """Filter one run that is corrected; errors as :func:`estimate_run`, and where it is not.

    Parameters
    ----------
    run, robot : as :func:`terrain.extension.correct` returns them
    name : one of :data:`FILTERS`
    tuning : one of :data:`TUNINGS`; the filter's own (:data:`OWN_TUNING`) by default
    noise : that of a tuning on chosen runs, or any other, in place of the physical
    initial_yaw_rad : heading at the start in the frame of the GNSS, east 0; found from the drive by default,
        and where the drive does not determine it the GNSS is left out and counted
    """
    tuning = tuning_of(name, tuning)
    model, usual = model_and_noise(run, robot, name, tuning)
    ema_alpha = THESIS_EMA_ALPHA if tuning == "thesis" and name == "vio12" else None
    yaw_rad = initial_yaw_rad or 0.0
    table = measurement_table(run, robot, ema_alpha=ema_alpha, initial_yaw_rad=yaw_rad)
    gnss_places = [model.rows.index(row) for row in GNSS_ROWS if row in model.rows]
    if initial_yaw_rad is None and name != "skid" and gnss_places:
        yaw_rad = gnss_heading(table, robot)
        if math.isnan(yaw_rad):
            without = filter_run(_without_gnss(run), robot, name, tuning=tuning, initial_yaw_rad=0.0)
            unused = {"gnss: heading not observable in this run": len(run.streams["gnss"])}
            return replace(without, table=replace(without.table, dropped={**without.table.dropped, **unused}))
        table = measurement_table(run, robot, ema_alpha=ema_alpha, initial_yaw_rad=yaw_rad)
    is_physical, noise, inputs = noise is None and tuning == "physical", noise or usual, None
    if gnss_places:  # each position has the variance of its own fix
        variance = np.tile(noise.measurement_variance, (len(table.time_s), 1))
        variance[:, gnss_places] = table.gnss_variance
        noise = Noise(noise.process_variance, variance, noise.initial_variance)
    if is_physical:
        noise, inputs = swerve.scheduled(model, noise, table)
    settings = FilterSettings(1.0 if tuning == "thesis" else GATE_PROBABILITY, REOPEN_AFTER_S)
    track = run_filter(model, noise, table.time_s, table.columns(model.rows), settings, inputs)
    if name == "skid":
        track = replace(track, mean=within_bounds(track.mean, robot.track_m))
        speed_mps = track.state("speed_mps")
    else:
        speed_mps = np.hypot(track.state("speed_x_mps"), track.state("speed_y_mps"))
    noise = noise.at(np.searchsorted(table.time_s, track.time_s))
    table = table.at(track.time_s)
    slip, blind = wheel_slip(track, table, robot), blind_slip(track, table, robot)
    rolling = np.where(table.columns(robot.wheel_rows) < 0.0, -1.0, 1.0)
    shown = slip if np.isfinite(slip.slip_ratio).any() else blind
    figures = slip_figures(shown, speed_mps, track.time_s, rolling)
    truth = true_states(run, track, robot, robot.encoder_lag_s, yaw_rad)
    return Estimate(run, robot, name, model, noise, table, track, slip, blind, figures, truth)


def model_and_noise(
    run: RunLog, robot: Robot, name: str, tuning: str | None = None
) -> tuple[FilterModel, Noise]:
    """Return the filter for a corrected run, and the noise that it starts from; errors as :func:`filter_run`."""
    check_corrected(robot)
    suitable = FILTERS_OF_DRIVE[robot.drive]
    if robot.filters:
        suitable = tuple(each for each in suitable if each in robot.filters)
    if name in FILTERS and name not in suitable:
        from terrain.estimation.models.choice import observers_of  # has kernels that filters do not need

        fits = ", ".join((*suitable, *observers_of(robot))) or "pose"
        raise ConfigError(
            f"filter {name!r} is not for robot {robot.name}, whose drive is {robot.drive}: use {fits}"
        )
    tuning = tuning_of(name, tuning)
    if name == "skid":
        return make_skid_filter(robot), skid_noise(robot)
    if tuning == "thesis":
        noise = swerve.thesis_noise(name, robot, THESIS_SAMPLE_TIME_S)
        return swerve.make_filter(name, robot), noise
    gnss = "gnss" in run.streams and len(run.streams["gnss"]) > 0
    return swerve.make_filter(name, robot, with_gnss=gnss), swerve.default_noise(name, robot, gnss)


def tuning_of(name: str, tuning: str | None) -> str:
    """Return the tuning of a filter: the one chosen, or its own; ``ConfigError`` if there is no such tuning."""
    tuning = tuning or OWN_TUNING.get(name, "physical")
    if tuning not in TUNINGS:
        raise ConfigError(f"there is no tuning {tuning!r}; there are {', '.join(TUNINGS)}")
    return tuning


def _without_gnss(run: RunLog) -> RunLog:
    return replace(run, streams={name: stream for name, stream in run.streams.items() if name != "gnss"})


def enriched(estimate: Estimate) -> RunLog:
    """Return the run with its estimate.

    Wheel speeds join the stream ``wheels``.  New are ``slip``; ``estimator``, the states that windows are
    made of; and ``state``, of which no features are made: every state and ``std_<state>``,
    ``std_slip_<wheel>_ratio``, ``stale_ratio`` (1 where the speed over ground was not measured lately),
    ``stuck_ratio`` (1 where the robot is stuck, NaN where that is unknown) and ``nis_<sensor>_ratio``; a column
    without any finite value is left out.
    """
    run, track, slip = with_wheel_speeds(estimate.run, estimate.robot), estimate.track, estimate.slip
    channels = tuple(state for state in ESTIMATOR_CHANNELS if state in track.states)
    estimator = Stream(track.time_s, np.column_stack([track.state(state) for state in channels]), channels)
    columns = {state: track.state(state) for state in track.states}
    columns |= {f"std_{state}": track.std(state) for state in track.states}
    columns |= {f"std_slip_{wheel}_ratio": slip.slip_std[:, i] for i, wheel in enumerate(slip.wheels)}
    columns["stale_ratio"] = slip.stale.astype(float)
    if (motion := estimate.motion) is not None:
        columns["stuck_ratio"] = np.where(motion == Motion.UNKNOWN, np.nan, motion == Motion.STUCK)
    columns |= {f"nis_{sensor}_ratio": track.nis[:, k] for k, sensor in enumerate(track.sensors)}
    streams = {**run.streams, "estimator": estimator, "slip": slip.as_stream()}
    streams["state"] = known_columns(track.time_s, columns)
    return replace(run, streams=streams, filter=estimate.name)


def known_columns(time_s: Array, columns: Mapping[str, Array]) -> Stream:
    """Return the columns (n,) that have a finite value as one stream."""
    known = {name: column for name, column in columns.items() if np.isfinite(column).any()}
    return Stream(time_s, np.column_stack(list(known.values())), tuple(known))


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
    #: time that the robot was at rest, moving, stuck, and neither is known; None of a filter that does not judge it
    motion: Mapping[str, float] | None
    stuck: tuple[StuckInterval, ...] | None  #: when it was stuck, None as ``motion``


def summarize(estimate: Estimate) -> EstimateSummary:
    """Return the figures of an estimate."""
    track, slip, figures, motion = estimate.track, estimate.slip, estimate.figures, estimate.motion
    truth, used = estimate.truth, track.use == USED
    steps_s = np.diff(track.time_s, append=track.time_s[-1:])
    true_slip = true_slip_at(estimate.run, estimate.robot, track.time_s)
    n_refused = sum(n for kind, n in track.dropped.items() if not kind.endswith(" gated"))
    judged = [i for i, state in enumerate(track.states) if state.startswith(JUDGED_STATES)]
    speeds = [i for i, state in enumerate(track.states) if state in ("speed_x_mps", "speed_y_mps")]
    mean_nees = speed_rmse_mps = math.nan
    if truth is not None:
        names = [track.states[i] for i in judged]
        mean_nees = known_mean(nees(track, truth[:, judged], names)) / len(judged)
        error = (track.mean - truth)[:, speeds]
        speed_rmse_mps = math.sqrt(known_mean(error**2) * len(speeds))
    report = consistency_report(track, truth)._asdict()
    return EstimateSummary(
        run_id=estimate.run.run_id,
        filter=estimate.name,
        slip_mean=figures.steady_mean,
        slip_std=known_mean(slip.slip_std[figures.steady]),
        slip_true_mean=known_mean(true_slip[figures.steady]),
        slip_observable=estimate.observable,
        slip_peak=figures.peak,
        steady_s=float(steps_s[figures.steady].sum()),
        stale_s=float(steps_s[slip.stale].sum()),
        nis={
            sensor: float(np.nansum(track.nis[used[:, k], k]) / dof)
            for k, sensor in enumerate(track.sensors)
            if (dof := int(track.nis_dof[used[:, k], k].sum()))
        },
        nees=mean_nees,
        consistency={
            kind: {entry.name: entry.verdict for entry in entries} for kind, entries in report.items()
        },
        speed_rmse_mps=speed_rmse_mps,
        n_dropped=sum(estimate.table.dropped.values()) + n_refused,
        n_gated=int((track.use == GATED).sum()),
        dropped={**estimate.table.dropped, **track.dropped},
        finite=bool(np.isfinite(track.mean).all() and np.isfinite(track.cov).all()),
        motion=None if motion is None else motion_seconds(track.time_s, motion),
        stuck=None if motion is None else stuck_intervals(track.time_s, motion),
    )


def known_mean(values: Array) -> float:
    """Return the mean of what is finite; NaN of nothing."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan
