"""Blind trials over processes: a few of them, and what the command prints, writes and refuses."""

import json
import sys

import pytest

from pipelines.cli import main as cli
from pipelines.explain.trials import TrialsSettings, explain_trials
from pipelines.reporting.json_file import as_json
from terrain.discrepancy.trials.rows import Row
from terrain.errors import ConfigError


@pytest.mark.slow
def test_a_few_blind_trials_come_out_right():
    """One on each robot of each kind that has to be right: more of them are for the command."""
    result = explain_trials(TrialsSettings(n=2, seed=1, rows="none,strong", runs=4, n_jobs=1))
    table = result.table
    assert len(result.trials) == 4
    assert table["none: false alarms"].hits == 0
    assert table["strong: named"].hits == 2
    assert table["strong: wrongly named"].hits == 0
    assert [trial.row for trial in result.trials] == ["none", "none", "strong", "strong"]
    assert 0 < result.seconds.median <= result.seconds.worst
    for trial, shown in zip(
        result.trials, json.loads(json.dumps(as_json(result.trials), allow_nan=False)), strict=True
    ):
        assert (shown["hidden"], shown["named"]) == (trial.hidden, list(trial.named))


@pytest.fixture
def terrain(monkeypatch, capsys, tmp_path):
    """Return a function that runs the command in this process: exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["terrain", "explain-trials", *words])
        try:
            cli.main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.mark.slow
def test_the_command_prints_its_table_and_writes_every_trial(terrain, tmp_path):
    words = ("--n", "1", "--rows", "none,found", "--runs", "3", "--jobs", "1", "--seed", "2")
    code, out, err = terrain(*words, "--json", "trials.json")
    assert code == 0, err
    assert "none: false alarms" in out
    assert "row found: no effect had 5 trials" in out
    assert "2 trials of 3 runs, seed 2" in out
    found = json.loads((tmp_path / "trials.json").read_text())
    assert (found["n"], found["seed"], found["runs"], found["rows"]) == (1, 2, 3, ["none", "found"])
    assert [case["row"] for case in found["trials"]] == ["none", "found"]
    assert found["trials"][1]["hidden"]
    assert found["found_from"] == {}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--rows", "none,weak"), "--rows is 'none,weak'; some of none,strong,ladder,"),
        (("--rows", ","), "--rows is ''"),
        (("--rows", "none,none"), "each once"),
        (("--n", "0"), "--n is 0: "),
        (("--runs", "2"), "--runs is 2; at least 3"),
    ],
)
def test_a_users_mistake_is_one_sentence_and_nothing_is_written(terrain, tmp_path, words, message):
    code, out, err = terrain(*words, "--json", "trials.json")
    assert (code, out) == (2, "")
    assert message in err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_all_rows_are_run_unless_named():
    with pytest.raises(ConfigError, match=",".join(Row)):
        TrialsSettings(rows=("all",))
