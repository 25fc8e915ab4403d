"""Where robots of each drive touch the ground."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.robots import BicycleRobot, Robot, TrackedRobot

TRACK_PATCHES = 4  # along a track, each of an even pressure


class Contact(NamedTuple):
    """Where a robot touches the ground: the number of its wheel, its place, and how the wheel turns it there."""

    wheel: int
    x_m: float
    y_m: float
    side_ratio: float = (
        0.0  # -1 and 1 of the left and the right tyre behind a differential, or that turn freely
    )
    ackermann_m: float = 0.0  # wheelbase, where both tyres of a steered axle roll about one centre
    in_line_ratio: float = 0.0  # 1 and -1 of tyres that drive forward, and backward, in the rut of another


def contacts_of(robot: Robot) -> tuple[Contact, ...]:
    """Return where a robot touches the ground.

    A side of a skid-steer robot has a tyre at either end of the wheelbase, a track patches along its length, an
    axle of a car-like robot a tyre on either side, and every other wheel is one contact.  Rear tyres of a car
    follow the front ones in their ruts, which are pressed already: they compact no soil.  Those of robots that skid
    press ruts of their own.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> [contact[:3] for contact in contacts_of(load_robot("husky"))]
    [(0, 0.256, 0.2854), (0, -0.256, 0.2854), (1, 0.256, -0.2854), (1, -0.256, -0.2854)]
    """
    contacts, length_m = [], robot.wheelbase_m
    ahead_m = np.zeros(1)
    if robot.skids:
        ahead_m = np.array([0.5, -0.5]) * length_m
    if isinstance(robot, TrackedRobot):
        ahead_m = length_m * (0.5 - (np.arange(TRACK_PATCHES) + 0.5) / TRACK_PATCHES)
    for i, (x_m, y_m) in enumerate(robot.wheel_positions_m.tolist()):
        if isinstance(robot, BicycleRobot) and not (robot.front_driven and i == 0):
            steered_m = length_m if robot.wheels[i] in robot.steered_wheels else 0.0
            sides = ((-1.0, robot.track_m / 2), (1.0, -robot.track_m / 2))
            in_line = 0.0 if robot.front_driven else -1.0 if steered_m else 1.0
            contacts += [Contact(i, x_m, left_m, side, steered_m, in_line) for side, left_m in sides]
        else:
            contacts += [Contact(i, x_m + ahead, y_m) for ahead in ahead_m.tolist()]
    return tuple(contacts)
