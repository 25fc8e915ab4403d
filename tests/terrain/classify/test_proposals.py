"""What is worth a question, and the sequence of grounds that labels are proposed from."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.classify.proposals import Proposal, held_out_errors, questions, smoothed_classes, taken_from
from terrain.records import Windows


def test_doubt_is_of_what_is_improbable_unsupported_or_unknown():
    certain = Proposal("a", 0.0, 9.0, "ice", 0.99, 1.0, 0.0, 4)
    for changed in ({"confidence": 0.5}, {"supported_ratio": 0.0}, {"unknown_ratio": 1.0}):
        doubtful = certain._replace(run_id="b", **changed)
        assert questions([certain, doubtful], 1) == [1]
        assert not doubtful.certain(0.9)
    assert certain.certain(0.9)
    assert questions([certain], 5) == [0]
    assert questions([], 5) == []


def test_the_smoothed_sequence_is_the_best_of_all_of_them():
    rng = np.random.default_rng(0)
    probability, prior = rng.dirichlet(np.ones(3), 7), np.array([0.5, 0.3, 0.2])
    time_s = np.cumsum(rng.uniform(0.5, 8.0, 7))
    evidence = np.log(0.98 * probability / prior + 0.02)

    def score(path):
        kept = np.exp(-np.diff(time_s) / 20.0)
        same = np.diff(path) == 0
        return evidence[np.arange(7), path].sum() + np.log(np.where(same, kept, (1 - kept) / 2)).sum()

    every = np.array(np.meshgrid(*[range(3)] * 7)).reshape(7, -1).T
    best = every[np.argmax([score(path) for path in every])]
    assert smoothed_classes(probability, time_s, prior).tolist() == best.tolist()
    assert smoothed_classes(np.zeros((0, 3)), np.zeros(0), prior).tolist() == []


def windows_of(n_runs, n_windows=20):
    """Return windows of runs on two grounds, and the unit of each."""
    run = np.repeat([f"run {i}" for i in range(n_runs)], n_windows)
    ground = np.repeat(np.where(np.arange(n_runs) % 2, "ice", "mud"), n_windows)
    start_s = np.tile(np.arange(n_windows) * 2.0, n_runs)
    return Windows({}, {}, {}, 2.0, start_s, run.astype(object), ground.astype(object)), run


def held_out(windows, unit, wrong, confidence=0.97):
    """Return probabilities that are of the other ground in the units that are wrong."""
    right = (windows.terrain == "mud") ^ np.isin(unit, wrong)
    return np.where(right[:, None], [1 - confidence, confidence], [confidence, 1 - confidence])


def errors_of(n_runs, wrong, **options):
    windows, unit = windows_of(n_runs)
    given = ["ice", "mud"], np.array([0.5, 0.5])
    return held_out_errors(windows, held_out(windows, unit, wrong, **options), *given, unit)


def test_what_is_taken_over_holds_its_error_by_units_and_not_by_windows():
    assert taken_from(errors_of(148, []), 0.02) is None  # 2960 windows, all right
    assert taken_from(errors_of(150, []), 0.02).confidence == 0.7
    (lowest, *_, highest) = errors_of(60, ["run 3", "run 4", "run 5"])
    assert (lowest.n_units, lowest.unit, lowest.ratio) == (60, "run", 1.0)
    assert lowest.wrong == pytest.approx(0.05)
    assert lowest.wrong_upper == pytest.approx(0.124, abs=0.001)  # Clopper and Pearson of 3 in 60
    assert highest.confidence == 0.95
    windows, unit = windows_of(40)
    probability = held_out(windows, unit, ["run 3"], 0.8)  # the wrong one is less certain than most others
    probability[unit != "run 3"] = held_out(windows, unit, [])[unit != "run 3"]
    given = windows, probability, ["ice", "mud"], np.array([0.5, 0.5])
    assert taken_from(held_out_errors(*given, unit), 0.08).confidence == 0.9
    sessions = np.where(np.arange(unit.size) < unit.size // 2, "monday", "friday")
    assert taken_from(held_out_errors(*given, sessions), 0.5) is None  # two sessions show next to nothing


def test_a_ground_that_was_never_held_out_whole_is_not_taken_over():
    windows, unit = windows_of(31)
    alone = replace(windows, terrain=np.where(unit == "run 0", "sand", windows.terrain))
    probability = np.full((unit.size, 3), 0.01)
    probability[np.arange(unit.size), np.searchsorted(["ice", "mud", "sand"], alone.terrain.astype(str))] = (
        0.98
    )
    classes = ["ice", "mud", "sand"]
    found = held_out_errors(alone, probability, classes, np.full(3, 1 / 3), unit)
    assert found[0].terrains == ("ice", "mud")
    assert found[0].n_units == 30
    assert held_out_errors(alone, np.full((unit.size, 3), np.nan), classes, np.full(3, 1 / 3), unit) == ()


@pytest.mark.slow
def test_the_stated_error_holds_on_units_that_were_not_seen():
    rng, exceeded, taken = np.random.default_rng(0), 0, 0
    for _ in range(200):
        right = rng.beta(6, 0.4, 80)  # how certain a unit is of its ground, and how often it is right
        wrong = [f"run {i}" for i in np.flatnonzero(rng.random(80) > right)]
        windows, unit = windows_of(80, 4)
        confidence = np.repeat(np.maximum(right, 0.5), 4)[:, None]
        probability = np.abs(held_out(windows, unit, wrong, 1.0) - (1 - confidence))
        least = taken_from(held_out_errors(windows, probability, ["ice", "mud"], np.full(2, 0.5), unit), 0.1)
        if least is not None:
            new = rng.beta(6, 0.4, 2000)
            kept = new[np.maximum(new, 0.5) >= least.confidence]
            exceeded += (1 - kept).mean() > 0.1
            taken += 1
    assert exceeded / 200 <= 0.06
    assert taken > 100
