"""``terrain track``."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.track.settings import TrackSettings

app = typer.Typer()


@command(app, "track")
def track_command(settings: TrackSettings, json_file: Json = None) -> None:
    """Let a car-like robot follow a path of yours in simulation, with an observer of sideslip."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console
    from pipelines.track.screen import print_track
    from pipelines.track.track import track

    result = track(settings)
    print_track(result, output_console())
    write_json(json_file, result)
