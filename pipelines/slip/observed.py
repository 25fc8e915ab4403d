"""``terrain estimate`` by an observer of slip, of robots of any drive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.report.figure import Figure, Line, Mark, Panel, Points, Strip, spans
from pipelines.report.numbers import enumerated, format_value, plural
from pipelines.report.results import Progress, described
from pipelines.report.tree import Column, Report, Text
from pipelines.slip.estimate import EstimateOptions
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
from terrain.estimation.models.choice import BY_MODEL
from terrain.estimation.models.observer import ObserverStatus
from terrain.estimation.models.slip_model import read_slip_model
from terrain.estimation.observe import (
    SETTLED,
    ObserverEstimate,
    ObserverSummary,
    observe_run,
    summarize_observer,
    with_estimates,
)
from terrain.logs.clock import offsets_apart_s
from terrain.records import Array, RunLog
from terrain.robots import Robot, robot_named

LATE_S = 2.0
"""Time from the start that does not set the limits of an axis: estimates begin where nothing is known."""


class ObserverResult(TracksResult, kw_only=True):
    """Estimates of runs by an observer."""

    filter: str = described("which observer")
    slip_model: Path | None = described("file of the slip model that it has")
    runs: tuple[ObserverSummary, ...] = described("figures of each run; slip positive in traction")
    clocks: tuple[str, ...] = described("a sentence where wheels and IMU of runs do not share a clock")


def estimate_all(
    runs: Sequence[RunLog],
    robot: Robot | None,
    options: EstimateOptions,
    progress: Progress,
    keep: Keep | None,
) -> ObserverResult:
    """Run an observer over runs, as :func:`pipelines.slip.estimate.estimate_runs`."""
    assert options.filter is not None  # chosen before
    name, file = options.filter, options.slip_model
    if file is not None and name not in (*BY_MODEL, "encoder-odometry"):
        raise ConfigError(f"filter {name!r} takes no slip model: leave --slip-model out")

    def robot_of(run: RunLog) -> Robot:
        return robot or robot_named(run.robot)

    def observe(run: RunLog) -> tuple[Any, RunLog, Pictures]:
        own = robot_of(run)
        found = observe_run(run, own, name, None if file is None else read_slip_model(file, own.name))
        return summarize_observer(found), with_estimates(found), partial(figures_of, found)

    found = estimate_each(runs, name, observe, progress, keep)
    # the turns of a robot that skids show where the clocks of wheels and IMU are apart
    skidding = [run for run in runs if name == "slip" and robot_of(run).skids]
    clocks: tuple[str, ...] = ()
    if apart := offsets_apart_s(skidding, lambda run: robot_of(run).track_m):
        worst = max(apart, key=lambda run_id: abs(apart[run_id]))
        clocks = (
            f"the clocks of wheels and IMU are apart in {len(apart)} of {len(runs)} runs, by "
            f"{apart[worst]:+.2f} s in {worst}: yaw rates and slip in turns of these are wrong; --align brings the "
            "wheels onto the IMU's clock",
        )
    return ObserverResult(**found, slip_model=file, clocks=clocks)


SLIPS = (
    Column("run", of="run.run_id", long=True),
    Column("slip", of=lambda row: _words(row["name"]) or row["name"]),
    Column("mean", SLIP, of="slip.mean"),
    Column("std", ".4f", of="slip.std"),
    Column("true", SLIP, of="slip.true_mean"),
    Column("RMSE", ".4f", of="slip.rmse"),
    Column("NEES", ".2f", of="slip.nees"),
    Column("position RMSE", ".3f", "m", of="run.position_rmse_m"),
)


def report(result: ObserverResult) -> Report:
    """Return each slip of a run, its truth where it is known, and how long the observer had which status."""
    rows = [
        {"run": run, "name": name, "slip": slip}
        for run in result.runs
        for name, slip in run.slip.items() or [("not estimated", None)]
    ]
    lacking = set.intersection(*(set(run.missing) for run in result.runs)) if result.runs else set()
    statuses = [f"not measured in any run: {', '.join(sorted(lacking))}"] if lacking else []
    for run in result.runs:
        times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in run.status_s.items())
        dropped = f"; left out: {sum(run.dropped.values())} samples" if run.dropped else ""
        own = [name for name in run.missing if name not in lacking]
        missing = f"; not measured: {', '.join(own)}" if own else ""
        why = f"; slip is not known: {run.reason}" if run.reason else ""
        statuses.append(f"{run.run_id}: {times}{dropped}{missing}{why}")
    return tracks_report(
        result,
        f"Estimates by '{result.filter}'",
        _answer(result),
        (rows, SLIPS, "slip by run"),
        ("Statuses", statuses),
        [Text(sentence, "warning") for sentence in result.clocks],
    )


def _answer(result: ObserverResult) -> str:
    n = plural(len(result.runs), "run")
    means: dict[str, list[float]] = {}
    for row in result.runs:
        for name, slip in row.slip.items():
            means.setdefault(name, []).extend([slip.mean] if math.isfinite(slip.mean) else [])
    known = [
        f"{_words(name)} is {format_value((min(each), max(each)) if len(each) > 1 else each[0], SLIP)}"
        for name, each in means.items()
        if each
    ]
    if known:
        return f"In the means of {n}, {enumerated(known)}."
    errors = [row.position_rmse_m for row in result.runs if math.isfinite(row.position_rmse_m)]
    if errors:
        worst = format_value(max(errors), ".3f", "m")
        return f"The position of {n} is estimated; it is off by at most {worst} RMS in a run."
    reasons = sorted({row.reason for row in result.runs if row.reason})
    why = f": {'; '.join(reasons)}" if reasons else ""
    return f"The position of {n} is estimated; slip is not{why}."


def figures_of(found: ObserverEstimate) -> dict[str, Figure]:
    """Return ``<run>_slip`` and ``<run>_path``, those of them that there is something to show in."""
    figures = {}
    if found.track.slips:
        figures[f"{found.run.run_id}_slip"] = slip_figure(found)
    if "position_x_m" in found.track.states:
        figures[f"{found.run.run_id}_path"] = path_figure(found)
    return figures


def slip_figure(found: ObserverEstimate) -> Figure:
    """Show each slip over time with a band of one standard deviation, and its truth where there is one."""
    track, time_s = found.track, found.track.time_s
    away = ~np.isin(track.status, (*SETTLED, ObserverStatus.STANDING))
    strip = Strip(spans(time_s, away, {1: "does not follow measurements"}))
    panels = []
    for k, name in enumerate(track.slips):
        scale, unit = (np.degrees(1.0), "degrees") if name.endswith("_rad") else (1.0, "ratio")
        slip, std, true = scale * track.slip[:, k], scale * track.slip_std[:, k], found.true(name)
        marks = estimated("estimate", time_s, slip, std, 1, None if true is None else scale * true)
        label = f"{_words(name)} [{unit}]"
        panels.append(Panel([*marks, strip], label, y_range=_range(time_s, slip)))
    caption = f"Estimated by '{found.observer.name}', with one standard deviation."
    return Figure(f"Slip of {found.run.run_id}", panels, caption, x_label="time [s]")


def path_figure(found: ObserverEstimate) -> Figure:
    """Show the estimated path, the fixes, and the true one where it is known."""
    own, true = found.path()
    marks: list[Mark] = []
    placed = "position_x_m" in found.observer.rows or found.observer.in_world
    for name in ("pose", "gnss") if placed else ():
        stream = found.run.streams.get(name)
        if stream is not None and "position_x_m" in stream.channels:
            x, y = stream.columns(["position_x_m", "position_y_m"]).T
            marks.append(Points(f"measured ({name})", x, y, colour=4))
            break
    marks.append(Line("estimate", own.real, own.imag, 0))
    if true is not None:
        marks.append(Line("truth", true.real, true.imag, TRUTH_COLOUR, dashed=True))
    caption = f"Estimated by '{found.observer.name}'."
    panel = Panel(marks, "y [m]", equal=True)
    return Figure(f"Path of {found.run.run_id}", (panel,), caption, x_label="x [m]")


def _words(channel: str) -> str:
    """Return a channel as a reader writes it: ``slip left`` of ``slip_left_ratio``."""
    return channel.rpartition("_")[0].replace("_", " ")


def _range(time_s: Array, slip: Array) -> tuple[float, float] | None:
    """Return the range of the values after the start, and a tenth of it around them."""
    known = slip[np.isfinite(slip) & (time_s > time_s[0] + min(LATE_S, 0.1 * np.ptp(time_s)))]
    if not known.size or np.ptp(known) == 0.0:
        return None
    margin = 0.1 * np.ptp(known)
    return float(known.min() - margin), float(known.max() + margin)
