"""Pilots of ``terrain drive``, with the source of the terrain that their controllers have, and their drives."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pipelines.live.classifying import Classifier
from pipelines.live.model import TerrainModel
from pipelines.live.pilot import LivePilot
from pipelines.report.results import Progress, silent
from terrain.control.controllers import Controller, Source
from terrain.control.situations import Situation, simulate_situation
from terrain.control.slip_table import SlipTable
from terrain.control.switching import KnownTerrain, TerrainSource
from terrain.errors import ConfigError
from terrain.records import RunLog
from terrain.robots import Robot


@dataclass(frozen=True, slots=True, eq=False)
class DriveInputs:
    """Robots and models of a comparison."""

    robot: Robot  #: as the controllers assume it
    table: SlipTable  #: target slips
    model: TerrainModel | None = None  #: classifier of ``classified`` and ``thesis:classified``
    plant: Robot | None = None  #: the simulated robot, where it is another one

    @property
    def simulated(self) -> Robot:
        """The robot that is simulated."""
        return self.plant or self.robot

    def of(self, controller: Controller) -> DriveInputs:
        """Return what a controller needs: a model is large to send to another process."""
        return self if controller.source is Source.CLASSIFIER else replace(self, model=None)


def drive_once(inputs: DriveInputs, controller: Controller, situation: Situation) -> RunLog:
    """Return the log of one drive, the pilot's status in its stream ``control``.

    Raises
    ------
    ConfigError
        if the controller needs a classifier and there is none.
    """
    source = _terrain_source(controller, inputs.model, inputs.robot)
    pilot = LivePilot(inputs.robot, controller.table, source, controller.pilot)
    return simulate_situation(inputs.simulated, situation, pilot.step, controller.pilot.delay_s)


def _terrain_source(controller: Controller, model: TerrainModel | None, robot: Robot) -> TerrainSource:
    if controller.source is Source.NONE:
        return TerrainSource()
    if controller.source is Source.TRUTH:
        return KnownTerrain()
    if controller.source is Source.KNOWN:
        return KnownTerrain(lambda _: controller.known_terrain)
    if model is None:
        raise ConfigError(f"controller {controller.name!r} needs a classifier: give a model")
    return Classifier(model, robot)


def train_classifier(robot: Robot, seed: int, progress: Progress = silent) -> TerrainModel:
    """Return a classifier that was trained on simulated labelled runs of a swerve robot, as many as of quickstart.

    The runs differ from the drives of ``terrain drive`` at any seed.
    """
    from pipelines.learn.settings import RecipeSettings
    from pipelines.learn.training_data import fitted_model
    from pipelines.slip.labelled import RUNS_A_TERRAIN, labelled_runs

    runs, _, _ = labelled_runs(seed, RUNS_A_TERRAIN, progress, robot)
    progress("train", 0, 1)
    model = fitted_model(runs, RecipeSettings(seed=seed), "simulated")
    progress("train", 1, 1)
    return model
