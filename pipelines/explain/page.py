"""One self-contained HTML page of a diagnosis: figures first, then causes, gain, and detection limits."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from pipelines.explain.figures import (
    dependence_figure,
    parts_figure,
    run_figure,
    spectra_figure,
    strongest_figure,
    systematic_figure,
)
from pipelines.explain.results import DiagnosedRuns, Explanation
from pipelines.explain.sections import page_view
from pipelines.explain.view import FigureView, RunPicture
from pipelines.reporting.drawing import png_bytes, svg_text
from pipelines.reporting.numbers import shorten
from pipelines.reporting.pictures import MAX_SVG_BYTES, png_image, svg_image
from pipelines.reporting.progress import Progress, silent
from pipelines.reporting.templates import render
from pipelines.reporting.words import in_words_of
from terrain.discrepancy.compared import STRETCH_S, ComparedRun, example_stretch, telling_runs
from terrain.discrepancy.noise import Noise
from terrain.files.atomic import atomic_write

PAGE_FILE, PICTURES = "explain.html", "pictures"

MAX_EMBEDDED = 12
"""Pictures on the page itself; those of more runs lie beside it."""

RUN_DPI = 96
"""Resolution of figures of whole runs, of which there may be many on a page."""


class _Drawn(NamedTuple):
    """Heading and caption of a figure."""

    heading: str
    caption: str


DRAWN = {
    "stretch": _Drawn(
        "One run beside the simulation",
        "Left: the measurement, and the prediction of the simulation from the logged wheels, steering and "
        "tilt. Right: the difference; the band about 0 holds 95 % of the noise alone, without offsets. It is "
        f"a stretch, {STRETCH_S:g} s at the most, of a run whose squared residual over the noise is larger "
        "than that of four in five, not the largest. All have passed the same low-pass.",
    ),
    "strongest": _Drawn(
        "What each channel depends on",
        "Means over bins of the input on which the residual depends most, with 95 % intervals over runs. A "
        "residual that is noise depends on nothing: its means lie on the line.",
    ),
    "parts": _Drawn(
        "Whether the values are one number",
        "The value of each cause fitted to a part of the data: thirds of each run's time, and halves of the "
        "runs. Bars and band: 95 % intervals.",
    ),
    "dependence": _Drawn(
        "Every input",
        "Intervals are over runs; those of single runs come from the noise, and do not include differences "
        "from run to run. Of many runs the last column shows how their means are distributed. Turn: wheel "
        "speed right minus left, or last minus first wheel.",
    ),
    "shares": _Drawn(
        "How much of it is systematic",
        "A full bar is the squared residual of a channel. Grey is noise: what is left when every effect of "
        "the library is freed, and levels and what depends on speed and turn are taken off. Differences from "
        "run to run, as of the tyre pressure, count as systematic.",
    ),
    "spectra": _Drawn(
        "At which frequencies",
        "Dashed: the noise. A line above it is more than noise. Dotted: the cut-off of the low-pass, beyond "
        "which nothing is compared.",
    ),
}
"""By the name of the figure's file, the most telling first."""


def write_explain_page(
    out: Path,
    diagnosed: DiagnosedRuns,
    result: Explanation,
    max_pictures: int | None = 12,
    progress: Progress = silent,
) -> None:
    """Write the page, and its figures into ``pictures``.

    Parameters
    ----------
    out : folder
    diagnosed, result : of the command
    max_pictures : most of them; None for one of every run, too
    progress : called with pictures that are done

    Raises
    ------
    TerrainError
        if the folder cannot be written.
    """
    makers = dict(list(explain_figures(diagnosed).items())[:max_pictures])
    runs: Sequence[ComparedRun] = [*diagnosed.compared, *result.gain.judged]
    if max_pictures is not None:
        runs = telling_runs(runs, diagnosed.noise, max_pictures - len(makers))
    figures, pictures, n = [], [], len(makers) + len(runs)
    for name, make in makers.items():
        figure = make()
        svg, png = svg_text(figure), png_bytes(figure)
        atomic_write(out / PICTURES / f"{name}.png", png)
        atomic_write(out / PICTURES / f"{name}.svg", svg)
        figures.append(figure_view(name, svg, png))
        progress("pictures", len(figures), n)
    for number, run in enumerate(runs, start=1):
        stem = re.sub(r"[^\w.-]", "_", run.run_id)
        file = f"{PICTURES}/run_{number:03d}_{stem}.png"
        content = run_png(run, diagnosed.noise)
        atomic_write(out / file, content)
        title = run_title(run)
        image = png_image(content, title) if len(figures) + number <= MAX_EMBEDDED else None
        pictures.append(RunPicture(title, file, image))
        progress("pictures", len(figures) + number, n)
    atomic_write(out / PAGE_FILE, explain_page(result, figures, pictures))


def run_title(run: ComparedRun) -> str:
    """Return the title of a whole run."""
    name = shorten(run.run_id, 40) + (f", {shorten(run.terrain, 24)}" if run.terrain else "")
    return name + (", held out" if run.held_out else "")


def run_png(run: ComparedRun, noise: Noise) -> bytes:
    """Return the figure of a whole run as PNG."""
    return png_bytes(run_figure(run, noise, run_title(run)), RUN_DPI)


def explain_figures(diagnosed: DiagnosedRuns) -> dict[str, Callable[[], Figure]]:
    """Return what draws each figure of the runs behind the diagnosis, by name, the most telling first."""
    used, noise, diagnosis = diagnosed.compared, diagnosed.noise, diagnosed.diagnosis
    extended = diagnosed.extended is not None

    def stretch() -> Figure:
        part = example_stretch(used, noise)
        return run_figure(
            part, noise, f"Example: {run_title(part)}: {part.time_s[0]:.0f} to {part.time_s[-1]:.0f} s"
        )

    makers: dict[str, Callable[[], Figure]] = {
        "stretch": stretch,
        "strongest": lambda: strongest_figure(used),
        "parts": lambda: parts_figure(diagnosed.parts),
        "dependence": lambda: dependence_figure(used, noise),
        "shares": lambda: systematic_figure(diagnosis.residual_before, diagnosis.residual_after, extended),
        "spectra": lambda: spectra_figure(used, noise, diagnosed.low_pass.cutoff_hz),
    }
    return {name: makers[name] for name in DRAWN if name != "parts" or diagnosed.parts}


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
    page = render("explain/page.html.j2", view=page_view(result, figures, runs))
    return in_words_of(result.drive, page)
