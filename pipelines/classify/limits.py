"""What a trained model knows of its own limits: novelty score, support, threshold of sets of classes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from features.matrix import FeatureMatrix
from features.motion import NO_MOTION, window_motion
from pipelines.support.evaluate import table_of
from terrain.classify.conformal import conformal_threshold, held_out_scores
from terrain.classify.novelty import NoveltyScore
from terrain.classify.novelty_numbers import NoveltyNumbers
from terrain.classify.support import SupportTable
from terrain.errors import DataError
from terrain.records import Array, Windows


class Limits(NamedTuple):
    """Limits of a model, each None where the training runs do not give it, and why in ``notes``."""

    novelty: NoveltyNumbers | None
    support: SupportTable | None
    conformal: float | None
    notes: tuple[str, ...]


def limits_of(
    classifier: Any, matrix: FeatureMatrix, windows: Windows, group: Array, gap: int, seed: int
) -> Limits:
    """Return the limits of a model that was fitted on windows.

    Parameters
    ----------
    classifier : fitted, with its out-of-fold probabilities as ``inner_probability_``
    matrix : of the features
    windows : labelled, that it was fitted on
    group : (n,) what must not be split, the run of each window
    gap, seed : of the inner folds
    """
    terrain, notes = windows.terrain.astype(str), []
    novelty = conformal = support = None
    try:
        score = NoveltyScore(gap=gap, seed=seed).fit(matrix.of(windows), terrain, group)
        novelty = score.numbers_
    except DataError as error:
        notes.append(f"no window is ever called unknown: {error}")
    try:
        conformal = conformal_threshold(held_out_scores(classifier, terrain), group.astype(str))
    except DataError as error:
        notes.append(f"no sets of terrains: {error}")
    motion = window_motion(windows)
    if motion is None:
        notes.append(f"support: {NO_MOTION}")
    else:
        support = table_of(motion, terrain, windows.run_id.astype(str), np.unique(terrain).tolist())
    return Limits(novelty, support, conformal, tuple(notes))
