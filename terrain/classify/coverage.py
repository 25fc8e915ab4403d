r"""Which motions the training runs cover, and which drives to record next: what more runs of a terrain would gain.

The errors that are left fall with the number n of training runs near a window's motion, as

.. math:: e(n) = e_\infty + b (1 + n)^{-c},

fitted to held-out windows of all terrains.  A cell, one terrain in one regime, has an error rate of its own,
which few windows state poorly: it is drawn towards the curve by ``PRIOR_WINDOWS`` windows.  With m runs more,
it falls in the proportion in which the curve does.  Weighted by how much of the driving the cell is expected
to be, this is the accuracy that the runs would gain.  The law is that of the learning curve (e.g. Cortes et
al., Learning Curves: Asymptotic Values and Rate of Convergence, 1994).

Regimes are those that a person can ask for: a range of speed, straight on, in a curve or on the spot.  Accuracy is also
given by support, by the true terrain and by the mark that needs no label.  Each held-out window is judged by a table of
the training windows of its own fold.  Figures are ratios of sums over windows, their intervals those of a bootstrap
that draws whole units (sessions where there are, otherwise runs) within their classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from terrain.classify.folds import run_of, units_of
from terrain.classify.held_out import HeldOut
from terrain.classify.limits import (
    SUPPORTED,
    Motion,
    SupportLevel,
    learn_support,
    support_levels,
    supported_probability,
)
from terrain.classify.metrics import N_BOOTSTRAP, Draws, Interval, confidence_auc
from terrain.records import Array

#: At most so many ranges of speed, none narrower: closer speeds are not worth asking an operator for.
MAX_SPEEDS, MIN_WIDTH_MPS = 4, 0.15
#: Edges are multiples of the first; an inner one is moved by up to the second to where fewest windows lie, so that one
#: commanded speed is not cut in two.
EDGE_STEP_MPS, EDGE_SHIFT_MPS = 0.05, 0.1
STRAIGHT_RADPS = 0.1  #: A smaller yaw rate is straight on: 11 degrees in a window of 2 s.
#: Difference of the speeds of the two sides over their sum: straight on below the first where no yaw rate is measured,
#: on the spot above the second, where one side nearly stands or turns against the other.
STRAIGHT_RATIO, SPIN_RATIO = 0.1, 0.8
#: A robot without two sides turns on the spot below this speed per yaw rate: about half a track width.
SPIN_RADIUS_M = 0.3
ADDED_RUNS = 2  #: Runs that are asked for: a single one may be unlike the others.
#: Windows that the curve counts as beside those of a cell; a run in a cell has about so many.
PRIOR_WINDOWS = 10.0
MIN_COUNTS = 3  #: With fewer different numbers of runs there is no curve; its law has three parameters.
#: Windows that a run to be recorded should give, as many as the prior of a cell, and its least length.
RUN_WINDOWS, MIN_RUN_S = 10, 20.0
MAX_DRIVES = 20
MIN_GAIN = 5e-5  #: A drive that is expected to gain less is not named: it would be shown as 0.00 %.


class Manoeuvre(IntEnum):
    """What a robot does in a window."""

    STRAIGHT = 0
    CURVE = 1
    SPIN = 2


def manoeuvres(motion: Motion) -> Array:
    """Return the :class:`Manoeuvre` (n,) of each window."""
    speed_mps, yaw_rate_radps, turn_ratio = motion
    straight = np.where(
        np.isnan(yaw_rate_radps), ~(turn_ratio >= STRAIGHT_RATIO), yaw_rate_radps < STRAIGHT_RADPS
    )
    by_radius = speed_mps < SPIN_RADIUS_M * yaw_rate_radps
    spin = np.where(np.isnan(turn_ratio), ~straight & by_radius, turn_ratio >= SPIN_RATIO)
    return np.where(spin, Manoeuvre.SPIN, np.where(straight, Manoeuvre.STRAIGHT, Manoeuvre.CURVE))


def speed_edges(speed_mps: Array) -> tuple[float, ...]:
    """Return the edges of ranges of speed that divide what was driven evenly, between commanded speeds.

    The range is that from the 1st to the 99th percentile of the windows, whatever their terrain; what lies outside is
    in the range beside it.

    Examples
    --------
    >>> speed_edges(np.array([0.2, 0.22, 0.4, 0.6, 0.8])), speed_edges(np.array([0.48, 0.5, 0.52]))
    ((0.2, 0.35, 0.55, 0.8), (0.45, 0.55))
    """
    low, high = np.quantile(speed_mps, [0.01, 0.99])
    n_ranges = int(np.clip((high - low) / MIN_WIDTH_MPS, 1, MAX_SPEEDS))
    reach, inner = round(EDGE_SHIFT_MPS / EDGE_STEP_MPS), set()
    for edge in np.linspace(low, high, n_ranges + 1)[1:-1]:
        nearest = round(edge / EDGE_STEP_MPS)
        places = EDGE_STEP_MPS * np.arange(max(nearest - reach, 1), nearest + reach + 1)
        beside = (np.abs(speed_mps - places[:, None]) < EDGE_STEP_MPS / 2).sum(axis=1)
        best = np.lexsort((np.abs(places - edge), beside))[0]  # of the fewest windows the nearest
        inner.add(float(np.round(places[best], 6)))
    ends = np.floor(low / EDGE_STEP_MPS), max(np.ceil(high / EDGE_STEP_MPS), 1.0)
    first, last = (float(np.round(EDGE_STEP_MPS * end, 6)) for end in ends)
    return (first, *sorted(edge for edge in inner if first < edge < last), last)


def held_out_support(held_out: HeldOut, run_id: Array, motion: Motion) -> tuple[Array, Array]:
    """Return the support of each window (repeats, n), of a run and with a motion, by the training windows of its fold.

    Returns
    -------
    training runs of the true terrain near its motion, and the supported probability of the predicted one; NaN where
    it was not held out
    """
    shape, terrain = held_out.probability.shape[:2], held_out.truth
    true_runs, probability = np.zeros(shape, dtype=int), np.full(shape, np.nan)
    true = np.searchsorted(held_out.classes, terrain)
    for (repeat, _, train, test), stated, *_ in held_out.results:
        driven, there = motion.of(train), motion.of(test)
        trained = driven.speed_mps, driven.yaw_rate_radps, terrain[train], run_id[train]
        near = learn_support(*trained, held_out.classes.tolist()).near_runs(
            there.speed_mps, there.yaw_rate_radps
        )
        true_runs[repeat, test] = near[np.arange(len(test)), true[test]]
        probability[repeat, test] = supported_probability(stated, near)
    return true_runs, probability


class PartFigures(NamedTuple):
    """A part of the held-out windows: of all windows, its accuracy, and of all errors those in it.

    Intervals are of 95 % over units, None where it holds no window; the ratio of errors is None where there is none.
    """

    windows_ratio: float
    windows_ratio_ci: Interval
    accuracy: float | None
    accuracy_ci: Interval | None
    errors_ratio: float | None
    errors_ratio_ci: Interval | None


def errors_left(law: Array, n_runs: Array) -> Array:
    """Return the error rate ``floor + scale (1 + n) ** -power`` with so many training runs."""
    floor, scale, power = law
    return np.asarray(floor + scale * (1.0 + np.asarray(n_runs, dtype=float)) ** -power)


def fit_growth(n_runs: Array, correct: Array) -> Array | None:
    """Return the law of :func:`errors_left` of held-out windows (n,); None where the data cannot show it.

    Examples
    --------
    >>> n_runs = np.repeat([0, 1, 3, 7], 1000)
    >>> right = np.tile(np.arange(1000), 4) >= 1000 * 0.8 / (1 + n_runs)
    >>> errors_left(fit_growth(n_runs, right), np.array([0, 3])).round(2).tolist()
    [0.8, 0.2]
    """
    counts, of = np.unique(n_runs, return_inverse=True)
    if len(counts) < MIN_COUNTS:
        return None
    n = np.bincount(of)
    wrong = 1.0 - np.bincount(of, weights=correct.astype(float)) / n
    weight = np.sqrt(n / n.sum())

    def residual(law: Array) -> Array:
        return np.asarray(weight * (errors_left(law, counts) - wrong))

    fit = least_squares(residual, x0=[0.05, 0.5, 0.7], bounds=([0.0, 0.0, 0.05], [1.0, 1.0, 3.0]))
    return np.asarray(fit.x)


def expected_gain(
    law: Array,
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
    expected_ratio : of the driving that is expected, what takes place in the cell
    n_windows, n_errors : held-out windows in it, and how many of them, mean over repeats, were wrong
    held_out_runs, all_runs : training runs near them when they were held out, and with all runs in training, mean
    """
    of_curve = errors_left(law, held_out_runs)
    error = (n_errors + PRIOR_WINDOWS * of_curve) / (n_windows + PRIOR_WINDOWS)
    fall = errors_left(law, all_runs) - errors_left(law, all_runs + added_runs)
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
    """A drive that is worth recording: of at least so many runs, each at least so long."""

    terrain: str
    regime: str
    runs: int
    duration_s: float
    #: accuracy that these runs are expected to add; it orders the drives, and no more: with cells of recorded runs
    #: taken away and put back (BorealTC, 35 cells), its rank correlation with the real gain was 0.5 and its size far
    #: too small
    gain: float
    support_runs: float  #: training runs near that motion so far, mean
    #: windows, accuracy: of the terrain in the regime so far, and their accuracy when held out, if there are any
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


def coverage_of(
    held_out: HeldOut, groups: Array, motion: Motion, window_s: float, seed: int
) -> Mapping[str, Any]:
    """Return the coverage of held-out windows, by name.

    The regimes of the rows are cut from the speeds of all windows; no figure but the rows and the choice of
    drives depends on them.  The driving that is expected is half as recorded and half as if terrains and
    regimes met independently: a robot that drives both will drive one on the other, whether or not a run
    shows it.

    Returns
    -------
    support : a :class:`SupportRow` of each terrain in each regime, those without a window among them
    next_drives : :class:`NextDrive`, best first; empty where the data cannot show what more runs gain
    accuracy_by_support : by :class:`~terrain.classify.limits.SupportLevel` of the true terrain: needs labels
    unsupported, supported : by the mark of the prediction, without a label
    supported_auc : area from the supported probability to correctness, None where all are right
    """
    unit, run_id = units_of(held_out.truth, groups), run_of(groups)
    classes, tested = [str(name) for name in held_out.classes], np.flatnonzero(held_out.tested)
    table = learn_support(motion.speed_mps, motion.yaw_rate_radps, held_out.truth, run_id, classes)
    true_runs, probability = (each[:, tested] for each in held_out_support(held_out, run_id, motion))
    correct = held_out.correct[:, tested]
    run_id, terrain, motion = run_id[tested], held_out.truth[tested], motion.of(tested)
    near = table.near_runs(motion.speed_mps, motion.yaw_rate_radps)
    edges_mps = speed_edges(motion.speed_mps)
    within = np.searchsorted(np.array(edges_mps[1:-1]), motion.speed_mps, side="right")
    # manoeuvre by manoeuvre in each range
    regime, rows, cells = (within * len(Manoeuvre) + manoeuvres(motion)).astype(int), [], []
    for column, name in enumerate(classes):
        for number in np.unique(regime):
            of_class, of_regime = terrain == name, regime == number
            inside = of_class & of_regime
            n, (place, manoeuvre) = int(inside.sum()), divmod(int(number), len(Manoeuvre))
            right = float(correct[:, inside].mean()) if n else None
            low, high = edges_mps[place : place + 2]
            named = f"{Manoeuvre(manoeuvre).name.lower()} at {low:g} to {high:g} m/s"
            rows.append(SupportRow(name, named, n, len(np.unique(run_id[inside])), right))
            expected = float(inside.mean() + of_class.mean() * of_regime.mean()) / 2
            at = inside if n else of_regime  # the motions of other terrains show where coverage lacks
            all_runs = float(near[at, column].mean())
            errors = float((~correct[:, inside]).mean(axis=0).sum()) if n else 0.0
            held_out_runs = float(true_runs[:, inside].mean()) if n else all_runs
            cells.append((expected, n, errors, held_out_runs, all_runs))
    law = fit_growth(true_runs.ravel(), correct.ravel())
    gain = np.zeros(len(cells)) if law is None else expected_gain(law, *np.array(cells, dtype=float).T)
    lasts_s, drives = max(RUN_WINDOWS * window_s, MIN_RUN_S), []
    for i in np.argsort(-gain, kind="stable")[:MAX_DRIVES]:
        if gain[i] >= MIN_GAIN:
            name, driven, n, _, right = rows[i]
            asked = name, driven, ADDED_RUNS, lasts_s, float(gain[i])
            drives.append(NextDrive(*asked, cells[i][-1], n, right))

    draws = Draws.of(unit[tested], terrain, N_BOOTSTRAP, np.random.default_rng(seed))

    def part(inside: Array) -> PartFigures:
        of_windows = np.ones(correct.shape), inside, ~correct, inside & ~correct
        n_all, n_inside, n_wrong, n_wrong_inside = (draws.sums(each.sum(axis=0)) for each in of_windows)
        ratio, interval = draws.ratio(n_inside, n_all)
        accuracy = draws.ratio(n_inside - n_wrong_inside, n_inside)
        of_errors = draws.ratio(n_wrong_inside, n_wrong)
        return PartFigures(ratio or 0.0, interval or (0.0, 0.0), *accuracy, *of_errors)

    level, supported = support_levels(true_runs), probability >= SUPPORTED
    once, repeats = np.ones((1, len(terrain))), zip(probability, correct.astype(float), strict=True)
    areas = np.array([confidence_auc(stated, right, once)[0] for stated, right in repeats])
    known = np.isfinite(areas)
    return {
        "support": tuple(rows),
        "next_drives": tuple(drives),
        "accuracy_by_support": tuple(
            {"support": each.value, **part(level == each.value)._asdict()} for each in SupportLevel
        ),
        "unsupported": part(~supported),
        "supported": part(supported),
        "supported_auc": float(areas[known].mean()) if known.any() else None,
    }
