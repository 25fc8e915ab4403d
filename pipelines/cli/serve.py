"""The command of the live service: serve."""

from __future__ import annotations

import typer

from pipelines.cli.command import Json, command
from pipelines.serve.settings import ServeSettings

app = typer.Typer()


@command(app, "serve")
def serve_command(settings: ServeSettings, json_file: Json = None) -> None:
    """Serve terrain, target slips and commands to robots, live."""
    from pipelines.serve.server import Service, checked, prepare

    prepared = prepare(settings)
    if not settings.check:
        Service(prepared).run(lambda url: typer.echo(f"serving {settings.model} at {url}"))
        return
    from pipelines.reporting.json_file import write_json

    result = checked(prepared, settings.robot)
    typer.echo(f"{settings.model} can be served: {', '.join(result.classes)}")
    write_json(json_file, result)
