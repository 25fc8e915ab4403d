"""Settings of the commands on runs: which are read, in which layout, with which faults, or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol, TypeVar

from pydantic import field_validator

from pipelines.report.settings import Settings, setting
from terrain.errors import ConfigError
from terrain.files.names import listed, shown

if TYPE_CHECKING:
    from terrain.records import RunLog

Layout = Literal[
    "auto", "runs", "borealtc", "csv", "drive", "drive-recording", "robotino", "testbed", "can", "bag"
]
"""``auto``: found out; ``runs``: run folders as this package writes them; ``csv``: any CSV, by a mapping
file; ``drive``: the files ``samples.csv.gz`` of DRIVE, one a session; ``drive-recording``: its whole
recordings; ``robotino``: three motors and a camera above; ``testbed``: ``smooth.csv`` and ``grouser.csv`` of
a wheel in a box of sand, a trial a row; ``can``: logs of a CAN bus; ``bag``: MCAP files and ROS 2 bags."""


ROBOT_TEXT = (
    "Robot of logs that do not name theirs (DRIVE, CAN, bags), by name or its YAML file; of DRIVE the husky."
)


MAPPING_TEXT = (
    "YAML file that describes CSV files by the keys robot, run_id, terrain, streams; of a stream file, time, "
    "channels, delimiter, decimal, skip_rows, header_rows; of time and channels column, unit; of channels "
    "scale, offset (docs/mapping.md). With --format bag topics; with can a DBC."
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
    only: tuple[str, ...] = setting((), "Ids of the runs to use, by commas; all by default.", separated=True)
    without: tuple[str, ...] = setting((), "Ids of runs to leave out, by commas.", separated=True)
    align: bool = setting(False, "Bring the wheel stream onto the IMU's clock where both see the turns.")


class InspectSettings(RunsSettings):
    """What is inspected."""

    data: Path = setting(..., "Folder to read, or an MCAP file.", option="FOLDER")
    robot: str | None = setting(None, ROBOT_TEXT)


class ImportSettings(InspectSettings):
    """What is imported, and where to."""

    mapping: Path | None = setting(None, MAPPING_TEXT)
    out: Path = setting(..., "Folder of the new run folders.")


class Named(Protocol):
    """What has the id of a run."""

    @property
    def run_id(self) -> str:
        """Id of the run."""


AnyRun = TypeVar("AnyRun", bound=Named)


class LoadedRuns(NamedTuple):
    """Runs, and a sentence for each run that a repairing read had to skip."""

    runs: list[RunLog]
    skipped: list[str]


def load(settings: RunsSettings, robot: str | None = None, *, align: bool = False) -> LoadedRuns:
    """Return the runs, sorted by their id.

    Parameters
    ----------
    settings : which runs, and how they are read
    robot : of logs that do not name theirs; that of the settings by default, where they have one
    align : bring the wheel stream onto the clock of the IMU; as the settings have it, where they do

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
        align=align or (isinstance(settings, AlignedRunsSettings) and settings.align),
        robot=getattr(settings, "robot", None) if robot is None else robot,
        on_skip=skipped.append,
    )
    if isinstance(settings, AlignedRunsSettings):
        runs = chosen_runs(runs, settings)
    return LoadedRuns(runs, skipped)


def chosen_runs(runs: Sequence[AnyRun], settings: AlignedRunsSettings) -> list[AnyRun]:
    """Return the runs that ``--only`` and ``--without`` leave.

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
    chosen = [
        run
        for run in runs
        if (not settings.only or run.run_id in settings.only) and run.run_id not in settings.without
    ]
    if not chosen:
        raise ConfigError("--only and --without leave no run")
    return chosen


class SimulateSettings(Settings):
    """What is simulated, and where to."""

    robot: str = setting(..., "Robot by name, or its YAML file.")
    terrain: str = setting(..., "Name of a soil, 'all' for each in turn, 'course' or 'bench'.")
    scenario: str = setting(
        ...,
        "stand, straight, arc, starts, climb, brake, circle, crab, spot_turn, complex, survey; slip, for "
        "learn-slip; course on 'course', six_positions on 'bench'.",
    )
    out: Path = setting(..., "Folder of the new run folders.")
    runs: int = setting(1, "Number of runs for each terrain.", ge=1)
    duration_s: float | None = setting(None, "Length of a run in s.", option="--duration")
    seed: int = setting(0, "Seed of everything that is drawn.", ge=0)
    vary: bool = setting(False, "Draw soil, slope, load and tyres anew for each run.")
    grade_deg: float = setting(
        0.0, "Slope along the start's heading in degrees, uphill > 0.", option="--grade", ge=-30.0, le=30.0
    )
    payload_kg: float = setting(0.0, "Load in kg.", option="--payload", ge=0.0)
    camera_lost: tuple[str, ...] = setting((), "START:END in s without the camera; may be given again.")
    gnss: bool = setting(False, "With an RTK receiver on board.")
    effect: tuple[str, ...] = setting(
        (), "NAME=VALUE of an effect that acts, as wheel_radius=0.03; may be given again."
    )

    @property
    def camera_lost_s(self) -> tuple[tuple[float, float], ...]:
        """Intervals (start, end) without the camera."""
        return tuple(_interval(text) for text in self.camera_lost)

    @field_validator("camera_lost")
    @classmethod
    def _check_intervals(cls, texts: tuple[str, ...]) -> tuple[str, ...]:
        for text in texts:
            _interval(text)
        return texts


def _interval(text: str) -> tuple[float, float]:
    """Read ``START:END``."""
    start, _, end = text.partition(":")
    try:
        start_s, end_s = float(start), float(end)
    except ValueError:
        start_s = end_s = 0.0
    if not 0.0 <= start_s < end_s:
        raise ValueError(f"--camera-lost is {text!r}; START:END in seconds is required, as in 10:13")
    return start_s, end_s
