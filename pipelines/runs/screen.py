"""What ``terrain import`` and ``terrain inspect`` print."""

from __future__ import annotations

from rich.console import Console

from pipelines.data.duplicates import sentences
from pipelines.data.plausibility import doubt_sentences
from pipelines.reporting.numbers import format_counts
from pipelines.reporting.terminal import print_lines
from pipelines.runs.results import Imported


def print_import(result: Imported, console: Console) -> None:
    """Print what was skipped, how many runs were written, and what was dropped."""
    print_lines(console, (f"skipped: {sentence}" for sentence in result.skipped))
    counts = f", {format_counts(result.dropped)}" if result.dropped else ""
    print_lines(console, doubt_sentences(result.doubts))
    print_lines(console, [f"{result.n_runs} runs written to {result.out}{counts}"])
    print_lines(console, sentences(result.duplicates))
