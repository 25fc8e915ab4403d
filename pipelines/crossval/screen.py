"""What ``terrain crossval`` prints."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from pipelines.courses.screen import over_time_lines
from pipelines.crossval.results import (
    Applicability,
    CrossvalReport,
    Extras,
    SlowFast,
    StiffnessFigures,
    UnknownTerrain,
)
from pipelines.reporting.numbers import percent
from pipelines.reporting.terminal import print_lines
from pipelines.support.screen import support_lines
from terrain.classify.conformal_figures import ConformalFigures


def print_crossval(report: CrossvalReport, console: Console) -> None:
    """Print the headline, the classes, and the extras."""
    low, high = report.accuracy_ci
    spread = report.accuracy_spread
    repeats = "" if spread is None else f", spread over {report.repeats} fold assignments {spread:.1%}"
    console.print(
        f"{report.dataset}, protocol {report.protocol}, recipe {report.recipe}: "
        f"{report.n_windows} windows of {report.window_s:g} s from {report.n_runs} runs"
    )
    print_lines(
        console,
        (
            f"accuracy {percent(report.accuracy)} (95 % over runs: {low:.1%} to {high:.1%}{repeats})",
            f"balanced accuracy {percent(report.balanced_accuracy)}, macro F1 {report.macro_f1:.3f}, "
            f"mean over classes then runs {percent(report.macro_run_accuracy)}, "
            f"vote over 5 s ({report.vote_windows:.1f} windows on average) {percent(report.vote_accuracy)}",
            _confidence_line(report),
        ),
    )
    table = Table("terrain", "windows", "precision", "recall", "F1", title="per class, all repeats together")
    for name, row in report.per_class.items():
        table.add_row(name, str(row.n_windows), percent(row.precision), percent(row.recall), f"{row.f1:.3f}")
    console.print(table)
    if report.unknown is not None:
        print_lines(console, _unknown_lines(report.unknown))
    if report.conformal is not None:
        print_lines(console, [_sets_line(report.conformal)])
    if report.support is not None:
        print_lines(console, support_lines(report.support))
    if report.extras is not None:
        print_lines(console, _extras_lines(report.extras))
    print_lines(console, (f"note: {note}" for note in (*report.notes, *(report.skipped or ()))))


def _confidence_line(report: CrossvalReport) -> str:
    """Return how the probability of the predicted class relates to whether it is right."""
    area, (low, high) = report.confidence_auc, report.confidence_auc_ci
    ranked = f"area {area:.2f} ({low:.2f} to {high:.2f})" if area == area else "all alike right or wrong"
    most_confident = "; ".join(
        f"the most confident {row.coverage:.0%} are right in {percent(row.accuracy)} "
        f"({row.accuracy_ci[0]:.1%} to {row.accuracy_ci[1]:.1%})"
        for row in report.accuracy_at_coverage
    )
    return f"from confidence to correctness: {ranked}; {most_confident}; calibration error {report.ece:.3f}"


def _sets_line(found: ConformalFigures) -> str:
    low, high = found.coverage_ci
    return (
        f"sets of terrains at {found.level:.0%}: hold the true one in {percent(found.coverage)} of windows "
        f"({low:.1%} to {high:.1%}), in the worst run in {percent(found.coverage_worst_run)}; "
        f"{found.set_size:.2f} terrains a set, one alone in {percent(found.single_ratio)}"
    )


def _unknown_lines(found: UnknownTerrain) -> Iterator[str]:
    (low, high), (low_10s, high_10s) = found.auroc_unknown_ci, found.auroc_unknown_10s_ci
    yield (
        f"a terrain left out of training, area under the ROC curve of the novelty score: a window "
        f"{found.auroc_unknown:.3f} (95 % over runs: {low:.3f} to {high:.3f}), mean over 10 s "
        f"{found.auroc_unknown_10s:.3f} ({low_10s:.3f} to {high_10s:.3f})"
    )
    yield (
        f"at a threshold meant to keep {percent(found.known_kept_target)} of the known windows: "
        f"{percent(found.known_kept)} of held-out known windows are kept, "
        f"{percent(found.unknown_accepted)} of unknown ones are accepted as known"
    )
    for name, row in found.unknown_by_terrain.items():
        yield (
            f"{name} left out: {row.auroc:.3f}, over 10 s {row.auroc_10s:.3f}, "
            f"accepted {percent(row.accepted)}"
        )


def _extras_lines(extras: Extras) -> Iterator[str]:
    speed = extras.speed_only_accuracy
    yield (
        f"from wheel speed alone: {'-' if speed is None else percent(speed)} "
        "(what recognising the driving would give)"
    )
    yield _slow_fast_line(extras.slow_fast)
    yield f"runs: {extras.learning_curve.statement}"
    if extras.over_time is not None:
        yield from over_time_lines(extras.over_time)
    if extras.stiffness is not None:
        yield from _stiffness_lines(extras.stiffness)


def _stiffness_lines(found: StiffnessFigures) -> Iterator[str]:
    low, high = found.accuracy_ci
    yield (
        f"stiffness level: {percent(found.accuracy)} (95 % over runs: {low:.1%} to {high:.1%}), "
        f"soft and hard confused in {percent(found.soft_hard_ratio)}"
    )
    low, high = found.gain_ci
    yield (
        f"cost of confusing levels: {found.cost:.3f} a window, {found.least_cost:.3f} by the class of least "
        f"expected cost (gain {found.gain:.4f}, 95 % over runs: {low:.4f} to {high:.4f})"
    )
    if found.clusters is not None:
        low, high = found.clusters.interval
        yield (
            f"clusters of runs without labels: {found.clusters.n_clusters}, adjusted Rand index with the "
            f"levels {found.clusters.adjusted_rand:.2f} (95 % over runs: {low:.2f} to {high:.2f})"
        )


def _slow_fast_line(result: SlowFast) -> str:
    out = "".join(f"; {name} left out ({reason})" for name, reason in result.left_out.items())
    if result.status is Applicability.NOT_APPLICABLE:
        return f"trained slow, tested fast: not applicable{out}"
    to_fast, to_slow = (
        "-" if ratio is None else percent(ratio) for ratio in (result.slow_to_fast, result.fast_to_slow)
    )
    return f"trained slow, tested fast: {to_fast}; back: {to_slow} ({', '.join(result.classes)}{out})"
