"""Quickstart: the whole job in one command; what it predicts is held out for real, and its report says so."""

import json
from contextlib import nullcontext

import pytest

from pipelines.cli.quickstart import Settings, run
from pipelines.data.datasets import load
from pipelines.data.settings import AlignedRunsSettings
from pipelines.learn.model_file import read_model
from pipelines.report.results import as_json
from pipelines.report.terminal import terminal_text
from terrain.errors import ConfigError, DataError
from terrain.logs.run_folders import data_digest, read_run, write_run


def test_the_runs_that_are_predicted_took_no_part(in_tracked, drive_all, tmp_path, monkeypatch):
    """Nine runs of three terrains in a folder, and what quickstart makes of them; kernels are compiled by then."""
    monkeypatch.setattr("pipelines.cli.quickstart._compiling_ahead", nullcontext)
    runs = drive_all(n_runs=3, duration_s=12.0)
    for each in runs:
        write_run(each, tmp_path / "data")
    result = run(Settings(data=tmp_path / "data", out=tmp_path / "out", name="held", n_jobs=1))
    assert result.held_out == ("ASPHALT_3",)
    assert {row.run_id for row in result.predict.windows} == {"ASPHALT_3"}
    assert result.predict.training_runs == ()
    info = read_model(result.train.model_uri).info
    training = [each for each in runs if each.run_id != "ASPHALT_3"]
    assert sorted(info.run_digests) == sorted(data_digest([each]) for each in training)
    assert info.data_digest == result.data_digest == data_digest(training)
    assert {each.run_id for each in result.crossval.per_run} == {each.run_id for each in training}
    assert [" --without ASPHALT_3" in step for step in result.commands] == [True, True, False]
    assert result.commands[-1].endswith(" --only ASPHALT_3")
    loaded, *_ = load(AlignedRunsSettings(data=tmp_path / "data", without=("ASPHALT_3",)))
    assert data_digest(loaded) == result.data_digest

    page = result.report_file.read_text()
    assert "neither trained nor evaluated on them" in page
    lines = terminal_text(result.report).splitlines()
    assert len(lines) <= 25
    assert page.count("whole runs held out") == 1  # once
    assert lines[0] == result.crossval.report.answer
    found = as_json(result)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["imported"]["n_runs"] == 9
    assert "crossval" not in found["train"]


def test_other_runs_in_the_folder_are_not_overwritten(make_run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_run(make_run("SNOW_1"), tmp_path / "data")
    write_run(make_run("ICE_1", seed=1), tmp_path / "out" / "runs")
    with pytest.raises(DataError, match="holds other runs than"):
        run(Settings(data=tmp_path / "data", out=tmp_path / "out"))


@pytest.mark.slow
def test_quickstart_needs_no_data(in_tracked, tmp_path, monkeypatch):
    monkeypatch.setattr("pipelines.slip.labelled.soil_names", lambda: ("grass", "tiles", "clay"))
    result = run(Settings(out=tmp_path / "out", name="from_nothing", runs_a_terrain=2, n_jobs=1))
    found = as_json(result)
    assert found["imported"] == {"out": str(tmp_path / "out" / "runs"), "n_runs": 6, "reused": False}
    assert len(found["slip"]) == 3
    assert result.report_file.read_text().count("steady slip of the simulated runs") == 1
    assert result.commands[0].startswith("terrain simulate --robot agrimaro --terrain all")
    assert (tmp_path / "out" / "report.html").read_text().count('class="plot"') >= 3
    assert len(terminal_text(result.report).splitlines()) <= 25
    assert read_run(tmp_path / "out" / "runs" / "grass_survey_01").robot == "agrimaro"


def test_runs_are_chosen_by_id(make_run, tmp_path):
    for number in range(3):
        write_run(make_run(f"a{number}", seed=number), tmp_path)

    def chosen(**options):
        return [each.run_id for each in load(AlignedRunsSettings(data=tmp_path, **options))[0]]

    assert chosen(only=("a2", "a0")) == chosen(without=("a1",)) == ["a0", "a2"]
    assert chosen(only=("a0", "a1"), without=("a1",)) == ["a0"]
    with pytest.raises(ConfigError, match="--without: there is no run 'b'; there are a0, a1, a2"):
        chosen(without=("b",))
    with pytest.raises(ConfigError, match="leave no run"):
        chosen(only=("a0",), without=("a0",))
