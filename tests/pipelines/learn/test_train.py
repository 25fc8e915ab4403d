"""Training: evaluated on held-out runs, tracked with its card, and kept where the tracking server stops."""

import json
import socket
import time
from dataclasses import replace

import numpy as np
import pytest
from sklearn.tree import DecisionTreeClassifier

from features.motion import window_motion
from features.protocols import samples_of
from pipelines.learn import tracking
from pipelines.learn.card import limits_of, model_result, read_training
from pipelines.learn.model_file import CARD_FILE, TRAINING_FILE, seal
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.train import Settings, run
from pipelines.report.results import as_json
from terrain.classify.held_out import channel_drops
from terrain.errors import ModelError, TerrainError
from terrain.logs.run_folders import write_run


def test_training_is_evaluated_on_held_out_runs_and_names_the_model(tracked):
    _, result = tracked
    document = json.loads(json.dumps(as_json(result), allow_nan=False))
    assert (document["model_uri"], document["version"]) == ("models:/drawn/1", "1")
    assert set(document) == {
        *("model_uri", "version", "run_id", "alias_moved", "alias_reason", "dataset", "data_digest"),
        *("commit", "n_windows", "chosen", "importance", "crossval"),
    }
    assert document["crossval"]["protocol"] == "grouped"
    assert "dataset" not in document["crossval"]
    assert result.n_windows == 144
    drops = [row.drop for row in result.importance]
    assert drops == sorted(drops, reverse=True)
    assert result.ui.startswith("mlflow ui --backend-store-uri sqlite:////")
    assert result.ui in str(result.report)


def test_a_tracking_folder_that_cannot_be_written_is_reported_before_any_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "mlruns").write_text("an obstacle")
    with pytest.raises(TerrainError, match="mlruns: cannot be written"):
        run(Settings(name="m", data=tmp_path / "nowhere"))
    assert (tmp_path / "mlruns").read_text() == "an obstacle"


def test_only_the_channel_that_is_used_is_important():
    features = np.random.default_rng(0).normal(size=(400, 3))
    truth = np.where(features[:, 0] > 0, "b", "a")
    stump = DecisionTreeClassifier(max_depth=1).fit(features, truth)
    drops = channel_drops(features, truth, ["imu.x", "imu.y", "imu.x"], 0, 1, stump)
    assert drops[0] == pytest.approx(0.5, abs=0.1)
    assert drops[1] == 0.0


def test_a_model_has_its_card_and_its_figures(model_dir, tracked, runs):
    result, evaluation = model_result(model_dir, "field"), tracked[1].crossval
    training = result.training
    assert (result.data_digest, result.dataset) == (tracked[1].data_digest, "twelve runs")
    assert [row.run_id for row in training.runs] == [each.run_id for each in runs]
    assert sum(row.n_windows for row in training.runs) == training.params["n_windows"] == 144
    assert as_json(training.evaluation) == as_json(evaluation)
    assert as_json(training.importance) == as_json(tracked[1].importance)
    assert training.latency_ms > 0
    assert result.files == {"model.skops": (model_dir / "model.skops").stat().st_size}
    assert (result.finds_unknown, result.counts_support, result.names_sets) == (True, True, True)
    json.dumps(as_json(result), allow_nan=False)
    text = (model_dir / CARD_FILE).read_text()
    for part in ("Robots other than husky", f"{100 * evaluation.accuracy:.1f}", f"{evaluation.ece:.3f}"):
        assert part in text
    assert result.to_pandas()["recall"].tolist() == evaluation.to_pandas()["recall"].tolist()


def test_limits_name_what_is_weak(tracked, runs, model):
    windows, evaluation = samples_of(runs, RecipeSettings().rule).windows, tracked[1].crossval
    weak = {name: row._replace(recall=0.3) for name, row in evaluation.per_class.items() if name == "GRASS"}
    evaluation = replace(evaluation, per_class={**evaluation.per_class, **weak})
    limits = " ".join(limits_of(model.info, windows, window_motion(windows), evaluation))
    assert "Decisions that rest on GRASS: recognised in under half of the windows." in limits
    assert "Speeds outside of 0." in limits


def test_a_record_of_a_training_that_is_none_is_one_sentence(in_tracked, model_dir, model):
    file = model_dir / TRAINING_FILE
    document = json.loads(file.read_text())
    document["evaluation"]["accuracy"] = "much"
    for text in ("{", "[]", json.dumps(document)):
        file.write_text(text)
        with pytest.raises(ModelError, match=r"training\.json: is damaged"):
            read_training(model_dir)
        seal(model_dir, model.info)
        with pytest.raises(ModelError, match=r"training\.json: is no record of a training") as refusal:
            run(Settings(kept=model_dir, name="m"))
        assert len(str(refusal.value).splitlines()) == 1
    # A model that was not evaluated says so and is not registered.
    for name in (TRAINING_FILE, CARD_FILE):
        (model_dir / name).unlink()
    seal(model_dir, model.info)
    assert "was not evaluated" in model_result(model_dir, "field").report.answer
    with pytest.raises(ModelError, match="holds a model that was not evaluated"):
        run(Settings(kept=model_dir, name="m"))


def test_a_store_that_fails_in_the_middle_costs_no_model(runs, tracked, tmp_path, monkeypatch):
    for each in runs:
        write_run(each, tmp_path / "runs")
    best = {"C": 10, "gamma": 0.4, "percentile": 100}  # a choice would take longer
    (tmp_path / "best.json").write_text(json.dumps({"version": 1, "params": best}))
    monkeypatch.chdir(tracked[0])
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)

    def failing(*given):
        raise OSError("the server has stopped")

    usual = tracking._log_model
    monkeypatch.setattr(tracking, "_log_model", failing)
    sentence = (
        r"has stopped; the model is kept in .*: register it by terrain train --register .*/kept --name f"
    )
    asked = {"data": tmp_path / "runs", "params": tmp_path / "best.json", "out": tmp_path / "kept"}
    with pytest.raises(TerrainError, match=sentence) as error:
        run(Settings(name="field", repeats=1, n_jobs=1, **asked))
    assert len(str(error.value).splitlines()) == 1
    monkeypatch.setattr(tracking, "_log_model", usual)
    asked = Settings(kept=tmp_path / "kept", name="kept")
    found, again = run(asked), run(asked)
    assert (found.model_uri, found.alias_moved) == ("models:/kept/1", True)
    assert not again.alias_moved
    assert "is not better than" in again.alias_reason


@pytest.mark.slow
def test_a_server_that_hangs_costs_seconds(model_dir, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as silent:  # takes calls, and never answers
        monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{silent.getsockname()[1]}")
        begun_s = time.monotonic()
        with pytest.raises(TerrainError, match="MLflow: ") as error:
            run(Settings(kept=model_dir, name="field"))
    assert time.monotonic() - begun_s < 30.0
    assert len(str(error.value).splitlines()) == 1
