"""How well a car-like robot followed a path, and what its observer knew, by a simulated truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.control.car_following import FollowedTick
from terrain.control.paths import PathStatus, ReferencePath, locate
from terrain.records import Array, RunLog

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
        pose = (float(columns[name][k]) for name in ("position_x_m", "position_y_m", "yaw_rad"))
        before, places[k, 1], *_ = locate(path.rows, *pose, before)
        places[k, 0] = before
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
