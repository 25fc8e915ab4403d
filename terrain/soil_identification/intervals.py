"""What trials say of each parameter of a law: value, interval, and whether they say anything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.records import Array
from terrain.soil_identification.fit import IDENTIFIED_RATIO, LawFit, fit_law, predict
from terrain.soil_identification.laws import SINKAGES, Law
from terrain.soil_identification.trials import Trials, Wheel
from terrain.terramechanics.inflow_wheel import FORCE

EDGE = 1e-3
"""In standard deviations of the prior: a value so near to its bound stands at it."""


class Parameter(NamedTuple):
    """A parameter of a law.

    Parameters
    ----------
    name : ends in its unit, or in ``ratio`` or ``exponent``
    value : of the fit to all trials
    interval : 95 % over bootstrap samples of the settings of slip and angle, and the fit's own value
    prior_std : standard deviation that the prior holds it with
    informed_ratio : standard deviation with the trials over that without them
    identified : whether the trials narrow it to less than half, away from its bounds
    """

    name: str
    value: float
    interval: tuple[float, float]
    prior_std: float
    informed_ratio: float
    identified: bool


def parameters_of(
    fit: LawFit, trials: Trials, n_draws: int, seed: int, on_draw: Callable[[], None] = lambda: None
) -> dict[str, Parameter]:
    """Return the parameters of a fitted law by name, those of the sinkage first.

    Whole settings are drawn, as repeats of a trial share what a law misses.

    Parameters
    ----------
    fit : to all trials
    trials : means of settings, as they were fitted
    n_draws, seed : of the bootstrap
    on_draw : called after each sample
    """
    counts = bootstrap_counts(len(trials), n_draws, seed)
    draws = []
    for count in counts:
        rows = np.flatnonzero(count)
        sample = trials.chosen(rows)
        weighed = replace(sample, n_trials=sample.n_trials * count[rows])
        draws.append(fit_law(fit.law, weighed, fit.wheel, start=fit))
        on_draw()
    of_sinkage = SINKAGES[fit.law.sinkage]
    found = {}
    for i, (name, (_, prior_std)) in enumerate(of_sinkage.items()):
        drawn = np.array([draw.sinkage[i] for draw in draws])
        bounds = 0.0, np.inf
        found[name] = _parameter(name, fit.sinkage[i], drawn, fit.sinkage_std[i], prior_std, bounds)
    for i, name in enumerate(fit.law.free):
        drawn = np.array([draw.force[i] for draw in draws])
        _, prior_std, *limits = FORCE[name]
        found[name] = _parameter(name, fit.force[i], drawn, fit.force_std[i], prior_std, limits)
    return found


def _parameter(
    name: str, value: float, draws: Array, std: float, prior_std: float, bounds: Sequence[float]
) -> Parameter:
    low, high = percentile_interval(draws) if len(draws) else (np.nan, np.nan)
    informed = float(std / prior_std)
    at_bound = min(value - bounds[0], bounds[1] - value) < EDGE * prior_std
    return Parameter(
        name,
        float(value),
        (min(low, float(value)), max(high, float(value))),
        prior_std,
        informed,
        informed < IDENTIFIED_RATIO and not at_bound,
    )


class CohesionRow(NamedTuple):
    """A fit with a cohesion that is given: friction that goes with it, and the sum of squares of the fit."""

    cohesion_pa: float
    friction_angle_rad: float
    cost: float


def cohesion_profile(
    law: Law, trials: Trials, wheel: Wheel, cohesions_pa: Sequence[float]
) -> list[CohesionRow]:
    """Return how much less friction goes with a cohesion that is given.

    Parameters
    ----------
    law, trials, wheel : as :func:`~terrain.soil_identification.fit.fit_law` takes them
    cohesions_pa : values to hold
    """
    rows = []
    place = law.free.index("tan_friction")
    for cohesion_pa in cohesions_pa:
        held = law._replace(fixed={**law.fixed, "cohesion_pa": cohesion_pa})
        fit = fit_law(held, trials, wheel)
        rows.append(CohesionRow(cohesion_pa, float(np.arctan(fit.force[place])), fit.cost))
    return rows


class ModulusSpread(NamedTuple):
    """Pressure in Pa at a depth of one wheel width that carries the measured load at the measured sinkage.

    Parameters
    ----------
    rolling_pa : median of trials that roll straight ahead, |slip| below 0.3 and angle below 8 degrees
    smallest_pa, largest_pa : 5 and 95 % over all trials
    load_error_ratio : root mean square of the logarithm of the load by the median modulus over the measured
    """

    rolling_pa: float
    smallest_pa: float
    largest_pa: float
    load_error_ratio: float


def modulus_spread(fit: LawFit, trials: Trials) -> ModulusSpread:
    """Return how the apparent modulus of the soil differs from trial to trial."""
    modulus = predict(fit, trials, "sinkage").modulus_pa
    straight = (np.abs(trials.slip_ratio) < 0.3) & (np.abs(trials.angle_setting) < 8.0)
    rolling = float(np.median(modulus[straight])) if straight.any() else np.nan
    low, high = np.quantile(modulus, [0.05, 0.95]).tolist()
    spread = np.log(modulus / np.median(modulus))
    return ModulusSpread(rolling, low, high, float(np.sqrt(np.mean(spread**2))))
