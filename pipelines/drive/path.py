"""A car-like robot follows a path of the user in simulation, with an observer of sideslip."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.drive.drive import PAGE_FILE
from pipelines.drive.path_file import read_path
from pipelines.report import (
    Band,
    Figure,
    Line,
    Pairs,
    Panel,
    Part,
    Points,
    Progress,
    Report,
    Result,
    Section,
    Text,
    described,
    format_counts,
    format_value,
)
from terrain.control.car_evaluation import FollowedDrive, followed_drive
from terrain.control.car_following import CarFollower, FollowedTick, SlipSource
from terrain.control.paths import ROLL, PathStatus, ReferencePath, S, X, Y, path_warnings
from terrain.control.steering_law import SteeringSettings, SteerStatus
from terrain.errors import ConfigError
from terrain.estimation.observers.family import ObserverStatus
from terrain.files.atomic import atomic_write
from terrain.robots import BicycleRobot, as_drive, load_robot
from terrain.simulation.bicycle.plant import Ground
from terrain.simulation.bicycle.simulate import CarDrive, SpeedProfile, simulate_car
from terrain.status import StatusCode

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.drive.drive import Settings

SPEED_MPS = 3.0
"""Unless another is given."""

STAND_S = 3.0
"""Time of a stop."""

START_M, SLOW_MPS = 2.0, 0.5
"""Distance travelled beside that of speeding up, and speed, from which the robot counts as cruising."""

WHEELS = ("front", "rear")
SHOWN_M = 1.5
"""Lateral errors beyond this leave the figure."""


@dataclass(frozen=True, eq=False, repr=False)
class PathResult(Result):
    """A path that was followed."""

    robot: str = described("name")
    path: Path = described("file of the path")
    observer: str = described("that gave the sideslip")
    seed: int = described("of the noise")
    length_m: float = described("of the path", "m")
    n_points_merged: int = described("points of the file that lay too close to their neighbours")
    speed_mps: float = described("desired", "m/s")
    reached_end: bool = described("whether the robot came to the end")
    duration_s: float = described("of the drive", "s")
    slowest_mps: float = described("slowest speed, start and standing excepted", "m/s")
    lateral_max_m: float = described("largest error of the true position, to the desired offset", "m")
    lateral_rms_m: float = described("its root mean square", "m")
    lateral_max_at_m: float = described("distance along the path of the largest error", "m")
    limit_m: float = described("a tenth of the speed, the bound of Deremetz et al.", "m")
    within_limit: bool = described("whether the largest error is below it and the end was reached")
    slip_max_rad: float = described("largest true slip angle above 0.5 m/s", "rad")
    slip_error_rad: float = described(
        "root mean square error of the estimate; null without an observer", "rad"
    )
    stiffness_error_ratio: float = described("median error of the cornering stiffness over the secant", "1")
    grip_ratio: float = described("largest side force over load as known at the end, with the preview", "1")
    grip_std: float = described("its standard deviation", "1")
    statuses: Mapping[str, Mapping[str, int]] = described(
        "ticks by the status of observer, path and steering"
    )
    warnings: tuple[str, ...] = described("a sentence for each")
    page: Path | None = described("page that was written")
    files: tuple[Path, ...] = described("all that was written")
    offset_m: float = field(default=0.0)
    drive: FollowedDrive | None = None
    reference: ReferencePath | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the fields but what only figures need."""
        document: dict[str, Any] = super().as_json()
        return {
            key: value for key, value in document.items() if key not in ("offset_m", "drive", "reference")
        }

    def to_pandas(self) -> pd.DataFrame:
        """Return the drive, a row a tick."""
        import pandas as pd

        return pd.DataFrame(columns_of(self.drive) if self.drive is not None else {})


def run(settings: Settings, progress: Progress) -> PathResult:
    """Follow the path of the settings in simulation; with ``out`` write the table ``drive.csv`` of the drive.

    Parameters
    ----------
    settings : of the command, with a path
    progress : called when the drive is over

    Raises
    ------
    ConfigError
        if the robot is not car-like, or cannot drive as fast.
    TerrainError
        if the path cannot be read, or the folder not be written.
    """
    assert settings.path is not None
    robot = as_drive(
        BicycleRobot,
        load_robot(settings.robot),
        "robot {name}: drive {drive!r} cannot follow a path, only 'bicycle' can",
    )
    speed_mps = SPEED_MPS if settings.speed_mps is None else settings.speed_mps
    if speed_mps > robot.speed_max_mps:
        raise ConfigError(
            f"--speed is {speed_mps:g}; {robot.name} drives at most {robot.speed_max_mps:g} m/s"
        )
    path = read_path(settings.path, settings.point_std)
    follower = CarFollower(
        robot, path, SlipSource(settings.observer), SteeringSettings(offset_m=settings.offset)
    )
    plan = _plan(settings, path, speed_mps)
    log = simulate_car(robot, plan, follower, np.random.default_rng(settings.first_seed))
    drive = followed_drive(log, path, follower.ticks)
    progress("drive", 1, 1)
    files = () if settings.out is None else (settings.out / PAGE_FILE, settings.out / "drive.csv")
    if files:
        atomic_write(files[1], _table(drive))
    return PathResult(
        robot=robot.name,
        path=settings.path,
        observer=settings.observer,
        seed=settings.first_seed,
        length_m=path.length_m,
        n_points_merged=path.n_merged,
        speed_mps=speed_mps,
        **_figures_of(drive, settings, speed_mps),
        statuses=_statuses(follower.ticks),
        warnings=(*path_warnings(path, robot), *_warnings(drive, follower.ticks, settings)),
        page=files[0] if files else None,
        files=files,
        offset_m=settings.offset,
        drive=drive,
        reference=path,
    )


def _plan(settings: Settings, path: ReferencePath, speed_mps: float) -> CarDrive:
    """Return ground and profile; the ground has the roll of the path where that is known."""
    at = path.rows[::10]
    roll = np.where(np.isnan(at[:, ROLL]), np.deg2rad(settings.slope_deg), at[:, ROLL])
    ground = Ground(at[:, S], np.full(len(at), settings.grip), roll)
    stops = tuple((distance, STAND_S) for distance in settings.stop if distance < path.length_m)
    longest_s = 2.0 * path.length_m / speed_mps + 30.0 + STAND_S * len(stops)
    x, y, heading = path.start
    x, y = x - settings.offset * np.sin(heading), y + settings.offset * np.cos(heading)
    return CarDrive(ground, SpeedProfile(speed_mps, stops), longest_s, (x, y, heading))


def _figures_of(drive: FollowedDrive, settings: Settings, speed_mps: float) -> dict[str, Any]:
    """Return the figures of a drive by the names of :class:`PathResult`."""
    error = drive.lateral_m - settings.offset
    moves = drive.speed_mps > SLOW_MPS
    cruises = moves & drive.between(START_M + speed_mps**2 / 3.0, np.inf)
    stiffness = np.abs(drive.stiffness_error_ratio)
    slips = np.abs(drive.slip_true_rad[moves])
    observed = settings.observer != "none"
    worst, limit = float(np.abs(error).max()), speed_mps / 10.0
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
        "slip_error_rad": _rms(drive.slip_error_rad[moves]) if observed else math.nan,
        "stiffness_error_ratio": float(np.median(stiffness)) if stiffness.size else math.nan,
        "grip_ratio": float(drive.grip_ratio[-1]),
        "grip_std": float(drive.grip_std[-1]),
    }


def _rms(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


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


def _warnings(drive: FollowedDrive, ticks: Sequence[FollowedTick], settings: Settings) -> list[str]:
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


def columns_of(drive: FollowedDrive) -> dict[str, np.ndarray]:
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


def _table(drive: FollowedDrive) -> str:
    """Return the drive as CSV, a row a tick."""
    columns, text = columns_of(drive), io.StringIO()
    np.savetxt(
        text, np.column_stack(list(columns.values())), "%.6g", ",", header=",".join(columns), comments=""
    )
    return text.getvalue()


def report(result: PathResult) -> Report:
    """Return whether the path was followed, its lateral error, and behind it what the observer gave."""
    degrees = 180.0 / math.pi
    figures: list[tuple[Any, ...]] = [
        ("length of the path", result.length_m, ".1f", "m"),
        ("duration", result.duration_s, ".1f", "s"),
        ("slowest speed away from start and stops", result.slowest_mps, "", "m/s"),
        ("lateral error, largest", result.lateral_max_m, ".3f", "m"),
        ("lateral error, root mean square", result.lateral_rms_m, ".3f", "m"),
        ("true slip angle, largest", result.slip_max_rad * degrees, "", "°"),
        ("slip angle, error of the estimate", result.slip_error_rad * degrees, "", "°"),
        ("cornering stiffness, median error", result.stiffness_error_ratio, ".1%"),
    ]
    if not math.isnan(result.grip_ratio):
        grip = f"{format_value(result.grip_ratio)} ± {format_value(result.grip_std)}"
        figures.append(("grip at the end", grip))
    statuses = [(name, format_counts(counts)) for name, counts in result.statuses.items()]
    return Report(
        title=f"{result.robot} along {result.path.name}",
        answer=verdict(result),
        lead=f"{result.speed_mps:g} m/s · sideslip by: {result.observer} · seed {result.seed}",
        picture=None if result.drive is None else _lateral_figure(result, result.drive),
        parts=[*(Text(text, "warning") for text in result.warnings), Pairs(figures)],
        details=[
            Section("Path and robot", list(_map(result))),
            Section("What the observer gave", list(_observed(result))),
            Section("Ticks of 20 ms by status", [Pairs(statuses)]),
        ],
    )


def verdict(result: PathResult) -> str:
    """Return whether the path was followed, in a sentence."""
    if not result.reached_end:
        return "The end of the path was not reached."
    beside = "within" if result.within_limit else "beyond"
    return (
        "The path was followed to its end; the lateral error is at most "
        f"{format_value(result.lateral_max_m, '.3f', 'm')} (at {result.lateral_max_at_m:.0f} m), {beside} a tenth "
        f"of the speed, {format_value(result.limit_m, '.3f', 'm')}."
    )


def _lateral_figure(result: PathResult, drive: FollowedDrive) -> Figure:
    error, ends = drive.lateral_m - result.offset_m, drive.distance_m[[0, -1]]
    most = 1.1 * min(max(result.limit_m, float(np.abs(error).max())), SHOWN_M)
    marks = [
        Line("lateral error", drive.distance_m, error, 0),
        Line("a tenth of the speed", ends, [result.limit_m] * 2, 6, dashed=True),
        Line("", ends, [-result.limit_m] * 2, 6, dashed=True),
    ]
    return Figure(
        "Lateral error along the path",
        [Panel(marks, "lateral error [m]", y_range=(-most, most))],
        "Of the true position, to the desired offset; positive to the left.",
        x_label="distance along the path [m]",
    )


def _map(result: PathResult) -> Iterator[Part]:
    if result.drive is None or result.reference is None:
        return
    rows, drive = result.reference.rows, result.drive
    marks = [
        Line("path", rows[:, X], rows[:, Y], 6, dashed=True),
        Line("rear axle", *drive.position_m.T, 0),
    ]
    yield Figure(
        "The path, and where the rear axle was", [Panel(marks, "y [m]", x_label="x [m]", equal=True)]
    )
    yield Figure(
        "Speed of the rear axle, and angle of the front wheel",
        [
            Panel([Line("speed", drive.distance_m, drive.speed_mps)], "speed [m/s]"),
            Panel([Line("steering", drive.distance_m, np.degrees(drive.steer_rad))], "steering [°]"),
        ],
        x_label="distance along the path [m]",
    )


def _observed(result: PathResult) -> Iterator[Part]:
    """Yield slip angles and cornering stiffness of both axles, estimate beside truth."""
    drive = result.drive
    if drive is None:
        return
    panels = []
    for j, wheel in enumerate(WHEELS):
        estimate, std = np.degrees(drive.slip_rad[:, j]), np.degrees(drive.slip_std_rad[:, j])
        most = 1.4 * max(2.0, float(np.abs(estimate[np.isfinite(estimate)]).max(initial=0.0)))
        marks = [
            Band("two standard deviations", drive.time_s, estimate - 2 * std, estimate + 2 * std, 0),
            Line("estimate", drive.time_s, estimate, 0),
            Line("true", drive.time_s, np.degrees(drive.slip_true_rad[:, j]), 6),
        ]
        panels.append(Panel(marks, f"slip angle, {wheel} [°]", y_range=(-most, most)))
    yield Figure("Sideslip", panels, "At rest there is no true one.", x_label="time [s]")
    if np.isfinite(drive.stiffness_npr).any():
        stiffness = []
        for j, wheel in enumerate(WHEELS):
            both = [
                Line("estimate", drive.time_s, drive.stiffness_npr[:, j] / 1e3, 0),
                Points("true secant, where excited", drive.time_s, drive.secant_npr[:, j] / 1e3, colour=6),
            ]
            stiffness.append(Panel(both, f"{wheel} [kN/rad]", y_range=(0.0, 32.0)))
        caption = "Cornering stiffness of the axles, and -F/b of the simulated tyres."
        yield Figure("Cornering stiffness", stiffness, caption, x_label="time [s]")
