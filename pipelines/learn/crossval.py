"""Evaluate recipes or models on held-out runs, one alone or several side by side.

A recipe is fitted anew on every fold, by default of whole runs; a model, on runs that it was not trained on,
as it is.  Several are compared on the same windows, with differences that are paired by run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pipelines.data.settings import AlignedRunsSettings, load
from pipelines.learn.comparison import ComparisonResult, compare_models, compare_recipes, side_by_side
from pipelines.learn.evaluation import CrossvalResult, crossval, evaluate_recipe
from pipelines.learn.parallel import ComputeSettings
from pipelines.learn.settings import EvaluationSettings
from pipelines.report import Progress, silent
from terrain.errors import DataError

if TYPE_CHECKING:
    from terrain.records import Windows

__all__ = [
    "ComparisonResult",
    "CrossvalResult",
    "EvaluationSettings",
    "Settings",
    "compare_models",
    "compare_recipes",
    "cross_validate",
    "crossval",
    "evaluate_recipe",
    "run",
]

EXAMPLE = "terrain crossval --data runs/ --recipe svm"


class Settings(EvaluationSettings, AlignedRunsSettings, ComputeSettings):
    """What is evaluated, of which runs."""


def run(settings: Settings, progress: Progress = silent) -> CrossvalResult | ComparisonResult:
    """Read runs, and evaluate recipes or models on them.

    Raises
    ------
    ConfigError, LogError, DataError
        if a setting is not accepted, a run cannot be read, or the data cannot answer.
    """
    from pipelines.data.datasets import data_digest
    from pipelines.learn.parallel import computing

    runs, skipped = load(settings)
    asked = settings.with_(skip_short=settings.repair)
    with computing(settings.compute):
        if settings.model:
            from pipelines.learn.load import load_model

            found = compare_models(runs, [load_model(each) for each in settings.model], asked)
        elif len(asked.recipes) > 1:
            found = compare_recipes(runs, asked, progress)
        else:
            found = crossval(runs, asked, progress)
    named = replace(found, dataset=settings.dataset, data_digest=data_digest(runs), data=str(settings.data))
    return replace(named, skipped=tuple(skipped)) if isinstance(named, CrossvalResult) else named


def cross_validate(
    recipe: Any, windows: Windows, *, names: Sequence[str] = (), progress: Progress = silent, **options: Any
) -> CrossvalResult | ComparisonResult:
    """Evaluate one recipe, or several side by side, on windows with labels; whole runs are held out.

    Parameters
    ----------
    recipe : a scikit-learn classifier of features, a whole recipe or the name of one, or a list of them
    windows : with the run and the terrain of each
    names : of the recipes, for the report
    progress : called as folds are done
    options : fields of :class:`EvaluationSettings`, as ``protocol``, ``repeats``, ``seed``, ``n_jobs``; and
        ``functions``, a list of own functions of a window

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.neighbors import KNeighborsClassifier
    >>> from terrain.records import Windows
    >>> rng, run = np.random.default_rng(0), np.repeat(np.arange(10), 8)
    >>> terrain = np.where(run % 2, "ice", "mud").astype(object)
    >>> shaking = rng.normal(size=(80, 1, 200)) * np.where(run % 2, 1.0, 3.0)[:, None, None]
    >>> windows = Windows({"imu": shaking}, {"imu": ("accel_z_mps2",)}, {"imu": 100.0}, 2.0,
    ...                   2.0 * np.arange(80), run.astype(str).astype(object), terrain)
    >>> def peak(window):
    ...     return np.abs(window["imu", "accel_z_mps2"]).max()
    >>> found = cross_validate(KNeighborsClassifier(3), windows, functions=[peak], repeats=1, n_jobs=1)
    >>> found.recipe, found.n_features, found.accuracy
    ('KNeighborsClassifier', 52, 1.0)
    """
    from pipelines.learn.protocols import Samples
    from pipelines.learn.recipes import make_recipe

    functions = options.pop("functions", ())
    recipes = list(recipe) if isinstance(recipe, list | tuple) else [recipe]
    settings = EvaluationSettings(**{"extras": False} | options)
    known = windows[windows.terrain != ""]
    if not len(known):
        raise DataError("no window has a terrain label: nothing can be trained or tested")
    gap = settings.rule.overlap
    samples = Samples(known, {}, known.run_id, gap)
    made = [
        make_recipe(each, settings.signal_sets, gap=gap, seed=settings.seed, functions=functions)
        for each in recipes
    ]
    texts = names or [each if isinstance(each, str) else type(each).__name__ for each in recipes]
    contenders = [(text, each, samples) for text, each in zip(texts, made, strict=True)]
    if len(contenders) == 1:
        return evaluate_recipe(made[0], texts[0], samples, settings, progress)[0]
    return side_by_side(contenders, settings, progress)
