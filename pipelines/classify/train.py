"""``terrain train``: evaluate a recipe on held-out runs, fit it on all of them, track and register it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from sklearn.base import clone

from pipelines.classify.card import model_card, written
from pipelines.classify.importance import channel_importance
from pipelines.classify.limits import limits_of
from pipelines.classify.results import Training
from pipelines.classify.settings import TrainSettings
from pipelines.crossval.crossval import crossval, samples_of
from pipelines.crossval.evaluation import Examples
from pipelines.crossval.results import ChannelImportance, CrossvalReport
from pipelines.crossval.settings import RecipeSettings
from pipelines.crossval.splits import Samples, folds_of
from pipelines.models.champion import scope_of
from pipelines.models.novelty_file import NOVELTY_FILE, novelty_bytes
from pipelines.models.recipes import WindowPipeline
from pipelines.models.results import ModelInfo
from pipelines.reporting.json_file import as_json
from pipelines.reporting.progress import Progress, silent
from pipelines.runs.datasets import data_digest
from pipelines.streaming.window_feed import ESTIMATED
from terrain import __version__
from terrain.errors import DataError
from terrain.records import RunLog, Windows

METRICS = ("accuracy", "balanced_accuracy", "macro_f1", "vote_accuracy", "ece")


def train(
    runs: Sequence[RunLog],
    settings: TrainSettings,
    dataset: str,
    progress: Progress = silent,
    evaluation: CrossvalReport | None = None,
) -> Training:
    """Evaluate, fit, track and register a recipe.

    Parameters
    ----------
    runs : labelled runs
    settings : recipe, windows, seed, and the name of the registered model
    dataset : name of the data set, for the record
    progress : called as the work goes on
    evaluation : result of ``crossval`` with the same settings, where there is one already

    Raises
    ------
    TerrainError
        if the data do not suffice or the tracking folder cannot be written.
    """
    from pipelines.classify.judging import held_out_runs, judge_of, standing_of, standing_tags
    from pipelines.crossval_figures.figures import all_figures
    from pipelines.models.onnx_file import require_onnx
    from pipelines.models.tracking import TrainingRecord, code_commit, ensure_tracking, log_training

    if settings.recipe != "svm":
        require_onnx()
    ensure_tracking()
    report = crossval(runs, settings.evaluation, progress) if evaluation is None else evaluation
    report = report.named(dataset, data_digest(runs))
    samples = samples_of(runs, settings.evaluation)
    windows = samples.cut.windows
    recipe = settings.new_recipe().fit(windows, windows.terrain.astype(str))
    progress("fit on all runs", 1, 1)
    importance = _importance(recipe, samples, settings, progress)
    limits = limits_of(
        recipe[-1], recipe.matrix, windows, samples.group, settings.rule.overlap, settings.seed
    )
    report = replace(report, notes=(*report.notes, *limits.notes))
    chosen = recipe[-1].best_._asdict()
    metrics = _metrics(report)
    digests = {run.run_id: data_digest([run]) for run in runs}
    info = replace(
        model_info(runs, settings, windows, dataset, code_commit()),
        evaluation=metrics,
        run_accuracy={digests[k]: each.accuracy for k, each in held_out_runs(samples, report).items()},
        support=None if limits.support is None else limits.support.as_json(),
        conformal=limits.conformal,
    )
    standing = standing_of(info, report)
    record = TrainingRecord(
        _params(settings, report, len(windows), dataset, chosen),
        metrics,
        standing_tags(standing, scope_of(info)),
        {"crossval.json": as_json(report), "importance.json": {"channels": as_json(importance)}},
        all_figures(report, importance),
        {} if limits.novelty is None else {NOVELTY_FILE: novelty_bytes(limits.novelty)},
    )
    card = model_card(settings.name, info, windows, report, chosen)
    registered = log_training(
        settings.name,
        recipe,
        windows,
        info,
        record,
        judge_of(runs, samples, report, standing, settings.seed),
        lambda folder: written(card, folder, windows[0]).texts(),
    )
    return Training(
        registered=registered,
        dataset=dataset,
        data_digest=info.data_digest,
        commit=info.commit,
        n_windows=len(windows),
        chosen=chosen,
        importance=importance,
        crossval=report,
    )


def _importance(
    recipe: WindowPipeline, samples: Samples, settings: TrainSettings, progress: Progress
) -> tuple[ChannelImportance, ...]:
    windows = samples.cut.windows
    return channel_importance(
        clone(recipe[-1]),
        Examples(recipe[:-1].transform(windows), windows.terrain.astype(str), samples.group),
        list(recipe[0].get_feature_names_out()),
        folds_of(samples, "grouped", 1, settings.seed),
        settings.seed,
        settings.jobs,
        progress,
    )


def _metrics(report: CrossvalReport) -> dict[str, float]:
    metrics: dict[str, float] = {name: getattr(report, name) for name in METRICS}
    if report.extras is not None and report.extras.speed_only_accuracy is not None:
        metrics["speed_only_accuracy"] = report.extras.speed_only_accuracy
    return metrics


def _params(
    settings: TrainSettings, report: CrossvalReport, n_windows: int, dataset: str, chosen: Mapping[str, Any]
) -> dict[str, Any]:
    rule = settings.rule
    return {
        "recipe": settings.recipe,
        "window_s": rule.length_s,
        "stride_s": rule.step_s,
        "steady": rule.steady is not None,
        "seed": settings.seed,
        "skip_short": settings.skip_short,
        "signal_sets": ",".join(settings.signal_sets),
        "repeats": report.repeats,
        "n_windows": n_windows,
        "n_runs": report.n_runs,
        "dataset": dataset,
        **{f"chosen_{key}": value for key, value in chosen.items()},
    }


def model_info(
    runs: Sequence[RunLog], settings: RecipeSettings, windows: Windows, dataset: str, commit: str
) -> ModelInfo:
    """Return how the training windows were cut, as those of a new log must be, and where they came from.

    Raises
    ------
    DataError
        if the model uses estimates that several filters made.
    """
    rule = settings.rule
    filters = {run.filter for run in runs} if set(ESTIMATED) & set(windows.channels) else {""}
    if len(filters) > 1:
        names = " and ".join(sorted(name or "an unknown filter" for name in filters))
        raise DataError(f"the runs hold estimates of {names}: estimate all of them with one filter")
    classes, counts = np.unique(windows.terrain.astype(str), return_counts=True)
    return ModelInfo(
        classes=tuple(classes.tolist()),
        window_s=rule.length_s,
        stride_s=rule.stride_s,
        steady=rule.steady,
        channels={stream: tuple(names) for stream, names in windows.channels.items()},
        rate_hz=dict(windows.rate_hz),
        run_digests=tuple(data_digest([run]) for run in runs),
        recipe=settings.recipe,
        signal_sets=settings.signal_sets,
        seed=settings.seed,
        data_digest=data_digest(runs),
        dataset=dataset,
        commit=commit,
        package_version=__version__,
        robots=tuple(sorted({run.robot for run in runs})),
        filter=filters.pop(),
        class_ratio=dict(zip(classes.tolist(), (counts / counts.sum()).tolist(), strict=True)),
    )
