"""Tables of ``terrain faults`` for terminal and page: cells as texts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from pipelines.faults.results import SHORT_BARS, FaultRow, FaultsResult, duration_text
from pipelines.reporting.numbers import NOT_KNOWN, format_known

MET = "met"

FIGURES: dict[str, str] = {
    "ok_total_s": "OK while acting, s",
    "ok_longest_s": "longest, s",
    "not_ok_s": "held back, s",
    "slip_error_ratio": "error of slip",
    "slip_peak_ratio": "peak of slip",
    "plain_slip_peak_ratio": "plain's",
    "stop_ratio": "stop, of plain's",
    "recovery_s": "recovery, s",
    "overspeed_s": "above desired, s",
    "n_exceptions": "exceptions",
    "n_not_finite": "not finite",
}
"""Figures in the table of all rows, and their headings."""


class OverviewRow(NamedTuple):
    """A fault: its name, what it does, its nature, a cell a situation, and the sensors that were named."""

    fault: str
    about: str
    nature: str
    cells: tuple[str, ...]
    blamed: str


class DetailRow(NamedTuple):
    """A drive: its fault, where it was driven and for how long the fault acted, its figures and verdict."""

    fault: str
    place: str
    duration: str
    cells: tuple[str, ...]
    verdict: str
    blamed: str


def situation_headings(result: FaultsResult) -> dict[tuple[str, str], str]:
    """Return the heading of each situation on each terrain."""
    return {(one.situation, one.terrain): f"{one.situation} on {one.terrain}" for one in result.clean}


def names_sensors(result: FaultsResult) -> bool:
    """Return whether the controller states the health of its sensors."""
    return any(row.blamed is not None for row in result.rows)


def overview(result: FaultsResult) -> list[OverviewRow]:
    """Return a row a fault, over durations and seeds."""
    by_fault: dict[str, list[FaultRow]] = {}
    for row in result.rows:
        by_fault.setdefault(row.case.fault, []).append(row)
    table = []
    for fault, rows in by_fault.items():
        cells = [
            _cell([row for row in rows if (row.case.situation, row.case.terrain) == place])
            for place in situation_headings(result)
        ]
        about, nature = result.abouts[fault], rows[0].nature
        table.append(OverviewRow(fault, about, nature, tuple(cells), _blamed(rows)))
    return table


def details(result: FaultsResult) -> list[DetailRow]:
    """Return a row a drive, with all figures."""
    headings = situation_headings(result)
    seeds = len(result.seeds) > 1
    return [
        DetailRow(
            row.case.fault,
            headings[row.case.situation, row.case.terrain] + (f", seed {row.case.seed}" if seeds else ""),
            duration_text(row.case.duration_s),
            tuple(format_known(getattr(row.figures, name), "{:.3g}", NOT_KNOWN) for name in FIGURES),
            _short(row.unmet) or MET,
            _blamed([row]),
        )
        for row in result.rows
    ]


def _cell(rows: Sequence[FaultRow]) -> str:
    unmet = [row for row in rows if row.unmet]
    if not unmet:
        return MET if rows else NOT_KNOWN
    text = _short(name for name in SHORT_BARS if any(name in row.unmet for row in unmet))
    return text if len(unmet) == len(rows) else f"{text} ({len(unmet)} of {len(rows)})"


def _short(names: Iterable[str]) -> str:
    return " ".join(SHORT_BARS[name] for name in names)


def _blamed(rows: Sequence[FaultRow]) -> str:
    """Return the sensors that were named in any row, those with the same statuses together."""
    named: dict[str, set[str]] = {}
    for row in rows:
        for sensor, statuses in (row.blamed or {}).items():
            named.setdefault(sensor, set()).update(statuses.split(", "))
    together: dict[str, list[str]] = {}
    for sensor in sorted(named):
        together.setdefault(", ".join(sorted(named[sensor])), []).append(sensor)
    return "; ".join(f"{', '.join(sensors)}: {statuses}" for statuses, sensors in together.items())
