"""``terrain estimate``: state and slip tracks of runs, judged against the truth where a log has one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.reporting.progress import Progress, silent
from terrain.errors import ConfigError, LogError
from terrain.estimation.ekf.consistency import consistency_report, nees
from terrain.estimation.ekf.filter import run_filter
from terrain.estimation.ekf.innovations import Innovations, innovations
from terrain.estimation.ekf.model import GATE_PROBABILITY, REOPEN_AFTER_S, FilterModel, FilterSettings, Noise
from terrain.estimation.filters.skid import make_skid_filter, skid_noise
from terrain.estimation.filters.swerve import make_filter
from terrain.estimation.filters.swerve_noise import default_noise, thesis_noise
from terrain.estimation.measurements.batch import measurement_table
from terrain.estimation.measurements.heading import gnss_heading
from terrain.estimation.measurements.table import GNSS_ROWS, MeasurementTable
from terrain.estimation.reference import true_states
from terrain.estimation.slip_figures import SlipFigures, slip_figures
from terrain.estimation.wheel_slip import blind_slip, wheel_slip
from terrain.extension import corrected, corrected_log
from terrain.files.atomic import ensure_writable
from terrain.kinematics.wheel_speed import with_wheel_speeds
from terrain.logs.write import run_folder, write_run
from terrain.records import GATED, USED, Array, RunLog, SlipTrack, StateTrack, Stream
from terrain.robots import Robot, load_robot

FILTERS = ("encoder12", "slip14", "vio12", "vio15", "skid")
"""Names of the filters; the numbers are those of their states."""

TUNINGS = ("physical", "thesis", "likelihood")
"""Noise in natural units; the thesis' own (6.13), (6.14), with its smoothing and without gates; process noise
fitted to chosen runs."""

OWN_TUNING = {"vio12": "thesis"}
"""Tuning unless another is asked for: vio12 is the thesis' own filter, all others are physical."""

THESIS_SAMPLE_TIME_S = 0.02
"""Q of the thesis is a step's; the sample time that it does not print is that of the wheels stream."""

THESIS_EMA_ALPHA = 0.2
"""Thesis (7.8): smoothing of the camera."""

JUDGED_STATES = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "slip_speed_")
"""States whose error is judged (NEES): what slip is made of."""

ESTIMATOR_CHANNELS = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")
"""States that go into windows."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """All that is known of one run after filtering it.

    Parameters
    ----------
    run : the log, as measured
    robot : whose log it is, as the filter believes it: without the effects of an extended one
    name : of the filter
    model : the filter
    noise : what it took model and sensors to be off by
    table : its measurements, of the log without the robot's effects
    track : its states
    slip : NaN where the speed over ground is not observed
    blind : the slip that the filter's own speed gives; of a filter without a reference that is no slip
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
        """What each measurement said beyond its prediction."""
        return innovations(self.model, self.noise, self.track, self.table.columns(self.model.rows))

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
) -> Estimate:
    """Filter one run.

    Parameters
    ----------
    run : log of the robot
    robot : its description; the effects of an extended one are taken off the log before it is filtered
    name : one of :data:`FILTERS`
    tuning : one of :data:`TUNINGS`; the filter's own (:data:`OWN_TUNING`) by default
    noise : what was tuned on chosen runs, or any other noise, in place of the physical
    initial_yaw_rad : heading at the start in the frame of the GNSS, east 0; found from the drive by default,
        and where the drive does not tell it the GNSS is left out and counted

    Raises
    ------
    ConfigError
        if the filter does not fit the robot, or has no tuning of that name.
    DataError
        if the log has no wheels.
    """
    measured, run, robot = run, corrected_log(run, robot), corrected(robot)
    model, usual = model_and_noise(run, robot, name, tuning)
    thesis = _tuning(name, tuning) == "thesis"
    ema_alpha = THESIS_EMA_ALPHA if thesis and name == "vio12" else None
    yaw_rad = initial_yaw_rad or 0.0
    table = measurement_table(run, robot, ema_alpha=ema_alpha, initial_yaw_rad=yaw_rad)
    if initial_yaw_rad is None and set(GNSS_ROWS) & set(model.rows) and name != "skid":
        yaw_rad = gnss_heading(table, robot)
        if math.isnan(yaw_rad):
            n_unused = len(run.streams["gnss"])
            run, measured = (
                replace(log, streams={kind: log.streams[kind] for kind in log.streams if kind != "gnss"})
                for log in (run, measured)
            )
            found = estimate_run(run, robot, name, tuning=tuning, initial_yaw_rad=0.0)
            dropped = {**found.table.dropped, "gnss: heading not told by the drive": n_unused}
            return replace(found, run=measured, table=replace(found.table, dropped=dropped))
        table = measurement_table(run, robot, ema_alpha=ema_alpha, initial_yaw_rad=yaw_rad)
    noise = _with_gnss_variance(noise or usual, model, table)
    settings = FilterSettings(1.0 if thesis else GATE_PROBABILITY, REOPEN_AFTER_S)
    track = run_filter(model, noise, table.time_s, table.columns(model.rows), settings)
    table = table.at(track.time_s)
    slip, blind = wheel_slip(track, table, robot), blind_slip(track, table, robot)
    speed_mps = track.state("speed_mps" if name == "skid" else "speed_x_mps")
    if name != "skid":
        speed_mps = np.hypot(speed_mps, track.state("speed_y_mps"))
    shown = slip if np.isfinite(slip.slip_ratio).any() else blind
    return Estimate(
        measured,
        robot,
        name,
        model,
        noise,
        table,
        track,
        slip,
        blind,
        slip_figures(shown, speed_mps, track.time_s, _rolling(table, robot)),
        true_states(run, track, robot, robot.encoder_lag_s, yaw_rad),
    )


def _rolling(table: MeasurementTable, robot: Robot) -> Array:
    """Return the direction (n, wheels) in which each wheel rolls: -1 backward, else 1."""
    unit = "radps" if robot.drive == "swerve" else "mps"
    rates = table.columns([f"wheel_{wheel}_{unit}" for wheel in robot.wheels])
    return np.where(rates < 0.0, -1.0, 1.0)


def model_and_noise(
    run: RunLog, robot: Robot, name: str, tuning: str | None = None
) -> tuple[FilterModel, Noise]:
    """Return the filter for a run, and the noise that it starts from.

    Raises
    ------
    ConfigError
        as :func:`estimate_run` does.
    """
    if (name == "skid") != (robot.drive == "skid_steer"):
        fits = "skid" if robot.drive == "skid_steer" else ", ".join(FILTERS[:-1])
        raise ConfigError(
            f"filter {name!r} is not for robot {robot.name}, whose drive is {robot.drive}: use {fits}"
        )
    robot, tuning = corrected(robot), _tuning(name, tuning)
    if name == "skid":
        return make_skid_filter(robot), skid_noise(robot)
    if tuning == "thesis":
        return make_filter(name, robot), thesis_noise(name, robot, THESIS_SAMPLE_TIME_S)
    gnss = "gnss" in run.streams and len(run.streams["gnss"]) > 0
    return make_filter(name, robot, with_gnss=gnss), default_noise(name, robot, gnss)


def _tuning(name: str, tuning: str | None) -> str:
    tuning = tuning or OWN_TUNING.get(name, "physical")
    if tuning not in TUNINGS:
        raise ConfigError(f"there is no tuning {tuning!r}; there are {', '.join(TUNINGS)}")
    return tuning


def _with_gnss_variance(noise: Noise, model: FilterModel, table: MeasurementTable) -> Noise:
    """Give each position the variance of its own fix."""
    places = [model.rows.index(row) for row in GNSS_ROWS if row in model.rows]
    if not places:
        return noise
    variance = np.tile(noise.measurement_variance, (len(table.time_s), 1))
    variance[:, places] = table.gnss_variance
    return Noise(noise.process_variance, variance, noise.initial_variance)


def summary(estimate: Estimate) -> dict[str, Any]:
    """Return what ``terrain estimate --json`` holds of a run; None where something is not known.

    Slips are positive in traction whichever way a wheel rolls.  ``slip_mean`` of a filter without a
    reference of speed is its blind figure, and ``slip_observable`` is false.  ``nis`` is the mean squared
    innovation a degree of freedom of each sensor, of what was used; ``nees`` the mean squared error of
    speeds, yaw rate and slip speeds over its covariance, a state.  ``consistency`` says of each sensor (NIS)
    and, where there is a truth, of each group of states (NEES) whether it is within its chi-square bounds.
    """
    track, slip = estimate.track, estimate.slip
    steady = estimate.figures.steady
    steps_s = np.diff(track.time_s, append=track.time_s[-1:])
    used = track.use == USED
    counted = {
        sensor: float(np.nansum(track.nis[used[:, k], k]) / dof)
        for k, sensor in enumerate(track.sensors)
        if (dof := int(track.nis_dof[used[:, k], k].sum()))
    }
    return {
        "run_id": estimate.run.run_id,
        "filter": estimate.name,
        "slip_mean": _known(estimate.figures.steady_mean),
        "slip_std": _known(_mean(slip.slip_std[steady])),
        "slip_true_mean": _known(_mean(_true_slip(estimate)[steady])),
        "slip_observable": estimate.observable,
        "slip_peak": _known(estimate.figures.peak),
        "steady_s": float(steps_s[steady].sum()),
        "stale_s": float(steps_s[slip.stale].sum()),
        "nis": counted,
        "nees": _known(_judged(estimate)),
        "consistency": {
            kind: {entry.name: entry.verdict for entry in entries}
            for kind, entries in consistency_report(track, estimate.truth)._asdict().items()
        },
        "speed_rmse_mps": _known(_speed_rmse_mps(estimate)),
        "n_dropped": sum(estimate.table.dropped.values())
        + sum(n for kind, n in track.dropped.items() if not kind.endswith(" gated")),
        "n_gated": int((track.use == GATED).sum()),
        "dropped": {**estimate.table.dropped, **track.dropped},
        "finite": bool(np.isfinite(track.mean).all() and np.isfinite(track.cov).all()),
    }


def enriched(estimate: Estimate) -> RunLog:
    """Return the run with what was estimated beside what was measured.

    Wheel speeds join the stream ``wheels``.  New are ``slip``; ``estimator``, the states that windows are
    made of; and ``state``, of which no features are made: every state and ``std_<state>``,
    ``std_slip_<wheel>_ratio``, ``stale_ratio`` (1 where nothing measured the speed over ground lately) and
    ``nis_<sensor>_ratio``.
    """
    run = with_wheel_speeds(estimate.run, estimate.robot)
    track = estimate.track
    channels = tuple(state for state in ESTIMATOR_CHANNELS if state in track.states)
    values = np.column_stack([track.state(state) for state in channels])
    streams = dict(run.streams)
    streams["estimator"] = Stream(track.time_s, values, channels)
    streams["slip"] = estimate.slip.as_stream()
    streams["state"] = _state_stream(estimate)
    return RunLog(run.run_id, run.robot, streams, run.labels, run.source, run.dropped)


def _state_stream(estimate: Estimate) -> Stream:
    """Return all that the filter says; what it never knew is left out."""
    track, slip = estimate.track, estimate.slip
    columns = {state: track.state(state) for state in track.states}
    columns |= {f"std_{state}": track.std(state) for state in track.states}
    columns |= {f"std_slip_{wheel}_ratio": slip.slip_std[:, i] for i, wheel in enumerate(slip.wheels)}
    columns["stale_ratio"] = slip.stale.astype(float)
    columns |= {f"nis_{sensor}_ratio": track.nis[:, k] for k, sensor in enumerate(track.sensors)}
    known = {name: column for name, column in columns.items() if np.isfinite(column).any()}
    return Stream(track.time_s, np.column_stack(list(known.values())), tuple(known))


def estimate(
    runs: Sequence[RunLog],
    name: str,
    *,
    robot: str | None = None,
    tuning: str | None = None,
    out: Path | None = None,
    figures: bool = True,
    tune_on: Sequence[str] | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Filter runs; write them with their tracks, and their pictures.

    Parameters
    ----------
    runs : logs
    name : one of :data:`FILTERS`
    robot : description to use in place of the one that each log names
    tuning : one of :data:`TUNINGS`; the filter's own (:data:`OWN_TUNING`) by default
    out : folder of the new run folders and of ``figures/``; nothing is written without
    figures : whether to draw
    tune_on : ids of the runs that teach the tuning ``likelihood``; the first few by default

    Returns
    -------
    dict that JSON can hold
        ``filter, tuning, tuned, out, runs`` with one :func:`summary` a run

    Raises
    ------
    LogError
        if a run is in ``out`` already; nothing is written then.
    """
    if out is not None:
        ensure_writable(out)
        for run in runs:
            if (folder := run_folder(run.run_id, out)).exists():
                raise LogError(f"{folder}: is there already, and is left as it is; choose another --out")
    if tune_on is not None and _tuning(name, tuning) != "likelihood":
        raise ConfigError(f"runs to tune on go with the tuning 'likelihood', not {_tuning(name, tuning)!r}")
    tuning, taught_noise, tuned = _tuning(name, tuning), None, None
    if tuning == "likelihood":
        from pipelines.estimate.tune import chosen_runs, tuned_noise

        training_runs = chosen_runs(runs, tune_on)
        trained = load_robot(robot or training_runs[0].robot)
        told = [corrected_log(training_run, trained) for training_run in training_runs]
        taught_noise, tuned = tuned_noise(*model_and_noise(told[0], trained, name), told, corrected(trained))
    rows = []
    for done, run in enumerate(runs):
        described, noise = load_robot(robot or run.robot), None
        if taught_noise is not None:  # of the process alone: not every run has the teachers' sensors
            _, own = model_and_noise(run, described, name, tuning)
            noise = Noise(taught_noise.process_variance, own.measurement_variance, own.initial_variance)
        found = estimate_run(run, described, name, tuning=tuning, noise=noise)
        rows.append(summary(found))
        if out is not None:
            write_run(enriched(found), out)
            if figures:
                from pipelines.estimate.figures import write_figures

                write_figures(found, out / "figures")
        progress(f"estimate {name}", done + 1, len(runs))
    return {
        "filter": name,
        "tuning": tuning,
        "tuned": tuned,
        "out": None if out is None else str(out),
        "runs": rows,
    }


def _true_slip(estimate: Estimate) -> Array:
    """Return the true slip (n, wheels), positive in traction, at each instant; NaN without a truth."""
    shape = estimate.slip.slip_ratio.shape
    truth = estimate.run.streams.get("truth")
    if truth is None:
        return np.full(shape, np.nan)
    columns = []
    for wheel in estimate.slip.wheels:
        slip = truth.channel(f"slip_{wheel}_ratio")
        at = np.clip(np.searchsorted(truth.time_s, estimate.track.time_s), 0, len(truth) - 1)
        rolling = np.where(truth.channel(f"wheel_{wheel}_radps") < 0.0, -1.0, 1.0)
        columns.append((slip * rolling)[at])
    return np.column_stack(columns)


def _judged(estimate: Estimate) -> float:
    if estimate.truth is None:
        return math.nan
    states = estimate.track.states
    judged = [i for i, state in enumerate(states) if state.startswith(JUDGED_STATES)]
    squared = nees(estimate.track, estimate.truth[:, judged], [states[i] for i in judged])
    return _mean(squared) / len(judged)


def _speed_rmse_mps(estimate: Estimate) -> float:
    if estimate.truth is None:
        return math.nan
    chosen = [i for i, state in enumerate(estimate.track.states) if state in ("speed_x_mps", "speed_y_mps")]
    error = (estimate.track.mean - estimate.truth)[:, chosen]
    return math.sqrt(_mean(error**2) * len(chosen))


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
