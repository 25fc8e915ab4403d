"""What the scripts of all papers share: claims read from YAML, their numbers, verdicts, and the report.

A paper is a module and a YAML file of the same name.  The YAML holds its experiments and claims: what was
measured, where the paper says so, what it prints, and the rule by which the verdict is found.  The module has a
function for each experiment that gives the numbers; no text and no printed value stands in it.

A claim with a list ``each`` stands for a row an entry; all texts may name values, ``{speed:g} m/s``, and
``{variance!n}`` is a number as reports show it.  A rule is a verdict and an expression over ``simulated``,
``low`` and ``high`` of the spread, the values of the row, and :func:`agrees`; the first that is true holds,
else what stands at ``else``, which is ``differs`` unless given.
"""

from __future__ import annotations

import math
import string
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.files.documents import read_yaml
from terrain.files.names import data_folder

if TYPE_CHECKING:
    from pipelines.report.figure import Figure
    from pipelines.report.tree import Report

SAME = 1e-9
"""Relative difference up to which two numbers are equal but for rounding."""


class Verdict(StrEnum):
    """Result of a comparison."""

    AS_PRINTED = "as printed"
    DIFFERS = "differs"
    CORRECTED = "corrected"
    ASSUMED = "assumed"
    NOT_PRINTED = "not printed"


MEANINGS: Mapping[Verdict, str] = {
    Verdict.AS_PRINTED: "the simulation agrees with what the paper prints",
    Verdict.DIFFERS: "the simulation does not agree; the row states the reason as far as it is known",
    Verdict.CORRECTED: "the paper prints an error, which the row names; the result here is by the right form",
    Verdict.ASSUMED: "the simulation agrees, but depends on parameters that were fitted to this figure: not "
    "an independent check",
    Verdict.NOT_PRINTED: "the paper has no figure for it",
}


class Numbers(NamedTuple):
    """The numbers of a row.

    Parameters
    ----------
    simulated : the number, over several runs their mean
    spread : (low, high) over the runs, where there were several
    beside : related numbers, by name
    values : that texts and the rule of the claim name
    """

    simulated: float
    spread: tuple[float, float] | None = None
    beside: Mapping[str, float] = {}
    values: Mapping[str, Any] = {}

    @classmethod
    def over(cls, runs: Sequence[float], beside: Mapping[str, float] | None = None, **values: Any) -> Numbers:
        """Return the mean over runs and their range.

        Examples
        --------
        >>> Numbers.over([1.0, 2.0, 6.0])[:2]
        (3.0, (1.0, 6.0))
        """
        return cls(float(np.mean(runs)), (float(np.min(runs)), float(np.max(runs))), beside or {}, values)


class Finding(NamedTuple):
    """Numbers by the name of their claim, in a list where the claim stands for several; figures by name."""

    numbers: Mapping[str, Numbers | Sequence[Numbers]]
    figures: Mapping[str, Figure] = {}


class Trial(NamedTuple):
    """What an experiment is given: the seed, whether runs are few and short, and the claims' lists ``each``."""

    seed: int
    quick: bool
    each: Mapping[str, Sequence[Mapping[str, Any]]]


Experiment = Callable[[Trial], Finding]


@dataclass(frozen=True, slots=True)
class Row:
    """One quantity that a paper measures or claims, and its value in simulation.

    Raises
    ------
    ValueError
        if a text is empty, a number not finite, or an interval ends before it starts.
    """

    experiment: str
    what: str
    where: str
    printed: str
    simulated: float
    unit: str
    verdict: Verdict
    why: str
    printed_interval: tuple[float, float] | None = None
    spread: tuple[float, float] | None = None
    beside: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("what", "where", "printed", "unit", "why"):
            if not getattr(self, name).strip():
                raise ValueError(f"row {self.what!r}: {name} is empty")
        intervals = [pair for pair in (self.printed_interval, self.spread) if pair is not None]
        if any(low > high for low, high in intervals):
            raise ValueError(f"row {self.what!r}: an interval of {intervals} ends before it starts")
        numbers = [self.simulated, *self.beside.values(), *(end for pair in intervals for end in pair)]
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError(f"row {self.what!r}: {numbers} are not all finite")


class AssumedNumber(NamedTuple):
    """A number of a description that is neither printed in the paper nor measured."""

    file: str
    name: str
    value: float
    unit: str
    source: str


@dataclass(frozen=True, slots=True)
class Reproduction:
    """A paper's experiments in simulation; ``figures`` are not part of the JSON."""

    paper: str
    title: str
    about: str
    seed: int
    quick: bool
    rows: tuple[Row, ...]
    verdicts: Mapping[Verdict, int]
    assumed: tuple[AssumedNumber, ...]
    command: str
    figures: tuple[Figure, ...] = ()


def agrees(
    simulated: float, printed: tuple[float, float] | None, spread: tuple[float, float] | None = None
) -> bool:
    """Return whether a number agrees with a printed one.

    Parameters
    ----------
    simulated : a number, over several runs their mean
    printed : the paper's interval, or its one number twice
    spread : of the simulation over several runs

    Notes
    -----
    A printed interval has to contain the mean.  A single printed number is of one run: it agrees if it lies
    within the spread of the simulated runs.  Without a spread the two have to be equal.

    Examples
    --------
    >>> agrees(0.118, (0.116, 0.135)), agrees(0.2, (0.3, 0.3), spread=(0.1, 0.31))
    (True, True)
    >>> agrees(0.141, (0.116, 0.135), spread=(0.12, 0.15)), agrees(0.2, (0.3, 0.3))
    (False, False)
    """
    assert printed is not None
    (low, high), value = printed, simulated
    if low == high and spread is not None:
        value, (low, high) = low, spread
    slack = SAME * max(abs(low), abs(high))
    return low - slack <= value <= high + slack


class _Texts(string.Formatter):
    def convert_field(self, value: Any, conversion: Any) -> Any:
        if conversion != "n":
            return super().convert_field(value, conversion)
        from pipelines.report.numbers import format_value

        return format_value(value)


def verdict_by(rule: str | Mapping[str, str], names: Mapping[str, Any]) -> Verdict:
    """Return the verdict of a rule.

    Examples
    --------
    >>> str(verdict_by({"as printed": "simulated > 2", "else": "corrected"}, {"simulated": 1.0}))
    'corrected'
    >>> str(verdict_by("not printed", {})), str(verdict_by({"corrected": "x < 0"}, {"x": 1}))
    ('not printed', 'differs')
    """
    if isinstance(rule, str):
        return Verdict(rule)
    for name, expression in rule.items():
        if name != "else" and _value(expression, names):
            return Verdict(name)
    return Verdict(rule.get("else", "differs"))


def _value(expression: Any, names: Mapping[str, Any]) -> Any:
    """Return the value of an expression of a paper's own file; a number is itself."""
    if not isinstance(expression, str):
        return expression
    known = {"agrees": agrees, "abs": abs, "min": min, "max": max, "round": round}
    return eval(expression, {"__builtins__": {}}, {**known, **names})


def rows_of(experiment: str, claims: Mapping[str, Any], found: Finding) -> list[Row]:
    """Return the rows of an experiment, claim by claim."""
    rows = []
    if set(claims) != set(found.numbers):
        raise ValueError(f"{experiment}: claims and numbers differ: {set(claims) ^ set(found.numbers)}")
    for name, claim in claims.items():
        numbers = found.numbers[name]
        each = claim.get("each", [{}])
        listed = [numbers] if isinstance(numbers, Numbers) else list(numbers)
        for given, one in zip(each, listed, strict=True):
            rows.append(_row(experiment, claim, given, one))
    return rows


def _row(experiment: str, claim: Mapping[str, Any], given: Mapping[str, Any], numbers: Numbers) -> Row:
    named = {**claim, **given}
    names = {**given, **numbers.values, "simulated": numbers.simulated, "spread": numbers.spread}
    names["low"], names["high"] = numbers.spread or (numbers.simulated, numbers.simulated)
    interval = named.get("interval")
    if interval is not None:
        low, high = interval if isinstance(interval, list) else (interval, interval)
        interval = (float(_value(low, names)), float(_value(high, names)))
    names["printed"] = interval
    texts = {key: _Texts().format(str(named[key]), **names) for key in ("what", "where", "printed", "why")}
    return Row(
        experiment,
        simulated=numbers.simulated,
        unit=named["unit"],
        verdict=verdict_by(named["verdict"], names),
        printed_interval=interval,
        spread=numbers.spread,
        beside=dict(numbers.beside),
        **texts,
    )


def reproduce(
    paper: str,
    seed: int = 0,
    progress: Callable[[str, int, int], object] = lambda *_: None,
    *,
    quick: bool = False,
    only: Sequence[str] | None = None,
) -> Reproduction:
    """Rerun a paper's experiments.

    Parameters
    ----------
    paper : name of its module and its YAML file
    seed : of all runs
    progress : called after each experiment
    quick : fewer and shorter runs, to try it out
    only : names of the functions of some of the experiments

    Raises
    ------
    ConfigError
        if there is no such paper.
    """
    folder = Path(__file__).parent
    papers = sorted(file.stem for file in folder.glob("*.yaml"))
    if paper not in papers:
        raise ConfigError(f"there is no paper {paper!r} to reproduce; there are {', '.join(papers)}")
    from importlib import import_module

    described = read_yaml(folder / f"{paper}.yaml")
    module = import_module(f"{__package__}.{paper}" if __package__ else paper)
    chosen = [each for each in described["experiments"] if only is None or each["run"] in only]
    rows: list[Row] = []
    figures: list[Figure] = []
    for done, each in enumerate(chosen):
        lists = {name: claim.get("each", ()) for name, claim in each["claims"].items()}
        found = getattr(module, each["run"])(Trial(seed, quick, lists))
        rows += rows_of(each["title"], each["claims"], found)
        figures += [replace(figure, caption=each["figures"][name]) for name, figure in found.figures.items()]
        progress(f"reproduce {paper}", done + 1, len(chosen))
    counts = Counter(row.verdict for row in rows)
    return Reproduction(
        paper=paper,
        title=described["title"],
        about=described["about"],
        seed=seed,
        quick=quick,
        rows=tuple(rows),
        verdicts={verdict: counts[verdict] for verdict in Verdict},
        assumed=assumed_numbers(described["descriptions"]),
        command=f"python examples/papers {paper} --seed {seed}",
        figures=tuple(figures),
    )


def assumed_numbers(descriptions: Iterable[str]) -> tuple[AssumedNumber, ...]:
    """Return every number of descriptions ``KIND/NAME`` that was assumed or fitted, by its own source.

    Examples
    --------
    >>> assumed_numbers(["soils/asphalt"])[-1].file
    'soils/asphalt.yaml'
    """
    found = []
    for described in descriptions:
        kind, _, name = described.partition("/")
        for key, entry in _entries(read_yaml(data_folder(kind) / f"{name}.yaml")):
            source = str(entry.get("source", ""))
            if "assumed" in source or "identified" in source:
                found.append(AssumedNumber(f"{described}.yaml", key, entry["value"], entry["unit"], source))
    return tuple(found)


def _entries(described: Any, place: str = "") -> Iterable[tuple[str, dict[str, Any]]]:
    """Yield, by their dotted names, the mappings of a description that hold no further ones with a value."""
    for key, value in described.items():
        if isinstance(value, dict) and "value" in value:
            yield f"{place}{key}", value
        elif isinstance(value, dict):
            yield from _entries(value, f"{place}{key}.")


def report_of(result: Reproduction) -> Report:
    """Return the report: the counts, the paper's figures beside the simulation's, then the reasons."""
    from pipelines.report.numbers import format_value
    from pipelines.report.tree import Column, Report, Section, Table, Text

    columns = (Column("measured", long=True), Column("in the paper", long=True), "in simulation", "verdict")
    tables, reasons = [], []
    for title in dict.fromkeys(row.experiment for row in result.rows):
        rows = [row for row in result.rows if row.experiment == title]
        tables.append(
            Table(columns, tuple((r.what, r.printed, _shown(r), r.verdict.value) for r in rows), title=title)
        )
        lines = []
        for row in rows:
            beside = "; ".join(f"{name}: {format_value(value)}" for name, value in row.beside.items())
            lines.append((row.what, row.where, row.why, beside))
        named = ("measured", "where", Column("why", long=True), Column("beside", long=True))
        reasons.append(Table(named, tuple(lines), title=title))
    assumed = Table(("number", "value", "unit", "file", Column("source", long=True)),
        tuple((each.name, each.value, each.unit, each.file, each.source) for each in result.assumed),
    )  # fmt: skip
    counted = [f"{count} {verdict.value}" for verdict, count in result.verdicts.items() if count]
    few = " Made with few and short runs, to try it out." if result.quick else ""
    return Report(
        f"{result.title}, in simulation",
        f"{len(result.rows)} figures and claims of the paper, measured again on simulated runs: "
        f"{', '.join(counted)}.{few}",
        parts=(
            Table(
                ("verdict", "figures and claims", Column("which is", long=True)),
                [
                    (verdict.value, count, MEANINGS[verdict])
                    for verdict, count in result.verdicts.items()
                    if count
                ],
            ),
        ),
        details=(
            Section("The paper's figure beside the simulation's", (Text(_RANGES), *tables)),
            Section("Why", tuple(reasons)),
            Section("Figures", result.figures),
            Section("What is assumed", (Text(_ASSUMED), assumed)),
        ),
        lead=result.about,
        next_step=result.command,
    )


def _shown(row: Row) -> str:
    from pipelines.report.numbers import format_value

    unit = "" if row.unit == "ratio" else row.unit
    spread = "" if row.spread is None else f" ({format_value(row.spread)})"
    return f"{format_value(row.simulated)}{f' {unit}' if unit else ''}{spread}"


_RANGES = (
    "Robot and terrain are models: where the simulation agrees, the method does what the paper states on a "
    "robot like this; it does not show that the paper's robot did. A range is that of several runs, the figure "
    "before it their mean. A printed interval agrees if it contains that mean; a single printed number, of one "
    "run, if it lies in the range."
)
_ASSUMED = (
    "Numbers that the simulation needs and that are neither printed in the paper nor measured on this robot. "
    "They differ between robots, and the simulated figures depend on them."
)
