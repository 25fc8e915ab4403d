"""The slope of the terrain along a path."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.records import Array
from terrain.simulation.planar.model import VX, VY, W


class Hills(NamedTuple):
    """The lie of the land, level by default.

    Parameters
    ----------
    grade_ratio : mean gradient along the start's heading and to its left, uphill positive
    undulation_ratio : standard deviation of what undulations add to either
    undulation_length_m : about their wave length; three of them cross in drawn directions
    """

    grade_ratio: tuple[float, float] = (0.0, 0.0)
    undulation_ratio: float = 0.0
    undulation_length_m: float = 15.0


def undulations(hills: Hills, rng: np.random.Generator) -> Array:
    """Return (3, 4) of the undulations: amplitude along their two axes' direction, wave numbers, phase."""
    waves = np.zeros((0, 4))
    if hills.undulation_ratio:
        direction = rng.uniform(0.0, math.pi, 3)
        phase = rng.uniform(0.0, 2.0 * math.pi, 3)
        size = np.full(3, hills.undulation_ratio * math.sqrt(4.0 / 3.0))
        number = 2.0 * math.pi / (hills.undulation_length_m * np.array([0.7, 1.0, 1.4]))
        waves = np.column_stack([size, number, direction, phase])
    return waves


@njit(cache=True)
def path_of(truth: Array, dt: float) -> Array:
    """Return east, north and heading (n, 3) of the body's origin, from 0."""
    n = truth.shape[0]
    pose = np.zeros((n, 3))
    for k in range(1, n):
        yaw = pose[k - 1, 2] + 0.5 * dt * (truth[k - 1, W] + truth[k, W])
        middle = 0.5 * (yaw + pose[k - 1, 2])
        x, y = 0.5 * (truth[k - 1, VX] + truth[k, VX]), 0.5 * (truth[k - 1, VY] + truth[k, VY])
        cos, sin = math.cos(middle), math.sin(middle)
        pose[k, 0] = pose[k - 1, 0] + dt * (x * cos - y * sin)
        pose[k, 1] = pose[k - 1, 1] + dt * (x * sin + y * cos)
        pose[k, 2] = yaw
    return pose


@njit(cache=True)
def tilt_along(pose: Array, grade_ratio: Array, waves: Array) -> tuple[Array, Array]:
    """Return grade (nose up positive) and roll (left side up positive) (n,) of a body along its path."""
    n = pose.shape[0]
    grade, roll = np.zeros(n), np.zeros(n)
    for k in range(n):
        east, north = grade_ratio[0], grade_ratio[1]
        for i in range(waves.shape[0]):
            cos, sin = math.cos(waves[i, 2]), math.sin(waves[i, 2])
            value = waves[i, 0] * math.cos(waves[i, 1] * (pose[k, 0] * cos + pose[k, 1] * sin) + waves[i, 3])
            east += value * cos
            north += value * sin
        cos, sin = math.cos(pose[k, 2]), math.sin(pose[k, 2])
        ahead, left = east * cos + north * sin, -east * sin + north * cos
        grade[k] = math.atan(ahead / math.hypot(1.0, left))
        roll[k] = math.atan(left)
    return grade, roll
