"""Equations of Deremetz et al. that are printed wrong, and what the error does."""

from __future__ import annotations

import numpy as np

from pipelines.reproduce.deremetz.drives import FAST_MPS, adap2e, drives, over
from pipelines.reproduce.deremetz.stiffness import median_error
from pipelines.reproduce.results import Finding, Picture, Row, Verdict
from pipelines.track.figures import stiffness_figure
from terrain.control.car_evaluation import FollowedDrive
from terrain.estimation.observers.sideslip_forces import C_LOW_NPR
from terrain.robots.bicycle import BicycleRobot


def misprints(seed: int, quick: bool) -> Finding:
    """Show the signs of (3): its eigenvalue, and where they send the cornering stiffness."""
    robot = adap2e()
    right, printed = (fastest_growth_ps(robot, FAST_MPS, sign) for sign in (-1.0, 1.0))
    wrong = drives("slope", FAST_MPS, "multi-model, printed signs", seed, quick)
    least = over(wrong, lambda drive: float(drive.stiffness_npr.min()))
    corrected = over(drives("slope", FAST_MPS, "multi-model", seed, quick), _last_npr)
    lateral = over(wrong, lambda drive: drive.lateral_max_m(0.0, 58.0))
    rows = [
        Row(
            what="Largest real part of the eigenvalues of (3) at 5 m/s",
            where="II.C, (3) line 2",
            printed="a model of a robot that drives stably",
            simulated=right,
            unit="1/s",
            verdict=Verdict.CORRECTED if right < 0.0 < printed else Verdict.DIFFERS,
            why="Line 2 prints the forces and v cos(b_R) yaw' with reversed signs: it has an unstable "
            "eigenvalue. Right is d(v_G sin b)/dt = -(C_F b_F cos d + C_R b_R)/m - g sin a - v cos(b_R) "
            "yaw'.",
            beside={"as printed": printed},
        ),
        Row(
            what="Smallest cornering stiffness estimated at 5 m/s with the printed signs",
            where="II.C, (3) line 2",
            printed="an adapted stiffness",
            simulated=least.mean,
            spread=least.spread,
            unit="N/rad",
            verdict=Verdict.CORRECTED if least.spread[1] <= C_LOW_NPR else Verdict.DIFFERS,
            why="On the slope the printed signs ask for a side force downhill, and the stiffness runs to "
            "its lower limit. The lateral error in the S-bend is as with the right signs.",
            beside={
                "at the end, right signs": corrected.mean,
                "median error ratio, printed": over(wrong, median_error).mean,
                "lateral error in the S-bend [m]": lateral.mean,
            },
        ),
        Row(
            what="Gains of the yaw rate in section VI",
            where="VI.B.2",
            printed="K of yaw rate = 15 and 20",
            simulated=15.0,
            unit="1/s",
            verdict=Verdict.CORRECTED,
            why="It is given twice: 15 is that of theta~ beside that of y, 20 that of the yaw rate beside "
            "that of v_G sin b.",
        ),
    ]
    shown = {
        "right signs": drives("slope", FAST_MPS, "multi-model", seed, quick)[0],
        "printed signs": wrong[0],
    }
    picture = Picture(
        "Cornering stiffness at 5 m/s with the right and the printed signs of (3), line 2.",
        stiffness_figure(shown, "Cornering stiffness: right and printed signs"),
    )
    return Finding(rows, [picture])


def fastest_growth_ps(robot: BicycleRobot, speed_mps: float, sign: float) -> float:
    """Return the largest real part of the eigenvalues of yaw rate and lateral speed.

    Parameters
    ----------
    robot : with its nominal cornering stiffness
    speed_mps : of the rear axle
    sign : of the forces and of v yaw' in line 2: -1 is right, 1 as printed

    Examples
    --------
    >>> round(fastest_growth_ps(adap2e(), 5.0, 1.0)), fastest_growth_ps(adap2e(), 5.0, -1.0) < 0
    (14, True)
    """
    front, rear = robot.com_behind_front_m, robot.com_ahead_m
    c_front, c_rear = robot.front_cornering_npr, robot.rear_cornering_npr
    slips = np.array([[front, 1.0], [-rear, 1.0]]) / speed_mps  # b_F, b_R by yaw rate and lateral speed
    matrix = np.array(
        [
            (rear * c_rear * slips[1] - front * c_front * slips[0]) / robot.yaw_inertia_kgm2,
            sign * ((c_front * slips[0] + c_rear * slips[1]) / robot.mass_kg + np.array([speed_mps, 0.0])),
        ]
    )
    return float(np.linalg.eigvals(matrix).real.max())


def _last_npr(drive: FollowedDrive) -> float:
    return float(drive.stiffness_npr[-1].mean())
