"""Checks beside the headline figure: speed alone, slow against fast, and how many runs are enough."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from sklearn.base import BaseEstimator

from features.windows import WindowCut, wheel_speeds
from pipelines.crossval.evaluation import Examples, FoldResult, fit_folds
from pipelines.crossval.results import (
    MIN_CLASSES,
    Applicability,
    ClassSpeeds,
    LearningCurve,
    SlowFast,
)
from pipelines.crossval.splits import Fold, Samples
from pipelines.reporting.progress import Progress, silent
from terrain.errors import DataError
from terrain.logs.schema import signal_set_of
from terrain.records import Array, Windows

MIN_RUNS_A_SIDE = 2
MIN_TIME_A_SIDE_S = 60.0
MOVING_MPS = 0.03
"""The faster wheel moves above this; it is the steady-motion rule's own threshold."""

CURVE_RUNS = (1, 2, 3, 5, 8, 12)
CURVE_DRAWS = 2
MIN_CURVE_POINTS = 4
"""The law of the learning curve has three parameters."""
ENOUGH_GAIN = 0.01
"""Enough runs: doubling them would gain less than this accuracy."""


def has_speed(windows: Windows) -> bool:
    """Return whether the windows hold a wheel speed."""
    return any(
        signal_set_of(stream, channel) == "wheels"
        for stream, channels in windows.channels.items()
        for channel in channels
    )


def run_speeds(windows: Windows) -> dict[str, float]:
    """Return the median speed (m/s) of each run's faster wheel where it moves; NaN if it never does."""
    if not has_speed(windows):
        return dict.fromkeys(np.unique(windows.run_id.astype(str)), float("nan"))
    fastest = np.abs(wheel_speeds(windows.values, windows.channels)).max(axis=1)
    speeds = {}
    for run_id in np.unique(windows.run_id.astype(str)):
        speed = fastest[windows.run_id == run_id].ravel()
        moving = speed[speed > MOVING_MPS]
        speeds[run_id] = float(np.median(moving)) if len(moving) else float("nan")
    return speeds


def covered_s(start_s: Array, length_s: float) -> float:
    """Return the time that windows of one run cover; where they overlap it counts once.

    Examples
    --------
    >>> covered_s(np.array([0.0, 1.0, 5.0]), 2.0)
    5.0
    """
    return float(np.minimum(np.diff(np.sort(start_s)), length_s).sum() + length_s)


class SlowFastSplit(NamedTuple):
    """Runs of each class on both sides of its median speed, as (run, class) pairs.

    ``classes`` has the speeds of the classes that are kept, ``left_out`` the reason for each of the others.
    """

    slow: tuple[tuple[str, str], ...]
    fast: tuple[tuple[str, str], ...]
    classes: dict[str, ClassSpeeds]
    left_out: dict[str, str]

    @property
    def status(self) -> Applicability:
        """Whether enough classes are kept."""
        enough = len(self.classes) >= MIN_CLASSES
        return Applicability.APPLICABLE if enough else Applicability.NOT_APPLICABLE


def slow_fast_split(samples: Samples) -> SlowFastSplit:
    """Split the runs of each class at their median speed, taken over the run's time on that class."""
    windows = samples.cut.windows
    run_id, y = windows.run_id.astype(str), windows.terrain.astype(str)
    sides: dict[str, list[tuple[str, str]]] = {"slow": [], "fast": []}
    kept: dict[str, ClassSpeeds] = {}
    left_out: dict[str, str] = {}
    for terrain in np.unique(y).tolist():
        speeds = run_speeds(windows[y == terrain])
        runs = [run for run in np.unique(run_id[y == terrain]) if np.isfinite(speeds[run])]
        median = np.median([speeds[run] for run in runs]) if runs else math.nan
        slow = [run for run in runs if speeds[run] <= median]
        fast = [run for run in runs if speeds[run] > median]
        reason = None
        for name, side in (("slow", slow), ("fast", fast)):
            time_s = sum(
                covered_s(windows.start_s[(run_id == run) & (y == terrain)], windows.length_s) for run in side
            )
            if len(side) < MIN_RUNS_A_SIDE:
                reason = reason or f"{name} runs: {len(side)}"
            elif time_s < MIN_TIME_A_SIDE_S:
                reason = reason or f"{name} runs: {time_s:.0f} s"
        if reason:
            left_out[terrain] = reason
            continue
        slow_mps, fast_mps = (float(np.median([speeds[run] for run in side])) for side in (slow, fast))
        kept[terrain] = ClassSpeeds(slow_mps, fast_mps)
        sides["slow"] += [(run, terrain) for run in slow]
        sides["fast"] += [(run, terrain) for run in fast]
    return SlowFastSplit(tuple(sides["slow"]), tuple(sides["fast"]), kept, left_out)


def slow_fast(
    classifier: BaseEstimator, features: Array, samples: Samples, n_jobs: int, progress: Progress = silent
) -> SlowFast:
    """Train on the slow runs of each class and test on the fast ones, and the reverse.

    A run that is slow on one class and fast on another is on neither side.
    """
    split = slow_fast_split(samples)
    status, classes, left_out = split.status, split.classes, split.left_out
    if status is Applicability.NOT_APPLICABLE:
        return SlowFast(status, classes, left_out)
    examples = examples_of(features, samples)
    slow, fast = _rows_of_sides(samples, split)
    folds = [Fold(0, 0, slow, fast), Fold(0, 1, fast, slow)]
    results = fit_folds(classifier, examples, folds, n_jobs, "slow to fast", progress)
    to_fast, to_slow = (_accuracy([result], examples.terrain) for result in results)
    return SlowFast(status, classes, left_out, to_fast, to_slow)


def _rows_of_sides(samples: Samples, split: SlowFastSplit) -> tuple[Array, Array]:
    windows = samples.cut.windows
    both = {run for run, _ in split.slow} & {run for run, _ in split.fast}
    pairs = list(zip(windows.run_id.astype(str), windows.terrain.astype(str), strict=True))
    slow, fast = (
        np.array([i for i, pair in enumerate(pairs) if pair in set(side) and pair[0] not in both], dtype=int)
        for side in (split.slow, split.fast)
    )
    return slow, fast


class SpeedSplit(NamedTuple):
    """Windows of slow and fast runs alone, the fold that trains on one side, and what a reader must know."""

    samples: Samples
    fold: Fold
    note: str


def speed_split(samples: Samples, protocol: str) -> SpeedSplit:
    """Return what ``slow-fast`` or ``fast-slow`` trains and tests on, as :func:`slow_fast` does.

    Raises
    ------
    DataError
        if too few classes have enough slow and fast runs.
    """
    split = slow_fast_split(samples)
    out = "; ".join(f"{name}: {reason}" for name, reason in split.left_out.items())
    if split.status is Applicability.NOT_APPLICABLE:
        raise DataError(
            f"{protocol!r} needs {MIN_CLASSES} terrains with slow and fast runs, at least {MIN_RUNS_A_SIDE} "
            f"and {MIN_TIME_A_SIDE_S:g} s of each; there are {len(split.classes)} ({out})"
        )
    sides = dict(zip(("slow", "fast"), _rows_of_sides(samples, split), strict=True))
    trained, tested = protocol.split("-")
    rows = np.sort(np.concatenate(list(sides.values())))
    train, test = (np.searchsorted(rows, sides[side]) for side in (trained, tested))
    cut = WindowCut(samples.cut.windows[rows], samples.cut.dropped)
    note = (
        f"trained on the {trained} runs of each terrain ({len(train)} windows), tested on the {tested} ones, "
        f"on either side of its median speed{'; left out: ' if out else ''}{out}"
    )
    return SpeedSplit(samples._replace(cut=cut, group=samples.group[rows]), Fold(0, 0, train, test), note)


def examples_of(features: Array, samples: Samples) -> Examples:
    """Return rows of features with the terrain and the group of their windows."""
    return Examples(features, samples.cut.windows.terrain.astype(str), samples.group)


def _accuracy(results: Sequence[FoldResult], terrain: Array) -> float:
    classes = np.unique(terrain)
    right = [classes[r.probability.argmax(axis=1)] == terrain[r.fold.test] for r in results]
    return float(np.concatenate(right).mean())


def fold_accuracy(
    classifier: BaseEstimator,
    examples: Examples,
    folds: Sequence[Fold],
    n_jobs: int,
    task: str,
    progress: Progress = silent,
) -> float:
    """Return the accuracy over the folds of one repeat."""
    return _accuracy(fit_folds(classifier, examples, folds, n_jobs, task, progress), examples.terrain)


def learning_curve(
    classifier: BaseEstimator,
    examples: Examples,
    folds: Sequence[Fold],
    full_accuracy: float,
    seed: int,
    n_jobs: int,
    progress: Progress = silent,
) -> LearningCurve:
    """Return the accuracy against the number of training runs of each class.

    The test folds stay the same; of the training runs of each class at most m are drawn.

    Parameters
    ----------
    classifier : unfitted, with ``fit(X, y, groups)``
    examples : rows that the folds number
    folds : the folds of one repeat
    full_accuracy : accuracy on these folds with all training runs
    seed : of the draws
    n_jobs : processes at once
    progress : called as folds are done
    """
    y, group = examples.terrain, examples.group.astype(str)
    available = [_runs_per_class(y, group, fold.train) for fold in folds]
    sizes = [size for size in CURVE_RUNS if size < max(counts.max() for counts in available)]
    rng = np.random.default_rng((seed, len(CURVE_RUNS)))
    drawn = [
        Fold(draw, size, fold.train[_rows_of_drawn_runs(y, group, fold.train, size, rng)], fold.test)
        for size in sizes
        for draw in range(CURVE_DRAWS)
        for fold in folds
    ]
    results = fit_folds(classifier, examples._replace(group=group), drawn, n_jobs, "learning curve", progress)
    runs, accuracy = [], []
    spread: list[float | None] = []
    for size in sizes:
        draws = [
            _accuracy([r for r in results if r.fold.number == size and r.fold.repeat == draw], y)
            for draw in range(CURVE_DRAWS)
        ]
        runs.append(float(np.mean([np.minimum(counts, size).mean() for counts in available])))
        accuracy.append(float(np.mean(draws)))
        spread.append(float(np.std(draws, ddof=1)))
    runs.append(float(np.mean([counts.mean() for counts in available])))
    accuracy.append(full_accuracy)
    spread.append(None)
    enough = enough_runs(np.array(runs), np.array(accuracy))
    return LearningCurve(tuple(runs), tuple(accuracy), tuple(spread), enough.n_runs, enough.statement)


def _runs_per_class(y: Array, group: Array, rows: Array) -> Array:
    return np.array([len(np.unique(group[rows][y[rows] == terrain])) for terrain in np.unique(y[rows])])


def _rows_of_drawn_runs(y: Array, group: Array, rows: Array, size: int, rng: np.random.Generator) -> Array:
    kept = np.zeros(len(rows), dtype=bool)
    for terrain in np.unique(y[rows]):
        runs = np.unique(group[rows][y[rows] == terrain])
        chosen = rng.permutation(runs)[:size]
        kept |= np.isin(group[rows], chosen) & (y[rows] == terrain)
    return kept


class EnoughRuns(NamedTuple):
    """How many runs of each class are enough; None where that was not reached or cannot be determined."""

    n_runs: int | None
    statement: str


def enough_runs(runs_per_class: Array, accuracy: Array) -> EnoughRuns:
    """Return how many runs of each class would be enough, by the law ``accuracy(m) = a - b m^-c``.

    Enough is the smallest whole m for which doubling gains less than :data:`ENOUGH_GAIN` by that law; it
    is not sought beyond ten times the largest m that was measured.

    Parameters
    ----------
    runs_per_class, accuracy : (k,) measured points; the law needs four

    Examples
    --------
    >>> m = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    >>> enough_runs(m, 0.9 - 0.3 / m).n_runs
    16
    """
    if len(accuracy) < MIN_CURVE_POINTS:
        return EnoughRuns(None, f"{len(accuracy)} sizes are too few to estimate how many runs are enough")
    fit = least_squares(
        lambda p: p[0] - p[1] * runs_per_class ** -p[2] - accuracy,
        x0=[min(accuracy.max() + 0.02, 1.0), 0.3, 0.7],
        bounds=([0.0, 0.0, 0.05], [1.0, 2.0, 3.0]),
    )
    _, scale, power = fit.x
    largest = runs_per_class.max()
    sizes = np.arange(1, int(10 * largest) + 1)
    gain = scale * sizes**-power * (1 - 2.0**-power)
    slack = float(np.interp(largest, sizes, gain))
    found = sizes[gain < ENOUGH_GAIN]
    if not len(found):
        return EnoughRuns(
            None,
            f"not enough yet: doubling the {largest:.1f} runs per class would still gain {slack:.1%}",
        )
    enough = int(found[0])
    verdict = "enough" if enough <= largest else "not enough yet"
    return EnoughRuns(
        enough,
        f"{verdict}: {enough} {'run' if enough == 1 else 'runs'} per class would be enough "
        f"(doubling them gains under {ENOUGH_GAIN:.0%}); "
        f"the data have {largest:.1f} on average, doubling which would gain {slack:.1%}",
    )
