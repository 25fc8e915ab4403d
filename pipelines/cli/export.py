"""Command that writes runs for other tools: export."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.data.settings import InspectSettings
from pipelines.export.settings import ExportSettings

app = typer.Typer()


@command(app, "export")
def export_command(source: InspectSettings, settings: ExportSettings, json_file: Json = None) -> None:
    """Write runs as MCAP files or ROS 2 bags, which Foxglove, PlotJuggler and ROS open."""
    from pipelines.export.export_runs import export_runs
    from pipelines.export.screen import print_export
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console

    result = export_runs(source, settings)
    print_export(result, output_console())
    write_json(json_file, result)
