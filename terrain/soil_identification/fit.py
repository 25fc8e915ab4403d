"""A law of a wheel in sand fitted to trials, and what the trials say of each of its parameters.

A candidate law is which terms of the wheel's stresses are there, and which law gives the sinkage.  It is fitted
sinkage first, then the forces at the sinkage that it predicts.  Both fits are least squares
(:func:`terrain.identify.identify`) with weak normal priors, which hold what the trials do not::

    sum over settings of n ((z - z') / 2 mm)^2             + sum of ((p - p0) / s)^2
    sum over settings of n (((Fx - Fx') / W / 0.1)^2 + ((Fy - Fy') / W / 0.1)^2) + sum of ((p - p0) / s)^2

n is the number of trials of a setting over the mean number, and 2 mm and 0.1 are what such laws miss by, of
which the repeats of a trial (0.8 mm, 0.04) are a small part.  A parameter is ``identified`` where the trials
narrow its prior to less than half.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.bootstrap import bootstrap_counts, percentile_interval
from terrain.identify import Fit, Parameter, identify
from terrain.records import Array
from terrain.soil_identification.trials import Trials, Wheel
from terrain.terramechanics.inflow_wheel import FORCE, NAMES, bulldozing_ratio, wheel_forces
from terrain.terramechanics.travel_sinkage import (
    DEEPEST_RATIO,
    DING,
    LYASKO,
    TRAVEL,
    ding_sinkage,
    lyasko_sinkage,
    travel_sinkage,
)

SINKAGES: dict[str, dict[str, tuple[float, float]]] = {"travel": TRAVEL, "lyasko": LYASKO, "ding": DING}
"""Parameters of each law of sinkage."""


class Law(NamedTuple):
    """A law of the forces and one of the sinkage.

    Parameters
    ----------
    name : of both
    sinkage : one of :data:`SINKAGES`
    free : parameters of :data:`~terrain.terramechanics.inflow_wheel.FORCE` that are fitted
    fixed : value of each other one that is not where its fit would begin
    tied : whether the side face's pressure is that of the friction angle
    text : what it is, for readers
    """

    name: str
    sinkage: str
    free: tuple[str, ...]
    fixed: Mapping[str, float]
    tied: bool
    text: str


_ARC = ("pressure_exponent", "peak_ratio", "peak_slip_ratio", "exit_ratio", "tan_friction", "shear_modulus_m")
_NO_SIDE = {
    "exit_slip_ratio": 0.0,
    "side_inflow_ratio": 0.0,
    "side_pressure_ratio": 0.0,
    "side_friction_ratio": 0.0,
    "side_lift_ratio": 0.0,
    "inflow": 0.0,
}
_BULLDOZING = _NO_SIDE | {"side_depth_exponent": 1.0, "travel_exponent": 1.0, "rotation_exponent": 0.0}
_BEKKER = {"peak_ratio": 0.0, "peak_slip_ratio": 0.0, "exit_ratio": 0.0}
ALL = tuple(name for name in NAMES if name not in ("cohesion_pa", "inflow"))

LAWS: dict[str, Law] = {
    law.name: law
    for law in (
        Law(
            "bekker",
            "lyasko",
            ("pressure_exponent", "tan_friction", "shear_modulus_m"),
            _NO_SIDE | _BEKKER,
            False,
            "Bekker's pressure by depth in front of the axle, Janosi's shear, Lyasko's sinkage",
        ),
        Law(
            "wong_reece", "lyasko", _ARC, _NO_SIDE, False, "Wong and Reece's peak and exit, Lyasko's sinkage"
        ),
        Law("ishigami", "lyasko", _ARC, _BULLDOZING, True, "and Ishigami's bulldozing of the side face"),
        Law("ishigami_ding", "ding", _ARC, _BULLDOZING, True, "the same with Ding's sinkage"),
        Law("ishigami_travel", "travel", _ARC, _BULLDOZING, True, "the same with the sinkage by travel"),
        Law("inflow", "travel", ALL, {}, False, "inflow of soil, friction and lift of the side face"),
    )
}
"""By name, from the plainest to the one that holds."""


class Prediction(NamedTuple):
    """Forces in N, sinkage in m and apparent modulus in Pa of each trial, (n,)."""

    pull_n: Array
    side_n: Array
    sinkage_m: Array
    modulus_pa: Array


def force_vector(law: Law, values: Array) -> Array:
    """Return all parameters of the forces (17,), the free ones being ``values``."""
    named = {name: entry[0] for name, entry in FORCE.items()} | dict(law.fixed)
    named |= dict(zip(law.free, np.asarray(values).tolist(), strict=True))
    if law.tied:
        named["side_pressure_ratio"] = bulldozing_ratio(named["tan_friction"])
    return np.array([named[name] for name in NAMES])


def sinkage_of(law: Law, values: Array, trials: Trials, wheel: Wheel) -> Array:
    """Return the sinkage (n,) in m that a law predicts from slip and angle, and Ding's from the load."""
    if law.sinkage == "travel":
        wheel_mps = trials.wheel_radps * wheel.tip_radius_m
        depth = travel_sinkage(
            values, wheel_mps, trials.travel_mps, trials.slip_angle_rad, wheel.tip_radius_m
        )
    elif law.sinkage == "lyasko":
        depth = lyasko_sinkage(values, trials.slip_ratio)
    else:
        depth = ding_sinkage(values, trials.slip_ratio, trials.load_n, wheel.tip_radius_m, wheel.width_m)
    return np.clip(depth, 1e-4, DEEPEST_RATIO * wheel.tip_radius_m)


def forces_of(law: Law, values: Array, trials: Trials, wheel: Wheel, sinkage_m: Array) -> Prediction:
    """Return the forces of each trial for a sinkage (n,) in m."""
    vector = force_vector(law, values)
    depths = np.ascontiguousarray(sinkage_m)
    found = wheel_forces(vector, wheel.tip_radius_m, wheel.width_m, trials.motion, depths)
    return Prediction(found[:, 0], found[:, 1], depths, found[:, 2])


SINKAGE_MISFIT_M = 2e-3
FORCE_MISFIT_RATIO = 0.1
_STARTS = (0.0, -0.7, 0.7)
"""In standard deviations of the priors: where fits begin; the best one counts."""

_MAX_STEPS = 60


class LawFit(NamedTuple):
    """A fitted law: what was fitted, and the parameters of its sinkage and of its forces."""

    law: Law
    wheel: Wheel
    sinkage: Fit
    force: Fit


def fit_law(law: Law, trials: Trials, wheel: Wheel, start: LawFit | None = None) -> LawFit:
    """Return a law fitted to trials.

    Parameters
    ----------
    law : what to fit
    trials : means of settings, with their numbers
    wheel : of the trials
    start : a fit to begin at; without one, begin at several places around the priors
    """
    weight = np.sqrt(trials.n_trials / trials.n_trials.mean())

    def depth_misfit(values: Array) -> Array:
        miss = sinkage_of(law, values, trials, wheel) - trials.sinkage_m
        return np.asarray(miss * weight / SINKAGE_MISFIT_M)

    of_sinkage = [
        Parameter(name, mean, 0.0, prior_std=std) for name, (mean, std) in SINKAGES[law.sinkage].items()
    ]
    sinkage = _identify(depth_misfit, of_sinkage, None if start is None else start.sinkage)
    depths = sinkage_of(law, sinkage.value, trials, wheel)
    scale = weight / (FORCE_MISFIT_RATIO * trials.load_n)

    def force_misfit(values: Array) -> Array:
        found = forces_of(law, values, trials, wheel, depths)
        misses = (found.pull_n - trials.pull_n) * scale, (found.side_n - trials.side_n) * scale
        return np.concatenate(misses)

    of_force = [
        Parameter(name, mean, low, high, std) for name in law.free for mean, std, low, high in [FORCE[name]]
    ]
    force = _identify(force_misfit, of_force, None if start is None else start.force)
    return LawFit(law, wheel, sinkage, force)


def _identify(misfit: Callable[[Array], Array], parameters: Sequence[Parameter], start: Fit | None) -> Fit:
    around = [np.array([p.nominal + s * p.prior_std for p in parameters]) for s in _STARTS]
    starts = around if start is None else [start.value]
    return identify(
        misfit, parameters, starts=starts, diff_step=1e-4, xtol=1e-5, ftol=1e-5, max_nfev=_MAX_STEPS
    )


def predict(fit: LawFit, trials: Trials, given: str = "load") -> Prediction:
    """Return what a fitted law predicts of trials.

    Parameters
    ----------
    fit : of the law
    trials : their motion and load are used
    given : ``load``: the sinkage is the law's; ``sinkage``: it is the measured one
    """
    depths = trials.sinkage_m
    if given == "load":
        depths = sinkage_of(fit.law, fit.sinkage.value, trials, fit.wheel)
    return forces_of(fit.law, fit.force.value, trials, fit.wheel, depths)


class SoilParameter(NamedTuple):
    """A parameter of a law.

    Parameters
    ----------
    name : ends in its unit, or in ``ratio`` or ``exponent``
    value : of the fit to all trials
    interval : 95 %: what holds both the bootstrap over settings of slip and angle, which knows nothing of what the
        prior pulls, and what the fit with its prior leaves open
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
) -> dict[str, SoilParameter]:
    """Return the parameters of a fitted law by name, those of the sinkage first.

    Whole settings are drawn, as repeats of a trial share what a law misses.

    Parameters
    ----------
    fit : to all trials
    trials : means of settings, as they were fitted
    n_draws, seed : of the bootstrap
    on_draw : called after each sample
    """
    draws = []
    for count in bootstrap_counts(len(trials), n_draws, seed):
        rows = np.flatnonzero(count)
        sample = trials.chosen(rows)
        weighed = replace(sample, n_trials=sample.n_trials * count[rows])
        again = fit_law(fit.law, weighed, fit.wheel, start=fit)
        draws.append(np.concatenate([again.sinkage.value, again.force.value]))
        on_draw()
    drawn = np.array(draws).T if draws else None
    found: dict[str, SoilParameter] = {}
    for own in (fit.sinkage, fit.force):
        columns = (own.value, own.std, *own.interval, own.identified)
        for p, value, std, low, high, identified in zip(
            own.parameters, *(c.tolist() for c in columns), strict=True
        ):
            if drawn is not None:
                least, most = percentile_interval(drawn[len(found)])
                low, high = min(low, least), max(high, most)
            interval = max(low, p.low), min(high, p.high)
            found[p.name] = SoilParameter(p.name, value, interval, p.prior_std, std / p.prior_std, identified)
    return found


class CohesionRow(NamedTuple):
    """A fit with a cohesion that is given: friction that goes with it, and the sum of squares of the fit."""

    cohesion_pa: float
    friction_angle_rad: float
    cost: float


def cohesion_profile(
    law: Law, trials: Trials, wheel: Wheel, cohesions_pa: Sequence[float]
) -> list[CohesionRow]:
    """Return how much less friction goes with a cohesion that is given."""
    rows = []
    place = law.free.index("tan_friction")
    for cohesion_pa in cohesions_pa:
        held = law._replace(fixed={**law.fixed, "cohesion_pa": cohesion_pa})
        fit = fit_law(held, trials, wheel)
        rows.append(CohesionRow(cohesion_pa, float(np.arctan(fit.force.value[place])), fit.force.cost))
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
