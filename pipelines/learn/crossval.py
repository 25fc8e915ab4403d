"""Evaluate recipes or models on held-out runs, one alone or several side by side.

A recipe is fitted anew on every fold, by default of whole runs; a model, on runs that it was not trained on,
as it is.  Several are compared on the same windows, with differences that are paired by run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

from pydantic import model_validator

from pipelines.data.datasets import load
from pipelines.data.settings import AlignedRunsSettings
from pipelines.learn.parallel import ComputeSettings, computing
from pipelines.learn.settings import EvaluationSettings
from pipelines.report.results import Progress, silent
from terrain.errors import ConfigError, DataError

if TYPE_CHECKING:
    from pipelines.learn.comparison import ComparisonResult
    from pipelines.learn.evaluation import CrossvalResult
    from terrain.records import RunLog, Windows

EXAMPLE = "terrain crossval --data runs/ --recipe svm"
RESULTS = ("pipelines.learn.evaluation", "pipelines.learn.comparison")


class Settings(EvaluationSettings, AlignedRunsSettings, ComputeSettings):
    """What is evaluated, of which runs."""

    @model_validator(mode="after")
    def _check_runs(self) -> Self:
        of_runs = self.protocol in ("published", "slow-fast", "fast-slow") or self.speed is not None
        if self.cache is not None and (of_runs or self.model):
            raise ConfigError(
                "--cache holds features of windows; --model, this protocol or --speed needs the runs"
            )
        return self


def run(settings: Settings, progress: Progress = silent) -> CrossvalResult | ComparisonResult:
    """Read runs, or their cached features, and evaluate recipes or models on them."""
    from pipelines.learn.evaluation import CrossvalResult

    found: CrossvalResult | ComparisonResult
    with computing(settings.compute):
        if settings.cache is not None:
            from pipelines.learn.cache import cached_data, loaders_of
            from pipelines.learn.evaluate import evaluate_recipe

            data, skipped, doubts = cached_data(loaders_of(settings), settings, settings.cache, progress)
            (name,), computed, digest = settings.recipes, (data.rows, data.motion), data.digest
            found, _ = evaluate_recipe(data.recipe, name, data.samples, settings, progress, computed)
        else:
            from terrain.logs.run_folders import data_digest

            runs, skipped, doubts = load(settings)
            asked, digest = settings.with_(skip_short=settings.repair), data_digest(runs)
            if settings.model:
                from pipelines.learn.comparison import compare_models

                found = compare_models(runs, [settings.read_model(each) for each in settings.model], asked)
            else:
                found = crossval(runs, asked, progress)
    named = replace(found, dataset=settings.dataset, data_digest=digest, data=str(settings.data))
    named = named.with_doubts(doubts)
    return replace(named, skipped=tuple(skipped)) if isinstance(named, CrossvalResult) else named


def crossval(
    runs: Sequence[RunLog], settings: EvaluationSettings, progress: Progress = silent
) -> CrossvalResult | ComparisonResult:
    """Cross-validate one recipe on labelled runs, or compare several on the same folds, then without extras.

    Raises
    ------
    DataError
        if the data cannot answer: one class, fewer runs than folds, a run shorter than a window; or if two
        recipes cut different windows from them.
    """
    from features.protocols import samples_of
    from pipelines.learn.comparison import side_by_side
    from pipelines.learn.recipes import recipe_of

    several, contenders = len(settings.recipes) > 1, []
    settings = settings.with_(extras=settings.extras and not several)
    for name in settings.recipes:
        recipe = recipe_of(settings, name)
        used, speed_mps = recipe[0].signal_sets if several else settings.signal_sets, settings.speed_mps
        asked = settings.rule, used, settings.protocol
        samples = samples_of(runs, *asked, speed_mps=speed_mps, **settings.reading)
        contenders.append((name, recipe, samples))
    return side_by_side(contenders, settings, progress)


def cross_validate(
    recipe: Any, windows: Windows, *, progress: Progress = silent, **options: Any
) -> CrossvalResult | ComparisonResult:
    """Evaluate one recipe, or several side by side, on windows with labels; whole runs are held out.

    Parameters
    ----------
    recipe : a :class:`~pipelines.learn.classifier.TerrainClassifier`, a scikit-learn classifier of features, a
        whole recipe or the name of one; or a list of them
    windows : with the run and the terrain of each
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
    ('KNeighborsClassifier with peak', 52, 1.0)
    """
    from features.extractor import function_name
    from features.protocols import Samples
    from features.recipes import make_recipe
    from features.windows import overlap_of
    from pipelines.learn.comparison import side_by_side

    functions = options.pop("functions", ())
    recipes = list(recipe) if isinstance(recipe, list | tuple) else [recipe]
    settings = EvaluationSettings(**{"extras": False} | options)
    known = windows[windows.terrain != ""]
    if not len(known):
        raise DataError("no window has a terrain label: nothing can be trained or tested")
    gap = overlap_of(known)
    samples, contenders = Samples(known, {}, known.groups, gap), []
    for each in recipes:
        kind = each
        if hasattr(each, "unfitted"):
            kind, made = each.recipe, each.unfitted(gap)
        else:
            made = make_recipe(each, settings.signal_sets, gap=gap, seed=settings.seed, functions=functions)
        name, own = kind if isinstance(kind, str) else type(kind).__name__, getattr(made[0], "functions", ())
        name += f" with {', '.join(map(function_name, own))}" if own else ""
        contenders.append((name, made, samples))
    return side_by_side(contenders, settings, progress)
