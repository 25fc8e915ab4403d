"""From runs of a robot to a diagnosis of its simulation, an extended one, and its gain on held-out runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from terrain.discrepancy.compared import ComparedRun, compare_runs, without_levels
from terrain.discrepancy.constancy import PartValues, part_values
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.grounds import simulation_for
from terrain.discrepancy.health.fault import repaired
from terrain.discrepancy.held_out import (
    HOLD_OUT_FROM,
    Comparison,
    Gain,
    filter_gain,
    fit_to_judge,
    gain_of_signals,
    repair_held_out,
    split_runs,
)
from terrain.discrepancy.learner import Reference, black_box_reference
from terrain.discrepancy.noise import Noise
from terrain.discrepancy.runs import (
    LowPass,
    Signals,
    Simulation,
    TerrainMatch,
    in_order,
    low_pass_of,
    signals_of,
)
from terrain.discrepancy.search import Problem
from terrain.discrepancy.verdict import INTERVAL_T, Diagnosis
from terrain.effects import CHANNELS, Effect
from terrain.errors import ConfigError, DataError
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.records import Array, RunLog
from terrain.robots import Robot

ACTS_RATIO = 0.25
"""Least part of the change of a channel by all causes, root mean square, that one of them makes to be named
with it."""


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosedRuns:
    """Runs with their diagnosis, which figures are drawn from."""

    diagnosis: Diagnosis
    simulation: Simulation
    extended: Simulation | None  #: with the causes built in; None where no cause was named
    terrains: tuple[TerrainMatch, ...]  #: on which the runs of each label were simulated
    fit: tuple[RunLog, ...]  #: behind the diagnosis
    used: tuple[RunLog, ...]  #: these and those excluded from it
    held_out: tuple[RunLog, ...]
    compared: tuple[ComparedRun, ...]  #: fit runs beside the simulation
    held_signals: tuple[Signals, ...]  #: of the runs held out, faults repaired
    noise: Noise  #: of the fit runs
    low_pass: LowPass
    parts: tuple[PartValues, ...]  #: values of the causes in parts of the data
    acting: Mapping[str, Sequence[str]]  #: by cause, the channels that it changes


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutGain:
    """What an extension gains on held-out runs; None, and why, where it was not measured."""

    gain: Gain | None
    reason: str | None = None
    comparisons: Mapping[str, Comparison | None] = field(default_factory=dict)
    """By ``filter`` and ``classifier``; None for one that does not apply."""
    black_box: Reference | None = None  #: what a black-box reference reaches; None where no run is held out
    judged: tuple[ComparedRun, ...] = ()  #: held-out runs that are fit, beside the simulation

    def as_json(self) -> dict[str, Any]:
        """Return the gain as JSON has it."""
        measured = {"reason": self.reason} if self.gain is None else self.gain._asdict()
        reference = {} if self.black_box is None else {"black_box_reference": self.black_box}
        return {"measured": self.gain is not None, **measured, **self.comparisons, **reference}


def diagnose_runs(
    runs: Sequence[RunLog], robot: Robot, library: Sequence[Effect], hold_out: int | None, seed: int
) -> DiagnosedRuns:
    """Return the diagnosis of all runs but those held out (chosen by the seed), and the simulation extended by it.

    Raises
    ------
    DataError
        if runs are too few, or cannot be compared with the simulation.
    """
    runs = [with_wheel_speeds(run, robot) for run in in_order(runs)]
    place = {run.run_id: float(k) for k, run in enumerate(runs)}
    used, held_out = split_runs(runs, hold_out, seed)
    every = {run.run_id: replace(signals_of(run, robot), place=place[run.run_id]) for run in used}
    simulation, terrains = simulation_for(used, robot, library, [*every.values()])
    diagnosis = diagnose(used, simulation, library, [*every.values()] if len(every) == len(used) else None)
    # ambiguous sets are left out: which of their effects acts is not known
    extended = simulation.with_effects(diagnosis.values) if diagnosis.causes else None
    excluded = {run.run_id for run in diagnosis.excluded_runs}
    fit = tuple(run for run in used if run.run_id not in excluded)
    signals = repaired([every[run.run_id] for run in fit], diagnosis.faults)
    low_pass = low_pass_of(signals)
    compared = compare_runs(simulation, extended, signals, low_pass)
    last = extended or simulation
    info = Problem(signals, simulation, low_pass, tuple(library)).at(last.vector)
    held_signals = [signals_of(run, robot) for run in held_out]
    return DiagnosedRuns(
        diagnosis=diagnosis,
        simulation=simulation,
        extended=extended,
        terrains=terrains,
        fit=fit,
        used=tuple(used),
        held_out=tuple(held_out),
        compared=compared,
        held_signals=repair_held_out(held_signals, diagnosis.faults, last, low_pass, _noise_of(diagnosis)),
        noise=without_levels(info.noise, compared),
        low_pass=low_pass,
        parts=part_values(info, diagnosis.causes),
        acting=acting_causes(simulation, diagnosis, signals, compared),
    )


def _noise_of(diagnosis: Diagnosis) -> dict[str, float]:
    return {channel: residual.noise for channel, residual in diagnosis.residual_before.items()}


def acting_causes(
    simulation: Simulation, diagnosis: Diagnosis, signals: Sequence[Signals], used: Sequence[ComparedRun]
) -> dict[str, tuple[str, ...]]:
    """Return the channels that each named cause changes: where the extension without it predicts otherwise."""
    acting, low_pass = {}, low_pass_of(signals)

    def squares(others: Sequence[ComparedRun], extended: bool) -> Array:
        """Return the square (channels,) of differences from the extended simulation, where it was measured."""
        apart = (
            run.residual(True) - other.residual(extended) for run, other in zip(used, others, strict=True)
        )
        return np.asarray(sum((np.nansum(x**2, axis=0) for x in apart), np.zeros(len(CHANNELS))))

    for cause in diagnosis.causes:
        own = {value.name for value in cause.parameters}
        others = {name: value for name, value in diagnosis.values.items() if name not in own}
        without = compare_runs(simulation, simulation.with_effects(others), signals, low_pass)
        acts = squares(without, True) > ACTS_RATIO**2 * squares(used, False)
        acting[cause.name] = tuple(name for name, yes in zip(CHANNELS, acts, strict=True) if yes)
    return acting


def held_out_gain(diagnosed: DiagnosedRuns, robot: Robot, seed: int) -> HeldOutGain:
    """Return what the extension gains on the runs held out, or why that was not measured."""
    simulation, extended, runs = diagnosed.simulation, diagnosed.extended, diagnosed.held_signals
    gain, reason = None, None
    comparisons: dict[str, Comparison | None] = {}
    fit: Sequence[Signals] = ()
    try:
        if not runs:
            reason = (
                f"no run was held out ({len(diagnosed.used)} runs; {HOLD_OUT_FROM} or more, or --hold-out, "
                "hold some out)"
            )
        elif extended is None:
            reason = "no cause was named, so that nothing was built in"
            fit = fit_to_judge(simulation, runs)[0]
        else:
            gain = gain_of_signals(simulation, extended, runs, seed)
            fit = [run for run in runs if run.run_id in gain.runs]
    except DataError as error:
        reason = reason or str(error)
    if extended is not None and runs:
        # a filter is given the logs as they are: with a fault in them its error is that of the fault
        faulty = bool(diagnosed.diagnosis.faults)
        comparisons["filter"] = None if faulty else filter_gain(diagnosed.held_out, robot, extended, seed)
    judged = compare_runs(simulation, extended, fit, diagnosed.low_pass, held_out=True)
    reference = black_box_reference(diagnosed.compared, judged, _noise_of(diagnosed.diagnosis), seed)
    return HeldOutGain(gain, reason, comparisons, reference, judged)


# -- The simulation, and the description of the robot, with what it lacked built in ------------------------


def extended_effects(
    robot: Robot, diagnosis: Diagnosis
) -> tuple[dict[str, float], Array, dict[str, tuple[float, float]]]:
    """Return the effects of the robot with the named causes added.

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
