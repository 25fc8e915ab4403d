"""Several recipes on the same folds, or models on runs that none was trained on, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from pipelines.learn.evaluation import (
    MAX_ROWS,
    PERCENT,
    CrossvalResult,
    evaluate_recipe,
    held_out_words,
    recall_figure,
    recall_table,
)
from pipelines.learn.settings import EvaluationSettings
from pipelines.report import (
    Column,
    Progress,
    Report,
    Result,
    Section,
    Table,
    Text,
    described,
    enumerated,
    format_value,
    plural,
    silent,
)
from terrain.errors import DataError

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.learn.evaluate import HeldOut
    from pipelines.learn.model_file import TerrainModel
    from pipelines.learn.protocols import Samples
    from pipelines.learn.recipes import WindowPipeline
    from terrain.classify.paired import Difference, Outcome, RunDifference
    from terrain.records import RunLog

POINTS = "+.1f"


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
    return side_by_side(contenders, settings.with_(extras=False), progress)


def side_by_side(
    contenders: Sequence[tuple[str, WindowPipeline, Samples]],
    settings: EvaluationSettings,
    progress: Progress,
) -> ComparisonResult:
    """Evaluate recipes, each with the windows of its own signals, on the same folds."""
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
    return Report(
        title=f"{enumerated([each.recipe for each in result.contenders])} on {what}",
        answer=(
            f"{best.b} classifies {format_value(found.b, PERCENT)} of windows correctly, {best.a} "
            f"{format_value(found.a, PERCENT)}: {format_value(apart, POINTS)} points "
            f"({format_value(ends, POINTS)}, 95 % over runs, paired), {verdict}."
        ),
        lead=(
            f"{what}: {plural(first.n_windows, 'window')} of {plural(first.n_runs, 'run')}, "
            f"{held_out_words(first.protocol)}, {plural(first.repeats, 'fold assignment')}"
        ),
        picture=recall_figure(result.contenders),
        parts=[
            Table(
                (
                    *(result.kind, Column("accuracy", PERCENT), Column("mean over runs", PERCENT)),
                    *(Column("confidence", ".2f"), DIFFERENCE, INTERVAL, "is"),
                ),
                rows,
                note=f"Differences are to {first.recipe}; confidence: area from confidence to correctness.",
            ),
            *(Text(note, "note") for note in (*result.notes, *([left_out] if result.excluded_runs else ()))),
        ],
        details=(
            *(_paired(each) for each in result.differences),
            *(
                Section(
                    f"{each.recipe} alone", [recall_table(each), *(Text(note, "note") for note in each.notes)]
                )
                for each in result.contenders
            ),
        ),
        next_step=f"terrain train --data {result.data or 'DIR'} --recipe RECIPE --name NAME"
        if result.kind == "recipes"
        else f"terrain predict --model {best.b if apart > 0 else best.a} --data DIR",
    )


DIFFERENCE = Column("difference", POINTS, "points")
INTERVAL = Column("95 % over runs, paired", POINTS, "points")


def _points(found: Difference) -> tuple[float, tuple[float, float], str]:
    """Return a difference and its interval in percentage points, and its verdict."""
    low, high = found.interval
    return 100 * found.difference, (100 * low, 100 * high), str(found.verdict)


def _paired(found: PairedDifferences) -> Section:
    figures = {
        "accuracy": found.accuracy,
        "mean over terrains then runs": found.macro_run_accuracy,
        "from confidence to correctness": found.confidence_auc,
        **{f"accuracy on {name}": row for name, row in found.by_class.items()},
        **{f"accuracy, {level}": row for level, row in found.by_support.items()},
    }
    both = Column(found.a, PERCENT), Column(found.b, PERCENT)
    rows = [(name, row.a, row.b, *_points(row), row.n_runs) for name, row in figures.items()]
    runs = sorted((row for row in found.by_run if row.a != row.b), key=lambda row: -abs(row.b - row.a))
    parts = [
        Table(("figure", *both, DIFFERENCE, INTERVAL, f"{found.b} is", "runs"), rows),
        Table(("run", "terrain", *both), [tuple(row) for row in runs[:MAX_ROWS]], "Runs that differ most"),
    ]
    return Section(f"{found.b} less {found.a}", parts)
