"""The support vector machine on features and the network on samples, joined on held-out runs.

``log p = w_svm log p_svm + w_net log p_net - log sum`` with weights not below zero: where one of the two is
uncertain, the other decides.  The weights make the true classes of held-out windows most likely; a penalty
draws them towards one half each, the mean of the two, which is where few runs leave them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from terrain.classify.folds import fold_numbers
from terrain.classify.grouped import GroupedClassifier
from terrain.classify.grouped_network import GroupedNetwork
from terrain.classify.network_input import SampleColumns, log_softmax
from terrain.classify.svm import CANDIDATES, GroupedSVC
from terrain.errors import DataError
from terrain.records import Array

PENALTY = 0.1
"""Of the squared distance of the weights from one half, against the mean log loss of a window."""

N_CROSS_FOLDS = 5
MIN_STANDARD_ERRORS = 1.0
"""The SVM is left only for what has a lower loss by so many standard errors over runs."""


class StackChoice(NamedTuple):
    """What held-out runs chose.

    Parameters
    ----------
    used : ``svm``, ``cnn`` or ``stack``
    weight_svm, weight_cnn : of their log probabilities
    loss_svm, loss_cnn, loss_stack : mean log loss of held-out runs, of the stack with weights of other runs
    """

    used: str
    weight_svm: float
    weight_cnn: float
    loss_svm: float
    loss_cnn: float
    loss_stack: float


class GroupedStack(GroupedClassifier):
    """Stack of :class:`GroupedSVC` and :class:`GroupedNetwork` that keeps runs whole.

    Parameters
    ----------
    columns : of the samples, the last columns of a row; the features are before them
    choose : use whichever of the SVM, the network and the stack held-out runs favour, instead of the stack
    candidates : of the SVM
    n_inner_folds : of both, which are thus weighed on the same held-out runs
    n_members, epochs, trial_epochs : of the network
    gap, seed : of both

    Attributes
    ----------
    classes_ : (k,) class names
    best_ : :class:`StackChoice`
    inner_probability_ : (n, k) of held-out rows; NaN where one of the two has none
    svm_, network_ : the two, fitted; None where it is not used
    """

    def __init__(
        self,
        columns: Sequence[SampleColumns] = (),
        choose: bool = False,
        candidates: Sequence[Sequence[float]] = CANDIDATES,
        n_inner_folds: int = 3,
        n_members: int = 3,
        epochs: int = 30,
        trial_epochs: int = 10,
        gap: int = 1,
        seed: int = 0,
    ) -> None:
        self.columns = columns
        self.choose = choose
        self.candidates = candidates
        self.n_inner_folds = n_inner_folds
        self.n_members = n_members
        self.epochs = epochs
        self.trial_epochs = trial_epochs
        self.gap = gap
        self.seed = seed

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> GroupedStack:
        """Fit both and their weights; parameters and errors as of the two.

        Raises
        ------
        DataError
            also if the rows hold no features beside the samples.
        """
        X, y, groups = self._training_rows(X, y, groups)
        features, samples = self._parts(X)
        of_both = {"n_inner_folds": self.n_inner_folds, "gap": self.gap, "seed": self.seed}
        svm = GroupedSVC(self.candidates, **of_both).fit(features, y, groups)
        network = GroupedNetwork(
            self.columns,
            n_members=self.n_members,
            epochs=self.epochs,
            trial_epochs=self.trial_epochs,
            **of_both,
        ).fit(samples, y, groups)
        both = np.stack([svm.inner_probability_, network.inner_probability_])
        rows = np.flatnonzero(np.isfinite(both).all(axis=(0, 2)))
        if not len(rows):
            raise DataError("no window was held out by both the SVM and the network; add runs")
        truth, run = np.searchsorted(self.classes_, y[rows]), groups[rows].astype(str)
        weights = fit_weights(both[:, rows], truth)
        crossed = _cross_joined(both[:, rows], truth, run, self.seed)
        losses = np.stack([-log_of_truth(each, truth) for each in (*both[:, rows], crossed)])
        used = chosen_of(losses, run) if self.choose else "stack"
        weights = {"svm": np.array([1.0, 0.0]), "cnn": np.array([0.0, 1.0]), "stack": weights}[used]
        self.best_ = StackChoice(used, *weights.tolist(), *losses.mean(axis=1).tolist())
        self.inner_probability_ = np.full(both.shape[1:], np.nan)
        self.inner_probability_[rows] = joined(both[:, rows], weights)
        self.svm_ = svm if weights[0] > 0 else None
        self.network_ = network if weights[1] > 0 else None
        return self

    def _parts(self, X: Array) -> tuple[Array, Array]:
        width = sum(each.width for each in self.columns)
        if not 0 < width < X.shape[1]:
            raise DataError(f"{X.shape[1]} columns are not features and {width} samples")
        return X[:, : X.shape[1] - width], X[:, X.shape[1] - width :]

    def predict_proba(self, X: Array) -> Array:
        """Return calibrated probabilities (n, k) in the order of ``classes_``."""
        features, samples = self._parts(self._rows(X))
        svm = None if self.svm_ is None else self.svm_.predict_proba(features)
        network = None if self.network_ is None else self.network_.predict_proba(samples)
        return joined_of(svm, network, np.array([self.best_.weight_svm, self.best_.weight_cnn]))


def fit_weights(probability: Array, class_index: Array) -> Array:
    """Return the weights (2,) of log probabilities (2, n, k) under which the true classes are most likely.

    Examples
    --------
    >>> good = np.array([[0.9, 0.1], [0.2, 0.8]] * 50)
    >>> useless = np.full((100, 2), 0.5)
    >>> fit_weights(np.stack([good, useless]), np.array([0, 1] * 50)).round(1)
    array([1.3, 0.5])
    """
    half = np.full(2, 0.5)

    def loss(weights: Array) -> float:
        fit = -log_of_truth(joined(probability, weights), class_index).mean()
        return float(fit + PENALTY * ((weights - half) ** 2).sum())

    return np.asarray(minimize(loss, half, bounds=[(0.0, 5.0)] * 2, method="L-BFGS-B").x)


def joined(probability: Array, weights: Array) -> Array:
    """Return probabilities (n, k) from those of both (2, n, k).

    Examples
    --------
    >>> joined(np.array([[[0.8, 0.2]], [[0.5, 0.5]]]), np.array([1.0, 1.0]))
    array([[0.8, 0.2]])
    """
    logits = np.tensordot(weights, np.log(np.maximum(probability, np.finfo(float).tiny)), axes=1)
    return np.asarray(np.exp(log_softmax(logits)))


def joined_of(svm: Array | None, network: Array | None, weights: Array) -> Array:
    """Return the probabilities of the one that is there, unchanged, or those of both joined.

    Raises
    ------
    ValueError
        if neither is there.
    """
    if svm is not None and network is not None:
        return joined(np.stack([svm, network]), weights)
    alone = network if svm is None else svm
    if alone is None:
        raise ValueError("a stack of neither")
    return alone


def log_of_truth(probability: Array, class_index: Array) -> Array:
    """Return the log probability (n,) of the true class."""
    tiny = np.finfo(float).tiny
    return np.asarray(np.log(np.maximum(probability[np.arange(len(class_index)), class_index], tiny)))


def _cross_joined(probability: Array, class_index: Array, run: Array, seed: int) -> Array:
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

    Examples
    --------
    >>> run = np.array(list("aabbccdd"))
    >>> losses = np.stack([np.full(8, 0.5), np.linspace(0.2, 0.9, 8), np.linspace(0.38, 0.42, 8)])
    >>> chosen_of(losses, run), chosen_of(losses[[0, 1, 0]], run)
    ('stack', 'svm')
    """
    _, of_run = np.unique(run, return_inverse=True)
    count = np.bincount(of_run)
    mean = np.stack([np.bincount(of_run, weights=each) / count for each in losses])
    difference = mean - mean[0]
    error = difference.std(axis=1, ddof=1) / np.sqrt(len(count)) if len(count) > 1 else np.full(3, np.inf)
    found = difference.mean(axis=1)
    better = [i for i in (1, 2) if found[i] < -MIN_STANDARD_ERRORS * error[i]]
    return ("svm", "cnn", "stack")[min(better, key=lambda i: found[i], default=0)]
