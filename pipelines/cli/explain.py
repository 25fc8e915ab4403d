"""Commands that compare measured runs with a simulation: explain, explain-trials."""

from __future__ import annotations

from dataclasses import replace

import typer

from pipelines.cli.command import Json, command
from pipelines.data.settings import load
from pipelines.explain.settings import ExplainSettings, TrialsSettings

app = typer.Typer()


@command(app, "explain")
def explain_command(settings: ExplainSettings, json_file: Json = None) -> None:
    """Find what a robot's simulation gets wrong about runs, extend it, and measure the gain."""
    from pipelines.explain.explain import explain
    from pipelines.explain.screen import print_explain
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    runs, skipped = load(settings)
    with progress_bar() as progress:
        result = replace(explain(runs, settings, progress), skipped=tuple(skipped))
    print_explain(result, output_console())
    write_json(json_file, result)


@command(app, "explain-trials")
def explain_trials_command(settings: TrialsSettings, json_file: Json = None) -> None:
    """Hide effects in simulated runs, diagnose them blindly, and count how often that is right."""
    from pipelines.explain.screen import print_explain_trials
    from pipelines.explain.trials import explain_trials
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar

    with progress_bar() as progress:
        result = explain_trials(settings, progress)
    print_explain_trials(result, output_console())
    write_json(json_file, result)
