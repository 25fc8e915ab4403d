"""Recipes: whole scikit-learn pipelines from windows to terrain, by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from sklearn.pipeline import Pipeline

from features.extractor import FeatureExtractor
from terrain.classify.svm import GroupedSVC
from terrain.errors import ConfigError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, Windows

RECIPES = ("svm",)


class WindowPipeline(Pipeline):
    """A scikit-learn pipeline over windows that passes the run of each window to its last step.

    The last step makes its inner folds of whole runs; ``cross_validate(recipe, windows, terrain,
    groups=windows.run_id)`` therefore needs no further argument.  ``classifier__groups`` overrides the run.
    """

    def fit(self, X: Windows, y: Any = None, **params: Any) -> WindowPipeline:
        """Fit all steps; the last one is given ``groups``."""
        groups = f"{self.steps[-1][0]}__groups"
        fitted: WindowPipeline = super().fit(X, y, **{groups: X.run_id, **params})
        return fitted


def make_recipe(
    name: str,
    signal_sets: Iterable[str] = SIGNAL_SETS,
    level_sets: Iterable[str] = (),
    gap: int = 1,
    seed: int = 0,
) -> WindowPipeline:
    """Return an unfitted recipe.

    Parameters
    ----------
    name : one of :data:`RECIPES`
    signal_sets, level_sets : as :class:`~features.extractor.FeatureExtractor`
    gap : windows left out beside an inner test block; as many as share samples with a window
    seed : deals runs into the inner folds

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
    return WindowPipeline(
        [
            ("features", FeatureExtractor(tuple(signal_sets), tuple(level_sets))),
            ("classifier", GroupedSVC(gap=gap, seed=seed)),
        ]
    )


def feature_matrix(recipe: WindowPipeline, windows: Windows) -> Array:
    """Return the output of the steps before the last one.

    These steps learn nothing but the channels and rates that all windows have in common, so their output for
    a window does not depend on the other windows, and one computation serves all folds.
    """
    return np.asarray(recipe[:-1].fit_transform(windows))
