"""What an evaluation on held-out windows finds, and its report.

The types of its fields are imported for more than a type checker: the record of a training is read by them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from features.protocols import PROTOCOLS
from pipelines.report.figure import Bars, Figure, Line, Mark, Panel, Points
from pipelines.report.numbers import format_value, plural
from pipelines.report.results import Result, described
from pipelines.report.tree import Column, Pairs, Part, Report, Section, Table, Text, value_at
from terrain.classify.changes import Breakaway
from terrain.classify.coverage import NextDrive, PartFigures, SupportRow
from terrain.classify.held_out import SlowFast
from terrain.classify.metrics import (
    ClassFigures,
    ConformalFigures,
    CoverageFigures,
    DelayFigures,
    Difference,
    FoldFigures,
    LearningCurve,
    LeftOutTerrain,
    RefusalFigures,
    ReliabilityBin,
    RunFigures,
    SequenceFigures,
)

MAX_ROWS = 10
PERCENT = ".1%"

WIDE_INTERVAL = 0.2
"""Accuracies that differ by half of this cannot be distinguished where the 95 % interval is wider."""

optional = partial(described, optional=True)


class CrossvalResult(Result):
    """An evaluation on held-out windows: its figures, how they were obtained, and what to know of them.

    Figures are means over the repeats, intervals of 95 % over units, runs or sessions, within classes.  ``data``,
    where the data lie for the next step, is not in JSON.
    """

    classes: tuple[str, ...] = described("terrains")
    n_windows: int = described("windows that were held out")
    n_runs: int = described("runs that they are of")
    n_sessions: int = described("sessions that the runs name")
    unit: str = described("what intervals are over, and what is held out whole: session or run")
    repeats: int = described("fold assignments")
    accuracy: float = described("windows classified correctly", "1")
    accuracy_spread: float | None = described("standard deviation over the repeats", "1")
    accuracy_per_repeat: tuple[float, ...] = described("accuracy of each repeat", "1")
    accuracy_ci: tuple[float, float] = described("interval of the accuracy", "1")
    balanced_accuracy: float = described("mean recall of the terrains", "1")
    macro_f1: float = described("mean F1 of the terrains", "1", form=".3f")
    macro_run_accuracy: float = described("mean over terrains of the mean over runs", "1")
    per_class: Mapping[str, ClassFigures] = described("precision, recall and F1, all repeats together")
    confusion: tuple[tuple[int, ...], ...] = described("windows by true and predicted terrain, all repeats")
    vote_accuracy: float = described("accuracy of a vote over 5 s", "1")
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
    stride_s: float | None = described("stride; none where a protocol sets it", "s")
    steady: bool = described("windows of steady motion alone")
    signal_sets: tuple[str, ...] = described("signals that were used")
    seed: int = described("seed of the folds and of the intervals")
    n_features: int = described("features of a window; 0 of a model")
    dropped: Mapping[str, int] = described("windows left out, by reason")
    repaired: Mapping[str, int] = described("what a repairing reader changed, by kind")
    notes: tuple[str, ...] = described("what a reader has to know")
    speed_only_accuracy: float | None = optional("accuracy from wheel speed alone", "1")
    plain_accuracy: float | None = optional(
        "accuracy of boosted trees on means and standard deviations (recipe plain)", "1"
    )
    slow_fast: SlowFast | None = optional("slow runs train and fast ones test, and the reverse")
    learning_curve: LearningCurve | None = optional("accuracy by number of training runs")
    over_time: Difference | None = optional(
        "accuracy of single windows and of the filter that goes on through a run or session, 'unknown' being wrong"
    )
    filtered_accuracy: float | None = optional("accuracy of the filter over time", "1")
    filtered_accuracy_ci: tuple[float, float] | None = optional("interval of it", "1")
    filter_delay_s: DelayFigures | None = optional("from a change of terrain to its report", "s")
    courses: SequenceFigures | None = optional("sequences spliced from held-out runs")
    recorded_courses: SequenceFigures | None = optional("runs over several terrains")
    breakaways: tuple[Breakaway, ...] | None = optional("stretches that look unlike their run")
    auroc_unknown: float | None = optional(
        "area of the score of how unlike learned terrains one is that was never learned", "1", form=".3f"
    )
    auroc_unknown_ci: tuple[float, float] | None = optional("interval of it", "1", form=".3f")
    auroc_unknown_10s: float | None = optional("the same of means over 10 s", "1", form=".3f")
    auroc_unknown_10s_ci: tuple[float, float] | None = optional("interval of it", "1", form=".3f")
    unknown_accepted: float | None = optional("unknown windows taken for known", "1")
    known_kept: float | None = optional("known windows not called unknown", "1")
    known_kept_target: float | None = optional("known windows that the threshold is to keep", "1")
    unknown_by_terrain: Mapping[str, LeftOutTerrain] | None = optional("by terrain left out")
    support: tuple[SupportRow, ...] | None = optional("windows and accuracy by terrain and driving")
    accuracy_by_support: tuple[Mapping[str, str | float | tuple[float, float] | None], ...] | None = optional(
        "accuracy by training runs of the true terrain near the motion of a window"
    )
    unsupported: PartFigures | None = optional("predictions without training runs near them")
    supported: PartFigures | None = optional("the other predictions")
    supported_auc: float | None = optional("area from supported probability to correctness", "1")
    next_drives: tuple[NextDrive, ...] | None = optional("what to record next, best first")
    refusals: RefusalFigures | None = optional(
        "windows of learned terrains called unknown, and accuracy with them"
    )
    conformal: ConformalFigures | None = optional("sets of terrains that hold the true one")
    dataset: str | None = optional("name of the data")
    data_digest: str | None = optional("digest of the runs")
    skipped: tuple[str, ...] | None = optional("runs that a repairing reader had to skip")
    data: str = ""

    @property
    def chance(self) -> float:
        """Accuracy of always predicting the class with the most windows."""
        counts = [figures.n_windows for figures in self.per_class.values()]
        return max(counts) / sum(counts)

    @property
    def over(self) -> str:
        """What intervals are over, in words."""
        return "95 % over sessions, Student's t" if self.unit == "session" else "95 % over runs"

    @property
    def held_out(self) -> str:
        """What was held out, in words, and what that does not show."""
        words, protocol = held_out_words(self.protocol), PROTOCOLS.get(self.protocol)
        if self.unit == "session" and (
            protocol is None or protocol.whole_sessions
        ):  # None: of a model, on other runs
            return words.replace("whole runs", "whole sessions")
        of_runs = "one session" if self.n_sessions else "runs without a session"
        within = "sessions" if self.unit == "session" else of_runs
        return f"{words}, within {within}: what another day does is not shown"

    @property
    def weaknesses(self) -> tuple[str, ...]:
        """Why the accuracy must not be relied on, in sentences; none where it may."""
        low, high = self.accuracy_ci
        found = []
        if not low > self.chance:
            found.append(
                f"the accuracy ({self.over}: {format_value((low, high), PERCENT)}) is not above chance, "
                f"{format_value(self.chance, PERCENT)} (always the most frequent class)"
            )
        if not high - low <= WIDE_INTERVAL:
            found.append(
                f"the interval of the accuracy is {100 * (high - low):.0f} points wide: more {self.unit}s are needed "
                "to rely on it"
            )
        return tuple(found)

    def as_json(self) -> Any:
        """Return the fields that are known by name; of checks that were made, all."""
        made: tuple[str, ...] = () if self.support is None else ("supported_auc",)
        if self.learning_curve is not None:
            made += ("speed_only_accuracy", "courses", "recorded_courses")
        return dict.fromkeys(made) | super().as_json()

    def records(self) -> Iterable[Any]:
        """Return precision, recall, F1 and windows of each terrain."""
        return ({"terrain": name, **row._asdict()} for name, row in self.per_class.items())


def report(result: CrossvalResult) -> Report:
    """Return the report: the accuracy on held-out runs, each terrain, what to do next, and the rest folded."""
    dataset, curve, drives = result.dataset or "windows", result.learning_curve, result.next_drives
    decide: list[tuple[Any, ...]] = [("always the most frequent terrain", result.chance, PERCENT)]
    if result.plain_accuracy is not None:
        decide += result.pairs("plain_accuracy")
    if curve is not None:
        decide += [
            *result.pairs("speed_only_accuracy"),
            (f"number of {result.unit}s", curve.statement),
        ]
    if result.over_time is not None:
        filtered, gain, (low, high) = (
            result.over_time.b,
            result.over_time.difference,
            result.over_time.interval,
        )
        points = f"{100 * gain:+.1f} points, {100 * low:+.1f} to {100 * high:+.1f}"
        text = f"{format_value(filtered, PERCENT)} ({points}, {result.over})"
        decide.append((f"filtered through each {result.unit}", text))
    if (found := result.refusals) is not None:
        refused, ends, worst = (
            format_value(each, PERCENT) for each in (found.refused, found.refused_ci, found.worst_unit)
        )
        decide += [
            ("refused as unknown", f"{refused} ({ends}, {result.over}), worst {result.unit} {worst}"),
            ("right of those accepted", found.accuracy_accepted, PERCENT),
            ("right and accepted, of all", found.right_and_accepted, PERCENT),
        ]
    if result.auroc_unknown is not None:
        decide += result.pairs("auroc_unknown", "unknown_accepted")
    if drives:
        decide.append(("record next", drives[0].request))
    return Report(
        title=f"Evaluation on held-out {result.unit}s of {dataset}",
        answer=(
            f"{format_value(result.accuracy, PERCENT)} of windows classified correctly "
            f"({format_value(result.accuracy_ci, PERCENT)}, {result.over}), {result.held_out}."
        ),
        lead=(
            f"{dataset}, recipe {result.recipe}: {plural(result.n_windows, 'window')} of {result.window_s:g} s "
            f"from {plural(result.n_runs, 'run')}, protocol {result.protocol}"
        ),
        picture=recall_figure([result]),
        parts=[recall_table(result), Pairs(decide), *notes(*result.notes, *(result.skipped or ()))],
        details=_details(result),
        next_step=f"terrain train --data {result.data or 'DIR'} --recipe {result.recipe} --name NAME",
    )


def notes(*texts: str) -> list[Text]:
    """Return what a reader has to know."""
    return [Text(each, "note") for each in texts]


def held_out_words(protocol: str) -> str:
    """Return what a protocol holds out, in words."""
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
        "windows" if result.repeats == 1 else f"windows, {result.repeats} deals",
    )
    note = "" if len(rows) <= MAX_ROWS else f"the {MAX_ROWS} worst of {len(rows)} terrains"
    return Table(columns, [row for row in rows if row in worst], note=note)


ACCURACY = Column("accuracy", PERCENT)


def _details(result: CrossvalResult) -> list[Section]:
    """Return what is folded: confusion, runs, confidence, coverage, checks, time, and how it was done."""
    over_time = result.courses or result.recorded_courses or result.breakaways
    return [
        Section(title, partial(make, result))
        for title, make, known in (
            ("Confusion", _confusion, True),
            ("Runs", _runs, True),
            ("Confidence", _confidence, True),
            ("Training coverage", _coverage, result.support is not None),
            ("Checks of the data", _checks, result.learning_curve is not None),
            ("Terrain over time, on sequences over several terrains", _over_time, over_time),
            ("A terrain that was left out of training", _unknown, result.unknown_by_terrain is not None),
            ("How it was done", _done, True),
        )
        if known
    ]


def _confusion(result: CrossvalResult) -> list[Part]:
    shaded = [Column(name, ".0%", shade=True) for name in result.classes]
    rows = [
        (name, *(n / max(sum(row), 1) for n in row))
        for name, row in zip(result.classes, result.confusion, strict=True)
    ]
    text = "A row is a true terrain and adds up to 100 %; dark cells off the diagonal are what it is mistaken for."
    return [Table(("true terrain", *shaded), rows), Text(text)]


def _runs(result: CrossvalResult) -> list[Part]:
    head = ("run", "terrain", "windows", ACCURACY, Column("of votes", PERCENT), "mistaken for")
    worst = sorted(result.per_run, key=lambda row: row.accuracy)
    text = "The worst first. One long bad run weighs more than several short ones."
    return [Table(head, worst, note=text)]


def _confidence(result: CrossvalResult) -> list[Part]:
    bins, sets = result.reliability, result.conformal
    low, high = zip(*(each.accuracy_ci for each in bins), strict=True) if bins else ((), ())
    stated, right = [each.confidence for each in bins], [each.accuracy for each in bins]
    marks: list[Mark] = [
        Line("as stated", [0.0, 1.0], [0.0, 1.0], dashed=True),
        Points("windows by confidence", stated, right, low, high),
    ]
    rows = result.pairs("confidence_auc", "confidence_auc_ci", "ece", "ece_ci")
    for row in result.accuracy_at_coverage:
        rows.append((f"right of the most confident {row.coverage:.0%}", row.accuracy, PERCENT))
    if sets is not None:
        rows += [
            (f"sets of terrains at {sets.level:.0%} that hold the true one", sets.coverage, PERCENT),
            (f"  {result.over}", sets.coverage_ci, PERCENT),
            ("  in the worst run", sets.coverage_worst_run, PERCENT),
            ("  terrains in a set", sets.set_size, ".2f"),
            ("  sets with one terrain", sets.single_ratio, PERCENT),
        ]
    caption = (
        "Each point is a bin of equally many windows; below the line, predictions are wrong more often than their "
        "probability says."
    )
    panel = Panel(marks, "classified correctly", x_range=(0.0, 1.0), y_range=(0.0, 1.0))
    label = "probability of the predicted terrain"
    return [Pairs(rows), Figure("Confidence and accuracy", [panel], caption, x_label=label)]


def _coverage(result: CrossvalResult) -> list[Part]:
    support = result.support or ()
    names = ("windows_ratio", "accuracy", "accuracy_ci", "errors_ratio")
    parts: list[tuple[Any, Any]] = [(each["support"], each) for each in result.accuracy_by_support or ()]
    parts += [("unsupported prediction", result.unsupported), ("other predictions", result.supported)]
    rows = [(text, *(value_at(part, name) for name in names)) for text, part in parts]
    head = [Column(name, PERCENT) for name in ("windows", "accuracy", result.over, "of the errors")]
    cells = {(row.terrain, row.regime): row.accuracy for row in support}
    regimes = list(dict.fromkeys(row.regime for row in support))
    driven = [(name, *(cells.get((name, regime)) for regime in regimes)) for name in result.classes]
    shaded = [Column(name, ".0%", shade=True) for name in regimes]
    of_drive = ("record next", "driving", "runs", Column("each of", "g", "s"), Column("gain", ".2%"))
    so_far = (Column("runs near it", ".1f"), "windows", ACCURACY)
    note = "The drive that is expected to gain most first; the order alone is to be relied on."
    return [
        Table(("training runs near the motion", *head), rows),
        Table(("terrain", *shaded), driven, "Accuracy by terrain and driving"),
        Table((*of_drive, *so_far), (result.next_drives or ())[:MAX_ROWS], note=note),
    ]


def _checks(result: CrossvalResult) -> list[Part]:
    found, curve = result.slow_fast, result.learning_curve
    assert found is not None
    assert curve is not None
    out = [f"{name} left out ({reason})" for name, reason in found.left_out.items()]
    rows = [
        *result.pairs("speed_only_accuracy"),
        ("trained on slow runs, tested on fast ones", found.slow_to_fast, PERCENT),
        ("the reverse", found.fast_to_slow, PERCENT),
        ("slow and fast runs", "; ".join([str(found.status), *out])),
    ]
    runs, right = curve.runs_per_class, curve.accuracy
    spread = [(a, std or 0.0) for a, std in zip(right, curve.accuracy_spread, strict=True)]
    low, high = [a - std for a, std in spread], [a + std for a, std in spread]
    marks: list[Mark] = [Line("", runs, right, 0), Points("held-out runs", runs, right, low, high, 0)]
    caption = (
        "What each further run brought; where it still rises at its right end, more runs help. Bars: one standard "
        "deviation over draws of runs."
    )
    label = "training runs of each terrain"
    figure = Figure("Learning curve", [Panel(marks, "accuracy")], caption, x_label=label)
    return [Pairs(rows), figure]


def _over_time(result: CrossvalResult) -> list[Part]:
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
    parts: list[Part] = [Table(("sequences", *accuracy, *delays, "missed", *flips_a_minute), rows)]
    if result.breakaways:
        ends = [Column(name, ".1f", "s") for name in ("from", "to")]
        means = [Column(name, ".2f") for name in ("by", "the label by", "in the rest of the run by")]
        title = "Stretches that look like another terrain than the rest of their run"
        stretches = result.breakaways[:MAX_ROWS]
        parts.append(Table(("run", *ends, "label", "looks like", *means), stretches, title))
    return parts


def _unknown(result: CrossvalResult) -> list[Part]:
    names = (
        "auroc_unknown auroc_unknown_ci auroc_unknown_10s auroc_unknown_10s_ci known_kept_target known_kept"
    )
    head = (Column("area", ".3f"), Column("over 10 s", ".3f"), Column("taken for known", PERCENT))
    left_out = [(name, *row[:3]) for name, row in (result.unknown_by_terrain or {}).items()]
    return [Pairs(result.pairs(*names.split())), Table(("left out", *head), left_out)]


def _done(result: CrossvalResult) -> list[Part]:
    names = (
        "balanced_accuracy macro_f1 macro_run_accuracy vote_accuracy vote_windows repeats accuracy_spread window_s "
        "stride_s steady signal_sets n_features seed data_digest"
    )
    of_fold = ("repeat", "fold", "trained on", "tested on", ACCURACY, "chosen")
    folds = [
        (*row[:5], ", ".join(f"{name} {value}" for name, value in row.chosen.items())) for row in result.folds
    ]
    return [Pairs(result.pairs(*names.split())), Table(of_fold, folds)]
