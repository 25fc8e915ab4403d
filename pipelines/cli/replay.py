"""Command on the live chain over a log: replay."""

from __future__ import annotations

from threading import Event

import typer

from pipelines.cli.command import Json, command
from pipelines.data.settings import InspectSettings
from pipelines.replay.settings import ReplaySettings

app = typer.Typer()


@command(app, "replay")
def replay_command(source: InspectSettings, settings: ReplaySettings, json_file: Json = None) -> None:
    """Replay a log through the live chain, at its own speed or as fast as it goes."""
    from pipelines.replay.replay import replay_logs
    from pipelines.replay.screen import live_view, print_replay
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.stopping import stopping
    from pipelines.reporting.terminal import output_console

    console, stopped = output_console(), Event()
    with live_view(console) as show, stopping(stopped.set):
        result = replay_logs(source, settings, show, stopped.is_set)
    print_replay(result, console)
    write_json(json_file, result)
    if result.interrupted:
        raise typer.Exit(130)
