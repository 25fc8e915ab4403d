"""The thesis' protocol: as many windows as it has, whole runs held out, one seed the same windows."""

import numpy as np
import pytest

from pipelines.stiffness.protocol import (
    N_CLASSES,
    N_WINDOWS,
    HeldOutWindows,
    classify_soils,
    level_result,
    soil_responses,
    thesis_windows,
)
from terrain.robots import load_robot
from terrain.terramechanics.soil import soil_names


@pytest.fixture(scope="module")
def robot():
    return load_robot("agrimaro")


@pytest.fixture(scope="module")
def windows(robot):
    return thesis_windows(robot, 4, 2)


def test_there_are_208_windows_of_2_s_that_do_not_overlap(windows):
    assert (len(windows), windows.length_s) == (N_WINDOWS, 2.0)
    names, counts = np.unique(windows.terrain.astype(str), return_counts=True)
    assert tuple(names) == soil_names()
    assert set(counts) == {N_WINDOWS // N_CLASSES}
    for run_id in np.unique(windows.run_id.astype(str)):
        starts_s = np.sort(windows.start_s[windows.run_id == run_id])
        assert np.all(np.diff(starts_s) > 2.0 - 1e-6)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_windows(windows, robot):
    again = thesis_windows(robot, 4, 2)
    assert all(
        np.array_equal(again.values[name], values, equal_nan=True) for name, values in windows.values.items()
    )


@pytest.mark.slow
def test_held_out_runs_are_recognised_above_chance_and_not_above_windows_dealt_at_random(robot):
    found = classify_soils(robot, 4, 2)
    chance, error = 1 / N_CLASSES, np.sqrt(1 / N_WINDOWS) / 2
    assert found.by_run.correct.mean() > chance + 3 * error
    assert found.at_random.correct.mean() > found.by_run.correct.mean() - 3 * error
    low, high = found.by_run.interval(0)
    assert low < found.by_run.correct.mean() < high
    assert np.allclose(found.by_run.probability.sum(axis=1), 1.0)


def test_windows_taken_for_another_terrain_of_the_level_cost_a_quarter(robot):
    classes = np.array(soil_names())
    true = np.arange(len(classes))
    swap = {"asphalt": "tiles", "tiles": "asphalt"}
    predicted = [classes.tolist().index(swap.get(name, name)) for name in classes]
    found = HeldOutWindows(classes, np.eye(len(classes))[predicted], true, classes)
    level = level_result(found, soil_responses(robot))
    assert (level.accuracy, level.soft_hard_ratio) == (1.0, 0.0)
    assert level.cost == pytest.approx(2 * 0.25 / len(classes))
    assert found.recall()["tiles"] == 0.0
