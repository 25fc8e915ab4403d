"""What a classifier knows of its limits, for which *unknown* is an answer: novelty, support, and sets of classes.

**Novelty**: whether a window is of a terrain that was never learned.  Three terms, each larger for a window that is
less like the training windows:

- margin: ``-max_a min_b f_ab`` of a support vector machine for each pair of classes, whose kernel is narrow,
  so that the margins of windows far from all others fall towards a constant;
- relative Mahalanobis distance ``min_c |W (z - m_c)|^2 - |B (z - m_0)|^2`` of the principal components z,
  with the within-class covariance ``(W'W)^-1`` and that of all windows ``(B'B)^-1`` (Ren et al. 2021, A
  simple fix to Mahalanobis distance for improving near-OOD detection, eq. 3);
- distance to the nearest training window in the first components.

Each term has its rank among the terms of held-out known windows, ``P = (n_above + 1) / (n + 1)``, and the
score is ``-(log P_1 + log P_2 + log P_3)`` (Fisher 1932, combination of independent tests; the terms depend
on each other, so that the score is compared with a threshold of held-out windows and not with a chi-square).
The references are windows of known terrains whose sessions or runs took no part in fitting: inner folds.  The
threshold keeps a given part of the windows of a new session or run, as that of the sets below does.  Nothing is
weighted, so that nothing has to be learned from terrains that are left out.  The score needs no classifier, and
stands beside any.

**Support** of a prediction: how many training runs drove its terrain as the robot drives now.  A classifier that saw a
terrain only at one speed, or only straight on, has not seen it in a curve.  A training run supports a terrain if it
drove that terrain within about 0.2 m/s and 0.4 rad/s of the window.  Runs count, not windows: windows of a run are
alike.  *By true terrain*, which needs a label: how often are windows right whose terrain was driven like this in n
training runs?  *Without a label*, which a robot can ask: the supported probability ``p n / (1 + n)`` of the predicted
terrain, whose probability is p and which n runs support, is low where the classifier doubts or where its answer rests
on few runs; below one half the prediction is marked unsupported.  ``n / (1 + n)`` is the rule of succession with no
observation for the contrary.

**Sets of classes** (conformal): as many classes as are needed to hold the true one at a given level.  The score of a
window is ``s = 1 - p_y``, with the probability of its true class by a classifier that its run did not train; a class
belongs to the set of a new window if ``1 - p_c <= q`` (Sadinle, Lei, Wasserman 2019; Angelopoulos and Bates 2021,
1.1).  Windows of a run resemble each other, so that windows are not exchangeable, but runs are, given that they were
recorded alike.  With R runs, q is the smallest score with

    sum_r F_r(q) / (R + 1) >= level,

F_r the empirical distribution of run r (Dunn, Wasserman, Ramdas 2022, Distribution-free prediction sets for
two-layer hierarchical models, section 3.1, pooled distributions): all windows of a run weigh together as much
as those of another.  Coverage holds on average over windows of a new run, not in each run.  The most probable
class is always in the set, which can only raise the coverage.  A session is a run here, where there are several.  With
scores of inner folds in place of a single calibration part (cross-conformal, Vovk 2015), and with fewer than nine units
for a level of 0.9, the level is not guaranteed, and is therefore measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import stdtrit

from terrain.classify.folds import TOO_FEW, inner_splits, two_classes, units_of
from terrain.errors import DataError
from terrain.records import Array

N_TERMS = 3
N_NEAR = 10  #: Neighbours are sought in so many leading components: in more, all distances become alike.
KNOWN_KEPT = 0.95  #: Part of the windows of known terrains that is not to be called unknown.
N_COMPONENTS = 40
#: Neighbours are sought among at most so many training windows, thinned evenly: 15 us a window.
MAX_PROTOTYPES = 1500
MAX_REFERENCE = 2000
CLIP_STD = 5.0  #: Scaled features are clipped here, as those of the classifier.
SELECTED = 0.8  #: Part of the features that an F test between classes keeps, as the classifier's.
N_INNER_FOLDS = 5
#: Of the support vector machine; gamma is relative to 1 / number of features. The kernel is narrower than what
#: classifies best.
PENALTY, GAMMA = 10.0, 1.0


class Novelty(NamedTuple):
    """A fitted score of novelty."""

    n_features: int  #: before selection
    columns: Array  #: (m,) places of the features that are used
    fill: Array  #: fill, mean, scale: (m,) median, mean and standard deviation of each
    mean: Array
    scale: Array
    components: Array  #: (q, m) principal directions, divided by the square root of m
    within: Array  #: within, background: (q, q) W and B
    background: Array
    means: Array  #: means, centre: (k, q) and (q,) means of the classes and of all windows, multiplied by W and by B
    centre: Array
    prototypes: Array  #: (s, at most 10) training windows in the leading components
    #: vectors, weights, offsets: (v, m), (v, p) and (p,) of the pairs' margins ``f = sum_i w_i exp(-gamma / m |x -
    #: v_i|^2) + c``, positive for the first class of a pair
    vectors: Array
    weights: Array
    offsets: Array
    squares: Array  #: (v,) squared lengths of the vectors
    reference: Array  #: (n, 3) ascending terms of held-out known windows
    threshold: float  #: of the score, above which a window is unknown; so is one without a score

    def score(self, features: Array) -> Array:
        """Return the score (n,) of features (n, f), NaN where not defined; NaN where one is infinite.

        ``DataError`` where there are not as many features.
        """
        return fisher_scores(self.reference, self.terms(features))

    def terms(self, features: Array) -> Array:
        """Return the three terms (n, 3) of each window; arguments and errors as :meth:`score`."""
        features = np.asarray(features, dtype=float)
        if features.ndim != 2 or features.shape[1] != self.n_features:
            raise DataError(f"features have the shape {features.shape}, (n, {self.n_features}) is needed")
        used = features[:, self.columns]
        used = np.where(np.isfinite(used), used, self.fill)
        scaled = np.clip((used - self.mean) / self.scale, -CLIP_STD, CLIP_STD)
        components = scaled @ self.components.T
        products = scaled.astype(self.vectors.dtype) @ self.vectors.T
        squares = np.square(scaled).sum(axis=1)[:, np.newaxis] + self.squares - 2.0 * products
        gamma = GAMMA / len(self.columns)
        margins = np.exp(-gamma * np.maximum(squares, 0.0)) @ self.weights + self.offsets
        terms = np.empty((len(features), N_TERMS))
        terms[:, 0] = -largest_margin(margins, len(self.means))
        terms[:, 1] = cdist(components @ self.within.T, self.means, "sqeuclidean").min(axis=1)
        terms[:, 1] -= np.square(components @ self.background.T - self.centre).sum(axis=1)
        terms[:, 2] = cdist(components[:, : self.prototypes.shape[1]], self.prototypes).min(axis=1)
        terms[np.isinf(features).any(axis=1)] = np.nan
        return terms


def check_novelty(novelty: Novelty, n_classes: int) -> None:
    """Refuse by ``DataError`` a score whose shapes do not fit each other, or that is not of finite numbers."""
    m, q, s, n = (
        len(part) for part in (novelty.columns, novelty.components, novelty.prototypes, novelty.reference)
    )
    near, v, p = min(q, N_NEAR), len(novelty.vectors), n_classes * (n_classes - 1) // 2
    shapes = (
        (), (m,), (m,), (m,), (m,), (q, m), (q, q), (q, q), (n_classes, q), (q,), (s, near),
        (v, m), (v, p), (p,), (v,), (n, N_TERMS), ()
    )  # fmt: skip
    for name, array, shape in zip(novelty._fields, map(np.asarray, novelty), shapes, strict=True):
        kind = "iu" if name in ("columns", "n_features") else "f"
        if array.shape != shape or array.dtype.kind not in kind or not np.isfinite(array).all():
            raise DataError(f"the novelty score's {name} are not {shape} finite numbers")
    if min(m, q, s, n) == 0 or novelty.columns.min() < 0 or novelty.columns.max() >= novelty.n_features:
        raise DataError("the novelty score's columns are none of its features")
    if (novelty.scale <= 0.0).any():
        raise DataError("the novelty score's scales are not above zero")


def largest_margin(margins: Array, n_classes: int) -> Array:
    """Return ``max_a min_b f_ab`` (n,) of the margins of pairs (n, p): by how much the best class wins."""
    least = np.full((len(margins), n_classes), np.inf)
    for pair, (a, b) in enumerate(combinations(range(n_classes), 2)):
        least[:, a] = np.minimum(least[:, a], margins[:, pair])
        least[:, b] = np.minimum(least[:, b], -margins[:, pair])
    found: Array = least.max(axis=1)
    return found


def rarities(reference: Array, scores: Array) -> Array:
    """Return ``-log P`` (n, j) of scores (n, j) by their ranks in ascending references (r, j); 0 where not known.

    Examples
    --------
    >>> reference = np.column_stack([np.arange(99.0), np.full(99, np.nan)])
    >>> rarities(reference, np.array([[99.0, np.nan], [-1.0, 5.0]])).round(2).tolist()
    [[4.61, 0.0], [0.0, 0.0]]
    """
    out = np.zeros(scores.shape)
    for j in range(scores.shape[1]):
        n = int(np.isfinite(reference[:, j]).sum())  # NaN is last in order
        n_above = n - np.searchsorted(reference[:n, j], scores[:, j])
        out[:, j] -= np.log((n_above + 1) / (n + 1))
    return np.where(np.isfinite(scores), out, 0.0)


def fisher_scores(reference: Array, terms: Array) -> Array:
    """Return the score (n,) of terms (n, j) by their ranks in ascending references (r, j); NaN where one is none."""
    known = np.isfinite(terms).all(axis=1)
    return np.where(known, rarities(reference, terms).sum(axis=1), np.nan)


def held_out_terms(X: Array, y: Array, groups: Array, *, gap: int = 1, seed: int = 0) -> Array:
    """Return the terms (n, 3) of training windows when their session or run was held out; NaN where it never was.

    Arguments and errors are those of :func:`learn_novelty`.
    """
    X, y, groups = np.asarray(X, dtype=float), np.asarray(y), np.asarray(groups)
    two_classes(y)
    terms = np.full((len(y), N_TERMS), np.nan)
    for train, test in inner_splits(y, groups, N_INNER_FOLDS, seed, gap):
        terms[test] = _fitted(X[train], y[train]).terms(X[test])
    return terms


def learn_novelty(
    X: Array, y: Array, groups: Array, *, gap: int = 1, seed: int = 0, terms: Array | None = None
) -> Novelty:
    """Return the score of novelty of training windows: features (n, f), NaN where not defined, classes and runs (n,).

    Parameters
    ----------
    gap : rows left out beside a block, where the only run of a class is cut
    seed : deals runs into inner folds
    terms : of :func:`held_out_terms`, where they are there already

    Raises
    ------
    DataError
        if there is one class only, or rows are too few to hold some of them out.
    """
    if terms is None:
        terms = held_out_terms(X, y, groups, gap=gap, seed=seed)
    X, y = np.asarray(X, dtype=float), np.asarray(y)
    known = terms[np.isfinite(terms).all(axis=1)]
    if not len(known):
        raise DataError(TOO_FEW)
    reference = np.sort(known, axis=0)
    if len(reference) > MAX_REFERENCE:
        reference = np.quantile(reference, np.linspace(0.0, 1.0, MAX_REFERENCE), axis=0)
    unit = units_of(y, groups)[np.isfinite(terms).all(axis=1)]
    threshold = conformal_threshold(fisher_scores(reference, known), unit, KNOWN_KEPT, np.inf)
    return _fitted(X, y)._replace(reference=reference, threshold=threshold)


def _fitted(X: Array, y: Array) -> Novelty:
    """Return the score without references and threshold."""
    from sklearn.covariance import ledoit_wolf
    from sklearn.svm import SVC

    from terrain.classify.grouped import f_score, filled_by_median

    fill, filled = filled_by_median(X, np.isfinite(X))
    mean, scale = filled.mean(axis=0), filled.std(axis=0)
    columns = np.flatnonzero(scale > 1e-12 * np.abs(mean))
    if not len(columns):
        raise DataError("no feature varies: windows cannot be compared")
    f_test = np.nan_to_num(f_score(filled[:, columns], y)[0], posinf=np.inf)
    columns = columns[f_test >= np.quantile(f_test, 1.0 - SELECTED)]
    fill, mean, scale = fill[columns], mean[columns], scale[columns]
    scaled = np.clip((filled[:, columns] - mean) / scale, -CLIP_STD, CLIP_STD)
    directions = np.linalg.eigh(np.cov(scaled, rowvar=False).reshape(len(columns), -1))[1][:, ::-1]
    n_components = min(N_COMPONENTS, len(columns), len(X) - 1)
    components = np.ascontiguousarray(directions[:, :n_components].T) / np.sqrt(len(columns))
    z = scaled @ components.T
    classes, class_of = np.unique(y, return_inverse=True)
    means = np.stack([z[class_of == c].mean(axis=0) for c in range(len(classes))])
    whitening = []  # W with W'W the inverse of the shrunk covariance (Ledoit and Wolf 2004)
    for residuals in (z - means[class_of], z - z.mean(axis=0)):
        covariance = ledoit_wolf(residuals, assume_centered=True)[0]
        covariance += 1e-9 * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
        whitening.append(np.linalg.inv(np.linalg.cholesky(covariance)))
    within, background = whitening
    svc = SVC(C=PENALTY, gamma=GAMMA / scaled.shape[1], cache_size=500).fit(scaled, y)
    sign = -1.0 if len(classes) == 2 else 1.0  # scikit-learn turns the two-class decision around
    bounds, pairs = (
        np.concatenate(([0], np.cumsum(svc.n_support_))),
        list(combinations(range(len(classes)), 2)),
    )
    weights = np.zeros((len(svc.support_vectors_), len(pairs)))
    for pair, (a, b) in enumerate(pairs):
        of_a, of_b = slice(bounds[a], bounds[a + 1]), slice(bounds[b], bounds[b + 1])
        weights[of_a, pair] = sign * svc.dual_coef_[b - 1, of_a]
        weights[of_b, pair] = sign * svc.dual_coef_[a, of_b]
    vectors = svc.support_vectors_.astype(np.float32)  # half the memory that a window has to go through
    step = -(-len(z) // MAX_PROTOTYPES)
    return Novelty(
        X.shape[1], columns.astype(np.int64), fill, mean, scale, components, within, background,
        means @ within.T, background @ z.mean(axis=0), np.ascontiguousarray(z[::step, :N_NEAR]),
        vectors, weights, sign * svc.intercept_, np.square(vectors, dtype=float).sum(axis=1),
        np.zeros((0, N_TERMS)), np.inf,
    )  # fmt: skip


class Motion(NamedTuple):
    """How the robot moved in each of n windows."""

    speed_mps: Array  #: (n,) magnitude of the speed of the fastest wheel, mean over the window
    yaw_rate_radps: Array  #: (n,) magnitude of the mean yaw rate; NaN where no gyroscope measures it
    #: (n,) ``|v_right - v_left| / (|v_right| + |v_left|)`` of the mean speeds of the two sides: 0 straight on, 1
    #: where one side stands or they turn against each other; NaN without two sides
    turn_ratio: Array

    def of(self, rows: Array) -> Motion:
        """Return the motion in some of the windows."""
        return Motion(*(each[rows] for each in self))


SPEED_STEP_MPS, YAW_STEP_RADPS = 0.05, 0.1  #: Cells of motion.
#: A run supports the cells around those it drove, up to so many: about 0.2 m/s and 0.4 rad/s. Chosen, with
#: ``SUPPORTED``, on held-out runs of BorealTC and Vulpi dealt by seed 101; between 0.15 and 0.2 m/s, and 0.25 and 0.4
#: rad/s, the figures differ little.
REACH = 3
#: What is faster counts as 20 m/s, and as 6.4 rad/s, so that a table stays small.
MAX_SPEED_CELLS, MAX_YAW_CELLS = 400, 64
#: A prediction of a smaller supported probability is unsupported: rather wrong or unseen than right.
SUPPORTED = 0.5
ENOUGH_RUNS = 4  #: Of so many training runs near its motion a terrain counts as well supported.


class SupportLevel(StrEnum):
    """How many training runs drove a terrain with the motion of a window."""

    NEVER = "never seen in training"
    FEW = f"1 to {ENOUGH_RUNS - 1} runs"
    ENOUGH = f"{ENOUGH_RUNS} runs and more"


@dataclass(frozen=True, slots=True, eq=False)
class SupportTable:
    """Training runs (classes, speed cells, yaw cells) near each cell of motion; none beyond the last cells."""

    classes: tuple[str, ...]
    n_runs: Array

    def near_runs(self, speed_mps: Array, yaw_rate_radps: Array) -> Array:
        """Return the training runs (n, classes) of each terrain near the motion of n windows.

        A yaw rate that is not known, NaN, counts as zero, as it did in training.
        """
        speed, yaw = motion_cells(speed_mps, yaw_rate_radps)
        _, n_speed, n_yaw = self.n_runs.shape
        inside = (speed < n_speed) & (yaw < n_yaw)
        found = self.n_runs[:, np.minimum(speed, n_speed - 1), np.minimum(yaw, n_yaw - 1)].T
        return np.asarray(np.where(inside[:, None], found, 0))


def check_support(table: SupportTable, classes: Sequence[str]) -> None:
    """Refuse by ``DataError`` a table whose classes are others, or whose numbers of runs are none."""
    if table.classes != tuple(classes):
        raise DataError("the table of support is of other classes")
    counts = np.asarray(table.n_runs)
    if counts.ndim != 3 or len(counts) != len(classes) or counts.dtype.kind not in "iu" or not counts.size:
        raise DataError(f"the table of support has the shape {counts.shape}, in numbers of {counts.dtype}")
    if counts.min() < 0:
        raise DataError("the table of support holds negative numbers of runs")


def motion_cells(speed_mps: Array, yaw_rate_radps: Array) -> tuple[Array, Array]:
    """Return the speed cell and the yaw cell (n,) of each window."""
    speed = np.floor(np.nan_to_num(speed_mps) / SPEED_STEP_MPS).astype(int)
    yaw = np.floor(np.nan_to_num(yaw_rate_radps) / YAW_STEP_RADPS).astype(int)
    return np.clip(speed, 0, MAX_SPEED_CELLS - 1), np.clip(yaw, 0, MAX_YAW_CELLS - 1)


def learn_support(
    speed_mps: Array, yaw_rate_radps: Array, terrain: Array, run_id: Array, classes: Sequence[str]
) -> SupportTable:
    """Count the training runs of each terrain near each cell of motion, of training windows (n,).

    Examples
    --------
    >>> speed, yaw = np.array([0.5, 0.52, 1.5]), np.zeros(3)
    >>> table = learn_support(speed, yaw, np.array(["ice"] * 3), np.array(["a", "b", "b"]), ["ice", "mud"])
    >>> table.near_runs(np.array([0.6, 1.0, 1.6]), np.zeros(3)).tolist()
    [[2, 0], [0, 0], [1, 0]]
    """
    speed, yaw = motion_cells(speed_mps, yaw_rate_radps)
    shape = int(speed.max(initial=0)) + REACH + 1, int(yaw.max(initial=0)) + REACH + 1
    counts = np.zeros((len(classes), *shape), dtype=int)
    for number, name in enumerate(classes):
        of_class = terrain == name
        for run in np.unique(run_id[of_class]):
            rows = np.flatnonzero(of_class & (run_id == run))
            near = np.zeros(shape, dtype=bool)
            for i, j in set(zip(speed[rows].tolist(), yaw[rows].tolist(), strict=True)):
                near[max(i - REACH, 0) : i + REACH + 1, max(j - REACH, 0) : j + REACH + 1] = True
            counts[number] += near
    return SupportTable(tuple(str(name) for name in classes), counts)


def supported_probability(probability: Array, near_runs: Array) -> Array:
    """Return ``p n / (1 + n)`` (n,) of the most probable terrain of each window, both (n, k) of the same classes.

    A prediction of less than :data:`SUPPORTED` is unsupported.

    Examples
    --------
    >>> supported_probability(np.array([[0.9, 0.1], [0.9, 0.1], [0.4, 0.6]]), np.array([[4, 4], [0, 9], [9, 2]]))
    array([0.72, 0.  , 0.4 ])
    """
    rows, best = np.arange(len(probability)), probability.argmax(axis=1)
    n_runs = near_runs[rows, best]
    return np.asarray(probability[rows, best] * n_runs / (1.0 + n_runs))


def support_levels(n_runs: Array) -> Array:
    """Return the :class:`SupportLevel` of numbers of training runs, as texts of the same shape."""
    names = np.array([level.value for level in SupportLevel])
    return names[np.digitize(n_runs, [1, ENOUGH_RUNS])]


LEVEL = 0.9  #: Of the sets of classes.
ONE_SIDED = 0.9  #: Of the bound of their coverage, where units are few.


def held_out_scores(classifier: Any, terrain: Array) -> Array:
    """Return ``1 - p`` of the true class (n,) of each training row when its run was held out; NaN where it was not."""
    truth = np.searchsorted(classifier.classes_, terrain)
    return np.asarray(1.0 - classifier.inner_probability_[np.arange(len(terrain)), truth])


def conformal_threshold(scores: Array, units: Array, level: float = LEVEL, most: float = 1.0) -> float:
    """Return q of held-out scores (n,), NaN left out, over their units (n,), sessions or runs.

    Where the units are too few for a guarantee, q is the smallest score up to which the mean of their distributions
    reaches the level by its one-sided bound (Student's t); with one unit it is the most that a score can be.
    ``DataError`` where no score is finite.

    Examples
    --------
    >>> scores, runs = np.arange(100) / 100, np.arange(100).astype(str)
    >>> conformal_threshold(scores, runs, 0.9), conformal_threshold(scores[:1], runs[:1], 0.9)
    (0.9, 1.0)
    >>> conformal_threshold(np.array([0.1, 0.5, 0.2, 0.6]), np.array(["a", "a", "b", "b"]), 0.9)
    0.6
    """
    kept = np.isfinite(scores)
    if not kept.any():
        raise DataError("there is no held-out window to calibrate the sets of classes with")
    scores, units = scores[kept], units[kept]
    _, unit_of, n_windows = np.unique(units.astype(str), return_inverse=True, return_counts=True)
    order, n_units = np.argsort(scores, kind="stable"), len(n_windows)
    if (1.0 - level) * (
        n_units + 1.0
    ) >= 1.0 - 1e-9:  # one unit more, whose scores are all above, can be missed
        held = np.cumsum(1.0 / (n_windows[unit_of[order]] * (n_units + 1.0)))
    elif n_units > 1:
        each = np.cumsum(unit_of[order, None] == np.arange(n_units), axis=0) / n_windows
        error = each.std(axis=1, ddof=1) / np.sqrt(n_units)
        held = each.mean(axis=1) - stdtrit(n_units - 1, ONE_SIDED) * error
    else:
        return most
    reached = held >= level - 1e-12
    return float(scores[order][reached.argmax()]) if reached.any() else most


def conformal_sets(probability: Array, threshold: float) -> Array:
    """Return which classes are in the set of each window (n, k), from probabilities (n, k).

    Examples
    --------
    >>> conformal_sets(np.array([[0.6, 0.3, 0.1], [0.4, 0.3, 0.3]]), 0.7)
    array([[ True,  True, False],
           [ True,  True,  True]])
    """
    found: Array = 1.0 - probability <= threshold + 1e-12
    found[np.arange(len(found)), probability.argmax(axis=1)] = True
    return found
