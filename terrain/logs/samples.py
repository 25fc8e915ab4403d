"""From arrays to a :class:`~terrain.records.Stream`, and from files to arrays: the one place where a log is judged.

Files of a log and the names in it do not lead elsewhere, whoever wrote it.  Every reader hands its arrays to
:func:`checked_stream`.  A strict read refuses times that are not finite, go back or repeat, channels with nothing
finite in them and streams of fewer than two samples.  A repairing read drops the rows at fault, keeps a dead channel
as NaN (all runs of a data set must have the same channels), and counts what it did.  NaN among finite values is no
fault: it stays NaN, infinite values become NaN, and the windows that touch them are dropped and counted later.  A
finite value that no quantity can have, as of damaged bytes, stays as it is; a repairing read makes it NaN.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from terrain.errors import DataError, LogError
from terrain.files.names import (
    check_inside,
    check_name,
    check_regular,
    has_control_characters,
    normal_name,
    shown,
)
from terrain.records import Array, Label, RunLog, Stream

MAX_MAGNITUDE = 1e12
"""No quantity of a vehicle is larger in its SI unit (a position on Earth in m has 8 digits, a time since 1970
in s has 10); the fourth power of what is much larger, which features need, is no finite number."""

BEYOND = f"beyond {MAX_MAGNITUDE:g} in its SI unit no quantity is plausible: --repair leaves such values out"
"""What a message states of a value that is larger, wherever it occurs."""

BAD_TIME = "rows with a bad time"
BAD_CELL = "cells that are no number"
SHORT_ROW = "rows with missing or extra cells"
DEAD_CHANNEL = "channels with nothing finite"
IMPLAUSIBLE = "values beyond any quantity"
RESPELT = "labels in another spelling of their terrain"


def refuse_or_count(repairs: Counter[str] | None, kind: str, sentence: str, n: int = 1) -> None:
    """Raise ``LogError`` where nothing is repaired, else count ``n`` of a kind."""
    if repairs is None:
        raise LogError(sentence)
    repairs[kind] += n


def usable(samples: Array, *, unknown_is_a_value: bool = False) -> Array:
    """Return which samples in SI units are plausible values; NaN, if stated, is one.

    Examples
    --------
    >>> usable(np.array([1.0, -2.0, np.nan, np.inf, 1e200])).tolist()
    [True, True, False, False, False]
    """
    is_value = np.abs(samples) <= MAX_MAGNITUDE  # NaN is not
    return np.asarray(is_value | np.isnan(samples) if unknown_is_a_value else is_value)


def refuse_implausible(run: RunLog, channels: Mapping[str, Sequence[str]]) -> None:
    """Refuse a finite value that no quantity can have, in the channels of some streams of a run; ``DataError``."""
    for name, of_stream in channels.items():
        stream = run.streams[name]
        for channel in of_stream:
            values = stream.channel(channel)
            beyond = np.flatnonzero((np.abs(values) > MAX_MAGNITUDE) & np.isfinite(values))
            if len(beyond):
                raise DataError(
                    f"run {run.run_id}, stream {name!r}: channel {channel!r} is {values[beyond[0]]:.6g} at "
                    f"{stream.time_s[beyond[0]]:.2f} s; {BEYOND}"
                )


def short_name(path: Path) -> str:
    """Return folder and name of a file, as messages call it: ``ASPHALT/imu_03.csv``."""
    return "/".join(path.parts[-2:])


def check_log_file(path: Path, folder: Path) -> Path:
    """Return a regular file that lies in a folder, links resolved, or raise ``LogError``; the folder may be a link."""
    place = short_name(path)
    if not path.is_symlink() and not path.exists():
        raise LogError(f"{place}: is missing")
    check_inside(path, folder, place, LogError)
    check_regular(path, place, LogError)
    return path


def checked_names(place: str, run: RunLog) -> RunLog:
    """Return a run whose names are plain ones, or raise ``LogError``: it says nothing of where a file lies.

    Examples
    --------
    >>> checked_names("run.json", RunLog("SNOW_01", "robots/husky.yaml", {}))
    Traceback (most recent call last):
    terrain.errors.LogError: run.json: robot 'robots/husky.yaml' is no plain name: it holds a path separator
    """
    names = [("run_id", run.run_id), ("robot", run.robot)]
    names += [(key, name) for key in ("session", "filter") if (name := getattr(run, key))]
    names += [("terrain", terrain) for terrain in run.terrains]
    for stream, content in run.streams.items():
        names += [("stream", stream), *(("channel", channel) for channel in content.channels)]
    for key, name in names:
        check_name(f"{place}: {key}", name, LogError)
    for kind in run.dropped:
        if has_control_characters(kind):
            raise LogError(f"{place}: key {shown(kind)} of 'dropped' holds a control character")
    return run


def longest_rise(time_s: Array) -> Array:
    """Return the indices (m,) of the longest strictly increasing subsequence of finite times (n,).

    One forward spike costs one row and not the rest of the run, as dropping whatever is not later than the row
    before would.

    Examples
    --------
    >>> longest_rise(np.array([0.0, 0.1, 99.0, 0.2, 0.2, 0.3])).tolist()
    [0, 1, 3, 5]
    """
    last_times: list[float] = []  # last_times[k]: smallest end of a rise of k + 1 samples
    last_rows: list[int] = []
    before = np.full(time_s.size, -1)
    for row, time in enumerate(time_s.tolist()):
        length = bisect_left(last_times, time)
        if length:
            before[row] = last_rows[length - 1]
        if length == len(last_times) or time < last_times[length]:
            last_times[length : length + 1], last_rows[length : length + 1] = [time], [row]
    chain = []
    row = last_rows[-1] if last_rows else -1
    while row >= 0:
        chain.append(row)
        row = int(before[row])
    return np.array(chain[::-1], dtype=np.intp)


def rising_rows(
    name: str, time_s: Array, row_of: Callable[[int], int], repairs: Counter[str] | None
) -> Array | slice:
    """Return which rows have times that are finite and rise; refuse others, or count them (:func:`checked_stream`)."""
    finite = np.flatnonzero(np.isfinite(time_s))
    fallen = 1 + np.flatnonzero(np.diff(time_s[finite]) <= 0.0)
    if finite.size == time_s.size and not fallen.size:
        return slice(None)
    if repairs is not None:
        kept = finite[longest_rise(time_s[finite])]
        repairs[BAD_TIME] += time_s.size - kept.size
        return kept
    if finite.size < time_s.size:
        row = int(np.flatnonzero(~np.isfinite(time_s))[0])
        raise LogError(f"{name}: time at row {row_of(row)} is not finite ({time_s[row]})")
    row = int(fallen[0])
    now, then = float(time_s[row]), float(time_s[row - 1])
    if now == then:
        raise LogError(f"{name}: time repeats at row {row_of(row)} ({now:.15g} s twice)")
    raise LogError(f"{name}: time goes back at row {row_of(row)} ({now:.15g} s after {then:.15g} s)")


def checked_stream(
    name: str,
    time_s: Array,
    values: Array,
    channels: Sequence[str],
    *,
    row_of: Callable[[int], int] = lambda sample: sample + 1,
    columns: Sequence[str] = (),
    repairs: Counter[str] | None = None,
    unknown_is_a_value: bool = False,
) -> Stream:
    """Return the stream that the arrays hold, or raise ``LogError`` that says what is wrong with them.

    Parameters
    ----------
    name : what the message calls the file
    time_s, values, channels : (n,) seconds, (n, c) SI units, c names
    row_of : row number in the file of a sample, for the message
    columns : c names of the columns in the file, for the message, where they are not the channels
    repairs : counts by kind of what is dropped instead of refused; None refuses.  Fewer than two samples are
        refused in any case
    unknown_is_a_value : a channel may hold nothing but NaN, as unobservable slip does

    Examples
    --------
    >>> time_s, values = np.array([0.0, 0.2, 0.1]), np.ones((3, 1))
    >>> checked_stream("a.csv", time_s, values, ["gyro_z_radps"], row_of=lambda i: i + 2)
    Traceback (most recent call last):
    terrain.errors.LogError: a.csv: time goes back at row 4 (0.1 s after 0.2 s)
    """
    values = np.where(np.isfinite(values), values, np.nan)
    kept = rising_rows(name, time_s, row_of, repairs)
    time_s, values = time_s[kept], values[kept]
    if time_s.size < 2:
        raise LogError(f"{name}: has {time_s.size} usable rows of data, at least 2 are needed")
    implausible = np.abs(values) > MAX_MAGNITUDE
    if repairs is not None and implausible.any():
        repairs[IMPLAUSIBLE] += int(implausible.sum())
        values = np.where(implausible, np.nan, values)
    for i in [] if unknown_is_a_value else np.flatnonzero(~np.isfinite(values).any(axis=0)).tolist():
        of = f"channel {channels[i]}{f' (column {columns[i]})' if columns else ''}"
        refuse_or_count(repairs, DEAD_CHANNEL, f"{name}: {of} has nothing finite in its {time_s.size} rows")
    return Stream(time_s, values, tuple(channels))


def refuse_apart(run_id: str, streams: Mapping[str, Stream]) -> None:
    """Raise ``LogError`` when no instant is covered by every stream of a run."""
    if max(s.time_s[0] for s in streams.values()) >= min(s.time_s[-1] for s in streams.values()):
        spans = ", ".join(f"{n} {s.time_s[0]:.15g} to {s.time_s[-1]:.15g} s" for n, s in streams.items())
        raise LogError(f"{run_id}: the streams do not overlap in time ({spans})")


def whole_run_label(streams: Mapping[str, Stream], terrain: str) -> Label:
    """Return the label that covers every sample of a run, the last one with its sampling period.

    Examples
    --------
    >>> whole_run_label({"imu": Stream([0.0, 0.5, 1.0], [[0.0]] * 3, ("gyro_z_radps",))}, "SNOW")
    Label(start_s=0.0, end_s=1.5, terrain='SNOW')
    """
    last = max(streams.values(), key=lambda stream: float(stream.time_s[-1]))
    period_s = float(np.median(np.diff(last.time_s)))
    start_s = min(float(stream.time_s[0]) for stream in streams.values())
    return Label(start_s, float(last.time_s[-1]) + period_s, terrain)


def one_spelling(place: str, runs: Sequence[RunLog], *, repair: bool = False) -> list[RunLog]:
    """Return the runs of a data set, ``place`` in messages, whose terrains differ by more than upper and lower case.

    An accented letter has two forms in Unicode; names that differ in that alone are the same, in form C.
    ``LogError`` where a terrain has two spellings; a repairing read takes that of most runs, the first in the alphabet
    among equals, and counts the labels.

    Examples
    --------
    >>> runs = [RunLog(name, "husky", {}, ((0.0, 1.0, name),)) for name in ("Asphalt", "ASPHALT")]
    >>> one_spelling("logs", runs)
    Traceback (most recent call last):
    terrain.errors.LogError: logs: the terrains 'ASPHALT' and 'Asphalt' differ in upper and lower case ...
    """
    n_runs = Counter(terrain for run in runs for terrain in run.terrains)
    alike: defaultdict[str, defaultdict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for terrain in n_runs:
        alike[normal_name(terrain).casefold()][normal_name(terrain)].append(terrain)
    better: dict[str, str] = {}
    for forms in alike.values():
        spelt = {each[0] if len(each) == 1 else name: each for name, each in forms.items()}
        names = sorted(spelt, key=lambda name: (-sum(n_runs[each] for each in spelt[name]), name))
        if len(names) > 1 and not repair:
            listed = " and ".join(shown(name) for name in sorted(names))
            raise LogError(
                f"{place}: the terrains {listed} differ in upper and lower case only; name them alike, or "
                "merge them with --repair"
            )
        better |= {each: names[0] for every in spelt.values() for each in every}
    respelt = []
    for run in runs:
        if any(better[terrain] != terrain for terrain in run.terrains):
            labels = tuple(label._replace(terrain=better[label.terrain]) for label in run.labels)
            n = sum(normal_name(each.terrain) != normal_name(better[each.terrain]) for each in run.labels)
            run = replace(run, labels=labels, dropped=Counter(run.dropped) + Counter({RESPELT: n}))
        respelt.append(run)
    return respelt
