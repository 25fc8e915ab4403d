"""The page of ``terrain fit-soil``: laws compared, misfits, parameters, and what the trials cannot say."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from pipelines.reporting.numbers import NOT_KNOWN, format_number
from pipelines.reporting.pictures import Image, png
from pipelines.reporting.templates import render
from pipelines.soil.results import BAR_RATIO, HeldOut, WheelResult
from terrain.soil_identification.held_out import Misfit

LAW_HEADINGS = (
    "law",
    "parameters",
    "slip out: traction",
    "side",
    "angle out: traction",
    "side",
    "sinkage [mm]",
)
MISFIT_HEADINGS = ("trials", "traction", "side force", "sinkage [mm]")
PARAMETER_HEADINGS = ("parameter", "value", "95 %", "of the prior", "identified")


@dataclass(frozen=True, slots=True)
class WheelView:
    """One wheel on the page: names, rows of tables as texts, and images by heading."""

    wheel: str
    lead: str
    verdict: str
    laws: tuple[tuple[str, ...], ...]
    misfits: Mapping[str, tuple[tuple[str, ...], ...]]
    parameters: tuple[tuple[str, ...], ...]
    not_identified: tuple[str, ...]
    soil: str
    images: Mapping[str, Image]


def soil_page(wheels: Sequence[WheelResult], figures: Mapping[str, Figure], dataset: str) -> str:
    """Return the page.

    Parameters
    ----------
    wheels : in the order in which they are shown
    figures : by name, which begins with that of the wheel
    dataset : name of the data
    """
    views = tuple(
        _view(
            result,
            {name: png(figure, name) for name, figure in figures.items() if name.startswith(result.wheel)},
        )
        for result in wheels
    )
    return render(
        "soil/page.html.j2",
        dataset=dataset,
        wheels=views,
        law_headings=LAW_HEADINGS,
        misfit_headings=MISFIT_HEADINGS,
        parameter_headings=PARAMETER_HEADINGS,
    )


def verdict(result: WheelResult) -> str:
    """Return whether the last law reaches what is aimed at, and where it stops."""
    row = result.laws[-1]
    parts = []
    for held, found in (("slips", row.slip), ("angles", row.angle)):
        errors = f"{found.load.pull_ratio:.1%} and {found.load.side_ratio:.1%}"
        rest = f"{found.below_axle_angle.pull_ratio:.1%} and {found.below_axle_angle.side_ratio:.1%}"
        state = (
            "reached" if found.reached else f"not reached ({rest} without the wheel dragged along its axle)"
        )
        parts.append(f"{held} left out, traction and side force off by {errors} of the load: {state}")
    if result.checked is not None:
        errors_text = f"{result.checked.load.pull_ratio:.1%} and {result.checked.load.side_ratio:.1%}"
        parts.append(f"{result.checked.load.n_trials} further trials: {errors_text}")
    return f"{BAR_RATIO:.0%} aimed at; " + "; ".join(parts)


def coupling_text(result: WheelResult) -> str:
    """Return by how much the measured traction is corrected, or that it is not."""
    ratio, std, n_trials = result.coupling
    if math.isnan(ratio):
        return "traction as measured, no trials of a locked wheel along its axle"
    return (
        f"traction less {ratio:.3f} ± {std:.3f} of the side force, what {n_trials} trials of a locked wheel "
        "along its axle show"
    )


def _view(result: WheelResult, images: Mapping[str, Image]) -> WheelView:
    low, high = result.load_range_n
    shallow, deep = result.sinkage_range_m
    lead = (
        f"{result.n_trials} trials at {result.n_settings} settings, load {low:.1f} to {high:.1f} N, sinkage "
        f"{shallow * 1e3:.0f} to {deep * 1e3:.0f} mm, {result.deeper_than_axle} trials deeper than the axle; "
        f"{coupling_text(result)}"
    )
    tables = {
        "By regime, slips left out": result.regimes,
        "By the wheel speed left out [mm/s]": {f"{key:g}": value for key, value in result.by_slip.items()},
        "By the slip angle left out [deg]": {f"{key:g}": value for key, value in result.by_angle.items()},
        "Polynomial of slip and angle, no mechanics": {
            "slips left out": result.surrogate_slip,
            "angles left out": result.surrogate_angle,
        },
    }
    soil = result.soil.misfit
    return WheelView(
        wheel=result.wheel,
        lead=lead,
        verdict=verdict(result),
        laws=tuple(
            (
                row.name,
                str(row.n_parameters),
                *_ratios(row.slip),
                *_ratios(row.angle),
                _mm(row.slip.load.sinkage_m),
            )
            for row in result.laws
        ),
        misfits={
            heading: tuple((name, *misfit_cells(each)) for name, each in rows.items())
            for heading, rows in tables.items()
        },
        parameters=tuple(
            (
                each.name,
                format_number(each.value),
                f"{format_number(each.interval[0])} to {format_number(each.interval[1])}",
                f"{each.informed_ratio:.2f}",
                "yes" if each.identified else "no",
            )
            for each in result.parameters.values()
        ),
        not_identified=result.not_identified,
        soil=f"{result.soil.file.name}: on trials that roll nearly straight the simulator's law is off by "
        f"{soil.pull_ratio:.1%} (traction), {soil.side_ratio:.1%} (side force) and {_mm(soil.sinkage_m)} mm",
        images=images,
    )


def misfit_cells(each: Misfit) -> tuple[str, ...]:
    """Return the number of trials, both forces in % of the load, and the sinkage in mm."""
    return str(each.n_trials), f"{each.pull_ratio:.1%}", f"{each.side_ratio:.1%}", _mm(each.sinkage_m)


def _ratios(found: HeldOut) -> tuple[str, str]:
    return f"{found.load.pull_ratio:.1%}", f"{found.load.side_ratio:.1%}"


def _mm(depth_m: float) -> str:
    return NOT_KNOWN if math.isnan(depth_m) else f"{depth_m * 1e3:.1f}"
