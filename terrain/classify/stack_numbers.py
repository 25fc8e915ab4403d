"""A fitted :class:`~terrain.classify.stack.GroupedStack` as plain numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.classify.network_numbers import NetworkNumbers, check_network, log_softmax
from terrain.classify.network_numbers import probabilities as network_probabilities
from terrain.classify.svm_numbers import SvmNumbers, check_numbers
from terrain.classify.svm_numbers import probabilities as svm_probabilities
from terrain.errors import DataError
from terrain.records import Array


class StackNumbers(NamedTuple):
    """What a stack computes with.

    Parameters
    ----------
    weights : (2,) of the log probabilities of the SVM and the network
    svm, network : of the two; None where its weight is 0
    """

    weights: Array
    svm: SvmNumbers | None
    network: NetworkNumbers | None


def joined(probability: Array, weights: Array) -> Array:
    """Return probabilities (n, k) from those of both (2, n, k), see :mod:`terrain.classify.stack`.

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


def stack_of(numbers: SvmNumbers | NetworkNumbers | StackNumbers) -> StackNumbers:
    """Return the numbers of any of the three classifiers as those of a stack."""
    if isinstance(numbers, StackNumbers):
        return numbers
    if isinstance(numbers, SvmNumbers):
        return StackNumbers(np.array([1.0, 0.0]), numbers, None)
    return StackNumbers(np.array([0.0, 1.0]), None, numbers)


def probabilities(numbers: StackNumbers, features: Array | None, samples: Array | None) -> Array:
    """Return calibrated probabilities (n, k) in the order of the classes.

    Parameters
    ----------
    numbers : of the stack
    features, samples : (n, f), (n, n_columns), NaN where not defined; not needed of what has no weight

    Raises
    ------
    DataError
        if there are not as many columns, or a value is infinite.
    """
    svm = None if numbers.svm is None or features is None else svm_probabilities(numbers.svm, features)
    network = (
        None
        if numbers.network is None or samples is None
        else network_probabilities(numbers.network, samples)
    )
    return joined_of(svm, network, numbers.weights)


def check_stack(numbers: StackNumbers, n_classes: int) -> None:
    """Refuse numbers that do not fit each other.

    Raises
    ------
    DataError
        if a shape is another, a number is not finite, or what has a weight is not there.
    """
    weights = numbers.weights
    if weights.shape != (2,) or not np.isfinite(weights).all() or (weights < 0).any() or not weights.any():
        raise DataError("the classifier's weights are not two numbers above zero")
    for weight, part in zip(weights, (numbers.svm, numbers.network), strict=True):
        if weight > 0 and part is None:
            raise DataError("the classifier lacks one of its two parts")
    if numbers.svm is not None:
        check_numbers(numbers.svm, n_classes)
    if numbers.network is not None:
        check_network(numbers.network, n_classes)
