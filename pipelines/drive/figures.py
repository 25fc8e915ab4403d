"""Pictures of drives side by side: what they cost, a run's slip against its target, the curves of a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.signal import lfilter

from pipelines.reporting.drawing import (
    BLUE,
    CLASS_COLOURS,
    FAINT_INK,
    GRID,
    INK,
    NOT_KNOWN,
    VERMILION,
    finished,
    new_figure,
    shorten,
    styled,
)
from pipelines.reporting.numbers import format_number as said
from pipelines.slip.figures import GREEN, LARGEST_RATIO, LAW_NAMES
from terrain.control.drive_metrics import PEAK_ABOVE_MPS, SMOOTH_S
from terrain.control.slip_table import SlipTable
from terrain.control.traction import BRAKING, STATUS_NAMES, TRACTION
from terrain.records import Array, RunLog
from terrain.slip_learning.slip_curve import LAW_PARAMETERS, traction_ratio

ORANGE, PINK, SKY, GREY = (CLASS_COLOURS[i] for i in (1, 3, 4, 6))
COLOURS = {
    "plain": GREY,
    "ramp": ORANGE,
    "thesis": PINK,
    "fixed": SKY,
    "learned": BLUE,
    "oracle": GREEN,
}
"""Of the controllers; those that are told something are vermilion."""

COLUMNS = 3
LONGEST = 2.0
"""Intervals are drawn up to so many times the longest bar."""

MAX_POINTS = 2500
RISING_COLOUR, BRAKING_COLOUR, HATCH_COLOUR = "#f7efc9", "#f3dccb", "#dba888"
LEAST_NAME_SHARE = 0.035
"""Of the width of a picture: ground that was driven for less has no name in the strip."""


class Panel(NamedTuple):
    """One figure of all controllers: what it is called, with its unit, and each mean with its interval."""

    name: str
    values: Mapping[str, tuple[float | None, Sequence[float] | None]]


def bars_figure(panels: Sequence[Panel], n_seeds: int) -> Figure:
    """Draw a small chart a figure, a bar a controller, with its 95 % interval and its number beside it."""
    n_rows = math.ceil(len(panels) / COLUMNS)
    n_bars = max(len(panel.values) for panel in panels)
    with styled():
        figure = new_figure(10.0, 0.5 + n_rows * (0.85 + 0.235 * n_bars))
        grid = figure.subplots(n_rows, COLUMNS, squeeze=False)
        for number, axes in enumerate(grid.ravel()):
            if number >= len(panels):
                axes.set_axis_off()
                continue
            _bars(axes, panels[number], named=number % COLUMNS == 0)
        days = (
            "One day, which shows no spread"
            if n_seeds == 1
            else f"Mean and 95 % interval over {n_seeds} days"
        )
        return finished(figure, days)


def _bars(axes: Axes, panel: Panel, named: bool) -> None:
    means = [mean for mean, _ in panel.values.values() if mean is not None]
    ends = [end for _, interval in panel.values.values() for end in interval or ()]
    low, high = min([0.0, *means]), max([0.0, *means])
    # an interval of few days may be wider than the picture: it is cut off, the table has it
    high = min(max([high, *ends]), max(LONGEST * high, high - low)) or 1.0
    low = max(min([low, *ends]), -LONGEST * abs(low))
    room = high - low
    axes.set_xlim(low - (0.04 * room if low < 0.0 else 0.0), high + 0.2 * room)
    for row, (name, (mean, interval)) in enumerate(panel.values.items()):
        if mean is None:
            axes.text(0.0, row, f"  {NOT_KNOWN}", va="center", fontsize=9)
            continue
        axes.barh(row, mean, height=0.68, color=COLOURS.get(name, VERMILION))
        if interval is not None:
            shown = np.clip(interval, low, high)
            axes.plot(shown, [row, row], color=INK, lw=1.2, marker="|", ms=5, mew=1.2, solid_capstyle="butt")
        axes.text(
            1.0, row, said(mean), transform=axes.get_yaxis_transform(), ha="right", va="center", fontsize=7.5
        )
    axes.set_ylim(len(panel.values) - 0.4, -0.6)
    axes.set_yticks(range(len(panel.values)), [shorten(name, 18) for name in panel.values] if named else [])
    axes.tick_params(axis="y", length=0)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.spines["left"].set_visible(False)
    axes.axvline(0.0, color=FAINT_INK, lw=0.8)
    axes.grid(axis="x")
    axes.set_title(panel.name, loc="left", fontsize=8.5)


class Drawn(NamedTuple):
    """What a picture of a run shows: speeds (n,) in m/s and slips (n,) of truth and control."""

    true_s: Array
    true_mps: Array
    slip: Array
    slip_least: Array
    slip_largest: Array
    control_s: Array
    control: Mapping[str, Array]
    aimed: Array
    blind: bool


def drawn(run: RunLog) -> Drawn:
    """Return what is drawn of a run.

    True slip is behind the low-pass that its estimate is behind, and there is none where the robot is slower
    than :data:`terrain.control.drive_metrics.PEAK_ABOVE_MPS`.  A wheel that turns backwards while the robot
    goes on brakes as one that is locked does, and more: the sign is that of the way over ground.
    """
    truth, control = run.streams["truth"], run.streams["control"]
    step_s = float(np.median(np.diff(truth.time_s)))
    keep = math.exp(-step_s / SMOOTH_S)
    speed = np.hypot(truth.channel("speed_x_mps"), truth.channel("speed_y_mps"))
    wheels = [name.split("_")[1] for name in truth.channels if name.startswith("wheel_")]
    slips = np.column_stack([truth.channel(f"slip_{wheel}_ratio") for wheel in wheels])
    turns = np.sign(np.column_stack([truth.channel(f"wheel_{wheel}_radps") for wheel in wheels]))
    slips = np.nan_to_num(slips * turns * np.where(np.abs(slips) > 1.0, -1.0, 1.0))
    slips = lfilter([1.0 - keep], [1.0, -keep], np.clip(slips, -1.0, 1.0), axis=0)
    slips[speed < PEAK_ABOVE_MPS] = np.nan
    said_by = {name: control.channel(name) for name in control.channels}
    aimed = said_by["aimed_ratio"]
    if not np.isfinite(said_by["balance_ratio"]).any():  # the thesis' aim is told without its sign
        aimed = np.where(said_by["drive_state_ratio"] == BRAKING, -aimed, aimed)
    return Drawn(
        truth.time_s,
        speed,
        slips.mean(axis=1),
        slips.min(axis=1),
        slips.max(axis=1),
        control.time_s,
        said_by,
        aimed,
        not np.isfinite(said_by["slip_ratio"]).any(),
    )


def run_figures(examples: Mapping[str, RunLog], table: SlipTable) -> dict[str, Figure]:
    """Return a picture of each run, all with the same axes.

    Parameters
    ----------
    examples : a run of each controller, with the streams ``truth`` and ``control``
    table : whose entries the pilot numbered its grounds by
    """
    shown = {name: drawn(run) for name, run in examples.items()}
    if not shown:
        return {}
    fastest = max(float(part.true_mps.max()) for part in shown.values())
    fastest = max(fastest, *(float(np.nanmax(part.control["desired_mps"])) for part in shown.values()))
    slips = np.concatenate(
        [values for part in shown.values() for values in (part.slip_least, part.slip_largest, part.aimed)]
    )
    least, largest = float(np.nanmin([-0.02, *slips])), float(np.nanmax([0.1, *slips]))
    limits = (
        (-0.03 * fastest, 1.1 * fastest),
        (least - 0.06 * (largest - least), largest + 0.1 * (largest - least)),
    )
    return {name: _run_figure(name, examples[name], part, table, limits) for name, part in shown.items()}


def _run_figure(
    name: str,
    run: RunLog,
    part: Drawn,
    table: SlipTable,
    limits: tuple[tuple[float, float], tuple[float, float]],
) -> Figure:
    grounds = ground_strips(run, part, table)
    with styled():
        figure = new_figure(10.0, 5.4 + 0.28 * len(grounds))
        ratios = [2.0, 3.0] + ([0.26 * len(grounds)] if grounds else [])
        panels = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios)
        above, below = panels[:2]
        _shade(above, part, named=False)
        _line(above, part.control_s, part.control["desired_mps"], INK, "wanted, fastest wheel", 0.9, "--")
        _line(above, part.control_s, part.control["driven_mps"], VERMILION, "driven, fastest wheel", 1.2)
        _line(above, part.true_s, part.true_mps, BLUE, "true, over ground", 1.5)
        above.set(ylim=limits[0], ylabel="speed [m/s]")
        _shade(below, part, named=True)
        every = _every(part.true_s)
        below.fill_between(
            part.true_s[::every],
            part.slip_least[::every],
            part.slip_largest[::every],
            color=BLUE,
            alpha=0.22,
            lw=0,
            label="true, least to largest wheel",
        )
        _line(below, part.true_s, part.slip, BLUE, "true, mean of the wheels", 1.5)
        if not part.blind:
            _said(below, part)
        below.set(ylim=limits[1], ylabel="slip ratio")
        for axes in (above, below):
            axes.grid()
            axes.legend(
                ncols=4, fontsize=7.5, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), borderpad=0
            )
        if grounds:
            _strips(panels[2], grounds, part.control_s)
        panels[-1].set(xlabel="time [s]", xlim=(part.control_s[0], part.control_s[-1]))
        what = "speeds and slip" if part.blind else "slip against its target"
        return finished(figure, f"{shorten(name, 40)}: {what}")


def _said(axes: Axes, part: Drawn) -> None:
    """Draw what the pilot saw and aimed for, and where it made no correction."""
    control = part.control
    moving = np.interp(part.control_s, part.true_s, part.true_mps) >= PEAK_ABOVE_MPS
    seen = np.where(moving, control["slip_ratio"], np.nan)
    for values, colour, label, width, style in (
        (seen, ORANGE, "estimated, largest wheel", 1.0, "-"),
        (control["target_ratio"], GREEN, "target", 1.8, "-"),
        (part.aimed, INK, "aimed for", 1.0, "--"),
        (control["balance_ratio"], FAINT_INK, "balance of steady motion", 1.2, ":"),
    ):
        if np.isfinite(values).any():
            _line(axes, part.control_s, values, colour, label, width, style)
    why = control["status_code"]
    refused = why != 0
    if refused.any():
        reasons = [word for code, word in enumerate(STATUS_NAMES) if code and (why == code).any()]
        axes.fill_between(
            part.control_s,
            0.955,
            1.0,
            where=_touching(refused),
            transform=axes.get_xaxis_transform(),
            color=INK,
            lw=0,
            zorder=4,
            label=f"no correction: {', '.join(reasons)}",
        )


def _shade(axes: Axes, part: Drawn, named: bool) -> None:
    """Shade where a speed was held back or a braking was on; what is steady stays white."""
    state = part.control["drive_state_ratio"]
    for code, colour, hatch, label in (
        (TRACTION, RISING_COLOUR, None, "traction: speed rises"),
        (BRAKING, BRAKING_COLOUR, "////", "braking"),
    ):
        if (state == code).any():
            axes.fill_between(
                part.control_s,
                0.0,
                1.0,
                where=_touching(state == code),
                transform=axes.get_xaxis_transform(),
                facecolor=colour,
                edgecolor=HATCH_COLOUR,
                hatch=hatch,
                lw=0,
                zorder=0,
                label=label if named else None,
            )


def _touching(marked: Array) -> Array:
    """Return the mask with the sample after each stretch, so that one of a single sample is drawn, too."""
    after = marked.copy()
    after[1:] |= marked[:-1]
    return after


def ground_strips(
    run: RunLog, part: Drawn, table: SlipTable
) -> list[tuple[str, list[tuple[float, float, str]]]]:
    """Return the true and, where one was believed, the believed ground over time; nothing on one ground."""
    if len(run.terrains) < 2:
        return []
    strips = [("true", [(label.start_s, label.end_s, label.terrain) for label in run.labels])]
    names, index = tuple(table.targets), part.control["terrain_ratio"].astype(int)
    if (index >= 0).any():
        first = np.flatnonzero(np.diff(index, prepend=index[0] - 1))
        ends = [*part.control_s[first[1:]].tolist(), float(part.control_s[-1])]
        strips.append(
            (
                "believed",
                [
                    (float(part.control_s[i]), end, names[index[i]])
                    for i, end in zip(first, ends, strict=True)
                    if index[i] >= 0
                ],
            )
        )
    return strips


def _strips(axes: Axes, strips: Sequence[tuple[str, list[tuple[float, float, str]]]], time_s: Array) -> None:
    names = sorted({name for _, pieces in strips for *_, name in pieces})
    length_s = time_s[-1] - time_s[0]
    for row, (_, pieces) in enumerate(strips):
        for start_s, end_s, name in pieces:
            place = names.index(name)
            axes.broken_barh(
                [(start_s, end_s - start_s)],
                (row - 0.44, 0.88),
                facecolor=CLASS_COLOURS[place % len(CLASS_COLOURS)],
                alpha=0.55,
                hatch="..." if place >= len(CLASS_COLOURS) else None,
                edgecolor="white",
                lw=0.6,
            )
            letters = int(140 * (end_s - start_s) / length_s)
            if end_s - start_s >= LEAST_NAME_SHARE * length_s:
                axes.text(
                    (start_s + end_s) / 2, row, shorten(name, max(letters, 3)), ha="center", va="center",
                    fontsize=6.5, clip_on=True,
                )  # fmt: skip
    axes.set_yticks(range(len(strips)), [f"{name} ground" for name, _ in strips], fontsize=8)
    axes.set_ylim(len(strips) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)


def _line(
    axes: Axes, time_s: Array, values: Array, colour: str, label: str, width: float, style: str = "-"
) -> None:
    every = _every(time_s)
    axes.plot(time_s[::every], values[::every], color=colour, label=label, lw=width, ls=style)


def _every(time_s: Array) -> int:
    return max(1, math.ceil(len(time_s) / MAX_POINTS))


def table_figure(table: SlipTable) -> Figure:
    """Draw the curves that a table holds: the law, its peak, the resistance and the targets on it.

    What was measured is not in a table; ``terrain learn-slip --figures`` draws the curves with it.
    """
    n_rows = math.ceil(len(table.curves) / COLUMNS)
    with styled():
        figure = new_figure(10.0, 0.9 + 2.2 * n_rows)
        panels = figure.subplots(n_rows, COLUMNS, squeeze=False, sharex=True)
        for axes, terrain in zip(panels.ravel(), table.curves, strict=False):
            _curve(axes, table, terrain)
        for axes in panels.ravel()[len(table.curves) :]:
            axes.set_axis_off()
        for number in range(max(0, len(table.curves) - COLUMNS), len(table.curves)):
            panels.ravel()[number].set_xlabel("slip ratio")
            panels.ravel()[number].tick_params(labelbottom=True)
        for axes in panels[:, 0]:
            axes.set_ylabel("thrust over load")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, fontsize=7.5, frameon=False, ncols=4, loc="outside lower center")
        return finished(figure, f'Slip curves of the table "{shorten(table.name, 40)}"')


def _curve(axes: Axes, table: SlipTable, terrain: str) -> None:
    curve = table.curves[terrain]
    parameters = [curve.parameters[name] for name in LAW_PARAMETERS[curve.law]]

    def thrust(slips: Any) -> Array:
        return traction_ratio(curve.law, parameters, np.atleast_1d(np.asarray(slips, dtype=float)))

    axes.axvspan(*curve.peak_interval_ratio, color=VERMILION, alpha=0.12, lw=0, label="peak slip, 90 %")
    seen, beyond = np.linspace(*curve.slip_range_ratio, 100), np.linspace(curve.slip_range_ratio[1], 1.0, 50)
    axes.plot(seen, thrust(seen), color=BLUE, lw=1.6, label="law, in the slips seen")
    axes.plot(beyond, thrust(beyond), color=BLUE, lw=0.9, ls=":", label="beyond")
    axes.axhline(curve.resistance_ratio, color=INK, lw=0.8, ls="--", label="resistance")
    axes.plot(
        [curve.peak_slip_ratio],
        thrust(curve.peak_slip_ratio),
        "^",
        color=VERMILION,
        ms=6,
        label="peak of the net pull, or 95 % of it",
    )
    for state, marker in (("traction", "D"), ("steady", "s")):
        slip = table.targets[terrain][state].slip_ratio
        axes.plot([slip], thrust(slip), marker, color=GREEN, ms=5, label=f"target, {state}")
    top = min(
        max(0.1, float(thrust(np.linspace(0.0, 1.0, 101)).max()), curve.resistance_ratio), LARGEST_RATIO
    )
    axes.set(xlim=(-0.03, 1.0), ylim=(-0.04 * top, 1.14 * top))
    axes.grid(color=GRID)
    axes.set_title(
        f"{shorten(terrain, 20)}: {LAW_NAMES[curve.law]}, {curve.n_runs} runs",
        loc="left",
        fontsize=8,
        color=INK,
    )
