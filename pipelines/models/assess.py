"""What a model says of windows, and what it knows of its own limits there.

A window is *unknown* where it is less like all learned terrains than nearly all known windows are
(:mod:`terrain.classify.novelty_numbers`), and *unsupported* where few training runs drove the predicted
terrain like this (:mod:`terrain.classify.support`).  Of windows of known terrains,
5 % are unknown by definition.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from features.motion import window_motion
from pipelines.models.lean import LeanRecipe
from pipelines.models.model_files import TerrainModel
from terrain.classify.conformal import conformal_sets
from terrain.classify.novelty_numbers import novelty_scores
from terrain.classify.support import support_of
from terrain.records import Array, Windows


class Assessed(NamedTuple):
    """Outputs of a model for n windows.

    Parameters
    ----------
    probability : (n, k) in the order of the model's classes
    novelty : (n,) score; NaN where the model has none
    unknown : (n,) whether the window is like no terrain that was learned
    n_runs : (n,) training runs of the predicted terrain near the window's motion; NaN where not counted
    supported : (n,) whether they support the prediction; NaN where not counted
    """

    probability: Array
    novelty: Array
    unknown: Array
    n_runs: Array
    supported: Array


def assess(model: TerrainModel, windows: Windows) -> Assessed:
    """Return what a model says of windows.

    Raises
    ------
    DataError
        if the windows are not those that the model requires.
    """
    nothing = np.full(len(windows), np.nan)
    novelty, features = nothing, None
    if model.novelty is not None:
        features = model.recipe.matrix.of(windows)
        novelty = novelty_scores(model.novelty, features)
    recipe = model.recipe
    probability = (
        recipe.probabilities(windows, features)
        if isinstance(recipe, LeanRecipe)
        else np.asarray(recipe.predict_proba(windows))
    )
    unknown = np.zeros(len(windows), dtype=bool)
    if model.novelty is not None:
        unknown = ~(novelty <= model.novelty.threshold)
    motion = None if model.support is None else window_motion(windows)
    if model.support is None or motion is None:
        return Assessed(probability, novelty, unknown, nothing, nothing)
    near = model.support.near_runs(motion.speed_mps, motion.yaw_rate_radps)
    support = support_of(probability, near)
    return Assessed(
        probability, novelty, unknown, support.n_runs.astype(float), support.supported.astype(float)
    )


def class_sets(model: TerrainModel, probability: Array) -> list[tuple[str, ...]] | None:
    """Return the classes of each window that hold the true one in 90 % of windows; None if not calibrated.

    Parameters
    ----------
    model : whose threshold was calibrated on held-out runs
    probability : (n, k)
    """
    if model.info.conformal is None:
        return None
    classes = np.asarray(model.info.classes)
    return [tuple(classes[row].tolist()) for row in conformal_sets(probability, model.info.conformal)]
