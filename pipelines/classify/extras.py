"""The honest extras beside the headline: speed alone, slow against fast, and how many runs are enough."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from sklearn.base import BaseEstimator

from features.windows import wheel_speeds
from pipelines.classify.evaluation import fit_folds
from pipelines.classify.splits import Fold, Samples
from pipelines.reporting.progress import Progress, silent
from terrain.logs.schema import signal_set_of
from terrain.records import Array, Windows

MIN_RUNS_A_SIDE = 2
MIN_TIME_A_SIDE_S = 60.0
MIN_CLASSES = 3
MOVING_MPS = 0.03
"""The faster wheel moves above this; it is the steady-motion rule's own threshold."""

CURVE_RUNS = (1, 2, 3, 5, 8, 12)
CURVE_DRAWS = 2
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


def slow_fast_split(samples: Samples) -> dict[str, Any]:
    """Split the runs of each class at their median speed, taken over the run's time on that class.

    Returns
    -------
    dict
        ``status`` (``applicable`` or ``not applicable``), ``classes`` with the speeds of both sides,
        ``left_out`` with the reason for each class, and ``slow`` and ``fast`` (run, class) pairs.
    """
    windows = samples.cut.windows
    run_id, y = windows.run_id.astype(str), windows.terrain.astype(str)
    sides: dict[str, list[tuple[str, str]]] = {"slow": [], "fast": []}
    kept: dict[str, dict[str, float]] = {}
    left_out: dict[str, str] = {}
    for terrain in np.unique(y):
        speeds = run_speeds(windows[y == terrain])
        runs = [run for run in np.unique(run_id[y == terrain]) if np.isfinite(speeds[run])]
        speed = np.array([speeds[run] for run in runs])
        slow = [run for run in runs if speeds[run] <= np.median(speed)]
        fast = [run for run in runs if speeds[run] > np.median(speed)]
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
            left_out[str(terrain)] = reason
            continue
        kept[str(terrain)] = {
            "slow_mps": float(np.median([speeds[run] for run in slow])),
            "fast_mps": float(np.median([speeds[run] for run in fast])),
        }
        sides["slow"] += [(run, str(terrain)) for run in slow]
        sides["fast"] += [(run, str(terrain)) for run in fast]
    status = "applicable" if len(kept) >= MIN_CLASSES else "not applicable"
    return {"status": status, "classes": kept, "left_out": left_out, **sides}


def slow_fast(
    classifier: BaseEstimator, features: Array, samples: Samples, n_jobs: int, progress: Progress = silent
) -> dict[str, Any]:
    """Train on the slow runs of each class and test on the fast ones, and back.

    A run that is slow on one class and fast on another has no part in either.
    """
    split = slow_fast_split(samples)
    slow, fast = split.pop("slow"), split.pop("fast")
    if split["status"] != "applicable":
        return {**split, "slow_to_fast": None, "fast_to_slow": None}
    windows = samples.cut.windows
    run_id, y = windows.run_id.astype(str), windows.terrain.astype(str)
    both = {run for run, _ in slow} & {run for run, _ in fast}
    pairs = list(zip(run_id, y, strict=True))
    rows_slow, rows_fast = (
        np.array([i for i, pair in enumerate(pairs) if pair in set(side) and pair[0] not in both])
        for side in (slow, fast)
    )
    folds = [Fold(0, 0, rows_slow, rows_fast), Fold(0, 1, rows_fast, rows_slow)]
    results = fit_folds(classifier, features, y, samples.group, folds, n_jobs, "slow to fast", progress)
    accuracy = [_accuracy([result], y) for result in results]
    return {**split, "slow_to_fast": accuracy[0], "fast_to_slow": accuracy[1]}


def _accuracy(results: Sequence[Any], y: Array) -> float:
    classes = np.unique(y)
    right = [classes[r.probability.argmax(axis=1)] == y[r.fold.test] for r in results]
    return float(np.concatenate(right).mean())


def fold_accuracy(
    classifier: BaseEstimator,
    features: Array,
    samples: Samples,
    folds: Sequence[Fold],
    n_jobs: int,
    task: str,
    progress: Progress = silent,
) -> float:
    """Return the accuracy over the folds of one repeat."""
    y = samples.cut.windows.terrain.astype(str)
    return _accuracy(fit_folds(classifier, features, y, samples.group, folds, n_jobs, task, progress), y)


def learning_curve(
    classifier: BaseEstimator,
    features: Array,
    samples: Samples,
    folds: Sequence[Fold],
    full_accuracy: float,
    seed: int,
    n_jobs: int,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Return the accuracy against the number of training runs of each class.

    The test folds stay what they are; of the training runs of each class at most m are drawn.

    Parameters
    ----------
    folds : the folds of one repeat
    full_accuracy : accuracy on these folds with all training runs

    Returns
    -------
    dict
        ``runs_per_class`` (mean over classes and folds, since a class may have fewer than were asked
        for), ``accuracy``, ``accuracy_spread`` (over draws of runs; None for all runs), ``enough_runs``
        (None when not reached) and ``statement``, from :func:`enough_runs`.
    """
    y, group = samples.cut.windows.terrain.astype(str), samples.group.astype(str)
    available = [_runs_per_class(y, group, fold.train) for fold in folds]
    sizes = [size for size in CURVE_RUNS if size < max(counts.max() for counts in available)]
    rng = np.random.default_rng((seed, len(CURVE_RUNS)))
    drawn = [
        Fold(draw, size, fold.train[_rows_of_drawn_runs(y, group, fold.train, size, rng)], fold.test)
        for size in sizes
        for draw in range(CURVE_DRAWS)
        for fold in folds
    ]
    results = fit_folds(classifier, features, y, group, drawn, n_jobs, "learning curve", progress)
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
    return {
        "runs_per_class": runs,
        "accuracy": accuracy,
        "accuracy_spread": spread,
        **enough_runs(np.array(runs), np.array(accuracy)),
    }


def _runs_per_class(y: Array, group: Array, rows: Array) -> Array:
    return np.array([len(np.unique(group[rows][y[rows] == terrain])) for terrain in np.unique(y[rows])])


def _rows_of_drawn_runs(y: Array, group: Array, rows: Array, size: int, rng: np.random.Generator) -> Array:
    kept = np.zeros(len(rows), dtype=bool)
    for terrain in np.unique(y[rows]):
        runs = np.unique(group[rows][y[rows] == terrain])
        chosen = rng.permutation(runs)[:size]
        kept |= np.isin(group[rows], chosen) & (y[rows] == terrain)
    return kept


def enough_runs(runs_per_class: Array, accuracy: Array) -> dict[str, Any]:
    """Return how many runs a class would be enough, from ``accuracy(m) = a - b m^-c``.

    Enough is the smallest whole m for which doubling gains less than :data:`ENOUGH_GAIN` by that law; it
    is not sought beyond ten times the largest m that was measured.

    Parameters
    ----------
    runs_per_class, accuracy : (k,) measured points; the law needs four

    Examples
    --------
    >>> m = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    >>> enough_runs(m, 0.9 - 0.3 / m)["enough_runs"]
    16
    """
    if len(accuracy) < 4:
        return {
            "enough_runs": None,
            "statement": f"{len(accuracy)} sizes are too few to tell how many runs are enough",
        }
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
        return {
            "enough_runs": None,
            "statement": (
                f"not enough yet: doubling the {largest:.1f} runs a class would still gain {slack:.1%}"
            ),
        }
    enough = int(found[0])
    verdict = "enough" if enough <= largest else "not enough yet"
    return {
        "enough_runs": enough,
        "statement": (
            f"{verdict}: {enough} {'run' if enough == 1 else 'runs'} a class would be enough "
            f"(doubling them gains under {ENOUGH_GAIN:.0%}); "
            f"the data have {largest:.1f} on average, doubling which would gain {slack:.1%}"
        ),
    }
