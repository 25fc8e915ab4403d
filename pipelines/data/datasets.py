"""Data sets: every readable layout becomes a list of run logs."""

from __future__ import annotations

import logging
import math
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from operator import attrgetter
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from pipelines.data.settings import AlignedRunsSettings, RunsSettings, chosen_runs
from terrain.errors import ConfigError, DoubtfulRunWarning, LogError, TerrainError
from terrain.logs.motion_checks import Described, is_short
from terrain.logs.plausibility import (
    Check,
    Doubt,
    counted,
    doubt_sentences,
    doubts_of,
    judge,
    judge_together,
    refuse_implausible_runs,
)

if TYPE_CHECKING:
    from pipelines.data.runs import Runs
    from terrain.logs.drive import DriveRobot
    from terrain.records import RunLog, Stream
    from terrain.robots import Robot

    Readers = list[Callable[..., RunLog]]
    """One a run; called with ``repair=``."""

CAN_ROBOT = "agrimaro"  #: Robot of a log of a CAN bus where none is named

DRIVE_ROBOT = "husky"
"""Robot of a log of DRIVE where none is named: that of the log that was published with the paper."""

ACCEPTED = (
    "accepted are run folders (run.json), the BorealTC layout (<CLASS>/imu_N.csv and pro_N.csv), "
    "the DRIVE layout (samples.csv.gz, or folders of sessions with one each), its whole recordings "
    "(<robot>_<terrain>/*.csv.gz), the Robotino layout (camera_params.json over folders of .csv.gz), "
    "the wheel testbed's (smooth.csv, grouser.csv), ticks of a tricycle (.txt, .txt.gz), MCAP files and bags, and "
    "any CSV with a mapping file"
)
"""What a refusal lists."""

FOUND_BY: dict[str, tuple[str, tuple[str, ...]]] = {
    "runs": ("terrain.logs.run_folders:find_runs", ("run.json", "*/run.json")),
    "borealtc": ("terrain.logs.mapping:find_borealtc", ("*/imu_*.csv", "*/pro_*.csv")),
    "drive": ("terrain.logs.drive:find_sessions", ("samples.csv.gz", "*/samples.csv.gz")),
    "robotino": (
        "terrain.logs.robotino:find_runs",
        tuple(f"{above}camera_params.json" for above in ("", "../", "../../", "../../../")),
    ),
    "drive-recording": ("terrain.logs.drive:find_recordings", ("*.csv.gz", "*/*.csv.gz")),
    "testbed": ("terrain.logs.testbed:find_runs", ("smooth.csv", "grouser.csv")),
    "tricycle": ("terrain.logs.tricycle:find_runs", ("*.txt", "*.txt.gz")),
}
"""What finds the runs of each layout, and patterns of its files: without one of these it is not even imported."""

T = TypeVar("T")
MOST_TOGETHER = 100  #: Short runs that are judged together: so many show what all do

_log = logging.getLogger(__name__)


class RunLoader(NamedTuple):
    """Reads one run of a data set as :func:`read` gives it; it can be sent to another process."""

    read: Callable[..., RunLog]  #: reader of the layout
    #: repair, align: as :func:`load_runs`
    repair: bool
    align: bool
    robot: Robot | None  #: description of the robot that is named; None where none is

    def __call__(self) -> RunLog:
        """Return the run; errors as :func:`load_runs`."""
        run = self.read(repair=self.repair)
        wheels = run.streams.get("wheels")
        by_motor = wheels is not None and any(channel.startswith("motor_") for channel in wheels.channels)
        if by_motor or self.align:
            from terrain.robots import robot_named
        if by_motor:
            from terrain.kinematics.logged_wheels import with_wheel_speeds

            run = with_wheel_speeds(run, robot_named(run.robot, self.robot))
        if self.align:
            from terrain.logs.clock import align, estimate_clock

            run = align(run, estimate_clock(run, track_m=robot_named(run.robot, self.robot).track_m))
        return run

    @property
    def run_folder(self) -> Path | None:
        """The run folder that is read; None of other layouts."""
        first = getattr(self.read, "args", (None,))[0]
        return first if isinstance(first, Path) and (first / "run.json").is_file() else None

    @property
    def plain_folder(self) -> Path | None:
        """The run folder that is given as it is stored; None of other layouts and of what is changed."""
        return None if self.repair or self.align else self.run_folder


def load_runs(folder: str | Path, *, robot: str | Path | None = None, **reading: Any) -> Runs:
    """Return the runs that lie under a folder, sorted by their id; a warning is logged for each that is skipped.

    Every run passes the gate that those of all commands pass (:mod:`terrain.logs.plausibility`): one whose units, signs
    or axes cannot be right is refused, what is doubtful is a :class:`~terrain.errors.DoubtfulRunWarning`.

    Parameters
    ----------
    folder : a run folder, a folder of run folders, a folder in the BorealTC or the DRIVE layout (a session,
        or folders of sessions), or the folder that the files of ``mapping`` or bags are found under; or an
        MCAP file
    robot : the robot of logs that do not name theirs, by name or its YAML file; of those of DRIVE
        :data:`DRIVE_ROBOT` by default
    layout : one of :data:`~pipelines.data.settings.Layout`; ``auto`` looks, as by default
    mapping : YAML file that describes how to read CSV files (``terrain.logs.mapping``); of logs of a CAN bus
        their DBC, by default AgriMaRo's; of bags their topics (``terrain.logs.mapping``)
    repair : drop and count what a strict read refuses, take implausible runs as they are and count what is
        implausible, and skip runs that cannot be read at all
    align : bring the wheel stream onto the clock of the IMU where the two clocks can be compared

    Raises
    ------
    LogError, ConfigError, DataError
        as :func:`read`.
    """
    from pipelines.data.runs import Runs

    name = None if robot is None else str(robot)
    found = read(AlignedRunsSettings(data=Path(folder), robot=name, **reading))
    for sentence in found.skipped:
        _log.warning(sentence)
    warn_of(found.doubts)
    return Runs(found.runs)


def warn_of(doubts: Sequence[Doubt]) -> None:
    """Warn of doubts about runs, as a function of the package that is called from outside."""
    for sentence in doubt_sentences(doubts):
        warnings.warn(sentence, DoubtfulRunWarning, stacklevel=3)


class ReadRuns(NamedTuple):
    """Runs of a data set that passed the gate."""

    runs: list[RunLog]  #: sorted by their id
    skipped: list[str]  #: a sentence for each that a repairing read skipped
    doubts: tuple[Doubt, ...]  #: what is doubtful or implausible about the others
    verdicts: Mapping[str, tuple[Check, ...]]  #: every check of each run, by its id


def load(settings: RunsSettings, *, refuse: bool = True) -> tuple[list[RunLog], list[str], list[str]]:
    """Return the runs of :func:`read`, and sentences: on runs that were skipped, and on what is doubtful."""
    found = read(settings, refuse=refuse)
    return found.runs, found.skipped, [*doubt_sentences(found.doubts)]


def read(settings: RunsSettings, *, refuse: bool = True) -> ReadRuns:
    """Return the runs of the settings, with what is doubtful about them.

    Parameters
    ----------
    settings : with ``repair``, implausible runs are taken as they are, and count which checks they do not pass
    refuse : implausible runs; where a command only states them they are taken and not counted

    Raises
    ------
    LogError
        if nothing readable is there, a run cannot be read or is implausible, two runs have one id, layouts are
        mixed, or a terrain has two spellings.
    ConfigError
        if the mapping is not accepted, or a robot is unknown (to align, or to turn motor rates into wheel
        speeds).
    DataError
        if a run that is to be aligned has no gyro or no wheel speeds.
    """
    from terrain.files.names import packaged, shown
    from terrain.logs.samples import one_spelling

    folder, repair, robot = settings.data, settings.repair, named_robot(settings)
    runs: list[RunLog] = []
    skipped: list[str] = []
    places: dict[str, list[str]] = {}
    for loader in run_loaders(settings):
        try:
            run = loader()
        except LogError as error:
            if not repair:
                raise
            skipped.append(f"run skipped: {error}")
            continue
        if robot is not None and run.robot not in (robot.name, *packaged("robots")):
            named = f"run {run.run_id} is of robot {shown(run.robot)}, --robot describes {robot.name!r}"
            raise LogError(f"{folder}: {named}: name both alike, or give the other's file")
        runs.append(run)
        places.setdefault(run.run_id, []).append(str(loader.run_folder or run.source))
    if not runs:
        first = skipped[0].removeprefix("run skipped: ")
        raise LogError(f"{folder}: not one run could be read, the first for this: {first}")
    for run_id, found in places.items():
        if len(found) > 1:
            raise LogError(f"{folder}: {len(found)} runs have the id {run_id!r} ({' and '.join(found)})")
    runs = sorted(one_spelling(str(folder), runs, repair=repair), key=attrgetter("run_id"))
    if isinstance(settings, AlignedRunsSettings):
        runs = chosen_runs(runs, settings)
    verdicts = verdicts_of(runs, robot)
    doubts = doubts_of(verdicts)
    if repair:
        runs = [counted(run, verdicts[run.run_id]) for run in runs]
    elif refuse:
        refuse_implausible_runs(doubts, {run.run_id: run.dropped for run in runs})
    return ReadRuns(runs, skipped, doubts, verdicts)


def named_robot(settings: RunsSettings) -> Robot | None:
    """Return the robot that the settings name."""
    if settings.robot is None:
        return None
    from terrain.robots import load_robot

    return load_robot(settings.robot)


def run_loaders(settings: RunsSettings) -> list[RunLoader]:
    """Return what reads each run of the settings, without reading any.

    Raises
    ------
    LogError, ConfigError
        as :func:`read`, where no run is found or a setting is not accepted.
    """
    robot = named_robot(settings)
    readers = _readers(settings.data, settings.layout, settings.mapping, robot)
    if not readers:
        raise LogError(f"{settings.data}: holds no run; {ACCEPTED}")
    align = isinstance(settings, AlignedRunsSettings) and settings.align
    return [RunLoader(read, settings.repair, align, robot) for read in readers]


def verdicts_of(runs: Sequence[RunLog], robot: Robot | None = None) -> dict[str, tuple[Check, ...]]:
    """Return the checks of each run by its id, with those of short runs of one robot taken together.

    Parameters
    ----------
    runs, robot : as :func:`verdict` takes one
    """
    verdicts: dict[str, tuple[Check, ...]] = {}
    alike: defaultdict[Any, list[tuple[RunLog, Described]]] = defaultdict(list)
    for run in runs:
        known, described = _described(run, robot)
        verdicts[run.run_id] = judge(known, described)
        if is_short(known):
            sensors = frozenset((name, stream.channels) for name, stream in known.streams.items())
            alike[run.robot, sensors].append((known, described))
    for group in alike.values():
        odd = judge_together(some_of(group))
        for run, _ in group if odd else ():
            verdicts[run.run_id] += odd
    return verdicts


def some_of(runs: Sequence[T]) -> Sequence[T]:
    """Return at most :data:`MOST_TOGETHER` runs, spread over all."""
    return runs[:: 1 + len(runs) // MOST_TOGETHER]


def verdict_together(runs: Sequence[RunLog], robot: Robot | None = None) -> tuple[Check, ...]:
    """Return what is odd about short runs of one robot with the same sensors, taken together."""
    return judge_together([_described(run, robot) for run in runs])


def verdict(run: RunLog, robot: Robot | None = None) -> tuple[Check, ...]:
    """Return the checks of a run, with what is known of its robot.

    Parameters
    ----------
    run : as a reader returns it
    robot : that the user named; where the run names another, that of the package
    """
    return judge(*_described(run, robot))


def _described(run: RunLog, robot: Robot | None) -> tuple[RunLog, Described]:
    """Return a run with the speeds of its wheels where rates of motors are logged, and what is known of its robot."""
    from terrain.kinematics.logged_wheels import with_wheel_speeds
    from terrain.robots import robot_named

    try:
        known = robot_named(run.robot, robot)
        run = with_wheel_speeds(run, known)
    except ConfigError:
        return run, Described()
    fastest_mps = getattr(known, "speed_max_mps", _wheel_rate_max_radps(known) * known.wheel_radius_m)
    motors = known.motors if known.describes("motors") else None
    twist, contradiction = _motion_of_wheels(run, known)
    logged = run.streams["wheels"].channels if "wheels" in run.streams else known.rate_channels
    return run, Described(
        lacking=tuple(channel for channel in known.rate_channels if channel not in logged),
        track_m=known.track_m,
        speed_max_mps=fastest_mps,
        twist=twist,
        contradiction=contradiction,
        sideways=known.sideways,
        length_m=max(known.track_m, known.wheelbase_m),
        front_driven=getattr(known, "front_driven", False),
        wheel_radius_m=known.wheel_radius_m,
        reduction_ratio=math.nan if motors is None else motors.reduction_ratio,
        steering_rate_max_radps=known.steering_rate_max_radps,
        current_max_a=math.inf if motors is None else motors.torque_max_nm / motors.nm_per_a,
    )


def _motion_of_wheels(run: RunLog, robot: Robot) -> tuple[Stream | None, tuple[float, float]]:
    """Return the body's twist by the wheels of a run as if they rolled, and how they contradict each other.

    The twist is None where some wheels are not logged.  The part of the speeds that no twist explains is that with
    steering angles as logged and with turned ones, NaN of what is not steered at each wheel.
    """
    import numpy as np

    from terrain.kinematics.wheels import no_slip_twist, rolled_twist
    from terrain.logs.schema import TWIST
    from terrain.records import Stream

    try:
        wheels = run.streams["wheels"]
        speeds = wheels.columns(f"speed_{wheel}_mps" for wheel in robot.logged_wheels)
        angles = np.zeros((len(wheels), len(robot.wheels)))
        if robot.steered:
            steering = run.streams["steering"]
            for i, channel in enumerate(robot.steer_channels):
                angles[:, i] = np.interp(wheels.time_s, steering.time_s, steering.channel(channel))
            angles -= robot.steering_zeros_rad
        twist = Stream(wheels.time_s, rolled_twist(robot, speeds, angles), TWIST)
        parts = [math.nan, math.nan]
        if robot.steered and robot.sideways:
            power = float(np.nansum(speeds**2)) or math.nan
            for i, sign in enumerate((1.0, -1.0)):
                _, rest = no_slip_twist(robot.wheel_positions_m, sign * angles, speeds)
                parts[i] = math.sqrt(float(np.nansum(rest**2)) / power)
        return twist, (parts[0], parts[1])
    except (KeyError, TerrainError):
        return None, (math.nan, math.nan)


def _wheel_rate_max_radps(robot: Robot) -> float:
    return robot.motors.speed_max_radps if robot.describes("motors") else math.inf


def _readers(folder: Path, layout: str, mapping: str | Path | None, robot: Robot | None) -> Readers:
    """Return the readers of a layout, which ``auto`` finds; none where there is no run."""
    if not folder.exists():
        raise LogError(f"{folder}: does not exist; {ACCEPTED}")
    if layout == "bag" or (layout == "auto" and folder.is_file()):
        from pipelines.data import bag_runs

        bags = bag_runs.find_runs(folder, mapping, robot)
        if bags or layout == "bag":
            return bags
    if not folder.is_dir():
        raise LogError(f"{folder}: is no folder; {ACCEPTED}")
    if layout == "can":
        from pipelines.data import can_frames

        name = CAN_ROBOT if robot is None else robot.name
        return can_frames.find_runs(folder, can_frames.load_layout(mapping, complete=False), name)
    if mapping is not None and layout not in ("auto", "csv"):
        raise ConfigError(f"a mapping file is for CSV files, not for the layout {layout!r}")
    if mapping is not None:  # a stream may lie in a bag
        from pipelines.data import bag_runs
        from terrain.logs.mapping import find_runs, load_mapping

        read = load_mapping(mapping)
        radius_m = bag_runs.wheel_radius_m(read.robot, robot)
        return find_runs(folder, read, partial(bag_runs.read_stream, radius_m=radius_m))
    if layout == "csv":
        raise ConfigError("the layout 'csv' needs a mapping file")
    found: dict[str, Any] = {}
    files, by_camera = folder.resolve(), False
    for name, (finder, patterns) in FOUND_BY.items():
        asked = layout == name
        if layout == "auto":
            asked = any(chain.from_iterable(map(files.glob, patterns)))
            by_camera |= asked and name == "robotino"
            # files of Robotino have the ending of recordings, below the file of a camera
            asked = asked and not (by_camera and name == "drive-recording")
        if asked and (readers := resolve_name(finder)(folder)):
            found[name] = readers
    if len(found) > 1:
        raise LogError(f"{folder}: mixes the layouts {' and '.join(found)}; choose one with --format")
    if not found and layout == "auto":
        from pipelines.data import bag_runs

        return bag_runs.find_runs(folder, None, robot)
    if "drive" in found:
        from terrain.logs import drive

        return drive.find_runs(folder, drive_robot(robot))
    if "drive-recording" in found:
        from terrain.logs import drive
        from terrain.robots import robot_named

        return drive.find_recorded_runs(folder, lambda name: drive_robot(robot_named(name, robot)))
    return next(iter(found.values()), [])


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
    return DriveRobot(robot.name, robot.wheel_radius_m, _wheel_rate_max_radps(robot))
