"""Training coverage of held-out windows: a run never covers itself, and what was never driven is asked for first."""

import json
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from features.motion import Motion
from pipelines.learn.coverage import coverage_of, held_out_coverage
from pipelines.learn.crossval import crossval
from pipelines.learn.evaluate import FoldResult, HeldOut
from pipelines.learn.protocols import Fold, Samples
from pipelines.report.json_file import as_json
from terrain.classify.support import SupportLevel
from terrain.records import Windows

CLASSES = np.array(["ice", "mud"])


class Evaluated(NamedTuple):
    held_out: HeldOut
    samples: Samples
    motion: Motion

    def coverage(self):
        return coverage_of(*self, 0)

    def runs_near(self):
        return held_out_coverage(*self).true_runs[0]


def with_probability(held_out, probability):
    results = [each._replace(probability=probability[0, each.fold.test]) for each in held_out.results]
    return held_out._replace(probability=probability, results=results)


def evaluated(runs, right_when_seen=0.9, folds=3, seed=0):
    """Return held-out windows of runs ``(class, speed)``: right where another run drove the class so fast."""
    rng = np.random.default_rng(seed)
    number = np.repeat(np.arange(len(runs)), 20)
    n = len(number)
    terrain = np.array([runs[i][0] for i in number])
    speed = np.array([runs[i][1] for i in number]) + rng.normal(0, 0.005, n)
    motion = Motion(speed, np.zeros(n), np.zeros(n))
    run_id = number.astype(str).astype(object)
    windows = Windows({}, {}, {}, 2.0, np.zeros(n), run_id, terrain.astype(object))
    samples = Samples(windows, {}, run_id, 1)
    fold = number % folds
    parts = [Fold(0, k, np.flatnonzero(fold != k), np.flatnonzero(fold == k)) for k in range(folds)]
    results = [FoldResult(part, np.full((len(part.test), 2), 0.5), {}) for part in parts]
    held_out = HeldOut(CLASSES, np.full((1, n, 2), 0.5), fold[None], terrain, results)
    seen = held_out_coverage(held_out, samples, motion).true_runs[0] > 0
    right = rng.random(n) < np.where(seen, right_when_seen, 0.1)
    first = np.where((terrain == "ice") == right, 0.9, 0.1)
    return Evaluated(with_probability(held_out, np.stack([first, 1 - first], axis=1)[None]), samples, motion)


RUNS = [(name, speed) for speed in (0.2, 0.6) for name in ("ice", "mud") for _ in range(5)]


def test_a_run_never_supports_itself():
    alone = evaluated([*RUNS, ("ice", 1.5)])
    near, own = alone.runs_near(), alone.samples.run_id == str(len(RUNS))
    assert (near[own] == 0).all()
    assert (near[~own] > 0).all()


def test_coverage_is_counted_among_the_training_windows_of_the_fold_only():
    one = evaluated(RUNS)
    _, _, train, test = one.held_out.results[0].fold
    speed, terrain, run_id = one.motion.speed_mps, one.samples.terrain, one.samples.run_id
    for row, n_runs in zip(test, one.runs_near()[test], strict=True):
        near = (np.abs(speed[train] - speed[row]) < 0.1) & (terrain[train] == terrain[row])
        assert n_runs == len(np.unique(run_id[train][near]))


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
    never = found.accuracy.by_true_terrain[SupportLevel.NEVER]
    assert never.accuracy < 0.3
    assert never.windows_ratio == pytest.approx(20 / len(one.samples.run_id))


def test_rows_count_every_window_once_and_name_what_was_never_driven():
    one = evaluated([*RUNS, ("ice", 1.5)])
    rows = one.coverage().rows
    assert sum(row.windows for row in rows) == len(one.samples.run_id)
    missing = [row for row in rows if row.windows == 0]
    assert [(row.terrain, row.n_runs, row.accuracy) for row in missing] == [("mud", 0, None)]


def test_windows_that_were_not_held_out_are_left_out():
    one = evaluated(RUNS)
    test = one.held_out.results[0].fold.test
    probability = np.full_like(one.held_out.probability, np.nan)
    probability[:, test] = one.held_out.probability[:, test]
    part = one.held_out._replace(probability=probability, results=one.held_out.results[:1])
    assert sum(row.windows for row in one._replace(held_out=part).coverage().rows) == len(test)


def test_a_class_of_one_fold_only_has_no_coverage_there():
    one = evaluated([*RUNS, ("ice", 0.2)])
    alone = one.samples.run_id == "20"
    terrain = np.where(alone, "snow", one.samples.terrain)
    windows = replace(one.samples.windows, terrain=terrain.astype(object))
    probability = np.concatenate([one.held_out.probability, np.zeros((1, len(terrain), 1))], axis=2)
    held_out = with_probability(one.held_out._replace(classes=np.array(["ice", "mud", "snow"])), probability)
    found = held_out_coverage(held_out, one.samples._replace(windows=windows), one.motion)
    assert (found.true_runs[0, alone] == 0).all()
    assert not found.correct[0, alone].any()


def test_json_has_the_drives_and_both_kinds_of_coverage(runs, settings):
    document = as_json(crossval(runs, settings()))
    json.dumps(document, allow_nan=False)
    assert set(document["support"][0]) == {"class", "regime", "windows", "n_runs", "accuracy"}
    assert [row["support"] for row in document["accuracy_by_support"]] == [
        level.value for level in SupportLevel
    ]
    assert sum(row["windows_ratio"] for row in document["accuracy_by_support"]) == pytest.approx(1)


def test_without_wheels_support_is_unknown_and_the_reason_is_stated(runs, settings):
    report = crossval(runs, settings(steady=False, signal_sets=("imu",)))
    assert report.support is None
    assert any("no wheel speed" in note for note in report.notes)
    assert "support" not in as_json(report)


@pytest.mark.slow
def test_runs_on_both_sides_have_no_support(runs, settings):
    assert crossval(runs, settings(protocol="published")).support is None
