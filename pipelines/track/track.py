"""``terrain track``: simulate the closed loop along a path, judge it by its truth, write page and table."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipelines.track.path_file import read_path
from pipelines.track.results import TrackResult
from pipelines.track.settings import TrackSettings
from terrain.control.car_evaluation import FollowedDrive, followed_drive
from terrain.control.car_following import CarFollower, FollowedTick, SlipSource
from terrain.control.paths import ROLL, PathStatus, ReferencePath, S, path_warnings
from terrain.control.steering_law import SteeringSettings, SteerStatus
from terrain.errors import ConfigError
from terrain.estimation.observers.family import ObserverStatus
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.robots import BicycleRobot, as_drive, load_robot
from terrain.simulation.bicycle.plant import Ground
from terrain.simulation.bicycle.simulate import CarDrive, SpeedProfile, simulate_car
from terrain.status import StatusCode

STAND_S = 3.0
"""Time of a stop."""
_START_M, _SLOW_MPS = 2.0, 0.5


def track(settings: TrackSettings) -> TrackResult:
    """Follow a path in simulation, and write the page ``track.html``, pictures and ``drive.csv``.

    Parameters
    ----------
    settings : of the command

    Raises
    ------
    ConfigError
        if the robot is not car-like, or cannot drive as fast.
    TerrainError
        if the path cannot be read, or the folder not be written.
    """
    from pipelines.reporting.drawing import png_bytes
    from pipelines.track.figures import drive_figures
    from pipelines.track.page import track_page

    robot = as_drive(
        BicycleRobot,
        load_robot(settings.robot),
        "robot {name}: drive {drive!r} cannot be tracked, only 'bicycle' can",
    )
    if settings.speed > robot.speed_max_mps:
        raise ConfigError(
            f"--speed is {settings.speed:g}; {robot.name} drives at most {robot.speed_max_mps:g} m/s"
        )
    path = read_path(settings.path, settings.point_std)
    ensure_writable(settings.out)
    follower = CarFollower(
        robot, path, SlipSource(settings.observer), SteeringSettings(offset_m=settings.offset)
    )
    log = simulate_car(robot, _drive(settings, path), follower, np.random.default_rng(settings.seed))
    drive = followed_drive(log, path, follower.ticks)
    figures = drive_figures(drive, path, settings.offset, settings.speed / 10.0)
    pictures = {settings.out / f"{name}.png": figure for name, figure in figures.items()}
    report, table = settings.out / "track.html", settings.out / "drive.csv"
    result = TrackResult(
        robot=robot.name,
        path=settings.path,
        observer=settings.observer,
        seed=settings.seed,
        length_m=path.length_m,
        n_points_merged=path.n_merged,
        **_figures_of(drive, settings),
        statuses=_statuses(follower.ticks),
        warnings=(*path_warnings(path, robot), *_warnings(drive, follower.ticks, settings)),
        report=report,
        files=(report, table, *pictures),
    )
    for place, figure in pictures.items():
        atomic_write(place, png_bytes(figure))
    atomic_write(table, _table(drive))
    atomic_write(report, track_page(result, figures))
    return result


def _drive(settings: TrackSettings, path: ReferencePath) -> CarDrive:
    """Return ground and profile; the ground has the roll of the path where that is known."""
    at = path.rows[::10]
    roll = np.where(np.isnan(at[:, ROLL]), np.deg2rad(settings.slope_deg), at[:, ROLL])
    ground = Ground(at[:, S], np.full(len(at), settings.grip), roll)
    stops = tuple((distance, STAND_S) for distance in settings.stop if distance < path.length_m)
    longest_s = 2.0 * path.length_m / settings.speed + 30.0 + STAND_S * len(stops)
    x, y, heading = path.start
    x, y = x - settings.offset * np.sin(heading), y + settings.offset * np.cos(heading)
    return CarDrive(ground, SpeedProfile(settings.speed, stops), longest_s, (x, y, heading))


def _figures_of(drive: FollowedDrive, settings: TrackSettings) -> dict[str, Any]:
    """Return the figures of a drive by the names of :class:`TrackResult`."""
    error = drive.lateral_m - settings.offset
    moves = drive.speed_mps > _SLOW_MPS
    cruises = moves & drive.between(_START_M + settings.speed**2 / 3.0, np.inf)
    errors = drive.slip_error_rad[moves]
    stiffness = np.abs(drive.stiffness_error_ratio)
    slips = np.abs(drive.slip_true_rad[moves])
    observed = settings.observer != "none"
    worst, limit = float(np.abs(error).max()), settings.speed / 10.0
    return {
        "speed_mps": settings.speed,
        "reached_end": drive.reached_end,
        "duration_s": float(drive.time_s[-1]),
        "slowest_mps": float(drive.speed_mps[cruises].min()) if cruises.any() else float("nan"),
        "lateral_max_m": worst,
        "lateral_rms_m": float(np.sqrt(np.mean(error**2))),
        "lateral_max_at_m": float(drive.distance_m[np.abs(error).argmax()]),
        "limit_m": limit,
        "within_limit": bool(drive.reached_end and worst <= limit),
        "slip_max_rad": float(np.nanmax(slips)) if np.isfinite(slips).any() else float("nan"),
        "slip_error_rad": _rms(errors) if observed else float("nan"),
        "stiffness_error_ratio": float(np.median(stiffness)) if stiffness.size else float("nan"),
        "grip_ratio": float(drive.grip_ratio[-1]),
        "grip_std": float(drive.grip_std[-1]),
    }


def _rms(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def _statuses(ticks: Sequence[FollowedTick]) -> Mapping[str, Mapping[str, int]]:
    kinds: dict[str, tuple[type[StatusCode], str]] = {
        "observer": (ObserverStatus, "observer_status"),
        "path": (PathStatus, "path_status"),
        "steering": (SteerStatus, "steer_status"),
    }
    return {
        name: {kind(code).label: n for code, n in sorted(Counter(getattr(t, key) for t in ticks).items())}
        for name, (kind, key) in kinds.items()
    }


def _warnings(drive: FollowedDrive, ticks: Sequence[FollowedTick], settings: TrackSettings) -> list[str]:
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
    late = [distance for distance in settings.stop if distance > drive.distance_m[-1]]
    if late:
        found.append(f"stop at {late[0]:g} m is beyond where the drive ended")
    return found


def _table(drive: FollowedDrive) -> str:
    """Return the drive as CSV, a row a tick."""
    columns = {
        "time_s": drive.time_s,
        "distance_m": drive.distance_m,
        "lateral_m": drive.lateral_m,
        "position_x_m": drive.position_m[:, 0],
        "position_y_m": drive.position_m[:, 1],
        "speed_mps": drive.speed_mps,
        "steer_front_rad": drive.steer_rad,
    }
    for j, wheel in enumerate(("front", "rear")):
        columns |= {
            f"slip_{wheel}_rad": drive.slip_rad[:, j],
            f"slip_{wheel}_std_rad": drive.slip_std_rad[:, j],
            f"slip_{wheel}_true_rad": drive.slip_true_rad[:, j],
            f"cornering_{wheel}_npr": drive.stiffness_npr[:, j],
        }
    text = io.StringIO()
    np.savetxt(
        text, np.column_stack(list(columns.values())), "%.6g", ",", header=",".join(columns), comments=""
    )
    return text.getvalue()
