"""Settings of ``terrain explain`` and ``terrain explain-trials``."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import field_validator

from pipelines.data.settings import AlignedRunsSettings
from pipelines.report.settings import Settings, setting
from terrain.discrepancy.trials.rows import Row


class ExplainSettings(AlignedRunsSettings):
    """Runs to explain, the simulation under test, and where the page goes."""

    robot: str = setting(..., "Robot whose simulation is tested: name or YAML file.")
    out: Path = setting(..., "Folder of the page, its pictures, and the extended robot.")
    model: str | None = setting(None, "Extended description of that robot, tested in its place.")
    effects: tuple[str, ...] | None = setting(
        None, "Effects that may be named, by commas; all by default.", separated=True
    )
    terrain: str | None = setting(None, "Use only runs of this label.")
    hold_out: int | None = setting(
        None, "Runs held out to measure the gain; a quarter of six or more by default.", ge=0
    )
    classifier: bool = setting(
        False, "Also train a classifier in simulation, before and after; takes a minute."
    )
    pictures: str = setting("12", "Most pictures of the page: a number, or 'all' for one of every run too.")
    seed: int = setting(0, "Of the choice of held-out runs, and of the bootstrap.", ge=0)

    @field_validator("pictures")
    @classmethod
    def _check_pictures(cls, pictures: str) -> str:
        if pictures != "all" and not pictures.isdecimal():
            raise ValueError(f"--pictures is {pictures!r}; a number or 'all' is required")
        return pictures

    @property
    def max_pictures(self) -> int | None:
        """Most pictures; None for all."""
        return None if self.pictures == "all" else int(self.pictures)


class TrialsSettings(Settings):
    """Blind trials: how many of which kind."""

    n: int = setting(
        100,
        "Trials of each row; row 'found' takes the effects in turn, 50 trials a round, and gives a result "
        "after 5 rounds.",
        ge=1,
    )
    seed: int = setting(0, "Of all that is drawn.", ge=0)
    rows: tuple[str, ...] = setting(
        tuple(row.value for row in Row), "Kinds of trials, by commas.", separated=True
    )
    runs: int = setting(8, "Runs of each trial; 80 of 6 s in rows short and known.")
    n_jobs: int = setting(0, "Processes at once; 0 for one a core.", "--jobs", ge=0)

    @field_validator("rows")
    @classmethod
    def _check_rows(cls, rows: tuple[str, ...]) -> tuple[str, ...]:
        if not rows or len(set(rows)) < len(rows) or set(rows) - set(Row):
            raise ValueError(f"--rows is {','.join(rows)!r}; some of {','.join(Row)} are required, each once")
        return rows

    @property
    def jobs(self) -> int:
        """Processes at once: what was asked for, or one a core."""
        return self.n_jobs or os.cpu_count() or 1
