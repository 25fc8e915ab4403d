"""Ensemble of networks that chooses and calibrates itself on folds which keep runs whole.

Steps of ``fit``: standardise by all rows; on all inner folds of whole runs choose the augmentation; fit one
network an inner fold, stopped where its held-out runs are most likely; their held-out probabilities give the
temperature; fit the members anew on all runs, for the mean number of epochs of these networks: with few runs,
each one counts.  What is fitted is kept as a graph (:mod:`terrain.classify.network_onnx`): it predicts without
torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from terrain.classify.augment import Augmentation, mirrors_of
from terrain.classify.folds import inner_splits
from terrain.classify.grouped import GroupedClassifier
from terrain.classify.network import (
    Task,
    fit_member,
    fit_on_all,
    reproducible,
    require_torch,
    task_of,
    weights_of,
)
from terrain.classify.network_input import SampleColumns, log_softmax, softmax, streams_of
from terrain.classify.network_onnx import log_probabilities, network_onnx, require_onnx
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


class GroupedNetwork(GroupedClassifier):
    """Ensemble of small convolutional networks that keeps runs whole.

    Parameters
    ----------
    columns : :class:`~terrain.classify.network_input.SampleColumns` of each stream
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
    onnx_ : the graph that it predicts with
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
            if torch or onnx is not installed.
        DataError
            if there is one class only, too few windows to hold some of them out, or other columns.
        """
        require_torch()
        require_onnx()
        X, y, groups = self._training_rows(X, y, groups)
        class_index = np.searchsorted(self.classes_, y)
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
        members = [weights_of(net) for net in nets]
        self.onnx_ = network_onnx(columns, task.branches, members, fill, temperature, self.classes_.tolist())
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
        return np.asarray(np.exp(log_probabilities(self.onnx_, self.columns, self._rows(X))))

    def decision_function(self, X: Array) -> Array:
        """Return log probabilities (n, k); of two classes the odds of the second (n,)."""
        found = log_probabilities(self.onnx_, self.columns, self._rows(X))
        return found[:, 1] - found[:, 0] if len(self.classes_) == 2 else found


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
