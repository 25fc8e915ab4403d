"""Accuracy against the number of training runs of each class, and how many are enough by the law of this curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from terrain.classify.folds import Fold
from terrain.records import Array

CURVE_RUNS = (1, 2, 3, 5, 8, 12)
CURVE_DRAWS = 2
MIN_CURVE_POINTS = 4
"""The law of the learning curve has three parameters."""
ENOUGH_GAIN = 0.01
"""Enough runs: doubling them would gain less than this accuracy."""


class LearningCurve(NamedTuple):
    """Accuracy against the number of training runs of each class.

    Parameters
    ----------
    runs_per_class : mean over classes and folds, since a class may have fewer than were asked for
    accuracy : with so many training runs
    accuracy_spread : over draws of runs; None for all runs
    enough_runs : the number of runs beyond which doubling brings next to nothing; None when not reached
    statement : the same in a sentence
    """

    runs_per_class: tuple[float, ...]
    accuracy: tuple[float, ...]
    accuracy_spread: tuple[float | None, ...]
    enough_runs: int | None
    statement: str


def drawn_folds(y: Array, group: Array, folds: Sequence[Fold], seed: int) -> tuple[list[Fold], Array]:
    """Draw at most m training runs of each class, for each m of :data:`CURVE_RUNS`; test rows stay the same.

    Parameters
    ----------
    y, group : (n,) class and run of each row
    folds : those of one repeat
    seed : of the draws

    Returns
    -------
    folds : :data:`CURVE_DRAWS` repeats a size
    runs_per_class : of each size, and of all runs
    """
    available = [
        np.array([len(set(group[train][y[train] == name])) for name in np.unique(y[train])])
        for _, _, train, _ in folds
    ]
    sizes = [size for size in CURVE_RUNS if size < max(counts.max() for counts in available)]
    rng = np.random.default_rng((seed, len(CURVE_RUNS)))
    drawn = []
    for number, size in enumerate(sizes):
        for draw in range(CURVE_DRAWS):
            for _, fold, train, test in folds:
                kept = np.zeros(len(train), dtype=bool)
                for terrain in np.unique(y[train]):
                    of_class = y[train] == terrain
                    chosen = rng.permutation(np.unique(group[train][of_class]))[:size]
                    kept |= np.isin(group[train], chosen) & of_class
                drawn.append(Fold(CURVE_DRAWS * number + draw, fold, train[kept], test))
    means = [[np.minimum(counts, size).mean() for counts in available] for size in (*sizes, len(y))]
    return drawn, np.mean(means, axis=1)


def learning_curve(runs_per_class: Array, drawn: Sequence[float], full: float) -> LearningCurve:
    """Return the curve through the accuracies of :func:`drawn_folds`, in their order, and that of all runs."""
    by_size = np.reshape(drawn, (-1, CURVE_DRAWS))
    accuracy = np.append(by_size.mean(axis=1), full)
    spread = (*by_size.std(axis=1, ddof=1).tolist(), None)
    enough = enough_runs(runs_per_class, accuracy)
    return LearningCurve(tuple(runs_per_class.tolist()), tuple(accuracy.tolist()), spread, *enough)


def enough_runs(runs_per_class: Array, accuracy: Array) -> tuple[int | None, str]:
    """Return how many runs of each class would be enough by the law ``accuracy(m) = a - b m^-c``, and a sentence.

    Enough is the smallest whole m for which doubling gains less than :data:`ENOUGH_GAIN` by that law; it
    is not sought beyond ten times the largest m that was measured, and is None beyond, or with too few points.

    Parameters
    ----------
    runs_per_class, accuracy : (k,) measured points; the law needs four

    Examples
    --------
    >>> m = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    >>> enough_runs(m, 0.9 - 0.3 / m)[0]
    16
    """
    if len(accuracy) < MIN_CURVE_POINTS:
        return (None, f"{len(accuracy)} sizes are too few to estimate how many runs are enough")
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
        return (
            None,
            f"not enough yet: doubling the {largest:.1f} runs per class would still gain {_percent(slack, 1)}",
        )
    enough = int(found[0])
    verdict = "enough" if enough <= largest else "not enough yet"
    return (
        enough,
        f"{verdict}: {enough} {'run' if enough == 1 else 'runs'} per class would be enough "
        f"(doubling them gains under {_percent(ENOUGH_GAIN, 0)}); "
        f"the data have {largest:.1f} on average, doubling which would gain {_percent(slack, 1)}",
    )


def _percent(ratio: float, decimals: int) -> str:
    return f"{100 * ratio:.{decimals}f}\N{NO-BREAK SPACE}%"
