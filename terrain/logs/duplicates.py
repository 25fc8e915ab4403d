"""Runs that hold the same measurements, found by content: copies, pieces and overlaps under other names.

Two drives never shake a robot alike, so that the order of the heights of consecutive peaks identifies a
stretch of a run.  Of each measured channel, low-pass filtered, the local maxima ``h_1, h_2, ...`` are taken;
:data:`N_PEAKS` consecutive ones give one whole number, whose bits are ``h_i < h_(i+d)`` for d = 1, 2, 3.
Neither an offset of the clock, a cut, rounding, a positive factor, an offset of the channel, its name nor
another sampling rate changes that number, and equal numbers are found by sorting: the cost grows with the
data, not with the number of pairs.  Equal numbers are candidates only; heights and times of the peaks must
agree as well, in several stretches with one offset.

Found: copies, cut pieces of at least about five seconds with the vibrations of a drive, overlaps, rounding
to a tenth of the standard deviation of a channel, resampling of 50 Hz and more, and channels that were
scaled, renamed or exchanged.  Not found: shorter pieces, copies of which all channels changed their sign,
copies at less than half of the sampling rate, and copies to which noise was added.  Channels that do not vary
take no part.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from terrain.logs.fingerprints import (
    N_PEAKS,
    Peaks,
    RunPrint,
    fingerprints,
    measured_streams,
    samples_digest,
    scaled_heights,
)
from terrain.records import Array, RunLog

MIN_CORRELATION = 0.99
"""Of the heights of two stretches whose order agrees already; copies rounded to a tenth of the standard
deviation of their channel are above 0.995."""

MAX_RATE_RATIO = 1.1
"""Clocks of two copies may run at rates that differ by less than this; those of loggers differ by 4 %."""

MIN_STRETCHES = 3
"""Fingerprints that must agree in their offset; three are one more peak each, not three times the time."""

MIN_EQUAL = 6
"""Equal fingerprints without their heights: 21 peaks of one channel, or fewer of several.  Of 10000 runs of
noise of one kind, some hundred pairs agree in so many by chance."""

OFFSET_TOLERANCE_S = 0.3
"""Fingerprints of one overlap agree in their offset within this, and a tenth of the time between them."""

MAX_HOLE_S = 15.0
"""An overlap may lose its fingerprints for so long, as at a standstill, and is one overlap still."""

EDGE_S = 1.5
"""An overlap that reaches so close to the end of a run reaches its end: the first peaks come later."""

N_FILES = 32
RECORD = np.dtype([("code", "<i8"), ("time_s", "<f8"), ("run", "<i4")])
SPREADING = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio: the first bits of a product with it are spread evenly (Knuth, The Art of
Computer Programming 3, section 6.4)."""


class SharedStretch(NamedTuple):
    """A stretch of one run that another run holds as well, each on its own clock.

    Parameters
    ----------
    first, second : run ids, in the order of the runs
    first_start_s, first_end_s : of the stretch in the first run
    second_start_s, second_end_s : of the stretch in the second run
    """

    first: str
    second: str
    first_start_s: float
    first_end_s: float
    second_start_s: float
    second_end_s: float

    def of(self, run_id: str) -> tuple[float, float]:
        """Return start and end of the stretch on the clock of one of the two runs."""
        if run_id == self.first:
            return self.first_start_s, self.first_end_s
        return self.second_start_s, self.second_end_s

    @property
    def duration_s(self) -> float:
        """Length of the stretch on the clock of the first run."""
        return self.first_end_s - self.first_start_s


class _Matches(NamedTuple):
    """Stretches (m,) of two runs whose peaks agree."""

    first: Array
    second: Array
    first_start_s: Array
    first_end_s: Array
    second_start_s: Array
    second_end_s: Array


def shared_stretches(runs: Sequence[RunLog]) -> tuple[SharedStretch, ...]:
    """Return the stretches that two of the runs have in common, in the order of the runs.

    Of more than two copies, each is found beside some other one, not beside all.

    Parameters
    ----------
    runs : with ids of their own

    Examples
    --------
    >>> from terrain.records import Stream
    >>> noise = np.random.default_rng(0).normal(size=(1000, 1))
    >>> def run(run_id, rows, start_s):
    ...     time_s = start_s + np.arange(len(rows)) / 50.0
    ...     return RunLog(run_id, "husky", {"imu": Stream(time_s, rows, ("accel_z_mps2",))})
    >>> (found,) = shared_stretches([run("a", noise, 0.0), run("b", noise[500:].round(2), 100.0)])
    >>> found.first, found.second, round(found.first_start_s), round(found.second_start_s)
    ('a', 'b', 10, 100)
    """
    found = [
        stretch
        for (first, second), rows in _by_pair(_matches(*fingerprints(runs))).items()
        for stretch in _stretches(rows, runs[first], runs[second])
    ]
    known = {(stretch.first, stretch.second) for stretch in found}
    found += [stretch for stretch in _same_bytes(runs) if (stretch.first, stretch.second) not in known]
    return tuple(sorted(found, key=lambda stretch: (stretch.first, stretch.second, stretch.first_start_s)))


def _matches(codes: Array, start: Array, peaks: Peaks) -> _Matches:
    """Return where two runs have one fingerprint, and heights and times of its peaks agree."""
    order = np.argsort(codes, kind="stable")
    codes, start = codes[order], start[order]
    same = np.flatnonzero((codes[1:] == codes[:-1]) & (peaks.run[start[1:]] != peaks.run[start[:-1]]))
    a, b = start[same], start[same + 1]  # stable: the run of a comes before that of b
    rows = np.arange(N_PEAKS)
    heights = [peaks.height[each[:, None] + rows] for each in (a, b)]
    times_s = [peaks.time_s[each[:, None] + rows] for each in (a, b)]
    agree = _heights_agree(heights, [peaks.spread[each] for each in (a, b)])
    agree &= _times_agree(times_s, np.maximum(peaks.period_s[a], peaks.period_s[b]))
    (of_a, of_b), a, b = (each[agree] for each in times_s), a[agree], b[agree]
    return _Matches(peaks.run[a], peaks.run[b], of_a[:, 0], of_a[:, -1], of_b[:, 0], of_b[:, -1])


def _heights_agree(heights: Sequence[Array], spreads: Sequence[Array]) -> Array:
    """Return where heights (m, N_PEAKS) of both runs are one another's up to offset and factor."""
    (a, a_varies), (b, b_varies) = map(scaled_heights, heights, spreads)
    return np.asarray(a_varies & b_varies & (np.einsum("ij,ij->i", a, b) > MIN_CORRELATION))


def _times_agree(times_s: Sequence[Array], period_s: Array) -> Array:
    """Return where times (m, N_PEAKS) of both runs differ by an offset and a rate, within two samples."""
    of_a, of_b = (each - each[:, :1] for each in times_s)
    rate = of_b[:, -1] / of_a[:, -1]
    near = np.abs(of_b - rate[:, None] * of_a).max(axis=1) <= 2.0 * period_s
    return np.asarray(near & (rate < MAX_RATE_RATIO) & (rate > 1.0 / MAX_RATE_RATIO))


def _by_pair(matches: _Matches) -> dict[tuple[int, int], Array]:
    """Return the matched stretches (m, 4) of each pair of runs in order of time."""
    pairs: dict[tuple[int, int], list[Array]] = defaultdict(list)
    times_s = np.column_stack(matches[2:])
    for first, second, row in zip(
        matches.first.astype(int).tolist(), matches.second.astype(int).tolist(), times_s, strict=True
    ):
        pairs[first, second].append(row)
    return {
        pair: np.array(rows)[np.argsort(np.array(rows)[:, 0], kind="stable")]
        for pair, rows in sorted(pairs.items())
        if len(rows) >= MIN_STRETCHES
    }


def _stretches(rows: Array, first: RunLog, second: RunLog) -> list[SharedStretch]:
    """Join matched stretches (m, 4) with one offset between two clocks."""
    offset_s = rows[:, 2] - rows[:, 0]
    joined: list[list[int]] = []
    for number in range(len(rows)):
        for members in joined:
            last = members[-1]
            apart_s = rows[number, 0] - rows[last, 1]
            drift_s = OFFSET_TOLERANCE_S + 0.1 * max(apart_s, 0.0)
            if apart_s <= MAX_HOLE_S and abs(offset_s[number] - offset_s[last]) <= drift_s:
                members.append(number)
                break
        else:
            joined.append([number])
    return [_widened(rows[members], first, second) for members in joined if len(members) >= MIN_STRETCHES]


def _widened(rows: Array, first: RunLog, second: RunLog) -> SharedStretch:
    """Return the stretch that matches cover, up to the end of a run that is near."""
    begin_a, begin_b = float(rows[:, 0].min()), float(rows[:, 2].min())
    end_a, end_b = float(rows[:, 1].max()), float(rows[:, 3].max())
    before_s = min(begin_a - _begin_s(first), begin_b - _begin_s(second))
    after_s = min(_end_s(first) - end_a, _end_s(second) - end_b)
    before_s, after_s = (each if 0.0 < each <= EDGE_S else 0.0 for each in (before_s, after_s))
    return SharedStretch(
        first.run_id, second.run_id,
        begin_a - before_s, end_a + after_s, begin_b - before_s, end_b + after_s,
    )  # fmt: skip


def _begin_s(run: RunLog) -> float:
    return min(float(stream.time_s[0]) for stream, _ in measured_streams(run))


def _end_s(run: RunLog) -> float:
    return max(float(stream.time_s[-1]) for stream, _ in measured_streams(run))


def _same_bytes(runs: Sequence[RunLog]) -> list[SharedStretch]:
    """Return runs whose fastest measured stream is the same, however short it is."""
    seen: dict[bytes, RunLog] = {}
    found = []
    for run in runs:
        digest = samples_digest(run)
        if digest and (first := seen.setdefault(digest, run)) is not run:
            found.append(
                SharedStretch(
                    first.run_id, run.run_id, _begin_s(first), _end_s(first), _begin_s(run), _end_s(run)
                )
            )
    return found


class PrintFiles:
    """Fingerprints of many runs in files by their value, while the block lasts: one is read at a time.

    Examples
    --------
    >>> codes, time_s = np.arange(9), np.arange(9.0)
    >>> with PrintFiles() as prints:
    ...     prints.add(RunPrint(codes, time_s, b""))
    ...     prints.add(RunPrint(codes[1:], 50.0 + time_s[1:], b""))
    ...     prints.possible_pairs()
    [(0, 1)]
    """

    def __init__(self) -> None:
        self._digests: list[bytes] = []

    def __enter__(self) -> PrintFiles:
        self._folder = TemporaryDirectory()
        self._files = [(Path(self._folder.name) / str(number)).open("w+b") for number in range(N_FILES)]
        return self

    def __exit__(self, *_: object) -> None:
        for file in self._files:
            file.close()
        self._folder.cleanup()

    def add(self, prints: RunPrint) -> None:
        """Take the fingerprints of the next run."""
        records = np.empty(len(prints.codes), RECORD)
        records["code"], records["time_s"], records["run"] = prints.codes, prints.time_s, len(self._digests)
        self._digests.append(prints.digest)
        number = (prints.codes.astype(np.uint64) * SPREADING) // np.uint64(2**64 // N_FILES)
        for each in np.unique(number).tolist():
            self._files[each].write(records[number == each].tobytes())

    def possible_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of runs, by their places, that may share a stretch; :func:`shared_stretches` decides.

        They have enough equal fingerprints near one offset of their clocks, or equal digests.
        """
        found = []
        for file in self._files:
            file.seek(0)
            records = np.frombuffer(file.read(), RECORD)
            records = records[np.argsort(records["code"], kind="stable")]
            one, next_ = records[:-1], records[1:]
            same = (one["code"] == next_["code"]) & (one["run"] != next_["run"])
            one, next_ = one[same], next_[same]
            found.append((one["run"], next_["run"], next_["time_s"] - one["time_s"]))
        first, second, offset_s = map(np.concatenate, zip(*found, strict=True))
        order = np.lexsort((offset_s, second, first))
        first, second, offset_s = first[order], second[order], offset_s[order]
        a, b = slice(None, 1 - MIN_EQUAL), slice(MIN_EQUAL - 1, None)
        near = offset_s[b] - offset_s[a] <= (MIN_EQUAL - 1) * (OFFSET_TOLERANCE_S + 0.1 * MAX_HOLE_S)
        near &= (first[a] == first[b]) & (second[a] == second[b])
        pairs = set(zip(first[a][near].tolist(), second[a][near].tolist(), strict=True))
        seen: dict[bytes, int] = {}
        for place, digest in enumerate(self._digests):
            if digest and (before := seen.setdefault(digest, place)) != place:
                pairs.add((before, place))
        return sorted(pairs)


def groups_of(stretches: Sequence[SharedStretch]) -> tuple[tuple[str, ...], ...]:
    """Return the ids of runs that are linked by shared stretches, at least two a group, sorted.

    Examples
    --------
    >>> groups_of([SharedStretch("a", "c", 0, 9, 0, 9), SharedStretch("c", "d", 0, 9, 0, 9)])
    (('a', 'c', 'd'),)
    """
    group: dict[str, set[str]] = {}
    for stretch in stretches:
        joined = group.get(stretch.first, {stretch.first}) | group.get(stretch.second, {stretch.second})
        group |= dict.fromkeys(joined, joined)
    return tuple(sorted({tuple(sorted(members)) for members in group.values()}))
