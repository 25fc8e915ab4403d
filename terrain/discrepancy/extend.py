"""The simulation with what it lacked built in."""

from __future__ import annotations

from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.verdict import Diagnosis
from terrain.errors import ConfigError


def extend(simulation: Simulation, diagnosis: Diagnosis) -> Simulation:
    """Return the simulation with the named causes built in, over what it has of them already.

    Sets of which one is there and these runs do not tell which are left out: none of them is known.

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
            f"the diagnosis is {diagnosis.verdict!r} and names no cause: there is nothing to build in"
        )
    return simulation.with_effects(diagnosis.values)
