import numpy as np
import pytest

from terrain.classify.breakaway import breakaways, stretches
from terrain.classify.held_out import HeldOut
from terrain.records import Windows

START_S = 2.0 * np.arange(30)


def of_run(probability, start_s=START_S):
    """Return the stretches of a run of class 0."""
    classes = np.arange(probability.shape[1]).astype(str)
    return stretches("a", "0", classes, probability, start_s, 2.0)


def draw_run(seed, accuracy=0.85):
    """Return probabilities of a run of class 0 whose windows are wrong now and then."""
    rng = np.random.default_rng(seed)
    column = np.where(rng.random(30) < accuracy, 0, rng.integers(1, 4, 30))
    probability = rng.dirichlet(np.full(4, 0.5), 30) * 0.3
    probability[np.arange(30), column] += 0.7
    return probability


@pytest.mark.parametrize("first", [0, 9, 25])
def test_a_hidden_stretch_of_another_terrain_is_found(first):
    n_found = 0
    for seed in range(20):
        probability = draw_run(seed)
        probability[first : first + 5] = [0.05, 0.05, 0.85, 0.05]
        found = [each for each in of_run(probability) if each.looks_like == "2"]
        n_found += bool(found)
        if found:
            assert found[0].start_s <= 2.0 * first
            assert found[0].end_s >= 2.0 * first + 10.0
            assert found[0].label_probability < 0.2 < 0.5 < found[0].rest_probability
    assert n_found >= 19


def test_single_wrong_windows_are_no_stretch():
    # by chance, three in a row of one wrong class: 200 runs x 28 places x 3 classes x 0.05^3 = 2.1
    by_chance = 200 * 28 * 3 * (0.15 / 3) ** 3
    n_found = sum(len(of_run(draw_run(seed))) for seed in range(200))
    assert n_found < by_chance + 4 * by_chance**0.5


def test_a_run_that_is_wrong_throughout_does_not_break_away_from_itself():
    assert of_run(np.tile([0.05, 0.9, 0.05], (30, 1))) == []
    half = np.repeat([[0.3, 0.5, 0.2], [0.05, 0.9, 0.05]], 15, axis=0)
    assert of_run(half) == []


def test_windows_beside_a_pause_are_no_stretch_and_nothing_is_found_in_nothing():
    probability = np.repeat([[0.9, 0.1], [0.1, 0.9], [0.9, 0.1]], [13, 4, 13], axis=0)
    assert len(of_run(probability)) == 1
    paused = START_S + 60.0 * (np.arange(30) >= 15)
    assert of_run(probability, paused) == []
    assert of_run(np.empty((0, 2)), np.empty(0)) == []


def test_run_and_both_terrains_are_named():
    probability = np.repeat([[0.9, 0.1], [0.1, 0.9], [0.9, 0.1]], [13, 4, 13], axis=0)
    terrain, run_id = np.full(30, "ice"), np.full(30, "a", dtype=object)
    windows = Windows({}, {}, {}, 2.0, START_S, run_id, terrain)
    (found,) = breakaways(HeldOut.of_model(np.array(["ice", "snow"]), probability, terrain), windows)
    assert (found.run_id, found.label, found.looks_like) == ("a", "ice", "snow")
    assert (found.start_s, found.end_s) == (26.0, 34.0)
