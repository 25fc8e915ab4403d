"""Switching targets without harm: when a class is believed, and how fast a target may move.

A classifier speaks once a window and is wrong at times; a target that followed each word would jump with it.
Here a class is believed when it was said with enough probability, window after window, for a dwell; doubt
that lasts as long is believed too, as "unknown", and the table's fallback stands in.  Whatever is believed,
the target moves to its new value at a bounded rate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from terrain.errors import ConfigError

UNKNOWN = ""
"""What is believed of ground that nobody knows."""


class SwitchSettings(NamedTuple):
    """When a class is believed, and how fast a target moves.

    Parameters
    ----------
    probability_least : of a window's class, for it to count; less is doubt.  With the eight classes of the
        simulated runs, 0.5 is where the calibrated classifier is right more often than not
    dwell_s : from the first window of a class to the last, all alike; windows come every 2 s, so two of them
    silent_s : no word for so long, as while the robot stands, and the row of words starts anew
    rate_ratio : change of the target a second: a start takes some seconds
    """

    probability_least: float = 0.5
    dwell_s: float = 1.5
    silent_s: float = 10.0
    rate_ratio: float = 0.1


SWITCHING = SwitchSettings()


class Belief(NamedTuple):
    """What is believed of the ground, and what may be believed next.

    Parameters
    ----------
    terrain : believed; :data:`UNKNOWN` at first
    probability : with which it was said last; NaN before
    candidate, since_s, received_s : what was said last, since when without interruption, and when last
    """

    terrain: str = UNKNOWN
    probability: float = math.nan
    candidate: str = UNKNOWN
    since_s: float = math.nan
    received_s: float = math.nan


NOTHING = Belief()


def check_switching(settings: SwitchSettings) -> None:
    """Refuse settings that are none.

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
        most, desired = (1.0, "from 0 to 1") if name == "probability_least" else (math.inf, "from zero up")
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and math.isfinite(value) and 0.0 <= value <= most):
            raise ConfigError(f"switching: {name} is {value!r}, a number {desired} is required")


def hear(
    belief: Belief, time_s: float, terrain: str, probability: float, settings: SwitchSettings = SWITCHING
) -> Belief:
    """Return what is believed after one word of a classifier.

    A probability that is NaN or too low, like an empty terrain, is doubt, whatever class goes with it.  A
    word that is not later than the last is not heard.

    Examples
    --------
    >>> belief = hear(NOTHING, 2.0, "grass", 0.9)
    >>> belief.terrain, hear(belief, 4.0, "grass", 0.8).terrain
    ('', 'grass')
    """
    if not math.isfinite(time_s) or time_s <= belief.received_s:
        return belief
    said = terrain if probability >= settings.probability_least else UNKNOWN  # False for NaN
    goes_on = said == belief.candidate and time_s - belief.received_s <= settings.silent_s
    since_s = belief.since_s if goes_on else time_s
    if said == belief.terrain:
        shown = probability if said else math.nan
        return Belief(belief.terrain, shown, said, since_s, time_s)
    if time_s - since_s >= settings.dwell_s - 1e-9:
        return Belief(said, probability if said else math.nan, said, since_s, time_s)
    return Belief(belief.terrain, belief.probability, said, since_s, time_s)


def approach(now: float, desired: float, rate: float, dt_s: float) -> float:
    """Return a target on its way: no further than ``rate dt`` from now; where there is none yet, the wanted.

    Examples
    --------
    >>> round(approach(0.10, 0.25, 0.1, 0.02), 4), approach(float("nan"), 0.25, 0.1, 0.02)
    (0.102, 0.25)
    """
    if not math.isfinite(now):
        return desired
    step = rate * max(dt_s, 0.0)
    return now + min(max(desired - now, -step), step)
