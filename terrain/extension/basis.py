"""The numbers of a description that an effect's value is relative to, and whether they are assumed."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from terrain.effects import PARAMETER
from terrain.extension.description import apply_homes
from terrain.robots import Robot


class Origin(StrEnum):
    """Where a number of a description comes from."""

    SOURCED = "sourced"
    ASSUMED = "assumed"
    LEFT_OUT = "left out"


class Basis(NamedTuple):
    """A number of a robot's description that a parameter of an effect changes.

    Parameters
    ----------
    section, field : of the description; the section is empty for a number of the robot itself
    described : the number as it stands; the neutral one of :attr:`terrain.robots.Robot.completed` where the
        description lacks the section
    extended : the number with the parameter's value
    origin : where the described number comes from
    written : what the description calls it: of tracks ``sprocket_radius_m`` is the ``wheel_radius_m``
    """

    section: str
    field: str
    described: float
    extended: float
    origin: Origin
    written: str

    @property
    def name(self) -> str:
        """Name of the number, as :attr:`terrain.robots.Robot.assumed` has it."""
        return f"{self.section}.{self.written}" if self.section else self.written


def basis_of(robot: Robot, parameter: str, value: float = 0.0) -> tuple[Basis, ...]:
    """Return the described numbers that a parameter of an effect changes; none where it has no home.

    A lever arm of -0.23 m is relative to the lever arm described: where that one is assumed, so is half of
    the answer, and only their sum was measured.

    Parameters
    ----------
    robot : whose description it is; its own effects are not applied
    parameter : of :data:`terrain.effects.PARAMETER`
    value : that was found of it

    Raises
    ------
    KeyError
        if there is no such parameter.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> (basis,) = basis_of(load_robot("husky"), "lever_x_m", -0.23)
    >>> basis.name, basis.described, round(basis.extended, 2), basis.origin.value
    ('camera.lever_x_m', 0.35, 0.12, 'assumed')
    >>> basis_of(load_robot("husky"), "yaw_delay_s")
    ()
    """
    before = replace(robot.completed, effects={}, effects_cov=np.empty((0, 0)))
    after = apply_homes(replace(before, effects={parameter: value}, effects_cov=np.full((1, 1), np.nan)))
    found = []
    for home in PARAMETER[parameter].homes:
        if home.section and home.section not in before.parts:
            continue
        written = home.field if home.section else robot.spelled.get(home.field, home.field)
        name = f"{home.section}.{written}" if home.section else written
        origin = Origin.ASSUMED if name in robot.assumed else Origin.SOURCED
        if home.section and not robot.describes(home.section):
            origin = Origin.LEFT_OUT
        described, extended = (_number(each, home.section, home.field) for each in (before, after))
        found.append(Basis(home.section, home.field, described, extended, origin, written))
    return tuple(found)


def _number(robot: Robot, section: str, field: str) -> float:
    part: Any = robot.parts[section] if section else robot
    return float(getattr(part, field))
