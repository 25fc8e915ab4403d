"""A search tries the same whatever runs beside it or interrupts it, and never sees what judges it."""

import json
import sys

import numpy as np
import pytest

from pipelines.crossval.settings import CrossvalSettings
from pipelines.models.params_file import read_params
from pipelines.reporting.json_file import as_json
from pipelines.sweep import sweep as module
from pipelines.sweep.settings import SweepSettings
from pipelines.sweep.sweep import STUDY_FILE, TRIALS_FILE, sweep
from terrain.errors import ConfigError, LogError


def asked(out, **changed):
    return SweepSettings(**({"out": out, "trials": 8, "n_jobs": 1} | changed))


@pytest.fixture(scope="module")
def searched(runs, tmp_path_factory):
    out = tmp_path_factory.mktemp("sweep") / "one"
    return out, sweep(runs, asked(out), "drawn")


@pytest.mark.slow
def test_an_interrupted_search_goes_on_to_the_same_result(runs, searched, tmp_path):
    out, whole = searched
    first = sweep(runs, asked(tmp_path / "two", trials=4), "drawn")
    assert (first.trials, first.resumed) == (4, 0)
    text = (tmp_path / "two" / TRIALS_FILE).read_text()
    second = sweep(runs, asked(tmp_path / "two"), "drawn")
    assert (second.trials, second.resumed) == (8, 4)
    assert (tmp_path / "two" / TRIALS_FILE).read_text() == (out / TRIALS_FILE).read_text()
    assert (tmp_path / "two" / TRIALS_FILE).read_text().startswith(text)
    assert second.best == whole.best
    assert second.held_out == whole.held_out
    again = sweep(runs, asked(tmp_path / "two"), "drawn")  # nothing is left to try
    assert again.resumed == 8


@pytest.mark.slow
def test_two_processes_try_what_one_tries(runs, searched, tmp_path):
    sweep(runs, asked(tmp_path / "two", n_jobs=2), "drawn")
    assert (tmp_path / "two" / TRIALS_FILE).read_bytes() == (searched[0] / TRIALS_FILE).read_bytes()


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


def test_no_trial_sees_the_runs_that_judge_it(runs, tmp_path, monkeypatch):
    seen = []

    def spy(function, shared, each, n_jobs):
        seen.append(set(np.unique(shared[0].group.astype(str))))
        return (function(*shared, *one) for one in each)

    monkeypatch.setattr(module, "parallel", spy)
    report = sweep(runs, asked(tmp_path / "out", trials=4), "drawn")
    assert report.held_out_runs
    assert all(not groups & set(report.held_out_runs) for groups in seen)
    assert seen[0] | set(report.held_out_runs) == {run.run_id for run in runs}
    assert report.held_out.n_runs == len(report.held_out_runs)


def test_a_result_takes_the_place_of_the_choice(runs, searched, settings):
    from pipelines.crossval.crossval import crossval

    found = crossval(runs, settings(params=searched[1].params_file))
    chosen = {json.dumps(fold.chosen, sort_keys=True) for fold in found.folds}
    assert chosen == {json.dumps(searched[1].best.params._asdict(), sort_keys=True)}


def test_another_search_in_the_folder_is_refused(runs, searched, tmp_path):
    out, _ = searched
    with pytest.raises(ConfigError, match="other runs, settings or another version"):
        sweep(runs[:-1], asked(out), "drawn")
    with pytest.raises(ConfigError, match="other runs, settings or another version"):
        sweep(runs, asked(out, seed=1), "drawn")
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="holds other files"):
        sweep(runs, asked(tmp_path), "drawn")
    with pytest.raises(ConfigError, match="not of 'cnn'"):
        sweep(runs, asked(tmp_path / "new", recipe="cnn"), "drawn")


@pytest.mark.parametrize(
    "line", ["{", "[]", '{"params": {"C": 1}}', '{"params": {"q": 1}, "accuracy_ci": [0, 1]}']
)
def test_a_damaged_search_is_one_sentence(runs, searched, tmp_path, line):
    (tmp_path / STUDY_FILE).write_text((searched[0] / STUDY_FILE).read_text())
    (tmp_path / TRIALS_FILE).write_text(line + "\n")
    with pytest.raises(LogError, match="is damaged") as refusal:
        sweep(runs, asked(tmp_path), "drawn")
    assert len(str(refusal.value).splitlines()) == 1


def test_without_optuna_there_is_one_sentence(runs, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match="pip install"):
        sweep(runs, asked(tmp_path / "new"), "drawn")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "no result of terrain sweep"),
        ('{"version": 9, "params": {}}', "version 9"),
        (
            '{"version": 1, "params": {"C": 1, "gamma": 1, "percentile": 50, "depth": 3}}',
            "'depth' is no hyper",
        ),
        ('{"version": 1, "params": {"C": 1, "gamma": 1}}', "percentile is None"),
        ('{"version": 1, "params": {"C": -1, "gamma": 1, "percentile": 50}}', "C is -1"),
        ('{"version": 1, "params": {"C": 1, "gamma": 1, "percentile": 500}}', "percentile is 500"),
    ],
)
def test_parameters_that_are_none_are_refused(tmp_path, content, sentence):
    (tmp_path / "best.json").write_text(content)
    with pytest.raises(ConfigError, match=sentence):
        read_params(tmp_path / "best.json")


def test_a_network_has_no_such_parameters(tmp_path):
    with pytest.raises(ConfigError, match="--params"):
        CrossvalSettings(recipe="cnn", params=tmp_path / "best.json")
