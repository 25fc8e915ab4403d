"""A car-like robot that follows a path: observer, steering law and preview as a controller in the loop.

At a tick the observer takes what was measured, the path gives the deviations of the estimated pose, and
:mod:`terrain.control.steering_law` the steering.  Without an observer of sideslip the slip is 0, and the pose
is that of the extended kinematic model without slip.  The robot stops where it does not know where it is: no
fix for three seconds, or further from the path than its search reaches; at the end the drive is finished.

The preview gives speed and steering ahead of bends, by the grip that the estimated cornering stiffness
shows.  An axle under the load N carries |F| = f N.  With the cornering stiffness C_0 that the tyre has at small
slip, the force that saturates at the grip mu is, as in :mod:`terrain.simulation.car`::

    f = mu (1 - exp(-q / mu)),   q = C_0 |b| / N

The secant stiffness -F/b falls below C_0 the more of the grip is used.  f is known from speed, yaw rate and
roll, b from an observer of sideslip: a scalar Kalman filter on mu weighs each tick by how much it shows,
df/dmu = 1 - exp(-q/mu) (1 + q/mu), which is nothing at small slip.  What is used is the mean less one
standard deviation.  Ahead, the side force of a speed v in curvature c on a roll a is m (v^2 c + g sin a)::

    v(s)^2 <= (part mu g cos a - g sin a sgn c) / |c|          v^2 <= v(s)^2 + 2 b (s - s_0)

with the braking b.  The sideslip expected ahead, b = -F / C with the adapted C, is steered before it comes.

Future work of Deremetz et al., ICRA 2017, section VII: "parts of the adapted dynamic parameters" in the
prediction.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.control.paths import GRID_M, PathStatus, ReferencePath
from terrain.control.steering_law import SteeringSettings, SteerState, SteerStatus, check_steering, steer
from terrain.errors import ConfigError
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
from terrain.robots import BicycleRobot
from terrain.simulation.car import CarCommand, CarSample

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


class GripSettings(NamedTuple):
    """What is assumed of grip, and how much of it is used.

    Parameters
    ----------
    grip_ratio, grip_std : at first
    grip_walk : change within a second, one standard deviation
    used_part : of the grip that the side force ahead may take
    braking_mps2 : below the drive's acceleration
    stiffness_std_ratio : of C_0, the nominal stiffness
    correlation_s : for which errors of an estimated slip last
    """

    grip_ratio: float = 0.6
    grip_std: float = 0.15
    grip_walk: float = 0.02
    used_part: float = 0.75
    braking_mps2: float = 1.0
    stiffness_std_ratio: float = 0.2
    correlation_s: float = 0.3


_LEAST_GRIP, _MOST_GRIP = 0.05, 1.5
_SHOWS = 0.1
"""Part of the load below which a side force shows nothing of the grip."""
_LOOK_M = 0.5


class Grip(NamedTuple):
    """Largest side force over load, and its variance."""

    ratio: float
    variance: float


def first_grip(settings: GripSettings) -> Grip:
    """Return the grip before anything is known.

    Raises
    ------
    ConfigError
        if a setting is not above zero, or the part used above 1.
    """
    bad = [f"{name} is {value:g}" for name, value in settings._asdict().items() if not 0 < value < math.inf]
    if bad or settings.used_part > 1.0:
        raise ConfigError(f"{', '.join(bad) or 'used_part is above 1'}; see GripSettings")
    return Grip(settings.grip_ratio, settings.grip_std**2)


def grip_step(
    robot: BicycleRobot,
    settings: GripSettings,
    grip: Grip,
    force_mps2: float,
    slips: Array,
    slip_std: Array,
    dt_s: float,
) -> Grip:
    """Return the next grip.

    Parameters
    ----------
    robot, settings, grip : whose tyres; what is assumed; as it was
    force_mps2 : lateral specific force, u r + g sin a
    slips, slip_std : (2,) as estimated; NaN shows nothing
    dt_s : since the step before

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> robot, grip = load_robot("adap2e"), first_grip(GripSettings())
    >>> slips, std = np.array([-0.3, -0.3]), np.full(2, 0.01)
    >>> for _ in range(200):  # half of g although the slip is large: that is all the grip there is
    ...     grip = grip_step(robot, GripSettings(), grip, 4.9, slips, std, 0.02)
    >>> round(grip.ratio, 2)
    0.51
    """
    if not (0.0 < dt_s < 1.0 and abs(force_mps2) < 50.0):
        return grip
    mu, variance = grip.ratio, min(grip.variance + settings.grip_walk * settings.grip_walk * dt_s, 0.25)
    used = abs(force_mps2) / GRAVITY_MPS2
    if used < _SHOWS:
        return Grip(mu, variance)
    base = robot.com_ahead_m + robot.com_behind_front_m
    arms = robot.com_ahead_m, robot.com_behind_front_m
    stiffness = robot.front_cornering_npr, robot.rear_cornering_npr
    for slip, std, arm, c_0 in zip(slips.tolist(), slip_std.tolist(), arms, stiffness, strict=True):
        load = robot.mass_kg * GRAVITY_MPS2 * arm / base
        if not (abs(slip) < 1.5 and std < 1.0) or slip * force_mps2 > 0.0:
            continue
        slope = c_0 / load
        q = slope * abs(slip)
        left = math.exp(-q / mu)
        shown = 1.0 - left * (1.0 + q / mu)
        by_slip, by_stiffness = slope * std, settings.stiffness_std_ratio * q
        noise = 0.02 * 0.02 + left * left * (by_slip * by_slip + by_stiffness * by_stiffness)
        noise *= max(1.0, 2.0 * settings.correlation_s / dt_s)
        gain = variance * shown / (shown * shown * variance + noise)
        mu = min(max(mu + gain * (used - mu * (1.0 - left)), _LEAST_GRIP), _MOST_GRIP)
        variance *= 1.0 - gain * shown
    return Grip(mu, variance)


def _roll_at(path: ReferencePath, row: int, roll_rad: float) -> float:
    """Return the roll of a row of a path; where it is not known, what is measured now."""
    assert path.roll_rad is not None
    known = float(path.roll_rad[row])
    return roll_rad if math.isnan(known) else known


def preview_speed(
    settings: GripSettings, grip: Grip, path: ReferencePath, distance_m: float, roll_rad: float
) -> float:
    """Return the fastest speed at a distance along a path; infinite where nothing limits it.

    Examples
    --------
    >>> from terrain.control.paths import path_from_curvature
    >>> bend = path_from_curvature(np.array([0.0, 20.0, 20.1, 40.0]), np.array([0.0, 0.0, 0.1, 0.1]))
    >>> [round(preview_speed(GripSettings(), Grip(0.5, 0.0), bend, s, 0.0), 2) for s in (10.0, 20.0, 25.0)]
    [7.6, 6.15, 6.06]
    """
    known = max(grip.ratio - math.sqrt(grip.variance), _LEAST_GRIP)
    first, least = path.row_at(distance_m), math.inf
    for i in range(first, len(path.x_m), int(_LOOK_M / GRID_M)):
        ahead = (i - first) * GRID_M
        if 2.0 * settings.braking_mps2 * ahead > least:
            break
        curvature, roll = float(path.curvature_pm[i]), _roll_at(path, i, roll_rad)
        pull = GRAVITY_MPS2 * math.sin(roll) * (1.0 if curvature > 0.0 else -1.0)
        room = settings.used_part * known * GRAVITY_MPS2 * math.cos(roll) - max(pull, 0.0)
        square = max(room, 0.25) / max(abs(curvature), 1e-6)
        least = min(least, square + 2.0 * settings.braking_mps2 * ahead)
    return math.sqrt(least)


def expected_slips(
    robot: BicycleRobot,
    path: ReferencePath,
    distance_m: float,
    roll_rad: float,
    speed_mps: float,
    stiffness_npr: Array,
) -> Array:
    """Return the slip angles (2,) of steady cornering at a distance, by an estimated stiffness."""
    row = path.row_at(distance_m)
    curvature, roll = float(path.curvature_pm[row]), _roll_at(path, row, roll_rad)
    force = speed_mps * speed_mps * curvature + GRAVITY_MPS2 * math.sin(roll)
    base = robot.com_ahead_m + robot.com_behind_front_m
    arms = np.array([robot.com_ahead_m, robot.com_behind_front_m])
    return np.clip(-robot.mass_kg * arms / base * force / stiffness_npr, -0.2, 0.2)


class FollowedTick(NamedTuple):
    """What a controller knew and did at a tick.

    Parameters
    ----------
    time_s : of the tick
    distance_m, lateral_m : on the path, by the estimated pose
    path_status, steer_status, observer_status : whether each could do its part
    estimate : of the observer
    steer_rad, speed_mps : commanded
    grip_ratio, grip_std : as estimated; NaN without the preview
    """

    time_s: float
    distance_m: float
    lateral_m: float
    path_status: PathStatus
    steer_status: SteerStatus
    observer_status: int
    estimate: ObserverOutput
    steer_rad: float
    speed_mps: float
    grip_ratio: float
    grip_std: float


class CarFollower:
    """Controller of a drive along a path, for :func:`terrain.simulation.car.simulate_car`.

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
        self._robot, self._path, self._source = robot, path, SlipSource(source)
        self._observer = sideslip_observer(robot, self._source) if observer is None else observer
        self._memory, self._steered = np.array(self._observer.start), SteerState()
        self._steering, self._grip_settings, self._grip = check_steering(steering), grip, first_grip(grip)
        self._reach_s = steering.delay_s + REACH_TIME_CONSTANTS * robot.steering_time_constant_s
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
        x_m, y_m, yaw_rad = known.mean[:3].tolist()
        place = self._path.locate(x_m, y_m, yaw_rad, self._before_m)
        if place.status not in (PathStatus.NO_POSE, PathStatus.FAR) or math.isnan(self._before_m):
            self._before_m = place.distance_m if place.status is not PathStatus.NO_POSE else math.nan
        slips = np.zeros(2) if self._source is SlipSource.NONE else known.slip
        desired, previews = sample.speed_desired_mps, self._source is SlipSource.GRIP
        if previews:
            slips, desired = self._preview(known, sample, place.distance_m, dt_s, desired)
        steer_rad, self._steered, status = steer(
            self._robot, self._steering, self._steered, self._path, place, slips, speed, dt_s
        )
        lost = self._memory[SINCE_FIX] > LOST_STOP_S or place.status is PathStatus.FAR
        finished = place.status is PathStatus.END
        command = CarCommand(steer_rad, 0.0 if lost or finished else desired, finished)
        grip = self._grip if previews else Grip(math.nan, math.nan)
        self.ticks.append(
            FollowedTick(
                time_s=sample.time_s,
                distance_m=place.distance_m,
                lateral_m=place.lateral_m,
                path_status=place.status,
                steer_status=status,
                observer_status=known.status,
                estimate=known,
                steer_rad=steer_rad,
                speed_mps=command.speed_mps,
                grip_ratio=grip.ratio,
                grip_std=math.sqrt(grip.variance),
            )
        )
        return command

    def _preview(
        self, known: ObserverOutput, sample: CarSample, distance_m: float, dt_s: float, desired_mps: float
    ) -> tuple[Array, float]:
        """Return slips with what is expected of the path ahead, and the speed that the grip allows."""
        robot, path, settings = self._robot, self._path, self._grip_settings
        speed, roll = float(self._memory[SPEED]), float(self._memory[ROLL])
        force = float(sample.measured[IN_SPEED] * sample.measured[IN_RATE]) + GRAVITY_MPS2 * math.sin(roll)
        self._grip = grip_step(robot, settings, self._grip, force, known.slip, known.slip_std, dt_s)
        fastest = preview_speed(settings, self._grip, path, distance_m, roll)
        here, ahead = (
            expected_slips(robot, path, s, roll, speed, known.mean[5:7])
            for s in (distance_m, distance_m + abs(speed) * self._reach_s)
        )
        return known.slip + ahead - here, min(desired_mps, fastest)
