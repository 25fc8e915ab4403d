"""A car-like robot along a path in simulation: what is driven, how well, and what its observer knew."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from terrain.control.car_following import CarFollower, FollowedTick, SlipSource
from terrain.control.paths import PathStatus, ReferencePath
from terrain.control.steering_law import SteeringSettings, SteerStatus
from terrain.estimation.observers.family import ObserverStatus
from terrain.records import Array, RunLog
from terrain.robots import BicycleRobot
from terrain.simulation.car import CarDrive, Ground, SpeedProfile, simulate_car
from terrain.status import StatusCode

EXCITED_MPS2, EXCITED_RAD = 1.5, 0.02
"""Lateral specific force and slip angles from which a cornering stiffness can be compared with its secant."""


class FollowedDrive(NamedTuple):
    """Truth and estimates at the ticks of a drive.

    Parameters
    ----------
    time_s, distance_m, lateral_m : (n,) of the true pose beside the path
    position_m : (n, 2) true
    speed_mps : (n,) true
    slip_rad, slip_true_rad : (n, 2) front and rear; NaN where unknown, or at rest
    slip_std_rad : (n, 2) of the estimate
    stiffness_npr, secant_npr : (n, 2) as estimated, and -F/b of the truth where it is excited; else NaN
    steer_rad : (n,) true
    grip_ratio, grip_std : (n,) as estimated; NaN without the preview
    reached_end : whether the drive came to the end of the path
    """

    time_s: Array
    distance_m: Array
    lateral_m: Array
    position_m: Array
    speed_mps: Array
    slip_rad: Array
    slip_true_rad: Array
    slip_std_rad: Array
    stiffness_npr: Array
    secant_npr: Array
    steer_rad: Array
    grip_ratio: Array
    grip_std: Array
    reached_end: bool

    def between(self, start_m: float, end_m: float) -> Array:
        """Return which ticks (n,) lie between two distances."""
        return (self.distance_m >= start_m) & (self.distance_m < end_m)

    def lateral_max_m(self, start_m: float = 0.0, end_m: float = math.inf) -> float:
        """Return the largest lateral error between two distances; NaN where the robot never was."""
        part = np.abs(self.lateral_m[self.between(start_m, end_m)])
        return float(part.max()) if part.size else math.nan

    @property
    def stiffness_error_ratio(self) -> Array:
        """Errors (k,) of the estimated stiffness over its secant, of both axles, where it is excited."""
        error = (self.stiffness_npr / self.secant_npr - 1.0).ravel()
        return error[np.isfinite(error)]

    @property
    def slip_error_rad(self) -> Array:
        """Errors (n, 2) of the slip angles; NaN where one is not known."""
        return self.slip_rad - self.slip_true_rad


def followed_drive(run: RunLog, path: ReferencePath, ticks: Sequence[FollowedTick]) -> FollowedDrive:
    """Return the drive of a simulated car and what its controller knew.

    Parameters
    ----------
    run : as simulated, with its truth
    path : that was followed
    ticks : of the controller, one for each tick of the wheels
    """
    truth, n = run.streams["truth"], len(ticks)
    step = round(len(truth) / n)
    columns = {name: truth.channel(name)[::step][:n] for name in truth.channels}
    before, places = math.nan, np.empty((n, 2))
    for k in range(n):
        x_m, y_m, yaw_rad = (float(columns[name][k]) for name in ("position_x_m", "position_y_m", "yaw_rad"))
        place = path.locate(x_m, y_m, yaw_rad, before)
        before, places[k] = place.distance_m, place[:2]
    true_slips = np.column_stack([columns["slip_front_rad"], columns["slip_rear_rad"]])
    forces = np.column_stack([columns["side_front_n"], columns["side_rear_n"]])
    shown = (np.abs(true_slips) > EXCITED_RAD) & (np.abs(columns["accel_y_mps2"]) > EXCITED_MPS2)[:, None]
    shown &= forces * true_slips < 0.0
    secant = np.full((n, 2), math.nan)
    np.divide(-forces, true_slips, out=secant, where=shown)
    means = [tick.estimate.mean for tick in ticks]
    stiffness = [mean[5:7] if len(mean) == 7 else np.full(2, math.nan) for mean in means]
    return FollowedDrive(
        time_s=truth.time_s[::step][:n],
        distance_m=places[:, 0],
        lateral_m=places[:, 1],
        position_m=np.column_stack([columns["position_x_m"], columns["position_y_m"]]),
        speed_mps=columns["speed_x_mps"],
        slip_rad=np.array([tick.estimate.slip for tick in ticks]),
        slip_true_rad=true_slips,
        slip_std_rad=np.array([tick.estimate.slip_std for tick in ticks]),
        stiffness_npr=np.array(stiffness),
        secant_npr=secant,
        steer_rad=columns["steer_front_rad"],
        grip_ratio=np.array([tick.grip_ratio for tick in ticks]),
        grip_std=np.array([tick.grip_std for tick in ticks]),
        reached_end=ticks[-1].path_status == PathStatus.END,
    )


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
    assert path.roll_rad is not None
    at, known = path.distance_m[::10], path.roll_rad[::10]
    roll = np.where(np.isnan(known), plan.slope_rad, known)
    ground = Ground(at, np.full(len(at), plan.grip_ratio), roll)
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
