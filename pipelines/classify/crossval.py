"""``terrain crossval``: how well a recipe does on runs it has not seen."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sklearn.base import clone

from features.extractor import FeatureExtractor
from features.windows import WindowRule
from pipelines.classify.evaluation import fit_folds, pool, summarise
from pipelines.classify.extras import fold_accuracy, has_speed, learning_curve, slow_fast
from pipelines.classify.splits import (
    N_FOLDS,
    PROTOCOLS,
    PUBLISHED_WINDOW_S,
    Samples,
    counted,
    folds_of,
    grouped_samples,
    published_samples,
)
from pipelines.models.recipes import WindowPipeline, feature_matrix, make_recipe
from pipelines.reporting.progress import Progress, silent
from terrain.classify.folds import single_run_classes
from terrain.errors import ConfigError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import RunLog

DEFAULT_WINDOW_S = 2.0
DEFAULT_REPEATS = {"grouped": 5, "leave-one-run-out": 1, "published": 5}


@dataclass(frozen=True, slots=True)
class CrossvalSettings:
    """What to evaluate and how.

    ``window_s`` and ``repeats`` default to what the protocol asks for (2 s; 1.7 s under ``published``);
    ``skip_short`` leaves out and counts runs shorter than a window instead of refusing them.
    """

    recipe: str = "svm"
    protocol: str = "grouped"
    window_s: float | None = None
    stride_s: float | None = None
    steady: bool = True
    repeats: int | None = None
    seed: int = 0
    signal_sets: tuple[str, ...] = SIGNAL_SETS
    extras: bool = True
    n_jobs: int = 0
    skip_short: bool = False

    def __post_init__(self) -> None:
        if self.protocol not in PROTOCOLS:
            raise ConfigError(f"there is no protocol {self.protocol!r}; there are {', '.join(PROTOCOLS)}")
        if self.repeats is not None and self.repeats < 1:
            raise ConfigError(f"{self.repeats} repeats are none; at least 1 is needed")
        if self.protocol == "published" and (self.stride_s is not None or not self.steady):
            raise ConfigError(
                "'published' sets its own strides and keeps all motion: stride and steady do not apply"
            )
        if self.protocol == "leave-one-run-out" and (self.repeats or 1) > 1:
            raise ConfigError("'leave-one-run-out' leaves nothing to deal anew: it has one repeat")
        for name in self.signal_sets:
            if name not in SIGNAL_SETS:
                raise ConfigError(f"unknown signal set {name!r}; there are {', '.join(SIGNAL_SETS)}")

    @property
    def rule(self) -> WindowRule:
        """How windows are cut."""
        default_s = PUBLISHED_WINDOW_S if self.protocol == "published" else DEFAULT_WINDOW_S
        length_s = default_s if self.window_s is None else self.window_s
        steady = WindowRule().steady if self.steady else None
        return WindowRule(length_s, self.stride_s, steady)

    def new_recipe(self) -> WindowPipeline:
        """Return the recipe, unfitted."""
        return make_recipe(self.recipe, self.signal_sets, gap=self.rule.overlap, seed=self.seed)

    @property
    def jobs(self) -> int:
        """Processes at once: what was asked for, or one a core."""
        return self.n_jobs if self.n_jobs > 0 else os.cpu_count() or 1


def crossval(
    runs: Sequence[RunLog], settings: CrossvalSettings, progress: Progress = silent
) -> dict[str, Any]:
    """Cross-validate a recipe on labelled runs.

    Returns
    -------
    dict that JSON can hold
        ``protocol, recipe, window_s, n_windows, n_runs, accuracy, accuracy_ci, accuracy_spread,
        balanced_accuracy, macro_f1, per_class, confusion, classes, folds, per_run, vote_accuracy, ece,
        reliability, dropped, repaired, notes`` and, with extras under ``grouped``, ``speed_only_accuracy``,
        ``slow_fast`` and ``learning_curve``.

    Raises
    ------
    DataError
        if the data cannot answer: one class, fewer runs than folds, a run shorter than a window.
    """
    samples = samples_of(runs, settings)
    windows = samples.cut.windows
    y = windows.terrain.astype(str)
    repeats = settings.repeats or DEFAULT_REPEATS[settings.protocol]
    folds = folds_of(samples, settings.protocol, repeats, settings.seed)
    recipe = settings.new_recipe()
    progress("features", 0, 1)
    features = feature_matrix(recipe, windows)
    progress("features", 1, 1)
    classifier = recipe[-1]
    results = fit_folds(
        classifier, features, y, samples.group, folds, settings.jobs, settings.protocol, progress
    )
    repaired = dict(sum((Counter(run.dropped) for run in runs), Counter()))
    report = {
        "protocol": settings.protocol,
        "recipe": settings.recipe,
        "window_s": settings.rule.length_s,
        "stride_s": None if settings.protocol == "published" else settings.rule.step_s,
        "steady": settings.rule.steady is not None and settings.protocol != "published",
        "signal_sets": list(settings.signal_sets),
        "seed": settings.seed,
        **summarise(pool(results, y), samples, settings.seed),
        "n_features": features.shape[1],
        "dropped": dict(samples.cut.dropped),
        "repaired": repaired,
        "notes": notes(samples, settings, repaired),
    }
    if settings.extras and settings.protocol == "grouped":
        first = [fold for fold in folds if fold.repeat == 0]
        report["speed_only_accuracy"] = None
        if has_speed(windows):
            speed = FeatureExtractor(("wheels",), ("wheels",)).fit_transform(windows)
            report["speed_only_accuracy"] = fold_accuracy(
                clone(classifier), speed, samples, first, settings.jobs, "speed only", progress
            )
        report["slow_fast"] = slow_fast(classifier, features, samples, settings.jobs, progress)
        report["learning_curve"] = learning_curve(
            classifier,
            features,
            samples,
            first,
            report["accuracy_per_repeat"][0],
            settings.seed,
            settings.jobs,
            progress,
        )
    return report


def samples_of(runs: Sequence[RunLog], settings: CrossvalSettings) -> Samples:
    """Cut the windows that the protocol asks for."""
    if settings.protocol == "published":
        return published_samples(runs, settings.rule, settings.signal_sets)
    return grouped_samples(runs, settings.rule, settings.signal_sets, skip_short=settings.skip_short)


def notes(samples: Samples, settings: CrossvalSettings, repaired: dict[str, int]) -> list[str]:
    """Return in sentences what a reader of the figures must know."""
    said = []
    windows = samples.cut.windows
    alone = single_run_classes(windows.terrain.astype(str), windows.run_id.astype(str))
    if alone and settings.protocol != "published":
        said.append(
            f"{', '.join(alone)}: one run only, cut into {N_FOLDS} contiguous blocks with a gap; "
            "its figures are optimistic, the same run teaches and tests"
        )
    if settings.protocol == "published":
        said.append(
            "published protocol: parts of one run lie on both sides of the split; "
            "for comparison with papers only"
        )
    if samples.cut.dropped:
        said.append(f"windows left out: {counted(samples.cut.dropped)}")
    if repaired:
        said.append(f"dropped to repair the logs: {counted(repaired)}")
    return said
