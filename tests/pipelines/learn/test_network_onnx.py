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
def fitted(request, windows):
    return quick(request.param).fit(windows, windows.terrain.astype(str))


@pytest.fixture
def folder(fitted, model_dir):
    """A model folder with the fitted recipe in it."""
    write_model(model_dir, read_model(model_dir)._replace(recipe=fitted, novelty=None))
    return model_dir


@pytest.mark.parametrize(
    "fitted", ["cnn", "stack", pytest.param("best", marks=pytest.mark.slow)], indirect=True
)
def test_a_model_read_back_gives_the_same_bytes(folder, fitted, windows):
    desired = fitted.predict_proba(windows)
    assert np.array_equal(read_model(folder).recipe.predict_proba(windows), desired)
    assert set(skops_io().get_untrusted_types(file=folder / MODEL_FILE)) <= set(TRUSTED_TYPES)
    assert (folder / ONNX_FILE).exists() == (getattr(fitted[-1], "network_", fitted[-1]) is not None)


def test_a_classifier_fitted_on_the_matrix_is_that_of_the_windows(windows):
    recipe = quick("stack")
    features = feature_matrix(recipe, windows)
    terrain = windows.terrain.astype(str)
    alone = recipe[-1].fit(features, terrain, groups=windows.run_id)
    whole = quick("stack").fit(windows, terrain)
    assert np.array_equal(alone.predict_proba(features), whole.predict_proba(windows))


@pytest.mark.parametrize("fitted", ["cnn", "stack"], indirect=True)  # "best" may be the SVM
def test_onnx_computes_the_network(folder, fitted, windows):
    network = getattr(fitted[-1], "network_", fitted[-1])
    session = onnxruntime.InferenceSession((folder / ONNX_FILE).read_bytes())
    inputs = {stream: values.astype(np.float32) for stream, values in windows.values.items()}
    inputs["wheels"][3, 0, 2:4] = np.nan
    inputs["imu"][5, 1] = np.nan
    given = replace(windows, values={stream: values.astype(float) for stream, values in inputs.items()})
    samples = fitted[0].transform(given)[:, -sum(each.width for each in network.columns) :]
    (found,) = session.run(["probabilities"], inputs)
    np.testing.assert_allclose(found, network.predict_proba(samples), atol=1e-5)
    described = session.get_modelmeta().custom_metadata_map
    assert json.loads(described["classes"]) == fitted.classes_.tolist()
    assert json.loads(described["streams"])["imu"]["channels"] == list(windows.channels["imu"])
    times_s = time_of_onnx((folder / ONNX_FILE).read_bytes(), windows[0], 3)
    assert times_s.shape == (3,)
    assert (times_s > 0).all()
    onnx.checker.check_model(onnx.load_from_string((folder / ONNX_FILE).read_bytes()))
    with pytest.raises(onnxruntime.capi.onnxruntime_pybind11_state.InvalidArgument):
        session.run(None, {stream: values[:, 1:] for stream, values in inputs.items()})


@pytest.mark.parametrize("fitted", ["cnn"], indirect=True)
@pytest.mark.slow
def test_numbers_of_a_network_that_a_checksum_covers_up_end_in_one_sentence(folder):
    file, info = folder / ONNX_FILE, read_model(folder).info
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])
    with pytest.raises(ModelError, match=r"network\.onnx: is damaged"):
        read_model(folder)
    names = [each.name for each in onnx.load_from_string(whole).graph.initializer]
    names = [
        name for name in names if not name[1:].isdigit() and not name.endswith(".centred")
    ]  # set on reading
    assert len(names) > 10
    for name in names:
        for array in (None, np.zeros(7, np.float32), ...):
            model = onnx.load_from_string(whole)
            (place,) = [i for i, each in enumerate(model.graph.initializer) if each.name == name]
            values = onnx.numpy_helper.to_array(model.graph.initializer[place])
            del model.graph.initializer[place]
            if array is not None:
                other = np.full_like(values, np.nan) if array is ... else array
                model.graph.initializer.append(onnx.numpy_helper.from_array(other, name))
            file.write_bytes(model.SerializeToString())
            seal(folder, info)
            with pytest.raises(ModelError, match=r"network\.onnx: cannot be loaded") as refusal:
                read_model(folder)
            assert len(str(refusal.value).splitlines()) == 1


@pytest.mark.parametrize("fitted", ["cnn"], indirect=True)
def test_a_graph_that_would_do_more_than_compute_is_refused(folder):
    file, info = folder / ONNX_FILE, read_model(folder).info
    model = onnx.load_from_string(file.read_bytes())
    model.graph.node.append(onnx.helper.make_node("RandomNormal", [], ["drawn"], shape=[1]))
    file.write_bytes(model.SerializeToString())
    seal(folder, info)
    with pytest.raises(ModelError, match="the graph has other operators than a network"):
        read_model(folder)


@pytest.mark.parametrize("name", ["onnx", "onnxruntime"])
def test_without_onnx_there_is_one_sentence(name, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match="pip install"):
        require_onnx()
