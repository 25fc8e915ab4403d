"""Runs that hold the same measurements, found by content: reported, refused, or made one run.

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

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.logs.samples import MAX_MAGNITUDE
from terrain.logs.schema import signal_set_of
from terrain.records import Array, Label, RunLog, Stream

N_PEAKS = 16
"""Peaks of a fingerprint: 42 comparisons, of which some 30 are independent."""

LAGS = (1, 2, 3)
"""A peak is compared with so many that follow it."""

SMOOTHING_S = 0.04
"""Standard deviation of the low-pass filter: some five peaks a second, whatever the sampling rate."""

MEASURED_SETS = ("imu", "wheels", "currents")
"""Signal sets whose channels are measured; what a filter makes of them adds nothing."""

MIN_SPREAD_RATIO = 0.1
"""Heights that differ by less than this part of the channel's standard deviation are those of a periodic
signal or of noise in the last digit, which repeats from run to run."""

MIN_LEVELS = 10
"""Different heights of a stretch: channels that go back and forth between a few values repeat themselves."""

MIN_DISTINCT = 64
"""Values that a stream must have taken for its bytes to identify it."""


class Peaks(NamedTuple):
    """Peaks of all channels of all runs, one after the other; ``spread`` is that of the channel."""

    run: Array
    time_s: Array
    height: Array
    spread: Array
    period_s: Array


def measured_streams(run: RunLog) -> list[tuple[Stream, list[int]]]:
    """Return the streams that were measured, with the places of the channels that features are made of."""
    chosen = []
    for name, stream in run.streams.items():
        places = _measured_places(name, tuple(stream.channels))
        if places and len(stream) > 1:
            chosen.append((stream, list(places)))
    return chosen


@lru_cache(maxsize=1024)
def _measured_places(stream: str, channels: tuple[str, ...]) -> tuple[int, ...]:
    """Return the places of the measured channels of a stream; all runs of a data set ask for the same."""
    return tuple(i for i, each in enumerate(channels) if signal_set_of(stream, each) in MEASURED_SETS)


def fingerprints(runs: Sequence[RunLog]) -> tuple[Array, Array, Peaks]:
    """Return the fingerprints (n,), the place (n,) of their first peak, and all peaks."""
    parts: list[tuple[Array, ...]] = []
    codes: list[Array] = []
    starts: list[Array] = []
    n_peaks = 0
    for number, run in enumerate(runs):
        for stream, places in measured_streams(run):
            period_s = 1.0 / stream.rate_hz
            for place in places:
                smooth = _low_pass(stream.values[:, place], SMOOTHING_S / period_s)
                at = 1 + np.flatnonzero((smooth[1:-1] > smooth[:-2]) & (smooth[1:-1] >= smooth[2:]))
                if len(at) < N_PEAKS:
                    continue
                height = smooth[at]
                codes.append(_codes(height))
                starts.append(n_peaks + np.arange(len(codes[-1])))
                spread = float(np.nanstd(smooth))
                constant = (np.full(len(at), each) for each in (number, spread, period_s))
                of_run, of_spread, of_period = constant
                parts.append((of_run.astype(int), stream.time_s[at], height, of_spread, of_period))
                n_peaks += len(at)
    if not parts:
        nothing = np.empty(0)
        return np.empty(0, np.int64), np.empty(0, int), Peaks(*[nothing] * 5)
    peaks = Peaks(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    return np.concatenate(codes), np.concatenate(starts), peaks


def _low_pass(values: Array, std_samples: float) -> Array:
    """Return values (n,) behind a Gaussian filter; NaN where one is near, and at both ends."""
    values = np.where(np.abs(values) <= MAX_MAGNITUDE, values, np.nan)
    half = min(int(np.ceil(3.0 * std_samples)), (len(values) - 1) // 2)
    if std_samples < 0.5 or half < 1:
        return values
    weights = np.exp(-0.5 * (np.arange(-half, half + 1) / std_samples) ** 2)
    smooth = np.convolve(values, weights / weights.sum(), mode="same")
    smooth[:half] = smooth[len(smooth) - half :] = np.nan
    return smooth


def _codes(height: Array) -> Array:
    """Return the fingerprint (n - N_PEAKS + 1,) that begins with each peak of a channel."""
    n = len(height) - N_PEAKS + 1
    codes = np.zeros(n, dtype=np.int64)
    for lag in LAGS:
        higher = (height[:-lag] < height[lag:]).astype(np.int64)
        for i in range(N_PEAKS - lag):
            codes <<= 1
            codes |= higher[i : i + n]
    return codes


def scaled_heights(height: Array, spread: Array) -> tuple[Array, Array]:
    """Return heights (m, N_PEAKS) less their mean over their norm, and where (m,) they vary enough."""
    centred = height - height.mean(axis=1, keepdims=True)
    norm = np.sqrt(np.einsum("ij,ij->i", centred, centred))
    varies = norm > MIN_SPREAD_RATIO * spread * np.sqrt(N_PEAKS)
    varies &= norm > 1e-9 * np.abs(height).max(axis=1)  # rounding
    steps = np.diff(np.sort(centred, axis=1), axis=1)
    varies &= 1 + (steps > 1e-6 * norm[:, None]).sum(axis=1) >= MIN_LEVELS
    return centred / np.where(norm > 0.0, norm, 1.0)[:, None], varies


def samples_digest(run: RunLog) -> bytes:
    """Return what identifies the samples of the fastest measured stream; empty where they may repeat."""
    measured = measured_streams(run)
    if not measured:
        return b""
    stream, places = max(measured, key=lambda each: each[0].rate_hz)
    with np.errstate(over="ignore"):
        values = stream.values[:, places].astype(np.float32)
    if max(len(np.unique(column)) for column in values.T) < min(MIN_DISTINCT, len(values)):
        return b""
    return hashlib.blake2b(np.ascontiguousarray(values + np.float32(0.0)).tobytes()).digest()


class RunPrint(NamedTuple):
    """What of a run shows whether another one may hold a stretch of it.

    Parameters
    ----------
    codes, time_s : (n,) fingerprints of peaks whose heights vary, and the times of their first peaks
    digest : of the fastest stream; empty where its samples may repeat
    """

    codes: Array
    time_s: Array
    digest: bytes


def run_print(run: RunLog) -> RunPrint:
    """Return the fingerprints of a run."""
    codes, start, peaks = fingerprints([run])
    if len(codes):
        varies = scaled_heights(peaks.height[start[:, None] + np.arange(N_PEAKS)], peaks.spread[start])[1]
        codes, start = codes[varies], start[varies]
    return RunPrint(codes, peaks.time_s[start], samples_digest(run))


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


PART_GAP_S = 1.0
"""Between two parts of a merged run; far longer than the gaps that a window may have."""

LABEL_MARGIN_S = 2.0
"""Labels are compared this far inside of a stretch, whose ends are known to a second."""

MAX_SHOWN = 3
"""Pairs that a refusal names."""

Part = tuple[RunLog, float, float]
"""A run, and start and end of what is kept of it."""


class DistinctRuns(NamedTuple):
    """Runs of which no two hold the same measurements, and the ids of those that were merged."""

    runs: list[RunLog]
    merged: tuple[tuple[str, ...], ...] = ()


def distinct_runs(runs: Sequence[RunLog], *, merge: bool) -> DistinctRuns:
    """Return runs of which no two hold the same measurements.

    Parameters
    ----------
    runs : of one data set
    merge : make one run of those that share a stretch, which then counts once; else they are refused

    Raises
    ------
    DataError
        if runs share a stretch and are not to be merged, or label it differently.
    """
    found = shared_stretches(runs)
    if not found:
        return DistinctRuns(list(runs))
    refuse_other_labels(runs, found)
    if not merge:
        raise DataError(
            f"{'; '.join(sentences(found))}: held out, they would be recognised and not classified; remove "
            "one of them, or use --merge-duplicates to treat them as one run"
        )
    return DistinctRuns(merge_runs(runs, found), groups_of(found))


def sentences(found: Sequence[SharedStretch]) -> list[str]:
    """Return what the shared stretches are, in words; beyond the first ones their number.

    Examples
    --------
    >>> sentences([SharedStretch("a", "b", 0.0, 9.0, 100.0, 109.0)])
    ['runs a and b hold the same measurements for 9.0 s (from 0.0 s of a and 100.0 s of b)']
    """
    shown = [
        f"runs {each.first} and {each.second} hold the same measurements for {each.duration_s:.1f} s "
        f"(from {each.first_start_s:.1f} s of {each.first} and {each.second_start_s:.1f} s of {each.second})"
        for each in found[:MAX_SHOWN]
    ]
    if len(found) > MAX_SHOWN:
        shown.append(f"and so do {len(found) - MAX_SHOWN} more pairs of runs")
    return shown


def merge_runs(runs: Sequence[RunLog], stretches: Sequence[SharedStretch]) -> list[RunLog]:
    """Return runs of which no two share a stretch.

    Of the runs of a group, the first with labels is kept whole; what others hold besides follows it, on its
    clock, with gaps.  A merged run bears the id of the run that was kept whole; what a gap touches is in no
    window.

    Parameters
    ----------
    runs : with ids of their own
    stretches : that they share, as :func:`~terrain.logs.duplicates.shared_stretches` finds them

    Raises
    ------
    DataError
        if two runs label a stretch differently, or the rest of a run has other channels.

    Examples
    --------
    >>> imu = Stream(np.arange(4.0), np.ones((4, 1)), ("gyro_z_radps",))
    >>> a, b = (RunLog(name, "husky", {"imu": imu}, ((0.0, 4.0, "ice"),)) for name in "ab")
    >>> [run.run_id for run in merge_runs([a, b], [SharedStretch("a", "b", 0.0, 3.0, 0.0, 3.0)])]
    ['a']
    """
    refuse_other_labels(runs, stretches)
    by_id = {run.run_id: run for run in runs}
    merged: dict[str, RunLog] = {}
    absorbed: set[str] = set()
    for group in groups_of(stretches):
        in_order = [run for run in runs if run.run_id in group]
        members = sorted(in_order, key=lambda run: not run.labels)  # stable: labelled runs first
        first = members[0]
        parts: list[Part] = []
        for number, run in enumerate(members[1:], 1):
            before = {earlier.run_id for earlier in members[:number]}
            taken = [
                stretch.of(run.run_id)
                for stretch in stretches
                if run.run_id in (stretch.first, stretch.second)
                and (stretch.first in before or stretch.second in before)
            ]
            parts += [(run, *span) for span in _complement(run, taken)]
        merged[first.run_id] = _join(first, parts)
        absorbed |= set(group) - {first.run_id}
    return [merged.get(run_id, run) for run_id, run in by_id.items() if run_id not in absorbed]


def refuse_other_labels(runs: Sequence[RunLog], stretches: Sequence[SharedStretch]) -> None:
    """Refuse runs that hold the same measurements under different labels."""
    by_id = {run.run_id: run for run in runs}
    for stretch in stretches:
        first, second = (
            _terrains(by_id[name], *stretch.of(name)) for name in (stretch.first, stretch.second)
        )
        if first and second and first != second:
            raise DataError(
                f"runs {stretch.first} and {stretch.second} hold the same measurements under the labels "
                f"{' and '.join(first)} and {' and '.join(second)}: correct one, or remove a run"
            )


def _terrains(run: RunLog, start_s: float, end_s: float) -> tuple[str, ...]:
    """Return the labels inside of a stretch."""
    margin_s = min(LABEL_MARGIN_S, (end_s - start_s) / 4)
    inside = [
        label.terrain
        for label in run.labels
        if label.start_s < end_s - margin_s and label.end_s > start_s + margin_s
    ]
    return tuple(dict.fromkeys(inside))


def _complement(run: RunLog, taken: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the spans of a run outside of some stretches."""
    spans, at_s = [], min(float(stream.time_s[0]) for stream in run.streams.values())
    end_s = max(float(stream.time_s[-1]) for stream in run.streams.values())
    for start_s, stop_s in sorted(taken):
        if start_s - at_s > PART_GAP_S:
            spans.append((at_s, start_s))
        at_s = max(at_s, stop_s)
    if end_s - at_s > PART_GAP_S:
        spans.append((at_s, end_s + 1e-9))
    return spans


def _join(first: RunLog, parts: Sequence[Part]) -> RunLog:
    """Return a run followed by parts of others."""
    if not parts:
        return first
    times_s = {name: [stream.time_s] for name, stream in first.streams.items()}
    values = {name: [stream.values] for name, stream in first.streams.items()}
    labels = list(first.labels)
    end_s = max(float(stream.time_s[-1]) for stream in first.streams.values())
    for run, start_s, stop_s in parts:
        shift_s = end_s + PART_GAP_S - start_s
        for name, stream in first.streams.items():
            other = run.streams.get(name)
            if other is None or set(other.channels) != set(stream.channels):
                raise DataError(
                    f"runs {first.run_id} and {run.run_id} hold the same measurements, but not the same "
                    f"channels of stream {name!r}: remove one of the runs"
                )
            inside = (other.time_s >= start_s) & (other.time_s < stop_s)
            order = [other.channels.index(channel) for channel in stream.channels]
            times_s[name].append(other.time_s[inside] + shift_s)
            values[name].append(other.values[inside][:, order])
        labels += [
            Label(max(each.start_s, start_s) + shift_s, min(each.end_s, stop_s) + shift_s, each.terrain)
            for each in run.labels
            if each.start_s < stop_s and each.end_s > start_s
        ]
        end_s = shift_s + stop_s
    streams = {
        name: Stream(np.concatenate(times_s[name]), np.concatenate(values[name]), stream.channels)
        for name, stream in first.streams.items()
    }
    return RunLog(
        first.run_id, first.robot, streams, tuple(labels), first.source, first.dropped, first.session,
        first.filter,
    )  # fmt: skip
