"""``terrain estimate`` by a filter: state and slip of runs, with their errors where a log has a truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.report.figure import Band, Figure, Line, Mark, Panel, Points, Strip, spans
from pipelines.report.numbers import format_value, plural
from pipelines.report.results import Progress, described
from pipelines.report.tree import Column, Part, Report, Text
from pipelines.slip.tracks import (
    SLIP,
    TRUTH_COLOUR,
    Keep,
    Pictures,
    TracksResult,
    estimate_each,
    estimated,
    tracks_report,
)
from terrain.errors import ConfigError
from terrain.estimation.consistency import lagged_slip_at
from terrain.estimation.estimate import (
    Estimate,
    EstimateSummary,
    enriched,
    estimate_run,
    summarize,
    tuning_of,
)
from terrain.kinematics.wheels import no_slip_twist
from terrain.records import GATED, Array, RunLog
from terrain.robots import Robot, robot_named

if TYPE_CHECKING:
    from pipelines.slip.estimate import EstimateOptions
    from terrain.estimation.tuning import TunedNoise


class FilterResult(TracksResult, kw_only=True):
    """Estimates of runs by a filter."""

    filter: str = described("which filter")
    tuning: str = described("source of its noise: physical, thesis or likelihood")
    tuned: TunedNoise | None = described("what the tuning 'likelihood' did; none with another")
    runs: tuple[EstimateSummary, ...] = described("figures of each run; slip positive in traction")


def estimate_all(
    runs: Sequence[RunLog],
    robot: Robot | None,
    options: EstimateOptions,
    progress: Progress,
    keep: Keep | None,
) -> FilterResult:
    """Filter runs, as :func:`pipelines.slip.estimate.estimate_runs`."""
    assert options.filter is not None  # chosen before
    name, tuning = options.filter, tuning_of(options.filter, options.tuning)
    if options.tune_on is not None and tuning != "likelihood":
        raise ConfigError(f"runs to tune on go with the tuning 'likelihood', not {tuning!r}")
    variance, tuned = None, None
    if tuning == "likelihood":
        from terrain.estimation.tuning import tuned_noise

        variance, tuned = tuned_noise(runs, robot, name, options.tune_on)

    def robot_of(run: RunLog) -> Robot:
        return robot or robot_named(run.robot)

    def estimate(run: RunLog) -> tuple[Any, RunLog, Pictures]:
        found = estimate_run(run, robot_of(run), name, tuning=tuning, process_variance=variance)
        return summarize(found), enriched(found), partial(figures_of, found)

    return FilterResult(**estimate_each(runs, name, estimate, progress, keep), tuning=tuning, tuned=tuned)


RUNS = (
    Column("run", of="run_id", long=True),
    Column("slip", SLIP, of="slip_mean"),
    Column("observed", of=lambda row: "yes" if row.slip_observable else "blind"),
    Column("std", ".4f", of="slip_std"),
    Column("true", SLIP, of="slip_true_mean"),
    Column("stale", ".1f", "s", of="stale_s"),
    Column("NEES", ".2f", of="nees"),
    Column("NIS camera", ".2f", of="nis.camera_speed"),
    Column("speed RMSE", ".4f", "m/s", of="speed_rmse_mps"),
    Column("dropped", of="n_dropped"),
    Column("gated", of="n_gated"),
)

SEEING = ("vio12", "vio15")  #: Filters that have a camera

BLIND = (
    "Blind: this filter takes no measurement of the speed over ground, so the figure is the wheels against "
    "themselves, and the slip in the tracks is NaN; where logs have poses or a lidar twist, --filter pose "
    "measures it."
)


def report(result: FilterResult) -> Report:
    """Return slip, its truth where it is known, and how consistent the filter was."""
    blind = not all(row.slip_observable for row in result.runs)
    columns = [each for each in RUNS if blind or each.title != "observed"]
    parts: list[Part] = []
    if blind:
        parts.append(Text(BLIND, "note"))
    if (tuned := result.tuned) is not None:
        scales = [f"{name} {scale:.3g} ({tuned.status[name]})" for name, scale in tuned.scales.items()]
        parts.append(Text(f"Process variances scaled on {', '.join(tuned.runs)}: {', '.join(scales)}."))
    return tracks_report(
        result,
        f"Motion and slip by {result.filter}",
        _answer(result),
        (result.runs, columns, f"filter {result.filter}, {result.tuning} noise"),
        parts=parts,
    )


def _answer(result: FilterResult) -> str:
    n = plural(len(result.runs), "run")
    known = [row for row in result.runs if row.slip_observable and math.isfinite(row.slip_mean)]
    if known:
        means, std = [row.slip_mean for row in known], max(row.slip_std for row in known)
        slip = (
            format_value(means[0], SLIP) if len(means) == 1 else format_value((min(means), max(means)), SLIP)
        )
        deviation = format_value(std, ".4f")
        return f"Slip in steady motion is {slip} in {n}, with a standard deviation of at most {deviation}."
    return f"Motion of {n} is estimated; slip is not known in steady motion."


LABELS = {
    "speed_x_mps": "longitudinal speed [m/s]",
    "speed_y_mps": "lateral speed [m/s]",
    "yaw_rate_radps": "yaw rate [rad/s]",
}
"""States that are drawn, of the filters that have them."""


def figures_of(estimate: Estimate) -> dict[str, Figure]:
    """Return ``<run>_motion`` and ``<run>_slip``."""
    run_id = estimate.run.run_id
    return {f"{run_id}_motion": motion_figure(estimate), f"{run_id}_slip": slip_figure(estimate)}


def motion_figure(estimate: Estimate) -> Figure:
    """Show motion as estimated, as sensors measured it and as it was, and innovations."""
    track, table, name = estimate.track, estimate.table, estimate.name
    panels = []
    for state, sensors in _measured(estimate).items():
        marks: list[Mark] = [
            Line(each, table.time_s, sensors[each], i) for i, each in enumerate(sensors, start=1)
        ]
        true = None if estimate.truth is None else estimate.truth[:, track.states.index(state)]
        known = true if true is not None and np.isfinite(true).any() else None
        marks += estimated(name, track.time_s, track.state(state), track.std(state), 2, known)
        panels.append(Panel(marks, LABELS[state]))
    innovations = estimate.innovations
    for row in [f"camera_{state}" for state in LABELS] if name in SEEING else ["gyro_z_radps"]:
        value, std = innovations[row]
        sensor = next(k for k, (_, names) in enumerate(estimate.model.sensors) if row in names)
        gated = track.use[:, sensor] == GATED
        used = value[~gated & np.isfinite(value)]
        marks = [
            Band("± 2 std expected", track.time_s, -2 * std, 2 * std, 6),
            Line("innovation", track.time_s, np.where(gated, np.nan, value), 0),
        ]
        if gated.any():
            marks.append(Points("gated", track.time_s[gated], np.zeros(gated.sum()), colour=5))
        title, reach = f"innovation of {row}, variance none", None
        if used.size:
            title = f"innovation of {row}, variance {used.var():.1e}"
            most = 1.2 * max(float(np.nanmax(2 * std)), float(np.percentile(np.abs(used), 99.5)))
            reach = -most, most
        panels.append(Panel(marks, "innovation", title, y_range=reach))
    return Figure(
        f"{estimate.run.run_id}: motion by {name}",
        panels,
        "Estimates with two standard deviations beside the sensors; the truth behind the same low-pass. "
        "Innovations beside the two standard deviations that the filter expected of them.",
        x_label="time [s]",
    )


def _measured(estimate: Estimate) -> dict[str, dict[str, Array]]:
    """Return by state what the sensors say of it (n,)."""
    table, robot = estimate.table, estimate.robot
    gyro = {"gyro": table.columns(["gyro_z_radps"])[:, 0]}
    rates = table.columns([f"wheel_{wheel}_radps" for wheel in robot.wheels])
    steer = table.columns([f"steer_{wheel}_rad" for wheel in robot.wheels])
    twist = no_slip_twist(robot.wheel_positions_m, steer, robot.wheel_radius_m * rates)[0]
    found = {}
    for state, wheels in zip(("speed_x_mps", "speed_y_mps", "yaw_rate_radps"), twist.T, strict=True):
        found[state] = {"encoders, forward kinematics": wheels}
        if estimate.name in SEEING:
            found[state]["camera, at its place"] = table.columns([f"camera_{state}"])[:, 0]
    found["yaw_rate_radps"] |= gyro
    return found


def slip_figure(estimate: Estimate) -> Figure:
    """Show the slip of each wheel with its uncertainty, and the two speeds that it is made of."""
    track, slip, table, robot = estimate.track, estimate.slip, estimate.table, estimate.robot
    time_s, observed, ahead_mps = track.time_s, estimate.observable, track.state("speed_x_mps")
    shown = slip if observed else estimate.blind
    true = lagged_slip_at(estimate.run, robot, time_s) if "truth" in estimate.run.streams else None
    speeds = robot.wheel_radius_m * table.columns([f"wheel_{wheel}_radps" for wheel in slip.wheels])
    above: list[Mark] = [Line("speed over ground, estimated", time_s, ahead_mps, 6)]
    below: list[Mark] = []
    for i, wheel in enumerate(slip.wheels):
        above.append(Line(f"circumference, wheel {wheel}", table.time_s, speeds[:, i], i))
        ratio, half = shown.slip_ratio[:, i], 2 * slip.slip_std[:, i]
        if observed:
            below.append(Band(f"± 2 std, wheel {wheel}", time_s, ratio - half, ratio + half, i))
        below.append(Line(f"wheel {wheel}", time_s, ratio, i))
        if true is not None:
            below.append(Line(f"truth, wheel {wheel}", time_s, true[:, i], TRUTH_COLOUR, dashed=True))
    below.append(Strip(spans(time_s, slip.stale, {1: "stale: no speed reference"})))
    if np.isfinite(mean := estimate.figures.steady_mean):
        below.append(Line(f"steady mean {mean:.3f}", time_s[[0, -1]], [mean, mean], 5, dashed=True))
    y_range = (-0.6 if np.nanmin(np.append(ahead_mps, 0.0)) < -0.1 else -0.05, 0.6)
    return Figure(
        f"{estimate.run.run_id}: {'slip' if observed else 'slip is not observed'}, {estimate.name}",
        (
            Panel(above, "speed [m/s]"),
            Panel(below, "slip ratio" if observed else "blind figure, no slip", y_range=y_range),
        ),
        "Slip of each wheel with two standard deviations; the truth is behind the same low-pass.",
        x_label="time [s]",
    )
