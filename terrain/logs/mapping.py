"""Reader of any CSV files, whose layout a small YAML mapping describes.

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

A word in braces stands for any text without a slash, and the files of which all such words agree make one
run; every stream has the same words.  Several streams may name one file.  The files lie under the data
folder, and so does what links in it lead to.  The robot is a name, of the package or of the description that
the user gives.  A cell becomes ``(scale * cell + offset)`` in the unit given, and then SI; the unit must suit
the name of the channel (:data:`~terrain.logs.schema.UNIT_SCALES`).  Names are compared in Unicode's normal
form C, whichever form the file system keeps.
"""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, ValidationError

from terrain.errors import ConfigError, LogError
from terrain.files.documents import read_yaml
from terrain.files.names import check_name, has_control_characters, normal_name, shown
from terrain.logs.borealtc import whole_run_label
from terrain.logs.csv_table import TextLayout, data_row, read_columns
from terrain.logs.log_files import check_log_file, checked_names, short_name
from terrain.logs.samples import checked_stream, refuse_apart
from terrain.logs.schema import UNIT_OFFSETS, UNIT_SCALES, canonical_unit, unit_of
from terrain.records import RunLog, Stream

MAX_HEADER_ROWS = 1000
"""No instrument writes a longer head."""

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
    """Where the time is."""

    column: Word
    unit: Unit


class StreamMapping(Strict):
    """Where a stream is."""

    file: Word
    time: TimeColumn
    channels: Annotated[dict[str, Column], Field(min_length=1)]
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


def load_mapping(path: str | Path) -> Mapping:
    """Return the mapping that a YAML file describes.

    Raises
    ------
    ConfigError
        if the file cannot be read, a key is unknown or missing, a unit is unknown or does not suit its
        channel, or the file patterns do not agree on the words in braces.
    """
    path = Path(path)
    described = read_yaml(path)
    try:
        mapping = Mapping.model_validate(described)
    except ValidationError as error:
        raise ConfigError(f"{path.name}: {first_fault(error)}") from error
    check_name(f"{path.name}: robot", mapping.robot, ConfigError)
    for name, stream in mapping.streams.items():
        if stream.decimal == stream.delimiter:
            raise ConfigError(
                f"{path.name}: stream {name}: delimiter and decimal are both {stream.decimal!r}; numbers "
                "with a comma need another delimiter, such as ';'"
            )
    _check_units(path.name, mapping)
    _check_fields(path.name, mapping)
    return mapping


def find_runs(folder: Path, mapping: Mapping) -> list[Callable[..., RunLog]]:
    """Return one reader per run that the mapping finds under ``folder``; call it with ``repair=``.

    Raises
    ------
    LogError
        if no file fits.
    """
    found: dict[str, Found] = {}
    for name, stream in mapping.streams.items():
        pattern = _pattern(normal_name(stream.file))
        for path in folder.glob(_glob_of(stream.file)):
            place = path.relative_to(folder).as_posix()
            if match := pattern.fullmatch(normal_name(place)):
                words = match.groupdict()
                found.setdefault(repr(sorted(words.items())), Found(words, {})).places[name] = place
    if not found:
        patterns = ", ".join(stream.file for stream in mapping.streams.values())
        raise LogError(f"{folder}: no file there fits the mapping ({patterns})")
    return [partial(read_run, folder, mapping, run) for _, run in sorted(found.items())]


def _glob_of(file: str) -> str:
    """Return a pattern of :mod:`glob` that finds a file pattern in any of Unicode's forms."""
    return "".join(
        "*" if part.startswith("{") else re.sub(r"[^\x00-\x7f]+", "*", glob.escape(normal_name(part)))
        for part in _SPLIT_AT_FIELDS.split(file)
    )


def read_run(folder: Path, mapping: Mapping, found: Found, *, repair: bool = False) -> RunLog:
    """Return the run whose files were found.

    Parameters
    ----------
    folder : folder that the file patterns start from
    mapping : as :func:`load_mapping` returns it
    found : its words and files; a stream whose file was not found is missing there
    repair : drop and count what a strict read refuses

    Raises
    ------
    LogError
        if a file is missing, empty or broken, or the streams do not overlap in time.
    """
    words = found.words
    dropped: Counter[str] = Counter()
    streams: dict[str, Stream] = {}
    files = []
    for name, stream in mapping.streams.items():
        path = check_log_file(folder / found.places.get(name, stream.file.format(**words)), folder)
        files.append(path.relative_to(folder).as_posix())
        columns = list(stream.channels.values())
        table = read_columns(
            path,
            [normal_name(name) for name in (stream.time.column, *(column.column for column in columns))],
            layout=stream.layout,
            repair=repair,
            dropped=dropped,
        )
        scale, offset, factor, zero = np.array(
            [(c.scale, c.offset, UNIT_SCALES[c.unit][1], UNIT_OFFSETS.get(c.unit, 0.0)) for c in columns]
        ).T
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is judged below
            time_s = table[:, 0] * UNIT_SCALES[stream.time.unit][1]
            values = (table[:, 1:] * scale + offset) * factor + zero
        streams[name] = checked_stream(
            short_name(path),
            time_s,
            values,
            list(stream.channels),
            row_of=partial(data_row, path, layout=stream.layout),
            columns=[column.column for column in columns],
            repairs=dropped if repair else None,
        )
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
            source=f"{' and '.join(dict.fromkeys(files))}, by a mapping",
            dropped=dropped,
        ),
    )


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


def first_fault(error: ValidationError) -> str:
    """Return the first thing in a mapping that is not accepted, in one sentence."""
    fault: dict[str, Any] = dict(error.errors()[0])
    place = ".".join(str(part) for part in fault["loc"]) or "the file"
    if fault["type"] == "extra_forbidden":
        return f"key {shown(place)} is unknown"
    if fault["type"] == "missing":
        return f"key {place!r} is missing"
    return f"{place} is {shown(fault['input'])}: {fault['msg'][0].lower()}{fault['msg'][1:]}"
