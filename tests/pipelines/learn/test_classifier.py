"""TerrainClassifier, and a classifier and features of one's own: by name in the current folder, and by passing them."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.linear_model import LogisticRegression, RidgeClassifier
from sklearn.neighbors import KNeighborsClassifier

from features.recipes import feature_matrix, make_recipe
from pipelines.learn.card import model_result
from pipelines.learn.classifier import TerrainClassifier
from pipelines.learn.crossval import cross_validate, crossval
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.training_data import data_of_runs, info_of, with_limits
from pipelines.live.windows import filter_of, filtered
from terrain.classify.grouped import OwnClassifier
from terrain.classify.svm import GroupedSVC
from terrain.classify.terrain_filter import filter_sessions, reported
from terrain.errors import ConfigError, DataError, ModelError


@pytest.fixture(scope="module")
def fitted(windows):
    return TerrainClassifier("svm").fit(windows)


def test_what_is_saved_predicts_the_same_wherever_it_is_loaded(fitted, windows, tmp_path):
    assert fitted.classes_.tolist() == ["ASPHALT", "GRASS", "GRAVEL"]
    assert fitted.score(windows, windows.terrain) > 0.9
    folder = fitted.save(tmp_path / "field")
    again = TerrainClassifier.load(folder)
    assert np.array_equal(again.predict_proba(windows), fitted.predict_proba(windows))
    assert again.predict(windows).tolist() == fitted.predict(windows).tolist()
    table = fitted.predictions(windows)
    assert table.columns.tolist() == ["run_id", "start_s", "terrain", "ASPHALT", "GRASS", "GRAVEL"]
    assert again.model_.novelty is not None
    assert again.model_.support is not None
    (folder / "training.json").write_text("of another model")
    fitted.save(folder)  # a model takes the place of a model
    assert model_result(folder, "field").training is None


def test_an_estimator_of_scikit_learn_is_fitted_to_labels_of_ones_own_and_stored(windows, tmp_path):
    other = np.where(windows.terrain == "GRASS", "soft", "hard")
    model = TerrainClassifier(KNeighborsClassifier(3), seed=3).fit(windows, other)
    again = TerrainClassifier.load(model.save(tmp_path / "neighbours"))
    assert np.array_equal(again.predict_proba(windows), model.predict_proba(windows))
    assert again.classes_.tolist() == ["hard", "soft"]


def test_a_recipe_passes_session_and_run_of_each_window_on(windows, monkeypatch):
    passed = []
    monkeypatch.setattr(GroupedSVC, "fit", lambda self, X, y, groups: passed.append(groups))
    session = np.where(np.arange(len(windows)) % 2, "monday", "tuesday")
    make_recipe("svm").fit(replace(windows, session=session), windows.terrain)
    np.testing.assert_array_equal(passed, [np.stack([session, windows.run_id], axis=1)])


def local():
    class Local(LogisticRegression):
        """Of no module: what reads a model could not find it."""

    return Local()


def test_what_does_not_fit_is_one_sentence(fitted, windows, tmp_path):
    channels = {name: names[1:] for name, names in windows.channels.items()}
    values = {name: each[:, 1:] for name, each in dict(windows.values).items()}
    fewer = replace(windows, values=values, channels=channels)
    lacks = r"the windows lack imu\.gyro_x_radps, wheels\.speed_left_mps: they have imu with gyro_y_radps.*; "
    for act, kind, sentence in (
        (
            lambda: fitted.predict(fewer),
            DataError,
            lacks + "the features were learned on imu with gyro_x_radps",
        ),
        (lambda: fitted.predict(np.zeros((3, 4))), DataError, "windows are needed, as terrain.cut_windows"),
        (lambda: TerrainClassifier().fit(windows, ["a"]), DataError, "1 terrains for 144 windows"),
        (lambda: TerrainClassifier("svn").fit(windows), ConfigError, "there is no recipe 'svn'"),
        (lambda: fitted.save(tmp_path), ConfigError, "holds something else than a model"),
        (
            lambda: TerrainClassifier(local()).fit(windows).save(tmp_path / "local"),
            ModelError,
            r"the recipe cannot be stored \(.*\.Local cannot be imported: .*\): a model file holds types of this",
        ),
        (lambda: TerrainClassifier.load(tmp_path), ModelError, "holds no model of this package"),
    ):
        (tmp_path / "mine.txt").write_text("mine")
        with pytest.raises(kind, match=sentence) as refusal:
            act()
        assert len(str(refusal.value).splitlines()) == 1


OWN = """
import numpy as np
from sklearn.neighbors import KNeighborsClassifier

def make():
    return KNeighborsClassifier(5)

def roughness(window):
    change = np.diff(window["imu", "accel_z_mps2"])
    return {"mean": np.abs(change).mean(), "largest": np.abs(change).max()}

def fails(window):
    return window["imu", "no_such_channel"]

def words(window):
    return "rough"
"""


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    (tmp_path / "my_terrain.py").write_text(OWN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*__import__("sys").path])


@pytest.mark.usefixtures("in_folder")
def test_a_classifier_and_a_feature_of_the_current_folder_go_in_by_name(runs, settings, tracked):
    own = crossval(runs, settings(recipe="my_terrain:make", feature=("my_terrain:roughness",)))
    assert own.n_features == tracked[1].crossval.n_features + 2
    assert own.recipe == "my_terrain:make"
    assert own.accuracy > 0.5  # chance is one third
    assert own.support is not None
    assert own.conformal is not None
    assert str(own).splitlines()[-1].startswith("next: terrain train")


@pytest.mark.usefixtures("in_folder")
def test_what_is_not_accepted_is_one_sentence(runs, settings):
    for options, sentence in (
        ({"recipe": "nowhere:make"}, "nowhere:make: module 'nowhere' cannot be imported"),
        ({"recipe": "my_terrain:absent"}, "my_terrain:absent: module 'my_terrain' has no 'absent'"),
        ({"recipe": "collections:OrderedDict"}, "is no scikit-learn classifier: it needs fit, predict"),
        ({"feature": ("my_terrain:fails",)}, "feature 'fails' fails on the window of run .*no_such_channel"),
        ({"feature": ("my_terrain:words",)}, "feature 'words' is given 'rough' for the window of run"),
        (
            {"recipe": "cnn", "feature": ("my_terrain:roughness",)},
            "'cnn' does not take .*; 'svm' and 'trees' do",
        ),
        ({"recipe": "lucky"}, "there is no recipe 'lucky'; there are svm, .* or MODULE:NAME"),
        ({"recipe": "my_terrain:make", "params": "best.json"}, "--params has hyper-parameters of the SVM"),
    ):
        with pytest.raises(ConfigError, match=sentence) as refusal:
            crossval(runs, settings(**options))
        assert "\n" not in str(refusal.value)


class Margins(ClassifierMixin, BaseEstimator):
    """Gives margins only, as many classifiers do."""

    def fit(self, X, y):
        self.inner_ = RidgeClassifier().fit(X, y)
        self.classes_ = self.inner_.classes_
        return self

    def predict(self, X):
        return self.inner_.predict(X)

    def decision_function(self, X):
        return self.inner_.decision_function(X)


class Names(Margins):
    """Gives names only."""

    decision_function = property()


def test_estimators_and_recipes_stand_side_by_side_and_probabilities_are_said_to_be_what_they_are(
    windows, tracked
):
    estimators = [LogisticRegression(max_iter=500), Margins(), Names()]
    outputs = [OwnClassifier(each).outputs for each in estimators]
    assert outputs == ["predict_proba", "decision_function", "predict"]
    found = cross_validate([*estimators, "svm"], windows, repeats=1, n_jobs=1)
    assert [each.recipe for each in found.contenders] == ["LogisticRegression", "Margins", "Names", "svm"]
    accuracy = [each.accuracy for each in found.contenders]
    assert min(accuracy) > 0.45
    assert [(pair.accuracy.a, pair.accuracy.b) for pair in found.differences] == [
        (accuracy[0], other) for other in accuracy[1:]
    ]
    assert accuracy[-1] == tracked[1].crossval.accuracy  # of the same windows and folds
    _, margins, names, _ = (" ".join(each.notes) for each in found.contenders)
    assert "its decisions were calibrated on inner held-out runs" in margins
    assert "each prediction counts as certain" in names
    assert all(0.0 <= each.ece < 0.35 for each in found.contenders[:2])


def test_held_out_outputs_are_of_whole_runs(windows):
    recipe = make_recipe(LogisticRegression(max_iter=500))
    features, y = feature_matrix(recipe, windows), windows.terrain.astype(str)
    fitted = recipe[-1].fit(features, y, groups=windows.run_id)
    assert np.isfinite(fitted.inner_probability_).all()
    trained = fitted.predict_proba(features)[np.arange(len(y)), np.searchsorted(fitted.classes_, y)]
    held_out = fitted.inner_probability_[np.arange(len(y)), np.searchsorted(fitted.classes_, y)]
    assert held_out.mean() < trained.mean()  # runs that it was not fitted on


@pytest.mark.parametrize("left_out", [(), ("GRASS_2", "GRASS_4", "GRAVEL_1")])
def test_training_takes_a_terrain_filter_only_where_it_is_no_worse_than_single_windows(runs, left_out):
    """Three drawn runs are mostly taken for another terrain when they are held out, which a filter makes worse."""
    data = data_of_runs([run for run in runs if run.run_id not in left_out], RecipeSettings())
    samples, windows = data.samples, data.samples.windows
    data.recipe[-1].fit(data.rows, samples.terrain, groups=samples.group)
    info = info_of(data, RecipeSettings(), "")
    model, notes = with_limits(data.recipe, info, samples, data.features, data.motion)
    settings, held_out = filter_of(model.info), data.recipe[-1].inner_probability_
    assert (settings is None) == (not left_out) == any("filtered over time" in note for note in notes)
    assert (filtered(model).over_time is None) == (settings is None)
    if settings is not None:
        belief = filter_sessions(held_out, windows.start_s + 2.0, windows.groups, 2.0, settings)
        truth = np.searchsorted(model.info.classes, samples.terrain)
        assert np.mean(reported(belief) == truth) >= np.mean(held_out.argmax(axis=1) == truth)


class Reversed(ClassifierMixin, BaseEstimator):
    """Nearest mean whose classes are not in alphabetical order."""

    def fit(self, X, y):
        self.classes_ = np.unique(y)[::-1]
        self.means_ = np.array([X[y == name].mean(axis=0) for name in self.classes_])
        return self

    def predict_proba(self, X):
        weight = np.exp(-np.linalg.norm(X[:, None] - self.means_, axis=2))
        return weight / weight.sum(axis=1, keepdims=True)

    def predict(self, X):
        return self.classes_[self.predict_proba(X).argmax(axis=1)]


def test_columns_of_an_own_classifier_are_put_in_order_and_a_class_that_none_held_out_keeps_its_margins():
    rng, y = np.random.default_rng(0), np.repeat(["ice", "mud"], 40).astype("<U4")
    runs = np.arange(80) // 10
    X = rng.normal(size=(80, 2)) + 6.0 * (y == "mud")[:, None]
    own = OwnClassifier(Reversed()).fit(X, y, groups=runs)
    assert own.score(X, y) > 0.95
    y[[0, 1, 10, 11]] = "sand"  # of two runs mostly on ice: some seed deals both into one fold
    for seed in range(20):
        own = OwnClassifier(RidgeClassifier(), seed=seed).fit(X, y, groups=runs)
        assert own.predict_proba(X).shape == (80, 3)


def test_thresholds_of_a_fitted_classifier_are_over_sessions(windows):
    run = windows.run_id.astype(str)
    second = np.char.rpartition(run, "_")[:, 2].astype(int) % 2
    of_two = replace(windows, session=np.where(second == 1, "monday", "tuesday").astype(object))
    by_run, by_session = (TerrainClassifier("svm").fit(each).model_ for each in (windows, of_two))
    assert by_session.novelty.threshold != by_run.novelty.threshold
