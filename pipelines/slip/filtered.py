"""``terrain estimate`` by a filter or an observer: state and slip of runs, and errors where a log has a truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.report.figure import Band, Figure, Line, Mark, Panel, Points, Strip, spans
from pipelines.report.numbers import enumerated, format_value, plural
from pipelines.report.results import Progress, described
from pipelines.report.tree import Column, Part, Report, Text, sections
from pipelines.slip.shown import first_rows, known_columns
from pipelines.slip.tracks import Keep, TracksResult
from terrain.errors import ConfigError
from terrain.estimation.estimate import (
    FILTERS,
    SETTLED,
    Estimate,
    EstimateSummary,
    enriched,
    estimate_run,
    summarize,
    tuning_of,
)
from terrain.estimation.models.observer import ObserverStatus
from terrain.kinematics.wheels import no_slip_twist
from terrain.logs.clock import offsets_apart_s
from terrain.records import GATED, Array, RunLog
from terrain.robots import Robot, robot_named

if TYPE_CHECKING:
    from pipelines.slip.estimate import EstimateOptions
    from terrain.estimation.tuning import TunedNoise

MAX_PICTURED = 3  #: Runs whose pictures a page has; ``--figures`` writes those of all
TRUTH_COLOUR = 6  #: Grey, for what was true
SLIP = "+.4f"
#: Time from the start that does not set the limits of an axis: estimates begin where nothing is known.
LATE_S = 2.0


class EstimateResult(TracksResult, kw_only=True):
    """Estimates of runs by a filter or an observer."""

    filter: str = described("which filter or observer")
    tuning: str | None = described(
        "source of a filter's noise: physical, thesis or likelihood; none of an observer"
    )
    tuned: TunedNoise | None = described("what the tuning 'likelihood' did; none with another")
    slip_model: Path | None = described("file of the slip model that an observer has")
    runs: tuple[EstimateSummary, ...] = described("figures of each run; slip positive in traction")
    clocks: tuple[str, ...] = described("a sentence where wheels and IMU of runs do not share a clock")


def estimate_all(
    runs: Sequence[RunLog],
    robot: Robot | None,
    options: EstimateOptions,
    progress: Progress,
    keep: Keep | None,
) -> EstimateResult:
    """Run a filter or an observer over runs, as :func:`pipelines.slip.estimate.estimate_runs`."""
    assert options.filter is not None  # chosen before
    name, file = options.filter, options.slip_model
    tuning, variance, tuned = None, None, None
    if name in FILTERS:
        tuning = tuning_of(name, options.tuning)
        if options.tune_on is not None and tuning != "likelihood":
            raise ConfigError(f"runs to tune on go with the tuning 'likelihood', not {tuning!r}")
    if tuning == "likelihood":
        from terrain.estimation.tuning import tuned_noise

        variance, tuned = tuned_noise(runs, robot, name, options.tune_on)
    if file is not None:
        from terrain.estimation.models.choice import BY_MODEL
        from terrain.estimation.models.slip_model import read_slip_model

        if name not in (*BY_MODEL, "encoder-odometry"):
            raise ConfigError(f"filter {name!r} takes no slip model: leave --slip-model out")
    rows, pictures = [], dict[str, Figure]()
    for done, run in enumerate(runs, start=1):
        own = robot or robot_named(run.robot)
        slip_model = None if file is None else read_slip_model(file, own.name)
        found = estimate_run(run, own, name, tuning=tuning, process_variance=variance, slip_model=slip_model)
        rows.append(summarize(found))
        if keep is not None:
            keep(enriched(found), partial(figures_of, found))
        pictures |= figures_of(found) if done <= MAX_PICTURED else {}
        progress(f"estimate {name}", done, len(runs))
    return EstimateResult(
        filter=name,
        tuning=tuning,
        tuned=tuned,
        slip_model=file,
        runs=tuple(rows),
        clocks=_clocks_apart(runs, robot) if name == "slip" else (),
        pictures=pictures,
    )


def _clocks_apart(runs: Sequence[RunLog], robot: Robot | None) -> tuple[str, ...]:
    """Return a sentence where the turns of robots that skid look as if the clocks of wheels and IMU were apart."""
    robots = {run.run_id: robot or robot_named(run.robot) for run in runs}
    skidding = [run for run in runs if robots[run.run_id].skids]
    apart = offsets_apart_s(skidding, lambda run: robots[run.run_id].track_m)
    if not apart:
        return ()
    worst = max(apart, key=lambda run_id: abs(apart[run_id]))
    return (
        f"the clocks of wheels and IMU look apart in {len(apart)} of {len(runs)} runs, by {apart[worst]:+.2f} s in "
        f"{worst}: if they are, and it is not slip that varies from turn to turn, yaw rates and slip in turns of these "
        "are wrong; --align brings the wheels onto the IMU's clock",
    )


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
    Column("position RMSE", ".3f", "m", of="position_rmse_m"),
    Column("dropped", of="n_dropped"),
    Column("gated", of="n_gated"),
)

SLIPS = (
    Column("run", of="run_id", long=True),
    Column("slip", of=lambda row: _words(row["name"])),
    Column("mean", SLIP, of="slip.mean"),
    Column("std", ".4f", of="slip.std"),
    Column("true", SLIP, of="slip.true_mean"),
    Column("RMSE", ".4f", of="slip.rmse"),
    Column("NEES", ".2f", of="slip.nees"),
)

BLIND = (
    "Blind: no measurement of the speed over ground was taken, so the figure is the wheels against "
    "themselves, and the slip in the tracks is NaN; where logs have poses or a lidar twist, --filter pose "
    "measures it."
)


def report(result: EstimateResult) -> Report:
    """Return slip, its truth where it is known, how consistent the filter was, and what was not measured.

    It leads with the slip of the first run that has one.
    """
    blind = any(not row.slip_observable and math.isfinite(row.slip_mean) for row in result.runs)
    columns = known_columns([each for each in RUNS if blind or each.title != "observed"], result.runs)
    of_noise = f", {result.tuning} noise" if result.tuning else ""
    first, all_rows = first_rows(result.runs, columns, f"slip in steady motion, {result.filter}{of_noise}")
    slips = [
        {"run_id": row.run_id, "name": name, "slip": slip}
        for row in result.runs
        for name, slip in row.slip.items()
    ]
    parts: list[Part] = [first]
    of_slips: tuple[str, list[Part]] = ("", [])
    if slips:
        table, of_slips = first_rows(slips, known_columns(SLIPS, slips), "each slip, while the robot moves")
        parts.append(table)
    if blind:
        parts.append(Text(BLIND, "note"))
    if (tuned := result.tuned) is not None:
        scales = [f"{name} {scale:.3g} ({tuned.status[name]})" for name, scale in tuned.scales.items()]
        parts.append(Text(f"Process variances scaled on {', '.join(tuned.runs)}: {', '.join(scales)}."))
    parts += [Text(sentence, "warning") for sentence in result.clocks]
    pictures = dict(result.pictures)
    lead = next((name for name in pictures if name.endswith("_slip")), next(iter(pictures), ""))
    writing = f"terrain estimate --data DIR --filter {result.filter} --out runs/"
    return Report(
        f"Motion and slip by {result.filter}",
        _answer(result),
        pictures.pop(lead, None),
        parts,
        sections(
            all_rows,
            ("All slips", of_slips[1]),
            ("Statuses", _statuses(result)),
            ("Pictures", list(pictures.values())),
            ("Not read", result.skipped),
        ),
        writing if result.out is None else f"terrain crossval --data {result.out}",
    )


def _statuses(result: EstimateResult) -> list[str]:
    lacking = set.intersection(*(set(run.missing) for run in result.runs)) if result.runs else set()
    sentences = [f"not measured in any run: {', '.join(sorted(lacking))}"] if lacking else []
    for run in result.runs:
        times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in run.status_s.items())
        dropped = f"; left out: {sum(run.dropped.values())} samples" if run.dropped else ""
        own = [name for name in run.missing if name not in lacking]
        missing = f"; not measured: {', '.join(own)}" if own else ""
        why = f"; slip is not known: {run.reason}" if run.reason else ""
        sentences.append(f"{run.run_id}: {times}{dropped}{missing}{why}")
    return sentences


def _answer(result: EstimateResult) -> str:
    n = plural(len(result.runs), "run")
    known = [row for row in result.runs if row.slip_observable and math.isfinite(row.slip_mean)]
    if known:
        slip, std = _range([row.slip_mean for row in known]), max(row.slip_std for row in known)
        deviation = format_value(std, ".4f")
        return f"Slip in steady motion is {slip} in {n}, with a standard deviation of at most {deviation}."
    means: dict[str, list[float]] = {}
    for row in result.runs:
        for name, of_wheel in row.slip.items():
            means.setdefault(name, []).extend([of_wheel.mean] if math.isfinite(of_wheel.mean) else [])
    if any(means.values()):
        each = [f"{_words(name)} is {_range(values)}" for name, values in means.items() if values]
        return f"In the means of {n}, {enumerated(each)}."
    reasons = sorted({row.reason for row in result.runs if row.reason})
    why = f": {'; '.join(reasons)}" if reasons else ""
    errors = [row.position_rmse_m for row in result.runs if math.isfinite(row.position_rmse_m)]
    off = f"; its position is off by at most {format_value(max(errors), '.3f', 'm')} RMS" if errors else ""
    return f"Motion of {n} is estimated{off}; slip is not known{why}."


def _range(values: Sequence[float]) -> str:
    return format_value((min(values), max(values)) if len(values) > 1 else values[0], SLIP)


def _words(channel: str) -> str:
    """Return a channel as a reader writes it: ``slip left`` of ``slip_left_ratio``."""
    return channel.rpartition("_")[0].replace("_", " ")


LABELS = {
    "speed_x_mps": "longitudinal speed [m/s]",
    "speed_y_mps": "lateral speed [m/s]",
    "yaw_rate_radps": "yaw rate [rad/s]",
}
"""States that are drawn, of the filters that have them."""


def figures_of(estimate: Estimate) -> dict[str, Figure]:
    """Return ``<run>_motion``, ``<run>_slip`` and ``<run>_path``, those that there is something to show in."""
    run_id, states, figures = estimate.run.run_id, estimate.track.states, dict[str, Figure]()
    if any(state in states for state in LABELS):
        figures[f"{run_id}_motion"] = motion_figure(estimate)
    if estimate.slip.channels:
        figures[f"{run_id}_slip"] = slip_figure(estimate)
    if "position_x_m" in states:
        figures[f"{run_id}_path"] = path_figure(estimate)
    return figures


def estimated(label: str, time_s: Array, mean: Array, std: Array, true: Array | None = None) -> list[Mark]:
    """Return an estimate (n,) over time, the band of two standard deviations, and what was true where it is known."""
    marks: list[Mark] = [
        Band("± 2 std", time_s, mean - 2 * std, mean + 2 * std, 0),
        Line(label, time_s, mean, 0),
    ]
    if true is not None and np.isfinite(true).any():
        marks.append(Line("truth", time_s, true, TRUTH_COLOUR, dashed=True))
    return marks


def motion_figure(estimate: Estimate) -> Figure:
    """Show motion as estimated, as sensors measured it and as it was, and innovations."""
    track, name, panels = estimate.track, estimate.name, []
    measured = _measured(estimate)
    for state, label in LABELS.items():
        if state not in track.states:
            continue
        marks: list[Mark] = [
            Line(sensor, track.time_s, values, i)
            for i, (sensor, values) in enumerate(measured.get(state, {}).items(), start=1)
        ]
        true = estimate.true_state(state)
        marks += estimated(name, track.time_s, track.state(state), track.std(state), true)
        panels.append(Panel(marks, label))
    innovations = estimate.innovations
    seen = [f"camera_{state}" for state in LABELS if f"camera_{state}" in innovations]
    for row in seen or ["gyro_z_radps"] * bool(innovations):
        panels.append(_innovation_panel(estimate, row, *innovations[row]))
    return Figure(
        f"{estimate.run.run_id}: motion by {name}",
        panels,
        "Estimates with two standard deviations beside the sensors, and the truth. "
        "Innovations beside the two standard deviations that the filter expected of them.",
        x_label="time [s]",
    )


def _innovation_panel(estimate: Estimate, row: str, value: Array, std: Array) -> Panel:
    track, model = estimate.track, estimate.model
    assert model is not None  # whose innovations these are
    sensor = next(k for k, (_, names) in enumerate(model.sensors) if row in names)
    gated = track.use[:, sensor] == GATED
    used = value[~gated & np.isfinite(value)]
    marks: list[Mark] = [
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
    return Panel(marks, "innovation", title, y_range=reach)


def _measured(estimate: Estimate) -> dict[str, dict[str, Array]]:
    """Return by state what the sensors say of it (n,)."""
    table, robot = estimate.table, estimate.robot
    if table is None:
        return {}
    rates, steer = table.columns(robot.wheel_rows), table.columns(robot.steer_rows)
    twist = no_slip_twist(robot.wheel_positions_m, steer, robot.wheel_radius_m * rates)[0]
    found = {}
    for state, wheels in zip(LABELS, twist.T, strict=True):
        found[state] = {"encoders, forward kinematics": wheels}
        if estimate.model is not None and f"camera_{state}" in estimate.model.rows:
            found[state]["camera, at its place"] = table.columns([f"camera_{state}"])[:, 0]
    found["yaw_rate_radps"]["gyro"] = table.columns(["gyro_z_radps"])[:, 0]
    return found


def slip_figure(estimate: Estimate) -> Figure:
    """Show each slip over time with two standard deviations, and its truth where there is one."""
    time_s, observed = estimate.track.time_s, estimate.observable
    shown = estimate.slip if observed or estimate.blind is None else estimate.blind
    follows = (*SETTLED, ObserverStatus.STANDING)
    strip = Strip(
        spans(time_s, estimate.status, {int(each): each.label for each in set(ObserverStatus) - set(follows)})
    )
    panels, mean = [], estimate.figures.steady_mean
    for name, slip, std in zip(shown.channels, shown.mean.T, estimate.slip.std.T, strict=True):
        scale, unit = (np.degrees(1.0), "degrees") if name.endswith("_rad") else (1.0, "ratio")
        true = estimate.true(name)
        marks = estimated(
            "estimate", time_s, scale * slip, scale * std, None if true is None else scale * true
        )
        if np.isfinite(mean) and name in shown.ratios.channels:
            marks.append(Line(f"steady mean {mean:.3f}", time_s[[0, -1]], [mean, mean], 5, dashed=True))
        label = f"{_words(name)} [{unit}]" if observed else f"{_words(name)}: blind, no slip"
        panels.append(Panel([*marks, strip], label, y_range=_y_range(time_s, scale * slip)))
    title = f"{estimate.run.run_id}: {'slip' if observed else 'slip is not observed'}, {estimate.name}"
    caption = "Each slip with two standard deviations; shaded with its status where it does not follow measurements."
    return Figure(title, panels, caption, x_label="time [s]")


def path_figure(estimate: Estimate) -> Figure:
    """Show the estimated path, the fixes, and the true one where it is known."""
    own, true = estimate.path()
    marks: list[Mark] = []
    for name in ("pose", "gnss") if estimate.in_world else ():
        stream = estimate.run.streams.get(name)
        if stream is not None and "position_x_m" in stream.channels:
            x, y = stream.columns(["position_x_m", "position_y_m"]).T
            marks.append(Points(f"measured ({name})", x, y, colour=4))
            break
    marks.append(Line("estimate", own.real, own.imag, 0))
    if true is not None:
        marks.append(Line("truth", true.real, true.imag, TRUTH_COLOUR, dashed=True))
    title, panel = f"{estimate.run.run_id}: path, {estimate.name}", Panel(marks, "y [m]", equal=True)
    return Figure(title, (panel,), f"Estimated by '{estimate.name}'.", x_label="x [m]")


def _y_range(time_s: Array, slip: Array) -> tuple[float, float] | None:
    """Return the range of the values after the start, and a tenth of it around them."""
    known = slip[np.isfinite(slip) & (time_s > time_s[0] + min(LATE_S, 0.1 * np.ptp(time_s)))]
    if not known.size or np.ptp(known) == 0.0:
        return None
    margin = 0.1 * np.ptp(known)
    return float(known.min() - margin), float(known.max() + margin)
