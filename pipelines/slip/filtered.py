"""``terrain estimate`` by a filter: state and slip of runs, with their errors where a log has a truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.report import (
    Figure,
    Mark,
    Panel,
    Part,
    Points,
    Progress,
    Report,
    Result,
    Shown,
    Strip,
    Text,
    described,
    format_value,
    frame,
    interval,
    plural,
    sections,
    silent,
)
from pipelines.slip.shown import MAX_PICTURED, TRUTH_COLOUR, band, first_rows, line, spans
from terrain.errors import ConfigError, DataError
from terrain.estimation.ekf.model import Noise
from terrain.estimation.enriched import enriched
from terrain.estimation.estimate import Estimate, beside, filter_run, model_and_noise, tuning_of
from terrain.estimation.reference import lagged_slip_at
from terrain.estimation.stuck import stuck_intervals
from terrain.estimation.summary import EstimateSummary, summarize
from terrain.estimation.tuned_noise import TunedNoise, tuned_noise, tuning_runs
from terrain.extension import correct, corrected, corrected_log
from terrain.kinematics.swerve import forward
from terrain.logs.clock import estimate_clock
from terrain.records import GATED, Array, RunLog
from terrain.robots import Robot, packaged_robot

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.slip.modes import EstimateOptions

MAX_APART_S = 0.1
"""Between the clocks of wheels and IMU: in more, a robot that begins to turn is seen to turn without wheels,
and the effective track is wrong by as much as its turns are short."""

SLIP = "+.4f"

Keep = Callable[[RunLog, Callable[[], Mapping[str, Figure]]], None]
"""Gets each run with its estimates, and what makes its pictures by name."""


@dataclass(frozen=True)
class EstimateResult(Result):
    """Estimates of runs by a filter."""

    filter: str = described("which filter")
    tuning: str = described("source of its noise: physical, thesis or likelihood")
    tuned: TunedNoise | None = described("what the tuning 'likelihood' did; none with another")
    out: Path | None = described("folder that the runs were written to")
    runs: tuple[EstimateSummary, ...] = described("figures of each run; slip positive in traction")
    skipped: tuple[str, ...] = described("a sentence for each run that a repairing read left out", default=())
    clocks: tuple[str, ...] = described(
        "a sentence where wheels and IMU of runs do not share a clock", default=()
    )
    pictures: Mapping[str, Figure] = field(default_factory=dict)

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a run."""
        return frame(self.runs)


def filter_runs(
    runs: Sequence[RunLog],
    robot: Robot | None,
    options: EstimateOptions,
    progress: Progress = silent,
    keep: Keep | None = None,
) -> EstimateResult:
    """Filter runs.

    Parameters
    ----------
    runs : logs
    robot : whose they are; by default each that a run names
    options : filter and noise
    keep : gets each run with its estimates

    Raises
    ------
    ConfigError
        if the filter does not fit a robot, or runs to tune on are named without the tuning ``likelihood``.
    DataError
        if there is no run of a name to tune on, or a log has no wheels.
    """
    tuning = tuning_of(options.filter, options.tuning)
    if options.tune_on is not None and tuning != "likelihood":
        raise ConfigError(f"runs to tune on go with the tuning 'likelihood', not {tuning!r}")
    process_noise, tuned = _tuned(runs, robot, options) if tuning == "likelihood" else (None, None)
    rows: list[EstimateSummary] = []
    pictures: dict[str, Figure] = {}
    for done, run in enumerate(runs):
        (log, own), noise = correct(run, robot or packaged_robot(run.robot)), None
        if process_noise is not None:  # not every run has the sensors of the runs tuned on
            noise = model_and_noise(log, own, options.filter, tuning)[1]
            noise = replace(noise, process_variance=process_noise.process_variance)
        found = beside(run, filter_run(log, own, options.filter, tuning=tuning, noise=noise))
        rows.append(summarize(found))
        if keep is not None:
            keep(enriched(found), partial(figures_of, found))
        pictures |= figures_of(found) if done < MAX_PICTURED else {}
        progress(f"estimate {options.filter}", done + 1, len(runs))
    clocks = _apart(runs, robot) if options.filter == "skid" else ()
    return EstimateResult(options.filter, tuning, tuned, None, tuple(rows), (), clocks, pictures)


def _apart(runs: Sequence[RunLog], given: Robot | None) -> tuple[str, ...]:
    """Return a sentence where wheels and IMU of runs clearly do not share a clock."""
    offsets_s = {}
    for run in runs:
        try:
            found = estimate_clock(run, track_m=(given or packaged_robot(run.robot)).track_m)
        except DataError:  # no gyro, or no speeds of two sides
            continue
        known = found.status in ("estimated", "offset only")
        if known and abs(found.offset_s) > max(MAX_APART_S, 3.0 * found.offset_std_s):
            offsets_s[run.run_id] = found.offset_s
    if not offsets_s:
        return ()
    worst = max(offsets_s, key=lambda name: abs(offsets_s[name]))
    return (
        f"the clocks of wheels and IMU are apart in {len(offsets_s)} of {len(runs)} runs, by "
        f"{offsets_s[worst]:+.2f} s in {worst}: tracks and yaw rates of these are wrong; --align brings the "
        "wheels onto the IMU's clock",
    )


def _tuned(runs: Sequence[RunLog], given: Robot | None, options: EstimateOptions) -> tuple[Noise, TunedNoise]:
    chosen = tuning_runs(runs, options.tune_on)
    robot = given or packaged_robot(chosen[0].robot)
    logs, robot = [corrected_log(run, robot) for run in chosen], corrected(robot)
    return tuned_noise(*model_and_noise(logs[0], robot, options.filter), logs, robot)


RUNS = (
    Shown("run", "run_id", long=True),
    Shown("slip", "slip_mean", SLIP),
    Shown("observed", lambda row: "yes" if row.slip_observable else "blind"),
    Shown("std", "slip_std", ".4f"),
    Shown("true", "slip_true_mean", SLIP),
    Shown("stale", "stale_s", ".1f", "s"),
    Shown("NEES", "nees", ".2f"),
    Shown("NIS camera", lambda row: row.nis.get("camera_speed"), ".2f"),
    Shown("speed RMSE", "speed_rmse_mps", ".4f", "m/s"),
    Shown("dropped", "n_dropped"),
    Shown("gated", "n_gated"),
)

BLIND = (
    "Blind: this filter takes no measurement of the speed over ground, so the figure is the wheels against "
    "themselves, and the slip in the tracks is NaN; where logs have poses or a lidar twist, --filter pose "
    "measures it."
)


def report(result: EstimateResult) -> Report:
    """Return slip, its truth where it is known, and how consistent the filter was."""
    blind = not all(row.slip_observable for row in result.runs)
    columns = [each for each in RUNS if blind or each.title != "observed"]
    first, all_runs = first_rows(result.runs, columns, f"filter {result.filter}, {result.tuning} noise")
    parts: list[Part] = [first, *(Text(sentence, "warning") for sentence in result.clocks)]
    if blind:
        parts.append(Text(BLIND, "note"))
    if (tuned := result.tuned) is not None:
        scales = [f"{name} {scale:.3g} ({tuned.status[name]})" for name, scale in tuned.scales.items()]
        parts.append(Text(f"Process variances scaled on {', '.join(tuned.runs)}: {', '.join(scales)}."))
    pictures = dict(result.pictures)
    lead = next((name for name in pictures if name.endswith("_slip")), next(iter(pictures), ""))
    return Report(
        f"Motion and slip by {result.filter}",
        _answer(result),
        pictures.pop(lead, None),
        parts,
        sections(
            all_runs,
            ("At rest, moving, stuck", [_motion_text(row) for row in result.runs if row.motion is not None]),
            ("Pictures", list(pictures.values())),
            ("Not read", result.skipped),
        ),
        next_step(result.filter, result.out),
    )


def next_step(filter_name: str, out: Path | None) -> str:
    """Return what follows an estimate: learning on runs that were written, or writing them."""
    writing = f"terrain estimate --data DIR --filter {filter_name} --out runs/"
    return writing if out is None else f"terrain crossval --data {out}"


def _answer(result: EstimateResult) -> str:
    n = plural(len(result.runs), "run")
    known = [row for row in result.runs if row.slip_observable and math.isfinite(row.slip_mean)]
    if known:
        means, std = [row.slip_mean for row in known], max(row.slip_std for row in known)
        slip = format_value(means[0], SLIP) if len(means) == 1 else interval(min(means), max(means), SLIP)
        deviation = format_value(std, ".4f")
        return f"Slip in steady motion is {slip} in {n}, with a standard deviation of at most {deviation}."
    if any(row.motion is not None for row in result.runs):
        n_stuck = sum(bool(row.stuck) for row in result.runs)
        return f"Motion of {n} is estimated without slip; the robot was stuck in {n_stuck} of them."
    return f"Motion of {n} is estimated; slip is not known in steady motion."


def _motion_text(row: EstimateSummary) -> str:
    """Return when a robot was stuck, and for how long nothing is known of its motion."""
    motion = row.motion or {}
    times = ", ".join(f"{each.start_s:.1f} to {each.end_s:.1f} s" for each in row.stuck or ())
    return (
        f"{row.run_id}: {f'stuck from {times}' if times else 'not seen to be stuck'}; moving for "
        f"{motion['moving']:.1f} s, at rest for {motion['at_rest']:.1f} s, unknown for {motion['unknown']:.1f} s"
    )


SWERVE_PANELS = (
    # state, label, row of the camera that sees it
    ("speed_x_mps", "longitudinal speed [m/s]", "camera_speed_x_mps"),
    ("speed_y_mps", "lateral speed [m/s]", "camera_speed_y_mps"),
    ("yaw_rate_radps", "yaw rate [rad/s]", "camera_yaw_rate_radps"),
)


def figures_of(estimate: Estimate) -> dict[str, Figure]:
    """Return ``<run>_motion`` and, where there is slip to show, ``<run>_slip``."""
    run_id = estimate.run.run_id
    if estimate.name == "skid":
        return {f"{run_id}_motion": skid_motion(estimate)}
    return {f"{run_id}_motion": swerve_motion(estimate), f"{run_id}_slip": slip_figure(estimate)}


def swerve_motion(estimate: Estimate) -> Figure:
    """Show speeds and yaw rate as estimated, as sensors measured them and as they were; below, innovations."""
    track, table = estimate.track, estimate.table
    seen, robot, time_s = estimate.name in ("vio12", "vio15"), estimate.robot, table.time_s
    rates = table.columns([f"wheel_{wheel}_radps" for wheel in robot.wheels])
    steer = table.columns([f"steer_{wheel}_rad" for wheel in robot.wheels])
    twist = forward(robot.wheel_positions_m, robot.wheel_radius_m, rates, steer)[0]
    panels = []
    for i, (state, label, row) in enumerate(SWERVE_PANELS):
        marks = [line("encoders, forward kinematics", time_s, twist[:, i], 1)]
        if seen:
            marks.append(line("camera, at its place", time_s, table.columns([row])[:, 0], 4))
        if state == "yaw_rate_radps":
            marks.append(line("gyro", time_s, table.columns(["gyro_z_radps"])[:, 0], 2))
        true = None if estimate.truth is None else estimate.truth[:, track.states.index(state)]
        panels.append(Panel((*marks, *_estimated(estimate, state, true)), label))
    rows = [row for _, _, row in SWERVE_PANELS] if seen else ["gyro_z_radps"]
    innovations = estimate.innovations
    return Figure(
        f"{estimate.run.run_id}: motion by {estimate.name}",
        (*panels, *(_innovation_panel(estimate, row, *innovations.row(row)) for row in rows)),
        "Estimates with two standard deviations beside the sensors; the truth behind the same low-pass. "
        "Innovations beside the two standard deviations that the filter expected of them.",
        x_label="time [s]",
    )


def _estimated(estimate: Estimate, state: str, true: Array | None = None) -> list[Mark]:
    track = estimate.track
    marks: list[Mark] = [
        band("± 2 std", track.time_s, track.state(state), 2 * track.std(state), 0),
        line(estimate.name, track.time_s, track.state(state), 0),
    ]
    return marks if true is None else [*marks, line("truth", track.time_s, true, TRUTH_COLOUR, dashed=True)]


def _innovation_panel(estimate: Estimate, row: str, value: Array, std: Array) -> Panel:
    track = estimate.track
    sensor = next(k for k, (_, rows) in enumerate(estimate.model.sensors) if row in rows)
    gated = track.use[:, sensor] == GATED
    used = value[~gated & np.isfinite(value)]
    variance = f"{used.var():.1e}" if used.size else "none"
    marks: list[Mark] = [
        band("± 2 std expected", track.time_s, np.zeros_like(std), 2 * std, 6),
        line("innovation", track.time_s, np.where(gated, np.nan, value), 0),
    ]
    if gated.any():
        marks.append(Points("gated", track.time_s[gated], np.zeros(gated.sum()), colour=5))
    reach = None
    if used.size:
        reach = 1.2 * max(float(np.nanmax(2 * std)), float(np.percentile(np.abs(used), 99.5)))
    return Panel(
        tuple(marks),
        "innovation",
        f"innovation of {row}, variance {variance}",
        y_range=None if reach is None else (-reach, reach),
    )


def skid_motion(estimate: Estimate) -> Figure:
    """Show speed, yaw rate and effective track of a skid-steer robot, and when it was stuck."""
    track, table = estimate.track, estimate.table
    wheels, track_m = table.columns(["wheel_left_mps", "wheel_right_mps"]), estimate.robot.track_m
    stuck = tuple(
        (interval.start_s, interval.end_s, "stuck")
        for interval in stuck_intervals(track.time_s, np.asarray(estimate.motion))
    )
    measured = {
        "speed_mps": [line("mean of the wheels", table.time_s, wheels.mean(axis=1), 1)],
        "yaw_rate_radps": [
            line(f"wheels over {track_m:g} m", table.time_s, np.diff(wheels, axis=1)[:, 0] / track_m, 1),
            line("gyro", table.time_s, table.columns(["gyro_z_radps"])[:, 0], 2),
        ],
        "effective_track_m": [],
    }
    labels = ("speed [m/s]", "yaw rate [rad/s]", "effective track [m]")
    panels = tuple(
        Panel((*marks, *_estimated(estimate, state), *((Strip(stuck),) if stuck else ())), label)
        for (state, marks), label in zip(measured.items(), labels, strict=True)
    )
    return Figure(
        f"{estimate.run.run_id}: motion without a speed reference",
        panels,
        "The skid filter with two standard deviations, beside wheels and gyro.",
        x_label="time [s]",
    )


def slip_figure(estimate: Estimate) -> Figure:
    """Show the slip of each wheel with its uncertainty, and the two speeds that it is made of."""
    track, slip, table = estimate.track, estimate.slip, estimate.table
    shown = slip if estimate.observable else estimate.blind
    has_truth = "truth" in estimate.run.streams
    true = lagged_slip_at(estimate.run, estimate.robot, track.time_s) if has_truth else None
    speeds_mps = (
        table.columns([f"wheel_{wheel}_radps" for wheel in slip.wheels]) * estimate.robot.wheel_radius_m
    )
    above = [line("speed over ground, estimated", track.time_s, track.state("speed_x_mps"), 6)]
    below: list[Mark] = []
    for i, wheel in enumerate(slip.wheels):
        above.append(line(f"circumference, wheel {wheel}", table.time_s, speeds_mps[:, i], i))
        ratio = shown.slip_ratio[:, i]
        if estimate.observable:
            below.append(band(f"± 2 std, wheel {wheel}", track.time_s, ratio, 2 * slip.slip_std[:, i], i))
        below.append(line(f"wheel {wheel}", track.time_s, ratio, i))
        if true is not None:
            below.append(line(f"truth, wheel {wheel}", track.time_s, true[:, i], TRUTH_COLOUR, dashed=True))
    if stale := spans(track.time_s, slip.stale, "stale: no speed reference"):
        below.append(Strip(stale))
    mean = estimate.figures.steady_mean
    if np.isfinite(mean):
        ends = track.time_s[[0, -1]]
        below.append(line(f"steady mean {mean:.3f}", ends, np.full(2, mean), 5, dashed=True))
    backward = np.nanmin(np.append(track.state("speed_x_mps"), 0.0)) < -0.1
    return Figure(
        f"{estimate.run.run_id}: {'slip' if estimate.observable else 'slip is not observed'}, {estimate.name}",
        (
            Panel(tuple(above), "speed [m/s]"),
            Panel(
                tuple(below),
                "slip ratio" if estimate.observable else "blind figure, no slip",
                y_range=(-0.6 if backward else -0.05, 0.6),
            ),
        ),
        "Slip of each wheel with two standard deviations; the truth is behind the same low-pass.",
        x_label="time [s]",
    )
