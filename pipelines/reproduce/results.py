"""Results of a reproduced paper: rows of comparison, figures, and the verdict on each row."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    Verdict.ASSUMED: "the simulation agrees, but depends on parameters that were fitted to this figure: "
    "not an independent check",
    Verdict.NOT_PRINTED: "the paper has no figure for it",
}


class Paper(NamedTuple):
    """A paper that can be reproduced.

    Parameters
    ----------
    title, about : of the paper
    module : with a table ``EXPERIMENTS`` of :class:`Experiment`
    descriptions : files under ``data/`` (kind and name) whose assumed numbers the page lists
    """

    title: str
    about: str
    module: str
    descriptions: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Row:
    """One quantity that a paper measures or claims, and its value in simulation.

    Parameters
    ----------
    what : the quantity
    where : section, equation or figure of the paper
    printed : the paper's figure, or its claim in words
    simulated : the number, over several runs their mean
    unit : of all numbers of the row
    verdict : on the comparison
    why : a sentence that explains the verdict
    printed_interval : (low, high) of the paper's figure where it is one number (twice) or an interval
    spread : (low, high) of the simulation over the runs, where there were several
    beside : related numbers, by name

    Raises
    ------
    ValueError
        if a text is empty, a number not finite, or an interval ends before it starts.
    """

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


class Picture(NamedTuple):
    """A figure and its caption."""

    caption: str
    figure: Figure


class Finding(NamedTuple):
    """Rows and figures of an experiment."""

    rows: Sequence[Row]
    pictures: Sequence[Picture] = ()


class Experiment(NamedTuple):
    """An experiment; ``run(seed, quick)`` returns its finding, ``quick`` makes runs fewer and shorter."""

    title: str
    run: Callable[[int, bool], Finding]


class AssumedNumber(NamedTuple):
    """A number of a description that is neither printed in the paper nor measured."""

    file: str
    name: str
    value: float
    unit: str
    source: str


class ExperimentRow(NamedTuple):
    """A row with the title of its experiment."""

    experiment: str
    row: Row

    def as_json(self) -> dict[str, object]:
        """Return the experiment beside the fields of the row."""
        return {"experiment": self.experiment} | {
            name: getattr(self.row, name) for name in self.row.__dataclass_fields__
        }


@dataclass(frozen=True, slots=True)
class Reproduction:
    """Result of ``terrain reproduce``; its fields are the keys of ``--json``.

    Parameters
    ----------
    paper, title, about : of the paper
    seed : of all runs
    quick : whether runs were few and short
    rows : in the order of the page
    verdicts : how many rows have each
    assumed : numbers without a source of their own
    command : that makes the page again
    report : the page
    """

    paper: str
    title: str
    about: str
    seed: int
    quick: bool
    rows: tuple[ExperimentRow, ...]
    verdicts: Mapping[Verdict, int]
    assumed: tuple[AssumedNumber, ...]
    command: str
    report: Path


def verdict_of(
    simulated: float, printed: tuple[float, float], spread: tuple[float, float] | None = None
) -> Verdict:
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
    >>> str(verdict_of(0.118, (0.116, 0.135))), str(verdict_of(0.2, (0.3, 0.3), spread=(0.1, 0.31)))
    ('as printed', 'as printed')
    >>> str(verdict_of(0.141, (0.116, 0.135), spread=(0.12, 0.15))), str(verdict_of(0.2, (0.3, 0.3)))
    ('differs', 'differs')
    """
    low, high = printed
    value = simulated
    if low == high and spread is not None:
        value, (low, high) = low, spread
    slack = SAME * max(abs(low), abs(high))
    return holds(low - slack <= value <= high + slack)


def holds(claim: bool) -> Verdict:
    """Return the verdict on a claim without a number.

    Examples
    --------
    >>> str(holds(True)), str(holds(False))
    ('as printed', 'differs')
    """
    return Verdict.AS_PRINTED if claim else Verdict.DIFFERS


def equation_verdict(simulated: float, right: float, printed: float) -> Verdict:
    """Return the verdict on an equation whose correct result is known.

    It is ``corrected`` where only the simulation gives the correct result.

    Examples
    --------
    >>> str(equation_verdict(30.0, 30.0, -90.0)), str(equation_verdict(30.0, 30.0, 30.0))
    ('corrected', 'as printed')
    >>> str(equation_verdict(1.0, 2.0, 3.0))
    'differs'
    """
    if verdict_of(simulated, (printed, printed)) is Verdict.AS_PRINTED:
        return Verdict.AS_PRINTED
    right_here = verdict_of(simulated, (right, right)) is Verdict.AS_PRINTED
    return Verdict.CORRECTED if right_here else Verdict.DIFFERS
