"""What ``terrain track`` prints."""

from __future__ import annotations

from rich.console import Console

from pipelines.reporting.numbers import format_counts
from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column
from pipelines.track.page import rows, verdict
from pipelines.track.results import TrackResult


def print_track(result: TrackResult, console: Console) -> None:
    """Print figures of the drive, its statuses, and where the page is."""
    title = (
        f"{result.robot} along {result.path.name} at {result.speed_mps:g} m/s, sideslip: {result.observer}"
    )
    table = compact_table(text_column("figure"), *number_columns("value"), title=title)
    for name, value in rows(result):
        table.add_row(name, value)
    console.print(table)
    statuses = [f"{name}: {format_counts(counts)}" for name, counts in result.statuses.items()]
    print_lines(console, [verdict(result), *result.warnings, *statuses, f"report: {result.report}"])
