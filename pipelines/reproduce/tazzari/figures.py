"""Figures with two panels: circle and straight motion side by side, as in the paper's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import finished, new_figure, styled
from pipelines.reporting.line_figure import Line, add_legend


class Panel(NamedTuple):
    """Lines over a common axis; its labels, and whether both axes have one scale."""

    x_label: str
    y_label: str
    lines: Sequence[Line]
    square: bool = False
    draw_background: Callable[[Axes], object] | None = None


def panels_figure(title: str, panels: Sequence[Panel], height_in: float = 3.6) -> Figure:
    """Draw panels side by side."""
    with styled():
        figure = new_figure(8.4, height_in)
        for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            if panel.draw_background is not None:
                panel.draw_background(axes)
            for line in panel.lines:
                axes.plot(line.time_s, line.values, color=line.colour, lw=1.1, label=line.label)
            axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
            if panel.square:
                axes.set_aspect("equal", adjustable="datalim")
            add_legend(axes)
        return finished(figure, title)
