"""Blind trials of the diagnosis."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.explain.trials import TrialsSettings

app = typer.Typer()


@command(app, "explain-trials")
def explain_trials_command(settings: TrialsSettings, json_file: Json = None) -> None:
    """Hide effects in simulated runs, diagnose them blindly, and count how often that is right."""
    from pipelines.explain.trials import explain_trials, print_explain_trials
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    with progress_bar() as progress:
        result = explain_trials(settings, progress)
    print_explain_trials(result, output_console())
    write_json(json_file, result)
