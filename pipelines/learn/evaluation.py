"""What an evaluation on held-out windows finds, how it is found, and its report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeAlias

from pipelines.learn.settings import FEATURE_RECIPE, EvaluationSettings
from pipelines.report import (
    Bars,
    Column,
    Figure,
    Line,
    Mark,
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
    format_counts,
    format_value,
    interval,
    plural,
    silent,
)

if TYPE_CHECKING:
    import pandas as pd

    from features.motion import Motion
    from pipelines.learn.checks import LearningCurve, SlowFast, StiffnessFigures
    from pipelines.learn.coverage import NextDrive, SupportRow
    from pipelines.learn.evaluate import Examples, FoldFigures, HeldOut
    from pipelines.learn.protocols import Fold, Samples
    from pipelines.learn.recipes import WindowPipeline
    from pipelines.learn.sequences import Breakaway
    from terrain.classify.confidence import CoverageFigures, ReliabilityBin
    from terrain.classify.conformal_figures import ConformalFigures
    from terrain.classify.metrics import ClassFigures, RunFigures
    from terrain.classify.sequence_figures import DelayFigures, SequenceFigures
    from terrain.classify.support_figures import PartFigures
    from terrain.classify.unknown_figures import LeftOutTerrain
    from terrain.records import RunLog

CHECKED_WITH = FEATURE_RECIPE
"""The recipe of the checks beside the figures: they are of the data, and have many fits."""

MAX_ROWS = 10
PERCENT = ".1%"


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


def evaluate_recipe(
    recipe: WindowPipeline,
    name: str,
    samples: Samples,
    settings: EvaluationSettings,
    progress: Progress = silent,
    cached: tuple[Any, Motion | None] | None = None,
    ask: Callable[[Examples, Fold], Callable[[Any], Any] | None] | None = None,
) -> tuple[CrossvalResult, HeldOut]:
    """Evaluate a recipe on windows by the protocol of the settings; also return its held-out probabilities.

    Parameters
    ----------
    recipe, name : unfitted, and as it is named
    samples : labelled windows with their groups
    settings : protocol, repeats, seed, processes and extras
    progress : called as the work goes on
    cached : features (n, f) and motion of the windows, where they are there already
    ask : gives for each fold what is called with its fitted classifier, which is then fitted on all windows, too;
        not together with extras

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
    elif ask is not None:
        follow = [ask(examples, fold) for fold in folds]
    on_all = ask is not None
    held_out = evaluate(recipe[-1], examples, folds, jobs, protocol, progress, follow, on_all)
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
    from pipelines.learn.sequences import breakaways_of
    from terrain.classify.sequence_figures import sequence_figures

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
    from pipelines.learn.protocols import PROTOCOLS, notes_of
    from terrain.classify.svm import GroupedSVC

    protocol, classifier = settings.protocol, recipe[-1]
    if protocol in ("slow-fast", "fast-slow"):
        yield f"{PROTOCOLS[protocol].held_out}, on either side of the median speed of each terrain"
    yield from notes_of(samples, protocol)
    if not isinstance(classifier, GroupedSVC) and settings.extras and protocol == "grouped":
        yield f"speed alone, slow against fast and the learning curve are of recipe {CHECKED_WITH!r}"
    outputs = getattr(classifier, "outputs", "predict_proba")  # of a classifier of one's own
    if outputs == "decision_function":
        yield "the classifier gives no probabilities: its decisions were calibrated on inner held-out runs"
    if outputs == "predict":
        yield "the classifier gives no probabilities: each prediction counts as certain"
    if protocol == "leave-terrain-out":
        yield "accuracy and the table of classes are of folds in which all terrains are known"
    if samples.dropped:
        yield f"windows left out: {format_counts(samples.dropped)}"
    if samples.repaired:
        yield f"changed or left out in reading the logs: {format_counts(samples.repaired)}"


def report(result: CrossvalResult) -> Report:
    """Return the report: the accuracy on held-out runs, each terrain, what to do next, and the rest folded."""
    dataset, curve = result.dataset or "windows", result.learning_curve
    decide: list[tuple[Any, ...]] = [("always the most frequent terrain", result.chance, PERCENT)]
    if curve is not None:
        decide.append(("from wheel speed alone", result.speed_only_accuracy, PERCENT))
        decide.append(("number of runs", curve.statement))
    if result.auroc_unknown is not None:
        decide.append(("a terrain never learned: area of the novelty score", result.auroc_unknown, ".3f"))
        decide.append(("  its windows taken for a known one", result.unknown_accepted, PERCENT))
    if result.next_drives:
        decide.append(("record next", result.next_drives[0].request))
    lead = (
        f"{dataset}, recipe {result.recipe}: {plural(result.n_windows, 'window')} of {result.window_s:g} s from "
        f"{plural(result.n_runs, 'run')}, protocol {result.protocol}"
    )
    return Report(
        title=f"Evaluation on held-out runs of {dataset}",
        answer=(
            f"{format_value(result.accuracy, PERCENT)} of windows classified correctly, "
            f"{held_out_words(result.protocol)} ({interval(*result.accuracy_ci, PERCENT)}, 95 % over runs)."
        ),
        lead=lead,
        picture=recall_figure([result]),
        parts=[
            recall_table(result),
            Pairs(decide),
            *(Text(note, "note") for note in (*result.notes, *(result.skipped or ()))),
        ],
        details=tuple(_details(result)),
        next_step=f"terrain train --data {result.data or 'DIR'} --recipe {result.recipe} --name NAME",
    )


def held_out_words(protocol: str) -> str:
    """Return what a protocol holds out, in words."""
    from pipelines.learn.protocols import PROTOCOLS

    return PROTOCOLS[protocol].held_out if protocol in PROTOCOLS else protocol


def recall_figure(results: Sequence[CrossvalResult]) -> Figure:
    """Return a bar for each terrain and result."""
    marks = [
        Bars(each.recipe, each.classes, [row.recall for row in each.per_class.values()]) for each in results
    ]
    return Figure(
        "Windows of each terrain that are classified correctly",
        [Panel(marks, x_range=(0.0, 1.0))],
        caption="Recall of each terrain on held-out windows.",
    )


def recall_table(result: CrossvalResult) -> Table:
    """Return the figures of each terrain; of many, the worst ones."""
    rows = [(name, *row) for name, row in result.per_class.items()]
    worst = sorted(rows, key=lambda row: row[2])[:MAX_ROWS]
    columns = (
        "terrain",
        Column("precision", PERCENT),
        Column("recall", PERCENT),
        Column("F1", ".3f"),
        "windows",
    )
    note = "" if len(rows) <= MAX_ROWS else f"the {MAX_ROWS} worst of {len(rows)} terrains"
    return Table(columns, [row for row in rows if row in worst], note=note)


Columns: TypeAlias = dict[str, Column | str]
ACCURACY: Column | str = Column("accuracy", PERCENT)


def _table(records: Iterable[Any], columns: Columns, title: str = "", note: str = "") -> Table:
    """Return the fields of records that columns are named after."""
    rows = [tuple(getattr(each, name) for name in columns) for each in records]
    return Table(tuple(columns.values()), rows, title, note)


def _details(result: CrossvalResult) -> Iterator[Section]:
    """Yield what is folded: confusion, runs, confidence, coverage, checks, time, and how it was done."""
    counts = [
        (name, row, max(sum(row), 1)) for name, row in zip(result.classes, result.confusion, strict=True)
    ]
    shaded = [Column(name, ".0%", shade=True) for name in result.classes]
    confusion = Table(
        ("true terrain", *shaded), [(name, *(n / total for n in row)) for name, row, total in counts]
    )
    yield Section(
        "Confusion",
        [
            confusion,
            Text(
                "A row is a true terrain and adds up to 100 %; dark cells off the diagonal are what it is mistaken for."
            ),
        ],
    )
    of_run: Columns = {"run_id": "run", "terrain": "terrain", "n_windows": "windows"}
    of_run = of_run | {"accuracy": ACCURACY, "mistaken_for": "mistaken for"}
    worst = sorted(result.per_run, key=lambda row: row.accuracy)
    yield Section(
        "Runs",
        [
            _table(
                worst, of_run, note="The worst first. One long bad run weighs more than several short ones."
            )
        ],
    )
    yield _confidence(result)
    if result.support is not None:
        yield _coverage(result)
    if result.learning_curve is not None:
        yield _checks(result)
    if result.courses is not None or result.recorded_courses is not None or result.breakaways:
        yield _over_time(result)
    if result.unknown_by_terrain is not None:
        yield _unknown(result)
    done = [
        ("balanced accuracy", result.balanced_accuracy, PERCENT),
        ("macro F1", result.macro_f1, ".3f"),
        ("mean over terrains, then runs", result.macro_run_accuracy, PERCENT),
        (f"vote over 5 s ({result.vote_windows:.1f} windows)", result.vote_accuracy, PERCENT),
        ("fold assignments", result.repeats),
        ("  spread over them", result.accuracy_spread, PERCENT),
        ("window, stride", f"{result.window_s:g} s, {result.stride_s or result.window_s:g} s"),
        ("steady motion alone", result.steady),
        ("signal sets", ", ".join(result.signal_sets)),
        ("features, seed", f"{result.n_features}, {result.seed}"),
        ("data digest", result.data_digest),
    ]
    of_fold = ("repeat", "fold", "trained on", "tested on", ACCURACY, "chosen")
    folds = [
        (*row[:5], ", ".join(f"{name} {value}" for name, value in row.chosen.items())) for row in result.folds
    ]
    yield Section("How it was done", [Pairs(done), Table(of_fold, folds)])


def _confidence(result: CrossvalResult) -> Section:
    bins = result.reliability
    low, high = zip(*(each.accuracy_ci for each in bins), strict=True) if bins else ((), ())
    stated, right = [each.confidence for each in bins], [each.accuracy for each in bins]
    marks: list[Mark] = [
        Line("as stated", [0.0, 1.0], [0.0, 1.0], dashed=True),
        Points("windows by confidence", stated, right, low, high),
    ]
    rows = [
        ("area from confidence to correctness", result.confidence_auc, ".2f"),
        ("  95 % over runs", result.confidence_auc_ci, ".2f"),
        ("calibration error", result.ece, ".3f"),
        *(
            (f"right of the most confident {row.coverage:.0%}", row.accuracy, PERCENT)
            for row in result.accuracy_at_coverage
        ),
    ]
    sets = result.conformal
    if sets is not None:
        rows += [
            (f"sets of terrains at {sets.level:.0%} that hold the true one", sets.coverage, PERCENT),
            ("  95 % over runs", sets.coverage_ci, PERCENT),
            ("  in the worst run", sets.coverage_worst_run, PERCENT),
            ("  terrains in a set", sets.set_size, ".2f"),
            ("  sets with one terrain", sets.single_ratio, PERCENT),
        ]
    panel = Panel(marks, "classified correctly", x_range=(0.0, 1.0), y_range=(0.0, 1.0))
    caption = (
        "Each point is a bin of equally many windows; below the line, predictions are wrong more often than their "
        "probability says."
    )
    figure = Figure(
        "Confidence and accuracy", [panel], caption, x_label="probability of the predicted terrain"
    )
    return Section("Confidence", [Pairs(rows), figure])


def _coverage(result: CrossvalResult) -> Section:
    names = ("windows_ratio", "accuracy", "accuracy_ci", "errors_ratio")
    rows = [(each["support"], *(each[name] for name in names)) for each in result.accuracy_by_support or ()]
    for text, part in (
        ("unsupported prediction", result.unsupported),
        ("other predictions", result.supported),
    ):
        rows.append((text, *(getattr(part, name) for name in names)))
    head = [Column(name, PERCENT) for name in ("windows", "accuracy", "95 % over runs", "of the errors")]
    cells = {(row.terrain, row.regime): row.accuracy for row in result.support or ()}
    regimes = list(dict.fromkeys(regime for _, regime in cells))
    driven = [(name, *(cells.get((name, regime)) for regime in regimes)) for name in result.classes]
    shaded = [Column(name, ".0%", shade=True) for name in regimes]
    of_drive: Columns = {
        "request": "record next",
        "support_runs": Column("runs near it", ".1f"),
        "windows": "windows",
    }
    note = "The drive that is expected to gain most first; the order alone is to be relied on."
    return Section(
        "Training coverage",
        [
            Table(("training runs near the motion", *head), rows),
            Table(("terrain", *shaded), driven, "Accuracy by terrain and driving"),
            _table((result.next_drives or ())[:MAX_ROWS], of_drive | {"accuracy": ACCURACY}, note=note),
        ],
    )


def _checks(result: CrossvalResult) -> Section:
    found, curve, levels = result.slow_fast, result.learning_curve, result.stiffness
    assert found is not None
    assert curve is not None
    out = [f"{name} left out ({reason})" for name, reason in found.left_out.items()]
    rows: list[tuple[Any, ...]] = [
        ("from wheel speed alone", result.speed_only_accuracy, PERCENT),
        ("trained on slow runs, tested on fast ones", found.slow_to_fast, PERCENT),
        ("the reverse", found.fast_to_slow, PERCENT),
        ("slow and fast runs", "; ".join([str(found.status), *out])),
    ]
    if levels is not None:
        rows += [
            ("stiffness level right", levels.accuracy, PERCENT),
            ("  95 % over runs", levels.accuracy_ci, PERCENT),
            ("soft and hard confused", levels.soft_hard_ratio, PERCENT),
            ("cost of confusing levels, a window", levels.cost, ".3f"),
            ("  by the class of least expected cost", levels.least_cost, ".3f"),
            ("  gain, 95 % over runs", levels.gain_ci, ".4f"),
        ]
    if levels is not None and levels.clusters is not None:
        rows += [
            ("clusters of runs without labels", levels.clusters.n_clusters),
            ("  adjusted Rand index with the levels", levels.clusters.adjusted_rand, ".2f"),
            ("  95 % over runs", levels.clusters.interval, ".2f"),
        ]
    runs, right = curve.runs_per_class, curve.accuracy
    spread = [(a, std or 0.0) for a, std in zip(right, curve.accuracy_spread, strict=True)]
    low, high = [a - std for a, std in spread], [a + std for a, std in spread]
    marks: list[Mark] = [Line("", runs, right, 0), Points("held-out runs", runs, right, low, high, 0)]
    caption = (
        "What each further run brought; where it still rises at its right end, more runs help. Bars: one standard "
        "deviation over draws of runs."
    )
    figure = Figure(
        "Learning curve", [Panel(marks, "accuracy")], caption, x_label="training runs of each terrain"
    )
    return Section("Checks of the data", [Pairs(rows), figure])


def _over_time(result: CrossvalResult) -> Section:
    rows: list[tuple[Any, ...]] = []
    for name, each in (("spliced", result.courses), ("recorded", result.recorded_courses)):
        if each is not None:
            delay = each.filter_delay_s
            missed = f"{delay.n_missed} of {delay.n_changes}"
            right = (name, each.filtered_accuracy, each.filtered_accuracy_ci, each.single_accuracy)
            flips = (each.flips_per_minute, each.single_flips_per_minute)
            rows.append((*right, delay.p50, delay.p90, missed, *flips))
    accuracy = [Column(name, PERCENT) for name in ("filter", "95 % over runs", "last window")]
    delays = [Column(name, ".1f", "s") for name in ("delay", "90 % within")]
    flips_a_minute = [Column(name, ".1f", "1/min") for name in ("false changes", "of windows")]
    of_stretch: Columns = {
        "run_id": "run",
        "start_s": Column("from", ".1f", "s"),
        "end_s": Column("to", ".1f", "s"),
    }
    of_stretch = of_stretch | {
        "label": "label",
        "looks_like": "looks like",
        "probability": Column("by", ".2f"),
    }
    parts: list[Part] = [Table(("sequences", *accuracy, *delays, "missed", *flips_a_minute), rows)]
    if result.breakaways:
        title = "Stretches that look like another terrain than the rest of their run"
        parts.append(_table(result.breakaways[:MAX_ROWS], of_stretch, title))
    return Section("Terrain over time, on sequences over several terrains", parts)


def _unknown(result: CrossvalResult) -> Section:
    rows = [
        ("area under the ROC curve, a window", result.auroc_unknown, ".3f"),
        ("  95 % over runs", result.auroc_unknown_ci, ".3f"),
        ("mean over 10 s", result.auroc_unknown_10s, ".3f"),
        ("  95 % over runs", result.auroc_unknown_10s_ci, ".3f"),
        ("known windows that the threshold is to keep", result.known_kept_target, PERCENT),
        ("  that it keeps", result.known_kept, PERCENT),
    ]
    head = (Column("area", ".3f"), Column("over 10 s", ".3f"), Column("taken for known", PERCENT))
    left_out = [(name, *row[:3]) for name, row in (result.unknown_by_terrain or {}).items()]
    return Section(
        "A terrain that was left out of training", [Pairs(rows), Table(("left out", *head), left_out)]
    )
