"""The windows of :mod:`features.windows`, cut sample by sample while the robot drives.

:func:`~features.windows.cut_at` cuts here as well, on short buffers, so that a classifier gets live what it
would have got from the log.  The window ``k`` starts at ``s = start + k step``; it is cut as soon as every
stream reaches its end, which is the moment from which a log would hold it too.

A live chain does not stop for a bad sample: what cannot be used is dropped, counted and named, and a
stream that stops costs windows and no memory.

:class:`WindowFeed` takes readings as a robot's sensors give them, and the estimates of its filter.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from features.windows import (
    INTERPOLATED,
    MAX_GAP_PERIODS,
    TIME_TOLERANCE_S,
    Layout,
    WindowRule,
    at_rates,
    cut_at,
    lost_times,
    max_missing,
    wheel_speeds,
    with_lost,
)
from terrain.errors import ConfigError, DataError
from terrain.estimation.clocks import readable
from terrain.estimation.live import LiveEstimate, estimated_values
from terrain.kinematics.logged_wheels import wheel_speeds_from
from terrain.records import Array, Reading, Stream, Windows
from terrain.robots import Robot

#: A stream that lags further behind the others has stopped: longer than a logger takes to write its buffer, shorter
#: than an operator waits.
PATIENCE_S = 5.0
#: Room of a buffer over what its nominal rate fills; a stream that overruns it loses its oldest samples.
BUFFER_MARGIN = 4
_MIN_BUFFER = 64


@dataclass
class _Buffer:
    """Accepted samples of one stream, oldest first, at most so many."""

    capacity: int
    n_channels: int
    time_s: list[float] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)
    first_s: float = math.nan
    last_s: float = math.nan
    suspect: tuple[float, Sequence[float] | Array] | None = None


class WindowStream:
    """Cut windows from samples as they arrive.

    Fed with the samples of a log in order of time, it returns the windows that
    :func:`~features.windows.cut_windows` cuts from that log with the same rule and layout, bit for bit,
    and counts the same drops; samples of different streams may arrive out of order by up to :data:`PATIENCE_S`.
    Streams that pause for longer may differ in the reason that is counted, and where
    one never comes back, windows that a log would not hold at all are counted as ``gap``.

    Where windows may be resampled, the rate of each stream is judged by its steps in the first window, as the log's is
    by all of its steps, and :attr:`resampled` says from which; at rates that are too low, all windows are dropped, by
    the sentence that says so.

    A stamp that is further ahead than that, like the first one of a stream, is held back until
    the next sample confirms it, so that one wrong stamp costs one sample and not the rest of the run.  A
    clock that starts again from an earlier time needs a new ``WindowStream``.

    Parameters
    ----------
    rule, layout : how to cut; streams, channels (in the order in which their values are pushed) and rates

    Attributes
    ----------
    dropped : windows dropped so far, by reason (:data:`~features.windows.DROP_REASONS`)
    dropped_samples : samples dropped so far, by stream and reason
    filled : values that were missing and are interpolated in the windows

    Examples
    --------
    >>> layout = Layout({"wheels": ("speed_left_mps",)}, {"wheels": 10.0})
    >>> stream = WindowStream(WindowRule(length_s=1.0), layout)
    >>> for i in range(25):
    ...     for windows in stream.push("wheels", i / 10, [0.5]):
    ...         print(i, windows.start_s, windows.values["wheels"].shape)
    9 [0.] (1, 1, 10)
    19 [1.] (1, 1, 10)
    >>> stream.push("wheels", 2.0, [0.5]), dict(stream.dropped_samples)
    ([], {('wheels', 'time goes back or repeats'): 1})
    """

    def __init__(self, rule: WindowRule, layout: Layout) -> None:
        longest_step_s = max(MAX_GAP_PERIODS / rate for rate in layout.rate_hz.values())
        if not longest_step_s < PATIENCE_S:
            raise ConfigError(
                f"a step of {longest_step_s:.3g} s is no gap; less than {PATIENCE_S:g} s is accepted"
            )
        self.rule = rule
        self.layout = layout
        self.dropped: Counter[str] = Counter()
        self.dropped_samples: Counter[tuple[str, str]] = Counter()
        self.filled = 0
        self._own, self._judged, self._refused = layout, not layout.least_hz, ""
        for name in layout.channels:  # too few are refused now and not at the first window
            layout.n_samples(name, rule.length_s)
        if rule.steady is not None:  # so is a rule that needs wheel speeds where there are none
            empty = {name: np.empty((0, len(names), 0)) for name, names in layout.channels.items()}
            wheel_speeds(empty, layout.channels)
        self._buffers = {
            name: _Buffer(self._capacity(layout.rate_hz[name]), len(channels))
            for name, channels in layout.channels.items()
        }
        self._start_s = math.nan  # of window 0, once every stream has begun
        self._next = 0  # number of the window that comes next
        self._due_s = dict.fromkeys(layout.channels, -math.inf)  # no sample before this can finish it

    @property
    def due_s(self) -> float:
        """No sample before this time can finish a window; minus infinity before all streams have begun."""
        return min(self._due_s.values())

    @property
    def resampled(self) -> tuple[str, ...]:
        """In a sentence, each stream whose windows are resampled."""
        return self.layout.resampled_from(self._own)

    def _capacity(self, rate_hz: float) -> int:
        span_s = self.rule.length_s + self.rule.step_s + PATIENCE_S
        return max(_MIN_BUFFER, math.ceil(BUFFER_MARGIN * span_s * rate_hz))

    def _take_rates(self) -> None:
        """Cut from now on at the rates that the first samples have, or drop all windows where these are too low."""
        self._judged, rate_hz = True, dict(self.layout.rate_hz)
        try:
            for name, buffer in self._buffers.items():
                if len(buffer.time_s) > 1:
                    step_s = float(np.median(np.diff(buffer.time_s)))
                    rate_hz[name] = self.layout.cut_hz(name, 1.0 / step_s)
                    buffer.capacity = self._capacity(rate_hz[name])
            own = Layout(self.layout.channels, rate_hz)
            for name in own.channels:
                own.n_samples(name, self.rule.length_s)
            self._own = own
            for name, buffer in self._buffers.items():
                if buffer.time_s:
                    samples = np.array(buffer.time_s), np.array(buffer.values)
                    time_s, values = with_lost(*samples, 1 / own.rate_hz[name], self._most(name))
                    buffer.time_s, buffer.values = time_s.tolist(), list(values)
        except DataError as error:
            self._refused = str(error)

    def push(self, stream: str, time_s: float, values: Sequence[float] | Array) -> list[Windows]:
        """Take one sample and return the windows that it completes, each a ``Windows`` of length 1.

        Values are one number a channel, in the order of the layout; NaN where one is missing.  A sample whose time is
        not finite, goes back or repeats is dropped and counted.

        Raises
        ------
        ConfigError
            if the layout has no such stream.
        ValueError
            if there are not as many values as channels.
        """
        buffer = self._buffers.get(stream)
        if buffer is None:
            known = ", ".join(self._buffers)
            raise ConfigError(f"there is no stream {stream!r} in the layout; it has {known}")
        if len(values) != buffer.n_channels:
            raise ValueError(
                f"stream {stream!r} has {buffer.n_channels} channels; the sample has {len(values)} values"
            )
        suspect = buffer.suspect
        if suspect is not None or not 0.0 < time_s - buffer.last_s <= PATIENCE_S:  # of NaN too
            # a first sample, one that jumps ahead, and the one after it: accept, hold back or drop
            time_s = float(time_s)
            if not math.isfinite(time_s):
                self.dropped_samples[stream, "time not finite"] += 1
                return []
            if time_s <= buffer.last_s or (suspect and time_s == suspect[0]):
                self.dropped_samples[stream, "time goes back or repeats"] += 1
                return []
            if suspect and not 0.0 < time_s - suspect[0] <= PATIENCE_S:
                self.dropped_samples[stream, "time jumps ahead"] += 1
                suspect = None
            is_confirmed = suspect is not None or time_s - buffer.last_s <= PATIENCE_S
            buffer.suspect = None if is_confirmed else (time_s, np.array(values, dtype=float))
            if not is_confirmed:
                return []
            if suspect is not None:
                self._append(stream, buffer, *suspect)
        self._append(stream, buffer, time_s, values)
        if suspect is not None and math.isnan(buffer.first_s):
            buffer.first_s = suspect[0]
            begun_s = [each.first_s for each in self._buffers.values()]
            if not any(map(math.isnan, begun_s)):
                self._start_s = max(begun_s)
                self._set_due()
        return self._advance() if time_s >= self._due_s[stream] else []

    def _most(self, stream: str) -> int:
        return max_missing(self._own.n_samples(stream, self.rule.length_s))

    def _append(self, stream: str, buffer: _Buffer, time_s: float, values: Sequence[float] | Array) -> None:
        if len(buffer.time_s) >= buffer.capacity:
            # remove what no window needs any more, and the oldest samples where that is not enough
            needed_from_s = self._start_s + self.rule.step_s * self._next
            if math.isnan(self._start_s):
                needed_from_s = max(b.last_s for b in self._buffers.values() if b.time_s) - PATIENCE_S
            n = bisect_left(buffer.time_s, needed_from_s - TIME_TOLERANCE_S)
            enough = buffer.capacity // BUFFER_MARGIN
            if n < enough:
                self.dropped_samples[stream, "faster than its rate"] += enough - n
                n = enough
            del buffer.time_s[:n], buffer.values[:n]
        if self._judged and time_s - buffer.last_s > MAX_GAP_PERIODS / self._own.rate_hz[stream]:
            period_s, most = 1 / self._own.rate_hz[stream], self._most(stream)
            for lost_s in lost_times(buffer.last_s, time_s, period_s, most):
                buffer.values.append(np.full(buffer.n_channels, np.nan))
                buffer.time_s.append(lost_s)
        buffer.values.append(np.array(values, dtype=float))
        buffer.time_s.append(time_s)
        buffer.last_s = time_s

    def _set_due(self) -> None:
        """Set the time before which no sample can finish the next window."""
        end_s = self._start_s + self.rule.step_s * self._next + self.rule.length_s - 2 * TIME_TOLERANCE_S
        self._due_s = {name: end_s - 1 / self._own.rate_hz[name] for name in self._buffers}

    def _n_decided(self) -> tuple[int, int]:
        """Return the numbers of windows that fit, by the formula of `regular_starts`, and that wait no longer."""
        front_s = max(buffer.last_s for buffer in self._buffers.values())
        reached_s = min(each.last_s + 1 / self._own.rate_hz[name] for name, each in self._buffers.items())
        n_fit, n_overdue = (
            math.floor((end_s - self._start_s - self.rule.length_s + TIME_TOLERANCE_S) / self.rule.step_s) + 1
            for end_s in (reached_s, front_s - PATIENCE_S)
        )
        return n_fit, n_overdue

    def _advance(self) -> list[Windows]:
        """Decide all windows that can be decided now."""
        if math.isnan(self._start_s):
            return []
        windows, rule, channels = list[Windows](), self.rule, self.layout.channels
        n_fit, n_overdue = self._n_decided()
        if not self._judged and max(n_fit, n_overdue) > 0:
            self._take_rates()
            n_fit, n_overdue = self._n_decided()
        if self._refused and max(n_fit, n_overdue) > self._next:
            self.dropped[self._refused] += max(n_fit, n_overdue) - self._next
            self._next = max(n_fit, n_overdue)
        while self._next < max(n_fit, n_overdue):
            start_s, streams = self._start_s + rule.step_s * self._next, {}
            for name, buffer in self._buffers.items():
                first = bisect_left(buffer.time_s, start_s - TIME_TOLERANCE_S)
                rows = slice(first, first + self._own.n_samples(name, rule.length_s))
                if rows.stop <= len(buffer.time_s):
                    samples = np.array(buffer.time_s[rows]), np.array(buffer.values[rows])
                    streams[name] = Stream(*samples, channels[name])
            if len(streams) == len(channels):
                at = np.array([start_s])
                values, (reason,), (filled,) = cut_at(streams, at, rule, self._own)
                self._next += 1
                if reason:
                    self.dropped[str(reason)] += 1
                else:
                    self.filled += int(filled)
                    run_id, unknown = (np.array([name], dtype=object) for name in ("live", ""))
                    values = at_rates(values, self._own, self.layout, rule.length_s)
                    of_layout = channels, self.layout.rate_hz, rule.length_s
                    windows.append(Windows(values, *of_layout, at, run_id, unknown))
            elif self._next < n_overdue:
                # A window that lacks samples is followed by windows that lack them too.
                self.dropped["gap"] += n_overdue - self._next
                self._next = n_overdue
            else:
                break
        self._set_due()
        return windows


class WindowFeed:
    """Cut windows from the readings of sensors and the estimates of a filter.

    The windows are those that :func:`~features.windows.cut_windows` cuts from the log with wheel speeds
    (:func:`terrain.kinematics.logged_wheels.with_wheel_speeds`) and estimates
    (:func:`terrain.estimation.estimate.enriched`).

    Parameters
    ----------
    rule, layout : of the windows
    channels : of each stream that is measured, in the order of the columns of its readings
    estimated : of each stream that a filter adds (:func:`terrain.estimation.live.estimated_channels`)
    robot : corrected; may be missing where every channel of the windows is measured; ``DataError`` where one is
        neither measured nor estimated

    Attributes
    ----------
    unreadable : number of readings that were no arrays of the right shape, by stream

    Examples
    --------
    >>> layout = Layout({"imu": ("gyro_z_radps",)}, {"imu": 10.0})
    >>> feed = WindowFeed(WindowRule(1.0, steady=None), layout, {"imu": ("accel_x_mps2", "gyro_z_radps")})
    >>> time_s = np.arange(12) / 10
    >>> window, = feed.push({"imu": Reading(time_s, np.column_stack([time_s, -time_s]))})
    >>> float(window.values["imu"][0, 0, -1])
    -0.9
    """

    def __init__(
        self,
        rule: WindowRule,
        layout: Layout,
        channels: Mapping[str, Sequence[str]],
        estimated: Mapping[str, Sequence[str]] | None = None,
        robot: Robot | None = None,
    ) -> None:
        self.unreadable: Counter[str] = Counter()
        self._stream = WindowStream(rule, layout)
        self._measured: dict[str, tuple[int, Callable[[Array], Array] | None, list[int]]] = {}
        self._estimated: dict[str, list[int]] = {}
        added = estimated or {}
        for stream, needed in layout.channels.items():
            measured = list(channels.get(stream, ()))
            with_speeds, known = None, measured if stream in channels else list(added.get(stream, ()))
            if stream == "wheels" and stream in channels and robot is not None:
                found = wheel_speeds_from(measured, robot)
                known, with_speeds = (known, None) if found is None else (list(found[0]), found[1])
            for channel in needed:
                if channel not in known:
                    there = ", ".join(known or [*channels, *added]) or "no streams"
                    raise DataError(
                        f"the model requires {channel!r} of the stream {stream!r}, which is neither measured nor "
                        f"estimated here (there are {there})"
                    )
            places = [known.index(channel) for channel in needed]
            if stream in channels:
                self._measured[stream] = len(measured), with_speeds, places
            else:
                self._estimated[stream] = places

    @property
    def dropped(self) -> dict[str, int]:
        """Windows and samples that were not used, as counts by kind."""
        counts = {f"window: {reason}": n for reason, n in self._stream.dropped.items()}
        counts |= {f"{name}: {why}": n for (name, why), n in self._stream.dropped_samples.items()}
        counts |= self.filled
        return counts | {f"{name}: unreadable": n for name, n in self.unreadable.items()}

    @property
    def resampled(self) -> tuple[str, ...]:
        """In a sentence, each stream whose windows are resampled."""
        return self._stream.resampled

    @property
    def filled(self) -> dict[str, int]:
        """Number of values that were missing and are interpolated, as of :class:`~features.windows.WindowCut`."""
        return {INTERPOLATED: self._stream.filled} if self._stream.filled else {}

    @property
    def due_s(self) -> float:
        """No sample before this time can finish a window; minus infinity before all streams have begun."""
        return self._stream.due_s

    def push(self, readings: Mapping[str, Reading], estimates: Sequence[LiveEstimate] = ()) -> list[Windows]:
        """Take what was measured and estimated since the last call; return the windows it completes."""
        windows: list[Windows] = []
        push = self._stream.push
        for stream, (n_columns, with_speeds, places) in self._measured.items():
            if stream not in readings:
                continue
            reading = readable(readings[stream])
            if reading is None or not reading.time_s.size or reading.values.shape[1] != n_columns:
                self.unreadable[stream] += 1
                continue
            values = reading.values if with_speeds is None else with_speeds(reading.values)
            for time_s, row in zip(reading.time_s.tolist(), values[:, places], strict=True):
                windows += push(stream, time_s, row)
        for estimate in estimates:
            for stream, places in self._estimated.items():
                windows += push(stream, estimate.time_s, estimated_values(stream, estimate)[places])
        return windows
