"""A model that a store of features gives is the one that its runs give."""

import json
import shutil
from dataclasses import fields, replace

import numpy as np
import pytest

from features.windows import Layout, cut_windows
from pipelines.classify.card import CARD_FILE, CARD_JSON, drawn_window
from pipelines.classify.settings import TrainSettings
from pipelines.classify.train import train, train_store
from pipelines.classify.training_data import data_of_runs, data_of_store
from pipelines.data.datasets import data_digest, joint_digest, load_runs, run_loaders
from pipelines.feature_store.build import build_store
from pipelines.feature_store.settings import FeaturesSettings
from pipelines.feature_store.store import open_store, read_store
from pipelines.live.model import assess
from pipelines.models.lean import NUMBERS_FILE
from pipelines.models.model_files import read_lean_model, read_model
from pipelines.models.novelty_file import NOVELTY_FILE
from pipelines.reporting.json_file import as_json
from terrain.errors import ConfigError, DataError, LogError
from terrain.logs.write import write_run

SETTINGS = TrainSettings(name="drawn", repeats=1, n_jobs=1)


def stored(runs, folder):
    """Write runs, build their store, and return where both lie."""
    for run in runs:
        write_run(run, folder / "runs")
    build_store(run_loaders(folder / "runs"), FeaturesSettings(out=folder / "store", n_jobs=1))
    return folder


def opened(folder, settings=SETTINGS):
    return open_store(folder / "store", settings.rule, settings.signal_sets)


@pytest.fixture(scope="module")
def place(runs, tmp_path_factory):
    return stored(runs, tmp_path_factory.mktemp("store"))


@pytest.fixture(scope="module")
def trained_there(place, tmp_path_factory):
    """Train from the store in a folder of its own; return the folder, the result and the model's folder."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        result = train_store(opened(place), SETTINGS, "twelve runs")
    (file,) = (folder / "mlruns").rglob("model.skops")
    return folder, result, file.parent


@pytest.fixture
def trained_here(trained_there, tmp_path, monkeypatch):
    """Return the result and the folder of the model, in a copy of the folder where it was trained."""
    folder, result, model = trained_there
    shutil.copytree(folder, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return result, model


def test_the_model_of_a_store_is_that_of_its_runs(tracked, trained_here, runs, place):
    """Different by nature: the digest of the data, the identity of the training, and measured times."""
    of_runs, of_store = tracked[0] / "model", trained_here[1]
    for name in (NUMBERS_FILE, NOVELTY_FILE):
        with np.load(of_runs / name) as one, np.load(of_store / name) as two:
            assert one.files == two.files
            assert all(one[each].tobytes() == two[each].tobytes() for each in one.files)
    one, two = (read_model(folder).info for folder in (of_runs, of_store))
    differing = [each.name for each in fields(one) if getattr(one, each.name) != getattr(two, each.name)]
    assert differing == ["data_digest"]
    assert two.data_digest == joint_digest(two.run_digests)
    assert (
        one.run_digests == two.run_digests == tuple(data_digest([run]) for run in load_runs(place / "runs"))
    )
    cards = [json.loads((folder / CARD_JSON).read_text()) for folder in (of_runs, of_store)]
    differing = {key for key in cards[0] if cards[0][key] != cards[1][key]}
    assert differing <= {"data_digest", "latency_ms", "files"}  # an archive holds the time of its writing
    assert (of_store / CARD_FILE).read_text().startswith("# Model card: drawn\n")
    documents = [as_json(each) for each in (tracked[1], trained_here[0])]
    differing = {key for key in documents[0] if documents[0][key] != documents[1][key]}
    assert differing <= {"data_digest", "run_id", "alias_reason"}
    windows = cut_windows(runs[:3], two.rule, layout=two.layout).windows
    for read in (read_model, read_lean_model):
        for a, b in zip(assess(read(of_runs), windows), assess(read(of_store), windows), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_the_same_data_are_recognised_as_runs_and_as_a_store(trained_here, runs, place):
    again = train(runs, SETTINGS, "twelve runs")
    assert again.registered.alias_reason.endswith("of version 1 on the same data")
    assert again.registered.alias_moved is False
    other = train_store(opened(place), SETTINGS, "twelve runs")
    assert other.registered.alias_reason.endswith("of version 1 on the same data")


@pytest.mark.slow
def test_a_champion_is_judged_on_new_runs_by_their_features(tracked, trained_here, drive_all, tmp_path):
    new = [replace(run, run_id=f"{run.run_id}_new") for run in drive_all(n_runs=3, seed=41)]
    folder = stored(new, tmp_path / "new")
    result = train_store(opened(folder), SETTINGS, "nine runs")
    champion = read_model(tracked[0] / "model")
    windows = data_of_runs(new, SETTINGS).samples.cut.windows
    theirs = float(np.mean(champion.recipe.predict(windows) == windows.terrain.astype(str)))
    begin = (
        f"new data: on 9 runs, each held out, accuracy {result.crossval.accuracy:.1%} against {theirs:.1%}"
    )
    assert result.registered.alias_reason.startswith(begin)


def test_features_of_other_rates_judge_no_champion(tracked, place):
    store = opened(place)
    data = data_of_store(store, read_store(store), SETTINGS)
    rows, model = np.arange(4), read_model(tracked[0] / "model")
    expected = data_of_runs(load_runs(place / "runs"), SETTINGS).probabilities(model, rows)
    np.testing.assert_array_equal(data.probabilities(model, rows), expected)
    network = model._replace(info=replace(model.info, recipe="cnn"))
    assert data.probabilities(network, rows) is None
    assert data.probabilities(read_lean_model(tracked[0] / "model"), rows) is None
    layout = model.recipe[0].layout_
    slower = Layout(layout.channels, {**layout.rate_hz, "imu": 0.99 * layout.rate_hz["imu"]})
    model.recipe[0].layout_ = slower
    assert data.probabilities(model, rows) is None


def test_a_drawn_window_has_the_shape_of_a_measured_one(tracked, runs):
    model = read_lean_model(tracked[0] / "model")
    measured = cut_windows(runs[:1], model.rule, layout=model.layout).windows[0]
    drawn = drawn_window(model.layout, model.info.window_s)
    assert {name: each.shape for name, each in drawn.values.items()} == {
        name: each.shape for name, each in measured.values.items()
    }
    assert np.isfinite(assess(model, drawn).probability).all()


@pytest.mark.parametrize("recipe", ["cnn", "stack", "best"])
def test_recipes_that_need_samples_are_refused_before_anything_is_written(
    place, tmp_path, monkeypatch, recipe
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as refusal:
        train_store(opened(place), SETTINGS.with_(recipe=recipe), "twelve runs")
    assert str(refusal.value) == f"recipe '{recipe}' needs the samples of runs, not a store of features"
    assert not (tmp_path / "mlruns").exists()


def test_a_damaged_store_trains_nothing(runs, tmp_path, monkeypatch):
    folder = stored(runs[::3], tmp_path)
    monkeypatch.chdir(tmp_path)
    path = folder / "store" / "windows" / "GRASS_3.parquet"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(LogError, match=r"GRASS_3\.parquet: is no whole file"):
        train_store(opened(folder), SETTINGS, "four runs")


def test_a_store_of_one_class_trains_nothing(drive_all, tmp_path, monkeypatch):
    folder = stored(drive_all(terrains=("GRASS",), n_runs=5), tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match="at least two classes"):
        train_store(opened(folder), SETTINGS, "five runs")
    assert not (tmp_path / "mlruns").exists()
