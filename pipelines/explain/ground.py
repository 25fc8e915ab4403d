"""The simulation that measured runs are held against, on the ground that each run's label tells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.tilt import with_effective_tilt
from terrain.effects import Effect
from terrain.errors import ConfigError
from terrain.records import RunLog
from terrain.robots import Robot
from terrain.simulation.planar.ground import planar_ground
from terrain.simulation.planar.model import Ground
from terrain.simulation.planar.noise import load_scatter
from terrain.terramechanics.soil import extra_soil_names, load_soil, soil_names


def simulation_for(
    runs: Sequence[RunLog], robot: Robot, library: Sequence[Effect]
) -> tuple[Simulation, list[dict[str, Any]]]:
    """Return the simulation, and ``terrain, soil, effective_ratio`` of each label; None where not known.

    A label that is the name of a soil of the package is driven on that soil, all others on a ground like any.
    """
    labels = sorted({run.terrains[0] if len(run.terrains) == 1 else "" for run in runs})
    grounds = {label: ground for label in labels if (ground := _ground(robot, label)) is not None}
    simulation = Simulation(robot, Ground(), robot.effects, load_scatter()._asdict(), grounds)
    if grounds:
        signals = [signals_of(run, robot) for run in runs]
        simulation = with_effective_tilt(simulation, signals, library)
    told = []
    for label in labels:
        ground = simulation.grounds.get(label)
        told.append(
            {
                "terrain": label,
                "soil": None if ground is None else label,
                "effective_ratio": None if ground is None else ground.effective_ratio,
            }
        )
    return simulation, told


def _ground(robot: Robot, label: str) -> Ground | None:
    if not robot.describes("body") or label not in (*soil_names(), *extra_soil_names()):
        return None
    try:
        return planar_ground(robot, load_soil(label))
    except ConfigError:  # on which it would get stuck
        return None


def ground_notes(told: Sequence[dict[str, Any]]) -> list[str]:
    """Return what a reader has to know of the grounds, in sentences."""
    return [
        f"On {each['terrain']} runs fit best where {100.0 * each['effective_ratio']:.0f} % of the measured "
        "tilt is a slope to drive up; the rest is taken for a body that rides over bumps, which takes no "
        "traction."
        for each in told
        if each["effective_ratio"] is not None and each["effective_ratio"] < 1.0
    ]


def ground_words(told: Sequence[dict[str, Any]]) -> str:
    """Return on which ground each label was driven, plain text.

    Examples
    --------
    >>> ground_words([{"terrain": "grass", "soil": "grass"}, {"terrain": "", "soil": None}])
    'soil grass; runs without a label (or with several): a ground like any'
    """
    words = []
    for each in told:
        name = f"label {each['terrain']}" if each["terrain"] else "runs without a label (or with several)"
        words.append(f"soil {each['soil']}" if each["soil"] else f"{name}: a ground like any")
    return "; ".join(words)
