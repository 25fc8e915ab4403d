"""The command of the live service: serve."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from pipelines.cli.command import Json, command
from pipelines.serve.settings import ServeSettings

app = typer.Typer()


@contextmanager
def without(package: str) -> Iterator[None]:
    """Keep a package that others import where they find it from being imported."""
    if package in sys.modules:
        yield
        return
    sys.modules[package] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules[package]


@command(app, "serve")
def serve_command(settings: ServeSettings, json_file: Json = None) -> None:
    """Serve terrain, target slips and commands to robots, live."""
    with without("pandas"):  # scikit-learn takes it: 67 MB and a second, and the service has no use for it
        from pipelines.serve.server import Service, checked, prepare

    prepared = prepare(settings)
    if not settings.check:
        Service(prepared).run(lambda url: typer.echo(f"serving {settings.model} at {url}"))
        return
    from pipelines.reporting.json_file import write_json

    result = checked(prepared, settings.robot)
    typer.echo(f"{settings.model} can be served: {', '.join(result.classes)}")
    write_json(json_file, result)
