"""Sources of the current terrain: a classifier on live windows, a known terrain, or none."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from features.stream import WindowFeed
from pipelines.live.classifying import ClassifierThread, WindowOutput, classify_window
from pipelines.live.model import LiveModel, WindowsInfo
from pipelines.live.windows import feed_of, live_filter, needs_filter
from terrain.classify.terrain_filter import LiveTerrainFilter
from terrain.control.switching import UNKNOWN
from terrain.errors import DataError
from terrain.estimation.live.choice import Estimate
from terrain.estimation.live.clocks import last_stamp_s
from terrain.estimation.live.estimator import CHANNELS
from terrain.extension import correct_live
from terrain.records import Reading, Sample
from terrain.robots import Robot

PILOT_FILTER = "vio15"
"""Filter of :class:`pipelines.live.pilot.LivePilot`."""

MAX_WAITING = 1000
"""Steps of one robot that may wait for the thread: 20 s; of more, the oldest are left out and counted."""

AT_MOST = 25
"""The thread takes what waits at the end of a window, and before that whenever so many steps wait."""


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

    def check(self, model: LiveModel | None) -> None:
        """Raise what :meth:`swap` would."""

    def swap(self, model: LiveModel | None) -> None:
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


class _Part(NamedTuple):
    """A model, and what cuts its windows."""

    model: LiveModel
    feed: WindowFeed


class Classifier(TerrainSource):
    """The output of a model for each live window, cut as the windows of its training.

    Parameters
    ----------
    model : fitted on such windows; None where it comes later
    robot : its description; may be missing where every channel of the model is measured
    thread : that cuts and classifies; by default that is done at once, for logs and simulations, which can wait.
        Arrays that are taken are kept for it and must not change
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

    Notes
    -----
    Models and samples go through one queue, so that what was taken before a model is for the model before.
    Only :meth:`_work` touches the windows; where a thread runs it, both sides share queues whose ends are
    atomic, and plain numbers.
    """

    def __init__(
        self,
        model: LiveModel | None,
        robot: Robot | None,
        thread: ClassifierThread | None = None,
        channels: Mapping[str, Sequence[str]] = CHANNELS,
        filter_name: str = PILOT_FILTER,
    ) -> None:
        self.model: LiveModel | None = None
        self.failed: Counter[str] = Counter()
        self._channels, self._filter_name, self._thread = channels, filter_name, thread
        self._robot = None if robot is None else correct_live(robot)[0]
        self._waiting: deque[tuple[Mapping[str, Reading], Sequence[Estimate]] | _Part] = deque()
        self._finished: deque[WindowOutput] = deque()
        self._part: _Part | None = None  # that is worked with
        self._due_s, self._n_overrun = math.inf, 0
        self._counts: Mapping[str, int] = {}
        if model is not None:
            self._begin(model, self._feed_of(model))

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows and samples that were not used by the last window, as counts by kind."""
        counts = dict(self._counts)
        if self._n_overrun:
            counts["steps: overrun"] = self._n_overrun
        return counts | {f"window: refused, {why}": n for why, n in self.failed.items()}

    def _feed_of(self, model: LiveModel) -> WindowFeed:
        """Return what cuts the windows of a model; ``DataError`` where it does not suit what runs here."""
        feed = feed_of(model.info, self._channels, self._robot)
        if needs_filter(model.info, self._channels) and (
            self._robot is None or live_filter(model.info, self._robot) != self._filter_name
        ):
            raise DataError(
                f"the model was trained on estimates of the filter {model.info.filter!r}; "
                f"{self._filter_name or 'none'!r} runs here"
            )
        return feed

    def check(self, model: LiveModel | None) -> None:
        """Raise ``DataError`` where a model cannot replace this one, or is none."""
        if model is not None and not self._suits(model.info):
            self._feed_of(model)
        if model is None and self.model is not None:
            raise DataError("a model cannot be replaced by none")

    def swap(self, model: LiveModel | None) -> None:
        """Go on with another model, between two samples; ``DataError`` as :meth:`check`.

        Where both take the same windows, the one that is being cut is the first of the new model; otherwise
        its windows begin with the next sample.
        """
        self.check(model)
        if model is not None:
            self._begin(model, self._feed if self._suits(model.info) else self._feed_of(model))

    def restart(self) -> None:
        """Cut windows anew from the next sample on."""
        if self.model is not None:
            self._begin(self.model, self._feed_of(self.model))

    def _suits(self, info: WindowsInfo) -> bool:
        """Say whether another model takes the same windows."""
        return self.model is not None and all(
            getattr(info, name) == getattr(self.model.info, name)
            for name in ("channels", "rate_hz", "rule", "filter")
        )

    def _begin(self, model: LiveModel, feed: WindowFeed) -> None:
        self.model, self._feed = model, feed
        self._over_time = None if model.over_time is None else LiveTerrainFilter(model.over_time)
        self.settled = self._over_time is not None
        self._due_s = math.inf
        self._waiting.append(_Part(model, feed))
        self._do_what_waits()

    def _do_what_waits(self) -> None:
        if self._thread is None:
            self._work()
        else:
            self._thread.due(self._work)

    def take(self, readings: Mapping[str, Reading], estimates: Sequence[Estimate]) -> list[WindowOutput]:
        """Take readings and estimates; return the outputs of windows that are there by now."""
        if self.model is None:
            return []
        self._waiting.append((readings, estimates))
        n = len(self._waiting)
        if n > MAX_WAITING:
            self._leave_out()
        if self._thread is None or n % AT_MOST == 0 or _newest_s(readings, estimates) >= self._due_s:
            self._do_what_waits()
        self.outputs = outputs = [self._finished.popleft() for _ in range(len(self._finished))]
        self.failed.update(output.refused for output in outputs if output.refused)
        self.n_refused = self.failed.total()
        return outputs

    def _leave_out(self) -> None:
        """Remove the oldest step that waits; a model that waits before it is taken first."""
        try:
            oldest = self._waiting.popleft()
            if isinstance(oldest, _Part):
                self._waiting.appendleft(oldest)
            else:
                self._n_overrun += 1
        except IndexError:  # the thread has just taken it
            pass

    def _work(self) -> None:
        """Cut and classify what waits."""
        classify = classify_window if self._thread is None else self._thread.classify
        try:
            while self._waiting:
                taken = self._waiting.popleft()
                if isinstance(taken, _Part):
                    self._part = taken
                elif self._part is not None:
                    for window in self._part.feed.push(*taken):
                        self._finished.append(classify(self._part.model, window))
        finally:
            if self._part is not None:
                due_s = self._part.feed.due_s  # minus infinity before all streams have begun
                self._due_s = due_s if math.isfinite(due_s) else math.inf
                self._counts = self._part.feed.dropped

    def update(self, sample: Sample, estimates: Sequence[Estimate]) -> list[TerrainEstimate]:
        """Return the terrain at the end of each window whose output is there by now."""
        found = []
        for output in self.take(sample.readings, estimates):
            terrain, probability = output.terrain, output.probability
            if self._over_time is not None:
                window = output.end_s, output.probabilities, output.novelty, output.unknown
                best, probability = self._over_time.take(*window)
                terrain = output.classes[best] if best >= 0 else UNKNOWN
            elif output.refused:
                continue
            found.append(TerrainEstimate(output.end_s, terrain, probability))
        return found


def _newest_s(readings: Mapping[str, Reading], estimates: Sequence[Estimate]) -> float:
    """Return the newest stamp; minus infinity where there is none."""
    stamps = [last_stamp_s(readings, stream) for stream in readings] + [one.time_s for one in estimates[-1:]]
    return max((stamp_s for stamp_s in stamps if not math.isnan(stamp_s)), default=-math.inf)
