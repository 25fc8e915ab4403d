"""The command find-changes."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.data.settings import RunsSettings, load
from pipelines.ground_changes.settings import FindChangesSettings

app = typer.Typer()


@command(app, "find-changes")
def find_changes_command(settings: FindChangesSettings, json_file: Json = None) -> None:
    """Find changes of the ground as a robot drives, from the currents of its wheels."""
    from pipelines.ground_changes.find import find_changes
    from pipelines.ground_changes.screen import print_changes
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    runs, skipped = load(settings)
    quiet, also_skipped = load(RunsSettings(data=settings.calibrate, repair=settings.repair), settings.robot)
    with progress_bar() as progress:
        result = find_changes(runs, quiet, settings, [*skipped, *also_skipped], progress)
    print_changes(result, output_console())
    write_json(json_file, result)
