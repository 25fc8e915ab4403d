"""Command on the labels of recorded runs: label."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.label.settings import LabelSettings

app = typer.Typer()


@command(app, "label")
def label_command(settings: LabelSettings, json_file: Json = None) -> None:
    """List windows of low confidence of recorded runs, or set their terrain."""
    from pipelines.label.labels import doubtful_windows, set_label
    from pipelines.label.screen import print_doubtful, print_labelled
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console

    if settings.sets:
        labelled = set_label(settings)
        print_labelled(labelled, output_console())
        write_json(json_file, labelled)
        return
    found = doubtful_windows(settings)
    print_doubtful(found, output_console())
    write_json(json_file, found)
