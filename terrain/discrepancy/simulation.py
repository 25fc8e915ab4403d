"""The simulation under test: a robot, its terrain, the effects built in, and scatter from run to run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from terrain.effects import Effect, library_of, vector_of
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.plants.planar import Ground, Planar, make_planar


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """What :func:`terrain.discrepancy.diagnose.diagnose` compares measured runs with."""

    robot: Robot
    ground: Ground = field(default_factory=Ground)  #: default terrain
    #: that are built in already; those not named are 0
    effects: Mapping[str, float] = field(default_factory=dict)
    #: standard deviation from run to run of parameters in NUISANCES; those not named are 0
    scatter: Mapping[str, float] = field(default_factory=dict)
    grounds: Mapping[str, Ground] = field(default_factory=dict)  #: terrains by the label of a run
    #: how large the simulation's own error is in units of parameters, the same in all runs; what is no larger is not
    #: stated
    model_error: Mapping[str, float] = field(default_factory=dict)
    #: mean over runs and scatter of them that conditions may make which differ from run to run, in units of parameters:
    #: see :mod:`terrain.discrepancy.varying`
    varied_error: Mapping[str, float] = field(default_factory=dict)
    varied_scatter: Mapping[str, float] = field(default_factory=dict)
    #: how much the residual of a channel depends on an input by the simulation's own error
    probe_error: Mapping[tuple[str, str], float] = field(default_factory=dict)

    @property
    def library(self) -> tuple[Effect, ...]:
        """Effects that apply to this robot."""
        return library_of(self.robot.drive)

    @property
    def planar(self) -> Planar:
        """Numbers for the kernels, on the default terrain."""
        return make_planar(self.robot, self.ground)

    def planar_on(self, terrain: str) -> Planar:
        """Return the numbers for the kernels on the terrain of a label."""
        return make_planar(self.robot, self.grounds.get(terrain, self.ground))

    def tilt_is_slope(self, terrain: str) -> bool:
        """Return whether all of the measured tilt on the terrain of a label counts as a slope."""
        return self.grounds.get(terrain, self.ground).effective_ratio >= 1.0

    @property
    def known_scatter(self) -> dict[str, float]:
        """Scatter from run to run that is no news: what is assumed, or what conditions may make."""
        both = {*self.scatter, *self.varied_scatter}
        return {n: max(self.scatter.get(n, 0.0), self.varied_scatter.get(n, 0.0)) for n in both}

    @property
    def vector(self) -> Array:
        """Parameters (len(PARAMETERS),) of the effects built in."""
        return vector_of(self.effects)

    def with_effects(self, values: Mapping[str, float]) -> Simulation:
        """Return the same with effects added to those that are built in already."""
        added = {name: self.effects.get(name, 0.0) + value for name, value in values.items()}
        return replace(self, effects={**self.effects, **added})
