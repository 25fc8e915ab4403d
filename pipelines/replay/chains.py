"""The live chain that a log is sent through: that of its robot."""

from __future__ import annotations

from pipelines.data.datasets import robot_of
from pipelines.live.chain import Chain, PilotChain
from pipelines.live.observer import Observer
from pipelines.live.pilot_settings import PilotSettings
from pipelines.live.windows import needs_filter
from pipelines.models.model_files import TerrainModel
from terrain.control.slip_table import SlipTable
from terrain.errors import ConfigError, DataError
from terrain.estimation.live.estimator import CHANNELS
from terrain.logs.replay import SENSORS
from terrain.records import RunLog
from terrain.robots import Robot

UNNEEDED = "confidence_ratio"
"""Channel that the pilot does without: other cameras than AgriMaRo's do not give it."""

_FOLLOWED = PilotSettings(follows=False)  # another controller drove when the log was written


def chain_of(run: RunLog, model: TerrainModel | None, table: SlipTable, robot: Robot | None = None) -> Chain:
    """Return the chain of a run's robot.

    Parameters
    ----------
    run : to be replayed
    model, table : of the chain
    robot : description of the robot of runs that bear its name; the package's by default

    Raises
    ------
    ConfigError
        if the robot has no pilot and there is no model, or the table is another robot's.
    DataError
        if the run lacks what the model or the pilot needs.
    """
    if table.robot and run.robot != table.robot:
        raise ConfigError(
            f"table {table.name} is for robot {table.robot!r}, run {run.run_id} is of {run.robot!r}"
        )
    channels = {name: stream.channels for name, stream in run.streams.items() if name in SENSORS}
    described = _described(run, model, robot)
    if described is not None and described.drive == "swerve":
        for name in channels.keys() & CHANNELS.keys():
            lacking = [channel for channel in CHANNELS[name] if channel not in channels[name]]
            if set(lacking) - {UNNEEDED}:
                raise DataError(
                    f"run {run.run_id}: stream {name} has no channel {lacking[0]!r} for the pilot"
                )
        return PilotChain(described, model, table, channels, settings=_FOLLOWED)
    if model is None:
        raise ConfigError(f"run {run.run_id}: robot {run.robot!r} has no pilot: give a model with --model")
    try:
        return Observer(model, table, described, channels)
    except (ConfigError, DataError) as error:
        raise DataError(f"run {run.run_id}: {error}") from error


def _described(run: RunLog, model: TerrainModel | None, robot: Robot | None) -> Robot | None:
    """Return the description of a run's robot; None where there is none and the model needs none."""
    try:
        return robot_of(run, robot)
    except ConfigError:
        channels = {name: stream.channels for name, stream in run.streams.items() if name in SENSORS}
        if model is None or needs_filter(model.info, channels):
            raise
        return None
