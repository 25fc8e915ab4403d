"""Trees on features, fitted by scikit-learn and kept as plain arrays that one kernel predicts.

Extremely randomised trees (Geurts, Ernst and Wehenkel 2006, "Extremely randomized trees", Machine Learning 63): each of
many trees is grown on all rows until its leaves are of one class, with random thresholds of some features at each node;
the mean of their leaves' class shares is the probability.  Boosted trees (scikit-learn's histogram gradient boosting)
add up to log odds.  Both in scikit-learn's own settings: nothing is chosen.

Both give log probabilities ``z_c = log p_c``; one scale s of held-out rows calibrates them as the SVM's
margins are, ``p_c = exp(s z_c) / sum_b exp(s z_b)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax

from terrain.classify.folds import TOO_FEW, inner_splits
from terrain.classify.grouped import GroupedClassifier, Preparation, fit_preparation
from terrain.errors import DataError
from terrain.kernels import njit
from terrain.records import Array

N_TREES = 300
#: Scales of log probabilities: beyond, they are flat or certain.
LOG_SCALE_BOUNDS = (-4.0, 4.0)
#: Log odds of a class beyond the reach of any sum of leaves.
LEAST_LOG = -30.0


class Forest(NamedTuple):
    """Trees of n features as arrays over all m nodes; a node's children come after it.

    ``feature`` (m,) is -1 at a leaf, whose row of ``outputs`` (r, k) is ``left`` (m,); elsewhere a row goes on to the
    node ``left`` where its feature is not above ``threshold`` (m,), else to ``right`` (m,).  ``roots`` (t,) are the
    first nodes of the trees, and ``start`` (k,) is what their outputs are added to.
    """

    feature: Array
    threshold: Array
    left: Array
    right: Array
    outputs: Array
    roots: Array
    start: Array

    def sums(self, X: Array) -> Array:
        """Return the sum (n, k) of what all trees give for rows (n, f) without NaN."""
        return np.asarray(_sums(np.ascontiguousarray(X, dtype=float), *self))


@njit
def _sums(
    X: Array,
    feature: Array,
    threshold: Array,
    left: Array,
    right: Array,
    outputs: Array,
    roots: Array,
    start: Array,
) -> Array:
    sums = np.empty((X.shape[0], outputs.shape[1]))
    for i in range(X.shape[0]):
        sums[i] = start
        for root in roots:
            node = root
            while feature[node] >= 0:
                node = left[node] if X[i, feature[node]] <= threshold[node] else right[node]
            sums[i] += outputs[left[node]]
    return sums


def check_forest(forest: Forest, n_features: int, n_classes: int) -> None:
    """Refuse by ``DataError`` a forest that a kernel must not walk: of a file, its numbers may be any."""
    m, r, t = len(forest.feature), len(forest.outputs), len(forest.roots)
    shapes = {
        "feature": (m,), "threshold": (m,), "left": (m,), "right": (m,),
        "outputs": (r, n_classes), "roots": (t,), "start": (n_classes,),
    }  # fmt: skip
    for name, shape in shapes.items():
        array, kind = getattr(forest, name), np.float64 if name in FLOATS else np.int32
        if type(array) is not np.ndarray or array.shape != shape or array.dtype != kind:
            raise DataError(f"the {name} of its trees is no array {shape} of {kind.__name__}")
        if kind is np.float64 and np.isnan(array).any():
            raise DataError(f"the {name} of its trees is not a number")
    check_nodes(forest.feature, forest.left, forest.right, forest.feature < 0, n_features)
    leaves = forest.left[forest.feature < 0]
    if not t or ((forest.roots < 0) | (forest.roots >= m)).any() or ((leaves < 0) | (leaves >= r)).any():
        raise DataError("its trees have a root or a leaf that is not there")


FLOATS = ("threshold", "outputs", "start")


def check_nodes(feature: Array, left: Array, right: Array, leaf: Array, n_features: int) -> None:
    """Refuse by ``DataError`` nodes (m,) of trees with a feature that is not there, or a child not after its parent."""
    inner, n_nodes = np.flatnonzero(~leaf), len(leaf)
    if ((feature[inner] < 0) | (feature[inner] >= n_features)).any():
        raise DataError(f"a tree asks for a feature beyond its {n_features}")
    for children in (left[inner], right[inner]):
        if ((children <= inner) | (children >= n_nodes)).any():
            raise DataError("a tree has a child that is not there, or that leads back")


@dataclass(eq=False, repr=False)
class GroupedTrees(GroupedClassifier):
    """Trees that keep runs whole, with probabilities calibrated on inner held-out runs.

    Attributes
    ----------
    scale_ : of the log probabilities
    preparation_, forest_ : :class:`Preparation` of features, and :class:`Forest`

    Examples
    --------
    >>> rng, runs = np.random.default_rng(0), np.repeat(np.arange(8), 10)
    >>> y = np.where(runs % 2, "ice", "mud")
    >>> X = rng.normal(size=(80, 2)) + 3.0 * (y == "mud")[:, None]
    >>> trees = GroupedTrees(n_trees=20).fit(X, y, groups=runs)
    >>> trees.predict([[0.0, 0.0], [3.0, 3.0]]).tolist(), len(trees.forest_.roots)
    (['ice', 'mud'], 20)
    """

    boosted: bool = False  #: boosted trees in place of extremely randomised ones
    n_trees: int = N_TREES  #: of extremely randomised ones
    n_inner_folds: int = 3  #: calibrate
    gap: int = 1  #: windows left out beside an inner test block, where the only run of a class is cut
    seed: int = 0  #: deals runs into inner folds, and draws features and thresholds

    def fit(self, X: Array, y: Array, groups: Array | None = None) -> GroupedTrees:
        """Calibrate and fit; ``DataError`` where a class has too few windows to hold some of them out."""
        X, y, groups = self._training_rows(X, y, groups)
        held_out, learned = np.full((len(y), len(self.classes_)), np.nan), np.zeros(len(y), dtype=bool)
        for train, test in inner_splits(y, groups, self.n_inner_folds, self.seed, self.gap, lacking=True):
            fitted = self._fitted(X[train], y[train])
            held_out[test] = LEAST_LOG  # of a class that was not there
            held_out[np.ix_(test, np.isin(self.classes_, y[train]))] = self._logs(*fitted, X[test])
            learned[test] = np.isin(y[test], y[train])
        rows = np.flatnonzero(learned)  # no scale makes a class probable that was not there
        if not len(rows):
            raise DataError(TOO_FEW)
        self.scale_ = fit_scale(held_out[rows], np.searchsorted(self.classes_, y[rows]))
        self.inner_probability_ = np.exp(log_softmax(self.scale_ * held_out, axis=1))
        self.preparation_, self.forest_ = self._fitted(X, y)
        return self

    def predict_proba(self, X: Array) -> Array:
        """Return calibrated probabilities (n, k) in the order of ``classes_``."""
        logs = self._logs(self.preparation_, self.forest_, self._rows(X))
        return np.asarray(np.exp(log_softmax(self.scale_ * logs, axis=1)))

    def check(self) -> None:
        """Refuse by ``DataError`` what was not fitted here, and might lead a kernel out of its arrays."""
        columns = self.preparation_.columns
        if not isinstance(self.forest_, Forest) or columns.ndim != 1 or columns.dtype.kind != "i":
            raise DataError("its trees are no forest of features")
        check_forest(self.forest_, len(columns), len(self.classes_))

    def _fitted(self, X: Array, y: Array) -> tuple[Preparation, Forest]:
        preparation = fit_preparation(X, y, 100.0)
        return preparation, fitted_forest(
            _rounded(preparation.of(X)), y, self.boosted, self.n_trees, self.seed
        )

    def _logs(self, preparation: Preparation, forest: Forest, X: Array) -> Array:
        """Return log probabilities (n, k) of rows, not calibrated."""
        sums = forest.sums(_rounded(preparation.of(X)))
        if self.boosted:
            return np.asarray(np.maximum(log_softmax(sums, axis=1), LEAST_LOG))
        n_trees = len(forest.roots)  # a class that no tree gives has half a tree
        return np.asarray(np.log(np.maximum(sums, 0.5) / n_trees))


def _rounded(prepared: Array) -> Array:
    """Return features as scikit-learn's trees compare them, in single precision."""
    return prepared.astype(np.float32).astype(float)


def fitted_forest(X: Array, y: Array, boosted: bool, n_trees: int, seed: int) -> Forest:
    """Return the trees that scikit-learn fits to rows (n, f) of single precision and their classes (n,)."""
    if boosted:
        from sklearn.ensemble import HistGradientBoostingClassifier

        return pack_boosted(HistGradientBoostingClassifier(random_state=seed).fit(X, y))
    from sklearn.ensemble import ExtraTreesClassifier

    trees = ExtraTreesClassifier(n_trees, random_state=seed).fit(X, y)
    parts = [
        (each.feature, each.threshold, each.children_left, each.children_right, each.value[:, 0])
        for each in (tree.tree_ for tree in trees.estimators_)
    ]
    return _joined([(each[2] < 0, *each) for each in parts], np.zeros(len(trees.classes_)))


def pack_boosted(fitted: Any) -> Forest:
    """Return the trees of a fitted ``HistGradientBoostingClassifier`` without categories."""
    baseline = fitted._baseline_prediction.ravel()
    start = (
        baseline if len(baseline) > 1 else np.array([0.0, baseline[0]])
    )  # log odds of the second of two classes
    parts = []
    for of_round in fitted._predictors:
        for score, nodes in enumerate(tree.nodes for tree in of_round):
            outputs = np.zeros((len(nodes), len(start)))
            outputs[:, score if len(baseline) > 1 else 1] = nodes["value"]
            walked = (nodes[name] for name in ("feature_idx", "num_threshold", "left", "right"))
            parts.append((nodes["is_leaf"] != 0, *walked, outputs))
    return _joined(parts, start)


def _joined(trees: Sequence[tuple[Array, ...]], start: Array) -> Forest:
    """Return a forest of trees: whether a leaf, feature, threshold, left, right and output of each node from 0 on."""
    n_nodes = [len(tree[0]) for tree in trees]
    roots = np.cumsum([0, *n_nodes[:-1]])
    first = np.repeat(roots, n_nodes)
    leaf, feature, threshold, left, right, output = (
        np.concatenate(each) for each in zip(*trees, strict=True)
    )
    outputs, row = np.unique(output[leaf], axis=0, return_inverse=True)
    left, right = left.astype(int) + first, right.astype(int) + first
    left[leaf], right[leaf] = row.ravel(), 0
    return Forest(
        np.where(leaf, -1, feature).astype(np.int32),
        np.where(leaf, 0.0, threshold),
        left.astype(np.int32),
        right.astype(np.int32),
        outputs,
        roots.astype(np.int32),
        start,
    )


def fit_scale(logs: Array, class_index: Array) -> float:
    """Return the scale of log probabilities (n, k) under which the true classes (n,) are most likely."""
    rows = np.arange(len(class_index))

    def loss(log_scale: float) -> float:
        return -float(log_softmax(np.exp(log_scale) * logs, axis=1)[rows, class_index].mean())

    return float(np.exp(minimize_scalar(loss, bounds=LOG_SCALE_BOUNDS, method="bounded").x))
