"""What a cross-validation finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Any, NamedTuple

from pipelines.courses.results import OverTime
from pipelines.support.results import SupportReport
from terrain.classify.confidence import CoverageFigures, ReliabilityBin
from terrain.classify.conformal_figures import ConformalFigures
from terrain.classify.metrics import ClassFigures, RunFigures


class FoldFigures(NamedTuple):
    """One fold: how many windows train and test, its accuracy, and what the inner folds chose."""

    repeat: int
    fold: int
    n_train: int
    n_test: int
    accuracy: float
    chosen: Mapping[str, Any]


class Applicability(StrEnum):
    """Whether the data allow a comparison."""

    APPLICABLE = "applicable"
    NOT_APPLICABLE = "not applicable"


MIN_CLASSES = 3
"""Slow and fast runs are compared where at least so many classes have enough of both."""


class ClassSpeeds(NamedTuple):
    """Median speeds of the slow and of the fast runs of a class."""

    slow_mps: float
    fast_mps: float


class SlowFast(NamedTuple):
    """Accuracy when slow runs train and fast runs test, and the reverse; None where not applicable.

    ``left_out`` gives the reason for each class without enough runs on both sides.
    """

    status: Applicability
    classes: Mapping[str, ClassSpeeds]
    left_out: Mapping[str, str]
    slow_to_fast: float | None = None
    fast_to_slow: float | None = None


class LearningCurve(NamedTuple):
    """Accuracy against the number of training runs of each class.

    Parameters
    ----------
    runs_per_class : mean over classes and folds, since a class may have fewer than were asked for
    accuracy : with so many training runs
    accuracy_spread : over draws of runs; None for all runs
    enough_runs : the number of runs beyond which doubling brings next to nothing; None when not reached
    statement : the same in a sentence
    """

    runs_per_class: tuple[float, ...]
    accuracy: tuple[float, ...]
    accuracy_spread: tuple[float | None, ...]
    enough_runs: int | None
    statement: str


class LeftOutTerrain(NamedTuple):
    """How well the windows of a terrain that was left out differ in score from held-out ones of others.

    Parameters
    ----------
    auroc, auroc_10s : area under the ROC curve of single windows, and of means over 10 s
    accepted : part of its windows that are taken for a known terrain
    known_kept : part of the held-out windows of the other terrains that are not called unknown
    """

    auroc: float
    auroc_10s: float
    accepted: float
    known_kept: float


class UnknownTerrain(NamedTuple):
    """Leave-one-terrain-out: means over the terrains, intervals by bootstrap over runs, and each terrain.

    The threshold of the score keeps ``known_kept_target`` of the known windows of inner held-out runs.
    """

    auroc_unknown: float
    auroc_unknown_ci: tuple[float, float]
    auroc_unknown_10s: float
    auroc_unknown_10s_ci: tuple[float, float]
    unknown_accepted: float
    known_kept: float
    known_kept_target: float
    unknown_by_terrain: Mapping[str, LeftOutTerrain]


class LevelClusters(NamedTuple):
    """Clusters of runs without labels, and how far they agree with the stiffness levels.

    Parameters
    ----------
    n_clusters : by the Bayesian information criterion
    adjusted_rand, interval : agreement with the levels, 1 the same, 0 by chance; 95 % over runs
    adjusted_rand_of_classes : the same with the terrains in place of their levels
    """

    n_clusters: int
    adjusted_rand: float
    interval: tuple[float, float]
    adjusted_rand_of_classes: float


class StiffnessFigures(NamedTuple):
    """Accuracy by stiffness level and the cost of confusing levels, all with 95 % intervals over runs.

    Parameters
    ----------
    levels : of each class
    accuracy, accuracy_ci : of the level, whichever the class
    cost, cost_ci : mean cost a window of the most probable class
    least_cost, least_cost_ci : mean cost of the class of least expected cost
    gain, gain_ci : the first less the second, run by run
    least_cost_accuracy : accuracy of the class of least expected cost
    soft_hard_ratio : windows of which soft was taken for hard or hard for soft, by the most probable class
    clusters : None where there are too few runs
    """

    levels: Mapping[str, str]
    accuracy: float
    accuracy_ci: tuple[float, float]
    cost: float
    cost_ci: tuple[float, float]
    least_cost: float
    least_cost_ci: tuple[float, float]
    gain: float
    gain_ci: tuple[float, float]
    least_cost_accuracy: float
    soft_hard_ratio: float
    clusters: LevelClusters | None


class Extras(NamedTuple):
    """What the headline figure does not show.

    ``speed_only_accuracy`` is None without wheel speeds, ``stiffness`` where the stiffness of a class is not
    known.
    """

    speed_only_accuracy: float | None
    slow_fast: SlowFast
    learning_curve: LearningCurve
    stiffness: StiffnessFigures | None = None
    over_time: OverTime | None = None

    def as_json(self) -> dict[str, Any]:
        """Return all fields, those over time by names of their own."""
        document = self._asdict()
        over_time = document.pop("over_time")
        if over_time is None:
            return document
        spliced = over_time.spliced
        if spliced is not None:
            names = ("filtered_accuracy", "filtered_accuracy_ci", "filter_delay_s")
            document |= {name: getattr(spliced, name) for name in names}
        return document | {
            "courses": spliced,
            "recorded_courses": over_time.recorded,
            "breakaways": over_time.breakaways,
        }


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of merit of a cross-validation, means over the repeats.

    ``accuracy_spread`` is the standard deviation over the repeats (None with a single one), ``accuracy_ci``
    the 95 % interval by bootstrap over runs within classes, as every ``_ci``; ``confidence_auc`` is the area
    under the curve from confidence to correctness, NaN where all are right; ``vote_windows`` is the
    mean number of windows that a vote over 5 s has; ``confusion``, ``per_class`` and
    ``reliability`` count all repeats together.
    """

    classes: tuple[str, ...]
    n_windows: int
    n_runs: int
    repeats: int
    accuracy: float
    accuracy_spread: float | None
    accuracy_per_repeat: tuple[float, ...]
    accuracy_ci: tuple[float, float]
    balanced_accuracy: float
    macro_f1: float
    macro_run_accuracy: float
    per_class: Mapping[str, ClassFigures]
    confusion: tuple[tuple[int, ...], ...]
    vote_accuracy: float
    vote_windows: float
    ece: float
    ece_ci: tuple[float, float]
    confidence_auc: float
    confidence_auc_ci: tuple[float, float]
    accuracy_at_coverage: tuple[CoverageFigures, ...]
    reliability: tuple[ReliabilityBin, ...]
    per_run: tuple[RunFigures, ...]
    folds: tuple[FoldFigures, ...]

    @property
    def chance(self) -> float:
        """Accuracy of always predicting the class with the most windows."""
        counts = [figures.n_windows for figures in self.per_class.values()]
        return max(counts) / sum(counts)


@dataclass(frozen=True, slots=True)
class CrossvalReport(Figures):
    """A cross-validation: its figures, how they were obtained, and what a reader has to know of them.

    ``extras`` and ``unknown`` are None where they were not asked for, ``support`` where the motion of
    the robot is not known or a run trains and tests, ``conformal`` where a run does or there are too few,
    ``dataset``, ``data_digest`` and ``skipped`` where the caller did not give them.
    """

    protocol: str
    recipe: str
    window_s: float
    stride_s: float | None
    steady: bool
    signal_sets: tuple[str, ...]
    seed: int
    n_features: int
    dropped: Mapping[str, int]
    repaired: Mapping[str, int]
    notes: tuple[str, ...]
    extras: Extras | None = None
    unknown: UnknownTerrain | None = None
    support: SupportReport | None = None
    conformal: ConformalFigures | None = None
    dataset: str | None = None
    data_digest: str | None = None
    skipped: tuple[str, ...] | None = None

    def named(self, dataset: str, data_digest: str) -> CrossvalReport:
        """Return the report with the name and the digest of its data."""
        return replace(self, dataset=dataset, data_digest=data_digest)

    def as_json(self) -> dict[str, Any]:
        """Return all fields, the extras among them, without those that are not there."""
        apart = ("extras", "unknown", "support", "conformal")
        found = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in apart}
        unknown = [name for name in ("dataset", "data_digest", "skipped") if found[name] is None]
        extras = {} if self.extras is None else self.extras.as_json()
        extras |= {} if self.unknown is None else self.unknown._asdict()
        extras |= {} if self.support is None else self.support.as_json()
        extras |= {} if self.conformal is None else {"conformal": self.conformal._asdict()}
        return {name: value for name, value in (found | extras).items() if name not in unknown}


class ChannelImportance(NamedTuple):
    """By how much balanced accuracy drops when a channel is shuffled; ``std`` over folds."""

    feature: str
    drop: float
    std: float
