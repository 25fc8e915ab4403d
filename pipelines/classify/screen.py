"""What ``terrain train`` and ``predict`` print."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

from rich.console import Console
from rich.table import Table

from pipelines.classify.results import Predictions, Training, WindowPrediction
from pipelines.reporting.numbers import format_counts, percent
from pipelines.reporting.terminal import print_lines
from terrain.control.slip_table import DRIVE_STATES

MAX_ROWS = 12


def print_training(result: Training, console: Console) -> None:
    """Print where the model is, and whether it is the champion."""
    model = result.registered
    verdict = "champion" if model.alias_moved else "not champion"
    line = f"model {model.model_uri} from {result.n_windows} windows: {verdict} ({model.alias_reason})"
    print_lines(console, [line])


def print_predictions(result: Predictions, console: Console) -> None:
    """Print consecutive windows of one terrain as a row, with probability and target slip."""
    table = Table(
        "run", "from s", "windows", "terrain", "prob.", "traction", "braking", "steady", title="target slip"
    )
    stretches = [list(rows) for _, rows in groupby(result.windows, lambda row: (row.run_id, row.terrain))]
    for rows in stretches[:MAX_ROWS]:
        table.add_row(*_stretch_cells(rows))
    console.print(table)
    if len(stretches) > MAX_ROWS:
        console.print(f"... and {len(stretches) - MAX_ROWS} stretches more; --json has every window")
    without_entry = [row for row in result.windows if row.slip_entry != row.terrain == row.nearest]
    if without_entry:
        names = ", ".join(sorted({row.terrain for row in without_entry}))
        entry = without_entry[0].slip_entry
        console.print(f"no entry in the slip table for {names}: the fallback {entry!r} is used")
    if any("unestimated" in row.status.values() for row in result.windows):
        console.print(f"target slips from the table {result.table_name!r} are unestimated: not measured")
    print_lines(console, _accuracy_lines(result))


def _stretch_cells(rows: Sequence[WindowPrediction]) -> list[str]:
    first = rows[0]
    probability = sum(row.probability for row in rows) / len(rows)
    slips = [f"{first.target_slip[state]:+.2f}" for state in DRIVE_STATES]
    return [
        first.run_id, f"{first.start_s:.1f}", str(len(rows)), first.terrain, f"{probability:.2f}", *slips
    ]  # fmt: skip


def _accuracy_lines(result: Predictions) -> Iterator[str]:
    if result.accuracy is not None:
        n_trained = len(result.training_runs)
        caution = (
            f"; the model was trained on {n_trained} of {result.n_runs} runs: no measure of its skill"
            if n_trained
            else ""
        )
        yield f"accuracy {percent(result.accuracy)} over {result.n_judged} labelled windows{caution}"
    if result.n_unknown:
        yield (
            f"{result.n_unknown} windows are like no terrain that was learned, as are 5% of those of learned "
            "ones: unknown, for which the table's fallback stands"
        )
    if result.n_unsupported:
        yield f"{result.n_unsupported} predictions are supported by no training run that drove like this"
    if result.filtered_accuracy is not None:
        yield f"filtered over time {percent(result.filtered_accuracy)}; what stays uncertain counts as wrong"
    if result.filtered:
        yield f"{len(result.filtered)} runs had no estimates: filtered as on the robot, sample by sample"
    for name, count in result.unknown_labels.items():
        yield f"{count} windows are labelled {name}, which the model was not trained on: not judged"
    for text, counts in (("windows left out", result.dropped), ("repaired", result.repaired)):
        if counts:
            yield f"{text}: {format_counts(counts)}"
    yield from result.skipped or ()
