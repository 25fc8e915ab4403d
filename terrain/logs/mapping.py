"""Where the channels of runs are, as a small YAML file describes it, and the readers of tables and messages.

One description serves all logs (``docs/mapping.md``, ``docs/bags.md``): a channel is a column of a table or a field of
messages, and ``(scale * number + offset)`` in the unit given, and then SI; the unit must suit the name of the channel
(:data:`~terrain.logs.schema.UNIT_SCALES`).  Messages are an object of ROS or Protobuf, or JSON, whatever decoded them;
a channel may name a topic of its own.  Samples of several topics are joined by ``join``: ``equal`` takes the instants
that all topics have, by their stamps; ``previous`` the instants of the stream's topic, with the last value of the
others by then.  What is wrong with messages is refused at once, or counted where it is repaired (:class:`Faults`).

Of tables a word in braces stands for any text without a slash, and the files of which all such words agree make one
run; every stream has the same words.  Several streams may name one file, whose rows without any value of a stream are
those of other sensors; the files of a run may be of different formats, bags too; ``offset`` brings their times onto one
clock.  Times that begin later than an hour are those of a clock, and are counted from the first of the run.
``position`` becomes the channels
:data:`POSITION_CHANNELS`.  A channel with ``rate`` is the rate of the number there, as of an encoder's
counts or position; a counter begins anew after ``wraps`` of them (:mod:`terrain.logs.counters`).

The files lie under the data folder, and so does what links in it lead to.  The robot is a
name, of the package or of the description that the user gives.  Names are compared in Unicode's normal form C,
whichever form the file system keeps.

The layout in which BorealTC and Vulpi are published is such a description: ``data/layouts/borealtc.yaml``.
"""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat

from terrain.errors import ConfigError, LogError
from terrain.files.documents import accepted, read_yaml
from terrain.files.names import (
    check_name,
    data_folder,
    has_control_characters,
    listed,
    normal_name,
    plain_name,
    shown,
)
from terrain.logs.counters import count_rates, unwrapped_counts
from terrain.logs.run_folders import label_intervals
from terrain.logs.samples import (
    check_log_file,
    checked_names,
    checked_stream,
    longest_rise,
    refuse_apart,
    refuse_or_count,
    short_name,
    whole_run_label,
)
from terrain.logs.schema import UNIT_OFFSETS, UNIT_SCALES, canonical_unit, check_unit, unit_of
from terrain.logs.tables import MAX_VALUES, TextLayout, read_table, row_number
from terrain.records import Array, Label, RunLog, Stream

MAX_HEADER_ROWS = 1000  #: No instrument writes a longer head
LATEST_START_S = (
    3600.0  #: No log counted from its own start begins later; a clock's does (1970, GPS week, boot)
)

POSITION_CHANNELS = ("position_x_m", "position_y_m", "position_z_m")
"""What latitude, longitude and height become: east, north and up of an origin."""
GROUND_CHANNELS = ("velocity_x_mps", "velocity_y_mps")
"""What speed and course over ground become: east and north."""
QUALITY_CHANNELS = ("fix_ratio", "std_position_m")
"""What the quality of a fix becomes."""

STD_OF_QUALITY_M: Mapping[int, float] = {1: 3.0, 2: 1.0, 3: 1.0, 4: 0.02, 5: 0.5}
"""Standard deviation of a position at an HDOP of 1, by the code of NMEA 0183's GGA: single, differential, PPS, RTK
with fixed and with float ambiguities.  Other codes (none, dead reckoning, typed in, simulated) are no fix.  Makers
state 1 to 3 m of single, about 1 m of differential positions, 1 to 2 cm of RTK and decimetres of its float solution."""
RTK_FIXED = 4

JOINT_UNITS = {"velocity": "rad/s", "position": "rad", "effort": "Nm"}  #: Of ROS, by field of a joint
_WORD = re.compile(r"\{([^\W\d]\w*)\}")
_PATH = re.compile(r"[A-Za-z]\w*(\[\d+\])?(\.[A-Za-z]\w*(\[\d+\])?)*")

Unit = Annotated[
    str, BeforeValidator(lambda unit: canonical_unit(unit) if isinstance(unit, str) else repr(unit))
]
Word = Annotated[str, Field(min_length=1)]


class Strict(BaseModel):
    """Part of a mapping: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Source(Strict):
    """Where a number is: ``(scale * number + offset)`` is in ``unit``."""

    unit: Unit = ""
    scale: FiniteFloat = 1.0
    offset: FiniteFloat = 0.0
    rate: bool = False
    wraps: Annotated[FiniteFloat, Field(gt=0.0)] | None = None

    def si(self, numbers: Array, unit: str) -> Array:
        """Return numbers, which are in a unit once they are scaled, in the SI unit; what overflows is not finite."""
        numbers = numbers if self.wraps is None else unwrapped_counts(numbers, self.wraps)
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = (numbers * self.scale + self.offset) * UNIT_SCALES[unit][1]
            return np.asarray(scaled + UNIT_OFFSETS.get(unit, 0.0))


class Column(Source):
    """A column of a table."""

    column: Word
    unit: Unit


class MessageField(Source):
    """A field of messages, or of a joint in them; ``source`` is that of unit, scale and offset."""

    field: Word
    joint: str = ""
    topic: str = ""
    source: str = ""

    @property
    def number_unit(self) -> str:
        """Unit as stated, else that of ROS for a joint."""
        return self.unit or (JOINT_UNITS.get(self.field, "") if self.joint else "")

    def turns(self, desired: str) -> bool:
        """Return whether it is a speed whose joint turns: its rate is multiplied by the wheel's radius."""
        units = ("rad", "deg", "mrad") if self.rate else ("rad/s", "deg/s", "rpm")
        turning = self.field == ("position" if self.rate else "velocity") and self.number_unit in units
        return desired == "mps" and bool(self.joint) and turning


class Position(Strict):
    """Where latitude and longitude of a receiver are, in ``unit``, and its height in m; the origin is in these.

    ``quality`` is the code of NMEA's GGA, which becomes ``fix_ratio`` and, times ``hdop``, ``std_position_m``.
    """

    latitude: Word
    longitude: Word
    height: str = ""
    quality: str = ""
    hdop: str = ""
    unit: Literal["deg", "rad"] = "deg"
    origin: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)] | None = None


class Ground(Strict):
    """Where speed and course over ground of a receiver are; the course is from north, clockwise."""

    speed: Column
    course: Column


class WheelRadius(Strict):
    """Radius by which rates of wheels become speeds."""

    value: Annotated[FiniteFloat, Field(gt=0.0)]
    unit: Literal["m", "mm"]
    source: Word


class MessageStream(Strict):
    """Where a stream of messages is."""

    topic: Word
    kind: Literal["fields", "gnss", "imu", "joints", "odometry", "pose", "twist"] = "fields"
    channels: Annotated[dict[str, MessageField], Field(default_factory=dict)]
    time: Literal["header", "log", ""] = ""
    join: Literal["equal", "previous"] = "equal"
    wheel_radius: WheelRadius | None = None


class TableStream(Strict):
    """Where a stream of a table is, or the messages of a file."""

    file: Word
    time: Column | None = None
    messages: MessageStream | None = None
    channels: Annotated[dict[str, Column], Field(default_factory=dict)]
    position: Position | None = None
    ground: Ground | None = None
    sheet: str = ""
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","
    decimal: Literal[".", ","] = "."
    skip_rows: Annotated[int, Field(ge=0, le=MAX_HEADER_ROWS)] = 0
    header_rows: Annotated[int, Field(ge=1, le=MAX_HEADER_ROWS)] = 1


class TableMapping(Strict):
    """How tables become run logs."""

    robot: Word
    streams: Annotated[dict[Word, TableStream], Field(min_length=1)]
    run_id: Word = ""
    terrain: str = ""


class TopicMapping(Strict):
    """How topics become streams."""

    streams: Annotated[dict[Word, MessageStream], Field(min_length=1)]
    robot: str = ""
    time: Literal["header", "log"] = "header"
    terrain: str = ""
    labels: str = ""


RunFiles = tuple[dict[str, str], dict[str, str]]
"""Files of one run: the text for each word in braces, and of each stream the place of its file as on disk."""

ReadMessages = Callable[[Path, str, MessageStream, "Counter[str] | None"], Stream]
"""Reads a stream of messages: file, name of the stream, its description, and what counts repairs."""


def load_mapping(path: str | Path) -> TableMapping:
    """Return the mapping of tables that a YAML file, or a packaged one of that name, describes.

    ``ConfigError`` where the file cannot be read, a key is unknown or missing, a unit is unknown or does not suit its
    channel, or the file patterns do not agree on the words in braces.
    """
    path = _packaged(path, "layouts")
    mapping = accepted(TableMapping, read_yaml(path), path.name, ConfigError)
    check_name(f"{path.name}: robot", mapping.robot, ConfigError)
    words = {name: set(_WORD.findall(stream.file)) for name, stream in mapping.streams.items()}
    first, *_ = words
    for name, stream in mapping.streams.items():
        place, file = f"{path.name}: stream {name}:", stream.file
        if stream.messages is not None:
            if stream.channels or stream.position or stream.ground or stream.time:
                raise ConfigError(f"{place} 'messages' leave out time, channels and position")
            check_messages(place, stream.messages)
        elif stream.time is None:
            raise ConfigError(f"{path.name}: key 'streams.{name}.time' is missing")
        else:
            placed, position = tuple[str, ...](), stream.position
            if position is not None:
                placed = (*POSITION_CHANNELS, *QUALITY_CHANNELS[: bool(position.quality)])
                if position.hdop and not position.quality:
                    raise ConfigError(f"{place} 'hdop' is for positions with 'quality', which scales it")
            if stream.ground is not None:
                placed += GROUND_CHANNELS
                check_unit(f"{place} ground: speed", stream.ground.speed.unit, "mps")
                check_unit(f"{place} ground: course", stream.ground.course.unit, "rad")
            if not stream.channels and not placed:
                raise ConfigError(f"{place} has no channels and no position")
            if twice := set(stream.channels).intersection(placed):
                by = "ground" if min(twice) in GROUND_CHANNELS else "position"
                raise ConfigError(f"{place} {by!r} gives the channel {min(twice)} too")
            if stream.decimal == stream.delimiter:
                both = f"delimiter and decimal are both {stream.decimal!r}"
                raise ConfigError(f"{place} {both}; numbers with a comma need another delimiter, such as ';'")
            check_unit(f"{place} time", stream.time.unit, "s")
            for channel, column in stream.channels.items():
                check_unit(f"{place} channel {channel}", column.unit, _unit_required(place, channel, column))
        if words[name] != words[first]:
            raise ConfigError(f"{path.name}: streams {first} and {name} do not have the same words in braces")
        if re.search(r"[{}]", _WORD.sub("", file)):
            raise ConfigError(f"{place} file {file!r} has a brace without its partner")
        if has_control_characters(file) or not Path(file).name:
            raise ConfigError(f"{place} file {shown(file)} names no file")
        if Path(file).is_absolute() or ".." in Path(file).parts:
            raise ConfigError(f"{place} file {file!r} must lie under the data folder")
    if not words[first] and not mapping.run_id:
        raise ConfigError(f"{path.name}: key 'run_id' is missing (the file patterns have no words in braces)")
    for key, rule in (("run_id", mapping.run_id), ("terrain", mapping.terrain)):
        if set(_WORD.findall(rule)) - words[first] or re.search(r"[{}]", _WORD.sub("", rule)):
            known = ", ".join(f"{{{word}}}" for word in sorted(words[first])) or "none"
            fault = f"uses a word that the files lack (they have {known})"
            raise ConfigError(f"{path.name}: {key} {rule!r} {fault}")
    return mapping


def _packaged(path: str | Path, folder: str) -> Path:
    """Return the file of a mapping: the path itself, or the packaged one of that name."""
    path = Path(path)
    packaged = data_folder(folder) / f"{path}.yaml"
    return packaged if not path.exists() and plain_name(str(path)) and packaged.is_file() else path


def load_topics(path: str | Path) -> TopicMapping:
    """Return the mapping of topics that a YAML file, or a packaged one of that name, describes.

    Raises
    ------
    ConfigError
        if the file cannot be read, a key is unknown or missing, or a unit is unknown or does not suit its
        channel.

    Examples
    --------
    >>> load_topics("husky_topics").streams["wheels"].topic
    '/joint_states'
    """
    path = _packaged(path, "bags")
    mapping = accepted(TopicMapping, read_yaml(path), path.name, ConfigError)
    for key in ("robot", "terrain"):
        if getattr(mapping, key):
            check_name(f"{path.name}: {key}", getattr(mapping, key), ConfigError)
    if mapping.terrain and mapping.labels:
        raise ConfigError(f"{path.name}: has both 'terrain' and 'labels', one of them is accepted")
    for name, stream in mapping.streams.items():
        check_name(f"{path.name}: stream", name, ConfigError)
        check_messages(f"{path.name}: stream {name}:", stream)
    return mapping


def check_messages(place: str, stream: MessageStream) -> None:
    """Refuse a stream of messages that contradicts itself; ``ConfigError``."""
    joints = stream.kind == "joints"
    if (joints or stream.kind == "fields") != bool(stream.channels):
        own = f"is of kind {stream.kind!r}, which has channels of its own"
        raise ConfigError(f"{place} {own if stream.channels else 'has no channels'}")
    if stream.wheel_radius is not None and not joints:
        raise ConfigError(f"{place} 'wheel_radius' is for kind 'joints'")
    for name, channel in stream.channels.items():
        at, field = f"{place} channel {name}", channel.field
        number = _unit_required(place, name, channel)
        desired = unit_of(name)
        if joints and field not in JOINT_UNITS:
            raise ConfigError(f"{at}: field {field!r} is none of {', '.join(JOINT_UNITS)}")
        if joints and not channel.joint:
            raise ConfigError(f"{at}: key 'joint' is missing")
        if joints and channel.topic:
            raise ConfigError(f"{at}: 'topic' is for streams without a kind")
        if channel.joint and not joints:
            raise ConfigError(f"{at}: 'joint' is for kind 'joints'")
        if not _PATH.fullmatch(field):
            raise ConfigError(f"{at}: field {field!r} is no path, as 'twist.linear.x' or 'data[2]' is one")
        if (joints or desired != "code") and not channel.turns(desired):
            check_unit(at, channel.number_unit, number)


#: Unit of what a rate is the rate of.
_UNIT_OF_RATE = {"mps": "m", "radps": "rad", "mps2": "mps"}


def _unit_required(place: str, channel: str, source: Source) -> str:
    try:
        unit = unit_of(channel)
    except LogError as error:
        raise ConfigError(f"{place} {error}") from error
    if not source.rate:
        return unit
    if unit not in _UNIT_OF_RATE:
        raise ConfigError(f"{place} channel {channel}: 'rate' is for channels in m/s, rad/s or m/s^2")
    return _UNIT_OF_RATE[unit]


def find_runs(
    folder: Path, mapping: TableMapping, read_messages: ReadMessages | None = None
) -> list[Callable[..., RunLog]]:
    """Return one reader per run that the mapping finds under ``folder``; call it with ``repair=``.

    ``LogError`` where no file fits; ``read_messages`` reads streams whose files are bags.
    """
    runs = run_files(folder, mapping)
    if not runs:
        patterns = ", ".join(stream.file for stream in mapping.streams.values())
        raise LogError(f"{folder}: no file there fits the mapping ({patterns})")
    return [partial(read_run, folder, mapping, run, read_messages=read_messages) for run in runs]


def find_borealtc(folder: Path) -> list[Callable[..., RunLog]]:
    """Return one reader per run in the layout of BorealTC and Vulpi; none where the folder does not have it.

    A run of which one file is missing has a reader too: it raises ``LogError`` with the name of that file.
    """
    mapping = load_mapping(data_folder("layouts") / "borealtc.yaml")
    files = {(each[0]["terrain"], each[0]["run"]): each for each in run_files(folder, mapping)}
    read = partial(read_run, folder, mapping, by="BorealTC layout", linked_folders=True)
    return [
        partial(read, files[terrain, run])
        for terrain, run in sorted(files)
        if re.fullmatch("[0-9]+", run) and not terrain.startswith(".")
    ]


def run_files(folder: Path, mapping: TableMapping) -> list[RunFiles]:
    """Return the files of each run that a mapping finds under a folder, in any of Unicode's forms; none fits none."""
    runs: dict[str, RunFiles] = {}
    for name, stream in mapping.streams.items():
        glob_text, pattern, seen = "", "", set[str]()
        for part in re.split(r"(\{[^\W\d]\w*\})", normal_name(stream.file)):
            if (word := _WORD.fullmatch(part)) is None:
                glob_text += re.sub(r"[^\x00-\x7f]+", "*", glob.escape(part))
                pattern += re.escape(part)
            else:
                glob_text += "*"
                pattern += f"(?P={word[1]})" if word[1] in seen else f"(?P<{word[1]}>[^/]+)"
                seen.add(word[1])
        for path in folder.glob(glob_text):
            place = path.relative_to(folder).as_posix()
            if match := re.fullmatch(pattern, normal_name(place)):
                words = match.groupdict()
                runs.setdefault(repr(sorted(words.items())), (words, {}))[1][name] = place
    return [run for _, run in sorted(runs.items())]


def read_run(
    folder: Path,
    mapping: TableMapping,
    files: RunFiles,
    *,
    repair: bool = False,
    read_messages: ReadMessages | None = None,
    by: str = "by a mapping",
    linked_folders: bool = False,
) -> RunLog:
    """Return the run of some files in a folder, which states ``by`` of how it was read.

    The folder of a file may be a link that leads elsewhere if that is accepted.  ``LogError`` where a file is missing,
    empty or broken, or the streams do not overlap in time; ``ConfigError`` where a package is missing, or nothing
    reads messages here.
    """
    words, places = files
    dropped: Counter[str] = Counter()
    repairs = dropped if repair else None
    streams: dict[str, Stream] = {}
    names = []
    shared = Counter(stream.file for stream in mapping.streams.values())
    for name, stream in mapping.streams.items():
        path = folder / places.get(name, stream.file.format(**words))
        check_log_file(path, path.parent if linked_folders else folder)
        names.append(path.relative_to(folder).as_posix())
        if stream.messages is not None:
            if read_messages is None:
                raise ConfigError(f"stream {name}: files of messages are not read here")
            streams[name] = read_messages(path, name, stream.messages, repairs)
            continue
        assert stream.time is not None
        sources = [stream.time, *stream.channels.values()]
        position, ground = stream.position, stream.ground
        if ground is not None:
            sources += [ground.speed, ground.course]
        placed = []
        if position is not None:
            given = position.height, position.quality, position.hdop
            placed = [position.latitude, position.longitude, *filter(None, given)]
        layout = TextLayout(stream.delimiter, stream.decimal, stream.skip_rows, stream.header_rows)
        columns = [normal_name(each) for each in (*(source.column for source in sources), *placed)]
        table = read_table(path, columns, layout=layout, sheet=stream.sheet, repairs=repairs).T
        own_rows = np.arange(table.shape[1])
        if shared[stream.file] > 1 and np.isfinite(table[1:]).any():
            own_rows = np.flatnonzero(np.isfinite(table[1:]).any(axis=0))
            table = table[:, own_rows]
        time_s, *values = (source.si(row, source.unit) for row, source in zip(table, sources, strict=False))
        values = [
            count_rates(time_s, value) if source.rate else value
            for value, source in zip(values, sources[1:], strict=True)
        ]
        channels, of = [*stream.channels], [source.column for source in sources[1:]]
        if ground is not None:
            speed_mps, course_rad = values[-2:]
            values[-2:] = [speed_mps * np.sin(course_rad), speed_mps * np.cos(course_rad)]
            channels += GROUND_CHANNELS
        if position is not None:
            try:
                found = _positions(position, dict(zip(placed, table[len(sources) :], strict=True)))
            except LogError as error:
                raise LogError(f"{short_name(path)}: {error}") from error
            own = {name: each for name, each in found.items() if name not in stream.channels}
            values += [column for column, _ in own.values()]
            of += [name for _, name in own.values()]
            channels += own
        streams[name] = checked_stream(
            short_name(path),
            time_s,
            np.column_stack(values),
            channels,
            row_of=partial(_row_of, path, own_rows, layout),
            columns=of,
            repairs=repairs,
        )
    if (start_s := min(each.time_s[0] for each in streams.values())) > LATEST_START_S:
        streams = {name: replace(each, time_s=each.time_s - start_s) for name, each in streams.items()}
    run_id = (mapping.run_id or "_".join(f"{{{word}}}" for word in words)).format(**words)
    refuse_apart(run_id, streams)
    terrain = mapping.terrain.format(**words)
    labels = (whole_run_label(streams, terrain),) if terrain else ()
    source = f"{' and '.join(dict.fromkeys(names))}, {by}"
    run = RunLog(run_id, mapping.robot, streams, labels, source, dropped)
    return checked_names(f"run {shown(run_id)}", run)


def _row_of(path: Path, rows: Array, layout: TextLayout, index: int) -> int:
    """Return the row of a file in which a sample is, of those that a stream has."""
    return row_number(path, int(rows[index]), layout=layout)


def _positions(position: Position, columns: Mapping[str, Array]) -> dict[str, tuple[Array, str]]:
    """Return the channels of positions, and the column of each; ``LogError`` as :func:`local_metres`."""
    to_rad = UNIT_SCALES[position.unit][1]
    origin = np.multiply(position.origin, (to_rad, to_rad, 1.0)) if position.origin else ()
    latitude_rad, longitude_rad = (to_rad * columns[name] for name in (position.latitude, position.longitude))
    found: dict[str, tuple[Array, str]] = {}
    if position.quality:
        code = columns[position.quality]
        std_m = np.array([STD_OF_QUALITY_M.get(int(each), np.nan) for each in np.nan_to_num(code, nan=-1.0)])
        latitude_rad = np.where(np.isfinite(std_m), latitude_rad, np.nan)
        hdop = columns[position.hdop] if position.hdop else np.ones(len(code))
        fixed = np.where(np.isfinite(std_m), code == RTK_FIXED, np.nan)
        found = {"fix_ratio": (fixed, position.quality), "std_position_m": (std_m * hdop, position.quality)}
    metres = local_metres(latitude_rad, longitude_rad, columns.get(position.height), origin)
    # east is of the longitude
    names = (position.longitude, position.latitude, *filter(None, [position.height]))
    placed = zip(POSITION_CHANNELS, metres.T, names, strict=False)
    return {channel: (column, name) for channel, column, name in placed} | found


def local_metres(
    latitude_rad: Array,
    longitude_rad: Array,
    height_m: Array | None = None,
    origin: Sequence[float] | Array = (),
) -> Array:
    """Return positions (n, 3) in m, east, north and up, by the ellipsoid WGS 84; NaN where one is unknown.

    Latitude, longitude and height (n,) are geodetic; the origin is one of each, the first known position by default,
    and its height that of what is unknown.  ``LogError`` where no position is known, or a latitude is beyond a pole.

    Examples
    --------
    >>> local_metres(np.radians([45.0, 45.001]), np.radians([7.0, 7.0]))[1, 1].round(2)
    np.float64(111.13)
    """
    import pymap3d

    known = np.isfinite(latitude_rad) & np.isfinite(longitude_rad)
    if not known.any():
        raise LogError("no latitude and longitude are known")
    farthest = np.abs(latitude_rad[known]).max()
    if farthest > np.pi / 2:
        raise LogError(
            f"latitude reaches {np.degrees(farthest):g} deg, 90 is the most (NMEA has 48.12 deg as 4807.2)"
        )
    if not len(origin):
        first = int(np.flatnonzero(known)[0])
        base_m = 0.0 if height_m is None or not np.isfinite(height_m[first]) else float(height_m[first])
        origin = (float(latitude_rad[first]), float(longitude_rad[first]), base_m)
    heights_m = np.full(latitude_rad.shape, np.nan) if height_m is None else height_m
    heights_m = np.where(np.isfinite(heights_m), heights_m, origin[2])
    metres = np.column_stack(pymap3d.geodetic2enu(latitude_rad, longitude_rad, heights_m, *origin, deg=False))
    metres[~known] = np.nan
    return metres


def csv_mapping(runs: Sequence[RunLog]) -> str | None:
    """Return the mapping that reads the CSV files of runs; None where they differ in robot or channels.

    Labels are no part of it, and neither are codes, which have no unit.
    """
    first = runs[0]
    if len({(run.robot, frozenset((n, s.channels) for n, s in run.streams.items())) for run in runs}) > 1:
        return None
    unit_name = {word: name for name, (word, factor) in reversed(UNIT_SCALES.items()) if factor == 1.0}
    streams: dict[str, Any] = {}
    for name, stream in first.streams.items():
        units = {channel: unit_name.get(unit_of(channel)) for channel in stream.channels}
        channels = {channel: {"column": channel, "unit": unit} for channel, unit in units.items() if unit}
        if channels:
            time = {"column": "time_s", "unit": "s"}
            streams[name] = {"file": f"{{run}}/{name}.csv", "time": time, "channels": channels}
    document = {"robot": first.robot, "run_id": "{run}", "streams": streams}
    return str(yaml.safe_dump(document, sort_keys=False, allow_unicode=True))


# -- Messages of topics -----------------------------------------------------------------------------------------

EARLY_END = "files that end early"
DAMAGED_BLOCK = "damaged blocks of messages"
DAMAGED_MESSAGE = "damaged messages"
UNMATCHED = "messages without one of equal stamp on the other topics"

STAMPS = (
    ("header.stamp.sec", "header.stamp.nanosec"),
    ("header.stamp.secs", "header.stamp.nsecs"),
    ("timestamp.seconds", "timestamp.nanos"),
    ("timestamp.sec", "timestamp.nsec"),
)
"""Where messages of ROS, and those of Foxglove in Protobuf and JSON, have the time of a measurement."""

TYPES: Mapping[str, tuple[str, ...]] = {
    "gnss": ("sensor_msgs/NavSatFix",),
    "imu": ("sensor_msgs/Imu",),
    "joints": ("sensor_msgs/JointState",),
    "odometry": ("nav_msgs/Odometry",),
    "pose": ("geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped"),
    "twist": ("geometry_msgs/Twist", "geometry_msgs/TwistStamped"),
}
"""Types of the messages of each kind of stream."""

STANDARD_STREAMS: Mapping[str, str] = {"imu": "imu", "odometry": "odometry", "commands": "twist"}
"""Stream of each kind that needs no mapping, where one topic alone is of its types."""

LABELS_TYPE = "std_msgs/String"

DISTRO = "ROS2_HUMBLE"
"""Release whose definitions are written, and taken for a bag that holds none and does not name its own."""

MAX_LABELS = 1_000_000  #: Messages with terrains; ten a second are 28 hours
LATEST_NS = 2**62  #: Latest stamp that a message may have

Number = Callable[[Any], float]
Converted = tuple[tuple[str, ...], Array]  #: Channels, and their values (n, c)


class Topic(NamedTuple):
    """A topic: its type, how its messages are encoded, and the definition that the file holds of it.

    ``definition`` is text; of Protobuf it is its bytes, a character each.
    """

    name: str
    kind: str
    encoding: str
    schema_encoding: str
    definition: str


class MessageKind(NamedTuple):
    """A type of message that becomes channels of its own."""

    paths: tuple[str, ...]  #: of its numbers
    channels: Callable[[Array], Converted]  #: from those (n, k) to channels
    #: from a stream to those (n, k), None where the stream lacks channels; None where none is written
    numbers: Callable[[Stream], Array | None] | None = None
    fixed: Mapping[str, Any] = MappingProxyType({})  #: what else is written, by path


class Faults:
    """Faults of one log: counts by kind in ``repairs``, None of which refuses.

    ``first`` is what a strict read would refuse first; empty without a fault.
    """

    def __init__(self, repairs: Counter[str] | None) -> None:
        self.repairs, self.first = repairs, ""

    def found(self, place: str, kind: str, text: str, n: int = 1) -> None:
        """Raise :class:`LogError`, or count."""
        self.first = self.first or f"{place}: {text}; read it with --repair to leave that out"
        refuse_or_count(self.repairs, kind, self.first, n)


def number_at(topic: str, kind: str, message: Any, path: str, joint: str = "") -> Number:
    """Return what takes a number from each message of a topic, of which ``message`` is one; NaN where one lacks it.

    The path is as ``twist.linear.x`` or ``data[2]``, of a joint that of the array that has its number, at its place in
    the field ``name``.  ``ConfigError`` where the message has no such field, or no number in it.

    Examples
    --------
    >>> speed = number_at("/speeds", "a_msgs/Speeds", {"speeds": [1.5, 2.5]}, "speeds[1]")
    >>> speed({"speeds": [3, 4]}), speed({"speeds": []})
    (4.0, nan)
    """
    place = f"topic {topic}: field {shown(path)}"
    if joint:
        if not {path, "name"} <= set(_fields(message)) or not _is_array(_field(message, path)):
            raise ConfigError(f"{place} is no array of joints")

        def of_joint(message: Any) -> float:
            names, values = list(_field(message, "name")), _field(message, path)
            at = names.index(joint) if joint in names else len(values)
            return float(values[at]) if at < len(values) else np.nan

        return of_joint
    steps: list[str | int] = []

    def along(message: Any) -> float:
        for step in steps:
            if isinstance(step, str):
                message = _field(message, step)
            else:
                message = message[step] if step < len(message) else None
            if message is None:
                return np.nan
        return float(message)

    value, owner = message, kind
    for name, index in re.findall(r"(\w+)(?:\[(\d+)\])?", path):
        fields = _fields(value)
        if name not in fields:
            lacks = f"has no {name!r} (it has {listed(fields)})" if fields else "has no fields of its own"
            raise ConfigError(f"{place}: {owner} {lacks}")
        value, owner = _field(value, name), repr(name)
        if _is_array(value) != bool(index):
            fault = f"give an index, as {name}[0]" if not index else f"leave the index out, as {name}"
            raise ConfigError(f"{place}: {name!r} is {'an' if not index else 'no'} array: {fault}")
        steps += [name, int(index)] if index else [name]
        if index:
            if int(index) >= len(value):  # another message may have more elements
                return along
            value = value[int(index)]
    if value is not None and not isinstance(value, int | float | np.number | np.bool_):
        inner = f" (it has {listed(fields)})" if (fields := _fields(value)) else ""
        raise ConfigError(f"{place} is of type {type(value).__name__}, a number is required{inner}")
    if isinstance(message, dict) or not all(isinstance(step, str) for step in steps):
        return along
    return attrgetter(path)


def _fields(message: Any) -> list[str]:
    """Return the names of the fields of a message; empty of what is none."""
    if isinstance(message, dict):
        return [str(name) for name in message]
    if hasattr(message, "DESCRIPTOR"):
        return [field.name for field in message.DESCRIPTOR.fields]
    return [name for name in getattr(message, "__dataclass_fields__", {}) if not name.startswith("__")]


def _field(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name)


def _is_array(value: Any) -> bool:
    return hasattr(value, "__getitem__") and not isinstance(value, str | bytes | dict) and np.ndim(value) > 0


def short_type(name: str) -> str:
    """Return the name of a type without its middle part: ``sensor_msgs/Imu`` of ``sensor_msgs/msg/Imu``."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) == 3 else name


def standard_mapping(place: str, topics: list[Topic]) -> TopicMapping:
    """Return the mapping of a bag, which messages call ``place``, by the types of its topics.

    Raises
    ------
    ConfigError
        if none has a type of :data:`STANDARD_STREAMS`, or several have one.

    Examples
    --------
    >>> standard_mapping("a.mcap", [Topic("/imu", "sensor_msgs/msg/Imu", "cdr", "", "")]).streams["imu"].topic
    '/imu'
    """
    streams = {}
    for stream, kind in STANDARD_STREAMS.items():
        fitting = [topic.name for topic in topics if short_type(topic.kind) in TYPES[kind]]
        if len(fitting) > 1:
            raise ConfigError(
                f"{place}: the topics {listed(fitting)} are all of type {' or '.join(TYPES[kind])}: "
                "choose one with --mapping"
            )
        if fitting:
            streams[stream] = MessageStream.model_validate({"topic": fitting[0], "kind": kind})
    if not streams:
        raise ConfigError(f"{place}: needs a mapping (--mapping): it has {_described(topics)}")
    return TopicMapping(streams=streams)


def _described(topics: Sequence[Topic]) -> str:
    return listed([f"{topic.name} ({topic.kind})" for topic in sorted(topics)]) if topics else "no topic"


class _Source(NamedTuple):
    """Where the numbers of a stream are: path and joint of each, by topic, and what makes channels of them."""

    stream: MessageStream
    paths: Mapping[str, Sequence[tuple[str, str]]]
    channels: Callable[[Array], Converted]


def mapped_streams(
    place: str,
    mapping: TopicMapping,
    topics: Mapping[str, Topic],
    kinds: Mapping[str, MessageKind],
    decoder: Callable[[Topic], Callable[[bytes], Any]],
    messages: Callable[[frozenset[str]], Iterable[tuple[str, int, bytes]]],
    wheel_radius_m: float | None,
    faults: Faults,
    start_ns: int | None = None,
) -> tuple[dict[str, Stream], tuple[Label, ...]]:
    """Return the streams that the messages of topics become by a mapping, and the intervals of its topic of labels.

    ``topics`` are those that there are, by name; ``kinds`` by type of message those that become channels of their own;
    ``decoder`` returns what makes an object of each message of a topic, ``messages`` yields topic, log time in ns and
    content of each message of some topics.  Time begins at the first stamp unless another is given; when repairing at
    the first of those in order.  ``LogError`` where there is no such topic, one of another type or without a message,
    topics of a stream have no stamp in common, or a stream is broken; ``ConfigError`` where speeds of wheels need the
    radius and none is known.
    """
    sources: dict[str, _Source] = {}
    there, repairs, labels = _described([*topics.values()]), faults.repairs, mapping.labels
    for name, stream in mapping.streams.items():
        at = f"{place}: stream {name}"
        for topic in (stream.topic, *(channel.topic for channel in stream.channels.values())):
            if topic and topic not in topics:
                raise LogError(f"{at}: there is no topic {shown(topic)} (there are {there})")
        kind = topics[stream.topic].kind
        if stream.kind != "fields" and short_type(kind) not in TYPES[stream.kind]:
            required = f"kind {stream.kind!r} is {' or '.join(TYPES[stream.kind])} (there are {there})"
            raise LogError(f"{at}: topic {stream.topic} is of type {kind}, {required}")
        if stream.channels:
            sources[name] = _fields_source(at, stream, wheel_radius_m)
        else:
            of_kind = kinds[short_type(kind)]
            paths = {stream.topic: [(path, "") for path in of_kind.paths]}
            sources[name] = _Source(stream, paths, of_kind.channels)
    if labels and labels not in topics:
        raise LogError(f"{place}: labels: there is no topic {shown(labels)} (there are {there})")
    if labels and short_type(topics[labels].kind) != LABELS_TYPE:
        of_type = f"topic {labels} is of type {topics[labels].kind}"
        raise LogError(f"{place}: labels: {of_type}, {LABELS_TYPE} is required")
    asked = [each for source in sources.values() for each in source.paths.items()]
    of_topic: dict[str, _TopicNumbers] = {}
    for topic, numbers in [*asked, *([(labels, [])] if labels else [])]:
        if topic not in of_topic:
            of_topic[topic] = _TopicNumbers(place, topics[topic], decoder(topics[topic]), faults)
        for path in numbers:
            of_topic[topic].paths.setdefault(path, len(of_topic[topic].paths))
    for topic, log_ns, content in messages(frozenset(of_topic)):
        of_topic[topic].take(log_ns, content)
    raw = {}
    for name, source in sources.items():
        stream = source.stream
        by_header = (stream.time or mapping.time) == "header"
        stamps_ns, parts = list[Array](), list[Array]()
        for topic, places in source.paths.items():
            stamp_ns, found = of_topic[topic].numbers(places, by_header=by_header)
            if not stamp_ns.size:
                what = " with any of the joints" if stream.kind == "joints" else ""
                raise LogError(f"{place}: topic {shown(topic)} has no message{what}")
            order = np.argsort(stamp_ns, kind="stable") if len(source.paths) > 1 else slice(None)
            stamps_ns.append(stamp_ns[order])
            parts.append(found[order])
        common = stamps_ns[0]
        if len(stamps_ns) > 1 and stream.join == "previous":
            for i, each in enumerate(stamps_ns[1:], start=1):
                row = np.searchsorted(each, common, side="right") - 1
                parts[i] = np.where((row >= 0)[:, None], parts[i][np.maximum(row, 0)], np.nan)
        elif len(stamps_ns) > 1:
            for each in stamps_ns[1:]:
                common = np.intersect1d(common, each)
            if n_lost := sum(each.size for each in stamps_ns) - common.size * len(stamps_ns):
                lost = f"{n_lost} messages of {' and '.join(shown(topic) for topic in source.paths)}"
                text = f"{name}: {lost} lack one of equal stamp (join: previous)"
                faults.found(place, UNMATCHED, text, n_lost)
            if not common.size:
                raise LogError(f"{place}: stream {name}: no two stamps of its topics agree (join: previous)")
            pairs = zip(parts, stamps_ns, strict=True)
            parts = [part[np.searchsorted(each, common)] for part, each in pairs]
        channels, joined = source.channels(np.concatenate(parts, axis=1))
        if not channels:
            raise LogError(f"{place}: topic {shown(stream.topic)} states that it measures nothing")
        for i, channel in enumerate(channels):
            if channel in stream.channels and stream.channels[channel].rate:
                joined[:, i] = count_rates((common - common[0]) / 1e9, joined[:, i])
        raw[name] = common, channels, joined
    if start_ns is None:
        stamps = [stamp_ns for stamp_ns, *_ in raw.values()]
        firsts = [each.min() if repairs is None else each[longest_rise(each)[0]] for each in stamps]
        start_ns = min(map(int, firsts))
    streams = {}
    for name, (stamp_ns, channels, values) in raw.items():
        at = f"{place}: stream {name}"
        if stamp_ns.size > 1 and not np.any(stamp_ns):
            raise LogError(f"{at}: all headers are stamped 0; take the log times (time: log)")
        streams[name] = checked_stream(at, (stamp_ns - start_ns) / 1e9, values, channels, repairs=repairs)
    texts = sorted(of_topic[labels].texts, key=lambda each: each[0]) if labels else []
    return streams, label_intervals(texts, start_ns, streams)


def _fields_source(at: str, stream: MessageStream, wheel_radius_m: float | None) -> _Source:
    """Return where the channels of a stream of fields or joints are."""
    if stream.wheel_radius is not None:
        wheel_radius_m = stream.wheel_radius.value * UNIT_SCALES[stream.wheel_radius.unit][1]
    by_topic: dict[str, list[str]] = {stream.topic: []}
    for name, channel in stream.channels.items():
        by_topic.setdefault(channel.topic or stream.topic, []).append(name)
        if channel.turns(unit_of(name)) and wheel_radius_m is None:
            missing = "'wheel_radius' is missing, and the robot has no description"
            raise ConfigError(f"{at}: channel {name} is the speed of a joint that turns: {missing}")
    places = [name for names in by_topic.values() for name in names]

    def in_si(values: Array) -> Converted:
        columns = []
        for name, channel in stream.channels.items():
            desired = unit_of(name)
            unit = "1" if desired == "code" else channel.number_unit
            si = channel.si(values[:, places.index(name)], unit)
            columns.append(si * (wheel_radius_m or np.nan) if channel.turns(desired) else si)
        return tuple(stream.channels), np.column_stack(columns)

    paths = {
        topic: [(stream.channels[name].field, stream.channels[name].joint) for name in names]
        for topic, names in by_topic.items()
        if names
    }
    return _Source(stream, paths, in_si)


class _TopicNumbers:
    """Collects the numbers of the messages of a topic, or their texts where no path is asked for.

    ``paths`` has for each number its path and, where its array has a number a joint, the joint's name; an
    entry of ``rows`` has them in that order.
    """

    def __init__(self, place: str, topic: Topic, decode: Callable[[bytes], Any], faults: Faults) -> None:
        self.topic, self.paths = topic, dict[tuple[str, str], int]()
        self.log_ns, self.stamp_ns = list[int](), list[int]()
        self.rows, self.texts = list[list[float]](), list[tuple[int, str]]()
        self._place, self._decode, self._faults = place, decode, faults
        self._numbers: list[Number] | None = None
        self._stamp: list[Number] = []

    def take(self, log_ns: int, content: bytes) -> None:
        try:
            message = self._decode(content)
        except Exception as error:  # whatever a library makes of damaged bytes
            self._damaged(error)
            return
        if not self.paths:
            self.texts.append((log_ns, str(message.data)))
            self._bounded(len(self.texts), MAX_LABELS, "messages")
            return
        if self._numbers is None:
            about = (self.topic.name, short_type(self.topic.kind), message)
            self._numbers = [number_at(*about, *path) for path in self.paths]
            for pair in STAMPS:  # the first of which the message has
                try:
                    self._stamp = self._stamp or [number_at(*about, path) for path in pair]
                except ConfigError:
                    continue
        try:
            row = [float(number(message)) for number in self._numbers]
            seconds, rest = (get(message) for get in self._stamp) if self._stamp else (0, log_ns)
            stamp_ns = int(seconds) * 10**9 + int(rest)
            if abs(stamp_ns) > LATEST_NS:
                raise ValueError("a stamp is beyond what clocks show")
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            self._damaged(error)
            return
        self.rows.append(row)
        self.stamp_ns.append(stamp_ns)
        self.log_ns.append(log_ns)
        self._bounded(len(self.rows) * len(self.paths), MAX_VALUES, "values")

    def _bounded(self, n: int, most: int, what: str) -> None:
        if n > most:
            raise LogError(f"{self._place}: topic {shown(self.topic.name)} has more than {most} {what}")

    def _damaged(self, error: Exception) -> None:
        text = f"topic {shown(self.topic.name)} has a message that is not as defined ({str(error)[:120]})"
        self._faults.found(self._place, DAMAGED_MESSAGE, text)

    def numbers(self, paths: Sequence[tuple[str, str]], *, by_header: bool) -> tuple[Array, Array]:
        """Return stamps (n,) in ns, and numbers (n, k) of some paths, in the order of log times."""
        order = np.argsort(np.array(self.log_ns, dtype=np.int64), kind="stable")
        stamp_ns = np.array(self.stamp_ns if by_header else self.log_ns, dtype=np.int64)[order]
        values = np.array(self.rows, dtype=np.float64).reshape(len(order), len(self.paths))
        values = values[order][:, [self.paths[path] for path in paths]]
        if any(joint for _, joint in paths):  # a robot may send its joints in several messages
            known = np.isfinite(values).any(axis=1)
            stamp_ns, values = stamp_ns[known], values[known]
        return stamp_ns, values
