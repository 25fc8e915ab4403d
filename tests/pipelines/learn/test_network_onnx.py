"""A network is an ONNX graph: read back it gives the same bytes, and another program the same figures."""

import json
import sys
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest

from features.recipes import feature_matrix, make_recipe
from pipelines.learn.model_file import (
    MODEL_FILE,
    ONNX_FILE,
    TRUSTED_TYPES,
    read_model,
    seal,
    skops_io,
    write_model,
)
from terrain.classify.network import require_onnx, time_of_onnx
from terrain.errors import ConfigError, ModelError


def quick(name):
    recipe = make_recipe(name, seed=1)
    recipe[-1].set_params(n_members=2, epochs=3, trial_epochs=0)
    if name != "cnn":
        recipe[-1].set_params(candidates=((10.0, 0.4, 100.0),))
    return recipe


@pytest.fixture(scope="module")
def fitted(windows):
    """A network alone, and one with an SVM beside it."""
    return {name: quick(name).fit(windows, windows.terrain.astype(str)) for name in ("cnn", "stack")}


@pytest.fixture
def stored(fitted, model_dir):
    """Return a function that puts a fitted recipe into a model folder."""

    def store(name):
        write_model(model_dir, read_model(model_dir)._replace(recipe=fitted[name], novelty=None))
        return model_dir

    return store


@pytest.mark.parametrize("name", ["cnn", "stack"])
def test_a_model_read_back_gives_the_same_bytes_and_onnx_the_same_figures(stored, fitted, windows, name):
    folder, recipe = stored(name), fitted[name]
    assert np.array_equal(read_model(folder).recipe.predict_proba(windows), recipe.predict_proba(windows))
    assert set(skops_io().get_untrusted_types(file=folder / MODEL_FILE)) <= set(TRUSTED_TYPES)
    content = (folder / ONNX_FILE).read_bytes()
    onnx.checker.check_model(onnx.load_from_string(content))
    session, network = onnxruntime.InferenceSession(content), getattr(recipe[-1], "network_", recipe[-1])
    inputs = {stream: values.astype(np.float32) for stream, values in windows.values.items()}
    inputs["wheels"][3, 0, 2:4] = np.nan
    inputs["imu"][5, 1] = np.nan
    given = replace(windows, values={stream: values.astype(float) for stream, values in inputs.items()})
    samples = recipe[0].transform(given)[:, -sum(each.width for each in network.columns) :]
    (found,) = session.run(["probabilities"], inputs)
    np.testing.assert_allclose(found, network.predict_proba(samples), atol=1e-5)
    described = session.get_modelmeta().custom_metadata_map
    assert json.loads(described["classes"]) == recipe.classes_.tolist()
    assert json.loads(described["streams"])["imu"]["channels"] == list(windows.channels["imu"])
    assert (time_of_onnx(content, windows[0], 3) > 0).tolist() == [True] * 3
    with pytest.raises(onnxruntime.capi.onnxruntime_pybind11_state.InvalidArgument):
        session.run(None, {stream: values[:, 1:] for stream, values in inputs.items()})


def test_a_classifier_fitted_on_the_matrix_is_that_of_the_windows(fitted, windows):
    recipe, whole = quick("stack"), fitted["stack"]
    features = feature_matrix(recipe, windows)
    alone = recipe[-1].fit(features, windows.terrain.astype(str), groups=windows.run_id)
    assert np.array_equal(alone.predict_proba(features), whole.predict_proba(windows))


def test_a_damaged_graph_or_one_that_would_do_more_than_compute_is_one_sentence(stored, monkeypatch):
    folder = stored("cnn")
    file, info = folder / ONNX_FILE, read_model(folder).info
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])
    with pytest.raises(ModelError, match=r"network\.onnx: is damaged"):
        read_model(folder)

    def spoilt(other):
        """Return the graph without the weights of its head, or with zeros of another shape or NaN in their place."""
        model = onnx.load_from_string(whole)
        (old,) = [each for each in model.graph.initializer if each.name == "head_weight"]
        array = onnx.numpy_helper.to_array(old)
        model.graph.initializer.remove(old)
        if other is not None:
            array = np.full_like(array, np.nan) if other is ... else np.zeros(other, np.float32)
            model.graph.initializer.append(onnx.numpy_helper.from_array(array, "head_weight"))
        return model

    drawing = onnx.load_from_string(whole)
    drawing.graph.node.append(onnx.helper.make_node("RandomNormal", [], ["drawn"], shape=[1]))
    for model, sentence in (
        (drawing, "the graph has other operators than a network"),
        (spoilt(None), ""),
        (spoilt((7,)), ""),
        (spoilt(...), "head_weight are not finite"),
    ):
        file.write_bytes(model.SerializeToString())
        seal(folder, info)
        with pytest.raises(ModelError, match=rf"network\.onnx: cannot be loaded .*{sentence}") as refusal:
            read_model(folder)
        assert len(str(refusal.value).splitlines()) == 1
    for name in ("onnx", "onnxruntime"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, name, None)
            with pytest.raises(ConfigError, match="pip install"):
                require_onnx()
