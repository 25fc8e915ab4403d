"""The operating points of wheels at constant speed: slip beside current and, where motors are known, thrust.

Of a wheel with the current I (its magnitude, or positive where it drives),

    F = (kt n eta I - T_friction) / r,    F / N with N = m g / wheels

is the thrust over its share of the weight.  A run at constant speed has one such point; points that differ in
slip on one surface differ in how the robot was driven, and are no curve of thrust over slip.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.measured_slip.slips import MeasuredSlip
from terrain.records import Array, RunLog
from terrain.robots import Robot


class OperatingPoints(NamedTuple):
    """Points of runs, (n,) each; NaN where it is not known.

    Parameters
    ----------
    slip_ratio : median of the body over a run's windows in steady motion
    current_a : median over these of the mean of the wheels
    thrust_ratio : mean thrust of a wheel over its share of the weight
    """

    slip_ratio: Array
    current_a: Array
    thrust_ratio: Array


def operating_points(runs: Sequence[RunLog], slips: Sequence[MeasuredSlip], robot: Robot) -> OperatingPoints:
    """Return the operating point of each run."""
    rows = [_point(run, slip, robot) for run, slip in zip(runs, slips, strict=True)]
    return OperatingPoints(*np.array(rows).reshape(-1, 3).T)


def _point(run: RunLog, slip: MeasuredSlip, robot: Robot) -> tuple[float, float, float]:
    rows = slip.known
    if not rows.size:
        return np.nan, np.nan, np.nan
    ratio = float(np.median(slip.body_slip[rows]))
    names = [f"current_{wheel}_a" for wheel in robot.wheels]
    wheels = run.streams["wheels"]
    if not set(names) <= set(wheels.channels):
        return ratio, np.nan, np.nan
    current = np.abs(np.column_stack([wheels.channel(name) for name in names]))
    inside = np.zeros(len(wheels), dtype=bool)
    for row in rows:
        inside |= (wheels.time_s >= slip.start_s[row]) & (wheels.time_s <= slip.end_s[row])
    known = np.isfinite(current).all(axis=1) & inside
    if not known.any():
        return ratio, np.nan, np.nan
    mean_a = float(current[known].mean())
    if not robot.describes("motors"):
        return ratio, mean_a, np.nan
    motors = robot.motors
    torque_nm = mean_a * motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio
    load_n = robot.mass_kg * GRAVITY_MPS2 / len(robot.wheels)
    return ratio, mean_a, (torque_nm - motors.friction_nm) / robot.wheel_radius_m / load_n
