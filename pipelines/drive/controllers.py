"""Controllers of ``terrain drive``: from a name to a pilot with its table and its terrain source."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from pipelines.drive.controller_names import KINDS, TRACK, Source, kind_of
from pipelines.learn.model_file import TerrainModel
from pipelines.live.pilot import LivePilot
from pipelines.live.terrain_source import Classifier, KnownTerrain, NoTerrain, TerrainSource
from pipelines.report import Progress, silent
from terrain.control.pilot_settings import PilotSettings
from terrain.control.situations import Situation
from terrain.control.slip_table import SlipTable
from terrain.errors import ConfigError
from terrain.records import RunLog, SlipTarget, TargetStatus
from terrain.robots import Robot
from terrain.simulation.dynamic.simulate import simulate

DEFAULT_RAMP_MPS2 = PilotSettings().ramp_mps2


@dataclass(frozen=True, slots=True)
class Controller:
    """What the name of a controller stands for.

    Parameters
    ----------
    name : as given
    pilot : its settings
    table : its targets
    source : of the current terrain
    known_terrain : given to the pilot on every terrain, where the source is ``KNOWN``
    """

    name: str
    pilot: PilotSettings
    table: SlipTable
    source: Source = Source.NONE
    known_terrain: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class DriveInputs:
    """Robots and models of a comparison.

    Parameters
    ----------
    robot : as the controllers assume it
    table : target slips
    model : classifier of ``classified`` and ``thesis:classified``
    plant : the simulated robot, where it is another one
    """

    robot: Robot
    table: SlipTable
    model: TerrainModel | None = None
    plant: Robot | None = None

    @property
    def simulated(self) -> Robot:
        """The robot that is simulated."""
        return self.plant or self.robot


def make_controller(
    name: str, table: SlipTable, delay_s: float, ramp_mps2: float = DEFAULT_RAMP_MPS2
) -> Controller:
    """Return a controller by name.

    Raises
    ------
    ConfigError
        if there is none of that name, or its terrain or target is none.
    """
    kind, (bare, track, rest) = kind_of(name), name.partition(TRACK)
    if kind is None or rest:
        raise ConfigError(
            f"controller {name!r} is unknown: use {', '.join(KINDS)}, known:NAME, target:SLIP; {TRACK}"
        )
    pilot = PilotSettings(controller=kind.pilot, delay_s=delay_s, ramp_mps2=ramp_mps2, track=bool(track))
    given = bare.partition(":")[2]
    if kind.source is Source.KNOWN and given not in table.targets:
        raise ConfigError(f"controller {name!r}: the table {table.name} has no entry {given!r}")
    if bare.startswith("target:"):
        table = _single_target(table, name, given)
    return Controller(name, pilot, table, kind.source, given if kind.source is Source.KNOWN else "")


def _single_target(table: SlipTable, name: str, slip: str) -> SlipTable:
    """Return a table whose only entry is its fallback, with one target."""
    try:
        ratio = float(slip)
    except ValueError:
        ratio = math.nan
    if not 0.0 <= ratio < 1.0:
        raise ConfigError(f"controller {name!r}: a slip from 0 to below 1 is required")
    entry = dict(table.targets[table.fallback])
    assumed = TargetStatus.UNESTIMATED
    entry["traction"] = SlipTarget(table.fallback, "traction", ratio, math.nan, 0, assumed, "given")
    return replace(table, targets={table.fallback: entry}, curves={}, reasons={})


def train_classifier(
    robot: Robot, seed: int, progress: Progress = silent, runs_a_terrain: int | None = None
) -> TerrainModel:
    """Return a classifier that was trained on simulated labelled runs of a robot.

    Parameters
    ----------
    robot : swerve robot
    seed : of the runs; they differ from the drives of ``terrain drive`` at any seed
    progress : of the runs and the training
    runs_a_terrain : number of runs; that of ``terrain quickstart`` by default
    """
    from pipelines.learn.settings import RecipeSettings
    from pipelines.learn.train import fitted_model
    from terrain.estimation.labelled import RUNS_A_TERRAIN, labelled_runs

    runs, _, _ = labelled_runs(seed, runs_a_terrain or RUNS_A_TERRAIN, progress, robot)
    progress("train", 0, 1)
    model = fitted_model(runs, RecipeSettings(seed=seed), "simulated")
    progress("train", 1, 1)
    return model


def drive_once(
    inputs: DriveInputs, controller: Controller, situation: Situation, run_id: str = "drive"
) -> RunLog:
    """Return the log of one drive, the pilot's status in its stream ``control``.

    Raises
    ------
    ConfigError
        if the controller needs a classifier and there is none.
    """
    source = _terrain_source(controller, inputs.model, inputs.robot)
    pilot = LivePilot(inputs.robot, controller.table, source, controller.pilot)
    return simulate(
        inputs.simulated,
        situation.scenario,
        situation.soils,
        situation.seed,
        run_id=run_id,
        conditions=situation.conditions,
        faults=situation.faults,
        controller=pilot.step,
        command_delay_s=controller.pilot.delay_s,
    )


def _terrain_source(controller: Controller, model: TerrainModel | None, robot: Robot) -> TerrainSource:
    if controller.source is Source.NONE:
        return NoTerrain()
    if controller.source is Source.TRUTH:
        return KnownTerrain()
    if controller.source is Source.KNOWN:
        return KnownTerrain(lambda _: controller.known_terrain)
    if model is None:
        raise ConfigError(f"controller {controller.name!r} needs a classifier: give a model")
    return Classifier(model, robot)
