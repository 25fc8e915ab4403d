"""Windows, classifiers and their evaluation in Python."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from features.recipes import make_recipe
from features.windows import SteadyMotion, WindowRule
from features.windows import cut_windows as cut
from pipelines.learn.classifier import TerrainClassifier
from pipelines.learn.comparison import ComparisonResult
from pipelines.learn.crossval import cross_validate as evaluate
from pipelines.learn.evaluation import CrossvalResult
from terrain.errors import DataError
from terrain.records import RunLog, Windows

__all__ = ["cross_validate", "cut_windows"]


def cut_windows(
    runs: Iterable[RunLog], length_s: float = 2.0, stride_s: float | None = None, *, steady: bool = True
) -> Windows:
    """Cut runs into windows of equal length; runs that are shorter are left out.

    Parameters
    ----------
    runs : whose channels and rates fit each other
    length_s, stride_s : of a window, and from start to start; one length by default
    steady : keep windows of steady motion only

    Raises
    ------
    DataError
        if no window is left, or runs do not fit each other.

    Examples
    --------
    >>> import terrain
    >>> terrain.cut_windows([terrain.simulate("husky", "grass", "straight", duration_s=8.0)])
    3 windows of 2 s from 1 runs: grass
    """
    rule = WindowRule(length_s, stride_s, SteadyMotion() if steady else None)
    found = cut(list(runs), rule, skip_short=True)
    if not len(found.windows):
        dropped = ", ".join(f"{n} {why}" for why, n in found.dropped.items())
        raise DataError(
            f"no window of {length_s:g} s is left; dropped: {dropped or 'none, there are no runs'}"
        )
    return found.windows


def cross_validate(model: Any, windows: Windows, **options: Any) -> CrossvalResult | ComparisonResult:
    """Evaluate one classifier, or several side by side, on windows with labels; whole runs are held out.

    Parameters
    ----------
    model : a :class:`TerrainClassifier`, a scikit-learn classifier of features, the name of a recipe; or a list
    windows : with the run and the terrain of each
    options : as :func:`pipelines.learn.crossval.cross_validate`, such as ``protocol``, ``repeats``, ``seed``
    """
    models = list(model) if isinstance(model, list | tuple) else [model]
    recipes = [_recipe(each) for each in models]
    return evaluate(recipes, windows, **{"names": [_name(each) for each in models]} | options)


def _recipe(model: Any) -> Any:
    if not isinstance(model, TerrainClassifier):
        return model
    return make_recipe(model.recipe, model.signal_sets, seed=model.seed, functions=model.functions)


def _name(model: Any) -> str:
    kind = model.recipe if isinstance(model, TerrainClassifier) else model
    return kind if isinstance(kind, str) else type(kind).__name__
