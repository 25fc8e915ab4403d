"""One self-contained HTML page of sensor faults: the table, all figures, and drawn drives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from pipelines.faults.drives import FaultInputs, Place, drive_case, drive_references
from pipelines.faults.figures import fault_figure
from pipelines.faults.results import SHORT_BARS, FaultCase, FaultsResult, duration_text
from pipelines.faults.tables import FIGURES, details, names_sensors, overview, situation_headings
from pipelines.reporting.drawing import png_bytes, svg_text
from pipelines.reporting.pictures import svg_or_png
from pipelines.reporting.progress import Progress, silent
from pipelines.reporting.templates import render
from pipelines.reporting.versions import versions
from terrain.files.atomic import atomic_write

PAGE, TEMPLATE = "faults.html", "faults/page.html.j2"

CAPTION = (
    "Above: desired and commanded speed, speed over ground and its estimate. Below: slip, and its estimate. "
    "Yellow: the fault acts. Bar: green where the status is OK, black where no correction is made."
)


def fault_drawings(
    inputs: FaultInputs, cases: Sequence[FaultCase], progress: Progress = silent
) -> dict[str, Figure]:
    """Return the figures of drives by name, each driven again."""
    figures = {}
    for done, case in enumerate(cases, start=1):
        references = drive_references(inputs, Place(case.situation, case.terrain, case.seed))
        length = duration_text(case.duration_s).replace(" ", "_")
        name = f"{case.fault}_{length}_{case.situation}_{Path(case.terrain).stem}"
        figures[name] = fault_figure(case, drive_case(inputs, case), references)
        progress("draw", done, len(cases))
    return figures


def faults_page(result: FaultsResult, figures: dict[str, Figure]) -> str:
    """Return the page.

    Parameters
    ----------
    result : of all drives
    figures : of some of them, by name
    """
    images = [
        svg_or_png(figure, f"{name}: {CAPTION}", "As above." if i else CAPTION)
        for i, (name, figure) in enumerate(figures.items())
    ]
    return render(
        TEMPLATE,
        result=result,
        short_bars=SHORT_BARS,
        situations=list(situation_headings(result).values()),
        overview=overview(result),
        figure_names=list(FIGURES.values()),
        details=details(result),
        names_sensors=names_sensors(result),
        images=images,
        versions=", ".join(f"{name} {number}" for name, number in versions().items()),
    )


def write_faults_page(out: Path, result: FaultsResult, figures: dict[str, Figure]) -> Path:
    """Write ``faults.html`` and ``figures/*.png`` and ``.svg``, each whole or not at all; return the page.

    Raises
    ------
    TerrainError
        if the folder cannot be written.
    """
    for name, figure in figures.items():
        atomic_write(out / "figures" / f"{name}.png", png_bytes(figure))
        atomic_write(out / "figures" / f"{name}.svg", svg_text(figure))
    atomic_write(out / PAGE, faults_page(result, figures))
    return out / PAGE
