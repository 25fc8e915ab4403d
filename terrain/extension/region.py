"""The region of driving of runs, and a warning where a run leaves the one that its robot was validated in."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np

from terrain.angles import unwrapped
from terrain.errors import OutsideRegionWarning
from terrain.kinematics.wheels import no_slip_twist
from terrain.records import Array, RunLog
from terrain.robots import BicycleRobot, Region, Robot
from terrain.robots.region import Range, outside, widened

OUTSIDE_S = 1.0
"""Time outside after which a live drive is: shorter ones, as of a bump, are in the percentiles' tails."""

MAX_STEP_S = 0.1
"""Longest time that a live sample stands for: after a gap nothing is known of what was driven."""

PERCENTILES = (1.0, 99.0)
"""Edges of a range: single samples, as of a start or a wheel that spun, are not what was validated."""


def region_of(runs: Sequence[RunLog], robot: Robot) -> Region:
    """Return the ranges of wheel speed, yaw rate by the wheels and slope of runs, and their terrains.

    Parameters
    ----------
    runs : of the robot, as measured
    robot : for its geometry; effects are not applied, so that a run can be judged before it is corrected

    Examples
    --------
    >>> from terrain.records import Stream
    >>> from terrain.robots import load_robot
    >>> wheels = Stream([0.0, 0.1], [[0.5, 0.9], [0.5, 0.9]], ("speed_left_mps", "speed_right_mps"))
    >>> region = region_of([RunLog("a", "husky", {"wheels": wheels})], load_robot("husky"))
    >>> region.wheel_speed_mps, region.grade_rad
    ((0.7, 0.7), None)
    """
    driven = [_driven(run, robot) for run in runs]
    speed, turn, grade = (np.concatenate([each[i] for each in driven] or [np.empty(0)]) for i in range(3))
    terrains = sorted({name for run in runs for name in run.terrains})
    return Region(_range(speed), _range(turn), _range(grade), tuple(terrains))


def warn_outside(run: RunLog, robot: Robot) -> None:
    """Warn, in one sentence, where a run leaves the region that the robot's effects were validated in.

    Parameters
    ----------
    run : as measured, or simulated
    robot : nothing is compared where its description has no region

    Warns
    -----
    OutsideRegionWarning
        with the ranges of the run and those validated.
    """
    if robot.region is None:
        return
    beyond = outside(robot.region, region_of([run], robot))
    if beyond:
        warn_of(f"run {run.run_id}", robot, beyond)


def warn_of(drive: str, robot: Robot, beyond: str) -> None:
    """Warn that a drive leaves the region, ``beyond`` as :func:`terrain.robots.region.outside` returns it."""
    warnings.warn(
        f"{drive} leaves the region that the effects of robot {robot.name} were validated in: {beyond}",
        OutsideRegionWarning,
        stacklevel=4,
    )


class RegionMonitor:
    """Warns, once, when a robot that is driven live has been outside its region for :data:`OUTSIDE_S`.

    Parameters
    ----------
    robot : whose region it is; without one nothing is compared

    Attributes
    ----------
    compares : whether samples are compared: there is a region, and nothing was warned of yet
    """

    def __init__(self, robot: Robot) -> None:
        self._robot, self._outside_s, self._last_s = robot, 0.0, math.inf
        region = robot.region
        ranges = {} if region is None else region._asdict()
        self._limits = tuple(
            widened(name, ranges[name]) if ranges.get(name) is not None else (-math.inf, math.inf)
            for name in ("wheel_speed_mps", "yaw_rate_radps")
        )
        self.compares = region is not None

    def step(self, time_s: float, wheel_speed_mps: float, yaw_rate_radps: float) -> None:
        """Take in a sample: mean wheel speed and yaw rate; NaN is inside."""
        if not self.compares:
            return
        (slow, fast), (right, left) = self._limits
        step_s = min(max(time_s - self._last_s, 0.0), MAX_STEP_S)
        self._last_s = time_s
        beyond = wheel_speed_mps < slow or wheel_speed_mps > fast
        if not (beyond or yaw_rate_radps < right or yaw_rate_radps > left):
            return
        self._outside_s += step_s
        if self._outside_s >= OUTSIDE_S and self._robot.region is not None:
            self.compares = False
            now = Region((wheel_speed_mps,) * 2, (yaw_rate_radps,) * 2, None, ())
            warn_of(f"the drive at {time_s:.1f} s", self._robot, outside(self._robot.region, now))


def _driven(run: RunLog, robot: Robot) -> tuple[Array, Array, Array]:
    """Return mean wheel speed (n,), yaw rate by the wheels (n,) and slope (m,); empty where not measured.

    Of omni wheels, which drive in three directions, the speed is what they would roll in any.
    """
    none = np.empty(0)
    wheels, imu = run.streams.get("wheels"), run.streams.get("imu")
    grade = -imu.channel("pitch_rad") if imu is not None and "pitch_rad" in imu.channels else none
    if wheels is None or not set(robot.rate_channels) <= set(wheels.channels):
        return none, none, grade
    rates = np.column_stack([wheels.channel(name) for name in robot.rate_channels])
    if robot.rate_channels[0].startswith("motor_"):
        rates = rates * (robot.wheel_radius_m / robot.motors.reduction_ratio)
    directions, speed = robot.wheel_directions_rad, rates.mean(axis=1)
    if isinstance(robot, BicycleRobot):
        return speed, _turned(run, robot, wheels.time_s, speed), grade
    if robot.steered:
        steering = run.streams.get("steering")
        if steering is None:
            return speed, none, grade
        columns = [
            np.interp(wheels.time_s, steering.time_s, unwrapped(steering.channel(name))) - zero
            for name, zero in zip(robot.steer_channels, robot.steering_zeros_rad, strict=True)
        ]
        directions = np.column_stack(columns)
    twist, _ = no_slip_twist(robot.wheel_positions_m, directions, rates, robot.on_omni_wheels)
    return np.hypot(twist[:, 0], twist[:, 1]) if robot.on_omni_wheels else speed, twist[:, 2], grade


def _turned(run: RunLog, robot: BicycleRobot, time_s: Array, speed_mps: Array) -> Array:
    """Return the yaw rate (n,) of a car-like robot without slip; empty without its steering."""
    steering = run.streams.get("steering")
    if steering is None or not set(robot.steer_channels) <= set(steering.channels):
        return np.empty(0)
    angle = np.interp(time_s, steering.time_s, steering.channel(robot.steer_channels[0]))
    return np.asarray(speed_mps * np.tan(angle) / robot.wheelbase_m)


def _range(values: Array) -> Range | None:
    known = values[np.isfinite(values)]
    if not known.size:
        return None
    low, high = np.percentile(known, PERCENTILES)
    return float(low), float(high)
