"""What an extension gains for a classifier that is trained in simulation and tested on measured runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from features.windows import cut_windows, labelled, layout_of, shared_layout
from pipelines.learn.recipes import recipe_of
from pipelines.learn.settings import FEATURE_RECIPE, LearnSettings
from pipelines.report.numbers import plural
from pipelines.report.results import Progress, silent
from terrain.discrepancy.held_out import Comparison, accuracy_change
from terrain.errors import TerrainError
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, RunLog
from terrain.robots import Robot
from terrain.simulation.run import simulate_run
from terrain.terramechanics.soil import soil_names

RUNS_A_TERRAIN, SCENARIO = 6, "survey"  #: Simulated runs that the classifier is trained on
MIN_RUNS, MIN_TERRAINS = 4, 2  #: Least numbers of held-out runs and known terrains for an accuracy


def classifier_gain(
    held_out: Sequence[RunLog],
    robot: Robot,
    before: Mapping[str, float],
    after: Mapping[str, float],
    seed: int,
    runs_a_terrain: int = RUNS_A_TERRAIN,
    progress: Progress = silent,
) -> Comparison:
    """Return the accuracy on held-out runs of a recipe trained on runs simulated without and with effects.

    Both are trained on the same varied drives with the same seeds, so many on each terrain, and tested on the
    same windows of the runs that are labelled with one soil of the package.  The interval is that of the
    difference, by bootstrap over runs.
    """
    settings = LearnSettings(seed=seed)
    known = [run for run in held_out if len(run.terrains) == 1 and run.terrains[0] in soil_names()]
    terrains = tuple(sorted({run.terrains[0] for run in known}))
    unknown = Comparison(FEATURE_RECIPE, None, len(known), {}, terrains)
    if len(terrains) < MIN_TERRAINS:
        on = plural(len(terrains), "known terrain")
        return unknown._replace(reason=f"the held-out runs are on {on}, at least {MIN_TERRAINS} are required")
    if len(known) < MIN_RUNS:
        return unknown._replace(reason=f"{len(known)} runs are held out, at least {MIN_RUNS} are required")
    bare = replace(robot, effects={}, effects_cov=np.empty((0, 0)))
    tested, correct = [with_wheel_speeds(run, bare) for run in known], []
    try:
        for step, effects in enumerate((dict(before), dict(after))):
            trained = [
                simulate_run(bare, terrain, SCENARIO, seed, number, vary=True, effects=effects)
                for terrain in terrains
                for number in range(1, runs_a_terrain + 1)
            ]
            trained = [with_wheel_speeds(run, bare) for run in trained]
            correct.append(_correct_windows(trained, tested, settings))
            progress("classifier", step + 1, 2)
    except TerrainError as error:
        return unknown._replace(reason=str(error))
    (first, run_id), (second, _) = correct
    return unknown._replace(errors={"accuracy": accuracy_change(first, second, run_id, seed)})


def _correct_windows(
    trained: Sequence[RunLog], known: Sequence[RunLog], settings: LearnSettings
) -> tuple[Array, Array]:
    """Return which windows (n,) of the known runs are classified correctly, and their runs (n,)."""
    layout = shared_layout(*(layout_of(runs, SIGNAL_SETS, speeds=True) for runs in (trained, known)))
    train, test = (
        labelled(cut_windows(runs, settings.rule, layout=layout, skip_short=True)).windows
        for runs in (trained, known)
    )
    recipe = recipe_of(settings)
    recipe.fit(train, train.terrain.astype(str))
    predicted = np.asarray(recipe.predict(test)).astype(str)
    return predicted == test.terrain.astype(str), test.run_id.astype(str)
