"""Figures of the experiments: points with their spread and lines over any abscissa."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from pipelines.reporting.drawing import finished, new_figure, styled
from pipelines.reporting.line_figure import add_legend
from terrain.records import Array


class Mark(NamedTuple):
    """Points (n,) or a line through them, of one colour and label; ``spread`` (n,) is drawn as bars."""

    x: Array
    y: Array
    colour: str
    label: str
    spread: Array | None = None
    joined: bool = True
    dashed: bool = False


class Panel(NamedTuple):
    """A set of axes: what stands above it, names of the axes, and marks."""

    title: str
    x_label: str
    y_label: str
    marks: Sequence[Mark]
    equal: bool = False


def panels_figure(title: str, panels: Sequence[Panel], columns: int = 2) -> Figure:
    """Draw panels beside each other; the legend is that of the first."""
    rows = -(-len(panels) // columns)
    with styled():
        figure = new_figure(8.4, 3.5 * rows + 0.2)
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for number, (axes, panel) in enumerate(zip(grid, panels, strict=False)):
            for mark in panel.marks:
                style = ("--" if mark.dashed else "-") if mark.joined else "none"
                if mark.spread is None:
                    marker = "none" if mark.joined else "o"
                    axes.plot(
                        mark.x,
                        mark.y,
                        style,
                        color=mark.colour,
                        label=mark.label,
                        marker=marker,
                        ms=2.5,
                        lw=1.3,
                    )
                else:
                    axes.errorbar(
                        mark.x,
                        mark.y,
                        np.asarray(mark.spread),
                        fmt="o",
                        color=mark.colour,
                        label=mark.label,
                        ms=4,
                        capsize=2.5,
                    )
            axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
            if panel.title:
                axes.set_title(panel.title, loc="right", fontsize=8.5, pad=18 if number == 0 else 4)
            if panel.equal:
                axes.set_aspect("equal", adjustable="datalim")
            if number == 0:
                add_legend(axes)
            axes.grid(visible=True)
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        return finished(figure, title)
