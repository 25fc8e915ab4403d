"""Sources of the current terrain: a classifier on live windows, a known terrain, or none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from pipelines.models.model_files import TerrainModel
from pipelines.streaming.classifying import AtOnce, Classifying, Part, WindowOutput
from pipelines.streaming.over_time import ground_filter
from pipelines.streaming.window_feed import WindowFeed, live_filter, needs_filter
from terrain.errors import DataError
from terrain.estimation.live.estimate import LiveEstimate
from terrain.estimation.live.estimator import CHANNELS
from terrain.extension import correct_live
from terrain.records import Sample
from terrain.robots import Robot

PILOT_FILTER = "vio15"
"""Filter of :class:`pipelines.live.pilot.LivePilot`."""


class TerrainEstimate(NamedTuple):
    """Terrain at a time, and its probability; an empty terrain is unknown."""

    time_s: float
    terrain: str
    probability: float


class TerrainSource(Protocol):
    """Gives the terrain from time to time.

    ``certain``: each output is accepted at once, and holds until the next.  ``settled``: it was filtered over
    time, and waits for no dwell.
    """

    certain: bool

    @property
    def settled(self) -> bool:
        """Whether outputs were filtered over time."""
        ...

    @property
    def n_refused(self) -> int:
        """Number of windows without an output."""
        ...

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Take a sample and the estimates made from it; return the terrains found, in most steps none."""
        ...


class NoTerrain:
    """No source: the terrain stays unknown, and the table's fallback is used."""

    certain = settled = False
    n_refused = 0

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Return nothing."""
        return []


class KnownTerrain:
    """The true terrain of the samples, at every change of it.

    Parameters
    ----------
    name_of : from the true terrain to the one that is given, to be wrong on purpose
    """

    certain = settled = True
    n_refused = 0

    def __init__(self, name_of: Callable[[str], str] = str) -> None:
        self._name_of = name_of
        self._last = ""

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Return the terrain of the sample where it has changed."""
        if not sample.terrain or sample.terrain == self._last:
            return []
        self._last = sample.terrain
        return [TerrainEstimate(sample.time_s, self._name_of(sample.terrain), 1.0)]


class Classifier:
    """The output of a model for each live window, cut as the windows of its training.

    Parameters
    ----------
    model : fitted on such windows
    robot : that is driven
    classifying : where windows are classified; at once by default

    Attributes
    ----------
    failed : number of windows that the model refused, by error message
    outputs : those of the last sample, in most cases none

    Raises
    ------
    DataError
        if the model requires a stream or a channel that is not computed live, or was trained on the estimates
        of another filter than the pilot's.
    """

    certain = False

    def __init__(self, model: TerrainModel, robot: Robot, classifying: Classifying | None = None) -> None:
        self.model, self._robot = model, correct_live(robot)[0]
        self.outputs: list[WindowOutput] = []
        self._feed = self.feed_of(model)
        self._classifying: Classifying = AtOnce() if classifying is None else classifying
        self._classifying.begin(Part(model, self._feed))
        self.failed: Counter[str] = Counter()
        self._over_time = ground_filter(model)

    @property
    def settled(self) -> bool:
        """Whether the model's outputs are filtered over time."""
        return self._over_time is not None

    def feed_of(self, model: TerrainModel) -> WindowFeed:
        """Return what cuts the windows of a model; ``DataError`` where it does not suit the pilot."""
        needed = needs_filter(model.info, CHANNELS)
        if needed and live_filter(model.info, self._robot) != PILOT_FILTER:
            raise DataError(
                f"the model was trained on estimates of the filter {model.info.filter!r}; the pilot runs "
                f"{PILOT_FILTER!r}"
            )
        return WindowFeed(model.info, CHANNELS, self._robot)

    def swap(self, model: TerrainModel) -> None:
        """Go on with another model, between two samples.

        Where both take the same windows, the one that is being cut is the first of the new model; otherwise
        its windows begin with the next sample.
        """
        if not self._feed.suits(model.info):
            self._feed = self.feed_of(model)
        self.model, self._over_time = model, ground_filter(model)
        self._classifying.begin(Part(model, self._feed))

    @property
    def n_refused(self) -> int:
        """Number of windows that the model refused."""
        return self.failed.total()

    @property
    def dropped(self) -> dict[str, int]:
        """Windows and samples that were not used, as counts by kind."""
        refused = {f"window: refused, {why}": n for why, n in self.failed.items()}
        return {**self._classifying.dropped, **refused}

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Return the terrain of each window whose output is there by now."""
        self._classifying.put(sample.readings, estimates)
        found: list[TerrainEstimate] = []
        self.outputs = self._classifying.finished()
        for output in self.outputs:
            if output.refused:
                self.failed[output.refused] += 1
            if self._over_time is not None:
                found = [TerrainEstimate(sample.time_s, *self._over_time.take(output))]
            elif not output.refused:  # of several that come at once, as after a stall, the newest stands
                found = [TerrainEstimate(sample.time_s, output.terrain, output.probability)]
        return found
