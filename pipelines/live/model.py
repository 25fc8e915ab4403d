"""A trained model, and what it says of windows.

A window is *unknown* where it is less like all learned terrains than nearly all known windows are
(:mod:`terrain.classify.novelty_numbers`), and *unsupported* where few training runs drove the predicted
terrain like this (:mod:`terrain.classify.support`).  Of windows of known terrains,
5 % are unknown by definition.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from features.motion import window_motion
from features.windows import Layout, SteadyMotion, WindowRule
from terrain.classify.conformal import conformal_sets
from terrain.classify.novelty_numbers import NoveltyNumbers, novelty_scores
from terrain.classify.support import SupportTable, support_of
from terrain.classify.terrain_filter import TerrainFilter
from terrain.records import Array, Windows


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """How the training windows of a model were cut, as those of a new log must be, and where they came from.

    Parameters
    ----------
    classes : in the order of the probabilities
    window_s, stride_s, steady : the rule of the windows
    channels, rate_hz : by stream, which a log must have
    run_digests : of each training run
    recipe, signal_sets, seed : what was trained
    data_digest, dataset : of the training runs
    commit, package_version : of the code
    robots : whose runs the training runs were, by name
    filter : that made the streams ``estimator`` and ``slip``; empty where the model uses neither
    class_ratio : share of each class among the training windows
    run_accuracy : of the windows of each training run when it was held out, by its digest
    conformal : threshold of the sets of classes; None where there is none
    """

    classes: tuple[str, ...]
    window_s: float
    stride_s: float | None
    steady: SteadyMotion | None
    channels: Mapping[str, tuple[str, ...]]
    rate_hz: Mapping[str, float]
    run_digests: tuple[str, ...]
    recipe: str = ""
    signal_sets: tuple[str, ...] = ()
    seed: int = 0
    data_digest: str = ""
    dataset: str = ""
    commit: str = ""
    package_version: str = ""
    robots: tuple[str, ...] = ()
    filter: str = ""
    class_ratio: Mapping[str, float] = field(default_factory=dict)
    run_accuracy: Mapping[str, float] = field(default_factory=dict)
    conformal: float | None = None

    @property
    def layout(self) -> Layout:
        """Channels and rates that a log must have."""
        return Layout(self.channels, self.rate_hz)

    @property
    def rule(self) -> WindowRule:
        """How windows must be cut."""
        return WindowRule(self.window_s, self.stride_s, self.steady)

    @property
    def windows(self) -> str:
        """How windows must be cut, in words."""
        motion = "all motion" if self.steady is None else "steady motion"
        return f"{self.window_s:g} s every {self.rule.step_s:g} s, {motion}"


class TerrainModel(NamedTuple):
    """A fitted recipe, and how its training windows were cut.

    ``recipe`` has ``predict_proba(windows)``, ``classes_`` and ``matrix`` of features.  ``novelty`` and ``support``
    are None of training runs that give none; ``over_time`` is the filter of its outputs, where they are to be
    filtered.
    """

    recipe: Any
    info: ModelInfo
    novelty: NoveltyNumbers | None = None
    support: SupportTable | None = None
    over_time: TerrainFilter | None = None


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
