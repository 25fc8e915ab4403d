"""Screen of ``terrain calibrate``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipelines.estimate.calibration_results import CalibrationResult

if TYPE_CHECKING:
    from rich.console import Console


def print_calibration(result: CalibrationResult, console: Console) -> None:
    """Print a calibration: what was found, then what was not and why."""
    from rich.table import Table

    found = [finding for finding in result.findings if finding.value is not None]
    table = Table(title=f"{result.robot}: {len(found)} numbers from {len(result.run_ids)} runs")
    for heading, right in (("number", False), ("was", True), ("is", True), ("95 % from", True), ("to", True)):
        table.add_column(heading, justify="right" if right else "left")
    table.add_column("of")
    for finding in found:
        figures = (finding.described, finding.value, finding.low, finding.high)
        runs = f", {len(finding.runs)} run{'s' * (len(finding.runs) > 1)}" * (finding.counted != "runs")
        table.add_row(
            finding.parameter,
            *("" if figure is None else f"{figure:.4g}" for figure in figures),
            f"{finding.n} {finding.counted}{runs}",
        )
    console.print(table)
    for title, chosen in (("not determined", False), ("assumed", True)):
        notes: dict[str, list[str]] = {}
        for finding in result.findings:
            if finding.note and (finding.value is not None) == chosen:
                notes.setdefault(finding.note, []).append(finding.parameter)
        for note, parameters in notes.items():
            console.print(f"{title}: {', '.join(parameters)}: {note}", highlight=False)
    if result.out is not None:
        console.print(f"written to {result.out}", highlight=False)
