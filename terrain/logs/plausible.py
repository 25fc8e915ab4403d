"""Values that a quantity can have: what windows are made of, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from terrain.errors import DataError
from terrain.records import Array, RunLog

MAX_MAGNITUDE = 1e12
"""No quantity of a vehicle is larger in its SI unit (a position on Earth in m has 8 digits, a time since 1970
in s has 10); the fourth power of what is much larger, which features need, is no finite number."""

BEYOND = f"beyond {MAX_MAGNITUDE:g} in its SI unit no quantity is plausible: --repair leaves such values out"
"""What a message states of a value that is larger, wherever it is found."""


def usable_rows(samples: Array, *, unknown_is_a_value: bool = False) -> Array:
    """Return which rows (n,) of samples (n, c) hold plausible values only.

    Parameters
    ----------
    samples : SI units
    unknown_is_a_value : NaN is plausible, as unobservable slip is

    Examples
    --------
    >>> usable_rows(np.array([[1.0, -2.0], [1.0, np.nan], [np.inf, 0.0], [1e200, 0.0]])).tolist()
    [True, False, False, False]
    """
    usable = np.abs(samples) <= MAX_MAGNITUDE  # NaN is not
    if unknown_is_a_value:
        usable |= np.isnan(samples)
    return np.asarray(usable.all(axis=1))


def refuse_implausible(run: RunLog, channels: Mapping[str, Sequence[str]]) -> None:
    """Refuse a finite value that no quantity can have, in the channels of some streams of a run.

    Raises
    ------
    DataError
        that names run, stream, channel, value and time.
    """
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
