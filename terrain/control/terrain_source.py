"""Sources of the current terrain for the control of a robot: a known one, none, or a classifier elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from terrain.records import Sample

if TYPE_CHECKING:
    from terrain.estimation.live.choice import Estimate


class TerrainEstimate(NamedTuple):
    """Terrain at a time, and its probability; an empty terrain is unknown."""

    time_s: float
    terrain: str
    probability: float


class TerrainSource:
    """Gives the terrain from time to time; this one never does: the terrain stays unknown.

    Attributes
    ----------
    certain : each output holds until the next, however long
    settled : each output is accepted at once, without a dwell
    n_refused : number of windows without an output
    model, outputs : that classifies, and what it gave at the last sample; none of a source without one
    """

    certain = settled = False
    n_refused = 0
    model: Any = None
    outputs: Sequence[Any] = ()

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows and samples that were not used, as counts by kind."""
        return {}

    def update(self, sample: Sample, estimates: Sequence[Estimate]) -> list[TerrainEstimate]:
        """Take a sample and the estimates made from it; return the terrains found, in most steps none."""
        return []

    def check(self, model: Any) -> None:
        """Raise what :meth:`swap` would."""

    def swap(self, model: Any) -> None:
        """Go on with another model, between two samples."""


class KnownTerrain(TerrainSource):
    """The true terrain of the samples, at every change of it.

    Parameters
    ----------
    name_of : from the true terrain to the one that is given, to be wrong on purpose
    """

    certain = settled = True

    def __init__(self, name_of: Callable[[str], str] = str) -> None:
        self._name_of = name_of
        self._last = ""

    def update(self, sample: Sample, estimates: Sequence[Estimate]) -> list[TerrainEstimate]:
        """Return the terrain of the sample where it has changed."""
        if not sample.terrain or sample.terrain == self._last:
            return []
        self._last = sample.terrain
        return [TerrainEstimate(sample.time_s, self._name_of(sample.terrain), 1.0)]
