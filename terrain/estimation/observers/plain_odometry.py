"""Odometry that Yamauchi et al. compare with: of encoders alone, with a gyro, and with Endo's law.

All three are the step of :mod:`~terrain.estimation.observers.slip_odometry` with parts of its model absent:

- *encoder odometry*: heading and speed by the tracks, over an effective distance of the tracks;
- *gyrodometry* (Borenstein and Feng 1996): the same, but the heading by the gyro wherever the two disagree by
  more than a threshold, which in a slipping turn is always;
- *Endo* (Endo et al. 2007): heading by the gyro, the longitudinal slip of a turn by Endo's law, no lateral
  slip.

None knows what slip it lacks: its standard deviations hold the errors assumed in :data:`UNKNOWN_SLIP_RATIO`
and :data:`UNKNOWN_ANGLE_RAD`, one of each a run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from terrain.estimation.observers.family import Observer, ObserverOutput
from terrain.estimation.observers.slip_model import N_MODEL, TRACK_RATIO, SlipModel
from terrain.estimation.observers.slip_odometry import (
    ROWS,
    SLIPS,
    STATES,
    OdometrySettings,
    odometry_memory,
    odometry_params,
    odometry_step,
    read_odometry,
)
from terrain.records import Array
from terrain.robots import TrackedRobot

UNKNOWN_SLIP_RATIO, UNKNOWN_ANGLE_RAD = 0.1, 0.1
"""Slip that odometry without a slip model may miss; assumed, what a grade of 10 degrees does on sand."""

TRACK_STD_RATIO = 0.2
"""Of an effective distance of the tracks that was not identified on this ground; assumed."""

GYRODOMETRY_THRESHOLD_RADPS = 0.01
"""Above the drift of the gyro and the noise of the encoders, far under what slip makes in a turn."""


def _observer(
    name: str, robot: TrackedRobot, model: SlipModel, settings: OdometrySettings, slips: Sequence[str]
) -> Observer:
    covariance = np.zeros((N_MODEL, N_MODEL))
    covariance[TRACK_RATIO, TRACK_RATIO] = TRACK_STD_RATIO**2
    model = replace(
        model,
        covariance=covariance,
        run_slip_std_ratio=UNKNOWN_SLIP_RATIO,
        run_angle_std_rad=UNKNOWN_ANGLE_RAD,
    )
    n = len(slips)

    def read(params: Array, memory: Array) -> ObserverOutput:
        mean, std, slip, slip_std, status = read_odometry(params, memory)
        return ObserverOutput(mean, std, slip[:n], slip_std[:n], status)

    params, start = odometry_params(robot, model, settings), odometry_memory(model, settings)
    return Observer(name, STATES, tuple(slips), ROWS, params, start, odometry_step, read)


def encoder_odometry_observer(
    robot: TrackedRobot, settings: OdometrySettings | None = None, track_ratio: float = 1.0
) -> Observer:
    """Return the odometry of the tracks alone; it knows no slip.

    Parameters
    ----------
    robot, settings : as for :func:`~terrain.estimation.observers.slip_odometry.slip_odometry_observer`
    track_ratio : effective distance of the tracks over the described one

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> encoder_odometry_observer(load_robot("patako"), track_ratio=1.5).slips
    ()
    """
    settings = replace(settings or OdometrySettings(), gyro_threshold_radps=math.inf)
    return _observer("encoder-odometry", robot, SlipModel(track_ratio=track_ratio), settings, ())


def gyrodometry_observer(
    robot: TrackedRobot,
    settings: OdometrySettings | None = None,
    threshold_radps: float = GYRODOMETRY_THRESHOLD_RADPS,
) -> Observer:
    """Return gyrodometry: the gyro's yaw rate where it differs from that of the tracks by a threshold."""
    settings = replace(settings or OdometrySettings(), gyro_threshold_radps=threshold_radps)
    return _observer("gyrodometry", robot, SlipModel(), settings, ())


def endo_odometry_observer(
    robot: TrackedRobot, turning_exponent: float, settings: OdometrySettings | None = None
) -> Observer:
    """Return odometry with the longitudinal slip of turns by Endo's law.

    Parameters
    ----------
    robot, settings : as for :func:`~terrain.estimation.observers.slip_odometry.slip_odometry_observer`
    turning_exponent : n
    """
    model = SlipModel(turning_exponent=turning_exponent)
    return _observer("endo", robot, model, settings or OdometrySettings(), SLIPS[:2])
