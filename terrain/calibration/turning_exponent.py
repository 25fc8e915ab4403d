r"""Exponent n of Endo's law, from turns whose speed is known.

Yamauchi et al. take n as the slope of :math:`\ln|\alpha_l / \alpha_r|` over :math:`\ln|v_r / v_l|` (fig.
13).  Near a track that stops, and in turns with little slip, both logarithms are noise over noise, and the
error of the abscissa flattens the line.  Here n is found from the speed of the body,

.. math::
    V_x = \frac{v_r' + v_l'}{2} - \lambda |w|\, grade
          - \frac{D}{2} \tanh\Big(\frac{1 - n}{2} \ln\Big|\frac{v_r}{v_l}\Big|\Big),

by nonlinear least squares.  All terms are bounded, so that a track may pass through 0; errors of the encoders
enter by their logarithm only there, where tanh is saturated or D tells nothing.  The straight slip in v' is
that of straight runs.  lambda can be left out, as printed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from terrain.calibration.clustered_fit import LinearFit, clustered_covariance, fit_runs
from terrain.calibration.track_motion import SlipSamples
from terrain.errors import DataError
from terrain.records import Array

MAX_EXPONENT = 3.0
LARGEST_LOG = 700.0
"""Of a ratio of speeds one of which is 0."""


class TurningFit(NamedTuple):
    """Exponent, and what a grade adds in a turn.

    Parameters
    ----------
    exponent, turn_grade_m : n and lambda
    covariance : (2, 2) of both, by runs
    residual_std_mps, run_std_mps : of the speed, within the runs and of their means
    n, n_runs : samples and runs
    """

    exponent: float
    turn_grade_m: float
    covariance: Array
    residual_std_mps: float
    run_std_mps: float
    n: int
    n_runs: int

    @property
    def exponent_std(self) -> float:
        """Standard deviation of the exponent."""
        return float(np.sqrt(self.covariance[0, 0]))


def fit_turning(
    samples: SlipSamples, half_track_m: float, line: tuple[float, float] = (0.0, 0.0), *, grade: bool = True
) -> TurningFit:
    """Fit Endo's law to turns.

    Parameters
    ----------
    samples : of turns
    half_track_m : d
    line : intercept and slope of the straight slip
    grade : whether lambda is fitted as well

    Raises
    ------
    DataError
        if there are fewer than three runs that turn.
    """
    runs, number = np.unique(samples.run, return_inverse=True)
    if len(runs) < 3:
        raise DataError(f"{len(runs)} runs turn tightly, three or more are required to find n")
    left, right = samples.left_mps, samples.right_mps
    uphill = -samples.pitch_rad
    own = [v * (1.0 - line[0]) - np.abs(v) * line[1] * uphill for v in (left, right)]
    half = 0.5 * (own[1] - own[0]) - half_track_m * samples.yaw_rate_radps
    with np.errstate(divide="ignore"):
        log = np.clip(np.log(np.abs(right)) - np.log(np.abs(left)), -LARGEST_LOG, LARGEST_LOG)
    climb = np.abs(samples.yaw_rate_radps) * uphill

    def residual(found: Array) -> Array:
        kappa = np.tanh(0.5 * (1.0 - found[0]) * log)
        return np.asarray(0.5 * (own[0] + own[1]) - half * kappa - found[1] * climb - samples.forward_mps)

    reach = (2.0, 10.0) if grade else (2.0, 1e-12)
    bounds = ([0.0, -reach[1]], [MAX_EXPONENT, reach[1]])
    done = least_squares(residual, [0.9, 0.0], bounds=bounds, x_scale=[0.1, 0.1])
    error, by = done.fun, done.jac.copy()
    if not grade:
        by[:, 1] = 0.0
    covariance = clustered_covariance(np.linalg.pinv(by.T @ by), by * error[:, None], number)
    means = np.bincount(number, error) / np.bincount(number)
    within = np.sum((error - means[number]) ** 2) / max(len(error) - len(runs), 1)
    return TurningFit(
        float(done.x[0]),
        float(done.x[1]) if grade else 0.0,
        covariance,
        float(np.sqrt(within)),
        float(np.sqrt(np.mean(means**2))),
        len(error),
        len(runs),
    )


def fit_track_ratio(samples: SlipSamples, half_track_m: float) -> LinearFit:
    """Fit the effective distance of the tracks over the described one, from encoders and gyro alone."""
    by_gyro = 2.0 * half_track_m * samples.yaw_rate_radps
    difference = samples.right_mps - samples.left_mps
    return fit_runs(by_gyro[:, None], difference, samples.run, ("track_ratio",))
