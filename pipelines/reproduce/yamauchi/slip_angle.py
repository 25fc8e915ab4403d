"""Experiment II of Yamauchi et al., second half (tables 3 and 4): the regression (28) in turns."""

from __future__ import annotations

import numpy as np
from scipy import stats

from pipelines.reproduce.results import Finding, Row, Verdict, holds, verdict_of
from pipelines.reproduce.yamauchi.trials import (
    FEW_REPEATS,
    REPEATS,
    UPHILL,
    patako,
    run_trial,
    turning_trials,
)
from terrain.calibration.clustered_fit import LinearFit, fit_runs
from terrain.calibration.track_motion import slip_samples
from terrain.calibration.turning_angle import angle_columns
from terrain.estimation.observers.slip_model import REGRESSORS
from terrain.records import Array

PRINTED_R2, PRINTED_N = 0.753, 1283
PRINTED = (-5.72, 31.2, 344.0, -37.9, -127.0, 82.7, -7.04, 0.321)
"""Table 3: of an angle in degrees; units of the variables are not printed, SI units are assumed."""

PITCH = REGRESSORS.index("pitch_rad")
SIGNIFICANT = 0.05
ERRATUM_CONDITION = 340.0
"""Of the variables, by this project's own check of the paper's set-up."""


def slip_angle(seed: int, quick: bool) -> Finding:
    """Fit (28) as printed to turns uphill on four slopes, and look at what it is worth."""
    trials = turning_trials(seed, max(FEW_REPEATS, 1) if quick else REPEATS, (UPHILL,))
    robot = patako()
    samples = slip_samples([run_trial(trial) for trial in trials], robot).turning
    x, angle = angle_columns(samples, robot.half_track_m)
    degrees = np.degrees(angle)
    found = fit_runs(x, degrees, samples.run, REGRESSORS)
    without = fit_runs(x[:, :-1], degrees, samples.run, REGRESSORS[:-1])
    return Finding(_rows(found, without, _independent_p(x, degrees, found)))


def _independent_p(x: Array, y: Array, found: LinearFit) -> Array:
    """Return p values with all samples taken for independent, as the paper's are."""
    residual = y - x @ found.coefficient
    variance = residual @ residual / (len(y) - x.shape[1])
    std = np.sqrt(variance * np.diag(np.linalg.inv(x.T @ x)))
    return np.asarray(2 * stats.t.sf(np.abs(found.coefficient) / std, len(y) - x.shape[1]))


def _rows(found: LinearFit, without: LinearFit, independent_p: Array) -> list[Row]:
    coefficients = dict(zip(REGRESSORS, found.coefficient.tolist(), strict=True))
    printed = dict(zip(REGRESSORS, PRINTED, strict=True))
    n_significant = int(np.sum(found.p_value < SIGNIFICANT))
    roll = REGRESSORS.index("roll_rad")
    interval = (float(found.interval[0][roll]), float(found.interval[1][roll]))
    gained = found.r2_ratio - without.r2_ratio
    return [
        Row(
            what="Coefficient of determination R² of the regression",
            where="table 4",
            printed=f"{PRINTED_R2}",
            printed_interval=(PRINTED_R2, PRINTED_R2),
            simulated=found.r2_ratio,
            unit="ratio",
            verdict=verdict_of(round(found.r2_ratio, 3), (PRINTED_R2, PRINTED_R2)),
            why="By forces a turn drifts by roll times yaw rate, a product that (28) does not have; the "
            f"printed figure is of {PRINTED_N} samples, this one of {found.n} of {found.n_runs} turns.",
            beside={"residual within a turn, deg": found.residual_std, "of turns, deg": found.run_std},
        ),
        Row(
            what="Variables of eight with p < 0.05, turns taken as a whole",
            where="table 3",
            printed="8",
            printed_interval=(8.0, 8.0),
            simulated=float(n_significant),
            unit="variables",
            verdict=verdict_of(float(n_significant), (8.0, 8.0)),
            why="Samples of one turn are not independent of each other. Taken as independent, as in the "
            f"paper, {int(np.sum(independent_p < SIGNIFICANT))} variables have p < 0.05. All trials have "
            "the same input speed, so that its coefficient is that of noise and shares the intercept's.",
            beside=dict(zip(REGRESSORS, found.p_value.tolist(), strict=True)),
        ),
        Row(
            what="Coefficient of the roll angle",
            where="table 3",
            printed=f"{printed['roll_rad']:g}",
            printed_interval=(printed["roll_rad"],) * 2,
            simulated=coefficients["roll_rad"],
            spread=interval,
            unit="deg/rad",
            verdict=verdict_of(coefficients["roll_rad"], (printed["roll_rad"],) * 2, interval),
            why="Units are not printed; an angle in degrees over radians is assumed.",
            beside={"pitch, nose down positive": coefficients["pitch_rad"], "printed pitch": PRINTED[PITCH]},
        ),
        Row(
            what="Coefficients of input and gyro yaw rate: condition number of the eight variables",
            where="table 3",
            printed="344 and -37.9, no condition number",
            simulated=found.condition,
            unit="ratio",
            verdict=Verdict.NOT_PRINTED,
            why="On one ground the gyro's yaw rate is a constant part of the input's, and the input "
            "speed is a constant: neither pair of coefficients can be separated, whatever their p "
            "values. Odometry uses a regression without the constant and with a ridge chosen by leaving "
            "turns out.",
            beside={
                "input yaw rate": coefficients["input_yaw_rate_radps"],
                "gyro yaw rate": coefficients["gyro_yaw_rate_radps"],
                "variance inflation": float(np.nanmax(found.inflation)),
                "known before": ERRATUM_CONDITION,
            },
        ),
        Row(
            what="Rise of R² by the slope angle as a variable",
            where="discussion",
            printed="about 10 %",
            simulated=gained,
            unit="ratio",
            verdict=holds(gained > 0.05),
            why="The slope angle is a function of roll and pitch, (29); what it adds is the even part.",
            beside={"without": without.r2_ratio},
        ),
    ]
