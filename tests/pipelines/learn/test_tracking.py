"""What MLflow holds of a training, which version is champion, and what becomes of a store that fails."""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from features.windows import cut_windows
from pipelines.data.tracking import ensure_tracking
from pipelines.learn.model_file import TRAINING_FILE, read_model, seal
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.tracking import METRICS, log_training
from pipelines.learn.training_data import data_of_runs
from terrain.errors import ModelError, TerrainError
from terrain.files.atomic import file_lock
from terrain.logs.run_folders import data_digest


@pytest.fixture
def mlflow(in_tracked):
    """The package, set to the database of the folder, with its own warnings off."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import mlflow

        mlflow.set_tracking_uri("sqlite:///mlruns/mlflow.db")
        mlflow.set_registry_uri("sqlite:///mlruns/mlflow.db")
        yield mlflow


@pytest.fixture
def log(tracked, runs, model, model_dir):
    """Return a function that logs the trained model once more, under a name, with a macro F1 and a digest."""
    data, document = data_of_runs(runs, RecipeSettings()), json.loads((model_dir / TRAINING_FILE).read_text())

    def again(name, macro_f1, digest="aa", accuracy_ci=(0.9, 0.95)):
        document["evaluation"] |= {"macro_f1": macro_f1, "accuracy_ci": accuracy_ci}
        (model_dir / TRAINING_FILE).write_text(json.dumps(document))
        seal(model_dir, replace(model.info, data_digest=digest))
        return log_training(name, model_dir, data)

    return again


def test_a_training_run_holds_what_is_needed_to_judge_and_repeat_it(in_tracked, mlflow, runs):
    result, evaluation = in_tracked, in_tracked.crossval
    run, client = mlflow.get_run(result.run_id), mlflow.MlflowClient()
    for name, value in {"window_s": 2.0, "n_runs": 12, "chosen_C": result.chosen["C"]}.items():
        assert run.data.params[name] == str(value)
    for name, value in {"data_digest": data_digest(runs), "seed": "0", "commit": result.commit}.items():
        assert run.data.tags[name] == value
    for metric in METRICS:
        assert run.data.metrics[metric] == pytest.approx(getattr(evaluation, metric))
    for name, row in evaluation.per_class.items():
        assert run.data.metrics[f"recall/{name}"] == pytest.approx(row.recall)
    (given,) = run.inputs.dataset_inputs
    assert (given.dataset.name, given.dataset.digest) == ("twelve runs", data_digest(runs)[:36])
    assert given.tags[0].value == "training"
    assert len(client.list_artifacts(result.run_id, "figures")) >= 2
    logged = mlflow.artifacts.load_text(f"runs:/{result.run_id}/crossval.json")
    assert json.loads(logged)["accuracy"] == evaluation.accuracy
    version = client.get_model_version("drawn", result.version)
    assert version.run_id == result.run_id
    assert (version.tags["robots"], version.tags["classes"]) == ("husky", "ASPHALT, GRASS, GRAVEL")
    ends = [float(end) for end in version.tags["accuracy_interval"].split(" to ")]
    assert ends == pytest.approx(evaluation.accuracy_ci, abs=1e-4)
    assert {"macro_f1", "data_digest", "channels", "windows", "chance"} <= version.tags.keys()
    signature = mlflow.models.get_model_info(result.model_uri).signature
    names = [spec.name for spec in signature.inputs]
    assert (names[0], len(names)) == ("imu.gyro_x_radps", 10)
    assert [spec.name for spec in signature.outputs] == ["ASPHALT", "GRASS", "GRAVEL"]


def test_a_model_is_loaded_by_alias_version_run_and_folder_and_as_pyfunc(in_tracked, mlflow, runs, tracked):
    registered = ("models:/drawn@champion", "models:/drawn/1", f"runs:/{in_tracked.run_id}/model")
    model = read_model(tracked[0] / "model")
    windows = cut_windows(runs[::4], model.info.rule).windows
    probability = model.recipe.predict_proba(windows)
    for uri in registered:
        found = read_model(uri)
        assert found.info == model.info
        np.testing.assert_array_equal(found.recipe.predict_proba(windows), probability)
    table = {}
    for stream, samples in dict(windows.values).items():
        table |= {f"{stream}.{name}": [*samples[:, i]] for i, name in enumerate(windows.channels[stream])}
    served = mlflow.pyfunc.load_model(in_tracked.model_uri).predict(pd.DataFrame(table))
    assert served.columns.tolist() == list(model.info.classes)
    np.testing.assert_array_equal(served, probability)


@pytest.mark.slow
def test_the_alias_is_at_the_champion_whatever_is_registered(in_tracked, log, mlflow):
    aliases = lambda name: mlflow.MlflowClient().get_registered_model(name).aliases  # noqa: E731
    for macro_f1, digest, champion in (
        (0.80, "aa", "1"),  # the first
        (0.85, "aa", "2"),  # better on the same data
        (0.84, "aa", "2"),  # worse than the champion, though better than the first
        (0.20, "bb", "4"),  # other data: not worse on the same runs, each held out
    ):
        registered = log("by_rule", macro_f1, digest)
        assert registered.alias_moved == (registered.version == champion)
        assert str(aliases("by_rule")["champion"]) == champion
    same = "new data: on 12 runs, each held out, accuracy 75.0% against 75.0% of version 2"
    assert registered.alias_reason.startswith(same)
    assert read_model("models:/by_rule@champion").info.data_digest == "bb"
    folder = Path(mlflow.artifacts.download_artifacts("models:/by_rule/4"))
    (folder / "model.skops").write_bytes(b"")
    last = log("by_rule", 0.5, "cc")
    assert (last.alias_moved, last.alias_reason) == (True, "version 4 cannot be loaded")
    assert log("useless", 0.3, accuracy_ci=(0.25, 0.45)).version == "1"
    assert aliases("useless") == {}


TWO_AT_ONCE = """
import os, sys, time
from pathlib import Path
from pipelines.data.tracking import ensure_tracking, log_run, mlflow_store
Path(f"ready_{sys.argv[1]}").touch()
while len(list(Path().glob("ready_*"))) < 3:
    time.sleep(0.01)
ensure_tracking()
with mlflow_store(create=True) as mlflow:
    print(log_run(mlflow, "together", {}, {"figure": 1.0}, {}, {}))
"""


@pytest.mark.slow
def test_processes_that_start_together_in_an_empty_folder_all_succeed(tmp_path):
    environment = {k: v for k, v in os.environ.items() if k != "MLFLOW_TRACKING_URI"}
    options = {"env": environment, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    words = [sys.executable, "-c", TWO_AT_ONCE]
    processes = [subprocess.Popen([*words, str(number)], cwd=tmp_path, **options) for number in range(3)]
    done = [process.communicate(timeout=240) for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], done
    assert len({out.strip() for out, _ in done}) == 3
    with sqlite3.connect(tmp_path / "mlruns" / "mlflow.db") as database:
        names = database.execute("SELECT name FROM experiments").fetchall()
        (n_runs,) = database.execute("SELECT COUNT(*) FROM runs").fetchone()
    database.close()
    assert (sorted(name for (name,) in names), n_runs) == (["Default", "terrain"], 3)


def test_the_server_that_is_named_is_the_one_that_is_used(tracked, log, tmp_path, monkeypatch):
    shutil.copy(tracked[0] / "mlruns" / "mlflow.db", tmp_path / "other.db")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'other.db'}")
    log("elsewhere", 0.5)
    assert read_model("models:/elsewhere@champion").info.data_digest == "aa"
    assert list((tmp_path / "work").iterdir()) == []  # no ./mlruns beside the server that was named
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    monkeypatch.chdir(tracked[0])
    with pytest.raises(ModelError, match="elsewhere"):
        read_model("models:/elsewhere@champion")


def test_a_model_that_is_not_there_is_one_sentence(in_tracked):
    for uri, sentence in (
        ("models:/missing@champion", "models:/missing@champion.*cannot be loaded"),
        ("models:/drawn/99", "models:/drawn/99.*cannot be loaded"),
        ("models:/", "models:/.*cannot be loaded"),
        ("runs:/0123/model", "runs:/0123/model.*cannot be loaded"),
        ("s3:/bucket/model", "is neither a folder nor a model URI"),
        ("nowhere", "is neither a folder nor a model URI"),
        ("a" * 5000, "cannot be opened"),
    ):
        with pytest.raises(ModelError, match=sentence) as error:
            read_model(uri)
        assert "\n" not in str(error.value)


def test_a_store_that_fails_is_one_sentence(in_tracked, tmp_path, monkeypatch, log):
    monkeypatch.setattr("pipelines.data.tracking.LOCK_TIMEOUT_S", 0.2)
    with (
        file_lock(Path("mlruns/mlflow.db.lock").resolve(), 1.0, "tests"),
        pytest.raises(TerrainError, match=r"mlflow\.db\.lock: another process writes to the tracking"),
    ):
        log("drawn", 0.5)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:1")
    champion = lambda: read_model("models:/drawn@champion")  # noqa: E731
    for act in (ensure_tracking, champion):
        with pytest.raises(TerrainError, match=r"MLFLOW_TRACKING_URI=http://127.0.0.1:1: cannot be reached"):
            act()
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    (tmp_path / "new").mkdir()
    monkeypatch.chdir(tmp_path / "new")
    with pytest.raises(ModelError, match=r"mlflow\.db does not exist: train a model here first"):
        champion()
    assert list(Path().iterdir()) == []  # looking for a model makes nothing
    Path("mlruns").mkdir()
    Path("mlruns/mlflow.db").write_text("no database, though as long as one. " * 100)
    for act in (champion, lambda: log("drawn", 0.5)):
        with pytest.raises(TerrainError) as error:
            act()
        assert "\n" not in str(error.value)
