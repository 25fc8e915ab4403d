"""Figures of measured slip: by surface, a run a point, and by the direction of travel or the turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from pipelines.measured_slip.results import MeasuredSlipResult
from pipelines.measured_slip.screen import UNLABELLED
from pipelines.reporting.drawing import BLUE, CLASS_COLOURS, INK, VERMILION, finished, new_figure, styled
from pipelines.reporting.numbers import shorten
from terrain.measured_slip.slips import MeasuredSlip
from terrain.records import Array, RunLog

MIN_SIDEWAYS = 0.2
"""Share of the windows that drive to the side, from which slip is drawn over the direction of travel."""


def measured_figures(
    result: MeasuredSlipResult, runs: Sequence[RunLog], slips: Sequence[MeasuredSlip]
) -> Mapping[str, Figure]:
    """Return the figures by name."""
    by_terrain: dict[str, list[MeasuredSlip]] = {row.terrain: [] for row in result.surfaces}
    for run, slip in zip(runs, slips, strict=True):
        by_terrain[run.terrains[0] if len(run.terrains) == 1 else ""].append(slip)
    return {
        "slip_by_surface": _by_surface(result, by_terrain),
        "slip_by_motion": _by_motion(result, by_terrain),
    }


def _by_surface(result: MeasuredSlipResult, by_terrain: Mapping[str, Sequence[MeasuredSlip]]) -> Figure:
    with styled():
        figure = new_figure(8.4, 1.6 + 0.5 * len(by_terrain))
        axes = figure.subplots()
        rng = np.random.default_rng(0)
        for place, row in enumerate(reversed(result.surfaces)):
            medians = np.array(
                [
                    np.median(known)
                    for slip in by_terrain[row.terrain]
                    if (known := slip.body_slip[slip.steady & np.isfinite(slip.body_slip)]).size
                ]
            )
            axes.plot(
                medians,
                place + rng.uniform(-0.22, 0.22, medians.size),
                ".",
                ms=4,
                color=BLUE,
                alpha=0.45,
                mew=0,
                label=None if place else "a run",
            )
            low, high = row.interval
            axes.plot([low, high], [place, place], color=VERMILION, lw=2.5, label=None if place else "95 %")
            axes.plot(
                [row.slip_ratio], [place], "|", color=INK, ms=16, mew=1.6, label=None if place else "median"
            )
        axes.set_yticks(
            range(len(by_terrain)),
            [shorten(row.terrain or UNLABELLED, 24) for row in reversed(result.surfaces)],
        )
        axes.set_xlabel(f"slip ratio of the body over {result.window_s:g} s")
        axes.grid(axis="x")
        axes.legend(fontsize=7.5, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return finished(figure, f"Slip of {result.robot} by surface, measured from outside")


def _by_motion(result: MeasuredSlipResult, by_terrain: Mapping[str, Sequence[MeasuredSlip]]) -> Figure:
    rolled = np.concatenate([slip.rolled_twist for slips in by_terrain.values() for slip in slips])
    with np.errstate(invalid="ignore"):
        sideways = np.nanmean(np.abs(rolled[:, 1]) > 0.1 * np.abs(rolled[:, 0])) > MIN_SIDEWAYS
    with styled():
        figure = new_figure(8.4, 4.6)
        axes = figure.subplots()
        for number, (terrain, slips) in enumerate(by_terrain.items()):
            if not slips:
                continue
            rows = [slip.steady & np.isfinite(slip.body_slip) for slip in slips]
            twist = np.concatenate([slip.rolled_twist[row] for slip, row in zip(slips, rows, strict=True)])
            ratio = np.concatenate([slip.body_slip[row] for slip, row in zip(slips, rows, strict=True)])
            axes.plot(
                _motion(twist, sideways),
                ratio,
                ".",
                ms=3.5,
                alpha=0.5,
                mew=0,
                color=CLASS_COLOURS[number % len(CLASS_COLOURS)],
                label=shorten(terrain or UNLABELLED, 24),
            )
        if sideways:
            axes.set_xlabel("direction of travel in the body's axes [degrees]")
            axes.set_xticks(range(-180, 181, 60))
        else:
            axes.set_xlabel("yaw rate of the wheels over their speed [rad/m]")
            axes.set_xlim(-3.0, 3.0)
        axes.set_ylabel("slip ratio of the body")
        axes.grid()
        axes.legend(fontsize=7.5, frameon=False, markerscale=2.5, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return finished(figure, f"Slip of {result.robot} by how it was driven, a window a point")


def _motion(twist: Array, sideways: bool) -> Array:
    if sideways:
        return np.degrees(np.arctan2(twist[:, 1], twist[:, 0]))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(twist[:, 2] / np.abs(twist[:, 0]))
