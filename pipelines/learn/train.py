"""Train: evaluate a recipe on held-out runs, fit it on all of them, track it in MLflow and register it.

``--search`` looks for hyper-parameters before; ``--register`` registers a model that was kept in a folder where
the tracking server had stopped.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from pydantic import model_validator

from pipelines.data.settings import AlignedRunsSettings, load
from pipelines.learn.parallel import ComputeSettings
from pipelines.learn.settings import FEATURE_RECIPE, RecipeSettings
from pipelines.report import (
    Column,
    Pairs,
    Part,
    Progress,
    Report,
    Result,
    Section,
    Table,
    Text,
    described,
    format_value,
    interval,
    plural,
    silent,
)
from pipelines.report.settings import setting
from terrain.errors import ConfigError, DataError

if TYPE_CHECKING:
    import pandas as pd

    from features.windows import Layout
    from pipelines.learn.evaluate import Examples
    from pipelines.learn.evaluation import CrossvalResult
    from pipelines.learn.model_file import ModelInfo, TerrainModel
    from pipelines.learn.protocols import Fold
    from pipelines.learn.search import SearchResult
    from pipelines.learn.tracking import Registered, TrainingRecord
    from pipelines.learn.training_data import RunIdentity, TrainingData
    from terrain.classify.novelty_numbers import NoveltyNumbers
    from terrain.classify.support import SupportTable
    from terrain.records import Array, RunLog, Windows

EXAMPLE = "terrain train --data runs/ --name field"

NETWORKS = ("cnn", "stack", "best")
"""Recipes whose fits take a minute: by default they are evaluated by one fold assignment, the SVM by five."""

METRICS = ("accuracy", "balanced_accuracy", "macro_f1", "vote_accuracy", "ece")
N_PERMUTATIONS = 3
MAX_CHANNELS = 6
PERCENT = ".1%"


class TrainingSettings(RecipeSettings):
    """Training: what is trained, and under which name it is registered."""

    name: str = setting(..., "Name of the registered model.")
    out: Path | None = setting(None, "Folder of the model, beside MLflow.")
    cache: Path | None = setting(None, "Folder of cached features; one that was interrupted goes on.")
    search: int = setting(
        0, "Candidates of the SVM's hyper-parameters that are tried before.", ge=0, le=10_000
    )
    trials: Path | None = setting(None, "Folder of the search (search-NAME); one that lies there goes on.")
    kept: Path | None = setting(
        None, "Folder of a trained model that is registered, in place of training.", "--register"
    )

    @model_validator(mode="after")
    def _check_training(self) -> Self:
        if not self.name or set(self.name) & set("/:@. "):
            raise ConfigError(
                f"model name {self.name!r}: must not be empty nor hold any of / : @ . and blanks"
            )
        for option, used in (("--search", self.search), ("--cache", self.cache)):
            if used and (self.recipe.partition("@")[0] != FEATURE_RECIPE or self.feature):
                raise ConfigError(
                    f"{option} is for recipe {FEATURE_RECIPE!r} on the package's own features, not for "
                    f"{self.recipe!r}{' with --feature' if self.feature else ''}"
                )
        if self.search and self.params is not None:
            raise ConfigError("--search and --params do not go together: search, or use what was found")
        if self.cache is not None and self.merge_duplicates:
            raise ConfigError("--cache keeps each run by itself: it does not go with --merge-duplicates")
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


class ChannelImportance(NamedTuple):
    """By how much balanced accuracy drops when a channel is shuffled; ``std`` over folds."""

    feature: str
    drop: float
    std: float


@dataclass(frozen=True, repr=False)
class TrainResult(Result):
    """A trained and registered model, and the evaluation that it is judged by."""

    model_uri: str = described("of the registered version")
    version: str = described("its number")
    run_id: str = described("of the run in MLflow")
    alias_moved: bool = described("whether it is the champion now")
    alias_reason: str = described("why, or why not")
    dataset: str = described("name of the data")
    data_digest: str = described("digest of the runs")
    commit: str = described("of the code")
    n_windows: int = described("windows that it was fitted on")
    chosen: Mapping[str, Any] = described("hyper-parameters that inner folds chose")
    importance: tuple[ChannelImportance, ...] = described("what each channel is worth on held-out runs")
    crossval: CrossvalResult = described("evaluation on held-out runs")
    skipped: tuple[str, ...] | None = described("runs that a repairing reader had to skip", default=None)
    search: SearchResult | None = described("of hyper-parameters; None without one", default=None)
    ui: str = described("what shows the store; not in JSON", default="")

    def as_json(self) -> Any:
        """Return all fields but those that are not known."""
        shown = replace(self, crossval=replace(self.crossval, dataset=None, data_digest=None, skipped=None))
        return {
            name: value
            for name, value in Result.as_json(shown).items()
            if name != "ui" and not (name in ("skipped", "search") and value is None)
        }

    def to_pandas(self) -> pd.DataFrame:
        """Return precision, recall and F1 of each terrain on held-out runs."""
        return self.crossval.to_pandas()


@dataclass(frozen=True, repr=False)
class RegisterResult(Result):
    """A model that was kept in a folder, and is registered now."""

    model_uri: str = described("of the registered version")
    version: str = described("its number")
    run_id: str = described("of the run in MLflow")
    alias_moved: bool = described("whether it is the champion now")
    alias_reason: str = described("why, or why not")
    folder: str = described("that the model lay in")


def run(settings: Settings, progress: Progress = silent) -> TrainResult | RegisterResult:
    """Read runs, or their cached features, train and register; or register a folder.

    Raises
    ------
    TerrainError
        if a setting is not accepted, the data do not suffice, or the tracking store fails; a model that was
        trained by then is kept in a folder, which the message names.
    """
    from pipelines.learn.parallel import computing

    if settings.kept is not None:
        return register(settings.kept, settings.name)
    with computing(settings.compute):
        if settings.cache is None:
            runs, skipped = load(settings)
            found = train(runs, settings.with_(skip_short=settings.repair), settings.dataset, progress)
            return replace(found, skipped=tuple(skipped))
        from pipelines.data.tracking import ensure_tracking
        from pipelines.learn.cache import cached_features, loaders_of
        from pipelines.learn.training_data import data_of_cache

        ensure_tracking()
        cached = cached_features(
            loaders_of(settings),
            settings.rule,
            settings.signal_sets,
            settings.cache,
            settings.jobs,
            progress,
            settings,
        )
        found = train_on(data_of_cache(cached, settings), settings, settings.dataset, progress)
        return replace(found, skipped=cached.skipped)


def train(
    runs: Sequence[RunLog],
    settings: TrainingSettings,
    dataset: str,
    progress: Progress = silent,
    evaluation: CrossvalResult | None = None,
) -> TrainResult:
    """Evaluate, fit, track and register a recipe.

    Parameters
    ----------
    runs : labelled runs
    settings : recipe, windows, seed, and the name of the registered model
    dataset : name of the data set, for the record
    progress : called as the work goes on
    evaluation : on the same runs with the same settings, where there is one already

    Raises
    ------
    TerrainError
        if the data do not suffice or the tracking folder cannot be written.
    """
    from pipelines.data.tracking import ensure_tracking
    from pipelines.learn.network_onnx import require_onnx
    from pipelines.learn.training_data import data_of_runs

    if settings.recipe.partition("@")[0] in NETWORKS:
        require_onnx()
    ensure_tracking()
    return train_on(data_of_runs(runs, settings), settings, dataset, progress, evaluation)


def train_on(
    data: TrainingData,
    settings: TrainingSettings,
    dataset: str,
    progress: Progress = silent,
    evaluation: CrossvalResult | None = None,
) -> TrainResult:
    """Evaluate a recipe, fit it, find its limits, and track and register it; parameters as :func:`train`.

    The fits of the evaluation's first fold assignment also tell what each channel is worth.
    """
    from pipelines.data.tracking import code_commit, ui_line
    from pipelines.learn.card import model_card, write_card
    from pipelines.learn.champion import held_out_runs, judge_of, standing_of, standing_tags
    from pipelines.learn.model_file import TRAINING_FILE, TerrainModel, write_model
    from pipelines.report.json_file import as_json
    from terrain.files.atomic import atomic_write

    _check_storable(data)
    searched = None
    if settings.search:
        from pipelines.learn.search import search
        from terrain.classify.svm import Candidate

        folder = settings.trials or Path(f"search-{settings.name}")
        searched = search(data, settings.search, folder, settings.seed, settings.jobs, progress)
        data.recipe[-1].set_params(candidates=(Candidate(*searched.best.params),))
    evaluation, importance, fitted = _evaluated(data, settings, evaluation, progress)
    evaluation = replace(evaluation, dataset=dataset, data_digest=data.digest)
    recipe = data.with_fitted(fitted)
    limits = _limits(recipe[-1], data, settings.rule.overlap, settings.seed)
    notes = (*evaluation.notes, *limits.notes, *_search_notes(searched))
    evaluation = replace(evaluation, notes=notes)
    best = getattr(recipe[-1], "best_", None)
    chosen = {} if best is None else best._asdict()
    digests = {each.run_id: each.digest for each in data.runs}
    held_out = held_out_runs(data.samples, evaluation)
    info = replace(
        info_of(data, settings, dataset, code_commit()),
        evaluation=_metrics(evaluation),
        run_accuracy={digests[run_id]: each.accuracy for run_id, each in held_out.items()},
        support=None if limits.support is None else limits.support.as_json(),
        conformal=limits.conformal,
    )
    standing = standing_of(info, evaluation)
    record = _record(data, settings, evaluation, importance, chosen, standing_tags(standing), info)
    judge = judge_of(data, evaluation, standing, settings.seed)
    card = model_card(settings.name, info, data.samples.windows, data.motion, evaluation, chosen)
    with TemporaryDirectory() as place:
        folder = Path(place)
        write_model(folder, TerrainModel(recipe, info, limits.novelty, limits.support))
        atomic_write(folder / TRAINING_FILE, record.as_text())
        write_card(folder, card, info)
        if settings.out is not None:
            _keep(folder, settings.out)
        registered = _registered(settings, folder, record, judge)
    return TrainResult(
        *registered,
        dataset=dataset,
        data_digest=info.data_digest,
        commit=info.commit,
        n_windows=len(data),
        chosen=as_json(chosen),
        importance=importance,
        crossval=evaluation,
        search=searched,
        ui=ui_line(),
    )


def register(folder: Path, name: str) -> RegisterResult:
    """Register a model that was kept in a folder when the tracking server had stopped.

    It becomes champion where there is none, or where it is better on the same data; on other data the two
    cannot be compared any more.

    Raises
    ------
    ModelError
        if there is no model, or it was not trained by ``train``.
    TerrainError
        if the tracking store fails again.
    """
    from pipelines.data.tracking import ensure_tracking
    from pipelines.learn.champion import judge_of_record
    from pipelines.learn.model_file import TRAINING_FILE, read_files
    from pipelines.learn.tracking import TrainingRecord, log_training
    from terrain.errors import ModelError

    info, contents = read_files(folder)
    if TRAINING_FILE not in contents:
        raise ModelError(
            f"{folder}: holds a model that was not evaluated, which only terrain train registers"
        )
    record = TrainingRecord.of_text(contents[TRAINING_FILE], folder / TRAINING_FILE)
    ensure_tracking()
    registered = log_training(name, folder, record, judge_of_record(info, record.tags))
    return RegisterResult(*registered, folder=str(folder))


def _check_storable(data: TrainingData) -> None:
    """Refuse a user's own classifier that could not be stored, before the work: by a fit on a few windows."""
    import numpy as np
    from sklearn.base import clone

    from pipelines.learn.model_file import check_storable
    from pipelines.learn.own import FunctionExtractor, OwnClassifier
    from terrain.errors import ModelError

    if isinstance(data.recipe[0], FunctionExtractor):
        raise ModelError("a model with features of your own cannot be stored: terrain crossval evaluates it")
    own = data.recipe[-1]
    if isinstance(own, OwnClassifier):
        terrain = data.samples.terrain
        rows = np.concatenate([np.flatnonzero(terrain == name)[:20] for name in np.unique(terrain)])
        check_storable(clone(own.estimator).fit(np.nan_to_num(data.rows[rows]), terrain[rows]))


def _registered(settings: TrainingSettings, folder: Path, record: TrainingRecord, judge: Any) -> Registered:
    """Register a model; where that fails, keep it in a folder and say how it is registered later."""
    from pipelines.data.tracking import TrackingError
    from pipelines.learn.tracking import log_training

    try:
        return log_training(settings.name, folder, record, judge)
    except TrackingError as error:
        kept = settings.out
        if kept is None:
            kept = Path(f"{settings.name}-not-registered")
            _keep(folder, kept)
        raise TrackingError(
            f"{error}; the model is kept in {kept}: register it by "
            f"terrain train --register {kept} --name {settings.name}"
        ) from error


def _keep(folder: Path, out: Path) -> None:
    """Copy a model's files into a folder, the manifest last."""
    from pipelines.learn.model_file import FILES, MANIFEST_FILE
    from terrain.files.atomic import atomic_write

    (out / MANIFEST_FILE).unlink(missing_ok=True)
    for name in (*FILES, MANIFEST_FILE):
        if (folder / name).is_file():
            atomic_write(out / name, (folder / name).read_bytes())
        else:
            (out / name).unlink(missing_ok=True)


def _evaluated(
    data: TrainingData, settings: TrainingSettings, evaluation: CrossvalResult | None, progress: Progress
) -> tuple[CrossvalResult, tuple[ChannelImportance, ...], Any]:
    """Return the evaluation on held-out runs, what each channel is worth, and the classifier fitted on all runs.

    One set of fits gives all three: channels are judged by those of the first repeat.
    """
    from pipelines.learn.evaluate import Examples, evaluate
    from pipelines.learn.evaluation import evaluate_recipe
    from pipelines.learn.protocols import folds_of
    from pipelines.learn.settings import EvaluationSettings

    channels = [channel_of(str(name)) for name in data.recipe[0].get_feature_names_out()]

    def ask(examples: Examples, fold: Fold) -> Any:
        if fold.repeat:
            return None
        test = fold.test
        return ChannelDrops(
            examples.features[test], examples.terrain[test], channels, settings.seed, fold.number
        )

    if evaluation is None:
        repeats = settings.repeats or (1 if settings.recipe.partition("@")[0] in NETWORKS else None)
        shared = settings.shared() | {"recipe": (settings.recipe,), "extras": False, "repeats": repeats}
        evaluation, held_out = evaluate_recipe(
            data.recipe,
            settings.recipe,
            data.samples,
            EvaluationSettings(**shared),
            progress,
            (data.rows, data.motion),
            ask,
        )
    else:
        examples = Examples(data.rows, data.samples.terrain, data.samples.group)
        folds = folds_of(data.samples, "grouped", 1, settings.seed)
        asks = [ask(examples, fold) for fold in folds]
        held_out = evaluate(data.recipe[-1], examples, folds, settings.jobs, "fits", progress, asks, True)
    drops = [each.found for each in held_out.results if each.found is not None]
    return evaluation, _importance(channels, drops), held_out.fitted


def channel_of(feature: str) -> str:
    """Return the stream and channel that a feature is made of.

    Examples
    --------
    >>> channel_of("imu.accel_z.std [m/s^2]"), channel_of("wheels.log_drive_effort [log10 A m/s]")
    ('imu.accel_z', 'wheels.log_drive_effort')
    >>> channel_of("imu.gyro_x~accel_y.correlation [1]"), channel_of("roughness")
    ('imu.correlations', 'roughness')
    """
    name = feature.partition(" [")[0]
    stream, separator, rest = name.partition(".")
    channel = rest.split(".")[0]
    return f"{stream}.correlations" if "~" in channel else f"{stream}{separator}{channel}"


class ChannelDrops(NamedTuple):
    """By how much balanced accuracy drops when all features of a channel are shuffled together.

    Shuffling a single feature hardly lowers it, since the features of a channel carry much the same
    information.  Called with the classifier of a fold, it returns a drop a channel, means over shuffles.

    Parameters
    ----------
    features, truth : (n, f) and (n,) of the windows that the fold holds out
    channels : (f,) channel of each feature
    seed, number : of the permutations, and of the fold
    """

    features: Array
    truth: Array
    channels: Sequence[str]
    seed: int
    number: int

    def __call__(self, fitted: Any, /) -> list[float]:
        """Return the drop of each channel, in the order of their names."""
        import numpy as np

        def balanced_accuracy(predicted: Array) -> float:
            return float(np.mean([np.mean(predicted[truth == name] == name) for name in np.unique(truth)]))

        present = np.isin(self.truth, fitted.classes_)
        test, truth = self.features[present], self.truth[present]
        baseline = balanced_accuracy(fitted.predict(test))
        rng = np.random.default_rng((self.seed, self.number))
        drops = []
        for channel in np.unique(np.array(self.channels)):
            columns = np.flatnonzero(np.array(self.channels) == channel)
            scores = []
            for _ in range(N_PERMUTATIONS):
                shuffled = test.copy()
                shuffled[:, columns] = test[rng.permutation(len(test))][:, columns]
                scores.append(balanced_accuracy(fitted.predict(shuffled)))
            drops.append(float(baseline - np.mean(scores)))
        return drops


def _importance(channels: Sequence[str], drops: Sequence[Sequence[float]]) -> tuple[ChannelImportance, ...]:
    """Return means and standard deviations over folds, the largest drop first."""
    import numpy as np

    table, names = np.array(drops), np.unique(np.array(channels))
    order = np.argsort(-table.mean(axis=0), kind="stable")
    return tuple(
        ChannelImportance(str(names[i]), float(table[:, i].mean()), float(table[:, i].std(ddof=1)))
        for i in order
    )


class Limits(NamedTuple):
    """What a trained model knows of its own limits, each None where the training runs do not give it.

    Parameters
    ----------
    novelty : score of windows that are like no terrain that was learned
    support : training runs by terrain and motion
    conformal : threshold of the sets of classes
    notes : why one is missing
    """

    novelty: NoveltyNumbers | None
    support: SupportTable | None
    conformal: float | None
    notes: tuple[str, ...]


def _limits(classifier: Any, data: TrainingData, gap: int, seed: int) -> Limits:
    import numpy as np

    from features.motion import NO_MOTION
    from pipelines.learn.coverage import table_of
    from terrain.classify.conformal import conformal_threshold, held_out_scores
    from terrain.classify.novelty import NoveltyScore

    terrain, run_id = data.samples.terrain, data.samples.group.astype(str)
    notes = []
    novelty = conformal = support = None
    try:
        novelty = NoveltyScore(gap=gap, seed=seed).fit(data.features, terrain, run_id).numbers_
    except DataError as error:
        notes.append(f"no window is ever called unknown: {error}")
    try:
        conformal = conformal_threshold(held_out_scores(classifier, terrain), run_id)
    except DataError as error:
        notes.append(f"no sets of terrains: {error}")
    if data.motion is None:
        notes.append(f"support: {NO_MOTION}")
    else:
        support = table_of(data.motion, terrain, run_id, np.unique(terrain).tolist())
    return Limits(novelty, support, conformal, tuple(notes))


def _search_notes(found: SearchResult | None) -> list[str]:
    if found is None:
        return []
    a, b = (format_value(value, PERCENT) for value in (found.held_out.a, found.held_out.b))
    return [
        "hyper-parameters were searched on these runs, which makes the accuracy optimistic: on "
        f"{plural(len(found.held_out_runs), 'run')} that no trial saw it is {b}, by the default choice {a}"
    ]


def _metrics(evaluation: CrossvalResult) -> dict[str, float]:
    metrics: dict[str, float] = {name: getattr(evaluation, name) for name in METRICS}
    if evaluation.speed_only_accuracy is not None:
        metrics["speed_only_accuracy"] = evaluation.speed_only_accuracy
    return metrics


def _record(
    data: TrainingData,
    settings: TrainingSettings,
    evaluation: CrossvalResult,
    importance: Sequence[ChannelImportance],
    chosen: Mapping[str, Any],
    tags: Mapping[str, str],
    info: ModelInfo,
) -> TrainingRecord:
    """Return what MLflow is given beside the model: figures by terrain among the metrics."""
    import numpy as np

    from pipelines.learn.tracking import RunRow, TrainingRecord
    from pipelines.report.drawing import figure_png
    from pipelines.report.json_file import as_json
    from pipelines.report.tree import figures_of

    rule, samples = settings.rule, data.samples
    of_terrain = {
        f"{figure}/{name}": float(getattr(row, figure))
        for name, row in evaluation.per_class.items()
        for figure in ("precision", "recall", "f1")
    }
    rows = []
    for each in data.runs:
        inside = samples.run_id == each.run_id
        terrains = ", ".join(np.unique(samples.terrain[inside]).tolist())
        rows.append(RunRow(each.run_id, each.robot, terrains, int(inside.sum()), each.digest))
    pictures = {
        f"figures/{place}.png": figure_png(figure)
        for place, figure in enumerate(figures_of(evaluation.report), start=1)
    }
    return TrainingRecord(
        {
            "recipe": settings.recipe,
            "window_s": rule.length_s,
            "stride_s": rule.step_s,
            "steady": rule.steady is not None,
            "seed": settings.seed,
            "skip_short": settings.skip_short,
            "signal_sets": ",".join(settings.signal_sets),
            "repeats": evaluation.repeats,
            "n_windows": len(data),
            "n_runs": evaluation.n_runs,
            "dataset": info.dataset,
            **{f"chosen_{key}": value for key, value in chosen.items()},
        },
        {**info.evaluation, **of_terrain},
        tags,
        tuple(rows),
        {"crossval.json": as_json(evaluation), "importance.json": {"channels": as_json(importance)}},
        pictures,
    )


def fitted_model(
    runs: Sequence[RunLog], settings: RecipeSettings | None = None, dataset: str = "", commit: str = ""
) -> TerrainModel:
    """Return a model that is fitted on labelled runs, without evaluation, limits and registration.

    Parameters
    ----------
    runs : labelled
    settings : recipe and windows; the defaults without
    dataset, commit : for the record

    Raises
    ------
    DataError
        if the data do not suffice, or the model uses estimates that several filters made.
    """
    from pipelines.learn.model_file import TerrainModel
    from pipelines.learn.protocols import samples_of
    from pipelines.learn.recipes import recipe_of

    settings = settings or RecipeSettings()
    windows = samples_of(runs, settings).windows
    info = model_info(runs, settings, windows, dataset, commit)
    return TerrainModel(recipe_of(settings, settings.recipe).fit(windows, windows.terrain.astype(str)), info)


def model_info(
    runs: Sequence[RunLog], settings: RecipeSettings, windows: Windows, dataset: str, commit: str
) -> ModelInfo:
    """Return how the training windows were cut, as those of a new log must be, and where they came from.

    Raises
    ------
    DataError
        if the model uses estimates that several filters made.
    """
    from features.windows import Layout
    from pipelines.data.datasets import data_digest
    from pipelines.learn.training_data import identities

    layout = Layout(windows.channels, windows.rate_hz)
    terrain = windows.terrain.astype(str)
    return _info(layout, terrain, settings, identities(runs), data_digest(runs), dataset, commit)


def info_of(data: TrainingData, settings: RecipeSettings, dataset: str, commit: str) -> ModelInfo:
    """Return the same of training data; errors as :func:`model_info`."""
    return _info(data.layout, data.samples.terrain, settings, data.runs, data.digest, dataset, commit)


def _info(
    layout: Layout,
    terrain: Array,
    settings: RecipeSettings,
    runs: Sequence[RunIdentity],
    digest: str,
    dataset: str,
    commit: str,
) -> ModelInfo:
    import numpy as np

    from pipelines.learn.model_file import ModelInfo
    from pipelines.live.windows import ESTIMATED
    from terrain import __version__

    filters = {each.filter for each in runs} if set(ESTIMATED) & set(layout.channels) else {""}
    if len(filters) > 1:
        names = " and ".join(sorted(name or "an unknown filter" for name in filters))
        raise DataError(f"the runs hold estimates of {names}: estimate all of them with one filter")
    classes, counts = np.unique(terrain, return_counts=True)
    rule = settings.rule
    return ModelInfo(
        classes=tuple(classes.tolist()),
        window_s=rule.length_s,
        stride_s=rule.stride_s,
        steady=rule.steady,
        channels={stream: tuple(names) for stream, names in layout.channels.items()},
        rate_hz=dict(layout.rate_hz),
        run_digests=tuple(each.digest for each in runs),
        recipe=settings.recipe,
        signal_sets=settings.signal_sets,
        seed=settings.seed,
        data_digest=digest,
        dataset=dataset,
        commit=commit,
        package_version=__version__,
        robots=tuple(sorted({each.robot for each in runs})),
        filter=filters.pop(),
        class_ratio=dict(zip(classes.tolist(), (counts / counts.sum()).tolist(), strict=True)),
    )


def report(result: TrainResult | RegisterResult) -> Report:
    """Return where the model is, how good it is on held-out runs, and what its channels are worth."""
    verdict = "champion" if result.alias_moved else "not champion"
    registered = f"{result.model_uri} is registered, {verdict}: {result.alias_reason}"
    if isinstance(result, RegisterResult):
        return Report(
            f"Model of {result.folder}",
            f"{registered}.",
            next_step=f"terrain inspect {result.model_uri}",
        )
    evaluated = result.crossval.report
    accuracy = format_value(result.crossval.accuracy, PERCENT)
    parts: list[Part] = [
        Pairs([("hyper-parameters", _chosen(result.chosen))]),
        Text(f"tracked, to be seen by: {result.ui}"),
    ]
    if result.search is not None:
        parts.append(
            Pairs([("searched", result.search.trials), ("use them", f"--params {result.search.params_file}")])
        )
    return Report(
        title=f"Training on {result.dataset}",
        answer=(
            f"{registered}; {accuracy} of windows of held-out runs classified correctly "
            f"({interval(*result.crossval.accuracy_ci, PERCENT)}, 95 % over runs)."
        ),
        lead=evaluated.lead,
        picture=evaluated.picture,
        parts=[*evaluated.parts[:1], *parts, *(Text(text, "note") for text in result.crossval.notes[:3])],
        details=[
            Section(
                "Channels",
                [
                    Table(
                        ("channel", Column("drop", PERCENT), Column("std over folds", PERCENT)),
                        result.importance,
                        note="By how much balanced accuracy on held-out runs drops when it is shuffled.",
                    )
                ],
            ),
            Section("Notes", [*evaluated.parts[1:]]),
            *evaluated.details,
        ],
        next_step=f"terrain predict --data runs/ --model {result.model_uri}",
    )


def _chosen(chosen: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {format_value(value)}" for name, value in chosen.items()) or "none"
