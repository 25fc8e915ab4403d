"""``terrain train``: evaluate a recipe on held-out runs, fit it on all of them, track and register it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import clone

from features.windows import Layout
from pipelines.classify.card import model_card, written
from pipelines.classify.importance import channel_importance
from pipelines.classify.limits import LimitData, limits_of
from pipelines.classify.results import Training
from pipelines.classify.settings import TrainSettings
from pipelines.classify.training_data import (
    RunIdentity,
    TrainingData,
    data_of_runs,
    data_of_store,
    identities,
)
from pipelines.crossval.crossval import crossval
from pipelines.crossval.evaluation import Examples
from pipelines.crossval.results import ChannelImportance, CrossvalReport
from pipelines.crossval.settings import FEATURE_RECIPE, RecipeSettings
from pipelines.crossval.splits import folds_of
from pipelines.data.datasets import data_digest
from pipelines.feature_store.crossval import crossval_stored, refuse_recipe
from pipelines.feature_store.store import FeatureStore, read_store
from pipelines.learn.model_file import ModelInfo, TerrainModel, seal, write_model
from pipelines.live.windows import ESTIMATED
from pipelines.models.champion import scope_of
from pipelines.reporting.json_file import as_json
from pipelines.reporting.progress import Progress, silent
from terrain import __version__
from terrain.errors import DataError
from terrain.records import Array, RunLog, Windows

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
    from pipelines.learn.network_onnx import require_onnx
    from pipelines.learn.tracking import ensure_tracking

    if settings.recipe != FEATURE_RECIPE:
        require_onnx()
    ensure_tracking()
    report = crossval(runs, settings.evaluation, progress) if evaluation is None else evaluation
    return _train(data_of_runs(runs, settings), report, settings, dataset, progress)


def train_store(
    store: FeatureStore, settings: TrainSettings, dataset: str, progress: Progress = silent
) -> Training:
    """Evaluate, fit, track and register a recipe of features on a store; the model is that of its runs.

    Only the digest of the data differs, and where the champion needs samples to be judged on new runs.

    Parameters
    ----------
    store : of labelled windows
    settings, dataset, progress : as :func:`train`

    Raises
    ------
    ConfigError
        if the recipe needs samples.
    TerrainError
        if the store is damaged, its data do not suffice, or the tracking folder cannot be written.
    """
    from pipelines.learn.tracking import ensure_tracking

    refuse_recipe(settings)
    ensure_tracking()
    stored = read_store(store, progress)
    report = crossval_stored(stored, settings.evaluation, store.repaired, progress)
    return _train(data_of_store(store, stored, settings), report, settings, dataset, progress)


def _train(
    data: TrainingData, report: CrossvalReport, settings: TrainSettings, dataset: str, progress: Progress
) -> Training:
    """Fit a recipe that was evaluated, find its limits, and track and register it."""
    from pipelines.classify.judging import held_out_runs, judge_of, standing_of, standing_tags
    from pipelines.crossval_figures.figures import all_figures
    from pipelines.learn.tracking import TrainingRecord, _png, code_commit, log_training

    report = report.named(dataset, data.digest)
    recipe = data.fitted()
    progress("fit on all runs", 1, 1)
    importance = _importance(data, settings, progress)
    limit_data = LimitData(data.features, data.terrain, data.samples.group.astype(str), data.motion)
    limits = limits_of(recipe[-1], limit_data, settings.rule.overlap, settings.seed)
    report = replace(report, notes=(*report.notes, *limits.notes))
    chosen = recipe[-1].best_._asdict()
    metrics = _metrics(report)
    digests = {run.run_id: run.digest for run in data.runs}
    held_out = held_out_runs(data.samples, report)
    info = replace(
        info_of(data, settings, dataset, code_commit()),
        evaluation=metrics,
        run_accuracy={digests[run_id]: each.accuracy for run_id, each in held_out.items()},
        support=None if limits.support is None else limits.support.as_json(),
        conformal=limits.conformal,
    )
    standing = standing_of(info, report)
    record = TrainingRecord(
        _params(settings, report, len(data), dataset, chosen),
        metrics,
        standing_tags(standing, scope_of(info)),
        (),
        {"crossval.json": as_json(report), "importance.json": {"channels": as_json(importance)}},
        {f"figures/{key}.png": _png(figure) for key, figure in all_figures(report, importance).items()},
    )
    card = model_card(settings.name, info, data.samples.cut.windows, data.motion, report, chosen)
    with TemporaryDirectory() as place:
        folder = Path(place)
        write_model(folder, TerrainModel(recipe, info, limits.novelty, limits.support))
        for name, text in written(card, folder).texts().items():
            (folder / name).write_text(text, encoding="utf-8")
        seal(folder, info)
        judge = judge_of(data, report, standing, settings.seed)
        registered = log_training(settings.name, folder, record, judge)
    return Training(
        registered=registered,
        dataset=dataset,
        data_digest=info.data_digest,
        commit=info.commit,
        n_windows=len(data),
        chosen=chosen,
        importance=importance,
        crossval=report,
    )


def _importance(
    data: TrainingData, settings: TrainSettings, progress: Progress
) -> tuple[ChannelImportance, ...]:
    return channel_importance(
        clone(data.recipe[-1]),
        Examples(data.rows, data.terrain, data.samples.group),
        list(data.recipe[0].get_feature_names_out()),
        folds_of(data.samples, "grouped", 1, settings.seed),
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
    layout = Layout(windows.channels, windows.rate_hz)
    where = _Origin(identities(runs), data_digest(runs), dataset, commit)
    return _info(layout, windows.terrain.astype(str), settings, where)


def info_of(data: TrainingData, settings: RecipeSettings, dataset: str, commit: str) -> ModelInfo:
    """Return the same of data that are runs or a store; errors as :func:`model_info`."""
    return _info(data.layout, data.terrain, settings, _Origin(data.runs, data.digest, dataset, commit))


class _Origin(NamedTuple):
    """Where a model comes from."""

    runs: tuple[RunIdentity, ...]
    data_digest: str
    dataset: str
    commit: str


def _info(layout: Layout, terrain: Array, settings: RecipeSettings, origin: _Origin) -> ModelInfo:
    rule, runs = settings.rule, origin.runs
    filters = {run.filter for run in runs} if set(ESTIMATED) & set(layout.channels) else {""}
    if len(filters) > 1:
        names = " and ".join(sorted(name or "an unknown filter" for name in filters))
        raise DataError(f"the runs hold estimates of {names}: estimate all of them with one filter")
    classes, counts = np.unique(terrain, return_counts=True)
    return ModelInfo(
        classes=tuple(classes.tolist()),
        window_s=rule.length_s,
        stride_s=rule.stride_s,
        steady=rule.steady,
        channels={stream: tuple(names) for stream, names in layout.channels.items()},
        rate_hz=dict(layout.rate_hz),
        run_digests=tuple(run.digest for run in runs),
        recipe=settings.recipe,
        signal_sets=settings.signal_sets,
        seed=settings.seed,
        data_digest=origin.data_digest,
        dataset=origin.dataset,
        commit=origin.commit,
        package_version=__version__,
        robots=tuple(sorted({run.robot for run in runs})),
        filter=filters.pop(),
        class_ratio=dict(zip(classes.tolist(), (counts / counts.sum()).tolist(), strict=True)),
    )
