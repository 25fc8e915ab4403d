"""What the live chain takes of a trained model, and what such a model says of windows.

A window is *unknown* where it is less like all learned terrains than nearly all known windows are
(:mod:`terrain.classify.novelty_numbers`), and *unsupported* where few training runs drove the predicted
terrain like this (:mod:`terrain.classify.support`).  Of windows of known terrains,
5 % are unknown by definition.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from features.motion import window_motion
from features.windows import Layout, WindowRule
from terrain.classify.conformal import conformal_sets
from terrain.classify.novelty_numbers import NoveltyNumbers, novelty_scores
from terrain.classify.support import SupportTable, support_of
from terrain.classify.terrain_filter import TerrainFilter
from terrain.records import Array, Windows


class WindowsInfo(Protocol):
    """How the windows of a model are cut, and what its classes are."""

    @property
    def classes(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def window_s(self) -> float: ...  # noqa: D102
    @property
    def channels(self) -> Mapping[str, tuple[str, ...]]: ...  # noqa: D102
    @property
    def rate_hz(self) -> Mapping[str, float]: ...  # noqa: D102
    @property
    def filter(self) -> str: ...  # noqa: D102
    @property
    def robots(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def class_ratio(self) -> Mapping[str, float]: ...  # noqa: D102
    @property
    def conformal(self) -> float | None: ...  # noqa: D102
    @property
    def layout(self) -> Layout: ...  # noqa: D102
    @property
    def rule(self) -> WindowRule: ...  # noqa: D102


class LiveModel(Protocol):
    """A trained model; ``recipe`` has ``predict_proba(windows)``, ``classes_`` and ``matrix`` of features."""

    @property
    def recipe(self) -> Any: ...  # noqa: D102
    @property
    def info(self) -> WindowsInfo: ...  # noqa: D102
    @property
    def novelty(self) -> NoveltyNumbers | None: ...  # noqa: D102
    @property
    def support(self) -> SupportTable | None: ...  # noqa: D102
    @property
    def over_time(self) -> TerrainFilter | None: ...  # noqa: D102


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


def assess(model: LiveModel, windows: Windows) -> Assessed:
    """Return what a model says of windows.

    Raises
    ------
    DataError
        if the windows are not those that the model requires.
    """
    nothing = np.full(len(windows), np.nan)
    novelty, features, recipe = nothing, None, model.recipe
    if model.novelty is not None:
        features = recipe.matrix.of(windows)
        novelty = novelty_scores(model.novelty, features)
    from_features = getattr(recipe, "probabilities", None)  # takes features that are there already
    probability = np.asarray(
        recipe.predict_proba(windows) if from_features is None else from_features(windows, features)
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


def class_sets(model: LiveModel, probability: Array) -> list[tuple[str, ...]] | None:
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
