"""Windows that were held out: by which folds, and what a classifier that is fitted on every fold makes of them.

Beside the folds of a protocol there are those of a learning curve, which train on fewer runs; of terrains that are left
out in turn, whose windows a novelty score is to find; and of slow runs against fast ones.  What a channel is worth to
a classifier is how much balanced accuracy drops when all its features are shuffled together: a single one hardly lowers
it, since the others carry much the same information.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple, Self

import numpy as np
from sklearn.base import clone

from terrain.classify.answers import Observed, best_misfit, joint_score, learn_answers, over_manoeuvre
from terrain.classify.folds import Fold, divided_units, run_of, split_runs, units_of
from terrain.classify.limits import (
    conformal_threshold,
    fisher_scores,
    held_out_scores,
    held_out_terms,
    learn_novelty,
)
from terrain.errors import DataError
from terrain.records import Array


class Examples(NamedTuple):
    """What a classifier learns from: features (n, f), class (n,), and run (n,) or session and run (n, 2)."""

    features: Array
    terrain: Array
    group: Array


class FoldResult(NamedTuple):
    """Held-out class probabilities of one fold, what inner folds chose, and what else was asked of its classifier.

    ``conformal`` is the threshold of its sets of classes; NaN where its training part does not give one.  ``inner``
    (n_train, k) has the probabilities of its training rows while inner folds held them out, NaN where none did.
    """

    fold: Fold
    probability: Array
    chosen: Mapping[str, Any]
    found: Any = None
    conformal: float = math.nan
    inner: Array | None = None


def fit_fold(
    classifier: Any,
    examples: Examples,
    classes: Array,
    fold: Fold,
    ask: Callable[[Any], Any] | None = None,
) -> FoldResult:
    """Fit a clone of the classifier on the training rows of a fold, and apply it to its test rows.

    Parameters
    ----------
    classifier : estimator with ``fit(X, y, groups)`` and ``predict_proba``
    examples, classes : rows that the fold numbers, and their classes (k,), sorted
    ask : what is called with the fitted classifier
    """
    features, terrain, group = examples
    train, test = fold.train, fold.test
    fitted = clone(classifier).fit(features[train], terrain[train], groups=group[train])
    probability = np.zeros((len(test), len(classes)))
    if len(test):
        probability[:, np.searchsorted(classes, fitted.classes_)] = fitted.predict_proba(features[test])
    best = getattr(fitted, "best_", None)
    chosen = {} if best is None else dict(best._asdict())
    threshold, inner = math.nan, inner_probability(fitted, classes)
    if inner is not None:
        try:
            scores = held_out_scores(fitted, terrain[train])
            threshold = conformal_threshold(scores, units_of(terrain[train], group[train]))
        except DataError:
            pass
    return FoldResult(fold, probability, chosen, None if ask is None else ask(fitted), threshold, inner)


def inner_probability(fitted: Any, classes: Array) -> Array | None:
    """Return probabilities (n, k) of training rows while inner folds held them out; None without inner folds."""
    if not hasattr(fitted, "inner_probability_"):
        return None
    probability = np.zeros((len(fitted.inner_probability_), len(classes)))
    probability[:, np.searchsorted(classes, fitted.classes_)] = fitted.inner_probability_
    return probability


def itself(fitted: Any) -> Any:
    """Return the classifier: asks a fold for it."""
    return fitted


class HeldOut(NamedTuple):
    """Held-out probabilities of every repeat, and the folds that they come from."""

    classes: Array  #: (k,) sorted
    probability: Array  #: (repeats, n, k); NaN of a window that was not held out
    fold_number: Array  #: (repeats, n); -1 of such a window
    truth: Array  #: (n,) class of each window
    results: Sequence[FoldResult] = ()  #: fold by fold; empty of a model that was fitted before
    fitted: Any = None  #: on all windows, where that was asked for

    @classmethod
    def of_folds(cls, results: Sequence[FoldResult], truth: Array) -> Self:
        """Return what folds hold out together; a fold without test rows gives its classifier, if asked for it."""
        classes, fitted = np.unique(truth), [each.found for each in results if not len(each.fold.test)]
        results = [each for each in results if len(each.fold.test)]
        shape = 1 + max(result.fold.repeat for result in results), len(truth)
        probability, number = np.full((*shape, len(classes)), np.nan), np.full(shape, -1)
        for result in results:
            probability[result.fold.repeat, result.fold.test] = result.probability
            number[result.fold.repeat, result.fold.test] = result.fold.number
        return cls(classes, probability, number, truth, results, *fitted)

    @classmethod
    def of_model(cls, classes: Array, probability: Array, truth: Array) -> Self:
        """Return what a model makes (n, k) of windows that it was not trained on."""
        return cls(classes, probability[None], np.zeros((1, len(truth)), dtype=int), truth)

    @property
    def tested(self) -> Array:
        """Whether each window (n,) was held out in every repeat."""
        return np.asarray(np.isfinite(self.probability).all(axis=(0, 2)))

    @property
    def correct(self) -> Array:
        """Whether each window (repeats, n) is classified correctly; not where it was not held out."""
        held_out = np.isfinite(self.probability).all(axis=2)
        return np.asarray(held_out & (self.classes[self.probability.argmax(axis=2)] == self.truth))

    @property
    def accuracies(self) -> list[float]:
        """Part of the held-out windows that are classified correctly, repeat by repeat."""
        held_out = np.asarray(np.isfinite(self.probability).all(axis=2))
        return [float(right[rows].mean()) for right, rows in zip(self.correct, held_out, strict=True)]


CURVE_RUNS = (1, 2, 3, 5, 8, 12)
CURVE_DRAWS = 2


def drawn_folds(y: Array, group: Array, folds: Sequence[Fold], seed: int) -> tuple[list[Fold], Array]:
    """Draw at most m training runs (or sessions) of each class, for each m of :data:`CURVE_RUNS`, not test rows.

    Returns
    -------
    folds : :data:`CURVE_DRAWS` repeats a size, of folds of one repeat
    runs_per_class : of each size, and of all runs
    """
    group = units_of(y, group)
    available = [
        np.array([len(set(group[train][y[train] == name])) for name in np.unique(y[train])])
        for _, _, train, _ in folds
    ]
    most, rng = max(counts.max() for counts in available), np.random.default_rng((seed, len(CURVE_RUNS)))
    sizes, drawn = list[int](), list[Fold]()
    for size in (each for each in CURVE_RUNS if each < most):
        of_size = []
        for repeat in range(CURVE_DRAWS):
            for _, fold, train, test in folds:
                kept = np.zeros(len(train), dtype=bool)
                for terrain in np.unique(y[train]):
                    of_class = y[train] == terrain
                    chosen = rng.permutation(np.unique(group[train][of_class]))[:size]
                    kept |= np.isin(group[train], chosen) & of_class
                of_size.append(Fold(CURVE_DRAWS * len(sizes) + repeat, fold, train[kept], test))
        if all(np.unique(y[each.train], return_counts=True)[1].min() > 1 for each in of_size):
            sizes.append(size)  # short runs may be of a single window, with which nothing can be held out
            drawn += of_size
    means = [[np.minimum(counts, size).mean() for counts in available] for size in (*sizes, len(y))]
    return drawn, np.mean(means, axis=1)


MIN_TERRAINS = 3  #: Two are needed to train without the third.


def left_out_folds(
    terrain: Array, groups: Array, n_folds: int, gap: int, seed: int
) -> list[tuple[Array, Array, Array]]:
    """Return training rows, held-out rows and rows of the terrain that is left out, terrain by terrain.

    ``DataError`` where there are fewer than three terrains, or too few runs.
    """
    y, terrains = terrain, np.unique(terrain)
    if len(terrains) < MIN_TERRAINS:
        raise DataError(
            f"the runs are of {len(terrains)} terrains ({', '.join(terrains)}): "
            f"at least {MIN_TERRAINS} are needed to leave one out"
        )
    folds = []
    for name in terrains:
        rows, unknown = np.flatnonzero(y != name), np.flatnonzero(y == name)
        n_groups = len(np.unique(divided_units(y[rows], groups[rows], n_folds)))
        if n_groups < n_folds:
            raise DataError(f"{n_groups} runs without {name} are fewer than {n_folds} folds")
        rng = np.random.default_rng((seed, 0))
        for train, test in split_runs(y[rows], groups[rows], n_folds, rng, gap):
            if len(test):
                folds.append((rows[train], rows[test], unknown))
    return folds


class Scored(NamedTuple):
    """Held-out known rows and all unknown rows, their scores by one fold, and the fold's threshold."""

    known: Array
    unknown: Array
    known_scores: Array
    unknown_scores: Array
    threshold: float


class Looks(NamedTuple):
    """What shows of n rows whether their terrain was learned: features (n, f), and what the ground answered."""

    features: Array
    observed: Observed | None
    end_s: Array  #: (n,) of the window


def _unlike(
    looks: Looks, y: Array, group: Array, gap: int, seed: int, train: Array
) -> tuple[Callable[[Array], Array], float]:
    """Return what scores rows by how unlike learned terrains they are, fitted on training rows; and its threshold."""
    X, observed, end_s = looks
    of_train = X[train], y[train], group[train]
    terms = held_out_terms(*of_train, gap=gap, seed=seed)
    fitted = learn_novelty(*of_train, gap=gap, seed=seed, terms=terms)
    if observed is None:
        return lambda rows: fitted.score(X[rows]), fitted.threshold
    held_out = fisher_scores(fitted.reference, terms)
    laws = learn_answers(observed.of(train), *of_train[1:], end_s[train], held_out, gap=gap, seed=seed)

    def score(rows: Array) -> Array:
        misfits = over_manoeuvre(laws.misfits(observed.of(rows)), end_s[rows], run_of(group[rows]))
        novelty = fitted.score(X[rows])
        return np.where(np.isnan(novelty), np.nan, joint_score(laws.reference, novelty, best_misfit(misfits)))

    return score, laws.threshold


def score_fold(
    looks: Looks, y: Array, group: Array, gap: int, seed: int, train: Array, test: Array, unknown: Array
) -> Scored:
    """Return how unlike learned terrains held-out and unknown rows are, by what is fitted on training rows."""
    score, threshold = _unlike(looks, y, group, gap, seed, train)
    return Scored(test, unknown, score(test), score(unknown), threshold)


def refused_rows(
    looks: Looks, y: Array, group: Array, gap: int, seed: int, train: Array, test: Array
) -> Array:
    """Return whether each test row is called unknown, by what is fitted on training rows."""
    score, threshold = _unlike(looks, y, group, gap, seed, train)
    return ~(score(test) <= threshold)


#: Slow and fast runs of a class that are compared: at least so many, of so much time.
MIN_RUNS_A_SIDE, MIN_TIME_A_SIDE_S = 2, 60.0
MIN_CLASSES = 3  #: Slow and fast runs are compared where at least so many classes have enough of both.
MOVING_MPS = 0.03  #: The faster wheel moves above this; it is the steady-motion rule's own threshold.


class Applicability(StrEnum):
    """Whether the data allow a comparison."""

    APPLICABLE = "applicable"
    NOT_APPLICABLE = "not applicable"


class SlowFast(NamedTuple):
    """Accuracy when slow runs train and fast runs test, and the reverse; None where not applicable.

    ``classes`` has the median speeds of slow and fast runs of those that are kept, ``left_out`` why the others are not.
    """

    status: Applicability
    classes: Mapping[str, Mapping[str, float]]
    left_out: Mapping[str, str]
    slow_to_fast: float | None = None
    fast_to_slow: float | None = None


def run_speeds(fastest_mps: Array, run_id: Array) -> dict[str, float]:
    """Return the median speed (m/s) of each run's faster wheel where it moves; NaN if it never does."""
    speeds = {}
    for run in np.unique(run_id).tolist():
        moving = fastest_mps[run_id == run].ravel()
        moving = moving[moving > MOVING_MPS]
        speeds[run] = float(np.median(moving)) if len(moving) else math.nan
    return speeds


def slow_fast_split(
    fastest_mps: Array, run_id: Array, terrain: Array, start_s: Array, length_s: float
) -> tuple[Array, SlowFast]:
    """Split the runs of each class at their median speed, taken over the run's time on that class.

    Parameters
    ----------
    fastest_mps : (n, samples) magnitude of the speed of the faster wheel in n windows; NaN where unknown
    run_id, terrain, start_s : (n,) run, class and start of each window, of ``length_s``

    Returns
    -------
    side : (n,) ``slow`` or ``fast``; empty of a class that is left out, and of a run that is slow on one class
        and fast on another
    split : of the classes, without accuracies
    """
    side = np.full(len(terrain), "", dtype=object)
    kept: dict[str, dict[str, float]] = {}
    left_out: dict[str, str] = {}
    for name in np.unique(terrain).tolist():
        of_class = terrain == name
        speeds = run_speeds(fastest_mps[of_class], run_id[of_class])
        known = {run: speed for run, speed in speeds.items() if math.isfinite(speed)}
        median = np.median(list(known.values())) if known else math.nan
        parts = {
            "slow": [run for run, speed in known.items() if speed <= median],
            "fast": [run for run, speed in known.items() if speed > median],
        }
        for each, runs in parts.items():
            starts_s = [
                np.sort(start_s[of_class & (run_id == run)]) for run in runs
            ]  # what overlaps counts once
            time_s = sum(np.minimum(np.diff(each), length_s).sum() + length_s for each in starts_s)
            if len(runs) < MIN_RUNS_A_SIDE:
                left_out.setdefault(name, f"{each} runs: {len(runs)}")
            elif time_s < MIN_TIME_A_SIDE_S:
                left_out.setdefault(name, f"{each} runs: {time_s:.0f} s")
        if name not in left_out:
            kept[name] = {}
            for each, runs in parts.items():
                kept[name][f"{each}_mps"] = float(np.median([known[run] for run in runs]))
                side[of_class & np.isin(run_id, runs)] = each
    both = set(run_id[side == "slow"]) & set(run_id[side == "fast"])
    side[np.isin(run_id, list(both))] = ""
    enough = len(kept) >= MIN_CLASSES
    status = Applicability.APPLICABLE if enough else Applicability.NOT_APPLICABLE
    return side, SlowFast(status, kept, left_out)


N_PERMUTATIONS = 3


class ChannelImportance(NamedTuple):
    """By how much balanced accuracy drops when a channel is shuffled; ``std`` over folds."""

    feature: str
    drop: float
    std: float


def channel_of(feature: str) -> str:
    """Return the stream and channel that a feature is made of.

    Examples
    --------
    >>> channel_of("imu.accel_z.std [m/s^2]"), channel_of("wheels.log_drive_effort [log10 A m/s]")
    ('imu.accel_z', 'wheels.log_drive_effort')
    >>> channel_of("imu.gyro_x~accel_y.correlation [1]"), channel_of("roughness")
    ('imu.correlations', 'roughness')
    """
    name = feature.partition(" [")[0]
    stream, separator, rest = name.partition(".")
    channel = rest.split(".")[0]
    return f"{stream}.correlations" if "~" in channel else f"{stream}{separator}{channel}"


def channel_drops(
    features: Array, truth: Array, channels: Sequence[str], seed: int, number: int, fitted: Any
) -> list[float]:
    """Return the drop of each channel (f,), in the order of their names, means over shuffles, by a fold's classifier.

    ``features`` (n, f) and ``truth`` (n,) are of the windows that the fold of that number holds out.
    """
    present, names = np.isin(truth, fitted.classes_), np.array(channels)
    test, truth = features[present], truth[present]
    of_label = [truth == label for label in np.unique(truth)]
    rng = np.random.default_rng((seed, number))

    def balanced_accuracies(copies: list[Array]) -> Array:
        """Return the mean recall of each copy, all of which are predicted at once."""
        right = fitted.predict(np.concatenate(copies)).reshape(len(copies), -1) == truth
        recalls: Array = np.stack([right[:, rows].mean(axis=1) for rows in of_label], axis=1)
        return np.asarray(recalls.mean(axis=1))

    (baseline,) = balanced_accuracies([test])
    drops = []
    for channel in np.unique(names):
        columns, copies = np.flatnonzero(names == channel), []
        for _ in range(N_PERMUTATIONS):
            shuffled = test.copy()
            shuffled[:, columns] = test[rng.permutation(len(test))][:, columns]
            copies.append(shuffled)
        drops.append(float(baseline - balanced_accuracies(copies).mean()))
    return drops


def channel_importance(
    channels: Sequence[str], drops: Sequence[Sequence[float]]
) -> tuple[ChannelImportance, ...]:
    """Return means and standard deviations over folds of their drops, the largest drop first."""
    table, names = np.array(drops), np.unique(np.array(channels))
    mean, std = table.mean(axis=0), table.std(axis=0, ddof=1)
    order = np.argsort(-mean, kind="stable")
    return tuple(ChannelImportance(str(names[i]), float(mean[i]), float(std[i])) for i in order)
