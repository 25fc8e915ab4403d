"""Reports: one tree of parts, three writers; and the settings and results of commands."""

from pipelines.report.numbers import (
    NOT_KNOWN,
    enumerated,
    format_counts,
    format_value,
    interval,
    plural,
    quantity,
    sentence,
    shorten,
)
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.tree import (
    Band,
    Bars,
    Card,
    Cards,
    Column,
    Figure,
    Line,
    Mark,
    Pairs,
    Panel,
    Part,
    Points,
    Report,
    Section,
    Strip,
    Table,
    Text,
)

__all__ = [
    "NOT_KNOWN",
    "Band",
    "Bars",
    "Card",
    "Cards",
    "Column",
    "Figure",
    "Line",
    "Mark",
    "Pairs",
    "Panel",
    "Part",
    "Points",
    "Progress",
    "Report",
    "Result",
    "Section",
    "Strip",
    "Table",
    "Text",
    "described",
    "enumerated",
    "figure_png",
    "figure_svg",
    "format_counts",
    "format_value",
    "html_page",
    "interval",
    "markdown_text",
    "plural",
    "quantity",
    "save_report",
    "sentence",
    "shorten",
    "silent",
]


def __getattr__(name: str) -> object:
    """Import a writer when it is asked for: help needs none."""
    from importlib import import_module

    writers = {
        "html_page": "html",
        "markdown_text": "markdown",
        "save_report": "writing",
        "figure_png": "drawing",
        "figure_svg": "drawing",
    }
    if name not in writers:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{writers[name]}"), name)
