"""What an extension is worth to a classifier that is taught in simulation and asked about measured runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from features.windows import Layout, cut_windows, layout_of
from pipelines.classify.labelled import RUNS_A_TERRAIN, SCENARIO
from pipelines.classify.settings import CrossvalSettings
from pipelines.classify.splits import labelled
from pipelines.reporting.progress import Progress, silent
from terrain.errors import DataError, TerrainError
from terrain.kinematics.wheel_speed import with_wheel_speeds
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, RunLog, Windows
from terrain.robots import Robot
from terrain.simulation.run import simulate_run
from terrain.terramechanics.soil import soil_names

MIN_RUNS, MIN_TERRAINS = 4, 2
"""Fewer held-out runs on fewer known terrains tell no accuracy."""

N_BOOTSTRAP = 2000


def classifier_gain(
    held_out: Sequence[RunLog],
    robot: Robot,
    before: Mapping[str, float],
    after: Mapping[str, float],
    seed: int,
    runs_a_terrain: int = RUNS_A_TERRAIN,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Return the accuracy on held-out runs of a recipe taught on runs simulated without and with effects.

    Both are taught on the same drives of varied days, with the same seeds, and asked about the same windows.
    The interval is that of the difference, by bootstrap over runs.

    Parameters
    ----------
    held_out : measured runs; those count that are labelled with one soil of the package
    robot : of the runs
    before, after : effects that act in the simulation
    seed : of simulation, inner folds and bootstrap
    runs_a_terrain : simulated on each

    Returns
    -------
    dict that JSON can hold
        ``name, reason, n_runs, terrains, errors``; ``errors`` is empty where ``reason`` says why.
    """
    settings = CrossvalSettings(seed=seed)
    known = [run for run in held_out if len(run.terrains) == 1 and run.terrains[0] in soil_names()]
    terrains = sorted({run.terrains[0] for run in known})
    found: dict[str, Any] = {"name": settings.recipe, "n_runs": len(known), "terrains": terrains}
    found["errors"] = {}
    if len(terrains) < MIN_TERRAINS:
        told = f"the held-out runs are on {len(terrains)} known terrain{'s' * (len(terrains) != 1)}, "
        return found | {"reason": f"{told}{MIN_TERRAINS} at the least are required"}
    if len(known) < MIN_RUNS:
        return found | {"reason": f"{len(known)} runs are held out, {MIN_RUNS} at the least are required"}
    bare = replace(robot, effects={}, effects_cov=np.empty((0, 0)))
    try:
        right = []
        for step, effects in enumerate((before, after)):
            trained = [
                with_wheel_speeds(
                    simulate_run(bare, terrain, SCENARIO, seed, number, vary=True, effects=dict(effects)),
                    bare,
                )
                for terrain in terrains
                for number in range(1, runs_a_terrain + 1)
            ]
            right.append(_right(trained, [with_wheel_speeds(run, bare) for run in known], settings))
            progress("classifier", step + 1, 2)
    except TerrainError as error:
        return found | {"reason": str(error)}
    (first, run_id), (second, _) = right
    return found | {"reason": None, "errors": {"accuracy": compared(first, second, run_id, seed)}}


def _right(
    trained: Sequence[RunLog], known: Sequence[RunLog], settings: CrossvalSettings
) -> tuple[Array, Array]:
    """Return which windows (n,) of the known runs are told right, and the runs (n,) that they are of."""
    layout = _shared_layout(trained, known, settings)
    lessons, exam = (_windows(runs, settings, layout) for runs in (trained, known))
    recipe = settings.new_recipe()
    recipe.fit(lessons, lessons.terrain.astype(str))
    said = np.asarray(recipe.predict(exam)).astype(str)
    return said == exam.terrain.astype(str), exam.run_id.astype(str)


def _shared_layout(trained: Sequence[RunLog], known: Sequence[RunLog], settings: CrossvalSettings) -> Layout:
    """Return the channels that simulated and measured runs both have."""
    own, theirs = (layout_of(runs, SIGNAL_SETS, speeds=True) for runs in (trained, known))
    channels = {
        stream: both
        for stream, names in own.channels.items()
        if (both := tuple(name for name in names if name in theirs.channels.get(stream, ())))
    }
    if not channels:
        raise DataError("simulated and measured runs have no channel in common")
    return Layout(channels, {stream: own.rate_hz[stream] for stream in channels})


def _windows(runs: Sequence[RunLog], settings: CrossvalSettings, layout: Layout) -> Windows:
    return labelled(cut_windows(runs, settings.rule, layout=layout, skip_short=True)).windows


def compared(before: Array, after: Array, run_id: Array, seed: int) -> dict[str, Any]:
    """Return accuracies ``before`` and ``after`` and the 95 % interval of their difference, ``change_ci``.

    Examples
    --------
    >>> found = compared(np.array([0, 0, 1, 1]), np.array([1, 1, 1, 1]), np.array(["a", "a", "b", "b"]), 0)
    >>> found["before"], found["after"], found["change_ci"]
    (0.5, 1.0, [0.0, 1.0])
    """
    runs, of = np.unique(run_id, return_inverse=True)
    n = len(runs)
    windows = np.bincount(of, minlength=n)
    change = np.bincount(of, weights=after.astype(float) - before.astype(float), minlength=n)
    weights = np.random.default_rng(seed).multinomial(n, np.full(n, 1 / n), N_BOOTSTRAP)
    low, high = np.quantile((weights @ change) / (weights @ windows), [0.025, 0.975])
    return {
        "before": float(before.mean()),
        "after": float(after.mean()),
        "change_ci": [float(low), float(high)],
    }
