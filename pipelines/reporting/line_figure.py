"""A figure of lines over time, with its legend above the axes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import finished, new_figure, styled
from terrain.records import Array


class Line(NamedTuple):
    """A line of a figure: times (n,) in s, values (n,), colour and label."""

    time_s: Array
    values: Array
    colour: str
    label: str


def lines_figure(
    title: str,
    y_label: str,
    lines: Sequence[Line],
    draw_background: Callable[[Axes], object] | None = None,
) -> Figure:
    """Draw lines over time, on top of what ``draw_background`` draws."""
    with styled():
        figure = new_figure(8.4, 3.8)
        axes = figure.add_subplot()
        if draw_background is not None:
            draw_background(axes)
        for line in lines:
            axes.plot(line.time_s, line.values, color=line.colour, lw=1.2, label=line.label)
        axes.set(xlabel="time [s]", ylabel=y_label)
        add_legend(axes)
        return finished(figure, title)


def add_legend(axes: Axes) -> None:
    """Add a grid, and a legend above the axes."""
    axes.grid()
    axes.legend(ncols=4, fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), borderpad=0)
