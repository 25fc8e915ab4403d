"""The simulation, and the description of the robot, with what it lacked built in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.verdict import INTERVAL_T, Diagnosis
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot


def extend(simulation: Simulation, diagnosis: Diagnosis) -> Simulation:
    """Return the simulation with the named causes added to what is built in already.

    Ambiguous sets are left out: which of their effects acts is not known.

    Raises
    ------
    ConfigError
        if nothing was named, or the diagnosis is of another robot.
    """
    if diagnosis.robot != simulation.robot.name:
        raise ConfigError(
            f"the diagnosis is of the robot {diagnosis.robot!r}, the simulation of {simulation.robot.name!r}"
        )
    if not diagnosis.causes:
        raise ConfigError(
            f"the diagnosis is {diagnosis.verdict.value!r} and names no cause: there is nothing to build in"
        )
    return simulation.with_effects(diagnosis.values)


class ExtendedEffects(NamedTuple):
    """Effects of an extended robot.

    Parameters
    ----------
    values : (k) by parameter
    cov : (k, k) covariance of the values, in their order
    intervals : 95 % interval by parameter
    """

    values: dict[str, float]
    cov: Array
    intervals: dict[str, tuple[float, float]]


def extended_effects(robot: Robot, diagnosis: Diagnosis) -> ExtendedEffects:
    """Return the effects of the robot with the named causes added.

    The covariance of a parameter that was found again is that of the new estimate; all other parameters keep
    theirs, and the two groups are taken as independent.

    Raises
    ------
    ConfigError
        if the covariance of the robot's effects is not known.
    """
    names = list(dict.fromkeys([*robot.effects, *diagnosis.parameters]))
    cov = np.zeros((len(names), len(names)))
    old = [names.index(name) for name in robot.effects]
    new = [names.index(name) for name in diagnosis.parameters]
    cov[np.ix_(old, old)] = robot.effects_cov
    cov[new], cov[:, new] = 0.0, 0.0
    cov[np.ix_(new, new)] = diagnosis.cov
    if not np.isfinite(cov).all():
        raise ConfigError(
            f"robot {robot.name}: its effects have no covariance, which an extended description requires"
        )
    found = diagnosis.values
    values = {name: robot.effects.get(name, 0.0) + found.get(name, 0.0) for name in names}
    halves = INTERVAL_T * np.sqrt(cov.diagonal())
    intervals = {
        name: (values[name] - float(half), values[name] + float(half))
        for name, half in zip(names, halves, strict=True)
    }
    return ExtendedEffects(values, cov, intervals)
