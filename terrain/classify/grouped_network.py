"""Ensemble of networks that chooses and calibrates itself on folds which keep runs whole.

Steps of ``fit``: standardise by all rows; on all inner folds of whole runs choose the augmentation; fit one
network an inner fold, stopped where its held-out runs are most likely; their held-out probabilities give the
temperature; fit the members anew on all runs, for the mean number of epochs of these networks: with few runs,
each one counts.  What is fitted is kept as
:class:`~terrain.classify.network_numbers.NetworkNumbers`: it predicts without torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from terrain.classify.augment import Augmentation, mirrors_of
from terrain.classify.folds import inner_splits
from terrain.classify.network import (
    Task,
    fit_member,
    fit_on_all,
    network_numbers_of,
    reproducible,
    require_torch,
    task_of,
)
from terrain.classify.network_numbers import (
    SampleColumns,
    log_softmax,
    mean_log_probabilities,
    probabilities,
    softmax,
    streams_of,
)
from terrain.errors import DataError
from terrain.records import Array

LOG_TEMPERATURE_BOUNDS = (-3.0, 3.0)


class NetworkChoice(NamedTuple):
    """What inner folds chose: the augmentation, and the members' mean number of epochs."""

    shift: bool
    gain: bool
    mirror: bool
    dropout: bool
    epochs: float


class Trial(NamedTuple):
    """An augmentation, and the mean log loss of runs that were held out under it."""

    augmentation: Augmentation
    loss: float


class GroupedNetwork(ClassifierMixin, BaseEstimator):
    """Ensemble of small convolutional networks that keeps runs whole.

    Parameters
    ----------
    columns : :class:`~terrain.classify.network_numbers.SampleColumns` of each stream
    n_inner_folds : networks that choose and calibrate, one an inner fold
    n_members : networks that predict, each fitted on all runs
    epochs : at most, of each
    trial_epochs : of the networks that choose the augmentation; 0 for none, and no choice
    gap : windows left out beside an inner test block, where the only run of a class is cut
    seed : deals runs into inner folds, and of all that is drawn

    Attributes
    ----------
    classes_ : (k,) class names
    best_ : :class:`NetworkChoice`
    trials_ : :class:`Trial` of each augmentation that was tried
    inner_probability_ : (n, k) of each training row by the member that did not see its run; NaN where all did
    numbers_ : what it predicts with
    """

    def __init__(
        self,
        columns: Sequence[SampleColumns] = (),
        n_inner_folds: int = 5,
        n_members: int = 3,
        epochs: int = 30,
        trial_epochs: int = 10,
        gap: int = 1,
        seed: int = 0,
    ) -> None:
        self.columns = columns
        self.n_inner_folds = n_inner_folds
        self.n_members = n_members
        self.epochs = epochs
        self.trial_epochs = trial_epochs
        self.gap = gap
        self.seed = seed

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> GroupedNetwork:
        """Choose, fit and calibrate.

        Parameters
        ----------
        X : (n, n_columns) samples, NaN where missing
        y : (n,) classes
        groups : (n,) run of each row; every row is its own run when missing

        Raises
        ------
        ConfigError
            if torch is not installed.
        DataError
            if there is one class only, too few windows to hold some of them out, or other columns.
        """
        X, y = validate_data(self, X, y, ensure_all_finite="allow-nan")
        check_classification_targets(y)
        require_torch()
        self.classes_, class_index = np.unique(y, return_inverse=True)
        if len(self.classes_) < 2:
            raise DataError(
                f"all windows are {str(self.classes_[0])!r}: a classifier needs at least two classes"
            )
        groups = np.arange(len(y)) if groups is None else np.asarray(groups)
        columns = tuple(self.columns)
        if not columns or sum(each.width for each in columns) != X.shape[1]:
            raise DataError(f"the columns of the samples do not describe rows of {X.shape[1]} columns")
        fill = fill_of(columns, X)
        task = task_of(columns, np.where(np.isnan(X), fill, X).astype(np.float32), class_index, groups)
        splits = list(inner_splits(y, groups, self.n_inner_folds, self.seed, self.gap))
        if not splits:
            raise DataError("the windows are too few to hold some of them out; add runs")
        with reproducible():
            used = self._choose(task, splits)
            inner = [
                fit_member(task, split, used, self.epochs, self.seed + i) for i, split in enumerate(splits)
            ]
            epochs = float(np.mean([each.epoch + 1 for each in inner]))
            nets = [
                fit_on_all(task, used, round(epochs), self.seed + len(splits) + i)
                for i in range(self.n_members)
            ]
        log_probability = np.full((len(y), len(self.classes_)), np.nan)
        for (_, test), member in zip(splits, inner, strict=True):
            log_probability[test] = member.held_out
        held_out = np.isfinite(log_probability).all(axis=1)
        temperature = fit_temperature(log_probability[held_out], class_index[held_out])
        self.inner_probability_ = softmax(log_probability / temperature)
        self.best_ = NetworkChoice(*used, epochs)
        self.numbers_ = network_numbers_of(task, fill, nets, temperature)
        return self

    def _choose(self, task: Task, splits: Sequence[tuple[Array, Array]]) -> Augmentation:
        """Return the augmentation with the lowest held-out loss: none, one, or all that lowered it alone."""
        plain, losses = Augmentation(), dict[Augmentation, float]()
        self.trials_: tuple[Trial, ...] = ()
        if not self.trial_epochs:
            return plain

        def loss(used: Augmentation) -> float:
            if used not in losses:
                fitted = [
                    fit_member(task, split, used, self.trial_epochs, self.seed + i)
                    for i, split in enumerate(splits)
                ]
                losses[used] = float(np.mean([member.loss for member in fitted]))
            return losses[used]

        possible = {
            "shift": True,
            "gain": any(each.frame for each in task.columns),
            "mirror": mirrors_of(task.columns) is not None,
            "dropout": len(task.columns) > 1,
        }
        limit = loss(plain)
        better = [
            name for name, can in possible.items() if can and loss(plain._replace(**{name: True})) < limit
        ]
        loss(plain._replace(**dict.fromkeys(better, True)))
        self.trials_ = tuple(Trial(*each) for each in losses.items())
        return min(losses, key=lambda used: losses[used])

    def predict_proba(self, X: Array) -> Array:
        """Return calibrated probabilities (n, k) in the order of ``classes_``."""
        check_is_fitted(self)
        X = validate_data(self, X, reset=False, ensure_all_finite="allow-nan")
        return probabilities(self.numbers_, X)

    def decision_function(self, X: Array) -> Array:
        """Return log probabilities (n, k); of two classes the odds of the second (n,)."""
        check_is_fitted(self)
        X = validate_data(self, X, reset=False, ensure_all_finite="allow-nan")
        found = log_softmax(mean_log_probabilities(self.numbers_, X) / self.numbers_.temperature)
        return found[:, 1] - found[:, 0] if len(self.classes_) == 2 else found

    def predict(self, X: Array) -> Array:
        """Return the class of the highest probability (n,)."""
        best = self.predict_proba(X).argmax(axis=1)
        return np.asarray(self.classes_[best])

    def __sklearn_tags__(self) -> Any:
        """Declare that NaN is accepted."""
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        return tags


def fit_temperature(log_probability: Array, class_index: Array) -> float:
    """Return the divisor of log probabilities (n, k) under which the true classes are most likely.

    Guo et al. 2017, "On calibration of modern neural networks", section 4.2.

    Examples
    --------
    >>> half = np.log(np.array([[0.99, 0.01]] * 10))
    >>> fit_temperature(half, np.array([0] * 8 + [1] * 2)) > 2.0  # as certain as that, it may not be
    True
    """
    rows = np.arange(len(class_index))

    def loss(log_temperature: float) -> float:
        return float(-log_softmax(log_probability / np.exp(log_temperature))[rows, class_index].mean())

    found = minimize_scalar(loss, bounds=LOG_TEMPERATURE_BOUNDS, method="bounded")
    return float(np.exp(found.x))


def fill_of(columns: Sequence[SampleColumns], X: Array) -> Array:
    """Return the mean of each channel (n_columns,), 0 where it was never measured."""
    parts = []
    for each, values in zip(columns, streams_of(columns, X), strict=True):
        known = np.isfinite(values)
        total = np.where(known, values, 0.0).sum(axis=(0, 2))
        parts.append(np.repeat(total / np.maximum(known.sum(axis=(0, 2)), 1), each.n_samples))
    return np.concatenate(parts)
