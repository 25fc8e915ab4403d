"""A filter run over a whole log: measurements, states, slip, and the truth where a log has one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.consistency import Innovations, innovations
from terrain.estimation.feed import GNSS_ROWS
from terrain.estimation.filter import (
    GATE_PROBABILITY,
    REOPEN_AFTER_S,
    FilterModel,
    FilterSettings,
    Noise,
    run_filter,
)
from terrain.estimation.filters.skid import WHEELS_AND_GYRO, make_skid_filter, skid_noise, within_bounds
from terrain.estimation.filters.swerve import make_filter
from terrain.estimation.filters.swerve_noise import default_noise, scheduled, thesis_noise
from terrain.estimation.reference import true_states
from terrain.estimation.slip_figures import SlipFigures, slip_figures
from terrain.estimation.stuck import motion_track
from terrain.estimation.table import MeasurementTable, gnss_heading, measurement_table
from terrain.estimation.wheel_slip import blind_slip, wheel_slip
from terrain.extension import check_corrected, correct
from terrain.records import Array, RunLog, SlipTrack, StateTrack
from terrain.robots import Robot

FILTERS = ("encoder12", "slip14", "vio12", "vio15", "skid")
"""Names of the filters; the numbers are those of their states."""

FILTERS_OF_DRIVE: Mapping[str, tuple[str, ...]] = {
    "swerve": FILTERS[:-1],
    "skid_steer": FILTERS[-1:],
    "tracked": FILTERS[-1:],
    "omni": (),
    "bicycle": (),
}
"""Filters of each drive."""

TUNINGS = ("physical", "thesis", "likelihood")
"""Noise in natural units; the thesis' own (6.13), (6.14), with its smoothing and without gates; process noise
fitted to chosen runs."""

OWN_TUNING: Mapping[str, str] = {"vio12": "thesis"}
"""Tuning unless another is chosen: vio12 is the thesis' own filter, all others are physical."""

THESIS_SAMPLE_TIME_S = 0.02
"""Q of the thesis is per step; the sample time, which it does not print, is that of the wheels stream."""

THESIS_EMA_ALPHA = 0.2
"""Thesis (7.8): smoothing of the camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """All that is known of one run after filtering it.

    Parameters
    ----------
    run : the log, as measured
    robot : whose log it is, as the filter models it: without the effects of an extended one
    name : of the filter
    model : the filter
    noise : of its process and its measurements
    table : its measurements, of the log without the robot's effects
    track : its states
    slip : NaN where the speed over ground is not observed
    blind : the slip by the encoders and the filter's own speed; of a filter without a reference of the speed
        over ground that is no slip
    figures : of ``slip``, or of ``blind`` where there is no other
    truth : (n, d) true states, or None
    """

    run: RunLog
    robot: Robot
    name: str
    model: FilterModel
    noise: Noise
    table: MeasurementTable
    track: StateTrack
    slip: SlipTrack
    blind: SlipTrack
    figures: SlipFigures
    truth: Array | None

    @property
    def innovations(self) -> Innovations:
        """Measurement minus prediction at each instant."""
        inputs = np.nan_to_num(self.table.columns(self.model.inputs))
        z = self.table.columns(self.model.rows)
        return innovations(self.model, self.noise, self.track, z, inputs=inputs)

    @property
    def motion(self) -> Array | None:
        """The :class:`~terrain.estimation.stuck.Motion` (n,) at each instant; None of robots that steer."""
        if self.name != "skid":
            return None
        return motion_track(
            self.track.time_s,
            self.table.columns(WHEELS_AND_GYRO),
            self.track.state("yaw_rate_radps"),
            self.track.std("gyro_bias_radps"),
            self.robot.track_m,
        )

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
    run : log of the robot, as measured
    robot : its description
    name, tuning, noise, initial_yaw_rad : as :func:`filter_run` takes them
    tuned : of other runs, which may have other sensors; only its process variance is taken

    Returns
    -------
    Estimate
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
    found = filter_run(log, robot, name, tuning=tuning, noise=noise, initial_yaw_rad=initial_yaw_rad)
    left_out = "gnss" in run.streams and "gnss" not in found.run.streams
    return replace(found, run=_without_gnss(run) if left_out else run)


def filter_run(
    run: RunLog,
    robot: Robot,
    name: str,
    *,
    tuning: str | None = None,
    noise: Noise | None = None,
    initial_yaw_rad: float | None = None,
) -> Estimate:
    """Filter one run that is corrected.

    Parameters
    ----------
    run, robot : as :func:`terrain.extension.correct` returns them
    name : one of :data:`FILTERS`
    tuning : one of :data:`TUNINGS`; the filter's own (:data:`OWN_TUNING`) by default
    noise : that of a tuning on chosen runs, or any other, in place of the physical
    initial_yaw_rad : heading at the start in the frame of the GNSS, east 0; found from the drive by default,
        and where the drive does not determine it the GNSS is left out and counted

    Raises
    ------
    ConfigError
        if the filter does not fit the robot, or has no tuning of that name, or the robot is not corrected.
    DataError
        if the log has no wheels.
    """
    tuning = tuning_of(name, tuning)
    model, usual = model_and_noise(run, robot, name, tuning)
    ema_alpha = THESIS_EMA_ALPHA if tuning == "thesis" and name == "vio12" else None
    yaw_rad = initial_yaw_rad or 0.0
    table = measurement_table(run, robot, ema_alpha=ema_alpha, initial_yaw_rad=yaw_rad)
    if initial_yaw_rad is None and name != "skid" and set(GNSS_ROWS) & set(model.rows):
        yaw_rad = gnss_heading(table, robot)
        if math.isnan(yaw_rad):
            found = filter_run(_without_gnss(run), robot, name, tuning=tuning, initial_yaw_rad=0.0)
            unused = {"gnss: heading not observable in this run": len(run.streams["gnss"])}
            table = replace(found.table, dropped={**found.table.dropped, **unused})
            return replace(found, table=table)
        table = measurement_table(run, robot, ema_alpha=ema_alpha, initial_yaw_rad=yaw_rad)
    physical = noise is None and tuning == "physical"
    noise, inputs = _with_gnss_variance(noise or usual, model, table), None
    if physical:
        noise, inputs = scheduled(model, noise, table)
    settings = FilterSettings(1.0 if tuning == "thesis" else GATE_PROBABILITY, REOPEN_AFTER_S)
    track = run_filter(model, noise, table.time_s, table.columns(model.rows), settings, inputs)
    if name == "skid":
        track = replace(track, mean=within_bounds(track.mean, robot.track_m))
    noise = noise.at(np.searchsorted(table.time_s, track.time_s))
    table = table.at(track.time_s)
    slip, blind = wheel_slip(track, table, robot), blind_slip(track, table, robot)
    figures = slip_figures(
        slip if np.isfinite(slip.slip_ratio).any() else blind,
        _speed_mps(track),
        track.time_s,
        _rolling_direction(table, robot),
    )
    truth = true_states(run, track, robot, robot.encoder_lag_s, yaw_rad)
    return Estimate(run, robot, name, model, noise, table, track, slip, blind, figures, truth)


def model_and_noise(
    run: RunLog, robot: Robot, name: str, tuning: str | None = None
) -> tuple[FilterModel, Noise]:
    """Return the filter for a corrected run, and the noise that it starts from.

    Raises
    ------
    ConfigError
        as :func:`filter_run` does.
    """
    check_corrected(robot)
    suitable = FILTERS_OF_DRIVE[robot.drive]
    if robot.filters:
        suitable = tuple(each for each in suitable if each in robot.filters)
    if name in FILTERS and name not in suitable:
        from terrain.estimation.observers.choice import observers_of  # has kernels that filters do not need

        fits = ", ".join((*suitable, *observers_of(robot))) or "pose"
        raise ConfigError(
            f"filter {name!r} is not for robot {robot.name}, whose drive is {robot.drive}: use {fits}"
        )
    tuning = tuning_of(name, tuning)
    if name == "skid":
        return make_skid_filter(robot), skid_noise(robot)
    if tuning == "thesis":
        return make_filter(name, robot), thesis_noise(name, robot, THESIS_SAMPLE_TIME_S)
    gnss = "gnss" in run.streams and len(run.streams["gnss"]) > 0
    return make_filter(name, robot, with_gnss=gnss), default_noise(name, robot, gnss)


def tuning_of(name: str, tuning: str | None) -> str:
    """Return the tuning of a filter: the one chosen, or its own.

    Raises
    ------
    ConfigError
        if there is no such tuning.
    """
    tuning = tuning or OWN_TUNING.get(name, "physical")
    if tuning not in TUNINGS:
        raise ConfigError(f"there is no tuning {tuning!r}; there are {', '.join(TUNINGS)}")
    return tuning


def _without_gnss(run: RunLog) -> RunLog:
    return replace(run, streams={name: stream for name, stream in run.streams.items() if name != "gnss"})


def _with_gnss_variance(noise: Noise, model: FilterModel, table: MeasurementTable) -> Noise:
    """Give each position the variance of its own fix."""
    places = [model.rows.index(row) for row in GNSS_ROWS if row in model.rows]
    if not places:
        return noise
    variance = np.tile(noise.measurement_variance, (len(table.time_s), 1))
    variance[:, places] = table.gnss_variance
    return Noise(noise.process_variance, variance, noise.initial_variance)


def _speed_mps(track: StateTrack) -> Array:
    if "speed_mps" in track.states:
        return track.state("speed_mps")
    return np.hypot(track.state("speed_x_mps"), track.state("speed_y_mps"))


def _rolling_direction(table: MeasurementTable, robot: Robot) -> Array:
    """Return the direction (n, wheels) in which each wheel rolls: -1 backward, else 1."""
    rates = table.columns(list(robot.wheel_rows))
    return np.where(rates < 0.0, -1.0, 1.0)
