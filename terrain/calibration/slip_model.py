"""The slip model of a tracked robot on one ground, from runs with poses: all laws of Yamauchi et al.

Laws whose motions were not driven keep what is assumed of unknown ground, with its wide standard deviation,
and :attr:`SlipIdentification.notes` names them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from terrain.calibration.clustered_fit import LinearFit
from terrain.calibration.straight_slip import fit_side_slip, fit_straight_slip
from terrain.calibration.track_motion import HALF_WINDOW_S, SlipSamples, slip_samples
from terrain.calibration.turning_angle import fit_turning_angle
from terrain.calibration.turning_exponent import TurningFit, fit_track_ratio, fit_turning
from terrain.errors import DataError
from terrain.estimation.observers.slip_learning import unknown_ground
from terrain.estimation.observers.slip_model import (
    ANGLE,
    COMPACTION,
    EXPONENT,
    SIDE,
    TRACK_RATIO,
    TURN_GRADE,
    SlipModel,
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
    turning, angle, track : of turns
    notes : what is missing, and why
    """

    model: SlipModel
    straight: LinearFit | None
    side: LinearFit | None
    turning: TurningFit | None
    angle: LinearFit | None
    track: LinearFit | None
    notes: tuple[str, ...]


def identify_slip_model(
    runs: Sequence[RunLog],
    robot: TrackedRobot,
    *,
    turn_grade: bool = True,
    half_window_s: float = HALF_WINDOW_S,
) -> SlipIdentification:
    """Identify the slip of a tracked robot.

    Parameters
    ----------
    runs : with poses: straight up and across slopes, and turns
    robot : that drove them
    turn_grade : whether a grade may move a turning robot by more than a straight one; not in the paper
    half_window_s : over which poses are differentiated

    Raises
    ------
    DataError
        if no run has poses of a moving robot.
    """
    samples = slip_samples(runs, robot, half_window_s)
    straight, turning = samples.straight, samples.turning
    half, notes = robot.half_track_m, []

    def attempt(name: str, fit: Callable[[], LinearFit]) -> LinearFit | None:
        try:
            return fit()
        except DataError as error:
            notes.append(f"{name}: {error}")
            return None

    line = attempt("straight slip", lambda: fit_straight_slip(straight))
    side = attempt("side slip", lambda: fit_side_slip(straight))
    angle = attempt("slip angle in turns", lambda: fit_turning_angle(turning, half))
    track = attempt("effective distance of the tracks", lambda: fit_track_ratio(turning, half))
    endo: TurningFit | None = None
    try:
        given = (0.0, 0.0) if line is None else (float(line.coefficient[0]), float(line.coefficient[1]))
        endo = fit_turning(turning, half, given, grade=turn_grade)
    except DataError as error:
        notes.append(f"Endo's law: {error}")
    model = _joined(samples, line, side, endo, angle, track)
    return SlipIdentification(model, line, side, endo, angle, track, tuple(notes))


def _joined(
    samples: SlipSamples,
    line: LinearFit | None,
    side: LinearFit | None,
    endo: TurningFit | None,
    angle: LinearFit | None,
    track: LinearFit | None,
) -> SlipModel:
    prior = unknown_ground()
    vector, covariance = np.array(prior.vector), np.array(prior.covariance)

    def put(place: int, values: Array, block: Array) -> None:
        places = np.arange(place, place + len(values))
        vector[places] = values
        covariance[np.ix_(places, places)] = block

    for place, fit in ((COMPACTION, line), (SIDE, side), (ANGLE, angle), (TRACK_RATIO, track)):
        if fit is not None:
            put(place, fit.coefficient, fit.covariance)
    within, of_runs = [0.0 if line is None else line.residual_std], [0.0 if line is None else line.run_std]
    if endo is not None:
        pair = np.array([EXPONENT, TURN_GRADE])
        vector[pair] = endo.exponent, endo.turn_grade_m
        covariance[np.ix_(pair, pair)] = endo.covariance
        turning = samples.turning
        speed = float(np.mean(np.abs(0.5 * (turning.left_mps + turning.right_mps))))
        within.append(endo.residual_std_mps / speed)
        of_runs.append(endo.run_std_mps / speed)
    angles = [fit for fit in (side, angle) if fit is not None]
    return model_of(
        vector,
        covariance=covariance,
        slip_std_ratio=max(within),
        angle_std_rad=max((fit.residual_std for fit in angles), default=prior.angle_std_rad),
        run_slip_std_ratio=max(of_runs),
        run_angle_std_rad=max((fit.run_std for fit in angles), default=0.0),
        found=f"{len(np.unique(samples.run))} runs with poses, {len(samples.run)} samples",
    )
