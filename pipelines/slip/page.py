"""The page of ``terrain learn-slip``: what was learned of each terrain, and the curves behind it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from matplotlib.figure import Figure

from pipelines.reporting.drawing import png_bytes
from pipelines.reporting.page import page
from terrain.control.slip_table import DRIVE_STATES, SlipTable

HEADINGS = ("terrain", "status", "runs", "slips seen", "peak", "90 %", *DRIVE_STATES, "why")


def slip_page(
    rows: Mapping[str, Mapping[str, Any]], figures: Mapping[str, Figure], table: SlipTable, n_runs: int
) -> str:
    """Return the page.

    Parameters
    ----------
    rows : by terrain, as ``terrain learn-slip --json`` has them
    figures : by name, in the order in which they are shown
    table : that was learned
    n_runs : behind it
    """
    fallback = ", ".join(
        f"{state} {target.slip_ratio:+.3f}" for state, target in table.targets[table.fallback].items()
    )
    sections = [
        f"<section><h2>Targets</h2>{_table(rows)}"
        "<p>* No peak within the slips seen: the slip at 95 % of the largest net pull seen. Traction is the "
        "lesser of nine tenths of the peak and the slip that gives the working pull; steady is where thrust "
        f"balances the resistance. For ground that nobody knows: {escape(fallback)}.</p></section>",
        *(
            f"<section><h2>{escape(name)}</h2>{_image(name, figure)}</section>"
            for name, figure in figures.items()
        ),
    ]
    lead = f"{escape(table.robot)} · {n_runs} runs · table {escape(table.name)}"
    return page(
        "Slip curves, learned", f"Slip of {table.robot}", f"Slip curves of {table.robot}", lead, sections
    )


def _table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in HEADINGS)
    body = "".join(f"<tr>{_cells(terrain, row)}</tr>" for terrain, row in rows.items())
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cells(terrain: str, row: Mapping[str, Any]) -> str:
    peak = row["peak_slip"]
    starred = "*" if row["peak_status"] == "no_peak" else ""
    cells = [
        terrain,
        row["status"],
        str(row["n_runs"]),
        _interval(row["slip_range"], "{:.2f}"),
        "-" if peak is None else f"{peak:.3f}{starred}",
        _interval(row["peak_slip_ci"], "{:.3f}"),
        *(f"{row['targets'][state]['slip_ratio']:+.3f}" for state in DRIVE_STATES),
        row["reason"] or row["targets"]["traction"]["source"],
    ]
    return "".join(f"<td>{escape(str(cell))}</td>" for cell in cells)


def _interval(edges: Sequence[float] | None, form: str) -> str:
    return "-" if edges is None else " to ".join(form.format(edge) for edge in edges)


def _image(name: str, figure: Figure) -> str:
    data = base64.b64encode(png_bytes(figure)).decode()
    image = f'<img alt="{escape(name, quote=True)}" src="data:image/png;base64,{data}">'
    return f'<figure class="wide">{image}</figure>'
