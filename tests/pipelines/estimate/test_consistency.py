"""Consistency by terrain and group of states: of its seed alone, with intervals over runs."""

import io
import json
from itertools import pairwise

import pytest
from rich.console import Console
from typer.testing import CliRunner

from pipelines.estimate import consistency
from pipelines.estimate.consistency import GROUPS, consistency_by_terrain, print_consistency
from pipelines.reporting.json_file import as_json
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")


@pytest.fixture(scope="module")
def rows():
    return consistency_by_terrain(ROBOT, 41, 1, n_jobs=1, terrains=("tiles", "tilled_loam"))


def test_every_group_of_every_terrain_has_a_mean_and_an_interval(rows):
    assert [row.terrain for row in rows] == ["tiles", "tilled_loam"]
    for row in rows:
        assert list(row.nees) == list(GROUPS)
        assert row.n_runs == row.slip_coverage.n == len(consistency.SCENARIOS)
        for value in (*row.nees.values(), row.slip_coverage):
            assert value.ci[0] < value.mean < value.ci[1]
        assert 0.3 < row.slip_coverage.mean <= 1.0


@pytest.mark.slow
def test_the_seed_alone_decides(rows):
    again = consistency_by_terrain(ROBOT, 41, 1, n_jobs=2, terrains=("tiles", "tilled_loam"))
    assert json.dumps(as_json(again)) == json.dumps(as_json(rows))
    (other,) = consistency_by_terrain(ROBOT, 42, 1, n_jobs=1, terrains=("tiles",))
    assert other.nees["slip_speed"].mean != rows[0].nees["slip_speed"].mean


def test_the_screen_has_a_line_a_terrain_and_cuts_nothing_off(rows):
    with Console(file=io.StringIO(), width=110) as console:
        print_consistency(rows, console)
    text = console.file.getvalue()
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    for means, intervals in pairwise(text.splitlines()):
        if "tiles" in means or "tilled_loam" in means:
            assert len(means.split()) == len(GROUPS) + 2
            assert intervals.count("\N{PLUS-MINUS SIGN}") == len(GROUPS) + 1
    assert text.count("\N{PLUS-MINUS SIGN}") == 2 * (len(GROUPS) + 1)


def test_the_command_writes_what_it_prints(tmp_path, monkeypatch, rows):
    import typer

    monkeypatch.setattr(consistency, "consistency_by_terrain", lambda *_: rows)
    app = typer.Typer()
    app.command()(consistency.main)
    done = CliRunner().invoke(app, ["--seed", "41", "--json", str(tmp_path / "out.json")])
    assert done.exit_code == 0
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["seed"] == 41
    assert written["consistency"] == as_json(rows)
