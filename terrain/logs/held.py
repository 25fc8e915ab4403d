"""Values that a log holds from one message to the next, read as the rate at which they really change."""

from __future__ import annotations

import numpy as np

from terrain.records import Array

MAX_HELD_S = 0.1
"""A value that is usually held for longer is read as straight lines.  Held for 0.1 s it lags by 0.025 s
on samples at 20 Hz, half a sample; held for 0.25 s by 0.1 s."""


def between_updates(values: Array, time_s: Array, held: int) -> Array:
    """Return a held signal as straight lines between the samples where it is new.

    A value that stays for longer than usual was measured again and found the same: it is held until the usual
    time before the next one.

    Parameters
    ----------
    values : (n,) as held
    time_s : (n,)
    held : usual number of samples from one new value to the next

    Examples
    --------
    >>> between_updates(np.array([0.0, 0.0, 0.0, 0.0, 4.0, 4.0, 8.0]), np.arange(7.0), 2).tolist()
    [0.0, 0.0, 0.0, 2.0, 4.0, 6.0, 8.0]
    """
    new = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    stayed = new[1:][np.diff(new) > held] - held
    known = np.sort(np.concatenate([new, stayed]))
    return np.asarray(np.interp(time_s, time_s[known], values[known]))


def usual_hold(values: Array, period_s: float) -> int:
    """Return the median samples from one new value to the next; 1 where that is short or unknown.

    Parameters
    ----------
    values : (n, k) n stretches of k samples
    period_s : from sample to sample

    Examples
    --------
    >>> usual_hold(np.arange(40.0)[None] // 5, 0.05), usual_hold(np.arange(40.0)[None] // 2, 0.05)
    (5, 1)
    """
    stretch, sample = np.nonzero(np.diff(values, axis=1) != 0.0)
    waits = np.diff(sample)[np.diff(stretch) == 0]
    usual = int(np.median(waits)) if waits.size else 1
    return usual if usual * period_s > MAX_HELD_S * (1.0 + 1e-6) else 1


def undo_hold(values: Array, time_s: Array, holds: tuple[int, ...]) -> Array:
    """Return held columns (n, c) as straight lines where they are usually held for more than one sample."""
    return np.column_stack(
        [between_updates(v, time_s, n) if n > 1 else v for v, n in zip(values.T, holds, strict=True)]
    )
