"""``terrain reproduce``: a paper's experiments rerun in simulation, its figures beside ours, on one page.

A paper is a module with a table ``EXPERIMENTS`` of :class:`Experiment`; each gives rows and pictures.
Nothing here knows of a particular paper but the table :data:`PAPERS`.
"""

from __future__ import annotations

import base64
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from html import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.files.descriptions import read_yaml
from terrain.files.resources import data_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

    from pipelines.reporting.progress import Progress

Result = Mapping[str, Any]


class Paper(NamedTuple):
    """A paper that can be reproduced: what it is, where its experiments are, and what they are driven with.

    ``descriptions`` are files under ``data/`` (kind and name) whose assumed numbers the page lists.
    """

    title: str
    about: str
    module: str
    descriptions: tuple[tuple[str, str], ...]


PAPERS: Mapping[str, Paper] = {
    "danzi": Paper(
        title="Danzi, AgriMaRo thesis",
        about=(
            "D. Danzi, Development of a terrain-aware omnidirectional robotic platform for enhanced mobility "
            "in agricultural fields, Politecnico di Torino, 2025-2026"
        ),
        module="pipelines.reproduce.danzi.experiments",
        descriptions=(
            ("robots", "agrimaro"),
            ("soils", "tiles"),
            ("soils", "grass"),
            ("soils", "firm_soil_gravel"),
        ),
    ),
}
"""Papers by the name that the command takes."""

VERDICTS: Mapping[str, str] = {
    "as printed": "ours agrees with what the paper prints",
    "differs": "ours does not; the row says what is known of the reason",
    "corrected": "the paper prints an error, which the row names; ours is the right form",
    "assumed": "ours agrees, but rests on numbers that were fitted to this very figure: no independent check",
    "not printed": "the paper has no figure for it; ours stands by itself",
}
"""What can come of a comparison."""

MAX_SVG_BYTES = 500_000
"""A figure that needs more as lines goes on the page as points."""

SAME = 1e-9
"""Relative difference that is rounding."""


@dataclass(frozen=True, slots=True)
class Row:
    """One thing that a paper measures or claims, and what it is here.

    Parameters
    ----------
    what : was measured
    where : section, equation or figure of the paper
    printed : the paper's figure, or its claim in our words
    ours : the number
    unit : of all numbers of the row
    verdict : one of :data:`VERDICTS`
    why : a sentence
    printed_interval : (low, high) of the paper's figure where it is one number (twice) or an interval
    spread : (low, high) of ours over the runs, where there were several
    beside : what else was measured with it, by name

    Raises
    ------
    ValueError
        if a text is empty, a number not finite, an interval the wrong way round, or the verdict unknown.
    """

    what: str
    where: str
    printed: str
    ours: float
    unit: str
    verdict: str
    why: str
    printed_interval: tuple[float, float] | None = None
    spread: tuple[float, float] | None = None
    beside: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("what", "where", "printed", "unit", "why"):
            if not getattr(self, name).strip():
                raise ValueError(f"row {self.what!r}: {name} is empty")
        if self.verdict not in VERDICTS:
            raise ValueError(f"row {self.what!r}: verdict {self.verdict!r} is none of {', '.join(VERDICTS)}")
        intervals = [pair for pair in (self.printed_interval, self.spread) if pair is not None]
        if any(low > high for low, high in intervals):
            raise ValueError(f"row {self.what!r}: an interval of {intervals} ends before it starts")
        numbers = [self.ours, *self.beside.values(), *(end for pair in intervals for end in pair)]
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError(f"row {self.what!r}: {numbers} are not all finite")


class Picture(NamedTuple):
    """A figure with what to see in it."""

    caption: str
    figure: Figure


class Finding(NamedTuple):
    """What an experiment gave."""

    rows: Sequence[Row]
    pictures: Sequence[Picture] = ()


class Experiment(NamedTuple):
    """``run(seed, quick)`` does the work; ``quick`` takes fewer and shorter runs and changes nothing else."""

    title: str
    run: Callable[[int, bool], Finding]


def verdict_of(ours: float, printed: tuple[float, float], spread: tuple[float, float] | None = None) -> str:
    """Return ``as printed`` or ``differs``.

    Parameters
    ----------
    ours : a number, over several runs their mean
    printed : the paper's interval, or its one number twice
    spread : of ours over several runs

    Notes
    -----
    An interval holds ours or does not.  One printed number comes of one run: it agrees if it might have been
    one of ours, within their spread.  Without a spread it has to be ours.

    Examples
    --------
    >>> verdict_of(0.118, (0.116, 0.135)), verdict_of(0.2, (0.3, 0.3), spread=(0.1, 0.31))
    ('as printed', 'as printed')
    >>> verdict_of(0.141, (0.116, 0.135), spread=(0.12, 0.15)), verdict_of(0.2, (0.3, 0.3))
    ('differs', 'differs')
    """
    low, high = printed
    value = ours
    if low == high and spread is not None:
        value, (low, high) = low, spread
    slack = SAME * max(abs(low), abs(high))
    return "as printed" if low - slack <= value <= high + slack else "differs"


def holds(claim: bool) -> str:
    """Return the verdict on a claim that is no number.

    Examples
    --------
    >>> holds(True), holds(False)
    ('as printed', 'differs')
    """
    return "as printed" if claim else "differs"


def equation_verdict(ours: float, right: float, printed: float) -> str:
    """Return the verdict on an equation whose right result is known: ``corrected`` where only ours gives it.

    Examples
    --------
    >>> equation_verdict(30.0, 30.0, -90.0), equation_verdict(30.0, 30.0, 30.0)
    ('corrected', 'as printed')
    >>> equation_verdict(1.0, 2.0, 3.0)
    'differs'
    """
    if verdict_of(ours, (printed, printed)) == "as printed":
        return "as printed"
    return "corrected" if verdict_of(ours, (right, right)) == "as printed" else "differs"


def reproduce(
    paper: str,
    out: Path,
    seed: int = 0,
    progress: Progress | None = None,
    *,
    quick: bool = False,
) -> dict[str, Any]:
    """Rerun a paper's experiments and write the page ``<paper>.html``.

    Parameters
    ----------
    paper : one of :data:`PAPERS`
    out : folder of the page
    seed : of all runs
    progress : told of each experiment done
    quick : fewer and shorter runs, to try it out

    Returns
    -------
    dict that JSON can hold
        ``paper, title, about, seed, quick, rows`` (each a :class:`Row` with its ``experiment``), ``verdicts``
        (how many of each), ``assumed`` (numbers without a source of their own), ``command``, ``report``

    Raises
    ------
    ConfigError
        if there is no such paper.
    TerrainError
        if the folder cannot be written.
    """
    if paper not in PAPERS:
        raise ConfigError(f"there is no paper {paper!r} to reproduce; there are {', '.join(PAPERS)}")
    known = PAPERS[paper]
    ensure_writable(out)
    experiments: Sequence[Experiment] = import_module(known.module).EXPERIMENTS
    rows: list[dict[str, Any]] = []
    pictures: list[Picture] = []
    for done, experiment in enumerate(experiments):
        found = experiment.run(seed, quick)
        rows += [{"experiment": experiment.title, **_as_json(row)} for row in found.rows]
        pictures += found.pictures
        if progress is not None:
            progress(f"reproduce {paper}", done + 1, len(experiments))
    counts = Counter(row["verdict"] for row in rows)
    page = out / f"{paper}.html"
    result = {
        "paper": paper,
        "title": known.title,
        "about": known.about,
        "seed": seed,
        "quick": quick,
        "rows": rows,
        "verdicts": {verdict: counts[verdict] for verdict in VERDICTS},
        "assumed": assumed_numbers(known.descriptions),
        "command": f"terrain reproduce {paper} --seed {seed}",
        "report": str(page),
    }
    atomic_write(page, html_page(result, pictures))
    return result


def _as_json(row: Row) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(row).items()}


def assumed_numbers(descriptions: Iterable[tuple[str, str]]) -> list[dict[str, Any]]:
    """Return every number of the descriptions that was assumed or fitted, as their sources say themselves.

    Examples
    --------
    >>> assumed_numbers([("soils", "asphalt")])[-1]["file"]
    'soils/asphalt.yaml'
    """
    found = []
    for kind, name in descriptions:
        file = f"{kind}/{name}.yaml"
        for key, entry in _entries(read_yaml(data_folder(kind) / f"{name}.yaml")):
            source = str(entry.get("source", ""))
            if "value" in entry and any(word in source for word in ("assumed", "identified")):
                found.append(
                    {
                        "file": file,
                        "name": key,
                        "value": entry["value"],
                        "unit": entry["unit"],
                        "source": source,
                    }
                )
    return found


def _entries(described: Any, place: str = "") -> Iterable[tuple[str, dict[str, Any]]]:
    """Yield, by their dotted names, the mappings of a description that hold no further ones with a value."""
    for key, value in described.items():
        if isinstance(value, dict) and "value" in value:
            yield f"{place}{key}", value
        elif isinstance(value, dict):
            yield from _entries(value, f"{place}{key}.")


def print_reproduction(result: Result, console: Console) -> None:
    """Print the paper's figures beside ours, how the comparisons came out, and where the page is."""
    from rich.table import Table

    table = Table("", "paper", "ours", "verdict", title=f"{result['title']}, in simulation")
    title = None
    for row in result["rows"]:
        if row["experiment"] != title:
            title = row["experiment"]
            table.add_section()
        ours = f"{said(row['ours'])}{_unit(row)}{_range(row)}"
        table.add_row(f"{row['what']} ({row['where']})", row["printed"], ours, row["verdict"])
    console.print(table)
    console.print(_counted(result["verdicts"]), highlight=False)
    console.print(f"report: {result['report']}", highlight=False)


def html_page(result: Result, pictures: Sequence[Picture]) -> str:
    """Return the page: the comparisons first, then figures, what is assumed, and how to make it again.

    Parameters
    ----------
    result : what :func:`reproduce` returns
    pictures : figures in their order
    """
    from pipelines.reporting.page import page

    title = f"{result['title']}: its experiments in simulation"
    sections = [
        _headline(result),
        _comparisons(result["rows"]),
        _figures(pictures),
        _assumed(result["assumed"]),
        _again(result),
    ]
    return page("Reproduced in simulation", result["title"], title, escape(result["about"]), sections)


def _headline(result: Result) -> str:
    cards = "".join(
        f'<div class="card"><dt>{escape(verdict)}</dt><dd>{count}</dd>'
        f"<p>{escape(VERDICTS[verdict])}</p></div>"
        for verdict, count in result["verdicts"].items()
        if count
    )
    quick = "" if not result["quick"] else " <b>Made with few and short runs, to try it out.</b>"
    return f"""<section class="headline" aria-label="Headline">
<p class="words">{len(result["rows"])} figures and claims of the paper, measured again on simulated runs.</p>
<p>The robot and the ground are models: where ours agrees, the method does what the paper says on a robot like
this; it does not show that the paper's robot did.{quick}</p>
<dl class="cards">{cards}</dl></section>"""


def _comparisons(rows: Sequence[Result]) -> str:
    head = "".join(
        f'<th scope=col class="text">{name}</th>' for name in ("measured", "in the paper", "ours", "verdict")
    )
    body = []
    title = None
    for row in rows:
        if row["experiment"] != title:
            title = row["experiment"]
            body.append(f'<tr><th scope=rowgroup colspan=4 class="text"><h3>{escape(title)}</h3></th></tr>')
        beside = "".join(
            f'<br><span class="small">{escape(name)}: {said(value)}</span>'
            for name, value in row["beside"].items()
        )
        weak = ' class="weak"' if row["verdict"] == "differs" else ""
        body.append(
            f"<tr{weak}><th scope=row>{escape(row['what'])}</th>"
            f'<td class="text long">{escape(row["printed"])}<br>'
            f'<span class="small">{escape(row["where"])}</span></td>'
            f'<td class="text long"><b>{said(row["ours"])}</b>{escape(_unit(row))}{_range(row)}'
            f"{beside}</td>"
            f'<td class="text long"><b>{escape(row["verdict"])}</b><br>'
            f'<span class="small">{escape(row["why"])}</span></td></tr>'
        )
    table = f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody>"
    return f"""<section><h2>The paper's figure beside ours</h2>
<div class="scroll"><table>{table}</table></div>
<p class="small">Ours is the mean over several runs where a range is given, which is theirs.  A printed
interval agrees where it holds ours; a single printed number, of one run, where it lies in the range of
ours.</p></section>"""


def _figures(pictures: Sequence[Picture]) -> str:
    from pipelines.reporting.drawing import png_bytes, svg_text

    if not pictures:
        return ""
    drawn = []
    for number, picture in enumerate(pictures, 1):
        caption = escape(picture.caption)
        content, kind = svg_text(picture.figure).encode(), "svg+xml"
        if len(content) > MAX_SVG_BYTES:
            content, kind = png_bytes(picture.figure), "png"
        source = base64.b64encode(content).decode()
        drawn.append(
            f'<figure class="wide"><img src="data:image/{kind};base64,{source}" alt="{caption}">'
            f"<figcaption><b>Figure {number}.</b> {caption}</figcaption></figure>"
        )
    return f'<section><h2>Figures</h2><div class="figures">{"".join(drawn)}</div></section>'


def _assumed(numbers: Sequence[Result]) -> str:
    rows = "".join(
        f"<tr><th scope=row>{escape(number['name'])}</th><td>{said(number['value'])}</td>"
        f'<td class="text">{escape(number["unit"])}</td><td class="text">{escape(number["file"])}</td>'
        f'<td class="text long">{escape(number["source"])}</td></tr>'
        for number in numbers
    )
    head = '<th scope=col class="text">number</th><th scope=col>value</th>' + "".join(
        f'<th scope=col class="text">{name}</th>' for name in ("unit", "file", "source")
    )
    return f"""<section class="dense"><h2>What is assumed</h2>
<p>{len(numbers)} numbers that the simulation needs are not the paper's, nor anybody's measurement of this
robot.  Another robot has others, and ours changes with them.</p>
<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div></section>"""


def _again(result: Result) -> str:
    from pipelines.reporting.versions import versions

    packages = ", ".join(f"{name} {number}" for name, number in versions().items())
    return f"""<section><h2>To make this page again</h2><pre>{escape(result["command"])}</pre>
<p class="small">Seed {result["seed"]}; {escape(packages)}.</p></section>"""


def _unit(row: Result) -> str:
    return "" if row["unit"] == "ratio" else f" {row['unit']}"


def _range(row: Result) -> str:
    if row["spread"] is None:
        return ""
    low, high = row["spread"]
    return f" ({said(low)} to {said(high)})"


def _counted(verdicts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items() if count)


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def said(number: float) -> str:
    """Return a number as pages show it, with three digits.

    Examples
    --------
    >>> said(0.12648), said(3.81e-4), said(7e-6), said(-2.0), said(4096.0)
    ('0.126', '3.81·10⁻⁴', '7·10⁻⁶', '−2', '4096')
    """
    if number == 0:
        return "0"
    if not 1e-3 <= abs(number) < 1e5:
        digits, _, power = f"{number:.2e}".partition("e")
        text = f"{float(digits):g}·10{str(int(power)).translate(_RAISED)}"
    else:
        text = f"{number:.3g}" if abs(number) < 1000 else f"{number:.0f}"
    return text.replace("-", "\N{MINUS SIGN}")
