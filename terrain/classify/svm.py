"""RBF support vector machine that chooses and calibrates itself on folds which keep runs whole.

Windows of one run resemble each other more than they resemble windows of the same terrain in another run.
Hyper-parameters chosen, or probabilities calibrated, on folds that split runs are therefore too optimistic;
here the inner folds are made of whole groups wherever a class has more than one.

Steps of ``fit``: scale and select on each inner training part, fit every candidate there, keep the
candidate with the best accuracy on the held-out parts; its held-out margins of pairs of classes give the one
scale, below, that makes the true classes most likely; scale, select and fit once more on everything.

One support vector machine separates each pair of classes (a, b), a before b, by a margin ``f_ab``, positive
for a.  With one scale s for all pairs, ``r_ab = 1 / (1 + exp(-s f_ab))`` estimates the probability of a where
the truth is a or b, and the class probabilities p are those that agree best with all pairs (Wu, Lin and Weng
2004, "Probability estimates for multi-class classification by pairwise coupling", JMLR 5, equations 15, 18):

    minimise  sum_a sum_{b != a} (r_ba p_a - r_ab p_b)^2   subject to  sum_a p_a = 1

which is one linear system: with ``Q_aa = sum_{b != a} r_ba^2`` and ``Q_ab = -r_ba r_ab``, the solution of
``(Q + 1 1') z = 1`` divided by its sum.

One-vs-rest decision values that count the votes of the pairs, as scikit-learn's do, saturate at the number of
classes and rank windows hardly by how often they are right; the margins themselves do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field
from scipy.optimize import minimize_scalar
from scipy.special import expit
from sklearn.svm import SVC

from terrain.classify.folds import TOO_FEW, inner_splits
from terrain.classify.grouped import GroupedClassifier, fit_preparation
from terrain.errors import DataError
from terrain.records import Array

#: Margins of support vectors are 1: beyond these bounds probabilities of the pairs are flat or 0 and 1.
LOG_SCALE_BOUNDS = (-4.0, 5.0)
#: Probabilities of pairs are kept from 0 and 1 by this, as in LIBSVM: the linear system is regular then.
MIN_PAIR_PROBABILITY = 1e-7
#: Hyper-parameters are chosen on at most so many rows, thinned evenly: overlapping windows repeat each other, and the
#: cost of an SVM grows with the square of their number. The last fit uses all rows.
MAX_INNER_ROWS = 4000


def pairs_of(n_classes: int) -> list[tuple[int, int]]:
    """Return the pairs of classes in the order of their margins."""
    return list(combinations(range(n_classes), 2))


def class_probabilities(margins: Array, n_classes: int, scale: float) -> Array:
    """Return the probabilities (n, k) that agree best with the margins (n, k (k - 1) / 2) of :func:`pairs_of`.

    A class whose pairs are all NaN, as it was not there to train on, has none in that row.

    Examples
    --------
    >>> class_probabilities(np.array([[2.0, 2.0, 0.0], [np.nan, 0.0, np.nan]]), 3, 1.0).round(2)
    array([[0.79, 0.11, 0.11],
           [0.5 , 0.  , 0.5 ]])
    """
    a, b = np.triu_indices(n_classes, 1)
    r = np.clip(expit(scale * margins), MIN_PAIR_PROBABILITY, 1.0 - MIN_PAIR_PROBABILITY)
    ratio = np.zeros((len(margins), n_classes, n_classes))
    ratio[:, a, b], ratio[:, b, a] = np.nan_to_num(r), np.nan_to_num(1.0 - r)
    known: Array = ratio.max(axis=2) > 0.0
    system = np.where(known[:, :, None] & known[:, None], 1.0 - ratio * ratio.swapaxes(1, 2), 0.0)
    both = np.arange(n_classes)
    # a class that is not known stands alone, and has the solution 0
    system[:, both, both] = 1.0 + np.square(ratio).sum(axis=1)
    solution = np.linalg.solve(system, known[:, :, None].astype(float))[:, :, 0]
    solution = np.maximum(solution, 0.0)  # -1e-17 of rounding
    return np.asarray(solution / solution.sum(axis=1, keepdims=True))


def fit_scale(margins: Array, class_index: Array, n_classes: int) -> float:
    """Return the scale under which the true classes (n,) of held-out windows are most likely."""
    rows = np.arange(len(class_index))

    def loss(log_scale: float) -> float:
        found = class_probabilities(margins, n_classes, float(np.exp(log_scale)))
        return -float(np.log(found[rows, class_index] + MIN_PAIR_PROBABILITY).sum())

    return float(np.exp(minimize_scalar(loss, bounds=LOG_SCALE_BOUNDS, method="bounded").x))


class Candidate(NamedTuple):
    """One choice of hyper-parameters.

    ``gamma`` is relative to 1 / number of selected features, so that it means the same distance whatever
    the number; ``percentile`` is the percentage of the features that an F test keeps.
    """

    C: Annotated[float, Field(gt=0.0, le=1e6)]
    gamma: Annotated[float, Field(gt=0.0, le=1e3)]
    percentile: Annotated[float, Field(gt=0.0, le=100.0)]


CANDIDATES: tuple[Candidate, ...] = (
    Candidate(10.0, 1.0, 80.0),
    Candidate(10.0, 1.0, 100.0),
    Candidate(10.0, 0.4, 80.0),
    Candidate(10.0, 0.4, 100.0),
    Candidate(3.0, 0.15, 100.0),
    Candidate(30.0, 0.15, 100.0),
)


@dataclass(eq=False, repr=False)
class GroupedSVC(GroupedClassifier):
    """RBF SVM with its own scaling, selection, choice of hyper-parameters and calibration.

    Attributes
    ----------
    best_, scale_ : the chosen :class:`Candidate`, and the scale of the margins
    inner_scores_ : (n_candidates,) accuracy on the held-out inner parts
    n_inner_fits_ : how many SVMs were fitted to choose and to calibrate
    """

    candidates: Sequence[Sequence[float]] = CANDIDATES  #: sequence of :class:`Candidate` to choose from
    n_inner_folds: int = 3  #: inner folds; the number of inner fits is this times the number of candidates
    #: windows left out beside an inner test block, where the only run of a class is cut; as many as share samples
    #: with a window
    gap: int = 1
    seed: int = 0  #: deals runs into inner folds

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> GroupedSVC:
        """Choose, calibrate and fit; ``DataError`` where a class has too few windows to hold some of them out."""
        X, y, groups = self._training_rows(X, y, groups)
        counts = np.unique(y, return_counts=True)[1]
        if counts.min() < 2:
            rare = str(self.classes_[counts.argmin()])
            raise DataError(f"there is one window of class {rare!r}; at least 2 are needed")
        candidates = [Candidate(*candidate) for candidate in self.candidates]
        step, k = -(-len(y) // MAX_INNER_ROWS), len(self.classes_)
        held_out, margins = self._inner_margins(X[::step], y[::step], groups[::step], step, candidates)
        truth = np.searchsorted(self.classes_, y[::step][held_out])
        scales = [fit_scale(margin, truth, k) for margin in margins]
        inner = [class_probabilities(margin, k, s) for margin, s in zip(margins, scales, strict=True)]
        self.inner_scores_ = np.array([np.mean(each.argmax(axis=1) == truth) for each in inner])
        best = int(np.argmax(self.inner_scores_))
        self.best_, self.scale_ = candidates[best], scales[best]
        self.inner_probability_ = np.full((len(y), k), np.nan)
        self.inner_probability_[np.arange(0, len(y), step)[held_out]] = inner[best]
        self.preparation_ = fit_preparation(X, y, self.best_.percentile)
        self.svc_ = _fit_svc(self.best_, self.preparation_.of(X), y)
        return self

    def _inner_margins(
        self, X: Array, y: Array, groups: Array, step: int, candidates: Sequence[Candidate]
    ) -> tuple[Array, Array]:
        """Return the rows that inner folds hold out, and their margins (candidates, rows, pairs)."""
        margins = np.full((len(candidates), len(y), len(pairs_of(len(self.classes_)))), np.nan)
        held_out = np.zeros(len(y), dtype=bool)
        self.n_inner_fits_ = 0
        gap = -(-self.gap // step)
        for train, test in inner_splits(y, groups, self.n_inner_folds, self.seed, gap, lacking=True):
            held_out[test] = True
            for percentile in dict.fromkeys(candidate.percentile for candidate in candidates):
                preparation = fit_preparation(X[train], y[train], percentile)
                prepared, prepared_test = preparation.of(X[train]), preparation.of(X[test])
                for i, candidate in enumerate(candidates):
                    if candidate.percentile == percentile:
                        svc = _fit_svc(candidate, prepared, y[train])
                        margins[i, test] = pair_margins(svc, prepared_test, self.classes_)
                        self.n_inner_fits_ += 1
        if not held_out.any():
            raise DataError(TOO_FEW)
        rows = np.flatnonzero(held_out)
        return rows, margins[:, rows]

    def predict_proba(self, X: Array) -> Array:
        """Return calibrated probabilities (n, k) in the order of ``classes_``."""
        rows = self._rows(X)
        margins = pair_margins(self.svc_, self.preparation_.of(rows), self.classes_)
        return class_probabilities(margins, len(self.classes_), self.scale_)


def _fit_svc(candidate: Candidate, prepared: Array, y: Array) -> SVC:
    gamma = candidate.gamma / prepared.shape[1]
    return SVC(C=candidate.C, gamma=gamma, cache_size=500, decision_function_shape="ovo").fit(prepared, y)


def pair_margins(svc: SVC, prepared: Array, classes: Array) -> Array:
    """Return the margins of all pairs of classes; NaN in those of a class that was not there to train on."""
    values = svc.decision_function(prepared)
    if values.ndim == 1:
        values = -values[:, None]  # scikit-learn turns the two-class decision around
    places = np.searchsorted(classes, svc.classes_)
    column = {pair: i for i, pair in enumerate(pairs_of(len(classes)))}
    margins = np.full((len(prepared), len(column)), np.nan)
    margins[:, [column[places[a], places[b]] for a, b in pairs_of(len(places))]] = values
    return margins
