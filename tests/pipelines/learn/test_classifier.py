"""TerrainClassifier, and a classifier and features of one's own: by name in the current folder, and by passing them."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.base import BaseEstimator, ClassifierMixin, clone
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression, RidgeClassifier
from sklearn.neighbors import KNeighborsClassifier

from features.recipes import feature_matrix, make_recipe
from pipelines.learn.card import model_result
from pipelines.learn.classifier import TerrainClassifier
from pipelines.learn.crossval import cross_validate, crossval
from terrain.classify.grouped import OwnClassifier
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


def test_labels_of_ones_own_take_the_place_of_those_of_the_runs(windows):
    other = np.where(windows.terrain == "GRASS", "soft", "hard")
    assert TerrainClassifier().fit(windows, other).classes_.tolist() == ["hard", "soft"]


def test_an_estimator_of_scikit_learn_is_fitted_and_stored(windows, tmp_path):
    model = TerrainClassifier(KNeighborsClassifier(3), seed=3).fit(windows)
    assert clone(model).seed == 3
    again = TerrainClassifier.load(model.save(tmp_path / "neighbours"))
    assert np.array_equal(again.predict_proba(windows), model.predict_proba(windows))
    assert clone(model).fit(windows).predict(windows).tolist() == model.predict(windows).tolist()


def test_what_does_not_fit_is_one_sentence(fitted, windows, tmp_path):
    fewer = replace(
        windows,
        values={name: values[:, 1:] for name, values in dict(windows.values).items()},
        channels={name: names[1:] for name, names in windows.channels.items()},
    )
    for act, kind, sentence in (
        (
            lambda: fitted.predict(fewer),
            DataError,
            r"the windows lack imu\.gyro_x_radps, wheels\.speed_left_mps: they have imu with gyro_y_radps.*; "
            r"the features were learned on imu with gyro_x_radps",
        ),
        (lambda: fitted.predict(np.zeros((3, 4))), DataError, "windows are needed, as terrain.cut_windows"),
        (lambda: TerrainClassifier().fit(windows, ["a"]), DataError, "1 terrains for 144 windows"),
        (lambda: TerrainClassifier("svn").fit(windows), ConfigError, "there is no recipe 'svn'"),
        (lambda: fitted.save(tmp_path), ConfigError, "holds something else than a model"),
        (
            lambda: TerrainClassifier(RandomForestClassifier(3)).fit(windows).save(tmp_path / "forest"),
            ModelError,
            r"sklearn\.tree\._tree\.Tree cannot be stored: a model file holds only types that can be checked",
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

number = 3
"""


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    (tmp_path / "my_terrain.py").write_text(OWN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*__import__("sys").path])


@pytest.mark.usefixtures("in_folder")
def test_a_classifier_and_a_feature_of_the_current_folder_go_in_by_name(runs, settings):
    plain = crossval(runs, settings())
    own = crossval(runs, settings(recipe="my_terrain:make", feature=("my_terrain:roughness",)))
    assert own.n_features == plain.n_features + 2
    assert own.recipe == "my_terrain:make"
    assert own.accuracy > 0.5  # chance is one third
    assert own.support is not None
    assert own.conformal is not None
    assert str(own).splitlines()[-1].startswith("next: terrain train")


@pytest.mark.usefixtures("in_folder")
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"recipe": "nowhere:make"}, "nowhere:make: module 'nowhere' cannot be imported"),
        ({"recipe": "my_terrain:absent"}, "my_terrain:absent: module 'my_terrain' has no 'absent'"),
        ({"recipe": "my_terrain:number"}, "module 'my_terrain' has no 'number'"),
        ({"recipe": "collections:OrderedDict"}, "is no scikit-learn classifier: it needs fit, predict"),
        ({"feature": ("my_terrain:fails",)}, "feature 'fails' fails on the window of run .*no_such_channel"),
        ({"feature": ("my_terrain:words",)}, "feature 'words' is given 'rough' for the window of run"),
        ({"recipe": "cnn", "feature": ("my_terrain:roughness",)}, "recipe 'cnn' does not take features"),
        ({"recipe": "lucky"}, "there is no recipe 'lucky'; there are svm, .* or MODULE:NAME"),
        ({"recipe": "my_terrain:make", "params": "best.json"}, "--params has hyper-parameters of the SVM"),
    ],
)
def test_what_is_not_accepted_is_one_sentence(runs, settings, options, sentence):
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


@pytest.mark.parametrize(
    ("estimator", "outputs", "note"),
    [
        (LogisticRegression(max_iter=500), "predict_proba", ""),
        (Margins(), "decision_function", "its decisions were calibrated on inner held-out runs"),
        (Names(), "predict", "each prediction counts as certain"),
    ],
)
def test_probabilities_of_any_classifier_are_said_to_be_what_they_are(windows, estimator, outputs, note):
    assert OwnClassifier(estimator).outputs == outputs
    found = cross_validate(estimator, windows, repeats=1, n_jobs=1)
    assert found.accuracy > 0.45
    assert found.recipe == type(estimator).__name__
    assert any(note in text for text in (*found.notes, ""))
    if outputs != "predict":
        assert 0.0 <= found.ece < 0.35


def test_estimators_and_recipes_stand_side_by_side_and_learn_from_the_same_windows(windows):
    found = cross_validate([LogisticRegression(max_iter=500), "svm"], windows, repeats=1, n_jobs=1)
    assert [each.recipe for each in found.contenders] == ["LogisticRegression", "svm"]
    (pair,) = found.differences
    assert (pair.accuracy.a, pair.accuracy.b) == tuple(each.accuracy for each in found.contenders)
    assert cross_validate("svm", windows, repeats=1, n_jobs=1).accuracy == pair.accuracy.b


def test_held_out_outputs_are_of_whole_runs(windows):
    recipe = make_recipe(LogisticRegression(max_iter=500))
    features, y = feature_matrix(recipe, windows), windows.terrain.astype(str)
    fitted = recipe[-1].fit(features, y, groups=windows.run_id)
    assert np.isfinite(fitted.inner_probability_).all()
    trained = fitted.predict_proba(features)[np.arange(len(y)), np.searchsorted(fitted.classes_, y)]
    held_out = fitted.inner_probability_[np.arange(len(y)), np.searchsorted(fitted.classes_, y)]
    assert held_out.mean() < trained.mean()  # runs that it was not fitted on
