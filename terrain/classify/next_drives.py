r"""Which motions the training runs cover, and which drives to record next: what more runs of a terrain would gain.

The errors that are left fall with the number n of training runs near a window's motion, as

.. math:: e(n) = e_\infty + b (1 + n)^{-c},

fitted to held-out windows of all terrains.  A cell, one terrain in one regime, has an error rate of its own,
which few windows state poorly: it is drawn towards the curve by ``PRIOR_WINDOWS`` windows.  With m runs more,
it falls in the proportion in which the curve does.  Weighted by how much of the driving the cell is expected
to be, this is the accuracy that the runs would gain.  The law is that of the learning curve (e.g. Cortes et
al., Learning Curves: Asymptotic Values and Rate of Convergence, 1994).

Accuracy is also given by support, by the true terrain and by the mark that needs no label.  Each held-out window
is judged by a table of the training windows of its own fold.  Figures are ratios of sums
over windows, their intervals those of a bootstrap that draws whole runs within their classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from terrain.bootstrap import percentile_interval, stratified_counts
from terrain.classify.held_out import HeldOut
from terrain.classify.metrics import N_BOOTSTRAP, Interval, confidence_auc, runs_of_classes
from terrain.classify.regimes import Motion, learn_regimes
from terrain.classify.support import SupportLevel, learn_support, support_levels, support_of
from terrain.records import Array


class HeldOutSupport(NamedTuple):
    """Support of held-out windows by the training runs of their folds, each (repeats, n).

    Parameters
    ----------
    correct : whether the prediction is right
    true_runs : training runs of the true terrain near the motion of the window
    predicted_runs : of the predicted terrain
    probability : supported probability of the predicted terrain
    supported : whether the prediction is marked supported
    """

    correct: Array
    true_runs: Array
    predicted_runs: Array
    probability: Array
    supported: Array


def held_out_support(held_out: HeldOut, run_id: Array, motion: Motion) -> HeldOutSupport:
    """Return the support of each window (repeats, n) by the training windows of the fold that held it out.

    Parameters
    ----------
    held_out : probabilities of the windows
    run_id, motion : run of each window, and how the robot moved in it
    """
    shape, terrain = held_out.probability.shape[:2], held_out.truth
    true_runs, predicted_runs = np.zeros((2, *shape), dtype=int)
    probability, supported = np.full(shape, np.nan), np.zeros(shape, dtype=bool)
    classes = [str(name) for name in held_out.classes]
    true = np.searchsorted(held_out.classes, terrain)
    for (repeat, _, train, test), stated, *_ in held_out.results:
        driven, there = motion.of(train), motion.of(test)
        table = learn_support(driven.speed_mps, driven.yaw_rate_radps, terrain[train], run_id[train], classes)
        near = table.near_runs(there.speed_mps, there.yaw_rate_radps)
        true_runs[repeat, test] = near[np.arange(len(test)), true[test]]
        predicted_runs[repeat, test], probability[repeat, test], supported[repeat, test] = support_of(
            stated, near
        )
    return HeldOutSupport(held_out.correct, true_runs, predicted_runs, probability, supported)


class PartFigures(NamedTuple):
    """A part of the held-out windows; intervals are of 95 % over runs, None where it holds no window.

    Parameters
    ----------
    windows_ratio, windows_ratio_ci : of all windows
    accuracy, accuracy_ci : of the part
    errors_ratio, errors_ratio_ci : of all errors, those in the part; None where there is no error
    """

    windows_ratio: float
    windows_ratio_ci: Interval
    accuracy: float | None
    accuracy_ci: Interval | None
    errors_ratio: float | None
    errors_ratio_ci: Interval | None


def support_accuracy(
    held_out: HeldOutSupport, run_id: Array, terrain: Array, rng: np.random.Generator
) -> tuple[dict[str, PartFigures], PartFigures, PartFigures, float | None]:
    """Return the accuracy of held-out windows by their support.

    Parameters
    ----------
    held_out : of n windows
    run_id, terrain : (n,) run and true terrain of each window
    rng : source of the bootstrap

    Returns
    -------
    by_true_terrain : by :class:`~terrain.classify.support.SupportLevel` of the true terrain: needs labels
    unsupported, supported : by the mark of the prediction, without a label
    auc : area from the supported probability to correctness; None where all are right

    Examples
    --------
    >>> right, runs = np.array([[True, True, False, True]]), np.array([[5, 5, 0, 2]])
    >>> held_out = HeldOutSupport(right, runs, runs, 0.9 * runs / (1 + runs), runs > 1)
    >>> run, terrain = np.array(list("aabb")), np.array(["ice"] * 4)
    >>> levels, without, supported, auc = support_accuracy(held_out, run, terrain, np.random.default_rng(0))
    >>> without.windows_ratio, without.errors_ratio, supported.accuracy
    (0.25, 1.0, 1.0)
    >>> levels["1 to 3 runs"].accuracy, auc
    (1.0, 1.0)
    """
    class_of, place = runs_of_classes(run_id, terrain)
    drawn = stratified_counts(class_of, N_BOOTSTRAP, rng)
    weights = np.vstack([np.ones(len(class_of)), drawn])  # the first as they are
    level = support_levels(held_out.true_runs)

    def part(inside: Array) -> PartFigures:
        return _part(inside, held_out.correct, place, weights)

    areas = [
        confidence_auc(probability, right.astype(float), np.ones((1, right.size)))[0]
        for probability, right in zip(held_out.probability, held_out.correct, strict=True)
    ]
    known = np.isfinite(areas)
    return (
        {each.value: part(level == each.value) for each in SupportLevel},
        part(~held_out.supported),
        part(held_out.supported),
        float(np.mean(np.array(areas)[known])) if known.any() else None,
    )


def _part(inside: Array, correct: Array, place: Array, weights: Array) -> PartFigures:
    def total(values: Array) -> Array:
        return np.asarray(weights @ np.bincount(place, values.sum(axis=0), weights.shape[1]))

    n, errors = total(np.ones(correct.shape)), total((~correct).astype(float))
    n_inside, wrong_inside = total(inside.astype(float)), total((inside & ~correct).astype(float))
    ratio, interval = _ratio(n_inside, n)
    return PartFigures(
        ratio or 0.0,
        interval or (0.0, 0.0),
        *_ratio(n_inside - wrong_inside, n_inside),
        *_ratio(wrong_inside, errors),
    )


def _ratio(numerator: Array, denominator: Array) -> tuple[float | None, Interval | None]:
    """Return the first ratio, and the interval of the others; None where the first has no denominator."""
    if not denominator[0]:
        return None, None
    ratio: Array = np.full(len(numerator), np.nan)
    np.divide(numerator, denominator, out=ratio, where=denominator > 0)
    return float(ratio[0]), percentile_interval(ratio[1:]) if np.isfinite(ratio[1:]).any() else None


ADDED_RUNS = 2
"""Runs that are asked for: a single one may be unlike the others."""

PRIOR_WINDOWS = 10.0
"""Windows that the curve counts as beside those of a cell; a run in a cell has about so many."""

MIN_COUNTS = 3
"""With fewer different numbers of runs there is no curve; its law has three parameters."""


RUN_WINDOWS, MIN_RUN_S = 10, 20.0
"""Windows that a run to be recorded should give, as many as the prior of a cell, and its least length."""

MAX_DRIVES = 20
MIN_GAIN = 5e-5
"""A drive that is expected to gain less is not named: it would be shown as 0.00 %."""


class Growth(NamedTuple):
    """Errors against the number of training runs: ``floor + scale (1 + n) ** -power``."""

    floor: float
    scale: float
    power: float

    def error(self, n_runs: Array) -> Array:
        """Return the error rate with so many training runs."""
        return np.asarray(self.floor + self.scale * (1.0 + np.asarray(n_runs, dtype=float)) ** -self.power)


def fit_growth(n_runs: Array, correct: Array) -> Growth | None:
    """Return how errors fall with the number of training runs; None where the data cannot show it.

    Parameters
    ----------
    n_runs : (n,) training runs near each held-out window
    correct : (n,) whether it was classified correctly

    Examples
    --------
    >>> n_runs = np.repeat([0, 1, 3, 7], 1000)
    >>> right = np.tile(np.arange(1000), 4) >= 1000 * 0.8 / (1 + n_runs)
    >>> fit_growth(n_runs, right).error(np.array([0, 3])).round(2).tolist()
    [0.8, 0.2]
    """
    counts, of = np.unique(n_runs, return_inverse=True)
    if len(counts) < MIN_COUNTS:
        return None
    n = np.bincount(of)
    wrong = 1.0 - np.bincount(of, weights=correct.astype(float)) / n
    weight = np.sqrt(n / n.sum())

    def residual(law: Array) -> Array:
        return np.asarray(weight * (Growth(*law).error(counts) - wrong))

    fit = least_squares(residual, x0=[0.05, 0.5, 0.7], bounds=([0.0, 0.0, 0.05], [1.0, 1.0, 3.0]))
    return Growth(*(float(value) for value in fit.x))


def expected_gain(
    growth: Growth,
    expected_ratio: Array,
    n_windows: Array,
    n_errors: Array,
    held_out_runs: Array,
    all_runs: Array,
    added_runs: int = ADDED_RUNS,
) -> Array:
    """Return the accuracy that so many more runs in each cell, a terrain in a regime, would gain (cells,).

    Parameters
    ----------
    growth : how errors fall
    expected_ratio : (cells,) of the driving that is expected, what takes place in the cell
    n_windows, n_errors : (cells,) held-out windows in it, and how many of them, mean over repeats, were wrong
    held_out_runs : (cells,) training runs near them when they were held out, mean
    all_runs : (cells,) training runs near them with all runs in training
    added_runs : in each cell

    Examples
    --------
    >>> cells = np.array([[0.5, 0.5], [100, 100], [80, 20], [0, 3], [0, 3]])
    >>> expected_gain(Growth(0.0, 0.8, 1.0), *cells, added_runs=4).round(3).tolist()
    [0.32, 0.05]
    """
    of_curve = growth.error(held_out_runs)
    error = (n_errors + PRIOR_WINDOWS * of_curve) / (n_windows + PRIOR_WINDOWS)
    fall = growth.error(all_runs) - growth.error(all_runs + added_runs)
    relative = np.divide(fall, of_curve, out=np.zeros_like(fall), where=of_curve > 0)
    return np.asarray(expected_ratio * error * relative)


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
    support : of each terrain in each regime, those without a window among them
    next_drives : best first; empty where the data cannot show what more runs gain
    accuracy_by_support : a row of :class:`~terrain.classify.next_drives.PartFigures` for each
        :class:`~terrain.classify.support.SupportLevel` of the true terrain
    unsupported, supported, supported_auc : as :func:`support_accuracy`
    """

    support: tuple[SupportRow, ...]
    next_drives: tuple[NextDrive, ...]
    accuracy_by_support: tuple[Mapping[str, Any], ...]
    unsupported: PartFigures
    supported: PartFigures
    supported_auc: float | None


def coverage_of(held_out: HeldOut, run_id: Array, motion: Motion, window_s: float, seed: int) -> Coverage:
    """Return the coverage of held-out windows.

    The regimes of the rows are cut from the speeds of all windows; no figure but the rows and the choice of
    drives depends on them.  The driving that is expected is half as recorded and half as if terrains and
    regimes met independently: a robot that drives both will drive one on the other, whether or not a run
    shows it.

    Parameters
    ----------
    held_out : probabilities of the windows
    run_id, motion : run of each window, and how the robot moved in it
    window_s : length of a window
    seed : of the bootstrap over runs
    """
    classes, tested = [str(name) for name in held_out.classes], np.flatnonzero(held_out.tested)
    table = learn_support(motion.speed_mps, motion.yaw_rate_radps, held_out.truth, run_id, classes)
    support = HeldOutSupport(*(each[:, tested] for each in held_out_support(held_out, run_id, motion)))
    run_id, terrain, motion = run_id[tested], held_out.truth[tested], motion.of(tested)
    near = table.near_runs(motion.speed_mps, motion.yaw_rate_radps)
    regimes = learn_regimes(motion.speed_mps)
    regime = regimes.numbers(*motion)
    rows, cells = [], []
    for column, name in enumerate(classes):
        for number in np.unique(regime):
            of_class, of_regime = terrain == name, regime == number
            inside = of_class & of_regime
            n = int(inside.sum())
            right = float(support.correct[:, inside].mean()) if n else None
            rows.append(SupportRow(name, regimes.name(int(number)), n, len(np.unique(run_id[inside])), right))
            expected = float(inside.mean() + of_class.mean() * of_regime.mean()) / 2
            at = inside if n else of_regime  # the motions of other terrains show where coverage lacks
            all_runs = float(near[at, column].mean())
            errors = float((~support.correct[:, inside]).mean(axis=0).sum()) if n else 0.0
            true_runs = float(support.true_runs[:, inside].mean()) if n else all_runs
            cells.append((expected, n, errors, true_runs, all_runs))
    drives: list[NextDrive] = []
    growth = fit_growth(support.true_runs.ravel(), support.correct.ravel())
    gain = expected_gain(growth, *np.array(cells, dtype=float).T) if growth else np.zeros(len(cells))
    for i in np.argsort(-gain, kind="stable")[:MAX_DRIVES]:
        if gain[i] >= MIN_GAIN:
            of_terrain, of_regime, n, _, right = rows[i]
            lasts_s = max(RUN_WINDOWS * window_s, MIN_RUN_S)
            drive = of_terrain, of_regime, ADDED_RUNS, lasts_s, float(gain[i]), cells[i][-1], n, right
            drives.append(NextDrive(*drive))
    levels, without, supported, auc = support_accuracy(support, run_id, terrain, np.random.default_rng(seed))
    by_support = tuple({"support": level, **part._asdict()} for level, part in levels.items())
    return Coverage(tuple(rows), tuple(drives), by_support, without, supported, auc)
