"""Classifying windows, on a thread of its own that no control step waits for."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from time import perf_counter
from typing import NamedTuple

import numpy as np

from pipelines.live.model import LiveModel, assess
from terrain.control.switching import UNKNOWN
from terrain.records import Array, Windows


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


class ClassifierThread:
    """A thread that cuts and classifies the windows of any number of robots, one after the other.

    Parameters
    ----------
    classify : what is done with a window

    Attributes
    ----------
    failures : number of errors that were not foreseen, by type; each costs its window

    Examples
    --------
    >>> thread = ClassifierThread()
    >>> thread.due(lambda: None)
    >>> thread.stop()
    """

    def __init__(self, classify: Callable[[LiveModel, Windows], WindowOutput] = classify_window) -> None:
        self.classify = classify
        self.failures: Counter[str] = Counter()
        self._pool = ThreadPoolExecutor(1, "classifier")
        self._n_due = self._n_done = 0

    @property
    def busy(self) -> bool:
        """Whether the thread has something to do."""
        return self._n_due > self._n_done

    def stop(self) -> None:
        """Let the thread finish the window that it is at, and end."""
        self._pool.shutdown(cancel_futures=True)

    def due(self, work: Callable[[], None]) -> None:
        """Let the thread do the work of a robot; nothing where the thread has ended."""
        self._n_due += 1
        with suppress(RuntimeError):
            self._pool.submit(self._run, work)

    def _run(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:  # of one window: the thread serves the next
            self.failures[type(error).__name__] += 1
        self._n_done += 1
