"""The command of the live service: serve."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from pipelines.cli.command import command
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
def serve_command(settings: ServeSettings) -> None:
    """Serve terrain, target slips and commands to robots, live."""
    with without("pandas"):  # scikit-learn takes it: 67 MB and a second, and the service has no use for it
        from pipelines.serve.server import Service, prepare

    Service(prepare(settings)).run(lambda url: typer.echo(f"serving {settings.model} at {url}"))
