"""Whether a robot that skids is stuck: its wheels turn it on the spot, and it does not turn.

Sides that turn against each other turn a robot with D / B, their difference over its track, where nothing slips,
usually with half of it, and where it is stuck not at all.  With its yaw rate w, the standard deviation s of its gyro's
bias, and means over the last second (low-passes)::

    stuck     |w| + 2 s < r |D| / B      with r = :data:`STUCK_RATIO`, for :data:`STUCK_AFTER_S`

of sides that turn against each other (``|v| <= |D| / 4``).  Driving straight it is not known: wheels turn whether or
not the ground stays below them.  Acceleration and currents do not show it on the measured runs of a Husky on snow, ice,
loam and asphalt: wheels that spin in snow shake the body as travel does (0.2 to 8 m/s^2, driving 0.4 to 8), and their
currents (1 to 20 A) are those of driving too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

#: Time constant of the means: longer than a wheel's measurement is late (0.3 s), shorter than a turn.
MEAN_S = 1.0
#: A robot that turns with less than a tenth of D / B: firm ground and ice have 0.5 to 0.7, snow 0.3.
STUCK_RATIO = 0.1
#: A turn has to have failed for so long: clocks of two loggers may be 1.3 s apart (BorealTC, SNOW_14).
STUCK_AFTER_S = 2.0
#: Wheels that would turn the robot slower show nothing: a tenth of it is a gyro's bias.
LEAST_TURN_RADPS = 0.1
OPPOSED_RATIO = 0.25  #: Largest mean of the sides over their difference of wheels that turn on the spot.
UNKNOWN_AFTER_S = 0.5  #: Without wheels or gyro for longer, nothing is known.
_ROUNDED_S = 1e-9


class Turns(NamedTuple):
    """What is remembered of how wheels turn a robot."""

    is_stuck: bool = False
    time_s: float = math.nan  #: of the last measurement
    #: means of the sides' speed, of their difference and of the yaw rate
    means: tuple[float, float, float] = (0.0, 0.0, 0.0)
    failing_s: float = math.nan  #: since when a turn has failed, and since when the means are taken
    start_s: float = math.nan


def next_turns(
    before: Turns,
    time_s: float,
    sides_mps: tuple[float, float],
    yaw_rate_radps: float,
    bias_std_radps: float,
    track_m: float,
) -> Turns:
    """Return what is known at a tick.

    Parameters
    ----------
    sides_mps : left and right, NaN where there is none
    yaw_rate_radps : of the filter; NaN where no gyro was measured
    bias_std_radps : s
    track_m : B, as described

    Examples
    --------
    >>> turns = Turns()
    >>> for k in range(30):
    ...     turns = next_turns(turns, 0.1 * k, (-0.15, 0.15), 0.0, 0.002, 0.57)
    >>> turns.is_stuck, turns.failing_s
    (True, 0.0)
    """
    left, right = sides_mps
    step_s = time_s - before.time_s
    if not math.isfinite(left + right + yaw_rate_radps):
        return before if 0.0 < step_s <= UNKNOWN_AFTER_S else Turns()
    now, means, gain = (0.5 * (left + right), right - left, yaw_rate_radps), before.means, 1.0
    failing_s, start_s = before.failing_s, before.start_s
    if 0.0 < step_s <= MEAN_S:
        gain = -math.expm1(-step_s / MEAN_S)
    else:
        failing_s, start_s, means = math.nan, time_s, now
    speed, difference, turn = (mean + gain * (value - mean) for mean, value in zip(means, now, strict=True))
    turns = abs(speed) <= OPPOSED_RATIO * abs(difference)
    turns &= min(abs(difference), abs(right - left)) >= LEAST_TURN_RADPS * track_m
    if not (turns and abs(turn) + 2.0 * bias_std_radps < STUCK_RATIO * abs(difference) / track_m):
        failing_s = math.nan
    elif math.isnan(failing_s):
        failing_s = time_s
    is_stuck = time_s - failing_s >= STUCK_AFTER_S - _ROUNDED_S and time_s - start_s >= MEAN_S
    return Turns(is_stuck, time_s, (speed, difference, turn), failing_s, start_s)
