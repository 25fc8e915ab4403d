"""Figure and page of ``terrain learn-slip`` where slip was measured from outside."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from pipelines.reporting.drawing import (
    CLASS_COLOURS,
    INK,
    finished,
    new_figure,
    png_bytes,
    styled,
    svg_text,
)
from pipelines.reporting.numbers import shorten
from pipelines.reporting.pictures import Image, png_image
from pipelines.reporting.templates import render
from pipelines.slip.measured_rows import (
    SURFACE_COLUMNS,
    TRANSFER_COLUMNS,
    MeasuredTargets,
    surface_cells,
    transfer_cells,
)
from terrain.files.atomic import atomic_write
from terrain.measured_slip.operating import OperatingPoints

PAGE_FILE = "slip.html"
FIGURE = "operating_points"

CAPTION = (
    "A run a point: its median slip in steady motion. Bars are the median of a surface and its 95 % interval "
    "over runs. Points of one surface differ in how the robot was driven and are no curve."
)


@dataclass(frozen=True, slots=True)
class MeasuredTargetsView:
    """What the page shows, as texts and a picture."""

    robot: str
    lead: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    transfer_headings: tuple[str, ...]
    transfers: tuple[tuple[str, ...], ...]
    not_used: tuple[str, ...]
    image: Image


def write_measured_page(
    result: MeasuredTargets, points: Mapping[str, OperatingPoints], folder: Path
) -> tuple[str, ...]:
    """Write the page and its figure into a folder; return the files."""
    figure = operating_figure(result, points)
    png = png_bytes(figure)
    view = MeasuredTargetsView(
        robot=result.robot,
        lead=f"{result.n_runs} runs · windows of {result.window_s:g} s · table {result.table.stem}",
        headings=("terrain", *SURFACE_COLUMNS, "reason"),
        rows=tuple((name, *surface_cells(row), row.reason) for name, row in result.surfaces.items()),
        transfer_headings=TRANSFER_COLUMNS,
        transfers=tuple(transfer_cells(each) for each in result.transfers),
        not_used=result.skipped,
        image=png_image(png, FIGURE, CAPTION),
    )
    contents: dict[str, bytes | str] = {
        f"{FIGURE}.png": png,
        f"{FIGURE}.svg": svg_text(figure),
        PAGE_FILE: render("slip/measured.html.j2", view=view),
    }
    files = [folder / name for name in contents]
    for file, content in zip(files, contents.values(), strict=True):
        atomic_write(file, content)
    return tuple(str(file) for file in files)


def operating_figure(result: MeasuredTargets, points: Mapping[str, OperatingPoints]) -> Figure:
    """Draw thrust over load, or current, or the surface alone, over the slip of each run."""
    values, label = _drawn(points)
    with styled():
        figure = new_figure(8.4, 4.8)
        axes = figure.subplots()
        for number, (name, row) in enumerate(result.surfaces.items()):
            colour = CLASS_COLOURS[number % len(CLASS_COLOURS)]
            height = values[name]
            axes.plot(
                points[name].slip_ratio,
                height,
                ".",
                ms=4,
                alpha=0.5,
                mew=0,
                color=colour,
                label=f"{shorten(name, 24)}, {row.slip.n_runs} runs",
            )
            known = height[np.isfinite(height)]
            if known.size and np.isfinite(row.slip.interval).all():
                middle = float(np.median(known))
                axes.plot(row.slip.interval, [middle, middle], color=INK, lw=4.0, solid_capstyle="butt")
                axes.plot(row.slip.interval, [middle, middle], color=colour, lw=2.0, solid_capstyle="butt")
        axes.set_xlabel("slip ratio of the body, median of a run")
        if label:
            axes.set_ylabel(label)
        else:
            axes.set_yticks(range(len(points)), [shorten(name, 24) for name in points])
        axes.grid()
        axes.legend(fontsize=7.5, frameon=False, markerscale=2.5, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return finished(figure, f"Steady slip of {result.robot}, measured from outside")


def _drawn(points: Mapping[str, OperatingPoints]) -> tuple[dict[str, np.ndarray], str]:
    """Return what is drawn over slip, by surface, and its name; places of surfaces without any current."""
    for field, label in (
        ("thrust_ratio", "thrust of a wheel over its share of the weight"),
        ("current_a", "mean current of a wheel [A]"),
    ):
        values = {name: np.asarray(getattr(each, field)) for name, each in points.items()}
        if any(np.isfinite(each).any() for each in values.values()):
            return values, label
    return {
        name: np.full(each.slip_ratio.size, float(i)) for i, (name, each) in enumerate(points.items())
    }, ""
