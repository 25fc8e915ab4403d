"""Settings of what reads runs: where they lie, in which layout, and what is done about their faults."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from pipelines.config.settings import Settings, setting

if TYPE_CHECKING:
    from terrain.records import RunLog

Layout = Literal["auto", "runs", "borealtc", "csv", "drive"]
"""``auto``: found out; ``runs``: run folders as this package writes them; ``csv``: any CSV, by a mapping
file; ``drive``: the file ``samples.csv.gz`` of the Husky log of DRIVE."""


class ReadSettings(Settings):
    """How files are read."""

    layout: Layout = setting("auto", "Layout of the folder.", option="--format")
    mapping: Path | None = setting(None, "YAML file that says how to read CSV files.")
    repair: bool = setting(False, "Drop and count what a strict read refuses.")


class RunsSettings(ReadSettings):
    """The runs that a command works on."""

    data: Path = setting(..., "Folder of runs in any readable layout.")

    @property
    def dataset(self) -> str:
        """Name of the data set: that of its folder."""
        return self.data.resolve().name


class AlignedRunsSettings(RunsSettings):
    """The runs of a command that can also bring their two loggers onto one clock."""

    align: bool = setting(False, "Bring the wheel stream onto the IMU's clock where both see the turns.")


class InspectSettings(RunsSettings):
    """What is inspected."""

    data: Path = setting(..., "Folder to read.", option="FOLDER")


class ImportSettings(InspectSettings):
    """What is imported, and where to."""

    out: Path = setting(..., "Folder of the new run folders.")


class LoadedRuns(NamedTuple):
    """Runs, and a sentence for each run that a repairing read had to skip."""

    runs: list[RunLog]
    skipped: list[str]


def load(settings: RunsSettings) -> LoadedRuns:
    """Return the runs, sorted by their id.

    Raises
    ------
    LogError, ConfigError, DataError
        as :func:`pipelines.runs.datasets.load_runs`.
    """
    from pipelines.runs.datasets import load_runs

    skipped: list[str] = []
    runs = load_runs(
        settings.data,
        layout=settings.layout,
        mapping=settings.mapping,
        repair=settings.repair,
        align=isinstance(settings, AlignedRunsSettings) and settings.align,
        on_skip=skipped.append,
    )
    return LoadedRuns(runs, skipped)
