"""Windows of equal length over streams of different rates.

A window of length ``L`` that starts at ``t0`` holds, of each stream, the first ``floor(L rate)`` samples
at or after ``t0``.  Each stream keeps its own rate, and a window holds the samples as they were measured, but where a
few are missing, lost or NaN, which are interpolated (:func:`max_missing`), and where a model takes windows of another
rate than a log's: these are cut at the log's rate and resampled one by one (:func:`at_rates`).  :func:`cut_at` is the
one place where samples are cut; whole logs, the papers' partitions and the sample-by-sample form of
:mod:`features.stream` all go through it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from terrain.errors import ConfigError, DataError
from terrain.logs.samples import refuse_implausible, usable
from terrain.logs.schema import SIGNAL_SETS, signal_set_of
from terrain.logs.schema import TIME_TOLERANCE_S as TIME_TOLERANCE_S
from terrain.records import WINDOW_COLUMNS, Array, RunLog, Stream, Windows
from terrain.signals import resampled

#: Runs whose rates differ by more than this cannot share windows of one length. The clocks of real loggers differ by
#: up to 4 % (lengths of the two files of a BorealTC run), which alignment turns into rates.
MAX_RATE_DEVIATION = 0.05
#: Streams whose NaN is a value (slip is undefined at a standstill) and drops no window.
NAN_TOLERANT_STREAMS = ("slip",)
#: Of a sample, by which a window may fall short of its last one. Loggers hold a whole or a half number of samples in a
#: window at their nominal rate; the rate that is measured of a set of runs lies a little beside it, on either side,
#: and windows of two sets must hold the same number.
RATE_SLACK = 0.1
#: A window whose samples span this much more or less time than they should, and one period, was not sampled at the
#: rate it is read with: a slow or a fast stretch of a logger, or a live stream set to another rate.
SPAN_TOLERANCE = 0.1
#: A longer step between two samples, in sample periods, is a gap: lets jitter through and catches one lost sample.
MAX_GAP_PERIODS = 1.8
DROP_REASONS = ("gap", "wrong rate", "not finite", "not moving", "not steady")
INTERPOLATED = "missing values interpolated"


def max_missing(n_samples: int) -> int:
    """Return how many of the samples of a window may miss in a channel, and are interpolated: ``sqrt(n) / 2``.

    White noise that is interpolated in single places has half of its variance there, so that of m missing ones of n
    its deviation falls by m / 4n, for so few by less than a fifth of what it scatters by chance, ``1 / sqrt(2 n)``.

    Examples
    --------
    >>> [max_missing(n) for n in (13, 100, 200)]
    [1, 5, 7]
    """
    return int(0.5 * np.sqrt(n_samples))


def lost_times(before_s: float, after_s: float, period_s: float, most: int) -> list[float]:
    """Return the times of samples that were lost between two; none where the step is no gap, or more were lost.

    Examples
    --------
    >>> lost_times(1.0, 1.3, 0.1, 2), lost_times(1.0, 1.4, 0.1, 2), lost_times(1.0, 1.1, 0.1, 2)
    ([1.1, 1.2], [], [])
    """
    step_s = after_s - before_s
    if not MAX_GAP_PERIODS * period_s < step_s < (most + 1.5) * period_s:
        return []
    n = round(step_s / period_s)
    return [before_s + step_s * i / n for i in range(1, n)]


def with_lost(time_s: Array, values: Array, period_s: float, most: int) -> tuple[Array, Array]:
    """Return samples with rows of NaN for those that were lost one by one, or few in a row."""
    gaps = np.flatnonzero(np.diff(time_s) > MAX_GAP_PERIODS * period_s)
    lost = [lost_times(float(time_s[i]), float(time_s[i + 1]), period_s, most) for i in gaps]
    at = np.repeat(gaps + 1, [len(each) for each in lost])
    if not len(at):
        return time_s, values
    return np.insert(time_s, at, np.concatenate(lost)), np.insert(values, at, np.nan, axis=0)


@dataclass(frozen=True, slots=True)
class SteadyMotion:
    """When a window counts as steady motion (thesis 8.1 requires it without numbers: both are assumed)."""

    min_speed_mps: float = 0.03  #: the mean speed of the faster wheel must reach this
    #: the mean speeds of a wheel in the two halves of the window may differ by at most this acceleration times half
    #: the length; means, because single wheel readings are noisy
    max_accel_mps2: float = 0.25


@dataclass(frozen=True, slots=True)
class WindowRule:
    """How runs are cut; ``ConfigError`` where a number is not positive and finite."""

    length_s: float = 2.0  #: length of a window (thesis 8.1: 2 s)
    stride_s: float | None = None  #: from start to start; ``None`` means one length, that is no overlap
    #: the rule of steady motion, ``None`` to keep every window
    steady: SteadyMotion | None = field(default_factory=SteadyMotion)

    def __post_init__(self) -> None:
        for name in ("length_s", "stride_s"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ConfigError(f"window {name} is {value}; it must be positive and finite")

    @property
    def step_s(self) -> float:
        """Distance from one start to the next."""
        return self.length_s if self.stride_s is None else self.stride_s

    @property
    def overlap(self) -> int:
        """How many windows on either side of a window may share samples with it; at least its neighbour."""
        return int(np.ceil(self.length_s / self.step_s))


@dataclass(frozen=True, slots=True, eq=False)
class WindowCut:
    """Windows, and how many were dropped for which reason (:data:`DROP_REASONS`)."""

    windows: Windows
    dropped: Mapping[str, int]
    resampled: Mapping[str, int] = field(default_factory=dict)  #: number of runs, by a sentence
    filled: Mapping[str, int] = field(default_factory=dict)  #: number of values, as :data:`INTERPOLATED`


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """What every run of a data set must bring: channels and rate of each stream that features use.

    ``least_hz`` is the lowest rate from which windows of a stream are resampled to its rate; without it, a run must
    have that rate.
    """

    channels: Mapping[str, tuple[str, ...]]
    rate_hz: Mapping[str, float]
    least_hz: Mapping[str, float] = field(default_factory=dict)

    def n_samples(self, stream: str, length_s: float) -> int:
        """Return how many samples of a stream a window holds; ``DataError`` when fewer than four."""
        n = int(np.floor(length_s * self.rate_hz[stream] + RATE_SLACK))
        if n < 4:
            raise DataError(
                f"a window of {length_s:g} s holds {n} samples of stream {stream!r} at "
                f"{self.rate_hz[stream]:.4g} Hz; at least 4 are needed"
            )
        return n

    def cut_hz(self, stream: str, rate_hz: float) -> float:
        """Return the rate at which a stream of some rate is cut: that of its windows, or its own, to two digits.

        ``DataError`` where it is another one that windows are not resampled from.
        """
        expected_hz, least_hz = self.rate_hz[stream], self.least_hz.get(stream)
        if abs(rate_hz / expected_hz - 1) <= MAX_RATE_DEVIATION:
            return expected_hz
        if least_hz is None:
            raise DataError(
                f"stream {stream!r} runs at {rate_hz:.4g} Hz where {expected_hz:.4g} Hz is expected (within "
                f"{MAX_RATE_DEVIATION:.0%})"
            )
        own_hz = float(f"{rate_hz:.2g}")
        if not (1 - MAX_RATE_DEVIATION) * least_hz <= own_hz < np.inf:
            raise DataError(
                f"stream {stream!r} runs at {rate_hz:.4g} Hz; the model, of windows at {expected_hz:.4g} Hz, needs "
                f"at least {least_hz:.4g} Hz; one that is trained with --rate {stream}={own_hz:g} takes it"
            )
        return own_hz

    def resampled_from(self, own: Layout) -> tuple[str, ...]:
        """Return in a sentence each stream whose windows are resampled from rates at which they are cut."""
        return tuple(
            f"{name} resampled from {own_hz:.4g} to {self.rate_hz[name]:.4g} Hz"
            for name, own_hz in own.rate_hz.items()
            if own_hz != self.rate_hz[name]
        )


def rows_of(channels: Sequence[str], quantity: str) -> list[int]:
    """Return the positions of the channels of one quantity.

    Examples
    --------
    >>> rows_of(("gyro_x_radps", "accel_x_mps2", "gyro_y_radps"), "gyro")
    [0, 2]
    """
    return [i for i, channel in enumerate(channels) if channel.partition("_")[0] == quantity]


def left_right(channels: Sequence[str], quantity: str) -> tuple[int, int] | None:
    """Return the positions of the left and the right channel of a quantity, None without such a pair."""
    side = {channel.split("_")[1]: i for i, channel in enumerate(channels) if channel.startswith(quantity)}
    return (side["left"], side["right"]) if {"left", "right"} <= set(side) else None


@lru_cache(maxsize=1024)
def rows_of_sets(stream: str, channels: tuple[str, ...], sets: frozenset[str]) -> tuple[int, ...]:
    """Return which channels of a stream belong to some signal sets; all runs of a data set ask for the same."""
    return tuple(i for i, channel in enumerate(channels) if signal_set_of(stream, channel) in sets)


def wheel_stream(channels: Mapping[str, Sequence[str]]) -> str | None:
    """Return the stream that measures wheel speeds; None where none does, so that there is no motion."""
    wheels = frozenset({"wheels"})
    return next((name for name, names in channels.items() if rows_of_sets(name, tuple(names), wheels)), None)


def wheel_speeds(values: Mapping[str, Array], channels: Mapping[str, tuple[str, ...]]) -> Array:
    """Return the wheel speeds (n_windows, wheels, samples) in m/s; ``DataError`` where there is none."""
    stream = wheel_stream(channels)
    if stream is None:
        raise DataError("steady motion cannot be judged without wheel speeds; switch the rule off")
    return values[stream][:, list(rows_of_sets(stream, tuple(channels[stream]), frozenset({"wheels"})))]


def layout_of(
    runs: Sequence[RunLog],
    signal_sets: Iterable[str] = SIGNAL_SETS,
    *,
    speeds: bool = True,
    rate_hz: Mapping[str, float] | None = None,
) -> Layout:
    """Return the streams, channels and rates that all runs have in common.

    Only channels of the chosen signal sets count, and wheel speeds besides where ``speeds`` says that the
    rule of steady motion needs them: what is not used cannot drop a window.  The rate is the median over
    runs; that of streams with a ``rate_hz`` of their own, from which windows are resampled, may be higher.

    Raises
    ------
    DataError
        if there is no run, a run lacks a channel that others have, or its rate differs by over 5 %.
    ConfigError
        if a rate is given of a stream that is not used.
    """
    if not runs:
        raise DataError("there is no run to cut windows from")
    desired_sets = frozenset({*signal_sets, *(("wheels",) if speeds else ())})

    channels: dict[str, tuple[str, ...]] = {}
    rates_hz, lower_hz = dict[str, float](), dict(rate_hz or {})
    used = [
        {
            name: tuple(stream.channels[i] for i in rows)
            for name, stream in run.streams.items()
            if (rows := rows_of_sets(name, tuple(stream.channels), desired_sets))
        }
        for run in runs
    ]
    for name in dict.fromkeys(name for each in used for name in each):
        for run in runs:
            if name not in run.streams:
                raise DataError(f"run {run.run_id} has no stream {name!r}, which other runs have")
        channels[name] = used[0].get(name, ())
        for run, own in zip(runs, used, strict=True):
            if differing := sorted(set(own.get(name, ())) ^ set(channels[name])):
                raise DataError(
                    f"run {run.run_id}, stream {name!r}: channel {differing[0]!r} is not in all runs"
                )
        rates_hz[name] = lower_hz.get(name, float(np.median([run.streams[name].rate_hz for run in runs])))
    if unused := sorted(set(lower_hz) - set(channels)):
        raise ConfigError(f"a rate is given of stream {unused[0]!r}; {', '.join(channels)} are used")
    layout = Layout(channels, rates_hz, lower_hz)
    for run in runs:
        check_layout(run, layout)
    if not channels:
        raise DataError(f"run {runs[0].run_id} has no channel that features are made of")
    return layout


def shared_layout(own: Layout, other: Layout) -> Layout:
    """Return the streams and channels that two layouts have in common, at the rates of the first."""
    channels = {
        stream: both
        for stream, names in own.channels.items()
        if (both := tuple(name for name in names if name in other.channels.get(stream, ())))
    }
    if not channels:
        raise DataError("simulated and measured runs have no channel in common")
    return Layout(channels, {stream: own.rate_hz[stream] for stream in channels})


def check_layout(run: RunLog, layout: Layout) -> Layout:
    """Return the layout at whose rates a run is cut; ``DataError`` when it lacks a stream, a channel or the rate."""
    rate_hz = {}
    for name, channels in layout.channels.items():
        if name not in run.streams:
            raise DataError(f"run {run.run_id} has no stream {name!r}, which is needed")
        stream = run.streams[name]
        missing = [channel for channel in channels if channel not in stream.channels]
        if missing:
            raise DataError(f"run {run.run_id}, stream {name!r}: channel {missing[0]!r} is missing")
        try:
            rate_hz[name] = layout.cut_hz(name, stream.rate_hz)
        except DataError as error:
            raise DataError(f"run {run.run_id}, {error}") from None
    return Layout(layout.channels, rate_hz)


def at_rates(values: Mapping[str, Array], own: Layout, layout: Layout, length_s: float) -> dict[str, Array]:
    """Return windows that were cut at a log's rates at those of a layout; each by itself, so that live equals batch."""
    return {
        name: each
        if own.rate_hz[name] == layout.rate_hz[name]
        else resampled(each, own.rate_hz[name], layout.n_samples(name, length_s), layout.rate_hz[name])
        for name, each in values.items()
    }


def cut_at(
    streams: Mapping[str, Stream], starts_s: Array, rule: WindowRule, layout: Layout
) -> tuple[dict[str, Array], Array, Array]:
    """Cut one run's streams, with rows of what was lost, at the starts (k,) of windows; the rule's stride is not used.

    Returns
    -------
    values : per stream ``(k, channels, samples)``; rows of windows that are not kept hold anything
    reason : (k,) of str: ``""`` where the window is kept, a :data:`DROP_REASONS` where it is dropped,
        ``"incomplete"`` where a stream ends before the window does
    filled : (k,) number of values that were missing and are interpolated
    """
    reason, filled = np.full(len(starts_s), "", dtype="<U10"), np.zeros(len(starts_s), dtype=int)
    values: dict[str, Array] = {}
    for name, channels in layout.channels.items():
        stream = streams[name]
        n = layout.n_samples(name, rule.length_s)
        period_s = 1 / layout.rate_hz[name]
        limit_s = MAX_GAP_PERIODS / layout.rate_hz[name]
        first = np.searchsorted(stream.time_s, starts_s - TIME_TOLERANCE_S)
        complete = first + n <= len(stream)
        first = np.where(complete, first, 0)
        if len(stream) < n:
            values[name] = np.zeros((len(starts_s), len(channels), n))
            reason[:] = "incomplete"
            continue
        samples = stream.values[:, [stream.channels.index(channel) for channel in channels]]
        gaps_before = np.concatenate(([0], np.cumsum(np.diff(stream.time_s) > limit_s)))
        known = usable(samples, unknown_is_a_value=name in NAN_TOLERANT_STREAMS)
        missing_before = np.concatenate((np.zeros((1, len(channels)), dtype=int), np.cumsum(~known, axis=0)))
        first_s, last_s = stream.time_s[first], stream.time_s[first + n - 1]
        has_gap = (gaps_before[first + n - 1] > gaps_before[first]) | (first_s - starts_s > limit_s)
        off_rate = (
            np.abs(last_s - first_s - (n - 1) * period_s) > SPAN_TOLERANCE * (n - 1) * period_s + period_s
        )
        missing = missing_before[first + n] - missing_before[first]
        not_finite = (missing > max_missing(n)).any(axis=1)
        for why, faulty in (("gap", has_gap), ("wrong rate", off_rate), ("not finite", not_finite)):
            reason[(reason == "") & faulty] = why
        reason[~complete] = "incomplete"
        # Contiguous, so that numpy adds one window's samples in the same order as those of many.
        values[name] = np.ascontiguousarray(samples[first[:, None] + np.arange(n)].transpose(0, 2, 1))
        for i, c in np.argwhere((missing > 0) & (reason == "")[:, None]):
            there = known[first[i] : first[i] + n, c]
            at = np.arange(n)
            values[name][i, c, ~there] = np.interp(at[~there], at[there], values[name][i, c, there])
        filled += missing.sum(axis=1)
    if rule.steady is not None:
        candidate = reason == ""
        speeds = np.ascontiguousarray(wheel_speeds(values, layout.channels)[candidate])
        half = speeds.shape[2] // 2
        before, after = speeds[:, :, :half].mean(axis=2), speeds[:, :, -half:].mean(axis=2)
        moving = np.abs(speeds).mean(axis=2).max(axis=1) >= rule.steady.min_speed_mps
        even = np.abs(after - before).max(axis=1) <= rule.steady.max_accel_mps2 * rule.length_s / 2
        reason[candidate] = np.where(moving, np.where(even, "", "not steady"), "not moving")
    return values, reason, filled


def label_windows(run: RunLog, starts_s: Array, length_s: float) -> Array:
    """Return the terrain (k,) under each window, ``""`` where a label does not cover all of it."""
    terrain = np.full(len(starts_s), "", dtype=object)
    for label in run.labels:
        inside = (starts_s >= label.start_s - TIME_TOLERANCE_S) & (
            starts_s + length_s <= label.end_s + TIME_TOLERANCE_S
        )
        terrain[inside] = label.terrain
    return terrain


def regular_starts(start_s: float, end_s: float, length_s: float, step_s: float) -> Array:
    """Return the starts of all windows of ``length_s`` that fit between two times.

    Examples
    --------
    >>> regular_starts(0.0, 6.0, 2.0, 2.0)
    array([0., 2., 4.])
    """
    n = int(np.floor((end_s - start_s - length_s + TIME_TOLERANCE_S) / step_s)) + 1
    return start_s + step_s * np.arange(max(n, 0))


def span_of(run: RunLog, layout: Layout) -> tuple[float, float]:
    """Return first and last time at which all streams run, the period of the last sample included."""
    streams = [(run.streams[name], layout.rate_hz[name]) for name in layout.channels]
    return (
        float(max(stream.time_s[0] for stream, _ in streams)),
        float(min(stream.time_s[-1] + 1 / rate for stream, rate in streams)),
    )


def holds_a_window(run: RunLog, layout: Layout, length_s: float, *, skip_short: bool) -> bool:
    """Say whether a run is as long as a window; ``DataError`` for a shorter one unless those are skipped."""
    begin_s, end_s = span_of(run, layout)
    is_short = end_s - begin_s + TIME_TOLERANCE_S < length_s
    if is_short and not skip_short:
        raise DataError(
            f"run {run.run_id} lasts {max(end_s - begin_s, 0):.2f} s, shorter than a window of {length_s:g} s"
        )
    return not is_short


def cut_windows(
    runs: Sequence[RunLog],
    rule: WindowRule | None = None,
    *,
    layout: Layout | None = None,
    starts_s: Mapping[str, Array] | None = None,
    skip_short: bool = False,
) -> WindowCut:
    """Cut all runs into windows, run by run and in order of time, and count what was dropped.

    A window whose samples lie under two labels keeps ``terrain == ""`` and is no sample for training.

    Parameters
    ----------
    rule : how to cut; 2 s without overlap in steady motion by default
    layout : channels and rates to expect; what the runs have in common by default
    starts_s : starts by run id, where they are not the regular ones of ``rule``
    skip_short : leave out runs that are shorter than a window instead of refusing them

    Raises
    ------
    DataError
        if a run lacks a channel, has a rate that windows are not resampled from or an implausible value, or is
        shorter than a window.

    Examples
    --------
    >>> from terrain.records import Stream, RunLog
    >>> time = np.arange(0, 5, 0.1)
    >>> wheels = Stream(time, np.ones((50, 2)), ("speed_left_mps", "speed_right_mps"))
    >>> cut = cut_windows([RunLog("a", "husky", {"wheels": wheels}, ((0.0, 5.0, "grass"),))])
    >>> len(cut.windows), cut.windows.values["wheels"].shape, list(cut.windows.terrain)
    (2, (2, 2, 20), ['grass', 'grass'])
    """
    rule = WindowRule() if rule is None else rule
    layout = layout_of(runs) if layout is None else layout
    own_layouts = [check_layout(run, layout) for run in runs]
    fastest_s = 1 / max(layout.rate_hz.values())
    if starts_s is None and rule.step_s < (1 - MAX_RATE_DEVIATION) * fastest_s:
        raise ConfigError(
            f"window stride_s is {rule.step_s:g}; at least the shortest sample period, {fastest_s:g} s, "
            "is needed"
        )

    def windows(values: dict[str, Array], at: Array, run_id: str, terrain: Array, session: str) -> Windows:
        names, of = (np.full(len(at), text, dtype=object) for text in (run_id, session))
        return Windows(values, layout.channels, layout.rate_hz, rule.length_s, at, names, terrain, of)

    n_samples = {name: layout.n_samples(name, rule.length_s) for name in layout.channels}
    nothing = {name: np.empty((0, len(names), n_samples[name])) for name, names in layout.channels.items()}
    parts = [windows(nothing, np.empty(0), "", np.empty(0, dtype=object), "")]
    dropped, changed, filled = Counter[str](), Counter[str](), 0
    for run, own in zip(runs, own_layouts, strict=True):
        refuse_implausible(run, layout.channels)
        if not holds_a_window(run, own, rule.length_s, skip_short=skip_short):
            dropped["run too short"] += 1
            continue
        if starts_s is None:
            at = regular_starts(*span_of(run, own), rule.length_s, rule.step_s)
        else:
            at = np.asarray(starts_s.get(run.run_id, ()), dtype=float)
        streams = {}
        for name, channels in layout.channels.items():
            stream, most = run.streams[name], max_missing(own.n_samples(name, rule.length_s))
            complete = with_lost(stream.time_s, stream.columns(channels), 1 / own.rate_hz[name], most)
            streams[name] = Stream(*complete, channels)
        values, reason, interpolated = cut_at(streams, at, rule, own)
        filled += int(interpolated[reason == ""].sum())
        changed.update(layout.resampled_from(own))
        dropped.update(str(why) for why in reason if why not in ("", "incomplete"))
        kept, at = {name: array[reason == ""] for name, array in values.items()}, at[reason == ""]
        kept = at_rates(kept, own, layout, rule.length_s)
        parts.append(windows(kept, at, run.run_id, label_windows(run, at, rule.length_s), run.session))
    return WindowCut(
        join_windows(parts), dict(dropped), dict(changed), {INTERPOLATED: filled} if filled else {}
    )


def join_windows(parts: Sequence[Windows]) -> Windows:
    """Return the windows of all parts, at least one, which share channels, rates and length."""
    first = parts[0]
    return Windows(
        {name: np.concatenate([part.values[name] for part in parts]) for name in first.values},
        first.channels,
        first.rate_hz,
        first.length_s,
        *(np.concatenate([getattr(part, name) for part in parts]) for name in WINDOW_COLUMNS),
    )


def labelled(cut: WindowCut) -> WindowCut:
    """Keep the windows that lie under one label; the others are counted as ``no single label``.

    ``DataError`` where there is no window, or none with a label.
    """
    known = cut.windows.terrain != ""
    if not len(known):
        dropped = ", ".join(f"{n} {reason}" for reason, n in sorted(cut.dropped.items()))
        raise DataError(f"not one window is left: {dropped or 'no run is long enough'}")
    if not known.any():
        raise DataError("no window has a terrain label: nothing can be trained or tested")
    if known.all():
        return cut
    return replace(
        cut, windows=cut.windows[known], dropped={**cut.dropped, "no single label": int((~known).sum())}
    )


def windows_of(
    runs: Iterable[RunLog], length_s: float = 2.0, stride_s: float | None = None, *, steady: bool = True
) -> Windows:
    """Cut runs into windows of equal length; runs that are shorter are left out.

    Parameters
    ----------
    runs : whose channels and rates fit each other
    length_s, stride_s : of a window, and from start to start; one length by default
    steady : keep windows of steady motion only

    Raises
    ------
    DataError
        if no window is left, or runs do not fit each other.

    Examples
    --------
    >>> import terrain
    >>> terrain.cut_windows([terrain.simulate("husky", "grass", "straight", duration_s=8.0)])
    3 windows of 2 s from 1 runs: grass
    """
    rule = WindowRule(length_s, stride_s, SteadyMotion() if steady else None)
    found = cut_windows(list(runs), rule, skip_short=True)
    if not len(found.windows):
        dropped = ", ".join(f"{n} {why}" for why, n in found.dropped.items())
        raise DataError(
            f"no window of {length_s:g} s is left; dropped: {dropped or 'none, there are no runs'}"
        )
    return found.windows


def overlap_of(windows: Windows) -> int:
    """Return how many windows on either side of a window may share samples with it; at least its neighbour.

    Examples
    --------
    >>> run = np.array(["a"] * 3, dtype=object)
    >>> overlap_of(Windows({}, {}, {}, 2.0, np.array([0.0, 0.5, 1.0]), run, run))
    4
    """
    same = windows.run_id[1:] == windows.run_id[:-1]
    steps_s = np.diff(windows.start_s)[same]
    steps_s = steps_s[steps_s > 0]
    return int(np.ceil(windows.length_s / steps_s.min() - 1e-9)) if len(steps_s) else 1
