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
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from tempfile import TemporaryFile
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from terrain.errors import DataError
from terrain.logs.samples import MAX_MAGNITUDE
from terrain.logs.schema import signal_set_of
from terrain.records import Array, Label, RunLog, Stream

N_PEAKS = 16  #: Peaks of a fingerprint: 42 comparisons, of which some 30 are independent.
LAGS = (1, 2, 3)  #: A peak is compared with so many that follow it.
#: Standard deviation of the low-pass filter: some five peaks a second, whatever the sampling rate.
SMOOTHING_S = 0.04
#: Signal sets whose channels are measured; what a filter makes of them adds nothing.
MEASURED_SETS = ("imu", "wheels", "currents")
#: Heights that differ by less than this part of the channel's standard deviation are those of a periodic signal or of
#: noise in the last digit, which repeats from run to run.
MIN_SPREAD_RATIO = 0.1
#: Different heights of a stretch: channels that go back and forth between a few values repeat themselves.
MIN_LEVELS = 10

MIN_DISTINCT = 64  #: Values that a stream must have taken for its bytes to identify it.
#: Of the heights of two stretches whose order agrees already; copies rounded to a tenth of the standard deviation of
#: their channel are above 0.995.
MIN_CORRELATION = 0.99
#: Clocks of two copies may run at rates that differ by less than this; those of loggers differ by 4 %.
MAX_RATE_RATIO = 1.1
#: Fingerprints that must agree in their offset; three are one more peak each, not three times the time.
MIN_STRETCHES = 3
#: Equal fingerprints without their heights: 21 peaks of one channel, or fewer of several.  Of 10000 runs of noise of
#: one kind, some hundred pairs agree in so many by chance.
MIN_EQUAL = 6
#: Fingerprints of one overlap agree in their offset within this, and a tenth of the time between them.
OFFSET_TOLERANCE_S = 0.3

#: An overlap may lose its fingerprints for so long, as at a standstill, and is one overlap still.
MAX_HOLE_S = 15.0
#: An overlap that reaches so close to the end of a run reaches its end: the first peaks come later.
EDGE_S = 1.5
N_FILES = 32
#: 2^64 over the golden ratio: the first bits of a product with it are spread evenly (Knuth, The Art of Computer
#: Programming 3, section 6.4).
SPREADING = np.uint64(0x9E3779B97F4A7C15)
#: A fingerprint, the time of its first peak, and the run.
PRINT = np.dtype([("code", "<i8"), ("time_s", "<f8"), ("run", "<i4")])
#: A peak of a channel of a run; ``spread`` is that of the channel.
PEAK = np.dtype([("run", int), ("time_s", float), ("height", float), ("spread", float), ("period_s", float)])

PART_GAP_S = 1.0  #: Between two parts of a merged run; far longer than the gaps that a window may have.
LABEL_MARGIN_S = 2.0  #: Labels are compared this far inside of a stretch, whose ends are known to a second.
MAX_SHOWN = 3  #: Pairs that a refusal names.


def _measured(run: RunLog) -> list[tuple[Stream, list[int]]]:
    """Return the streams that were measured, with the places of the channels that features are made of."""
    streams = []
    for name, stream in run.streams.items():
        channels = enumerate(stream.channels)
        places = [i for i, channel in channels if signal_set_of(name, channel) in MEASURED_SETS]
        if places and len(stream) > 1:
            streams.append((stream, places))
    return streams


def _fingerprints(runs: Sequence[RunLog]) -> tuple[Array, Array, Array]:
    """Return the fingerprints (n,), the place (n,) of their first peak, and all peaks, as :data:`PEAK`."""
    codes, starts, peaks = [np.empty(0, np.int64)], [np.empty(0, int)], [np.empty(0, PEAK)]
    n_peaks = 0
    for number, run in enumerate(runs):
        for stream, place in ((stream, i) for stream, places in _measured(run) for i in places):
            values = stream.values[:, place]
            smooth = np.where(np.abs(values) <= MAX_MAGNITUDE, values, np.nan)
            width = SMOOTHING_S * stream.rate_hz
            half = min(int(np.ceil(3.0 * width)), (len(values) - 1) // 2)
            if width >= 0.5 and half >= 1:
                smooth = gaussian_filter1d(smooth, width, radius=half)
                smooth[:half] = smooth[len(smooth) - half :] = np.nan
            at = 1 + np.flatnonzero((smooth[1:-1] > smooth[:-2]) & (smooth[1:-1] >= smooth[2:]))
            n = len(at) - N_PEAKS + 1
            if n < 1:
                continue
            own = np.empty(len(at), PEAK)
            own["run"], own["time_s"], own["height"] = number, stream.time_s[at], smooth[at]
            own["spread"], own["period_s"] = np.nanstd(smooth), 1.0 / stream.rate_hz
            code = np.zeros(n, dtype=np.int64)
            for lag in LAGS:
                higher = (smooth[at[:-lag]] < smooth[at[lag:]]).astype(np.int64)
                for i in range(N_PEAKS - lag):
                    code = code << 1 | higher[i : i + n]
            codes.append(code)
            starts.append(n_peaks + np.arange(n))
            peaks.append(own)
            n_peaks += len(own)
    return np.concatenate(codes), np.concatenate(starts), np.concatenate(peaks)


def _scaled_heights(peaks: Array) -> tuple[Array, Array]:
    """Return heights of peaks (m, N_PEAKS) less their mean over their norm, and where (m,) they vary enough."""
    height, spread = peaks["height"], peaks["spread"][:, 0]
    centred = height - height.mean(axis=1, keepdims=True)
    norm = np.sqrt(np.einsum("ij,ij->i", centred, centred))
    varies = norm > MIN_SPREAD_RATIO * spread * np.sqrt(N_PEAKS)
    varies &= norm > 1e-9 * np.abs(height).max(axis=1)  # rounding
    steps = np.diff(np.sort(centred, axis=1), axis=1)
    varies &= 1 + (steps > 1e-6 * norm[:, None]).sum(axis=1) >= MIN_LEVELS
    return centred / np.where(norm > 0.0, norm, 1.0)[:, None], varies


def measured_digest(run: RunLog) -> bytes:
    """Return what identifies the samples of the fastest measured stream; empty where they may repeat.

    Neither names, labels nor estimates that were added change it.
    """
    stream, places = max(_measured(run), key=lambda each: each[0].rate_hz, default=(None, []))
    if stream is None:
        return b""
    with np.errstate(over="ignore"):
        values = stream.values[:, places].astype(np.float32)
    if max(len(np.unique(column)) for column in values.T) < min(MIN_DISTINCT, len(values)):
        return b""
    return hashlib.blake2b(np.ascontiguousarray(values + np.float32(0.0)).tobytes(), digest_size=16).digest()


def _same_digests(digests: Iterable[bytes]) -> list[tuple[int, int]]:
    """Return the places of the first and of each later one of equal digests."""
    seen: dict[bytes, int] = {}
    pairs = [(seen.setdefault(digest, i), i) for i, digest in enumerate(digests) if digest]
    return [(first, i) for first, i in pairs if first != i]


class RunPrint(NamedTuple):
    """What of a run shows whether another one may hold a stretch of it."""

    codes: Array  #: (n,) fingerprints of peaks whose heights vary, and the times of their first peaks
    time_s: Array
    digest: bytes  #: of the fastest stream; empty where its samples may repeat


def run_print(run: RunLog) -> RunPrint:
    """Return the fingerprints of a run."""
    codes, start, peaks = _fingerprints([run])
    varies = _scaled_heights(peaks[start[:, None] + np.arange(N_PEAKS)])[1]
    return RunPrint(codes[varies], peaks["time_s"][start[varies]], measured_digest(run))


def possible_pairs(prints: Iterable[RunPrint]) -> list[tuple[int, int]]:
    """Return the pairs of runs, by their places, that may share a stretch; :func:`shared_stretches` decides.

    They have enough equal fingerprints near one offset of their clocks, or equal digests.  Fingerprints wait in files
    by their value, of which one is read at a time: memory does not grow with the runs.

    Examples
    --------
    >>> codes, time_s = np.arange(9), np.arange(9.0)
    >>> possible_pairs([RunPrint(codes, time_s, b""), RunPrint(codes[1:], 50.0 + time_s[1:], b"")])
    [(0, 1)]
    """
    digests: list[bytes] = []
    matches = []
    with ExitStack() as stack:
        files = [stack.enter_context(TemporaryFile()) for _ in range(N_FILES)]
        for run, each in enumerate(prints):
            records = np.empty(len(each.codes), PRINT)
            records["code"], records["time_s"], records["run"] = each.codes, each.time_s, run
            digests.append(each.digest)
            number = (each.codes.astype(np.uint64) * SPREADING) // np.uint64(2**64 // N_FILES)
            for i in np.unique(number).tolist():
                files[i].write(records[number == i].tobytes())
        for file in files:
            file.seek(0)
            records = np.frombuffer(file.read(), PRINT)
            one, other = (records[at] for at in _equal(records["code"], records["run"]))
            matches.append((one["run"], other["run"], other["time_s"] - one["time_s"]))
    first, second, offset_s = map(np.concatenate, zip(*matches, strict=True))
    order = np.lexsort((offset_s, second, first))
    first, second, offset_s = first[order], second[order], offset_s[order]
    a, b = slice(None, 1 - MIN_EQUAL), slice(MIN_EQUAL - 1, None)
    near = offset_s[b] - offset_s[a] <= (MIN_EQUAL - 1) * (OFFSET_TOLERANCE_S + 0.1 * MAX_HOLE_S)
    near &= (first[a] == first[b]) & (second[a] == second[b])
    pairs = set(zip(first[a][near].tolist(), second[a][near].tolist(), strict=True))
    return sorted(pairs.union(_same_digests(digests)))


def _equal(codes: Array, run: Array) -> tuple[Array, Array]:
    """Return the places (m,) of equal codes that follow on one another, of two runs, the one before the other."""
    order = np.argsort(codes, kind="stable")
    one, other = order[:-1], order[1:]
    same = (codes[one] == codes[other]) & (run[one] != run[other])
    return one[same], other[same]


class SharedStretch(NamedTuple):
    """A stretch of one run that another run holds as well, each on its own clock; in the order of the runs."""

    first: str
    second: str
    first_start_s: float
    first_end_s: float
    second_start_s: float
    second_end_s: float

    def of(self, run_id: str) -> tuple[float, float]:
        """Return start and end of the stretch on the clock of one of the two runs."""
        return self[2:4] if run_id == self.first else self[4:]

    @property
    def duration_s(self) -> float:
        """Length of the stretch on the clock of the first run."""
        return self.first_end_s - self.first_start_s


def shared_stretches(runs: Sequence[RunLog]) -> tuple[SharedStretch, ...]:
    """Return the stretches that two of the runs have in common, in the order of the runs.

    Of more than two copies, each is found beside some other one, not beside all.

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
    codes, start, peaks = _fingerprints(runs)
    # where two runs have one fingerprint, and heights and times of its peaks agree
    a, b = (peaks[start[at][:, None] + np.arange(N_PEAKS)] for at in _equal(codes, peaks["run"][start]))
    (of_a, a_varies), (of_b, b_varies) = _scaled_heights(a), _scaled_heights(b)
    agree = a_varies & b_varies & (np.einsum("ij,ij->i", of_a, of_b) > MIN_CORRELATION)
    since_a, since_b = (each["time_s"] - each["time_s"][:, :1] for each in (a, b))
    rate = since_b[:, -1] / since_a[:, -1]  # times differ by an offset and a rate, within two samples
    off_s = np.abs(since_b - rate[:, None] * since_a).max(axis=1)
    agree &= off_s <= 2.0 * np.maximum(a["period_s"], b["period_s"])[:, 0]
    agree &= (rate < MAX_RATE_RATIO) & (rate > 1.0 / MAX_RATE_RATIO)
    a, b = a[agree], b[agree]
    pairs = np.column_stack([a["run"][:, 0], b["run"][:, 0]])
    times_s = np.column_stack([each["time_s"][:, i] for each in (a, b) for i in (0, -1)])
    order = np.lexsort((times_s[:, 0], pairs[:, 1], pairs[:, 0]))
    pairs, times_s = pairs[order], times_s[order]
    shared, known = [], set()
    for first, second in dict.fromkeys(map(tuple, pairs.tolist())):
        rows = times_s[(pairs == (first, second)).all(axis=1)]
        stretches = _stretches(rows, runs[first], runs[second])
        shared += stretches
        known |= {(first, second)} if stretches else set()
    for first, second in _same_digests(map(measured_digest, runs)):
        if (first, second) not in known:
            ids = runs[first].run_id, runs[second].run_id
            shared.append(SharedStretch(*ids, *_span(runs[first]), *_span(runs[second])))
    return tuple(sorted(shared))


def _stretches(rows: Array, first: RunLog, second: RunLog) -> list[SharedStretch]:
    """Join matches (m, 4) with one offset between two clocks, up to the end of a run that is near."""
    offset_s = rows[:, 2] - rows[:, 0]
    joined: list[list[int]] = []
    for number in range(len(rows)):
        for members in joined:
            apart_s = rows[number, 0] - rows[members[-1], 1]
            drift_s = OFFSET_TOLERANCE_S + 0.1 * max(apart_s, 0.0)
            if apart_s <= MAX_HOLE_S and abs(offset_s[number] - offset_s[members[-1]]) <= drift_s:
                members.append(number)
                break
        else:
            joined.append([number])
    stretches = []
    (begin_a, end_a), (begin_b, end_b) = _span(first), _span(second)
    for members in joined:
        if len(members) >= MIN_STRETCHES:
            start_a, _, start_b, _ = rows[members].min(axis=0).tolist()
            _, stop_a, _, stop_b = rows[members].max(axis=0).tolist()
            margins_s = min(start_a - begin_a, start_b - begin_b), min(end_a - stop_a, end_b - stop_b)
            before_s, after_s = (each if 0.0 < each <= EDGE_S else 0.0 for each in margins_s)
            own = start_a - before_s, stop_a + after_s, start_b - before_s, stop_b + after_s
            stretches.append(SharedStretch(first.run_id, second.run_id, *own))
    return stretches


def _span(run: RunLog) -> tuple[float, float]:
    """Return the first and the last time of what was measured."""
    streams = [stream for stream, _ in _measured(run)]
    return min(float(s.time_s[0]) for s in streams), max(float(s.time_s[-1]) for s in streams)


def distinct_runs(runs: Sequence[RunLog], *, merge: bool) -> tuple[list[RunLog], tuple[tuple[str, ...], ...]]:
    """Return runs of which no two hold the same measurements, and the ids of those that were merged.

    Raises
    ------
    DataError
        if runs share a stretch and are not to be merged, or label it differently.
    """
    stretches = shared_stretches(runs)
    if not stretches:
        return list(runs), ()
    merged = merge_runs(runs, stretches)
    if not merge:
        raise DataError(
            f"{'; '.join(sentences(stretches))}: held out, they would be recognised and not classified; remove "
            "one of them, or use --merge-duplicates to treat them as one run"
        )
    return merged, groups_of(stretches)


def sentences(stretches: Sequence[SharedStretch]) -> list[str]:
    """Return what the shared stretches are, in words; beyond the first ones their number.

    Examples
    --------
    >>> sentences([SharedStretch("a", "b", 0.0, 9.0, 100.0, 109.0)])
    ['runs a and b hold the same measurements for 9.0 s (from 0.0 s of a and 100.0 s of b)']
    """
    shown = [
        f"runs {each.first} and {each.second} hold the same measurements for {each.duration_s:.1f} s "
        f"(from {each.first_start_s:.1f} s of {each.first} and {each.second_start_s:.1f} s of {each.second})"
        for each in stretches[:MAX_SHOWN]
    ]
    if len(stretches) > MAX_SHOWN:
        shown.append(f"and so do {len(stretches) - MAX_SHOWN} more pairs of runs")
    return shown


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


def merge_runs(runs: Sequence[RunLog], stretches: Sequence[SharedStretch]) -> list[RunLog]:
    """Return runs of which no two share a stretch.

    Of the runs of a group, the first with labels is kept whole; what others hold besides follows it, on its
    clock, with gaps.  A merged run bears the id of the run that was kept whole; what a gap touches is in no
    window.

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
    merged = {run.run_id: run for run in runs}
    for stretch in stretches:
        labels_of = []
        for name in (stretch.first, stretch.second):
            start_s, stop_s = stretch.of(name)
            margin_s = min(LABEL_MARGIN_S, (stop_s - start_s) / 4)
            inside = [
                label.terrain
                for label in merged[name].labels
                if label.start_s < stop_s - margin_s and label.end_s > start_s + margin_s
            ]
            labels_of.append(list(dict.fromkeys(inside)))
        if all(labels_of) and labels_of[0] != labels_of[1]:
            raise DataError(
                f"runs {stretch.first} and {stretch.second} hold the same measurements under the labels "
                f"{' and '.join(labels_of[0])} and {' and '.join(labels_of[1])}: correct one, or remove a run"
            )
    for group in groups_of(stretches):
        members = [merged.pop(run.run_id) for run in runs if run.run_id in group]
        first, *others = sorted(members, key=lambda run: not run.labels)  # stable
        streams, labels, earlier = dict(first.streams), list(first.labels), {first.run_id}
        end_s = max(float(stream.time_s[-1]) for stream in streams.values())
        for run in others:
            taken = [each for each in stretches if run.run_id in each[:2] and earlier.intersection(each[:2])]
            earlier.add(run.run_id)
            at_s = min(float(stream.time_s[0]) for stream in run.streams.values())
            until_s = max(float(stream.time_s[-1]) for stream in run.streams.values()) + 1e-9
            for start_s, stop_s in [*sorted(each.of(run.run_id) for each in taken), (until_s, until_s)]:
                if start_s - at_s > PART_GAP_S:  # at_s to start_s is in no other run
                    end_s = _append(first.run_id, streams, labels, run, (at_s, start_s), end_s + PART_GAP_S)
                at_s = max(at_s, stop_s)
        merged[first.run_id] = replace(first, streams=streams, labels=tuple(labels))
    return [merged[run.run_id] for run in runs if run.run_id in merged]


def _append(
    name: str,
    streams: dict[str, Stream],
    labels: list[Label],
    run: RunLog,
    span_s: tuple[float, float],
    at_s: float,
) -> float:
    """Append a span of a run to the streams and labels of another, at a time; return the time of its end."""
    start_s, stop_s = span_s
    shift_s = at_s - start_s
    for stream_name, stream in streams.items():
        other = run.streams.get(stream_name)
        if other is None or set(other.channels) != set(stream.channels):
            raise DataError(
                f"runs {name} and {run.run_id} hold the same measurements, but not the same "
                f"channels of stream {stream_name!r}: remove one of the runs"
            )
        inside = (other.time_s >= start_s) & (other.time_s < stop_s)
        order = [other.channels.index(channel) for channel in stream.channels]
        time_s = np.concatenate([stream.time_s, other.time_s[inside] + shift_s])
        values = np.concatenate([stream.values, other.values[inside][:, order]])
        streams[stream_name] = Stream(time_s, values, stream.channels)
    labels += [
        Label(max(each.start_s, start_s) + shift_s, min(each.end_s, stop_s) + shift_s, each.terrain)
        for each in run.labels
        if each.start_s < stop_s and each.end_s > start_s
    ]
    return shift_s + stop_s
