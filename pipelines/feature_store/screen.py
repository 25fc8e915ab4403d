"""What ``terrain features`` prints."""

from __future__ import annotations

from rich.console import Console

from pipelines.data.duplicates import sentences
from pipelines.feature_store.results import StoreReport
from pipelines.reporting.numbers import format_counts
from pipelines.reporting.terminal import print_lines


def print_store(report: StoreReport, console: Console) -> None:
    """Print what the store holds, and what was left out."""
    lines = [
        f"{report.n_windows} windows of {report.n_runs} runs with {report.n_features} features each, "
        f"written to {report.out}",
        f"{report.n_computed} runs computed, {report.n_runs - report.n_computed} were there",
    ]
    for text, counts in (("windows left out", report.dropped), ("repaired", report.repaired)):
        if counts:
            lines.append(f"{text}: {format_counts(counts)}")
    print_lines(console, [*lines, *sentences(report.duplicates), *report.skipped])
