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
