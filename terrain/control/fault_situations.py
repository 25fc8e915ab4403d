"""Situations in which a sensor fault matters most, and the moment at which it begins in each."""

from __future__ import annotations

from typing import NamedTuple

from terrain.control.situations import (
    BRAKE,
    Situation,
    SituationOptions,
    brake_time,
    make_situation,
    start_times,
)
from terrain.errors import ConfigError
from terrain.robots import Robot
from terrain.simulation.conditions import Faults

START, STOP, STEADY = "start", "stop", "steady"

FAULT_SITUATIONS: dict[str, str] = {
    START: "from rest at 1 m/s^2 to 1 m/s; the fault begins as the start does",
    STOP: "a command to stop at once from 1 m/s; the fault begins with the command",
    STEADY: "at 1 m/s; the fault begins 3 s after the speed was reached",
}
"""Situations by name."""

START_LENGTH_S, STEADY_LENGTH_S = 7.0, 10.0
"""Long enough for a fault of 3 s and 2 s after it."""

STEADY_FAULT_S = 5.0
"""By then the slip of steady motion is known to the controller, after 1 s of rest and 1 s of start."""


class FaultSituation(NamedTuple):
    """A situation, and the time at which a fault begins in it."""

    situation: Situation
    start_s: float


def make_fault_situation(name: str, robot: Robot, terrain: str, seed: int) -> FaultSituation:
    """Return a situation without any fault by chance.

    Parameters
    ----------
    name : one of :data:`FAULT_SITUATIONS`
    robot : swerve robot
    terrain : soil
    seed : of all that is drawn: load, soil, tyres, noise

    Raises
    ------
    ConfigError
        if the situation or the terrain is unknown.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> make_fault_situation("start", load_robot("agrimaro"), "grass", 0).start_s
    1.0
    """
    if name not in FAULT_SITUATIONS:
        raise ConfigError(f"situation {name!r} is unknown: use {', '.join(FAULT_SITUATIONS)}")
    length_s = {START: START_LENGTH_S, STEADY: STEADY_LENGTH_S}.get(name)
    scenario = BRAKE if name == STOP else "straight"
    made = make_situation(scenario, robot, terrain, seed, SituationOptions(duration_s=length_s))
    made = made._replace(faults=Faults(by_chance=False))
    if name == START:
        return FaultSituation(made, start_times(made.scenario)[0])
    return FaultSituation(made, brake_time(made.scenario) if name == STOP else STEADY_FAULT_S)
