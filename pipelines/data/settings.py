"""Settings of the commands on runs: which are read, in which layout, with which faults."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pipelines.report.settings import Names, Settings, setting
from terrain.errors import ConfigError
from terrain.files.names import listed, shown

Layout = Literal[
    "auto",
    "runs",
    "borealtc",
    "csv",
    "drive",
    "drive-recording",
    "robotino",
    "testbed",
    "tricycle",
    "can",
    "bag",
]
"""``auto``: found out; ``runs``: run folders as this package writes them; ``csv``: any CSV, by a mapping
file; ``drive``: the files ``samples.csv.gz`` of DRIVE, one a session; ``drive-recording``: its whole
recordings; ``robotino``: files of three motors and a camera above; ``testbed``: ``smooth.csv`` and
``grouser.csv`` of a wheel in a box of sand, a trial a row; ``can``: logs of a CAN bus, by a DBC; ``bag``: MCAP
files and bags of ROS, by a mapping or by the types of their topics."""

Target = Literal["runs", "mcap", "ros2", "ros2-mcap", "csv"]
"""``runs``: run folders; ``mcap``: a file a run; ``ros2``, ``ros2-mcap``: a bag a run; ``csv``: tables a run."""

MAPPING_TEXT = (
    "YAML file that describes CSV, .mat and .xlsx files by the keys robot, run_id, terrain, streams; of a stream "
    "file, time, channels, position, delimiter, decimal, sheet, skip_rows, header_rows; of time and channels "
    "column, unit, offset; of channels scale (docs/mapping.md). With --format bag topics; with can a DBC."
)


class ReadSettings(Settings):
    """How files are read."""

    layout: Layout = setting("auto", "Layout of the folder.", option="--format")
    mapping: Path | None = setting(None)
    """YAML file that describes how to read CSV files, or with --format bag topics; with can a DBC."""
    repair: bool = setting(False, "Drop and count what a strict read refuses.")


class RunsSettings(ReadSettings):
    """The runs that a command works on."""

    data: Path = setting(..., "Folder of runs in any readable layout, or an MCAP file.")
    robot: str | None = setting(None)
    """Robot of logs that do not name theirs (DRIVE, CAN, bags), by name or its YAML file; of DRIVE the husky."""

    @property
    def dataset(self) -> str:
        """Name of the data set: that of its folder."""
        return self.data.resolve().name


class AlignedRunsSettings(RunsSettings):
    """The runs of a command that can choose among them, and bring their two loggers onto one clock."""

    only: Names = setting((), "Ids of the runs to use, by commas; all by default.")
    without: Names = setting((), "Ids of runs to leave out, by commas.")
    align: bool = setting(False, "Bring the wheel stream onto the IMU's clock where both see the turns.")


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
