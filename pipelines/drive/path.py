"""A car-like robot follows a path of the user in simulation, with an observer of sideslip."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.drive.drive import PAGE_FILE
from pipelines.report.figure import Band, Figure, Line, Mark, Panel, Points
from pipelines.report.numbers import format_counts, format_value
from pipelines.report.results import Progress, Result, described
from pipelines.report.tree import Pairs, Part, Report, Section, Text
from terrain.control.car_following import SlipSource
from terrain.control.path_drive import (
    WHEELS,
    FollowedDrive,
    PathPlan,
    columns_of,
    drive_along,
    drive_warnings,
    path_figures,
    tick_statuses,
)
from terrain.control.paths import ReferencePath, path_warnings, read_path
from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write
from terrain.robots import BicycleRobot, as_drive, load_robot

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.drive.drive import Settings

SPEED_MPS = 3.0
"""Unless another is given."""

DISTANCE = "distance along the path [m]"

SHOWN_M = 1.5
"""Lateral errors beyond this leave the figure."""


class PathResult(Result, eq=False):
    """A path that was followed, with the drive."""

    offset_m: float
    drive: FollowedDrive
    reference: ReferencePath
    robot: str = described("name")
    path: Path = described("file of the path")
    observer: str = described("that gave the sideslip")
    seed: int = described("of the noise")
    length_m: float = described("length of the path", "m", form=".1f")
    n_points_merged: int = described("points of the file that lay too close to their neighbours")
    speed_mps: float = described("desired", "m/s")
    reached_end: bool = described("whether the robot came to the end")
    duration_s: float = described("duration of the drive", "s", form=".1f")
    slowest_mps: float = described("slowest speed, start and standing excepted", "m/s")
    lateral_max_m: float = described("largest lateral error, to the desired offset", "m", form=".3f")
    lateral_rms_m: float = described("root mean square of the lateral error", "m", form=".3f")
    lateral_max_at_m: float = described("distance along the path of the largest error", "m")
    limit_m: float = described("a tenth of the speed, the bound of Deremetz et al.", "m")
    within_limit: bool = described("whether the largest error is below it and the end was reached")
    slip_max_rad: float = described("largest true slip angle above 0.5 m/s", "rad")
    slip_error_rad: float = described(
        "root mean square error of the estimate; null without an observer", "rad"
    )
    stiffness_error_ratio: float = described("cornering stiffness, median error over the secant", "1")
    grip_ratio: float = described("largest side force over load as known at the end, with the preview", "1")
    grip_std: float = described("its standard deviation", "1")
    statuses: Mapping[str, Mapping[str, int]] = described(
        "ticks by the status of observer, path and steering"
    )
    warnings: tuple[str, ...] = described("a sentence for each")
    page: Path | None = described("page that was written")
    files: tuple[Path, ...] = described("all that was written")

    def to_pandas(self) -> pd.DataFrame:
        """Return the drive, a row a tick."""
        import pandas as pd

        return pd.DataFrame(columns_of(self.drive))


def run(settings: Settings, progress: Progress) -> PathResult:
    """Follow the path of the settings in simulation; with ``out`` write the table ``drive.csv`` of the drive.

    Raises
    ------
    ConfigError
        if the robot is not car-like, or cannot drive as fast.
    TerrainError
        if the path cannot be read, or the folder not be written.
    """
    assert settings.path is not None
    refusal = "robot {name}: drive {drive!r} cannot follow a path, only 'bicycle' can"
    robot = as_drive(BicycleRobot, load_robot(settings.robot), refusal)
    speed_mps = SPEED_MPS if settings.speed_mps is None else settings.speed_mps
    if speed_mps > robot.speed_max_mps:
        raise ConfigError(
            f"--speed is {speed_mps:g}; {robot.name} drives at most {robot.speed_max_mps:g} m/s"
        )
    path = read_path(settings.path, settings.point_std)
    plan = PathPlan(
        speed_mps=speed_mps,
        source=SlipSource(settings.observer),
        slope_rad=np.deg2rad(settings.slope_deg),
        grip_ratio=settings.grip,
        offset_m=settings.offset,
        stops_m=settings.stop,
    )
    drive, ticks = drive_along(robot, path, plan, settings.first_seed)
    progress("drive", 1, 1)
    files = () if settings.out is None else (settings.out / PAGE_FILE, settings.out / "drive.csv")
    result = PathResult(
        robot=robot.name,
        path=settings.path,
        observer=settings.observer,
        seed=settings.first_seed,
        length_m=path.length_m,
        n_points_merged=path.n_merged,
        speed_mps=speed_mps,
        **path_figures(drive, plan),
        statuses=tick_statuses(ticks),
        warnings=(*path_warnings(path, robot), *drive_warnings(drive, ticks, plan)),
        page=files[0] if files else None,
        files=files,
        offset_m=settings.offset,
        drive=drive,
        reference=path,
    )
    if files:
        table = result.to_pandas().to_csv(index=False, float_format="%.6g", na_rep="nan")
        atomic_write(files[1], table)
    return result


def report(result: PathResult) -> Report:
    """Return whether the path was followed, its lateral error, and behind it what the observer gave."""
    degrees = 180.0 / math.pi
    figures: list[tuple[Any, ...]] = [
        *result.pairs("length_m", "duration_s", "slowest_mps", "lateral_max_m", "lateral_rms_m"),
        ("true slip angle, largest", result.slip_max_rad * degrees, "", "°"),
        ("slip angle, error of the estimate", result.slip_error_rad * degrees, "", "°"),
        *result.pairs("stiffness_error_ratio"),
    ]
    if not math.isnan(result.grip_ratio):
        grip = f"{format_value(result.grip_ratio)} ± {format_value(result.grip_std)}"
        figures.append(("grip at the end", grip))
    statuses = [(name, format_counts(counts)) for name, counts in result.statuses.items()]
    return Report(
        title=f"{result.robot} along {result.path.name}",
        answer=verdict(result),
        lead=f"{result.speed_mps:g} m/s · sideslip by: {result.observer} · seed {result.seed}",
        picture=_lateral_figure(result),
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


def _lateral_figure(result: PathResult) -> Figure:
    drive = result.drive
    error, ends = drive.lateral_m - result.offset_m, drive.distance_m[[0, -1]]
    most = 1.1 * min(max(result.limit_m, float(np.abs(error).max())), SHOWN_M)
    marks: list[Mark] = [
        Band("a tenth of the speed", ends, [-result.limit_m] * 2, [result.limit_m] * 2, 6),
        Line("lateral error", drive.distance_m, error, 0),
    ]
    return Figure(
        "Lateral error along the path",
        [Panel(marks, "lateral error [m]", y_range=(-most, most))],
        "Of the true position, to the desired offset; positive to the left.",
        x_label=DISTANCE,
    )


def _map(result: PathResult) -> Iterator[Part]:
    path, drive = result.reference, result.drive
    marks = [
        Line("path", path.x_m, path.y_m, 6, dashed=True),
        Line("rear axle", drive.position_m[:, 0], drive.position_m[:, 1], 0),
    ]
    seen = Panel(marks, "y [m]", x_label="x [m]", equal=True)
    yield Figure("The path, and where the rear axle was", [seen])
    speed = Line("speed", drive.distance_m, drive.speed_mps)
    steering = Line("steering", drive.distance_m, np.degrees(drive.steer_rad))
    panels = Panel([speed], "speed [m/s]"), Panel([steering], "steering [°]")
    title = "Speed of the rear axle, and angle of the front wheel"
    yield Figure(title, panels, x_label=DISTANCE)


def _observed(result: PathResult) -> Iterator[Part]:
    """Yield slip angles and cornering stiffness of both axles, estimate beside truth."""
    drive = result.drive
    panels = []
    for j, wheel in enumerate(WHEELS):
        estimate, std = np.degrees(drive.slip_rad[:, j]), np.degrees(drive.slip_std_rad[:, j])
        most = 1.4 * max(2.0, float(np.abs(estimate[np.isfinite(estimate)]).max(initial=0.0)))
        marks: list[Mark] = [
            Band("two standard deviations", drive.time_s, estimate - 2 * std, estimate + 2 * std, 0),
            Line("estimate", drive.time_s, estimate, 0),
            Line("true", drive.time_s, np.degrees(drive.slip_true_rad[:, j]), 6),
        ]
        panels.append(Panel(marks, f"slip angle, {wheel} [°]", y_range=(-most, most)))
    yield Figure("Sideslip", panels, "At rest there is no true one.", x_label="time [s]")
    if np.isfinite(drive.stiffness_npr).any():
        stiffness = []
        for wheel, found, true in zip(
            WHEELS, drive.stiffness_npr.T / 1e3, drive.secant_npr.T / 1e3, strict=True
        ):
            secant = Points("true secant, where excited", drive.time_s, true, colour=6)
            both = Line("estimate", drive.time_s, found, 0), secant
            stiffness.append(Panel(both, f"{wheel} [kN/rad]", y_range=(0.0, 32.0)))
        caption = "Cornering stiffness of the axles, and -F/b of the simulated tyres."
        yield Figure("Cornering stiffness", stiffness, caption, x_label="time [s]")
