"""Terminal output of ``terrain faults``."""

from __future__ import annotations

from rich.console import Console
from rich.table import Column

from pipelines.faults.results import SHORT_BARS, FaultsResult
from pipelines.faults.tables import names_sensors, overview, situation_headings
from pipelines.reporting.numbers import format_known
from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column


def print_faults(result: FaultsResult, console: Console) -> None:
    """Print the unmet bars of each fault, what clean drives show, and the counts by bar."""
    names = names_sensors(result)
    table = compact_table(
        Column("fault", no_wrap=True),
        "nature",
        *map(text_column, situation_headings(result).values()),
        *([text_column("sensors named")] if names else []),
        title="bars that are not met, over durations and seeds",
    )
    for row in overview(result):
        table.add_row(row.fault, row.nature, *row.cells, *([row.blamed] if names else []))
    console.print(table)
    _print_clean(result, console)
    bars = compact_table(
        "", *number_columns("met", "unmet", "not judged"), text_column("bar"), title="rows by bar"
    )
    for name, bar in result.bars.items():
        bars.add_row(SHORT_BARS[name], str(bar.n_met), str(bar.n_unmet), str(bar.n_not_judged), bar.text)
    console.print(bars)
    print_lines(
        console,
        [
            f"{result.robot}, table {result.table}, seeds: {len(result.seeds)}, delay {result.delay_s:g} s: "
            f"{result.n_met} of {len(result.rows)} rows meet all bars"
        ],
    )


def _print_clean(result: FaultsResult, console: Console) -> None:
    headings = ("error of slip", "not OK, s", "peak of slip", "plain's", "stop, m", "plain's, m")
    table = compact_table(text_column(""), *number_columns(*headings), title="without a fault")
    for one in result.clean:
        values = (
            *(one.slip_error_ratio, one.not_ok_s, one.slip_peak_ratio, one.plain_slip_peak_ratio),
            *(one.stop_m, one.plain_stop_m),
        )
        seed = f", seed {one.seed}" if len(result.seeds) > 1 else ""
        cells = (format_known(value, "{:.3f}") for value in values)
        table.add_row(f"{one.situation} on {one.terrain}{seed}", *cells)
    console.print(table)
