"""``terrain train``: evaluate a recipe on held-out runs, fit it on all of them, track and register it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipelines.classify.crossval import CrossvalSettings, crossval, samples_of
from pipelines.classify.importance import channel_importance
from pipelines.classify.splits import folds_of
from pipelines.reporting.progress import Progress, silent
from pipelines.runs.datasets import data_digest
from terrain import __version__
from terrain.errors import ConfigError
from terrain.records import RunLog, Windows

METRICS = ("accuracy", "balanced_accuracy", "macro_f1", "vote_accuracy", "ece", "speed_only_accuracy")


def train(
    runs: Sequence[RunLog],
    settings: CrossvalSettings,
    name: str,
    dataset: str,
    progress: Progress = silent,
    evaluation: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Evaluate, fit, track and register a recipe.

    Parameters
    ----------
    runs : labelled runs
    settings : recipe, windows and seed; the protocol must be ``grouped``
    name : name of the registered model
    dataset : name of the data set, for the record
    evaluation : result of ``crossval`` with the same settings, where it has been done already

    Returns
    -------
    dict that JSON can hold
        ``model_uri, version, run_id, alias_moved, alias_reason, crossval, importance, n_windows, chosen``.

    Raises
    ------
    ConfigError
        if the name cannot be one of a registered model.
    TerrainError
        if the data do not suffice or the tracking folder cannot be written.
    """
    from pipelines.classify.figures import all_figures
    from pipelines.models.tracking import code_commit, ensure_tracking, log_training

    if not name or set(name) & set("/:@. "):
        raise ConfigError(f"model name {name!r}: must not be empty nor hold any of / : @ . and blanks")
    if settings.protocol != "grouped":
        raise ConfigError(f"training is judged by the protocol 'grouped', not by {settings.protocol!r}")
    ensure_tracking()
    report = crossval(runs, settings, progress) if evaluation is None else evaluation
    samples = samples_of(runs, settings)
    windows = samples.cut.windows
    y = windows.terrain.astype(str)
    recipe = settings.new_recipe()
    progress("fit on all runs", 0, 1)
    recipe.fit(windows, y)
    progress("fit on all runs", 1, 1)
    importance = channel_importance(
        settings.new_recipe()[-1],
        recipe[:-1].transform(windows),
        list(recipe[0].get_feature_names_out()),
        y,
        samples.group,
        folds_of(samples, "grouped", 1, settings.seed),
        settings.seed,
        settings.jobs,
        progress,
    )
    rule = settings.rule
    chosen = recipe[-1].best_._asdict()
    info = model_info(runs, settings, windows, dataset, code_commit())
    params = {
        "recipe": settings.recipe,
        "window_s": rule.length_s,
        "stride_s": rule.step_s,
        "steady": rule.steady is not None,
        "seed": settings.seed,
        "skip_short": settings.skip_short,
        "signal_sets": ",".join(settings.signal_sets),
        "repeats": report["repeats"],
        "n_windows": len(windows),
        "n_runs": report["n_runs"],
        "dataset": dataset,
        **{f"chosen_{key}": value for key, value in chosen.items()},
    }
    registered = log_training(
        name,
        recipe,
        windows,
        info,
        params,
        {key: report[key] for key in METRICS if report.get(key) is not None},
        {"crossval.json": report, "importance.json": {"channels": importance}},
        all_figures({**report, "dataset": dataset}, importance),
    )
    return {
        **registered._asdict(),
        "dataset": dataset,
        "data_digest": info["data_digest"],
        "commit": info["commit"],
        "n_windows": len(windows),
        "chosen": chosen,
        "importance": importance,
        "crossval": report,
    }


def model_info(
    runs: Sequence[RunLog], settings: CrossvalSettings, windows: Windows, dataset: str, commit: str
) -> dict[str, Any]:
    """Return how the training windows were cut, as a new log must be, and where they came from."""
    rule = settings.rule
    return {
        "recipe": settings.recipe,
        "classes": [str(c) for c in np.unique(windows.terrain.astype(str))],
        "window_s": rule.length_s,
        "stride_s": rule.stride_s,
        "steady": dataclasses.asdict(rule.steady) if rule.steady is not None else None,
        "signal_sets": list(settings.signal_sets),
        "channels": {stream: list(names) for stream, names in windows.channels.items()},
        "rate_hz": dict(windows.rate_hz),
        "seed": settings.seed,
        "data_digest": data_digest(runs),
        "run_digests": [data_digest([run]) for run in runs],
        "dataset": dataset,
        "commit": commit,
        "package_version": __version__,
    }
