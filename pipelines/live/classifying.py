"""Classifying live windows, at once or on a thread of its own that no control step waits for."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from time import perf_counter
from typing import NamedTuple

import numpy as np

from features.stream import WindowFeed
from pipelines.live.assess import Recent, SessionStart, as_evidence, assess
from pipelines.live.model import TerrainModel
from pipelines.live.windows import feed_of
from terrain.classify.answers import MANOEUVRE_S
from terrain.classify.terrain_filter import LiveTerrainFilter
from terrain.control.switching import UNKNOWN, TerrainEstimate, TerrainSource
from terrain.errors import DataError
from terrain.estimation.clocks import last_stamp_s
from terrain.estimation.live import CHANNELS, LiveEstimate
from terrain.extension import correct_live
from terrain.records import Array, Reading, Sample, Windows
from terrain.robots import Robot

PILOT_FILTER = "vio15"  #: Filter of :class:`pipelines.live.pilot.LivePilot`

MAX_WAITING = 1000
"""Steps of one robot that may wait for the thread: 20 s; of more, the oldest are left out and counted."""

AT_MOST = 25
"""The thread takes what waits at the end of a window, and before that whenever so many steps wait."""


class WindowOutput(NamedTuple):
    """What a model gives for a window."""

    #: start_s, end_s: of the window, on the clock of its stamps
    start_s: float
    end_s: float
    #: terrain, probability: class of the largest probability; empty and NaN where the window was refused,
    #: empty where it is like no terrain that was learned
    terrain: str
    probability: float
    probabilities: Mapping[str, float]  #: of each class of the model, in its order
    refused: str = ""  #: why there is no output; empty where there is one
    took_s: float = math.nan  #: time of features and classifier
    nearest: str = ""  #: class of the largest probability also where the terrain is unknown
    #: how unlike all learned terrains the window is; NaN where the model has no such score
    novelty: float = math.nan
    #: whether training runs that drove like this support the class; None where not counted
    supported: bool | None = None
    #: misfit of the terrain that explains best how the ground answered; NaN where the model has no laws
    answers: float = math.nan
    reason: str = ""  #: why the terrain is unknown; empty where it is not


def classify_window(
    model: TerrainModel, window: Windows, recent: deque[tuple[Array, float]] | None = None
) -> WindowOutput:
    """Return the output of a model for one window; one that it refuses gives none, and raises nothing.

    ``recent`` has misfits (k, q) and end of the windows before this one, to which those of this one are added.
    """
    start_s, classes, started_s = float(window.start_s[0]), model.info.classes, perf_counter()
    end_s = start_s + window.length_s
    try:
        recent = deque() if recent is None else recent
        while recent and recent[0][1] <= end_s - MANOEUVRE_S:
            recent.popleft()
        earlier = Recent(*(np.array(each) for each in zip(*recent, strict=True))) if recent else None
        assessed = assess(model, window, earlier)
        recent.append((assessed.misfits[0], end_s))
        probabilities = assessed.probability[0]
        if not np.isfinite(probabilities).all():
            raise DataError("a probability is not finite")
    except Exception as error:  # whatever broken samples lead a recipe to, it must not stop the loop
        refused, nothing = str(error) or type(error).__name__, dict.fromkeys(classes, math.nan)
        took_s = perf_counter() - started_s
        return WindowOutput(start_s, end_s, "", math.nan, nothing, refused, took_s)
    took_s = perf_counter() - started_s
    best = int(probabilities.argmax())
    nearest, supported = str(model.recipe.classes_[best]), assessed.supported[0]
    return WindowOutput(
        start_s,
        end_s,
        UNKNOWN if assessed.unknown[0] else nearest,
        float(probabilities[best]),
        dict(zip(classes, probabilities.tolist(), strict=True)),
        "",
        took_s,
        nearest,
        float(assessed.novelty[0]),
        None if math.isnan(supported) else bool(supported),
        float(assessed.answers[0]),
        str(assessed.reason[0]),
    )


class _Part(NamedTuple):
    """What classifies the windows of a session, and what cuts them."""

    session: SessionStart
    feed: WindowFeed
    recent: deque[tuple[Array, float]]  #: misfits and ends of its last windows


class Classifier(TerrainSource):
    """The output of a model for each live window, cut as the windows of its training.

    Parameters
    ----------
    model : fitted on such windows; None where it comes later
    robot : its description; may be missing where every channel of the model is measured
    thread : of one worker, which cuts and classifies for any number of robots, one after the other; an error
        that was not foreseen costs its window, and is counted.  By default that is done at once, for logs and
        simulations, which can wait.  Arrays that are taken are kept for it and must not change
    channels : of each stream that is measured; those of a pilot's robot by default
    filter_name : filter that runs here; that of a pilot by default

    Attributes
    ----------
    failed : number of windows that the model refused, by error message
    adapted : what the start of the session shifted, in a sentence; empty before and without

    Notes
    -----
    Models and samples go through one queue, so that what was taken before a model is for the model before.
    Only :meth:`_work` touches the windows; where a thread runs it, both sides share queues whose ends are
    atomic, plain numbers and counts.
    """

    def __init__(
        self,
        model: TerrainModel | None,
        robot: Robot | None,
        thread: ThreadPoolExecutor | None = None,
        channels: Mapping[str, Sequence[str]] = CHANNELS,
        filter_name: str = PILOT_FILTER,
    ) -> None:
        self.model: TerrainModel | None = None
        self.failed: Counter[str] = Counter()
        self._channels, self._filter_name, self._thread = channels, filter_name, thread
        self._robot = None if robot is None else correct_live(robot)[0]
        self._waiting: deque[tuple[Mapping[str, Reading], Sequence[LiveEstimate]] | _Part] = deque()
        self._finished: deque[WindowOutput] = deque()
        self._part: _Part | None = None  # that is worked with
        self._over_time: LiveTerrainFilter | None = None
        self.adapted = ""
        self._due_s = math.inf
        self._counts: Mapping[str, int] = {}
        self._lost: Counter[str] = Counter()
        if model is not None:
            self._begin(model, self._feed_of(model))

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows and samples that were not used by the last window, as counts by kind."""
        refused = {f"window: refused, {why}": n for why, n in self.failed.items()}
        return {**self._counts, **self._lost, **refused}

    def _feed_of(self, model: TerrainModel) -> WindowFeed:
        """Return what cuts the windows of a model; ``DataError``, as of :func:`feed_of`, where it does not suit."""
        return feed_of(model.info, self._channels, self._robot, self._filter_name)

    def check(self, model: TerrainModel | None) -> None:
        """Raise ``DataError`` where a model cannot replace this one, or is none."""
        if model is not None:
            self._feed_for(model)
        elif self.model is not None:
            raise DataError("a model cannot be replaced by none")

    def swap(self, model: TerrainModel | None) -> None:
        """Go on with another model, between two samples; ``DataError`` as :meth:`check`.

        Where both take the same windows, the one that is being cut is the first of the new model; otherwise
        its windows begin with the next sample.
        """
        self.check(model)
        if model is not None:
            self._begin(model, self._feed_for(model))

    def restart(self) -> None:
        """Cut windows anew from the next sample on; the belief of the terrain filter goes on."""
        if self.model is not None:
            over_time = self._over_time
            session = None if self._part is None or not self._part.session.over else self._part.session
            self._begin(self.model, self._feed_of(self.model), session)
            if over_time is not None:
                over_time.restart(self.model.info.window_s)
                self._over_time = over_time

    def _feed_for(self, model: TerrainModel) -> WindowFeed:
        """Return what cuts the windows of another model: what cuts them now, where both take the same windows."""
        same = ("channels", "rate_hz", "least_rate_hz", "rule", "filter")
        if self.model is not None and all(
            getattr(model.info, n) == getattr(self.model.info, n) for n in same
        ):
            return self._feed
        return self._feed_of(model)

    def _begin(self, model: TerrainModel, feed: WindowFeed, session: SessionStart | None = None) -> None:
        self.model, self._feed = model, feed
        self._over_time = None if model.over_time is None else LiveTerrainFilter(model.over_time)
        self.settled = self._over_time is not None
        self._due_s = math.inf
        self._waiting.append(_Part(session or SessionStart(model), feed, deque()))
        self._do_what_waits()

    def _do_what_waits(self) -> None:
        if self._thread is None:
            self._work()
        else:
            with suppress(RuntimeError):  # the thread has ended
                self._thread.submit(self._work_beside)

    def _work_beside(self) -> None:
        """Do what waits, on the thread: what is raised there reaches no caller, so that it is counted by its type."""
        try:
            self._work()
        except Exception as error:  # of one window: the next are served
            self._lost[f"window: lost to a fault, {type(error).__name__}"] += 1

    def take(self, readings: Mapping[str, Reading], estimates: Sequence[LiveEstimate]) -> list[WindowOutput]:
        """Take readings and estimates; return the outputs of windows that are there by now."""
        if self.model is None:
            return []
        self._waiting.append((readings, estimates))
        n = len(self._waiting)
        if n > MAX_WAITING:  # the oldest step is left out; a model that waits before it is taken first
            with suppress(IndexError):  # the thread has just taken it
                oldest = self._waiting.popleft()
                if isinstance(oldest, _Part):
                    self._waiting.appendleft(oldest)
                else:
                    self._lost["steps: overrun"] += 1
        stamps = [last_stamp_s(readings, stream) for stream in readings] + [
            one.time_s for one in estimates[-1:]
        ]
        # False for NaN, of a stream without a stamp
        if self._thread is None or n % AT_MOST == 0 or any(stamp_s >= self._due_s for stamp_s in stamps):
            self._do_what_waits()
        self.outputs = outputs = [self._finished.popleft() for _ in range(len(self._finished))]
        self.failed.update(output.refused for output in outputs if output.refused)
        return outputs

    def _work(self) -> None:
        """Cut and classify what waits."""
        try:
            while self._waiting:
                taken = self._waiting.popleft()
                if isinstance(taken, _Part):
                    self._part = taken
                elif self._part is not None:
                    for window in self._part.feed.push(*taken):
                        model = self._part.session.take(window)
                        self._finished.append(classify_window(model, window, self._part.recent))
                        self.adapted = "" if model.adaptation is None else model.adaptation.found
        finally:
            if self._part is not None:
                due_s = self._part.feed.due_s  # minus infinity before all streams have begun
                self._due_s = due_s if math.isfinite(due_s) else math.inf
                self._counts = self._part.feed.dropped

    def update(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> list[TerrainEstimate]:
        """Return the terrain at the end of each window whose output is there by now."""
        found = []
        for output in self.take(sample.readings, estimates):
            terrain, probability = output.terrain, output.probability
            if self._over_time is not None:
                if self.model is not None and tuple(output.probabilities) != self.model.info.classes:
                    continue  # of the model before, of other terrains: no evidence for the filter of this one
                classes, probabilities = zip(*output.probabilities.items(), strict=True)
                unknown = (
                    not output.refused and not output.terrain
                )  # the window is like none that was learned
                (evidence,) = as_evidence(np.array([probabilities]), np.array([output.reason], dtype=object))
                best, probability = self._over_time.take(output.end_s, evidence, output.novelty, unknown)
                terrain = classes[best] if best >= 0 else UNKNOWN
            elif output.refused:
                continue
            reason = "" if terrain else output.reason
            found.append(TerrainEstimate(output.end_s, terrain, probability, reason))
        return found
