"""Training coverage: how many training runs drove as a held-out window does, and which drives to record next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from features.motion import Motion
from pipelines.learn.evaluate import HeldOut
from pipelines.learn.protocols import Samples
from terrain.classify.next_drives import ADDED_RUNS, Cells, expected_gain, fit_growth
from terrain.classify.regimes import Regimes, learn_regimes
from terrain.classify.support import SupportTable, learn_support, support_of
from terrain.classify.support_figures import HeldOutSupport, SupportAccuracy, support_accuracy
from terrain.records import Array

RUN_WINDOWS, MIN_RUN_S = 10, 20.0
"""Windows that a run to be recorded should give, as many as the prior of a cell, and its least length."""

MAX_DRIVES = 20
MIN_GAIN = 5e-5
"""A drive that is expected to gain less is not named: it would be shown as 0.00 %."""


class SupportRow(NamedTuple):
    """A terrain in a regime of driving: its windows, their runs, and their accuracy when held out, if any."""

    terrain: str
    regime: str
    windows: int
    n_runs: int
    accuracy: float | None

    def as_json(self) -> dict[str, Any]:
        """Return all fields; the terrain is the class."""
        row = self._asdict()
        return {"class": row.pop("terrain"), **row}


class NextDrive(NamedTuple):
    """A drive that is worth recording.

    Parameters
    ----------
    terrain, regime : to be driven
    runs, duration_s : at least so many, each at least so long
    gain : accuracy that these runs are expected to add; it orders the drives, and no more: with cells of
        recorded runs taken away and put back (BorealTC, 35 cells), its rank correlation with the real gain
        was 0.5 and its size far too small
    support_runs : training runs near that motion so far, mean
    windows : of the terrain in the regime so far
    accuracy : of these windows when held out; None where there are none
    """

    terrain: str
    regime: str
    runs: int
    duration_s: float
    gain: float
    support_runs: float
    windows: int
    accuracy: float | None

    def as_json(self) -> dict[str, Any]:
        """Return all fields and the request in words; the terrain is the class."""
        row = self._asdict()
        return {"class": row.pop("terrain"), **row, "request": self.request}

    @property
    def request(self) -> str:
        """The drive in words that an operator can take along."""
        return f"{self.terrain}, {self.regime}, at least {self.runs} runs of {self.duration_s:g} s"


class Coverage(NamedTuple):
    """Coverage of held-out windows by the training runs of their folds.

    Parameters
    ----------
    rows : of each terrain in each regime, those without a window among them
    accuracy : by coverage
    next_drives : best first; empty where the data cannot show what more runs gain
    """

    rows: tuple[SupportRow, ...]
    accuracy: SupportAccuracy
    next_drives: tuple[NextDrive, ...]


def table_of(motion: Motion, terrain: Array, run_id: Array, classes: Sequence[str]) -> SupportTable:
    """Return the table of coverage that training windows give."""
    return learn_support(motion.speed_mps, motion.yaw_rate_radps, terrain, run_id, classes)


def coverage_of(held_out: HeldOut, samples: Samples, motion: Motion, seed: int) -> Coverage:
    """Return the coverage of held-out windows.

    Each window is judged by a table of the training windows of its own fold.  The regimes of the rows are
    cut from the speeds of all windows; no figure but the rows and the choice of drives depends on them.

    Parameters
    ----------
    held_out, samples : probabilities of windows, and the windows
    motion : how the robot moved in each
    seed : of the bootstrap over runs
    """
    classes = [str(name) for name in held_out.classes]
    table = table_of(motion, samples.terrain, samples.run_id, classes)
    rows = np.flatnonzero(held_out.tested)
    kept = HeldOutSupport(*(values[:, rows] for values in held_out_coverage(held_out, samples, motion)))
    run_id, terrain, motion = samples.run_id[rows], samples.terrain[rows], motion.of(rows)
    accuracy = support_accuracy(kept, run_id, terrain, np.random.default_rng(seed))
    regimes = learn_regimes(motion.speed_mps)
    regime = regimes.numbers(*motion)
    found = []
    for name in classes:
        for number in np.unique(regime):
            inside = (terrain == name) & (regime == number)
            right = float(kept.correct[:, inside].mean()) if inside.any() else None
            n_runs = len(np.unique(run_id[inside]))
            found.append(SupportRow(name, regimes.name(int(number)), int(inside.sum()), n_runs, right))
    near = table.near_runs(motion.speed_mps, motion.yaw_rate_radps)
    drives = _next_drives(kept, near, regime, regimes, terrain, classes, samples.windows.length_s)
    return Coverage(tuple(found), accuracy, drives)


def held_out_coverage(held_out: HeldOut, samples: Samples, motion: Motion) -> HeldOutSupport:
    """Return the coverage of each held-out window (repeats, n) by the training windows of its fold."""
    shape = held_out.probability.shape[:2]
    correct, supported = np.zeros((2, *shape), dtype=bool)
    true_runs, predicted_runs = np.zeros((2, *shape), dtype=int)
    probability = np.full(shape, np.nan)
    run_id, terrain = samples.run_id, samples.terrain
    classes = [str(name) for name in held_out.classes]
    true = np.searchsorted(held_out.classes, terrain)
    for (repeat, _, train, test), stated, *_ in held_out.results:
        table = table_of(motion.of(train), terrain[train], run_id[train], classes)
        there = motion.of(test)
        near = table.near_runs(there.speed_mps, there.yaw_rate_radps)
        found = support_of(stated, near)
        correct[repeat, test] = stated.argmax(axis=1) == true[test]
        true_runs[repeat, test] = near[np.arange(len(test)), true[test]]
        predicted_runs[repeat, test] = found.n_runs
        probability[repeat, test], supported[repeat, test] = found.probability, found.supported
    return HeldOutSupport(correct, true_runs, predicted_runs, probability, supported)


def _next_drives(
    held_out: HeldOutSupport,
    near: Array,
    regime: Array,
    regimes: Regimes,
    terrain: Array,
    classes: Sequence[str],
    window_s: float,
) -> tuple[NextDrive, ...]:
    """Return the drives by what they gain.

    The driving that is expected is half as recorded and half as if terrains and regimes met independently: a
    robot that drives both will drive one on the other, whether or not a run shows it.
    """
    growth = fit_growth(held_out.true_runs.ravel(), held_out.correct.ravel())
    if growth is None:
        return ()
    pairs = [(i, int(number)) for i in range(len(classes)) for number in np.unique(regime)]
    rows = []
    for i, number in pairs:
        of_regime, of_class = regime == number, terrain == classes[i]
        inside = of_regime & of_class
        ratio = float(inside.mean() + of_class.mean() * of_regime.mean()) / 2
        at = inside if inside.any() else of_regime  # the motions of other terrains show where coverage lacks
        all_runs = float(near[at, i].mean())
        if inside.any():
            errors = float((~held_out.correct[:, inside]).mean(axis=0).sum())
            true_runs = float(held_out.true_runs[:, inside].mean())
            rows.append((ratio, float(inside.sum()), errors, true_runs, all_runs))
        else:
            rows.append((ratio, 0.0, 0.0, all_runs, all_runs))
    cells = Cells(*np.array(rows).T)
    gain = expected_gain(growth, cells)
    drives = []
    for place in np.argsort(-gain, kind="stable")[:MAX_DRIVES]:
        if gain[place] < MIN_GAIN:
            break
        i, number = pairs[place]
        n, n_errors = int(cells.n_windows[place]), float(cells.n_errors[place])
        drives.append(
            NextDrive(
                terrain=classes[i],
                regime=regimes.name(number),
                runs=ADDED_RUNS,
                duration_s=max(RUN_WINDOWS * window_s, MIN_RUN_S),
                gain=float(gain[place]),
                support_runs=float(cells.all_runs[place]),
                windows=n,
                accuracy=1.0 - n_errors / n if n else None,
            )
        )
    return tuple(drives)
