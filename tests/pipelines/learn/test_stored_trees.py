"""Estimators of scikit-learn in a model file: read back they give the same bits, and no number leads into nowhere."""

import numpy as np
import pytest
from sklearn.calibration import CalibratedClassifierCV
from sklearn.ensemble import (
    AdaBoostClassifier,
    BaggingClassifier,
    ExtraTreesClassifier,
    GradientBoostingClassifier,
    HistGradientBoostingClassifier,
    RandomForestClassifier,
    VotingClassifier,
)
from sklearn.linear_model import LogisticRegression
from sklearn.naive_bayes import GaussianNB
from sklearn.neighbors import KNeighborsClassifier
from sklearn.neural_network import MLPClassifier
from sklearn.svm import SVC
from sklearn.tree import DecisionTreeClassifier

from features.recipes import make_recipe
from pipelines.learn.classifier import TerrainClassifier
from pipelines.learn.model_file import (
    MODEL_FILE,
    TRUSTED_TYPES,
    packed,
    read_files,
    read_model,
    seal,
    skops_io,
)
from pipelines.learn.stored_trees import trees_as_arrays, trees_of_arrays
from terrain.errors import DataError, ModelError

X = np.random.default_rng(0).normal(size=(90, 4))
Y = np.array(["ice", "mud", "sand"])[np.digitize(X[:, 0] + X[:, 1] ** 2, [0.0, 1.0])]


def again(content):
    found = skops_io().loads(content, trusted=list(TRUSTED_TYPES))
    trees_of_arrays(found)
    return found


@pytest.mark.parametrize(
    "estimator",
    [
        DecisionTreeClassifier(),
        RandomForestClassifier(5),
        ExtraTreesClassifier(5),
        GradientBoostingClassifier(n_estimators=4),
        HistGradientBoostingClassifier(max_iter=4),
        AdaBoostClassifier(n_estimators=4),
        BaggingClassifier(max_features=0.5),
        CalibratedClassifierCV(RandomForestClassifier(3)),
        VotingClassifier([("a", LogisticRegression()), ("b", ExtraTreesClassifier(3))], voting="soft"),
        KNeighborsClassifier(3, algorithm="kd_tree"),
        KNeighborsClassifier(3, algorithm="ball_tree", metric="minkowski", p=3),
        MLPClassifier((3,), tol=1.0),
    ],
    ids=lambda each: type(each).__name__,
)
def test_what_is_read_back_gives_the_same_bits_and_what_was_stored_stays_as_it_was(estimator):
    estimator.fit(X, Y)
    before = estimator.predict_proba(X)
    content, own = packed(estimator)
    assert own == ()
    assert np.array_equal(again(content).predict_proba(X), before)
    assert np.array_equal(estimator.predict_proba(X), before)


def spoiled(estimator, change):
    """Return what a file holds of a fitted estimator in which a stranger has changed numbers."""
    estimator = estimator.fit(X, Y)
    with trees_as_arrays(estimator):
        change(estimator)
        return skops_io().dumps(estimator)


def node(field, value, place=0):
    def change(tree):
        state = tree.tree_[1]
        state["nodes"] = state["nodes"].copy()
        state["nodes"][field][place] = value

    return change


def boosted_node(field, value):
    def change(boosted):
        nodes = boosted._predictors[0][0]["nodes"]
        nodes[field][0] = value

    return change


def set_state(name, value):
    return lambda tree: tree.tree_[1].update({name: value})


def put(name, value):
    return lambda fitted: setattr(fitted, name, value(getattr(fitted, name)))


def without_tree(neighbours):
    del neighbours._tree  # brute force takes none
    neighbours._y = neighbours._y + 10**9


def swap_tree(stages):
    stages.estimators_[0, 0] = DecisionTreeClassifier().fit(X[:, :2], Y)
    stages.estimators_[0, 0].tree_ = stages.estimators_[0, 0].tree_.__reduce__()[1:]


def masked(array):
    return np.ma.MaskedArray(array, mask=np.arange(len(array)) > 0)


TREE, BOOSTED = DecisionTreeClassifier(), HistGradientBoostingClassifier(max_iter=2)
STAGES = GradientBoostingClassifier(n_estimators=2)


@pytest.mark.parametrize(
    ("estimator", "change", "sentence"),
    [
        (TREE, node("left_child", 10**6), "a child that is not there, or that leads back"),
        (TREE, node("right_child", 0), "or that leads back"),  # a circle
        (TREE, node("left_child", -2), "or that leads back"),
        (TREE, node("feature", 4), "asks for a feature beyond its 4"),
        (TREE, node("feature", -3), "asks for a feature beyond its 4"),
        (TREE, set_state("node_count", 10**6), "numbers of nodes of its DecisionTreeClassifier"),
        (TREE, set_state("values", np.zeros((3, 1, 3))), "the values of its DecisionTreeClassifier"),
        (TREE, put("tree_", lambda stored: ((400, *stored[0][1:]), stored[1])), "numbers of nodes"),
        (TREE, put("tree_", lambda stored: ((*stored[0][:2], 9), stored[1])), "the outputs"),
        (BOOSTED, boosted_node("left", 10**6), "a child that is not there"),
        (BOOSTED, boosted_node("right", 0), "or that leads back"),
        (BOOSTED, boosted_node("feature_idx", 4), "asks for a feature beyond its 4"),
        (BOOSTED, boosted_node("is_categorical", 1), "the nodes of its HistGradientBoostingClassifier"),
        (STAGES, put("estimators_", lambda trees: np.concatenate([trees, trees], 1)), "the trees of its"),
        (STAGES, swap_tree, "the trees of its GradientBoostingClassifier"),
        (STAGES, put("init_", lambda _: GaussianNB().fit(X, Y)), "first estimates of its"),
        (SVC(), put("_n_support", lambda counts: counts + np.int32(50)), "the support vectors of its SVC"),
        (SVC(), put("_dual_coef_", lambda values: values[:, :1]), "the coefficients of its SVC"),
        (SVC(), put("_intercept_", lambda values: values[:1]), "the coefficients of its SVC"),
        (
            KNeighborsClassifier(),
            put("_y", lambda place: place + 9),
            "the classes of its KNeighborsClassifier",
        ),
        (
            KNeighborsClassifier(algorithm="brute", metric="manhattan"),
            without_tree,
            "the classes of its KNei",
        ),
        (
            KNeighborsClassifier(),
            put("_fit_X", lambda rows: rows[:, :2].copy()),
            "the rows of its KNeighbors",
        ),
        (
            TREE,
            lambda tree: set_state("nodes", masked(tree.tree_[1]["nodes"]))(tree),
            "the arrays of its Dec",
        ),
        (SVC(), put("_n_support", masked), "the arrays of its SVC"),
        (KNeighborsClassifier(), put("_y", masked), "the arrays of its KNeighborsClassifier"),
        (SVC(), put("kernel", lambda _: "precomputed"), "the kernel and its rows of its SVC"),
    ],
)
def test_numbers_of_a_stranger_are_refused_before_they_are_followed(estimator, change, sentence):
    content = spoiled(estimator, change)
    with pytest.raises(DataError, match=sentence):
        again(content)


def test_trees_as_they_are_and_forests_that_lead_back_are_refused_in_one_sentence(windows, tmp_path):
    recipe = make_recipe("trees")
    recipe[-1].set_params(n_trees=9)
    folder = TerrainClassifier(recipe).fit(windows).save(tmp_path / "trees")
    model = read_model(folder)
    assert np.array_equal(
        TerrainClassifier.load(folder).predict_proba(windows), model.recipe.predict_proba(windows)
    )
    info, _ = read_files(folder)
    forest = model.recipe[-1].forest_
    back = forest.right.copy()
    back[0] = 0
    for part, sentence in (
        ({"forest_": forest._replace(right=back)}, "a child that is not there, or that leads back"),
        ({"forest_": DecisionTreeClassifier().fit(X, Y)}, r"holds sklearn\.tree\._tree\.Tree, a type that"),
        ({"forest_": LogisticRegression()}, "its trees are no forest of features"),
        (
            {"forest_": forest._replace(right=np.ma.MaskedArray(back, mask=True))},
            "the right of its trees is no",
        ),
        ({"forest_": forest, "scale_": np.nan}, "gives probabilities that are not finite"),
    ):
        vars(model.recipe[-1]).update(part)
        (folder / MODEL_FILE).write_bytes(skops_io().dumps(model.recipe))
        seal(folder, info)
        with pytest.raises(ModelError, match=sentence) as refusal:
            read_model(folder)
        assert str(refusal.value).count("\n") == 0
