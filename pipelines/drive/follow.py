"""A robot of any drive but a car-like one follows a path of the user in simulation, by its pilot."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.drive.drive import PAGE_FILE
from pipelines.live.pilot import LivePilot
from pipelines.report.figure import Band, Figure, Line, Panel
from pipelines.report.numbers import format_counts, format_value
from pipelines.report.results import Progress, Result, described
from pipelines.report.tree import Pairs, Report, Section, Text
from terrain.control.path_following import PathFollower
from terrain.control.paths import PathStatus, ReferencePath, read_path
from terrain.control.robot_control import POSE_STATES, PilotSettings
from terrain.control.situations import SituationOptions, make_situation, simulate_situation
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.switching import KnownTerrain
from terrain.control.traction import TractionStatus
from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write
from terrain.records import Array, Command, RunLog, Sample
from terrain.robots import Robot
from terrain.simulation.assumed import with_assumed
from terrain.simulation.scenario import RATE_HZ, Patch, Scenario
from terrain.status import StatusCode

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.drive.drive import Settings

#: Desired speed unless another is given, over that of the motors and at the most.
SPEED_RATIO, SPEED_MPS = 0.6, 1.0
DISTANCE = "distance along the path [m]"
SHOWN_M = 1.5  #: Lateral errors beyond this leave the figure
COLUMNS = ("time_s", "distance_m", "lateral_m", "position_x_m", "position_y_m", "speed_mps", "slip_ratio")


class PathDrive(Result, eq=False):
    """A path that was followed."""

    offset_m: float
    drive: Any  #: an array by columns, or a record of them
    reference: ReferencePath
    robot: str = described("name")
    path: Path = described("file of the path")
    seed: int = described("of the drive")
    length_m: float = described("length of the path", "m", form=".1f")
    speed_mps: float = described("desired", "m/s")
    reached_end: bool = described("whether the robot came to the end")
    duration_s: float = described("duration of the drive", "s", form=".1f")
    lateral_max_m: float = described("largest lateral error, to the desired offset", "m", form=".3f")
    lateral_rms_m: float = described("root mean square of the lateral error", "m", form=".3f")
    limit_m: float = described("a tenth of the speed, the bound of Deremetz et al.", "m")
    within_limit: bool = described("whether the largest error is below it and the end was reached")
    statuses: Mapping[str, Mapping[str, int]] = described("steps of 20 ms by the status of each part")
    page: Path | None = described("page that was written")
    files: tuple[Path, ...] = described("all that was written")

    def write(self) -> None:
        """Write the table of the drive, where there is a folder for it."""
        if self.files:
            table = self.to_pandas().to_csv(index=False, float_format="%.6g", na_rep="nan")
            atomic_write(self.files[1], table)

    @property
    def verdict(self) -> str:
        """Whether the path was followed, in a sentence."""
        if not self.reached_end:
            return "The end of the path was not reached."
        beside = "within" if self.within_limit else "beyond"
        worst, limit = (format_value(one, ".3f", "m") for one in (self.lateral_max_m, self.limit_m))
        text = f"The path was followed to its end; the lateral error is at most {worst}, {beside} a tenth of the speed"
        return f"{text}, {limit}."


def path_figures(
    settings: Settings, path: ReferencePath, speed_mps: float, error_m: Array, *, reached_end: bool
) -> dict[str, Any]:
    """Return the fields of :class:`PathDrive` that the settings, and the lateral errors (n,) of a drive, give."""
    worst, limit_m, out = float(np.abs(error_m).max()), speed_mps / 10.0, settings.out
    files = () if out is None else (out / PAGE_FILE, out / "drive.csv")
    return {
        "seed": settings.first_seed,
        "offset_m": settings.offset,
        "reference": path,
        "speed_mps": speed_mps,
        "reached_end": reached_end,
        "lateral_max_m": worst,
        "lateral_rms_m": float(np.sqrt(np.mean(error_m**2))),
        "limit_m": limit_m,
        "within_limit": bool(reached_end and worst <= limit_m),
        "page": files[0] if files else None,
        "files": files,
    }


class FollowResult(PathDrive, eq=False):
    """A path that a pilot followed, with the drive."""

    terrain: str = described("soil")
    table: str = described("name of the table of target slips")
    slip_max_ratio: float = described("largest mean slip of the driven wheels above 0.2 m/s", "1", form=".3f")

    def to_pandas(self) -> pd.DataFrame:
        """Return the drive, a row a step."""
        import pandas as pd

        return pd.DataFrame(self.drive, columns=list(COLUMNS))


def follow(settings: Settings, robot: Robot, progress: Progress) -> FollowResult:
    """Follow the path of the settings; with ``out`` write the table ``drive.csv`` of the drive.

    ``ConfigError`` for a speed beyond the motors', a soil or table that does not exist, or an option of car-like
    robots.
    """
    assert settings.path is not None
    settings.refuse(("observer", "slope_deg", "grip"), f"is accepted of car-like robots, not of {robot.name}")
    robot = with_assumed(robot)
    limit_mps = robot.wheel_radius_m * robot.motors.speed_max_radps
    speed_mps = min(SPEED_RATIO * limit_mps, SPEED_MPS) if settings.speed_mps is None else settings.speed_mps
    if speed_mps > limit_mps:
        raise ConfigError(f"--speed is {speed_mps:g}; {robot.name} drives at most {limit_mps:.3g} m/s")
    path, table = read_path(settings.path, settings.point_std), load_slip_table(settings.table, robot.name)
    drive, follower, log = drive_along(robot, path, table, settings, speed_mps)
    progress("drive", 1, 1)
    moves, statuses = drive[:, 5] > 0.2, log.streams["control"].channel("status_code")
    result = FollowResult.of(
        settings,
        path,
        robot=robot.name,
        table=table.name,
        duration_s=float(drive[-1, 0]),
        **path_figures(
            settings, path, speed_mps, drive[:, 2] - settings.offset, reached_end=follower.finished
        ),
        slip_max_ratio=float(np.nanmax(drive[moves, 6])) if np.isfinite(drive[moves, 6]).any() else math.nan,
        statuses={
            "path": counted(place.status for place in follower.places),
            "pilot": counted(TractionStatus(int(code)) for code in statuses.tolist()),
        },
        drive=drive,
    )
    result.write()
    return result


def counted(codes: Iterable[StatusCode]) -> dict[str, int]:
    """Return how often each status was, by its name."""
    return {code.label: n for code, n in sorted(Counter(codes).items())}


def at_origin(path: ReferencePath, offset_m: float) -> ReferencePath:
    """Return a path in the frame of a robot that stands at its start, at its offset."""
    x_m, y_m, yaw_rad = path.start
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    x, y = path.x_m - x_m, path.y_m - y_m
    heading = path.heading_rad - yaw_rad
    return replace(path, x_m=cos * x + sin * y, y_m=cos * y - sin * x - offset_m, heading_rad=heading)


def drive_along(
    robot: Robot, path: ReferencePath, table: SlipTable, settings: Settings, speed_mps: float
) -> tuple[Array, PathFollower, RunLog]:
    """Return the drive along a path, rows of :data:`COLUMNS`, its follower, and its log; the robot starts on it."""
    placed = at_origin(path, settings.offset)
    stops = [distance for distance in settings.stop if distance < path.length_m]
    follower = PathFollower(placed, speed_mps, settings.offset, stops)
    pilot = LivePilot(robot, table, KnownTerrain(), PilotSettings())
    longest_s = 2.0 * path.length_m / speed_mps + 30.0 + 4.0 * len(stops)
    made = make_situation("straight", robot, settings.terrain, settings.first_seed, SituationOptions())
    time_s = np.arange(round(longest_s * RATE_HZ) + 1) / RATE_HZ
    patches = (Patch(0.0, next(iter(made.soils))),)
    still = np.zeros((time_s.size, 3))
    made = made._replace(scenario=Scenario("path", RATE_HZ, time_s, still, patches))
    filter_ = pilot.filter_states
    states = [filter_.index(name) for name in POSE_STATES if name in filter_]
    if len(states) < len(POSE_STATES):
        raise ConfigError(f"robot {robot.name}: nothing that it has measures its position")
    unknown = np.full(3, math.nan)

    def step(sample: Sample) -> Command:
        pose = unknown if pilot.estimate is None else pilot.estimate.mean[states]
        return pilot.step(sample._replace(twist=follower.step(sample.time_s, pose)))

    log = simulate_situation(robot, made, step, PilotSettings().delay_s)
    truth, before_m, rows = log.streams["truth"], math.nan, []
    names = ("position_x_m", "position_y_m", "yaw_rad", "speed_x_mps", "speed_y_mps")
    slips = [f"slip_{wheel}_ratio" for wheel in robot.logged_wheels]
    columns, slip = truth.columns(names), np.abs(truth.columns(slips)).mean(axis=1)
    stands = next((k for k, place in enumerate(follower.places) if place.status is PathStatus.END), -1)
    last_s = time_s[stands]
    for at_s, row, ratio in zip(truth.time_s.tolist(), columns, slip.tolist(), strict=True):
        if at_s > last_s:
            break
        x_m, y_m, yaw_rad = row[:3].tolist()
        place = placed.locate(x_m, y_m, yaw_rad, before_m)
        before_m = place.distance_m
        speed = math.hypot(row[3], row[4])
        rows.append((at_s, place.distance_m, place.lateral_m, row[0], row[1], speed, ratio))
    return np.array(rows), follower, log


def report(result: FollowResult) -> Report:
    """Return whether the path was followed, and how far beside it the robot was."""
    figures: list[tuple[Any, ...]] = list(
        result.pairs("length_m", "duration_s", "lateral_max_m", "lateral_rms_m", "slip_max_ratio")
    )
    statuses = [(name, format_counts(counts)) for name, counts in result.statuses.items()]
    warnings = [] if result.reached_end else [f"the robot came to {result.drive[-1, 1]:.1f} m"]
    return Report(
        title=f"{result.robot} along {result.path.name}",
        answer=result.verdict,
        lead=f"{result.speed_mps:.3g} m/s · {result.terrain} · table {result.table} · seed {result.seed}",
        picture=lateral_figure(result.drive[:, 1], result.drive[:, 2] - result.offset_m, result.limit_m),
        parts=[*(Text(text, "warning") for text in warnings), Pairs(figures)],
        details=[
            Section("Path and robot", list(_map(result))),
            Section("Steps of 20 ms by status", [Pairs(statuses)]),
        ],
    )


def lateral_figure(distance_m: Array, error_m: Array, limit_m: float) -> Figure:
    """Show the lateral error (n,) along a path, and a tenth of the speed."""
    most = 1.1 * min(max(limit_m, float(np.abs(error_m).max())), SHOWN_M)
    marks = (
        Band("a tenth of the speed", distance_m[[0, -1]], [-limit_m] * 2, [limit_m] * 2, 6),
        Line("lateral error", distance_m, error_m, 0),
    )
    return Figure(
        "Lateral error along the path",
        [Panel(marks, "lateral error [m]", y_range=(-most, most))],
        "Of the true position, to the desired offset; positive to the left.",
        x_label=DISTANCE,
    )


def map_figure(path: ReferencePath, position_m: Array, what: str) -> Figure:
    """Show a path, and the positions (n, 2) of a part of the robot."""
    marks = (
        Line("path", path.x_m, path.y_m, 6, dashed=True),
        Line(what, position_m[:, 0], position_m[:, 1], 0),
    )
    panel = Panel(marks, "y [m]", x_label="x [m]", equal=True)
    return Figure(f"The path, and where the {what} was", [panel])


def _map(result: FollowResult) -> Iterator[Figure]:
    drive = result.drive
    yield map_figure(at_origin(result.reference, result.offset_m), drive[:, 3:5], "body's origin")
    panels = [
        Panel([Line("", drive[:, 1], drive[:, k], 0)], label)
        for k, label in ((5, "speed [m/s]"), (6, "slip ratio"))
    ]
    yield Figure("Speed over ground, and mean slip of the driven wheels", panels, x_label=DISTANCE)
