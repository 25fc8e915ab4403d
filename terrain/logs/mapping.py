"""Where the channels of runs are, as a small YAML file describes it, and the reader of tables (CSV, .mat, .xlsx) by it.

One description serves all logs (``docs/mapping.md``, ``docs/bags.md``): a channel is a column of a table or a field of
messages, and ``(scale * number + offset)`` in the unit given, and then SI; the unit must suit the name of the channel
(:data:`~terrain.logs.schema.UNIT_SCALES`).  Messages become streams in :mod:`terrain.logs.topics`.

Of tables a word in braces stands for any text without a slash, and the files of which all such words agree make one
run; every stream has the same words.  Several streams may name one file, and the files of a run may be of different
formats, bags too; ``offset`` brings their times onto one clock.  ``position`` becomes the channels
:data:`POSITION_CHANNELS`.  The files lie under the data folder, and so does what links in it lead to.  The robot is a
name, of the package or of the description that the user gives.  Names are compared in Unicode's normal form C,
whichever form the file system keeps.

The layout in which BorealTC and Vulpi are published is such a description: ``data/layouts/borealtc.yaml``.
"""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat

from terrain.errors import ConfigError, LogError, library
from terrain.files.documents import accepted, read_yaml
from terrain.files.names import (
    check_name,
    data_folder,
    has_control_characters,
    normal_name,
    plain_name,
    shown,
)
from terrain.logs.samples import (
    check_log_file,
    checked_names,
    checked_stream,
    refuse_apart,
    short_name,
    to_si,
    whole_run_label,
)
from terrain.logs.schema import UNIT_SCALES, canonical_unit, check_unit, unit_of
from terrain.logs.tables import TextLayout, read_table, row_number
from terrain.records import Array, RunLog, Stream

MAX_HEADER_ROWS = 1000  #: No instrument writes a longer head

POSITION_CHANNELS = ("position_x_m", "position_y_m", "position_z_m")
"""What latitude, longitude and height become: east, north and up of an origin."""

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

    def si(self, numbers: Array, unit: str) -> Array:
        """Return numbers, which are in a unit once they are scaled, in the SI unit."""
        return to_si(numbers, unit, self.scale, self.offset)


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
        turning = self.field == "velocity" and self.number_unit in ("rad/s", "deg/s", "rpm")
        return desired == "mps" and bool(self.joint) and turning


class Position(Strict):
    """Where latitude and longitude of a receiver are, in ``unit``, and its height in m; the origin is in these."""

    latitude: Word
    longitude: Word
    height: str = ""
    unit: Literal["deg", "rad"] = "deg"
    origin: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)] | None = None


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
    sheet: str = ""
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","
    decimal: Literal[".", ","] = "."
    skip_rows: Annotated[int, Field(ge=0, le=MAX_HEADER_ROWS)] = 0
    header_rows: Annotated[int, Field(ge=1, le=MAX_HEADER_ROWS)] = 1


class Mapping(Strict):
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


class RunFiles(NamedTuple):
    """Files of one run: the text for each word in braces, and of each stream the place of its file as on disk."""

    words: dict[str, str]
    places: dict[str, str]


ReadMessages = Callable[[Path, str, MessageStream, "Counter[str] | None"], Stream]
"""Reads a stream of messages: file, name of the stream, its description, and what counts repairs."""


def load_mapping(path: str | Path) -> Mapping:
    """Return the mapping of tables that a YAML file describes.

    ``ConfigError`` where the file cannot be read, a key is unknown or missing, a unit is unknown or does not suit its
    channel, or the file patterns do not agree on the words in braces.
    """
    path = Path(path)
    mapping = accepted(Mapping, read_yaml(path), path.name, ConfigError)
    check_name(f"{path.name}: robot", mapping.robot, ConfigError)
    words = {name: set(_WORD.findall(stream.file)) for name, stream in mapping.streams.items()}
    first, *_ = words
    for name, stream in mapping.streams.items():
        place, file = f"{path.name}: stream {name}:", stream.file
        if stream.messages is not None:
            if stream.channels or stream.position or stream.time:
                raise ConfigError(f"{place} 'messages' leave out time, channels and position")
            check_messages(place, stream.messages)
        elif stream.time is None:
            raise ConfigError(f"{path.name}: key 'streams.{name}.time' is missing")
        else:
            placed = () if stream.position is None else POSITION_CHANNELS
            if not stream.channels and not placed:
                raise ConfigError(f"{place} has no channels and no position")
            if twice := set(stream.channels).intersection(placed):
                raise ConfigError(f"{place} 'position' gives the channel {min(twice)} too")
            if stream.decimal == stream.delimiter:
                both = f"delimiter and decimal are both {stream.decimal!r}"
                raise ConfigError(f"{place} {both}; numbers with a comma need another delimiter, such as ';'")
            check_unit(f"{place} time", stream.time.unit, "s")
            for channel, column in stream.channels.items():
                check_unit(f"{place} channel {channel}", column.unit, _unit_required(place, channel))
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
    path = Path(path)
    packaged = data_folder("bags") / f"{path}.yaml"
    if not path.exists() and plain_name(str(path)) and packaged.is_file():
        path = packaged
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
        desired, at, field = _unit_required(place, name), f"{place} channel {name}", channel.field
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
            check_unit(at, channel.number_unit, desired)


def _unit_required(place: str, channel: str) -> str:
    try:
        return unit_of(channel)
    except LogError as error:
        raise ConfigError(f"{place} {error}") from error


def find_runs(
    folder: Path, mapping: Mapping, read_messages: ReadMessages | None = None
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
    files = {(each.words["terrain"], each.words["run"]): each for each in run_files(folder, mapping)}
    read = partial(read_run, folder, mapping, by="BorealTC layout", linked_folders=True)
    return [
        partial(read, files[terrain, run])
        for terrain, run in sorted(files)
        if re.fullmatch("[0-9]+", run) and not terrain.startswith(".")
    ]


def run_files(folder: Path, mapping: Mapping) -> list[RunFiles]:
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
                runs.setdefault(repr(sorted(words.items())), RunFiles(words, {})).places[name] = place
    return [run for _, run in sorted(runs.items())]


def read_run(
    folder: Path,
    mapping: Mapping,
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
    words = files.words
    dropped: Counter[str] = Counter()
    streams: dict[str, Stream] = {}
    names = []
    for name, stream in mapping.streams.items():
        path = folder / files.places.get(name, stream.file.format(**words))
        check_log_file(path, path.parent if linked_folders else folder)
        names.append(path.relative_to(folder).as_posix())
        if stream.messages is None:
            streams[name] = _table_stream(path, stream, dropped if repair else None)
        elif read_messages is None:
            raise ConfigError(f"stream {name}: files of messages are not read here")
        else:
            streams[name] = read_messages(path, name, stream.messages, dropped if repair else None)
    run_id = (mapping.run_id or "_".join(f"{{{word}}}" for word in words)).format(**words)
    refuse_apart(run_id, streams)
    terrain = mapping.terrain.format(**words)
    labels = (whole_run_label(streams, terrain),) if terrain else ()
    source = f"{' and '.join(dict.fromkeys(names))}, {by}"
    run = RunLog(run_id, mapping.robot, streams, labels, source, dropped)
    return checked_names(f"run {shown(run_id)}", run)


def _table_stream(path: Path, stream: TableStream, repairs: Counter[str] | None) -> Stream:
    assert stream.time is not None
    position, sources = stream.position, [stream.time, *stream.channels.values()]
    placed = []
    if position is not None:
        placed = [position.latitude, position.longitude, *filter(None, [position.height])]
    layout = TextLayout(stream.delimiter, stream.decimal, stream.skip_rows, stream.header_rows)
    names = [normal_name(name) for name in (*(source.column for source in sources), *placed)]
    table = read_table(path, names, layout=layout, sheet=stream.sheet, repairs=repairs).T
    time_s, *values = (source.si(row, source.unit) for row, source in zip(table, sources, strict=False))
    if position is not None:
        degrees, to_rad = table[len(sources) :], UNIT_SCALES[position.unit][1]
        origin = np.multiply(position.origin, (to_rad, to_rad, 1.0)) if position.origin else ()
        try:
            height_m = degrees[2] if position.height else None
            metres = local_metres(to_rad * degrees[0], to_rad * degrees[1], height_m, origin)
        except LogError as error:
            raise LogError(f"{short_name(path)}: {error}") from error
        values += [*metres.T[: len(degrees)]]
        placed[:2] = placed[1::-1]  # east is of the longitude
    return checked_stream(
        short_name(path),
        time_s,
        np.column_stack(values),
        [*stream.channels, *POSITION_CHANNELS[: len(placed)]],
        row_of=partial(row_number, path, layout=layout),
        columns=[*(source.column for source in sources[1:]), *placed],
        repairs=repairs,
    )


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
    pymap3d = library("pymap3d", "latitude and longitude need the package pymap3d", "logs")
    known = np.isfinite(latitude_rad) & np.isfinite(longitude_rad)
    if not known.any():
        raise LogError("no latitude and longitude are known")
    farthest = np.abs(latitude_rad[known]).max()
    if farthest > np.pi / 2:
        raise LogError(f"latitude reaches {np.degrees(farthest):g} deg, 90 is the most")
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
