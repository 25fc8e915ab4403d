"""Observers by name: which a robot has, and one ready to run."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from terrain.errors import ConfigError
from terrain.estimation.observers.family import Observer
from terrain.estimation.observers.plain_odometry import (
    encoder_odometry_observer,
    endo_odometry_observer,
    gyrodometry_observer,
)
from terrain.estimation.observers.sideslip_dynamic import sideslip_dynamic_observer
from terrain.estimation.observers.sideslip_kinematic import sideslip_kinematic_observer
from terrain.estimation.observers.sideslip_multi import sideslip_multi_observer
from terrain.estimation.observers.slip_learning import slip_learning_observer
from terrain.estimation.observers.slip_model import SlipModel
from terrain.estimation.observers.slip_odometry import slip_odometry_observer
from terrain.estimation.observers.tracked import tracked_observer
from terrain.estimation.observers.tracked_settings import TrackedSettings
from terrain.robots import BicycleRobot, Robot, TrackedRobot

IN_MANOEUVRES = TrackedSettings(observation_gain_ps=(2.0, 2.0, 2.0), normalised=True, eta_walk_ratio=0.03)
"""Gains of the adaptive observer for logs of any driving: as fast at every speed, and efficiencies that
change by a tenth within some seconds, as from straight motion to a turn.  Squared errors over their variance
are then 1 to 2 in manoeuvres and well below 1 in steady motion.  The paper's gains, for slip that stays as it
is, are the defaults of :class:`~terrain.estimation.observers.tracked_settings.TrackedSettings`."""

OF_TRACKED: Mapping[str, Callable[[TrackedRobot, SlipModel], Observer]] = {
    "tracked": lambda robot, _: tracked_observer(robot, IN_MANOEUVRES),
    "slip-odometry": slip_odometry_observer,
    "slip-learning": lambda robot, model: slip_learning_observer(robot),
    "encoder-odometry": lambda robot, model: encoder_odometry_observer(robot, track_ratio=model.track_ratio),
    "gyrodometry": lambda robot, _: gyrodometry_observer(robot),
    "endo": lambda robot, model: endo_odometry_observer(robot, model.turning_exponent),
}
"""Observers of tracked robots: the adaptive one, slip-compensated odometry by a slip model, the same that
finds its model by fixes, and the odometry that it is compared with."""

OF_CARS: Mapping[str, Callable[[BicycleRobot], Observer]] = {
    "sideslip-kinematic": sideslip_kinematic_observer,
    "sideslip-dynamic": sideslip_dynamic_observer,
    "sideslip-multi": sideslip_multi_observer,
}
"""Observers of car-like robots."""

BY_MODEL = ("slip-odometry", "endo")
"""Observers that are nothing without a slip model."""

OBSERVERS: tuple[str, ...] = (*OF_TRACKED, *OF_CARS)
"""Names of all observers."""


def observers_of(robot: Robot) -> tuple[str, ...]:
    """Return the names of the observers of a robot: those of its drive, or those that its description lists.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> observers_of(load_robot("adap2e"))
    ('sideslip-kinematic', 'sideslip-dynamic', 'sideslip-multi')
    >>> observers_of(load_robot("husky"))
    ()
    """
    if isinstance(robot, TrackedRobot):
        known = tuple(OF_TRACKED)
    else:
        known = tuple(OF_CARS) if isinstance(robot, BicycleRobot) else ()
    return tuple(name for name in known if name in robot.filters) if robot.filters else known


def make_observer(name: str, robot: Robot, slip_model: SlipModel | None = None) -> Observer:
    """Return an observer of a robot.

    Parameters
    ----------
    name : one of :data:`OBSERVERS`
    robot : corrected
    slip_model : of a tracked robot on its ground; of encoder odometry its effective track counts

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
    if isinstance(robot, BicycleRobot):
        return OF_CARS[name](robot)
    if slip_model is None and name in BY_MODEL:
        raise ConfigError(
            f"filter {name!r} needs a slip model (--slip-model), which terrain calibrate --what odometry finds; "
            "slip-learning finds its own by fixes"
        )
    assert isinstance(robot, TrackedRobot)
    return OF_TRACKED[name](robot, slip_model or SlipModel())
