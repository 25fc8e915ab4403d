"""Figures of single drives: speeds over ground, and slip against its target, over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import (
    BLUE,
    CLASS_COLOURS,
    FAINT_INK,
    GREEN,
    INK,
    ORANGE,
    VERMILION,
    finished,
    new_figure,
    styled,
)
from pipelines.reporting.numbers import shorten
from terrain.control.drive_metrics import PEAK_ABOVE_MPS, low_passed_slip
from terrain.control.power_state import DriveState
from terrain.control.slip_table import SlipTable
from terrain.control.traction import TractionStatus
from terrain.kinematics.true_slip import true_slip
from terrain.records import Array, RunLog

MAX_POINTS = 2500
RISING_COLOUR, BRAKING_COLOUR, HATCH_COLOUR = "#f7efc9", "#f3dccb", "#dba888"
LEAST_NAME_RATIO = 0.035
"""Of the length of a drive: a terrain that was driven for less has no name in the strip."""

LETTERS_A_STRIP = 140


class DriveCurves(NamedTuple):
    """Curves of a drive: true speed and slip (n,), least and largest of the wheels, and the control stream.

    Parameters
    ----------
    true_s, true_mps, slip, slip_least, slip_largest : (n,) of the truth
    control_s, control : (m,) times, and channels by name of :class:`pipelines.live.pilot.PilotStatus`
    aimed : (m,) target slip with its floor, negative in braking
    is_open_loop : whether no slip was estimated
    """

    true_s: Array
    true_mps: Array
    slip: Array
    slip_least: Array
    slip_largest: Array
    control_s: Array
    control: Mapping[str, Array]
    aimed: Array
    is_open_loop: bool


def drive_curves(run: RunLog) -> DriveCurves:
    """Return the curves of a drive.

    True slip is low-pass filtered as its estimate, and NaN where the robot is slower than
    :data:`terrain.control.drive_metrics.PEAK_ABOVE_MPS`.  A wheel that turns against the motion is drawn as a
    locked one.
    """
    truth, control = run.streams["truth"], run.streams["control"]
    step_s = float(np.median(np.diff(truth.time_s)))
    speed = np.hypot(truth.channel("speed_x_mps"), truth.channel("speed_y_mps"))
    wheels = [name.split("_")[1] for name in truth.channels if name.startswith("wheel_")]
    slips = low_passed_slip(np.clip(true_slip(truth, wheels), -1.0, 1.0), step_s)
    slips[speed < PEAK_ABOVE_MPS] = np.nan
    channels = {name: control.channel(name) for name in control.channels}
    aimed = channels["aimed_ratio"]
    if not np.isfinite(channels["balance_ratio"]).any():  # the thesis reports the magnitude of its target
        aimed = np.where(channels["drive_state_code"] == DriveState.BRAKING, -aimed, aimed)
    return DriveCurves(
        truth.time_s,
        speed,
        slips.mean(axis=1),
        slips.min(axis=1),
        slips.max(axis=1),
        control.time_s,
        channels,
        aimed,
        not np.isfinite(channels["slip_ratio"]).any(),
    )


def run_figures(examples: Mapping[str, RunLog], table: SlipTable) -> dict[str, Figure]:
    """Return a figure of each drive, all with the same axes.

    Parameters
    ----------
    examples : a drive of each controller, with the streams ``truth`` and ``control``
    table : whose entries the pilot numbers the terrains by
    """
    shown = {name: drive_curves(run) for name, run in examples.items()}
    if not shown:
        return {}
    fastest = max(float(part.true_mps.max()) for part in shown.values())
    fastest = max(fastest, *(float(np.nanmax(part.control["desired_mps"])) for part in shown.values()))
    slips = np.concatenate(
        [values for part in shown.values() for values in (part.slip_least, part.slip_largest, part.aimed)]
    )
    least, largest = float(np.nanmin([-0.02, *slips])), float(np.nanmax([0.1, *slips]))
    limits = (
        (-0.03 * fastest, 1.1 * fastest),
        (least - 0.06 * (largest - least), largest + 0.1 * (largest - least)),
    )
    return {name: _run_figure(name, examples[name], part, table, limits) for name, part in shown.items()}


def _run_figure(
    name: str,
    run: RunLog,
    part: DriveCurves,
    table: SlipTable,
    limits: tuple[tuple[float, float], tuple[float, float]],
) -> Figure:
    strips = terrain_strips(run, part, table)
    with styled():
        figure = new_figure(10.0, 5.4 + 0.28 * len(strips))
        ratios = [2.0, 3.0] + ([0.26 * len(strips)] if strips else [])
        panels = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios)
        above, below = panels[:2]
        _shade(above, part, named=False)
        _line(above, part.control_s, part.control["desired_mps"], INK, "desired, fastest wheel", 0.9, "--")
        _line(above, part.control_s, part.control["driven_mps"], VERMILION, "commanded, fastest wheel", 1.2)
        _line(above, part.true_s, part.true_mps, BLUE, "true, over ground", 1.5)
        above.set(ylim=limits[0], ylabel="speed [m/s]")
        _shade(below, part, named=True)
        every = _every(part.true_s)
        below.fill_between(
            part.true_s[::every],
            part.slip_least[::every],
            part.slip_largest[::every],
            color=BLUE,
            alpha=0.22,
            lw=0,
            label="true, least to largest wheel",
        )
        _line(below, part.true_s, part.slip, BLUE, "true, mean of the wheels", 1.5)
        if not part.is_open_loop:
            _control(below, part)
        below.set(ylim=limits[1], ylabel="slip ratio")
        for axes in (above, below):
            axes.grid()
            axes.legend(
                ncols=4, fontsize=7.5, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), borderpad=0
            )
        if strips:
            _strips(panels[2], strips, part.control_s)
        panels[-1].set(xlabel="time [s]", xlim=(part.control_s[0], part.control_s[-1]))
        what = "speeds and slip" if part.is_open_loop else "slip against its target"
        return finished(figure, f"{shorten(name, 40)}: {what}")


def _control(axes: Axes, part: DriveCurves) -> None:
    """Draw the estimated slip, its target, and where no correction was made."""
    control = part.control
    moving = np.interp(part.control_s, part.true_s, part.true_mps) >= PEAK_ABOVE_MPS
    estimated = np.where(moving, control["slip_ratio"], np.nan)
    for values, colour, label, width, style in (
        (estimated, ORANGE, "estimated, largest wheel", 1.0, "-"),
        (control["target_ratio"], GREEN, "target", 1.8, "-"),
        (part.aimed, INK, "target with its floor", 1.0, "--"),
        (control["balance_ratio"], FAINT_INK, "slip of steady motion", 1.2, ":"),
    ):
        if np.isfinite(values).any():
            _line(axes, part.control_s, values, colour, label, width, style)
    status = control["status_code"]
    refused = status != TractionStatus.OK
    if refused.any():
        reasons = [each.label for each in TractionStatus if each and (status == each).any()]
        axes.fill_between(
            part.control_s,
            0.955,
            1.0,
            where=_touching(refused),
            transform=axes.get_xaxis_transform(),
            color=INK,
            lw=0,
            zorder=4,
            label=f"no correction: {', '.join(reasons)}",
        )


def _shade(axes: Axes, part: DriveCurves, named: bool) -> None:
    """Shade where speed rises or the robot brakes; steady motion stays white."""
    state = part.control["drive_state_code"]
    for code, colour, hatch, label in (
        (DriveState.TRACTION, RISING_COLOUR, None, "traction: speed rises"),
        (DriveState.BRAKING, BRAKING_COLOUR, "////", "braking"),
    ):
        if (state == code).any():
            axes.fill_between(
                part.control_s,
                0.0,
                1.0,
                where=_touching(state == code),
                transform=axes.get_xaxis_transform(),
                facecolor=colour,
                edgecolor=HATCH_COLOUR,
                hatch=hatch,
                lw=0,
                zorder=0,
                label=label if named else None,
            )


def _touching(marked: Array) -> Array:
    """Return the mask with the sample after each interval, so that one of a single sample is drawn, too."""
    after = marked.copy()
    after[1:] |= marked[:-1]
    return after


def terrain_strips(
    run: RunLog, part: DriveCurves, table: SlipTable
) -> list[tuple[str, list[tuple[float, float, str]]]]:
    """Return the true and, where there is one, the classified terrain over time; nothing on one terrain."""
    if len(run.terrains) < 2:
        return []
    strips = [("true", [(label.start_s, label.end_s, label.terrain) for label in run.labels])]
    names, index = tuple(table.targets), part.control["terrain_code"].astype(int)
    if (index >= 0).any():
        first = np.flatnonzero(np.diff(index, prepend=index[0] - 1))
        ends = [*part.control_s[first[1:]].tolist(), float(part.control_s[-1])]
        strips.append(
            (
                "classified",
                [
                    (float(part.control_s[i]), end, names[index[i]])
                    for i, end in zip(first, ends, strict=True)
                    if index[i] >= 0
                ],
            )
        )
    return strips


def _strips(axes: Axes, strips: Sequence[tuple[str, list[tuple[float, float, str]]]], time_s: Array) -> None:
    names = sorted({name for _, pieces in strips for *_, name in pieces})
    length_s = time_s[-1] - time_s[0]
    for row, (_, pieces) in enumerate(strips):
        for start_s, end_s, name in pieces:
            place = names.index(name)
            axes.broken_barh(
                [(start_s, end_s - start_s)],
                (row - 0.44, 0.88),
                facecolor=CLASS_COLOURS[place % len(CLASS_COLOURS)],
                alpha=0.55,
                hatch="..." if place >= len(CLASS_COLOURS) else None,
                edgecolor="white",
                lw=0.6,
            )
            letters = int(LETTERS_A_STRIP * (end_s - start_s) / length_s)
            if end_s - start_s >= LEAST_NAME_RATIO * length_s:
                axes.text(
                    (start_s + end_s) / 2, row, shorten(name, max(letters, 3)), ha="center", va="center",
                    fontsize=6.5, clip_on=True,
                )  # fmt: skip
    axes.set_yticks(range(len(strips)), [f"{name} terrain" for name, _ in strips], fontsize=8)
    axes.set_ylim(len(strips) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)


def _line(
    axes: Axes, time_s: Array, values: Array, colour: str, label: str, width: float, style: str = "-"
) -> None:
    every = _every(time_s)
    axes.plot(time_s[::every], values[::every], color=colour, label=label, lw=width, ls=style)


def _every(time_s: Array) -> int:
    return max(1, math.ceil(len(time_s) / MAX_POINTS))
