"""Stretches of a run that look like another terrain than their label, while the rest of the run does not.

A robot that is stuck, a label that ends too late, or a patch of other ground shows as several held-out
windows in a row in which the label is improbable and one other class is probable throughout.  Single windows
are wrong now and then and are no stretch; a run that looks like another terrain as a whole is not recognised,
which accuracy tells, and does not break away from itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.classify.held_out import HeldOut
from terrain.records import Array, Windows

LEAST_S = 6.0
"""Shortest stretch: three windows of 2 s, as two wrong ones in a row are common in a class of 80 %
accuracy."""

LABEL_MOST = 0.2
"""Mean probability of the label in the stretch, at most: that of a guess among five classes."""

OTHER_LEAST = 0.5
"""Probability of the other class in each window of the stretch, at least: above all others together."""

REST_LEAST = 0.5
"""Mean probability of the label in the rest of the run, at least: otherwise nothing is broken away from."""


class Breakaway(NamedTuple):
    """A stretch of a run that looks like another terrain than its label, unlike the rest of the run.

    Parameters
    ----------
    start_s, end_s : of its first and its last window
    probability, label_probability : means over its windows, of the terrain that it looks like and of the label
    rest_probability : mean of the label's probability over the rest of the run
    """

    run_id: str
    start_s: float
    end_s: float
    label: str
    looks_like: str
    probability: float
    label_probability: float
    rest_probability: float


def breakaways(held_out: HeldOut, windows: Windows) -> tuple[Breakaway, ...]:
    """Return the stretches that break away by their mean held-out probabilities, the surest first.

    Parameters
    ----------
    held_out : probabilities of the windows
    windows : n windows
    """
    run_id, probability = windows.run_id.astype(str), held_out.probability.mean(axis=0)
    found = []
    for run in np.unique(run_id).tolist():
        for label in np.unique(held_out.truth[run_id == run]).tolist():
            rows = np.flatnonzero((run_id == run) & (held_out.truth == label))
            rows = rows[np.argsort(windows.start_s[rows], kind="stable")]
            of_run = probability[rows], windows.start_s[rows], windows.length_s
            found += stretches(run, label, held_out.classes, *of_run)
    return tuple(sorted(found, key=lambda each: -each.probability * (each.end_s - each.start_s)))


def stretches(
    run_id: str, label: str, classes: Array, probability: Array, start_s: Array, length_s: float
) -> list[Breakaway]:
    """Return the stretches of one run under one label that break away, in order of time.

    Parameters
    ----------
    run_id, label : run and its terrain
    classes : (k,) sorted
    probability : (n, k) held-out class probabilities of the run's windows
    start_s : (n,) start of each window, in order
    length_s : of a window

    Examples
    --------
    >>> probability = np.repeat([[0.9, 0.1], [0.05, 0.95], [0.8, 0.2]], [10, 4, 10], axis=0)
    >>> classes = np.array(["ice", "snow"])
    >>> [found] = stretches("a", "ice", classes, probability, 2.0 * np.arange(24), 2.0)
    >>> found.start_s, found.end_s, found.looks_like, round(found.rest_probability, 2)
    (20.0, 28.0, 'snow', 0.85)
    """
    column = int(np.searchsorted(classes, label))
    best = probability.argmax(axis=1)
    other = (best != column) & (probability.max(axis=1, initial=0.0) >= OTHER_LEAST)
    state = np.where(other, best, -1)
    apart = np.diff(start_s) > 2.0 * length_s  # windows on both sides of a pause are no stretch
    first = np.flatnonzero(np.concatenate(([True], (np.diff(state) != 0) | apart)))
    found = []
    for begin, end in zip(first, np.append(first[1:], len(state)), strict=True):
        inside = np.zeros(len(state), dtype=bool)
        inside[begin:end] = True
        lasts_s = float(start_s[end - 1] + length_s - start_s[begin]) if len(state) else 0.0
        if not len(state) or state[begin] < 0 or lasts_s < LEAST_S - 1e-6 or inside.all():
            continue
        label_ratio = float(probability[inside, column].mean())
        rest_ratio = float(probability[~inside, column].mean())
        if label_ratio <= LABEL_MOST and rest_ratio >= REST_LEAST:
            found.append(
                Breakaway(
                    run_id,
                    float(start_s[begin]),
                    float(start_s[end - 1] + length_s),
                    label,
                    str(classes[state[begin]]),
                    float(probability[inside, state[begin]].mean()),
                    label_ratio,
                    rest_ratio,
                )
            )
    return found
