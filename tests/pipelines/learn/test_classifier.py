"""TerrainClassifier is a scikit-learn estimator of windows, which is saved, loaded and refused in one sentence."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.ensemble import RandomForestClassifier
from sklearn.neighbors import KNeighborsClassifier

from features.windows import WindowRule, cut_windows
from pipelines.learn.card import model_result
from pipelines.learn.classifier import TerrainClassifier
from terrain.errors import ConfigError, DataError, ModelError


@pytest.fixture(scope="module")
def windows(runs):
    return cut_windows(runs, WindowRule()).windows


@pytest.fixture(scope="module")
def fitted(windows):
    return TerrainClassifier("svm").fit(windows)


def test_parameters_are_those_of_an_estimator():
    model = TerrainClassifier("svm", seed=3)
    assert set(model.get_params()) == {"recipe", "signal_sets", "seed", "functions"}
    assert clone(model).seed == 3
    assert TerrainClassifier().set_params(recipe="cnn").recipe == "cnn"


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
    model = TerrainClassifier(KNeighborsClassifier(3)).fit(windows)
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
