r"""Odometry of a tracked robot fitted to legs: each kind of it is one slip model with other parts free.

The observed point lies at l in the body, and its sensor is turned by :math:`\gamma`; with the pose of the
body :math:`(p, \psi)` that the odometry sums from 0,

.. math:: moved = R(\gamma)^T \big(p + R(\psi)\, l - l\big),

and parameters minimise the distance from the measured end of each leg, bounded in its influence (soft L1, at
the median distance that is left), with the prior of unknown ground
(:func:`~terrain.estimation.observers.slip_learning.unknown_ground`) as a ridge.  All kinds have the same
scale of the tracks, l and :math:`\gamma` fitted, which are no slip.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.optimize import least_squares

from terrain.calibration.clustered_fit import clustered_covariance
from terrain.calibration.odometry_legs import Leg
from terrain.errors import DataError
from terrain.estimation.observers.slip_learning import unknown_ground
from terrain.estimation.observers.slip_model import (
    ANGLE,
    COMPACTION,
    EXPONENT,
    GRADE,
    N_MODEL,
    N_PARAMETERS,
    SIDE,
    TRACK_RATIO,
    TURN_GRADE,
    TURN_SHIFT,
    TURN_SIDE,
    SlipModel,
    body_velocity,
    model_of,
    next_displacement,
)
from terrain.records import Array
from terrain.robots import TrackedRobot

LEVER_X, LEVER_Y, TURNED = range(3)
"""Numbers of a mount."""

MOUNT_STD = (0.3, 0.3, 0.1)
"""What is known of a mount before: on the robot, and mounted straight within 6 degrees."""

SCALE_STD_RATIO = 0.1
"""Of the sprocket's radius beside the described one."""

FIRST_ERROR_M, LEAST_ERROR_M, PASSES = 0.1, 1e-4, 4
"""Error of a leg of 2 s that a fit begins with, and the least; each pass takes what the one before left."""

MIN_LEGS = 10

FLAT_RAD = 0.02
"""Root mean square tilt, a degree, below which the ground counts as level."""


class Kind(NamedTuple):
    """A kind of odometry.

    Parameters
    ----------
    name : as reports have it
    free : places of the slip model that are fitted
    by_gyro : whether the yaw rate is the gyro's; else that of the tracks
    """

    name: str
    free: tuple[int, ...]
    by_gyro: bool


ENCODER = Kind("encoder odometry", (COMPACTION, TRACK_RATIO), False)
GYRODOMETRY = Kind("gyrodometry", (COMPACTION,), True)
ENDO = Kind("Endo", (COMPACTION, EXPONENT), True)
SLIP = Kind(
    "slip-compensated",
    tuple(place for place in range(N_MODEL) if place != TRACK_RATIO),
    True,
)
KINDS = (ENCODER, GYRODOMETRY, ENDO, SLIP)
"""Encoder odometry has the best single effective track."""


@dataclass(frozen=True, eq=False)
class FittedOdometry:
    """A kind of odometry fitted to legs.

    Parameters
    ----------
    kind : which
    model : its slip model, with the covariance of what was fitted, clustered by runs
    mount : (3,) place of the observed point in the body, and angle of its sensor
    """

    kind: Kind
    model: SlipModel
    mount: Array


def fit_odometry(kind: Kind, legs: Sequence[Leg], robot: TrackedRobot) -> FittedOdometry:
    """Fit a kind of odometry.

    Parameters
    ----------
    kind : which parts of the model are free
    legs : to fit; longer ones count by the inverse of their length
    robot : that drove them

    Raises
    ------
    DataError
        if there are fewer than ten legs.
    """
    if len(legs) < MIN_LEGS:
        raise DataError(f"{len(legs)} legs have poses at both ends, {MIN_LEGS} or more are required")
    prior = unknown_ground()
    start = np.where(np.isin(np.arange(N_MODEL), kind.free), prior.vector, SlipModel().vector)
    std = np.sqrt(np.diag(prior.covariance))
    std[COMPACTION] = SCALE_STD_RATIO
    free = np.array(kind.free)
    known_std = np.concatenate([std[free], MOUNT_STD])
    first = np.concatenate([start[free], np.zeros(3)])
    packed, measured = _packed(legs), np.array([leg.moved[:2] for leg in legs])
    longer = np.array([max(leg.length_s / 2.0, 1.0) for leg in legs])
    low = np.full(len(first), -np.inf)
    low[:-3][free == EXPONENT] = 0.0
    low[:-3][free == TRACK_RATIO] = 0.05

    def errors_m(found: Array) -> Array:
        vector = start.copy()
        vector[free] = found[:-3]
        ends = _ends(packed, vector, found[-3:], robot, kind.by_gyro)
        return np.asarray((ends[:, :2] - measured) / longer[:, None])

    error_m, found = FIRST_ERROR_M, first
    for _ in range(PASSES):

        def residual(found: Array, error_m: float = error_m) -> Array:
            return np.concatenate([errors_m(found).ravel() / error_m, (found - first) / known_std])

        done = least_squares(residual, found, bounds=(low, np.inf), loss="soft_l1", x_scale=known_std)
        found = done.x
        error_m = max(float(np.median(np.hypot(*errors_m(found).T))), LEAST_ERROR_M)
    vector = start.copy()
    vector[free] = found[:-3]
    covariance = np.zeros((N_MODEL, N_MODEL))
    by = done.jac[: 2 * len(legs)]
    left = done.fun[: 2 * len(legs)]
    inverse = np.linalg.inv(by.T @ by + np.diag(1.0 / known_std**2))
    _, number = np.unique([leg.run for leg in legs], return_inverse=True)
    clustered = clustered_covariance(inverse, by * left[:, None], np.repeat(number, 2))
    covariance[np.ix_(free, free)] = clustered[:-3, :-3]
    left_m = np.hypot(*errors_m(found).T) * longer
    path_m = np.array([np.abs(leg.speeds_mps.mean(axis=1)).sum() * leg.step_s for leg in legs])
    ratio = float(np.sqrt((left_m**2).mean() / max((path_m**2).mean(), 1e-12)))
    model = model_of(
        vector,
        covariance=covariance,
        run_slip_std_ratio=ratio / math.sqrt(2.0),
        run_angle_std_rad=ratio / math.sqrt(2.0),
        found=f"{len({leg.run for leg in legs})} runs, {len(legs)} legs",
    )
    return FittedOdometry(kind, model, found[-3:])


def predict_ends(fitted: FittedOdometry, legs: Sequence[Leg], robot: TrackedRobot) -> Array:
    """Return the change of pose (n, 3) of the observed point over each leg."""
    return _ends(_packed(legs), fitted.model.vector, fitted.mount, robot, fitted.kind.by_gyro)


def without_tilt(legs: Sequence[Leg]) -> bool:
    """Return whether legs show no slopes: the rms of their mean tilts is below :data:`FLAT_RAD`."""
    tilts = np.array([leg.tilt_rad.mean(axis=0) for leg in legs])
    return bool(np.sqrt((tilts**2).mean(axis=0)).max() < FLAT_RAD)


def level(kind: Kind) -> Kind:
    """Return a kind without the parameters that only slopes show."""
    tilt = {GRADE, TURN_GRADE, SIDE, TURN_SIDE, TURN_SHIFT, *(ANGLE + k for k in (4, 5, 7))}
    return kind._replace(free=tuple(place for place in kind.free if place not in tilt))


class _Packed(NamedTuple):
    """All legs in a row: samples, where each leg ends, and its step."""

    speeds: Array
    rate: Array
    tilt: Array
    end: Array
    step_s: Array


def _packed(legs: Sequence[Leg]) -> _Packed:
    return _Packed(
        np.concatenate([leg.speeds_mps for leg in legs]),
        np.concatenate([leg.yaw_rate_radps for leg in legs]),
        np.concatenate([leg.tilt_rad for leg in legs]),
        np.cumsum([len(leg.yaw_rate_radps) for leg in legs]),
        np.array([leg.step_s for leg in legs]),
    )


def _ends(packed: _Packed, vector: Array, mount: Array, robot: TrackedRobot, by_gyro: bool) -> Array:
    theta = np.zeros(N_PARAMETERS)
    theta[:N_MODEL] = vector
    geometry = np.array([robot.half_track_m, robot.contact_length_m])
    return np.asarray(_sum_legs(theta, mount, geometry, by_gyro, packed))


@njit(cache=True)
def _sum_legs(
    theta: Array,
    mount: Array,
    geometry: Array,
    by_gyro: bool,
    packed: _Packed,
) -> Array:
    """Return the change of pose (legs, 3) of the observed point; ``geometry`` is d and the length."""
    speeds, rate, tilt, end, step_s = packed
    half_track_m, length_m = geometry
    out, slopes, first = np.empty((len(end), 3)), np.empty((3, N_PARAMETERS)), 0
    by_track = 2.0 * half_track_m * theta[TRACK_RATIO]
    for leg in range(len(end)):
        x, y, yaw, displaced = 0.0, 0.0, 0.0, 0.0
        for k in range(first, end[leg]):
            pair = (speeds[k, 0], speeds[k, 1])
            turn = rate[k] if by_gyro else (pair[1] - pair[0]) * (1.0 - theta[COMPACTION]) / by_track
            displaced = next_displacement(displaced, pair, turn, length_m, step_s[leg])
            if by_gyro:
                v_x, v_y, _, _ = body_velocity(
                    theta, half_track_m, pair, turn, (tilt[k, 0], tilt[k, 1]), displaced, slopes
                )
            else:
                v_x, v_y = 0.5 * (pair[0] + pair[1]) * (1.0 - theta[COMPACTION]), 0.0
            middle = yaw + 0.5 * turn * step_s[leg]
            x += step_s[leg] * (v_x * math.cos(middle) - v_y * math.sin(middle))
            y += step_s[leg] * (v_x * math.sin(middle) + v_y * math.cos(middle))
            yaw += turn * step_s[leg]
        first = end[leg]
        cos, sin = math.cos(yaw), math.sin(yaw)
        x += (cos - 1.0) * mount[0] - sin * mount[1]
        y += sin * mount[0] + (cos - 1.0) * mount[1]
        turned_cos, turned_sin = math.cos(mount[2]), math.sin(mount[2])
        out[leg, 0] = turned_cos * x + turned_sin * y
        out[leg, 1] = turned_cos * y - turned_sin * x
        out[leg, 2] = yaw
    return out
