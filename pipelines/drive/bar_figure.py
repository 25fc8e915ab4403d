"""Figure of metrics as bars: one small chart per metric, one bar per controller."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pipelines.reporting.drawing import (
    BLUE,
    FAINT_INK,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PINK,
    SKY,
    VERMILION,
    finished,
    new_figure,
    styled,
)
from pipelines.reporting.numbers import NOT_KNOWN, format_number, shorten
from terrain.control.comparison import MeanInterval

COLOURS = {
    "plain": GREY,
    "ramp": ORANGE,
    "thesis": PINK,
    "fallback": SKY,
    "classified": BLUE,
    "true_terrain": GREEN,
}
"""Of the controllers; all others are vermilion."""

COLUMNS = 3
LONGEST = 2.0
"""Intervals are drawn up to this multiple of the longest bar."""


class Panel(NamedTuple):
    """A metric of all controllers: its name with its unit, and each mean with its interval."""

    name: str
    values: Mapping[str, MeanInterval]


def bars_figure(panels: Sequence[Panel], n_seeds: int) -> Figure:
    """Draw a chart per metric, a bar per controller, with its 95 % interval and its number beside it."""
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
        one = "One seed, which gives no interval"
        return finished(figure, one if n_seeds == 1 else f"Mean and 95 % interval over {n_seeds} seeds")


def _bars(axes: Axes, panel: Panel, named: bool) -> None:
    means = [value.mean for value in panel.values.values() if value.mean is not None]
    ends = [end for value in panel.values.values() for end in value.ci or ()]
    low, high = min([0.0, *means]), max([0.0, *means])
    # an interval of few seeds may be wider than the picture: it is cut off, the table has it
    high = min(max([high, *ends]), max(LONGEST * high, high - low)) or 1.0
    low = max(min([low, *ends]), -LONGEST * abs(low))
    room = high - low
    axes.set_xlim(low - (0.04 * room if low < 0.0 else 0.0), high + 0.2 * room)
    for row, (name, (mean, interval, _)) in enumerate(panel.values.items()):
        if mean is None:
            axes.text(0.0, row, f"  {NOT_KNOWN}", va="center", fontsize=9)
            continue
        axes.barh(row, mean, height=0.68, color=COLOURS.get(name, VERMILION))
        if interval is not None:
            shown = np.clip(interval, low, high)
            axes.plot(shown, [row, row], color=INK, lw=1.2, marker="|", ms=5, mew=1.2, solid_capstyle="butt")
        axes.text(
            1.0,
            row,
            format_number(mean),
            transform=axes.get_yaxis_transform(),
            ha="right",
            va="center",
            fontsize=7.5,
        )
    axes.set_ylim(len(panel.values) - 0.4, -0.6)
    axes.set_yticks(range(len(panel.values)), [shorten(name, 18) for name in panel.values] if named else [])
    axes.tick_params(axis="y", length=0)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.spines["left"].set_visible(False)
    axes.axvline(0.0, color=FAINT_INK, lw=0.8)
    axes.grid(axis="x")
    axes.set_title(panel.name, loc="left", fontsize=8.5)
