"""A trained model, and what it says of windows.

A window is *unknown* where it is less like all learned terrains than nearly all known windows are
(:mod:`terrain.classify.limits`), and *unsupported* where few training runs drove the predicted
terrain like this (:mod:`terrain.classify.limits`).  Of windows of known terrains,
5 % are unknown by definition.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from features.motion import window_motion
from features.windows import Layout, SteadyMotion, WindowRule
from pipelines.report.results import described
from terrain.classify.limits import SUPPORTED, Novelty, SupportTable, conformal_sets, supported_probability
from terrain.classify.proposals import TakenOver
from terrain.classify.terrain_filter import NOVELTY_WEIGHTS, SHARE_POWERS, FilterSettings
from terrain.records import Array, Windows


@dataclass(frozen=True)
class ModelInfo:
    """How the training windows of a model were cut, as those of a new log must be, and where they came from."""

    classes: tuple[str, ...] = described("terrains, in the order of the probabilities")
    class_ratio: Mapping[str, float] = described("share of each terrain among the training windows")
    window_s: float = described("length of a window", "s")
    stride_s: float | None = described("from window to window; one length where it is none", "s")
    steady: SteadyMotion | None = described("limits of steady motion; None where all windows are kept")
    channels: Mapping[str, tuple[str, ...]] = described("channels that a log must have, by stream")
    rate_hz: Mapping[str, float] = described("their rates", "Hz")
    least_rate_hz: Mapping[str, float] = described(
        "lowest rates from which they are resampled; their own where none is shown not to matter", "Hz"
    )
    run_digests: tuple[str, ...] = described("digest of each training run")
    run_accuracy: Mapping[str, float] = described("of each training run when held out, by its digest", "1")
    package_version: str = described("of the package that trained it")
    recipe: str = described("what was trained")
    signal_sets: tuple[str, ...] = described("whose channels the features use")
    seed: int = described("deals runs into folds")
    data_digest: str = described("digest of the training runs", default="")
    dataset: str = described("name of the training data", default="")
    commit: str = described("of the code", default="")
    robots: tuple[str, ...] = described("robots whose runs it was trained on", default=())
    filter: str = described("filter whose estimates it uses; empty where it uses none", default="")
    own_code: tuple[str, ...] = described("MODULE.NAME of all that it needs beside the package", default=())
    conformal: float | None = described("threshold of the sets of terrains, None without", default=None)
    share_power: float | None = described(
        "power of the class ratios that the terrain filter divides by; None where single windows are better",
        default=SHARE_POWERS[0],
    )
    novelty_weight: float = described(
        "of the novelty's log-likelihood in the terrain filter", default=NOVELTY_WEIGHTS[0]
    )
    known_refused: tuple[float, float, float] | None = described(
        "part of held-out windows of learned terrains that is called unknown, and its interval of 95 % over units; "
        "None where not measured",
        "1",
        default=None,
    )
    taken_over: tuple[TakenOver, ...] = described("wrong proposals of labels for held-out runs", default=())

    @property
    def layout(self) -> Layout:
        """Channels and rates that a log must have."""
        return Layout(self.channels, self.rate_hz, {**self.rate_hz, **self.least_rate_hz})

    @property
    def rule(self) -> WindowRule:
        """How windows must be cut."""
        return WindowRule(self.window_s, self.stride_s, self.steady)

    @property
    def cut_words(self) -> str:
        """How windows must be cut, in words."""
        motion = "all motion" if self.steady is None else "steady motion"
        return f"{self.window_s:g} s every {self.rule.step_s:g} s, {motion}"


class TerrainModel(NamedTuple):
    """A fitted recipe, and how its training windows were cut.

    ``recipe`` has ``predict_proba(windows)``, ``classes_`` and ``matrix`` of features.  ``novelty`` and ``support``
    are None of training runs that give none; ``over_time`` are the settings of the filter of its outputs, where they
    are to be filtered.
    """

    recipe: Any
    info: ModelInfo
    novelty: Novelty | None = None
    support: SupportTable | None = None
    over_time: FilterSettings | None = None


class Assessed(NamedTuple):
    """Outputs of a model for n windows."""

    probability: Array  #: (n, k) in the order of the model's classes
    novelty: Array  #: (n,) score; NaN where the model has none
    unknown: Array  #: (n,) whether the window is like no terrain that was learned
    #: (n,) whether training runs near the window's motion support the prediction; NaN where not counted
    supported: Array


def assess(model: TerrainModel, windows: Windows) -> Assessed:
    """Return what a model says of windows.

    Raises
    ------
    DataError
        if the windows are not those that the model requires.
    """
    novelty = supported = np.full(len(windows), np.nan)
    features, recipe = None, model.recipe
    if model.novelty is not None:
        features = recipe[0].features_of(windows)
        novelty = model.novelty.score(features)
    from_features = getattr(recipe, "probabilities", None)  # takes features that are there already
    probability = np.asarray(
        recipe.predict_proba(windows) if from_features is None else from_features(windows, features)
    )
    unknown = np.zeros(len(windows), dtype=bool)
    if model.novelty is not None:
        unknown = ~(novelty <= model.novelty.threshold)
    if model.support is not None and (motion := window_motion(windows)) is not None:
        near = model.support.near_runs(motion.speed_mps, motion.yaw_rate_radps)
        supported = (supported_probability(probability, near) >= SUPPORTED).astype(float)
    return Assessed(probability, novelty, unknown, supported)


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
