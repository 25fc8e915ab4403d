"""Figures as PNG or SVG by matplotlib: one style, the same bytes for the same figure.

The object-oriented interface and an own style are used, so that nothing global is changed and a user's
settings do not show.
"""

from __future__ import annotations

import io
import textwrap
from collections import Counter
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Drawn
from matplotlib.layout_engine import ConstrainedLayoutEngine

from pipelines.report.figure import Figure, Mark, Panel
from pipelines.report.numbers import plain_line

PNG_DPI = 160
WIDTH_IN, PANEL_HEIGHT_IN, BAR_HEIGHT_IN, HEAD_IN = 8.4, 2.3, 0.26, 0.9
STRIP_HEIGHT_IN = 0.7
TITLE_LETTERS_AN_INCH = 11
LONGEST_NAME = 40  #: Letters of a category; of a longer name the middle is left out

INK = "#1f2933"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#e69f00", "#cc79a7", "#56b4e9", "#8c8c8c")
"""Okabe and Ito (2008), without black and yellow, and grey: distinguishable for colour-blind readers, too."""

STYLE = Path(__file__).parent / "assets" / "report.mplstyle"


def figure_png(figure: Figure) -> bytes:
    """Return a figure as PNG: the same bytes for the same figure, with no date and no version inside."""
    return _saved(figure, format="png", dpi=PNG_DPI, metadata={"Software": None})


def figure_svg(figure: Figure) -> str:
    """Return a figure as SVG: the same text for the same figure; letters are drawn, no font is needed."""
    return _saved(figure, format="svg", metadata={"Date": None, "Creator": None}).decode()


def _saved(figure: Figure, **options: Any) -> bytes:
    with matplotlib.style.context(["default", STYLE]):
        file = io.BytesIO()
        draw(figure).savefig(file, **options)
    return file.getvalue()


def draw(figure: Figure) -> Drawn:
    """Return the figure as matplotlib has it: panels below one another, with the layout fixed."""
    heights = []
    for panel in figure.panels:
        kinds = Counter(mark.kind for mark in panel.marks)
        height = 4.5 if panel.equal else PANEL_HEIGHT_IN
        if kinds["bars"]:
            height = 0.6 + BAR_HEIGHT_IN * len(panel.marks[0].x) * max(1.0, 0.7 * kinds["bars"])
        elif set(kinds) == {"strip"}:
            height = STRIP_HEIGHT_IN
        heights.append(height)
    drawn = Drawn(
        figsize=(WIDTH_IN, sum(heights) + HEAD_IN),
        dpi=PNG_DPI,
        layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.05),
    )
    FigureCanvasAgg(drawn)
    grid = drawn.add_gridspec(len(heights), 1, height_ratios=heights)
    names: dict[str, int] = {}  # of intervals, in the order of their colours
    for i, panel in enumerate(figure.panels):
        axes = drawn.add_subplot(grid[i])
        _draw_panel(axes, panel, names)
        if i == len(heights) - 1 and figure.x_label and not panel.x_label:
            axes.set_xlabel(figure.x_label)
    title = textwrap.fill(plain_line(figure.title), int(TITLE_LETTERS_AN_INCH * WIDTH_IN))
    drawn.suptitle(title, x=0.015, ha="left", fontsize=10.5, fontweight="bold")
    drawn.draw_without_rendering()
    drawn.set_layout_engine("none")
    return drawn


def _draw_panel(axes: Axes, panel: Panel, names: dict[str, int]) -> None:
    n_bars = sum(mark.kind == "bars" for mark in panel.marks)
    for number, mark in enumerate(panel.marks):
        colour = COLOURS[(number if mark.colour is None else mark.colour) % len(COLOURS)]
        style: dict[str, Any] = {"color": colour, "label": plain_line(mark.label) or "_nolegend_"}
        if mark.kind == "strip":
            _draw_strip(axes, mark, names, thin=len(panel.marks) == 1)
            continue
        y, low, high = (np.asarray(each, float) for each in (mark.y, mark.low, mark.high))
        if mark.kind == "bars":
            height, places = 0.8 / n_bars, np.arange(len(mark.x))
            at = places + (number - 0.5 * (n_bars - 1)) * height
            axes.barh(at, y, height=0.9 * height, alpha=0.85, **style)
            if mark.low is not None:
                axes.hlines(at, low, high, color=INK, lw=1.0)
            axes.set_yticks(places, [shorten(plain_line(name), LONGEST_NAME) for name in mark.x])
            axes.set_ylim(len(places) - 0.4, -0.6)
            continue
        x = np.asarray(mark.x, float)
        if mark.kind == "line":
            axes.plot(x, y, lw=1.2, ls="--" if mark.dashed else "-", **style)
        elif mark.kind == "band":
            axes.fill_between(x, low, high, alpha=0.2, lw=0, **style)
        else:
            axes.plot(x, y, "o", ms=3.5, **style)
            if mark.low is not None:
                axes.vlines(x, low, high, color=colour, lw=1.0)
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
    if panel.title:
        axes.set_title(plain_line(panel.title), loc="left")
    if panel.x_range is not None:
        axes.set_xlim(*panel.x_range)
    if panel.y_range is not None:
        axes.set_ylim(*panel.y_range)
    if panel.log_x:
        axes.set_xscale("log")
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    axes.grid(axis="x" if n_bars else "both")
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) > 1 or (labels and not panel.y_label):
        legend = {"ncols": 4, "fontsize": 8, "frameon": False, "borderpad": 0}
        above = (0.0, 1.1 if panel.title else 1.0)
        axes.legend(handles, labels, loc="lower left", bbox_to_anchor=above, **legend)


def _draw_strip(axes: Axes, mark: Mark, names: dict[str, int], thin: bool) -> None:
    """Draw intervals in the colours of their names; where nothing else is drawn, without a vertical axis.

    Behind other marks the colours are taken from the last on, grey, which lines have last.
    """
    labelled: set[str] = set()
    for start, end, name in mark.x:
        number = names.setdefault(name, len(names)) % len(COLOURS)
        style: dict[str, Any] = {
            "color": COLOURS[number if thin else -1 - number],
            "alpha": 0.75 if thin else 0.18,
            "lw": 0,
        }
        axes.axvspan(start, end, **style)
        if name not in labelled:
            labelled.add(name)
            axes.fill_between([], [], label=plain_line(name), **style)
    if thin:
        axes.set_yticks([])


def shorten(text: str, width: int) -> str:
    """Cut the middle out of a text that is too long; both ends of an id carry information.

    Examples
    --------
    >>> shorten("2024-05-01_field_north_run_17", 16)
    '2024-05…h_run_17'
    """
    if len(text) <= width:
        return text
    tail = width // 2
    return f"{text[: width - tail - 1]}…{text[-tail:]}"
