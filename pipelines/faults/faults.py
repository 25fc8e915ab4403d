"""``terrain faults``: the table of sensor faults in the closed loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from pipelines.faults.drives import (
    DELAY_S,
    FaultInputs,
    Place,
    References,
    clean_drive,
    drive_references,
    evaluate_case,
)
from pipelines.faults.results import FaultCase, FaultRow, FaultsResult
from pipelines.faults.settings import FaultsSettings
from pipelines.reporting.progress import Progress, silent
from terrain.control.fault_evaluation import LIMITS
from terrain.control.fault_situations import STOP, make_fault_situation
from terrain.control.learned_table import learned_table
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.errors import ConfigError
from terrain.robots import Robot, SwerveRobot, as_drive, load_robot
from terrain.simulation.faults.catalogue import fault_catalogue, select_faults
from terrain.simulation.faults.fault import SensorFault
from terrain.simulation.slip_sweep import learning_runs
from terrain.slip_learning.learn import learn_terrain, terrain_runs
from terrain.terramechanics.soil import load_soil

LEARNING_SEED = 5000
"""Of the simulated runs that targets are learned from; seeds of drives are far below."""


def faults_robot(settings: FaultsSettings) -> Robot:
    """Return the robot, once all that is named is known to exist.

    Raises
    ------
    ConfigError
        if a fault, a situation or a terrain is unknown, or the robot is no swerve robot with all sections.
    TerrainError
        if its description cannot be read.
    """
    robot = as_drive(
        SwerveRobot,
        load_robot(settings.robot),
        "robot {name}: drive {drive!r} has no pilot, only 'swerve' has",
    )
    robot.require(*robot.sections)
    catalogue = fault_catalogue(robot)
    select_faults(catalogue, settings.faults)
    drawn = {fault.name for fault in select_faults(catalogue, settings.draw)}
    chosen = {fault.name for fault in select_faults(catalogue, settings.faults)}
    if settings.draw and not drawn <= chosen:
        raise ConfigError(
            f"--draw has {min(drawn - chosen)!r}, which is not among the faults that are driven"
        )
    for place in _places(settings):
        make_fault_situation(place.situation, robot, place.terrain, place.seed)
    return robot


def faults_inputs(settings: FaultsSettings, robot: Robot, progress: Progress = silent) -> FaultInputs:
    """Return the robot with its table of target slips, which is learned where none is given.

    Raises
    ------
    TerrainError
        if the table cannot be read, or is another robot's.
    """
    if settings.table is not None:
        return FaultInputs(robot, load_slip_table(settings.table, robot.name))
    terrains = list(dict.fromkeys(place.terrain for place in _places(settings)))
    return FaultInputs(robot, learn_table(robot, terrains, progress))


def learn_table(robot: Robot, terrains: Sequence[str], progress: Progress = silent) -> SlipTable:
    """Return target slips learned from simulated runs on terrains, as ``terrain learn-slip`` learns them."""
    learned = []
    for done, terrain in enumerate(terrains, start=1):
        runs = learning_runs(robot, terrain, LEARNING_SEED)
        measured = [one for run in runs for one in terrain_runs(run, robot)]
        learned.append(learn_terrain(load_soil(terrain).name, measured, LEARNING_SEED))
        progress("learn targets", done, len(terrains))
    return learned_table(learned, robot, "learned")


def faults(
    settings: FaultsSettings, inputs: FaultInputs | None = None, progress: Progress = silent
) -> FaultsResult:
    """Drive each fault in each situation, and evaluate what the controller makes of it.

    Parameters
    ----------
    settings : what is driven
    inputs : robot and table; made by default
    progress : of the drives

    Raises
    ------
    TerrainError
        if a setting is not accepted.
    """
    inputs = faults_inputs(settings, faults_robot(settings), progress) if inputs is None else inputs
    chosen = select_faults(fault_catalogue(inputs.robot), settings.faults)
    places = _places(settings)
    made = _in_processes(settings.n_jobs, drive_references, [(inputs, place) for place in places])
    references: dict[Place, References] = {}
    for place, found in zip(places, made, strict=True):
        references[place] = found
        progress("drive without faults", len(references), len(places))
    cases = list(_cases(settings, chosen, places))
    rows: list[FaultRow] = []
    tasks = [(inputs, case, references[Place(*case[2:])]) for case in cases]
    for row in _in_processes(settings.n_jobs, evaluate_case, tasks):
        rows.append(row)
        progress("drive with faults", len(rows), len(cases))
    return FaultsResult(
        robot=inputs.robot.name,
        table=inputs.table.name,
        seeds=tuple(dict.fromkeys(place.seed for place in places)),
        delay_s=DELAY_S,
        limits=LIMITS,
        abouts={fault.name: fault.about for fault in chosen},
        clean=tuple(clean_drive(place, found) for place, found in references.items()),
        rows=tuple(rows),
    )


def drawn_cases(settings: FaultsSettings, result: FaultsResult) -> list[FaultCase]:
    """Return the drives that the page draws, of the first seed.

    With ``settings.draw`` those of these faults, for the longest time that was driven; else of each kind the
    drive with the most unmet bars.
    """
    longest_s, first = max(row.case.duration_s for row in result.rows), result.seeds[0]
    rows = [row for row in result.rows if row.case.seed == first]
    if settings.draw:
        return [
            row.case
            for row in rows
            if {row.case.fault, row.kind} & set(settings.draw) and row.case.duration_s == longest_s
        ]
    worst: dict[str, FaultRow] = {}
    for row in rows:
        if row.unmet and len(row.unmet) > len(worst[row.kind].unmet if row.kind in worst else ()):
            worst[row.kind] = row
    return [row.case for row in worst.values()]


def _places(settings: FaultsSettings) -> list[Place]:
    return [
        Place(situation, terrain, seed)
        for seed in range(settings.first_seed, settings.first_seed + settings.seeds)
        for situation in settings.situations
        for terrain in (settings.stop_terrains if situation == STOP else settings.terrains)
    ]


def _cases(
    settings: FaultsSettings, chosen: Iterable[SensorFault], places: Sequence[Place]
) -> Iterator[FaultCase]:
    for fault in chosen:
        for place in places:
            for duration_s in sorted(settings.durations_s, key=lambda each: (math.isinf(each), each)):
                yield FaultCase(fault.name, duration_s, *place)


def _in_processes(n_jobs: int, work: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
    """Yield what the work gives for each task, in their order."""
    from joblib import Parallel, delayed

    pool = Parallel(n_jobs=max(min(n_jobs, len(tasks)), 1), return_as="generator")
    yield from pool(delayed(work)(*task) for task in tasks)
