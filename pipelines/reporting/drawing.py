"""How pictures are drawn: one style, one layout, the same bytes for the same figure.

Figures are made with the object-oriented interface and an own style, so that nothing global is changed and
a user's matplotlib settings do not show.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager

import matplotlib.style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

PNG_DPI = 160
TITLE_LETTERS_AN_INCH = 11

INK = "#1f2933"
FAINT_INK = "#66717d"
GRID = "#dde2e7"
BLUE = "#0072b2"
VERMILION = "#d55e00"
BARE = {"facecolor": "white", "edgecolor": "none", "pad": 0.7}
"""Behind a text that would else be crossed by lines of the grid."""
CLASS_COLOURS = (BLUE, "#e69f00", "#009e73", "#cc79a7", "#56b4e9", VERMILION, "#8c8c8c")
"""Okabe and Ito (2008), without black and yellow, and grey: distinguishable for colour-blind readers, too."""
_, ORANGE, GREEN, PINK, SKY, _, GREY = CLASS_COLOURS

LAW_NAMES = {"janosi": "Janosi and Hanamoto", "magic": "Magic Formula"}
"""Of the laws of thrust over slip."""

LARGEST_THRUST_RATIO = 1.3
"""Thrust over load up to which curves are drawn."""

STYLE = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT_INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "text.color": INK,
    "text.parse_math": False,
    "text.hinting": "none",
    "xtick.color": FAINT_INK,
    "ytick.color": FAINT_INK,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "svg.fonttype": "path",
    "svg.hashsalt": "terrain",
    "path.simplify": False,
}
"""Names of runs are drawn as they are: a dollar sign in one starts no formula.  Without hinting a text is
as wide in one resolution as in another, so that a layout made for one fits the other."""


def png_bytes(figure: Figure, dpi: int = PNG_DPI) -> bytes:
    """Return a figure as PNG: the same bytes for the same figure, with no date and no version inside."""
    with styled():
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=dpi, metadata={"Software": None})
    return file.getvalue()


def svg_text(figure: Figure) -> str:
    """Return a figure as SVG: the same text for the same figure; letters are drawn, no font is needed."""
    with styled():
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue().decode()


@contextmanager
def styled() -> Iterator[None]:
    """Draw in the house style."""
    with matplotlib.style.context(["default", STYLE]):
        yield


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure of that size in inches, laid out by constraints."""
    figure = Figure(
        figsize=(width_in, height_in), dpi=PNG_DPI, layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.05)
    )
    FigureCanvasAgg(figure)
    return figure


def finished(figure: Figure, title: str) -> Figure:
    """Title a figure and fix its layout, so that every later rendering has the same one."""
    width = int(TITLE_LETTERS_AN_INCH * figure.get_figwidth())
    figure.suptitle(textwrap.fill(title, width), x=0.015, ha="left", fontsize=10.5, fontweight="bold")
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    return figure
