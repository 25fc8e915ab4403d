"""One self-contained HTML page that compares controllers: what they cost, and what they did."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from pipelines.drive.results import DriveResult
from pipelines.drive.view import drive_figures, drive_view
from pipelines.reporting.drawing import png_bytes, svg_text
from pipelines.reporting.templates import render
from terrain.control.slip_table import SlipTable
from terrain.files.atomic import atomic_write
from terrain.records import RunLog

PAGE, TEMPLATE = "drive.html", "drive/page.html.j2"


def drive_page(result: DriveResult, examples: Mapping[str, RunLog], table: SlipTable) -> str:
    """Return the page.

    Parameters
    ----------
    result : of all controllers
    examples : the drive of each controller at the first seed, with the streams ``truth`` and ``control``
    table : target slips of the drives
    """
    return render(TEMPLATE, view=drive_view(result, drive_figures(result, examples, table)))


def write_drive_page(
    out: Path, result: DriveResult, examples: Mapping[str, RunLog], table: SlipTable
) -> Path:
    """Write ``drive.html`` and ``figures/*.png`` and ``.svg``, each whole or not at all; return the page.

    Raises
    ------
    TerrainError
        if the folder cannot be written.
    """
    figures = drive_figures(result, examples, table)
    for name, figure in figures.items():
        stem = re.sub(r"[^\w.-]", "_", name)
        atomic_write(out / "figures" / f"{stem}.png", png_bytes(figure))
        atomic_write(out / "figures" / f"{stem}.svg", svg_text(figure))
    atomic_write(out / PAGE, render(TEMPLATE, view=drive_view(result, figures)))
    return out / PAGE
