"""The soil of the simulator's own law, fitted to trials.

``terrain simulate`` has one number for the limit of the thrust, one for its rise and Bekker's sinkage, with
the force along the resultant slip (:func:`~terrain.terramechanics.traction.wheel_ground`).  Of one wheel
under one load in dry sand four numbers can be fitted: friction, shear modulus, kphi and slip sinkage.
Cohesion is taken as 0, kc as 0 (it needs wheels of two widths) and the exponent n as 1 (it needs two loads).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.errors import DataError
from terrain.records import Array
from terrain.soil_identification.fit import FORCE_MISFIT_RATIO
from terrain.soil_identification.laws import Prediction
from terrain.soil_identification.trials import Trials, Wheel
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import ground_record, wheel_ground

PARAMETERS = ("friction_angle_rad", "shear_modulus_m", "kphi_npmn2", "slip_sinkage_ratio")
_START = np.array([0.5, 0.01, 1e6, 0.5])
_LOW, _HIGH = np.array([0.05, 1e-4, 1e3, 1e-3]), np.array([1.1, 0.5, 1e9, 5.0])
MAX_ANGLE_DEG, MIN_SLIP = 31.0, -0.6
"""Of trials that roll nearly straight, as a robot's wheels do."""

SINKAGE_M = 5e-3
"""Error of the sinkage that weighs as much as one of the forces of a tenth of the load."""


class PlainFit(NamedTuple):
    """Values and 95 % intervals of :data:`PARAMETERS`, NaN of what was held, and the number of trials."""

    values: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    n_trials: int


def plain_soil(values: Array, name: str) -> Soil:
    """Return the soil of fitted values (4,) in the order of :data:`PARAMETERS`."""
    named = dict(zip(PARAMETERS, np.asarray(values).tolist(), strict=True))
    return Soil(
        name,
        "janosi",
        rolling_resistance_ratio=0.0,
        roughness_m3=0.0,
        cohesion_pa=0.0,
        kc_npmn1=0.0,
        sinkage_exponent_ratio=1.0,
        **named,
    )


def plain_prediction(soil: Soil, trials: Trials, wheel: Wheel) -> Prediction:
    """Return what the simulator's law predicts; its apparent modulus is NaN.

    Lateral slip is over the larger of both speeds along the wheel, as in the simulator.

    Parameters
    ----------
    soil, trials, wheel : of the prediction
    """
    ground = ground_record(soil, wheel.tip_radius_m, wheel.width_m, 0.0)[0]
    out = np.full((len(trials), 4), np.nan)
    for i, (omega, travel, angle, load) in enumerate(trials.motion):
        speed, ahead, across = omega * wheel.radius_m, travel * math.cos(angle), travel * math.sin(angle)
        fastest = max(speed, abs(ahead), 1e-9)
        slip_x, slip_y = (speed - ahead) / fastest, across / fastest
        thrust, side, resistance, sinkage = wheel_ground(ground, load, slip_x, slip_y)
        out[i] = thrust - resistance, side, sinkage, math.nan
    return Prediction(*out.T)


def nearly_straight(trials: Trials) -> Trials:
    """Return the trials that roll nearly straight ahead, and do not skid much."""
    return trials.chosen((np.abs(trials.angle_setting) < MAX_ANGLE_DEG) & (trials.slip_ratio > MIN_SLIP))


def fit_plain_soil(
    trials: Trials,
    wheel: Wheel,
    friction_angle_rad: float = math.nan,
    n_draws: int = 0,
    seed: int = 0,
) -> PlainFit:
    """Return the soil that fits trials best.

    Parameters
    ----------
    trials : means of settings
    wheel : of the trials
    friction_angle_rad : to hold; NaN to fit it with the others
    n_draws, seed : of the bootstrap over settings

    Raises
    ------
    DataError
        if there are fewer settings than parameters.
    """
    if len(trials) < len(PARAMETERS):
        raise DataError(f"trials have {len(trials)} settings, the simulator's law needs {len(PARAMETERS)}")
    fixed = 0 if math.isnan(friction_angle_rad) else 1
    start = _START.copy()
    if fixed:
        start[0] = friction_angle_rad
    best = _fitted(trials, wheel, np.ones(len(trials)), start, fixed)
    draws = [
        _fitted(trials, wheel, np.sqrt(counts), best, fixed)
        for counts in bootstrap_counts(len(trials), n_draws, seed)
    ]
    columns = np.array(draws).T if draws else np.full((len(PARAMETERS), 1), np.nan)
    intervals = [
        percentile_interval(column) if draws and place >= fixed else (math.nan, math.nan)
        for place, column in enumerate(columns)
    ]
    return PlainFit(
        dict(zip(PARAMETERS, best.tolist(), strict=True)),
        dict(zip(PARAMETERS, intervals, strict=True)),
        int(trials.n_trials.sum()),
    )


def _fitted(trials: Trials, wheel: Wheel, weight: Array, start: Array, fixed: int) -> Array:
    def whole(scaled: Array) -> Array:
        return np.concatenate([start[:fixed], np.exp(scaled)])

    def misfit(scaled: Array) -> Array:
        found = plain_prediction(plain_soil(whole(scaled), "fit"), trials, wheel)
        return np.concatenate(
            [
                weight * (found.pull_n - trials.pull_n) / trials.load_n / FORCE_MISFIT_RATIO,
                weight * (found.side_n - trials.side_n) / trials.load_n / FORCE_MISFIT_RATIO,
                weight * (found.sinkage_m - trials.sinkage_m) / SINKAGE_M,
            ]
        )

    low, high = np.log(_LOW[fixed:]), np.log(_HIGH[fixed:])
    begin = np.clip(np.log(start[fixed:]), low + 1e-6, high - 1e-6)
    return whole(least_squares(misfit, begin, bounds=(low, high), max_nfev=60).x)
