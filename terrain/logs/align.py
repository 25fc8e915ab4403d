"""One clock for a run: the wheel stream brought onto the clock of the IMU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from terrain.logs.clock import ClockEstimate
from terrain.records import RunLog, Stream


def align(run: RunLog, estimate: ClockEstimate) -> RunLog:
    """Return the run with its wheel stream on the clock of the IMU.

    With the status ``offset only`` the times are shifted and not stretched; where the clocks could not be
    compared the run comes back as it is.  Labels and all other streams stay as they are: the clock of the
    IMU is the clock of the run.

    Parameters
    ----------
    run : run log with the streams that the estimate was made from
    estimate : as :func:`terrain.logs.clock.estimate_clock` returns it

    Examples
    --------
    >>> wheels = Stream([10.0, 11.0, 12.0], [[1.0]] * 3, ("speed_left_mps",))
    >>> estimate = ClockEstimate(0.5, 0.01, 0.02, 0.001, 0.6, 0.9, "estimated", 10.0)
    >>> align(RunLog("SNOW_01", "husky", {"wheels": wheels}), estimate).streams["wheels"].time_s
    array([10.5 , 11.52, 12.54])
    """
    if estimate.status not in ("estimated", "offset only"):
        return run
    wheels = run.streams["wheels"]
    rate = 0.0 if np.isnan(estimate.rate) else estimate.rate
    since_s = wheels.time_s - estimate.reference_s
    time_s = estimate.reference_s + estimate.offset_s + (1.0 + rate) * since_s
    return replace(run, streams={**run.streams, "wheels": Stream(time_s, wheels.values, wheels.channels)})
