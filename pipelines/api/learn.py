"""Windows, classifiers and their evaluation in Python."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from features.protocols import Samples
from features.recipes import make_recipe
from features.windows import SteadyMotion, WindowRule
from features.windows import cut_windows as cut
from pipelines.learn.classifier import TerrainClassifier
from pipelines.learn.comparison import ComparisonResult
from pipelines.learn.crossval import evaluated
from pipelines.learn.evaluation import CrossvalResult
from pipelines.learn.settings import EvaluationSettings
from pipelines.report.results import Progress, silent
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


def cross_validate(
    model: Any, windows: Windows, *, names: Sequence[str] = (), progress: Progress = silent, **options: Any
) -> CrossvalResult | ComparisonResult:
    """Evaluate one classifier, or several side by side, on windows with labels; whole runs are held out.

    Parameters
    ----------
    model : a :class:`TerrainClassifier`, a scikit-learn classifier of features, a whole recipe or the name of one;
        or a list of them
    windows : with the run and the terrain of each
    names : of the models, for the report
    progress : called as folds are done
    options : fields of :class:`~pipelines.learn.settings.EvaluationSettings`, as ``protocol``, ``repeats``,
        ``seed``, ``n_jobs``; and ``functions``, a list of own functions of a window

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
    functions = options.pop("functions", ())
    settings = EvaluationSettings(**{"extras": False} | options)
    known = windows[windows.terrain != ""]
    if not len(known):
        raise DataError("no window has a terrain label: nothing can be trained or tested")
    gap, contenders = settings.rule.overlap, []
    samples = Samples(known, {}, known.run_id, gap)
    models = list(model) if isinstance(model, list | tuple) else [model]
    for name, each in zip(names or [_name(each) for each in models], models, strict=True):
        if isinstance(each, TerrainClassifier):
            recipe = make_recipe(each.recipe, each.signal_sets, seed=each.seed, functions=each.functions)
        else:
            recipe = make_recipe(each, settings.signal_sets, gap=gap, seed=settings.seed, functions=functions)
        contenders.append((name, recipe, samples))
    return evaluated(contenders, settings, progress)


def _name(model: Any) -> str:
    kind = model.recipe if isinstance(model, TerrainClassifier) else model
    return kind if isinstance(kind, str) else type(kind).__name__
