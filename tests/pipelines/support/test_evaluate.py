"""Support of held-out windows: a run never supports itself, and what was never driven is asked for first."""

import json

import numpy as np
import pytest

from features.motion import Motion
from pipelines.crossval.crossval import crossval
from pipelines.reporting.json_file import as_json
from pipelines.support.evaluate import Judged, held_out_support, support_report
from pipelines.support.screen import SHOWN_DRIVES, support_lines
from terrain.classify.support import SupportLevel

CLASSES = np.array(["ice", "mud"])


def judged(runs, right_when_seen=0.9, folds=3, seed=0):
    """Return held-out windows of runs ``(class, speed)``: right where another run drove the class so fast."""
    rng = np.random.default_rng(seed)
    number = np.repeat(np.arange(len(runs)), 20)
    terrain = np.array([runs[i][0] for i in number])
    speed = np.array([runs[i][1] for i in number]) + rng.normal(0, 0.005, len(number))
    motion = Motion(speed, np.zeros(len(number)), np.zeros(len(number)))
    fold = number % folds
    rows = [(0, np.flatnonzero(fold != each), np.flatnonzero(fold == each)) for each in range(folds)]
    found = Judged(motion, number.astype(str), terrain, CLASSES, np.full((1, len(number), 2), 0.5), rows, 2.0)
    seen = held_out_support(found).true_runs[0] > 0
    right = rng.random(len(number)) < np.where(seen, right_when_seen, 0.1)
    probability = np.where((terrain == "ice") == right, 0.9, 0.1)
    return found._replace(probability=np.stack([probability, 1 - probability], axis=1)[None])


RUNS = [(name, speed) for speed in (0.2, 0.6) for name in ("ice", "mud") for _ in range(5)]


def test_a_run_never_supports_itself():
    alone = judged([*RUNS, ("ice", 1.5)])
    found = held_out_support(alone)
    own = alone.run_id == str(len(RUNS))
    assert (found.true_runs[0, own] == 0).all()
    assert (found.true_runs[0, ~own] > 0).all()


def test_support_is_counted_among_the_training_windows_of_the_fold_only():
    one = judged(RUNS)
    _, train, test = one.splits[0]
    found = held_out_support(one).true_runs[0, test]
    for row, n_runs in zip(test, found, strict=True):
        near = np.abs(one.motion.speed_mps[train] - one.motion.speed_mps[row]) < 0.1
        same = one.terrain[train] == one.terrain[row]
        assert n_runs == len(np.unique(one.run_id[train][near & same]))


def test_the_terrain_that_was_driven_once_at_a_speed_is_asked_for_first():
    found = support_report(judged([*RUNS, ("ice", 1.5), ("mud", 1.5), ("mud", 1.5), ("mud", 1.5)]), 0)
    first = found.next_drives[0]
    assert (first.terrain, first.windows, first.support_runs) == ("ice", 20, 1.0)
    assert first.regime.startswith("straight at ")
    assert "1.5" in first.regime
    assert first.request == f"ice, {first.regime}, at least 2 runs of 20 s"
    gains = [drive.gain for drive in found.next_drives]
    assert gains == sorted(gains, reverse=True)
    never = found.accuracy.by_true_terrain[SupportLevel.NEVER]
    assert never.accuracy < 0.3
    assert never.windows_ratio == pytest.approx(20 / len(judged([*RUNS, *[("mud", 1.5)] * 4]).run_id))


def test_rows_count_every_window_once_and_name_what_was_never_driven():
    one = judged([*RUNS, ("ice", 1.5)])
    rows = support_report(one, 0).rows
    assert sum(row.windows for row in rows) == len(one.run_id)
    missing = [row for row in rows if row.windows == 0]
    assert [(row.terrain, row.n_runs, row.accuracy) for row in missing] == [("mud", 0, None)]


def test_windows_that_were_not_held_out_are_left_out():
    one = judged(RUNS)
    _, _, test = one.splits[0]
    probability = np.full_like(one.probability, np.nan)
    probability[:, test] = one.probability[:, test]
    found = support_report(one._replace(probability=probability, splits=one.splits[:1]), 0)
    assert sum(row.windows for row in found.rows) == len(test)


def test_a_class_of_one_fold_only_has_no_support_there():
    one = judged([*RUNS, ("ice", 0.2)])
    lone = one._replace(
        terrain=np.where(one.run_id == "20", "snow", one.terrain), classes=np.array(["ice", "mud", "snow"])
    )
    probability = np.concatenate([one.probability, np.zeros((1, len(one.run_id), 1))], axis=2)
    found = held_out_support(lone._replace(probability=probability))
    assert (found.true_runs[0, lone.run_id == "20"] == 0).all()
    assert not found.correct[0, lone.run_id == "20"].any()


def test_screen_and_json_have_the_drives_and_both_kinds_of_support(runs, settings):
    report = crossval(runs, settings())
    lines = list(support_lines(report.support))
    assert "near the motion of a window" in lines[0]
    assert sum(line.startswith("record next") for line in lines) == min(
        SHOWN_DRIVES, len(report.support.next_drives)
    )
    document = as_json(report)
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
