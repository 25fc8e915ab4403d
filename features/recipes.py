"""Recipes: whole scikit-learn pipelines from windows to terrain, by name or around one's own classifier."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from sklearn.base import ClassifierMixin
from sklearn.pipeline import Pipeline

from features.extractor import (
    FeatureExtractor,
    FunctionExtractor,
    PlainExtractor,
    SampleExtractor,
    WindowFunction,
)
from terrain.classify.grouped import OwnClassifier
from terrain.classify.svm import CANDIDATES, GroupedSVC
from terrain.errors import ConfigError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, Windows

#: SVM and trees on features, network on samples, SVM and network joined, and which of these four held-out runs favour;
#: what wheels answer to how they are driven; and a baseline, boosted trees on means and standard deviations.
RECIPES = ("svm", "trees", "cnn", "stack", "best", "response", "plain")
#: Recipes that take own functions of a window, as one's own classifiers do.
WITH_FUNCTIONS = ("svm", "trees")


class WindowPipeline(Pipeline):
    """A scikit-learn pipeline over windows that passes session and run of each window to its last step.

    The last step makes its inner folds of whole sessions, or runs without; ``cross_validate(recipe, windows, terrain,
    groups=windows.run_id)`` therefore needs no further argument.  ``classifier__groups`` overrides them.
    """

    def fit(self, X: Windows, y: Any = None, **params: Any) -> WindowPipeline:
        """Fit all steps; the last one is given ``groups``, and which columns are samples."""
        inform(self, self[0].fit(X))
        groups = f"{self.steps[-1][0]}__groups"
        fitted: WindowPipeline = super().fit(X, y, **{groups: X.groups, **params})
        return fitted

    def probabilities(self, windows: Windows, features: Array | None = None) -> Array:
        """Return probabilities (n_windows, k), from the windows' features where they are there already."""
        if features is None or getattr(type(self[0]), "transform", None) is not FeatureExtractor.transform:
            return np.asarray(self.predict_proba(windows))
        return np.asarray(self[-1].predict_proba(self[0].matrix(windows, features)))


def make_recipe(
    recipe: str | Any = "svm",
    signal_sets: Iterable[str] = SIGNAL_SETS,
    level_sets: Iterable[str] = (),
    gap: int = 1,
    seed: int = 0,
    candidates: Sequence[Sequence[float]] = CANDIDATES,
    functions: Sequence[WindowFunction] = (),
) -> WindowPipeline:
    """Return an unfitted recipe.

    Parameters
    ----------
    recipe : one of :data:`RECIPES`; or a scikit-learn classifier of features, or what returns one; or a
        :class:`WindowPipeline`, which is returned as it is
    gap : windows left out beside an inner test block; as many as share samples with a window
    candidates : hyper-parameters that the SVM chooses among
    functions : own functions of a window, beside the features

    Raises
    ------
    ConfigError
        if there is no recipe of that name, or it does not learn from features and is given functions.

    Examples
    --------
    >>> [step for step, _ in make_recipe("svm").steps]
    ['features', 'classifier']
    >>> from sklearn.neighbors import KNeighborsClassifier
    >>> make_recipe(KNeighborsClassifier(3))[-1].outputs
    'predict_proba'
    """
    if isinstance(recipe, WindowPipeline):
        return recipe
    if isinstance(recipe, str) and recipe not in RECIPES:
        raise ConfigError(f"there is no recipe {recipe!r}; there are {', '.join(RECIPES)}")
    sets = tuple(signal_sets), tuple(level_sets)
    if functions and isinstance(recipe, str) and recipe not in WITH_FUNCTIONS:
        takers = " and ".join(map(repr, WITH_FUNCTIONS))
        raise ConfigError(f"recipe {recipe!r} does not take features of your own; {takers} do")
    features: FeatureExtractor = FeatureExtractor(*sets)
    if functions:
        features = FunctionExtractor(*sets, tuple(functions))
    classifier: ClassifierMixin
    if recipe == "svm":
        classifier = GroupedSVC(candidates, gap=gap, seed=seed)
    elif recipe in ("trees", "plain"):
        from terrain.classify.trees import GroupedTrees

        features = PlainExtractor(*sets) if recipe == "plain" else features
        classifier = GroupedTrees(boosted=recipe == "plain", gap=gap, seed=seed)
    elif recipe == "cnn":
        from terrain.classify.network import GroupedNetwork

        features, classifier = SampleExtractor(*sets), GroupedNetwork(gap=gap, seed=seed)
    elif recipe == "response":  # responses are compared at the speeds of the wheels
        from features.response import ResponseExtractor
        from terrain.classify.response import GroupedResponse

        with_speeds = tuple(dict.fromkeys((*sets[0], "wheels")))
        features, classifier = ResponseExtractor(with_speeds, sets[1]), GroupedResponse()
    elif isinstance(recipe, str):
        from terrain.classify.stack import GroupedStack

        features = SampleExtractor(*sets, with_features=True)
        classifier = GroupedStack(choose=recipe == "best", candidates=candidates, gap=gap, seed=seed)
    else:
        made = recipe if hasattr(recipe, "fit") and not isinstance(recipe, type) else recipe()
        if isinstance(made, WindowPipeline):
            return made
        if not (hasattr(made, "fit") and hasattr(made, "predict") and hasattr(made, "get_params")):
            raise ConfigError(f"{made!r} is no scikit-learn classifier: it needs fit, predict and get_params")
        classifier = OwnClassifier(made, gap, seed)
    return WindowPipeline([("features", features), ("classifier", classifier)])


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
