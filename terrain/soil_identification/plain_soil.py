"""The soil of the simulator's own law, fitted to trials, and its file as ``data/soils`` describes soils.

``terrain simulate`` has one number for the limit of the thrust, one for its rise and Bekker's sinkage, with
the force along the resultant slip (:func:`~terrain.terramechanics.traction.wheel_ground`).  Of one wheel
under one load in dry sand four numbers can be fitted: friction, shear modulus, kphi and slip sinkage.
Cohesion is taken as 0, kc as 0 (it needs wheels of two widths) and the exponent n as 1 (it needs two loads).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import yaml

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.errors import DataError
from terrain.identify import Parameter, identify
from terrain.records import Array
from terrain.soil_identification.fit import FORCE_MISFIT_RATIO, Prediction, SoilParameter
from terrain.soil_identification.trials import Trials, Wheel
from terrain.terramechanics.soil import Soil, load_soil
from terrain.terramechanics.traction import ground_record, wheel_ground

PARAMETERS = ("friction_angle_rad", "shear_modulus_m", "kphi_npmn2", "slip_sinkage_ratio")
_START, _LOW, _HIGH = (
    np.log(row) for row in ([0.5, 0.01, 1e6, 0.5], [0.05, 1e-4, 1e3, 1e-3], [1.1, 0.5, 1e9, 5.0])
)
"""They are identified by their logarithms."""

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
    given = _START.copy()
    if not math.isnan(friction_angle_rad):
        given[0] = math.log(friction_angle_rad)
    free = slice(0 if math.isnan(friction_angle_rad) else 1, None)
    parameters = [
        Parameter(name, *bounds)
        for name, *bounds in zip(PARAMETERS[free], given[free], _LOW[free], _HIGH[free], strict=True)
    ]

    def identified(weight: Array, start: Array) -> Array:
        """Return the logarithms (4,) that fit trials with weights (n,) best."""

        def misfit(free_logs: Array) -> Array:
            given[free] = free_logs
            found = plain_prediction(plain_soil(np.exp(given), "fit"), trials, wheel)
            forces = found.pull_n - trials.pull_n, found.side_n - trials.side_n
            misses = [force / trials.load_n / FORCE_MISFIT_RATIO for force in forces]
            return np.concatenate(
                [weight * miss for miss in (*misses, (found.sinkage_m - trials.sinkage_m) / SINKAGE_M)]
            )

        own = identify(misfit, parameters, starts=[start[free]], max_nfev=60).value
        return np.concatenate([given[: len(given) - len(own)], own])

    best = identified(np.ones(len(trials)), given.copy())
    counts = bootstrap_counts(len(trials), n_draws, seed)
    draws = np.exp([identified(np.sqrt(count), best) for count in counts]).reshape(-1, len(PARAMETERS))
    intervals = dict.fromkeys(PARAMETERS, (math.nan, math.nan))
    if n_draws:
        intervals |= zip(PARAMETERS[free], map(percentile_interval, draws.T[free]), strict=True)
    return PlainFit(
        dict(zip(PARAMETERS, np.exp(best).tolist(), strict=True)), intervals, int(trials.n_trials.sum())
    )


UNITS = {
    "friction_angle_rad": "rad",
    "shear_modulus_m": "m",
    "kphi_npmn2": "npmn2",
    "slip_sinkage_ratio": "ratio",
}
DIGITS = 4


def soil_yaml(name: str, wheel: str, dataset: str, fit: PlainFit, friction: SoilParameter, law: str) -> str:
    """Return the text of a soil file."""
    described: dict[str, Any] = {"name": name, "law": "janosi"}
    described["rolling_resistance_ratio"] = _entry(
        0.0, "ratio", "assumed: a rigid wheel has no loss of its own"
    )
    described["slip_sinkage_ratio"] = _measured("slip_sinkage_ratio", wheel, dataset, fit)
    borrowed = load_soil("dry_sand").roughness_m3
    described["roughness_m3"] = _entry(borrowed, "m3", "assumed: that of dry_sand; a testbed has none")
    described["cohesion_pa"] = _entry(
        0.0, "pa", "assumed: under one load cohesion cannot be separated from friction"
    )
    low, high = (math.atan(bound) for bound in friction.interval)
    source = (
        f"terrain calibrate on {dataset}, {wheel} wheel, law {law}; 95 % over settings of slip and angle: "
        f"{low:.3f} to {high:.3f} rad"
    )
    described["friction_angle_rad"] = _entry(math.atan(friction.value), "rad", source)
    described["shear_modulus_m"] = _measured("shear_modulus_m", wheel, dataset, fit)
    described["kc_npmn1"] = _entry(0.0, "npmn1", "assumed: one width of wheel says nothing of it")
    described["kphi_npmn2"] = _measured("kphi_npmn2", wheel, dataset, fit)
    described["sinkage_exponent_ratio"] = _entry(1.0, "ratio", "assumed: one load says nothing of it")
    head = f"# Dry sand of a wheel testbed, identified from {fit.n_trials} trials of the {wheel} wheel.\n"
    return head + yaml.safe_dump(described, sort_keys=False, width=1000, allow_unicode=True)


def _measured(parameter: str, wheel: str, dataset: str, fit: PlainFit) -> dict[str, Any]:
    low, high = fit.intervals[parameter]
    source = (
        f"terrain calibrate on {dataset}, {fit.n_trials} trials of the {wheel} wheel, nearly straight, law of "
        f"the simulator; 95 % over settings: {low:.4g} to {high:.4g}"
    )
    return _entry(fit.values[parameter], UNITS[parameter], source)


def _entry(value: float, unit: str, source: str) -> dict[str, Any]:
    return {"value": float(f"{value:.{DIGITS}g}"), "unit": unit, "source": source}
