"""Evaluate recipes or models on held-out runs, one alone or several side by side.

A recipe is fitted anew on every fold, by default of whole runs; a model, on runs that it was not trained on,
as it is.  Several are compared on the same windows, with differences that are paired by run.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

from pydantic import field_validator, model_validator

from pipelines.data.settings import AlignedRunsSettings, load
from pipelines.learn.parallel import ComputeSettings
from pipelines.learn.settings import (
    FEATURE_RECIPE,
    RECIPE_TEXT,
    WINDOW_S,
    LearnSettings,
    check_params,
    check_recipe,
    split_recipes,
)
from pipelines.report import (
    Bars,
    Column,
    Figure,
    Line,
    Pairs,
    Panel,
    Part,
    Points,
    Progress,
    Report,
    Result,
    Section,
    Table,
    Text,
    described,
    enumerated,
    format_counts,
    format_value,
    interval,
    plural,
    silent,
)
from pipelines.report.settings import setting
from terrain.errors import ConfigError, DataError

if TYPE_CHECKING:
    import pandas as pd

    from features.motion import Motion
    from features.windows import WindowRule
    from pipelines.learn.checks import LearningCurve, LeftOutTerrain, SlowFast, StiffnessFigures
    from pipelines.learn.coverage import NextDrive, SupportRow
    from pipelines.learn.evaluate import FoldFigures, HeldOut
    from pipelines.learn.model_file import TerrainModel
    from pipelines.learn.protocols import Samples
    from pipelines.learn.recipes import WindowPipeline
    from pipelines.learn.sequences import Breakaway, DelayFigures, SequenceFigures
    from terrain.classify.confidence import CoverageFigures, ReliabilityBin
    from terrain.classify.conformal_figures import ConformalFigures
    from terrain.classify.metrics import ClassFigures, RunFigures
    from terrain.classify.paired import Difference, Outcome, RunDifference
    from terrain.classify.support_figures import PartFigures
    from terrain.records import RunLog, Windows

EXAMPLE = "terrain crossval --data runs/ --recipe svm"

ProtocolName = Literal[
    "grouped",
    "leave-one-run-out",
    "leave-sessions-out",
    "leave-regimes-out",
    "leave-terrain-out",
    "published",
    "slow-fast",
    "fast-slow",
]
"""The names of ``pipelines.learn.protocols.PROTOCOLS``."""
SEVERAL_REPEATS = ("grouped", "leave-regimes-out", "leave-terrain-out", "published")
PUBLISHED_WINDOW_S = 1.7

CHECKED_WITH = FEATURE_RECIPE
"""The recipe of the checks beside the figures: they are of the data, and have many fits."""

MAX_ROWS = 10
PERCENT, POINTS = ".1%", "+.1f"


class EvaluationSettings(LearnSettings):
    """Evaluation: what is compared, and which windows are held out."""

    recipe: tuple[str, ...] = setting((), f"Recipes to evaluate (svm), by commas or repeated: {RECIPE_TEXT}")
    model: tuple[str, ...] = setting((), "Model folder or URI in place of recipes; may be given again.")
    protocol: ProtocolName = setting("grouped", "Which windows train and which test.")
    extras: bool = setting(True, "Speed alone, slow against fast, learning curve, terrain over time.")
    speed: str | None = setting(
        None, "LOW:HIGH in m/s: runs commanded at such a speed alone (or, without commands, driven at)."
    )

    @field_validator("speed")
    @classmethod
    def _check_speed(cls, text: str | None) -> str | None:
        if text is not None:
            _speeds(text)
        return text

    @field_validator("recipe")
    @classmethod
    def _check_recipes(cls, texts: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(check_recipe(text) for text in split_recipes(texts))

    @model_validator(mode="after")
    def _check_protocol(self) -> Self:
        if self.model and self.recipe:
            raise ConfigError("--model and --recipe do not go together: compare models, or recipes")
        check_params(self.params, self.recipe)
        if self.protocol == "published" and (self.stride_s is not None or not self.steady):
            raise ConfigError(
                "'published' sets its own strides and keeps all motion: stride and steady do not apply"
            )
        if self.protocol not in SEVERAL_REPEATS and (self.repeats or 1) > 1:
            raise ConfigError(f"{self.protocol!r} has a single fold assignment: it has one repeat")
        return self

    @property
    def recipes(self) -> tuple[str, ...]:
        """The recipes by name; the SVM where none is given."""
        return self.recipe or (FEATURE_RECIPE,)

    @property
    def rule(self) -> WindowRule:
        """How windows are cut."""
        return self.rule_of(PUBLISHED_WINDOW_S if self.protocol == "published" else WINDOW_S)

    @property
    def speed_mps(self) -> tuple[float, float] | None:
        """Speeds of the runs that are used; None for all."""
        return None if self.speed is None else _speeds(self.speed)


class Settings(EvaluationSettings, AlignedRunsSettings, ComputeSettings):
    """What is evaluated, of which runs."""


def _speeds(text: str) -> tuple[float, float]:
    """Read ``LOW:HIGH``."""
    low, _, high = text.partition(":")
    try:
        low_mps, high_mps = float(low), float(high)
    except ValueError:
        low_mps = high_mps = 0.0
    if not 0.0 <= low_mps < high_mps < math.inf:
        raise ConfigError(f"--speed is {text!r}; LOW:HIGH in m/s is required, as in 0:0.15")
    return low_mps, high_mps


@dataclass(frozen=True, repr=False)
class CrossvalResult(Result):
    """An evaluation on held-out windows: its figures, how they were obtained, and what to know of them.

    Figures are means over the repeats, intervals of 95 % over runs within classes.  What was not asked for,
    or is not known, is None and left out of JSON.
    """

    classes: tuple[str, ...] = described("terrains")
    n_windows: int = described("windows that were held out")
    n_runs: int = described("runs that they are of")
    repeats: int = described("fold assignments")
    accuracy: float = described("windows classified correctly", "1", form=PERCENT)
    accuracy_spread: float | None = described("standard deviation over the repeats", "1", form=PERCENT)
    accuracy_per_repeat: tuple[float, ...] = described("accuracy of each repeat", "1")
    accuracy_ci: tuple[float, float] = described("interval of the accuracy", "1", form=PERCENT)
    balanced_accuracy: float = described("mean recall of the terrains", "1", form=PERCENT)
    macro_f1: float = described("mean F1 of the terrains", "1", form=".3f")
    macro_run_accuracy: float = described("mean over terrains of the mean over runs", "1", form=PERCENT)
    per_class: Mapping[str, ClassFigures] = described("precision, recall and F1, all repeats together")
    confusion: tuple[tuple[int, ...], ...] = described("windows by true and predicted terrain, all repeats")
    vote_accuracy: float = described("accuracy of a vote over 5 s", "1", form=PERCENT)
    vote_windows: float = described("windows of a vote, mean", form=".1f")
    ece: float = described("expected calibration error", "1", form=".3f")
    ece_ci: tuple[float, float] = described("interval of the calibration error", "1", form=".3f")
    confidence_auc: float = described(
        "area from confidence to correctness; NaN if all are right", "1", form=".2f"
    )
    confidence_auc_ci: tuple[float, float] = described("interval of this area", "1", form=".2f")
    accuracy_at_coverage: tuple[CoverageFigures, ...] = described("accuracy of the most confident windows")
    reliability: tuple[ReliabilityBin, ...] = described("confidence and accuracy by bins of confidence")
    per_run: tuple[RunFigures, ...] = described("accuracy of each run on each of its terrains")
    folds: tuple[FoldFigures, ...] = described("what each fold trained and tested; none of a model")
    protocol: str = described("which windows were held out")
    recipe: str = described("recipe or model")
    window_s: float = described("length of a window", "s")
    stride_s: float | None = described("from window to window; None where a protocol sets it", "s")
    steady: bool = described("whether windows of steady motion alone were kept")
    signal_sets: tuple[str, ...] = described("signals that were used")
    seed: int = described("deals runs into folds, and draws runs for intervals")
    n_features: int = described("features of a window; 0 of a model")
    dropped: Mapping[str, int] = described("windows left out, by reason")
    repaired: Mapping[str, int] = described("what a repairing reader changed, by kind")
    notes: tuple[str, ...] = described("what a reader has to know")
    speed_only_accuracy: float | None = described("accuracy of wheel speed alone", "1", default=None)
    slow_fast: SlowFast | None = described(
        "slow runs train and fast ones test, and the reverse", default=None
    )
    learning_curve: LearningCurve | None = described("accuracy by number of training runs", default=None)
    stiffness: StiffnessFigures | None = described("accuracy by level of stiffness", default=None)
    filtered_accuracy: float | None = described("accuracy of the filter over time", "1", default=None)
    filtered_accuracy_ci: tuple[float, float] | None = described("interval of it", "1", default=None)
    filter_delay_s: DelayFigures | None = described(
        "from a change of terrain to its report", "s", default=None
    )
    courses: SequenceFigures | None = described("sequences spliced from held-out runs", default=None)
    recorded_courses: SequenceFigures | None = described("runs over several terrains", default=None)
    breakaways: tuple[Breakaway, ...] | None = described("stretches that look unlike their run", default=None)
    auroc_unknown: float | None = described("area of the novelty score, terrain left out", "1", default=None)
    auroc_unknown_ci: tuple[float, float] | None = described("interval of it", "1", default=None)
    auroc_unknown_10s: float | None = described("the same of means over 10 s", "1", default=None)
    auroc_unknown_10s_ci: tuple[float, float] | None = described("interval of it", "1", default=None)
    unknown_accepted: float | None = described("unknown windows taken for known", "1", default=None)
    known_kept: float | None = described("known windows not called unknown", "1", default=None)
    known_kept_target: float | None = described("what the threshold was set for", "1", default=None)
    unknown_by_terrain: Mapping[str, LeftOutTerrain] | None = described("by terrain left out", default=None)
    support: tuple[SupportRow, ...] | None = described(
        "windows and accuracy by terrain and driving", default=None
    )
    accuracy_by_support: tuple[Mapping[str, Any], ...] | None = described(
        "accuracy by training runs of the true terrain near the motion of a window", default=None
    )
    unsupported: PartFigures | None = described("predictions without training runs near them", default=None)
    supported: PartFigures | None = described("the other predictions", default=None)
    supported_auc: float | None = described(
        "area from supported probability to correctness", "1", default=None
    )
    next_drives: tuple[NextDrive, ...] | None = described("what to record next, best first", default=None)
    conformal: ConformalFigures | None = described("sets of terrains that hold the true one", default=None)
    dataset: str | None = described("name of the data", default=None)
    data_digest: str | None = described("digest of the runs", default=None)
    skipped: tuple[str, ...] | None = described("runs that a repairing reader had to skip", default=None)
    data: str = described("where the data lie, for the next step; not in JSON", default="")

    @property
    def chance(self) -> float:
        """Accuracy of always predicting the class with the most windows."""
        counts = [figures.n_windows for figures in self.per_class.values()]
        return max(counts) / sum(counts)

    def as_json(self) -> Any:
        """Return the fields that are known by name; of checks that were made, all."""
        always = {"accuracy_spread", "stride_s"}
        if self.learning_curve is not None:
            always |= {"speed_only_accuracy", "stiffness", "courses", "recorded_courses"}
        if self.support is not None:
            always |= {"supported_auc"}
        left_out = {
            each.name
            for each in fields(self)
            if each.name == "data" or (getattr(self, each.name) is None and each.name not in always)
        }
        return {name: value for name, value in super().as_json().items() if name not in left_out}

    def to_pandas(self) -> pd.DataFrame:
        """Return precision, recall, F1 and windows of each terrain."""
        import pandas as pd

        return pd.DataFrame([{"terrain": name, **row._asdict()} for name, row in self.per_class.items()])


class PairedDifferences(NamedTuple):
    """Differences of b minus a, paired by run.

    ``by_support`` has those of accuracy by how many training runs drove the true terrain with the motion of a
    window; empty of models, and where the motion is not known.
    """

    a: str
    b: str
    accuracy: Difference
    macro_run_accuracy: Difference
    confidence_auc: Difference
    by_class: Mapping[str, Difference]
    by_run: tuple[RunDifference, ...]
    by_support: Mapping[str, Difference]


@dataclass(frozen=True, repr=False)
class ComparisonResult(Result):
    """Several recipes on the same folds, or several models on the same runs; each compared with the first."""

    kind: str = described("recipes or models")
    contenders: tuple[CrossvalResult, ...] = described("the evaluation of each")
    differences: tuple[PairedDifferences, ...] = described("of each of the others less the first")
    excluded_runs: tuple[str, ...] = described("runs that one of the models was trained on")
    notes: tuple[str, ...] = described("what a reader has to know")
    dataset: str = described("name of the data", default="")
    data_digest: str = described("digest of the runs", default="")
    data: str = described("where the data lie", default="")

    def to_pandas(self) -> pd.DataFrame:
        """Return a row of figures for each contender."""
        import pandas as pd

        return pd.concat([Result.to_pandas(each) for each in self.contenders], ignore_index=True)


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


def crossval(
    runs: Sequence[RunLog], settings: EvaluationSettings, progress: Progress = silent
) -> CrossvalResult:
    """Cross-validate one recipe on labelled runs; extras are computed under ``grouped`` only.

    Raises
    ------
    DataError
        if the data cannot answer: one class, fewer runs than folds, a run shorter than a window.
    """
    from pipelines.learn.protocols import samples_of
    from pipelines.learn.recipes import recipe_of

    (name,) = settings.recipes
    samples = samples_of(runs, settings, settings.protocol, settings.speed_mps)
    return evaluate_recipe(recipe_of(settings, name), name, samples, settings, progress)[0]


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
    return _side_by_side(contenders, settings, progress)


def compare_recipes(
    runs: Sequence[RunLog], settings: EvaluationSettings, progress: Progress = silent
) -> ComparisonResult:
    """Compare recipes on the same folds.

    Raises
    ------
    DataError
        if the data do not suffice, or two recipes cut different windows from them.
    """
    from pipelines.learn.protocols import samples_of
    from pipelines.learn.recipes import recipe_of

    contenders = []
    for name in settings.recipes:
        recipe = recipe_of(settings, name)
        of_recipe = settings.with_(signal_sets=tuple(recipe[0].signal_sets), extras=False)
        contenders.append((name, recipe, samples_of(runs, of_recipe, settings.protocol, settings.speed_mps)))
    return _side_by_side(contenders, settings.with_(extras=False), progress)


def _side_by_side(
    contenders: Sequence[tuple[str, WindowPipeline, Samples]],
    settings: EvaluationSettings,
    progress: Progress,
) -> ComparisonResult:
    import numpy as np

    from features.motion import window_motion
    from pipelines.learn.coverage import held_out_coverage
    from terrain.classify.support import support_levels

    samples = contenders[0][2]
    for name, _, other in contenders[1:]:
        if not np.array_equal(samples.windows.start_s, other.windows.start_s):
            raise DataError(
                f"{contenders[0][0]} and {name} keep different windows of these runs, whose streams end at "
                "different times: compare them on signal sets of the same streams"
            )
    found = [evaluate_recipe(recipe, name, each, settings, progress) for name, recipe, each in contenders]
    motion, levels = window_motion(samples.windows), None
    if motion is not None and settings.protocol != "published":
        true_runs = held_out_coverage(found[0][1], samples, motion).true_runs
        levels = support_levels(np.median(true_runs, axis=0))
    outcomes = [_outcome(held_out, samples) for _, held_out in found]
    return ComparisonResult(
        "recipes",
        tuple(result for result, _ in found),
        _differences([name for name, *_ in contenders], outcomes, settings.seed, levels),
        (),
        (),
    )


def compare_models(
    runs: Sequence[RunLog], models: Sequence[TerrainModel], settings: EvaluationSettings
) -> CrossvalResult | ComparisonResult:
    """Evaluate models, named as in the settings, on the runs that none of them was trained on.

    Raises
    ------
    DataError
        if no run is left, a run lacks a channel that a model requires, or the models share no class.
    """
    import numpy as np

    from features.windows import cut_windows
    from pipelines.data.datasets import data_digest
    from pipelines.learn.evaluate import HeldOut, figures_of, weaknesses
    from pipelines.learn.protocols import Samples

    trained = {digest for model in models for digest in model.info.run_digests}
    excluded = tuple(each.run_id for each in runs if data_digest([each]) in trained)
    kept = [each for each in runs if each.run_id not in excluded]
    if not kept:
        raise DataError(
            f"all {len(runs)} runs were used to train {enumerated(settings.model, 'or')}: "
            "no run is left to compare on"
        )
    shared = sorted(set.intersection(*(set(model.info.classes) for model in models)))
    notes = []
    if any(model.info.classes != models[0].info.classes for model in models):
        notes.append(
            f"the models have other classes: compared on windows of {', '.join(shared) or 'no terrain'}"
        )
    results, outcomes = [], []
    for name, model in zip(settings.model, models, strict=True):
        cut = cut_windows(kept, model.rule, layout=model.layout)
        windows = cut.windows[np.isin(cut.windows.terrain.astype(str), shared)]
        if not len(windows):
            raise DataError(
                f"no window of these runs is labelled as a class of all models ({', '.join(shared)})"
            )
        samples = Samples(windows, cut.dropped, windows.run_id, model.rule.overlap)
        probability = np.asarray(model.recipe.predict_proba(windows))[None]
        classes = np.asarray(model.recipe.classes_, dtype=str)
        number = np.zeros(probability.shape[:2], dtype=int)
        held_out = HeldOut(classes, probability, number, samples.terrain, [])
        figures = figures_of(held_out, samples, settings.seed)
        rule = model.rule
        result = CrossvalResult(
            **figures,
            protocol="runs not trained on",
            recipe=name,
            window_s=rule.length_s,
            stride_s=rule.step_s,
            steady=rule.steady is not None,
            signal_sets=tuple(model.info.signal_sets),
            seed=settings.seed,
            n_features=0,
            dropped=dict(cut.dropped),
            repaired={},
            notes=(),
        )
        results.append(replace(result, notes=weaknesses(result.accuracy_ci, result.chance)))
        outcomes.append(_outcome(held_out, samples))
    if len(results) == 1:
        left_out = f"{plural(len(excluded), 'run')} left out: the model was trained on them"
        return replace(results[0], notes=(*results[0].notes, *([left_out] if excluded else [])))
    differences = _differences(settings.model, outcomes, settings.seed, None)
    return ComparisonResult("models", tuple(results), differences, excluded, tuple(notes))


def _outcome(held_out: HeldOut, samples: Samples) -> Outcome:
    """Return which windows were classified correctly, and how confidently."""
    from terrain.classify.paired import Outcome

    predicted = held_out.classes[held_out.probability.argmax(axis=2)]
    confidence = held_out.probability.max(axis=2)
    return Outcome(samples.run_id, samples.terrain, predicted == samples.terrain, confidence)


def _differences(
    names: Sequence[str], outcomes: Sequence[Outcome], seed: int, levels: Any
) -> tuple[PairedDifferences, ...]:
    """Compare each outcome with the first; of recipes also by the coverage ``levels`` (n,) of the windows."""
    import numpy as np

    from terrain.classify.paired import Outcome, compare_outcomes
    from terrain.classify.support import SupportLevel

    def rows_of(outcome: Outcome, rows: Any) -> Outcome:
        run_id, terrain, correct, confidence = outcome
        return Outcome(run_id[rows], terrain[rows], correct[:, rows], confidence[:, rows])

    first, found = outcomes[0], []
    for name, other in zip(names[1:], outcomes[1:], strict=True):
        compared = compare_outcomes(first, other, np.random.default_rng(seed))
        by_support = {}
        for level in SupportLevel if levels is not None else ():
            rows = np.flatnonzero(levels == level.value)
            if len(rows):
                parts = rows_of(first, rows), rows_of(other, rows)
                by_support[level.value] = compare_outcomes(*parts, np.random.default_rng(seed)).accuracy
        found.append(PairedDifferences(names[0], name, *compared, by_support))
    return tuple(found)


def evaluate_recipe(
    recipe: WindowPipeline,
    name: str,
    samples: Samples,
    settings: EvaluationSettings,
    progress: Progress = silent,
    cached: tuple[Any, Motion | None] | None = None,
) -> tuple[CrossvalResult, HeldOut]:
    """Evaluate a recipe on windows by the protocol of the settings; also return its held-out probabilities.

    Parameters
    ----------
    recipe, name : unfitted, and as it is named
    samples : labelled windows with their groups
    settings : protocol, repeats, seed, processes and extras
    progress : called as the work goes on
    cached : features (n, f) and motion of the windows, where the windows have no samples

    Raises
    ------
    DataError
        if there is one class only, or there are too few runs.
    """
    from features.motion import NO_MOTION, window_motion
    from pipelines.learn.checks import leave_terrain_out
    from pipelines.learn.coverage import coverage_of
    from pipelines.learn.evaluate import Examples, evaluate, figures_of, sets_of, weaknesses
    from pipelines.learn.protocols import PROTOCOLS, folds_of
    from pipelines.learn.recipes import feature_matrix, recipe_of
    from pipelines.learn.sequences import following
    from terrain.classify.svm import GroupedSVC

    protocol, seed, jobs, windows = settings.protocol, settings.seed, settings.jobs, samples.windows
    n_repeats = settings.repeats or PROTOCOLS[protocol].repeats
    folds = folds_of(samples, protocol, n_repeats, seed)
    progress("features", 0, 1)
    features, motion = cached or (feature_matrix(recipe, windows), window_motion(windows))
    progress("features", 1, 1)
    examples = Examples(features, samples.terrain, samples.group)
    beside = settings.extras and protocol == "grouped" and cached is None
    follow: list[Any] | None = None
    if beside and samples.runs:
        follow = [*following(recipe, samples, settings.rule, folds, seed)]
    held_out = evaluate(recipe[-1], examples, folds, jobs, protocol, progress, follow)
    published = protocol == "published"
    signal_sets = tuple(getattr(recipe[0], "signal_sets", settings.signal_sets))
    result = CrossvalResult(
        **figures_of(held_out, samples, seed),
        protocol=protocol,
        recipe=name,
        window_s=windows.length_s,
        stride_s=None if published else settings.rule.step_s,
        steady=settings.rule.steady is not None and not published,
        signal_sets=signal_sets,
        seed=seed,
        n_features=features.shape[1],
        dropped=dict(samples.dropped),
        repaired=dict(samples.repaired),
        notes=tuple(_notes(samples, recipe, settings)),
    )
    found: dict[str, Any] = {}
    notes = [*result.notes, *weaknesses(result.accuracy_ci, result.chance)]
    checked, checked_features = recipe[-1], features
    if (beside or protocol == "leave-terrain-out") and not isinstance(checked, GroupedSVC):
        svm = recipe_of(settings, CHECKED_WITH)
        checked, checked_features = svm[-1], feature_matrix(svm, windows)
    if beside:
        found |= _extras(
            checked, checked_features, samples, held_out, recipe[-1] is checked, settings, progress
        )
    elif settings.extras and protocol == "grouped":
        notes.append(NO_EXTRAS)
    if not published:
        found["conformal"] = sets_of(held_out, samples, seed)
        if motion is None:
            notes.append(f"support: {NO_MOTION}")
        else:
            coverage = coverage_of(held_out, samples, motion, seed)
            by_level = coverage.accuracy.by_true_terrain.items()
            found |= {
                "support": coverage.rows,
                "accuracy_by_support": tuple({"support": name, **part._asdict()} for name, part in by_level),
                "unsupported": coverage.accuracy.unsupported,
                "supported": coverage.accuracy.supported,
                "supported_auc": coverage.accuracy.auc,
                "next_drives": coverage.next_drives,
            }
    if protocol == "leave-terrain-out":
        found |= leave_terrain_out(checked_features, samples, seed, jobs, progress)._asdict()
    return replace(result, notes=tuple(notes), **found), held_out


NO_EXTRAS = (
    "from cached features: speed alone, slow against fast, the learning curve and terrain over time need the "
    "runs themselves"
)


def _extras(
    classifier: Any,
    features: Any,
    samples: Samples,
    held_out: HeldOut,
    same: bool,
    settings: EvaluationSettings,
    progress: Progress,
) -> dict[str, Any]:
    """Return the checks beside the figures by field; ``same`` where held-out windows are of this classifier."""
    from pipelines.learn.checks import learning_curve, slow_fast, speed_only, stiffness_figures
    from pipelines.learn.evaluate import Examples, evaluate
    from pipelines.learn.sequences import breakaways_of, sequence_figures

    seed, jobs = settings.seed, settings.jobs
    examples = Examples(features, samples.terrain, samples.group)
    first = [result.fold for result in held_out.results if result.fold.repeat == 0]
    if not same:
        accuracy = evaluate(classifier, examples, first, jobs, CHECKED_WITH, progress).accuracies[0]
    else:
        accuracy = held_out.accuracies[0]
    tracks = [track for result in held_out.results for track in result.found or ()]
    spliced = sequence_figures([track for track in tracks if track.spliced], seed)
    found = {
        "speed_only_accuracy": speed_only(classifier, samples, first, jobs, progress),
        "slow_fast": slow_fast(classifier, features, samples, jobs, progress),
        "learning_curve": learning_curve(classifier, examples, first, accuracy, seed, jobs, progress),
        "stiffness": stiffness_figures(held_out, features, samples, seed),
        "courses": spliced,
        "recorded_courses": sequence_figures([track for track in tracks if not track.spliced], seed),
        "breakaways": breakaways_of(held_out, samples.windows),
    }
    if spliced is not None:
        names = ("filtered_accuracy", "filtered_accuracy_ci", "filter_delay_s")
        found |= {name: getattr(spliced, name) for name in names}
    return found


def _notes(samples: Samples, recipe: WindowPipeline, settings: EvaluationSettings) -> Iterator[str]:
    """Yield in sentences what a reader of the figures must know."""
    from pipelines.learn.own import OwnClassifier
    from pipelines.learn.protocols import PROTOCOLS, notes_of
    from terrain.classify.svm import GroupedSVC

    protocol, classifier = settings.protocol, recipe[-1]
    if protocol in ("slow-fast", "fast-slow"):
        yield f"{PROTOCOLS[protocol].held_out}, on either side of the median speed of each terrain"
    yield from notes_of(samples, protocol)
    if not isinstance(classifier, GroupedSVC) and settings.extras and protocol == "grouped":
        yield f"speed alone, slow against fast and the learning curve are of recipe {CHECKED_WITH!r}"
    if isinstance(classifier, OwnClassifier) and classifier.outputs == "decision_function":
        yield "the classifier gives no probabilities: its decisions were calibrated on inner held-out runs"
    if isinstance(classifier, OwnClassifier) and classifier.outputs == "predict":
        yield "the classifier gives no probabilities: each prediction counts as certain"
    if protocol == "leave-terrain-out":
        yield "accuracy and the table of classes are of folds in which all terrains are known"
    if samples.dropped:
        yield f"windows left out: {format_counts(samples.dropped)}"
    if samples.repaired:
        yield f"changed or left out in reading the logs: {format_counts(samples.repaired)}"


def report(result: CrossvalResult | ComparisonResult) -> Report:
    """Return the report of an evaluation, or of several side by side."""
    return _comparison_report(result) if isinstance(result, ComparisonResult) else _evaluation_report(result)


def held_out_words(protocol: str) -> str:
    """Return what a protocol holds out, in words."""
    from pipelines.learn.protocols import PROTOCOLS

    return PROTOCOLS[protocol].held_out if protocol in PROTOCOLS else protocol


def _evaluation_report(result: CrossvalResult) -> Report:
    dataset = result.dataset or "windows"
    names = list(result.per_class)
    known = list(result.next_drives or ())[:3]
    decide: list[tuple[Any, ...]] = [("always the most frequent terrain", result.chance, PERCENT)]
    if result.learning_curve is not None:
        decide.append(("from wheel speed alone", result.speed_only_accuracy, PERCENT))
        decide.append(("number of runs", result.learning_curve.statement))
    if result.auroc_unknown is not None:
        decide.append(("a terrain never learned: area of the novelty score", result.auroc_unknown, ".3f"))
        decide.append(("  its windows taken for a known one", result.unknown_accepted, PERCENT))
    if known:
        decide.append(("record next", "; ".join(drive.request for drive in known)))
    worst = sorted(names, key=lambda name: result.per_class[name].recall)[:MAX_ROWS]
    shown = [name for name in names if name in worst]
    return Report(
        title=f"Evaluation on held-out runs of {dataset}",
        answer=(
            f"{format_value(result.accuracy, PERCENT)} of windows classified correctly, "
            f"{held_out_words(result.protocol)} ({interval(*result.accuracy_ci, PERCENT)}, 95 % over runs)."
        ),
        lead=(
            f"{dataset}, recipe {result.recipe}: {plural(result.n_windows, 'window')} of {result.window_s:g} s "
            f"from {plural(result.n_runs, 'run')}, protocol {result.protocol}"
        ),
        picture=Figure(
            "Windows of each terrain that are classified correctly",
            [
                Panel(
                    [Bars("recall", names, [row.recall for row in result.per_class.values()])],
                    x_range=(0.0, 1.0),
                )
            ],
            caption="Recall of each terrain on held-out windows.",
        ),
        parts=[
            Table(
                (
                    "terrain",
                    "windows",
                    Column("recall", PERCENT),
                    Column("precision", PERCENT),
                    Column("F1", ".3f"),
                ),
                [
                    (name, row.n_windows, row.recall, row.precision, row.f1)
                    for name, row in result.per_class.items()
                    if name in shown
                ],
                note="" if len(shown) == len(names) else f"the {MAX_ROWS} worst of {len(names)} terrains",
            ),
            Pairs(decide),
            *(Text(note, "note") for note in (*result.notes, *(result.skipped or ()))),
        ],
        details=tuple(_details(result)),
        next_step=f"terrain train --data {result.data or 'DIR'} --recipe {result.recipe} --name NAME",
    )


def _details(result: CrossvalResult) -> Iterator[Section]:
    """Yield what is folded: confusion, runs, confidence, coverage, checks, time, and how it was done."""
    names = list(result.per_class)
    counts = {name: max(sum(row), 1) for name, row in zip(names, result.confusion, strict=True)}
    yield Section(
        "Confusion",
        [
            Table(
                ("true terrain", *(Column(name, ".0%", shade=True) for name in names)),
                [
                    (name, *(n / counts[name] for n in row))
                    for name, row in zip(names, result.confusion, strict=True)
                ],
                note="A row has the predictions for the windows of one terrain.",
            )
        ],
    )
    worst = sorted(result.per_run, key=lambda row: row.accuracy)
    yield Section(
        "Runs",
        [
            Table(
                ("run", "terrain", "windows", Column("accuracy", PERCENT), "mistaken for"),
                [(row.run_id, row.terrain, row.n_windows, row.accuracy, row.mistaken_for) for row in worst],
                note="The worst first.",
            )
        ],
    )
    yield _confidence(result)
    if result.support is not None:
        yield _coverage(result)
    if result.learning_curve is not None:
        yield Section("Checks of the data", list(_check_parts(result)))
    if result.courses is not None or result.recorded_courses is not None or result.breakaways:
        yield Section("Terrain over time", list(_time_parts(result)))
    if result.unknown_by_terrain is not None:
        yield _unknown(result)
    yield Section(
        "How it was done",
        [
            Pairs(
                [
                    ("balanced accuracy", result.balanced_accuracy, PERCENT),
                    ("macro F1", result.macro_f1, ".3f"),
                    ("mean over terrains, then runs", result.macro_run_accuracy, PERCENT),
                    (f"vote over 5 s ({result.vote_windows:.1f} windows)", result.vote_accuracy, PERCENT),
                    ("fold assignments", result.repeats),
                    ("spread over them", result.accuracy_spread, PERCENT),
                    ("window, stride", f"{result.window_s:g} s, {result.stride_s or result.window_s:g} s"),
                    ("steady motion alone", result.steady),
                    ("signal sets", ", ".join(result.signal_sets)),
                    ("features", result.n_features),
                    ("seed", result.seed),
                    ("data digest", result.data_digest),
                ]
            ),
            Table(
                ("repeat", "fold", "trained on", "tested on", Column("accuracy", PERCENT), "chosen"),
                [
                    (*row[:5], ", ".join(f"{name} {value}" for name, value in row.chosen.items()))
                    for row in result.folds
                ],
            ),
        ],
    )


def _confidence(result: CrossvalResult) -> Section:
    bins = result.reliability
    parts: list[Part] = [
        Pairs(
            [
                ("area from confidence to correctness", result.confidence_auc, ".2f"),
                ("  95 % over runs", result.confidence_auc_ci, ".2f"),
                ("calibration error", result.ece, ".3f"),
                *(
                    (f"of the most confident {row.coverage:.0%}, right", row.accuracy, PERCENT)
                    for row in result.accuracy_at_coverage
                ),
            ]
        ),
        Figure(
            "Confidence and accuracy",
            [
                Panel(
                    [
                        Line("as stated", [0.0, 1.0], [0.0, 1.0], dashed=True),
                        Points(
                            "windows by confidence",
                            [each.confidence for each in bins],
                            [each.accuracy for each in bins],
                            [each.accuracy_ci[0] for each in bins],
                            [each.accuracy_ci[1] for each in bins],
                        ),
                    ],
                    y_label="classified correctly",
                    x_range=(0.0, 1.0),
                    y_range=(0.0, 1.0),
                )
            ],
            caption="Below the line, predictions are wrong more often than their probability says.",
            x_label="probability of the predicted terrain",
        ),
    ]
    sets = result.conformal
    if sets is not None:
        parts.append(
            Pairs(
                [
                    ("windows whose set holds the true terrain", sets.coverage, PERCENT),
                    ("  95 % over runs", sets.coverage_ci, PERCENT),
                    ("  in the worst run", sets.coverage_worst_run, PERCENT),
                    ("terrains in a set", sets.set_size, ".2f"),
                    ("sets with one terrain", sets.single_ratio, PERCENT),
                ],
                title=f"Sets of terrains that hold the true one in {sets.level:.0%}",
            )
        )
    return Section("Confidence", parts)


def _coverage(result: CrossvalResult) -> Section:
    rows = [
        (
            each["support"],
            *(each[name] for name in ("windows_ratio", "accuracy", "accuracy_ci", "errors_ratio")),
        )
        for each in result.accuracy_by_support or ()
    ]
    for name, part in (
        ("unsupported prediction", result.unsupported),
        ("other predictions", result.supported),
    ):
        if part is not None:
            rows.append((name, part.windows_ratio, part.accuracy, part.accuracy_ci, part.errors_ratio))
    head = tuple(Column(name, PERCENT) for name in ("windows", "accuracy", "95 % over runs", "of the errors"))
    regimes = list(dict.fromkeys(row.regime for row in result.support or ()))
    cells = {(row.terrain, row.regime): row for row in result.support or ()}
    return Section(
        "Training coverage",
        [
            Table(("training runs near the motion", *head), rows),
            Table(
                ("terrain", *(Column(name, ".0%", shade=True) for name in regimes)),
                [
                    (
                        name,
                        *(row.accuracy if (row := cells.get((name, regime))) else None for regime in regimes),
                    )
                    for name in result.classes
                ],
                title="Accuracy by terrain and driving",
            ),
            Table(
                ("record next", Column("runs near it", ".1f"), "windows", Column("accuracy", PERCENT)),
                [
                    (row.request, row.support_runs, row.windows, row.accuracy)
                    for row in (result.next_drives or ())[:MAX_ROWS]
                ],
                note="The drive that is expected to gain most first; the order alone is to be relied on.",
            ),
        ],
    )


def _check_parts(result: CrossvalResult) -> Iterator[Part]:
    found, curve = result.slow_fast, result.learning_curve
    assert found is not None
    assert curve is not None
    out = "; ".join(f"{name} left out ({reason})" for name, reason in found.left_out.items())
    yield Pairs(
        [
            ("from wheel speed alone", result.speed_only_accuracy, PERCENT),
            ("trained on slow runs, tested on fast ones", found.slow_to_fast, PERCENT),
            ("the reverse", found.fast_to_slow, PERCENT),
            ("slow and fast runs", "; ".join(each for each in (str(found.status), out) if each)),
        ]
    )
    runs, accuracy = curve.runs_per_class, curve.accuracy
    spread = [std or 0.0 for std in curve.accuracy_spread]
    low, high = ([a + sign * s for a, s in zip(accuracy, spread, strict=True)] for sign in (-1.0, 1.0))
    yield Figure(
        "Learning curve",
        [
            Panel(
                [Line("", runs, accuracy, 0), Points("held-out runs", runs, accuracy, low, high, 0)],
                "accuracy",
            )
        ],
        caption=f"Bars: one standard deviation over draws of runs. {curve.statement}",
        x_label="training runs of each terrain, mean",
    )
    levels = result.stiffness
    if levels is not None:
        yield Pairs(
            [
                ("stiffness level right", levels.accuracy, PERCENT),
                ("  95 % over runs", levels.accuracy_ci, PERCENT),
                ("soft and hard confused", levels.soft_hard_ratio, PERCENT),
                ("cost of confusing levels, a window", levels.cost, ".3f"),
                ("  by the class of least expected cost", levels.least_cost, ".3f"),
                ("  gain, 95 % over runs", levels.gain_ci, ".4f"),
            ]
        )
        if levels.clusters is not None:
            yield Pairs(
                [
                    ("clusters of runs without labels", levels.clusters.n_clusters),
                    ("  adjusted Rand index with the levels", levels.clusters.adjusted_rand, ".2f"),
                    ("  95 % over runs", levels.clusters.interval, ".2f"),
                ]
            )


def _time_parts(result: CrossvalResult) -> Iterator[Part]:
    sequences = {"spliced": result.courses, "recorded": result.recorded_courses}
    found = {name: each for name, each in sequences.items() if each is not None}
    rows: list[tuple[Any, ...]] = []
    for name, each in found.items():
        delay = each.filter_delay_s
        rows.append(
            (
                *(name, each.filtered_accuracy, each.filtered_accuracy_ci, each.single_accuracy),
                *(delay.p50, delay.p90, f"{delay.n_missed} of {delay.n_changes}"),
                *(each.flips_per_minute, each.single_flips_per_minute),
            )
        )
    if rows:
        yield Table(
            (
                *("sequences", Column("filter", PERCENT), Column("95 % over runs", PERCENT)),
                *(Column("last window", PERCENT), Column("delay", ".1f", "s"), Column("p90", ".1f", "s")),
                *("missed", Column("false changes", ".1f", "1/min"), Column("of windows", ".1f", "1/min")),
            ),
            rows,
            note="Accuracy of the filter over time on sequences over several terrains.",
        )
    if result.breakaways:
        yield Table(
            (
                "run",
                Column("from", ".1f", "s"),
                Column("to", ".1f", "s"),
                "label",
                "looks like",
                Column("by", ".2f"),
            ),
            [
                (each.run_id, each.start_s, each.end_s, each.label, each.looks_like, each.probability)
                for each in result.breakaways[:MAX_ROWS]
            ],
            title="Stretches that look like another terrain than the rest of their run",
        )


def _unknown(result: CrossvalResult) -> Section:
    return Section(
        "A terrain that was left out of training",
        [
            Pairs(
                [
                    ("area under the ROC curve, a window", result.auroc_unknown, ".3f"),
                    ("  95 % over runs", result.auroc_unknown_ci, ".3f"),
                    ("mean over 10 s", result.auroc_unknown_10s, ".3f"),
                    ("  95 % over runs", result.auroc_unknown_10s_ci, ".3f"),
                    ("known windows that the threshold is to keep", result.known_kept_target, PERCENT),
                    ("  that it keeps", result.known_kept, PERCENT),
                ]
            ),
            Table(
                (
                    "left out",
                    Column("area", ".3f"),
                    Column("over 10 s", ".3f"),
                    Column("taken for known", PERCENT),
                ),
                [
                    (name, row.auroc, row.auroc_10s, row.accepted)
                    for name, row in (result.unknown_by_terrain or {}).items()
                ],
            ),
        ],
    )


def _comparison_report(result: ComparisonResult) -> Report:
    first = result.contenders[0]
    best = max(result.differences, key=lambda each: each.accuracy.b)
    found = best.accuracy
    apart = (100 * found.difference, tuple(100 * end for end in found.interval))
    return Report(
        title=f"{enumerated([each.recipe for each in result.contenders])} on {result.dataset or 'windows'}",
        answer=(
            f"{best.b} classifies {format_value(found.b, PERCENT)} of windows correctly, {best.a} "
            f"{format_value(found.a, PERCENT)}: {format_value(apart[0], POINTS)} points "
            f"({format_value(apart[1], POINTS)}, 95 % over runs, paired), {found.verdict}."
        ),
        lead=(
            f"{result.dataset or 'windows'}: {plural(first.n_windows, 'window')} of {plural(first.n_runs, 'run')}, "
            f"{held_out_words(first.protocol)}, {plural(first.repeats, 'fold assignment')}"
        ),
        picture=Figure(
            "Windows of each terrain that are classified correctly",
            [
                Panel(
                    [
                        Bars(
                            each.recipe, list(each.per_class), [row.recall for row in each.per_class.values()]
                        )
                        for each in result.contenders
                    ],
                    x_range=(0.0, 1.0),
                )
            ],
            caption="Recall of each terrain on held-out windows.",
        ),
        parts=[
            Table(
                (
                    *(result.kind, Column("accuracy", PERCENT), Column("mean over runs", PERCENT)),
                    *(Column("confidence", ".2f"), Column("difference", POINTS, "points")),
                    *(Column("95 % over runs, paired", POINTS, "points"), "is"),
                ),
                [
                    _contender_row(each, compared)
                    for each, compared in zip(result.contenders, (None, *result.differences), strict=True)
                ],
                note=f"Differences are to {first.recipe}; confidence: area from confidence to correctness.",
            ),
            *([Text(_excluded(result), "note")] if result.excluded_runs else []),
            *(Text(note, "note") for note in result.notes),
        ],
        details=(
            *(_paired(each) for each in result.differences),
            *(Section(f"{each.recipe} alone", _evaluation_report(each).parts) for each in result.contenders),
        ),
        next_step=f"terrain train --data {result.data or 'DIR'} --recipe RECIPE --name NAME"
        if result.kind == "recipes"
        else f"terrain predict --model {best.b if apart[0] > 0 else best.a} --data DIR",
    )


def _contender_row(result: CrossvalResult, compared: PairedDifferences | None) -> tuple[Any, ...]:
    row = (result.recipe, result.accuracy, result.macro_run_accuracy, result.confidence_auc)
    return (*row, None, None, None) if compared is None else (*row, *_points(compared.accuracy))


def _points(found: Difference) -> tuple[Any, ...]:
    """Return a difference and its interval in percentage points, and its verdict."""
    return 100 * found.difference, tuple(100 * end for end in found.interval), str(found.verdict)


def _excluded(result: ComparisonResult) -> str:
    return f"{plural(len(result.excluded_runs), 'run')} left out: one of the models was trained on them"


def _paired(found: PairedDifferences) -> Section:
    figures = {
        "accuracy": found.accuracy,
        "mean over terrains then runs": found.macro_run_accuracy,
        "from confidence to correctness": found.confidence_auc,
        **{f"accuracy on {name}": row for name, row in found.by_class.items()},
        **{f"accuracy, {level}": row for level, row in found.by_support.items()},
    }
    columns = (
        *(
            "figure",
            Column(found.a, PERCENT),
            Column(found.b, PERCENT),
            Column("difference", POINTS, "points"),
        ),
        *(Column("95 % over runs, paired", POINTS, "points"), f"{found.b} is", "runs"),
    )
    rows = [(name, row.a, row.b, *_points(row), row.n_runs) for name, row in figures.items()]
    runs = sorted((row for row in found.by_run if row.a != row.b), key=lambda row: -abs(row.b - row.a))
    return Section(
        f"{found.b} less {found.a}",
        [
            Table(columns, rows),
            Table(
                ("run", "terrain", Column(found.a, PERCENT), Column(found.b, PERCENT)),
                [(row.run_id, row.terrain, row.a, row.b) for row in runs[:MAX_ROWS]],
                title="Runs that differ most",
            ),
        ],
    )
