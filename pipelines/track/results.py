"""Results of ``terrain track``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class TrackResult:
    """A path that was followed; its fields are the keys of ``--json``.

    Parameters
    ----------
    robot, path, observer : names
    seed : of the noise
    length_m, n_points_merged : of the path
    speed_mps : desired
    reached_end : whether the robot came to the end
    duration_s, slowest_mps : of the drive; the slowest speed, start and standing excepted
    lateral_max_m, lateral_rms_m : error of the true position, to the desired offset
    lateral_max_at_m : distance along the path of the largest error
    limit_m : a tenth of the speed, the bound of Deremetz et al.
    within_limit : whether the largest error is below it and the end was reached
    slip_max_rad, slip_error_rad : largest true slip angle, and root mean square of the estimate's error,
        above 0.5 m/s; NaN without an observer
    stiffness_error_ratio : median error of the cornering stiffness over the secant; NaN where it is not shown
    grip_ratio, grip_std : as known at the end; NaN without the preview
    statuses : ticks by the status of observer, path and steering
    warnings : a sentence for each
    report : the page
    files : all that was written
    """

    robot: str
    path: Path
    observer: str
    seed: int
    length_m: float
    n_points_merged: int
    speed_mps: float
    reached_end: bool
    duration_s: float
    slowest_mps: float
    lateral_max_m: float
    lateral_rms_m: float
    lateral_max_at_m: float
    limit_m: float
    within_limit: bool
    slip_max_rad: float
    slip_error_rad: float
    stiffness_error_ratio: float
    grip_ratio: float
    grip_std: float
    statuses: Mapping[str, Mapping[str, int]]
    warnings: tuple[str, ...]
    report: Path
    files: tuple[Path, ...]
