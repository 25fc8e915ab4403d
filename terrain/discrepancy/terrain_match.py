"""The simulation that measured runs are compared with, on the terrain that each run's label names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.evidence import evidence_at
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.search import names_of
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.effects import Effect, parameters_of
from terrain.errors import ConfigError, DataError
from terrain.records import Array, RunLog
from terrain.robots import Robot
from terrain.simulation.plants.planar import Ground, load_model_error, load_scatter, planar_ground
from terrain.terramechanics.soil import extra_soil_names, load_soil, soil_names

RATIOS = (0.0, 0.5, 1.0)
"""Effective ratios that are tried; the best lies on the parabola through their losses."""

TILT_LOSS = 20.0
"""All of the tilt counts as a slope, unless a smaller part fits better by that in minus twice the
log-likelihood."""


class TerrainMatch(NamedTuple):
    """The terrain on which runs of a label are simulated."""

    terrain: str  #: label of the runs; empty for runs without a label or with several
    soil: str | None  #: its soil of the package; None for the default terrain
    effective_ratio: float | None
    """Part of the tilt that acts as a slope, 0 to 1; None on the default terrain."""

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

    A label that is the name of a soil of the package is simulated on that soil, all others on the default terrain.  On
    soils the simulation has an error of its own, and a part of the measured tilt acts as a slope: a tilt that is none,
    of a body that rides over bumps, takes no traction; simulated as a slope it biases mass, resistance and slip.  The
    runs fit best with the part that acts, all parameters of the library freed.
    """
    labels = sorted({run.terrains[0] if len(run.terrains) == 1 else "" for run in runs})
    known, grounds = {*soil_names(), *extra_soil_names()}, {}
    for label in labels:
        if label in known and drivable(robot, label):
            grounds[label] = planar_ground(robot, load_soil(label))
    simulation = Simulation(robot, Ground(), robot.effects, load_scatter()._asdict(), grounds)
    if grounds:
        parameters, error = parameters_of(robot.drive), load_model_error()
        common, varied, scatter = (
            {name: size for name, size in sizes.items() if name in parameters}
            for sizes in (error.common, error.varied, error.scatter)
        )
        simulation = replace(
            simulation,
            model_error=common,
            varied_error=varied,
            varied_scatter=scatter,
            probe_error=error.probes,
        )
    signals = [signals_of(run, robot) for run in runs] if grounds else []
    for label, ground in list(grounds.items()):
        own = [run for run in signals if run.terrain == label]
        if not own:
            continue
        losses = np.zeros(len(RATIOS))
        for k, ratio in enumerate(RATIOS):
            tried = replace(simulation, grounds={label: ground._replace(effective_ratio=ratio)})
            info = evidence_at(own, tried, simulation.vector, names_of(library), low_pass_of(own))
            # minus twice the log-likelihood of what the whole library leaves, up to a constant
            scale = -np.log(np.abs(info.noise.filters[:, 0]))
            for run in info.rows:
                size = np.log(info.noise.size(run.pace_mps)) + scale
                losses[k] += 2.0 * float(size[np.isfinite(run.residual) & np.isfinite(size)].sum())
        ratio, least = best_ratio(losses)
        effective = ratio if losses[-1] - least > TILT_LOSS else 1.0
        grounds[label] = ground._replace(effective_ratio=effective)
    ratios = {label: ground.effective_ratio for label, ground in grounds.items()}
    matches = (TerrainMatch(label, label if label in ratios else None, ratios.get(label)) for label in labels)
    return replace(simulation, grounds=grounds), tuple(matches)


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
    chosen = [run for run in runs if terrain is None or run.terrains == (terrain,)]
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
