"""A search tries the same whatever runs beside it or interrupts it, and never sees what judges it."""

import json
import sys

import numpy as np
import pytest

from pipelines.learn.recipes import read_params
from pipelines.learn.search import STUDY_FILE, TRIALS_FILE, search
from pipelines.learn.settings import RecipeSettings
from pipelines.learn.training_data import data_of_runs
from pipelines.report.results import as_json, silent
from terrain.errors import ConfigError, LogError


@pytest.fixture(scope="module")
def data(runs):
    return data_of_runs(runs, RecipeSettings())


def sweep(data, out, trials=8, seed=0, n_jobs=1):
    return search(data, trials, out, seed, n_jobs, silent)


@pytest.fixture(scope="module")
def searched(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("search") / "one"
    return out, sweep(data, out)


@pytest.mark.slow
def test_a_search_that_is_interrupted_or_in_two_processes_has_the_same_result(data, searched, tmp_path):
    out, whole = searched
    first = sweep(data, tmp_path / "two", trials=4)
    assert (first.trials, first.resumed) == (4, 0)
    text = (tmp_path / "two" / TRIALS_FILE).read_text()
    second = sweep(data, tmp_path / "two")
    assert (second.trials, second.resumed) == (8, 4)
    assert (tmp_path / "two" / TRIALS_FILE).read_text() == (out / TRIALS_FILE).read_text()
    assert (tmp_path / "two" / TRIALS_FILE).read_text().startswith(text)
    assert second.best == whole.best
    assert second.held_out == whole.held_out
    again = sweep(data, tmp_path / "two")  # nothing is left to try
    assert again.resumed == 8
    sweep(data, tmp_path / "both", n_jobs=2)
    assert (tmp_path / "both" / TRIALS_FILE).read_bytes() == (out / TRIALS_FILE).read_bytes()


def test_the_best_is_the_most_accurate_on_inner_folds(searched):
    out, report = searched
    lines = [json.loads(line) for line in (out / TRIALS_FILE).read_text().splitlines()]
    assert len(lines) == 8
    assert len({json.dumps(line["params"]) for line in lines}) == 8
    assert report.best.accuracy == max(line["accuracy"] for line in lines)
    low, high = report.best.accuracy_ci
    assert 1 / 3 < low <= report.best.accuracy <= high <= 1.0
    assert read_params(report.params_file) == report.best.params
    json.dumps(as_json(report), allow_nan=False)


def test_no_trial_sees_the_runs_that_judge_it(data, tmp_path, monkeypatch):
    seen = []

    def spy(function, shared, each, n_jobs):
        seen.append(set(np.unique(shared[0].group.astype(str))))
        return (function(*shared, *one) for one in each)

    monkeypatch.setattr("pipelines.learn.search.parallel", spy)
    report = sweep(data, tmp_path / "out", trials=4)
    assert report.held_out_runs
    assert all(not groups & set(report.held_out_runs) for groups in seen)
    assert seen[0] | set(report.held_out_runs) == set(data.samples.run_id)
    assert report.held_out.n_runs == len(report.held_out_runs)


def test_another_search_in_the_folder_is_refused(runs, data, searched, tmp_path):
    out, _ = searched
    with pytest.raises(ConfigError, match="other runs, settings or another version"):
        sweep(data_of_runs(runs[:-1], RecipeSettings()), out)
    with pytest.raises(ConfigError, match="other runs, settings or another version"):
        sweep(data, out, seed=1)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="holds other files"):
        sweep(data, tmp_path)


@pytest.mark.parametrize("line", ["{", '{"params": {"q": 1}, "accuracy_ci": [0, 1]}'])
def test_a_damaged_search_is_one_sentence(data, searched, tmp_path, line):
    (tmp_path / STUDY_FILE).write_text((searched[0] / STUDY_FILE).read_text())
    (tmp_path / TRIALS_FILE).write_text(line + "\n")
    with pytest.raises(LogError, match="is damaged") as refusal:
        sweep(data, tmp_path)
    assert len(str(refusal.value).splitlines()) == 1


def test_without_optuna_there_is_one_sentence(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match="pip install"):
        sweep(data, tmp_path / "new")
    assert not (tmp_path / "new").exists()


BEST = {"C": 1, "gamma": 1, "percentile": 50}


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "no result of a search"),
        ({"version": 9, "params": BEST}, "version: Input should be 1"),
        ({"version": 1, "params": BEST | {"depth": 3}}, "params.depth: Extra inputs"),
        ({"version": 1, "params": {"C": 1, "gamma": 1}}, "params.percentile: Field required"),
        ({"version": 1, "params": BEST | {"C": -1}}, "params.C: Input should be greater"),
        ({"version": 1, "params": BEST | {"percentile": 500}}, "params.percentile: Input should be less"),
    ],
)
def test_parameters_that_are_none_are_refused(tmp_path, content, sentence):
    (tmp_path / "best.json").write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ConfigError, match=sentence):
        read_params(tmp_path / "best.json")
