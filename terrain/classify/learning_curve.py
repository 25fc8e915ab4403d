"""How many runs of each class are enough, by the law of a learning curve."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from terrain.records import Array

MIN_CURVE_POINTS = 4
"""The law of the learning curve has three parameters."""
ENOUGH_GAIN = 0.01
"""Enough runs: doubling them would gain less than this accuracy."""


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
            f"not enough yet: doubling the {largest:.1f} runs per class would still gain {_percent(slack, 1)}",
        )
    enough = int(found[0])
    verdict = "enough" if enough <= largest else "not enough yet"
    return EnoughRuns(
        enough,
        f"{verdict}: {enough} {'run' if enough == 1 else 'runs'} per class would be enough "
        f"(doubling them gains under {_percent(ENOUGH_GAIN, 0)}); "
        f"the data have {largest:.1f} on average, doubling which would gain {_percent(slack, 1)}",
    )


def _percent(ratio: float, decimals: int) -> str:
    return f"{100 * ratio:.{decimals}f}\N{NO-BREAK SPACE}%"
