"""What a classifier knows of its own limits: when a window is unknown, which sets hold the truth, what was driven."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from terrain.classify.conformal import conformal_threshold, held_out_scores
from terrain.classify.novelty import NoveltyNumbers, NoveltyScore
from terrain.classify.support import SupportTable, learn_support
from terrain.errors import DataError
from terrain.records import Array


class Limits(NamedTuple):
    """Limits of a classifier, each None where the training windows do not give it.

    Parameters
    ----------
    novelty : score of windows that are like no terrain that was learned
    support : training runs by terrain and motion
    conformal : threshold of the sets of classes
    notes : why one is missing
    """

    novelty: NoveltyNumbers | None
    support: SupportTable | None
    conformal: float | None
    notes: tuple[str, ...]


def learn_limits(
    classifier: Any,
    features: Array,
    terrain: Array,
    run_id: Array,
    motion: tuple[Array, Array] | None,
    gap: int = 1,
    seed: int = 0,
) -> Limits:
    """Return the limits of a classifier, as far as its training windows give them.

    Parameters
    ----------
    classifier : fitted on the windows, with its out-of-fold probabilities as ``inner_probability_``
    features, terrain, run_id : (n, f), (n,) and (n,) of the training windows
    motion : speed in m/s and yaw rate in rad/s (n,) of each; None where that is not known
    gap : windows on either side of a window that may share samples with it
    seed : deals runs into inner folds
    """
    notes = []
    novelty = conformal = support = None
    try:
        novelty = NoveltyScore(gap=gap, seed=seed).fit(features, terrain, run_id).numbers_
    except DataError as error:
        notes.append(f"no window is ever called unknown: {error}")
    try:
        conformal = conformal_threshold(held_out_scores(classifier, terrain), run_id)
    except (AttributeError, DataError) as error:
        notes.append(f"no sets of terrains: {error}")
    if motion is not None:
        support = learn_support(*motion, terrain, run_id, np.unique(terrain).tolist())
    return Limits(novelty, support, conformal, tuple(notes))
