"""Support of held-out windows, fold by fold, and the drives that would add most to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from features.motion import Motion
from pipelines.support.results import NextDrive, SupportReport, SupportRow
from terrain.classify.next_drives import ADDED_RUNS, Cells, expected_gain, fit_growth
from terrain.classify.regimes import Regimes, learn_regimes
from terrain.classify.support import SupportTable, learn_support, support_of
from terrain.classify.support_figures import HeldOutSupport, support_accuracy
from terrain.records import Array

RUN_WINDOWS, MIN_RUN_S = 10, 20.0
"""Windows that a run to be recorded should give, as many as the prior of a cell, and its least length."""

MAX_DRIVES = 20
MIN_GAIN = 5e-5
"""A drive that is expected to gain less is not named: it would be shown as 0.00 %."""


class Judged(NamedTuple):
    """Held-out windows and what a classifier made of them.

    Parameters
    ----------
    motion, run_id, terrain : of n windows
    classes : (k,)
    probability : (repeats, n, k); NaN where a window was not held out
    splits : (repeat, train, test) of each fold
    window_s : length of a window
    """

    motion: Motion
    run_id: Array
    terrain: Array
    classes: Array
    probability: Array
    splits: Sequence[tuple[int, Array, Array]]
    window_s: float


def table_of(motion: Motion, terrain: Array, run_id: Array, classes: Sequence[str]) -> SupportTable:
    """Return the table of support that training windows give."""
    return learn_support(motion.speed_mps, motion.yaw_rate_radps, terrain, run_id, classes)


def support_report(judged: Judged, seed: int) -> SupportReport:
    """Return the support of held-out windows.

    Each window is judged by a table of the training windows of its own fold.  The regimes of the rows are
    cut from the speeds of all windows; no figure but the rows and the choice of drives depends on them.

    Parameters
    ----------
    judged : held-out windows
    seed : of the bootstrap over runs
    """
    held_out = held_out_support(judged)
    tested = np.flatnonzero(np.isfinite(judged.probability).all(axis=(0, 2)))
    kept = HeldOutSupport(*(values[:, tested] for values in held_out))
    run_id, terrain = judged.run_id[tested], judged.terrain[tested]
    accuracy = support_accuracy(kept, run_id, terrain, np.random.default_rng(seed))
    motion = judged.motion.of(tested)
    regimes = learn_regimes(motion.speed_mps)
    regime = regimes.numbers(*motion)
    rows = _rows(kept.correct, regime, regimes, run_id, terrain, judged.classes)
    drives = _next_drives(judged, motion, kept, regime, regimes, terrain)
    return SupportReport(rows, accuracy, drives)


def held_out_support(judged: Judged) -> HeldOutSupport:
    """Return the support of each held-out window by the training windows of its fold."""
    n_repeats, n = judged.probability.shape[:2]
    correct, supported = np.zeros((2, n_repeats, n), dtype=bool)
    true_runs, predicted_runs = np.zeros((2, n_repeats, n), dtype=int)
    probability = np.full((n_repeats, n), np.nan)
    classes = [str(name) for name in judged.classes]
    true = np.searchsorted(judged.classes, judged.terrain)
    for repeat, train, test in judged.splits:
        table = table_of(judged.motion.of(train), judged.terrain[train], judged.run_id[train], classes)
        motion = judged.motion.of(test)
        near = table.near_runs(motion.speed_mps, motion.yaw_rate_radps)
        stated = judged.probability[repeat, test]
        found = support_of(stated, near)
        correct[repeat, test] = stated.argmax(axis=1) == true[test]
        true_runs[repeat, test] = near[np.arange(len(test)), true[test]]
        predicted_runs[repeat, test] = found.n_runs
        probability[repeat, test], supported[repeat, test] = found.probability, found.supported
    return HeldOutSupport(correct, true_runs, predicted_runs, probability, supported)


def _rows(
    correct: Array, regime: Array, regimes: Regimes, run_id: Array, terrain: Array, classes: Array
) -> tuple[SupportRow, ...]:
    rows = []
    for name in classes:
        for number in np.unique(regime):
            inside = (terrain == name) & (regime == number)
            accuracy = float(correct[:, inside].mean()) if inside.any() else None
            n_runs = len(np.unique(run_id[inside]))
            rows.append(SupportRow(str(name), regimes.name(int(number)), int(inside.sum()), n_runs, accuracy))
    return tuple(rows)


def _next_drives(
    judged: Judged,
    motion: Motion,
    held_out: HeldOutSupport,
    regime: Array,
    regimes: Regimes,
    terrain: Array,
) -> tuple[NextDrive, ...]:
    """Return the drives by what they gain.

    The driving that is expected is half as recorded and half as if terrains and regimes met independently: a
    robot that drives both will drive one on the other, whether or not a run shows it.
    """
    growth = fit_growth(held_out.true_runs.ravel(), held_out.correct.ravel())
    if growth is None:
        return ()
    classes = [str(name) for name in judged.classes]
    table = table_of(judged.motion, judged.terrain, judged.run_id, classes)
    near = table.near_runs(motion.speed_mps, motion.yaw_rate_radps)
    pairs = [(i, int(number)) for i in range(len(classes)) for number in np.unique(regime)]
    cells = Cells(*np.array([_cell(held_out, near, regime, terrain, classes, *pair) for pair in pairs]).T)
    gain = expected_gain(growth, cells)
    drives = []
    for at in np.argsort(-gain, kind="stable")[:MAX_DRIVES]:
        if gain[at] < MIN_GAIN:
            break
        i, number = pairs[at]
        n, n_errors = int(cells.n_windows[at]), float(cells.n_errors[at])
        drives.append(
            NextDrive(
                terrain=classes[i],
                regime=regimes.name(number),
                runs=ADDED_RUNS,
                duration_s=max(RUN_WINDOWS * judged.window_s, MIN_RUN_S),
                gain=float(gain[at]),
                support_runs=float(cells.all_runs[at]),
                windows=n,
                accuracy=1.0 - n_errors / n if n else None,
            )
        )
    return tuple(drives)


def _cell(
    held_out: HeldOutSupport,
    near: Array,
    regime: Array,
    terrain: Array,
    classes: Sequence[str],
    i: int,
    number: int,
) -> tuple[float, float, float, float, float]:
    """Return what :class:`Cells` has of terrain ``i`` in a regime."""
    of_regime, of_class = regime == number, terrain == classes[i]
    inside = of_regime & of_class
    ratio = float(inside.mean() + of_class.mean() * of_regime.mean()) / 2
    at = inside if inside.any() else of_regime  # the motions of other terrains show where support lacks
    all_runs = float(near[at, i].mean())
    if not inside.any():
        return ratio, 0.0, 0.0, all_runs, all_runs
    errors = float((~held_out.correct[:, inside]).mean(axis=0).sum())
    return ratio, float(inside.sum()), errors, float(held_out.true_runs[:, inside].mean()), all_runs
