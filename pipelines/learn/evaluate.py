"""Evaluation: a classifier is fitted on every fold, and its figures are those of windows that were held out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from features.extractor import FeatureExtractor
from features.motion import NO_MOTION, window_motion
from features.protocols import PROTOCOLS, Samples, folds_of, slow_and_fast
from features.recipes import WindowPipeline, feature_matrix
from features.sequences import following
from features.windows import wheel_stream
from pipelines.learn.evaluation import CrossvalResult
from pipelines.learn.parallel import parallel
from pipelines.learn.rates import right_at
from pipelines.learn.recipes import recipe_of
from pipelines.learn.settings import FEATURE_RECIPE, EvaluationSettings, RecipeSettings
from pipelines.report.numbers import format_counts
from pipelines.report.results import Progress, silent
from terrain.classify.changes import breakaways
from terrain.classify.coverage import coverage_of
from terrain.classify.folds import N_FOLDS, Fold, has_sessions, run_of, single_run_classes
from terrain.classify.held_out import (
    Applicability,
    Examples,
    HeldOut,
    Looks,
    channel_drops,
    drawn_folds,
    fit_fold,
    itself,
    left_out_folds,
    refused_rows,
    score_fold,
)
from terrain.classify.limits import Motion
from terrain.classify.metrics import (
    Difference,
    Outcome,
    RefusalFigures,
    compare_outcomes,
    held_out_figures,
    learning_curve,
    refusal_figures,
    sequence_figures,
    set_figures,
    unknown_figures,
)
from terrain.classify.svm import GroupedSVC
from terrain.classify.terrain_filter import choose_settings, filter_sessions, reported
from terrain.errors import DataError
from terrain.records import Array, Windows

CHECKED_WITH, BASELINE = FEATURE_RECIPE, "plain"
"""The recipe of the checks beside the figures: they are of the data, and have many fits; what a recipe must beat."""

NO_EXTRAS = (
    "from cached features: speed alone, slow against fast, the learning curve and terrain over time need the "
    "runs themselves"
)


def evaluate(
    classifier: Any,
    examples: Examples,
    folds: Sequence[Fold],
    n_jobs: int = 1,
    task: str = "folds",
    progress: Progress = silent,
    asks: Sequence[Callable[[Any], Any] | None] | None = None,
    on_all: bool = False,
) -> HeldOut:
    """Fit a clone of a classifier on each fold, and return what it makes of the windows that are held out.

    Parameters
    ----------
    classifier : estimator with ``fit(X, y, groups)`` and ``predict_proba``
    examples : rows that the folds number
    folds : train and test rows
    n_jobs : processes at once on this machine, see :func:`pipelines.learn.parallel.parallel`
    task, progress : name of the work, and what is called as it goes on
    asks : for each fold, what is called with its fitted classifier, where it is fitted
    on_all : whether a clone is fitted on all rows, too, beside the folds

    Examples
    --------
    >>> rng, runs = np.random.default_rng(0), np.repeat(np.arange(8), 10)
    >>> y = np.where(runs % 2, "ice", "mud")
    >>> examples = Examples(rng.normal(size=(80, 3)) + 9.0 * (y == "ice")[:, None], y, runs)
    >>> evaluate(GroupedSVC(), examples, [Fold(0, 0, np.flatnonzero(runs > 1), np.flatnonzero(runs < 2))]).accuracies
    [1.0]
    """
    shared, n = (classifier, examples, np.unique(examples.terrain)), len(examples.terrain)
    each = [*zip(folds, [None] * len(folds) if asks is None else asks, strict=True)]
    if on_all:  # first, as it takes longest
        each.insert(0, (Fold(0, 0, np.arange(n), np.zeros(0, dtype=int)), itself))
    results = parallel(fit_fold, shared, each, n_jobs, task, progress)
    return HeldOut.of_folds(list(results), examples.terrain)


def evaluate_recipe(
    recipe: WindowPipeline,
    name: str,
    samples: Samples,
    settings: EvaluationSettings | RecipeSettings,
    progress: Progress = silent,
    computed: tuple[Array, Motion | None] | None = None,
    channels: Sequence[str] = (),
    lower: Sequence[Array] = (),
) -> tuple[CrossvalResult, HeldOut]:
    """Evaluate a recipe on windows by the protocol of the settings; also return its held-out probabilities.

    Parameters
    ----------
    recipe, name : unfitted, and as it is named
    samples : labelled windows with their groups
    settings : protocol, repeats, seed, processes and extras; these are computed under ``grouped`` only
    progress : called as the work goes on
    computed : features (n, f) and motion of the windows, where they are there already
    channels : of each feature, where it is to be found what each channel is worth to the fits of the first repeat;
        the classifier is then fitted on all windows, too; not together with extras
    lower : rows of the windows at lower rates, which these fits classify as well (:mod:`pipelines.learn.rates`)

    Raises
    ------
    DataError
        if there is one class only, or there are too few runs.
    """
    protocol, seed, windows = settings.protocol, settings.seed, samples.windows
    folds = folds_of(samples, protocol, settings.repeats or PROTOCOLS[protocol].repeats, seed)
    progress("features", 0, 1)
    features, motion = computed or (feature_matrix(recipe, windows), window_motion(windows))
    progress("features", 1, 1)
    examples = Examples(features, samples.terrain, samples.group)
    beside, published = settings.extras and protocol == "grouped", protocol == "published"
    asks: list[Any] | None = None
    if beside and samples.runs:
        asks = [*following(recipe[:-1], windows, samples.runs, settings.rule, folds, seed)]
    elif channels:
        asks = []
        for fold in folds:
            held = features[fold.test], samples.terrain[fold.test]
            at_rates = partial(right_at, [rows[fold.test] for rows in lower], held[1])
            drops = partial(channel_drops, *held, channels, seed, fold.number)
            asks.append(None if fold.repeat else partial(_answers, (drops, at_rates)))
    held_out = evaluate(recipe[-1], examples, folds, settings.jobs, protocol, progress, asks, bool(channels))
    found: dict[str, Any] = {}
    notes = []
    judged, dealt = settings.extras or bool(channels), (samples.terrain, samples.group, samples.gap, seed)
    checks = cache(partial(_checks, recipe, features, samples, settings))
    if beside and computed is None:
        found |= _extras(checks(), samples, held_out, settings, progress)
    elif beside:
        notes.append(NO_EXTRAS)
    if judged and windows.values:
        plain = recipe_of(settings.with_(feature=()), BASELINE)
        rows = Examples(feature_matrix(plain, windows), samples.terrain, samples.group)
        first = [fold for fold in folds if fold.repeat == 0]
        beaten = evaluate(plain[-1], rows, first, settings.jobs, BASELINE, progress)
        found["plain_accuracy"] = beaten.accuracies[0]
    if protocol == "leave-terrain-out":
        left_out = left_out_folds(*dealt[:2], N_FOLDS, *dealt[2:])
        shared = checks().looks, *dealt
        scores = [*parallel(score_fold, shared, left_out, settings.jobs, protocol, progress)]
        found |= unknown_figures(scores, *dealt[:2], windows.start_s, seed)
    elif judged and not published:
        try:
            found["refusals"] = _refusals(
                (checks().looks, *dealt), held_out, windows.groups, settings.jobs, progress
            )
        except DataError as error:
            notes.append(f"no window is ever called unknown: {error}")
    if not published and protocol not in ("leave-terrain-out", "slow-fast", "fast-slow"):
        found["over_time"] = _over_time(held_out, windows, samples.unit, seed)
    if not published:
        found["conformal"] = set_figures(held_out, windows, samples.unit, seed)
        if motion is None:
            notes.append(f"support: {NO_MOTION}")
        else:
            found |= coverage_of(held_out, windows.groups, motion, windows.length_s, seed)
    result = evaluation_of(
        held_out,
        samples,
        seed,
        protocol=protocol,
        recipe=name,
        stride_s=None if published else settings.rule.step_s,
        steady=settings.rule.steady is not None and not published,
        signal_sets=tuple(getattr(recipe[0], "signal_sets", settings.signal_sets)),
        n_features=features.shape[1],
        **found,
    )
    return replace(result, notes=(*_notes(samples, recipe, settings), *result.notes, *notes)), held_out


def _answers(asks: Sequence[Callable[[Any], Any]], fitted: Any) -> tuple[Any, ...]:
    """Return what a fitted classifier answers to each of some questions."""
    return tuple(ask(fitted) for ask in asks)


def evaluation_of(held_out: HeldOut, samples: Samples, seed: int, **fields: Any) -> CrossvalResult:
    """Return the result of an evaluation; ``fields`` are those that held-out windows do not give."""
    segment = run_of(samples.group)
    result = CrossvalResult(
        **held_out_figures(held_out, samples.windows, samples.unit, segment, seed),
        unit="session" if has_sessions(samples.terrain, samples.windows.groups) else "run",
        n_sessions=len(np.setdiff1d(samples.windows.groups[:, 0], samples.run_id)),
        window_s=samples.windows.length_s,
        seed=seed,
        dropped=dict(samples.dropped),
        repaired=dict(samples.repaired),
        notes=(),
        **fields,
    )
    return replace(result, notes=result.weaknesses)


class Checks(NamedTuple):
    """What the checks beside the figures are made with."""

    classifier: Any
    looks: Looks
    own: bool  #: whether these are of the recipe that is evaluated


def _checks(
    recipe: WindowPipeline, features: Array, samples: Samples, settings: EvaluationSettings | RecipeSettings
) -> Checks:
    """Return what checks are made with: classifier and features of a recipe by the SVM, else the SVM's own."""
    if not (own := isinstance(recipe[-1], GroupedSVC)):
        recipe = recipe_of(settings, CHECKED_WITH)
        features = feature_matrix(recipe, samples.windows)
    end_s = samples.windows.start_s + samples.windows.length_s
    return Checks(recipe[-1], Looks(features, samples.observed, end_s), own)


def _over_time(held_out: HeldOut, windows: Windows, unit: Array, seed: int) -> Difference | None:
    """Return the accuracy of the first fold assignment by single windows, and by the filter through runs or sessions.

    The settings of each fold are those that its own training part chooses; belief goes on through the windows of its
    sessions that other folds hold out.  None of a classifier without inner folds.
    """
    terrain, end_s, groups = held_out.truth, windows.start_s + windows.length_s, windows.groups
    right = np.zeros((2, len(terrain)), dtype=bool)
    for fold, probability, _, _, _, inner in held_out.results:
        if fold.repeat or inner is None:
            continue
        train, test = fold.train, fold.test
        classes, counts = np.unique(terrain[train], return_counts=True)
        columns = np.searchsorted(held_out.classes, classes)
        prior = dict(zip(classes.tolist(), (counts / counts.sum()).tolist(), strict=True))
        of_training = terrain[train], end_s[train], groups[train], windows.length_s, prior
        settings = choose_settings(inner[:, columns], *of_training)
        right[:, test] = probability.argmax(axis=1) == np.searchsorted(held_out.classes, terrain[test])
        if settings is not None:
            along = np.flatnonzero(held_out.tested & np.isin(groups[:, 0], groups[test, 0]))
            of_sessions = end_s[along], groups[along], windows.length_s, settings
            found = reported(filter_sessions(held_out.probability[0][np.ix_(along, columns)], *of_sessions))
            mine = np.isin(along, test)
            right[1, along[mine]] = (found[mine] >= 0) & (classes[found[mine]] == terrain[along[mine]])
    rows = np.flatnonzero(held_out.tested)
    if not right.any():
        return None
    single, filtered = (
        Outcome(unit, terrain, each[None], np.ones((1, len(terrain)))).at(rows) for each in right
    )
    return compare_outcomes(single, filtered, np.random.default_rng(seed)).accuracy


def _refusals(
    dealt: tuple[Looks, Array, Array, int, int],
    held_out: HeldOut,
    groups: Array,
    n_jobs: int,
    progress: Progress,
) -> RefusalFigures:
    """Return how often the windows that the first fold assignment holds out are called unknown."""
    refused, rows = np.zeros(len(held_out.truth), dtype=bool), np.flatnonzero(held_out.tested)
    folds = [each.fold[2:] for each in held_out.results if each.fold.repeat == 0]
    found = parallel(refused_rows, dealt, folds, n_jobs, "refusals", progress)
    for (_, test), of_fold in zip(folds, found, strict=True):
        refused[test] = of_fold
    judged = held_out.correct[0, rows], held_out.truth[rows], groups[rows]
    return refusal_figures(refused[rows], *judged, dealt[-1])


def _extras(
    checks: Checks,
    samples: Samples,
    held_out: HeldOut,
    settings: EvaluationSettings | RecipeSettings,
    progress: Progress,
) -> dict[str, Any]:
    """Return the checks beside the figures, by field."""
    classifier, (features, _, _), own = checks
    windows, terrain, group, seed = samples.windows, samples.terrain, samples.group, settings.seed
    first = [result.fold for result in held_out.results if result.fold.repeat == 0]

    def accuracies(features: Array, folds: Sequence[Fold], task: str) -> list[float]:
        examples = Examples(features, terrain, group)
        return evaluate(classifier, examples, folds, settings.jobs, task, progress).accuracies

    full = held_out.accuracies[0] if own else accuracies(features, first, CHECKED_WITH)[0]
    speed_only = None
    if wheel_stream(windows.channels) is not None:
        wheels = FeatureExtractor(("wheels",), ("wheels",)).fit_transform(windows)
        speed_only = accuracies(wheels, first, "speed only")[0]
    side, slow_fast = slow_and_fast(samples)
    if slow_fast.status is Applicability.APPLICABLE:
        slow, fast = np.flatnonzero(side == "slow"), np.flatnonzero(side == "fast")
        both = accuracies(features, [Fold(0, 0, slow, fast), Fold(1, 0, fast, slow)], "slow to fast")
        slow_fast = slow_fast._replace(slow_to_fast=both[0], fast_to_slow=both[1])
    unit = "session" if has_sessions(terrain, group) else "run"
    drawn, runs_per_class = drawn_folds(terrain, group, first, seed)
    curve = accuracies(features, drawn, "learning curve") if drawn else []
    tracks = [track for result in held_out.results for track in result.found or ()]
    spliced = sequence_figures([track for track in tracks if track.spliced], seed)
    found = {
        "speed_only_accuracy": speed_only,
        "slow_fast": slow_fast,
        "learning_curve": learning_curve(runs_per_class, curve, full, unit),
        "courses": spliced,
        "recorded_courses": sequence_figures([track for track in tracks if not track.spliced], seed),
        "breakaways": breakaways(held_out, windows),
    }
    if spliced is not None:
        for name in ("filtered_accuracy", "filtered_accuracy_ci", "filter_delay_s"):
            found[name] = getattr(spliced, name)
    return found


def _notes(
    samples: Samples, recipe: WindowPipeline, settings: EvaluationSettings | RecipeSettings
) -> Iterator[str]:
    """Yield in sentences what a reader of the figures must know."""
    protocol, classifier = settings.protocol, recipe[-1]
    for group in samples.merged:
        yield (
            f"runs {', '.join(group)} hold the same measurements: they are one run, in which each stretch "
            "counts once"
        )
    alone = single_run_classes(samples.terrain, samples.run_id)
    if alone and protocol != "published":
        yield (
            f"{', '.join(alone)}: one run only, cut into {N_FOLDS} contiguous blocks with a gap; "
            "its figures are optimistic, the same run trains and tests"
        )
    once = single_run_classes(samples.terrain, samples.windows.groups[:, 0])
    if has_sessions(samples.terrain, samples.windows.groups) and (
        once := [each for each in once if each not in alone]
    ):
        yield (
            f"{', '.join(once)}: one session only, whose runs are divided into {N_FOLDS} parts: what another day does "
            "is not shown"
        )
    if PROTOCOLS[protocol].note:
        yield PROTOCOLS[protocol].note
    if not isinstance(classifier, GroupedSVC) and settings.extras and protocol == "grouped":
        yield f"speed alone, slow against fast and the learning curve are of recipe {CHECKED_WITH!r}"
    outputs = getattr(classifier, "outputs", "predict_proba")  # of a classifier of one's own
    if outputs == "decision_function":
        yield "the classifier gives no probabilities: its decisions were calibrated on inner held-out runs"
    if outputs == "predict":
        yield "the classifier gives no probabilities: each prediction counts as certain"
    if samples.dropped:
        yield f"windows left out: {format_counts(samples.dropped)}"
    if samples.repaired:
        yield f"changed or left out: {format_counts(samples.repaired)}"
