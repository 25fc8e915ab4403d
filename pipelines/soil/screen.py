"""What ``terrain fit-soil`` prints."""

from __future__ import annotations

from rich.console import Console

from pipelines.reporting.numbers import sentence
from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column
from pipelines.soil.page import coupling_text, misfit_cells, verdict
from pipelines.soil.results import FitSoilResult, WheelResult


def print_soil(result: FitSoilResult, console: Console) -> None:
    """Print the laws of each wheel with their errors on what was left out, the parameters and the limits."""
    for wheel in result.wheels:
        _print_laws(wheel, console)
        _print_parameters(wheel, console)
        print_lines(
            console,
            [
                sentence(coupling_text(wheel)),
                verdict(wheel),
                *wheel.not_identified,
                f"soil written to {wheel.soil.file}",
            ],
        )
    print_lines(console, [f"page and pictures in {result.out}", *result.skipped])


def _print_laws(wheel: WheelResult, console: Console) -> None:
    table = compact_table(
        text_column("law"),
        *number_columns(
            "param.", "given", "slip out: traction", "side", "mm", "angle out: traction", "side", "mm"
        ),
        title=f"{wheel.wheel} wheel, {wheel.n_trials} trials: errors over the load",
    )
    for row in wheel.laws:
        for given in ("load", "sinkage"):
            slip, angle = (misfit_cells(getattr(found, given))[1:] for found in (row.slip, row.angle))
            cells = (row.name, str(row.n_parameters)) if given == "load" else ("", "")
            if "nan%" not in slip:
                table.add_row(*cells, given, *slip, *angle)
    slip, angle = (misfit_cells(each)[1:] for each in (wheel.surrogate_slip, wheel.surrogate_angle))
    table.add_row("(polynomial)", "", "load", *slip, *angle)
    console.print(table)


def _print_parameters(wheel: WheelResult, console: Console) -> None:
    table = compact_table(
        text_column("parameter"),
        *number_columns("value", "95 %", "of the prior"),
        "identified",
        title=f"{wheel.wheel} wheel, law {wheel.law}",
    )
    for each in wheel.parameters.values():
        low, high = each.interval
        table.add_row(
            each.name,
            f"{each.value:.4g}",
            f"{low:.4g} to {high:.4g}",
            f"{each.informed_ratio:.2f}",
            "yes" if each.identified else "no",
        )
    console.print(table)
