"""Settings of the commands on runs: which are read, in which layout, with which faults, or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pipelines.data.layouts import Layout
from pipelines.report.settings import Names, Settings, setting
from terrain.errors import ConfigError
from terrain.files.names import listed, shown

if TYPE_CHECKING:
    from terrain.records import RunLog

ROBOT_TEXT = (
    "Robot of logs that do not name theirs (DRIVE, CAN, bags), by name or its YAML file; of DRIVE the husky."
)

MAPPING_TEXT = (
    "YAML file that describes CSV, .mat and .xlsx files by the keys robot, run_id, terrain, streams; of a stream "
    "file, time, channels, position, delimiter, decimal, sheet, skip_rows, header_rows; of time and channels "
    "column, unit, offset; of channels scale (docs/mapping.md). With --format bag topics; with can a DBC."
)


class ReadSettings(Settings):
    """How files are read."""

    layout: Layout = setting("auto", "Layout of the folder.", option="--format")
    mapping: Path | None = setting(
        None, "YAML file that describes how to read CSV files, or with --format bag topics; with can a DBC."
    )
    repair: bool = setting(False, "Drop and count what a strict read refuses.")


class RunsSettings(ReadSettings):
    """The runs that a command works on."""

    data: Path = setting(..., "Folder of runs in any readable layout, or an MCAP file.")

    @property
    def dataset(self) -> str:
        """Name of the data set: that of its folder."""
        return self.data.resolve().name


class AlignedRunsSettings(RunsSettings):
    """The runs of a command that can choose among them, and bring their two loggers onto one clock."""

    robot: str | None = setting(None, ROBOT_TEXT)
    only: Names = setting((), "Ids of the runs to use, by commas; all by default.")
    without: Names = setting((), "Ids of runs to leave out, by commas.")
    align: bool = setting(False, "Bring the wheel stream onto the IMU's clock where both see the turns.")


class LoadedRuns(NamedTuple):
    """Runs, and a sentence for each run that a repairing read had to skip."""

    runs: list[RunLog]
    skipped: list[str]


def load(settings: RunsSettings) -> LoadedRuns:
    """Return the runs of the settings, sorted by their id.

    Raises
    ------
    LogError, ConfigError, DataError
        as :func:`pipelines.data.datasets.load_runs`.
    """
    from pipelines.data.datasets import load_runs

    skipped: list[str] = []
    runs = load_runs(
        settings.data,
        layout=settings.layout,
        mapping=settings.mapping,
        repair=settings.repair,
        align=isinstance(settings, AlignedRunsSettings) and settings.align,
        robot=getattr(settings, "robot", None),
        on_skip=skipped.append,
    )
    if isinstance(settings, AlignedRunsSettings):
        runs = chosen_runs(runs, settings)
    return LoadedRuns(runs, skipped)


def chosen_runs(runs: Sequence[Any], settings: AlignedRunsSettings) -> list[Any]:
    """Return those of runs, or of what has the id of one, that ``--only`` and ``--without`` leave.

    Raises
    ------
    ConfigError
        if there is no run of a name, or none is left.
    """
    known = [run.run_id for run in runs]
    for option, names in (("--only", settings.only), ("--without", settings.without)):
        for name in names:
            if name not in known:
                raise ConfigError(f"{option}: there is no run {shown(name)}; there are {listed(known)}")
    kept = set(settings.only or known) - set(settings.without)
    chosen = [run for run in runs if run.run_id in kept]
    if not chosen:
        raise ConfigError("--only and --without leave no run")
    return chosen
