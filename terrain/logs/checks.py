"""Result of one check of a run's plausibility."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Level(StrEnum):
    """How plausible a run is in one respect; unknown where it cannot be judged, never ok by default."""

    OK = "ok"
    UNKNOWN = "unknown"
    DOUBTFUL = "doubtful"
    IMPLAUSIBLE = "implausible"


class Check(NamedTuple):
    """One respect in which a run was judged.

    Parameters
    ----------
    check : what was judged: ``gravity``, ``yaw rate``, ``wheel speed``, ``sampling``, ``values``,
        ``channel names``, ``constant channels``, ``overlap``
    level : how plausible it is
    place : stream or channel that it is about
    measured : the figure that was judged; NaN where there is none
    sentence : what was measured, and what is expected
    """

    check: str
    level: Level
    place: str
    measured: float
    sentence: str
