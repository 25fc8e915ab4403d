"""A law fitted to trials: sinkage first, then the forces at the sinkage that it predicts.

Both fits are least squares with weak normal priors, which hold what the trials do not::

    sum over settings of n ((z - z') / 2 mm)^2             + sum of ((p - p0) / s)^2
    sum over settings of n (((Fx - Fx') / W / 0.1)^2 + ((Fy - Fy') / W / 0.1)^2) + sum of ((p - p0) / s)^2

n is the number of trials of a setting over the mean number, and 2 mm and 0.1 are what such laws miss by, of
which the repeats of a trial (0.8 mm, 0.04) are a small part.  A parameter is ``identified`` where the trials
narrow its prior to less than half.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from terrain.records import Array
from terrain.soil_identification.laws import SINKAGES, Law, Prediction, forces_of, sinkage_of
from terrain.soil_identification.trials import Trials, Wheel
from terrain.terramechanics.inflow_wheel import FORCE

SINKAGE_MISFIT_M = 2e-3
FORCE_MISFIT_RATIO = 0.1
IDENTIFIED_RATIO = 0.5
"""Standard deviation after the trials over that of the prior, below which a parameter is identified."""

_STARTS = (0.0, -0.7, 0.7)
"""In standard deviations of the priors: where fits begin; the best one counts."""

_MAX_STEPS = 60


class LawFit(NamedTuple):
    """A fitted law.

    Parameters
    ----------
    law, wheel : what was fitted
    sinkage, force : values of the parameters, in the order of the law
    sinkage_std, force_std : standard deviations by the trials and the priors, of the linearised problem
    cost : half of the sum of squares of the fit of the forces
    """

    law: Law
    wheel: Wheel
    sinkage: Array
    force: Array
    sinkage_std: Array
    force_std: Array
    cost: float


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
    table = SINKAGES[law.sinkage]
    centre, spread = np.array(list(table.values())).T

    def depth_misfit(values: Array) -> Array:
        miss = sinkage_of(law, values, trials, wheel) - trials.sinkage_m
        return np.asarray(miss * weight / SINKAGE_MISFIT_M)

    bounds = np.zeros(len(centre)), np.full(len(centre), np.inf)
    begin = None if start is None else start.sinkage
    depth = _fitted(depth_misfit, centre, spread, bounds, begin)
    depths = sinkage_of(law, depth.values, trials, wheel)
    entries = np.array([FORCE[name] for name in law.free])
    scale = weight / (FORCE_MISFIT_RATIO * trials.load_n)

    def force_misfit(values: Array) -> Array:
        found = forces_of(law, values, trials, wheel, depths)
        misses = (found.pull_n - trials.pull_n) * scale, (found.side_n - trials.side_n) * scale
        return np.concatenate(misses)

    begin = None if start is None else start.force
    force = _fitted(force_misfit, entries[:, 0], entries[:, 1], (entries[:, 2], entries[:, 3]), begin)
    return LawFit(law, wheel, depth.values, force.values, depth.std, force.std, force.cost)


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
        depths = sinkage_of(fit.law, fit.sinkage, trials, fit.wheel)
    return forces_of(fit.law, fit.force, trials, fit.wheel, depths)


class _Fitted(NamedTuple):
    values: Array
    std: Array
    cost: float


def _fitted(
    misfit: Callable[[Array], Array],
    centre: Array,
    spread: Array,
    bounds: tuple[Array, Array],
    begin: Array | None,
) -> _Fitted:
    """Minimise misfit and prior, in units of the prior's standard deviations."""
    low, high = ((bound - centre) / spread for bound in bounds)

    def residuals(scaled: Array) -> Array:
        return np.concatenate([misfit(centre + spread * scaled), scaled])

    best: OptimizeResult | None = None
    places = [np.full(len(centre), start) for start in _STARTS]
    for place in places if begin is None else [(begin - centre) / spread]:
        inside = np.clip(place, low + 1e-6, high - 1e-6)
        found = least_squares(
            residuals, inside, bounds=(low, high), diff_step=1e-4, xtol=1e-5, ftol=1e-5, max_nfev=_MAX_STEPS
        )
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    spread_left = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    return _Fitted(centre + spread * best.x, spread * spread_left, float(best.cost))
