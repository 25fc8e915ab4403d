"""Figures of the experiments: points with their spread and lines over any abscissa."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import finished, new_figure, styled
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
    """Draw panels beside each other, with one legend below them."""
    rows = -(-len(panels) // columns)
    with styled():
        figure = new_figure(8.4, 3.2 * rows + 0.5)
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        labelled: dict[str, Artist] = {}
        for axes, panel in zip(grid, panels, strict=False):
            for mark in panel.marks:
                drawn = _draw(axes, mark)
                if mark.label:
                    labelled.setdefault(mark.label, drawn)
            axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
            axes.set_title(panel.title, loc="left", fontsize=9)
            if panel.equal:
                axes.set_aspect("equal", adjustable="datalim")
            axes.grid(visible=True)
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        figure.legend(
            labelled.values(), labelled.keys(), loc="outside lower left", ncols=6, fontsize=8, frameon=False
        )
        return finished(figure, title)


def _draw(axes: Axes, mark: Mark) -> Artist:
    if mark.spread is not None:
        bars = axes.errorbar(mark.x, mark.y, mark.spread, fmt="o", color=mark.colour, ms=4, capsize=2.5)
        return bars.lines[0]
    if not mark.joined:
        return axes.scatter(mark.x, mark.y, s=4, color=mark.colour)
    return axes.plot(mark.x, mark.y, color=mark.colour, lw=1.3, ls="--" if mark.dashed else "-")[0]
