"""Runs of the dynamic simulation, which differs from the planar one that the diagnosis replays.

They are made by what ``terrain simulate`` calls, and diagnosed as ``terrain explain`` does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.trials.drives import Drives
from terrain.kinematics.wheel_speed import with_wheel_speeds
from terrain.records import RunLog
from terrain.robots import Robot
from terrain.simulation.planar.hills import Hills
from terrain.simulation.run import simulate_run

TERRAIN, SCENARIOS = "grass", ("complex", "starts", "survey")

HIDDEN = {"wheel_radius_ratio": 0.03}
"""Hidden in every second trial."""


class Setting(NamedTuple):
    """What is driven, whether conditions vary, and whether something is hidden."""

    scenario: str
    vary: bool
    hides: bool

    @property
    def name(self) -> str:
        """The setting in words."""
        return f"{self.scenario}, varied" if self.vary else self.scenario


def setting_of(number: int) -> Setting:
    """Return the setting of a trial: every combination in twelve.

    Examples
    --------
    >>> len({setting_of(number) for number in range(12)})
    12
    """
    return Setting(SCENARIOS[number // 2 % 3], number // 6 % 2 == 1, number % 2 == 1)


def dynamic_runs(
    robot: Robot, setting: Setting, seed: int, n_runs: int, effects: Mapping[str, float]
) -> tuple[RunLog, ...]:
    """Return runs 1, 2... of a scenario, as ``terrain explain`` diagnoses them; the truth is removed."""
    runs = []
    for number in range(1, n_runs + 1):
        run = simulate_run(robot, TERRAIN, setting.scenario, seed, number, vary=setting.vary, effects=effects)
        shown = {name: stream for name, stream in run.streams.items() if name != "truth"}
        runs.append(with_wheel_speeds(replace(run, streams=shown, source=""), robot))
    return tuple(runs)


def drives_of(runs: Sequence[RunLog]) -> Drives:
    """Return the commanded twists of runs on level ground."""
    axes = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    twists = [np.column_stack([run.streams["commands"].channel(axis) for axis in axes]) for run in runs]
    return Drives(tuple(twists), tuple(Hills() for _ in runs))
