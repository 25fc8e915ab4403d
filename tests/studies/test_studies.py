"""Every study by its runner; small ones give the known results; measured figures are made from their records."""

import doctest
import json
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from pipelines.report.results import Result
from pipelines.report.tree import Report
from studies import (
    ablation,
    consistency,
    figures,
    intervals,
    labels,
    long_drives,
    mutants,
    scale,
    trials,
    watching,
)
from studies.__main__ import STUDIES, main
from studies.blind_trials.drives import rich_drives
from studies.blind_trials.trial import Row, hidden_runs
from terrain.bootstrap import proportion_interval
from terrain.errors import ConfigError, DataError
from terrain.logs.run_folders import write_run
from terrain.logs.schema import SIGNAL_SETS
from terrain.robots import load_robot

ROOT = Path(__file__).parents[2]
ROBOT = load_robot("agrimaro")


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_is_one_file_like_a_command(name):
    module = import_module(f"studies.{name.replace('-', '_')}")
    assert module.EXAMPLE.startswith(f"python tests/studies {name}")
    assert isinstance(module.Settings, type)
    assert callable(module.run)
    assert callable(module.report)
    assert doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE).failed == 0


def test_the_runner_lists_studies_and_names_a_mistake(capsys):
    assert main([]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in STUDIES)
    assert main(["nothing"]) == 2
    assert "there is no study 'nothing'; there are slip, " in capsys.readouterr().err
    assert main(["trials", "--runs", "2"]) == 2
    assert capsys.readouterr().err == "error: --runs is 2; at least 3 are required, to hold some out\n"


def test_nothing_of_the_packages_imports_studies_or_examples():
    pattern = re.compile(r"^\s*(from|import) (studies|tests|examples|claims)\b", re.MULTILINE)
    for package in ("terrain", "features", "pipelines"):
        for file in (ROOT / package).rglob("*.py"):
            assert not pattern.search(file.read_text(encoding="utf-8")), file


# -- measured figures --------------------------------------------------------------------------------------


def test_the_pages_of_measured_figures_are_what_their_records_give():
    tables = figures.read_tables(ROOT / "docs" / "measured")
    for page, text in figures.pages(figures.Settings(), tables).items():
        assert page.read_text(encoding="utf-8") == text, page
    records = [record for table in tables for record in table["records"]]
    assert len(records) >= 100
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d", record["date"]) for record in records)
    assert sum("readme" in record for record in records) == 6


def test_a_record_without_its_command_is_refused(tmp_path):
    record = {"figure": "depth", "measured": {"value": "1 m"}, "date": "2026-01-01", "commit": "abc"}
    table = {"title": "Moor", "columns": ["value"], "records": [record]}
    (tmp_path / "moor.json").write_text(json.dumps(table))
    with pytest.raises(DataError, match=r"moor\.json: record 'depth' has no command"):
        figures.read_tables(tmp_path)


def test_a_table_stands_between_its_marks():
    text = f"before\n<!-- measured: depth -->\nold\n{figures.END}\nafter"
    assert figures.with_table(text, "new", "depth") == text.replace("old", "new")
    with pytest.raises(DataError, match="lacks <!-- measured: width -->"):
        figures.with_table(text, "new", "width")


# -- mutants -----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "mutant",
    [*mutants.read_mutants(), *mutants.read_mutants(mutants.TERRAIN_FILE)],
    ids=lambda mutant: mutant.name,
)
def test_every_mutant_has_one_place_and_its_tests(mutant):
    text = (ROOT / mutant.file).read_text(encoding="utf-8")
    assert mutants.mutated(text, mutant) != text
    assert mutant.tests
    assert all((ROOT / test.partition("::")[0]).exists() for test in mutant.tests)


def test_a_mutant_is_caught_by_a_test_that_fails_and_the_tree_is_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # it starts three times as fast
    (tmp_path / "half.py").write_text("def half(x):\n    return x / 2\n")
    (tmp_path / "test_half.py").write_text("import half\n\ndef test_half():\n    assert half.half(4) == 2\n")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow\npythonpath = .\n")
    double = mutants.Mutant("double", "doubles", "half.py", "x / 2", "x * 2", ("test_half.py",))
    assert mutants.is_caught(double, tmp_path)[0]
    assert not mutants.is_caught(double._replace(new="x * 0.5"), tmp_path)[0]
    with pytest.raises(ValueError, match="holds its text 0 times"):
        mutants.is_caught(double._replace(old="x / 3"), tmp_path)
    assert (tmp_path / "half.py").read_text() == "def half(x):\n    return x / 2\n"


# -- slip, filters, trials, labels -------------------------------------------------------------------------


@pytest.mark.slow
def test_intervals_contain_the_true_peaks_of_learned_slip():
    """Four cases at 90 %: fewer than two inside is less than one time in two hundred."""
    (row,) = intervals.run(intervals.Settings(repeats=4, seed=1400, uses="slip-peak")).rows
    assert row.coverage >= 2 / 4
    assert row.error_median < 0.03


@pytest.mark.slow
def test_every_use_of_intervals_is_drawn_and_identified():
    uses = [use for use in intervals.USES if use != "slip-peak"]
    rows = intervals.run(intervals.Settings(repeats=2, seed=1500, uses=",".join(uses))).rows
    assert {row.use for row in rows} == set(uses)
    assert np.mean([row.coverage for row in rows]) > 0.8


def test_the_interval_of_a_probability_is_exact():
    assert proportion_interval(0, 5) == (0.0, pytest.approx(1 - 0.025 ** (1 / 5)))
    assert proportion_interval(5, 5)[0] == pytest.approx(0.025 ** (1 / 5))
    assert proportion_interval(90, 100) == pytest.approx((0.824, 0.951), abs=1e-3)


def test_consistency_has_a_mean_and_an_interval_of_every_group_on_every_terrain():
    rows = consistency.consistency_by_terrain(ROBOT, 41, 1, terrains=("tiles", "tilled_loam"))
    assert [row.terrain for row in rows] == ["tiles", "tilled_loam"]
    for row in rows:
        assert list(row.nees) == list(consistency.GROUPS)
        assert row.n_runs == row.slip_coverage.n == len(consistency.SCENARIOS)
        for value in (*row.nees.values(), row.slip_coverage):
            assert value.ci[0] < value.mean < value.ci[1]
        assert 0.3 < row.slip_coverage.mean <= 1.0


@pytest.mark.slow
def test_yaw_and_uncertainty_of_drives_of_several_minutes():
    found = long_drives.run(long_drives.Settings(seed=21, runs=2, minutes=200 / 60, n_jobs=1))
    assert [drive.terrain for drive in found.drives] == ["asphalt", "clay"]
    for drive in found.drives:
        assert 0.0 < drive.yaw_error_rad < 0.02
        assert 0.0 < drive.blind_yaw_error_rad < 0.1
        assert 0.85 < drive.slip_coverage <= 1.0
    assert "rad after 60 s" in found.report.answer


def test_a_drive_without_a_minute_before_the_loss_is_refused():
    with pytest.raises(ConfigError, match="too short"):
        long_drives.drive_long(ROBOT, "grass", 0, 1, 90.0)


@pytest.mark.slow
def test_a_few_blind_trials_come_out_right(capsys, tmp_path):
    file = tmp_path / "trials.json"
    words = f"--n 2 --seed 1 --rows none,strong --runs 4 --jobs 1 --json {file}".split()
    assert main(["trials", *words]) == 0
    assert "4 trials of 4 runs, seed 1" in capsys.readouterr().out
    found = json.loads(file.read_text())
    assert found["table"]["none: false alarms"]["hits"] == 0
    assert found["table"]["strong: named"]["hits"] == 2
    assert found["table"]["strong: wrongly named"]["hits"] == 0
    assert [trial["row"] for trial in found["trials"]] == ["none", "none", "strong", "strong"]


@pytest.mark.parametrize(
    ("settings", "options", "message"),
    [
        (trials.Settings, {"rows": "none,weak"}, "--rows is 'none,weak'; some of none,strong,ladder,"),
        (trials.Settings, {"rows": ","}, "--rows is ''"),
        (trials.Settings, {"rows": "none,none"}, "each once"),
        (trials.Settings, {"rows": "all"}, ",".join(Row)),
        *((scale.Settings, {"workers": workers}, "--workers is") for workers in ("0", "1,1", "", "x")),
    ],
)
def test_settings_that_are_not_accepted_are_one_sentence(settings, options, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        settings(**options)


# -- scale -------------------------------------------------------------------------------------------------


def test_a_generated_run_depends_on_seed_and_number_only_and_has_the_colour_of_its_terrain():
    for seed, same in ((3, True), (4, False)):
        one, two = (scale.generated_run(each, 7).streams["imu"].values for each in (3, seed))
        assert np.array_equal(one, two) is same
    for number, (_, colour) in enumerate(scale.TERRAINS.values()):
        gyro = [scale.generated_run(0, number + 4 * k).streams["imu"].values[:, 0] for k in range(8)]
        gyro = np.concatenate(gyro)
        assert np.corrcoef(gyro[1:], gyro[:-1])[0, 1] == pytest.approx(colour, abs=5 / np.sqrt(len(gyro)))


@pytest.mark.slow
def test_few_runs_are_measured_and_nothing_is_left(tmp_path):
    result = scale.run(scale.Settings(runs=20, workers=(1,), scratch=tmp_path))
    assert [point.n_runs for point in result.points] == [2, 6, 20]
    assert all(point.seconds > 0 and point.peak_mb > 0 for point in result.points)
    assert result.speed_up == {}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_label_strategies_are_compared_on_held_out_runs(tmp_path):
    from terrain.logs.run_folders import write_run

    for number in range(24):
        write_run(scale.generated_run(1, number), tmp_path / "runs")
    found = labels.run(labels.Settings(data=tmp_path / "runs", repeats=1, n_jobs=1))
    assert [row.name for row in found.rows] == list(labels.STRATEGIES)
    first, *others = [row.n_labelled for row in found.rows]
    assert first == 4.0
    assert min(others) >= 2 * first
    assert "points against as many drawn" in found.report.answer


@pytest.mark.slow
def test_a_signal_set_that_tells_terrains_is_worth_what_is_lost_without_it(tmp_path, monkeypatch, runs):
    """Of drawn runs whose terrain is in the IMU, paired by run; a set that is not there is refused."""
    from terrain.logs.run_folders import write_run

    for run in runs:
        write_run(run, tmp_path / "drawn")
    monkeypatch.setitem(ablation.SETS, "drawn", ablation.Source({"drawn": "husky"}, "slip"))
    asked = ablation.Settings(data=tmp_path, sets=("drawn",), recipes=("svm",), repeats=1, n_jobs=1)
    found = ablation.run(asked)
    assert found.units == {"drawn": "144 windows of 12 runs"}
    rows = {row.signals: row.found for row in found.rows}
    assert set(rows) == {"plain", *(f"without {name}" for name in SIGNAL_SETS)}
    assert len({row.a for row in rows.values()}) == 1
    assert rows["without imu"].difference < -0.1
    assert rows["without slip"].difference == 0.0  # it is NaN of a robot that nothing measures from outside
    assert "points on drawn (svm)" in found.report.answer
    with pytest.raises(ConfigError, match="there is no set 'moon'; there are borealtc, vulpi, "):
        ablation.run(ablation.Settings(sets=("moon",)))


def test_what_is_not_accepted_is_exit_code_1(monkeypatch):
    class Bad(Result):
        refused = "memory grew"
        report = Report("soak", "bad")

        def as_json(self):
            return {}

    monkeypatch.setattr("studies.soak.run", lambda settings, progress: Bad())
    assert main(["soak"]) == 1


@pytest.mark.slow
def test_watched_runs_agree_until_they_are_changed(tmp_path):
    drives = rich_drives(np.random.default_rng(3), 9, 30.0)
    for run in hidden_runs(load_robot("husky"), drives, np.random.SeedSequence(3), {"camera_yaw_rad": 0.04}):
        write_run(run, tmp_path)
    found = watching.run(watching.Settings(data=tmp_path, robot="husky", hours=1.0))
    rows = {row.change: row for row in found.rows}
    assert found.n_quiet == 6
    assert rows["none"].alarms == 0
    assert rows["none"].compared_s >= 70.0
    assert rows["gyro +20 %"].first_alarm_s < rows["gyro +10 %"].first_alarm_s < np.inf
    assert "turns" in rows["gyro +20 %"].says
