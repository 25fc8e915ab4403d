"""Pictures of learned slip curves: what runs showed, the law through it, its peak and the targets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import (
    BLUE,
    CLASS_COLOURS,
    FAINT_INK,
    INK,
    VERMILION,
    finished,
    new_figure,
    shorten,
    styled,
)
from terrain.slip_learning.slip_curve import traction_ratio

if TYPE_CHECKING:
    from pipelines.slip.learn_slip import Learned

LAW_NAMES = {"janosi": "Janosi and Hanamoto", "magic": "Magic Formula"}
GREEN = CLASS_COLOURS[2]
SHEET_COLUMNS = 2
LARGEST_RATIO = 1.3


def curve_figures(learned: Sequence[Learned], robot: str) -> dict[str, Figure]:
    """Return a figure a terrain, by its name, and ``all_terrains`` with all of them on a sheet."""
    figures = {entry.terrain: curve_figure(entry, robot) for entry in learned}
    if learned:
        figures["all_terrains"] = sheet(learned, robot)
    return figures


def curve_figure(entry: Learned, robot: str) -> Figure:
    """Draw one terrain: bins of each run, the law with its 90 % band, peak, resistance and targets."""
    with styled():
        figure = new_figure(8.4, 4.8)
        axes = figure.subplots()
        draw_curve(axes, entry)
        axes.set_xlabel("slip ratio")
        axes.set_ylabel("thrust over load")
        axes.legend(fontsize=7.5, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return finished(figure, f"{shorten(entry.terrain, 40)}, {robot}: {_headline(entry)}")


def sheet(learned: Sequence[Learned], robot: str) -> Figure:
    """Draw all terrains beside each other, with the same slip axis."""
    n_rows = math.ceil(len(learned) / SHEET_COLUMNS)
    with styled():
        figure = new_figure(10.0, 0.8 + 3.0 * n_rows)
        panels = np.atleast_1d(figure.subplots(n_rows, SHEET_COLUMNS, squeeze=False)).ravel()
        for axes, entry in zip(panels, learned, strict=False):
            draw_curve(axes, entry)
            axes.set_title(
                f"{shorten(entry.terrain, 24)}\n{_headline(entry)}", loc="left", fontsize=8, color=INK
            )
        for axes in panels[len(learned) :]:
            axes.set_axis_off()
        for axes in panels[max(0, len(learned) - SHEET_COLUMNS) : len(learned)]:
            axes.set_xlabel("slip ratio")
        for axes in panels[: len(learned) : SHEET_COLUMNS]:
            axes.set_ylabel("thrust over load")
        handles, labels = panels[0].get_legend_handles_labels()
        for axes in panels[1 : len(learned)]:
            more = [
                pair for pair in zip(*axes.get_legend_handles_labels(), strict=True) if pair[1] not in labels
            ]
            handles, labels = handles + [h for h, _ in more], labels + [name for _, name in more]
        figure.legend(handles, labels, fontsize=7.5, frameon=False, ncols=4, loc="outside lower center")
        return finished(figure, f"slip curves of {robot}")


def draw_curve(axes: Axes, entry: Learned) -> None:
    """Draw what runs showed on one terrain, and what was learned of it."""
    for number, part in enumerate(entry.parts):
        bins = part.bins
        axes.errorbar(
            bins.slip_ratio,
            bins.traction_ratio,
            xerr=bins.slip_std,
            yerr=bins.traction_std,
            fmt="o",
            ms=2.6,
            lw=0.6,
            color=FAINT_INK,
            alpha=0.55,
            label=None if number else "bins of each run, ± 1 std",
        )
    shown = [value for part in entry.parts for value in part.bins.traction_ratio]
    if entry.curve is not None:
        _draw_law(axes, entry)
        shown += [entry.curve.resistance_ratio, float(entry.curve.band[:, 2].max())]
    low, high = min([0.0, *shown]), min(max([0.1, *shown]), LARGEST_RATIO)
    axes.set_ylim(low - 0.08 * (high - low), high + 0.12 * (high - low))
    axes.set_xlim(-0.03, 1.0)
    axes.grid()


def _draw_law(axes: Axes, entry: Learned) -> None:
    curve = entry.curve
    assert curve is not None
    slips = curve.band[:, 0]
    axes.fill_between(
        slips, curve.band[:, 1], curve.band[:, 2], color=BLUE, alpha=0.2, lw=0, label="90 % over runs"
    )
    axes.plot(
        slips,
        traction_ratio(curve.law, curve.parameters, slips),
        color=BLUE,
        lw=1.6,
        label="law, in the slips seen",
    )
    beyond = np.linspace(curve.slip_range[1], 1.0, 50)
    axes.plot(
        beyond,
        traction_ratio(curve.law, curve.parameters, beyond),
        color=BLUE,
        lw=0.9,
        ls=":",
        label="beyond",
    )
    axes.axhline(curve.resistance_ratio, color=INK, lw=0.8, ls="--", label="resistance")
    axes.axvspan(*curve.peak_interval, color=VERMILION, alpha=0.12, lw=0, label="peak slip, 90 %")
    peak = curve.peak.slip_ratio
    axes.plot(
        [peak],
        traction_ratio(curve.law, curve.parameters, np.array([peak])),
        "^",
        color=VERMILION,
        ms=7,
        label="peak of the net pull, or 95 % of it",
    )
    if entry.targets is not None:
        for state, marker in (("traction", "D"), ("steady", "s")):
            slip = getattr(entry.targets, state).slip_ratio
            axes.plot(
                [slip],
                traction_ratio(curve.law, curve.parameters, np.array([slip])),
                marker,
                color=GREEN,
                ms=5.5,
                label=f"target, {state}",
            )


def _headline(entry: Learned) -> str:
    if entry.curve is None:
        return f"{entry.status}, {entry.reason}"
    curve = entry.curve
    low, high = curve.peak_interval
    words = "peak" if curve.peak.status == "peak" else "no peak, 95 %"
    tail = f", {entry.reason}" if entry.reason else ""
    return (
        f"{LAW_NAMES[curve.law]}, {words} at {curve.peak.slip_ratio:.3f} ({low:.3f} to {high:.3f}), "
        f"{curve.n_runs} runs{tail}"
    )
