"""``terrain crossval``: how well a recipe does on held-out runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import NamedTuple

from sklearn.base import BaseEstimator, clone

from features.extractor import FeatureExtractor
from features.motion import NO_MOTION, Motion, window_motion
from pipelines.courses.following import following
from pipelines.courses.judgement import find_breakaways, judge
from pipelines.courses.results import OverTime
from pipelines.crossval.evaluation import Examples, HeldOut, fit_folds, pool, sets_of, summarise
from pipelines.crossval.extras import (
    examples_of,
    fold_accuracy,
    has_speed,
    learning_curve,
    slow_fast,
    speed_split,
)
from pipelines.crossval.results import CrossvalReport, Extras, Figures
from pipelines.crossval.settings import SPEED_PROTOCOLS, CrossvalSettings
from pipelines.crossval.splits import (
    N_FOLDS,
    Fold,
    Samples,
    folds_of,
    grouped_samples,
    published_samples,
)
from pipelines.crossval.stiffness import stiffness_figures
from pipelines.crossval.unknown import leave_terrain_out
from pipelines.data.duplicates import distinct_runs
from pipelines.data.regimes import driven_at
from pipelines.learn.evaluate import weaknesses
from pipelines.learn.recipes import WindowPipeline, feature_matrix
from pipelines.reporting.numbers import format_counts
from pipelines.reporting.progress import Progress, silent
from pipelines.support.evaluate import Judged, support_report
from terrain.classify.folds import single_run_classes
from terrain.errors import DataError
from terrain.records import RunLog, Windows

CHECKED_WITH = "svm"
"""The recipe of the checks beside the figures."""


def crossval(
    runs: Sequence[RunLog], settings: CrossvalSettings, progress: Progress = silent
) -> CrossvalReport:
    """Cross-validate a recipe on labelled runs; extras are computed under ``grouped`` only.

    Raises
    ------
    DataError
        if the data cannot answer: one class, fewer runs than folds, a run shorter than a window.
    """
    samples = samples_of(runs, settings)
    speed = None
    if settings.protocol in SPEED_PROTOCOLS:
        speed = speed_split(samples, settings.protocol)
        samples, folds = speed.samples, [speed.fold]
    else:
        folds = folds_of(samples, settings.protocol, settings.n_repeats, settings.seed)
    windows = samples.cut.windows
    recipe = settings.new_recipe()
    progress("features", 0, 1)
    features = feature_matrix(recipe, windows)
    progress("features", 1, 1)
    examples = examples_of(features, samples)
    beside = settings.extras and settings.protocol == "grouped"
    asks = None
    if beside:
        followed = following(recipe, samples.runs, windows, settings.rule, folds, settings.seed)
        asks = [each.follow for each in followed]
    results = fit_folds(recipe[-1], examples, folds, settings.jobs, settings.protocol, progress, asks)
    held_out = pool(results, examples.terrain)
    figures = summarise(held_out, samples, settings.seed)
    extras = None
    checks = _checks(recipe, examples, windows, settings)
    if beside:
        first = [fold for fold in folds if fold.repeat == 0]
        accuracy = figures.accuracy_per_repeat[0] if settings.recipe == CHECKED_WITH else None
        extras = _extras(checks, samples, first, accuracy, settings, progress)
        extras = extras._replace(over_time=_over_time(held_out, windows, settings.seed))
        extras = extras._replace(
            stiffness=stiffness_figures(held_out, checks.examples.features, samples, settings.seed)
        )
    repaired = dict(sum((Counter(run.dropped) for run in runs), Counter()))
    report = report_of(figures, samples, settings, features.shape[1], repaired, extras)
    if speed is not None:
        report = replace(report, notes=(speed.note, *report.notes))
    if settings.protocol != "published":
        report = with_limits(report, held_out, samples, window_motion(windows))
    if settings.protocol == "leave-terrain-out":
        unknown = leave_terrain_out(checks.examples, samples, settings.seed, settings.jobs, progress)
        report = replace(report, unknown=unknown)
    return report


def report_of(
    figures: Figures,
    samples: Samples,
    settings: CrossvalSettings,
    n_features: int,
    repaired: Mapping[str, int],
    extras: Extras | None,
) -> CrossvalReport:
    """Return the report of a cross-validation.

    Parameters
    ----------
    figures : of merit
    samples, settings : that they were found with
    n_features : features of a window
    repaired : what a repairing reader dropped, as counts by kind
    extras : checks beside the figures; None where there are none
    """
    published = settings.protocol == "published"
    return CrossvalReport(
        **{each.name: getattr(figures, each.name) for each in fields(Figures)},
        protocol=settings.protocol,
        recipe=settings.recipe,
        window_s=settings.rule.length_s,
        stride_s=None if published else settings.rule.step_s,
        steady=settings.rule.steady is not None and not published,
        signal_sets=settings.signal_sets,
        seed=settings.seed,
        n_features=n_features,
        dropped=dict(samples.cut.dropped),
        repaired=dict(repaired),
        notes=(*notes(samples, settings, repaired), *weaknesses(figures.accuracy_ci, figures.chance)),
        extras=extras,
    )


class _Checks(NamedTuple):
    """The classifier and the features that the checks beside the figures are made with."""

    classifier: BaseEstimator
    examples: Examples


def _checks(
    recipe: WindowPipeline, examples: Examples, windows: Windows, settings: CrossvalSettings
) -> _Checks:
    """Return the SVM and its features whatever the recipe: the checks are of the data and have many fits."""
    if settings.recipe == CHECKED_WITH:
        return _Checks(recipe[-1], examples)
    svm = settings.model_copy(update={"recipe": CHECKED_WITH}).new_recipe()
    return _Checks(svm[-1], examples._replace(features=feature_matrix(svm, windows)))


def _extras(
    checks: _Checks,
    samples: Samples,
    folds: Sequence[Fold],
    accuracy: float | None,
    settings: CrossvalSettings,
    progress: Progress,
) -> Extras:
    """Return the checks beside an ``accuracy`` that was found on ``folds``, or is found here."""
    (classifier, examples), windows, jobs = checks, samples.cut.windows, settings.jobs
    if accuracy is None:
        accuracy = fold_accuracy(classifier, examples, folds, jobs, "svm", progress)
    speed_only = None
    if has_speed(windows):
        speed = FeatureExtractor(("wheels",), ("wheels",)).fit_transform(windows)
        speed_only = fold_accuracy(
            clone(classifier), examples_of(speed, samples), folds, jobs, "speed only", progress
        )
    return Extras(
        speed_only,
        slow_fast(classifier, examples.features, samples, jobs, progress),
        learning_curve(classifier, examples, folds, accuracy, settings.seed, jobs, progress),
    )


def _over_time(held_out: HeldOut, windows: Windows, seed: int) -> OverTime:
    """Return what held-out runs show over time."""
    tracks = [track for result in held_out.results for track in result.found]
    return OverTime(
        judge([track for track in tracks if track.spliced], seed),
        judge([track for track in tracks if not track.spliced], seed),
        find_breakaways(held_out.probability.mean(axis=0), held_out.classes, windows),
    )


def with_limits(
    report: CrossvalReport, held_out: HeldOut, samples: Samples, motion: Motion | None
) -> CrossvalReport:
    """Return a report with the support of its held-out windows, and the figures of sets of classes.

    Parameters
    ----------
    report : of the cross-validation
    held_out, samples : its probabilities and windows, which need not have samples
    motion : how the robot moved in each window; where it is None, the reason is noted
    """
    report = replace(report, conformal=sets_of(held_out, samples, report.seed))
    if motion is None:
        return replace(report, notes=(*report.notes, f"support: {NO_MOTION}"))
    windows = samples.cut.windows
    splits = [(each.fold.repeat, each.fold.train, each.fold.test) for each in held_out.results]
    run_id, terrain = windows.run_id.astype(str), windows.terrain.astype(str)
    judged = Judged(motion, run_id, terrain, held_out.classes, held_out.probability, splits, windows.length_s)
    return replace(report, support=support_report(judged, report.seed))


def samples_of(runs: Sequence[RunLog], settings: CrossvalSettings) -> Samples:
    """Cut the windows that the protocol asks for.

    Raises
    ------
    DataError
        if runs hold the same measurements and are not to be merged, or the data do not fit the protocol.
    """
    if settings.speed_mps is not None:
        runs = [run for run in runs if driven_at(run, *settings.speed_mps)]
        if not runs:
            raise DataError(f"no run is driven at a speed of {settings.speed} m/s")
    distinct = distinct_runs(runs, merge=settings.merge_duplicates)
    if settings.protocol == "published":
        samples = published_samples(distinct.runs, settings.rule, settings.signal_sets)
    else:
        samples = grouped_samples(
            distinct.runs, settings.rule, settings.signal_sets, skip_short=settings.skip_short
        )
    _refuse_constant(samples.cut.windows)
    return samples._replace(merged=distinct.merged, runs=distinct.runs)


def _refuse_constant(windows: Windows) -> None:
    if not any((values != values[:1, :, :1]).any() for values in windows.values.values()):
        streams = " and ".join(repr(name) for name in windows.values)
        raise DataError(f"no channel of the streams {streams} ever varies: nothing can be learned from them")


def merge_notes(merged: Sequence[Sequence[str]]) -> list[str]:
    """Return in a sentence each what groups of runs were taken for one run."""
    return [
        f"runs {', '.join(group)} hold the same measurements: they are one run, in which each stretch "
        "counts once"
        for group in merged
    ]


def notes(samples: Samples, settings: CrossvalSettings, repaired: Mapping[str, int]) -> list[str]:
    """Return in sentences what a reader of the figures must know."""
    sentences = merge_notes(samples.merged)
    windows = samples.cut.windows
    alone = single_run_classes(windows.terrain.astype(str), windows.run_id.astype(str))
    if alone and settings.protocol != "published":
        sentences.append(
            f"{', '.join(alone)}: one run only, cut into {N_FOLDS} contiguous blocks with a gap; "
            "its figures are optimistic, the same run trains and tests"
        )
    if settings.protocol == "published":
        sentences.append(
            "published protocol: parts of one run lie on both sides of the split; "
            "for comparison with papers only"
        )
    if settings.recipe != CHECKED_WITH and settings.extras and settings.protocol == "grouped":
        sentences.append(
            f"speed alone, slow against fast and the learning curve are of recipe {CHECKED_WITH!r}"
        )
    if settings.protocol == "leave-terrain-out":
        sentences.append("accuracy and the table of classes are of folds in which all terrains are known")
    if samples.cut.dropped:
        sentences.append(f"windows left out: {format_counts(samples.cut.dropped)}")
    if repaired:
        sentences.append(f"changed or left out in reading the logs: {format_counts(repaired)}")
    return sentences
