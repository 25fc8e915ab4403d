"""What ``terrain label`` prints of proposals and of the labels that were written."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from pipelines.propose.labelling import ProposedLabels, WrittenLabels
from pipelines.propose.proposals import questions
from pipelines.reporting.numbers import percent
from pipelines.reporting.terminal import number_columns, print_lines, text_column


def print_proposed(found: ProposedLabels, console: Console) -> None:
    """Print the questions, and what happens to the other proposals."""
    asked = [found.proposals[i] for i in questions(found.proposals, found.n_asked)]
    if asked:
        table = Table(
            text_column("run"),
            *number_columns("from s", "to s"),
            text_column("proposed"),
            *number_columns("confidence", "supported", "unknown"),
            title="worth an answer, the first the most",
        )
        for row in asked:
            table.add_row(
                row.run_id,
                f"{row.start_s:.1f}",
                f"{row.end_s:.1f}",
                row.terrain,
                f"{row.confidence:.2f}",
                percent(row.supported_ratio),
                percent(row.unknown_ratio),
            )
        console.print(table)
    rest = len(found.proposals) - found.n_asked
    print_lines(
        console,
        [
            f"{len(found.proposals)} proposals for {found.n_runs} runs in {found.file}: "
            f"{found.n_asked} questions; of the other {rest}, {found.n_taken_over} need no answer",
            "answer with a terrain, 'yes' or 'none' in the column answer, then: "
            f"terrain label {found.data} --answers {found.file} --out NEW",
        ],
    )


def print_written(found: WrittenLabels, console: Console) -> None:
    """Print how many labels there are of each source."""
    counts = ", ".join(f"{n} by {source}" for source, n in found.n_labels.items())
    print_lines(
        console,
        [f"{found.n_runs} runs in {found.out}: labels {counts}; {found.n_left_open} stretches without one"],
    )
