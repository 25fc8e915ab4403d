"""From nothing to a classifier: simulated, filtered, cut, learned, reported."""

import json
import re

import numpy as np
import pytest

from pipelines.crossval.crossval import crossval
from pipelines.crossval.settings import CrossvalSettings
from pipelines.quickstart.quickstart import quickstart
from pipelines.quickstart.settings import QuickstartSettings
from pipelines.reporting.json_file import as_json
from terrain.errors import DataError
from terrain.estimation.labelled import labelled_runs
from terrain.logs.read import read_run
from terrain.terramechanics.soil import soil_names


@pytest.fixture(scope="module")
def labelled():
    return labelled_runs(seed=3, runs_a_terrain=3)


@pytest.mark.slow
def test_every_terrain_is_driven_and_its_slip_is_near_the_truth(labelled):
    runs, rows, example = labelled
    assert [run.terrains for run in runs] == [(name,) for name in soil_names() for _ in range(3)]
    assert [row.terrain for row in rows] == list(soil_names())
    assert all({"slip", "estimator", "imu", "wheels", "truth"} <= set(run.streams) for run in runs)
    for row in rows:
        assert row.slip_rmse < 0.01
    assert example.run.terrains == ("grass",)
    driven = {run.run_id: np.abs(run.streams["truth"].channel("speed_x_mps")).max() for run in runs}
    assert np.ptp(list(driven.values())) > 0.1


@pytest.mark.slow
def test_terrain_is_classified_on_held_out_runs_but_not_too_well_to_be_true(labelled):
    runs, _, _ = labelled
    report = crossval(runs, CrossvalSettings(repeats=1, extras=False, n_jobs=2))
    assert 2.5 / 8 < report.accuracy < 0.95


@pytest.mark.slow
def test_quickstart_needs_no_data(in_tracked, tmp_path):
    settings = CrossvalSettings(repeats=1, extras=False, n_jobs=1, signal_sets=("currents", "slip"))
    asked = QuickstartSettings(out=tmp_path / "out", name="from_nothing")
    result = as_json(quickstart(asked, evaluation=settings, runs_a_terrain=2))
    assert json.loads(json.dumps(result)) == result
    assert result["imported"] == {"out": str(tmp_path / "out" / "runs"), "n_runs": 16, "reused": False}
    assert len(result["slip"]) == len(result["consistency"]) == 8
    assert result["commands"][0].startswith("terrain simulate --robot agrimaro --terrain all")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "From logs to slip" in page
    assert "How far the filter's uncertainty can be believed" in page.replace("&#39;", "'")
    assert len(re.findall("<figure", page)) >= 4
    run = read_run(tmp_path / "out" / "runs" / "grass_survey_01")
    assert run.robot == "agrimaro"

    with pytest.raises(DataError, match="holds other runs than this simulation"):
        quickstart(asked.with_(seed=9, n_jobs=1), runs_a_terrain=2)
