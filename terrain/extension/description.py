"""Effects that are no more than other numbers of a robot's description."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from terrain.effects import PARAMETER, Home
from terrain.errors import ConfigError
from terrain.robots import Robot

AnyRobot = TypeVar("AnyRobot", bound=Robot)
"""What is corrected keeps its drive."""


def apply_homes(robot: AnyRobot, names: Collection[str] = tuple(PARAMETER)) -> AnyRobot:
    """Return a robot with those of its effects that have a home in its description applied there.

    Parameters
    ----------
    robot : any; without effects it is returned as it is
    names : parameters that are applied, as far as the robot has them and the section of their home

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> extended = replace(load_robot("agrimaro"), effects={"payload_ratio": 0.1, "camera_yaw_rad": 0.02})
    >>> robot = apply_homes(extended)
    >>> round(robot.mass_kg, 3), dict(robot.effects)
    (99.0, {'camera_yaw_rad': 0.02})
    """
    applied = []
    for name, value in robot.effects.items():
        homes = PARAMETER[name].homes
        if name in names and homes and all(home.optional or _has_section(robot, home) for home in homes):
            for home in homes:
                robot = _apply(robot, home, value)
            applied.append(name)
    return _without(robot, applied)


def corrected(robot: AnyRobot) -> AnyRobot:
    """Return the robot that filters take, together with a log that is :func:`corrected_log`.

    Effects with a home in the description are applied there; of the others those are left that have no
    inverse on samples.  A robot without effects is returned as it is, and so is one that was corrected.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot = corrected(replace(load_robot("agrimaro"), effects={"wheel_radius_ratio": 0.05}))
    >>> round(robot.wheel_radius_m, 3), dict(robot.effects)
    (0.21, {})
    """
    return _without(apply_homes(robot), [name for name in robot.effects if PARAMETER[name].inverse])


def check_corrected(robot: Robot) -> None:
    """Refuse a robot with effects that :func:`corrected` would apply or that samples would be corrected for.

    Raises
    ------
    ConfigError
        if there are any: a filter would take them for motion.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> check_corrected(replace(load_robot("agrimaro"), effects={"camera_yaw_rad": 0.02}))
    Traceback (most recent call last):
    terrain.errors.ConfigError: robot agrimaro: camera_yaw_rad is not corrected, neither in it nor in its log
    """
    left = set(robot.effects) - set(corrected(robot).effects)
    if left:
        raise ConfigError(
            f"robot {robot.name}: {', '.join(sorted(left))} is not corrected, neither in it nor in its log"
        )


def _has_section(robot: Robot, home: Home) -> bool:
    return not home.section or robot.describes(home.section)


def _apply(robot: AnyRobot, home: Home, value: float) -> AnyRobot:
    """Return a robot with one number of its description changed; the same robot if it lacks the section."""
    if not _has_section(robot, home):
        return robot
    part: Any = robot.parts[home.section] if home.section else robot
    if home.scaled_by:
        value *= getattr(part, home.scaled_by)
    part = replace(part, **{home.field: home.combine.apply(getattr(part, home.field), value)})
    changed: AnyRobot = robot.with_parts(**{home.section: part}) if home.section else part
    return changed


def _without(robot: AnyRobot, names: Collection[str]) -> AnyRobot:
    kept = [i for i, name in enumerate(robot.effects) if name not in names]
    if len(kept) == len(robot.effects):
        return robot
    effects = list(robot.effects.items())
    return replace(
        robot, effects=dict(effects[i] for i in kept), effects_cov=robot.effects_cov[np.ix_(kept, kept)]
    )
