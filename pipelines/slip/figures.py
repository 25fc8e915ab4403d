"""Figures of learned slip curves: bins of the runs, the fitted law, its peak and the targets."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import (
    BLUE,
    FAINT_INK,
    GREEN,
    INK,
    LARGEST_THRUST_RATIO,
    LAW_NAMES,
    VERMILION,
    finished,
    new_figure,
    styled,
)
from pipelines.reporting.numbers import shorten
from terrain.slip_learning.learn import LearnedTerrain
from terrain.slip_learning.peak import PeakStatus

SHEET_COLUMNS = 2


def curve_figures(learned: Sequence[LearnedTerrain], robot: str) -> dict[str, Figure]:
    """Return a figure a terrain, by its name, and ``all_terrains`` with all of them on a sheet."""
    figures = {entry.terrain: curve_figure(entry, robot) for entry in learned}
    if learned:
        figures["all_terrains"] = sheet(learned, robot)
    return figures


def curve_figure(entry: LearnedTerrain, robot: str) -> Figure:
    """Draw one terrain: bins of each run, the law with its 90 % band, peak, resistance and targets."""
    with styled():
        figure = new_figure(8.4, 4.8)
        axes = figure.subplots()
        draw_curve(axes, entry)
        axes.set_xlabel("slip ratio")
        axes.set_ylabel("thrust over load")
        axes.legend(fontsize=7.5, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return finished(figure, f"{shorten(entry.terrain, 40)}, {robot}: {_headline(entry)}")


def sheet(learned: Sequence[LearnedTerrain], robot: str) -> Figure:
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


def draw_curve(axes: Axes, entry: LearnedTerrain) -> None:
    """Draw bins of the runs on one terrain, and its curve."""
    for number, run in enumerate(entry.runs):
        bins = run.bins
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
    shown = [value for run in entry.runs for value in run.bins.traction_ratio]
    if entry.curve is not None:
        _draw_law(axes, entry)
        shown += [entry.curve.resistance_ratio, float(entry.curve.band.high_ratio.max())]
    low, high = min([0.0, *shown]), min(max([0.1, *shown]), LARGEST_THRUST_RATIO)
    axes.set_ylim(low - 0.08 * (high - low), high + 0.12 * (high - low))
    axes.set_xlim(-0.03, 1.0)
    axes.grid()


def _draw_law(axes: Axes, entry: LearnedTerrain) -> None:
    curve = entry.curve
    assert curve is not None
    slips, low, high = curve.band
    axes.fill_between(slips, low, high, color=BLUE, alpha=0.2, lw=0, label="90 % over runs")
    axes.plot(
        slips,
        curve.thrust_ratio(slips),
        color=BLUE,
        lw=1.6,
        label="law, within the observed slips",
    )
    beyond = np.linspace(curve.slip_range[1], 1.0, 50)
    axes.plot(
        beyond,
        curve.thrust_ratio(beyond),
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
        curve.thrust_ratio(np.array([peak])),
        "^",
        color=VERMILION,
        ms=7,
        label="peak of net traction, or 95 % of it",
    )
    if entry.targets is not None:
        for state, marker in (("traction", "D"), ("steady", "s")):
            slip = entry.targets.of(state).slip_ratio
            axes.plot(
                [slip],
                curve.thrust_ratio(np.array([slip])),
                marker,
                color=GREEN,
                ms=5.5,
                label=f"target, {state}",
            )


def _headline(entry: LearnedTerrain) -> str:
    if entry.curve is None:
        return f"{entry.status}, {entry.reason}"
    curve = entry.curve
    low, high = curve.peak_interval
    kind = "peak" if curve.peak.status is PeakStatus.PEAK else "no peak, 95 %"
    tail = f", {entry.reason}" if entry.reason else ""
    return (
        f"{LAW_NAMES[curve.law]}, {kind} at {curve.peak.slip_ratio:.3f} ({low:.3f} to {high:.3f}), "
        f"{curve.n_runs} runs{tail}"
    )
