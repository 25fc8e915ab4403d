"""``terrain calibrate --what odometry``: slip-compensated odometry, judged on runs that were held out."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from pipelines.data.datasets import drive_robot, load
from pipelines.report.numbers import format_value
from pipelines.report.results import Progress, Result, described
from pipelines.report.tree import Column, Report, Table, Text, sections
from pipelines.slip.calibrate import Settings
from terrain.calibration.odometry import LegScores, ParameterFound, judge_odometry
from terrain.estimation.models.slip_model import check_slip_model_file, write_slip_model
from terrain.logs.drive import FILE_NAME, WindowPoses, find_sessions, read_window_poses
from terrain.robots import TrackedRobot, as_drive, load_robot

FLAT = "no slope was driven, or no tilt measured: what slopes do is not fitted"

RMSE = ".3f"


class OdometryResult(Result):
    """Odometry of one robot, judged on runs held out."""

    robot: str = described("its name")
    seed: int = described("of folds and bootstrap")
    folds: int = described("of whole runs")
    n_runs: int = described("with poses")
    scores: tuple[LegScores, ...] = described("by length of the legs")
    parameters: Mapping[str, ParameterFound] = described("of the odometry fitted to all runs")
    observed_point_m: tuple[float, float] = described("where the point that poses show lies in the body", "m")
    observed_angle_rad: float = described("by which the sensor of the poses is turned", "rad")
    delay_s: float = described("of the poses behind the gyro, as the robot's description has it", "s")
    adaptive: LegScores | None = described("of the last windows of commands, by adaptive observer and others")
    written: Path | None = described("file of the slip model")
    notes: tuple[str, ...] = described("what is missing, in words")

    def records(self) -> Iterable[Any]:
        """Return a row a kind of odometry and length of legs."""
        return (
            {"length_s": scores.length_s, **asdict(kind)} for scores in self.scores for kind in scores.kinds
        )


def calibrate(settings: Settings, progress: Progress) -> OdometryResult:
    """Fit kinds of odometry to folds of runs and judge them on the others; write the slip model of all.

    Raises
    ------
    ConfigError
        if the robot is not tracked, or the file is there already.
    DataError
        if fewer runs than folds have poses.
    """
    assert settings.robot is not None
    runs, _, doubts = load(settings)
    refusal = "robot {name}: drive {drive!r} has no tracks; --what odometry is for 'tracked'"
    robot = as_drive(TrackedRobot, load_robot(settings.robot), refusal)
    if settings.out is not None:
        check_slip_model_file(settings.out)
    windows: Mapping[str, tuple[WindowPoses, ...]] = {}
    if settings.data.is_dir() and any((path / FILE_NAME).is_file() for path in find_sessions(settings.data)):
        windows = read_window_poses(settings.data, drive_robot(robot))
    asked = settings.lengths, settings.folds, settings.seed
    model, flat, figures = judge_odometry(runs, windows, robot, *asked, partial(progress, "odometry"))
    if settings.out is not None:
        write_slip_model(settings.out, model, robot.name)
    notes = (FLAT,) if flat else ()
    found = OdometryResult.of(settings, **figures, robot=robot.name, written=settings.out, notes=notes)
    return found.with_doubts(doubts)


KINDS = (
    Column("odometry", of="kind"),
    Column("RMSE", RMSE, "m", of="rmse_m"),
    Column("95 %", RMSE, of="rmse_ci_m"),
    Column("median", RMSE, "m", of="median_m"),
    Column("heading", ".1f", "degrees", of=lambda row: math.degrees(row.yaw_rmse_rad)),
    Column("below encoder", ".0%", of="gain_encoder"),
    Column("95 %", ".0%", of="gain_encoder_ci"),
    Column("below gyro", ".0%", of="gain_gyro"),
    Column("95 %", ".0%", of="gain_gyro_ci"),
)


def report(result: OdometryResult) -> Report:
    """Return the errors of each kind of odometry by the length of a leg, and the slip model."""
    x_m, y_m = result.observed_point_m
    tables = [_table(scores, f"position after {scores.length_s:.2g} s, held out") for scores in result.scores]
    if result.adaptive is not None:
        title = f"last windows of {result.adaptive.n_legs} commands, by efficiencies of the windows before"
        tables.append(_table(result.adaptive, title))
    columns = ("parameter", Column("value", ".4g"), Column("95 %", ".4g"))
    parameters = [(name, each.value, (each.low, each.high)) for name, each in result.parameters.items()]
    mount = (
        f"The poses are of a point {100 * x_m:+.1f} cm ahead and {100 * y_m:+.1f} cm to the left, turned by "
        f"{math.degrees(result.observed_angle_rad):+.1f} degrees, {result.delay_s:.2f} s late."
    )
    longest = result.scores[-1]
    best = min(longest.kinds, key=lambda kind: kind.rmse_m)
    return Report(
        f"Odometry of {result.robot}",
        f"After {longest.length_s:.2g} s the position is off by {format_value(best.rmse_m, RMSE, 'm')} "
        f"({format_value(best.rmse_ci_m, RMSE)}) by {best.kind} odometry, on runs held out.",
        parts=[tables[len(result.scores) - 1], Text(mount), *(Text(note, "note") for note in result.notes)],
        details=sections(("All lengths", tables), ("Slip model of all runs", [Table(columns, parameters)])),
        next_step=f"terrain estimate --data DIR --filter slip-odometry --slip-model {result.written or 'FILE'}",
    )


def _table(scores: LegScores, title: str) -> Table:
    size = f"{scores.n_legs} legs of {scores.n_runs} runs, {scores.path_m:.2g} m apart"
    return Table(KINDS, scores.kinds, f"{title}: {size}")
