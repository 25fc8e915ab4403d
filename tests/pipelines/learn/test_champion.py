"""A champion is judged on runs that are new to it, or by its own held-out figures."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.learn.champion import Bench, Champion, compare, held_out_runs, judge, standing_of
from pipelines.learn.crossval import EvaluationSettings, crossval
from pipelines.learn.model_file import TerrainModel, read_model
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.training_data import data_of_runs, identities

TRAINING = RecipeSettings(repeats=1, n_jobs=1)
EVALUATION = EvaluationSettings(repeats=1, n_jobs=1, extras=False)


@pytest.fixture(scope="module")
def model(tracked):
    return read_model(tracked[0] / "model")


def judged(model, runs):
    data, report = data_of_runs(runs, TRAINING), crossval(runs, EVALUATION)
    info = replace(model.info, data_digest=data.digest)
    bench = Bench(data, held_out_runs(data.samples, report), 0)
    verdict = judge(Champion("1", {"macro_f1": "0.9"}, model), standing_of(info, report), bench)
    return verdict, data.samples, report


@pytest.mark.slow
def test_the_champion_is_judged_on_runs_that_it_never_saw(model, drive_all):
    new = drive_all(n_runs=3, seed=41)
    (moved, reason), samples, report = judged(model, new)
    windows = samples.windows
    predicted = model.recipe.predict(windows)
    theirs = float(np.mean(predicted == windows.terrain.astype(str)))
    assert moved == (report.accuracy >= theirs)
    figures = f"accuracy {report.accuracy:.1%} against {theirs:.1%} of version 1"
    assert reason.startswith(f"new data: on 9 runs, each held out, {figures}")


class Oracle:
    """Predicts every window right, or none."""

    def __init__(self, classes, terrain, right):
        self.classes_ = np.array(classes)
        self.terrain, self.right = terrain, right

    def predict_proba(self, windows):
        true = windows.terrain.astype(str)[:, None] == self.classes_
        return true.astype(float) if self.right else np.roll(true, 1, axis=1).astype(float)


def test_it_stays_where_it_is_better_and_goes_where_it_is_not(model, drive_all):
    new = drive_all(n_runs=3, seed=43)
    for right, moved in ((True, False), (False, True)):
        stand_in = TerrainModel(Oracle(model.info.classes, None, right), model.info)
        (found, reason), _, report = judged(stand_in, new)
        assert report.accuracy_ci[0] > report.chance
        assert report.accuracy < 1.0
        assert found == moved
    assert "against 0.0% of version 1" in reason


def test_its_own_runs_count_with_the_figures_of_when_they_were_held_out(model, runs, drive_all):
    more = [*runs, *(replace(run, run_id=f"{run.run_id}_new") for run in drive_all(n_runs=1, seed=47))]
    data, report = data_of_runs(more, TRAINING), crossval(more, EVALUATION)
    digests = {run.run_id: run.digest for run in identities(more)}
    held_out = held_out_runs(data.samples, report)
    cheat = TerrainModel(Oracle(model.info.classes, None, True), model.info)
    found = compare(cheat, Bench(data, held_out, 0))
    own = [model.info.run_accuracy[digests[run.run_id]] for run in runs]
    assert found.n_runs == 15
    assert found.champion == pytest.approx((np.sum(own) + 3) / 15)  # what it was trained on is not predicted
    unknown = TerrainModel(cheat.recipe, replace(model.info, run_accuracy={}))
    assert compare(unknown, Bench(data, held_out, 0)).n_unknown == 12
    only_old = {run.run_id: each for run in runs for each in [held_out[run.run_id]]}
    assert compare(unknown, Bench(data, only_old, 0)) is None


def test_held_out_figures_of_a_run_count_all_of_its_terrains(runs):
    samples = data_of_runs(runs, TRAINING).samples
    report = crossval(runs, EVALUATION)
    found = held_out_runs(samples, report)
    assert {name: each.n_windows for name, each in found.items()} == {run.run_id: 12 for run in runs}
    assert np.mean([each.accuracy for each in found.values()]) == pytest.approx(report.accuracy)
