"""What ``terrain export`` prints."""

from __future__ import annotations

from rich.console import Console

from pipelines.export.results import Exported
from pipelines.reporting.numbers import format_counts
from pipelines.reporting.terminal import print_lines


def print_export(result: Exported, console: Console) -> None:
    """Print what was skipped, and how many runs, messages and topics were written."""
    print_lines(console, (f"skipped: {sentence}" for sentence in result.skipped))
    counts = f", {format_counts(result.dropped)}" if result.dropped else ""
    n_messages = sum(result.topics.values())
    print_lines(
        console,
        [
            f"{result.n_runs} runs, {n_messages} messages on {len(result.topics)} topics, "
            f"written to {result.out}{counts}"
        ],
    )
