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

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.logs.plausible import MAX_MAGNITUDE
from terrain.logs.schema import signal_set_of
from terrain.records import Array, RunLog, Stream

N_PEAKS = 16
"""Peaks of a fingerprint: 42 comparisons, of which some 30 are independent."""

LAGS = (1, 2, 3)
"""A peak is compared with so many that follow it."""

SMOOTHING_S = 0.04
"""Standard deviation of the low-pass filter: some five peaks a second, whatever the sampling rate."""

MEASURED_SETS = ("imu", "wheels", "currents")
"""Signal sets whose channels are measured; what a filter makes of them adds nothing."""

MIN_CORRELATION = 0.99
"""Of the heights of two stretches whose order agrees already; copies rounded to a tenth of the standard
deviation of their channel are above 0.995."""

MIN_SPREAD_RATIO = 0.1
"""Heights that differ by less than this part of the channel's standard deviation are those of a periodic
signal or of noise in the last digit, which repeats from run to run."""

MIN_LEVELS = 10
"""Different heights of a stretch: channels that go back and forth between a few values repeat themselves."""

MAX_RATE_RATIO = 1.1
"""Clocks of two copies may run at rates that differ by less than this; those of loggers differ by 4 %."""

MIN_STRETCHES = 3
"""Fingerprints that must agree in their offset; three are one more peak each, not three times the time."""

OFFSET_TOLERANCE_S = 0.3
"""Fingerprints of one overlap agree in their offset within this, and a tenth of the time between them."""

MAX_HOLE_S = 15.0
"""An overlap may lose its fingerprints for so long, as at a standstill, and is one overlap still."""

EDGE_S = 1.5
"""An overlap that reaches so close to the end of a run reaches its end: the first peaks come later."""

MIN_DISTINCT = 64
"""Values that a stream must have taken for its bytes to identify it."""


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


class _Peaks(NamedTuple):
    """Peaks of all channels of all runs, one after the other; ``spread`` is that of the channel."""

    run: Array
    time_s: Array
    height: Array
    spread: Array
    period_s: Array


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
        for (first, second), rows in _by_pair(_matches(*_fingerprints(runs))).items()
        for stretch in _stretches(rows, runs[first], runs[second])
    ]
    known = {(stretch.first, stretch.second) for stretch in found}
    found += [stretch for stretch in _same_bytes(runs) if (stretch.first, stretch.second) not in known]
    return tuple(sorted(found, key=lambda stretch: (stretch.first, stretch.second, stretch.first_start_s)))


def _measured(run: RunLog) -> list[tuple[Stream, list[int]]]:
    """Return the streams that were measured, with the places of the channels that features are made of."""
    chosen = []
    for name, stream in run.streams.items():
        places = [i for i, each in enumerate(stream.channels) if signal_set_of(name, each) in MEASURED_SETS]
        if places and len(stream) > 1:
            chosen.append((stream, places))
    return chosen


def _fingerprints(runs: Sequence[RunLog]) -> tuple[Array, Array, _Peaks]:
    """Return the fingerprints (n,), the place (n,) of their first peak, and all peaks."""
    parts: list[tuple[Array, ...]] = []
    codes: list[Array] = []
    starts: list[Array] = []
    n_peaks = 0
    for number, run in enumerate(runs):
        for stream, places in _measured(run):
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
        return np.empty(0, np.int64), np.empty(0, int), _Peaks(*[nothing] * 5)
    peaks = _Peaks(*(np.concatenate(column) for column in zip(*parts, strict=True)))
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


def _matches(codes: Array, start: Array, peaks: _Peaks) -> _Matches:
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
    scaled = []
    varies = np.ones(len(heights[0]), dtype=bool)
    for height, spread in zip(heights, spreads, strict=True):
        centred = height - height.mean(axis=1, keepdims=True)
        norm = np.sqrt(np.einsum("ij,ij->i", centred, centred))
        varies &= norm > MIN_SPREAD_RATIO * spread * np.sqrt(N_PEAKS)
        varies &= norm > 1e-9 * np.abs(height).max(axis=1)  # rounding
        steps = np.diff(np.sort(centred, axis=1), axis=1)
        varies &= 1 + (steps > 1e-6 * norm[:, None]).sum(axis=1) >= MIN_LEVELS
        scaled.append(centred / np.where(norm > 0.0, norm, 1.0)[:, None])
    return np.asarray(varies & (np.einsum("ij,ij->i", *scaled) > MIN_CORRELATION))


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
    return min(float(stream.time_s[0]) for stream, _ in _measured(run))


def _end_s(run: RunLog) -> float:
    return max(float(stream.time_s[-1]) for stream, _ in _measured(run))


def _same_bytes(runs: Sequence[RunLog]) -> list[SharedStretch]:
    """Return runs whose fastest measured stream is the same, however short it is."""
    seen: dict[bytes, RunLog] = {}
    found = []
    for run in runs:
        measured = _measured(run)
        if not measured:
            continue
        stream, places = max(measured, key=lambda each: each[0].rate_hz)
        with np.errstate(over="ignore"):
            values = stream.values[:, places].astype(np.float32)
        if max(len(np.unique(column)) for column in values.T) < min(MIN_DISTINCT, len(values)):
            continue
        digest = hashlib.blake2b(np.ascontiguousarray(values + np.float32(0.0)).tobytes()).digest()
        first = seen.setdefault(digest, run)
        if first is not run:
            found.append(
                SharedStretch(
                    first.run_id, run.run_id, _begin_s(first), _end_s(first), _begin_s(run), _end_s(run)
                )
            )
    return found


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
