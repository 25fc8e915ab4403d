"""Curves and figures of single drives: speeds over ground, and slip against its target."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipelines.report.figure import Band, Figure, Line, Mark, Panel, Span, Strip, spans
from terrain.control.drive_metrics import PEAK_ABOVE_MPS, SMOOTH_S
from terrain.control.pid import DriveState
from terrain.control.slip_table import SlipTable
from terrain.control.traction import TractionStatus
from terrain.kinematics.logged_wheels import true_slip
from terrain.records import Array, RunLog
from terrain.signals import low_pass

MAX_POINTS = 2500

CAPTION = (
    "Above: desired and commanded speed, and the speed over ground. Below: the true slip, with the range of the "
    "wheels, its estimate, the target, and the target with its floor: at least the slip of steady motion and a "
    f"margin. Below {PEAK_ABOVE_MPS:g} m/s no slip is drawn. All drives have the same axes."
)

STATES = {int(DriveState.TRACTION): "traction: speed rises", int(DriveState.BRAKING): "braking"}

BLUE, VERMILION, GREEN, ORANGE, PINK, _, GREY = range(7)


class DriveCurves(NamedTuple):
    """Curves of a drive, of so many points as can be seen."""

    true_s: Array  # of the true speed and slip, (n,)
    true_mps: Array
    slips: Array  # of each wheel, (n, wheels)
    control_s: Array  # of the pilot's channels, (m,)
    control: Mapping[str, Array]  # the target slip with its floor is negative in braking
    terrains: Mapping[str, Sequence[Span]]  # ``true`` and ``classified`` over time; empty on one terrain


def drive_curves(run: RunLog, table: SlipTable) -> DriveCurves:
    """Return the curves of a drive by a pilot that numbers the terrains by a table's entries.

    True slip is low-pass filtered as its estimate, and NaN where the robot is slower than
    :data:`terrain.control.drive_metrics.PEAK_ABOVE_MPS`.  A wheel that turns against the motion is drawn as a
    locked one.
    """
    truth, control = run.streams["truth"], run.streams["control"]
    speed = np.hypot(truth.channel("speed_x_mps"), truth.channel("speed_y_mps"))
    wheels = [name[6:-6] for name in truth.channels if name.startswith("wheel_")]
    true = np.clip(true_slip(truth, wheels), -1.0, 1.0)
    slips = low_pass(np.nan_to_num(true), float(np.median(np.diff(truth.time_s))), SMOOTH_S)
    slips[speed < PEAK_ABOVE_MPS] = np.nan
    seen, ticks = (
        slice(None, None, max(1, math.ceil(len(each) / MAX_POINTS)))
        for each in (truth.time_s, control.time_s)
    )
    channels = {name: control.channel(name)[ticks] for name in control.channels}
    control_s, codes = control.time_s[ticks], channels["terrain_code"]
    if not np.isfinite(channels["balance_ratio"]).any():  # the thesis reports the magnitude of its target
        brakes, aimed = channels["drive_state_code"] == DriveState.BRAKING, channels["aimed_ratio"]
        channels["aimed_ratio"] = np.where(brakes, -aimed, aimed)
    terrains = {}
    if len(run.terrains) > 1:
        terrains["true"] = [(label.start_s, label.end_s, label.terrain) for label in run.labels]
        if (codes >= 0).any():
            terrains["classified"] = spans(control_s, codes, dict(enumerate(table.targets)))
    return DriveCurves(truth.time_s[seen], speed[seen], slips[seen], control_s, channels, terrains)


def run_figures(examples: Mapping[str, DriveCurves]) -> list[Figure]:
    """Return a figure of each drive, by its controller, all with the same axes."""
    if not examples:
        return []
    fastest = max(
        float(np.nanmax([*each.true_mps, *each.control["desired_mps"]])) for each in examples.values()
    )
    slips = np.concatenate(
        [
            part
            for each in examples.values()
            for part in (each.slips.min(axis=1), each.slips.max(axis=1), each.control["aimed_ratio"])
        ]
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
    least, largest = drive.slips.min(axis=1), drive.slips.max(axis=1)
    slip: list[Mark] = [
        Band("true, least to largest wheel", drive.true_s, least, largest, BLUE),
        Line("true, mean of the wheels", drive.true_s, drive.slips.mean(axis=1), BLUE),
        *(_control_marks(drive) if np.isfinite(control["slip_ratio"]).any() else []),
    ]
    panels = [Panel(moves, "speed [m/s]", y_range=speeds_mps), Panel(slip, "slip ratio", y_range=slips)]
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
        ("target with its floor", control["aimed_ratio"], GREY, True),
        ("slip of steady motion", control["balance_ratio"], PINK, True),
    ):
        if np.isfinite(values).any():
            marks.append(Line(label, time_s, values, colour, dashed))
    return marks
