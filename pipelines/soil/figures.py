"""Figures of a wheel in sand: forces and sinkage over slip by angle, measured beside predicted."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import CLASS_COLOURS, INK, finished, new_figure, styled
from pipelines.soil.results import BAR_RATIO, Drawn, WheelResult
from terrain.records import Array
from terrain.soil_identification.laws import Prediction
from terrain.soil_identification.trials import Trials

PANELS = (("pull_n", "traction [N]"), ("side_n", "side force [N]"), ("sinkage_m", "sinkage [mm]"))
LEFT_OUT = {"slip": "slips left out", "angle": "slip angles left out"}


def wheel_figures(result: WheelResult, drawn: Drawn) -> dict[str, Figure]:
    """Return a figure for slips and one for angles left out, by name."""
    return {f"{drawn.wheel}, {text}": held_out_figure(result, drawn, held) for held, text in LEFT_OUT.items()}


def held_out_figure(result: WheelResult, drawn: Drawn, held_out: str) -> Figure:
    """Draw traction, side force and sinkage over slip, a colour an angle.

    Parameters
    ----------
    result : of the wheel
    drawn : its trials and predictions
    held_out : ``slip`` or ``angle``
    """
    prediction: Prediction = getattr(drawn, held_out)
    row = next(each for each in result.laws if each.name == drawn.law)
    errors = getattr(row, held_out).load
    with styled():
        figure = new_figure(11.0, 4.2)
        panels = figure.subplots(1, len(PANELS))
        for axes, (name, label) in zip(panels, PANELS, strict=True):
            scale = 1e3 if name.endswith("_m") else 1.0
            draw_over_slip(
                axes, drawn.trials, getattr(drawn.trials, name) * scale, getattr(prediction, name) * scale
            )
            axes.set(xlabel="slip ratio", ylabel=label)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, fontsize=7.5, frameon=False, ncols=8, loc="outside lower center")
        title = (
            f"{drawn.wheel} wheel, law {drawn.law}, {LEFT_OUT[held_out]}: traction off by "
            f"{errors.pull_ratio:.1%} and side force by {errors.side_ratio:.1%} of the load "
            f"(at most {BAR_RATIO:.0%} is aimed at), sinkage by {errors.sinkage_m * 1e3:.1f} mm"
        )
        return finished(figure, title)


def draw_over_slip(axes: Axes, trials: Trials, measured: Array, predicted: Array) -> None:
    """Draw measured values (n,) as points and predicted ones as lines, by angle."""
    for number, angle in enumerate(np.unique(trials.angle_setting)):
        rows = np.flatnonzero(trials.angle_setting == angle)
        colour = CLASS_COLOURS[number % len(CLASS_COLOURS)]
        axes.plot(trials.slip_ratio[rows], measured[rows], "o", ms=3.0, color=colour, alpha=0.7)
        speeds = np.unique(trials.slip_setting[rows])
        own = [rows[trials.slip_setting[rows] == speed] for speed in speeds]
        slips = [float(trials.slip_ratio[each].mean()) for each in own]
        means = [float(predicted[each].mean()) for each in own]
        axes.plot(slips, means, "-", lw=1.2, color=colour, label=f"{angle:g} deg")
    axes.plot([], [], "o", ms=3.0, color=INK, label="measured")
    axes.axhline(0.0, color=INK, lw=0.6)
    axes.grid()
