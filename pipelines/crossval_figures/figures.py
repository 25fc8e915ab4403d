"""The figures of a cross-validation report."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from pipelines.crossval.results import ChannelImportance, CrossvalReport, LearningCurve
from pipelines.crossval_figures.support import support_figure
from pipelines.reporting.drawing import (
    BARE,
    BLUE,
    CLASS_COLOURS,
    FAINT_INK,
    INK,
    VERMILION,
    finished,
    new_figure,
    styled,
)
from pipelines.reporting.numbers import NOT_KNOWN, percent, sentence, shorten
from terrain.classify.metrics import RunFigures
from terrain.records import Array

MAX_FEATURES = 20
MAX_RUNS = 120
"""Beyond this many runs only the worst are drawn; more would be a picture of metres."""
MAX_COUNTED_CLASSES = 10
"""Beyond this many classes a cell has no room for the number of windows below the percentage."""
MISTAKEN_BELOW = 0.5
WHOLE_STEPS = (1, 2, 5, 10)
"""Steps between ticks of a percentage; 2.5 would be rounded into uneven numbers."""


def all_figures(report: CrossvalReport, importances: Sequence[ChannelImportance] = ()) -> dict[str, Figure]:
    """Return, by name, the figures for which there are data."""
    figures = {
        "confusion": confusion_figure(report),
        "per_run": per_run_figure(report),
        "reliability": reliability_figure(report),
    }
    if report.support is not None:
        figures["support"] = support_figure(report.support, report.dataset)
    if report.extras is not None:
        figures["learning_curve"] = learning_curve_figure(report, report.extras.learning_curve)
    if importances:
        figures["importance"] = importance_figure(importances)
    return figures


def confusion_figure(report: CrossvalReport) -> Figure:
    """Draw the confusion matrix: true classes down, predicted ones across.

    A cell shows the percentage of the windows of its row and, below, their mean number per repeat.
    A class that was never tested has a dash.
    """
    classes = report.classes
    counts = np.asarray(report.confusion, dtype=float) / report.repeats
    total = counts.sum(axis=1, keepdims=True)
    ratio = np.divide(counts, total, out=np.full_like(counts, np.nan), where=total > 0)
    k = len(classes)
    side_in = min(3.4 + 0.45 * k, 11.0)
    with styled():
        figure = new_figure(side_in + 0.45, side_in)
        axes = figure.add_subplot()
        axes.pcolormesh(np.ma.masked_invalid(ratio), cmap="Blues", vmin=0, vmax=1, edgecolors="white", lw=1.5)
        axes.set(xlim=(0, k), ylim=(k, 0), aspect="equal")
        for row, column in np.ndindex(k, k):
            _cell(axes, row, column, float(ratio[row, column]), float(counts[row, column]), k)
        names = [shorten(name, 18) for name in classes]
        axes.set_xticks(np.arange(k) + 0.5, names, **_slanted(names))
        axes.set_yticks(
            np.arange(k) + 0.5,
            [f"{name}\n{_count(n)} windows" for name, n in zip(names, total[:, 0], strict=True)],
        )
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.set_xlabel("predicted terrain")
        axes.set_ylabel("true terrain")
        below = "" if k > MAX_COUNTED_CLASSES else ",\nin brackets their mean number per repeat"
        axes.set_title(
            f"percentage of the windows of the true terrain{below}", loc="left", fontsize=8, color=FAINT_INK
        )
        return finished(figure, _title("Confusion", report))


def _cell(axes: Axes, row: int, column: int, ratio: float, count: float, k: int) -> None:
    if np.isnan(ratio):
        axes.text(column + 0.5, row + 0.5, NOT_KNOWN, ha="center", va="center", color=FAINT_INK)
        return
    text = percent(ratio, 0)
    if k <= MAX_COUNTED_CLASSES:
        text += f"\n({_count(count)})"
    axes.text(
        column + 0.5,
        row + 0.5,
        text,
        ha="center",
        va="center",
        color="white" if ratio > 0.55 else INK if count else FAINT_INK,
        fontsize=9 if k <= MAX_COUNTED_CLASSES else 7,
        fontweight="bold" if row == column else "normal",
        linespacing=1.35,
    )


def reliability_figure(report: CrossvalReport) -> Figure:
    """Draw accuracy against the probability of the predicted class in bins of equal mass; bars are 95 %."""
    table = report.reliability
    confidence = np.array([row.confidence for row in table])
    accuracy = np.array([row.accuracy for row in table])
    interval = np.array([row.accuracy_ci for row in table])
    gap = accuracy - confidence
    least = float(np.nanmin([*confidence, *accuracy, *interval[:, 0]]))
    low = max(np.floor(20 * (least - 0.01)) / 20, 0.0)
    with styled():
        figure = new_figure(5.6, 5.4)
        axes, strip = figure.subplots(2, 1, sharex=True, height_ratios=[12, 1])
        axes.plot([low, 1], [low, 1], color=FAINT_INK, lw=1, ls="--", label="calibrated")
        for side, colour, label in (
            (gap >= 0, BLUE, "under-confident"),
            (gap < 0, VERMILION, "over-confident"),
        ):
            axes.vlines(confidence[side], *interval[side].T, color=colour, lw=5, alpha=0.15)
            axes.vlines(confidence[side], confidence[side], accuracy[side], color=colour, lw=1.5, alpha=0.6)
            axes.plot(confidence[side], accuracy[side], "o", color=colour, ms=6, label=label)
        axes.set(xlim=(low, 1.005), ylim=(low, 1.005))
        axes.set_ylabel("accuracy in the bin")
        axes.grid()
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False, borderpad=0, fontsize=8,
                    handletextpad=0.3, columnspacing=1.0)  # fmt: skip
        strip.vlines(confidence, 0, 1, color=INK, lw=1.2)
        strip.set(ylim=(0, 1), yticks=[])
        strip.spines["left"].set_visible(False)
        strip.set_xlabel("confidence: probability of the predicted terrain")
        sizes = sorted({row.n_windows for row in table})
        size = f"{sizes[0]}" if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}"
        held = f"{len(table)} bins of {size} windows each" + (
            f", {report.repeats} repeats together" if report.repeats > 1 else ""
        )
        strip.set_title(held, loc="left", fontsize=8, color=FAINT_INK, pad=3)
        for part in (axes, strip):
            part.xaxis.set_major_locator(MaxNLocator(8, steps=WHOLE_STEPS))
            part.xaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        axes.yaxis.set_major_locator(MaxNLocator(8, steps=WHOLE_STEPS))
        axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        return finished(figure, f"{_title('Reliability', report)}: ECE {percent(report.ece)}")


def per_run_figure(report: CrossvalReport) -> Figure:
    """Draw the accuracy of every run, class by class, with what bad runs are mistaken for.

    The dashed line is the accuracy over all windows of a class, over all its runs even where only the
    :data:`MAX_RUNS` worst runs of all are drawn.
    """
    runs = report.per_run
    worst = sorted(range(len(runs)), key=lambda i: runs[i].accuracy)[:MAX_RUNS]
    drawn = {name: [runs[i] for i in sorted(worst) if runs[i].terrain == name] for name in report.classes}
    n_rows = len(worst) + 1.5 * sum(bool(group) for group in drawn.values())
    with styled():
        figure = new_figure(7.6, 1.2 + 0.19 * n_rows)
        axes = figure.add_subplot()
        row = 0.0
        ticks: list[float] = []
        labels: list[str] = []
        for number, name in enumerate(report.classes):
            group = drawn[name]
            if not group:
                continue
            members = [run for run in runs if run.terrain == name]
            rows = row + 1 + np.arange(len(group))
            colour = CLASS_COLOURS[number % len(CLASS_COLOURS)]
            _draw_class(axes, name, members, group, rows, colour)
            ticks += rows.tolist()
            labels += [shorten(run.run_id, 26) for run in group]
            row = rows[-1] + 1.5
        axes.set_yticks(ticks, labels, fontsize=7.5)
        axes.set(xlim=(0, 1), ylim=(row - 0.6, -0.7))
        axes.xaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
        axes.grid(axis="x")
        axes.set_xlabel("accuracy on held-out windows of the run")
        _in_margin(axes, -0.7, "windows", va="bottom")
        title = _title("Accuracy of each run", report)
        if len(worst) < len(runs):
            title += f", the worst {len(worst)} of {len(runs)}"
        return finished(figure, title)


def _draw_class(
    axes: Axes,
    name: str,
    members: Sequence[RunFigures],
    drawn: Sequence[RunFigures],
    rows: Array,
    colour: str,
) -> None:
    n_windows = sum(run.n_windows for run in members)
    mean = sum(run.accuracy * run.n_windows for run in members) / n_windows
    accuracies = [run.accuracy for run in drawn]
    axes.barh(rows, accuracies, height=0.72, color=colour, label=name)
    axes.vlines(mean, rows[0] - 0.5, rows[-1] + 0.5, color=INK, lw=1, ls=(0, (3, 2)))
    only = "one run only" if len(members) == 1 else f"{len(members)} runs"
    heading = f"{shorten(name, 30)}: {percent(mean)} of {n_windows} windows, {only}"
    axes.text(0.004, rows[0] - 1, heading, va="center", fontsize=8.5, fontweight="bold", bbox=BARE)
    for row, run in zip(rows, drawn, strict=True):
        _in_margin(axes, row, f"{run.n_windows}", va="center")
        if run.accuracy < MISTAKEN_BELOW and run.mistaken_for is not None:
            taken = f"mistaken for {shorten(run.mistaken_for, 30)}"
            axes.text(run.accuracy + 0.012, row, taken, va="center", fontsize=7.5, bbox=BARE)


def _in_margin(axes: Axes, row: float, text: str, va: str) -> None:
    place = axes.get_yaxis_transform()
    axes.text(1.07, row, text, transform=place, ha="right", va=va, fontsize=7.5, color=FAINT_INK)


def learning_curve_figure(report: CrossvalReport, curve: LearningCurve) -> Figure:
    """Draw the accuracy against the number of training runs of each class."""
    runs, accuracy = np.array(curve.runs_per_class), np.array(curve.accuracy)
    spread = np.array([np.nan if std is None else std for std in curve.accuracy_spread])
    subset = np.isfinite(spread)
    with styled():
        figure = new_figure(5.6, 4.4)
        axes = figure.add_subplot()
        axes.plot(runs, accuracy, color=BLUE, lw=1.2, alpha=0.6)
        axes.errorbar(
            runs[subset], accuracy[subset], yerr=spread[subset], fmt="o", color=BLUE, ms=5, capsize=3, lw=1.4,
            label="some runs, drawn at random (bar: ± 1 standard deviation over draws)",
        )  # fmt: skip
        axes.plot(
            runs[~subset],
            accuracy[~subset],
            "D",
            color=VERMILION,
            ms=6.5,
            label="all runs of the training folds",
        )
        enough = curve.enough_runs
        if enough is not None and enough <= 2 * runs.max():
            axes.axvline(enough, color=FAINT_INK, lw=1, ls=":", label=f"enough by the fitted law: {enough}")
        axes.set_xlim(left=0)
        axes.set_ylim(top=min(axes.get_ylim()[1], 1.01))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.yaxis.set_major_locator(MaxNLocator(8, steps=WHOLE_STEPS))
        axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        axes.grid()
        axes.set_xlabel("training runs of each class, mean over classes and folds")
        axes.set_ylabel("accuracy on held-out runs")
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), frameon=False, borderpad=0, fontsize=8)
        statement = textwrap.fill(sentence(curve.statement), 82)
        figure.supxlabel(statement, x=0.015, ha="left", fontsize=8.5, multialignment="left")
        return finished(figure, _title("Learning curve", report))


def importance_figure(importances: Sequence[ChannelImportance]) -> Figure:
    """Draw the :data:`MAX_FEATURES` inputs whose shuffling costs most."""
    ranked = sorted(importances, key=lambda row: (-row.drop, row.feature))[:MAX_FEATURES]
    drops = np.array([100 * row.drop for row in ranked])
    stds = np.array([100 * row.std for row in ranked])
    rows = np.arange(len(ranked))
    with styled():
        figure = new_figure(6.4, 1.3 + 0.24 * len(ranked))
        axes = figure.add_subplot()
        axes.barh(rows, drops, height=0.7, color=BLUE)
        axes.errorbar(drops, rows, xerr=stds, fmt="none", ecolor=INK, lw=1, capsize=2.5)
        axes.axvline(0, color=FAINT_INK, lw=0.8)
        axes.set_yticks(rows, [shorten(row.feature, 44) for row in ranked], fontsize=8)
        axes.set_ylim(len(ranked) - 0.4, -0.6)
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
        axes.grid(axis="x")
        meaning = "drop of balanced accuracy when shuffled, percentage points; line: ± 1 standard deviation"
        axes.set_xlabel(meaning, fontsize=8, x=1.0, ha="right")
        shown = "" if len(ranked) == len(importances) else f", {len(ranked)} of {len(importances)}"
        return finished(figure, f"Permutation importance{shown}")


PROTOCOL_WORDS = {
    "grouped": "grouped by run",
    "leave-one-run-out": "leave one run out",
    "leave-terrain-out": "grouped by run",
    "published": "published protocol",
    "slow-fast": "trained slow, tested fast",
    "fast-slow": "trained fast, tested slow",
}


def _title(what: str, report: CrossvalReport) -> str:
    dataset = [] if report.dataset is None else [shorten(report.dataset, 28)]
    return ", ".join([what, *dataset, PROTOCOL_WORDS[report.protocol]])


def _slanted(names: Sequence[str]) -> dict[str, Any]:
    """Slant the labels of columns when they would not fit side by side."""
    if max(map(len, names), default=0) * len(names) <= 44:
        return {}
    return {"rotation": 30, "ha": "right", "rotation_mode": "anchor"}


def _count(n: float) -> str:
    return f"{n:.0f}" if abs(n - round(n)) < 1e-9 else f"{n:.1f}"
