"""Figures of a drive along a path: its map, lateral error, sideslip, cornering stiffness and speed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from pipelines.reporting.drawing import BLUE, GREEN, GREY, INK, VERMILION, finished, new_figure, styled
from pipelines.reporting.line_figure import add_legend
from terrain.control.car_evaluation import FollowedDrive
from terrain.control.paths import ReferencePath, X, Y

WHEELS = ("front", "rear")
Drives = Mapping[str, FollowedDrive]
"""Drives by the name of their controller."""
COLOURS = (BLUE, VERMILION, GREEN, "#cc79a7", "#e69f00")


def drive_figures(
    drive: FollowedDrive, path: ReferencePath, offset_m: float, limit_m: float
) -> dict[str, Figure]:
    """Return the figures of one drive by the names of their files."""
    one = {"robot": drive}
    figures = {
        "map": map_figure(one, path, "Path and robot"),
        "lateral": lateral_figure(one, limit_m, "Lateral error along the path", offset_m),
        "sideslip": sideslip_figure(drive, "Sideslip: estimate with two standard deviations, and truth"),
        "speed": speed_figure(drive, "Speed and steering"),
    }
    if np.isfinite(drive.stiffness_npr).any():
        figures["stiffness"] = stiffness_figure(one, "Cornering stiffness: estimate and secant of the truth")
    return figures


def map_figure(drives: Drives, path: ReferencePath, title: str) -> Figure:
    """Draw the path and where robots were."""
    with styled():
        figure = new_figure(8.4, 5.2)
        axes = figure.add_subplot()
        axes.plot(path.rows[:, X], path.rows[:, Y], color=INK, lw=2.4, alpha=0.35, label="path")
        for (name, drive), colour in zip(drives.items(), COLOURS, strict=False):
            axes.plot(*drive.position_m.T, color=colour, lw=1.2, label=name)
        axes.set(xlabel="x [m]", ylabel="y [m]")
        axes.set_aspect("equal", adjustable="datalim")
        add_legend(axes)
        return finished(figure, title)


def lateral_figure(
    drives: Drives, limit_m: float, title: str, offset_m: float = 0.0, shown_m: float = 1.5
) -> Figure:
    """Draw lateral errors over distance, with limits; beyond ``shown_m`` they leave the figure."""
    with styled():
        figure = new_figure(8.4, 3.8)
        axes = figure.add_subplot()
        for sign in (-1.0, 1.0):
            axes.axhline(
                sign * limit_m, color=GREY, lw=1.0, ls="--", label="speed / 10" if sign > 0 else None
            )
        largest = limit_m
        for (name, drive), colour in zip(drives.items(), COLOURS, strict=False):
            error = drive.lateral_m - offset_m
            axes.plot(drive.distance_m, error, color=colour, lw=1.2, label=name)
            largest = max(largest, float(np.abs(error).max()))
        axes.set(xlabel="distance along the path [m]", ylabel="lateral error [m]")
        axes.set_ylim(*(1.1 * min(largest, shown_m) * np.array([-1.0, 1.0])))
        add_legend(axes)
        return finished(figure, title)


def sideslip_figure(drive: FollowedDrive, title: str) -> Figure:
    """Draw the slip angles of both axles over time, estimate beside truth."""
    with styled():
        figure = new_figure(8.4, 5.2)
        for j, (axes, wheel) in enumerate(zip(figure.subplots(2, 1, sharex=True), WHEELS, strict=True)):
            estimate, std = np.degrees(drive.slip_rad[:, j]), np.degrees(drive.slip_std_rad[:, j])
            axes.fill_between(
                drive.time_s, estimate - 2 * std, estimate + 2 * std, color=BLUE, alpha=0.18, lw=0
            )
            axes.plot(drive.time_s, estimate, color=BLUE, lw=1.1, label="estimate, ± 2 std")
            axes.plot(drive.time_s, np.degrees(drive.slip_true_rad[:, j]), color=INK, lw=1.0, label="true")
            known = np.abs(estimate[np.isfinite(estimate)])
            shown = 1.4 * max(2.0, float(known.max(initial=0.0)))
            axes.set(ylabel=f"{wheel} [deg]", ylim=(-shown, shown))
            axes.grid()
            if j == 0:
                add_legend(axes)
        axes.set_xlabel("time [s]")
        return finished(figure, title)


def stiffness_figure(drives: Drives, title: str) -> Figure:
    """Draw the cornering stiffness of both axles over time, and the secant of the last drive's truth."""
    with styled():
        figure = new_figure(8.4, 5.2)
        for j, (axes, wheel) in enumerate(zip(figure.subplots(2, 1, sharex=True), WHEELS, strict=True)):
            for (name, drive), colour in zip(drives.items(), COLOURS, strict=False):
                axes.plot(drive.time_s, drive.stiffness_npr[:, j] / 1e3, color=colour, lw=1.2, label=name)
                axes.plot(
                    *(drive.time_s, drive.secant_npr[:, j] / 1e3, "."),
                    color=INK if len(drives) == 1 else colour,
                    ms=1.5,
                    alpha=0.5,
                    label="true secant, where excited" if drive is list(drives.values())[-1] else None,
                )
            axes.set(ylabel=f"{wheel} [kN/rad]", ylim=(0.0, 32.0))
            axes.grid()
            if j == 0:
                add_legend(axes)
        axes.set_xlabel("time [s]")
        return finished(figure, title)


def speed_figure(drive: FollowedDrive, title: str) -> Figure:
    """Draw speed and steering angle over distance."""
    with styled():
        figure = new_figure(8.4, 4.6)
        above, below = figure.subplots(2, 1, sharex=True)
        above.plot(drive.distance_m, drive.speed_mps, color=BLUE, lw=1.2)
        below.plot(drive.distance_m, np.degrees(drive.steer_rad), color=BLUE, lw=1.2)
        above.set_ylabel("speed [m/s]")
        below.set(ylabel="steering [deg]", xlabel="distance along the path [m]")
        for axes in (above, below):
            axes.grid()
        return finished(figure, title)
