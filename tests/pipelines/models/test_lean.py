"""The numbers of a model classify as the model does, without scikit-learn, and nothing else is accepted."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from pipelines.models.lean import NUMBERS_FILE, LeanRecipe, read_numbers, write_numbers

from features.windows import cut_windows
from pipelines.models.model_files import INFO_FILE, read_lean_model, read_model, write_info
from terrain.classify.svm import GroupedSVC
from terrain.classify.svm_numbers import check_numbers, probabilities
from terrain.errors import DataError, ModelError


def windows_of(model, runs):
    return cut_windows(runs, model.rule, layout=model.layout).windows


def test_a_trained_model_has_its_numbers_and_they_classify_alike(model_dir, runs):
    model, lean = read_model(model_dir), read_lean_model(model_dir)
    assert isinstance(lean.recipe, LeanRecipe)
    assert lean.info == model.info
    windows = windows_of(model, runs)
    desired = model.recipe.predict_proba(windows)
    np.testing.assert_allclose(lean.recipe.predict_proba(windows), desired, atol=1e-12)
    assert lean.recipe.classes_.tolist() == model.recipe.classes_.tolist()
    np.testing.assert_allclose(lean.recipe.predict_proba(windows[3]), desired[3:4], atol=1e-12)


@pytest.mark.parametrize("n_classes", [2, 3, 6])
def test_numbers_give_the_probabilities_of_any_number_of_classes(n_classes):
    rng = np.random.default_rng(n_classes)
    y = np.repeat([f"class {k}" for k in range(n_classes)], 30)
    X = rng.normal(size=(len(y), 12)) + 0.8 * rng.normal(size=(n_classes, 12)).repeat(30, axis=0)
    X[:, 3] = 1.0  # constant
    X[:, 5] = np.nan  # never defined
    X[rng.random(X.shape) < 0.05] = np.nan
    fitted = GroupedSVC().fit(X, y, np.arange(len(y)) // 5)
    numbers = fitted.numbers()
    check_numbers(numbers, n_classes)
    test = rng.normal(size=(50, 12)) * 3.0
    test[rng.random(test.shape) < 0.2] = np.nan
    found = probabilities(numbers, test)
    np.testing.assert_allclose(found, fitted.predict_proba(test), atol=1e-12)
    assert found.sum(axis=1) == pytest.approx(1.0)


def test_features_that_do_not_fit_are_refused(model_dir):
    numbers = read_lean_model(model_dir).recipe.numbers.svm
    n = int(numbers.settings[3])
    with pytest.raises(DataError, match=rf"\(n, {n}\) is needed"):
        probabilities(numbers, np.zeros((1, n - 1)))
    with pytest.raises(DataError, match="infinite"):
        probabilities(numbers, np.full((1, n), np.inf))


def test_windows_of_other_channels_are_refused(model_dir, runs):
    model = read_lean_model(model_dir)
    windows = windows_of(model, runs[:1])
    other = replace(windows, length_s=1.0)
    with pytest.raises(DataError, match="windows last 1 s"):
        model.recipe.predict_proba(other)


def test_a_model_of_an_earlier_release_is_read_whole(model_dir, runs):
    info = read_model(model_dir).info
    (model_dir / NUMBERS_FILE).unlink()
    with pytest.raises(ModelError, match=r"numbers\.npz: cannot be opened"):
        read_lean_model(model_dir)  # listed, and not there
    write_info(model_dir, info)
    model = read_lean_model(model_dir)
    assert not isinstance(model.recipe, LeanRecipe)
    assert model.recipe.predict_proba(windows_of(model, runs[:1])).shape[1] == 3


def test_damaged_numbers_are_refused_in_one_sentence(model_dir):
    file = model_dir / NUMBERS_FILE
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(ModelError, match=r"numbers\.npz: is damaged"):
        read_lean_model(model_dir)


def test_numbers_that_a_checksum_covers_up_end_in_one_sentence(model_dir):
    """Bytes and ends of the file are changed, and the checksum with them: it is refused, or classifies."""
    file, info = model_dir / NUMBERS_FILE, read_model(model_dir).info
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    n_refused = 0
    for _ in range(150):
        content = bytearray(whole)
        if rng.random() < 0.3:
            content = content[: int(rng.integers(len(content)))]
        else:
            for place in rng.integers(len(content), size=3):
                content[place] ^= int(rng.integers(1, 256))
        file.write_bytes(content)
        write_info(model_dir, info)
        try:
            read_lean_model(model_dir)
        except ModelError as error:
            n_refused += len(str(error).splitlines()) == 1
    assert n_refused > 100


@pytest.mark.parametrize(
    ("name", "array", "fault"),
    [
        ("offsets", np.zeros(7), "offsets are not"),
        ("scale", np.zeros(1), "scale are not"),
        ("columns", np.array([10**6]), "fill are not"),
        ("vectors", np.array([["text"]]), "vectors are not"),
        ("settings", np.array([5.0, np.nan, 1.0, 10.0]), "settings are not"),
        ("channels", np.array(["gyro_q_radps"] * 2), "are not those of the model"),
        ("mean", np.array([{}], dtype=object), "Object arrays cannot be"),
    ],
)
def test_numbers_that_do_not_fit_each_other_are_refused(model_dir, name, array, fault):
    model = read_model(model_dir)
    write_numbers(model_dir, model.recipe)
    with np.load(model_dir / NUMBERS_FILE) as arrays:
        found = {key: arrays[key] for key in arrays.files} | {name: array}
    np.savez(model_dir / NUMBERS_FILE, **found)
    with pytest.raises((DataError, ValueError), match=fault):
        read_numbers((model_dir / NUMBERS_FILE).read_bytes(), model.info)
    write_info(model_dir, model.info)
    with pytest.raises(ModelError, match="cannot be loaded"):
        read_lean_model(model_dir)
    assert (model_dir / INFO_FILE).is_file()


def test_a_service_imports_nothing_of_scikit_learn(model_dir):
    code = (
        "import sys; from pathlib import Path; import pipelines.serve.service as s; "
        f"m = s.load_model({str(model_dir)!r}); s.warm_up(m, None); "
        "print([n for n in ('sklearn', 'pandas', 'skops', 'mlflow', 'pyarrow') if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
