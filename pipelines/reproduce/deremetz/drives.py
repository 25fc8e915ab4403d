"""What the experiments share: seeded drives along the paper's courses, and ranges over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from pipelines.reproduce.over_runs import OverRuns, over_runs
from terrain.control.car_evaluation import FollowedDrive, followed_drive
from terrain.control.car_following import CarFollower, SlipSource
from terrain.control.car_scenarios import STOP, Course, slope_course, stop_course
from terrain.estimation.observers.family import Observer
from terrain.estimation.observers.sideslip_dynamic import DynamicSettings, sideslip_dynamic_observer
from terrain.estimation.observers.sideslip_multi import (
    SECTION_VI,
    MultiModelSettings,
    sideslip_multi_observer,
)
from terrain.robots import BicycleRobot, as_drive, load_robot
from terrain.simulation.bicycle.simulate import simulate_car

RUNS, FEW_RUNS = 5, 2
"""Drives that a figure is a mean of, and the number with ``quick``."""
FASTEST_MPS, FAST_MPS, MEDIUM_MPS = 6.0, 5.0, 4.0
"""Speeds of the trials of section VI.B."""
SOFT_FRONT_NPR, SOFT_REAR_NPR = 8000.0, 10000.0
"""Tyres that are softer than the observers assume at first."""


class Variant(NamedTuple):
    """A controller of the comparison: where its slip is from, and what is other about its observer."""

    source: SlipSource
    observer: Callable[[BicycleRobot], Observer] | None = None


def _with(settings: MultiModelSettings) -> Callable[[BicycleRobot], Observer]:
    return lambda robot: sideslip_multi_observer(robot, settings)


VARIANTS: dict[str, Variant] = {
    "no observer": Variant(SlipSource.NONE),
    "dynamic": Variant(SlipSource.DYNAMIC),
    "kinematic": Variant(SlipSource.KINEMATIC),
    "multi-model": Variant(SlipSource.MULTI),
    "multi-model, gains of section VI": Variant(SlipSource.MULTI, _with(SECTION_VI)),
    "multi-model, printed signs": Variant(SlipSource.MULTI, _with(MultiModelSettings(as_printed=True))),
    "multi-model with preview": Variant(SlipSource.GRIP),
    "dynamic at every speed": Variant(
        SlipSource.DYNAMIC,
        lambda robot: sideslip_dynamic_observer(robot, DynamicSettings(slowest_mps=1e-3)),
    ),
}
"""Controllers by name."""


def adap2e() -> BicycleRobot:
    """Return the robot of the paper."""
    return as_drive(BicycleRobot, load_robot("adap2e"), "robot {name}: a car-like one is needed")


@lru_cache(maxsize=64)
def follow(course: str, speed_mps: float, variant: str, seed: int, soft: bool = False) -> FollowedDrive:
    """Return a drive along the course ``stop`` or ``slope``, on tyres as described or on softer ones."""
    robot, chosen = adap2e(), VARIANTS[variant]
    along = course_of(course)
    observer = None if chosen.observer is None else chosen.observer(robot)
    follower = CarFollower(robot, along.path, chosen.source, observer=observer)
    drive = along.drive(speed_mps, STOP if course == "stop" else ())
    driven = robot
    if soft:
        driven = replace(robot, front_cornering_npr=SOFT_FRONT_NPR, rear_cornering_npr=SOFT_REAR_NPR)
    run = simulate_car(driven, drive, follower, np.random.default_rng(seed))
    return followed_drive(run, along.path, follower.ticks)


def course_of(name: str) -> Course:
    """Return the course of a name."""
    return stop_course() if name == "stop" else slope_course()[0]


def drives(
    course: str, speed_mps: float, variant: str, seed: int, quick: bool, soft: bool = False
) -> list[FollowedDrive]:
    """Return drives that differ in their noise."""
    numbers = range(FEW_RUNS if quick else RUNS)
    return [follow(course, speed_mps, variant, 1000 * seed + k, soft) for k in numbers]


def over(found: list[FollowedDrive], value: Callable[[FollowedDrive], float]) -> OverRuns:
    """Return a number over drives."""
    return over_runs([value(drive) for drive in found])
