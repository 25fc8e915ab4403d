"""The support vector machine on features and the network on samples, joined on held-out runs.

``log p = w_svm log p_svm + w_net log p_net - log sum`` with weights not below zero: where one of the two is
uncertain, the other decides.  The weights make the true classes of held-out windows most likely; a penalty
draws them towards one half each, the mean of the two, which is where few runs leave them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_softmax

from terrain.classify.folds import fold_numbers, units_of
from terrain.classify.grouped import GroupedClassifier
from terrain.classify.network import GroupedNetwork, SampleColumns
from terrain.classify.svm import CANDIDATES, GroupedSVC
from terrain.errors import DataError
from terrain.records import Array

#: Of the squared distance of the weights from one half, against the mean log loss of a window.
PENALTY = 0.1
N_CROSS_FOLDS = 5
#: The SVM is left only for what has a lower loss by so many standard errors over runs.
MIN_STANDARD_ERRORS = 1.0
TINY = np.finfo(float).tiny


class StackChoice(NamedTuple):
    """What held-out runs chose: which is ``used`` (svm, cnn, stack), and the weights of the log probabilities.

    Losses are mean log losses of held-out runs, of the stack with weights of other runs.
    """

    used: str
    weight_svm: float
    weight_cnn: float
    loss_svm: float
    loss_cnn: float
    loss_stack: float


@dataclass(eq=False, repr=False)
class GroupedStack(GroupedClassifier):
    """Stack of :class:`GroupedSVC` and :class:`GroupedNetwork` that keeps runs whole.

    Attributes
    ----------
    best_ : :class:`StackChoice`
    svm_, network_ : the two, fitted; None where it is not used
    """

    columns: Sequence[
        SampleColumns
    ] = ()  #: of the samples, the last columns of a row; the features are before them
    #: use whichever of the SVM, the network and the stack held-out runs favour, instead of the stack
    choose: bool = False
    candidates: Sequence[Sequence[float]] = CANDIDATES  #: of the SVM
    n_inner_folds: int = 3  #: of both, which are thus weighed on the same held-out runs
    n_members: int = 3  #: n_members, epochs, trial_epochs: of the network
    epochs: int = 30
    trial_epochs: int = 10
    gap: int = 1  #: gap, seed: of both
    seed: int = 0

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> GroupedStack:
        """Fit both and their weights; errors as of the two, and where rows hold no features beside the samples."""
        X, y, groups = self._training_rows(X, y, groups)
        features, samples = self._parts(X)
        of_both: dict[str, Any] = {"n_inner_folds": self.n_inner_folds, "gap": self.gap, "seed": self.seed}
        sizes: dict[str, Any] = {
            "n_members": self.n_members,
            "epochs": self.epochs,
            "trial_epochs": self.trial_epochs,
        }
        svm = GroupedSVC(self.candidates, **of_both).fit(features, y, groups)
        network = GroupedNetwork(self.columns, **sizes, **of_both).fit(samples, y, groups)
        both = np.stack([svm.inner_probability_, network.inner_probability_])
        rows = np.flatnonzero(np.isfinite(both).all(axis=(0, 2)))
        if not len(rows):
            raise DataError("no window was held out by both the SVM and the network; add runs")
        held_out, truth = both[:, rows], np.searchsorted(self.classes_, y[rows])
        run = units_of(y, groups)[rows]
        crossed = cross_joined(held_out, truth, run, self.seed)
        losses = np.stack([-log_of_truth(each, truth) for each in (*held_out, crossed)])
        used = chosen_of(losses, run) if self.choose else "stack"
        alone = {"svm": np.array([1.0, 0.0]), "cnn": np.array([0.0, 1.0])}
        weights = alone[used] if used in alone else fit_weights(held_out, truth)
        self.best_ = StackChoice(used, *weights.tolist(), *losses.mean(axis=1).tolist())
        self.inner_probability_ = np.full(both.shape[1:], np.nan)
        self.inner_probability_[rows] = joined(held_out, weights)
        self.svm_ = svm if weights[0] > 0 else None
        self.network_ = network if weights[1] > 0 else None
        return self

    def _parts(self, X: Array) -> tuple[Array, Array]:
        width = sum(each.width for each in self.columns)
        if not 0 < width < X.shape[1]:
            raise DataError(f"{X.shape[1]} columns are not features and {width} samples")
        return X[:, : X.shape[1] - width], X[:, X.shape[1] - width :]

    def predict_proba(self, X: Array) -> Array:
        """Return calibrated probabilities (n, k) in the order of ``classes_``, of one alone unchanged."""
        parts = zip((self.svm_, self.network_), self._parts(self._rows(X)), strict=True)
        found = [each.predict_proba(part) for each, part in parts if each is not None]
        weights = np.array([self.best_.weight_svm, self.best_.weight_cnn])
        return joined(np.stack(found), weights) if len(found) == 2 else found[0]


def fit_weights(probability: Array, class_index: Array) -> Array:
    """Return the weights (2,) of log probabilities (2, n, k) under which the true classes are most likely."""
    half = np.full(2, 0.5)

    def loss(weights: Array) -> float:
        fit = -log_of_truth(joined(probability, weights), class_index).mean()
        return float(fit + PENALTY * ((weights - half) ** 2).sum())

    return np.asarray(minimize(loss, half, bounds=[(0.0, 5.0)] * 2, method="L-BFGS-B").x)


def joined(probability: Array, weights: Array) -> Array:
    """Return probabilities (n, k) from those of both (2, n, k)."""
    logits = np.tensordot(weights, np.log(np.maximum(probability, TINY)), axes=1)
    return np.asarray(np.exp(log_softmax(logits, axis=1)))


def log_of_truth(probability: Array, class_index: Array) -> Array:
    """Return the log probability (n,) of the true class."""
    return np.asarray(np.log(np.maximum(probability[np.arange(len(class_index)), class_index], TINY)))


def cross_joined(probability: Array, class_index: Array, run: Array, seed: int) -> Array:
    """Return stacked probabilities of each run with weights that were fitted to other runs."""
    n_folds = min(N_CROSS_FOLDS, len(np.unique(run)))
    if n_folds < 2:
        return joined(probability, fit_weights(probability, class_index))
    fold = fold_numbers(class_index, run, n_folds, np.random.default_rng(seed))
    found = np.empty(probability.shape[1:])
    for number in range(n_folds):
        test = fold == number
        weights = fit_weights(probability[:, ~test], class_index[~test])
        found[test] = joined(probability[:, test], weights)
    return found


def chosen_of(losses: Array, run: Array) -> str:
    """Return which of SVM, network and stack the losses (3, n) of held-out windows favour.

    The SVM, the cheapest, unless another has a lower loss by :data:`MIN_STANDARD_ERRORS`, by differences
    paired by run.
    """
    _, of_run = np.unique(run, return_inverse=True)
    count = np.bincount(of_run)
    mean = np.stack([np.bincount(of_run, weights=each) / count for each in losses])
    difference = mean - mean[0]
    error = difference.std(axis=1, ddof=1) / np.sqrt(len(count)) if len(count) > 1 else np.full(3, np.inf)
    found = difference.mean(axis=1)
    better = [i for i in (1, 2) if found[i] < -MIN_STANDARD_ERRORS * error[i]]
    return ("svm", "cnn", "stack")[min(better, key=lambda i: found[i], default=0)]
