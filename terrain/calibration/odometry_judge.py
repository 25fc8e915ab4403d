"""Kinds of odometry judged on runs that they were not fitted to, with intervals over runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.calibration.odometry_fit import (
    ENCODER,
    GYRODOMETRY,
    KINDS,
    Kind,
    fit_odometry,
    level,
    predict_ends,
    without_tilt,
)
from terrain.calibration.odometry_legs import Leg
from terrain.errors import DataError
from terrain.records import Array
from terrain.robots import TrackedRobot

DRAWS = 2000
"""Bootstrap samples of runs."""


@dataclass(frozen=True, slots=True)
class KindScore:
    """Error of a kind of odometry over legs of one length.

    Parameters
    ----------
    kind : name
    rmse_m, rmse_ci_m : root mean square distance from the measured end, held out, and its 95 % interval
    median_m : of the distances
    yaw_rmse_rad : root mean square error of the heading
    gain_encoder, gain_encoder_ci : by how much the RMSE is below that of encoder odometry, as a ratio
    gain_gyro, gain_gyro_ci : the same against gyrodometry
    """

    kind: str
    rmse_m: float
    rmse_ci_m: tuple[float, float]
    median_m: float
    yaw_rmse_rad: float
    gain_encoder: float
    gain_encoder_ci: tuple[float, float]
    gain_gyro: float
    gain_gyro_ci: tuple[float, float]


@dataclass(frozen=True, slots=True)
class LegScores:
    """Scores of all kinds over legs of one length.

    Parameters
    ----------
    length_s : of the legs, their mean
    n_legs, n_runs : how many
    path_m : root mean square of the distance between the ends of a leg
    kinds : in the order of :data:`~terrain.calibration.odometry_fit.KINDS`
    """

    length_s: float
    n_legs: int
    n_runs: int
    path_m: float
    kinds: tuple[KindScore, ...]


def held_out_ends(
    groups: Mapping[str, Sequence[Leg]],
    robot: TrackedRobot,
    n_folds: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, dict[str, Array]]:
    """Return by kind and group the predicted ends (n, 3) of legs whose runs were held out of the fit.

    Parameters
    ----------
    groups : legs by length
    robot : that drove them
    n_folds : whole runs are dealt into so many
    seed : of the deal
    progress : called after each fit

    Raises
    ------
    DataError
        if there are fewer runs than folds.
    """
    every = [leg for legs in groups.values() for leg in legs]
    runs = np.unique([leg.run for leg in every])
    if len(runs) < n_folds:
        raise DataError(f"{len(runs)} runs have legs, at least {n_folds} are required for {n_folds} folds")
    dealt = np.random.default_rng(seed).permutation(len(runs)) % n_folds
    fold_of = dict(zip(runs.tolist(), dealt.tolist(), strict=True))
    kinds = [level(kind) for kind in KINDS] if without_tilt(every) else list(KINDS)
    ends = {
        kind.name: {name: np.full((len(legs), 3), np.nan) for name, legs in groups.items()} for kind in kinds
    }
    for done, (fold, kind) in enumerate((fold, kind) for fold in range(n_folds) for kind in kinds):
        fitted = fit_odometry(kind, [leg for leg in every if fold_of[leg.run] != fold], robot)
        for name, legs in groups.items():
            held = [k for k, leg in enumerate(legs) if fold_of[leg.run] == fold]
            if held:
                ends[kind.name][name][held] = predict_ends(fitted, [legs[k] for k in held], robot)
        progress(done + 1, n_folds * len(kinds))
    return ends


def score_legs(legs: Sequence[Leg], ends: Mapping[str, Array], seed: int) -> LegScores:
    """Return the scores of kinds over legs of one length.

    Parameters
    ----------
    legs : n of them
    ends : predicted (n, 3) by the name of the kind
    seed : of the bootstrap over runs
    """
    measured = np.array([leg.moved for leg in legs])
    runs, number = np.unique([leg.run for leg in legs], return_inverse=True)
    squares = {name: ((end[:, :2] - measured[:, :2]) ** 2).sum(axis=1) for name, end in ends.items()}
    per_run = {name: np.bincount(number, square) for name, square in squares.items()}
    counts, legs_of_run = bootstrap_counts(len(runs), DRAWS, seed), np.bincount(number)
    drawn = {name: np.sqrt((counts @ sums) / (counts @ legs_of_run)) for name, sums in per_run.items()}
    rmse = {name: math.sqrt(square.mean()) for name, square in squares.items()}

    def gain(name: str, against: Kind) -> tuple[float, tuple[float, float]]:
        over = 1.0 - drawn[name] / drawn[against.name]
        return 1.0 - rmse[name] / rmse[against.name], percentile_interval(over)

    scores = []
    for name, end in ends.items():
        by_encoder, by_gyro = gain(name, ENCODER), gain(name, GYRODOMETRY)
        scores.append(
            KindScore(
                name,
                rmse[name],
                percentile_interval(drawn[name]),
                float(np.median(np.sqrt(squares[name]))),
                math.sqrt(np.mean((end[:, 2] - measured[:, 2]) ** 2)),
                *by_encoder,
                *by_gyro,
            )
        )
    return LegScores(
        float(np.mean([leg.length_s for leg in legs])),
        len(legs),
        len(runs),
        math.sqrt((measured[:, :2] ** 2).sum(axis=1).mean()),
        tuple(scores),
    )
