"""Data sets: every readable layout becomes a list of run logs, and a digest that names their content."""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError, LogError
from terrain.logs.spelling import one_spelling
from terrain.records import Array, RunLog

if TYPE_CHECKING:
    from terrain.logs.drive import DriveRobot
    from terrain.robots import Robot

LAYOUTS = ("auto", "runs", "borealtc", "csv", "drive", "drive-recording", "robotino", "testbed", "can", "bag")
"""``runs``: run folders as this package writes them; ``csv``: any CSV, by a mapping file; ``drive``: the
files ``samples.csv.gz`` of DRIVE, one a session; ``drive-recording``: its whole recordings; ``robotino``:
files of three motors and a camera above; ``testbed``: ``smooth.csv`` and ``grouser.csv`` of a wheel in a
box of sand, a trial a row; ``can``: logs of a CAN bus, by a DBC; ``bag``: MCAP files and ROS 2 bags, by a
mapping or by the types of their topics."""

CAN_ROBOT = "agrimaro"
"""Robot of a log of a CAN bus where none is named."""

DRIVE_ROBOT = "husky"
"""Robot of a log of DRIVE where none is named: that of the log that was published with the paper."""

ACCEPTED = (
    "accepted are run folders (run.json), the BorealTC layout (<CLASS>/imu_N.csv and pro_N.csv), "
    "the DRIVE layout (samples.csv.gz, or folders of sessions with one each), its whole recordings "
    "(<robot>_<terrain>/*.csv.gz), the Robotino layout (camera_params.json over folders of .csv.gz), "
    "the wheel testbed's (smooth.csv, grouser.csv), MCAP files and ROS 2 bags, and "
    "any CSV with a mapping file"
)

_log = logging.getLogger(__name__)


def load_runs(
    folder: str | Path,
    *,
    layout: str = "auto",
    mapping: str | Path | None = None,
    repair: bool = False,
    align: bool = False,
    robot: str | Path | None = None,
    on_skip: Callable[[str], None] = _log.warning,
) -> list[RunLog]:
    """Return the runs that lie under a folder, sorted by their id.

    Parameters
    ----------
    folder : a run folder, a folder of run folders, a folder in the BorealTC or the DRIVE layout (a session,
        or folders of sessions), or the folder that the files of ``mapping`` or bags are found under; or an
        MCAP file
    layout : one of ``LAYOUTS``; ``auto`` looks
    mapping : YAML file that describes how to read CSV files (``terrain.logs.mapping``); of logs of a CAN bus
        their DBC, by default AgriMaRo's; of bags their topics (``terrain.logs.topic_mapping``)
    repair : drop and count what a strict read refuses, and skip runs that cannot be read at all
    align : bring the wheel stream onto the clock of the IMU where the two clocks can be compared
    robot : the robot of logs that do not name theirs, by name or its YAML file; of those of DRIVE
        :data:`DRIVE_ROBOT` by default
    on_skip : called with a sentence for each run that is skipped when repairing; logs a warning by default

    Raises
    ------
    LogError
        if nothing readable is there, a run cannot be read, two runs have one id, layouts are mixed, or a
        terrain has two spellings.
    ConfigError
        if the layout is unknown, the mapping is not accepted, or a robot is unknown (to align, or to turn
        motor rates into wheel speeds).
    DataError
        if a run that is to be aligned has no gyro or no wheel speeds.
    """
    folder = Path(folder)
    described = _described(robot)
    runs = []
    skipped: list[str] = []
    places: dict[str, list[str]] = {}
    for read in _readers(folder, layout, mapping, described):
        try:
            run = read(repair=repair)
        except LogError as error:
            if not repair:
                raise
            on_skip(f"run skipped: {error}")
            skipped.append(str(error))
            continue
        runs.append(run)
        places.setdefault(run.run_id, []).append(_place(read, run))
    if not runs:
        raise LogError(f"{folder}: not one run could be read, the first for this: {skipped[0]}")
    for run_id, found in places.items():
        if len(found) > 1:
            raise LogError(f"{folder}: {len(found)} runs have the id {run_id!r} ({' and '.join(found)})")
    runs = one_spelling(str(folder), runs, repair=repair)
    runs = sorted((_with_wheel_speeds(run, described) for run in runs), key=lambda run: run.run_id)
    return [_aligned(run, described) for run in runs] if align else runs


class RunLoader(NamedTuple):
    """Reads one run of a data set as :func:`load_runs` gives it; it can be sent to another process.

    Parameters
    ----------
    read : reader of the layout
    repair, align : as :func:`load_runs`
    robot : description of the robot that is named; None where none is
    """

    read: Callable[..., RunLog]
    repair: bool
    align: bool
    robot: Robot | None

    def __call__(self) -> RunLog:
        """Return the run; errors as :func:`load_runs`."""
        run = _with_wheel_speeds(self.read(repair=self.repair), self.robot)
        return _aligned(run, self.robot) if self.align else run

    @property
    def plain_folder(self) -> Path | None:
        """The run folder that is given as it is stored; None of other layouts and of what is changed."""
        first = getattr(self.read, "args", (None,))[0]
        plain = isinstance(first, Path) and (first / "run.json").is_file()
        return first if plain and not (self.repair or self.align) else None


def run_loaders(
    folder: str | Path,
    *,
    layout: str = "auto",
    mapping: str | Path | None = None,
    repair: bool = False,
    align: bool = False,
    robot: str | Path | None = None,
) -> list[RunLoader]:
    """Return what reads each run under a folder, without reading any; parameters as :func:`load_runs`.

    Raises
    ------
    LogError, ConfigError
        as :func:`load_runs`, where no run is found or a setting is not accepted.
    """
    described = _described(robot)
    readers = _readers(Path(folder).resolve(), layout, mapping, described)
    return [RunLoader(read, repair, align, described) for read in readers]


def data_digest(runs: Sequence[RunLog]) -> str:
    """Return a SHA-256 over the content of the runs, in hexadecimal.

    It covers ids, robots, sessions, labels, channels, times and values, and neither order nor source nor
    layout on disk: a data set read from CSV and from the run folders it was imported into has one digest.

    Examples
    --------
    >>> data_digest([])[:8]
    'e3b0c442'
    """
    digest = hashlib.sha256()
    for run in sorted(runs, key=lambda run: run.run_id):
        orders = {name: np.argsort(stream.channels) for name, stream in sorted(run.streams.items())}
        head = {
            "run_id": run.run_id,
            "robot": run.robot,
            "labels": [list(label) for label in run.labels],
            **({"session": run.session} if run.session else {}),
            "streams": {
                name: [len(run.streams[name]), [run.streams[name].channels[i] for i in order]]
                for name, order in orders.items()
            },
        }
        digest.update(json.dumps(head, sort_keys=True).encode())
        for name, order in orders.items():
            digest.update(_canonical_bytes(run.streams[name].time_s))
            digest.update(_canonical_bytes(run.streams[name].values[:, order]))
    return digest.hexdigest()


def joint_digest(digests: Sequence[str]) -> str:
    """Return a SHA-256 over the digests of runs, whatever their order.

    Examples
    --------
    >>> joint_digest(["ab", "cd"]) == joint_digest(["cd", "ab"])
    True
    """
    return hashlib.sha256("".join(f"{digest}\n" for digest in sorted(digests)).encode()).hexdigest()


def _canonical_bytes(array: Array) -> bytes:
    """Return little-endian doubles with one form of NaN and one of zero."""
    return (np.where(np.isnan(array), np.nan, array) + 0.0).astype("<f8").tobytes()


def _place(read: Callable[..., RunLog], run: RunLog) -> str:
    """Return where a run was found: its run folder, else what the reader calls its source."""
    first = getattr(read, "args", (None,))[0]
    return str(first) if isinstance(first, Path) and (first / "run.json").is_file() else run.source


def _described(robot: str | Path | None) -> Robot | None:
    if robot is None:
        return None
    from terrain.robots import load_robot

    return load_robot(robot)


def _readers(
    folder: Path, layout: str, mapping: str | Path | None, robot: Robot | None
) -> list[Callable[..., RunLog]]:
    if layout not in LAYOUTS:
        raise ConfigError(f"layout {layout!r} is unknown: choose one of {', '.join(LAYOUTS)}")
    if layout == "bag" or (layout == "auto" and folder.is_file() and _holds_bags(folder)):
        return _bags(folder, mapping, robot)
    if not folder.is_dir():
        fault = "is no folder" if folder.exists() else "does not exist"
        raise LogError(f"{folder}: {fault}; {ACCEPTED}")
    of_files = ("runs", "borealtc", "drive", "drive-recording", "robotino", "testbed")
    if (mapping is not None) and layout in of_files:
        raise ConfigError(f"a mapping file is for CSV files, not for the layout {layout!r}")
    if layout == "can":
        from pipelines.data import can_codec, can_logs

        name = CAN_ROBOT if robot is None else robot.name
        return _some(can_logs.find_runs(folder, can_codec.load_layout(mapping, ()), name), folder)
    if mapping is not None or layout == "csv":
        if mapping is None:
            raise ConfigError("the layout 'csv' needs a mapping file")
        return _mapped(folder, mapping, robot)
    from terrain.logs import borealtc, drive, drive_recording, read, robotino, testbed

    # files of a Robotino have the ending of recordings, and a camera's file above them
    recorded = layout == "drive-recording" or (layout == "auto" and robotino.find_root(folder) is None)
    found: dict[str, list[Any]] = {
        "runs": read.find_runs(folder) if layout in ("auto", "runs") else [],
        "borealtc": borealtc.find_runs(folder) if layout in ("auto", "borealtc") else [],
        "drive": drive.find_sessions(folder) if layout in ("auto", "drive") else [],
        "drive-recording": drive_recording.find_recordings(folder) if recorded else [],
        "robotino": robotino.find_runs(folder) if layout in ("auto", "robotino") else [],
        "testbed": testbed.find_runs(folder) if layout in ("auto", "testbed") else [],
    }
    names = [name for name, readers in found.items() if readers]
    if len(names) > 1:
        raise LogError(f"{folder}: mixes the layouts {' and '.join(names)}; choose one with --format")
    if not names and layout == "auto" and _holds_bags(folder):
        return _bags(folder, None, robot)
    if names == ["drive"]:
        return drive.find_runs(folder, drive_robot(robot))
    if names == ["drive-recording"]:
        return drive_recording.find_runs(folder, lambda name: drive_robot(_named(name, robot)))
    return _some([reader for readers in found.values() for reader in readers], folder)


def _mapped(folder: Path, mapping: str | Path, robot: Robot | None) -> list[Callable[..., RunLog]]:
    """Return the readers of files by a mapping; a stream may lie in a bag."""
    from pipelines.data import bag_runs
    from terrain.logs import mapping as by_mapping
    from terrain.logs import topic_mapping

    read = by_mapping.load_mapping(mapping, topic_mapping.check_stream)
    try:
        radius_m = _named(read.robot, robot).wheel_radius_m
    except ConfigError:
        radius_m = None
    return by_mapping.find_runs(folder, read, partial(bag_runs.read_stream, wheel_radius_m=radius_m))


def _holds_bags(place: Path) -> bool:
    from pipelines.data.bag_files import find_bags

    return bool(find_bags(place))


def _bags(place: Path, mapping: str | Path | None, robot: Robot | None) -> list[Callable[..., RunLog]]:
    """Return the readers of bags; a place without any is refused."""
    from pipelines.data import bag_runs

    if not place.exists():
        raise LogError(f"{place}: does not exist; {ACCEPTED}")
    named = place.resolve() if place.is_file() else place  # a file that the user names may be a link
    return _some(bag_runs.find_runs(named, mapping, robot), place)


def drive_robot(robot: Robot | None) -> DriveRobot:
    """Return what the reader of DRIVE takes of a robot."""
    from terrain.logs.drive import DriveRobot
    from terrain.robots import SkidSteerRobot, as_drive, load_robot

    robot = as_drive(
        SkidSteerRobot,
        load_robot(DRIVE_ROBOT) if robot is None else robot,
        "robot {name}: drive {drive!r} does not fit logs of DRIVE, which have a left and a right "
        "wheel speed, as 'skid_steer' has",
    )
    fastest = robot.motors.speed_max_radps if robot.describes("motors") else math.inf
    return DriveRobot(robot.name, robot.wheel_radius_m, fastest)


def _some(readers: list[Callable[..., RunLog]], folder: Path) -> list[Callable[..., RunLog]]:
    if not readers:
        raise LogError(f"{folder}: holds no run; {ACCEPTED}")
    return readers


def _with_wheel_speeds(run: RunLog, robot: Robot | None) -> RunLog:
    """Add wheel speeds where a log has motor rates, so that windows know how fast the robot drove."""
    wheels = run.streams.get("wheels")
    if wheels is None or not any(channel.startswith("motor_") for channel in wheels.channels):
        return run
    from terrain.kinematics.wheel_speed import with_wheel_speeds

    return with_wheel_speeds(run, robot_of(run, robot))


def robot_of(run: RunLog, robot: Robot | None) -> Robot:
    """Return the robot of a run: ``robot``, where it has the name that the run states, else the package's.

    Raises
    ------
    ConfigError
        if the package has no robot of the name.
    """
    return _named(run.robot, robot)


def _named(name: str, robot: Robot | None) -> Robot:
    from terrain.robots import packaged_robot

    return robot if robot is not None and robot.name == name else packaged_robot(name)


def _aligned(run: RunLog, robot: Robot | None) -> RunLog:
    from terrain.logs.align import align
    from terrain.logs.clock import estimate_clock

    return align(run, estimate_clock(run, track_m=robot_of(run, robot).track_m))
