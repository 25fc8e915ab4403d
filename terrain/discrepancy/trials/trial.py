"""One blind trial: effects are hidden in simulated runs, and the diagnosis is asked for them."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.trials.hidden_effects import Case
from terrain.discrepancy.trials.limits import confusable_class
from terrain.discrepancy.trials.rows import DRIVE_ROWS, Row
from terrain.discrepancy.trials.stage import Stage
from terrain.discrepancy.trials.stages import CLOCK, stage_of
from terrain.discrepancy.trials.written_faults import Statement
from terrain.discrepancy.verdict import Diagnosis, Verdict
from terrain.effects import HEADING, LIBRARY, effect_named, library_of, nuisances_of
from terrain.errors import DataError
from terrain.robots import Robot, load_robot
from terrain.simulation.planar.model import Ground
from terrain.simulation.planar.noise import load_scatter

CLOCK_STATED_S = 0.04
"""Largest error of the delay between two loggers that is stated: two samples of the wheels' logger."""


class Varying(NamedTuple):
    """An effect that differs from run to run, as it was answered.

    Parameters
    ----------
    name : of the effect
    groups : value and run ids of each group
    rivals : effects that explain the differences as well
    """

    name: str
    groups: tuple[tuple[float, tuple[str, ...]], ...]
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Trial:
    """What was hidden, and what the diagnosis answered.

    Parameters
    ----------
    row, number, robot, n_runs : of the case; ``n_runs`` that were made
    hidden : values by parameter
    causes : names of the effects hidden
    outside : name of what is hidden and not in the library
    over_limit : amplitude over the detection limit, of a single effect
    classes : by cause, the effects of its confusable class
    verdict : ``REFUSED`` where the diagnosis did not accept the runs, as too few seemed to be fit
    named, sets, unexplained : the answer
    intervals : by parameter named, alone or in a set: value, lower and upper end of its 95 % interval
    gain_low : lower end of the smallest held-out gain of a cause
    seconds : duration of the diagnosis
    variant, accepted, clipped, late_s, stalled, present, fault : as a
        :class:`~terrain.discrepancy.trials.stage.Stage` has them
    clock_s : median delay of IMU and camera that the answer states; NaN where it states none
    excluded : ids of the runs that were excluded
    varying : effects that differ from run to run
    statements : what the answer states of faults of the logs
    refusal : why the runs were refused
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
    variant: str = ""
    accepted: tuple[str, ...] = ()
    clipped: bool = False
    late_s: float = math.nan
    stalled: tuple[str, ...] = ()
    present: tuple[str, ...] = ()
    fault: str = ""
    clock_s: float = math.nan
    excluded: tuple[str, ...] = ()
    varying: tuple[Varying, ...] = ()
    statements: tuple[Statement, ...] = ()
    refusal: str = ""

    def found(self, cause: str) -> bool:
        """Return whether a hidden effect is named, alone or in a set with none but its confusable class.

        A late logger is found by the delay that is stated, too.
        """
        twins = {cause, *self.classes.get(cause, ())}
        if cause == CLOCK and abs(self.clock_s - self.late_s) <= CLOCK_STATED_S:
            return True
        return cause in self.named or any(cause in names and set(names) <= twins for names in self.sets)

    @property
    def right(self) -> bool:
        """Whether all that is hidden is named, and nothing else."""
        return all(self.found(cause) for cause in self.causes) and not self.wrong

    @property
    def wrong(self) -> bool:
        """Whether something is named, alone or in a set, that is not hidden."""
        fine = {*self.causes, *self.accepted}
        return bool(set(self.named) - fine) or any(not set(names) & fine for names in self.sets)


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
    stage = stage_of(case, robot, np.random.default_rng(drawn), noise)
    answer: Diagnosis | None = None
    refusal = ""
    start_s = time.perf_counter()
    try:
        answer = diagnose(stage.runs, stage.simulation or simulation_of(robot), stage.hidden.library)
    except DataError as error:
        refusal = str(error)
    return _trial(case, robot, stage, answer, refusal, time.perf_counter() - start_s)


def _trial(
    case: Case, robot: Robot, stage: Stage, answer: Diagnosis | None, refusal: str, seconds: float
) -> Trial:
    hidden = stage.hidden
    return Trial(
        row=case.row,
        number=case.number,
        robot=case.robot,
        n_runs=len(stage.runs),
        hidden=hidden.effects | hidden.outside_values,
        causes=hidden.causes,
        outside=hidden.outside,
        over_limit=hidden.over_limit,
        classes=_classes(stage, robot, case.row),
        seconds=seconds,
        variant=stage.variant,
        accepted=stage.accepted,
        clipped=stage.clipped,
        late_s=stage.late_s,
        stalled=stage.stalled,
        present=stage.present,
        fault=stage.fault,
        refusal=refusal,
        **_answered(answer),
    )


def _answered(answer: Diagnosis | None) -> dict[str, Any]:
    """Return the fields of a trial that are the answer; what a diagnosis does not have is empty."""
    if answer is None:
        none = dict.fromkeys(("named", "sets", "unexplained"), ())
        return {**none, "verdict": Verdict.REFUSED, "intervals": {}, "gain_low": math.nan}
    causes = answer.causes
    in_sets = [
        value
        for names in answer.ambiguous_sets
        for n in names
        for value in answer.ambiguous_values.get(n, ())
    ]
    values = [*in_sets, *(value for cause in causes for value in cause.values)]
    offset_s = np.array([clock.offset_s for clock in answer.clocks])
    known_s = offset_s[np.isfinite(offset_s)]
    return {
        "verdict": answer.verdict,
        "named": tuple(cause.name for cause in causes),
        "sets": answer.ambiguous_sets,
        "unexplained": tuple((each.channel, each.input) for each in answer.unexplained),
        "intervals": {value.name: (value.value, value.low, value.high) for value in values},
        "gain_low": min((cause.gain_low for cause in causes), default=math.nan),
        "clock_s": float(np.median(known_s)) if known_s.size else math.nan,
        "excluded": tuple(run.run_id for run in answer.excluded_runs),
        "varying": tuple(
            Varying(each.name, tuple((group.value, group.run_ids) for group in each.groups), each.rivals)
            for each in answer.varying
        ),
        "statements": tuple(
            Statement(fault.kind.value, fault.column.value, fault.sentence) for fault in answer.faults
        ),
    }


def _classes(stage: Stage, robot: Robot, row: Row) -> dict[str, tuple[str, ...]]:
    """Return, by cause, the effects that no log of these drives distinguishes from it."""
    if stage.limits is None:
        return {}
    has_heading = any("lidar" in run.streams for run in stage.runs)
    classes = {}
    for cause in stage.hidden.causes:
        if cause not in [effect.name for effect in LIBRARY]:
            continue
        effect = effect_named(cause)
        twins = {name for name, channel in effect.twins if not (has_heading and channel == HEADING)}
        twins |= confusable_class(stage.limits, effect, robot.drive)
        if row in DRIVE_ROWS:  # without currents a rolling resistance is nearly a smaller radius
            others, values = library_of(robot.drive), stage.hidden.effects
            twins |= {o.name for o in others if stage.limits.in_place_of(effect, values, o)}
        classes[cause] = tuple(sorted(twins))
    return classes
