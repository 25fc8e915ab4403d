"""How stiff a contact may be for the steps of the integration: beyond that it pushes the robot by itself.

A wheel of inertia I and radius r on a contact of stiffness ``K = (dF/ds) / sigma``, with the deflection u,
the relaxation length sigma and the damping T, :data:`terrain.simulation.contact.DEFLECTION_DAMPING_S`::

    F = K (u + T x)        x = w r - v        du/dt = x        dx/dt = -k u - k T x

with ``k = K (r^2 / I + 1 / m)`` and m the mass of the body.  ``step.advance`` steps the rate first, and the
deflection with the new rate::

    x' = x - dt k (u + T x)        u' = u + dt x'

The characteristic polynomial is ``z^2 - (2 - dt k T - dt^2 k) z + 1 - dt k T``.  By Jury's criterion its
roots are inside the unit circle where ``4 - 2 dt k T - dt^2 k > 0``, that is::

    k < 4 / (dt (dt + 2 T))

The decay of the deflection with the distance rolled only widens this.  Beyond the limit a wheel's rate
changes its sign from step to step and grows until the contact slides.  Its force then jumps between the
friction limits of the load, which for a large mass exceed what the motors can give by orders of magnitude.

Three contacts share the body: the largest eigenvalue of all of them together is at most the largest of the
wheels' own plus the trace of the body's, ``sum K_i (2 / m + rho_i^2 / I_z)``, with rho_i the distance of a
wheel from the centre of mass.  A tyre as a spring k_t with a damper c under a corner of mass m_i is stepped
alike, and is stable where ``dt^2 k_t + 2 dt c < 4 m_i``.
"""

from __future__ import annotations

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.simulation.contact import DEFLECTION_DAMPING_S
from terrain.simulation.dynamic.plant import Plant
from terrain.simulation.sensors.motion import STEP_S
from terrain.terramechanics.traction import wheel_ground

CONTACT_LIMIT_PS2 = 4.0 / (STEP_S * (STEP_S + 2.0 * DEFLECTION_DAMPING_S))
"""Largest stable ``k`` in 1/s^2."""

LOAD_MARGIN_RATIO = 2.0
"""Load transfer and rough ground load a wheel with up to so many times its share of the weight."""

_SMALL_SLIP = 1e-4


def contact_ratio(plant: Plant) -> float:
    """Return ``k`` of a plant under its weight, on its stiffest ground, over its limit: unstable from 1 on.

    Parameters
    ----------
    plant : of a robot on its terrain
    """
    load_n = plant.mass_kg * GRAVITY_MPS2 * plant.load_fraction
    spin = plant.radius_m**2 / plant.wheel_inertia_kgm2
    arm_m2 = ((plant.wheels_m - plant.com_m) ** 2).sum(axis=1)
    body = 2.0 / plant.mass_kg + arm_m2 / plant.yaw_inertia_kgm2
    rates_ps2 = []
    for ground in plant.grounds:
        stiffness_npm = _slope_n(ground, load_n) / plant.relaxation_m
        rates_ps2.append((stiffness_npm * spin).max() + (stiffness_npm * body).sum())
    return float(max(rates_ps2)) / CONTACT_LIMIT_PS2


def tyre_ratio(plant: Plant) -> float:
    """Return how stiff and damped the tyres are over their limit: unstable from 1 on."""
    corner_kg = plant.mass_kg * float(plant.load_fraction.min())
    needed_kg = STEP_S * (STEP_S * plant.ride_stiffness_npm + 2.0 * plant.ride_damping_nspm) / 4.0
    return needed_kg / corner_kg


def check_step(plant: Plant, name: str) -> None:
    """Refuse a plant whose contacts or tyres are too stiff for the steps of the integration.

    Parameters
    ----------
    plant : of a robot on its terrain
    name : of the robot

    Raises
    ------
    ConfigError
        if the contacts, with :data:`LOAD_MARGIN_RATIO`, or the tyres are beyond their limit, or a number of
        them is not finite.
    """
    steps = f"robot {name}: its motion cannot be integrated in steps of {STEP_S:g} s: "
    contact = LOAD_MARGIN_RATIO * contact_ratio(plant)
    if not contact <= 1.0:
        raise ConfigError(
            f"{steps}under {plant.mass_kg:g} kg the contacts are {contact:.3g} times too stiff for the "
            "inertia of wheels and yaw; reduce mass or load, or raise these inertias"
        )
    tyre = tyre_ratio(plant)
    if not tyre <= 1.0:
        raise ConfigError(
            f"{steps}with {plant.mass_kg:g} kg the tyres are {tyre:.3g} times too stiff or too damped; raise "
            "the mass, or reduce their stiffness and damping"
        )


def _slope_n(ground: Array, load_n: Array) -> Array:
    """Return the thrust (3,) of each wheel over its slip, at the start of the curve, where it is steepest."""
    return np.array([wheel_ground(ground, load, _SMALL_SLIP, 0.0)[0] for load in load_n]) / _SMALL_SLIP
