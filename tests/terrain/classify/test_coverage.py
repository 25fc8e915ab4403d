"""Training coverage of held-out windows: a run never covers itself, and what was never driven is asked for first."""

from typing import NamedTuple

import numpy as np
import pytest

from terrain.classify.folds import Fold
from terrain.classify.held_out import FoldResult, HeldOut
from terrain.classify.next_drives import coverage_of, held_out_support
from terrain.classify.regimes import Motion
from terrain.classify.support import SupportLevel

RUNS = [(name, speed) for speed in (0.2, 0.6) for name in ("ice", "mud") for _ in range(5)]


class Evaluated(NamedTuple):
    held_out: HeldOut
    run_id: np.ndarray
    motion: Motion

    def coverage(self):
        return coverage_of(*self, 2.0, 0)

    def runs_near(self):
        return held_out_support(*self).true_runs[0]


def evaluated(runs, folds=3, seed=0):
    """Return 20 held-out windows a run ``(class, speed)``: right mostly where another run drove the class so fast."""
    rng, number = np.random.default_rng(seed), np.repeat(np.arange(len(runs)), 20)
    terrain, n = np.array([runs[i][0] for i in number]), len(number)
    speed = np.array([runs[i][1] for i in number]) + rng.normal(0, 0.005, n)
    fold, run_id = number % folds, number.astype(str)

    def of(probability):
        results = []
        for k in range(folds):
            test = np.flatnonzero(fold == k)
            results.append(FoldResult(Fold(0, k, np.flatnonzero(fold != k), test), probability[test], {}))
        return Evaluated(HeldOut.of_folds(results, terrain), run_id, Motion(speed, np.zeros(n), np.zeros(n)))

    classes = np.unique(terrain)
    seen = of(np.full((n, len(classes)), 0.5)).runs_near() > 0
    right = rng.random(n) < np.where(seen, 0.9, 0.1)
    answer = np.where(right, np.searchsorted(classes, terrain), (np.searchsorted(classes, terrain) + 1) % 2)
    return of(np.where(np.arange(len(classes)) == answer[:, None], 0.9, 0.1))


def test_coverage_is_counted_among_other_runs_of_the_fold_only():
    one = evaluated([*RUNS, ("ice", 1.5)])
    near, own = one.runs_near(), one.run_id == str(len(RUNS))
    assert (near[own] == 0).all()  # a run never supports itself
    assert (near[~own] > 0).all()
    terrain = one.held_out.truth
    for _, _, train, test in (result.fold for result in one.held_out.results):
        for row in test:
            beside = np.abs(one.motion.speed_mps[train] - one.motion.speed_mps[row]) < 0.1
            assert near[row] == len(np.unique(one.run_id[train][beside & (terrain[train] == terrain[row])]))


def test_the_terrain_that_was_driven_once_at_a_speed_is_asked_for_first():
    one = evaluated([*RUNS, ("ice", 1.5), ("mud", 1.5), ("mud", 1.5), ("mud", 1.5)])
    found = one.coverage()
    first = found.next_drives[0]
    assert (first.terrain, first.windows, first.support_runs) == ("ice", 20, 1.0)
    assert first.regime.startswith("straight at ")
    assert "1.5" in first.regime
    assert first.request == f"ice, {first.regime}, at least 2 runs of 20 s"
    gains = [drive.gain for drive in found.next_drives]
    assert gains == sorted(gains, reverse=True)
    assert [row["support"] for row in found.accuracy_by_support] == [level.value for level in SupportLevel]
    never = found.accuracy_by_support[0]
    assert never["accuracy"] < 0.3
    assert never["windows_ratio"] == pytest.approx(20 / len(one.run_id))


def test_rows_count_every_window_once_and_name_what_was_never_driven():
    one = evaluated([*RUNS, ("ice", 1.5)])
    rows = one.coverage().support
    assert sum(row.windows for row in rows) == len(one.run_id)
    missing = [row.as_json() for row in rows if row.windows == 0]
    assert [(row["class"], row["n_runs"], row["accuracy"]) for row in missing] == [("mud", 0, None)]


def test_windows_that_were_not_held_out_are_left_out():
    one = evaluated(RUNS)
    held_out = HeldOut.of_folds(one.held_out.results[:1], one.held_out.truth)
    rows = one._replace(held_out=held_out).coverage().support
    assert sum(row.windows for row in rows) == len(one.held_out.results[0].fold.test)


def test_a_class_of_one_fold_only_has_no_coverage_there():
    one = evaluated([*RUNS, ("snow", 0.2)])
    alone = one.held_out.truth == "snow"
    assert (one.runs_near()[alone] == 0).all()
