r"""Slip of a tracked robot from runs with poses: the laws of Yamauchi et al., and what was corrected in them.

**Samples.**  Poses of cameras or satellites are differentiated by local polynomials of second order over a window of
a few tenths of a second; speeds of the tracks, gyro and tilt are smoothed by the same polynomials, so that all are
alike late and alike smooth.  With poses of 1 mm at 100 Hz and a window of 0.6 s a velocity is within 0.6 mm/s, and an
arc at 30 deg/s is seen 0.2 % too slow.

**Regression** on samples of several runs, with intervals that hold for a run that was not among them:

.. math::
    \hat a = (X^T X + \Lambda)^{-1} X^T y,

with the covariance by clusters of :mod:`terrain.identify`: samples of a run are not counted as independent; p values
are those of t with G - 1 degrees of freedom.  Where the columns, scaled to length 1, have a condition number above
:data:`ILL_CONDITIONED`, Lambda is that of ridge regression on centred and scaled columns, its size the one that
predicts runs left out best; with 0 among the choices.

**Straight motion**: the line (22) over the grade, and the slope (26) over the roll.  ``1 - V_x / v`` is linear in the
grade along the motion, with the compaction as its intercept, and ``V_y / |V_x|`` is minus the roll times a constant.
*Corrected*: uphill is positive, grade = -pitch in body frames, and gravity keeps its sign in reverse.

**Exponent n of Endo's law** from turns whose speed is known.  Yamauchi et al. take n as the slope of
:math:`\ln|\alpha_l / \alpha_r|` over :math:`\ln|v_r / v_l|` (fig. 13).  Near a track that stops, and in turns with
little slip, both logarithms are noise over noise, and the error of the abscissa flattens the line.  Here n is found
from the speed of the body,

.. math::
    V_x = \frac{v_r' + v_l'}{2} - \lambda |w|\, grade
          - \frac{D}{2} \tanh\Big(\frac{1 - n}{2} \ln\Big|\frac{v_r}{v_l}\Big|\Big),

by nonlinear least squares.  All terms are bounded, so that a track may pass through 0; errors of the encoders
enter by their logarithm only there, where tanh is saturated or D tells nothing.  The straight slip in v' is
that of straight runs.  lambda can be left out, as printed.

**Slip angle in turns**: the regression (28) on eight variables, those of
:data:`terrain.estimation.models.slip_model.REGRESSORS`, in SI units and as seen in a left turn driven forward, and
so is the angle.  *Corrected*: input and gyro yaw rate are nearly collinear, as the gyro's is a constant part of the
input's on one ground; condition number and variance inflation are reported, and a ridge is chosen by leaving runs out
where they are high.  With poses that noise makes vary in all directions, p values of collinear variables say little;
they are reported as the paper does.

**Drift in turns**, by gravity and by the shift of the load: terms of this project,

.. math:: V_y = -\lambda_y |w|\, roll + c\, w\, grade,

beside the regression (28), which is then one of :math:`V_y = |V_x| \sum_i a_i X_i`.  While a robot turns,
friction is directed against the turning, and a small sideways force makes it drift at a speed in proportion
to the yaw rate; on a grade it turns about a point behind its middle.  By the forces of
:mod:`terrain.simulation.plants.tracks` these two explain 98 % of the variance of V_y in turns on sand,
where the eight variables of (28) explain 78 %.

Laws whose motions were not driven keep what is assumed of unknown ground, with its wide standard deviation, and
:attr:`SlipIdentification.notes` names them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from scipy import stats

from terrain.angles import unwrapped
from terrain.calibration.odometry import odometry_rows
from terrain.errors import DataError
from terrain.estimation.models.slip_model import (
    ANGLE,
    COMPACTION,
    EXPONENT,
    N_ANGLE,
    N_PARAMETERS,
    REGRESSORS,
    SIDE,
    TIGHT_RATIO,
    TRACK_RATIO,
    TURN_GRADE,
    TURN_SHIFT,
    TURN_SIDE,
    SlipModel,
    angle_regressors,
    body_velocity,
    model_of,
    next_displacement,
    unknown_ground,
)
from terrain.identify import Parameter, half_width, identify, jackknife_covariance, leave_out, select
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot

HALF_WINDOW_S = 0.3
SPACING_S = 0.2
"""Of the samples: their windows overlap, and errors of one run are taken together anyhow."""

STEADY_S = 0.3
"""From the start of motion: belts and soil settle."""

MIN_SPEED_MPS = 0.01
"""Of the faster track; below, slip is noise over noise."""

STRAIGHT_RATIO = 0.1
"""Tightness of a turn below which the robot drives straight: noise of encoders is well below."""

_MIN_SAMPLES = 5  # in a window, of three coefficients


class SlipSamples(NamedTuple):
    """Samples (n,) of steady motion of one or several runs.

    Parameters
    ----------
    left_mps, right_mps : speeds of the tracks
    yaw_rate_radps, roll_rad, pitch_rad : gyro and tilt
    displacement_rad : yaw since the turn began
    forward_mps, lateral_mps : velocity of the body, from poses
    run : number of the run of each sample
    """

    left_mps: Array
    right_mps: Array
    yaw_rate_radps: Array
    roll_rad: Array
    pitch_rad: Array
    displacement_rad: Array
    forward_mps: Array
    lateral_mps: Array
    run: Array

    @property
    def tightness(self) -> Array:
        """Difference of the speeds of the tracks over the sum of their magnitudes."""
        total = np.abs(self.left_mps) + np.abs(self.right_mps)
        return np.asarray(np.abs(self.right_mps - self.left_mps) / total)

    @property
    def straight(self) -> SlipSamples:
        """The samples of straight motion."""
        return self.where(self.tightness < STRAIGHT_RATIO)

    @property
    def turning(self) -> SlipSamples:
        """The samples of turns that are tight enough for the laws of turning to hold alone."""
        return self.where(self.tightness >= TIGHT_RATIO)

    def where(self, chosen: Array) -> SlipSamples:
        """Return the samples that a mask (n,) chooses."""
        return SlipSamples(*(column[chosen] for column in self))


def local_polynomial(time_s: Array, values: Array, at_s: Array, half_window_s: float) -> Array:
    """Return values and slopes (m, k, 2) of parabolas through the samples around each of m times.

    Parameters
    ----------
    time_s : (n,) rising
    values : (n, k); NaN is left out
    at_s : (m,) rising
    half_window_s : samples within it, on either side, count alike

    Notes
    -----
    NaN where the window reaches beyond the samples, or holds fewer than five.
    """
    out = np.full((len(at_s), values.shape[1], 2), np.nan)
    inside = (at_s - half_window_s >= time_s[0]) & (at_s + half_window_s <= time_s[-1])
    first = np.searchsorted(time_s, at_s - half_window_s, "left")
    last = np.searchsorted(time_s, at_s + half_window_s, "right")
    for row in np.flatnonzero(inside):
        t = (time_s[first[row] : last[row]] - at_s[row]) / half_window_s
        for column, part in enumerate(values[first[row] : last[row]].T):
            known = np.isfinite(part)
            if known.sum() >= _MIN_SAMPLES:
                powers = np.vander(t[known], 3, increasing=True)
                found = np.linalg.solve(powers.T @ powers, powers.T @ part[known])
                out[row, column] = found[0], found[1] / half_window_s
    return out


def _displacements(time_s: Array, speeds: Array, rate: Array, length_m: float) -> Array:
    out, total = np.zeros(len(time_s)), 0.0
    for i in range(1, len(time_s)):
        pair = (speeds[i, 0], speeds[i, 1])
        total = next_displacement(total, pair, rate[i], length_m, time_s[i] - time_s[i - 1])
        out[i] = total
    return out


def slip_samples(
    runs: Sequence[RunLog], robot: TrackedRobot, half_window_s: float = HALF_WINDOW_S
) -> SlipSamples:
    """Return samples of steady motion of all runs that have poses.

    Parameters
    ----------
    runs : with the streams wheels, imu and pose
    robot : that drove them
    half_window_s : of the polynomials

    Raises
    ------
    DataError
        if no run has a sample of steady motion.
    """
    parts = [
        _samples(number, run, robot, half_window_s)
        for number, run in enumerate(runs)
        if "pose" in run.streams and len(run.streams["pose"]) > _MIN_SAMPLES
    ]
    joined = SlipSamples(*(np.concatenate(column) for column in zip(*parts, strict=True))) if parts else None
    if joined is None or not len(joined.run):
        raise DataError(f"none of {len(runs)} runs has poses of a moving robot: slip needs them")
    return joined


def _samples(number: int, run: RunLog, robot: TrackedRobot, half_window_s: float) -> SlipSamples:
    time_s, rows = odometry_rows(run, robot)
    pose = run.streams["pose"]
    values = np.array(pose.values)
    values[:, 2] = unwrapped(values[:, 2])
    at_s = np.arange(time_s[0] + half_window_s, time_s[-1], SPACING_S)
    seen = local_polynomial(pose.time_s, values, at_s, half_window_s)
    own = local_polynomial(time_s, rows, at_s, half_window_s)[:, :, 0]
    turned = np.interp(
        at_s, time_s, _displacements(time_s, rows[:, :2], np.nan_to_num(rows[:, 2]), robot.contact_length_m)
    )
    cos, sin = np.cos(seen[:, 2, 0]), np.sin(seen[:, 2, 0])
    forward = cos * seen[:, 0, 1] + sin * seen[:, 1, 1]
    lateral = cos * seen[:, 1, 1] - sin * seen[:, 0, 1]
    moving = np.abs(own[:, :2]).max(axis=1) > MIN_SPEED_MPS
    began = at_s[np.argmax(moving)] if moving.any() else np.inf
    steady = moving & (at_s >= began + STEADY_S) & np.isfinite(own[:, :3]).all(axis=1)
    steady &= np.isfinite(forward) & np.isfinite(own[:, 3:]).all(axis=1)
    left, right, rate, roll, pitch = own.T
    which = np.full(len(at_s), number)
    found = SlipSamples(left, right, rate, roll, pitch, turned, forward, lateral, which)
    return found.where(steady)


ILL_CONDITIONED = 30.0
"""Belsley, Kuh and Welsch, Regression Diagnostics (1980): 30 and more is a harmful collinearity."""

RIDGES = (0.0, *np.geomspace(1e-6, 1.0, 13).tolist())
"""Sizes of the ridge that are tried, over the number of samples."""


class LinearFit(NamedTuple):
    """Coefficients of a regression, and what they are worth.

    Parameters
    ----------
    names : of the k columns
    coefficient, std, p_value : (k,)
    covariance : (k, k)
    r2_ratio : part of the variance that is explained; about 0 where there is no intercept
    residual_std, run_std : within the runs, and of their means
    condition : number of the columns, scaled to length 1
    inflation : (k,) variance inflation factors; NaN of the intercept
    ridge_ratio : that was chosen, over the number of samples
    n, n_runs : samples and runs
    """

    names: tuple[str, ...]
    coefficient: Array
    std: Array
    p_value: Array
    covariance: Array
    r2_ratio: float
    residual_std: float
    run_std: float
    condition: float
    inflation: Array
    ridge_ratio: float
    n: int
    n_runs: int

    @property
    def interval(self) -> Array:
        """Lower and upper ends (2, k) of the 95 % intervals."""
        half = half_width(self.std, self.n_runs - 1)
        return np.stack((self.coefficient - half, self.coefficient + half))


def fit_runs(x: Array, y: Array, run: Array, names: tuple[str, ...], *, ridge: bool = False) -> LinearFit:
    """Fit a regression to samples of several runs.

    Parameters
    ----------
    x : (n, k) columns; an intercept is a column of ones
    y : (n,)
    run : (n,) number of the run of each sample
    names : of the columns
    ridge : whether to regularise where the condition number asks for it

    Raises
    ------
    DataError
        if there are fewer than three runs, no more samples than columns, or a column is the sum of others.

    Examples
    --------
    >>> x = np.column_stack([np.ones(6), np.arange(6.0)])
    >>> found = fit_runs(x, 2 + 3 * x[:, 1], np.arange(6) // 2, ("intercept", "slope"))
    >>> found.coefficient.round(6), found.n_runs
    (array([2., 3.]), 3)
    """
    runs, number = np.unique(run, return_inverse=True)
    n, k = x.shape
    if len(runs) < 3 or n <= k:
        raise DataError(f"{n} samples of {len(runs)} runs: more than {k} of three or more runs are required")
    length = np.linalg.norm(x, axis=0)
    condition = float(np.linalg.cond(x / np.where(length > 0, length, 1.0))) if (length > 0).all() else np.inf
    if condition > 1e10:
        raise DataError(f"columns {', '.join(names)} are not independent: the runs do not vary them apart")
    size = 0.0
    if ridge and condition > ILL_CONDITIONED:
        size, _ = select(
            lambda ridge, *parts: -_left_out_error(x, y, number, ridge, *parts),
            RIDGES,
            np.arange(len(runs)),
            0.0,
        )
    inverse = np.linalg.inv(x.T @ x + _penalty(x, size))
    coefficient = inverse @ (x.T @ y)
    residual = y - x @ coefficient
    normal = x.T @ x + _penalty(x, size)
    covariance = jackknife_covariance(leave_out(x, x * residual[:, None], number, normal))
    std = np.sqrt(np.diag(covariance))
    means = np.bincount(number, residual) / np.bincount(number)
    constant = bool((x == 1.0).all(axis=0).any())
    total = float(np.sum((y - y.mean() if constant else y) ** 2))
    p_value = 2 * stats.t.sf(np.abs(coefficient) / np.maximum(std, 1e-300), len(runs) - 1)
    return LinearFit(
        names,
        coefficient,
        std,
        p_value,
        covariance,
        1.0 - float(residual @ residual) / max(total, 1e-300),
        float(np.sqrt(np.sum((residual - means[number]) ** 2) / max(n - len(runs), 1))),
        float(np.sqrt(np.mean(means**2))),
        condition,
        _inflation(x),
        size,
        n,
        len(runs),
    )


def _penalty(x: Array, size: float) -> Array:
    """Return the ridge (k, k) on columns as if they were scaled to a standard deviation of 1."""
    return np.diag(size * len(x) * x.var(axis=0))


def _left_out_error(x: Array, y: Array, number: Array, ridge: float, train: Array, test: Array) -> Array:
    """Return the squared error (1,) of a run that is left out."""
    fitted, own = np.isin(number, train), np.isin(number, test)
    gram = x[fitted].T @ x[fitted] + _penalty(x, ridge)
    left = np.linalg.lstsq(gram, x[fitted].T @ y[fitted], rcond=None)[0]
    return np.array([float(np.sum((y[own] - x[own] @ left) ** 2))])


def _inflation(x: Array) -> Array:
    """Return by how much each column's own variance grows by what it shares with the others."""
    out = np.full(x.shape[1], np.nan)
    for j in range(x.shape[1]):
        variance = float(np.sum((x[:, j] - x[:, j].mean()) ** 2))
        if variance > 0.0:
            others = np.column_stack([np.ones(len(x)), np.delete(x, j, axis=1)])
            rest = x[:, j] - others @ np.linalg.lstsq(others, x[:, j], rcond=None)[0]
            out[j] = variance / max(float(rest @ rest), 1e-300)
    return out


LINE = ("compaction_slip_ratio", "grade_slip_ratio")


def fit_straight_slip(samples: SlipSamples) -> LinearFit:
    """Fit the slip ratio of straight motion over the grade.

    Parameters
    ----------
    samples : of straight motion, up or down several slopes

    Raises
    ------
    DataError
        if there are too few runs, or all are on one slope.
    """
    speed = 0.5 * (samples.left_mps + samples.right_mps)
    grade = -np.sign(speed) * samples.pitch_rad
    x = np.column_stack([np.ones(len(grade)), grade])
    return fit_runs(x, 1.0 - samples.forward_mps / speed, samples.run, LINE)


def fit_side_slip(samples: SlipSamples) -> LinearFit:
    """Fit the tangent of the slip angle of straight motion over the roll; there is none on the level.

    Parameters
    ----------
    samples : of straight motion, across several slopes

    Raises
    ------
    DataError
        if there are too few runs, or none has a roll.
    """
    tangent = samples.lateral_mps / np.abs(samples.forward_mps)
    return fit_runs(-samples.roll_rad[:, None], tangent, samples.run, ("side_slip_ratio",))


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
        ahead = 0.5 * (own[0] + own[1]) - half * kappa - samples.forward_mps
        return np.asarray(ahead - found[1] * climb if grade else ahead)

    parameters = [
        Parameter("exponent", 0.9, 0.0, MAX_EXPONENT, step=0.1),
        Parameter("turn_grade_m", 0.0, -10.0, 10.0, step=0.1),
    ]
    found = identify(residual, parameters[: 2 if grade else 1], clusters=number)
    error, covariance = found.residual, np.zeros((2, 2))
    covariance[: len(found.cov), : len(found.cov)] = found.cov
    means = np.bincount(number, error) / np.bincount(number)
    within = np.sum((error - means[number]) ** 2) / max(len(error) - len(runs), 1)
    return TurningFit(
        float(found.value[0]),
        float(found.value[1]) if grade else 0.0,
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


DRIFT = ("turn_side_m", "turn_shift_m")


def drift_columns(samples: SlipSamples) -> Array:
    """Return the columns (n, 2) of lambda_y and c."""
    rate = samples.yaw_rate_radps
    return np.column_stack([-np.abs(rate) * samples.roll_rad, -rate * samples.pitch_rad])


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
    drift : whether the two columns of :mod:`~terrain.calibration.odometry` come first; the sideways
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


class SlipIdentification(NamedTuple):
    """A slip model and the fits that it is made of; None where the runs do not show it.

    Parameters
    ----------
    model : for :func:`terrain.estimation.models.slip_odometry.SlipOdometry`
    straight, side : of straight motion
    turning, angle, track : of turns; the angle with the drift beside it, or as printed
    notes : what is missing, and why
    """

    model: SlipModel
    straight: LinearFit | None
    side: LinearFit | None
    turning: TurningFit | None
    angle: LinearFit | None
    track: LinearFit | None
    notes: tuple[str, ...]


_Fit = TypeVar("_Fit", LinearFit, TurningFit)


def _attempt(notes: list[str], name: str, fit: Callable[[], _Fit]) -> _Fit | None:
    """Return a fit, or None with a note where the data do not show it."""
    try:
        return fit()
    except DataError as error:
        notes.append(f"{name}: {error}")
        return None


def identify_slip_model(
    runs: Sequence[RunLog],
    robot: TrackedRobot,
    *,
    drift: bool = True,
    half_window_s: float = HALF_WINDOW_S,
) -> SlipIdentification:
    """Identify the slip of a tracked robot.

    Parameters
    ----------
    runs : with poses: straight up and across slopes, and turns
    robot : that drove them
    drift : whether the drift in turns is a part of the model; without, laws are those printed
    half_window_s : over which poses are differentiated

    Raises
    ------
    DataError
        if no run has poses of a moving robot.
    """
    samples = slip_samples(runs, robot, half_window_s)
    straight, turning = samples.straight, samples.turning
    half, notes = robot.half_track_m, list[str]()
    line = _attempt(notes, "straight slip", lambda: fit_straight_slip(straight))
    side = _attempt(notes, "side slip", lambda: fit_side_slip(straight))
    given = (0.0, 0.0) if line is None else (float(line.coefficient[0]), float(line.coefficient[1]))
    endo = _attempt(notes, "Endo's law", lambda: fit_turning(turning, half, given, grade=drift))
    angle = _attempt(notes, "slip angle in turns", lambda: fit_turning_angle(turning, half, drift=drift))
    track = _attempt(notes, "effective distance of the tracks", lambda: fit_track_ratio(turning, half))
    fits = {COMPACTION: line, SIDE: side, TURN_SIDE if drift else ANGLE: angle, TRACK_RATIO: track}
    model = _joined(fits, endo, drift=drift)
    found = f"{len(np.unique(samples.run))} runs with poses, {len(samples.run)} samples"
    model = model_of(
        model.vector,
        covariance=model.covariance,
        found=found,
        **_residual_noise(model, samples, half),
    )
    return SlipIdentification(model, line, side, endo, angle, track, tuple(notes))


def _joined(fits: Mapping[int, LinearFit | None], endo: TurningFit | None, *, drift: bool) -> SlipModel:
    """Return the model of all fits; what has none is as assumed of unknown ground."""
    prior = unknown_ground()
    vector, covariance = np.array(prior.vector), np.array(prior.covariance)

    def put(places: Array, values: Array, block: Array) -> None:
        vector[places] = values
        covariance[np.ix_(places, places)] = block

    for place, fit in fits.items():
        if fit is not None:
            put(place + np.arange(len(fit.coefficient)), fit.coefficient, fit.covariance)
    if endo is not None:
        put(np.array([EXPONENT, TURN_GRADE]), np.array([endo.exponent, endo.turn_grade_m]), endo.covariance)
    if not drift:
        put(np.array([TURN_GRADE]), np.zeros(1), np.zeros((1, 1)))
        put(np.array([TURN_SIDE, TURN_SHIFT]), np.zeros(2), np.zeros((2, 2)))
        if endo is not None:
            covariance[EXPONENT, EXPONENT] = endo.covariance[0, 0]
    return model_of(vector, covariance=covariance)


def _residual_noise(model: SlipModel, samples: SlipSamples, half_track_m: float) -> dict[str, float]:
    """Return the residuals of a model: within the runs and their correlation time, and of the runs."""
    theta = np.zeros(N_PARAMETERS)
    theta[: len(model.vector)] = model.vector
    predicted = np.empty((len(samples.run), 2))
    for i, (left, right, rate, roll, pitch, turned) in enumerate(zip(*samples[:6], strict=True)):
        predicted[i] = body_velocity(theta, half_track_m, (left, right), rate, (roll, pitch), turned)
    speed = 0.5 * (np.abs(samples.left_mps) + np.abs(samples.right_mps))
    error = (np.column_stack([samples.forward_mps, samples.lateral_mps]) - predicted) / speed[:, None]
    _, number = np.unique(samples.run, return_inverse=True)
    count = np.bincount(number)
    means = np.column_stack([np.bincount(number, error[:, k]) / count for k in range(2)])
    within, of_runs = np.std(error - means[number], axis=0), np.sqrt(np.mean(means**2, axis=0))
    alike = max(alike_samples(error[:, k], number) for k in range(2))
    return {
        "slip_std_ratio": float(within[0]),
        "angle_std_rad": float(within[1]),
        "correlation_s": SPACING_S * alike,
        "run_slip_std_ratio": float(of_runs[0]),
        "run_angle_std_rad": float(of_runs[1]),
    }


def alike_samples(residual: Array, run: Array) -> float:
    """Return over how many samples residuals (n,) within their runs are alike, 0.5 for white noise.

    Half of one, and the autocorrelation about the means of the runs up to where it crosses 0.

    Examples
    --------
    >>> alike_samples(np.array([1.0, -1, 1, -1, 1, -1]), np.zeros(6, int))
    0.5
    >>> alike_samples(np.sin(np.arange(100) / 8), np.zeros(100, int)) > 5
    True
    """
    means = np.bincount(run, residual) / np.maximum(np.bincount(run), 1)
    within, total = residual - means[run], 0.5
    power = float(np.mean(within**2))
    for lag in range(1, len(residual)):
        same = run[lag:] == run[:-lag]
        if not same.any() or power == 0.0:
            break
        correlation = float(np.mean((within[lag:] * within[:-lag])[same])) / power
        if correlation <= 0.0:
            break
        total += correlation
    return total
