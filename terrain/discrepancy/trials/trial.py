"""One blind trial: effects are hidden in simulated runs, and the diagnosis is asked for them."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.trials.drives import poor_drives, rich_drives
from terrain.discrepancy.trials.hidden_effects import Case, draw_hidden, hidden_runs
from terrain.discrepancy.trials.limits import Limits, confusable_class, limits_of
from terrain.discrepancy.trials.rows import Row
from terrain.discrepancy.verdict import Diagnosis, Verdict
from terrain.effects import effect_named, nuisances_of
from terrain.errors import DataError
from terrain.robots import Robot, load_robot
from terrain.simulation.planar.model import Ground
from terrain.simulation.planar.noise import load_scatter


@dataclass(frozen=True, slots=True)
class Trial:
    """What was hidden, and what the diagnosis answered.

    Parameters
    ----------
    row, number, robot, n_runs : of the case
    hidden : values by parameter
    causes : names of the effects hidden
    outside : name of what is hidden and not in the library
    over_limit : amplitude over the detection limit, of a single effect
    classes : by cause, the effects of its confusable class
    verdict : ``REFUSED`` where the diagnosis did not accept the runs, as too few seemed to be fit
    named, sets, unexplained : the answer
    intervals : by parameter named: value, lower and upper end of its 95 % interval
    gain_low : lower end of the smallest held-out gain of a cause
    seconds : duration of the diagnosis
    """

    row: Row
    number: int
    robot: str
    n_runs: int
    hidden: dict[str, float]
    causes: tuple[str, ...]
    outside: str
    over_limit: float
    classes: dict[str, tuple[str, ...]]
    verdict: Verdict
    named: tuple[str, ...]
    sets: tuple[tuple[str, ...], ...]
    unexplained: tuple[tuple[str, str], ...]
    intervals: dict[str, tuple[float, float, float]]
    gain_low: float
    seconds: float

    def found(self, cause: str) -> bool:
        """Return whether a hidden effect is named, alone or in a set with none but its confusable class."""
        twins = {cause, *self.classes.get(cause, ())}
        return cause in self.named or any(cause in names and set(names) <= twins for names in self.sets)

    @property
    def right(self) -> bool:
        """Whether all that is hidden is named, and nothing else."""
        return all(self.found(cause) for cause in self.causes) and not self.wrong

    @property
    def wrong(self) -> bool:
        """Whether something is named, alone or in a set, that is not hidden."""
        false = [name for name in self.named if name not in self.causes]
        return bool(false) or any(not set(names) & set(self.causes) for names in self.sets)


def simulation_of(robot: Robot) -> Simulation:
    """Return the simulation under test, with the known scatter from run to run."""
    every = load_scatter()
    scatter = {name: getattr(every, name) for name in nuisances_of(robot.drive)}
    return Simulation(robot, Ground(), robot.effects, scatter)


def run_trial(case: Case) -> Trial:
    """Hide effects in simulated runs, diagnose them, and return both."""
    robot = load_robot(case.robot)
    key = [case.seed, case.number, list(Row).index(case.row), case.n_runs]
    drawn, noise = np.random.SeedSequence(key).spawn(2)
    rng = np.random.default_rng(drawn)
    rich = rich_drives(rng, case.n_runs)
    drives = poor_drives(rng, case.n_runs) if case.row is Row.POOR else rich
    limits = None if case.row is Row.NONE else limits_of(robot, rich)
    hidden = draw_hidden(case, robot, limits, rng)
    runs = hidden_runs(robot, drives, noise, hidden.effects, hidden.outside_values)
    answer: Diagnosis | None
    start_s = time.perf_counter()
    try:
        answer = diagnose(runs, simulation_of(robot), hidden.library)
    except DataError:
        answer = None
    seconds = time.perf_counter() - start_s
    causes = () if answer is None else answer.causes
    left = () if answer is None else answer.unexplained
    return Trial(
        row=case.row,
        number=case.number,
        robot=case.robot,
        n_runs=case.n_runs,
        hidden=hidden.effects | hidden.outside_values,
        causes=hidden.causes,
        outside=hidden.outside,
        over_limit=hidden.over_limit,
        classes={} if limits is None else _classes(limits, hidden.causes, robot),
        verdict=Verdict.REFUSED if answer is None else answer.verdict,
        named=tuple(cause.name for cause in causes),
        sets=() if answer is None else answer.ambiguous_sets,
        unexplained=tuple((each.channel, each.input) for each in left),
        intervals={
            value.name: (value.value, value.low, value.high) for cause in causes for value in cause.values
        },
        gain_low=min((cause.gain_low for cause in causes), default=math.nan),
        seconds=seconds,
    )


def _classes(limits: Limits, causes: tuple[str, ...], robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return, by cause, the effects that no log of these drives distinguishes from it."""
    classes = {}
    for cause in causes:
        effect = effect_named(cause)
        twins = confusable_class(limits, effect, robot.drive) | {name for name, _ in effect.twins}
        classes[cause] = tuple(sorted(twins))
    return classes
