"""The protocol of the AgriMaRo thesis (8.1) on simulated runs: 208 windows of 2 s, eight terrains.

The thesis states a support vector machine, 208 labelled windows of 2 s that do not overlap, steady motion,
cross-validation and eight classes.  It names neither the classes nor the folds nor the features.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from sklearn.model_selection import StratifiedKFold

from features.windows import cut_windows, join_windows
from pipelines.crossval.evaluation import Examples, fit_folds
from pipelines.crossval.splits import Fold
from pipelines.learn.recipes import feature_matrix, make_recipe
from terrain.classify.folds import split_runs
from terrain.classify.metrics import run_bootstrap
from terrain.classify.stiffness import StiffnessLevel, cost_matrix, least_cost_class
from terrain.constants import GRAVITY_MPS2
from terrain.estimation.enriched import enriched
from terrain.estimation.estimate import estimate_run
from terrain.records import Array, Windows
from terrain.robots import Robot
from terrain.simulation.run import simulate_run
from terrain.terramechanics.soil import load_soil, soil_names
from terrain.terramechanics.stiffness import GroundResponse, response_of

N_WINDOWS, N_CLASSES = 208, 8
"""Of the thesis."""

N_FOLDS = 5
"""Assumed where windows are dealt at random; with whole runs held out each run of a class has a fold."""

TOTAL_S = 150.0
"""Of all runs of a terrain: leaves 40 windows of steady motion and more, of which 26 are taken."""


class HeldOutWindows(NamedTuple):
    """Held-out predictions of windows.

    Parameters
    ----------
    classes : (k,) terrains
    probability : (n, k) by classifiers that were not trained on the window
    true : (n,) column of the true terrain
    run_id : (n,) run of each window
    """

    classes: Array
    probability: Array
    true: Array
    run_id: Array

    @property
    def correct(self) -> Array:
        """Whether the most probable terrain of each window (n,) is the true one."""
        return np.asarray(self.probability.argmax(axis=1) == self.true)

    def interval(self, seed: int) -> tuple[float, float]:
        """Return the 95 % interval of the accuracy over runs."""
        rng = np.random.default_rng(seed)
        return run_bootstrap(self.correct, self.run_id, self.true, rng)

    def recall(self) -> dict[str, float]:
        """Return by terrain the fraction of its windows that are right."""
        return {str(c): float(self.correct[self.true == i].mean()) for i, c in enumerate(self.classes)}


class ProtocolResult(NamedTuple):
    """Windows dealt at random, where a run trains and tests, and the same ones with whole runs held out."""

    n_windows: int
    at_random: HeldOutWindows
    by_run: HeldOutWindows


class LevelResult(NamedTuple):
    """Accuracy of the stiffness level, windows of soft and hard that were confused, and cost a window."""

    accuracy: float
    soft_hard_ratio: float
    cost: float
    least_cost: float


def classify_soils(robot: Robot, seed: int, n_runs: int) -> ProtocolResult:
    """Classify windows of all described soils.

    Parameters
    ----------
    robot : swerve robot with all sections
    seed : of all that is drawn
    n_runs : of each soil, at least 2
    """
    windows = thesis_windows(robot, seed, n_runs)
    features, terrain = feature_matrix(make_recipe("svm"), windows), windows.terrain.astype(str)
    run_id, rng = windows.run_id.astype(str), np.random.default_rng(seed)
    alone = np.arange(len(run_id)).astype(str)
    deal = StratifiedKFold(N_FOLDS, shuffle=True, random_state=seed).split(features, terrain)
    at_random = _held_out(Examples(features, terrain, alone), list(deal))
    by_run = _held_out(Examples(features, terrain, run_id), list(split_runs(terrain, run_id, n_runs, rng)))
    return ProtocolResult(len(windows), at_random._replace(run_id=run_id), by_run)


def thesis_windows(robot: Robot, seed: int, n_runs: int) -> Windows:
    """Return 26 steady windows of 2 s of each soil, from runs whose soil, load and slope are drawn.

    What the thesis' filter estimates is part of the windows.
    """
    parts = []
    for name in soil_names():
        runs = [
            simulate_run(robot, name, "survey", seed, number, duration_s=TOTAL_S / n_runs, vary=True)
            for number in range(1, n_runs + 1)
        ]
        found = cut_windows([enriched(estimate_run(run, robot, "vio12", tuning="thesis")) for run in runs])
        in_run = np.concatenate([np.arange(np.sum(found.windows.run_id == run.run_id)) for run in runs])
        parts.append(found.windows[np.sort(np.argsort(in_run, kind="stable")[: N_WINDOWS // N_CLASSES])])
    return join_windows(parts)


def _held_out(examples: Examples, splits: list[tuple[Array, Array]]) -> HeldOutWindows:
    classes, true = np.unique(examples.terrain, return_inverse=True)
    folds = [Fold(0, number, *split) for number, split in enumerate(splits)]
    probability = np.zeros((len(true), len(classes)))
    for found in fit_folds(make_recipe("svm")[-1], examples, folds, 1, "thesis protocol"):
        probability[found.fold.test] = found.probability
    return HeldOutWindows(classes, probability, true, examples.group)


def level_result(found: HeldOutWindows, responses: dict[str, GroundResponse]) -> LevelResult:
    """Return how well the stiffness levels of soils are recognised."""
    levels = np.array([int(responses[name].level) for name in found.classes])
    cost, predicted = cost_matrix(levels.tolist()), found.probability.argmax(axis=1)
    apart = np.abs(levels[predicted] - levels[found.true]) == StiffnessLevel.HARD - StiffnessLevel.SOFT
    return LevelResult(
        float(np.mean(levels[predicted] == levels[found.true])),
        float(apart.mean()),
        float(cost[found.true, predicted].mean()),
        float(cost[found.true, least_cost_class(found.probability, cost)].mean()),
    )


def soil_responses(robot: Robot) -> dict[str, GroundResponse]:
    """Return how each soil yields under a wheel that carries its part of the robot's weight."""
    geometry = robot.wheel_radius_m, robot.body.tyre_width_m, robot.body.contact_length_m
    load_n = robot.mass_kg * GRAVITY_MPS2 / len(robot.wheels)
    return {name: response_of(load_soil(name), load_n, *geometry) for name in soil_names()}
