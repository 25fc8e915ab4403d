"""Classification of single windows: at once, or on a thread of its own that no control step waits for."""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from collections.abc import Callable
from time import perf_counter
from typing import Any, NamedTuple, Protocol

import numpy as np

from pipelines.models.model_files import TerrainModel
from terrain.errors import DataError
from terrain.records import Array, Windows

MAX_WAITING = 4
"""Windows of one robot that may wait for the thread; of more, the oldest is left out and counted."""


class WindowOutput(NamedTuple):
    """What a model says of a window.

    Parameters
    ----------
    start_s, end_s : of the window, on the clock of its stamps
    terrain, probability : class of the largest probability; empty and NaN where the window was refused
    probabilities : (k,) in the order of ``classes``
    classes : of the model
    refused : why there is no output; empty where there is one
    took_s : time of features and classifier
    """

    start_s: float
    end_s: float
    terrain: str
    probability: float
    probabilities: Array
    classes: tuple[str, ...]
    refused: str = ""
    took_s: float = math.nan


def classify_window(model: TerrainModel, window: Windows) -> WindowOutput:
    """Return the output of a model for one window; one that it refuses gives none, and raises nothing."""
    classes = model.info.classes
    start_s = float(window.start_s[0])
    started_s, refused = perf_counter(), ""
    recipe: Any = model.recipe
    try:
        probabilities = np.asarray(recipe.predict_proba(window)[0])
        if not np.isfinite(probabilities).all():
            refused = "a probability is not finite"
    except (ValueError, ArithmeticError, DataError) as error:  # broken samples must not stop the loop
        refused = str(error)
    took_s = perf_counter() - started_s
    end_s = start_s + window.length_s
    if refused:
        nothing = np.full(len(classes), math.nan)
        return WindowOutput(start_s, end_s, "", math.nan, nothing, classes, refused, took_s)
    best = int(probabilities.argmax())
    found = str(recipe.classes_[best]), float(probabilities[best])
    return WindowOutput(start_s, end_s, *found, probabilities, classes, "", took_s)


class Classifying(Protocol):
    """Takes windows, and gives their outputs some time later."""

    def submit(self, model: TerrainModel, window: Windows) -> None:
        """Take a window."""
        ...

    def finished(self) -> list[WindowOutput]:
        """Return the outputs since the last call, in the order of their windows."""
        ...

    @property
    def n_overrun(self) -> int:
        """Number of windows that were left out, as too many waited."""
        ...


class AtOnce:
    """Classifies each window as it is submitted: for logs and simulations, which can wait."""

    n_overrun = 0

    def __init__(self) -> None:
        self._finished: list[WindowOutput] = []

    def submit(self, model: TerrainModel, window: Windows) -> None:
        """Classify a window."""
        self._finished.append(classify_window(model, window))

    def finished(self) -> list[WindowOutput]:
        """Return the outputs since the last call."""
        found, self._finished = self._finished, []
        return found


class ClassifierThread:
    """A thread that classifies the windows of any number of robots, one after the other.

    Parameters
    ----------
    classify : what is done with a window

    Examples
    --------
    >>> thread = ClassifierThread()
    >>> robot = thread.robot()
    >>> robot.finished(), robot.n_overrun
    ([], 0)
    >>> thread.stop()
    """

    def __init__(self, classify: Callable[[TerrainModel, Windows], WindowOutput] = classify_window) -> None:
        self._classify = classify
        self._due: deque[_OfRobot] = deque()
        self._changed = threading.Condition()
        self._stopped = False
        self.failures: Counter[str] = Counter()
        self._thread = threading.Thread(target=self._run, name="classifier", daemon=True)
        self._thread.start()

    def robot(self) -> _OfRobot:
        """Return what takes the windows of one robot, and gives their outputs."""
        return _OfRobot(self)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Let the thread finish the window that it is at, and end."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join(timeout_s)

    def due(self, robot: _OfRobot) -> None:
        """Note that a robot has a window."""
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
                robot = self._due.popleft()
            try:
                robot.classify(self._classify)
            except Exception as error:  # of one window: the thread serves the next
                self.failures[type(error).__name__] += 1


class _OfRobot:
    """The windows of one robot, on a thread that several share."""

    def __init__(self, thread: ClassifierThread) -> None:
        self._thread = thread
        self._waiting: deque[tuple[TerrainModel, Windows]] = deque()
        self._finished: deque[WindowOutput] = deque()
        self.n_overrun = 0

    def submit(self, model: TerrainModel, window: Windows) -> None:
        """Queue a window; where too many wait, the oldest is left out."""
        if len(self._waiting) >= MAX_WAITING:
            try:
                self._waiting.popleft()
                self.n_overrun += 1
            except IndexError:  # the thread has just taken it
                pass
        self._waiting.append((model, window))
        self._thread.due(self)

    def finished(self) -> list[WindowOutput]:
        """Return the outputs since the last call."""
        found = []
        while self._finished:
            found.append(self._finished.popleft())
        return found

    def classify(self, classify: Callable[[TerrainModel, Windows], WindowOutput]) -> None:
        """Classify the oldest window that waits, if one does."""
        try:
            model, window = self._waiting.popleft()
        except IndexError:
            return
        self._finished.append(classify(model, window))
