"""Observers by name: which a robot has, and one ready to run."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from functools import partial
from typing import Any

from terrain.errors import ConfigError
from terrain.estimation.models import sideslip
from terrain.estimation.models.observer import Observer
from terrain.estimation.models.slip import SlipFilter
from terrain.estimation.models.slip_model import SlipModel, unknown_ground
from terrain.estimation.models.slip_odometry import SlipOdometry, plain_odometry
from terrain.estimation.models.tracked import TrackedObserver
from terrain.robots import BicycleRobot, Robot

PLAIN = ("encoder-odometry", "gyrodometry", "endo")
"""Odometry that slip-compensated odometry is compared with."""


def _sideslip(name: str, robot: BicycleRobot, _: SlipModel) -> Observer:
    return sideslip.Sideslip(robot, name)


_SLIP: Mapping[str, Callable[[Any, SlipModel], Observer]] = {"slip": lambda robot, _: SlipFilter(robot)}

OBSERVERS_OF_DRIVE: Mapping[str, Mapping[str, Callable[[Any, SlipModel], Observer]]] = {
    **dict.fromkeys(("swerve", "skid_steer", "omni", "mecanum", "tricycle"), _SLIP),
    "tracked": {
        **_SLIP,
        "tracked": lambda robot, _: TrackedObserver(robot),
        "slip-odometry": SlipOdometry,
        "slip-learning": lambda robot, _: SlipOdometry(robot, unknown_ground(), name="slip-learning"),
        **{name: partial(plain_odometry, name) for name in PLAIN},
    },
    "bicycle": {**_SLIP, **{name: partial(_sideslip, name) for name in sideslip.SETTINGS}},
}
"""Observers of each drive, from a robot and its slip model."""

BY_MODEL = ("slip-odometry", "endo")
"""Observers that are nothing without a slip model."""

OBSERVERS: tuple[str, ...] = tuple(
    dict.fromkeys(name for known in OBSERVERS_OF_DRIVE.values() for name in known)
)
"""Names of all observers."""


REFERENCES = ("gnss", "pose", "lidar", "odometry")
"""Streams that measure the motion over ground."""


def suitable_filter(robot: Robot, streams: Container[str]) -> str:
    """Return the filter or observer that makes most of what a log or a robot measures.

    Of swerve robots with a camera ``vio15``, and where nothing measures the motion over ground, so that slip is not
    observable, ``encoder12``; of all others ``slip``.

    Parameters
    ----------
    robot : of any drive; one whose description lists filters gets one of those
    streams : that are measured

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> swerve = load_robot("agrimaro")
    >>> suitable_filter(swerve, ("wheels", "imu")), suitable_filter(swerve, ("wheels", "imu", "gnss"))
    ('encoder12', 'slip')
    """
    if robot.drive == "swerve" and "odometry" in streams and robot.describes("camera"):
        name = "vio15"
    elif robot.drive == "swerve" and not any(stream in streams for stream in REFERENCES):
        name = "encoder12"
    else:
        name = "slip"
    return robot.filters[0] if robot.filters and name not in robot.filters else name


def observers_of(robot: Robot) -> tuple[str, ...]:
    """Return the names of the observers of a robot: those of its drive, or those that its description lists.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> observers_of(load_robot("adap2e")), observers_of(load_robot("husky"))
    (('slip', 'sideslip-kinematic', 'sideslip-dynamic', 'sideslip-multi'), ('slip',))
    """
    known = OBSERVERS_OF_DRIVE.get(robot.drive, {})
    return tuple(name for name in known if not robot.filters or name in robot.filters)


def make_observer(name: str, robot: Robot, slip_model: SlipModel | None = None) -> Observer:
    """Return an observer of a robot, before its first step.

    Of encoder odometry the effective track of the slip model counts.

    Raises
    ------
    ConfigError
        if the robot has no observer of that name, or it needs a slip model and none is given.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> make_observer("tracked", load_robot("orchard_ugv")).slips
    ('slip_left_ratio', 'slip_right_ratio')
    >>> make_observer("slip-odometry", load_robot("patako"))
    Traceback (most recent call last):
    terrain.errors.ConfigError: filter 'slip-odometry' needs a slip model (--slip-model), ...
    """
    if name not in (own := observers_of(robot)):
        fits = f"use {', '.join(own)}" if own else "none is"
        raise ConfigError(
            f"filter {name!r} is not for robot {robot.name}, whose drive is {robot.drive}: {fits}"
        )
    if slip_model is None and name in BY_MODEL:
        raise ConfigError(
            f"filter {name!r} needs a slip model (--slip-model), which terrain calibrate --what odometry finds; "
            "slip-learning finds its own by fixes"
        )
    return OBSERVERS_OF_DRIVE[robot.drive][name](robot, slip_model or SlipModel())
