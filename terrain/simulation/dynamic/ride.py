"""The terrain below the wheels: its gradient, its patches and its roughness."""

from __future__ import annotations

import math

from numba import njit

from terrain.records import Array
from terrain.simulation.dynamic.plant import Plant
from terrain.simulation.dynamic.states import CONTACT, RIDE, RIDE_RATE, ROAD

ROUGHNESS_WAVENUMBER = 0.1
"""Reference wave number of ISO 8608 in cycles/m."""

ROUGHNESS_CUTOFF = 0.01
"""Longest wave of the ground that counts as roughness, in cycles/m (ISO 8608's lower end)."""


@njit(cache=True)
def terrain_gradient(plant: Plant, state: Array, cos_yaw: float, sin_yaw: float) -> tuple[float, float]:
    """Gradient of the ground in body axes, uphill positive."""
    undulation = plant.undulation_ratio * math.sin(2 * math.pi * state[6] / plant.undulation_length_m)
    world_x, world_y = plant.grade_ratio[0] + undulation, plant.grade_ratio[1]
    return cos_yaw * world_x + sin_yaw * world_y, -sin_yaw * world_x + cos_yaw * world_y


@njit(cache=True)
def patch_index(plant: Plant, path_m: float) -> int:
    """Return the number of the patch at a path length."""
    patch = 0
    while patch + 1 < plant.patch_start_m.size and path_m >= plant.patch_start_m[patch + 1]:
        patch += 1
    return patch


@njit(cache=True)
def ride_over(plant: Plant, w: Array, i: int, patch: int, speed: float, noise: float, dt: float) -> float:
    """Move the corner on its tyre over the rough ground; return what that adds to the load.

    Roughness of waviness 2 is white in slope: ``d(road)/dt = -2 pi n_c v road + 2 pi n_0 sqrt(G v) w`` with
    ``w`` white of one-sided density 1 (ISO 8608); the contact averages it over its length.
    """
    white = noise * math.sqrt(0.5 / dt)
    w[ROAD] += dt * (
        -2 * math.pi * ROUGHNESS_CUTOFF * speed * w[ROAD]
        + 2 * math.pi * ROUGHNESS_WAVENUMBER * math.sqrt(plant.roughness_m3[patch] * speed) * white
    )
    contact_rate = (w[ROAD] - w[CONTACT]) * min(2.0 * speed / plant.contact_length_m, 1.0 / dt)
    w[CONTACT] += dt * contact_rate
    mass_kg = plant.mass_kg * plant.load_fraction[i]
    force_n = plant.ride_stiffness_npm * (w[CONTACT] - w[RIDE]) + plant.ride_damping_nspm * (
        contact_rate - w[RIDE_RATE]
    )
    w[RIDE_RATE] += dt * force_n / mass_kg
    w[RIDE] += dt * w[RIDE_RATE]
    return float(force_n)
