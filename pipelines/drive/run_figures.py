"""Figures of single drives: speeds over ground, and slip against its target."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipelines.report.figure import Band, Figure, Line, Mark, Panel, Strip
from terrain.control.danzi_pid import DriveState
from terrain.control.drive_curves import DriveCurves, spans
from terrain.control.drive_metrics import PEAK_ABOVE_MPS
from terrain.control.traction import TractionStatus

CAPTION = (
    "Above: desired and commanded speed, and the speed over ground. Below: the true slip, with the range of the "
    "wheels, its estimate, the target, and the target with its floor: at least the slip of steady motion and a "
    f"margin. Below {PEAK_ABOVE_MPS:g} m/s no slip is drawn. All drives have the same axes."
)

STATES = {int(DriveState.TRACTION): "traction: speed rises", int(DriveState.BRAKING): "braking"}

BLUE, VERMILION, GREEN, ORANGE, PINK, _, GREY = range(7)


def run_figures(examples: Mapping[str, DriveCurves]) -> list[Figure]:
    """Return a figure of each drive, by its controller, all with the same axes."""
    if not examples:
        return []
    fastest = max(
        float(np.nanmax([*each.true_mps, *each.control["desired_mps"]])) for each in examples.values()
    )
    slips = np.concatenate(
        [part for each in examples.values() for part in (each.slip_least, each.slip_largest, each.aimed)]
    )
    least, largest = float(np.nanmin([-0.02, *slips])), float(np.nanmax([0.1, *slips]))
    margin = 0.1 * (largest - least)
    limits = (-0.03 * fastest, 1.1 * fastest), (least - margin, largest + margin)
    return [_run_figure(name, each, *limits) for name, each in examples.items()]


def _run_figure(
    name: str, drive: DriveCurves, speeds_mps: tuple[float, float], slips: tuple[float, float]
) -> Figure:
    control = drive.control
    moves: list[Mark] = [
        Strip(spans(drive.control_s, control["drive_state_code"], STATES)),
        Line("desired, fastest wheel", drive.control_s, control["desired_mps"], GREY, dashed=True),
        Line("commanded, fastest wheel", drive.control_s, control["driven_mps"], VERMILION),
        Line("true, over ground", drive.true_s, drive.true_mps, BLUE),
    ]
    slip: list[Mark] = [
        Band("true, least to largest wheel", drive.true_s, drive.slip_least, drive.slip_largest, BLUE),
        Line("true, mean of the wheels", drive.true_s, drive.slip, BLUE),
        *([] if drive.is_open_loop else _control_marks(drive)),
    ]
    panels = [
        Panel(moves, "speed [m/s]", y_range=speeds_mps),
        Panel(slip, "slip ratio", y_range=slips),
    ]
    for kind, strip in drive.terrains.items():
        panels.append(Panel([Strip(strip)], f"{kind} terrain"))
    return Figure(name, panels, CAPTION, x_label="time [s]")


def _control_marks(drive: DriveCurves) -> list[Mark]:
    """Return the estimated slip, its target, and where no correction was made."""
    control, time_s = drive.control, drive.control_s
    moving = np.interp(time_s, drive.true_s, drive.true_mps) >= PEAK_ABOVE_MPS
    estimated = np.where(moving, control["slip_ratio"], np.nan)
    refused = {int(each): f"no correction: {each.label}" for each in TractionStatus if each}
    marks: list[Mark] = [Strip(spans(time_s, control["status_code"], refused))]
    for label, values, colour, dashed in (
        ("estimated, largest wheel", estimated, ORANGE, False),
        ("target", control["target_ratio"], GREEN, False),
        ("target with its floor", drive.aimed, GREY, True),
        ("slip of steady motion", control["balance_ratio"], PINK, True),
    ):
        if np.isfinite(values).any():
            marks.append(Line(label, time_s, values, colour, dashed))
    return marks
