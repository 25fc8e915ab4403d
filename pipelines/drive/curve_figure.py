"""Figure of the slip curves of a table: the law, its peak, the resistance, and the targets on it."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import (
    BLUE,
    GREEN,
    GRID,
    INK,
    LARGEST_THRUST_RATIO,
    LAW_NAMES,
    VERMILION,
    finished,
    new_figure,
    styled,
)
from pipelines.reporting.numbers import shorten
from terrain.control.slip_table import SlipTable
from terrain.records import Array
from terrain.slip_learning.laws import LAW_PARAMETERS, traction_ratio

COLUMNS = 3


def table_figure(table: SlipTable) -> Figure:
    """Draw the curves of a table, without measurements, which it does not hold.

    ``terrain learn-slip --figures`` draws the curves with the measurements.
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

    def thrust(slips: float | Array) -> Array:
        return traction_ratio(curve.law, parameters, np.atleast_1d(np.asarray(slips, dtype=float)))

    axes.axvspan(*curve.peak_interval_ratio, color=VERMILION, alpha=0.12, lw=0, label="peak slip, 90 %")
    measured, beyond = (
        np.linspace(*curve.slip_range_ratio, 100),
        np.linspace(curve.slip_range_ratio[1], 1.0, 50),
    )
    axes.plot(measured, thrust(measured), color=BLUE, lw=1.6, label="law, in the slips measured")
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
    largest = float(thrust(np.linspace(0.0, 1.0, 101)).max())
    top = min(max(0.1, largest, curve.resistance_ratio), LARGEST_THRUST_RATIO)
    axes.set(xlim=(-0.03, 1.0), ylim=(-0.04 * top, 1.14 * top))
    axes.grid(color=GRID)
    axes.set_title(
        f"{shorten(terrain, 20)}: {LAW_NAMES[curve.law]}, {curve.n_runs} runs",
        loc="left",
        fontsize=8,
        color=INK,
    )
