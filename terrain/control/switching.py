"""Switching of targets: when a classification is accepted, and how fast a target may change.

A classifier gives one output per window, and some are wrong; a target that followed each output would jump.
Here a class is accepted when it was classified with sufficient probability, window after window, for a dwell
time.  Outputs of low probability for as long are accepted as "unknown", for which the table's fallback is
used.  The target then moves to its new value at a bounded rate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from terrain.errors import ConfigError

UNKNOWN = ""
"""Name of a terrain that is not known."""


class SwitchSettings(NamedTuple):
    """When a class is accepted, and how fast a target moves.

    Parameters
    ----------
    probability_least : of a window's class, for it to count; below it the window counts as unknown.  With the
        eight classes of the simulated runs the calibrated classifier is right more often than not above 0.5
    dwell_s : time over which all windows have to agree; windows come every 2 s, so two of them
    silent_s : after a gap of this length between outputs, as while the robot stands, the dwell starts again
    rate_ratio : change of the target per second: a start takes some seconds
    """

    probability_least: float = 0.5
    dwell_s: float = 1.5
    silent_s: float = 10.0
    rate_ratio: float = 0.1


SWITCHING = SwitchSettings()


class TerrainBelief(NamedTuple):
    """The accepted terrain, and the candidate that may replace it.

    Parameters
    ----------
    terrain : accepted; :data:`UNKNOWN` at first
    probability : with which it was classified last; NaN before
    candidate, since_s, received_s : class of the last output, since when without interruption, and the time
        of the last output
    """

    terrain: str = UNKNOWN
    probability: float = math.nan
    candidate: str = UNKNOWN
    since_s: float = math.nan
    received_s: float = math.nan


NO_BELIEF = TerrainBelief()


def check_switching(settings: SwitchSettings) -> None:
    """Refuse invalid settings.

    Raises
    ------
    ConfigError
        if the probability is not within 0 and 1, or another number is not finite or below zero.

    Examples
    --------
    >>> check_switching(SWITCHING._replace(probability_least=1.5))
    Traceback (most recent call last):
    terrain.errors.ConfigError: switching: probability_least is 1.5, a number from 0 to 1 is required
    """
    for name, value in settings._asdict().items():
        most, accepted = (1.0, "from 0 to 1") if name == "probability_least" else (math.inf, "from zero up")
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and math.isfinite(value) and 0.0 <= value <= most):
            raise ConfigError(f"switching: {name} is {value!r}, a number {accepted} is required")


def update(
    belief: TerrainBelief,
    time_s: float,
    terrain: str,
    probability: float,
    settings: SwitchSettings = SWITCHING,
) -> TerrainBelief:
    """Return the belief after one output of a classifier.

    A probability that is NaN or too low, like an empty terrain, counts as unknown for any class.  An output
    that is not later than the last is ignored.

    Examples
    --------
    >>> belief = update(NO_BELIEF, 2.0, "grass", 0.9)
    >>> belief.terrain, update(belief, 4.0, "grass", 0.8).terrain
    ('', 'grass')
    """
    if not math.isfinite(time_s) or time_s <= belief.received_s:
        return belief
    candidate = terrain if probability >= settings.probability_least else UNKNOWN  # False for NaN
    continues = candidate == belief.candidate and time_s - belief.received_s <= settings.silent_s
    since_s = belief.since_s if continues else time_s
    known_probability = probability if candidate else math.nan
    if candidate == belief.terrain:
        return TerrainBelief(belief.terrain, known_probability, candidate, since_s, time_s)
    if time_s - since_s >= settings.dwell_s - 1e-9:
        return TerrainBelief(candidate, known_probability, candidate, since_s, time_s)
    return TerrainBelief(belief.terrain, belief.probability, candidate, since_s, time_s)


def approach(now: float, desired: float, rate: float, dt_s: float) -> float:
    """Return a target that approaches the desired one by at most ``rate dt``; the desired one at first.

    Examples
    --------
    >>> round(approach(0.10, 0.25, 0.1, 0.02), 4), approach(float("nan"), 0.25, 0.1, 0.02)
    (0.102, 0.25)
    """
    if not math.isfinite(now):
        return desired
    step = rate * max(dt_s, 0.0)
    return now + min(max(desired - now, -step), step)
