"""Pictures of one run by an observer: its slips with their standard deviation, and where the robot was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import (
    BLUE,
    FAINT_INK,
    GREY,
    INK,
    finished,
    new_figure,
    png_bytes,
    styled,
)
from pipelines.reporting.line_figure import add_legend
from pipelines.reporting.numbers import shorten
from terrain.estimation.observers.estimate import ObserverEstimate
from terrain.estimation.observers.family import ObserverStatus
from terrain.estimation.observers.summary import SETTLED
from terrain.files.atomic import atomic_write

RUN_WIDTH = 40
"""Letters of a run's name in a title."""

LATE_S = 2.0
"""Time from the start that does not set the limits of an axis: estimates begin where nothing is known."""


def write_observed_figures(found: ObserverEstimate, folder: Path) -> list[Path]:
    """Write ``<run>_slip.png`` and ``<run>_path.png``, those of them that there is something to show in."""
    figures = {}
    if found.track.slips:
        figures["slip"] = observed_slip_figure(found)
    if "position_x_m" in found.track.states:
        figures["path"] = path_figure(found)
    files = []
    for kind, figure in figures.items():
        folder.mkdir(parents=True, exist_ok=True)
        files.append(folder / f"{found.run.run_id}_{kind}.png")
        atomic_write(files[-1], png_bytes(figure))
    return files


def observed_slip_figure(found: ObserverEstimate) -> Figure:
    """Draw each slip over time with a band of one standard deviation, and its truth where there is one."""
    track, n = found.track, len(found.track.slips)
    with styled():
        figure = new_figure(8.4, 1.2 + 1.9 * n)
        panels = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
        for k, (axes, name) in enumerate(zip(panels, track.slips, strict=True)):
            scale, unit = (np.degrees(1.0), "degrees") if name.endswith("_rad") else (1.0, "ratio")
            slip, std = scale * track.slip[:, k], scale * track.slip_std[:, k]
            axes.fill_between(track.time_s, slip - std, slip + std, color=BLUE, alpha=0.2, lw=0)
            axes.plot(track.time_s, slip, color=BLUE, lw=1.2, label=found.observer.name)
            true = found.true(name)
            if true is not None:
                axes.plot(track.time_s, scale * true, color=INK, lw=0.9, ls="--", label="true")
            _shade_status(axes, found)
            axes.set_ylabel(f"{name.rpartition('_')[0].replace('_', ' ')} [{unit}]")
            _limit(axes, track.time_s, slip)
            if k > 0:
                axes.grid()
        add_legend(panels[0])
        panels[-1].set_xlabel("time [s]")
        return finished(
            figure, f"Slip of {shorten(found.run.run_id, RUN_WIDTH)} by the observer {found.observer.name}"
        )


def path_figure(found: ObserverEstimate) -> Figure:
    """Draw the estimated path, the fixes, and the true one where it is known."""
    track = found.track
    with styled():
        figure = new_figure(6.4, 5.2)
        axes = figure.add_subplot()
        x, y = found.true("position_x_m"), found.true("position_y_m")
        own = track.state("position_x_m") + 1j * track.state("position_y_m")
        if "position_x_m" not in found.observer.rows and x is not None and y is not None:
            yaw = found.true("yaw_rad")
            own = own * np.exp(1j * (0.0 if yaw is None else yaw[0])) + x[0] + 1j * y[0]
        if "position_x_m" in found.observer.rows and "gnss" in found.run.streams:
            gnss = found.run.streams["gnss"]
            axes.plot(
                gnss.channel("position_x_m"),
                gnss.channel("position_y_m"),
                ".",
                color=GREY,
                ms=2,
                label="fixes",
            )
        axes.plot(own.real, own.imag, color=BLUE, lw=1.2, label=found.observer.name)
        if x is not None and y is not None:
            axes.plot(x, y, color=INK, lw=0.9, ls="--", label="true")
        axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        axes.set_adjustable("datalim")
        add_legend(axes)
        return finished(
            figure, f"Path of {shorten(found.run.run_id, RUN_WIDTH)} by the observer {found.observer.name}"
        )


def _title(shown: str, found: ObserverEstimate) -> str:
    return f"{shown} of {shorten(found.run.run_id, RUN_WIDTH)} by the observer {found.observer.name}"


def _shade_status(axes: Axes, found: ObserverEstimate) -> None:
    """Shade where the observer's estimates do not follow measurements."""
    track = found.track
    away = ~np.isin(track.status, (*SETTLED, ObserverStatus.STANDING))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], away, [False]]).astype(int)))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        until = track.time_s[min(end, len(track.time_s) - 1)]
        axes.axvspan(track.time_s[begin], until, color=FAINT_INK, alpha=0.12, lw=0)


def _limit(axes: Axes, time_s: np.ndarray, slip: np.ndarray) -> None:
    """Show the values after the start, and a tenth of their range around them."""
    known = slip[np.isfinite(slip) & (time_s > time_s[0] + min(LATE_S, 0.1 * np.ptp(time_s)))]
    if known.size and np.ptp(known) > 0.0:
        margin = 0.1 * np.ptp(known)
        axes.set_ylim(known.min() - margin, known.max() + margin)
