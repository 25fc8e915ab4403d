"""Support: runs near a motion by two routes, laws of the counts, and tables that are no tables."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.classify.support import (
    REACH,
    SPEED_STEP_MPS,
    SUPPORTED,
    YAW_STEP_RADPS,
    check_support,
    learn_support,
    support_of,
)
from terrain.errors import DataError

CLASSES = ["ice", "mud", "snow"]


def windows(seed, n=60):
    rng = np.random.default_rng(seed)
    terrain = rng.choice(CLASSES[:2], n)
    return rng.uniform(0, 1, n), rng.uniform(0, 1.5, n), terrain, rng.choice(list("abcdef"), n)


def counted(training, speed, yaw):
    """Count one by one the runs with a window at most REACH cells away."""
    found = np.zeros((len(speed), len(CLASSES)), dtype=int)
    for i, (v, w) in enumerate(zip(speed, yaw, strict=True)):
        for j, name in enumerate(CLASSES):
            runs = {
                run
                for other_v, other_w, terrain, run in zip(*training, strict=True)
                if terrain == name
                and abs(int(v / SPEED_STEP_MPS) - int(other_v / SPEED_STEP_MPS)) <= REACH
                and abs(int(w / YAW_STEP_RADPS) - int(other_w / YAW_STEP_RADPS)) <= REACH
            }
            found[i, j] = len(runs)
    return found


@given(st.integers(0, 2**32 - 1))
def test_the_table_counts_the_runs_that_are_near(seed):
    training = windows(seed)
    speed, yaw, *_ = windows(seed + 1, 20)
    table = learn_support(*training, CLASSES)
    np.testing.assert_array_equal(table.near_runs(speed, yaw), counted(training, speed, yaw))


@given(st.integers(0, 2**32 - 1))
def test_a_run_more_lowers_no_count_and_adds_at_most_one(seed):
    training = windows(seed)
    fewer = training[3] != "a"
    speed, yaw, *_ = windows(seed + 1, 20)
    many = learn_support(*training, CLASSES).near_runs(speed, yaw)
    few = learn_support(*(part[fewer] for part in training), CLASSES).near_runs(speed, yaw)
    assert set(np.unique(many - few)) <= {0, 1}


def test_every_training_window_is_supported_by_its_own_run():
    training = windows(3)
    near = learn_support(*training, CLASSES).near_runs(*training[:2])
    assert (near[np.arange(len(near)), [CLASSES.index(name) for name in training[2]]] >= 1).all()


def test_windows_of_one_run_count_once_however_many_they_are():
    table = learn_support(np.full(50, 0.5), np.zeros(50), np.full(50, "ice"), np.full(50, "a"), CLASSES)
    assert table.near_runs(np.array([0.5, 5.0]), np.array([np.nan, 0.0])).tolist() == [[1, 0, 0], [0, 0, 0]]


def test_what_is_faster_than_any_cell_is_still_counted():
    table = learn_support(np.array([1e6]), np.array([1e3]), np.array(["mud"]), np.array(["a"]), CLASSES)
    assert table.near_runs(np.array([30.0]), np.array([50.0])).tolist() == [[0, 1, 0]]


@pytest.mark.parametrize(
    "changed",
    [
        {"classes": ("ice", "mud", "sand")},
        *({"n_runs": counts} for counts in (None, [[1]], np.full((3, 1, 1), 0.5), np.full((3, 1, 1), -1))),
        *({"n_runs": np.zeros(shape, dtype=int)} for shape in ((3, 0, 1), (2, 1, 1), (3, 1))),
    ],
)
def test_a_table_of_another_form_is_refused_in_one_sentence(changed):
    table = learn_support(*windows(1), CLASSES)
    check_support(table, CLASSES)
    with pytest.raises(DataError, match=r"^the table of support [^.]*$"):
        check_support(replace(table, **changed), CLASSES)


@given(st.floats(0.5, 1), st.integers(0, 50))
def test_the_supported_probability_never_exceeds_the_probability_and_grows_with_runs(probability, n_runs):
    stated = np.array([[probability, 1 - probability]])
    few, more = (support_of(stated, np.array([[n, 99]])) for n in (n_runs, n_runs + 1))
    assert few.probability[0] < more.probability[0] <= probability
    assert few.supported[0] == (few.probability[0] >= SUPPORTED)
    if n_runs == 0:
        assert not few.supported[0]
