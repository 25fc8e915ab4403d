"""The simulation that measured runs are compared with, on the terrain that each run's label names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.evidence import Evidence, evidence_at
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.search import names_of
from terrain.discrepancy.signals import Signals, signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.effects import Effect, parameters_of
from terrain.errors import ConfigError, DataError
from terrain.records import Array, RunLog
from terrain.robots import Robot
from terrain.simulation.planar.model import Ground, planar_ground
from terrain.simulation.planar.noise import load_model_error, load_scatter
from terrain.terramechanics.soil import extra_soil_names, load_soil, soil_names


class TerrainMatch(NamedTuple):
    """The terrain on which runs of a label are simulated.

    Parameters
    ----------
    terrain : label of the runs; empty for runs without a label or with several
    soil : its soil of the package; None for the default terrain
    effective_ratio : part of the measured tilt that acts as a slope, from 0 to 1; None on the default terrain
    """

    terrain: str
    soil: str | None
    effective_ratio: float | None

    @property
    def text(self) -> str:
        """On which terrain the runs were simulated, in words."""
        if self.soil:
            return f"soil {self.soil}"
        runs = f"label {self.terrain}" if self.terrain else "runs without a label (or with several)"
        return f"{runs}: default terrain"


def simulation_for(
    runs: Sequence[RunLog], robot: Robot, library: Sequence[Effect]
) -> tuple[Simulation, tuple[TerrainMatch, ...]]:
    """Return the simulation of runs, and the terrain that each of their labels is simulated on.

    A label that is the name of a soil of the package is simulated on that soil, all others on the default
    terrain.
    """
    labels = sorted({run.terrains[0] if len(run.terrains) == 1 else "" for run in runs})
    grounds = {label: ground for label in labels if (ground := _ground(robot, label)) is not None}
    simulation = Simulation(robot, Ground(), robot.effects, load_scatter()._asdict(), grounds)
    if grounds:
        simulation = with_model_error(simulation)
        signals = [signals_of(run, robot) for run in runs]
        simulation = with_effective_tilt(simulation, signals, library)
    matches = []
    for label in labels:
        ground = simulation.grounds.get(label)
        known = ground is not None
        matches.append(
            TerrainMatch(label, label if known else None, ground.effective_ratio if ground else None)
        )
    return simulation, tuple(matches)


def with_model_error(simulation: Simulation) -> Simulation:
    """Return the simulation with its own error on the soils of the package."""
    parameters = set(parameters_of(simulation.robot.drive))
    error = load_model_error()
    common, varied, scatter = (
        {name: size for name, size in sizes.items() if name in parameters}
        for sizes in (error.common, error.varied, error.scatter)
    )
    return replace(
        simulation,
        model_error=common,
        varied_error=varied,
        varied_scatter=scatter,
        probe_error=error.probes,
    )


def _ground(robot: Robot, label: str) -> Ground | None:
    """Return the soil of a label for the planar simulation; None where there is none that can be driven."""
    known = label in (*soil_names(), *extra_soil_names())
    return planar_ground(robot, load_soil(label)) if known and drivable(robot, label) else None


def drivable(robot: Robot, soil: str) -> bool:
    """Return whether a robot does not get stuck on a soil of the package."""
    try:
        planar_ground(robot, load_soil(soil))
    except ConfigError:
        return False
    return True


def runs_of_terrain(runs: Sequence[RunLog], terrain: str | None) -> list[RunLog]:
    """Return the runs that are of one label throughout; all of them where none is asked for.

    Raises
    ------
    DataError
        if there is no such run.
    """
    if not runs:
        raise DataError("there is no run to explain")
    if terrain is None:
        return list(runs)
    chosen = [run for run in runs if run.terrains == (terrain,)]
    if not chosen:
        labels = sorted({name for run in runs for name in run.terrains})
        raise DataError(
            f"no run is labelled {terrain!r} throughout; labels are {', '.join(labels) if labels else 'none'}"
        )
    return chosen


def check_robots(runs: Sequence[RunLog], robot: Robot) -> None:
    """Make sure that all runs are of the robot.

    Raises
    ------
    DataError
        if some are of another.
    """
    others = Counter(run.robot for run in runs if run.robot != robot.name)
    if others:
        (name, n), *_ = others.most_common(1)
        raise DataError(
            f"{n} of {len(runs)} runs are of the robot {name!r}; the simulation is of {robot.name!r}"
        )


# -- Which part of the measured tilt is a slope, and which part a body that rides over bumps ---------------
# A tilt that is no slope takes no traction; simulated as a slope it biases mass, resistance and slip.  The part
# that acts as a slope is estimated for each terrain: the runs fit best with it, all parameters of the library
# freed.

RATIOS = (0.0, 0.5, 1.0)
"""Effective ratios that are tried; the best lies on the parabola through their losses."""

TILT_LOSS = 20.0
"""All of the tilt counts as a slope, unless a smaller part fits better by that in minus twice the
log-likelihood."""


def with_effective_tilt(
    simulation: Simulation, signals: Sequence[Signals], library: Sequence[Effect]
) -> Simulation:
    """Return the simulation with the effective ratio of the tilt on each labelled terrain.

    Parameters
    ----------
    simulation : with terrains by label; that of runs without one stays as it is
    signals : of runs
    library : effects that are freed meanwhile
    """
    grounds = dict(simulation.grounds)
    for terrain, ground in simulation.grounds.items():
        runs = [run for run in signals if run.terrain == terrain]
        if runs:
            grounds[terrain] = ground._replace(
                effective_ratio=_best_effective_ratio(simulation, runs, ground, library)
            )
    return replace(simulation, grounds=grounds)


def _best_effective_ratio(
    simulation: Simulation, runs: Sequence[Signals], ground: Ground, library: Sequence[Effect]
) -> float:
    names, low_pass = names_of(library), low_pass_of(runs)
    losses = []
    for ratio in RATIOS:
        tried = replace(simulation, grounds={runs[0].terrain: ground._replace(effective_ratio=ratio)})
        losses.append(_loss(evidence_at(runs, tried, simulation.vector, names, low_pass)))
    ratio, least = best_ratio(np.array(losses))
    return ratio if losses[-1] - least > TILT_LOSS else 1.0


def best_ratio(losses: Array) -> tuple[float, float]:
    """Return the ratio, 0 to 1, and the loss at the minimum of the parabola through the losses of RATIOS.

    Examples
    --------
    >>> best_ratio(np.array([1.0, 0.0, 1.0]))[0], best_ratio(np.array([0.0, 2.0, 8.0]))[0]
    (0.5, 0.0)
    """
    a, b, c = np.polyfit(RATIOS, losses, 2)
    bottom = min(max(-b / (2.0 * a), 0.0), 1.0) if a > 0.0 else float(RATIOS[int(np.argmin(losses))])
    return round(float(bottom), 3), float(a * bottom**2 + b * bottom + c)


def _loss(info: Evidence) -> float:
    """Return minus twice the log-likelihood of what the whole library leaves, up to a constant."""
    scale = -np.log(np.abs(info.noise.filters[:, 0]))
    total = 0.0
    for run in info.rows:
        each = np.log(info.noise.size(run.pace_mps)) + scale
        total += 2.0 * float(each[np.isfinite(run.residual) & np.isfinite(each)].sum())
    return total
