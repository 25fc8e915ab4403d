"""What a model says of windows, those of a session in order of time.

A window is *unknown* where it is less like all learned terrains than nearly all known windows are
(:mod:`terrain.classify.limits`), or the ground answers as none of them does (:mod:`terrain.classify.answers`), and
*unsupported* where few training runs drove the predicted
terrain like this (:mod:`terrain.classify.limits`).  Of windows of known terrains,
5 % are unknown by definition.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from features.answers import answers_of
from features.motion import window_motion
from features.windows import join_windows
from pipelines.live.model import TerrainModel
from terrain.classify.adaptation import CERTAIN, averaged, corrected, corrections, start_of
from terrain.classify.answers import best_misfit, over_manoeuvre
from terrain.classify.limits import LEVEL, SUPPORTED, conformal_sets, rarities, supported_probability
from terrain.errors import DataError
from terrain.records import Array, Windows


class Assessed(NamedTuple):
    """Outputs of a model for n windows."""

    probability: Array  #: (n, k) in the order of the model's classes
    novelty: Array  #: (n,) score; NaN where the model has none
    unknown: Array  #: (n,) whether the window is like no terrain that was learned
    #: (n,) whether training runs near the window's motion support the prediction; NaN where not counted
    supported: Array
    #: (n,) misfit of the terrain that explains best how the ground answered in the manoeuvre; NaN without laws
    answers: Array
    reason: Array  #: (n,) why a window is unknown, in words; empty where it is not
    misfits: Array  #: (n, k, q) of each window alone, as :meth:`Answers.misfits`; (n, 0, 0) without laws

    @classmethod
    def join(cls, parts: Sequence[Assessed]) -> Assessed:
        """Return the outputs for windows of several parts, one after the other."""
        return cls(*map(np.concatenate, zip(*parts, strict=True)))


class Recent(NamedTuple):
    """Misfits (m, k, q) of the windows of a run before those that are assessed, and their ends (m,)."""

    misfits: Array
    end_s: Array


#: How much less likely a learned terrain is than another where the laws raise the alarm: they do so in 0.05 of the
#: windows of a Warthog on learned terrains, and in 0.7 where its yaw rate is halved.
ANSWERS_OTHERWISE = 0.05 / 0.7
NOT_LIKE = "no learned terrain looks like this"
NOT_CERTAIN = f"as the session is adapted to, no terrain has a probability of {CERTAIN:g}"


def as_evidence(probability: Array, reason: Array) -> Array:
    """Return probabilities (n, k) for a filter over time: of learned terrains less, where the laws of response say so.

    The state "unknown" gains as much; what the looks say of it goes through the filter's own weight of novelty.
    """
    by_laws = [each not in ("", NOT_LIKE, NOT_CERTAIN) for each in reason]
    return np.where(np.array(by_laws)[:, None], ANSWERS_OTHERWISE, 1.0) * probability


def assess(model: TerrainModel, windows: Windows, recent: Recent | None = None) -> Assessed:
    """Return what a model says of windows, those of a run in order of time.

    Parameters
    ----------
    recent : earlier windows of the run of the first window

    Raises
    ------
    DataError
        if the windows are not those that the model requires.
    """
    answers = supported = np.full(len(windows), np.nan)
    probability, novelty, windows = _outputs(model, windows)
    unknown, misfits = np.zeros(len(windows), dtype=bool), np.zeros((len(windows), 0, 0))
    if model.novelty is not None:
        unknown = ~(novelty <= model.novelty.threshold)
    reason = np.full(len(windows), "", dtype=object)
    if (laws := model.answers) is not None:
        misfits, end_s = laws.misfits(answers_of(windows)), windows.start_s + windows.length_s
        earlier, earlier_s = recent or (misfits[:0], end_s[:0])
        run = np.concatenate([np.repeat(windows.run_id[:1], len(earlier_s)), windows.run_id])
        all_misfits, all_s = np.concatenate([earlier, misfits]), np.concatenate([earlier_s, end_s])
        over = over_manoeuvre(all_misfits, all_s, run)[len(earlier_s) :]
        answers = best_misfit(over)
        rare = rarities(laws.reference, np.stack([novelty, answers], axis=1))
        unknown = (np.linalg.norm(rare, axis=1) > laws.threshold) | (
            np.isnan(novelty) & (model.novelty is not None)
        )
        for row in np.flatnonzero(unknown & (rare[:, 1] > 0.0) & (rare[:, 1] >= rare[:, 0])):
            reason[row] = laws.reason(over[row], str(model.recipe.classes_[probability[row].argmax()]))
    reason[unknown & (reason == "")] = NOT_LIKE
    if model.session_shift is not None:
        doubtful = ~(probability.max(axis=1) >= CERTAIN)
        reason[doubtful & ~unknown], unknown = NOT_CERTAIN, unknown | doubtful
    if model.support is not None and (motion := window_motion(windows)) is not None:
        near = model.support.near_runs(motion.speed_mps, motion.yaw_rate_radps)
        supported = (supported_probability(probability, near) >= SUPPORTED).astype(float)
    return Assessed(probability, novelty, unknown, supported, answers, reason, misfits)


def _outputs(model: TerrainModel, windows: Windows) -> tuple[Array, Array, Windows]:
    """Return probabilities (n, k), the score of novelty (n,), NaN without one, and the windows.

    Of an adapted model, probabilities are averages over the corrections that are possible, and windows, with their
    novelty, are as the most likely correction for their most probable terrain has them.
    """
    recipe, n, of_terrain = model.recipe, len(windows), None
    if model.session_shift is not None:
        values, of_terrain = corrections(model.session_shift)
        windows = corrected(model.session_shift, windows, values)
    features = novelty = None
    if model.novelty is not None:
        features = recipe[0].features_of(windows)
        novelty = model.novelty.score(features)
    from_features = getattr(recipe, "probabilities", None)  # takes features that are there already
    probability = np.asarray(
        recipe.predict_proba(windows) if from_features is None else from_features(windows, features)
    )
    if of_terrain is not None:
        probability = averaged(probability, of_terrain)
        row = (of_terrain > 0.0).argmax(axis=0)[probability.argmax(axis=1)] * n + np.arange(n)
        windows, novelty = windows[row], None if novelty is None else novelty[row]
    return probability, np.full(n, np.nan) if novelty is None else novelty, windows


def class_sets(model: TerrainModel, probability: Array) -> list[tuple[str, ...]] | None:
    """Return the classes of each window that hold the true one in 90 % of windows; None if not calibrated.

    Of an adapted model they are the most probable ones that have 90 % together: its probabilities hold what of the
    session is not known, which the threshold of training does not.

    Parameters
    ----------
    model : whose threshold was calibrated on held-out runs
    probability : (n, k)
    """
    if model.info.conformal is None:
        return None
    classes = np.asarray(model.info.classes)
    if model.session_shift is not None:
        order = np.argsort(-probability, axis=1)
        before = np.cumsum(np.take_along_axis(probability, order, axis=1), axis=1)
        n_needed = (before < LEVEL).sum(axis=1) + 1
        return [tuple(classes[np.sort(each[:n])].tolist()) for each, n in zip(order, n_needed, strict=True)]
    return [tuple(classes[row].tolist()) for row in conformal_sets(probability, model.info.conformal)]


class SessionStart:
    """The model for the windows of one session, in order of time: adapted by those of its start.

    Attributes
    ----------
    model : for windows from now on; that of the service where it takes no start

    Notes
    -----
    A start of too few windows leaves what a session begins with.
    """

    def __init__(self, model: TerrainModel) -> None:
        self.model = model
        self._kept: list[Windows] | None = []
        if model.adaptation is None or model.adaptation.start is None:
            self._kept = None

    @property
    def over(self) -> bool:
        """Whether no window is waited for any longer."""
        return self._kept is None

    def assess(self, windows: Windows) -> Assessed:
        """Return what :func:`assess` says of windows that follow those taken before."""
        if self._kept is None or not len(windows):
            return assess(self.model, windows)
        start = start_of(join_windows([*self._kept, windows]))[-len(windows) :]
        parts: list[Assessed] = []
        for each in (windows[start], windows[~start]):
            if len(each):
                before = (
                    Recent(parts[0].misfits, windows.start_s[start] + windows.length_s) if parts else None
                )
                parts.append(assess(self.take(each), each, before))
        return Assessed.join(parts)

    def take(self, windows: Windows) -> TerrainModel:
        """Return the model for windows that follow those taken before, all within or all after the start."""
        if self._kept is None or not len(windows):
            return self.model
        kept, self._kept = [*self._kept, windows], None
        if start_of(join_windows(kept))[-1]:
            self._kept = kept
        elif len(kept) > 1:
            assert self.model.adaptation is not None
            with suppress(DataError):  # too few windows
                terrain = self.model.adaptation.start or ""
                self.model = self.model.adapt(join_windows(kept[:-1]), terrain)
        return self.model
