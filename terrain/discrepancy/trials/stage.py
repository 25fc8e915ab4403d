"""A trial before the diagnosis: what it is given, and what is kept from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.terrain_match import simulation_for
from terrain.discrepancy.trials.drives import Drives, rich_drives
from terrain.discrepancy.trials.hidden_effects import CLIP_RATIO, STRONG, Case, Hidden, is_clipped, values_of
from terrain.discrepancy.trials.limits import Limits
from terrain.effects import library_of
from terrain.records import RunLog
from terrain.robots import Robot

CLEAR = (STRONG, 20.0)
"""Range of amplitudes over the limit beside what measured runs have: from one that has to be named to where
row ``gross`` begins."""


class Stage(NamedTuple):
    """A trial before the diagnosis.

    Parameters
    ----------
    runs : that the diagnosis gets
    hidden : in them
    limits : of the drives, for the confusable classes; None where nothing is hidden
    simulation : under test; None for the one with the known scatter
    variant : of the row, where it has several
    accepted : names that are no error beside the causes
    clipped : whether an amplitude was beyond the bounds of its effect
    late_s : how far the logger of IMU and camera is behind that of the wheels; NaN where that is not asked
    stalled, present : ids of the runs that are stalled, and of those that have the effect if only some do
    fault : name of the one written into the logs
    """

    runs: tuple[RunLog, ...]
    hidden: Hidden
    limits: Limits | None
    simulation: Simulation | None = None
    variant: str = ""
    accepted: tuple[str, ...] = ()
    clipped: bool = False
    late_s: float = math.nan
    stalled: tuple[str, ...] = ()
    present: tuple[str, ...] = ()
    fault: str = ""


class Draw(NamedTuple):
    """Case, robot, generator, and seed of the noise."""

    case: Case
    robot: Robot
    rng: np.random.Generator
    noise: np.random.SeedSequence

    def rich(self) -> Drives:
        """Return drives that excite all effects."""
        return rich_drives(self.rng, self.case.n_runs)

    def strong(
        self, limits: Limits, over_limit: tuple[float, float] = CLEAR, without: Sequence[str] = ()
    ) -> Hidden:
        """Draw an effect that these drives excite: its amplitude is within its bounds."""
        library = library_of(self.robot.drive)
        over = float(math.exp(self.rng.uniform(*np.log(over_limit))))
        fit = [e for e in library if e.name not in without and e.parameters[0].name in limits.names]
        for i in self.rng.permutation(len(fit)):
            values = values_of(fit[i], limits, over, self.rng)
            if not is_clipped(values):
                return Hidden(values, (fit[i].name,), over, "", library, {})
        raise RuntimeError(
            f"no effect of {over:.1f} times its limit is within its bounds"
        )  # no drives do that

    def in_turn(self, limits: Limits, number: int) -> Hidden:
        """Take in turn the effects that these drives show, of 3 times their limit, within their bounds."""
        library = library_of(self.robot.drive)
        most = {effect: CLIP_RATIO * min(p.high for p in effect.parameters) for effect in library}
        shown = [effect for effect in library if STRONG * limits.of(effect) < most[effect]]
        effect = shown[number % len(shown)]
        values = values_of(effect, limits, STRONG, self.rng)
        while is_clipped(values):  # in another direction it is not
            values = values_of(effect, limits, STRONG, self.rng)
        return Hidden(values, (effect.name,), STRONG, "", library, {})

    def compared(self, stage: Stage) -> Stage:
        """Return the stage with the simulation that ``terrain explain`` would test."""
        simulation, _ = simulation_for(stage.runs, self.robot, stage.hidden.library)
        return stage._replace(simulation=simulation)
