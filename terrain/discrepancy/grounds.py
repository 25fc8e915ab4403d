"""The simulation that runs are compared with: on which ground the runs of each label are simulated.

A label is a hypothesis.  The soil of the package of that name competes with the default ground, and is taken where
runs left out of the fit are predicted clearly better on it while everything that the library may change, within its
plausible range, is fitted with both.  Ties go to the default ground, so that a label by itself changes nothing.  With
what is named on either the soil has to be clearly better, too
(:func:`terrain.discrepancy.diagnosed_runs.found_on_ground`): where thirty parameters repair a soil and no few do, it is
not that of the runs.

On any ground a part of the measured tilt acts as a slope: a tilt that is none, of a body that rides over bumps, takes
no traction; simulated as a slope it biases mass, resistance and slip.

With products of whitened columns of each run, as :mod:`terrain.discrepancy.evidence` has them, the loss of run ``i``
at parameters ``x`` is ``c_i - 2 g_i'x + x'A_i x``, and its held-out loss is that at the ``x`` within the plausible
ranges that fits the runs of the other folds best.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from terrain.discrepancy.evidence import Evidence, evidence_at, move_point, z_of_t
from terrain.discrepancy.runs import (
    Signals,
    Simulation,
    TerrainMatch,
    drivable,
    low_pass_of,
    signals_of,
)
from terrain.discrepancy.search import names_of
from terrain.effects import PARAMETER, Effect, parameters_of
from terrain.files.names import packaged
from terrain.records import Array, RunLog
from terrain.robots import Robot
from terrain.simulation.plants.planar import Ground, planar_ground, probe_error, spread_numbers
from terrain.terramechanics.soil import EXTRA, Soil, load_soil, soil_names

MAX_RUNS = 16
"""Runs of a label by which its ground is chosen, evenly spaced: more tell no better what all of them have in common."""

N_FOLDS = 6  #: Of runs; each is predicted by a fit to the others
#: Gauss-Newton steps of the whole library: sensitivities at twice the track are others than at once.
N_STEPS = 2

Z_GROUND, LEAST_FALL = 2.33, 0.1
"""A soil, or a part of the tilt, is taken from that evidence on (one in a hundred by chance), clustered by session or
run, and from that ratio of the held-out loss.  Runs of the dynamic simulation have 0.4 to 0.7 by their own soil, 0.003
at most by another."""

RATIOS = (0.0, 0.5, 1.0)
"""Parts of the tilt that are tried.  All of it acts, unless one of the others is as clearly better as a soil has to be:
then that at the least of the parabola through their losses."""


def simulation_for(
    runs: Sequence[RunLog],
    robot: Robot,
    library: Sequence[Effect],
    signals: Sequence[Signals] | None = None,
    on_soils: bool = True,
) -> tuple[Simulation, tuple[TerrainMatch, ...]]:
    """Return the simulation of runs, and the terrain that each of their labels is simulated on.

    The ``signals`` of the runs are taken where they are known already; without ``on_soils`` no label is a soil.
    """
    labels = sorted({run.terrains[0] if len(run.terrains) == 1 else "" for run in runs})
    scatter = spread_numbers("scatter")
    simulation = Simulation(robot, Ground(), robot.effects, scatter, learned=robot.learned)
    known = {*soil_names(), *packaged(EXTRA)} if on_soils else set()
    every = [signals_of(run, robot) for run in runs] if signals is None else signals
    grounds, soils = {}, set()
    for label in labels:
        own = [run for run in every if run.terrain == label]
        soil = load_soil(label) if own and label in known and drivable(robot, label) else None
        if own:
            grounds[label], is_soil = ground_of(own, simulation, library, soil)
            soils |= {label} if is_soil else set()
    grounds = {label: ground for label, ground in grounds.items() if ground != simulation.ground}
    if soils:
        # on soils the simulation has an error of its own
        parameters = parameters_of(robot.drive)
        errors: dict[str, Any] = {"probe_error": probe_error()}
        for kind in ("model_error", "varied_error", "varied_scatter"):
            errors[kind] = {n: size for n, size in spread_numbers(kind).items() if n in parameters}
        simulation = replace(simulation, **errors)
    ratios = {label: ground.effective_ratio for label, ground in grounds.items()}
    return replace(simulation, grounds=grounds), tuple(
        TerrainMatch(label, label if label in soils else None, ratios.get(label)) for label in labels
    )


def ground_of(
    signals: Sequence[Signals], simulation: Simulation, library: Sequence[Effect], soil: Soil | None = None
) -> tuple[Ground, bool]:
    """Return the ground of runs of one label, with the part of the tilt that acts, and whether it is the soil."""
    default = simulation.ground
    tilts = any(np.nanmax(np.abs([run.grade_rad, run.roll_rad]), initial=0.0) > 0.0 for run in signals)
    if soil is None and not tilts:
        return default, False
    runs = [signals[i] for i in np.unique(np.linspace(0, len(signals) - 1, MAX_RUNS).round().astype(int))]
    names, low_pass, start = names_of(library), low_pass_of(runs), simulation.vector
    units = [run.session or run.run_id for run in runs]

    def on(ground: Ground, point: Array, **about: Any) -> Evidence:
        tried = replace(simulation, ground=ground)
        return evidence_at(runs, tried, point, names, low_pass, **about).counted_from(start)

    def fitted(ground: Ground, **about: Any) -> Array:
        """Return the point at which the whole library fits best."""
        point = start
        for _ in range(N_STEPS):
            info = on(ground, point, **about)
            change = within(info.a.sum(axis=0), info.g.sum(axis=0), *ranges_of(info, simulation.effects))
            point = move_point(start, info.names, change)
        return point

    point = fitted(default)
    measure = on(default, point)
    about = {"noise": measure.noise, "scatter": measure.scatter}  # of all grounds alike

    def best_of(ground: Ground, info: Evidence, point: Array) -> tuple[Ground, Array]:
        """Return a ground with the part of the tilt that acts, and its held-out losses."""
        losses = [held_out_losses(info, simulation.effects)]
        if tilts:
            others = [ground._replace(effective_ratio=ratio) for ratio in RATIOS[:-1]]
            losses[:0] = [held_out_losses(on(each, point, **about), simulation.effects) for each in others]
            least = min(losses, key=np.sum)
            if is_better(least, losses[-1], units):
                return ground._replace(effective_ratio=best_ratio(np.sum(losses, axis=1))), least
        return ground, losses[-1]

    default, loss = best_of(default, measure, point)
    if soil is not None:
        ground = planar_ground(simulation.robot, soil)
        point = fitted(ground, **about)
        ground, other = best_of(ground, on(ground, point, **about), point)
        if is_better(other, loss, units):
            return ground, True
    return default, False


def is_better(loss: Array, other: Array, units: Sequence[str]) -> bool:
    """Return whether the losses (n,) of runs are clearly less than others, as their units agree.

    Examples
    --------
    >>> other, units = np.array([100.0, 101.0, 99.0, 100.0, 102.0, 98.0]), list("abcdef")
    >>> is_better(other - 20.0, other, units), is_better(other - [30, -9, 2, -8, 1, -6], other, units)
    (True, False)
    """
    of = np.unique(units, return_inverse=True)[1]
    gain = np.bincount(of, weights=other - loss)
    if len(gain) < 2 or not gain.sum() > LEAST_FALL * other.sum():
        return False
    t = gain.mean() / max(float(gain.std(ddof=1)), 1e-12) * math.sqrt(len(gain))
    return z_of_t(float(t), len(gain) - 1.0) > Z_GROUND


def ranges_of(info: Evidence, built_in: Mapping[str, float]) -> tuple[Array, Array]:
    """Return the plausible ranges (k,) of changes of the parameters; what belongs to no effect stays."""
    ends = [PARAMETER[name].plausible if name in PARAMETER else (0.0, 0.0) for name in info.names]
    given = [built_in.get(name, 0.0) for name in info.names]
    low, high = np.array(ends).T - given
    return np.minimum(low, -1e-9), np.maximum(high, 1e-9)


def within(a: Array, g: Array, low: Array, high: Array) -> Array:
    """Return the ``x`` (k,) from ``low`` to ``high`` at which ``x'a x - 2 g'x`` is least.

    Examples
    --------
    >>> within(1e9 * np.eye(2), np.array([1e9, 4e9]), np.full(2, -3.0), np.full(2, 3.0)).round(6)
    array([1., 3.])
    """
    from scipy.optimize import lsq_linear

    unit = 0.5 * (high - low)
    scaled = a * np.outer(unit, unit) + np.eye(len(unit))  # ranges are priors, too
    root = np.linalg.cholesky(scaled + 1e-9 * np.trace(scaled) / len(unit) * np.eye(len(unit)))
    target = np.linalg.solve(root, g * unit)
    return np.asarray(lsq_linear(root.T, target, (low / unit, high / unit), method="bvls").x) * unit


def held_out_losses(info: Evidence, built_in: Mapping[str, float]) -> Array:
    """Return the loss (runs,) of each run at the fit to the runs of other folds."""
    a, g, c = info.a, info.g, info.c
    ends, fold = ranges_of(info, built_in), np.arange(len(a)) % min(N_FOLDS, len(a))
    losses = np.empty(len(a))
    for k in np.unique(fold):
        x = within(a[fold != k].sum(axis=0), g[fold != k].sum(axis=0), *ends)
        losses[fold == k] = (c - 2.0 * g @ x + np.einsum("i,kij,j->k", x, a, x))[fold == k]
    return losses


def best_ratio(losses: Array) -> float:
    """Return the ratio, 0 to 1, at the minimum of the parabola through the losses of RATIOS.

    Examples
    --------
    >>> best_ratio(np.array([1.0, 0.0, 1.0])), best_ratio(np.array([0.0, 2.0, 8.0]))
    (0.5, 0.0)
    """
    a, b, _ = np.polyfit(RATIOS, losses, 2)
    bottom = min(max(-b / (2.0 * a), 0.0), 1.0) if a > 0.0 else float(RATIOS[int(np.argmin(losses))])
    return round(float(bottom), 3)
