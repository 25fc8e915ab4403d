"""Figures of merit of held-out windows: accuracy, votes, confidence, sets of classes, terrain over time, differences.

Windows of one run are not independent, nor are runs of one session: intervals are those of a bootstrap that draws whole
units (sessions where a class has several, otherwise runs) within their classes, together those that units share, and
computes each figure again from the windows of the units drawn; of few units the percentiles are those of Student's t
(:mod:`terrain.bootstrap`).  Two
classifiers are judged on the same units, and one that is hard for one is mostly hard for the other: taking the figures
of both from the same draw leaves this common part out of the interval of their difference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.optimize import least_squares
from sklearn.metrics import confusion_matrix, precision_recall_fscore_support

from terrain.bootstrap import freedom_of, percentile_interval, shared_strata, stratified_counts
from terrain.classify.folds import run_of, units_of
from terrain.classify.held_out import CURVE_DRAWS, HeldOut, Scored
from terrain.classify.limits import KNOWN_KEPT, LEVEL, SupportLevel, conformal_sets
from terrain.errors import DataError
from terrain.records import Array, Label, Windows

VOTE_SPAN_S = 5.0
TIME_TOLERANCE_S = 1e-6
N_BOOTSTRAP = 2000

Interval = tuple[float, float]
NO_INTERVAL: Interval = (math.nan, math.nan)


class Draws(NamedTuple):
    """How often each cell, a unit's part on a class, counts: once (the first row), then as its unit is drawn."""

    weights: Array  #: (1 + draws, cells)
    place: Array  #: (n,) cell of each window
    unit: Array  #: unit, stratum: (cells,) number of the unit, and that within which it is drawn
    stratum: Array

    @classmethod
    def of(cls, unit: Array, terrain: Array, n_draws: int, rng: np.random.Generator) -> Self:
        """Return draws of the units (n,) of windows within their classes (n,), as :func:`shared_strata` has them."""
        _, number = np.unique(unit.astype(str), return_inverse=True)
        names = np.char.add(np.char.add(terrain.astype(str), "\n"), unit.astype(str))
        _, first, place = np.unique(names, return_index=True, return_inverse=True)
        of_cell, stratum = number[first], shared_strata(number[first], terrain[first])
        once = np.unique(of_cell, return_index=True)[1]
        weights = stratified_counts(stratum[once], n_draws, rng)[:, of_cell]
        return cls(np.vstack([np.ones(len(first)), weights]), place, of_cell, stratum)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of a figure over all units."""
        return freedom_of(self.unit, self.stratum)

    def sums(self, values: Array) -> Array:
        """Return the sum (1 + draws,) over windows of their values (n,), of all units and of each draw."""
        return np.asarray(self.weights @ np.bincount(self.place, values))

    def interval(self, figures: Array, ends: Interval = (0.0, 1.0)) -> Interval:
        """Return the 95 % interval of a figure of each draw (draws,) without the first; NaN where there is none.

        ``ends`` are what the figure can be.
        """
        return percentile_interval(figures, freedom=self.freedom, ends=ends)

    def ratio(
        self, numerator: Array, denominator: Array, ends: Interval = (0.0, 1.0)
    ) -> tuple[float | None, Interval | None]:
        """Return the first ratio, and the interval of the others; None where the first has no denominator."""
        if not denominator[0]:
            return None, None
        ratio = _over(numerator, denominator)
        low, high = self.interval(ratio[1:], ends)
        return float(ratio[0]), None if math.isnan(low) else (low, high)


def accuracy_interval(correct: Array, unit: Array, terrain: Array, rng: np.random.Generator) -> Interval:
    """Return a 95 % interval of the accuracy by resampling whole units (n,) within their classes.

    ``correct`` (n,) is the fraction of the repeats in which each window was classified correctly.  A class with one
    unit adds no spread; where all have one, the interval is NaN.
    """
    draws = Draws.of(unit, terrain, N_BOOTSTRAP, rng)
    hits, sizes = np.bincount(draws.place, weights=correct), np.bincount(draws.place)
    return draws.interval((draws.weights[1:] @ hits) / (draws.weights[1:] @ sizes))


class ClassFigures(NamedTuple):
    """Precision, recall and F1 of one class, and how many windows were truly of it."""

    precision: float
    recall: float
    f1: float
    n_windows: int


class RunFigures(NamedTuple):
    """Accuracy of the windows of one run, and the class that wrong ones are predicted as most often."""

    run_id: str
    terrain: str
    n_windows: int
    accuracy: float
    vote_accuracy: float
    mistaken_for: str | None


class FoldFigures(NamedTuple):
    """One fold: how many windows train and test, its accuracy, and what the inner folds chose."""

    repeat: int
    fold: int
    n_train: int
    n_test: int
    accuracy: float
    chosen: Mapping[str, Any]


def class_figures(y: Array, predicted: Array, classes: Array) -> dict[str, Any]:
    """Return accuracy, balanced accuracy, macro F1, figures of each class (k,), and the confusion matrix, by name.

    Rows of ``confusion`` are true classes, columns predicted ones.
    """
    columns = precision_recall_fscore_support(y, predicted, labels=classes, zero_division=0.0)
    _, recall, f1, n_true = columns
    return {
        "accuracy": float(np.mean(y == predicted)),
        "balanced_accuracy": float(recall[n_true > 0].mean()),
        "macro_f1": float(f1[n_true > 0].mean()),
        "per_class": dict(
            zip(
                classes.astype(str).tolist(),
                map(ClassFigures, *(each.tolist() for each in columns)),
                strict=True,
            )
        ),
        "confusion": tuple(map(tuple, confusion_matrix(y, predicted, labels=classes).tolist())),
    }


def vote(probability: Array, segment: Array, start_s: Array, length_s: float) -> tuple[Array, Array]:
    """Return the class index voted by the windows of the last :data:`VOTE_SPAN_S`, and how many they are, (n,) each.

    A window that ends at t votes together with the windows of its own segment (n,), a stretch of a run that was tested
    in one piece, that lie wholly in ``[t - span, t]``; a tie goes to the class with the higher summed probability.
    """
    ballots = np.eye(probability.shape[1])[probability.argmax(axis=1)]
    voted, sizes = np.empty((2, len(probability)), dtype=int)
    for name in np.unique(segment):
        rows = np.flatnonzero(segment == name)
        rows = rows[np.argsort(start_s[rows], kind="stable")]
        starts = start_s[rows]
        first = np.searchsorted(starts, starts + length_s - VOTE_SPAN_S - TIME_TOLERANCE_S)
        for position, row in enumerate(rows):
            voters = rows[min(first[position], position) : position + 1]
            count, weight = ballots[voters].sum(axis=0), probability[voters].sum(axis=0)
            voted[row], sizes[row] = np.lexsort((weight, count))[-1], len(voters)
    return voted, sizes


def runs_by_terrain(run_id: Array, terrain: Array) -> Array:
    """Return the run of each window, with the terrain added where a run has several.

    Examples
    --------
    >>> runs_by_terrain(np.array(["a", "a", "b"]), np.array(["ice", "snow", "ice"])).tolist()
    ['a (ice)', 'a (snow)', 'b']
    """
    mixed = [run for run in np.unique(run_id) if len(np.unique(terrain[run_id == run])) > 1]
    pairs = zip(run_id, terrain, strict=True)
    return np.array([f"{run} ({name})" if run in mixed else run for run, name in pairs])


#: Fractions of the windows, the most confident first, of which the accuracy is given.
COVERAGES = (0.8, 0.5)
N_DRAWS = 1000
CALIBRATION_BINS = 15
#: Bootstrap draws are computed in blocks of at most so many weights: 32 MB.
DRAWS_AT_ONCE_VALUES = 4_000_000


class CoverageFigures(NamedTuple):
    """Accuracy of the most confident windows, a fraction of all, with its interval, and their least confidence."""

    coverage: float
    accuracy: float
    accuracy_ci: Interval
    confidence_least: float


class ReliabilityBin(NamedTuple):
    """Mean confidence and accuracy of a bin of windows, with the 95 % interval of the accuracy over units."""

    confidence: float
    accuracy: float
    n_windows: int
    accuracy_ci: Interval


def confidence_auc(confidence: Array, correct: Array, weights: Array) -> Array:
    """Return the area under the curve from confidence (n,) to correctness (n,) under each set of weights (d, n).

    ``P(c_right > c_wrong) + P(c_right = c_wrong) / 2`` over weighted pairs of a window that is right and one
    that is wrong (Mann and Whitney); NaN where there are no such pairs.

    Examples
    --------
    >>> confidence_auc(np.array([0.9, 0.8, 0.6]), np.array([1, 0, 1]), np.ones((1, 3)))
    array([0.5])
    """
    order = np.argsort(confidence, kind="stable")
    first = np.unique(confidence[order], return_index=True)[1]
    right = np.add.reduceat(weights[:, order] * correct[order], first, axis=1)
    wrong = np.add.reduceat(weights[:, order] * (1.0 - correct[order]), first, axis=1)
    below = np.cumsum(wrong, axis=1) - wrong
    pairs = right.sum(axis=1) * wrong.sum(axis=1)
    area: Array = np.full(len(weights), np.nan)
    np.divide((right * (below + wrong / 2)).sum(axis=1), pairs, out=area, where=pairs > 0)
    return area


def accuracy_at_coverage(confidence: Array, correct: Array, weights: Array, coverage: float) -> Array:
    """Return the accuracy of the most confident windows that hold a fraction of the weight (d,)."""
    order = np.argsort(-confidence, kind="stable")
    upto = np.cumsum(weights[:, order], axis=1)
    kept = np.diff(np.minimum(upto, coverage * upto[:, -1:]), axis=1, prepend=0.0)
    total = kept.sum(axis=1)
    found: Array = np.full(len(weights), np.nan)
    np.divide(kept @ correct[order], total, out=found, where=total > 0)
    return found


def calibration_error(confidence: Array, correct: Array, weights: Array, n_bins: int) -> Array:
    """Return the expected calibration error over bins of equal count under each set of weights (d,).

    ``ece = sum_b w_b |accuracy_b - confidence_b|`` with the windows sorted by confidence and cut into
    ``n_bins`` bins of equal count (Guo et al. 2017, equation 3, equal mass instead of equal width).
    """
    order = np.argsort(confidence, kind="stable")
    first = np.cumsum([0, *(len(part) for part in np.array_split(order, n_bins)[:-1] if len(part))])
    first = first[first < len(order)]
    gaps = np.add.reduceat(weights[:, order] * (correct[order] - confidence[order]), first, axis=1)
    found: Array = np.abs(gaps).sum(axis=1) / weights.sum(axis=1)
    return found


def confidence_figures(
    confidence: Array, correct: Array, unit: Array, terrain: Array, rng: np.random.Generator
) -> dict[str, Any]:
    """Return how the confidence of held-out windows (repeats, n) relates to their correctness, by name.

    The area is the probability that a window that is right has a higher confidence than one that is wrong, ``ece`` the
    expected calibration error of the top label.  Figures are means over the repeats, bins hold all repeats.
    """
    of_units = Draws.of(unit, terrain, N_DRAWS, rng)
    weights = of_units.weights[:, of_units.place]
    at_once = max(1, DRAWS_AT_ONCE_VALUES // weights.shape[1])

    def figure(of: Callable[[Array, Array, Array], Array]) -> tuple[float, Interval]:
        draws = np.zeros(len(weights))
        for c, right in zip(confidence, correct.astype(float), strict=True):
            blocks = [of(c, right, weights[i : i + at_once]) for i in range(0, len(weights), at_once)]
            draws += np.concatenate(blocks) / len(confidence)
        return float(draws[0]), of_units.interval(draws[1:])

    at_coverage, n = [], confidence.shape[1]
    for coverage in COVERAGES:
        of_most = figure(partial(accuracy_at_coverage, coverage=coverage))
        least = float(np.mean(np.quantile(confidence, 1.0 - coverage, axis=1)))
        at_coverage.append(CoverageFigures(coverage, *of_most, least))
    stated, right, bins = confidence.ravel(), correct.ravel().astype(float), []
    for rows in np.array_split(np.argsort(stated, kind="stable"), min(CALIBRATION_BINS, len(stated))):
        drawn = weights[:, rows % n]
        accuracy, interval = of_units.ratio(drawn @ right[rows], drawn.sum(axis=1))
        of_bin = float(stated[rows].mean()), accuracy or 0.0, len(rows), interval or NO_INTERVAL
        bins.append(ReliabilityBin(*of_bin))
    auc, auc_ci = figure(confidence_auc)
    ece, ece_ci = figure(partial(calibration_error, n_bins=CALIBRATION_BINS))
    return {
        "ece": round(ece, 12),
        "ece_ci": ece_ci,
        "confidence_auc": auc,
        "confidence_auc_ci": auc_ci,
        "accuracy_at_coverage": tuple(at_coverage),
        "reliability": tuple(bins),
    }


def held_out_figures(
    held_out: HeldOut, windows: Windows, unit: Array, segment: Array, seed: int
) -> dict[str, Any]:
    """Return the figures of merit of held-out windows, by name.

    Figures are means over the repeats, intervals of 95 % over units (n,) within classes; ``per_class`` and
    ``confusion`` are of all repeats together.  Votes are taken among the windows of a segment (n,), as far as one fold
    tested them.
    """
    rows, classes = np.flatnonzero(held_out.tested), held_out.classes
    terrain, start_s = held_out.truth[rows], windows.start_s[rows]
    run_id = runs_by_terrain(windows.run_id.astype(str)[rows], terrain)
    probability, fold_number = held_out.probability[:, rows], held_out.fold_number[:, rows]
    predicted = classes[probability.argmax(axis=2)]
    correct = predicted == terrain
    segment_of = np.unique(segment.astype(str)[rows], return_inverse=True)[1]
    segments, votes = segment_of * (fold_number.max() + 1) + fold_number, []
    for p, each in zip(probability, segments, strict=True):
        votes.append(vote(p, each, start_s, windows.length_s))
    voted = classes[np.stack([each for each, _ in votes])] == terrain
    repeats = [class_figures(terrain, each, classes) for each in predicted]
    pooled = class_figures(np.tile(terrain, len(predicted)), predicted.ravel(), classes)
    means = {name: [each[name] for each in repeats] for name in ("accuracy", "balanced_accuracy", "macro_f1")}
    per_run, of_terrain = [], dict[str, list[float]]()
    for run in np.unique(run_id):
        mine = run_id == run
        name, accuracy = str(terrain[mine][0]), float(np.mean(correct[:, mine]))
        wrong, counts = np.unique(predicted[0, mine & ~correct[0]], return_counts=True)
        mistaken_for = str(wrong[counts.argmax()]) if len(wrong) else None
        voted_right = float(np.mean(voted[:, mine]))
        per_run.append(RunFigures(str(run), name, int(mine.sum()), accuracy, voted_right, mistaken_for))
        of_terrain.setdefault(name, []).append(accuracy)
    right, folds = np.where(held_out.tested, held_out.correct, np.nan), []
    for fold, _, chosen, *_ in held_out.results:
        sizes = len(fold.train), len(fold.test)
        accuracy = float(np.nanmean(right[fold.repeat, fold.test]))
        folds.append(FoldFigures(fold.repeat, fold.number, *sizes, accuracy, chosen))
    unit = unit[rows]
    of_confidence = probability.max(axis=2), correct, unit, terrain, np.random.default_rng(seed)
    return {
        "classes": tuple(str(name) for name in classes),
        "n_windows": len(terrain),
        "n_runs": len(np.unique(windows.run_id[rows])),
        "repeats": len(repeats),
        **{name: float(np.mean(each)) for name, each in means.items()},
        "accuracy_spread": float(np.std(means["accuracy"], ddof=1)) if len(repeats) > 1 else None,
        "accuracy_per_repeat": tuple(means["accuracy"]),
        "accuracy_ci": accuracy_interval(correct.mean(axis=0), unit, terrain, np.random.default_rng(seed)),
        "macro_run_accuracy": float(np.mean([np.mean(each) for each in of_terrain.values()])),
        "per_class": pooled["per_class"],
        "confusion": pooled["confusion"],
        "vote_accuracy": float(np.mean(voted)),
        "vote_windows": float(np.mean([sizes for _, sizes in votes])),
        **confidence_figures(*of_confidence),
        "per_run": tuple(per_run),
        "folds": tuple(folds),
    }


class ConformalFigures(NamedTuple):
    """What sets of classes hold, of windows whose runs were held out."""

    level: float  #: that they were calibrated for
    #: coverage, coverage_ci: fraction of windows whose set holds their class, with its 95 % interval over units
    coverage: float
    coverage_ci: Interval
    coverage_per_run: float  #: mean over runs of the fraction of their windows, the level's own measure
    coverage_worst_run: float  #: least of a run
    #: set_size, single_ratio: mean number of classes in a set, and fraction of the sets that name one class
    set_size: float
    single_ratio: float


def set_figures(held_out: HeldOut, windows: Windows, unit: Array, seed: int) -> ConformalFigures | None:
    """Return the figures of the sets of classes; None where a fold has no threshold."""
    if not held_out.results or any(math.isnan(result.conformal) for result in held_out.results):
        return None
    member = np.zeros(held_out.probability.shape, dtype=bool)
    for result in held_out.results:
        member[result.fold.repeat, result.fold.test] = conformal_sets(result.probability, result.conformal)
    rows = np.flatnonzero(held_out.tested)
    terrain, member = held_out.truth[rows], member[:, rows]
    run_id = runs_by_terrain(windows.run_id.astype(str)[rows], terrain)
    truth = np.searchsorted(held_out.classes, terrain)
    held = member[:, np.arange(len(terrain)), truth].mean(axis=0)
    _, run_of = np.unique(run_id, return_inverse=True)
    per_run = np.bincount(run_of, weights=held) / np.bincount(run_of)
    sizes = member.sum(axis=2)
    return ConformalFigures(
        LEVEL,
        float(held.mean()),
        accuracy_interval(held, unit[rows], terrain, np.random.default_rng(seed)),
        float(per_run.mean()),
        float(per_run.min()),
        float(sizes.mean()),
        float((sizes == 1).mean()),
    )


MIN_UNIT_WINDOWS = 5  #: A run of fewer windows is not the worst one: a single window would decide.


class RefusalFigures(NamedTuple):
    """How often windows of learned terrains are called unknown when held out, and the accuracy with and without.

    Every ``_ci`` is of 95 % over units.
    """

    refused: float  #: part of the windows that are called unknown
    refused_ci: Interval
    worst_unit: float  #: of the run or session with the most, among those of at least 5 windows; NaN without
    accuracy_accepted: float  #: of the windows that are not called unknown
    accuracy_accepted_ci: Interval
    right_and_accepted: float  #: part of all windows that is answered, and right
    right_and_accepted_ci: Interval
    n_units: int


def refusal_figures(
    refused: Array, correct: Array, terrain: Array, groups: Array, seed: int
) -> RefusalFigures:
    """Return the figures of held-out windows (n,), whether each is called unknown, and whether its class is right.

    Examples
    --------
    >>> refused, right = np.arange(40) % 10 == 0, np.arange(40) % 5 > 0
    >>> found = refusal_figures(refused, right, np.repeat(["ice", "mud"], 20), np.repeat(list("abcd"), 10), 0)
    >>> found.refused, round(found.accuracy_accepted, 2), found.right_and_accepted, found.worst_unit
    (0.1, 0.89, 0.8, 0.1)
    """
    unit, once = units_of(terrain, groups), np.ones(len(terrain))
    draws = Draws.of(unit, terrain, N_BOOTSTRAP, np.random.default_rng(seed))
    parts = (refused * 1.0, ~refused * 1.0, correct * ~refused * 1.0, once)
    n_refused, n_accepted, n_right, n_all = map(draws.sums, parts)
    pairs = (n_refused, n_all), (n_right, n_accepted), (n_right, n_all)
    figures = []
    for numerator, denominator in pairs:
        value, interval = draws.ratio(numerator, denominator)
        figures.append((math.nan if value is None else value, interval or NO_INTERVAL))
    _, number, size = np.unique(unit, return_inverse=True, return_counts=True)
    rates = (np.bincount(number, refused) / size)[size >= MIN_UNIT_WINDOWS]
    worst = float(rates.max()) if len(rates) else math.nan
    of_refused, *of_right = figures
    return RefusalFigures(*of_refused, worst, *of_right[0], *of_right[1], len(np.unique(unit)))


N_PAIRED_DRAWS = 2000
#: An interval of fewer degrees of freedom, the units less their classes, says nothing: it is not given.
MIN_FREEDOM = 2


class Verdict(StrEnum):
    """Whether the interval of a difference leaves zero out."""

    BETTER = "better"
    WORSE = "worse"
    NOT_DISTINGUISHED = "not distinguished"


class Outcome(NamedTuple):
    """What a classifier made of held-out windows: unit and true class (n,), whether it is right, and confidence.

    These two are (repeats, n).
    """

    unit: Array
    terrain: Array
    correct: Array
    confidence: Array

    @classmethod
    def of(cls, held_out: HeldOut, unit: Array) -> Self:
        """Return what was made of the windows that were held out."""
        whole = cls(unit, held_out.truth, held_out.correct, held_out.probability.max(axis=2))
        return whole.at(np.flatnonzero(held_out.tested))

    def at(self, rows: Array) -> Self:
        """Return some of the windows."""
        unit, terrain, correct, confidence = self
        return type(self)(unit[rows], terrain[rows], correct[:, rows], confidence[:, rows])


class Difference(NamedTuple):
    """A figure of two classifiers; ``difference`` is b minus a, with its ``interval`` of 95 % over units.

    Only classes in which the two differ show how units differ.  The interval is NaN, and ``reason`` says so, where
    these have too few units: less than :data:`MIN_FREEDOM` beyond one a class.
    """

    a: float
    b: float
    difference: float
    interval: Interval
    verdict: Verdict
    n_units: int
    reason: str = ""


class UnitDifference(NamedTuple):
    """Accuracies of two classifiers on the windows of one run or session."""

    unit: str
    terrain: str
    a: float
    b: float


class Comparison(NamedTuple):
    """Differences between two classifiers, b minus a.

    Those of each class are of accuracy, as are those ``by_support``: by how many training runs drove the true
    terrain with the motion of a window, where that is known.
    """

    accuracy: Difference
    macro_run_accuracy: Difference
    confidence_auc: Difference
    by_class: dict[str, Difference]
    by_unit: tuple[UnitDifference, ...]
    by_support: Mapping[str, Difference] = MappingProxyType({})
    a: str = ""
    b: str = ""


def compare_with_first(
    names: Sequence[str], outcomes: Sequence[Outcome], seed: int, levels: Array | None = None
) -> tuple[Comparison, ...]:
    """Return how each of the other classifiers differs from the first.

    ``levels`` (n,) has the :class:`~terrain.classify.limits.SupportLevel` of each window, the same of all outcomes.
    """
    first, found = outcomes[0], []
    for name, other in zip(names[1:], outcomes[1:], strict=True):
        by_support = {}
        for level in SupportLevel if levels is not None else ():
            rows = np.flatnonzero(levels == level.value)
            if len(rows):
                parts = compare_outcomes(first.at(rows), other.at(rows), np.random.default_rng(seed))
                by_support[level.value] = parts.accuracy
        compared = compare_outcomes(first, other, np.random.default_rng(seed))
        found.append(compared._replace(by_support=by_support, a=names[0], b=name))
    return tuple(found)


def compare_outcomes(a: Outcome, b: Outcome, rng: np.random.Generator) -> Comparison:
    """Return the differences between two classifiers, paired by unit; their windows may differ.

    ``DataError`` where they were not judged on the same units and classes.

    Examples
    --------
    >>> run, terrain = np.repeat(np.arange(8).astype(str), 10), np.repeat(["ice", "mud"], 40)
    >>> half, all_right = np.tile([True, False], (1, 40)), np.ones((1, 80), dtype=bool)
    >>> worse, better = (Outcome(run, terrain, right, np.full((1, 80), 0.9)) for right in (half, all_right))
    >>> found = compare_outcomes(worse, better, np.random.default_rng(0))
    >>> found.accuracy.difference, found.accuracy.verdict.value, found.by_class["ice"].n_units
    (0.5, 'better', 4)
    """
    pairs = [list(zip(each.unit.astype(str), each.terrain.astype(str), strict=True)) for each in (a, b)]
    cells = sorted(set(pairs[0]))
    if cells != sorted(set(pairs[1])):
        other = sorted(set(pairs[0]) ^ set(pairs[1]))[0]
        raise DataError(f"{other[0]} ({other[1]}) was judged by one of the two only")
    number = {cell: i for i, cell in enumerate(cells)}
    unit, terrain = np.array(cells).T
    draws = Draws.of(unit, terrain, N_PAIRED_DRAWS, rng)
    weights, stratum = draws.weights[:, draws.place], draws.stratum[draws.place]
    parts = {"": np.ones(len(cells))} | {str(name): (terrain == name) * 1.0 for name in np.unique(terrain)}
    figures, rates = [], []
    for each, of_windows in zip((a, b), pairs, strict=True):
        place = np.array([number[pair] for pair in of_windows])
        size = np.bincount(place)
        rate = np.bincount(place, weights=each.correct.mean(axis=0)) / size
        by_part = {
            name: _over(weights @ (kept * rate * size), weights @ (kept * size))
            for name, kept in parts.items()
        }
        of_class = [(weights @ (kept * rate), weights @ kept) for name, kept in parts.items() if name]
        macro = np.mean([_over(*each) for each in of_class], axis=0)
        repeats = zip(each.confidence, each.correct.astype(float), strict=True)
        areas = [confidence_auc(c, right, weights[:, place]) for c, right in repeats]
        figures.append((by_part, macro, np.mean(areas, axis=0)))
        rates.append(rate.tolist())
    (parts_a, macro_a, area_a), (parts_b, macro_b, area_b) = figures
    differs = np.not_equal(*rates)
    accuracy = {
        name: _difference(parts_a[name], parts_b[name], unit[kept > 0], stratum[kept > 0], differs[kept > 0])
        for name, kept in parts.items()
    }
    of_all = accuracy.pop("")
    macro = _difference(macro_a, macro_b, unit, stratum, differs)
    area = _difference(area_a, area_b, unit, stratum, np.ones(len(cells), dtype=bool))
    by_unit = (UnitDifference(*cell, *pair) for cell, *pair in zip(cells, *rates, strict=True))
    return Comparison(of_all, macro, area, accuracy, tuple(by_unit))


def paired_accuracy(
    unit: Array, terrain: Array, n_windows: Array, a: Array, b: Array, rng: np.random.Generator
) -> Difference:
    """Return the difference of two accuracies of runs (n,), whose units (n,) are drawn within their classes (n,)."""
    draws = Draws.of(unit, terrain, N_PAIRED_DRAWS, rng)
    weights = draws.weights[:, draws.place] * n_windows
    of_a, of_b = (weights @ each / weights.sum(axis=1) for each in (a, b))
    differs = np.bincount(draws.place, a != b) > 0
    return _difference(of_a, of_b, draws.unit, draws.stratum, differs)


def _over(numerator: Array, denominator: Array) -> Array:
    """Return a ratio (d,); NaN of a draw without any."""
    nothing: Array = np.full(len(numerator), np.nan)
    return np.divide(numerator, denominator, out=nothing, where=denominator > 0)


def _difference(of_a: Array, of_b: Array, unit: Array, stratum: Array, differs: Array) -> Difference:
    """Return the difference of figures of which the first is of all units, the others of draws of them.

    ``unit`` and ``stratum`` (cells,) are as of :class:`Draws`, ``differs`` (cells,) is whether the two differ there.
    """
    apart = of_b - of_a
    matters = np.isin(stratum, stratum[differs]) | ~differs.any()
    freedom, (low, high), reason = freedom_of(unit[matters], stratum[matters]), NO_INTERVAL, ""
    if freedom >= MIN_FREEDOM:
        low, high = percentile_interval(apart[1:], freedom=freedom, ends=(-1.0, 1.0))
    else:
        counts = ", ".join(
            f"{name} {len(np.unique(unit[stratum == name]))}" for name in np.unique(stratum[matters])
        )
        reason = f"too few runs or sessions where they differ ({counts})"
    verdict = Verdict.BETTER if low > 0 else Verdict.WORSE if high < 0 else Verdict.NOT_DISTINGUISHED
    ends = float(of_a[0]), float(of_b[0]), float(apart[0])
    return Difference(*ends, (low, high), verdict, len(np.unique(unit)), reason)


MEAN_SPAN_S = 10.0  #: Novelty scores are averaged over so long: a robot crosses a terrain for longer.


class LeftOutTerrain(NamedTuple):
    """How well the windows of a terrain that was left out differ in score from held-out ones of others."""

    auroc: float  #: auroc, auroc_10s: area under the ROC curve of single windows, and of means over 10 s
    auroc_10s: float
    accepted: float  #: part of its windows that are taken for a known terrain
    known_kept: float  #: part of the held-out windows of the other terrains that are not called unknown


def unknown_figures(
    scored: Sequence[Scored], terrain: Array, groups: Array, start_s: Array, seed: int
) -> dict[str, Any]:
    """Return how well a terrain that was never learned is found to be unknown, by name.

    Each terrain is left out in turn: figures are means over the terrains, intervals by bootstrap over units.  The
    threshold of the score keeps ``known_kept_target`` of the known windows of inner held-out runs.
    """
    terrains = np.unique(terrain)
    of_terrain = {str(t): [each for each in scored if terrain[each.unknown[0]] == t] for t in terrains}
    drawn = Draws.of(units_of(terrain, groups), terrain, N_BOOTSTRAP, np.random.default_rng(seed))
    run = np.unique(run_of(groups), return_inverse=True)[1]
    windows, spans, rows = [], [], {}
    for name, parts in of_terrain.items():
        means = []
        for part in parts:  # of the windows that begin in the same 10 s of a run, at the first of their rows
            both = []
            for at, scores in ((part.known, part.known_scores), (part.unknown, part.unknown_scores)):
                span = np.stack([run[at], np.floor(start_s[at] / MEAN_SPAN_S)])
                _, first, which = np.unique(span, axis=1, return_index=True, return_inverse=True)
                both.append((at[first], np.bincount(which.ravel(), scores) / np.bincount(which.ravel())))
            (known, known_scores), (unknown, unknown_scores) = both
            means.append(Scored(known, unknown, known_scores, unknown_scores, part.threshold))
        windows.append(_compare(parts, drawn.place))
        spans.append(_compare(means, drawn.place))
        areas = (float(won.sum() / pairs.sum()) for won, pairs in (windows[-1], spans[-1]))
        kept = (
            [each <= part.threshold for part, each in zip(parts, scores, strict=True)]
            for scores in ([part.unknown_scores for part in parts], [part.known_scores for part in parts])
        )
        rows[name] = LeftOutTerrain(*areas, *(float(np.concatenate(each).mean()) for each in kept))
    auroc, auroc_10s, accepted, known_kept = np.mean([*rows.values()], axis=0).tolist()
    return {
        "auroc_unknown": auroc,
        "auroc_unknown_ci": _area_interval(windows, drawn),
        "auroc_unknown_10s": auroc_10s,
        "auroc_unknown_10s_ci": _area_interval(spans, drawn),
        "unknown_accepted": accepted,
        "known_kept": known_kept,
        "known_kept_target": KNOWN_KEPT,
        "unknown_by_terrain": rows,
    }


def _compare(parts: Sequence[Scored], unit: Array) -> tuple[Array, Array]:
    """Return, by unit of known and unknown windows, how many pairs the unknown one wins, and how many pairs are.

    Pairs are of one fold; ties count one half, NaN as unknown.
    """
    n_units = int(unit.max()) + 1
    won, pairs = np.zeros((2, n_units, n_units))
    for part in parts:
        known_scores, unknown_scores = (
            np.nan_to_num(each, nan=np.inf, posinf=np.inf)
            for each in (part.known_scores, part.unknown_scores)
        )
        known_unit, unknown_unit = unit[part.known], unit[part.unknown]
        for one in np.unique(known_unit):
            ordered = np.sort(known_scores[known_unit == one])
            ranks = sum(np.searchsorted(ordered, unknown_scores, side) for side in ("left", "right"))
            won[one] += np.bincount(unknown_unit, ranks / 2.0, n_units)
            pairs[one] += np.bincount(unknown_unit, minlength=n_units) * len(ordered)
    return won, pairs


def _area_interval(compared: Sequence[tuple[Array, Array]], drawn: Draws) -> Interval:
    """Return the interval of the mean area over the terrains that were left out."""
    weights = drawn.weights[1:]
    draws = np.zeros(len(weights))
    for won, pairs in compared:
        draws += _over(
            *(np.einsum("dr,rs,ds->d", weights, each, weights, optimize=True) for each in (won, pairs))
        )
    return drawn.interval(draws / len(compared))


#: A window comes so often: four times as often as terrain has to be known at 1 Hz, an eighth of a window.
STRIDE_S = 0.25


class DelayFigures(NamedTuple):
    """Time from a change of terrain to where the new terrain is reported: quantiles in s over changes that were found.

    A change is found before the next one; ``n_missed`` of ``n_changes`` were never found.  ``p90_of_all`` takes
    these as infinite, and is None where it is.
    """

    p50: float
    p50_ci: Interval
    p90: float
    p90_ci: Interval
    n_changes: int
    n_missed: int
    p90_of_all: float | None


class SequenceFigures(NamedTuple):
    """How well single windows and the filter follow sequences; every ``_ci`` is 95 % by bootstrap over runs."""

    #: fraction of the time at which the right terrain was reported, where the window that ends then lies wholly on
    #: one terrain; "unknown" counts as wrong
    filtered_accuracy: float
    filtered_accuracy_ci: Interval
    single_accuracy: float  #: the same of the last window's own class
    single_accuracy_ci: Interval
    gain: float  #: filtered minus single, paired
    gain_ci: Interval
    filter_delay_s: DelayFigures  #: from a change to its report
    #: flips_per_minute, single_flips_per_minute: changes of the reported terrain, less the true ones
    flips_per_minute: float
    single_flips_per_minute: float
    unknown_ratio: float  #: fraction of the time at which "unknown" was reported
    n_courses: int  #: sequences


#: Of a stretch on one terrain; flips are changes of the reported terrain less the true one.
COUNTS = ("whole", "filtered", "single", "all", "unknown", "flips", "single_flips")


class Track(NamedTuple):
    """What was reported along a sequence: counts (m, 7) of every stretch on one terrain, its terrain and run (m,).

    ``delay_s`` (m,) is of the change to it: NaN where the terrain did not change before, and infinite where that was
    never found.
    """

    counts: Array
    delay_s: Array
    terrain: Array
    run: tuple[str, ...]
    spliced: bool


def track_of(
    labels: Sequence[Label],
    runs: tuple[str, ...],
    starts_s: Array,
    length_s: float,
    filtered: Array,
    single: Array,
    classes: Array,
    spliced: bool,
) -> Track:
    """Return what the last window and the filter over time report along a sequence.

    Parameters
    ----------
    labels, runs : terrain and run of each stretch of the sequence
    starts_s, length_s : (n,) starts of windows on a regular grid, and their length
    filtered, single : (n,) column of the class (k,), sorted, that the filter and the last window give; -1 for unknown
    """
    time_s, n = starts_s + length_s, len(labels)
    terrain = np.searchsorted(classes, [label.terrain for label in labels])
    counts, delay_s, flips = np.zeros((n, len(COUNTS))), np.full(n, np.nan), []
    for reports in (filtered, single):  # "unknown" between two terrains is no change
        flip, known = np.zeros(len(reports), dtype=bool), np.flatnonzero(reports >= 0)
        flip[known[1:]] = np.diff(reports[known]) != 0
        flips.append(flip)
    for i, label in enumerate(labels):
        here = (time_s > label.start_s + TIME_TOLERANCE_S) & (time_s <= label.end_s + TIME_TOLERANCE_S)
        whole = here & (starts_s >= label.start_s - TIME_TOLERANCE_S)
        right = [(reports == terrain[i]) & here for reports in (filtered, single)]
        changed = i > 0 and bool(terrain[i - 1] != terrain[i])
        parts = [whole, *(each & whole for each in right), here, here & (filtered < 0)]
        counts[i] = [*(np.sum(part) for part in parts), *(np.sum(flip & here) - changed for flip in flips)]
        if changed:
            at = np.flatnonzero(right[0])
            delay_s[i] = max(time_s[at[0]] - label.start_s, 0.0) if len(at) else np.inf
    return Track(counts, delay_s, terrain, runs, spliced)


def last_class(probability: Array) -> Array:
    """Return the class (n,) of the last window that had an output; -1 before the first."""
    there = np.asarray(np.isfinite(probability).all(axis=1))
    best = np.where(there, np.where(there[:, None], probability, 0.0).argmax(axis=1), -1)
    latest = np.maximum.accumulate(np.where(there, np.arange(len(there)), -1))
    return np.where(latest >= 0, best[latest], -1)


def sequence_figures(tracks: Sequence[Track], seed: int) -> SequenceFigures | None:
    """Return the figures of sequences by time; None where there is none.  The seed is of the bootstrap."""
    if not tracks:
        return None
    counts, delay_s = (np.concatenate(parts) for parts in zip(*(each[:2] for each in tracks), strict=True))
    run = np.array([name for track in tracks for name in track.run], dtype=str)
    terrain = np.concatenate([track.terrain for track in tracks])
    of_runs = Draws.of(run, terrain, N_BOOTSTRAP, np.random.default_rng(seed))
    draws = of_runs.weights[:, of_runs.place]
    drawn = dict(zip(COUNTS, (draws @ counts).T, strict=True))

    def ratio(numerator: Array, below: str = "all", least: float = 0.0) -> tuple[float, Interval]:
        value, interval = of_runs.ratio(numerator, drawn[below], (least, 1.0))
        return math.nan if value is None else value, interval or NO_INTERVAL

    changes, found = delay_s[~np.isnan(delay_s)], np.flatnonzero(np.isfinite(delay_s))
    order = found[np.argsort(delay_s[found], kind="stable")]
    ordered_s, upto = delay_s[order], draws[1:, order].cumsum(axis=1)

    def quantile(level: float) -> tuple[float, Interval]:
        if not len(order):
            return math.nan, NO_INTERVAL
        at = (upto < level * upto[:, -1:]).sum(axis=1)
        drawn_s = np.where(upto[:, -1] > 0, ordered_s[np.minimum(at, len(ordered_s) - 1)], np.nan)
        return float(np.quantile(ordered_s, level, method="inverted_cdf")), of_runs.interval(
            drawn_s, (0.0, math.inf)
        )

    of_all = float(np.quantile(changes, 0.9, method="inverted_cdf")) if len(found) else math.inf
    known = of_all if math.isfinite(of_all) else None
    n_missed, a_minute = len(changes) - len(found), 60.0 / STRIDE_S
    filtered, single = drawn["filtered"], drawn["single"]
    return SequenceFigures(
        *ratio(filtered, "whole"),
        *ratio(single, "whole"),
        *ratio(filtered - single, "whole", -1.0),
        DelayFigures(*quantile(0.5), *quantile(0.9), len(changes), n_missed, known),
        ratio(drawn["flips"] * a_minute)[0],
        ratio(drawn["single_flips"] * a_minute)[0],
        ratio(drawn["unknown"])[0],
        len(tracks),
    )


MIN_CURVE_POINTS = 4  #: The law of the learning curve has three parameters.
ENOUGH_GAIN = 0.01  #: Enough runs: doubling them would gain less than this accuracy.


class LearningCurve(NamedTuple):
    """Accuracy against the number of training runs of each class."""

    runs_per_class: tuple[
        float, ...
    ]  #: mean over classes and folds, since a class may have fewer than were asked for
    accuracy: tuple[float, ...]  #: with so many training runs
    accuracy_spread: tuple[float | None, ...]  #: over draws of runs; None for all runs
    enough_runs: (
        int | None
    )  #: the number of runs beyond which doubling brings next to nothing; None when not reached
    statement: str  #: the same in a sentence


def learning_curve(
    runs_per_class: Array, drawn: Sequence[float], full: float, unit: str = "run"
) -> LearningCurve:
    """Return the curve of accuracies of drawn folds, in their order, and that of all runs, or what the unit is."""
    by_size = np.reshape(drawn, (-1, CURVE_DRAWS))
    accuracy = np.append(by_size.mean(axis=1), full)
    spread = (*by_size.std(axis=1, ddof=1).tolist(), None)
    enough = enough_runs(runs_per_class, accuracy, unit)
    return LearningCurve(tuple(runs_per_class.tolist()), tuple(accuracy.tolist()), spread, *enough)


def enough_runs(runs_per_class: Array, accuracy: Array, unit: str = "run") -> tuple[int | None, str]:
    """Return how many units a class would be enough by the law ``accuracy(m) = a - b m^-c``, and a sentence.

    Enough is the smallest whole m for which doubling gains less than :data:`ENOUGH_GAIN` by that law; it
    is not sought beyond ten times the largest m that was measured, and is None beyond, or with fewer than four points.

    Examples
    --------
    >>> m = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    >>> enough_runs(m, 0.9 - 0.3 / m)[0]
    16
    """
    if len(accuracy) < MIN_CURVE_POINTS:
        return None, f"{len(accuracy)} sizes are too few to estimate how many {unit}s are enough"
    fit = least_squares(
        lambda p: p[0] - p[1] * runs_per_class ** -p[2] - accuracy,
        x0=[min(accuracy.max() + 0.02, 1.0), 0.3, 0.7],
        bounds=([0.0, 0.0, 0.05], [1.0, 2.0, 3.0]),
    )
    _, scale, power = fit.x
    largest = runs_per_class.max()
    sizes = np.arange(1, int(10 * largest) + 1)
    gain = scale * sizes**-power * (1 - 2.0**-power)
    slack = f"{100 * float(np.interp(largest, sizes, gain)):.1f}\N{NO-BREAK SPACE}%"
    found = sizes[gain < ENOUGH_GAIN]
    if not len(found):
        return None, f"not enough yet: doubling the {largest:.1f} {unit}s per class would still gain {slack}"
    enough = int(found[0])
    return enough, (
        f"{'enough' if enough <= largest else 'not enough yet'}: "
        f"{enough} {unit}{'' if enough == 1 else 's'} per class would be enough "
        f"(doubling them gains under {100 * ENOUGH_GAIN:.0f}\N{NO-BREAK SPACE}%); "
        f"the data have {largest:.1f} on average, doubling which would gain {slack}"
    )
