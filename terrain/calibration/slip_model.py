"""The slip model of a tracked robot on one ground, from runs with poses: all laws of Yamauchi et al.

Laws whose motions were not driven keep what is assumed of unknown ground, with its wide standard deviation,
and :attr:`SlipIdentification.notes` names them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from terrain.calibration.clustered_fit import LinearFit
from terrain.calibration.straight_slip import fit_side_slip, fit_straight_slip
from terrain.calibration.track_motion import HALF_WINDOW_S, SPACING_S, SlipSamples, slip_samples
from terrain.calibration.turning_angle import fit_turning_angle
from terrain.calibration.turning_exponent import TurningFit, fit_track_ratio, fit_turning
from terrain.errors import DataError
from terrain.estimation.observers.slip_learning import unknown_ground
from terrain.estimation.observers.slip_model import (
    ANGLE,
    COMPACTION,
    EXPONENT,
    N_PARAMETERS,
    SIDE,
    TRACK_RATIO,
    TURN_GRADE,
    TURN_SHIFT,
    TURN_SIDE,
    SlipModel,
    body_velocity,
    model_of,
)
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot


class SlipIdentification(NamedTuple):
    """A slip model and the fits that it is made of; None where the runs do not show it.

    Parameters
    ----------
    model : for :func:`terrain.estimation.observers.slip_odometry.slip_odometry_observer`
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
    theta, slopes = np.zeros(N_PARAMETERS), np.empty((2, N_PARAMETERS))
    theta[: len(model.vector)] = model.vector
    predicted = np.empty((len(samples.run), 2))
    for i, (left, right, rate, roll, pitch, turned) in enumerate(zip(*samples[:6], strict=True)):
        predicted[i] = body_velocity(theta, half_track_m, (left, right), rate, (roll, pitch), turned, slopes)[
            :2
        ]
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
