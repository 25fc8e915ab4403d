"""Estimators of scikit-learn that compiled code walks through: stored as plain arrays, checked when they are read.

The nodes of a tree name features and other nodes by number, which scikit-learn follows without looking: a file with
numbers of a stranger's could end the process.  A model file therefore has the arrays of each tree in its place; they
become a tree after every number has been found to lead somewhere.  The trees of neighbours are built anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from terrain.classify.trees import GroupedTrees, check_nodes
from terrain.errors import DataError


def parts_of(fitted: Any) -> Iterator[Any]:
    """Yield every object with attributes that a fitted recipe is made of."""
    seen: set[int] = set()
    waiting = [fitted]
    while waiting:
        each = waiting.pop()
        if id(each) in seen or isinstance(each, type | FunctionType | ModuleType):
            continue
        seen.add(id(each))
        if isinstance(each, dict):
            waiting += each.values()
        elif isinstance(each, list | tuple | set | frozenset):
            waiting += each
        elif isinstance(each, np.ndarray):
            waiting += each.ravel().tolist() if each.dtype == object else []
        elif hasattr(each, "__dict__"):
            yield each
            waiting += vars(each).values()


@contextmanager
def trees_as_arrays(fitted: Any) -> Iterator[None]:
    """Have the trees of a fitted recipe lie in it as plain arrays while the block lasts."""
    changed: list[tuple[Any, str, Any]] = []
    try:
        for part, name in _with_trees(fitted):
            value, plain = getattr(part, name), None
            if name == "tree_":
                plain = value.__reduce__()[1:]
            elif name == "_predictors":
                plain = [[vars(tree) for tree in of_round] for of_round in value]
            changed.append((part, name, value))
            setattr(part, name, plain)
        yield
    finally:
        for part, name, value in changed:
            setattr(part, name, value)


def _with_trees(fitted: Any) -> list[tuple[Any, str]]:
    """Return the fitted parts of scikit-learn with trees, and the attribute that holds them."""
    from sklearn.ensemble._hist_gradient_boosting.gradient_boosting import BaseHistGradientBoosting
    from sklearn.neighbors._base import NeighborsBase
    from sklearn.tree import BaseDecisionTree

    kinds = {BaseDecisionTree: "tree_", BaseHistGradientBoosting: "_predictors", NeighborsBase: "_tree"}
    parts = list(parts_of(fitted))
    return [
        (each, name)
        for kind, name in kinds.items()
        for each in parts
        if isinstance(each, kind) and name in vars(each)
    ]


def trees_of_arrays(fitted: Any) -> None:
    """Put trees in place of their arrays in what was read, and check all that compiled code follows by number.

    ``DataError`` says what is not as scikit-learn, or this package, had left it.
    """
    from sklearn.ensemble._gb import BaseGradientBoosting
    from sklearn.neighbors._base import NeighborsBase
    from sklearn.svm._base import BaseLibSVM

    restore = {"tree_": _restore_tree, "_predictors": _restore_boosted}
    for part, name in _with_trees(fitted):
        if name in restore:
            restore[name](part)
    for part in parts_of(fitted):
        if isinstance(part, GroupedTrees) and "forest_" in vars(part):
            part.check()
        elif isinstance(part, BaseGradientBoosting) and "estimators_" in vars(part):
            _check_stages(part)
        elif isinstance(part, NeighborsBase) and "_fit_X" in vars(part):  # followed without a tree, too
            _restore_neighbours(part)
        elif isinstance(part, BaseLibSVM) and "support_vectors_" in vars(part):
            _check_svm(part)


def _require(holds: Any, part: Any, what: str) -> None:
    if not holds:
        raise DataError(f"the {what} of its {type(part).__name__} are not those of a fitted one")


def _require_plain(part: Any, *arrays: Any) -> None:
    """Refuse masked arrays: comparisons leave out what is masked, and compiled code does not."""
    _require(all(type(each) is np.ndarray for each in arrays), part, "arrays")


def _restore_tree(part: Any) -> None:
    from sklearn.tree._tree import NODE_DTYPE, Tree

    (n_features, n_classes, n_outputs), state = part.tree_
    nodes, values, n_nodes = state["nodes"], state["values"], len(state["nodes"])
    _require_plain(part, nodes, values, n_classes)
    _require(nodes.shape == (n_nodes,) and n_nodes > 0 and nodes.dtype == NODE_DTYPE, part, "nodes")
    _require(state["node_count"] == n_nodes and n_features == part.n_features_in_, part, "numbers of nodes")
    _require(n_classes.shape == (1,) and n_classes.dtype == np.intp and n_outputs == 1, part, "outputs")
    _require(values.shape == (n_nodes, 1, n_classes[0]) and values.dtype == float, part, "values")
    _require(np.isfinite(values).all(), part, "values")
    leaf = nodes["left_child"] == -1
    check_nodes(nodes["feature"], nodes["left_child"], nodes["right_child"], leaf, n_features)
    part.tree_ = Tree(n_features, n_classes, n_outputs)
    part.tree_.__setstate__(state)


def _restore_boosted(part: Any) -> None:
    from sklearn.ensemble._hist_gradient_boosting.common import PREDICTOR_RECORD_DTYPE
    from sklearn.ensemble._hist_gradient_boosting.predictor import TreePredictor

    mapped = part.is_categorical_ is None and not np.any(part._bin_mapper.is_categorical_)
    _require(mapped and part._preprocessor is None, part, "features, of which none may be a category,")
    predictors = []
    for of_round in part._predictors:
        predictors.append([TreePredictor(**arrays) for arrays in of_round])
        for nodes in (tree.nodes for tree in predictors[-1]):
            _require_plain(part, nodes)
            _require(nodes.ndim == 1 and len(nodes) and nodes.dtype == PREDICTOR_RECORD_DTYPE, part, "nodes")
            _require(not nodes["is_categorical"].any(), part, "nodes")
            children = nodes["left"].astype(int), nodes["right"].astype(int)
            check_nodes(nodes["feature_idx"], *children, nodes["is_leaf"] != 0, part.n_features_in_)
    part._predictors = predictors


def _check_stages(part: Any) -> None:
    from sklearn.dummy import DummyClassifier
    from sklearn.tree import DecisionTreeRegressor

    trees, n_features = part.estimators_, part.n_features_in_
    _require(isinstance(part.init_, DummyClassifier) or part.init_ == "zero", part, "first estimates")
    _require(trees.ndim == 2 and len(trees), part, "trees")
    for tree in trees.ravel():
        _require(type(tree) is DecisionTreeRegressor and tree.n_features_in_ == n_features, part, "trees")
    first = part._raw_predict_init(np.zeros((1, n_features), dtype=np.float32))
    _require(first.shape == (1, trees.shape[1]) and first.dtype == float, part, "trees")


def _restore_neighbours(part: Any) -> None:
    from sklearn.neighbors import BallTree, KDTree

    rows = part._fit_X
    _require_plain(part, rows)
    _require(rows.ndim == 2 and np.isfinite(rows).all(), part, "rows")
    _require(rows.shape[1] == part.n_features_in_, part, "rows")
    if hasattr(part, "classes_"):
        place = part._y
        _require_plain(part, place)
        _require(place.shape == (len(rows),) and place.dtype.kind == "i", part, "classes")
        _require(place.min() >= 0 and place.max() < len(part.classes_), part, "classes")
    kind = {"kd_tree": KDTree, "ball_tree": BallTree}.get(part._fit_method)
    options = part.effective_metric_params_
    part._tree = kind and kind(rows, part.leaf_size, metric=part.effective_metric_, **options)


def _check_svm(part: Any) -> None:
    vectors, counts, coefficients = part.support_vectors_, part._n_support, part._dual_coef_
    _require_plain(part, vectors, counts, coefficients, part.support_, part._intercept_)
    n_pairs, classes = 1, part._impl in ("c_svc", "nu_svc")
    # any other is followed by the numbers of training rows
    _require(part.kernel in ("linear", "poly", "rbf", "sigmoid"), part, "kernel and its rows")
    if classes:
        n_pairs = len(counts) * (len(counts) - 1) // 2
        _require(counts.min() >= 0 and counts.sum() == len(vectors), part, "support vectors")
    _require(
        not part._sparse and vectors.ndim == 2 and len(part.support_) == len(vectors), part, "support vectors"
    )
    _require(vectors.shape[1] == part.n_features_in_, part, "support vectors")
    _require(coefficients.shape == (len(counts) - 1 if classes else 1, len(vectors)), part, "coefficients")
    _require(part._intercept_.shape == (n_pairs,), part, "coefficients")
    _require({len(part._probA), len(part._probB)} <= {0, n_pairs}, part, "probabilities")
