"""Two recipes on the same folds, two models on the same runs: what differs is found."""

import json

import numpy as np
import pytest

from pipelines.learn.comparison import compare_models
from pipelines.learn.crossval import crossval
from pipelines.report.results import as_json
from terrain.classify.limits import SupportLevel
from terrain.classify.metrics import Verdict
from terrain.errors import DataError
from terrain.logs.run_folders import data_digest


@pytest.fixture(scope="module")
def noisy_runs(drive_all):
    """Runs whose currents do not depend on the terrain."""
    return drive_all(n_runs=5, seed=4, current_a=3.0)


@pytest.mark.slow
def test_signal_sets_that_hold_the_terrain_are_better_than_those_that_do_not(noisy_runs, settings):
    report = crossval(noisy_runs, settings(recipe="svm@currents,svm@imu", repeats=2))
    (found,), n_all = report.differences, report.contenders[0].n_runs
    assert found.accuracy.verdict is Verdict.BETTER
    assert found.accuracy.a < 0.55 < found.accuracy.b
    assert (report.contenders[0].n_runs, report.contenders[0].repeats, report.kind) == (15, 2, "recipes")
    assert set(found.by_class) == {"ASPHALT", "GRASS", "GRAVEL"}
    assert set(found.by_support) <= {level.value for level in SupportLevel}
    n_runs = [row.n_runs for row in found.by_support.values()]
    assert max(n_runs) <= n_all <= sum(n_runs)
    differences = [row.difference for row in found.by_support.values()]
    assert min(differences) <= found.accuracy.difference <= max(differences)
    document = as_json(report)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["differences"][0]["accuracy"]["verdict"] == "better"
    text = str(report)
    assert text.startswith("svm@imu classifies ")
    assert "better" in text.splitlines()[0]
    assert len(text.splitlines()) <= 25
    assert report.to_pandas()["recipe"].tolist() == ["svm@currents", "svm@imu"]


def test_a_recipe_has_the_figures_of_its_cross_validation_and_does_not_differ_from_itself(runs, settings):
    (found,) = crossval(runs, settings(recipe="svm,svm")).differences
    assert found.accuracy.a == found.accuracy.b == crossval(runs, settings()).accuracy
    assert found.accuracy.verdict is Verdict.NOT_DISTINGUISHED


def test_models_are_compared_on_runs_that_none_was_trained_on(model, giving, runs, drive_all, settings):
    new = drive_all(n_runs=2, seed=91)
    constant = giving(lambda windows: np.tile([1.0, 0.0, 0.0], (len(windows), 1)))
    asked = settings(model=("old", "new"))
    digests = {data_digest([run]) for run in runs}
    assert digests == set(model.info.run_digests)
    renamed = [run for run in runs if run.run_id == "GRASS_4"]
    report = compare_models([*new, *renamed], (constant, model), asked)
    assert report.excluded_runs == ("GRASS_4",)
    assert report.contenders[1].n_runs == 6
    (found,) = report.differences
    assert found.accuracy.verdict is Verdict.BETTER
    assert found.accuracy.a == report.contenders[0].accuracy == pytest.approx(1 / 3)
    alone = compare_models([*new, *renamed], [model], settings(model=("new",)))
    assert alone.accuracy == found.accuracy.b
    assert "1 run left out" in alone.notes[-1]
    with pytest.raises(DataError, match="all 12 runs were used to train old or new: no run is left"):
        compare_models(runs, (model, model), asked)


def test_models_without_a_common_class_are_refused(model, drive_all, settings):
    new = drive_all(n_runs=1, seed=92, label="LAVA")
    with pytest.raises(DataError, match="no window of these runs is labelled as a class of all models"):
        compare_models(new, (model, model), settings(model=("old", "new")))
