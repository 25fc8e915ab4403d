"""What a trained model knows of its own limits: novelty score, support, threshold of sets of classes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from features.motion import NO_MOTION, Motion
from pipelines.support.evaluate import table_of
from terrain.classify.conformal import conformal_threshold, held_out_scores
from terrain.classify.novelty import NoveltyScore
from terrain.classify.novelty_numbers import NoveltyNumbers
from terrain.classify.support import SupportTable
from terrain.errors import DataError
from terrain.records import Array


class Limits(NamedTuple):
    """Limits of a model, each None where the training runs do not give it, and why in ``notes``."""

    novelty: NoveltyNumbers | None
    support: SupportTable | None
    conformal: float | None
    notes: tuple[str, ...]


class LimitData(NamedTuple):
    """Labelled windows that a model was fitted on.

    Parameters
    ----------
    features, terrain, run_id : (n, f), (n,) and (n,)
    motion : how the robot moved in each; None where no wheel speed was measured
    """

    features: Array
    terrain: Array
    run_id: Array
    motion: Motion | None


def limits_of(classifier: Any, data: LimitData, gap: int, seed: int) -> Limits:
    """Return the limits of a model that was fitted on windows.

    Parameters
    ----------
    classifier : fitted, with its out-of-fold probabilities as ``inner_probability_``
    data : that it was fitted on
    gap, seed : of the inner folds
    """
    features, terrain, run_id, motion = data
    notes = []
    novelty = conformal = support = None
    try:
        score = NoveltyScore(gap=gap, seed=seed).fit(features, terrain, run_id)
        novelty = score.numbers_
    except DataError as error:
        notes.append(f"no window is ever called unknown: {error}")
    try:
        conformal = conformal_threshold(held_out_scores(classifier, terrain), run_id)
    except DataError as error:
        notes.append(f"no sets of terrains: {error}")
    if motion is None:
        notes.append(f"support: {NO_MOTION}")
    else:
        support = table_of(motion, terrain, run_id, np.unique(terrain).tolist())
    return Limits(novelty, support, conformal, tuple(notes))
