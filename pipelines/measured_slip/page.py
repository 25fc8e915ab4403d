"""The page of ``terrain measure-slip``: slip by surface, delays, predictions, and the figures behind them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipelines.measured_slip.figures import measured_figures
from pipelines.measured_slip.results import MeasuredSlipResult
from pipelines.measured_slip.screen import (
    PREDICTION_COLUMNS,
    UNLABELLED,
    delay_words,
    distance_words,
    named_words,
    prediction_cells,
    roller_cells,
    roller_words,
    source_words,
    surface_cells,
)
from pipelines.reporting.drawing import png_bytes
from pipelines.reporting.pictures import Image, png_image
from pipelines.reporting.templates import render
from terrain.files.atomic import atomic_write
from terrain.measured_slip.slips import MeasuredSlip
from terrain.records import RunLog

PAGE_FILE = "measured_slip.html"

SURFACE_HEADINGS = (
    *("surface", "runs", "windows", "median slip", "95 % over runs", "quartiles of windows"),
    *("std of a window", "held-out difference", "wheels", "yaw rate over wheels'"),
)

CAPTIONS = {
    "slip_by_surface": "The median of each run, the median over runs and its 95 % interval over runs.",
    "slip_by_motion": "A window of steady motion a point.",
}


@dataclass(frozen=True, slots=True)
class MeasuredSlipView:
    """What the page shows, as texts and pictures."""

    robot: str
    lead: str
    surface_headings: tuple[str, ...]
    surfaces: tuple[tuple[str, ...], ...]
    delays: tuple[str, ...]
    prediction_headings: tuple[str, ...]
    predictions: tuple[tuple[str, ...], ...]
    rollers: tuple[tuple[str, ...], ...]
    roller_sentences: tuple[str, ...]
    not_measured: tuple[str, ...]
    images: Mapping[str, Image]


def write_page(
    result: MeasuredSlipResult, runs: Sequence[RunLog], slips: Sequence[MeasuredSlip], folder: Path
) -> list[str]:
    """Write the page and its figures; return the files."""
    contents = {name: png_bytes(figure) for name, figure in measured_figures(result, runs, slips).items()}
    view = MeasuredSlipView(
        robot=result.robot,
        lead=f"{result.n_runs} runs · windows of {result.window_s:g} s · measured by {source_words(result)}",
        surface_headings=SURFACE_HEADINGS,
        surfaces=tuple((row.terrain or UNLABELLED, *surface_cells(row)) for row in result.surfaces),
        delays=tuple(delay_words(name, delay) for name, delay in result.delays.items()),
        prediction_headings=("held out", *PREDICTION_COLUMNS),
        predictions=tuple((row.held_out, *prediction_cells(row)) for row in result.predictions),
        rollers=() if result.rollers is None else tuple(roller_cells(result.rollers)),
        roller_sentences=()
        if result.rollers is None
        else (*roller_words(result.rollers), *named_words(result), *distance_words(result)),
        not_measured=result.not_measured,
        images={name: png_image(content, name, CAPTIONS[name]) for name, content in contents.items()},
    )
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{name}.png" for name in contents]
    for file, content in zip(files, contents.values(), strict=True):
        atomic_write(file, content)
    page = folder / PAGE_FILE
    atomic_write(page, render("measured_slip/page.html.j2", view=view))
    return [str(file) for file in (*files, page)]
