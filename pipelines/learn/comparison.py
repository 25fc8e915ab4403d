"""Several recipes on the same folds, or models on runs that none was trained on, side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from pipelines.learn.evaluation import (
    MAX_ROWS,
    PERCENT,
    CrossvalResult,
    notes,
    recall_figure,
    recall_table,
)
from pipelines.learn.settings import EvaluationSettings
from pipelines.report.numbers import enumerated, format_value, plural
from pipelines.report.results import Progress, Result, described
from pipelines.report.tree import Column, Part, Report, Section, Table
from terrain.errors import DataError

if TYPE_CHECKING:
    from features.protocols import Samples
    from features.recipes import WindowPipeline
    from pipelines.live.model import TerrainModel
    from terrain.classify.metrics import Comparison, Difference
    from terrain.records import RunLog

POINTS = "+.1f"


class ComparisonResult(Result):
    """Several recipes on the same folds, or several models on the same runs; each compared with the first."""

    kind: str = described("recipes or models")
    contenders: tuple[CrossvalResult, ...] = described("the evaluation of each")
    differences: tuple[Comparison, ...] = described("of each of the others less the first")
    excluded_runs: tuple[str, ...] = described("runs that one of the models was trained on")
    notes: tuple[str, ...] = described("what a reader has to know")
    dataset: str = described("name of the data", default="")
    data_digest: str = described("digest of the runs", default="")
    data: str = described("where the data lie", default="")

    def records(self) -> Iterable[Any]:
        """Return a row of figures for each contender."""
        return (row for each in self.contenders for row in Result.records(each))


def side_by_side(
    contenders: Sequence[tuple[str, WindowPipeline, Samples]],
    settings: EvaluationSettings,
    progress: Progress,
) -> CrossvalResult | ComparisonResult:
    """Evaluate a recipe, or several, each with the windows of its own signals, on the same folds.

    Parameters
    ----------
    contenders : name, recipe and samples of each
    settings, progress : as of :func:`pipelines.learn.evaluate.evaluate_recipe`

    Raises
    ------
    DataError
        if the data do not suffice, or two recipes cut different windows from them.
    """
    import numpy as np

    from features.motion import window_motion
    from pipelines.learn.evaluate import evaluate_recipe
    from terrain.classify.coverage import held_out_support
    from terrain.classify.limits import support_levels
    from terrain.classify.metrics import Outcome, compare_with_first

    first, _, samples = contenders[0]
    for name, _, other in contenders[1:]:
        if not np.array_equal(samples.windows.start_s, other.windows.start_s):
            raise DataError(
                f"{first} and {name} keep different windows of these runs, whose streams end at "
                "different times: compare them on signal sets of the same streams"
            )
    found = [evaluate_recipe(recipe, name, each, settings, progress) for name, recipe, each in contenders]
    if len(found) == 1:
        return found[0][0]
    (_, held_out), motion, levels = found[0], window_motion(samples.windows), None
    if motion is not None and settings.protocol != "published":
        true_runs = held_out_support(held_out, samples.run_id, motion)[0]
        levels = support_levels(np.median(true_runs, axis=0))[held_out.tested]
    outcomes = [Outcome.of(each, samples.unit) for _, each in found]
    differences = compare_with_first([name for name, *_ in contenders], outcomes, settings.seed, levels)
    return ComparisonResult("recipes", tuple(result for result, _ in found), differences, (), ())


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

    from features.protocols import Samples
    from features.windows import cut_windows
    from pipelines.learn.evaluate import evaluation_of
    from terrain.classify.held_out import HeldOut
    from terrain.classify.metrics import Outcome, compare_with_first

    excluded = tuple(each.run_id for each in runs if any(model.info.trained_on(each) for model in models))
    kept = [each for each in runs if each.run_id not in excluded]
    if not kept:
        raise DataError(
            f"all {len(runs)} runs were used to train {enumerated(settings.model, 'or')}: "
            "no run is left to compare on"
        )
    shared = sorted(set.intersection(*(set(model.info.classes) for model in models)))
    classes, notes = ", ".join(shared), []
    if any(model.info.classes != models[0].info.classes for model in models):
        notes.append(f"the models have other classes: compared on windows of {classes or 'no terrain'}")
    results, outcomes = [], []
    for name, model in zip(settings.model, models, strict=True):
        rule = model.info.rule
        cut = cut_windows(kept, rule, layout=model.info.layout)
        windows = cut.windows[np.isin(cut.windows.terrain.astype(str), shared)]
        if not len(windows):
            raise DataError(f"no window of these runs is labelled as a class of all models ({classes})")
        samples = Samples(windows, cut.dropped, windows.groups, rule.overlap)
        probability = np.asarray(model.recipe.predict_proba(windows))
        held_out = HeldOut.of_model(
            np.asarray(model.recipe.classes_, dtype=str), probability, samples.terrain
        )
        result = evaluation_of(
            held_out,
            samples,
            settings.seed,
            protocol="runs not trained on",
            recipe=name,
            stride_s=rule.step_s,
            steady=rule.steady is not None,
            signal_sets=tuple(model.info.signal_sets),
            n_features=0,
        )
        results.append(result)
        outcomes.append(Outcome.of(held_out, samples.unit))
    if len(results) == 1:
        left_out = f"{plural(len(excluded), 'run')} left out: the model was trained on them"
        return replace(results[0], notes=(*results[0].notes, *([left_out] if excluded else [])))
    differences = compare_with_first(settings.model, outcomes, settings.seed)
    return ComparisonResult("models", tuple(results), differences, excluded, tuple(notes))


def report(result: ComparisonResult) -> Report:
    """Return the report: the best of the others against the first, all side by side, and each alone, folded."""
    first, what = result.contenders[0], result.dataset or "windows"
    best = max(result.differences, key=lambda each: each.accuracy.b)
    found, (apart, ends, verdict) = best.accuracy, _points(best.accuracy)
    rows: list[tuple[Any, ...]] = []
    for each, compared in zip(result.contenders, (None, *result.differences), strict=True):
        points = (None, None, None) if compared is None else _points(compared.accuracy)
        rows.append((each.recipe, each.accuracy, each.macro_run_accuracy, each.confidence_auc, *points))
    left_out = f"{plural(len(result.excluded_runs), 'run')} left out: one of the models was trained on them"
    ratios = [Column(name, PERCENT) for name in ("accuracy", "mean over runs")]
    columns: list[Column | str] = [
        result.kind,
        *ratios,
        Column("confidence", ".2f"),
        DIFFERENCE,
        INTERVAL,
        "is",
    ]
    note = f"Differences are to {first.recipe}; confidence: area from confidence to correctness."
    pairs = [Section(f"{each.b} less {each.a}", partial(_paired, each)) for each in result.differences]
    alone = [
        Section(f"{each.recipe} alone", [recall_table(each), *notes(*each.notes)])
        for each in result.contenders
    ]
    return Report(
        title=f"{enumerated([each.recipe for each in result.contenders])} on {what}",
        answer=(
            f"{best.b} classifies {format_value(found.b, PERCENT)} of windows correctly, {best.a} "
            f"{format_value(found.a, PERCENT)}: {format_value(apart, POINTS)} points "
            f"({format_value(ends, POINTS)}, {first.over}, paired), {verdict}, "
            f"{first.held_out}."
        ),
        lead=(
            f"{what}: {plural(first.n_windows, 'window')} of {plural(first.n_runs, 'run')}, "
            f"{plural(first.repeats, 'fold assignment')}"
        ),
        picture=recall_figure(result.contenders),
        parts=[
            Table(columns, rows, note=note),
            *notes(*result.notes, *([left_out] if result.excluded_runs else ())),
        ],
        details=[*pairs, *alone],
        next_step=f"terrain train --data {result.data or 'DIR'} --recipe RECIPE --name NAME"
        if result.kind == "recipes"
        else f"terrain predict --model {best.b if apart > 0 else best.a} --data DIR",
    )


DIFFERENCE = Column("difference", POINTS, "points")
INTERVAL = Column("95 %, paired", POINTS, "points")


def _points(found: Difference) -> tuple[float, tuple[float, float], str]:
    """Return a difference and its interval in percentage points, and its verdict."""
    low, high = found.interval
    reason = f": {found.reason}" if found.reason else ""
    return 100 * found.difference, (100 * low, 100 * high), f"{found.verdict}{reason}"


def _paired(found: Comparison) -> list[Part]:
    figures = {
        "accuracy": found.accuracy,
        "mean over terrains then runs": found.macro_run_accuracy,
        "from confidence to correctness": found.confidence_auc,
        **{f"accuracy on {name}": row for name, row in found.by_class.items()},
        **{f"accuracy, {level}": row for level, row in found.by_support.items()},
    }
    both = Column(found.a, PERCENT), Column(found.b, PERCENT)
    rows = [(name, row.a, row.b, *_points(row), row.n_units) for name, row in figures.items()]
    runs = sorted((row for row in found.by_unit if row.a != row.b), key=lambda row: -abs(row.b - row.a))
    return [
        Table(("figure", *both, DIFFERENCE, INTERVAL, f"{found.b} is", "units"), rows),
        Table(
            ("run or session", "terrain", *both),
            [tuple(row) for row in runs[:MAX_ROWS]],
            "Those that differ most",
        ),
    ]
