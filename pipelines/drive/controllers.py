"""Who drives in ``terrain drive``: from a controller's name to a pilot with its table and its watch."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from pipelines.drive.drives import Situation
from pipelines.live.pilot import LivePilot, PilotSettings
from pipelines.live.watch import Classifier, Nobody, Told, Watch
from pipelines.models.model_files import TerrainModel
from pipelines.reporting.progress import Progress, silent
from terrain.control.slip_table import SlipTable
from terrain.errors import ConfigError
from terrain.records import RunLog, SlipTarget
from terrain.robots import Robot
from terrain.simulation.dynamic.simulate import simulate

CONTROLLERS = ("plain", "ramp", "thesis", "fixed", "learned", "oracle")
"""Commands as they are; with a bounded rise; the thesis' PID on the table's fallback; ours on the fallback,
on what a classifier says, on the true ground.  Also ``told:NAME``, ours and always told that ground, and
``target:0.2``, ours with that target; and each of ours with ``+track``: held to its way."""


@dataclass(frozen=True, slots=True)
class Driver:
    """What a controller's name stands for.

    Parameters
    ----------
    name : as given
    pilot : how it drives
    table : targets that it looks up
    says : ``nobody``, ``classifier``, ``truth``, or the name of the ground that it is told
    """

    name: str
    pilot: PilotSettings
    table: SlipTable
    says: str = "nobody"


def make_driver(name: str, table: SlipTable, delay_s: float, ramp_mps2: float = 0.5) -> Driver:
    """Return a driver by name.

    Raises
    ------
    ConfigError
        if there is none of that name, or its ground or target is none.
    """
    bare, track, rest = name.partition("+track")
    if track and not rest:
        driver = make_driver(bare, table, delay_s, ramp_mps2)
        return replace(driver, name=name, pilot=replace(driver.pilot, track=True))
    kind, _, what = name.partition(":")
    ours = PilotSettings(delay_s=delay_s)
    if name in ("plain", "ramp", "thesis"):
        return Driver(name, replace(ours, controller=name, ramp_mps2=ramp_mps2), table)
    if name in ("fixed", "learned", "oracle"):
        says = {"fixed": "nobody", "learned": "classifier", "oracle": "truth"}[name]
        return Driver(name, ours, table, says)
    if kind == "told" and what:
        if what not in table.targets:
            raise ConfigError(f"controller {name!r}: the table {table.name} has no entry {what!r}")
        return Driver(name, ours, table, what)
    if kind == "target":
        return Driver(name, ours, _only(table, name, what))
    raise ConfigError(
        f"controller {name!r} is unknown: use {', '.join(CONTROLLERS)}, told:NAME, target:SLIP; +track"
    )


def _only(table: SlipTable, name: str, slip: str) -> SlipTable:
    """Return a table whose fallback has one target, and nothing else."""
    try:
        ratio = float(slip)
    except ValueError:
        ratio = math.nan
    if not 0.0 <= ratio < 1.0:
        raise ConfigError(f"controller {name!r}: a slip from 0 to below 1 is required")
    entry = dict(table.targets[table.fallback])
    entry["traction"] = SlipTarget(table.fallback, "traction", ratio, math.nan, 0, "unestimated", "given")
    return replace(table, targets={table.fallback: entry}, curves={}, reasons={})


def taught_classifier(
    robot: Robot, seed: int, progress: Progress = silent, runs_a_terrain: int | None = None
) -> TerrainModel:
    """Return a classifier that was taught on simulated labelled runs of a robot.

    Parameters
    ----------
    robot : swerve robot
    seed : of the runs; they are no drives of ``terrain drive``, whatever its seeds
    runs_a_terrain : how many; those of ``terrain quickstart`` by default
    """
    from pipelines.classify.crossval import samples_of
    from pipelines.classify.labelled import RUNS_A_TERRAIN, labelled_runs
    from pipelines.classify.settings import CrossvalSettings
    from pipelines.classify.train import model_info

    runs, _, _ = labelled_runs(seed, runs_a_terrain or RUNS_A_TERRAIN, progress, robot)
    settings = CrossvalSettings(seed=seed)
    windows = samples_of(runs, settings).cut.windows
    recipe = settings.new_recipe()
    progress("teach", 0, 1)
    recipe.fit(windows, windows.terrain.astype(str))
    progress("teach", 1, 1)
    return TerrainModel(recipe, model_info(runs, settings, windows, "simulated", ""))


def drive_once(
    robot: Robot,
    driver: Driver,
    where: Situation,
    delay_s: float,
    model: TerrainModel | None = None,
    run_id: str = "drive",
    plant: Robot | None = None,
) -> RunLog:
    """Return the log of one drive, the pilot's status in its stream ``control``.

    Raises
    ------
    ConfigError
        if the driver needs a classifier and there is none.
    """
    pilot = LivePilot(robot, driver.table, _watch(driver, model), driver.pilot)
    return simulate(
        plant or robot,
        where.scenario,
        where.soils,
        where.seed,
        run_id=run_id,
        conditions=where.conditions,
        faults=where.faults,
        controller=pilot.step,
        command_delay_s=delay_s,
    )


def _watch(driver: Driver, model: TerrainModel | None) -> Watch:
    if driver.says == "nobody":
        return Nobody()
    if driver.says == "truth":
        return Told()
    if driver.says != "classifier":
        return Told(lambda _: driver.says)
    if model is None:
        raise ConfigError("controller 'learned' needs a classifier: give a model")
    return Classifier(model)
