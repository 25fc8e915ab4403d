"""What a recipe is fitted on: labelled windows, and the runs that they are of."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from features.extractor import FeatureExtractor
from features.motion import window_motion
from features.protocols import Samples, samples_of
from features.recipes import WindowPipeline, feature_matrix
from features.windows import Layout
from pipelines.learn.adaptation import judged_adaptation
from pipelines.learn.model_file import model_info
from pipelines.learn.recipes import recipe_of
from pipelines.learn.settings import RecipeSettings
from pipelines.live.model import ModelInfo, TerrainModel
from terrain.classify.answers import learn_answers
from terrain.classify.held_out import inner_probability
from terrain.classify.limits import (
    Motion,
    conformal_threshold,
    fisher_scores,
    held_out_scores,
    held_out_terms,
    learn_novelty,
    learn_support,
)
from terrain.classify.proposals import TakenOver, held_out_errors
from terrain.classify.terrain_filter import choose_settings, novelty_evidence
from terrain.errors import DataError
from terrain.logs.duplicates import measured_digest
from terrain.logs.run_folders import data_digest
from terrain.logs.schema import ESTIMATED
from terrain.records import Array, RunLog


class TrainedRun(NamedTuple):
    """A run that a model is trained on."""

    #: run_id, robot, filter, digest, measured_digest: of the run; digests are of its content, and of what was measured
    run_id: str
    robot: str
    filter: str
    digest: str
    measured_digest: str
    terrain: str  #: of its windows; several by commas
    n_windows: int  #: of the run


def trained_runs(runs: Iterable[tuple[str, str, str, str, str]], samples: Samples) -> tuple[TrainedRun, ...]:
    """Return what is kept of runs, given by their first fields, in a model trained on their windows."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for run_id, terrain in zip(samples.run_id.tolist(), samples.terrain.tolist(), strict=True):
        counts[run_id][terrain] += 1
    return tuple(TrainedRun(*run, ", ".join(sorted(counts[run[0]])), counts[run[0]].total()) for run in runs)


@dataclass(frozen=True, slots=True, eq=False)
class TrainingData:
    """Labelled windows of runs, and what a recipe, its limits and its judge are made from."""

    samples: Samples  #: the windows; those of a cache have no samples
    layout: Layout  #: channels and rates that a log must have
    recipe: WindowPipeline  #: whose steps before the last one are fitted
    rows: Array  #: (n, columns) output of these steps
    motion: Motion | None  #: how the robot moved in each window; None where no wheel speed was measured
    runs: tuple[TrainedRun, ...]  #: those that windows were cut from
    digest: str  #: of the data

    @property
    def features(self) -> Array:
        """Features (n, f) of the windows, which are the rows of most recipes."""
        plain = type(self.recipe[0]) is FeatureExtractor
        return self.rows if plain else self.recipe[0].features_of(self.samples.windows)

    def probabilities(self, model: TerrainModel, rows: Array) -> Array | None:
        """Return what a model gives for some windows (m, k); None where it cannot be applied to them.

        It cannot where windows have other rates than its own, and those without samples where it needs
        samples or other features.
        """
        windows, recipe = self.samples.windows, model.recipe
        if windows.values:
            try:
                return np.asarray(recipe.predict_proba(windows[rows]))
            except DataError:
                return None
        if type(recipe[0]) is not FeatureExtractor or not recipe[0].equals(self.recipe[0]):
            return None
        return np.asarray(recipe[-1].predict_proba(self.rows[rows]))


def data_of_runs(runs: Sequence[RunLog], settings: RecipeSettings) -> TrainingData:
    """Return what a recipe is fitted on, of runs; errors as :func:`features.protocols.samples_of`."""
    samples = samples_of(runs, settings.rule, settings.signal_sets, **settings.reading)
    windows, recipe = samples.windows, recipe_of(settings, settings.recipe)
    digested = [
        (run.run_id, run.robot, run.filter, data_digest([run]), measured_digest(run).hex()) for run in runs
    ]
    return TrainingData(
        samples,
        Layout(windows.channels, windows.rate_hz),
        recipe,
        feature_matrix(recipe, windows),
        window_motion(windows),
        trained_runs(digested, samples),
        data_digest(runs),
    )


def info_of(data: TrainingData, settings: RecipeSettings, dataset: str) -> ModelInfo:
    """Return how the training windows were cut, as those of a new log must be, and where they came from.

    Raises
    ------
    DataError
        if the model uses estimates that several filters made.
    """
    runs = data.runs
    filters = {each.filter for each in runs} if set(ESTIMATED) & set(data.layout.channels) else {""}
    if len(filters) > 1:
        names = " and ".join(sorted(name or "an unknown filter" for name in filters))
        raise DataError(f"the runs hold estimates of {names}: estimate all of them with one filter")
    return model_info(
        data.layout,
        settings.rule,
        data.samples.terrain,
        run_digests=tuple(each.digest for each in runs),
        measured_digests=tuple(each.measured_digest for each in runs),
        recipe=settings.recipe,
        signal_sets=settings.signal_sets,
        seed=settings.seed,
        data_digest=data.digest,
        dataset=dataset,
        robots=tuple(sorted({each.robot for each in runs})),
        filter=filters.pop(),
    )


def with_limits(
    recipe: WindowPipeline, info: ModelInfo, samples: Samples, features: Array, motion: Motion | None
) -> tuple[TerrainModel, tuple[str, ...]]:
    """Return a fitted recipe with what it knows of its own limits, and in sentences which of them are missing.

    Parameters
    ----------
    recipe, info : fitted on the windows, and what is known of it
    samples, features, motion : the windows, their features (n, f), and how the robot moved in each, if known
    """
    notes, conformal, novelty, support, evidence, adaptation = [], None, None, None, None, None
    answers = score = None
    terrain, windows, dealt = samples.terrain, samples.windows, {"gap": samples.gap, "seed": info.seed}
    end_s = windows.start_s + windows.length_s
    try:
        terms = held_out_terms(features, terrain, samples.group, **dealt)
        novelty = learn_novelty(features, terrain, samples.group, **dealt, terms=terms)
        score = fisher_scores(novelty.reference, terms)
        # of looks alone: together with answers as many known windows are called unknown
        evidence = novelty_evidence(score, score > novelty.threshold)
    except DataError as error:
        notes.append(f"no window is called unknown for its looks: {error}")
    try:
        if (observed := samples.observed) is None:
            raise DataError("no wheel speed beside a yaw rate, a vibration, a current or a slip is at hand")
        answers = learn_answers(observed, terrain, samples.group, end_s, score, **dealt)
    except DataError as error:
        notes.append(f"whether the ground answers as the named terrain is not compared: {error}")
    try:
        conformal = conformal_threshold(held_out_scores(recipe[-1], terrain), samples.unit)
    except (AttributeError, DataError) as error:
        notes.append(f"no sets of terrains: {error}")
    taken_over: tuple[TakenOver, ...] = ()
    if (held_out := inner_probability(recipe[-1], np.array(info.classes))) is not None:
        shares = np.array([*info.class_ratio.values()])
        taken_over = held_out_errors(windows, held_out, info.classes, shares, samples.unit)
    over_time = choose_settings(
        held_out, terrain, end_s, windows.groups, windows.length_s, info.class_ratio, evidence
    )
    if over_time is None:
        notes.append("no terrain is filtered over time: on held-out runs single windows are right more often")
    info = replace(
        info,
        conformal=conformal,
        taken_over=taken_over,
        share_power=None if over_time is None else over_time.share_power,
        novelty_weight=info.novelty_weight if over_time is None else over_time.novelty_weight,
    )
    if motion is not None:
        driven = motion.speed_mps, motion.yaw_rate_radps
        support = learn_support(*driven, terrain, samples.run_id, np.unique(terrain).tolist())
    try:
        adaptation = judged_adaptation(
            samples.windows, features, recipe[0].features_of, samples.gap, info.seed
        )
        used = "is used" if adaptation.shown else "waits for --adapt"
        notes.append(f"adapting to a session {used}: that it helps is {adaptation.status}")
    except DataError as error:
        notes.append(f"no adapting to a session: {error}")
    return TerrainModel(recipe, info, novelty, support, None, adaptation, answers), tuple(notes)


def fitted_model(
    runs: Sequence[RunLog], settings: RecipeSettings | None = None, dataset: str = ""
) -> TerrainModel:
    """Return a model that is fitted on labelled runs, without evaluation, limits and registration.

    Parameters
    ----------
    runs : labelled; errors as :func:`data_of_runs` and :func:`info_of`
    settings : recipe and windows; the defaults without
    dataset : for the record
    """
    settings = settings or RecipeSettings()
    data = data_of_runs(runs, settings)
    info = info_of(data, settings, dataset)
    data.recipe[-1].fit(data.rows, data.samples.terrain, groups=data.samples.group)
    return TerrainModel(data.recipe, info)
