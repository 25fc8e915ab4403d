"""``terrain compare``: two recipes on the same folds, or two models on the same runs, paired by run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from features.motion import window_motion
from features.windows import cut_windows
from pipelines.compare.results import CompareReport
from pipelines.compare.settings import CompareSettings, Contender
from pipelines.crossval.crossval import samples_of
from pipelines.crossval.evaluation import HeldOut, fit_folds, pool
from pipelines.crossval.extras import examples_of
from pipelines.crossval.settings import CrossvalSettings
from pipelines.crossval.splits import Samples, folds_of
from pipelines.data.datasets import data_digest
from pipelines.learn.recipes import feature_matrix
from pipelines.models.model_files import TerrainModel
from pipelines.reporting.progress import Progress, silent
from pipelines.support.evaluate import Judged, held_out_support
from terrain.classify.paired import Comparison, Difference, Outcome, compare_outcomes
from terrain.classify.support import SupportLevel, support_levels
from terrain.errors import DataError
from terrain.records import Array, RunLog, Windows


def compare_recipes(
    runs: Sequence[RunLog],
    contenders: tuple[Contender, Contender],
    settings: CompareSettings,
    dataset: str,
    progress: Progress = silent,
) -> CompareReport:
    """Compare two recipes on the same folds of whole runs.

    Parameters
    ----------
    runs : labelled runs
    contenders : the two
    settings : windows, seed and number of fold assignments
    dataset : name of the data, for the record
    progress : called as the work goes on

    Raises
    ------
    DataError
        if the data do not suffice, or the two cut different windows from them.
    """
    evaluations = [settings.evaluation(each) for each in contenders]
    samples = [samples_of(runs, evaluation) for evaluation in evaluations]
    if not np.array_equal(samples[0].cut.windows.start_s, samples[1].cut.windows.start_s):
        raise DataError(
            "the two recipes keep different windows of these runs, whose streams end at different times: "
            "compare them on signal sets of the same streams"
        )
    held_out = [
        _held_out(each, evaluation, progress) for each, evaluation in zip(samples, evaluations, strict=True)
    ]
    windows = samples[0].cut.windows
    terrain = windows.terrain.astype(str)
    a, b = (outcome_of(each.classes, each.probability, windows.run_id, terrain) for each in held_out)
    report = _report(runs, settings, "recipes", (a, b), dataset, (), ())
    levels = _levels(held_out[0], windows)
    return report if levels is None else replace(report, by_support=_by_support(a, b, levels, settings.seed))


def _levels(held_out: HeldOut, windows: Windows) -> Array | None:
    """Return the level of support (n,) of each window's true terrain, by its median over the repeats."""
    motion = window_motion(windows)
    if motion is None:
        return None
    splits = [(each.fold.repeat, each.fold.train, each.fold.test) for each in held_out.results]
    run_id, terrain = windows.run_id.astype(str), windows.terrain.astype(str)
    judged = Judged(motion, run_id, terrain, held_out.classes, held_out.probability, splits, windows.length_s)
    return support_levels(np.median(held_out_support(judged).true_runs, axis=0))


def _by_support(a: Outcome, b: Outcome, levels: Array, seed: int) -> dict[str, Difference]:
    found = {}
    for level in SupportLevel:
        rows = np.flatnonzero(levels == level.value)
        if len(rows):
            of_a, of_b = (
                Outcome(
                    each.run_id[rows], each.terrain[rows], each.correct[:, rows], each.confidence[:, rows]
                )
                for each in (a, b)
            )
            found[level.value] = compare_outcomes(of_a, of_b, np.random.default_rng(seed)).accuracy
    return found


def _held_out(samples: Samples, evaluation: CrossvalSettings, progress: Progress) -> HeldOut:
    """Return what a recipe makes of held-out windows."""
    recipe, windows = evaluation.new_recipe(), samples.cut.windows
    examples = examples_of(feature_matrix(recipe, windows), samples)
    folds = folds_of(samples, "grouped", evaluation.n_repeats, evaluation.seed)
    results = fit_folds(recipe[-1], examples, folds, evaluation.jobs, evaluation.recipe, progress)
    return pool(results, examples.terrain)


def compare_models(
    runs: Sequence[RunLog],
    models: tuple[TerrainModel, TerrainModel],
    settings: CompareSettings,
    dataset: str,
) -> CompareReport:
    """Compare two models on the runs that neither was trained on.

    Parameters
    ----------
    runs : labelled runs
    models : the two; each cuts its own windows
    settings : names of the models, and the seed of the bootstrap
    dataset : name of the data, for the record

    Raises
    ------
    DataError
        if no run is left, or a run lacks a channel that a model requires.
    """
    trained = {digest for model in models for digest in model.info.run_digests}
    excluded = tuple(run.run_id for run in runs if data_digest([run]) in trained)
    kept = [run for run in runs if run.run_id not in excluded]
    if not kept:
        raise DataError(
            f"all {len(runs)} runs were used to train {settings.a} or {settings.b}: "
            "no run is left to compare on"
        )
    shared = sorted(set(models[0].info.classes) & set(models[1].info.classes))
    a, b = (_model_outcome(kept, model, shared) for model in models)
    notes = []
    if models[0].info.classes != models[1].info.classes:
        notes.append(
            f"the models have other classes: compared on windows of {', '.join(shared) or 'no terrain'}"
        )
    return _report(kept, settings, "models", (a, b), dataset, excluded, tuple(notes))


def _model_outcome(runs: Sequence[RunLog], model: TerrainModel, classes: Sequence[str]) -> Outcome:
    windows = cut_windows(runs, model.rule, layout=model.layout).windows
    windows = windows[np.isin(windows.terrain.astype(str), classes)]
    if not len(windows):
        raise DataError(
            f"no window of these runs is labelled as a class of both models ({', '.join(classes)})"
        )
    probability = np.asarray(model.recipe.predict_proba(windows))[None]
    return outcome_of(
        np.asarray(model.recipe.classes_, dtype=str), probability, windows.run_id, windows.terrain.astype(str)
    )


def outcome_of(classes: Array, probability: Array, run_id: Array, terrain: Array) -> Outcome:
    """Return which windows were classified correctly, and how confidently.

    Parameters
    ----------
    classes : (k,)
    probability : (repeats, n, k)
    run_id, terrain : (n,)
    """
    predicted = classes[probability.argmax(axis=2)]
    return Outcome(run_id.astype(str), terrain, predicted == terrain, probability.max(axis=2))


def _report(
    runs: Sequence[RunLog],
    settings: CompareSettings,
    kind: str,
    outcomes: tuple[Outcome, Outcome],
    dataset: str,
    excluded: tuple[str, ...],
    notes: tuple[str, ...],
) -> CompareReport:
    comparison: Comparison = compare_outcomes(*outcomes, np.random.default_rng(settings.seed))
    return CompareReport(
        dataset=dataset,
        data_digest=data_digest(runs),
        a=settings.a,
        b=settings.b,
        kind=kind,
        comparison=comparison,
        n_runs=len(np.unique(outcomes[0].run_id)),
        n_windows=outcomes[0].correct.shape[1],
        repeats=len(outcomes[0].correct),
        excluded_runs=excluded,
        notes=notes,
    )
