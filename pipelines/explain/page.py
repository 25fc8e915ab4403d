"""One self-contained HTML page of a diagnosis: figures first, then causes, gain, and detection limits."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from pipelines.explain.figures import dependence_figure, run_figure, spectra_figure, systematic_figure
from pipelines.explain.results import DiagnosedRuns, Explanation
from pipelines.explain.shown import STRETCH_S, ShownRun, example_stretch, shown_runs
from pipelines.explain.view import FigureView, RunPicture, page_view
from pipelines.reporting.drawing import png_bytes, svg_text
from pipelines.reporting.pictures import MAX_SVG_BYTES, png_image, svg_image
from pipelines.reporting.progress import Progress, silent
from pipelines.reporting.templates import render
from terrain.discrepancy.noise import Noise
from terrain.files.atomic import atomic_write

PAGE_FILE, PICTURES = "explain.html", "pictures"

MAX_EMBEDDED = 12
"""Figures of whole runs on the page itself; those of more runs lie beside it."""

RUN_DPI = 96
"""Resolution of figures of whole runs, of which there may be many on a page."""


class _Drawn(NamedTuple):
    """Heading and caption of a figure."""

    heading: str
    caption: str


DRAWN = {
    "stretch": _Drawn(
        "Measured against simulated",
        "Left: the measurement, and the prediction of the simulation from the logged wheels, steering and "
        "tilt. Right: the difference, over a band that contains 95 % of the noise. The stretch of "
        f"{STRETCH_S:g} s is of a run whose squared residual over the noise is larger than that of four in "
        "five, not the largest. All have passed the same low-pass.",
    ),
    "shares": _Drawn(
        "How much of it is systematic",
        "A full bar is the squared residual of a channel. Grey is what is left of it when every effect of "
        "the library is freed: noise, as far as can be known. Differences from run to run, as of the tyre "
        "pressure, count as systematic.",
    ),
    "spectra": _Drawn(
        "At which frequencies",
        "Dashed: the noise. A line above it is more than noise. Dotted: the cut-off of the low-pass, beyond "
        "which nothing is compared.",
    ),
    "dependence": _Drawn(
        "What it depends on",
        "A residual that is noise depends on nothing: its means lie on the line. Intervals are over runs; "
        "those of single runs come from the noise, and do not include differences from run to run. Turn: "
        "wheel speed right minus left, or last minus first wheel.",
    ),
}
"""By the name of the figure's file."""


def write_explain_page(
    out: Path, diagnosed: DiagnosedRuns, result: Explanation, progress: Progress = silent
) -> None:
    """Write the page, and all its figures into ``pictures``.

    Raises
    ------
    TerrainError
        if the folder cannot be written.
    """
    runs = shown_runs(diagnosed)
    figures = []
    for name, figure in explain_figures(diagnosed, runs).items():
        svg, png = svg_text(figure), png_bytes(figure)
        atomic_write(out / PICTURES / f"{name}.png", png)
        atomic_write(out / PICTURES / f"{name}.svg", svg)
        figures.append(figure_view(name, svg, png))
    pictures = []
    for number, run in enumerate(runs, start=1):
        stem = re.sub(r"[^\w.-]", "_", run.run_id)
        file = f"{PICTURES}/run_{number:03d}_{stem}.png"
        content = run_png(run, diagnosed.noise)
        atomic_write(out / file, content)
        image = png_image(content, run.title) if number <= MAX_EMBEDDED else None
        pictures.append(RunPicture(run.title, file, image))
        progress("pictures", number, len(runs))
    atomic_write(out / PAGE_FILE, explain_page(result, figures, pictures))


def run_png(run: ShownRun, noise: Noise) -> bytes:
    """Return the figure of a whole run as PNG."""
    return png_bytes(run_figure(run, noise, run.title), RUN_DPI)


def explain_figures(diagnosed: DiagnosedRuns, runs: Sequence[ShownRun]) -> Mapping[str, Figure]:
    """Return the figures by name, of the runs behind the diagnosis."""
    used = [run for run in runs if not run.held_out]
    noise, diagnosis = diagnosed.noise, diagnosed.diagnosis
    example = example_stretch(used, noise)
    extended = diagnosed.extended is not None
    return {
        "stretch": run_figure(example, noise, f"Example: {example.stretch_title}"),
        "shares": systematic_figure(diagnosis.residual_before, diagnosis.residual_after, extended),
        "spectra": spectra_figure(used, noise, diagnosed.low_pass.cutoff_hz),
        "dependence": dependence_figure(used, noise),
    }


def figure_view(name: str, svg: str, png: bytes) -> FigureView:
    """Return a figure as the page shows it: as SVG, or as PNG where that would be large."""
    heading, caption = DRAWN[name]
    if len(svg) <= MAX_SVG_BYTES:
        return FigureView(heading, svg_image(svg, caption, caption))
    return FigureView(heading, png_image(png, caption, caption))


def explain_page(result: Explanation, figures: Sequence[FigureView], runs: Sequence[RunPicture]) -> str:
    """Return the page.

    Parameters
    ----------
    result : of the command
    figures : of all runs
    runs : figures of whole runs
    """
    return render("explain/page.html.j2", view=page_view(result, figures, runs))
