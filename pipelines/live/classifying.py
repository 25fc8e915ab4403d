"""Cutting and classifying windows: at once, or on a thread of its own that no control step waits for."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from time import perf_counter
from typing import NamedTuple

import numpy as np

from pipelines.live.model import LiveModel, assess
from pipelines.live.windows import Estimate, WindowFeed
from terrain.control.switching import UNKNOWN
from terrain.records import Array, Reading, Windows

MAX_WAITING = 1000
"""Steps of one robot that may wait for the thread: 20 s; of more, the oldest are left out and counted."""

AT_MOST = 25
"""The thread takes what waits at the end of a window, and before that whenever so many steps wait."""


class WindowOutput(NamedTuple):
    """What a model gives for a window.

    Parameters
    ----------
    start_s, end_s : of the window, on the clock of its stamps
    terrain, probability : class of the largest probability; empty and NaN where the window was refused, empty
        where it is like no terrain that was learned
    probabilities : (k,) in the order of ``classes``
    classes : of the model
    refused : why there is no output; empty where there is one
    took_s : time of features and classifier
    nearest : class of the largest probability also where the terrain is unknown
    novelty : how unlike all learned terrains the window is; NaN where the model has no such score
    supported : whether training runs that drove like this support the class; None where not counted
    """

    start_s: float
    end_s: float
    terrain: str
    probability: float
    probabilities: Array
    classes: tuple[str, ...]
    refused: str = ""
    took_s: float = math.nan
    nearest: str = ""
    novelty: float = math.nan
    supported: bool | None = None

    @property
    def unknown(self) -> bool:
        """Whether the window is like no terrain that was learned."""
        return not self.refused and not self.terrain


def classify_window(model: LiveModel, window: Windows) -> WindowOutput:
    """Return the output of a model for one window; one that it refuses gives none, and raises nothing."""
    classes = model.info.classes
    start_s = float(window.start_s[0])
    started_s, refused = perf_counter(), ""
    try:
        assessed = assess(model, window)
        probabilities = assessed.probability[0]
        if not np.isfinite(probabilities).all():
            refused = "a probability is not finite"
    except Exception as error:  # whatever broken samples lead a recipe to, it must not stop the loop
        refused = str(error) or type(error).__name__
    took_s = perf_counter() - started_s
    end_s = start_s + window.length_s
    if refused:
        nothing = np.full(len(classes), math.nan)
        return WindowOutput(start_s, end_s, "", math.nan, nothing, classes, refused, took_s)
    best = int(probabilities.argmax())
    nearest, supported = str(model.recipe.classes_[best]), assessed.supported[0]
    return WindowOutput(
        start_s,
        end_s,
        UNKNOWN if assessed.unknown[0] else nearest,
        float(probabilities[best]),
        probabilities,
        classes,
        "",
        took_s,
        nearest,
        float(assessed.novelty[0]),
        None if math.isnan(supported) else bool(supported),
    )


Classify = Callable[[LiveModel, Windows], WindowOutput]


class Part(NamedTuple):
    """A model, and what cuts its windows."""

    model: LiveModel
    feed: WindowFeed


class AtOnce:
    """Takes what was measured and estimated, and gives the outputs of its windows: here in the caller's own time.

    For logs and simulations, which can wait; arrays that are taken are kept and must not change.

    Parameters
    ----------
    classify : what is done with a window
    """

    def __init__(self, classify: Classify = classify_window) -> None:
        self._classify = classify
        self._finished: deque[WindowOutput] = deque()
        self._part: Part | None = None

    def begin(self, part: Part) -> None:
        """Cut and classify from now on with a model; what was taken before is for the model before."""
        self._part = part

    def put(self, readings: Mapping[str, Reading], estimates: Sequence[Estimate]) -> None:
        """Classify the windows that are whole by now."""
        if self._part is not None:
            for window in self._part.feed.push(readings, estimates):
                self._finished.append(self._classify(self._part.model, window))

    def finished(self) -> list[WindowOutput]:
        """Return the outputs since the last call, in the order of their windows."""
        found = []
        while self._finished:
            found.append(self._finished.popleft())
        return found

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows and samples that were not used, as counts by kind."""
        return {} if self._part is None else self._part.feed.dropped


class ClassifierThread:
    """A thread that cuts and classifies the windows of any number of robots, one after the other.

    Parameters
    ----------
    classify : what is done with a window

    Examples
    --------
    >>> thread = ClassifierThread()
    >>> robot = thread.robot()
    >>> robot.finished(), robot.dropped
    ([], {})
    >>> thread.stop()
    """

    def __init__(self, classify: Classify = classify_window) -> None:
        self._classify = classify
        self._pool = ThreadPoolExecutor(1, "classifier")
        self._n_due = self._n_done = 0
        self.failures: Counter[str] = Counter()

    def robot(self) -> _OfRobot:
        """Return what takes the samples of one robot, and gives the outputs of its windows."""
        return _OfRobot(self._classify, self)

    @property
    def busy(self) -> bool:
        """Whether the thread has something to do."""
        return self._n_due > self._n_done

    def stop(self) -> None:
        """Let the thread finish the window that it is at, and end."""
        self._pool.shutdown(cancel_futures=True)

    def due(self, robot: _OfRobot) -> None:
        """Note that a robot has something to be done; nothing where the thread has ended."""
        self._n_due += 1
        with suppress(RuntimeError):
            self._pool.submit(self._work, robot)

    def _work(self, robot: _OfRobot) -> None:
        try:
            robot.work()
        except Exception as error:  # of one window: the thread serves the next
            self.failures[type(error).__name__] += 1
        self._n_done += 1


class _OfRobot(AtOnce):
    """The samples and windows of one robot, on a thread that several share.

    Only the thread touches the feed; both sides share queues whose ends are atomic, and plain numbers.
    """

    def __init__(self, classify: Classify, thread: ClassifierThread) -> None:
        super().__init__(classify)
        self._thread = thread
        self._waiting: deque[tuple[Mapping[str, Reading], Sequence[Estimate]] | Part] = deque()
        self._due_s, self._n_overrun = math.inf, 0
        self._counts: Mapping[str, int] = {}

    def begin(self, part: Part) -> None:
        """Go on with a model; ``put`` comes in order with it."""
        self._due_s = math.inf
        self._waiting.append(part)
        self._thread.due(self)

    def put(self, readings: Mapping[str, Reading], estimates: Sequence[Estimate]) -> None:
        """Queue what came; wake the thread where a window may be whole."""
        waiting = self._waiting
        waiting.append((readings, estimates))
        n = len(waiting)
        if n > MAX_WAITING:
            self._leave_out()
        if n % AT_MOST == 0 or _newest_s(readings, estimates) >= self._due_s:
            self._thread.due(self)

    def _leave_out(self) -> None:
        """Remove the oldest step that waits; a model that waits before it is taken first."""
        try:
            oldest = self._waiting.popleft()
            if isinstance(oldest, Part):
                self._waiting.appendleft(oldest)
            else:
                self._n_overrun += 1
        except IndexError:  # the thread has just taken it
            pass

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows and samples that were not used by the last time that the thread worked, by kind."""
        return {**self._counts, "steps: overrun": self._n_overrun} if self._n_overrun else self._counts

    def work(self) -> None:
        """Cut and classify what waits; called by the thread."""
        try:
            while self._waiting:
                taken = self._waiting.popleft()
                if isinstance(taken, Part):
                    super().begin(taken)
                else:
                    super().put(*taken)
        finally:
            if self._part is not None:
                due_s = self._part.feed.due_s  # minus infinity before all streams have begun
                self._due_s = due_s if math.isfinite(due_s) else math.inf
                self._counts = self._part.feed.dropped


def _newest_s(readings: Mapping[str, Reading], estimates: Sequence[Estimate]) -> float:
    """Return the newest stamp, as far as it is in order; minus infinity where there is none."""
    newest_s = estimates[-1].time_s if estimates else -math.inf
    for reading in readings.values():
        try:
            newest_s = max(newest_s, float(reading[0][-1]))
        except (TypeError, ValueError, LookupError):  # broken: the feed counts it
            continue
    return newest_s
