"""Labelled runs without data: simulated on each terrain, filtered, with slip beside the measurements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipelines.report.results import Progress, silent
from terrain.estimation.estimate import Estimate, EstimateSummary, enriched, estimate_run, summarize
from terrain.records import RunLog
from terrain.robots import Robot, load_robot
from terrain.simulation.run import simulate_run
from terrain.terramechanics.soil import soil_names

ROBOT, SCENARIO, FILTER, RUNS_A_TERRAIN = "agrimaro", "survey", "vio15", 6


class TerrainSlip(NamedTuple):
    """Steady slip of the simulated runs of a terrain: mean estimate, mean truth, RMSE, and mean NEES.

    NaN where the slip was nowhere steady.
    """

    terrain: str
    n_runs: int
    slip_mean: float
    slip_true_mean: float
    slip_rmse: float
    nees: float


def labelled_runs(
    seed: int, runs_a_terrain: int = RUNS_A_TERRAIN, progress: Progress = silent, robot: Robot | None = None
) -> tuple[list[RunLog], tuple[TerrainSlip, ...], Estimate]:
    """Simulate and filter runs on every terrain, with varied speed, slope, load, tyres and soil.

    Parameters
    ----------
    seed : of everything that is drawn
    runs_a_terrain : how many
    progress : of the runs
    robot : whose; :data:`ROBOT` by default

    Returns
    -------
    the runs with the streams ``estimator`` and ``slip``, sorted by id; steady slip of the runs of each terrain; and
    the estimate of one run, to be drawn
    """
    robot = load_robot(ROBOT) if robot is None else robot
    terrains = soil_names()
    runs, rows = [], []
    for terrain in terrains:
        summaries = []
        for number in range(1, runs_a_terrain + 1):
            run = simulate_run(robot, terrain, SCENARIO, seed, number, vary=True)
            estimate = estimate_run(run, robot, FILTER)
            runs.append(enriched(estimate))
            summaries.append(summarize(estimate))
            progress("simulate and filter", len(runs), runs_a_terrain * len(terrains))
            if terrain == "grass" and number == 1:
                example = estimate
        rows.append(_row(terrain, summaries))
    return sorted(runs, key=lambda run: run.run_id), tuple(rows), example


def _row(terrain: str, summaries: Sequence[EstimateSummary]) -> TerrainSlip:
    pairs = [(row.slip_mean, row.slip_true_mean) for row in summaries if math.isfinite(row.slip_true_mean)]
    estimated, true = np.array(pairs).T if pairs else (np.array([math.nan]), np.array([math.nan]))
    rmse, nees = np.sqrt(np.mean((estimated - true) ** 2)), np.mean([row.nees for row in summaries])
    means = float(estimated.mean()), float(true.mean())
    return TerrainSlip(terrain, len(summaries), *means, float(rmse), float(nees))
