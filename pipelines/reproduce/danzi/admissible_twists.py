"""Section 2.3.2 of Danzi, AgriMaRo thesis: body velocities at which no wheel motor saturates.

Lengths are in half wheelbases and speeds in the speed limit of the motors, as in (2.6) to (2.11).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from pipelines.reporting.drawing import CLASS_COLOURS, finished, new_figure, styled
from pipelines.reporting.line_figure import add_legend
from pipelines.reproduce.danzi.runs import ROBOT
from pipelines.reproduce.results import Finding, Picture, Row, Verdict, verdict_of
from terrain.kinematics.swerve import wheel_velocities
from terrain.kinematics.swerve_limits import admissible_scale, admissible_yaw_rate
from terrain.records import Array
from terrain.robots import load_robot

TRACKS_M = (0.7, 0.756, 1.1)
"""Lower limit of the adjustment, track of 7.2, upper limit."""
FORWARD = 0.7
"""Forward speed over its limit at which the printed equations are checked."""


def admissible_twists(seed: int, quick: bool) -> Finding:
    """Compare admissible speeds and yaw rates with the text, and the printed signs with the right ones."""
    robot = load_robot(ROBOT)
    half_m = robot.wheelbase_m / 2
    xi = robot.track_m / half_m
    places = {track_m: wheel_places(track_m / half_m) for track_m in TRACKS_M}
    picture = Picture(
        "Admissible twists without sideways motion (thesis, figure 2.8, with signs corrected) for three "
        "tracks: forward speed and yaw rate over the limits of the motors, the yaw rate times half the "
        "wheelbase. The wider the track, the flatter the region. It is convex, but no polyhedron: each wheel "
        "bounds the three-dimensional region by a cylinder.",
        _twist_figure(places, half_m),
    )
    return Finding([_translation(xi), _turn_on_the_spot(places, half_m), _printed_signs(xi)], [picture])


def wheel_places(xi: float) -> Array:
    """Return the places (3, 2) of the wheels in half wheelbases for a track of ``xi`` half wheelbases."""
    return np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -xi]])


def _translation(xi: float) -> Row:
    angle = np.linspace(0.0, 2 * np.pi, 361)
    directions = 2.0 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(angle.size)])
    slowest = float((2.0 * admissible_scale(wheel_places(xi), 1.0, directions, 1.0)).min())
    return Row(
        what="Speed in pure translation, in the slowest of 361 directions",
        where="2.3.2",
        printed="100 % of what the motors allow",
        printed_interval=(1.0, 1.0),
        simulated=slowest,
        unit="of the motors' speed",
        verdict=verdict_of(slowest, (1.0, 1.0)),
        why="Without a yaw rate all wheels move at the speed of the body.",
    )


def _turn_on_the_spot(places: Mapping[float, Array], half_m: float) -> Row:
    yaw_rates = {track_m: float(_yaw_rates(place, 0.0)[1]) for track_m, place in places.items()}
    narrow_m, wide_m = min(TRACKS_M), max(TRACKS_M)
    inverse = (narrow_m / wide_m, narrow_m / wide_m)
    return Row(
        what=f"Yaw rate of a turn on the spot with a track of {wide_m:g} m, divided by that with "
        f"{narrow_m:g} m",
        where="2.3.2, figure 2.8",
        printed="inversely proportional to the track",
        printed_interval=inverse,
        simulated=yaw_rates[wide_m] / yaw_rates[narrow_m],
        unit="ratio",
        verdict=verdict_of(yaw_rates[wide_m] / yaw_rates[narrow_m], inverse),
        why="The third wheel is the farthest from the centre and saturates first: the dimensionless yaw rate "
        "is 1/ξ where ξ, the track over half the wheelbase, is above 1. Below 1 the other two wheels "
        "saturate first, and it is 1.",
        beside={f"track {m:g} m, ξ = {m / half_m:.3f}": rate for m, rate in yaw_rates.items()},
    )


def _printed_signs(xi: float) -> Row:
    # y' - (w/2) g' for both puts wheels 1 and 2 at one end, x' - t g' the third to the left.
    printed = np.array([[-1.0, 0.0], [-1.0, 0.0], [0.0, xi]])
    admitted = float(_yaw_rates(printed, FORWARD)[1])
    corrected = float(_yaw_rates(wheel_places(xi), FORWARD)[1])
    wheels = wheel_velocities(wheel_places(xi), np.array([FORWARD, 0.0, admitted]))
    fastest = float(np.hypot(wheels[:, 0], wheels[:, 1]).max())
    return Row(
        what="Fastest wheel in the sharpest left turn that the printed equations admit, at "
        f"{FORWARD:g} of the full forward speed",
        where="(2.6) to (2.9)",
        printed="no wheel beyond 1",
        printed_interval=(0.0, 1.0),
        simulated=fastest,
        unit="of the motors' speed",
        verdict=Verdict.DIFFERS if fastest <= 1.0 else Verdict.CORRECTED,
        why="Each wheel has its own place: y' + x_i g' instead of y' - x_i g', of opposite sign for wheels 1 "
        "and 2, and x' + t g' instead of x' - t g' for the third. As printed, left and right turns are "
        "exchanged.",
        beside={"yaw rate admitted as printed": admitted, "yaw rate admitted, corrected": corrected},
    )


def _yaw_rates(places: Array, forward: float | Array) -> tuple[Array, Array]:
    return admissible_yaw_rate(places, 1.0, np.asarray(forward), np.zeros(()), 1.0)


def _twist_figure(places: Mapping[float, Array], half_m: float) -> Figure:
    speed = np.linspace(-1.0, 1.0, 401)
    with styled():
        figure = new_figure(6.4, 4.6)
        axes = figure.add_subplot()
        for (track_m, place), colour in zip(places.items(), CLASS_COLOURS, strict=False):
            low, high = _yaw_rates(place, speed)
            axes.fill_between(speed, low, high, color=colour, alpha=0.12, lw=0)
            label = f"track {track_m:g} m, ξ = {track_m / half_m:.2f}"
            axes.plot(np.r_[speed, speed[::-1]], np.r_[low, high[::-1]], color=colour, lw=1.4, label=label)
        axes.set_xlabel("forward speed over its limit")
        axes.set_ylabel("yaw rate, dimensionless (2.11)")
        add_legend(axes)
        return finished(figure, "Admissible twists, no sideways motion")
