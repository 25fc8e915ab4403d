"""One self-contained HTML page: how good a classifier is, and where its numbers come from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.figure import Figure

from pipelines.crossval.results import (
    MIN_CLASSES,
    Applicability,
    CrossvalReport,
    SlowFast,
)
from pipelines.learn.predict import Predictions, WindowPrediction
from pipelines.quickstart.consistency_view import ConsistencyTable, consistency_table
from pipelines.quickstart.results import QuickstartResult
from pipelines.reporting.numbers import NOT_KNOWN, format_counts, percent
from pipelines.reporting.pictures import Image, svg_or_png
from pipelines.reporting.templates import render
from pipelines.reporting.versions import versions
from terrain.classify.metrics import VOTE_SPAN_S, RunFigures
from terrain.control.slip_table import DRIVE_STATES

WEAK_BELOW = 0.5
WIDE = ("per_run", "support", "motion", "slip")
"""Figures that take the whole width; they come after those that stand side by side."""

HEADLINES = {
    "grouped": "of windows classified correctly, whole runs held out",
    "leave-one-run-out": "of windows classified correctly, each run held out in turn",
    "published": (
        "of windows classified correctly under the published protocol, for comparison with papers only"
    ),
}
CAPTIONS = {
    "confusion": (
        "Each row is a true terrain and adds up to 100%; dark cells off the diagonal show what it is "
        "mistaken for."
    ),
    "per_run": (
        "Each bar is one run, the dashed line the accuracy over all windows of its terrain; one long bad run "
        "weighs more than several short ones."
    ),
    "reliability": (
        "Each point is a bin of equally many windows; below the dashed line the stated probability is "
        "higher than the accuracy, above it lower."
    ),
    "support": (
        "Accuracy of each terrain by how it was driven; a dash is driving that no run shows, where an answer "
        "rests on nothing that was recorded."
    ),
    "learning_curve": (
        "The curve shows what each further run brought; where it is still rising at its right end, more runs "
        "help."
    ),
    "motion": (
        "One run on grass: the filter (band: two standard deviations) beside what each sensor measures of "
        "speed and yaw rate, and its innovations, which should fill the grey band and no more."
    ),
    "slip": (
        "The same run: wheel speeds beside the speed over ground, and the slip of each wheel, with "
        "two standard deviations."
    ),
    "importance": (
        "A long bar is an input that the model needs; the importance of related inputs is divided "
        "among them, so that each alone looks small."
    ),
}


class Mark(NamedTuple):
    """A reference value on the scale of the headline."""

    kind: str
    value: float
    text: str


class Headline(NamedTuple):
    """Text of the accuracy, values that it must exceed, and the terrains ``alone`` with a single run."""

    text: str
    alone: tuple[str, ...]
    marks: tuple[Mark, ...]
    cards: tuple[tuple[str, float, str], ...]


class TerrainRow(NamedTuple):
    """Figures of one terrain; ``n_windows`` per repeat, ``mistaken_for`` with its part of the windows."""

    terrain: str
    n_runs: int
    n_windows: float
    recall: float
    precision: float
    f1: float
    mistaken_for: str
    weak: bool


class SlowFastView(NamedTuple):
    """Whether accuracy carries over to another speed."""

    applicable: bool
    to_fast: float | None
    to_slow: float | None
    speeds: str
    n_kept: str
    n_required: int
    left_out: str


class RunRow(NamedTuple):
    """Predictions of one run, beside its true terrain and its accuracy in cross-validation."""

    run_id: str
    truth: str
    n_windows: int
    predicted: str
    accuracy: str
    held_out: str
    slips: tuple[str, ...]
    status: str
    wrong: bool


class TargetRow(NamedTuple):
    """Target slips of one terrain."""

    terrain: str
    slips: tuple[str, ...]
    status: str
    source: str


class Pair(NamedTuple):
    """A term and its value, which is code where a user may have to copy it."""

    name: str
    value: str
    code: bool = False


class View(NamedTuple):
    """What the templates of the page show."""

    result: QuickstartResult
    lead: str
    headline: Headline
    figures: tuple[tuple[Image, bool], ...]
    consistency: ConsistencyTable | None
    terrains: tuple[TerrainRow, ...]
    weak: tuple[str, ...]
    most_frequent: float
    slow_fast: SlowFastView | None
    model: tuple[Pair, ...]
    runs: tuple[RunRow, ...]
    targets: tuple[TargetRow, ...]
    n_unestimated: int
    drive_states: tuple[str, ...]
    provenance: tuple[Pair, ...]


def html_report(result: QuickstartResult, figures: Mapping[str, Figure]) -> str:
    """Return the report as one HTML page; figures by name, as :data:`CAPTIONS` lists them."""
    report, extras = result.crossval, result.crossval.extras
    terrains = _terrain_rows(report)
    targets = _target_rows(result.predict)
    view = View(
        result=result,
        lead=_lead(result),
        headline=_headline(report),
        figures=_images(figures),
        consistency=consistency_table(result.consistency) if result.consistency else None,
        terrains=terrains,
        weak=tuple(row.terrain for row in terrains if row.weak),
        most_frequent=report.chance,
        slow_fast=None if extras is None else _slow_fast(extras.slow_fast),
        model=_model(result),
        runs=_run_rows(result),
        targets=targets,
        n_unestimated=sum("unestimated" in row.status for row in targets),
        drive_states=tuple(DRIVE_STATES),
        provenance=_provenance(result),
    )
    return render("quickstart/page.html.j2", view=view)


def _lead(result: QuickstartResult) -> str:
    report = result.crossval
    return " · ".join(
        (
            f"{report.n_runs} runs",
            f"{len(report.classes)} terrains",
            f"{report.n_windows} windows of {report.window_s:g} s",
            f"recipe {report.recipe}",
            f"made {result.created}",
        )
    )


def _headline(report: CrossvalReport) -> Headline:
    n_runs = Counter(run.terrain for run in report.per_run)
    alone = tuple(sorted(name for name, count in n_runs.items() if count == 1))
    text = HEADLINES[report.protocol]
    if alone and report.protocol != "published":
        text += f", except {listed(alone)}"
    marks = [Mark("guess", report.chance, "always the most frequent terrain")]
    if report.extras is not None and report.extras.speed_only_accuracy is not None:
        marks.append(Mark("speed", report.extras.speed_only_accuracy, "speed alone"))
    cards = (
        ("balanced accuracy", report.balanced_accuracy, "every terrain counts the same"),
        ("macro F1", report.macro_f1, "mean of F1 over terrains"),
        (
            "vote accuracy",
            report.vote_accuracy,
            f"majority of the last {VOTE_SPAN_S:g} s, {report.vote_windows:.1f} windows on average",
        ),
        ("calibration error", report.ece, "stated probability against accuracy (ECE)"),
    )
    return Headline(text, alone, tuple(marks), cards)


def _images(figures: Mapping[str, Figure]) -> tuple[tuple[Image, bool], ...]:
    """Return the figures, and whether each takes the whole width."""
    ordered = sorted(figures.items(), key=lambda item: item[0] in WIDE)
    return tuple(
        (svg_or_png(figure, CAPTIONS[name], CAPTIONS[name]), name in WIDE) for name, figure in ordered
    )


def _terrain_rows(report: CrossvalReport) -> tuple[TerrainRow, ...]:
    n_runs = Counter(run.terrain for run in report.per_run)
    rows = []
    for name, counts in zip(report.classes, report.confusion, strict=True):
        figures = report.per_class[name]
        others = [(n, other) for n, other in zip(counts, report.classes, strict=True) if other != name and n]
        n_most, most = max(others, default=(0, None), key=lambda pair: pair[0])
        mistaken_for = NOT_KNOWN if most is None else f"{most} ({percent(n_most / sum(counts))})"
        rows.append(
            TerrainRow(
                name,
                n_runs[name],
                figures.n_windows / report.repeats,
                figures.recall,
                figures.precision,
                figures.f1,
                mistaken_for,
                weak=figures.recall < WEAK_BELOW,
            )
        )
    return tuple(rows)


def _slow_fast(split: SlowFast) -> SlowFastView:
    return SlowFastView(
        applicable=split.status is Applicability.APPLICABLE,
        to_fast=split.slow_to_fast,
        to_slow=split.fast_to_slow,
        speeds="; ".join(
            f"{name} {side.slow_mps:.2f} and {side.fast_mps:.2f} m/s" for name, side in split.classes.items()
        ),
        n_kept=_plural(len(split.classes), "terrain"),
        n_required=MIN_CLASSES,
        left_out=", ".join(f"{name} ({reason})" for name, reason in split.left_out.items()),
    )


def _model(result: QuickstartResult) -> tuple[Pair, ...]:
    model = result.train
    verdict = "this version is now champion" if model.alias_moved else "the champion remains as it was"
    return (
        Pair("model", model.model_uri, code=True),
        Pair("version", model.version),
        Pair("champion", f"{verdict}: {model.alias_reason}"),
        Pair("tracking run", model.run_id, code=True),
    )


def _run_rows(result: QuickstartResult) -> tuple[RunRow, ...]:
    held_out = {run.run_id: run for run in result.crossval.per_run}
    by_run: dict[str, list[WindowPrediction]] = {}
    for window in result.predict.windows:
        by_run.setdefault(window.run_id, []).append(window)
    return tuple(
        _run_row(run_id, windows, held_out.get(run_id), result.predict.classes)
        for run_id, windows in by_run.items()
    )


def _run_row(
    run_id: str, windows: Sequence[WindowPrediction], held_out: RunFigures | None, classes: Sequence[str]
) -> RunRow:
    terrain, count = Counter(window.terrain for window in windows).most_common(1)[0]
    named = next(window for window in windows if window.terrain == terrain)
    usual = held_out.terrain if held_out else None
    labels = [window.label or usual for window in windows]
    true_terrain = Counter(label for label in labels if label).most_common(1)
    truth = true_terrain[0][0] if true_terrain else None
    hits = [
        window.terrain == label for window, label in zip(windows, labels, strict=True) if label in classes
    ]
    return RunRow(
        run_id,
        truth or NOT_KNOWN,
        len(windows),
        f"{terrain} ({percent(count / len(windows), 0)})",
        percent(sum(hits) / len(hits)) if hits else NOT_KNOWN,
        percent(held_out.accuracy) if held_out else NOT_KNOWN,
        tuple(_slip(named.target_slip[state]) for state in DRIVE_STATES),
        ", ".join(dict.fromkeys(named.status.values())),
        wrong=truth is not None and terrain != truth,
    )


def _target_rows(predictions: Predictions) -> tuple[TargetRow, ...]:
    rows = []
    for terrain, row in predictions.table.items():
        source = row.source
        if row.entry != terrain:
            source = f"no entry of its own, fallback {row.entry!r}: {source}"
        slips = tuple(_slip(getattr(row, state)) for state in DRIVE_STATES)
        rows.append(TargetRow(terrain, slips, row.status, source))
    return tuple(rows)


def _provenance(result: QuickstartResult) -> tuple[Pair, ...]:
    report = result.crossval
    return (
        Pair("data digest", result.data_digest, code=True),
        Pair("commit", result.commit, code=True),
        Pair("seed", str(result.seed)),
        Pair("protocol", f"{report.protocol}, {_plural(report.repeats, 'repeat')}"),
        Pair("recipe", report.recipe),
        Pair("windows", f"{report.window_s:g} s; left out: {format_counts(report.dropped) or 'none'}"),
        Pair("signal sets", ", ".join(report.signal_sets)),
        Pair("features", str(report.n_features)),
        Pair("made", result.created),
        Pair("took", _duration(result.elapsed_s)),
        Pair("versions", ", ".join(f"{name} {number}" for name, number in versions().items())),
    )


def _slip(value: float) -> str:
    return f"{value:.3f}".replace("-", "\N{MINUS SIGN}")


def _duration(elapsed_s: float) -> str:
    minutes, seconds = divmod(round(elapsed_s), 60)
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"


def listed(names: Sequence[str]) -> str:
    """Return names in a sentence.

    Examples
    --------
    >>> listed(["ICE"]), listed(["ICE", "MUD", "SNOW"])
    ('ICE', 'ICE, MUD and SNOW')
    """
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
