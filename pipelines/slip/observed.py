"""``terrain estimate`` by an observer of slip, of tracked and car-like robots."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.report import (
    Figure,
    Mark,
    Panel,
    Points,
    Progress,
    Report,
    Result,
    Shown,
    Strip,
    described,
    enumerated,
    format_value,
    frame,
    interval,
    plural,
    sections,
    silent,
)
from pipelines.slip.filtered import Keep, next_step
from pipelines.slip.shown import MAX_PICTURED, TRUTH_COLOUR, band, first_rows, line, spans
from terrain.errors import ConfigError
from terrain.estimation.observers.choice import BY_MODEL
from terrain.estimation.observers.estimate import ObserverEstimate, observe_run, with_estimates
from terrain.estimation.observers.family import ObserverStatus
from terrain.estimation.observers.slip_model_file import read_slip_model
from terrain.estimation.observers.summary import SETTLED, ObservedSlip, ObserverSummary, summarize_observer
from terrain.records import Array, RunLog
from terrain.robots import Robot, packaged_robot

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.slip.modes import EstimateOptions

LATE_S = 2.0
"""Time from the start that does not set the limits of an axis: estimates begin where nothing is known."""

SLIP = "+.4f"


@dataclass(frozen=True)
class ObservedResult(Result):
    """Estimates of runs by an observer."""

    filter: str = described("which observer")
    slip_model: Path | None = described("file of the slip model that it has")
    out: Path | None = described("folder that the runs were written to")
    runs: tuple[ObserverSummary, ...] = described("figures of each run; slip positive in traction")
    skipped: tuple[str, ...] = described("a sentence for each run that a repairing read left out", default=())
    pictures: Mapping[str, Figure] = field(default_factory=dict)

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a run."""
        return frame(self.runs)


def observe_runs(
    runs: Sequence[RunLog],
    robot: Robot | None,
    options: EstimateOptions,
    progress: Progress = silent,
    keep: Keep | None = None,
) -> ObservedResult:
    """Run an observer over runs.

    Parameters
    ----------
    runs : logs
    robot : whose they are; by default each that a run names
    options : observer and slip model
    keep : gets each run with its estimates

    Raises
    ------
    ConfigError
        if the observer does not fit a robot, or needs a slip model and has none.
    DataError
        if a log has no wheels.
    """
    if options.slip_model is not None and options.filter not in (*BY_MODEL, "encoder-odometry"):
        raise ConfigError(f"filter {options.filter!r} takes no slip model: leave --slip-model out")
    rows: list[ObserverSummary] = []
    pictures: dict[str, Figure] = {}
    for done, run in enumerate(runs):
        own = robot or packaged_robot(run.robot)
        model = None if options.slip_model is None else read_slip_model(options.slip_model, own.name)
        found = observe_run(run, own, options.filter, model)
        rows.append(summarize_observer(found))
        if keep is not None:
            keep(with_estimates(found), partial(figures_of, found))
        pictures |= figures_of(found) if done < MAX_PICTURED else {}
        progress(f"estimate {options.filter}", done + 1, len(runs))
    return ObservedResult(options.filter, options.slip_model, None, tuple(rows), (), pictures)


SLIPS = (
    *(
        Shown("run", itemgetter(0), long=True),
        Shown("slip", itemgetter(1)),
        Shown("mean", itemgetter(2), SLIP),
    ),
    *(Shown("std", itemgetter(3), ".4f"), Shown("true", itemgetter(4), SLIP)),
    *(Shown("RMSE", itemgetter(5), ".4f"), Shown("NEES", itemgetter(6), ".2f")),
    Shown("position RMSE", itemgetter(7), ".3f", "m"),
)

NOT_ESTIMATED = {"not estimated": ObservedSlip(*[math.nan] * 5)}


def report(result: ObservedResult) -> Report:
    """Return each slip of a run, its truth where it is known, and how long the observer had which status."""
    rows = [
        (
            *("" if k else run.run_id, name, slip.mean, slip.std, slip.true_mean, slip.rmse, slip.nees),
            None if k else run.position_rmse_m,
        )
        for run in result.runs
        for k, (name, slip) in enumerate((run.slip or NOT_ESTIMATED).items())
    ]
    first, all_rows = first_rows(rows, SLIPS, f"observer {result.filter}")
    pictures = list(result.pictures.values())
    return Report(
        f"Slip by the observer {result.filter}",
        _answer(result),
        pictures[0] if pictures else None,
        [first],
        sections(
            all_rows,
            ("Statuses", [_status_text(row) for row in result.runs]),
            ("Pictures", pictures[1:]),
            ("Not read", result.skipped),
        ),
        next_step(result.filter, result.out),
    )


def _answer(result: ObservedResult) -> str:
    n = plural(len(result.runs), "run")
    means: dict[str, list[float]] = {}
    for row in result.runs:
        for name, slip in row.slip.items():
            means.setdefault(name, []).extend([slip.mean] if math.isfinite(slip.mean) else [])
    known = [f"{name} is {interval(min(each), max(each), SLIP)}" for name, each in means.items() if each]
    if known:
        return f"In the means of {n}, {enumerated(known)}."
    errors = [row.position_rmse_m for row in result.runs if math.isfinite(row.position_rmse_m)]
    if errors:
        worst = format_value(max(errors), ".3f", "m")
        return f"The position of {n} is estimated; it is off by at most {worst} RMS in a run."
    return f"The position of {n} is estimated; slip is not."


def _status_text(row: ObserverSummary) -> str:
    times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in row.status_s.items())
    dropped = f"; left out: {sum(row.dropped.values())} samples" if row.dropped else ""
    missing = f"; not measured: {', '.join(row.missing)}" if row.missing else ""
    return f"{row.run_id}: {times}{dropped}{missing}"


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
    away = spans(
        time_s, ~np.isin(track.status, (*SETTLED, ObserverStatus.STANDING)), "does not follow measurements"
    )
    panels = []
    for k, name in enumerate(track.slips):
        scale, unit = (np.degrees(1.0), "degrees") if name.endswith("_rad") else (1.0, "ratio")
        slip, true = scale * track.slip[:, k], found.true(name)
        marks: list[Mark] = [
            band("± 1 std", time_s, slip, scale * track.slip_std[:, k], 0),
            line(found.observer.name, time_s, slip, 0),
        ]
        if true is not None:
            marks.append(line("true", time_s, scale * true, TRUTH_COLOUR, dashed=True))
        if away:
            marks.append(Strip(away))
        label = f"{name.rpartition('_')[0].replace('_', ' ')} [{unit}]"
        panels.append(Panel(tuple(marks), label, y_range=_range(time_s, slip)))
    title = f"Slip of {found.run.run_id} by the observer {found.observer.name}"
    return Figure(title, tuple(panels), "With one standard deviation.", x_label="time [s]")


def path_figure(found: ObserverEstimate) -> Figure:
    """Show the estimated path, the fixes, and the true one where it is known."""
    track, rows = found.track, found.observer.rows
    x, y = found.true("position_x_m"), found.true("position_y_m")
    own = track.state("position_x_m") + 1j * track.state("position_y_m")
    if "position_x_m" not in rows and x is not None and y is not None:
        yaw = found.true("yaw_rad")
        own = own * np.exp(1j * (0.0 if yaw is None else yaw[0])) + x[0] + 1j * y[0]
    marks: list[Mark] = []
    if "position_x_m" in rows and "gnss" in found.run.streams:
        gnss = found.run.streams["gnss"]
        marks.append(Points("fixes", gnss.channel("position_x_m"), gnss.channel("position_y_m"), colour=4))
    marks.append(line(found.observer.name, own.real, own.imag, 0))
    if x is not None and y is not None:
        marks.append(line("true", x, y, TRUTH_COLOUR, dashed=True))
    title = f"Path of {found.run.run_id} by the observer {found.observer.name}"
    return Figure(title, (Panel(tuple(marks), "y [m]", equal=True),), x_label="x [m]")


def _range(time_s: Array, slip: Array) -> tuple[float, float] | None:
    """Return the range of the values after the start, and a tenth of it around them."""
    known = slip[np.isfinite(slip) & (time_s > time_s[0] + min(LATE_S, 0.1 * np.ptp(time_s)))]
    if not known.size or np.ptp(known) == 0.0:
        return None
    margin = 0.1 * np.ptp(known)
    return float(known.min() - margin), float(known.max() + margin)
