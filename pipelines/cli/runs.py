"""Commands on runs themselves: import, inspect, simulate."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.runs.settings import ImportSettings, InspectSettings, SimulateSettings

app = typer.Typer()


@command(app, "import")
def import_command(settings: ImportSettings, json_file: Json = None) -> None:
    """Turn logs of any readable layout into run folders."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console
    from pipelines.runs.import_logs import import_logs
    from pipelines.runs.screen import print_import

    result = import_logs(settings)
    print_import(result, output_console())
    write_json(json_file, result)


@command(app, "inspect")
def inspect_command(settings: InspectSettings, json_file: Json = None) -> None:
    """Show rates, lengths, gaps, stuck channels, and whether two loggers share one clock."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console
    from pipelines.runs.inspect_logs import inspect_logs
    from pipelines.runs.screen import print_inspection

    result = inspect_logs(settings)
    print_inspection(result, output_console())
    write_json(json_file, result)


@command(app, "simulate")
def simulate_command(settings: SimulateSettings, json_file: Json = None) -> None:
    """Simulate runs: ordinary run folders, with the truth beside the measurements."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import progress_bar
    from pipelines.runs.simulate import simulate_runs

    with progress_bar() as progress:
        result = simulate_runs(settings, progress)
    runs_of = "run of" if result.n_runs == 1 else "runs, in all"
    typer.echo(f"{result.n_runs} {runs_of} {result.duration_s:.0f} s, written to {result.out}")
    write_json(json_file, result)
