"""A trained model, and what it says of windows.

A window is *unknown* where it is less like all learned terrains than nearly all known windows are
(:mod:`terrain.classify.limits`), or the ground answers as none of them does (:mod:`terrain.classify.answers`), and
*unsupported* where few training runs drove the predicted
terrain like this (:mod:`terrain.classify.limits`).  Of windows of known terrains,
5 % are unknown by definition.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from features.answers import answers_of
from features.motion import window_motion
from features.windows import Layout, SteadyMotion, WindowRule, join_windows
from pipelines.report.results import described
from terrain.classify.adaptation import CERTAIN, Adaptation, adapt, corrected, corrections, start_of
from terrain.classify.answers import Answers, best_misfit, over_manoeuvre, rarities
from terrain.classify.limits import (
    LEVEL,
    SUPPORTED,
    Novelty,
    SupportTable,
    conformal_sets,
    supported_probability,
)
from terrain.classify.proposals import TakenOver
from terrain.classify.terrain_filter import NOVELTY_WEIGHTS, SHARE_POWERS, FilterSettings
from terrain.errors import DataError
from terrain.records import Array, Windows

NOTHING_TO_ADAPT = "the model knows no levels of currents or vibration that it could adapt by: train it anew"


@dataclass(frozen=True)
class ModelInfo:
    """How the training windows of a model were cut, as those of a new log must be, and where they came from."""

    classes: tuple[str, ...] = described("terrains, in the order of the probabilities")
    class_ratio: Mapping[str, float] = described("share of each terrain among the training windows")
    window_s: float = described("length of a window", "s")
    stride_s: float | None = described("from window to window; one length where it is none", "s")
    steady: SteadyMotion | None = described("limits of steady motion; None where all windows are kept")
    channels: Mapping[str, tuple[str, ...]] = described("channels that a log must have, by stream")
    rate_hz: Mapping[str, float] = described("their rates", "Hz")
    least_rate_hz: Mapping[str, float] = described(
        "lowest rates from which they are resampled; their own where none is shown not to matter", "Hz"
    )
    run_digests: tuple[str, ...] = described("digest of each training run")
    run_accuracy: Mapping[str, float] = described("of each training run when held out, by its digest", "1")
    package_version: str = described("of the package that trained it")
    recipe: str = described("what was trained")
    signal_sets: tuple[str, ...] = described("whose channels the features use")
    seed: int = described("deals runs into folds")
    data_digest: str = described("digest of the training runs", default="")
    dataset: str = described("name of the training data", default="")
    commit: str = described("of the code", default="")
    robots: tuple[str, ...] = described("robots whose runs it was trained on", default=())
    filter: str = described("filter whose estimates it uses; empty where it uses none", default="")
    own_code: tuple[str, ...] = described("MODULE.NAME of all that it needs beside the package", default=())
    conformal: float | None = described("threshold of the sets of terrains, None without", default=None)
    share_power: float | None = described(
        "power of the class ratios that the terrain filter divides by; None where single windows are better",
        default=SHARE_POWERS[0],
    )
    novelty_weight: float = described(
        "of the novelty's log-likelihood in the terrain filter", default=NOVELTY_WEIGHTS[0]
    )
    known_refused: tuple[float, float, float] | None = described(
        "part of held-out windows of learned terrains that is called unknown, and its interval of 95 % over units; "
        "None where not measured",
        "1",
        default=None,
    )
    taken_over: tuple[TakenOver, ...] = described("wrong proposals of labels for held-out runs", default=())

    @property
    def layout(self) -> Layout:
        """Channels and rates that a log must have."""
        return Layout(self.channels, self.rate_hz, {**self.rate_hz, **self.least_rate_hz})

    @property
    def rule(self) -> WindowRule:
        """How windows must be cut."""
        return WindowRule(self.window_s, self.stride_s, self.steady)

    @property
    def cut_words(self) -> str:
        """How windows must be cut, in words."""
        motion = "all motion" if self.steady is None else "steady motion"
        return f"{self.window_s:g} s every {self.rule.step_s:g} s, {motion}"


class TerrainModel(NamedTuple):
    """A fitted recipe, and how its training windows were cut.

    ``recipe`` has ``predict_proba(windows)``, ``classes_`` and ``matrix`` of features.  ``novelty``, ``support`` and
    ``answers`` are None of training runs that give none; ``over_time`` are the settings of the filter of its outputs,
    where they are to be filtered; ``adaptation`` is what was learned of sessions, and the shift of the present one.
    """

    recipe: Any
    info: ModelInfo
    novelty: Novelty | None = None
    support: SupportTable | None = None
    over_time: FilterSettings | None = None
    adaptation: Adaptation | None = None
    answers: Answers | None = None

    def adapt(self, windows: Windows, terrain: str = "") -> TerrainModel:
        """Return the model for a session, of which there are some windows: all on one terrain, or on what is not known.

        Raises
        ------
        ConfigError
            if the terrain was not learned.
        DataError
            if the windows are too few or lack a channel, or the model has nothing to adapt by.
        """
        if self.adaptation is None:
            raise DataError(NOTHING_TO_ADAPT)
        return self._replace(adaptation=adapt(self.adaptation, windows, terrain))

    def at_start(self, terrain: str = "") -> TerrainModel:
        """Return the model as a session begins with it: its first 20 s adapt it, on a terrain or none that is known.

        Errors as :meth:`adapt`.
        """
        if self.adaptation is None:
            raise DataError(NOTHING_TO_ADAPT)
        return self._replace(adaptation=self.adaptation.of_start(terrain))


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
        return Assessed(*(np.concatenate(each) for each in zip(*parts, strict=True)))

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


def with_start(model: TerrainModel, adapt: str, terrain: str) -> TerrainModel:
    """Return a model as sessions begin with it.

    Parameters
    ----------
    adapt : ``start``, which adapts; ``spread``, the spread of sessions throughout; ``none``; empty: ``start`` where
        that is shown to help, unless the model is one that was adapted and saved
    terrain : of each start; errors as :meth:`TerrainModel.at_start`
    """
    known = model.adaptation
    if adapt == "none" and known is not None:
        return model._replace(adaptation=known._replace(start=None, shift=None))
    unasked = not adapt and known is not None and known.shown and known.shift is None
    if adapt not in ("start", "spread") and not unasked:
        return model
    begun = model.at_start(terrain)
    if adapt != "spread":
        return begun
    assert begun.adaptation is not None
    return begun._replace(adaptation=begun.adaptation._replace(start=None))


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
    answering: dict[int, str] = {}
    if (laws := model.answers) is not None:
        misfits, end_s, run = (
            laws.misfits(answers_of(windows)),
            windows.start_s + windows.length_s,
            windows.run_id,
        )
        earlier, earlier_s = recent or (misfits[:0], end_s[:0])
        run = np.concatenate([np.repeat(run[:1], len(earlier_s)), run])
        all_misfits, all_s = np.concatenate([earlier, misfits]), np.concatenate([earlier_s, end_s])
        over = over_manoeuvre(all_misfits, all_s, run)[len(earlier_s) :]
        answers = best_misfit(over)
        rare = rarities(laws.reference, np.stack([novelty, answers], axis=1))
        unknown = (np.linalg.norm(rare, axis=1) > laws.threshold) | (
            np.isnan(novelty) & (model.novelty is not None)
        )
        answering = {
            row: laws.reason(over[row], str(model.recipe.classes_[probability[row].argmax()]))
            for row in np.flatnonzero(unknown & (rare[:, 1] > 0.0) & (rare[:, 1] >= rare[:, 0])).tolist()
        }
    reason = np.array(
        [answering.get(row, NOT_LIKE if each else "") for row, each in enumerate(unknown)], dtype=object
    )
    if model.adaptation is not None and model.adaptation.shift is not None:
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
    if model.adaptation is not None and model.adaptation.shift is not None:
        values, of_terrain = corrections(model.adaptation)
        windows = corrected(model.adaptation, windows, values)
    features = novelty = None
    if model.novelty is not None:
        features = recipe[0].features_of(windows)
        novelty = model.novelty.score(features)
    from_features = getattr(recipe, "probabilities", None)  # takes features that are there already
    probability = np.asarray(
        recipe.predict_proba(windows) if from_features is None else from_features(windows, features)
    )
    if of_terrain is not None:
        probability = np.einsum("ink,ik->nk", probability.reshape(-1, n, probability.shape[1]), of_terrain)
        probability /= probability.sum(axis=1, keepdims=True)
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
    if model.adaptation is not None and model.adaptation.shift is not None:
        order = np.argsort(-probability, axis=1)
        before = np.cumsum(np.take_along_axis(probability, order, axis=1), axis=1)
        n_needed = (before < LEVEL).sum(axis=1) + 1
        return [tuple(classes[np.sort(each[:n])].tolist()) for each, n in zip(order, n_needed, strict=True)]
    return [tuple(classes[row].tolist()) for row in conformal_sets(probability, model.info.conformal)]
