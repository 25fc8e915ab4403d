"""What shape a log is in: rate, gaps, jitter, stuck channels, missing values."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.records import Array, Stream

GAP_PERIODS = 1.5
"""An interval of this many median periods has lost at least one sample."""

STUCK_IMU_SAMPLES = 20
"""A gyro or accelerometer shows its noise in the last digit even at rest: on 69 published Husky runs it never
holds a value for more than 2 samples, so 20 (0.2 s at 100 Hz) are a fault."""

STUCK_SIBLING_CHANGES = 20
"""A wheel speed may hold one value for a whole run of steady driving, and a current rest at its floor.  They
are stuck when the same quantity at another wheel changes so often meanwhile; on the published runs
it changes at most 7 times."""

IMU_QUANTITIES = ("gyro", "accel")


class StreamQuality(NamedTuple):
    """Sampling of a stream and the quality of its channels.

    A gap is an interval of more than ``GAP_PERIODS`` median periods.  ``longest_gap_s`` is 0 and
    ``longest_gap_at_s`` NaN where there is none.  ``jitter_s`` is the standard deviation of the other
    intervals.  ``stuck`` names channels; missing samples and the longest stretch of one value are by channel.
    """

    n: int
    rate_hz: float
    duration_s: float
    n_gaps: int
    longest_gap_s: float
    longest_gap_at_s: float
    jitter_s: float
    stuck: tuple[str, ...]
    n_nonfinite: dict[str, int]
    longest_constant_s: dict[str, float]


def stream_quality(stream: Stream) -> StreamQuality:
    """Return the quality of a stream of at least two samples.

    A gyro or accelerometer channel is stuck when it holds one value for ``STUCK_IMU_SAMPLES``.  A speed is
    stuck when it holds one value over ``STUCK_SIBLING_CHANGES`` changes of a sibling: the same quantity, in
    the same unit, at another wheel.  Currents rest at their floor while the other side works, so that they
    are stuck only if they never leave one value.  Other channels are not judged.

    Examples
    --------
    >>> time_s = np.delete(np.arange(0.0, 1.0, 0.01), [50, 51])
    >>> quality = stream_quality(Stream(time_s, np.sin(time_s)[:, None], ("gyro_z_radps",)))
    >>> quality.n_gaps, round(quality.longest_gap_s, 3), round(quality.longest_gap_at_s, 3), quality.stuck
    (1, 0.03, 0.49, ())
    """
    intervals_s = np.diff(stream.time_s)
    gap = intervals_s > GAP_PERIODS * np.median(intervals_s)
    longest = int(np.argmax(intervals_s))
    constant = {name: constant_stretches(stream.channel(name)) for name in stream.channels}
    return StreamQuality(
        n=len(stream),
        rate_hz=stream.rate_hz,
        duration_s=stream.duration_s,
        n_gaps=int(gap.sum()),
        longest_gap_s=float(intervals_s[longest]) if gap.any() else 0.0,
        longest_gap_at_s=float(stream.time_s[longest]) if gap.any() else float("nan"),
        jitter_s=float(np.std(intervals_s[~gap])),
        stuck=tuple(name for name, (first, last) in constant.items() if _is_stuck(stream, name, first, last)),
        n_nonfinite={name: int(np.sum(~np.isfinite(stream.channel(name)))) for name in stream.channels},
        longest_constant_s={
            name: float(np.max(stream.time_s[last] - stream.time_s[first], initial=0.0))
            for name, (first, last) in constant.items()
        },
    )


def constant_stretches(values: Array) -> tuple[Array, Array]:
    """Return first and last index (m,) of the stretches of one finite value that cover ``values`` (n,).

    Examples
    --------
    >>> first, last = constant_stretches(np.array([1.0, 1.0, np.nan, 2.0, 2.0, 2.0]))
    >>> first.tolist(), last.tolist()
    ([0, 3], [1, 5])
    """
    first = np.flatnonzero(np.r_[True, values[1:] != values[:-1]])
    last = np.r_[first[1:] - 1, values.size - 1]
    finite = np.isfinite(values[first])
    return first[finite], last[finite]


def _is_stuck(stream: Stream, name: str, first: Array, last: Array) -> bool:
    quantity = name.partition("_")[0]
    if not first.size:
        return False
    if quantity in IMU_QUANTITIES:
        return bool(np.max(last - first) + 1 >= STUCK_IMU_SAMPLES)
    if quantity not in ("speed", "current"):
        return False
    if quantity == "current" and np.unique(stream.channel(name)[first]).size > 1:
        return False
    for sibling in stream.channels:
        if sibling != name and _kind(sibling) == _kind(name):
            n_changes = np.r_[0, np.cumsum(np.diff(stream.channel(sibling)) != 0.0)]
            if np.max(n_changes[last] - n_changes[first]) >= STUCK_SIBLING_CHANGES:
                return True
    return False


def _kind(channel: str) -> tuple[str, str]:
    return channel.partition("_")[0], channel.rpartition("_")[2]
