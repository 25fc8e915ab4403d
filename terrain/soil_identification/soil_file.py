"""The soil that was identified, as ``data/soils`` describes soils: each number with its source."""

from __future__ import annotations

import math
from typing import Any

import yaml

from terrain.soil_identification.intervals import Parameter
from terrain.soil_identification.plain_soil import PlainFit
from terrain.terramechanics.soil import load_soil

UNITS = {
    "friction_angle_rad": "rad",
    "shear_modulus_m": "m",
    "kphi_npmn2": "npmn2",
    "slip_sinkage_ratio": "ratio",
}
DIGITS = 4


def soil_yaml(name: str, wheel: str, dataset: str, fit: PlainFit, friction: Parameter, law: str) -> str:
    """Return the text of a soil file.

    Parameters
    ----------
    name : of the soil
    wheel, dataset : of the trials
    fit : of the simulator's law
    friction : tangent of the friction angle, of the law of stresses ``law``
    law : its name
    """
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
