"""What ``terrain sweep`` prints."""

from __future__ import annotations

from rich.console import Console

from pipelines.reporting.numbers import percent
from pipelines.reporting.terminal import print_lines
from pipelines.sweep.sweep import SweepReport


def print_sweep(found: SweepReport, console: Console) -> None:
    """Print the best candidate, and what it is worth on runs that were held out of the search."""
    best, held_out = found.best, found.held_out
    (low, high), (least, most) = best.accuracy_ci, held_out.interval
    chosen = ", ".join(f"{name} {value:g}" for name, value in best.params._asdict().items())
    begun = f", {found.resumed} of them from before" if found.resumed else ""
    print_lines(
        console,
        [
            f"{found.dataset}: best of {found.trials} trials{begun}: {chosen}",
            f"accuracy on inner folds of whole runs {percent(best.accuracy)} (95 % over runs: {low:.1%} to "
            f"{high:.1%}), the best of many and therefore optimistic",
            f"on {len(found.held_out_runs)} runs that no trial saw: {percent(held_out.b)}, by the default "
            f"choice {percent(held_out.a)}: {100 * held_out.difference:+.1f} points ({100 * least:+.1f} to "
            f"{100 * most:+.1f}), {held_out.verdict.value}",
            f"use it: --params {found.params_file}",
        ],
    )
