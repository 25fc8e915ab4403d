"""A report as one HTML file, whose figures zoom; as a fragment with pictures, for notebooks; and as Markdown.

All that a report holds is escaped: names from files may hold any sign.  The page needs no network: style and
scripts are inside it.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from pipelines.report.figure import Figure
from pipelines.report.numbers import plain_line
from pipelines.report.results import as_json
from pipelines.report.tree import Part, Report, Section, Table

ASSETS = Path(__file__).parent / "assets"
DIGITS = 6  #: Significant digits of what a figure draws: more than can be seen

MARKDOWN = "parts.md.j2"
_SPECIAL = re.compile(r"([\\`*_{}\[\]<>|#~&!])")
_ADDRESS = re.compile(r"(https?|ftp)(?=://)", re.IGNORECASE)

MAX_POINTS = 2000  #: More points of a line than this are more than a page can show
MAX_SVG_BYTES = 300_000  #: A figure of a fragment that needs more as lines becomes points


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("pipelines.report", "templates"),
        autoescape=select_autoescape(["html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["markdown"] = escape_markdown
    environment.globals |= {"sections": _sections, "shade": _shade}
    return environment


def html_page(report: Report) -> str:
    """Return the report as one page.

    Examples
    --------
    >>> page = html_page(Report("Runs of <ice>", "All are right."))
    >>> "<h1>Runs of &lt;ice&gt;</h1>" in page, "<script" in page
    (True, False)
    """
    figures: list[Figure] = []

    def picture(figure: Figure) -> Markup:
        figures.append(figure)
        holder = Markup('<div class="plot" role="img" aria-label="{}" data-figure="{}"></div>')
        return holder.format(figure.caption or figure.title, len(figures) - 1)

    body = _body(report, picture)
    data = json.dumps(figure_data(figures), separators=(",", ":"), allow_nan=False)
    page = _environment().get_template("page.html.j2")
    return page.render(
        title=report.title,
        body=body,
        style=Markup(_asset("report.css") + (_asset("uplot.css") if figures else "")),
        figures=Markup(data.replace("<", "\\u003c")) if figures else "",
        scripts=Markup(_asset("uplot.js") + _asset("report.js")),
    )


def html_fragment(report: Report) -> str:
    """Return the report as a part of a page: figures are pictures, and nothing runs."""

    def picture(figure: Figure) -> Markup:
        from pipelines.report.drawing import figure_png, figure_svg

        svg = figure_svg(figure).encode()
        kind, content = ("svg+xml", svg) if len(svg) <= MAX_SVG_BYTES else ("png", figure_png(figure))
        source = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
        return Markup('<img src="{}" alt="{}">').format(source, figure.caption or figure.title)

    return f'<div class="terrain-report">{_body(report, picture)}</div>'


def _body(report: Report, picture: Callable[[Figure], Markup]) -> Markup:
    parts = _environment().get_template("parts.html.j2").make_module({"picture": picture})
    body: Markup = parts.body(report)  # type: ignore[attr-defined]
    return body


def escape_markdown(text: str) -> str:
    r"""Return a text that Markdown shows as it is, on one line.

    Examples
    --------
    >>> print(escape_markdown("DIRT_ROAD | <b>\n# one"))
    DIRT\_ROAD \| \<b\>\\n\# one
    """
    return _ADDRESS.sub(r"\1\\", _SPECIAL.sub(r"\\\1", plain_line(text)))


def markdown_text(report: Report) -> str:
    """Return a report as Markdown, as a model card has it; details are folded, figures are left to pages.

    Examples
    --------
    >>> print(markdown_text(Report("Runs", "All are right.", lead="18 runs")))
    # Runs
    <BLANKLINE>
    **All are right.**
    <BLANKLINE>
    18 runs
    <BLANKLINE>
    """
    return _markdown("body", report) + "\n"


def markdown_table(table: Table) -> str:
    r"""Return the table alone.

    Examples
    --------
    >>> print(markdown_table(Table(("run", "windows"), [("a|b", 3)])))
    | run | windows |
    |---|---:|
    | a\|b | 3 |
    """
    return _markdown("table", table)


def _markdown(macro: str, part: Report | Table) -> str:
    text: str = getattr(_environment().get_template(MARKDOWN).module, macro)(part)
    return text.rstrip("\n")


def figure_data(figures: Sequence[Figure]) -> Any:
    """Return what the page's script draws: what is not finite is None, and no more points and digits than are seen.

    Examples
    --------
    >>> from pipelines.report.figure import Line, Panel
    >>> figure = Figure("Speed", [Panel([Line("measured", [0, 1], [0.123456789, math.nan])], "m/s")])
    >>> figure_data([figure])[0]["panels"][0]["marks"][0]["y"]
    [0.123457, None]
    """
    data = as_json(figures)
    for mark in (mark for figure in data for panel in figure["panels"] for mark in panel["marks"]):
        if mark["kind"] in ("line", "points", "band"):
            every = max(1, len(mark["x"]) // MAX_POINTS)
            mark.update({key: mark[key][::every] for key in ("x", "y", "low", "high") if mark[key]})
    exact = json.dumps(data, allow_nan=False)
    return json.loads(exact, parse_float=lambda text: float(f"{float(text):.{DIGITS}g}"))


@cache
def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def _sections(parts: Sequence[Part]) -> list[Section]:
    """Return the parts as sections: what lies between two of them is one without a heading."""
    found: list[Section] = []
    for part in parts:
        if isinstance(part, Section):
            found.append(part)
        elif found and not found[-1].title:
            found[-1] = Section("", [*found[-1].parts, part])
        else:
            found.append(Section("", [part]))
    return found


def _shade(value: Any) -> str:
    """Return the background of a cell that holds a ratio."""
    known = isinstance(value, int | float) and math.isfinite(value)
    return f"background: rgb(0 114 178 / {min(max(float(value), 0.0), 1.0) * 0.6:.2f})" if known else ""
