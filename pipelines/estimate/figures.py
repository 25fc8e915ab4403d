"""Pictures of one run: the filter beside the sensors (thesis, figures 6.1 to 6.6 and 7.2 to 7.4)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.reporting.drawing import (
    BLUE,
    CLASS_COLOURS,
    FAINT_INK,
    GRID,
    INK,
    VERMILION,
    finished,
    new_figure,
    png_bytes,
    styled,
)
from pipelines.reporting.numbers import shorten
from terrain.estimation.ekf.innovations import Innovations
from terrain.estimation.estimate import Estimate
from terrain.estimation.reference import lagged_slip_at
from terrain.estimation.stuck import stuck_intervals
from terrain.files.atomic import atomic_write
from terrain.kinematics.swerve import forward
from terrain.records import GATED, Array

GREEN = CLASS_COLOURS[2]
ORANGE = CLASS_COLOURS[1]
MAX_POINTS = 4000
"""More points a line than this are more than a picture can show."""

SWERVE_PANELS = (
    # state, unit, row of the camera that sees it, what the encoders' twist calls it
    ("speed_x_mps", "longitudinal speed [m/s]", "camera_speed_x_mps", 0),
    ("speed_y_mps", "lateral speed [m/s]", "camera_speed_y_mps", 1),
    ("yaw_rate_radps", "yaw rate [rad/s]", "camera_yaw_rate_radps", 2),
)
SKID_PANELS = (
    ("speed_mps", "speed [m/s]"),
    ("yaw_rate_radps", "yaw rate [rad/s]"),
    ("effective_track_m", "effective track [m]"),
)


def write_figures(estimate: Estimate, folder: Path) -> list[Path]:
    """Write ``<run>_motion.png`` and, where there is slip to show, ``<run>_slip.png``; return the files."""
    figures = {"motion": motion_figure(estimate)}
    if estimate.name != "skid":
        figures["slip"] = slip_figure(estimate)
    files = []
    for kind, figure in figures.items():
        folder.mkdir(parents=True, exist_ok=True)
        files.append(folder / f"{estimate.run.run_id}_{kind}.png")
        atomic_write(files[-1], png_bytes(figure))
    return files


def motion_figure(estimate: Estimate) -> Figure:
    """Draw speeds and yaw rate as estimated, as the sensors say and as they were; innovations beside them."""
    return _skid_motion(estimate) if estimate.name == "skid" else _swerve_motion(estimate)


def _swerve_motion(estimate: Estimate) -> Figure:
    track, table = estimate.track, estimate.table
    seen = estimate.name in ("vio12", "vio15")
    twist, innovations = _encoder_twist(estimate), estimate.innovations
    with styled():
        figure = new_figure(11.0, 7.6)
        panels = figure.subplots(3, 2, sharex=True, width_ratios=[3, 2])
        for (state, label, row, place), (left, right) in zip(SWERVE_PANELS, panels, strict=True):
            _line(left, table.time_s, twist[:, place], ORANGE, "encoders, forward kinematics", lw=0.8)
            if seen:
                _line(
                    left, table.time_s, table.columns([row])[:, 0], FAINT_INK, "camera, at its place", lw=0.8
                )
            if state == "yaw_rate_radps":
                _line(left, table.time_s, table.columns(["gyro_z_radps"])[:, 0], GREEN, "gyro", lw=0.6)
            _band(left, track.time_s, track.state(state), track.std(state))
            _line(left, track.time_s, track.state(state), BLUE, f"{estimate.name}, ± 2 std", lw=1.4)
            if estimate.truth is not None:
                true = estimate.truth[:, track.states.index(state)]
                _line(left, track.time_s, true, INK, "truth, behind the same low-pass", lw=0.8, ls="--")
            left.set_ylabel(label)
            left.grid()
            _innovation(right, estimate, innovations, row if seen else "gyro_z_radps")
        panels[0, 0].legend(ncols=3, fontsize=7.5, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
        for axes in panels[-1]:
            axes.set_xlabel("time [s]")
        return finished(figure, f"{shorten(estimate.run.run_id, 40)}: motion by {estimate.name}")


def _skid_motion(estimate: Estimate) -> Figure:
    track, table = estimate.track, estimate.table
    wheels = table.columns(["wheel_left_mps", "wheel_right_mps"])
    track_m, stuck = estimate.robot.track_m, np.zeros(track.time_s.size, dtype=bool)
    for interval in stuck_intervals(track.time_s, np.asarray(estimate.motion)):
        stuck |= (track.time_s >= interval.start_s) & (track.time_s <= interval.end_s)
    raw = {
        "speed_mps": (wheels.mean(axis=1), "mean of the wheels"),
        "yaw_rate_radps": (np.diff(wheels, axis=1)[:, 0] / track_m, f"wheels over {track_m:g} m"),
    }
    with styled():
        figure = new_figure(9.0, 7.6)
        for (state, label), axes in zip(SKID_PANELS, figure.subplots(3, 1, sharex=True), strict=True):
            if state in raw:
                values, name = raw[state]
                _line(axes, table.time_s, values, ORANGE, name, lw=0.8)
            if state == "yaw_rate_radps":
                _line(axes, table.time_s, table.columns(["gyro_z_radps"])[:, 0], GREEN, "gyro", lw=0.6)
            _band(axes, track.time_s, track.state(state), track.std(state))
            _line(axes, track.time_s, track.state(state), BLUE, "skid filter, ± 2 std", lw=1.4)
            _shade(axes, track.time_s, stuck, "stuck")
            axes.set_ylabel(label)
            axes.grid()
            axes.legend(ncols=4, fontsize=7.5, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
        axes.set_xlabel("time [s]")
        return finished(figure, f"{shorten(estimate.run.run_id, 40)}: motion without a speed reference")


def _innovation(axes: Axes, estimate: Estimate, innovations: Innovations, row: str) -> None:
    track = estimate.track
    value, std = innovations.row(row)
    sensor = next(k for k, (_, rows) in enumerate(estimate.model.sensors) if row in rows)
    gated = track.use[:, sensor] == GATED
    axes.fill_between(track.time_s, -2 * std, 2 * std, color=GRID, lw=0, label="± 2 std expected")
    _line(axes, track.time_s, np.where(gated, np.nan, value), BLUE, "innovation", lw=0.6)
    axes.plot(track.time_s[gated], np.zeros(gated.sum()), "x", color=VERMILION, ms=4, label="gated")
    used = value[~gated & np.isfinite(value)]
    variance = f"{used.var():.1e}" if used.size else "none"
    axes.set_title(f"innovation of {row}, variance {variance}", loc="left", fontsize=8, color=FAINT_INK)
    if used.size:
        reach = 1.2 * max(float(np.nanmax(2 * std)), float(np.percentile(np.abs(used), 99.5)))
        axes.set_ylim(-reach, reach)
    axes.grid()


def slip_figure(estimate: Estimate) -> Figure:
    """Draw the slip of each wheel with its uncertainty, and the two speeds that it is made of."""
    track, slip = estimate.track, estimate.slip
    shown = slip if estimate.observable else estimate.blind
    true = None
    if "truth" in estimate.run.streams:
        true = lagged_slip_at(estimate.run, estimate.robot, track.time_s)
    with styled():
        figure = new_figure(9.0, 6.6)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1, 2])
        wheel_speed = estimate.table.columns([f"wheel_{wheel}_radps" for wheel in slip.wheels])
        _line(above, track.time_s, track.state("speed_x_mps"), INK, "speed over ground, estimated", lw=1.4)
        for i, wheel in enumerate(slip.wheels):
            _line(
                above,
                estimate.table.time_s,
                wheel_speed[:, i] * estimate.robot.wheel_radius_m,
                CLASS_COLOURS[i],
                f"circumference, wheel {wheel}",
                lw=0.7,
            )
        above.set_ylabel("speed [m/s]")
        above.legend(ncols=4, fontsize=7.5, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
        above.grid()
        for i, wheel in enumerate(slip.wheels):
            if estimate.observable:
                _band(below, track.time_s, slip.slip_ratio[:, i], slip.slip_std[:, i], CLASS_COLOURS[i])
            _line(below, track.time_s, shown.slip_ratio[:, i], CLASS_COLOURS[i], f"wheel {wheel}", lw=1.0)
            if true is not None:
                label = None if i else "truth, behind the same low-pass"
                _line(below, track.time_s, true[:, i], INK, label, lw=0.6, ls="--")
        _shade(below, track.time_s, slip.stale, "stale: no speed reference")
        mean = estimate.figures.steady_mean
        if np.isfinite(mean):
            below.axhline(mean, color=VERMILION, lw=1.0, ls=":", label=f"steady mean {mean:.3f}")
        backward = np.nanmin(np.append(track.state("speed_x_mps"), 0.0)) < -0.1
        below.set(ylim=(-0.6 if backward else -0.05, 0.6), xlabel="time [s]")
        below.set_ylabel("slip ratio" if estimate.observable else "blind figure, no slip")
        below.legend(ncols=4, fontsize=7.5, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
        below.grid()
        words = "slip" if estimate.observable else "slip is not observed"
        return finished(figure, f"{shorten(estimate.run.run_id, 40)}: {words}, {estimate.name}")


def _encoder_twist(estimate: Estimate) -> Array:
    robot, table = estimate.robot, estimate.table
    rates = table.columns([f"wheel_{wheel}_radps" for wheel in robot.wheels])
    steer = table.columns([f"steer_{wheel}_rad" for wheel in robot.wheels])
    return forward(robot.wheel_positions_m, robot.wheel_radius_m, rates, steer)[0]


def _line(
    axes: Axes, time_s: Array, values: Array, colour: str, label: str | None, lw: float, ls: str = "-"
) -> None:
    every = max(1, len(time_s) // MAX_POINTS)
    axes.plot(time_s[::every], values[::every], color=colour, label=label, lw=lw, ls=ls)


def _band(axes: Axes, time_s: Array, mean: Array, std: Array, colour: str = BLUE) -> None:
    every = max(1, len(time_s) // MAX_POINTS)
    low, high = (mean - 2 * std)[::every], (mean + 2 * std)[::every]
    axes.fill_between(time_s[::every], low, high, color=colour, alpha=0.22, lw=0)


def _shade(axes: Axes, time_s: Array, marked: Array, label: str) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(int)))
    for n, (begin, end) in enumerate(edges.reshape(-1, 2)):
        until_s = time_s[min(end, len(time_s) - 1)]
        axes.axvspan(time_s[begin], until_s, color=GRID, lw=0, zorder=0, label=None if n else label)
