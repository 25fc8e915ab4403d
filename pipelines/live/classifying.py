"""Cutting and classifying windows: at once, or on a thread of its own that no control step waits for."""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import NamedTuple, Protocol

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


class Part(NamedTuple):
    """A model, and what cuts its windows."""

    model: LiveModel
    feed: WindowFeed


class Classifying(Protocol):
    """Takes what was measured and estimated, and gives the outputs of its windows some time later."""

    def begin(self, part: Part) -> None:
        """Cut and classify from now on with a model; what was taken before is for the model before."""
        ...

    def put(self, readings: Mapping[str, Reading], estimates: Sequence[Estimate]) -> None:
        """Take what came since the last call; the arrays are kept and must not change."""
        ...

    def finished(self) -> list[WindowOutput]:
        """Return the outputs since the last call, in the order of their windows."""
        ...

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows and samples that were not used, as counts by kind."""
        ...


class AtOnce:
    """Cuts and classifies in the caller's own time: for logs and simulations, which can wait."""

    def __init__(self) -> None:
        self._finished: list[WindowOutput] = []
        self._part: Part | None = None

    def begin(self, part: Part) -> None:
        """Go on with a model."""
        self._part = part

    def put(self, readings: Mapping[str, Reading], estimates: Sequence[Estimate]) -> None:
        """Classify the windows that are whole by now."""
        if self._part is not None:
            for window in self._part.feed.push(readings, estimates):
                self._finished.append(classify_window(self._part.model, window))

    def finished(self) -> list[WindowOutput]:
        """Return the outputs since the last call."""
        found, self._finished = self._finished, []
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

    def __init__(self, classify: Callable[[LiveModel, Windows], WindowOutput] = classify_window) -> None:
        self._classify = classify
        self._due: deque[_OfRobot] = deque()
        self._changed = threading.Condition()
        self._stopped = self._working = False
        self.failures: Counter[str] = Counter()
        self._thread = threading.Thread(target=self._run, name="classifier", daemon=True)
        self._thread.start()

    def robot(self) -> _OfRobot:
        """Return what takes the samples of one robot, and gives the outputs of its windows."""
        return _OfRobot(self)

    @property
    def busy(self) -> bool:
        """Whether the thread has something to do."""
        return self._working or bool(self._due)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Let the thread finish the window that it is at, and end."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join(timeout_s)

    def due(self, robot: _OfRobot) -> None:
        """Note that a robot has something to be done."""
        with self._changed:
            self._due.append(robot)
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._due and not self._stopped:
                    self._changed.wait()
                if self._stopped:
                    return
                self._working = True
                robot = self._due.popleft()
            try:
                robot.work(self._classify)
            except Exception as error:  # of one window: the thread serves the next
                self.failures[type(error).__name__] += 1
            self._working = False


_Taken = tuple[Mapping[str, Reading], Sequence[Estimate]]


class _OfRobot:
    """The samples and windows of one robot, on a thread that several share.

    Only the thread touches the feed; both sides share queues whose ends are atomic, and plain numbers.
    """

    def __init__(self, thread: ClassifierThread) -> None:
        self._thread = thread
        self._waiting: deque[_Taken | Part] = deque()
        self._finished: deque[WindowOutput] = deque()
        self._part: Part | None = None
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

    def finished(self) -> list[WindowOutput]:
        """Return the outputs since the last call."""
        found = []
        while self._finished:
            found.append(self._finished.popleft())
        return found

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows and samples that were not used by the last time that the thread worked, by kind."""
        return {**self._counts, "steps: overrun": self._n_overrun} if self._n_overrun else self._counts

    def work(self, classify: Callable[[LiveModel, Windows], WindowOutput]) -> None:
        """Cut and classify what waits; called by the thread."""
        try:
            while self._waiting:
                taken = self._waiting.popleft()
                if isinstance(taken, Part):
                    self._part = taken
                elif self._part is not None:
                    for window in self._part.feed.push(*taken):
                        self._finished.append(classify(self._part.model, window))
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
