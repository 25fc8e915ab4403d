"""Drives of Deremetz et al. 2017 in simulation: the stop of Fig. 4, and the trajectory of Fig. 7.

The paper prints neither lengths nor radii nor grip: they are assumed here, and stated where they are set.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.control.paths import ReferencePath, path_from_curvature
from terrain.simulation.plants.car import CarDrive, Ground, level_ground

GRIP_RATIO = 0.7
"""Of soil and grass; assumed."""
SLOPE_RAD = float(np.deg2rad(15.0))
"""Printed."""
RAMP_M = 4.0
"""Over which curvature or slope change; assumed."""
S_BEND_PM, SLOPE_BEND_PM = 1 / 10.0, 1 / 10.0
"""Curvatures of the S-bend on level ground and of the bend on the slope; assumed."""


class Course(NamedTuple):
    """A path, and the ground along it."""

    path: ReferencePath
    ground: Ground

    def drive(self, speed_mps: float, stops: tuple[tuple[float, float], ...] = ()) -> CarDrive:
        """Return the drive along the course at a speed, with stops (distance in m, time in s)."""
        stood_s = sum(seconds for _, seconds in stops)
        longest_s = 3.0 * self.path.length_m / speed_mps + 20.0 + stood_s
        return CarDrive(speed_mps, stops, longest_s, self.path.start)


def _along(parts: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Return distances and values of parts (length in m, value), with ramps of RAMP_M between them."""
    distance, values = [0.0], [parts[0][1]]
    for length_m, value in parts:
        if value != values[-1]:
            distance.append(distance[-1] + RAMP_M)
            values.append(value)
        distance.append(distance[-1] + length_m)
        values.append(value)
    return np.array(distance), np.array(values)


def stop_course() -> Course:
    """Return the course of Fig. 4: straight, a bend to each side, and straight, on level ground.

    Examples
    --------
    >>> round(stop_course().path.length_m)
    76
    """
    bend = 1 / 12.0
    path = path_from_curvature(*_along([(15.0, 0.0), (8.0, bend), (14.0, 0.0), (8.0, -bend), (15.0, 0.0)]))
    return Course(path, level_ground(GRIP_RATIO))


STOP: tuple[tuple[float, float], ...] = ((38.0, 3.0),)
"""Where and how long the robot stands on :func:`stop_course`, in the middle: 3 s from 38 m on."""


class Case(NamedTuple):
    """A part of the trajectory of Fig. 7."""

    name: str
    start_m: float
    end_m: float


def slope_course() -> tuple[Course, tuple[Case, ...]]:
    """Return the trajectory of Fig. 7, with its cases: S-bend, bend on a varying slope, straight on a slope.

    The bend turns uphill, which adds gravity to the centrifugal force: the harder of the two.

    Examples
    --------
    >>> [case.name for case in slope_course()[1]]
    ['S-bend on level ground', 'bend on a varying slope', 'straight on a slope']
    """
    parts = [(15.0, 0.0), (10.0, S_BEND_PM), (10.0, -S_BEND_PM), (15.0, 0.0), (20.0, SLOPE_BEND_PM)]
    path = path_from_curvature(*_along([*parts, (55.0, 0.0)]))
    slopes = [(69.0, 0.0), (14.0, SLOPE_RAD), (14.0, 0.0), (30.0, SLOPE_RAD)]
    distance, roll = _along(slopes)
    ground = Ground(distance, np.full(distance.size, GRIP_RATIO), roll)
    cases = (
        Case("S-bend on level ground", 0.0, 58.0),
        Case("bend on a varying slope", 58.0, 100.0),
        Case("straight on a slope", 100.0, path.length_m),
    )
    return Course(path, ground), cases
