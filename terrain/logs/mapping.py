"""Reader of any tables (CSV, .mat, .xlsx), whose layout a small YAML mapping describes.

::

    robot: husky
    run_id: "{terrain}_{run}"        # may be left out: the fields of the file patterns, joined by _
    terrain: "{terrain}"             # or a fixed word; left out: the runs are unlabelled
    streams:
      imu:
        file: "{terrain}/imu {run}.csv"
        time: {column: stamp, unit: ms}
        channels:
          gyro_z_radps: {column: yaw rate, unit: deg/s, scale: -1}
      wheels:
        file: "{terrain}/wheels {run}.csv"
        delimiter: ";"                 # or a tab, or another single character
        decimal: ","                   # numbers as 0,25
        skip_rows: 2                   # lines above the names of the columns
        header_rows: 2                 # lines of the header from the names on, as with units below them
        time: {column: t, unit: s}
        channels:
          speed_left_mps: {column: vl, unit: km/h}
          speed_right_mps: {column: vr, unit: km/h, offset: -0.2}
      gnss:
        file: "{terrain}/gps {run}.xlsx"
        sheet: fixes                   # the first by default
        time: {column: t, unit: s, offset: 12.5}
        position: {latitude: lat, longitude: lon, height: alt, unit: deg}
      odometry:
        file: "{terrain}/drive {run}.bag"
        messages: {topic: /odom, kind: odometry}     # as in a mapping of topics; times are seconds since 1970

A word in braces stands for any text without a slash, and the files of which all such words agree make one
run; every stream has the same words.  Several streams may name one file, and the files of a run may be of
different formats; ``offset`` brings their times onto one clock.  ``position`` becomes the channels
``position_x_m``, ``position_y_m`` and, with a height, ``position_z_m``: east, north and up of the first fix, or
of ``origin: [latitude, longitude, height]``.  The files lie under the data
folder, and so does what links in it lead to.  The robot is a name, of the package or of the description that
the user gives.  A cell becomes ``(scale * cell + offset)`` in the unit given, and then SI; the unit must suit
the name of the channel (:data:`~terrain.logs.schema.UNIT_SCALES`).  Names are compared in Unicode's normal
form C, whichever form the file system keeps.
"""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Callable, Sequence
from collections.abc import Mapping as Map
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat

from terrain.errors import ConfigError, LogError, library
from terrain.files.documents import accepted, read_yaml
from terrain.files.names import check_name, has_control_characters, normal_name, shown
from terrain.logs.labels import whole_run_label
from terrain.logs.samples import check_log_file, checked_names, checked_stream, refuse_apart, short_name
from terrain.logs.schema import UNIT_OFFSETS, UNIT_SCALES, canonical_unit, unit_of
from terrain.logs.tables import TextLayout, read_table, table_row
from terrain.records import Array, RunLog, Stream


def local_metres(
    latitude_rad: Array, longitude_rad: Array, height_m: Array | None = None, origin: Sequence[float] = ()
) -> Array:
    """Return positions (n, 3) in m, east, north and up, by the ellipsoid WGS 84; NaN where one is unknown.

    Parameters
    ----------
    latitude_rad, longitude_rad : (n,) geodetic
    height_m : (n,) above the ellipsoid; that of the origin where it is not known
    origin : its latitude and longitude in rad, and its height in m; the first known position by default

    Raises
    ------
    LogError
        if no position is known, or a latitude is beyond a pole.
    ConfigError
        if pymap3d is not installed.

    Examples
    --------
    >>> local_metres(np.radians([45.0, 45.001]), np.radians([7.0, 7.0]))[1, 1].round(2)
    np.float64(111.13)
    """
    pymap3d = library("pymap3d", "latitude and longitude need the package pymap3d", "logs")
    known = np.isfinite(latitude_rad) & np.isfinite(longitude_rad)
    if not known.any():
        raise LogError("no latitude and longitude are known")
    if np.abs(latitude_rad[known]).max() > np.pi / 2:
        raise LogError(
            f"latitude reaches {np.degrees(np.abs(latitude_rad[known]).max()):g} deg, 90 is the most"
        )
    if not origin:
        first = int(np.flatnonzero(known)[0])
        base_m = 0.0 if height_m is None or not np.isfinite(height_m[first]) else float(height_m[first])
        origin = (float(latitude_rad[first]), float(longitude_rad[first]), base_m)
    heights_m = np.full(latitude_rad.shape, origin[2]) if height_m is None else height_m
    heights_m = np.where(np.isfinite(heights_m), heights_m, origin[2])
    enu_m = pymap3d.geodetic2enu(latitude_rad, longitude_rad, heights_m, *origin, deg=False)
    east_north_up: Array = np.column_stack(enu_m)
    east_north_up[~known] = np.nan
    return east_north_up


MAX_HEADER_ROWS = 1000
"""No instrument writes a longer head."""

POSITION_CHANNELS = ("position_x_m", "position_y_m", "position_z_m")
"""What latitude, longitude and height become: east, north and up."""

_FIELD = re.compile(r"\{([^\W\d]\w*)\}")
_SPLIT_AT_FIELDS = re.compile(r"(\{[^\W\d]\w*\})")

Unit = Annotated[
    str, BeforeValidator(lambda unit: canonical_unit(unit) if isinstance(unit, str) else repr(unit))
]
Word = Annotated[str, Field(min_length=1)]


class Strict(BaseModel):
    """Part of a mapping: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Column(Strict):
    """Where a channel is: ``(scale * cell + offset)`` is in ``unit``."""

    column: Word
    unit: Unit
    scale: FiniteFloat = 1.0
    offset: FiniteFloat = 0.0


class TimeColumn(Strict):
    """Where the time is; ``offset`` is added, in the same unit."""

    column: Word
    unit: Unit
    offset: FiniteFloat = 0.0


class Position(Strict):
    """Where latitude and longitude of a receiver are; ``unit`` is theirs, the height is in m."""

    latitude: Word
    longitude: Word
    height: str = ""
    unit: Literal["deg", "rad"] = "deg"
    origin: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)] | None = None

    @property
    def columns(self) -> list[str]:
        """Names of its columns."""
        return [self.latitude, self.longitude, *([self.height] if self.height else [])]


class StreamMapping(Strict):
    """Where a stream is."""

    file: Word
    time: TimeColumn | None = None
    messages: dict[str, Any] | None = None
    channels: Annotated[dict[str, Column], Field(default_factory=dict)]
    position: Position | None = None
    sheet: str = ""
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","
    decimal: Literal[".", ","] = "."
    skip_rows: Annotated[int, Field(ge=0, le=MAX_HEADER_ROWS)] = 0
    header_rows: Annotated[int, Field(ge=1, le=MAX_HEADER_ROWS)] = 1

    @property
    def layout(self) -> TextLayout:
        """How its files hold their table."""
        return TextLayout(self.delimiter, self.decimal, self.skip_rows, self.header_rows)


class Mapping(Strict):
    """How CSV files become run logs."""

    robot: Word
    streams: Annotated[dict[Word, StreamMapping], Field(min_length=1)]
    run_id: Word = ""
    terrain: str = ""


class Found(NamedTuple):
    """Files of one run.

    Parameters
    ----------
    words : text for each word in braces
    places : file of each stream, under the data folder, as it is spelt on disk
    """

    words: dict[str, str]
    places: dict[str, str]


def load_mapping(
    path: str | Path, check_messages: Callable[[str, Map[str, Any]], object] | None = None
) -> Mapping:
    """Return the mapping that a YAML file describes.

    Parameters
    ----------
    path : of the file
    check_messages : gets the place of a stream of messages, as messages name it, and its description

    Raises
    ------
    ConfigError
        if the file cannot be read, a key is unknown or missing, a unit is unknown or does not suit its
        channel, or the file patterns do not agree on the words in braces.
    """
    path = Path(path)
    mapping = accepted(Mapping, read_yaml(path), path.name, ConfigError)
    check_name(f"{path.name}: robot", mapping.robot, ConfigError)
    for name, stream in mapping.streams.items():
        if stream.messages is not None:
            if stream.channels or stream.position or stream.time:
                raise ConfigError(
                    f"{path.name}: stream {name}: 'messages' leave out time, channels and position"
                )
            if check_messages is not None:
                check_messages(f"{path.name}: stream {name}", stream.messages)
            continue
        if stream.time is None:
            raise ConfigError(f"{path.name}: key 'streams.{name}.time' is missing")
        if not stream.channels and stream.position is None:
            raise ConfigError(f"{path.name}: stream {name}: has no channels and no position")
        twice = set(stream.channels) & set(POSITION_CHANNELS)
        if stream.position is not None and twice:
            raise ConfigError(f"{path.name}: stream {name}: 'position' gives the channel {min(twice)} too")
        if stream.decimal == stream.delimiter:
            raise ConfigError(
                f"{path.name}: stream {name}: delimiter and decimal are both {stream.decimal!r}; numbers "
                "with a comma need another delimiter, such as ';'"
            )
    _check_units(path.name, mapping)
    _check_fields(path.name, mapping)
    return mapping


ReadMessages = Callable[[Path, str, Map[str, Any], "Counter[str] | None"], Stream]
"""Reads a stream of messages: file, name of the stream, its description, and what counts repairs."""


def find_runs(
    folder: Path, mapping: Mapping, read_messages: ReadMessages | None = None
) -> list[Callable[..., RunLog]]:
    """Return one reader per run that the mapping finds under ``folder``; call it with ``repair=``.

    Parameters
    ----------
    folder : that the file patterns start from
    mapping : as :func:`load_mapping` returns it
    read_messages : reads streams whose files are bags

    Raises
    ------
    LogError
        if no file fits.
    """
    found = found_files(folder, mapping)
    if not found:
        patterns = ", ".join(stream.file for stream in mapping.streams.values())
        raise LogError(f"{folder}: no file there fits the mapping ({patterns})")
    return [partial(read_run, folder, mapping, run, read_messages=read_messages) for run in found]


def found_files(folder: Path, mapping: Mapping) -> list[Found]:
    """Return the files of each run that a mapping finds under a folder; none where no file fits."""
    found: dict[str, Found] = {}
    for name, stream in mapping.streams.items():
        pattern = _pattern(normal_name(stream.file))
        for path in folder.glob(_glob_of(stream.file)):
            place = path.relative_to(folder).as_posix()
            if match := pattern.fullmatch(normal_name(place)):
                words = match.groupdict()
                found.setdefault(repr(sorted(words.items())), Found(words, {})).places[name] = place
    return [run for _, run in sorted(found.items())]


def _glob_of(file: str) -> str:
    """Return a pattern of :mod:`glob` that finds a file pattern in any of Unicode's forms."""
    return "".join(
        "*" if part.startswith("{") else re.sub(r"[^\x00-\x7f]+", "*", glob.escape(normal_name(part)))
        for part in _SPLIT_AT_FIELDS.split(file)
    )


def read_run(
    folder: Path,
    mapping: Mapping,
    found: Found,
    *,
    repair: bool = False,
    read_messages: ReadMessages | None = None,
    by: str = "by a mapping",
    linked_folders: bool = False,
) -> RunLog:
    """Return the run whose files were found.

    Parameters
    ----------
    folder : folder that the file patterns start from
    mapping : as :func:`load_mapping` returns it
    found : its words and files; a stream whose file was not found is missing there
    repair : drop and count what a strict read refuses
    read_messages : reads streams whose files are bags
    by : what the run states of how it was read
    linked_folders : whether the folder of a file may be a link that leads elsewhere

    Raises
    ------
    LogError
        if a file is missing, empty or broken, or the streams do not overlap in time.
    ConfigError
        if a package is missing, or nothing reads messages here.
    """
    words = found.words
    dropped: Counter[str] = Counter()
    streams: dict[str, Stream] = {}
    files = []
    for name, stream in mapping.streams.items():
        path = folder / found.places.get(name, stream.file.format(**words))
        check_log_file(path, path.parent if linked_folders else folder)
        files.append(path.relative_to(folder).as_posix())
        if stream.messages is None:
            streams[name] = _read_stream(path, stream, dropped, repair=repair)
        elif read_messages is None:
            raise ConfigError(f"stream {name}: files of messages are not read here")
        else:
            streams[name] = read_messages(path, name, stream.messages, dropped if repair else None)
    run_id = (mapping.run_id or "_".join(f"{{{word}}}" for word in words)).format(**words)
    refuse_apart(run_id, streams)
    terrain = mapping.terrain.format(**words)
    return checked_names(
        f"run {shown(run_id)}",
        RunLog(
            run_id,
            mapping.robot,
            streams,
            (whole_run_label(streams, terrain),) if terrain else (),
            source=f"{' and '.join(dict.fromkeys(files))}, {by}",
            dropped=dropped,
        ),
    )


def _read_stream(path: Path, stream: StreamMapping, dropped: Counter[str], *, repair: bool) -> Stream:
    """Return the stream that a file holds."""
    assert stream.time is not None
    columns = list(stream.channels.values())
    names = [column.column for column in columns]
    placed = stream.position.columns if stream.position is not None else []
    table = read_table(
        path,
        [normal_name(name) for name in (stream.time.column, *names, *placed)],
        layout=stream.layout,
        sheet=stream.sheet,
        repair=repair,
        dropped=dropped,
    )
    channels = list(stream.channels)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is judged below
        time_s = (table[:, 0] + stream.time.offset) * UNIT_SCALES[stream.time.unit][1]
        values = np.empty((len(table), 0))
        if columns:
            scale, offset, factor, zero = np.array(
                [(c.scale, c.offset, UNIT_SCALES[c.unit][1], UNIT_OFFSETS.get(c.unit, 0.0)) for c in columns]
            ).T
            values = (table[:, 1 : 1 + len(columns)] * scale + offset) * factor + zero
    if stream.position is not None:
        try:
            metres = _local_metres(stream.position, table[:, 1 + len(columns) :])
        except LogError as error:
            raise LogError(f"{short_name(path)}: {error}") from error
        channels += list(POSITION_CHANNELS[: metres.shape[1]])
        names += [stream.position.longitude, stream.position.latitude, stream.position.height][
            : metres.shape[1]
        ]
        values = np.column_stack([values, metres])
    return checked_stream(
        short_name(path),
        time_s,
        values,
        channels,
        row_of=partial(table_row, path, layout=stream.layout),
        columns=names,
        repairs=dropped if repair else None,
    )


def _local_metres(position: Position, values: Array) -> Array:
    """Return east and north, and up where heights are known, of latitudes, longitudes and heights."""
    to_rad = UNIT_SCALES[position.unit][1]
    origin = position.origin
    metres = local_metres(
        values[:, 0] * to_rad,
        values[:, 1] * to_rad,
        values[:, 2] if position.height else None,
        () if origin is None else (origin[0] * to_rad, origin[1] * to_rad, origin[2]),
    )
    return metres if position.height else metres[:, :2]


def _pattern(file: str) -> re.Pattern[str]:
    seen: set[str] = set()
    pattern = ""
    for part in _SPLIT_AT_FIELDS.split(file):
        word = _FIELD.fullmatch(part)
        if word is None:
            pattern += re.escape(part)
        elif word[1] in seen:
            pattern += f"(?P={word[1]})"
        else:
            pattern += f"(?P<{word[1]}>[^/]+)"
            seen.add(word[1])
    return re.compile(pattern)


def _check_units(file: str, mapping: Mapping) -> None:
    for name, stream in mapping.streams.items():
        if stream.time is not None:
            check_unit(f"{file}: stream {name}: time", stream.time.unit, "s")
        for channel, column in stream.channels.items():
            place = f"{file}: stream {name}: channel {channel}"
            try:
                desired = unit_of(channel)
            except LogError as error:
                raise ConfigError(f"{file}: stream {name}: {error}") from error
            check_unit(place, column.unit, desired)


def check_unit(place: str, unit: str, desired: str) -> None:
    """Raise :class:`ConfigError` where a unit is unknown, or another than that of an SI unit word.

    Examples
    --------
    >>> check_unit("gyro_z_radps", "m", "radps")
    Traceback (most recent call last):
    terrain.errors.ConfigError: gyro_z_radps: unit 'm' does not suit it (accepted here: rad/s, deg/s, rpm)
    """
    unit = canonical_unit(unit)
    suitable = ", ".join(name for name, (word, _) in UNIT_SCALES.items() if word == desired)
    if unit not in UNIT_SCALES:
        raise ConfigError(f"{place}: unit {unit!r} is unknown (accepted here: {suitable})")
    if UNIT_SCALES[unit][0] != desired:
        raise ConfigError(f"{place}: unit {unit!r} does not suit it (accepted here: {suitable})")


def _check_fields(file: str, mapping: Mapping) -> None:
    words = {name: set(_FIELD.findall(stream.file)) for name, stream in mapping.streams.items()}
    first = next(iter(words))
    for name, stream in mapping.streams.items():
        if words[name] != words[first]:
            raise ConfigError(f"{file}: streams {first} and {name} do not have the same words in braces")
        if re.search(r"[{}]", _FIELD.sub("", stream.file)):
            raise ConfigError(f"{file}: stream {name}: file {stream.file!r} has a brace without its partner")
        if has_control_characters(stream.file) or not Path(stream.file).name:
            raise ConfigError(f"{file}: stream {name}: file {shown(stream.file)} names no file")
        if Path(stream.file).is_absolute() or ".." in Path(stream.file).parts:
            raise ConfigError(f"{file}: stream {name}: file {stream.file!r} must lie under the data folder")
    if not words[first] and not mapping.run_id:
        raise ConfigError(f"{file}: key 'run_id' is missing (the file patterns have no words in braces)")
    for key, rule in (("run_id", mapping.run_id), ("terrain", mapping.terrain)):
        strange = set(_FIELD.findall(rule)) - words[first]
        if strange or re.search(r"[{}]", _FIELD.sub("", rule)):
            known = ", ".join(f"{{{word}}}" for word in sorted(words[first])) or "none"
            raise ConfigError(f"{file}: {key} {rule!r} uses a word that the files lack (they have {known})")


def csv_mapping(runs: Sequence[RunLog]) -> str | None:
    """Return the mapping that reads the CSV files of runs; None where they differ in robot or channels.

    Labels are no part of it, and neither are codes, which have no unit.
    """
    first = runs[0]
    for run in runs:
        if run.robot != first.robot or {n: s.channels for n, s in run.streams.items()} != {
            n: s.channels for n, s in first.streams.items()
        }:
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
