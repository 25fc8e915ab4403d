"""The most likely sequence of grounds under all windows of a run, also those that come later.

For labels, unlike on the robot, the whole run is known: the path of a hidden Markov model (Viterbi 1967)
whose states are the classes, with the class shares of training taken out of the probabilities and a mean time
on one ground as in :mod:`terrain.classify.terrain_filter`.
"""

from __future__ import annotations

import numpy as np

from terrain.classify.terrain_filter import DWELL_S, OUTLIER_RATIO
from terrain.records import Array


def smoothed_classes(probability: Array, time_s: Array, prior: Array, dwell_s: float = DWELL_S) -> Array:
    """Return the class (n,) of each window along the most likely sequence.

    Maximises ``sum_i log((1 - o) p_i(c_i) / prior(c_i) + o) + sum_i log P(c_i | c_i-1, dt_i)`` with the share
    o of windows that follow no class; a ground is kept with ``exp(-dt / dwell)``, and followed by any other
    alike.

    Parameters
    ----------
    probability : (n, k) of windows that do not overlap, in order of time
    time_s : (n,) of the windows
    prior : (k,) shares of the classes among the training windows
    dwell_s : mean time on one ground

    Examples
    --------
    >>> probability = np.array([[0.9, 0.1]] * 4 + [[0.3, 0.7]] + [[0.9, 0.1]] * 4 + [[0.1, 0.9]] * 4)
    >>> smoothed_classes(probability, 2.0 * np.arange(13), np.array([0.5, 0.5])).tolist()
    [0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1]
    """
    n, k = probability.shape
    if n == 0:
        return np.zeros(0, dtype=int)
    evidence = np.log((1.0 - OUTLIER_RATIO) * probability / prior + OUTLIER_RATIO)
    score, origin = evidence[0].copy(), np.zeros((n, k), dtype=int)
    for i in range(1, n):
        kept = np.exp(-max(float(time_s[i] - time_s[i - 1]), 0.0) / dwell_s)
        step = np.full((k, k), np.log((1.0 - kept) / max(k - 1, 1) + 1e-300))
        np.fill_diagonal(step, np.log(kept + 1e-300))
        reached = score[:, None] + step
        origin[i] = reached.argmax(axis=0)
        score = reached.max(axis=0) + evidence[i]
    path = np.empty(n, dtype=int)
    path[-1] = int(score.argmax())
    for i in range(n - 1, 0, -1):
        path[i - 1] = origin[i, path[i]]
    return path
