"""``terrain reproduce``."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from pipelines.cli.command import Json, command
from pipelines.reproduce.settings import ReproduceSettings

app = typer.Typer()


class PaperName(StrEnum):
    """Papers that can be reproduced."""

    danzi = "danzi"
    tazzari = "tazzari"
    yamauchi = "yamauchi"
    deremetz = "deremetz"


@command(app, "reproduce")
def reproduce_command(
    paper: Annotated[PaperName, typer.Argument(help="Whose experiments to rerun in simulation.")],
    settings: ReproduceSettings,
    json_file: Json = None,
) -> None:
    """Rerun a paper's experiments in simulation, its figures beside the simulated ones."""
    from pipelines.reporting.json_file import write_json
    from pipelines.reporting.terminal import output_console, progress_bar
    from pipelines.reproduce.reproduce import reproduce
    from pipelines.reproduce.screen import print_reproduction

    with progress_bar() as progress:
        result = reproduce(paper.value, settings.out, settings.seed, progress)
    print_reproduction(result, output_console())
    write_json(json_file, result)
