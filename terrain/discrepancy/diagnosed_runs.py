"""From runs of a robot to a diagnosis of its simulation, an extended one, and its gain on held-out runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from terrain.deviation import Deviation
from terrain.discrepancy.compared import ComparedRun, beside_extended, compare_runs, without_levels
from terrain.discrepancy.constancy import PartValues, part_values, rogues_among
from terrain.discrepancy.diagnose import Found, check_ids, find_causes, judged, statement_of
from terrain.discrepancy.earned import MIN_RUNS, crossed_runs, held_out_runs, units_of
from terrain.discrepancy.gain import Gain
from terrain.discrepancy.grounds import few_of, is_better, on_soils, simulation_for
from terrain.discrepancy.held_out import Comparison, filter_gain, repair_held_out, split_runs
from terrain.discrepancy.learner import (
    Learned,
    LearnedGain,
    kept_terms,
    learn_terms,
    learned_gains,
    scatter_square,
)
from terrain.discrepancy.left_out import deviation_of, left_out_residuals
from terrain.discrepancy.noise import Noise
from terrain.discrepancy.runs import (
    LowPass,
    Signals,
    Simulation,
    TerrainMatch,
    comparable,
    in_order,
)
from terrain.discrepancy.verdict import INTERVAL_T, Diagnosis
from terrain.effects import CHANNELS, Effect
from terrain.errors import ConfigError, DataError
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.records import Array, RunLog
from terrain.robots import Robot


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosedRuns:
    """Runs with their diagnosis, which figures are drawn from."""

    diagnosis: Diagnosis
    simulation: Simulation
    extended: Simulation | None  #: with what was named built in; None where nothing was
    terrains: tuple[TerrainMatch, ...]  #: on which the runs of each label were simulated
    signals: tuple[Signals, ...]  #: of the runs that are compared, faults repaired
    fit: tuple[RunLog, ...]  #: behind the diagnosis
    used: tuple[RunLog, ...]  #: these and those excluded from it
    held_out: tuple[RunLog, ...]
    compared: tuple[
        ComparedRun, ...
    ]  #: fit runs beside the simulation, and that with what was named and learned
    judged: tuple[ComparedRun, ...]  #: runs held out, or left out in turn, beside the simulation
    noise: Noise  #: of the fit runs
    low_pass: LowPass
    parts: tuple[PartValues, ...]  #: values of the causes in parts of the data
    acting: Mapping[str, Sequence[str]]  #: by cause, the channels where it acts, on the runs judged
    learned: Mapping[str, Learned]  #: by channel, what was learned beside what was named
    learned_gains: tuple[LearnedGain, ...]  #: of each learned term; empty where no run was held out
    with_terms: Simulation  #: with what was named and learned built in
    #: runs judged, beside that; where none was held out, beside what was named
    whole: tuple[ComparedRun, ...]
    whole_gain: Gain  #: of that on them
    deviation: Deviation  #: from that of runs that were left out of the fit


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutGain:
    """What an extension gains on data held out; of what was built in before it, on all runs."""

    gain: Gain
    built_in_before: Gain | None = None
    """What the effects that the description had already gain over one without, on all runs; None without any."""
    comparisons: Mapping[str, Comparison | None] = field(default_factory=dict)
    """By ``filter`` and ``classifier``; None for one that does not apply."""

    def as_json(self) -> dict[str, Any]:
        """Return the gain as JSON has it."""
        return {**self.gain._asdict(), "built_in_before": self.built_in_before, **self.comparisons}


def diagnose_runs(
    runs: Sequence[RunLog], robot: Robot, library: Sequence[Effect], hold_out: int | None, seed: int
) -> DiagnosedRuns:
    """Return the diagnosis of all runs but those held out (chosen by the seed), judged on these.

    Where none is held out, parts of the runs are left out of the fit in turn.  Runs that cannot be compared are
    excluded, with the reason.

    Raises
    ------
    DataError
        if runs are too few, or cannot be compared with the simulation.
    """
    runs = [with_wheel_speeds(run, robot) for run in in_order(runs)]
    check_ids(runs)
    every, left_out = comparable(runs, robot)
    place = {run.run_id: float(k) for k, run in enumerate(runs)}
    by_id = {run.run_id: replace(run, place=place[run.run_id]) for run in every}
    if left_out and len(by_id) < MIN_RUNS:
        why = "; ".join([f"{run.run_id}: {run.reason}" for run in left_out[:3]])
        raise DataError(f"runs: only {len(by_id)} of {len(runs)} can be compared ({why})")
    used, held_out = split_runs([run for run in runs if run.run_id in by_id], hold_out, seed)
    given = [by_id[run.run_id] for run in used]
    found, simulation, terrains = found_on_ground(used, robot, library, given)
    problem = found.problem
    about = simulation, problem.low_pass, found.noise, seed
    on = None
    if held_out:
        given = [by_id[run.run_id] for run in held_out]
        held = repair_held_out(given, found.faults, found.extended, problem.low_pass, found.noise)
        rogues = rogues_among(problem, found.fit, held)
        found = found._replace(excluded=(*found.excluded, *rogues))
        held = tuple([run for run in held if run.run_id not in [rogue.run_id for rogue in rogues]])
        plain = compare_runs(simulation, None, problem.signals, problem.low_pass)
        with suppress(DataError):  # none of them is fit to judge on
            on = held_out_runs(plain, held, found.extended, *about)
    on = on or crossed_runs(problem.signals, *about)
    found, judgement = judged(found._replace(excluded=(*left_out, *found.excluded)), on)
    diagnosis = statement_of(found, judgement)
    extended = found.extended if diagnosis.built_in else None
    compared = compare_runs(simulation, extended, problem.signals, problem.low_pass)
    last = extended or simulation
    info = problem.at(last.vector)
    noise = without_levels(info.noise, compared)
    learned = learn_terms(last, problem.signals, compared, problem.low_pass, scatter_square(info), seed)
    gains: tuple[LearnedGain, ...] = ()
    with_terms, whole, whole_gain = last.with_learned(kept_terms(learned)), judgement.runs, judgement.gain
    if with_terms is not last and not on.in_turn:
        pairs = zip(on.plain, on.signals, strict=True)
        whole = tuple(beside_extended(run, own, with_terms, problem.low_pass) for run, own in pairs)
        whole_gain = on.gain(whole)
        gains = learned_gains(learned, judgement.runs, whole_gain, whole, seed)
    behind = {run.run_id for run in problem.signals}
    extension = None if with_terms is simulation else with_terms
    compared = compare_runs(simulation, extension, problem.signals, problem.low_pass)
    left = left_out_residuals(compared, problem.signals, info, diagnosis.covariance.parameters, learned)
    return DiagnosedRuns(
        diagnosis=diagnosis,
        simulation=simulation,
        extended=extended,
        terrains=terrains,
        signals=problem.signals if on.in_turn else (*problem.signals, *on.signals),
        fit=tuple(run for run in used if run.run_id in behind),
        used=tuple(used),
        held_out=tuple(held_out),
        compared=compared,
        judged=judgement.runs,
        noise=noise,
        low_pass=problem.low_pass,
        parts=part_values(info, diagnosis.built_in),
        acting=judgement.acting,
        learned=learned,
        learned_gains=gains,
        with_terms=with_terms,
        whole=whole,
        whole_gain=whole_gain,
        deviation=deviation_of(compared, left, units_of(compared), problem.low_pass),
    )


def found_on_ground(
    runs: Sequence[RunLog], robot: Robot, library: Sequence[Effect], signals: Sequence[Signals]
) -> tuple[Found, Simulation, tuple[TerrainMatch, ...]]:
    """Return what was found on the soils of the labels, or on the default ground, and the terrain of each label.

    With what is found on them soils have to leave clearly less of the runs behind the fit than the default ground, or
    less by fewer causes.  Of many runs some decide.
    """
    simulation, terrains = simulation_for(runs, robot, library, signals)
    found = find_causes(runs, simulation, library, signals)
    on_soil, on_labels = on_soils(runs, simulation, library, signals)
    if not any(match.soil for match in on_labels):
        return found, simulation, terrains
    few = few_of(range(len(runs)))
    some, every = ([runs[i] for i in few], [signals[i] for i in few]), len(few) == len(runs)
    try:
        one = found if every else find_causes(some[0], simulation, library, some[1])
        other = find_causes(some[0], on_soil, library, some[1])
    except DataError:  # on the soil too few of them are fit to be compared
        return found, simulation, terrains
    noise = np.array([one.noise.get(name, np.inf) for name in CHANNELS])

    def left_by(each: Found) -> dict[str, float]:
        compared = compare_runs(each.extended, None, each.problem.signals, each.problem.low_pass)
        return {run.run_id: float(np.nansum((run.residual(False) / noise) ** 2)) for run in compared}

    left, without = left_by(other), left_by(one)
    both = [run for run in one.problem.signals if run.run_id in left]
    loss, loss_without = (np.array([of[run.run_id] for run in both]) for of in (left, without))
    fewer = len(other.fit.causes) < len(one.fit.causes) and loss.sum() < loss_without.sum()
    if fewer or is_better(loss, loss_without, units_of(both)):
        with suppress(DataError):  # so may all of them be
            return other if every else find_causes(runs, on_soil, library, signals), on_soil, on_labels
    return found, simulation, terrains


def held_out_gain(diagnosed: DiagnosedRuns, robot: Robot, seed: int) -> HeldOutGain:
    """Return what the extension gains, for a filter too, and what the effects gain that the robot had already."""
    diagnosis, comparisons = diagnosed.diagnosis, {}
    extended = diagnosed.with_terms
    if extended is not diagnosed.simulation and diagnosed.held_out:
        # a filter is given the logs as they are: with a fault in them its error is that of the fault
        comparisons["filter"] = (
            None if diagnosis.faults else filter_gain(diagnosed.held_out, robot, extended, seed)
        )
    assert diagnosis.gain is not None
    return HeldOutGain(diagnosis.gain, gain_built_in(diagnosed, seed), comparisons)


def gain_built_in(diagnosed: DiagnosedRuns, seed: int) -> Gain | None:
    """Return what effects and terms that a simulation has already gain on all runs, over it without; None without any.

    Whether it was found by some of these runs is not known.
    """
    simulation = diagnosed.simulation
    if not simulation.effects and not simulation.learned:
        return None
    bare = replace(simulation, effects={}, learned=())
    signals, low_pass = diagnosed.signals, diagnosed.low_pass
    on = crossed_runs(
        signals,
        bare,
        low_pass,
        {name: of.noise for name, of in diagnosed.diagnosis.residual_before.items()},
        seed,
    )
    pairs = zip(on.plain, on.signals, strict=True)
    runs = [beside_extended(run, own, simulation, low_pass) for run, own in pairs]
    return on._replace(how=f"{len(runs)} runs, by some of which it may have been found").gain(runs)


# -- The simulation, and the description of the robot, with what it lacked built in ------------------------


def extended_effects(
    robot: Robot, diagnosis: Diagnosis
) -> tuple[dict[str, float], Array, dict[str, tuple[float, float]]]:
    """Return the effects of the robot with the named causes added, and the last value of what follows the runs' order.

    The covariance of a parameter that was found again is that of the new estimate; all other parameters keep
    theirs, and the two groups are taken as independent.

    Returns
    -------
    values : (k) by parameter
    cov : (k, k) covariance of the values, in their order
    intervals : 95 % interval by parameter

    Raises
    ------
    ConfigError
        if the covariance of the robot's effects is not known.
    """
    parameters, matrix = diagnosis.covariance
    names = list(dict.fromkeys([*robot.effects, *parameters]))
    cov = np.zeros((len(names), len(names)))
    old, new = ([names.index(name) for name in some] for some in (robot.effects, parameters))
    cov[np.ix_(old, old)] = robot.effects_cov
    cov[new], cov[:, new] = 0.0, 0.0
    cov[np.ix_(new, new)] = matrix
    if not np.isfinite(cov).all():
        raise ConfigError(
            f"robot {robot.name}: its effects have no covariance, which an extended description requires"
        )
    added = diagnosis.values
    values = {name: robot.effects.get(name, 0.0) + added.get(name, 0.0) for name in names}
    for latest in diagnosis.latest:  # in the place of a mean of all runs
        if latest.name not in names:
            names.append(latest.name)
            cov = np.pad(cov, (0, 1))
        k = names.index(latest.name)
        values[latest.name] = robot.effects.get(latest.name, 0.0) + latest.value
        cov[k], cov[:, k] = 0.0, 0.0
        cov[k, k] = (0.5 * (latest.high - latest.low) / INTERVAL_T) ** 2
    halves = dict(zip(names, (INTERVAL_T * np.sqrt(cov.diagonal())).tolist(), strict=True))
    return values, cov, {name: (values[name] - halves[name], values[name] + halves[name]) for name in names}


def chosen_runs(runs: Sequence[RunLog], robot: Robot, terrain: str | None) -> list[RunLog]:
    """Return the runs that are of one label throughout; all of them where none is asked for.

    Raises
    ------
    DataError
        if there is no such run, or if some are of another robot.
    """
    if not runs:
        raise DataError("there is no run to explain")
    chosen = [run for run in runs if terrain is None or run.terrains == (terrain,)]
    if not chosen:
        labels = ", ".join(sorted({name for run in runs for name in run.terrains})) or "none"
        raise DataError(f"no run is labelled {terrain!r} throughout; labels are {labels}")
    others = Counter(run.robot for run in chosen if run.robot != robot.name)
    for name, n in others.most_common(1):
        raise DataError(
            f"{n} of {len(chosen)} runs are of the robot {name!r}; the simulation is of {robot.name!r}"
        )
    return chosen
