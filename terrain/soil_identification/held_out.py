"""How well a law predicts trials at slips and slip angles that its fit did not have."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from terrain.records import Array
from terrain.soil_identification.fit import fit_law, predict
from terrain.soil_identification.laws import Law, Prediction
from terrain.soil_identification.trials import Trials, Wheel, setting_means

HELD_OUT = {"slip": "slip_setting", "angle": "angle_setting"}
"""What is held out in turn: all trials of one commanded wheel speed, or of one slip angle."""

GIVEN = ("load", "sinkage")

REGIMES: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "skidding, 0 to 30 deg": ((-1.1, -0.1), (0.0, 31.0)),
    "skidding, 45 to 75 deg": ((-1.1, -0.1), (31.0, 76.0)),
    "skidding, 90 deg": ((-1.1, -0.1), (76.0, 91.0)),
    "rolling, 0 to 30 deg": ((-0.1, 0.1), (0.0, 31.0)),
    "rolling, 45 to 75 deg": ((-0.1, 0.1), (31.0, 76.0)),
    "rolling, 90 deg": ((-0.1, 0.1), (76.0, 91.0)),
    "driving, 0 to 30 deg": ((0.1, 1.1), (0.0, 31.0)),
    "driving, 45 to 75 deg": ((0.1, 1.1), (31.0, 76.0)),
    "driving, 90 deg": ((0.1, 1.1), (76.0, 91.0)),
}
"""Ranges of slip and of the slip angle's size in degrees, by which misfits are shown."""


class Misfit(NamedTuple):
    """Root mean square errors: of both forces over the load, and of the sinkage in m; NaN of no trial."""

    n_trials: int
    pull_ratio: float
    side_ratio: float
    sinkage_m: float

    @property
    def forces(self) -> str:
        """The errors of traction and side force, in words."""
        return f"{100.0 * self.pull_ratio:.1f} % and {100.0 * self.side_ratio:.1f} %"


Predictor = Callable[[Trials, Trials], dict[str, Prediction]]
"""From training trials (means of settings) and tested trials to predictions by what is given."""


def law_predictor(law: Law, wheel: Wheel) -> Predictor:
    """Return what fits a law to the first trials and predicts the second, by each of :data:`GIVEN`."""

    def predictions(training: Trials, tested: Trials) -> dict[str, Prediction]:
        fit = fit_law(law, training, wheel)
        return {given: predict(fit, tested, given) for given in GIVEN}

    return predictions


def folds(trials: Trials, held_out: str) -> Iterator[tuple[Array, Array]]:
    """Give masks (n,) of training and of tested trials, for each setting in turn.

    Parameters
    ----------
    trials : single ones
    held_out : a key of :data:`HELD_OUT`
    """
    setting = getattr(trials, HELD_OUT[held_out])
    for value in np.unique(setting):
        yield setting != value, setting == value


def held_out_predictions(
    trials: Trials, predictor: Predictor, held_out: str, on_fold: Callable[[], None] = lambda: None
) -> dict[str, Prediction]:
    """Return predictions of all trials, each by a fit without its slip or its angle.

    Parameters
    ----------
    trials : single ones
    predictor : fits and predicts
    held_out : ``slip`` or ``angle``
    on_fold : called after each fit

    Raises
    ------
    DataError
        if too few settings are left to fit.
    """
    found: dict[str, list[Array]] = {}
    for training, tested in folds(trials, held_out):
        for given, part in predictor(setting_means(trials.chosen(training)), trials.chosen(tested)).items():
            whole = found.setdefault(given, [np.full(len(trials), np.nan) for _ in part])
            for all_trials, these in zip(whole, part, strict=True):
                all_trials[tested] = these
        on_fold()
    return {given: Prediction(*whole) for given, whole in found.items()}


def misfit(trials: Trials, prediction: Prediction, rows: Array | None = None) -> Misfit:
    """Return the errors of a prediction of trials, or of those of a mask (n,)."""
    rows = np.ones(len(trials), dtype=bool) if rows is None else rows
    if not rows.any():
        return Misfit(0, np.nan, np.nan, np.nan)
    errors = (
        (prediction.pull_n - trials.pull_n) / trials.load_n,
        (prediction.side_n - trials.side_n) / trials.load_n,
        prediction.sinkage_m - trials.sinkage_m,
    )
    pull, side, sinkage = (float(np.sqrt(np.mean(error[rows] ** 2))) for error in errors)
    return Misfit(int(rows.sum()), pull, side, sinkage)


def regime_misfits(trials: Trials, prediction: Prediction) -> dict[str, Misfit]:
    """Return the errors by :data:`REGIMES`, of those that have trials."""
    angle = np.abs(trials.angle_setting)
    rows = {
        name: (trials.slip_ratio >= slow) & (trials.slip_ratio < fast) & (angle >= straight) & (angle < aside)
        for name, ((slow, fast), (straight, aside)) in REGIMES.items()
    }
    return {name: misfit(trials, prediction, mask) for name, mask in rows.items() if mask.any()}


def setting_misfits(trials: Trials, prediction: Prediction, held_out: str) -> dict[float, Misfit]:
    """Return the errors by the setting that was held out."""
    setting = getattr(trials, HELD_OUT[held_out])
    return {
        float(value): misfit(trials, prediction, setting == value) for value in np.unique(setting).tolist()
    }
