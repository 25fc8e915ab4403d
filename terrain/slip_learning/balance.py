"""Mass and rolling resistance of a run by the force balance of the body along its direction of travel.

With the thrusts F of the wheels, the specific force f along the direction of travel (acceleration and grade),
the specific force f_z normal to the terrain, the mass m and the resistance over load rho::

    sum F = m (f + rho f_z)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.records import Array
from terrain.robots import Robot
from terrain.slip_learning.forces import WheelForces
from terrain.slip_learning.intervals import valid_intervals

BALANCE_S = 0.5
"""Length of a mean; vertical oscillation of the body at 7 Hz averages out."""

CORRELATED_MEANS = 4.0
"""Means whose errors are alike, over 2 s of terrain."""

MIN_MEANS = 4
"""Fewer means are too few for a median."""

THRUST_STD_RATIO = 0.03
"""Error that all thrusts of a run share: of the torque constant with the motor's temperature, and of currents
that are sampled in step with the commands."""

MASS_STD_RATIO = 0.15
"""Prior of the mass, relative to the described robot: payloads up to a third of it (data/spread)."""

MAX_MASS_STDS = 4.0
"""A mass further than this from its prior is not used: outside 36 to 144 kg for 90."""

TILT_STD_RAD = 0.01
"""Error of a grade by the attitude: mounting, and the body's tilt on its springs and on rough terrain."""


class Balance(NamedTuple):
    """Mass of the robot and resistance of its wheels over their load, each with one standard deviation."""

    mass_kg: float
    mass_std_kg: float
    resistance_ratio: float
    resistance_std: float


class _Means(NamedTuple):
    """Means (k,) over :data:`BALANCE_S`, and where (k - 1,) one follows another without a gap."""

    thrust_n: Array
    accel_mps2: Array
    force_mps2: Array
    normal_mps2: Array
    consecutive: Array


def body_balance(forces: WheelForces, robot: Robot, where: Array) -> Balance:
    """Return mass and resistance of a run; the resistance is NaN where there are too few means.

    Parameters
    ----------
    forces : of the run
    robot : whose mass, with a standard deviation of :data:`MASS_STD_RATIO`, is the prior
    where : (n,) whether an instant is on the terrain

    Notes
    -----
    Medians give rho; an attitude wrong by :data:`TILT_STD_RAD` is part of its uncertainty.
    """
    parts = valid_intervals(forces.time_s, forces.balance_valid & where, BALANCE_S)
    if len(parts) < MIN_MEANS:
        return Balance(robot.mass_kg, robot.mass_kg * MASS_STD_RATIO, math.nan, math.nan)
    means = _means(forces, parts)
    mass_kg, mass_std_kg = _mass(means, robot.mass_kg)
    ratio = (means.thrust_n / mass_kg - means.force_mps2) / means.normal_mps2
    rho = float(np.median(ratio))
    scatter = 1.4826 * float(np.median(np.abs(ratio - rho))) * math.sqrt(CORRELATED_MEANS / len(ratio))
    by_mass = mass_std_kg / mass_kg * abs(float(np.median(means.thrust_n / mass_kg / means.normal_mps2)))
    return Balance(mass_kg, mass_std_kg, rho, math.hypot(math.hypot(scatter, by_mass), TILT_STD_RAD))


def _means(forces: WheelForces, parts: list[slice]) -> _Means:
    thrust_n, grade, normal = (
        np.array([values[part].mean() for part in parts])
        for values in (forces.total_thrust_n, forces.grade_mps2, forces.normal_mps2)
    )
    ends = [(part.start, part.stop - 1) for part in parts]
    gained_mps = np.array([forces.speed_mps[b] - forces.speed_mps[a] for a, b in ends])
    accel = gained_mps / np.array([forces.time_s[b] - forces.time_s[a] for a, b in ends])
    consecutive = np.diff([part.start for part in parts]) == parts[0].stop - parts[0].start
    return _Means(thrust_n, accel, grade + accel, normal, consecutive)


def _mass(means: _Means, prior_kg: float) -> tuple[float, float]:
    """Return the mass and its standard deviation: its prior, combined with an estimate by changes.

    The mass is estimated by what changes from one mean to the next, with the changes of the acceleration a
    as the instrument, ``m = sum(da dF) / sum(da df)``: a is the speed gained over each mean and known well,
    while the attitude has the error of the body's tilt on rough terrain, which would bias m to low values.
    """
    prior_std_kg = prior_kg * MASS_STD_RATIO
    d_thrust, d_force, d_accel = (
        np.diff(values)[means.consecutive] for values in (means.thrust_n, means.force_mps2, means.accel_mps2)
    )
    covariation = float(d_accel @ d_force)
    found_kg = float(d_accel @ d_thrust) / covariation if covariation > 0.0 else math.nan
    # a robot that hardly changes its speed may come out at any mass, with a small error from few changes
    if len(d_accel) < MIN_MEANS or not abs(found_kg - prior_kg) < MAX_MASS_STDS * prior_std_kg:
        return prior_kg, prior_std_kg
    residual = d_accel * (d_thrust - found_kg * d_force)
    scatter_kg = math.sqrt(float(residual @ residual)) / covariation
    found_std_kg = math.hypot(scatter_kg, THRUST_STD_RATIO * found_kg)
    weight = prior_std_kg**2 / (prior_std_kg**2 + found_std_kg**2)
    return prior_kg + weight * (found_kg - prior_kg), math.sqrt(weight) * found_std_kg
