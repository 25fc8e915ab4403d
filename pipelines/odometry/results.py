"""Results of ``terrain odometry``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from terrain.calibration.odometry_judge import LegScores


@dataclass(frozen=True, slots=True)
class ParameterFound:
    """A parameter of a slip model: its value and its 95 % interval, NaN where it was not fitted."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class OdometryResult:
    """Odometry of one robot, judged on runs held out.

    Parameters
    ----------
    robot, seed, folds : of the comparison
    n_runs : runs with poses
    scores : by length of the legs
    parameters : of the slip-compensated odometry fitted to all runs
    observed_point_m : where the point that poses show lies in the body
    observed_angle_rad : by which the sensor of the poses is turned
    delay_s : of the poses behind the gyro, as the robot's description has it
    adaptive : scores of the last windows of commands, by the adaptive observer and others; None without
    written : file of the slip model, or None
    notes : what is missing, in words
    """

    robot: str
    seed: int
    folds: int
    n_runs: int
    scores: tuple[LegScores, ...]
    parameters: Mapping[str, ParameterFound]
    observed_point_m: tuple[float, float]
    observed_angle_rad: float
    delay_s: float
    adaptive: LegScores | None
    written: Path | None
    notes: tuple[str, ...]
