"""Find what a robot's simulation gets wrong about measured runs, extend it, and measure the gain."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.data.datasets import data_digest
from pipelines.explain.classifier import classifier_gain
from pipelines.explain.page import PAGE_FILE, write_explain_page
from pipelines.explain.results import DiagnosedRuns, Explanation, ExtendedDescription, HeldOutGain
from pipelines.explain.settings import ExplainSettings
from pipelines.reporting.progress import Progress, silent
from terrain.discrepancy.compared import compare_runs, without_levels
from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.extend import extend, extended_effects
from terrain.discrepancy.filter_gain import Comparison, filter_gain
from terrain.discrepancy.fitting import Problem
from terrain.discrepancy.gain import fit_to_judge, gain_of_signals
from terrain.discrepancy.health import repaired
from terrain.discrepancy.hold_out import HOLD_OUT_FROM, repair_held_out, split_runs
from terrain.discrepancy.nameless import nameless_gain
from terrain.discrepancy.next_drive import next_command
from terrain.discrepancy.parts import part_values
from terrain.discrepancy.powertrain import powertrain_answer
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.robot_terms import in_robot_terms
from terrain.discrepancy.signals import Signals, signals_of
from terrain.discrepancy.statements import acting_causes, statements_of, terrains_apart
from terrain.discrepancy.terrain_match import check_robots, runs_of_terrain, simulation_for
from terrain.discrepancy.verdict import Diagnosis, NextDrive
from terrain.effects import Effect, effect_named, library_of, showing
from terrain.errors import ConfigError, DataError
from terrain.extension import extended_yaml, region_of
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.kinematics.wheel_speed import with_wheel_speeds
from terrain.records import RunLog
from terrain.robots import Robot, load_robot

EXTENDED_FILE, NEXT_FILE = "extended.yaml", "next_drive.yaml"


def explain(runs: Sequence[RunLog], settings: ExplainSettings, progress: Progress = silent) -> Explanation:
    """Diagnose runs, extend the simulation, measure the gain, and write the page.

    Parameters
    ----------
    runs : of the robot
    settings : of the command; how files are read is not used
    progress : called with steps that are done

    Raises
    ------
    ConfigError
        if the robot, the model or an effect is not accepted, or ``out`` has an extended description already.
    DataError
        if the runs are of another robot, too few, or cannot be compared with the simulation.
    TerrainError
        if ``out`` cannot be written.
    """
    robot = _robot(settings.robot, settings.model)
    library = _library(robot, settings.effects)
    out, seed = settings.out, settings.seed
    if (out / EXTENDED_FILE).exists():
        raise ConfigError(
            f"{out / EXTENDED_FILE}: is there already and is not overwritten; choose another --out"
        )
    ensure_writable(out)
    chosen = runs_of_terrain(runs, settings.terrain)
    check_robots(chosen, robot)
    diagnosed = diagnose_runs(chosen, robot, library, settings.hold_out, seed)
    progress("diagnose", 1, 1)
    gained = held_out_gain(diagnosed, robot, seed, settings.classifier, progress)
    description = settings.model or settings.robot
    extended, text = None, ""
    diagnosis = diagnosed.diagnosis
    if diagnosed.extended is not None:
        effects = extended_effects(robot, diagnosis)
        source = f"terrain explain, {diagnosis.n_runs} runs of {settings.dataset or 'a data set'}"
        region = region_of(diagnosed.fit, robot)
        text = extended_yaml(description, *effects, source, region)
        extended = ExtendedDescription(out / EXTENDED_FILE, effects.values)
    result = Explanation(
        data=settings.dataset,
        data_digest=data_digest(runs),
        description=description,
        model=settings.model,
        terrain=settings.terrain,
        diagnosis=diagnosis,
        built_in=dict(diagnosed.simulation.effects),
        terrains=diagnosed.terrains,
        effects=tuple(effect.name for effect in library),
        seed=seed,
        used=tuple(run.run_id for run in diagnosed.used),
        held_out=tuple(run.run_id for run in diagnosed.held_out),
        gain=gained,
        extended=extended,
        page=out / PAGE_FILE,
        statements=statements_of(diagnosis, robot, diagnosed.compared, gained.gain, diagnosed.acting),
        terms={cause.name: in_robot_terms(cause.name, cause.values, robot) for cause in diagnosis.causes},
        next_command=next_command(diagnosis, description, robot, diagnosed.terrains),
        terrains_apart=terrains_apart(diagnosis, diagnosed.compared),
        powertrain=powertrain_answer(chosen, robot, diagnosis.faults, seed),
        drive=robot.drive,
    )
    write_explain_page(out, diagnosed, result, settings.max_pictures, progress)
    if extended is not None:
        atomic_write(extended.file, text)
    _write_next_drive(out, diagnosis.next_drive)
    return result


def diagnose_runs(
    runs: Sequence[RunLog], robot: Robot, library: Sequence[Effect], hold_out: int | None, seed: int
) -> DiagnosedRuns:
    """Return the diagnosis of all runs but those held out, and the simulation extended by it."""
    runs = [with_wheel_speeds(run, robot) for run in sorted(runs, key=lambda run: run.run_id)]
    used, held_out = split_runs(runs, hold_out, seed)
    simulation, terrains = simulation_for(used, robot, library)
    diagnosis = diagnose(used, simulation, library)
    extended = extend(simulation, diagnosis) if diagnosis.causes else None
    excluded = {run.run_id for run in diagnosis.excluded_runs}
    fit = tuple(run for run in used if run.run_id not in excluded)
    signals = repaired([signals_of(run, robot) for run in fit], diagnosis.faults)
    low_pass = low_pass_of(signals)
    compared = compare_runs(simulation, extended, signals, low_pass)
    last = extended or simulation
    info = Problem(signals, simulation, low_pass, tuple(library)).at(last.vector)
    held_signals = repair_held_out(
        [signals_of(run, robot) for run in held_out], diagnosis.faults, last, low_pass, _noise_of(diagnosis)
    )
    return DiagnosedRuns(
        diagnosis,
        simulation,
        extended,
        terrains,
        fit,
        tuple(used),
        tuple(held_out),
        compared,
        held_signals,
        without_levels(info.noise, compared),
        low_pass,
        part_values(info, diagnosis.causes),
        acting_causes(simulation, diagnosis, signals, compared),
    )


def _noise_of(diagnosis: Diagnosis) -> dict[str, float]:
    return {channel: residual.noise for channel, residual in diagnosis.residual_before.items()}


def held_out_gain(
    diagnosed: DiagnosedRuns, robot: Robot, seed: int, classifier: bool = False, progress: Progress = silent
) -> HeldOutGain:
    """Return what the extension gains on the runs held out, or why that was not measured.

    Parameters
    ----------
    classifier : whether a classifier trained in simulation is compared, too
    """
    simulation, extended, runs = diagnosed.simulation, diagnosed.extended, diagnosed.held_signals
    found, reason = None, None
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
            found = gain_of_signals(simulation, extended, runs, seed)
            fit = [run for run in runs if run.run_id in found.run_ids]
    except DataError as error:
        reason = reason or str(error)
    if extended is not None and runs:
        # a filter is given the logs as they are: with a fault in them its error is that of the fault
        faulty = bool(diagnosed.diagnosis.faults)
        comparisons["filter"] = None if faulty else filter_gain(diagnosed.held_out, robot, extended, seed)
        if classifier:
            comparisons["classifier"] = classifier_gain(
                diagnosed.held_out, robot, simulation.effects, extended.effects, seed, progress=progress
            )
    judged = compare_runs(simulation, extended, fit, diagnosed.low_pass, held_out=True)
    nameless = nameless_gain(diagnosed.compared, judged, _noise_of(diagnosed.diagnosis), seed)
    progress("gain", 1, 1)
    return HeldOutGain(found, reason, comparisons, nameless, judged)


def _robot(robot_name: str, model: str | None) -> Robot:
    robot = load_robot(robot_name)
    if model is None:
        return robot
    extended = load_robot(model)
    if extended.name != robot.name:
        raise ConfigError(f"--model is of the robot {extended.name!r}, --robot is {robot.name!r}")
    if extended.effects and not np.isfinite(extended.effects_cov).all():
        raise ConfigError(f"{model}: its effects have no covariance, which a model that is tested needs")
    return extended


def _library(robot: Robot, names: Sequence[str] | None) -> tuple[Effect, ...]:
    """Return the effects that may be named, in the order of the catalogue."""
    applicable = library_of(robot.drive)
    if names is None:
        return showing(robot.drive, robot.effects)
    chosen = [effect_named(name) for name in names]
    if not chosen:
        raise ConfigError("--effects names none; leave it out for all of them")
    for effect in chosen:
        if effect not in applicable:
            raise ConfigError(
                f"effect {effect.name} does not apply to a robot with the drive {robot.drive!r}"
            )
    return tuple(effect for effect in applicable if effect in chosen)


def _write_next_drive(out: Path, next_drive: NextDrive | None) -> None:
    import yaml

    if next_drive is None:
        (out / NEXT_FILE).unlink(missing_ok=True)  # of an earlier result
        return
    text = yaml.safe_dump(next_drive._asdict(), sort_keys=False, allow_unicode=True, width=10_000)
    atomic_write(out / NEXT_FILE, text)
