"""Stretches of a run that look like another terrain than their label, while the rest of the run does not.

A robot that is stuck, a label that ends too late, or a patch of other ground shows as several held-out
windows in a row in which the label is improbable and one other class is probable throughout.  Single windows
are wrong now and then and are no stretch; a run that looks like another terrain as a whole is not recognised,
which accuracy tells, and does not break away from itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.records import Array

LEAST_S = 6.0
"""Shortest stretch: three windows of 2 s, as two wrong ones in a row are common in a class of 80 %
accuracy."""

LABEL_MOST = 0.2
"""Mean probability of the label in the stretch, at most: that of a guess among five classes."""

OTHER_LEAST = 0.5
"""Probability of the other class in each window of the stretch, at least: above all others together."""

REST_LEAST = 0.5
"""Mean probability of the label in the rest of the run, at least: otherwise nothing is broken away from."""


class Stretch(NamedTuple):
    """A stretch that breaks away.

    Parameters
    ----------
    start_s, end_s : of its first and its last window
    looks_like : column of the class that it looks like
    probability, label_probability : means over its windows, of that class and of the label
    rest_probability : mean of the label's probability over the rest of the run
    """

    start_s: float
    end_s: float
    looks_like: int
    probability: float
    label_probability: float
    rest_probability: float


def breakaways(probability: Array, label: int, start_s: Array, length_s: float) -> list[Stretch]:
    """Return the stretches of one run under one label that break away, in order of time.

    Parameters
    ----------
    probability : (n, k) held-out class probabilities of the run's windows
    label : column of the run's label
    start_s : (n,) start of each window, in order
    length_s : of a window

    Examples
    --------
    >>> probability = np.repeat([[0.9, 0.1], [0.05, 0.95], [0.8, 0.2]], [10, 4, 10], axis=0)
    >>> [found] = breakaways(probability, 0, 2.0 * np.arange(24), 2.0)
    >>> found.start_s, found.end_s, found.looks_like, round(found.rest_probability, 2)
    (20.0, 28.0, 1, 0.85)
    """
    best = probability.argmax(axis=1)
    other = (best != label) & (probability.max(axis=1, initial=0.0) >= OTHER_LEAST)
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
        label_ratio = float(probability[inside, label].mean())
        rest_ratio = float(probability[~inside, label].mean())
        if label_ratio <= LABEL_MOST and rest_ratio >= REST_LEAST:
            found.append(
                Stretch(
                    float(start_s[begin]),
                    float(start_s[end - 1] + length_s),
                    int(state[begin]),
                    float(probability[inside, state[begin]].mean()),
                    label_ratio,
                    rest_ratio,
                )
            )
    return found
