"""Find what a robot's simulation gets wrong about runs, extend it, and measure the gain."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.data.datasets import load
from pipelines.data.settings import AlignedRunsSettings
from pipelines.report.settings import Names, setting
from pipelines.report.settings import Settings as BaseSettings
from terrain.errors import ConfigError

if TYPE_CHECKING:
    from pipelines.explain.explanation import ExplainResult
    from pipelines.report.results import Progress
    from terrain.discrepancy.watch import Watched
    from terrain.records import RunLog
    from terrain.robots import Robot

EXAMPLE = "terrain explain --data raw/ --robot husky --out explained/"
RESULTS = ("pipelines.explain.explanation",)  #: Modules of the results

PAGE_FILE, EXTENDED_FILE = "report.html", "extended.yaml"


class ExplainOptions(BaseSettings):
    """What may be named, of which runs, and how the gain is measured."""

    effects: Names | None = setting(None, min_length=1)
    """Effects that may be named, by commas; all by default."""
    terrain: str | None = setting(None, "Use only runs of this label.")
    hold_out: int | None = setting(None, ge=0)
    """Runs held out to measure the gain; a quarter of 24 or more by default, and with --against of six."""
    classifier: bool = setting(False)
    """Also train a classifier in simulation, before and after; takes a minute."""
    seed: int = setting(0, "Of the choice of held-out runs, and of the bootstrap.", ge=0)


class Settings(ExplainOptions, AlignedRunsSettings):
    """Runs to explain, and the simulation under test."""

    robot: str = setting(..., "Robot whose simulation is tested: name or YAML file.")
    out: Path = setting(..., "Folder of the page and of the extended robot.")
    model: str | None = setting(None, "Extended description of that robot, tested in its place.")
    against: Path | None = setting(None)
    """Folder of other runs of the robot: what changed from --data to them, as tyres, a load, or the floor."""
    pictures: str = setting("6", pattern="^([0-9]+|all)$")
    """Most runs that the page draws: a number, or 'all'."""


def run(settings: Settings, progress: Progress) -> ExplainResult:
    """Read runs, explain them as :func:`explain`, and write the page, the extended robot and the next drive."""
    import numpy as np

    from pipelines.explain.statements import sources_of
    from terrain.discrepancy.diagnosed_runs import extended_effects
    from terrain.discrepancy.next_drive import NEXT_FILE, commands_of, next_command
    from terrain.discrepancy.watch import watch_lines
    from terrain.extension import extended_yaml
    from terrain.files.atomic import atomic_write, ensure_writable
    from terrain.robots import load_robot

    if settings.against is not None and settings.against.resolve() == settings.data.resolve():
        raise ConfigError("--against is the folder of --data; a set of runs does not differ from itself")
    runs, skipped, doubts = load(settings)
    others: list[RunLog] = []
    if settings.against is not None:
        asked = settings.model_copy(update={"data": settings.against, "only": (), "without": ()})
        others, more, further = load(asked)
        skipped, doubts = [*skipped, *more], [*doubts, *further]
    out, model = settings.out, settings.model
    robot = tested = load_robot(settings.robot)
    if model is not None:
        tested = load_robot(model)
        if tested.name != robot.name:
            raise ConfigError(f"--model is of the robot {tested.name!r}, --robot is {robot.name!r}")
        if tested.effects and not np.isfinite(tested.effects_cov).all():
            raise ConfigError(f"{model}: its effects have no covariance, which a model that is tested needs")
    extended_file = out / EXTENDED_FILE
    if extended_file.exists():
        raise ConfigError(f"{extended_file}: is there already and is not overwritten; choose another --out")
    ensure_writable(out)
    description = model or settings.robot
    options = settings.model_dump(include=set(ExplainOptions.model_fields))
    found = explain(
        runs,
        tested,
        data=settings.dataset,
        description=description,
        progress=progress,
        against=others or None,
        against_data=settings.against.resolve().name if settings.against else "",
        **options,
    )
    result = replace(
        found,
        model=model,
        skipped=tuple(skipped),
        next_command=next_command(
            found.diagnosis.next_drive, description, robot, found.diagnosed.terrains, str(out / NEXT_FILE)
        ),
        n_pictures=None if settings.pictures == "all" else int(settings.pictures),
        page=out / PAGE_FILE,
        extended_file=extended_file if found.is_extended else None,
    ).with_doubts(doubts)
    if result.extended_file is not None:
        effects = extended_effects(tested, result.diagnosis)
        sources, about = sources_of(result.diagnosis, settings.dataset or "a data set"), result.extended
        watched, _ = watched_of(result, settings.dataset)
        text = extended_yaml(
            description, *effects, sources, about.region, about.learned, about.deviation, watch_lines(watched)
        )
        atomic_write(extended_file, text)
    if (drive := result.diagnosis.next_drive) is None:
        (out / NEXT_FILE).unlink(missing_ok=True)  # of an earlier result
    else:
        atomic_write(out / NEXT_FILE, commands_of(drive))
    result.report.save(out / PAGE_FILE)
    return result


def watched_of(found: ExplainResult, data: str) -> tuple[Watched, list[RunLog]]:
    """Return the extended robot as it is watched, and the runs by which: those behind the diagnosis and held out."""
    from terrain.discrepancy.runs import in_order
    from terrain.discrepancy.watch import watched_on

    judged = {run.run_id for run in found.diagnosed.judged}
    held_out = [run for run in found.diagnosed.held_out if run.run_id in judged]
    quiet = in_order([*found.diagnosed.fit, *held_out])
    source = f"terrain explain, {len(quiet)} runs of {data or 'a data set'}, {len(held_out)} of them held out"
    return watched_on(quiet, found.extended, source), quiet


def explain(
    runs: Iterable[RunLog],
    robot: Robot | str,
    *,
    data: str = "",
    description: str | None = None,
    progress: Progress | None = None,
    against: Iterable[RunLog] | None = None,
    against_data: str = "",
    **options: Any,
) -> ExplainResult:
    """Return what the simulation of a robot gets wrong about its runs, extend it, and measure the gain.

    Parameters
    ----------
    runs : of the robot, three or more; of one or two that are long, parts count as runs
    robot : whose simulation is tested, with the effects that its description has; or its name
    data : name of the data set, for the report
    description : of the robot, for the report and the suggested command; its name by default
    progress : called with steps that are done
    against : other runs of the robot, and the name of that data set: what changed from ``runs`` to them
    options : fields of :class:`ExplainOptions`, as ``hold_out`` or ``terrain``

    Returns
    -------
    ExplainResult
        with ``report``, ``extended`` (the robot with what earned it built in; as it was where nothing did)
        and ``to_pandas()``

    Raises
    ------
    ConfigError
        if an effect is not accepted, or the effects of the robot have no covariance.
    DataError
        if the runs are of another robot, too few, or cannot be compared with the simulation.
    """
    from pipelines.explain.explanation import ExplainResult
    from pipelines.explain.statements import notes_of, statements_of
    from pipelines.report.results import silent
    from terrain.discrepancy.compared import terrains_apart
    from terrain.discrepancy.diagnosed_runs import chosen_runs, diagnose_runs, extended_effects, held_out_gain
    from terrain.discrepancy.held_out import quarter
    from terrain.discrepancy.next_drive import next_command
    from terrain.discrepancy.powertrain import powertrain_of
    from terrain.discrepancy.robot_terms import in_robot_terms
    from terrain.effects import library_of, showing
    from terrain.extension import region_of
    from terrain.logs.cuts import cut_long, cut_note
    from terrain.logs.run_folders import data_digest
    from terrain.robots import load_robot

    asked, progress, runs = ExplainOptions(**options), progress or silent, list(runs)
    robot = load_robot(robot) if isinstance(robot, str) else robot
    description = description or robot.name
    names, seed = asked.effects, asked.seed
    library = showing(robot.drive, robot.effects) if names is None else library_of(robot.drive, names)
    parts = cut_long(runs)
    chosen = chosen_runs(parts, robot, asked.terrain)
    hold_out = asked.hold_out
    if hold_out is None and against is not None:  # differences are judged on runs held out of both sets
        hold_out = quarter(len(chosen))
    diagnosed = diagnose_runs(chosen, robot, library, hold_out, seed)
    progress("diagnose", 1, 1)
    gained = held_out_gain(diagnosed, robot, seed)
    progress("gain", 1, 1)
    compared_sets = None
    if against is not None:
        from terrain.discrepancy.against import compare_with

        others = chosen_runs(list(against), robot, asked.terrain)
        compared_sets = compare_with(diagnosed, robot, others, library, seed)
        progress("against", 1, 1)
    diagnosis, extended = diagnosed.diagnosis, robot
    if diagnosed.extended is not None and asked.classifier and diagnosed.held_out:
        from pipelines.explain.classifier import classifier_gain

        before, after = diagnosed.simulation.effects, diagnosed.extended.effects
        compared = classifier_gain(diagnosed.held_out, robot, before, after, seed, progress=progress)
        gained = replace(gained, comparisons={**gained.comparisons, "classifier": compared})
    if diagnosed.with_terms is not diagnosed.simulation or diagnosis.latest:
        values, cov, _ = extended_effects(robot, diagnosis)
        source = f"terrain explain, {diagnosis.n_runs} runs of {data or 'a data set'}"
        terms = [replace(term, source=source) for term in diagnosed.with_terms.learned[len(robot.learned) :]]
        extended = replace(robot, effects=values, effects_cov=cov, region=region_of(diagnosed.fit, robot))
        extended = replace(extended, learned=(*robot.learned, *terms), deviation=diagnosed.deviation)
    return ExplainResult.of(
        asked,
        data=data,
        data_digest=data_digest(runs),
        description=description,
        effects=tuple(effect.name for effect in library),
        robot=robot,
        diagnosed=diagnosed,
        gain=gained,
        extended=extended,
        statements=statements_of(diagnosis, robot, diagnosed.compared),
        terms={
            cause.name: in_robot_terms(cause.name, cause.parameters, robot) for cause in diagnosis.built_in
        },
        next_command=next_command(diagnosis.next_drive, description, robot, diagnosed.terrains),
        notes=(
            *cut_note(runs, parts),
            *notes_of(
                diagnosis,
                diagnosed.terrains,
                terrains_apart(diagnosis.differing_channels, diagnosed.compared),
            ),
        ),
        against=compared_sets,
        against_data=against_data,
        powertrain=powertrain_of(chosen, robot, diagnosis.faults, seed),
    )
