"""Figures of hand-made predictions."""

from types import SimpleNamespace

import numpy as np
import pytest

from terrain.classify.folds import Fold
from terrain.classify.held_out import FoldResult, HeldOut, held_out_figures
from terrain.records import Windows

NONE = np.empty(0, dtype=int)


def figures(run_ids, start_s, y, answers, folds):
    """Return figures of windows of 1 s, of which ``answers`` (repeats, n) are predicted, at 0.8."""
    windows = Windows(
        {}, {}, {}, 1.0, np.asarray(start_s, float), np.array(run_ids, dtype=object), np.array(y)
    )
    results = []
    for fold in folds:
        predicted = np.asarray(answers)[fold.repeat][fold.test]
        results.append(
            FoldResult(fold, np.where(predicted[:, None] == np.array(["ice", "mud"]), 0.8, 0.2), {})
        )
    held_out = HeldOut.of_folds(results, np.array(y))
    return SimpleNamespace(**held_out_figures(held_out, windows, windows.run_id, 0))


def test_figures_of_hand_made_predictions():
    y = ["ice"] * 4 + ["mud"] * 4
    runs, start_s = ["a", "a", "b", "b", "c", "c", "d", "d"], [0, 1] * 4
    answers = [
        ["ice", "ice", "ice", "mud", "mud", "mud", "mud", "mud"],  # 7 of 8
        ["ice", "ice", "mud", "mud", "mud", "mud", "ice", "mud"],  # 5 of 8
    ]
    folds = [Fold(r, k, NONE, np.arange(8)[k * 4 : k * 4 + 4]) for r in range(2) for k in range(2)]
    found = figures(runs, start_s, y, answers, folds)
    assert found.accuracy_per_repeat == (7 / 8, 5 / 8)
    assert found.accuracy == 0.75
    assert found.accuracy_spread == pytest.approx(np.std([7 / 8, 5 / 8], ddof=1))
    assert (found.n_windows, found.n_runs, found.repeats) == (8, 4, 2)
    assert found.confusion == ((5, 3), (1, 7))
    assert found.per_class["ice"].recall == 5 / 8
    assert [fold.accuracy for fold in found.folds] == [0.75, 1.0, 0.5, 0.75]
    # All are equally confident: 0.8 stated, 7/8 and 5/8 right; every window its own bin of mass one.
    assert found.ece == pytest.approx(np.mean([(7 * 0.2 + 1 * 0.8) / 8, (5 * 0.2 + 3 * 0.8) / 8]))
    # Votes are of one or two windows of equal weight: only 'd' could be outvoted, in the second repeat.
    per_run = {row.run_id: row for row in found.per_run}
    assert (per_run["b"].accuracy, per_run["b"].mistaken_for) == (0.25, "mud")
    low, high = found.accuracy_ci
    assert 0.25 <= low < found.accuracy < high <= 1.0
    assert figures(runs, start_s, y, answers[:1], folds[:2]).accuracy_spread is None


@pytest.mark.parametrize(
    ("runs", "first", "answers", "accuracy", "size"),
    [
        # run x1 in fold 12 and run x11 in fold 2: both would be x112 if names and numbers were just joined
        (["x1"] * 3 + ["x11"] * 3, 3, ["ice"] * 3 + ["mud"] * 3, 1.0, 2.0),
        # blocks of one run: a vote would otherwise reach into the block that another fold tested
        (["a"] * 6 + ["b"], 3, ["mud"] * 3 + ["ice"] * 3 + ["mud"], 4 / 7, 13 / 7),
    ],
)
def test_votes_stay_within_a_run_and_a_fold(runs, first, answers, accuracy, size):
    y = ["ice"] * 3 + ["mud"] * 3 if "x1" in runs else ["ice"] * 6 + ["mud"]
    folds = [Fold(0, 12, NONE, np.arange(first)), Fold(0, 2, NONE, np.arange(first, len(y)))]
    found = figures(runs, range(len(y)), y, [answers], folds)
    assert (found.vote_accuracy, found.vote_windows) == (accuracy, pytest.approx(size))
