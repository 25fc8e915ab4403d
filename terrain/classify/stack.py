"""The support vector machine on features and the network on samples, joined on held-out runs; or the best of all.

``log p = w_svm log p_svm + w_net log p_net - log sum`` with weights not below zero: where one of the two is
uncertain, the other decides.  The weights make the true classes of held-out windows most likely; a penalty
draws them towards one half each, the mean of the two, which is where few runs leave them.

The best is chosen on the same held-out windows among the SVM, trees, the network and the stack.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_softmax

from terrain.classify.folds import fold_numbers, units_of
from terrain.classify.grouped import GroupedClassifier
from terrain.classify.network import GroupedNetwork, SampleColumns, can_fit
from terrain.classify.svm import CANDIDATES, GroupedSVC
from terrain.classify.trees import GroupedTrees
from terrain.errors import DataError
from terrain.records import Array

#: Of the squared distance of the weights from one half, against the mean log loss of a window.
PENALTY = 0.1
N_CROSS_FOLDS = 5
#: What costs less, in time and memory, is left only for what has a lower loss by so many standard errors over runs.
MIN_STANDARD_ERRORS = 1.0
BY_COST = ("svm", "trees", "cnn", "stack")
TINY = np.finfo(float).tiny


class StackChoice(NamedTuple):
    """What held-out runs chose: which of :data:`BY_COST` is ``used``, and the weights of the log probabilities.

    Losses are mean log losses of held-out runs, of the stack with weights of other runs; None of what was not fitted.
    """

    used: str
    weight_svm: float
    weight_cnn: float
    loss_svm: float
    loss_trees: float | None
    loss_cnn: float | None
    loss_stack: float | None


@dataclass(eq=False, repr=False)
class GroupedStack(GroupedClassifier):
    """Stack of :class:`GroupedSVC` and :class:`GroupedNetwork` that keeps runs whole; or the best of all there are.

    Attributes
    ----------
    best_ : :class:`StackChoice`
    svm_, trees_, network_ : fitted; None where it is not used
    """

    columns: Sequence[
        SampleColumns
    ] = ()  #: of the samples, the last columns of a row; the features are before them
    #: use whichever of SVM, trees, network and stack held-out runs favour, instead of the stack; without torch, of
    #: SVM and trees
    choose: bool = False
    candidates: Sequence[Sequence[float]] = CANDIDATES  #: of the SVM
    n_inner_folds: int = 3  #: of all, which are thus weighed on the same held-out runs
    n_members: int = 3  #: n_members, epochs, trial_epochs: of the network
    epochs: int = 30
    trial_epochs: int = 10
    gap: int = 1  #: gap, seed: of all
    seed: int = 0

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> GroupedStack:
        """Fit all and their weights; errors as of each, and where rows hold no features beside the samples."""
        X, y, groups = self._training_rows(X, y, groups)
        features, samples = self._parts(X)
        of_all: dict[str, Any] = {"n_inner_folds": self.n_inner_folds, "gap": self.gap, "seed": self.seed}
        fitted: dict[str, Any] = {"svm": GroupedSVC(self.candidates, **of_all).fit(features, y, groups)}
        if self.choose:
            fitted["trees"] = GroupedTrees(**of_all).fit(features, y, groups)
        if not self.choose or can_fit():
            sizes = {name: getattr(self, name) for name in ("n_members", "epochs", "trial_epochs")}
            fitted["cnn"] = GroupedNetwork(self.columns, **sizes, **of_all).fit(samples, y, groups)
        rows = np.flatnonzero(
            np.all([np.isfinite(of.inner_probability_[:, 0]) for of in fitted.values()], axis=0)
        )
        if not len(rows):
            raise DataError(f"no window was held out by all of {', '.join(fitted)}; add runs")
        held_out = {name: each.inner_probability_[rows] for name, each in fitted.items()}
        truth = np.searchsorted(self.classes_, y[rows])
        unit = units_of(y, groups)[rows]
        losses = {name: -log_of_truth(each, truth) for name, each in held_out.items()}
        if "cnn" in fitted:
            both = np.stack([held_out["svm"], held_out["cnn"]])
            losses["stack"] = -log_of_truth(cross_joined(both, truth, unit, self.seed), truth)
        used = chosen_of(losses, unit) if self.choose else "stack"
        weights = (
            fit_weights(both, truth) if used == "stack" else np.array([used == "svm", used == "cnn"], float)
        )
        means: dict[str, Any] = {f"loss_{name}": None for name in BY_COST}
        means |= {f"loss_{name}": float(each.mean()) for name, each in losses.items()}
        self.best_ = StackChoice(used, *weights.tolist(), **means)
        self.inner_probability_ = np.full((len(y), len(self.classes_)), np.nan)
        self.inner_probability_[rows] = joined(both, weights) if used == "stack" else held_out[used]
        self.svm_ = fitted["svm"] if weights[0] > 0 else None
        self.trees_ = fitted["trees"] if used == "trees" else None
        self.network_ = fitted["cnn"] if weights[1] > 0 else None
        return self

    def _parts(self, X: Array) -> tuple[Array, Array]:
        width = sum(each.width for each in self.columns)
        if not 0 < width < X.shape[1]:
            raise DataError(f"{X.shape[1]} columns are not features and {width} samples")
        return X[:, : X.shape[1] - width], X[:, X.shape[1] - width :]

    def predict_proba(self, X: Array) -> Array:
        """Return calibrated probabilities (n, k) in the order of ``classes_``, of one alone unchanged."""
        features, samples = self._parts(self._rows(X))
        parts = ((self.svm_, features), (self.trees_, features), (self.network_, samples))
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


def chosen_of(losses: Mapping[str, Array], unit: Array) -> str:
    """Return which of :data:`BY_COST` the losses (n,) by name of held-out windows favour.

    The cheapest, unless one that costs more has a lower loss by :data:`MIN_STANDARD_ERRORS`, by differences paired by
    unit (n,), the session or run of each window; and so on from that one.
    """
    _, of_unit = np.unique(unit, return_inverse=True)
    count = np.bincount(of_unit)
    mean = {name: np.bincount(of_unit, weights=each) / count for name, each in losses.items()}
    chosen, *dearer = (name for name in BY_COST if name in losses)
    for name in dearer:
        lower = mean[chosen] - mean[name]
        error = lower.std(ddof=1) / np.sqrt(len(count)) if len(count) > 1 else np.inf
        if lower.mean() > MIN_STANDARD_ERRORS * error:
            chosen = name
    return chosen
