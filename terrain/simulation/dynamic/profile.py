"""The terrain of one run: what soil is where along the path, and how it varies there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.conditions import Conditions
from terrain.simulation.scenario.scenario import Scenario
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import ground_array

FIELD_STEP_M = 0.1
"""Grid of the variation of the terrain along the path."""

MAX_FIELD_CELLS = 5 * 10**6
"""Cells of terrain up to the farthest point that the fastest wheel can reach; 24 h at 2 m/s take 3.5
million."""


class TerrainProfile(NamedTuple):
    """The terrain of one run, by patches along the path.

    Parameters
    ----------
    grounds : (patches, GROUND_SIZE) of :func:`terrain.terramechanics.traction.ground_array`
    roughness_m3 : (patches,) ISO 8608 roughness
    start_m : (patches,) path length at which each begins, the first at 0
    field : (2, 3, cells) factors along the path on thrust and on resistance, for each wheel
    """

    grounds: Array
    roughness_m3: Array
    start_m: Array
    field: Array


def uniform_profile(
    robot: Robot, *soils: Soil, roughness_m3: float = 0.0, start_m: tuple[float, ...] = (0.0,)
) -> TerrainProfile:
    """Return a terrain of one soil a patch without variation along the path, all patches equally rough."""
    roughness = np.full(len(soils), roughness_m3)
    return TerrainProfile(_grounds(robot, soils), roughness, np.array(start_m), np.ones((2, 3, 1)))


def draw_profile(
    robot: Robot,
    scenario: Scenario,
    soils: Mapping[str, Soil],
    conditions: Conditions,
    rng: np.random.Generator,
) -> TerrainProfile:
    """Return the terrain of a scenario, drawn as its soils and the conditions describe.

    Raises
    ------
    ConfigError
        if a terrain has no soil, or the robot gets too far to hold its terrain in memory.
    """
    for patch in scenario.patches:
        if patch.terrain not in soils:
            raise ConfigError(f"scenario {scenario.name}: terrain {patch.terrain!r} has no soil")
    used = [soils[patch.terrain] for patch in scenario.patches]
    start_m = np.array([patch.start_m for patch in scenario.patches])
    speed_max_radps = robot.equipment.motors.speed_max_radps
    farthest_m = 2.0 * robot.wheel_radius_m * speed_max_radps * scenario.time_s[-1]
    n_cells = math.ceil(farthest_m / FIELD_STEP_M) + 1
    if n_cells > MAX_FIELD_CELLS:
        raise ConfigError(
            f"robot {robot.name}: its wheels can come {farthest_m / 2e3:g} km far in this run, "
            f"{MAX_FIELD_CELLS * FIELD_STEP_M / 2e3:g} km of terrain are simulated at most"
        )
    keep = math.exp(-FIELD_STEP_M / conditions.field_length_m)
    white = rng.standard_normal((2, 3, n_cells))
    white[:, :, 1:] *= math.sqrt(1.0 - keep**2)
    unit = lfilter([1.0], [1.0, -keep], white, axis=2)
    patch_of_cell = np.searchsorted(start_m, np.arange(n_cells) * FIELD_STEP_M, side="right") - 1
    ratios = np.array([[soil.thrust_field_ratio, soil.resistance_field_ratio] for soil in used])
    spread = ratios[patch_of_cell].T
    field = np.exp(spread[:, None, :] * unit - 0.5 * spread[:, None, :] ** 2)
    roughness = np.array([soil.roughness_m3 * conditions.roughness_factor for soil in used])
    return TerrainProfile(_grounds(robot, used), roughness, start_m, field)


def _grounds(robot: Robot, soils: list[Soil] | tuple[Soil, ...]) -> Array:
    body = robot.equipment.body
    geometry = robot.wheel_radius_m, body.tyre_width_m, body.contact_length_m
    return np.array([ground_array(soil, *geometry) for soil in soils])
