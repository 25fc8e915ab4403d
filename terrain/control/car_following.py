"""A car-like robot that follows a path: observer, steering law and preview as a controller in the loop.

At a tick the observer takes what was measured, the path gives the deviations of the estimated pose, and
:mod:`terrain.control.steering_law` the steering.  Without an observer of sideslip the slip is 0, and the pose
is that of the extended kinematic model without slip.  The robot stops where it does not know where it is: no
fix for three seconds, or further from the path than its search reaches; at the end the drive is finished.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.control import grip_preview
from terrain.control.grip_preview import GripSettings
from terrain.control.paths import PathStatus, ReferencePath, locate
from terrain.control.steering_law import STATE_SIZE, SteeringSettings, steer, steering_params
from terrain.estimation.observers.family import Observer, ObserverOutput
from terrain.estimation.observers.sideslip_dynamic import sideslip_dynamic_observer
from terrain.estimation.observers.sideslip_kinematic import sideslip_kinematic_observer
from terrain.estimation.observers.sideslip_multi import sideslip_multi_observer
from terrain.estimation.observers.sideslip_pose import (
    IN_RATE,
    IN_SPEED,
    ROLL,
    SINCE_FIX,
    SPEED,
    PoseSettings,
)
from terrain.records import Array
from terrain.robots.bicycle import BicycleRobot
from terrain.simulation.bicycle.simulate import CarCommand, CarSample

REACH_TIME_CONSTANTS = 1.0
"""Of the steering, by which the sideslip expected ahead is steered before it comes, beside the dead time."""
LOST_STOP_S = 3.0
"""Longer without a fix the robot stops."""


class SlipSource(StrEnum):
    """Where a controller has its sideslip from."""

    NONE = "none"
    DYNAMIC = "dynamic"
    KINEMATIC = "kinematic"
    MULTI = "multi"
    GRIP = "multi-grip"
    """The multi-model observer, and the preview by its cornering stiffness."""


def sideslip_observer(robot: BicycleRobot, source: SlipSource) -> Observer:
    """Return the observer of a source; of ``none``, one whose slip stays 0.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> sideslip_observer(load_robot("adap2e"), SlipSource.GRIP).name
    'sideslip-multi'
    """
    if source is SlipSource.NONE:
        return sideslip_kinematic_observer(robot, PoseSettings(slip_gain=0.0))
    if source is SlipSource.KINEMATIC:
        return sideslip_kinematic_observer(robot)
    return (
        sideslip_dynamic_observer(robot) if source is SlipSource.DYNAMIC else sideslip_multi_observer(robot)
    )


class FollowedTick(NamedTuple):
    """What a controller knew and did at a tick.

    Parameters
    ----------
    time_s : of the tick
    distance_m, lateral_m : on the path, by the estimated pose
    path_status, steer_status, observer_status : numbers of their enums
    estimate : of the observer
    steer_rad, speed_mps : commanded
    grip_ratio, grip_std : as estimated; NaN without the preview
    """

    time_s: float
    distance_m: float
    lateral_m: float
    path_status: int
    steer_status: int
    observer_status: int
    estimate: ObserverOutput
    steer_rad: float
    speed_mps: float
    grip_ratio: float
    grip_std: float


class CarFollower:
    """Controller of a drive along a path, for :func:`terrain.simulation.bicycle.simulate.simulate_car`.

    Parameters
    ----------
    robot : car-like
    path : to follow
    source : of the sideslip
    steering : gains of the law
    grip : settings of the preview, which only ``multi-grip`` has
    observer : another observer than :func:`sideslip_observer` gives
    """

    def __init__(
        self,
        robot: BicycleRobot,
        path: ReferencePath,
        source: SlipSource = SlipSource.MULTI,
        steering: SteeringSettings = SteeringSettings(),  # noqa: B008
        grip: GripSettings = GripSettings(),  # noqa: B008
        observer: Observer | None = None,
    ) -> None:
        self._path, self._source = path, SlipSource(source)
        self._observer = sideslip_observer(robot, self._source) if observer is None else observer
        self._memory, self._law_memory = np.array(self._observer.start), np.zeros(STATE_SIZE)
        self._law = steering_params(robot, steering)
        self._reach_s = steering.delay_s + REACH_TIME_CONSTANTS * robot.steering_time_constant_s
        self._grip, self._grip_memory = grip_preview.grip_params(robot, grip)
        self._before_m, self._time_s = math.nan, math.nan
        self.ticks: list[FollowedTick] = []
        """What was known and done, in the order of time."""

    def __call__(self, sample: CarSample) -> CarCommand:
        """Return the command of a tick."""
        dt_s = 0.0 if math.isnan(self._time_s) else sample.time_s - self._time_s
        self._time_s = sample.time_s
        self._memory = self._observer.step(self._observer.params, self._memory, sample.measured, dt_s)
        known = self._observer.read(self._observer.params, self._memory)
        speed = float(self._memory[SPEED])
        place = locate(self._path.rows, *map(float, known.mean[:3]), self._before_m)
        if place[4] not in (PathStatus.NO_POSE, PathStatus.FAR) or math.isnan(self._before_m):
            self._before_m = place[0] if place[4] != PathStatus.NO_POSE else math.nan
        slips = np.zeros(2) if self._source is SlipSource.NONE else known.slip
        desired, previews = sample.speed_desired_mps, self._source is SlipSource.GRIP
        if previews:
            slips, desired = self._preview(known, sample, place[0], dt_s, desired)
        steer_rad, self._law_memory, status = steer(
            self._law, self._law_memory, self._path.rows, np.array(place[:4]), slips, speed, dt_s
        )
        lost = self._memory[SINCE_FIX] > LOST_STOP_S or place[4] == PathStatus.FAR
        finished = place[4] == PathStatus.END
        command = CarCommand(steer_rad, 0.0 if lost or finished else desired, finished)
        grip = self._grip_memory if previews else np.full(2, math.nan)
        self.ticks.append(
            FollowedTick(
                sample.time_s,
                place[0],
                place[1],
                place[4],
                status,
                known.status,
                known,
                steer_rad,
                command.speed_mps,
                float(grip[0]),
                float(np.sqrt(grip[1])),
            )
        )
        return command

    def _preview(
        self, known: ObserverOutput, sample: CarSample, distance_m: float, dt_s: float, desired_mps: float
    ) -> tuple[Array, float]:
        """Return slips with what is expected of the path ahead, and the speed that the grip allows."""
        speed, roll = float(self._memory[SPEED]), float(self._memory[ROLL])
        force = sample.measured[IN_SPEED] * sample.measured[IN_RATE] + GRAVITY_MPS2 * math.sin(roll)
        self._grip_memory = grip_preview.grip_step(
            self._grip, self._grip_memory, force, known.slip, known.slip_std, dt_s
        )
        fastest = grip_preview.preview_speed(self._grip, self._grip_memory, self._path.rows, distance_m, roll)
        here, ahead = (
            grip_preview.expected_slips(self._grip, self._path.rows, s, roll, speed, known.mean[5:7])
            for s in (distance_m, distance_m + abs(speed) * self._reach_s)
        )
        return known.slip + ahead - here, min(desired_mps, fastest)
