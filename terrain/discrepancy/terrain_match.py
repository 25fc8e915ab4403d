"""The simulation that measured runs are compared with, on the terrain that each run's label names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.tilt import with_effective_tilt
from terrain.effects import Effect, parameters_of
from terrain.errors import ConfigError, DataError
from terrain.records import RunLog
from terrain.robots import Robot
from terrain.simulation.planar.ground import planar_ground
from terrain.simulation.planar.model import Ground
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
