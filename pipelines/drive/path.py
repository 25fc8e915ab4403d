"""A robot follows a path of the user in simulation: a car-like one with an observer of sideslip, others by a pilot."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.drive.follow import (
    DISTANCE,
    FollowResult,
    PathDrive,
    counted,
    follow,
    lateral_figure,
    map_figure,
    path_figures,
)
from pipelines.report.figure import Band, Figure, Line, Mark, Panel, Points
from pipelines.report.numbers import format_counts, format_value
from pipelines.report.results import Progress, described
from pipelines.report.tree import Pairs, Part, Report, Section, Text
from terrain.control.car_following import (
    CarFollower,
    FollowedDrive,
    FollowedTick,
    SlipSource,
    SteeringSettings,
    SteerStatus,
    followed_drive,
)
from terrain.control.paths import GRID_M, PathStatus, ReferencePath, read_path
from terrain.errors import ConfigError
from terrain.estimation.models.observer import ObserverStatus
from terrain.robots import BicycleRobot, load_robot
from terrain.simulation.plants.car import CarDrive, Ground
from terrain.simulation.run import simulate
from terrain.status import StatusCode

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.drive.drive import Settings

SPEED_MPS = 3.0  #: Unless another is given


STAND_S = 3.0  #: Time of a stop

START_M, SLOW_MPS = 2.0, 0.5
"""Distance travelled beside that of speeding up, and speed, from which the robot counts as cruising."""

WHEELS = ("front", "rear")


class PathResult(PathDrive, eq=False):
    """A path that a car-like robot followed, with the drive."""

    observer: str = described("that gave the sideslip")
    n_points_merged: int = described("points of the file that lay too close to their neighbours")
    slowest_mps: float = described("slowest speed, start and standing excepted", "m/s")
    lateral_max_at_m: float = described("distance along the path of the largest error", "m")
    slip_max_rad: float = described("largest true slip angle above 0.5 m/s", "rad")
    slip_error_rad: float = described("root mean square error of the estimate; null without observer", "rad")
    stiffness_error_ratio: float = described("cornering stiffness, median error over the secant", "1")
    grip_ratio: float = described("largest side force over load as known at the end, with the preview", "1")
    grip_std: float = described("its standard deviation", "1")
    warnings: tuple[str, ...] = described("a sentence for each")

    def to_pandas(self) -> pd.DataFrame:
        """Return the drive, a row a tick."""
        import pandas as pd

        drive = self.drive
        columns = {name: getattr(drive, name) for name in ("time_s", "distance_m", "lateral_m")}
        columns |= {f"position_{axis}_m": drive.position_m[:, i] for i, axis in enumerate("xy")}
        columns |= {"speed_mps": drive.speed_mps, "steer_front_rad": drive.steer_rad}
        for j, wheel in enumerate(WHEELS):
            columns |= {
                f"slip_{wheel}_rad": drive.slip_rad[:, j],
                f"slip_{wheel}_std_rad": drive.slip_std_rad[:, j],
                f"slip_{wheel}_true_rad": drive.slip_true_rad[:, j],
                f"cornering_{wheel}_npr": drive.stiffness_npr[:, j],
            }
        return pd.DataFrame(columns)


def run(settings: Settings, progress: Progress) -> PathResult | FollowResult:
    """Follow the path of the settings in simulation; with ``out`` write the table ``drive.csv`` of the drive."""
    assert settings.path is not None
    robot = load_robot(settings.robot)
    if not isinstance(robot, BicycleRobot):
        return follow(settings, robot, progress)
    settings.refuse(("terrain", "table"), f"is accepted of robots that are not car-like, as {robot.name} is")
    speed_mps = SPEED_MPS if settings.speed_mps is None else settings.speed_mps
    if speed_mps > robot.speed_max_mps:
        raise ConfigError(
            f"--speed is {speed_mps:g}; {robot.name} drives at most {robot.speed_max_mps:g} m/s"
        )
    path = read_path(settings.path, settings.point_std)
    drive, ticks = drive_along(robot, path, settings, speed_mps)
    progress("drive", 1, 1)
    codes: dict[str, Iterator[StatusCode]] = {
        "observer": (ObserverStatus(tick.estimate.status) for tick in ticks),
        "path": (tick.place.status for tick in ticks),
        "steering": (tick.steer_status for tick in ticks),
    }
    result = PathResult.of(
        settings,
        path,
        robot=robot.name,
        n_points_merged=path.n_merged,
        **path_figures(
            settings, path, speed_mps, drive.lateral_m - settings.offset, reached_end=drive.reached_end
        ),
        **slip_figures(drive, settings, speed_mps),
        statuses={name: counted(found) for name, found in codes.items()},
        warnings=(*path_warnings(path, robot), *drive_warnings(drive, ticks, settings.stop)),
        drive=drive,
    )
    result.write()
    return result


def drive_along(
    robot: BicycleRobot, path: ReferencePath, settings: Settings, speed_mps: float
) -> tuple[FollowedDrive, Sequence[FollowedTick]]:
    """Return the simulated drive along a path, and the ticks of its controller; the ground has the path's roll."""
    steering = SteeringSettings(offset_m=settings.offset)
    follower = CarFollower(robot, path, SlipSource(settings.observer), steering)
    assert path.roll_rad is not None
    at, known = path.distance_m[::10], path.roll_rad[::10]
    roll = np.where(np.isnan(known), np.deg2rad(settings.slope_deg), known)
    ground = Ground(at, np.full(len(at), settings.grip), roll)
    stops = tuple((distance, STAND_S) for distance in settings.stop if distance < path.length_m)
    longest_s = 2.0 * path.length_m / speed_mps + 30.0 + STAND_S * len(stops)
    x, y, heading = path.start
    start = (x - settings.offset * np.sin(heading), y + settings.offset * np.cos(heading), heading)
    drive = CarDrive(speed_mps, stops, longest_s, start)
    log = simulate(robot, drive, ground, settings.first_seed, run_id="car", controller=follower)
    return followed_drive(log, path, follower.ticks), follower.ticks


def slip_figures(drive: FollowedDrive, settings: Settings, speed_mps: float) -> dict[str, Any]:
    """Return figures of a drive by its truth; NaN where undefined, those of slip angles above :data:`SLOW_MPS`."""
    error = drive.lateral_m - settings.offset
    moves = drive.speed_mps > SLOW_MPS
    cruises = moves & drive.between(START_M + speed_mps**2 / 3.0, np.inf)
    stiffness = np.abs(drive.stiffness_error_ratio)
    slips, errors = np.abs(drive.slip_true_rad[moves]), drive.slip_error_rad[moves]
    errors = errors[np.isfinite(errors)]
    observed = settings.observer != "none" and errors.size
    return {
        "duration_s": float(drive.time_s[-1]),
        "slowest_mps": float(drive.speed_mps[cruises].min()) if cruises.any() else math.nan,
        "lateral_max_at_m": float(drive.distance_m[np.abs(error).argmax()]),
        "slip_max_rad": float(np.nanmax(slips)) if np.isfinite(slips).any() else math.nan,
        "slip_error_rad": float(np.sqrt(np.mean(errors**2))) if observed else math.nan,
        "stiffness_error_ratio": float(np.median(stiffness)) if stiffness.size else math.nan,
        "grip_ratio": float(drive.grip_ratio[-1]),
        "grip_std": float(drive.grip_std[-1]),
    }


def path_warnings(path: ReferencePath, robot: BicycleRobot) -> Iterator[str]:
    """Yield a sentence for what of a path the robot cannot drive, and for what was changed."""
    reach = math.tan(robot.steering_max_rad) / robot.wheelbase_m
    sharpest = int(np.abs(path.curvature_pm).argmax())
    if abs(curvature := path.curvature_pm[sharpest]) > reach:
        yield (
            f"curvature is {curvature:.3f} 1/m at {sharpest * GRID_M:.1f} m; "
            f"steering to {np.degrees(robot.steering_max_rad):.0f} degrees reaches {reach:.3f} 1/m"
        )
    if path.n_merged:
        yield f"{path.n_merged} points that repeat the one before were merged with it"


def drive_warnings(
    drive: FollowedDrive, ticks: Sequence[FollowedTick], stops_m: Sequence[float]
) -> Iterator[str]:
    """Yield what a user has to know of a drive along a path, a sentence each."""
    last_m = drive.distance_m[-1]
    if not drive.reached_end:
        yield f"the end was not reached: the robot came to {last_m:.1f} m"
    for status, text in (
        (PathStatus.FAR, "was too far from the path to find its place"),
        (PathStatus.SINGULAR, "was near the centre of curvature of the path"),
    ):
        first = next((tick for tick in ticks if tick.place.status == status), None)
        if first is not None:
            yield f"the robot {text}, first at {first.place.distance_m:.1f} m after {first.time_s:.1f} s"
    clamped = sum(tick.steer_status == SteerStatus.CLAMPED for tick in ticks) / len(ticks)
    if clamped > 0.01:
        yield f"the steering was at its limit for {clamped:.0%} of the drive"
    if late := [distance for distance in stops_m if distance > last_m]:
        yield f"stop at {late[0]:g} m is beyond where the drive ended"


def report(result: PathResult) -> Report:
    """Return whether the path was followed, its lateral error, and behind it what the observer gave."""
    degrees, drive = 180.0 / math.pi, result.drive
    figures: list[tuple[Any, ...]] = [
        *result.pairs("length_m", "duration_s", "slowest_mps"),
        *result.pairs("lateral_max_m", "lateral_max_at_m", "lateral_rms_m"),
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
        answer=result.verdict,
        lead=f"{result.speed_mps:g} m/s · sideslip by: {result.observer} · seed {result.seed}",
        picture=lateral_figure(drive.distance_m, drive.lateral_m - result.offset_m, result.limit_m),
        parts=[*(Text(text, "warning") for text in result.warnings), Pairs(figures)],
        details=[
            Section("Path and robot", list(_map(result))),
            Section("What the observer gave", list(_observed(result))),
            Section("Ticks of 20 ms by status", [Pairs(statuses)]),
        ],
    )


def _map(result: PathResult) -> Iterator[Part]:
    drive = result.drive
    yield map_figure(result.reference, drive.position_m, "rear axle")
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
