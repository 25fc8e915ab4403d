"""A search tries the same whatever runs beside it or interrupts it, and never sees what judges it."""

import json
import shutil
import sys

import pytest

from pipelines.learn.parallel import parallel
from pipelines.learn.recipes import read_params
from pipelines.learn.search import STUDY_FILE, TRIALS_FILE, search
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.training_data import data_of_runs
from pipelines.report.results import as_json, silent
from terrain.errors import ConfigError, LogError


@pytest.fixture(scope="module")
def data(runs):
    return data_of_runs(runs, RecipeSettings())


def sweep(data, out, trials=4, seed=0, n_jobs=1):
    return search(data, trials, out, seed, n_jobs, silent)


@pytest.fixture(scope="module")
def searched(data, tmp_path_factory):
    """The folder of a search, its result, and the runs that each batch of trials was given."""
    out, seen = tmp_path_factory.mktemp("search") / "one", []

    def watched(function, shared, each, n_jobs):
        seen.append(set(shared[0].group[:, 1]))
        return parallel(function, shared, each, n_jobs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipelines.learn.search.parallel", watched)
        return out, sweep(data, out), seen


@pytest.mark.slow
def test_a_search_that_is_interrupted_or_in_two_processes_has_the_same_result(data, searched, tmp_path):
    two, both = tmp_path / "two", tmp_path / "both"
    shutil.copytree(searched[0], two)
    second, whole = sweep(data, two, trials=8), sweep(data, both, trials=8, n_jobs=2)
    assert (second.trials, second.resumed, whole.resumed) == (8, 4, 0)
    assert (two / TRIALS_FILE).read_bytes() == (both / TRIALS_FILE).read_bytes()
    assert (two / TRIALS_FILE).read_text().startswith((searched[0] / TRIALS_FILE).read_text())
    assert (second.best, second.held_out) == (whole.best, whole.held_out)
    assert sweep(data, two, trials=8).resumed == 8  # nothing is left to try


def test_the_best_is_the_most_accurate_on_inner_folds_and_no_trial_sees_the_runs_that_judge_it(
    data, searched
):
    out, report, seen = searched
    lines = [json.loads(line) for line in (out / TRIALS_FILE).read_text().splitlines()]
    assert len({json.dumps(line["params"]) for line in lines}) == len(lines) == 4
    held_out = set(report.held_out_runs)
    assert report.held_out.n_units == len(held_out) > 0
    assert all(groups == set(data.samples.run_id) - held_out for groups in seen)
    assert report.best.accuracy == max(line["accuracy"] for line in lines)
    low, high = report.best.accuracy_ci
    assert 0.25 < low <= report.best.accuracy <= high <= 1.0
    assert read_params(report.params_file) == report.best.params
    json.dumps(as_json(report), allow_nan=False)


def test_another_or_a_damaged_search_and_one_without_optuna_are_one_sentence(
    runs, data, searched, tmp_path, monkeypatch
):
    out = searched[0]
    with pytest.raises(ConfigError, match="other runs, settings or another version"):
        sweep(data_of_runs(runs[:-1], RecipeSettings()), out)
    with pytest.raises(ConfigError, match="other runs, settings or another version"):
        sweep(data, out, seed=1)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="holds other files"):
        sweep(data, tmp_path)

    (tmp_path / "notes.txt").unlink()
    (tmp_path / STUDY_FILE).write_text((out / STUDY_FILE).read_text())
    for line in ("{", '{"params": {"q": 1}, "accuracy_ci": [0, 1]}'):
        (tmp_path / TRIALS_FILE).write_text(line + "\n")
        with pytest.raises(LogError, match="is damaged") as refusal:
            sweep(data, tmp_path)
        assert len(str(refusal.value).splitlines()) == 1
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match="pip install"):
        sweep(data, tmp_path / "new")
    assert not (tmp_path / "new").exists()


BEST = {"C": 1, "gamma": 1, "percentile": 50}


def test_parameters_that_are_none_are_refused(tmp_path):
    for content, sentence in (
        ("{", "no result of a search"),
        ({"version": 9, "params": BEST}, "version: Input should be 1"),
        ({"version": 1, "params": BEST | {"percentile": 500}}, "params.percentile: Input should be less"),
    ):
        (tmp_path / "best.json").write_text(content if isinstance(content, str) else json.dumps(content))
        with pytest.raises(ConfigError, match=sentence):
            read_params(tmp_path / "best.json")
