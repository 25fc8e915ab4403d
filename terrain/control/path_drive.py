"""A car-like robot along a path in simulation: what is driven, and the figures that it is judged by."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from terrain.control.car_evaluation import FollowedDrive, followed_drive
from terrain.control.car_following import CarFollower, FollowedTick, SlipSource
from terrain.control.paths import ROLL, PathStatus, ReferencePath, S
from terrain.control.steering_law import SteeringSettings, SteerStatus
from terrain.estimation.observers.family import ObserverStatus
from terrain.records import Array
from terrain.robots import BicycleRobot
from terrain.simulation.bicycle.plant import Ground
from terrain.simulation.bicycle.simulate import CarDrive, SpeedProfile, simulate_car
from terrain.status import StatusCode

STAND_S = 3.0
"""Time of a stop."""

START_M, SLOW_MPS = 2.0, 0.5
"""Distance travelled beside that of speeding up, and speed, from which the robot counts as cruising."""

WHEELS = ("front", "rear")


class PathPlan(NamedTuple):
    """How a path is driven.

    Parameters
    ----------
    speed_mps : desired
    source : of the sideslip
    slope_rad : side slope where the path has no roll, left side up > 0
    grip_ratio : largest side force over load
    offset_m : desired distance to the left of the path
    stops_m : distances at which to stop
    """

    speed_mps: float
    source: SlipSource
    slope_rad: float
    grip_ratio: float
    offset_m: float
    stops_m: tuple[float, ...]


def drive_along(
    robot: BicycleRobot, path: ReferencePath, plan: PathPlan, seed: int
) -> tuple[FollowedDrive, tuple[FollowedTick, ...]]:
    """Return the simulated drive of a robot along a path, and the ticks of its controller.

    Parameters
    ----------
    robot : that drives
    path : that it follows; its ground has the roll of the path where that is known
    plan : how
    seed : of the noise of the sensors
    """
    follower = CarFollower(robot, path, plan.source, SteeringSettings(offset_m=plan.offset_m))
    at = path.rows[::10]
    roll = np.where(np.isnan(at[:, ROLL]), plan.slope_rad, at[:, ROLL])
    ground = Ground(at[:, S], np.full(len(at), plan.grip_ratio), roll)
    stops = tuple((distance, STAND_S) for distance in plan.stops_m if distance < path.length_m)
    longest_s = 2.0 * path.length_m / plan.speed_mps + 30.0 + STAND_S * len(stops)
    x, y, heading = path.start
    start = (x - plan.offset_m * np.sin(heading), y + plan.offset_m * np.cos(heading), heading)
    drive = CarDrive(ground, SpeedProfile(plan.speed_mps, stops), longest_s, start)
    log = simulate_car(robot, drive, follower, np.random.default_rng(seed))
    return followed_drive(log, path, follower.ticks), tuple(follower.ticks)


def path_figures(drive: FollowedDrive, plan: PathPlan) -> dict[str, Any]:
    """Return the figures of a drive by its truth, by the fields of ``pipelines.drive.path.PathResult``.

    NaN where one is not defined; those of slip angles are above :data:`SLOW_MPS`.
    """
    error = drive.lateral_m - plan.offset_m
    moves = drive.speed_mps > SLOW_MPS
    cruises = moves & drive.between(START_M + plan.speed_mps**2 / 3.0, np.inf)
    stiffness = np.abs(drive.stiffness_error_ratio)
    slips = np.abs(drive.slip_true_rad[moves])
    errors = drive.slip_error_rad[moves]
    errors = errors[np.isfinite(errors)]
    observed = plan.source != SlipSource.NONE and errors.size
    worst, limit = float(np.abs(error).max()), plan.speed_mps / 10.0
    return {
        "reached_end": drive.reached_end,
        "duration_s": float(drive.time_s[-1]),
        "slowest_mps": float(drive.speed_mps[cruises].min()) if cruises.any() else math.nan,
        "lateral_max_m": worst,
        "lateral_rms_m": float(np.sqrt(np.mean(error**2))),
        "lateral_max_at_m": float(drive.distance_m[np.abs(error).argmax()]),
        "limit_m": limit,
        "within_limit": bool(drive.reached_end and worst <= limit),
        "slip_max_rad": float(np.nanmax(slips)) if np.isfinite(slips).any() else math.nan,
        "slip_error_rad": float(np.sqrt(np.mean(errors**2))) if observed else math.nan,
        "stiffness_error_ratio": float(np.median(stiffness)) if stiffness.size else math.nan,
        "grip_ratio": float(drive.grip_ratio[-1]),
        "grip_std": float(drive.grip_std[-1]),
    }


def tick_statuses(ticks: Sequence[FollowedTick]) -> dict[str, dict[str, int]]:
    """Return the number of ticks by the status of observer, path and steering."""
    kinds: dict[str, tuple[type[StatusCode], str]] = {
        "observer": (ObserverStatus, "observer_status"),
        "path": (PathStatus, "path_status"),
        "steering": (SteerStatus, "steer_status"),
    }
    return {
        name: {kind(code).label: n for code, n in sorted(Counter(getattr(t, key) for t in ticks).items())}
        for name, (kind, key) in kinds.items()
    }


def drive_warnings(drive: FollowedDrive, ticks: Sequence[FollowedTick], plan: PathPlan) -> list[str]:
    """Return what a user has to know of a drive along a path, a sentence each."""
    found = []
    if not drive.reached_end:
        found.append(f"the end was not reached: the robot came to {drive.distance_m[-1]:.1f} m")
    for status, text in (
        (PathStatus.FAR, "was too far from the path to find its place"),
        (PathStatus.SINGULAR, "was near the centre of curvature of the path"),
    ):
        first = next((tick for tick in ticks if tick.path_status == status), None)
        if first is not None:
            found.append(f"the robot {text}, first at {first.distance_m:.1f} m after {first.time_s:.1f} s")
    clamped = sum(tick.steer_status == SteerStatus.CLAMPED for tick in ticks) / len(ticks)
    if clamped > 0.01:
        found.append(f"the steering was at its limit for {clamped:.0%} of the drive")
    late = [distance for distance in plan.stops_m if distance > drive.distance_m[-1]]
    if late:
        found.append(f"stop at {late[0]:g} m is beyond where the drive ended")
    return found


def columns_of(drive: FollowedDrive) -> dict[str, Array]:
    """Return the columns of a drive (n,), by their names in ``drive.csv``."""
    columns = {
        "time_s": drive.time_s,
        "distance_m": drive.distance_m,
        "lateral_m": drive.lateral_m,
        "position_x_m": drive.position_m[:, 0],
        "position_y_m": drive.position_m[:, 1],
        "speed_mps": drive.speed_mps,
        "steer_front_rad": drive.steer_rad,
    }
    for j, wheel in enumerate(WHEELS):
        columns |= {
            f"slip_{wheel}_rad": drive.slip_rad[:, j],
            f"slip_{wheel}_std_rad": drive.slip_std_rad[:, j],
            f"slip_{wheel}_true_rad": drive.slip_true_rad[:, j],
            f"cornering_{wheel}_npr": drive.stiffness_npr[:, j],
        }
    return columns
