"""A fitted :class:`~terrain.classify.svm.GroupedSVC` as plain numbers: probabilities without scikit-learn.

Importing scikit-learn takes longer than all else that a live service imports, and most of a window's time on
the robot goes into checks of its inputs.  The numbers are those that it fitted:

- missing features take their median, the columns that were kept are scaled and clipped;
- of each pair of classes (a, b), a before b: ``f = sum_i w_i exp(-gamma |x - v_i|^2) + c``, positive for a;
- one scale of the margins gives the probabilities of the classes (:mod:`terrain.classify.coupling`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.classify.coupling import class_probabilities
from terrain.errors import DataError
from terrain.records import Array


class SvmNumbers(NamedTuple):
    """What a fitted classifier computes with.

    Parameters
    ----------
    columns : (m,) places of the features that are used
    fill, mean, scale : (m,) median, mean and standard deviation of each
    vectors : (s, m) support vectors, scaled and clipped
    weights : (s, p) of each support vector in each pair of classes
    offsets : (p,) of each pair
    settings : (4,) clip in standard deviations, gamma, scale of the margins, features before selection
    """

    columns: Array
    fill: Array
    mean: Array
    scale: Array
    vectors: Array
    weights: Array
    offsets: Array
    settings: Array

    @property
    def n_classes(self) -> int:
        """Number of classes k, of which there are k (k - 1) / 2 pairs."""
        return (1 + math.isqrt(1 + 8 * len(self.offsets))) // 2


def check_numbers(numbers: SvmNumbers, n_classes: int) -> None:
    """Refuse numbers that do not fit each other.

    Raises
    ------
    DataError
        if a shape is another, a number is not finite, or a place is none.
    """
    m, s, p = len(numbers.columns), len(numbers.vectors), n_classes * (n_classes - 1) // 2
    shapes = ((m,), (m,), (m,), (m,), (s, m), (s, p), (p,), (4,))
    for name, array, shape in zip(numbers._fields, numbers, shapes, strict=True):
        kind = "iu" if name == "columns" else "f"
        if array.shape != shape or array.dtype.kind not in kind or not np.isfinite(array).all():
            raise DataError(f"the classifier's {name} are not {shape} finite numbers")
    if m == 0 or numbers.columns.min() < 0 or numbers.columns.max() >= numbers.settings[3]:
        raise DataError("the classifier's columns are none of its features")
    if (numbers.scale <= 0.0).any() or (numbers.settings <= 0.0).any():
        raise DataError("the classifier's scales are not above zero")


def probabilities(numbers: SvmNumbers, features: Array) -> Array:
    """Return calibrated probabilities (n, k) in the order of the classes.

    Parameters
    ----------
    numbers : of the classifier
    features : (n, f), NaN where not defined

    Raises
    ------
    DataError
        if there are not as many features, or one is infinite.
    """
    clip, gamma, margin_scale, n_features = numbers.settings.tolist()
    if features.ndim != 2 or features.shape[1] != n_features:
        raise DataError(f"features have the shape {features.shape}, (n, {n_features:.0f}) is needed")
    if np.isinf(features).any():
        raise DataError("a feature is infinite")
    used = features[:, numbers.columns]
    used = np.where(np.isnan(used), numbers.fill, used)
    scaled = np.clip((used - numbers.mean) / numbers.scale, -clip, clip)
    margins = _margins(numbers.vectors, numbers.weights, numbers.offsets, gamma, scaled)
    return class_probabilities(margins, numbers.n_classes, margin_scale)


@njit(cache=True, nogil=True, error_model="numpy")
def _margins(vectors: Array, weights: Array, offsets: Array, gamma: float, rows: Array) -> Array:
    """Return the margin (n, p) of each pair of classes; other threads go on meanwhile."""
    margins = np.empty((rows.shape[0], offsets.size))
    for n in range(rows.shape[0]):
        margins[n] = offsets
        for i in range(vectors.shape[0]):
            squares = 0.0
            for j in range(vectors.shape[1]):
                difference = vectors[i, j] - rows[n, j]
                squares += difference * difference
            kernel = np.exp(-gamma * squares)
            for pair in range(offsets.size):
                margins[n, pair] += kernel * weights[i, pair]
    return margins
