"""Recipes: whole scikit-learn pipelines from windows to terrain, by name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from sklearn.base import ClassifierMixin
from sklearn.pipeline import Pipeline

from features.extractor import FeatureExtractor
from features.matrix import FeatureMatrix
from features.response import ResponseExtractor
from features.sample_extractor import SampleExtractor
from terrain.classify.grouped_network import GroupedNetwork
from terrain.classify.response import GroupedResponse
from terrain.classify.stack import GroupedStack
from terrain.classify.svm import CANDIDATES, GroupedSVC
from terrain.errors import ConfigError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, Windows

RECIPES = ("svm", "cnn", "stack", "best", "response")
"""SVM on features, network on samples, both joined, and which of these three held-out runs favour; and what
wheels answer to how they are driven."""


class WindowPipeline(Pipeline):
    """A scikit-learn pipeline over windows that passes the run of each window to its last step.

    The last step makes its inner folds of whole runs; ``cross_validate(recipe, windows, terrain,
    groups=windows.run_id)`` therefore needs no further argument.  ``classifier__groups`` overrides the run.
    """

    @property
    def matrix(self) -> FeatureMatrix:
        """What the features are computed from, once fitted."""
        found: FeatureMatrix = self[0].matrix
        return found

    def fit(self, X: Windows, y: Any = None, **params: Any) -> WindowPipeline:
        """Fit all steps; the last one is given ``groups``, and which columns are samples."""
        inform(self, self[0].fit(X))
        groups = f"{self.steps[-1][0]}__groups"
        fitted: WindowPipeline = super().fit(X, y, **{groups: X.run_id, **params})
        return fitted


def make_recipe(
    name: str,
    signal_sets: Iterable[str] = SIGNAL_SETS,
    level_sets: Iterable[str] = (),
    gap: int = 1,
    seed: int = 0,
    candidates: Sequence[Sequence[float]] = CANDIDATES,
) -> WindowPipeline:
    """Return an unfitted recipe.

    Parameters
    ----------
    name : one of :data:`RECIPES`
    signal_sets, level_sets : as :class:`~features.extractor.FeatureExtractor`
    gap : windows left out beside an inner test block; as many as share samples with a window
    seed : deals runs into the inner folds
    candidates : hyper-parameters that the SVM chooses among

    Raises
    ------
    ConfigError
        if there is no recipe of that name.

    Examples
    --------
    >>> [step for step, _ in make_recipe("svm").steps]
    ['features', 'classifier']
    """
    if name not in RECIPES:
        raise ConfigError(f"there is no recipe {name!r}; there are {', '.join(RECIPES)}")
    sets = tuple(signal_sets), tuple(level_sets)
    features: FeatureExtractor = FeatureExtractor(*sets)
    classifier: ClassifierMixin = GroupedSVC(candidates, gap=gap, seed=seed)
    if name == "cnn":
        features, classifier = SampleExtractor(*sets), GroupedNetwork(gap=gap, seed=seed)
    elif name == "response":
        features, classifier = ResponseExtractor(*_with_speeds(sets)), GroupedResponse()
    elif name != "svm":
        features = SampleExtractor(*sets, with_features=True)
        classifier = GroupedStack(choose=name == "best", candidates=candidates, gap=gap, seed=seed)
    return WindowPipeline([("features", features), ("classifier", classifier)])


def _with_speeds(sets: tuple[tuple[str, ...], tuple[str, ...]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the sets with that of the wheel speeds, at which responses are compared."""
    signal_sets, level_sets = sets
    return tuple(dict.fromkeys((*signal_sets, "wheels"))), level_sets


def inform(recipe: WindowPipeline, fitted: Any) -> None:
    """Pass on to the last step which columns of the matrix are samples, where it asks for them."""
    if hasattr(recipe[-1], "columns"):
        recipe[-1].set_params(columns=getattr(fitted, "columns_", ()))


def feature_matrix(recipe: WindowPipeline, windows: Windows) -> Array:
    """Return the output of the steps before the last one.

    These steps learn nothing but the channels and rates that all windows have in common, so their output for
    a window does not depend on the other windows, and one computation serves all folds.  The last step is
    informed, so that a clone of it can be fitted on rows of the matrix.
    """
    matrix = np.asarray(recipe[:-1].fit_transform(windows))
    inform(recipe, recipe[0])
    return matrix
