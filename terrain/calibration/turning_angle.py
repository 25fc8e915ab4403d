"""Slip angle in turns: the regression (28) of Yamauchi et al. on eight variables.

The variables are those of :data:`terrain.estimation.observers.slip_model.REGRESSORS`, in SI units and as
seen in a left turn driven forward, and so is the angle.  **Corrected**: input and gyro yaw rate are nearly
collinear, as the gyro's is a constant part of the input's on one ground; condition number and variance
inflation are reported, and a ridge is chosen by leaving runs out where they are high.  With poses that noise
makes vary in all directions, p values of collinear variables say little; they are reported as the paper does.
"""

from __future__ import annotations

import numpy as np

from terrain.calibration.clustered_fit import LinearFit, fit_runs
from terrain.calibration.track_motion import SlipSamples
from terrain.calibration.turning_drift import DRIFT, drift_columns
from terrain.errors import DataError
from terrain.estimation.observers.slip_model import N_ANGLE, REGRESSORS, angle_regressors
from terrain.records import Array

CONSTANT_RATIO = 0.1
"""Standard deviation over the mean of a variable: below it, its effect is that of the intercept."""

CONSTANT_STD = 0.2
"""Standard deviation, in rad, of what a doubled variable does to the angle where its effect was not driven;
assumed, the residual of the regression of Yamauchi et al."""


def angle_columns(samples: SlipSamples, half_track_m: float) -> tuple[Array, Array]:
    """Return the variables (n, 8) of (28), and the slip angle (n,), of a left turn driven forward."""
    x = np.empty((len(samples.run), N_ANGLE))
    for i in range(len(x)):
        angle_regressors(
            (samples.left_mps[i], samples.right_mps[i]),
            samples.yaw_rate_radps[i],
            samples.roll_rad[i],
            samples.pitch_rad[i],
            samples.displacement_rad[i],
            half_track_m,
            x[i],
        )
    mirror = left_turn_sign(samples)
    angle = np.arctan2(samples.lateral_mps, np.abs(samples.forward_mps))
    return x * mirror[:, None], angle * mirror


def left_turn_sign(samples: SlipSamples) -> Array:
    """Return m (n,), 1 in a left turn driven forward and in its image end to end and side to side."""
    forward, turn = samples.left_mps + samples.right_mps, samples.right_mps - samples.left_mps
    return np.where((forward >= 0.0) == (turn >= 0.0), 1.0, -1.0)


def fit_turning_angle(
    samples: SlipSamples, half_track_m: float, *, drift: bool = False, ridge: bool = True
) -> LinearFit:
    """Fit (28) to turns.

    Parameters
    ----------
    samples : of turns, of several rates, slopes and headings
    half_track_m : d
    drift : whether the two columns of :mod:`~terrain.calibration.turning_drift` come first; the sideways
        speed is fitted then, in place of the angle, which has no value at a forward speed of 0
    ridge : whether to regularise where the condition number asks for it

    Raises
    ------
    DataError
        if there are too few runs, or they do not vary the variables apart.
    """
    if len(np.unique(samples.run)) < 3:
        raise DataError("fewer than three runs turn tightly, three or more are required")
    x, y = angle_columns(samples, half_track_m)
    mean = np.abs(x.mean(axis=0))
    varied = x.std(axis=0) > CONSTANT_RATIO * mean
    varied[0] = True
    away = np.eye(N_ANGLE)[~varied]
    away[:, 0] = -x[:, ~varied].mean(axis=0)
    names = REGRESSORS
    if drift:
        mirror = left_turn_sign(samples)
        x = np.column_stack(
            [drift_columns(samples) * mirror[:, None], x * np.abs(samples.forward_mps)[:, None]]
        )
        y, names = mirror * samples.lateral_mps, DRIFT + REGRESSORS
        varied = np.concatenate([np.ones(len(DRIFT), bool), varied])
        away = np.column_stack([np.zeros((len(away), len(DRIFT))), away])
    kept = tuple(name for name, use in zip(names, varied.tolist(), strict=True) if use)
    fit = fit_runs(x[:, varied], y, samples.run, kept, ridge=ridge)
    if varied.all():
        return fit
    size = len(names)
    coefficient, p_value, inflation = np.zeros(size), np.full(size, np.nan), np.full(size, np.nan)
    unknown = away * (CONSTANT_STD / mean[~varied[-N_ANGLE:], None])
    covariance = unknown.T @ unknown
    covariance[np.ix_(varied, varied)] += fit.covariance
    coefficient[varied], p_value[varied], inflation[varied] = fit.coefficient, fit.p_value, fit.inflation
    return fit._replace(
        names=names,
        coefficient=coefficient,
        std=np.sqrt(np.diag(covariance)),
        p_value=p_value,
        covariance=covariance,
        inflation=inflation,
    )
