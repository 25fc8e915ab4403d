"""The simulation that runs are compared with: on which ground the runs of each label are simulated.

A label is a hypothesis.  The soil of the package of that name competes with the default ground once causes are found on
both (:func:`terrain.discrepancy.diagnosed_runs.found_on_ground`): it is taken where the runs behind the fit are
clearly nearer to it, each with what was found on it, or nearer at all while fewer causes are.  Ties go to the default
ground, so that a label by itself changes nothing.  What many parameters together could make of a ground does not
count: on the default one they repair the slip of most soils.

On any ground a part of the measured tilt acts as a slope: a tilt that is none, of a body that rides over bumps, takes
no traction; simulated as a slope it biases mass, resistance and slip.

With products of whitened columns of each run, as :mod:`terrain.discrepancy.evidence` has them, the loss of run ``i``
at parameters ``x`` is ``c_i - 2 g_i'x + x'A_i x``, and its held-out loss is that at the ``x`` within the plausible
ranges that fits the runs of the other folds best.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

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
from terrain.terramechanics.soil import EXTRA, load_soil, soil_names

T = TypeVar("T")

MAX_RUNS = 16
"""Runs by which a ground is chosen, evenly spaced: more tell no better what all of them have in common."""

N_FOLDS = 6  #: Of runs; each is predicted by a fit to the others
#: Gauss-Newton steps of the whole library: sensitivities at twice the track are others than at once.
N_STEPS = 2

Z_GROUND, LEAST_FALL = 2.33, 0.1
"""A soil, or a part of the tilt, is clearly better from that evidence on (one in a hundred by chance), of the logarithm
of the loss of sessions or runs, and from a loss that is less by that ratio."""

NEAR = 1.5
"""Ratio of the loss of runs on a soil, nothing fitted, over that on the default ground, to which causes are looked for
on the soil, too."""

RATIOS = (0.0, 0.5, 1.0)
"""Parts of the tilt that are tried.  On the default ground all of it acts unless one of the others is clearly better,
on a soil, which has to prove itself, that at the least of the parabola through their losses."""


def simulation_for(
    runs: Sequence[RunLog], robot: Robot, library: Sequence[Effect], signals: Sequence[Signals] | None = None
) -> tuple[Simulation, tuple[TerrainMatch, ...]]:
    """Return the simulation of runs on the default ground, with the part of the tilt that acts in those of each label.

    The ``signals`` of the runs are taken where they are known already.
    """
    simulation = Simulation(robot, Ground(), robot.effects, spread_numbers("scatter"), learned=robot.learned)
    labels = by_label(runs, [signals_of(run, robot) for run in runs] if signals is None else signals)
    grounds = {name: tilted(own, simulation, library, Ground()) for name, own in labels.items() if own}
    return on_grounds(simulation, labels, grounds, ())


def on_soils(
    runs: Sequence[RunLog], given: Simulation, library: Sequence[Effect], signals: Sequence[Signals]
) -> tuple[Simulation, tuple[TerrainMatch, ...]]:
    """Return a simulation of runs on the soils of those labels that come near to the runs, see :data:`NEAR`.

    That is without anything fitted: what many parameters together make of a ground says little about it.
    """
    labels, known = by_label(runs, signals), {*soil_names(), *packaged(EXTRA)}
    soils: dict[str, Ground] = {}
    for label, own in labels.items():
        if own and label in known and drivable(given.robot, label):
            soil = tilted(own, given, library, planar_ground(given.robot, load_soil(label)))
            some, low_pass, point = few_of(own), low_pass_of(own), given.vector
            plain, tried = (
                evidence_at(some, given, point, (), low_pass),
                replace(given, grounds={label: soil}),
            )
            beside = evidence_at(some, tried, point, (), low_pass, noise=plain.noise, scatter=plain.scatter)
            if log_ratio(beside.c, plain.c).mean() > -math.log(NEAR):
                soils[label] = soil
    return on_grounds(given, labels, {**given.grounds, **soils}, soils)


def by_label(runs: Sequence[RunLog], signals: Sequence[Signals]) -> dict[str, list[Signals]]:
    """Return the signals of runs by their label, empty where they have several."""
    labels = sorted({run.terrains[0] if len(run.terrains) == 1 else "" for run in runs})
    return {label: [run for run in signals if run.terrain == label] for label in labels}


def on_grounds(
    simulation: Simulation, labels: Iterable[str], grounds: Mapping[str, Ground], soils: Collection[str]
) -> tuple[Simulation, tuple[TerrainMatch, ...]]:
    """Return a simulation on the ground of each label, of which some are soils, and the terrain of each."""
    grounds = {label: ground for label, ground in grounds.items() if ground != simulation.ground}
    if soils:
        # on soils the simulation has an error of its own
        parameters = parameters_of(simulation.robot.drive)
        errors: dict[str, Any] = {"probe_error": probe_error()}
        for kind in ("model_error", "varied_error", "varied_scatter"):
            errors[kind] = {n: size for n, size in spread_numbers(kind).items() if n in parameters}
        simulation = replace(simulation, **errors)
    ratios = {label: ground.effective_ratio for label, ground in grounds.items()}
    matches = [TerrainMatch(label, label if label in soils else None, ratios.get(label)) for label in labels]
    return replace(simulation, grounds=grounds), tuple(matches)


def few_of(runs: Sequence[T]) -> list[T]:
    """Return at most :data:`MAX_RUNS` of runs."""
    return [runs[i] for i in np.unique(np.linspace(0, len(runs) - 1, MAX_RUNS).round().astype(int))]


def tilted(
    signals: Sequence[Signals], simulation: Simulation, library: Sequence[Effect], ground: Ground
) -> Ground:
    """Return a ground with the part of the tilt that acts in runs, of which all that a library has is fitted."""
    if not any(np.nanmax(np.abs([run.grade_rad, run.roll_rad]), initial=0.0) > 0.0 for run in signals):
        return ground
    runs, names, start = few_of(signals), names_of(library), simulation.vector
    low_pass, point = low_pass_of(runs), start
    about: dict[str, Any] = {}

    def on(ratio: float) -> Evidence:
        tried = replace(simulation, grounds={}, ground=ground._replace(effective_ratio=ratio))
        return evidence_at(runs, tried, point, names, low_pass, **about).counted_from(start)

    for _ in range(N_STEPS):
        info = on(1.0)
        change = within(info.a.sum(axis=0), info.g.sum(axis=0), *ranges_of(info, simulation.effects))
        point = move_point(start, info.names, change)
    measure = on(1.0)
    about = {"noise": measure.noise, "scatter": measure.scatter}  # of all alike
    losses = np.array([held_out_losses(on(ratio), simulation.effects) for ratio in RATIOS])
    least = losses[int(np.argmin(losses.sum(axis=1)))]
    units = [run.session or run.run_id for run in runs]
    if ground == simulation.ground and not is_better(least, losses[-1], units):
        return ground
    return ground._replace(effective_ratio=best_ratio(losses.sum(axis=1)))


def log_ratio(loss: Array, other: Array) -> Array:
    """Return the logarithm (n,) of another loss of runs over theirs: above 0 where theirs is less."""
    return np.asarray(np.log(np.maximum(other, 1e-12) / np.maximum(loss, 1e-12)))


def is_better(loss: Array, other: Array, units: Sequence[str]) -> bool:
    """Return whether the losses (n,) of runs are clearly less than others, as their units agree.

    Examples
    --------
    >>> other, units = np.array([100.0, 101.0, 99.0, 100.0, 102.0, 98.0]), list("abcdef")
    >>> is_better(other - 20.0, other, units), is_better(other - [30, -9, 2, -8, 1, -6], other, units)
    (True, False)
    """
    of = np.unique(units, return_inverse=True)[1]
    gain = np.bincount(of, weights=log_ratio(loss, other)) / np.bincount(of)
    if len(gain) < 2 or not gain.mean() > -math.log(1.0 - LEAST_FALL):
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
