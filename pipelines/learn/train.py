"""Train: evaluate a recipe on held-out runs, fit it on all of them, track it in MLflow and register it.

``--search`` looks for hyper-parameters before; ``--register`` registers a model that was kept in a folder where
the tracking server had stopped.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Self

from pydantic import model_validator

from pipelines.data.datasets import load
from pipelines.data.settings import AlignedRunsSettings
from pipelines.learn.parallel import ComputeSettings
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.tracking import Registered
from pipelines.report.numbers import format_value, plural
from pipelines.report.results import Progress, as_json, described, silent
from pipelines.report.settings import setting
from pipelines.report.tree import Report, Section, Text
from terrain.errors import ConfigError

if TYPE_CHECKING:
    from pipelines.learn.card import ModelResult
    from pipelines.learn.evaluation import CrossvalResult
    from pipelines.learn.search import SearchResult
    from pipelines.learn.training_data import TrainingData
    from terrain.classify.held_out import ChannelImportance

EXAMPLE = "terrain train --data runs/ --name field"

NETWORKS = ("cnn", "stack", "best")
"""Recipes whose fits take a minute: by default they are evaluated by one fold assignment, the SVM by five."""

PERCENT = ".1%"

PARAMS = ("recipe", "window_s", "stride_s", "steady", "seed", "repeats", "n_windows", "n_runs", "dataset")
"""What MLflow has of the evaluation's settings and counts as parameters."""


class TrainingSettings(RecipeSettings):
    """Training: what is trained, and under which name it is registered."""

    name: str = setting(..., "Name of the registered model.")
    out: Path | None = setting(None, "Folder of the model, beside MLflow.")
    search: int = setting(0, ge=0, le=10_000)
    """Candidates of the SVM's hyper-parameters that are tried before."""
    trials: Path | None = setting(None, "Folder of the search (search-NAME); one that lies there goes on.")
    kept: Path | None = setting(None, option="--register")
    """Folder of a trained model that is registered, in place of training."""

    @model_validator(mode="after")
    def _check_training(self) -> Self:
        if not self.name or set(self.name) & set("/:@. "):
            raise ConfigError(
                f"model name {self.name!r}: must not be empty nor hold any of / : @ . and blanks"
            )
        if self.search:
            self.require_features("--search")
        if self.search and self.params is not None:
            raise ConfigError("--search and --params do not go together: search, or use what was found")
        return self


class Settings(TrainingSettings, AlignedRunsSettings, ComputeSettings):
    """What is trained, on which runs."""

    data: Path = setting(None, "Folder of runs in any readable layout, or an MCAP file.")

    @model_validator(mode="after")
    def _check_data(self) -> Self:
        if (self.data is None) == (self.kept is None):
            raise ConfigError(
                "--data is missing" if self.data is None else "--register trains nothing on --data"
            )
        return self


class TrainResult(Registered, kw_only=True):
    """A trained and registered model, and the evaluation that it is judged by.

    ``ui``, what shows the store, and ``card`` are shown and not in JSON.
    """

    dataset: str = described("name of the data")
    data_digest: str = described("digest of the runs")
    commit: str = described("of the code")
    n_windows: int = described("windows that it was fitted on")
    chosen: Mapping[str, Any] = described("hyper-parameters that inner folds chose")
    importance: tuple[ChannelImportance, ...] = described("what each channel is worth on held-out runs")
    crossval: CrossvalResult = described("evaluation on held-out runs")
    skipped: tuple[str, ...] | None = described("runs that a repairing reader had to skip", optional=True)
    search: SearchResult | None = described("of hyper-parameters", optional=True)
    ui: str = ""
    card: ModelResult | None = None

    def as_json(self) -> Any:
        """Return all described fields; what they say of the data, the evaluation says no more."""
        evaluation = replace(self.crossval, dataset=None, data_digest=None, skipped=None)
        return super(TrainResult, replace(self, crossval=evaluation)).as_json()

    def records(self) -> Iterable[Any]:
        """Return precision, recall and F1 of each terrain on held-out runs."""
        return self.crossval.records()


def run(settings: Settings, progress: Progress = silent) -> Registered:
    """Read runs, or their cached features, train and register; or register a folder; errors as :func:`train`."""
    from pipelines.data.tracking import ensure_tracking
    from pipelines.learn.parallel import computing
    from pipelines.learn.tracking import log_training
    from pipelines.learn.training_data import data_of_runs

    ensure_tracking()
    if settings.kept is not None:
        return log_training(settings.name, settings.kept)
    asked = settings.with_(skip_short=settings.repair)
    with computing(settings.compute):
        if settings.cache is None:
            runs, skipped, doubts = load(settings)
            data = data_of_runs(runs, asked)
        else:
            from pipelines.learn.cache import cached_data, loaders_of

            data, skipped, doubts = cached_data(loaders_of(settings), asked, settings.cache, progress)
        found = train(data, asked, settings.dataset, progress)
    return replace(found, skipped=tuple(skipped)).with_doubts(doubts)


def train(
    data: TrainingData, settings: TrainingSettings, dataset: str, progress: Progress = silent
) -> TrainResult:
    """Evaluate a recipe, fit it, find its limits, and track and register it.

    The fits of the evaluation's first fold assignment also tell what each channel is worth.

    Parameters
    ----------
    data : labelled windows, as :func:`pipelines.learn.training_data.data_of_runs` makes them of runs
    settings : that the data were made with, and the name of the registered model
    dataset : name of the data set, for the record
    progress : called as the work goes on

    Raises
    ------
    TerrainError
        if the data do not suffice, the model could not be stored, or the tracking store fails; a model that
        was trained by then is kept in a folder, which the message names.
    """
    import numpy as np

    from pipelines.data.tracking import TrackingError, code_commit, ui_line
    from pipelines.learn.card import TrainingRecord, limits_of, write_training
    from pipelines.learn.champion import run_accuracies
    from pipelines.learn.evaluate import evaluate_recipe
    from pipelines.learn.model_file import write_model
    from pipelines.learn.rates import at_lower_rates, least_rates
    from pipelines.learn.tracking import log_training
    from pipelines.learn.training_data import info_of, with_limits
    from pipelines.learn.trust import remember
    from pipelines.report.drawing import figure_png
    from pipelines.report.tree import figures_of
    from pipelines.report.versions import versions
    from terrain.classify.held_out import channel_importance, channel_of

    _check_storable(data)
    searched, notes = None, []
    if settings.search:
        from pipelines.learn.search import search

        folder = settings.trials or Path(f"search-{settings.name}")
        searched = search(data, settings.search, folder, settings.seed, settings.jobs, progress)
        data.recipe[-1].set_params(candidates=(searched.best.params,))
        default, best = (format_value(value, PERCENT) for value in searched.held_out[:2])
        notes.append(
            "hyper-parameters were searched on these runs, which makes the accuracy optimistic: on "
            f"{plural(len(searched.held_out_runs), 'run')} that no trial saw it is {best}, by the default "
            f"choice {default}"
        )
    recipe, samples = data.recipe, data.samples
    channels = [channel_of(str(name)) for name in recipe[0].get_feature_names_out()]
    network = settings.recipe.partition("@")[0] in NETWORKS
    asked = settings.with_(repeats=1) if network and settings.repeats is None else settings
    computed, tried = (data.rows, data.motion), list(at_lower_rates(recipe, samples.windows))
    evaluation, held_out = evaluate_recipe(
        recipe, settings.recipe, samples, asked, progress, computed, channels, [each.rows for each in tried]
    )
    answers = [(each.fold.test, *each.found) for each in held_out.results if each.found is not None]
    importance = channel_importance(channels, [drops for _, drops, _ in answers])
    rows = np.concatenate([test for test, _, _ in answers])
    lower_right = np.concatenate([right for _, _, right in answers], axis=1)
    least_hz = least_rates(tried, held_out.correct[0][rows], lower_right, samples.unit[rows])
    recipe.steps[-1] = (recipe.steps[-1][0], held_out.fitted)
    refusals = evaluation.refusals
    known = None if refusals is None else (refusals.refused, *refusals.refused_ci)
    info = replace(
        info_of(data, settings, dataset),
        commit=code_commit(),
        run_accuracy=run_accuracies(data, evaluation),
        least_rate_hz=least_hz,
        known_refused=None if known is None or np.isnan(known).any() else known,
    )
    model, missing = with_limits(recipe, info, samples, data.features, data.motion)
    evaluation = replace(
        evaluation, dataset=dataset, data_digest=data.digest, notes=(*evaluation.notes, *missing, *notes)
    )
    record = TrainingRecord(
        params={name: getattr(evaluation, name) for name in PARAMS}
        | {"skip_short": settings.skip_short, "signal_sets": ",".join(settings.signal_sets)},
        runs=data.runs,
        evaluation=evaluation,
        importance=importance,
        chosen=as_json(getattr(held_out.fitted, "best_", {})),
        limits=limits_of(model.info, samples.windows, data.motion, evaluation),
        versions=versions(),
    )
    drawn = enumerate(figures_of(evaluation.report), start=1)
    pictures = {f"figures/{place}.png": figure_png(figure) for place, figure in drawn}
    with TemporaryDirectory() as place:
        folder = settings.out or Path(place)
        remember(write_model(folder, model))
        card = write_training(folder, settings.name, record)
        try:
            registered = log_training(settings.name, folder, data, pictures)
        except TrackingError as error:
            not_registered = Path(f"{settings.name}-not-registered")
            kept = settings.out or shutil.copytree(folder, not_registered, dirs_exist_ok=True)
            raise TrackingError(
                f"{error}; the model is kept in {kept}: register it by "
                f"terrain train --register {kept} --name {settings.name}"
            ) from error
    return TrainResult.of(
        registered,
        model.info,
        record,
        n_windows=len(samples.windows),
        crossval=evaluation,
        search=searched,
        ui=ui_line(),
        card=card,
    )


def _check_storable(data: TrainingData) -> None:
    """Refuse what could not be stored before the work; what is a user's own by a fit on a few windows."""
    import numpy as np
    from sklearn.base import clone

    from pipelines.learn.model_file import packed
    from pipelines.learn.trust import remember
    from terrain.classify.grouped import OwnClassifier
    from terrain.classify.network import GroupedNetwork, require_onnx
    from terrain.classify.stack import GroupedStack

    _, needed = packed(list(getattr(data.recipe[0], "functions", ())))
    own = data.recipe[-1]
    if isinstance(own, GroupedNetwork) or (isinstance(own, GroupedStack) and not own.choose):
        require_onnx()
    if isinstance(own, OwnClassifier):
        terrain = data.samples.terrain
        rows = np.concatenate([np.flatnonzero(terrain == name)[:20] for name in np.unique(terrain)])
        needed += packed(clone(own.estimator).fit(np.nan_to_num(data.rows[rows]), terrain[rows]))[1]
    remember(needed)


def report(result: TrainResult) -> Report:
    """Return where the model is, and its card: how good it is on held-out runs, and what it is not for."""
    assert result.card is not None
    card, parts = result.card.report, [Text(f"tracked, to be seen by: {result.ui}")]
    if result.search is not None:
        n_trials, file = result.search.trials, result.search.params_file
        parts.append(Text(f"hyper-parameters of {n_trials} trials, to be used again by --params {file}"))
    return replace(
        card,
        title=f"Training on {result.dataset}",
        answer=f"{result.verdict}; {card.answer}",
        parts=[*card.parts[:1], *parts, *(Text(text, "note") for text in result.crossval.notes[:3])],
        details=[Section("Limits", card.parts[1:]), *card.details],
        next_step=f"terrain predict --data runs/ --model {result.model_uri}",
    )
