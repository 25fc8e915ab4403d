"""The terrain that a controller believes in: its sources, when a classification is accepted, and targets that follow.

A classifier gives one output per window, and some are wrong; a target that followed each output would jump.
Here a class is accepted when it was classified with sufficient probability, window after window, for a dwell
time.  Outputs of low probability for as long are accepted as "unknown", for which the table's fallback is
used.  A class that no output has confirmed for some time of driving becomes unknown, too: a classifier that
fell silent, or that contradicts itself, says nothing of where the robot has come to since.  The target then
moves to its new value at a bounded rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from terrain.control.pid import checked
from terrain.records import Sample
from terrain.status import StatusCode

if TYPE_CHECKING:
    from terrain.estimation.live import LiveEstimate

#: A robot whose fastest wheel is to turn at least so fast drives: windows are cut from this speed on
#: (``features.windows.SteadyMotion``).
DRIVING_MPS = 0.03
UNKNOWN = ""  #: Name of a terrain that is not known.


class SwitchSettings(NamedTuple):
    """When a class is accepted, and how fast a target moves."""

    #: of a window's class, for it to count; below it the window counts as unknown. With the eight classes of the
    #: simulated runs the calibrated classifier is right more often than not above 0.5
    probability_least: float = 0.5
    dwell_s: float = 1.5  #: time over which all windows have to agree; windows come every 2 s, so two of them
    #: after a gap of this length between outputs, as while the robot stands, the dwell starts again
    silent_s: float = 10.0
    #: time of driving after which a class that no output has confirmed becomes unknown: five windows. Of the outputs
    #: on a simulated terrain 0.4 (tiles) to 1.0 (loam) are of its class, so that five in a row are not by chance in 8
    #: % of the cases at the worst
    unconfirmed_max_s: float = 10.0
    rate_ratio: float = 0.1  #: change of the target per second: a start takes some seconds


SWITCHING = SwitchSettings()


class TerrainBelief(NamedTuple):
    """The accepted terrain, and the candidate that may replace it."""

    terrain: str = UNKNOWN
    probability: float = math.nan  #: with which it was classified last; NaN before
    candidate: str = UNKNOWN  #: class of the last output
    since_s: float = math.nan  #: since when it is without interruption
    received_s: float = math.nan  #: time of the last output
    unconfirmed_s: float = 0.0  #: time of driving since an output of the accepted class


NO_BELIEF = TerrainBelief()


class OutputStatus(StatusCode):
    """The last output of a terrain source in a step, if there was one.

    ``ACCEPTED``: it counts for its class.  ``BELOW_THRESHOLD``: its probability does not suffice, and it
    counts as unknown.  ``REFUSED``: the classifier could not use the window.
    """

    NONE = 0
    ACCEPTED = 1
    BELOW_THRESHOLD = 2
    REFUSED = 3


def check_switching(settings: SwitchSettings) -> None:
    """Raise ``ConfigError`` if the probability is not within 0 and 1, or another number not finite or below zero."""
    checked("switching: ", settings, most={"probability_least": 1.0})


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
    counts = output_status(terrain, probability, settings) is OutputStatus.ACCEPTED
    candidate = terrain if counts else UNKNOWN
    continues = candidate == belief.candidate and time_s - belief.received_s <= settings.silent_s
    since_s = belief.since_s if continues else time_s
    if candidate == belief.terrain or time_s - since_s >= settings.dwell_s - 1e-9:
        return TerrainBelief(candidate, probability if candidate else math.nan, candidate, since_s, time_s)
    return belief._replace(candidate=candidate, since_s=since_s, received_s=time_s)


def output_status(terrain: str, probability: float, settings: SwitchSettings = SWITCHING) -> OutputStatus:
    """Return whether an output counts for its class.

    Examples
    --------
    >>> output_status("grass", 0.9).label, output_status("grass", 0.3).label
    ('accepted', 'below threshold')
    """
    enough = terrain != UNKNOWN and probability >= settings.probability_least  # False for NaN
    return OutputStatus.ACCEPTED if enough else OutputStatus.BELOW_THRESHOLD


def drive_on(
    belief: TerrainBelief, speed_mps: float, dt_s: float, settings: SwitchSettings = SWITCHING
) -> TerrainBelief:
    """Return the belief after a time without an output; unknown where it was not confirmed for too long.

    The speed is the desired circumferential one of the fastest wheel: below :data:`DRIVING_MPS` no time counts,
    as no windows come.

    Examples
    --------
    >>> grass = TerrainBelief("grass", 0.9, "grass", 0.0, 2.0)
    >>> [drive_on(grass, *driven).terrain for driven in ((1.0, 9.0), (1.0, 11.0), (0.0, 11.0))]
    ['grass', '', 'grass']
    """
    if belief.terrain == UNKNOWN or not (speed_mps >= DRIVING_MPS and dt_s > 0.0):
        return belief
    unconfirmed_s = belief.unconfirmed_s + dt_s
    if unconfirmed_s > settings.unconfirmed_max_s:
        return TerrainBelief(received_s=belief.received_s)
    return TerrainBelief(*belief[:-1], unconfirmed_s)


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


class TerrainEstimate(NamedTuple):
    """Terrain at a time, and its probability; an empty terrain is unknown."""

    time_s: float
    terrain: str
    probability: float
    #: why the terrain is unknown, in words; empty where it is not, or nothing is known of it
    reason: str = ""


class TerrainSource:
    """Gives the terrain from time to time; this one never does: the terrain stays unknown.

    Attributes
    ----------
    certain : each output holds until the next, however long
    settled : each output is accepted at once, without a dwell
    model, outputs : that classifies, and what it gave at the last sample; none of a source without one
    """

    certain = settled = False
    model: Any = None
    outputs: Sequence[Any] = ()

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows and samples that were not used, as counts by kind."""
        return {}

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Take a sample and the estimates made from it; return the terrains found, in most steps none."""
        return []

    def check(self, model: Any) -> None:
        """Raise what :meth:`swap` would."""

    def swap(self, model: Any) -> None:
        """Go on with another model, between two samples."""


class KnownTerrain(TerrainSource):
    """The true terrain of the samples, at every change of it; or another for it, to be wrong on purpose."""

    certain = settled = True

    def __init__(self, name_of: Callable[[str], str] = str) -> None:
        self._name_of = name_of
        self._last = ""

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Return the terrain of the sample where it has changed."""
        if not sample.terrain or sample.terrain == self._last:
            return []
        self._last = sample.terrain
        return [TerrainEstimate(sample.time_s, self._name_of(sample.terrain), 1.0)]
