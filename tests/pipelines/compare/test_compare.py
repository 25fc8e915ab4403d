"""Two recipes on the same folds, two models on the same runs: what differs is found."""

import json
import re

import numpy as np
import pytest
from rich.console import Console

from pipelines.compare.compare import compare_models, compare_recipes
from pipelines.compare.screen import print_compare
from pipelines.compare.settings import CompareSettings
from pipelines.crossval.crossval import crossval
from pipelines.data.datasets import data_digest
from pipelines.models.model_files import TerrainModel, read_model
from pipelines.reporting.json_file import as_json
from terrain.classify.paired import Verdict
from terrain.classify.support import SupportLevel
from terrain.errors import ConfigError, DataError


def settings_of(a, b, **options):
    return CompareSettings(a=a, b=b, **({"repeats": 1, "n_jobs": 1} | options))


@pytest.fixture(scope="module")
def noisy_runs(drive_all):
    """Runs whose currents do not depend on the terrain."""
    return drive_all(n_runs=5, seed=4, current_a=3.0)


@pytest.mark.slow
def test_signal_sets_that_hold_the_terrain_are_better_than_those_that_do_not(noisy_runs):
    settings = settings_of("svm@currents", "svm@imu", repeats=2)
    report = compare_recipes(noisy_runs, settings.contenders, settings, "moor")
    found = report.comparison
    assert found.accuracy.verdict is Verdict.BETTER
    assert found.accuracy.a < 0.55 < found.accuracy.b
    assert (report.n_runs, report.repeats, report.kind) == (15, 2, "recipes")
    assert set(found.by_class) == {"ASPHALT", "GRASS", "GRAVEL"}
    document = as_json(report)
    assert json.loads(json.dumps(document, allow_nan=False))["accuracy"]["verdict"] == "better"
    console = Console(record=True, width=160)
    print_compare(report, console)
    text = console.export_text()
    assert "A is svm@currents, B is svm@imu" in text
    assert re.search(r"accuracy on GRASS .* better", text)


def test_a_recipe_has_the_figures_of_its_cross_validation_and_does_not_differ_from_itself(runs, settings):
    comparing = settings_of("svm", "svm")
    found = compare_recipes(runs, comparing.contenders, comparing, "moor").comparison
    assert found.accuracy.a == found.accuracy.b == crossval(runs, settings()).accuracy
    assert found.accuracy.verdict is Verdict.NOT_DISTINGUISHED


def test_differences_by_support_are_of_the_windows_of_a_level(runs):
    comparing = settings_of("svm@currents", "svm@imu")
    report = compare_recipes(runs, comparing.contenders, comparing, "moor")
    assert set(report.by_support) <= {level.value for level in SupportLevel}
    assert report.by_support
    n_runs = [row.n_runs for row in report.by_support.values()]
    assert max(n_runs) <= report.n_runs <= sum(n_runs)
    of_all = report.comparison.accuracy.difference
    differences = [row.difference for row in report.by_support.values()]
    assert min(differences) <= of_all <= max(differences)


class Constant:
    """Stands in for a recipe: the same class with the same probability, always."""

    def __init__(self, classes, probability):
        self.classes_, self.probability = np.array(classes), np.array(probability)

    def predict_proba(self, windows):
        return np.tile(self.probability, (len(windows), 1))


@pytest.fixture
def model(tracked):
    return read_model(tracked[0] / "model")


def test_models_are_compared_on_runs_that_neither_was_trained_on(model, runs, drive_all):
    new = drive_all(n_runs=2, seed=91)
    constant = TerrainModel(Constant(model.info.classes, [1.0, 0.0, 0.0]), model.info)
    settings = settings_of("old", "new")
    digests = {data_digest([run]) for run in runs}
    assert digests == set(model.info.run_digests)
    renamed = [run for run in runs if run.run_id == "GRASS_4"]
    report = compare_models([*new, *renamed], (constant, model), settings, "moor")
    assert report.excluded_runs == ("GRASS_4",)
    assert report.n_runs == 6
    assert report.comparison.accuracy.verdict is Verdict.BETTER
    assert report.comparison.accuracy.a == pytest.approx(1 / 3)
    with pytest.raises(DataError, match="all 12 runs were used to train old or new: no run is left"):
        compare_models(runs, (model, model), settings, "moor")


def test_models_without_a_common_class_are_refused(model, drive_all):
    new = drive_all(n_runs=1, seed=92, label="LAVA")
    with pytest.raises(DataError, match="no window of these runs is labelled as a class of both models"):
        compare_models(new, (model, model), settings_of("old", "new"), "moor")


def test_a_recipe_is_not_compared_with_a_model():
    with pytest.raises(ConfigError, match=r"'svm' is a recipe and 'models:/field/1' is not"):
        settings_of("svm", "models:/field/1")
    comparing = settings_of("svm@radar", "svm")
    with pytest.raises(ConfigError, match="unknown signal set 'radar'"):
        comparing.evaluation(comparing.contenders[0])
