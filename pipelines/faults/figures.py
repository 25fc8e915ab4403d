"""Figures of single drives with a fault: speeds, slip and status over time."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.faults.drives import Driven, References
from pipelines.faults.results import FaultCase, duration_text
from pipelines.reporting.drawing import (
    BLUE,
    FAINT_INK,
    GREEN,
    GREY,
    INK,
    ORANGE,
    VERMILION,
    finished,
    new_figure,
    styled,
)

BEFORE_S = 1.0
"""Shown before the fault."""

ACTS_COLOUR = "#f7efc9"


def fault_figure(case: FaultCase, driven: Driven, references: References) -> Figure:
    """Return the figure of a drive with a fault.

    Parameters
    ----------
    case : what was driven
    driven : with the fault
    references : of the same place
    """
    start_s, drive = references.start_s, driven.drive
    end_s = min(start_s + case.duration_s, float(drive.time_s[-1]))
    with styled():
        figure = new_figure(7.6, 5.6)
        speeds, slips, status = figure.subplots(3, 1, sharex=True, height_ratios=(5, 5, 1))
        for axes in (speeds, slips):
            axes.axvspan(start_s, end_s, color=ACTS_COLOUR, linewidth=0)
            axes.grid(visible=True)
        _draw_speeds(speeds, driven)
        _draw_slips(slips, driven, references)
        status.stackplot(drive.time_s, drive.ok, ~drive.ok, step="post", colors=(GREEN, INK), linewidth=0)
        status.set(yticks=[], ylim=(0, 1), xlabel="time in s")
        status.set_ylabel("OK", rotation=0, ha="right", va="center")
        status.set_xlim(max(start_s - BEFORE_S, 0.0), float(drive.time_s[-1]))
        place = f"{case.situation} on {case.terrain}, seed {case.seed}"
        return finished(figure, f"{case.fault}, {duration_text(case.duration_s)}: {place}")


def _draw_speeds(axes: Axes, driven: Driven) -> None:
    drive = driven.drive
    estimated = np.where(np.abs(driven.speed_mps) < 10.0, driven.speed_mps, math.nan)
    axes.plot(drive.time_s, drive.desired_mps, color=GREY, linestyle="--", label="desired")
    axes.plot(drive.time_s, drive.commanded_mps, color=INK, label="commanded")
    axes.plot(drive.time_s, drive.speed_mps, color=BLUE, label="over ground, true")
    axes.plot(drive.time_s, estimated, color=VERMILION, linewidth=1.0, label="over ground, estimated")
    axes.set(ylabel="speed in m/s", ylim=(-0.5, 2.0))
    axes.legend(loc="upper right", fontsize=7, ncols=2, frameon=False)


def _draw_slips(axes: Axes, driven: Driven, references: References) -> None:
    drive, plain = driven.drive, references.plain
    axes.plot(
        plain.time_s, plain.body_slip_ratio, color=FAINT_INK, linestyle=":", label="true, plain commands"
    )
    axes.plot(drive.time_s, drive.body_slip_ratio, color=ORANGE, label="true, of the robot")
    axes.plot(drive.time_s, drive.true_slip_ratio, color=BLUE, label="true, largest of the wheels")
    axes.plot(drive.time_s, drive.slip_ratio, color=VERMILION, linewidth=1.0, label="estimated")
    axes.set(ylabel="slip ratio", ylim=(-1.1, 1.1))
    axes.legend(loc="upper right", fontsize=7, ncols=2, frameon=False)
