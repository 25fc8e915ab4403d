"""Simulated labelled runs, with the slip that a filter estimates."""

import numpy as np
import pytest

from pipelines.slip.labelled import labelled_runs
from terrain.terramechanics.soil import soil_names


@pytest.mark.slow
def test_every_terrain_is_driven_and_its_slip_is_near_the_truth():
    runs, rows, example = labelled_runs(seed=3, runs_a_terrain=2)
    assert [each.terrains for each in runs] == [(name,) for name in soil_names() for _ in range(2)]
    assert [row.terrain for row in rows] == list(soil_names())
    assert all({"slip", "estimator", "imu", "wheels", "truth"} <= set(each.streams) for each in runs)
    assert all(row.slip_rmse < 0.01 for row in rows)
    assert example.run.terrains == ("grass",)
    driven = {each.run_id: np.abs(each.streams["truth"].channel("speed_x_mps")).max() for each in runs}
    assert np.ptp(list(driven.values())) > 0.1
