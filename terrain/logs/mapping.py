"""Reader of any tables (CSV, .mat, .xlsx), whose layout a small YAML mapping describes (``docs/mapping.md``).

A word in braces stands for any text without a slash, and the files of which all such words agree make one run; every
stream has the same words.  Several streams may name one file, and the files of a run may be of different formats;
``offset`` brings their times onto one clock.  ``position`` becomes the channels :data:`POSITION_CHANNELS`.  The files
lie under the data folder, and so does what links in it lead to.  The robot is a name, of the package or of the
description that the user gives.  A cell becomes ``(scale * cell + offset)`` in the unit given, and then SI; the unit
must suit the name of the channel (:data:`~terrain.logs.schema.UNIT_SCALES`).  Names are compared in Unicode's normal
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

_FIELD = re.compile(r"\{([^\W\d]\w*)\}")

Unit = Annotated[
    str, BeforeValidator(lambda unit: canonical_unit(unit) if isinstance(unit, str) else repr(unit))
]
Word = Annotated[str, Field(min_length=1)]


class Strict(BaseModel):
    """Part of a mapping: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Column(Strict):
    """Where a channel or the time is: ``(scale * cell + offset)`` is in ``unit``."""

    column: Word
    unit: Unit
    scale: FiniteFloat = 1.0
    offset: FiniteFloat = 0.0


class Position(Strict):
    """Where latitude and longitude of a receiver are, in ``unit``, and its height in m; the origin is in these."""

    latitude: Word
    longitude: Word
    height: str = ""
    unit: Literal["deg", "rad"] = "deg"
    origin: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)] | None = None


class StreamMapping(Strict):
    """Where a stream is."""

    file: Word
    time: Column | None = None
    messages: dict[str, Any] | None = None
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
    streams: Annotated[dict[Word, StreamMapping], Field(min_length=1)]
    run_id: Word = ""
    terrain: str = ""


class RunFiles(NamedTuple):
    """Files of one run: the text for each word in braces, and of each stream the place of its file as on disk."""

    words: dict[str, str]
    places: dict[str, str]


ReadMessages = Callable[[Path, str, Map[str, Any], "Counter[str] | None"], Stream]
"""Reads a stream of messages: file, name of the stream, its description, and what counts repairs."""


def local_metres(
    latitude_rad: Array, longitude_rad: Array, height_m: Array | None = None, origin: Sequence[float] = ()
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
    if not origin:
        first = int(np.flatnonzero(known)[0])
        base_m = 0.0 if height_m is None or not np.isfinite(height_m[first]) else float(height_m[first])
        origin = (float(latitude_rad[first]), float(longitude_rad[first]), base_m)
    heights_m = np.full(latitude_rad.shape, np.nan) if height_m is None else height_m
    heights_m = np.where(np.isfinite(heights_m), heights_m, origin[2])
    metres = np.column_stack(pymap3d.geodetic2enu(latitude_rad, longitude_rad, heights_m, *origin, deg=False))
    metres[~known] = np.nan
    return metres


def load_mapping(
    path: str | Path, check_messages: Callable[[str, Map[str, Any]], object] | None = None
) -> Mapping:
    """Return the mapping that a YAML file describes; ``check_messages`` gets place and keys of a stream of messages.

    ``ConfigError`` where the file cannot be read, a key is unknown or missing, a unit is unknown or does not suit its
    channel, or the file patterns do not agree on the words in braces.
    """
    path = Path(path)
    mapping = accepted(Mapping, read_yaml(path), path.name, ConfigError)
    check_name(f"{path.name}: robot", mapping.robot, ConfigError)
    words = {name: set(_FIELD.findall(stream.file)) for name, stream in mapping.streams.items()}
    first = next(iter(words))
    for name, stream in mapping.streams.items():
        place = f"{path.name}: stream {name}:"
        if stream.messages is not None:
            if stream.channels or stream.position or stream.time:
                raise ConfigError(f"{place} 'messages' leave out time, channels and position")
            if check_messages is not None:
                check_messages(place[:-1], stream.messages)
        elif stream.time is None:
            raise ConfigError(f"{path.name}: key 'streams.{name}.time' is missing")
        else:
            _check_table(place, stream, stream.time)
        if words[name] != words[first]:
            raise ConfigError(f"{path.name}: streams {first} and {name} do not have the same words in braces")
        if re.search(r"[{}]", _FIELD.sub("", stream.file)):
            raise ConfigError(f"{place} file {stream.file!r} has a brace without its partner")
        if has_control_characters(stream.file) or not Path(stream.file).name:
            raise ConfigError(f"{place} file {shown(stream.file)} names no file")
        if Path(stream.file).is_absolute() or ".." in Path(stream.file).parts:
            raise ConfigError(f"{place} file {stream.file!r} must lie under the data folder")
    if not words[first] and not mapping.run_id:
        raise ConfigError(f"{path.name}: key 'run_id' is missing (the file patterns have no words in braces)")
    for key, rule in (("run_id", mapping.run_id), ("terrain", mapping.terrain)):
        if set(_FIELD.findall(rule)) - words[first] or re.search(r"[{}]", _FIELD.sub("", rule)):
            known = ", ".join(f"{{{word}}}" for word in sorted(words[first])) or "none"
            raise ConfigError(
                f"{path.name}: {key} {rule!r} uses a word that the files lack (they have {known})"
            )
    return mapping


def _check_table(place: str, stream: StreamMapping, time: Column) -> None:
    if not stream.channels and stream.position is None:
        raise ConfigError(f"{place} has no channels and no position")
    twice = set(stream.channels) & set(POSITION_CHANNELS)
    if stream.position is not None and twice:
        raise ConfigError(f"{place} 'position' gives the channel {min(twice)} too")
    if stream.decimal == stream.delimiter:
        raise ConfigError(
            f"{place} delimiter and decimal are both {stream.decimal!r}; numbers with a comma need another "
            "delimiter, such as ';'"
        )
    check_unit(f"{place} time", time.unit, "s")
    for channel, column in stream.channels.items():
        check_unit(f"{place} channel {channel}", column.unit, unit_required(place, channel))


def unit_required(place: str, channel: str) -> str:
    """Return the unit word of a channel in a mapping; ``ConfigError`` where it has none."""
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


def run_files(folder: Path, mapping: Mapping) -> list[RunFiles]:
    """Return the files of each run that a mapping finds under a folder; none where no file fits."""
    runs: dict[str, RunFiles] = {}
    for name, stream in mapping.streams.items():
        glob_text, pattern = _patterns(normal_name(stream.file))
        for path in folder.glob(glob_text):
            place = path.relative_to(folder).as_posix()
            if match := pattern.fullmatch(normal_name(place)):
                words = match.groupdict()
                runs.setdefault(repr(sorted(words.items())), RunFiles(words, {})).places[name] = place
    return [run for _, run in sorted(runs.items())]


def _patterns(file: str) -> tuple[str, re.Pattern[str]]:
    """Return what finds a file pattern in any of Unicode's forms (:mod:`glob`), and what takes its words."""
    glob_text, pattern, seen = "", "", set[str]()
    for part in re.split(r"(\{[^\W\d]\w*\})", file):
        word = _FIELD.fullmatch(part)
        if word is None:
            glob_text += re.sub(r"[^\x00-\x7f]+", "*", glob.escape(part))
            pattern += re.escape(part)
            continue
        glob_text += "*"
        pattern += f"(?P={word[1]})" if word[1] in seen else f"(?P<{word[1]}>[^/]+)"
        seen.add(word[1])
    return glob_text, re.compile(pattern)


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
            streams[name] = _read_stream(path, stream, dropped if repair else None)
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


def _read_stream(path: Path, stream: StreamMapping, repairs: Counter[str] | None) -> Stream:
    assert stream.time is not None
    position, columns = stream.position, [stream.time, *stream.channels.values()]
    channels, sources = list(stream.channels), [column.column for column in columns[1:]]
    placed: list[str] = []
    if position is not None:
        placed = [position.latitude, position.longitude, *filter(None, [position.height])]
    layout = TextLayout(stream.delimiter, stream.decimal, stream.skip_rows, stream.header_rows)
    names = [normal_name(name) for name in (stream.time.column, *sources, *placed)]
    table = read_table(path, names, layout=layout, sheet=stream.sheet, repairs=repairs).T
    time_s, *values = (to_si(row, c.unit, c.scale, c.offset) for row, c in zip(table, columns, strict=False))
    if position is not None:
        try:
            values += [*_local_metres(position, table[len(columns) :])]
        except LogError as error:
            raise LogError(f"{short_name(path)}: {error}") from error
        channels += POSITION_CHANNELS[: len(placed)]
        sources += [position.longitude, position.latitude, position.height][: len(placed)]
    return checked_stream(
        short_name(path),
        time_s,
        np.column_stack(values),
        channels,
        row_of=partial(row_number, path, layout=layout),
        columns=sources,
        repairs=repairs,
    )


def _local_metres(position: Position, fix: Array) -> Array:
    """Return east and north, and up where heights are known, (2 or 3, n) of latitudes, longitudes and heights."""
    to_rad = UNIT_SCALES[position.unit][1]
    height_m = fix[2] if position.height else None
    origin = (
        [] if position.origin is None else [*(to_rad * x for x in position.origin[:2]), position.origin[2]]
    )
    return local_metres(fix[0] * to_rad, fix[1] * to_rad, height_m, origin).T[: len(fix)]


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
