"""Sources of the current terrain: a classifier on live windows, a known terrain, or none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from pipelines.live.classifying import AtOnce, Part, WindowOutput
from pipelines.live.model import LiveModel
from pipelines.live.over_time import ground_filter, without_dwell
from pipelines.live.windows import Estimate, WindowFeed, live_filter, needs_filter
from terrain.control.switching import SwitchSettings
from terrain.errors import DataError
from terrain.estimation.live.estimator import CHANNELS
from terrain.extension import correct_live
from terrain.records import Reading, Sample
from terrain.robots import Robot

PILOT_FILTER = "vio15"
"""Filter of :class:`pipelines.live.pilot.LivePilot`."""


class TerrainEstimate(NamedTuple):
    """Terrain at a time, and its probability; an empty terrain is unknown."""

    time_s: float
    terrain: str
    probability: float


class TerrainSource:
    """Gives the terrain from time to time; this one never does.

    Attributes
    ----------
    certain : each output is accepted at once, and holds until the next
    settled : it was filtered over time, and waits for no dwell
    n_refused : number of windows without an output
    outputs : of a model, at the last sample
    """

    certain = settled = False
    n_refused = 0
    outputs: Sequence[WindowOutput] = ()

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows and samples that were not used, as counts by kind."""
        return {}

    def update(self, sample: Sample, estimates: Sequence[Estimate]) -> list[TerrainEstimate]:
        """Take a sample and the estimates made from it; return the terrains found, in most steps none."""
        return []


class NoTerrain(TerrainSource):
    """No source: the terrain stays unknown, and the table's fallback is used."""


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


class Classifier(TerrainSource):
    """The output of a model for each live window, cut as the windows of its training.

    Parameters
    ----------
    model : fitted on such windows
    robot : its description; may be missing where every channel of the model is measured
    classifying : where windows are classified; at once by default
    channels : of each stream that is measured; those of a pilot's robot by default
    filter_name : filter that runs here; that of a pilot by default

    Attributes
    ----------
    failed : number of windows that the model refused, by error message

    Raises
    ------
    DataError
        if the model requires a stream or a channel that is not computed live, or was trained on the estimates
        of another filter than runs here.
    """

    def __init__(
        self,
        model: LiveModel,
        robot: Robot | None,
        classifying: AtOnce | None = None,
        channels: Mapping[str, Sequence[str]] = CHANNELS,
        filter_name: str = PILOT_FILTER,
    ) -> None:
        self.model, self._channels, self._filter_name = model, channels, filter_name
        self._robot = None if robot is None else correct_live(robot)[0]
        self._classifying: AtOnce = AtOnce() if classifying is None else classifying
        self.failed: Counter[str] = Counter()
        self._feed = self.feed_of(model)
        self._begin(model)

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows and samples that were not used, as counts by kind."""
        refused = {f"window: refused, {why}": n for why, n in self.failed.items()}
        return {**self._classifying.dropped, **refused}

    def feed_of(self, model: LiveModel) -> WindowFeed:
        """Return what cuts the windows of a model; ``DataError`` where it does not suit what runs here."""
        feed = WindowFeed(model.info, self._channels, self._robot)
        if needs_filter(model.info, self._channels) and (
            self._robot is None or live_filter(model.info, self._robot) != self._filter_name
        ):
            raise DataError(
                f"the model was trained on estimates of the filter {model.info.filter!r}; "
                f"{self._filter_name or 'none'!r} runs here"
            )
        return feed

    def check(self, model: LiveModel | None) -> LiveModel:
        """Return a model that can replace this one; ``DataError`` where it cannot, or is none."""
        if model is None:
            raise DataError("a model cannot be replaced by none")
        if not self._feed.suits(model.info):
            self.feed_of(model)
        return model

    def swap(self, model: LiveModel | None) -> None:
        """Go on with another model, between two samples; ``DataError`` as :meth:`check`.

        Where both take the same windows, the one that is being cut is the first of the new model; otherwise
        its windows begin with the next sample.
        """
        checked = self.check(model)
        if not self._feed.suits(checked.info):
            self._feed = self.feed_of(checked)
        self._begin(checked)

    def restart(self) -> None:
        """Cut windows anew from the next sample on."""
        self._feed = self.feed_of(self.model)
        self._begin(self.model)

    def _begin(self, model: LiveModel) -> None:
        self.model, self._over_time = model, ground_filter(model)
        self.settled = self._over_time is not None
        self._classifying.begin(Part(model, self._feed))

    def take(self, readings: Mapping[str, Reading], estimates: Sequence[Estimate]) -> list[WindowOutput]:
        """Take readings and estimates; return the outputs of windows that are there by now."""
        self._classifying.put(readings, estimates)
        self.outputs = outputs = self._classifying.finished()
        self.failed.update(output.refused for output in outputs if output.refused)
        self.n_refused = self.failed.total()
        return outputs

    def terrain_of(self, output: WindowOutput) -> tuple[str, float] | None:
        """Return terrain and probability after an output, filtered over time where that is asked for."""
        if self._over_time is not None:
            return self._over_time.take(output)
        return None if output.refused else (output.terrain, output.probability)

    def switching(self, settings: SwitchSettings) -> SwitchSettings:
        """Return the settings of the belief in these outputs: a filter over time is the dwell."""
        return settings if self._over_time is None else without_dwell(settings)

    def update(self, sample: Sample, estimates: Sequence[Estimate]) -> list[TerrainEstimate]:
        """Return the terrain of the newest window whose output is there by now."""
        found: list[TerrainEstimate] = []
        for output in self.take(sample.readings, estimates):
            terrain = self.terrain_of(output)
            if terrain is not None:  # of several that come at once, as after a stall, the newest is used
                found = [TerrainEstimate(sample.time_s, *terrain)]
        return found
