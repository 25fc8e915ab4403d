"""The support table of a model card: every terrain in every regime of driving."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rich.table import Table
from rich.text import Text

from pipelines.reporting.numbers import NOT_KNOWN, percent, shorten
from pipelines.reporting.terminal import compact_table
from pipelines.support.results import SupportReport

NO_WINDOW = "none"
"""Shown where a terrain was never driven in a regime: a word among numbers."""

MAX_HEADING = 18


class SupportCell(NamedTuple):
    """Runs and windows of a terrain in a regime; ``accuracy`` when held out, None where not known."""

    terrain: str
    n_runs: int
    n_windows: int
    accuracy: float | None

    @property
    def text(self) -> str:
        """The cell in a table.

        Examples
        --------
        >>> SupportCell("ice", 3, 42, 0.931).text, SupportCell("ice", 0, 0, None).text
        ('3/42 93%', 'none')
        """
        if not self.n_windows:
            return NO_WINDOW
        known = NOT_KNOWN if self.accuracy is None else percent(self.accuracy, 0)
        return f"{self.n_runs}/{self.n_windows} {known}"


class RegimeRow(NamedTuple):
    """A regime of driving, and its cells in the order of the terrains."""

    regime: str
    cells: tuple[SupportCell, ...]


def regime_rows(found: SupportReport | None) -> tuple[RegimeRow, ...]:
    """Return the table of a report, slow regimes first; empty where how the robot moved is not known."""
    rows: dict[str, list[SupportCell]] = {}
    for row in () if found is None else found.rows:
        cell = SupportCell(row.terrain, row.n_runs, row.windows, row.accuracy)
        rows.setdefault(row.regime, []).append(cell)
    return tuple(RegimeRow(regime, tuple(cells)) for regime, cells in rows.items())


def rows_of_card(card: Mapping[str, Any]) -> tuple[RegimeRow, ...]:
    """Return the table that a card holds; empty of cards of earlier releases."""
    return tuple(
        RegimeRow(str(row["regime"]), tuple(SupportCell(**cell) for cell in row["cells"]))
        for row in card.get("support", ())
    )


def support_tables(rows: Sequence[RegimeRow], width: int) -> Iterator[Table]:
    """Yield the table for a terminal, in as many parts as its width (characters) asks for."""
    if not rows:
        return
    regime_width = max(len(row.regime) for row in rows)
    start = 0
    while start < len(rows[0].cells):
        end, left = start, width - regime_width - 3
        while end < len(rows[0].cells) and (end == start or left >= _column_width(rows, end)):
            left -= _column_width(rows, end)
            end += 1
        yield _table(rows, start, end)
        start = end


def _column_width(rows: Sequence[RegimeRow], column: int) -> int:
    heading = min(len(rows[0].cells[column].terrain), MAX_HEADING)
    return max(heading, *(len(row.cells[column].text) for row in rows)) + 2


def _table(rows: Sequence[RegimeRow], start: int, end: int) -> Table:
    names = [shorten(cell.terrain, MAX_HEADING) for cell in rows[0].cells[start:end]]
    title = "support: runs/windows, and accuracy when held out"
    table = compact_table("driving", *names, title=title)
    for row in rows:
        cells = [Text(each.text, "" if each.n_windows else "bold red") for each in row.cells[start:end]]
        table.add_row(Text(row.regime), *cells)
    return table
