"""What the benchmarks of the live chain give."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from terrain.records import Array


class Spread(NamedTuple):
    """Median, 99th percentile and largest of a figure; NaN of none."""

    median: float
    p99: float
    largest: float


def spread(values: Array | list[float]) -> Spread:
    """Return the spread of some figures.

    Examples
    --------
    >>> spread([1.0, 2.0, 3.0]).median
    2.0
    """
    if not len(values):
        return Spread(np.nan, np.nan, np.nan)
    median, p99 = np.percentile(values, [50, 99])
    return Spread(float(median), float(p99), float(np.max(values)))


class SessionsLatency(NamedTuple):
    """Round trip of control steps with so many robots, and what was lost."""

    sessions: int
    p99_ms: float
    median_ms: float
    lost_samples: int


@dataclass(frozen=True, slots=True)
class LiveBench:
    """Latencies of the live chain and the service.

    Parameters
    ----------
    step_us : one control step, as fast as a log goes, while the thread has no window
    step_beside_window_us : the same while the thread classifies one
    step_paced_us : one at 50 Hz in real time, where nothing is warm
    window_ms : from a whole window to its terrain
    websocket_ms : round trip of one robot at 100 Hz
    sessions, sessions_p99_ms, lost_samples : of as many robots at once
    by_sessions : the same of fewer and more
    start_s : from the start of the service's process to its first observation
    rss_mb : resident memory then
    rss_loaded_mb : after all robots
    """

    step_us: Spread
    step_beside_window_us: Spread
    step_paced_us: Spread
    window_ms: Spread
    websocket_ms: Spread
    sessions: int
    sessions_p99_ms: float
    lost_samples: int
    by_sessions: tuple[SessionsLatency, ...]
    start_s: float
    rss_mb: float
    rss_loaded_mb: float


@dataclass(frozen=True, slots=True)
class Soak:
    """What the service did under load and faults.

    Parameters
    ----------
    minutes, seed : as asked for
    steps : answers that robots got
    not_finite, stale : commands that are; none is accepted
    wrong_session : answers with a window of another robot; none is accepted
    unanswered : steps that were asked for on a sound connection and did not come in time
    crashes : how often the process ended
    faults : by kind, how often it was made
    errors : by code, how often the service named one
    rss_mb : resident memory once a minute, from the first
    memory_growth : of the mean of the last third over the first
    problems : what is not accepted, in sentences
    """

    minutes: float
    seed: int
    steps: int
    not_finite: int
    stale: int
    wrong_session: int
    unanswered: int
    crashes: int
    faults: Mapping[str, int]
    errors: Mapping[str, int]
    rss_mb: tuple[float, ...]
    memory_growth: float
    problems: tuple[str, ...]
