"""The live chains that a log can be sent through, each behind one method.

A chain takes what :func:`terrain.logs.replay.replay` yields, as it would come from the robot; one that sends
it to a service elsewhere fits in here too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np

from pipelines.data.datasets import robot_of
from pipelines.live.observer import TerrainObserver
from pipelines.live.pilot import LivePilot
from pipelines.live.pilot_settings import PilotSettings
from pipelines.live.terrain_source import Classifier, NoTerrain
from pipelines.models.model_files import TerrainModel
from pipelines.streaming.classifying import AtOnce, WindowOutput
from pipelines.streaming.window_feed import needs_filter
from terrain.control.slip_table import SlipTable
from terrain.errors import ConfigError, DataError
from terrain.estimation.live.estimator import CHANNELS
from terrain.logs.replay import SENSORS
from terrain.records import RunLog, Sample, Stream
from terrain.robots import Robot

UNNEEDED = "confidence_ratio"
"""Channel that the pilot does without: other cameras than AgriMaRo's do not give it."""

_FOLLOWED = PilotSettings(follows=False)  # another controller drove when the log was written


class Replayed(NamedTuple):
    """What a step of a chain gives: finished windows, the believed terrain, and its target slip."""

    windows: list[WindowOutput]
    believed: str
    target_ratio: float


class Chain(Protocol):
    """Takes samples in order of time."""

    name: str

    def step(self, sample: Sample) -> Replayed:
        """Take a sample."""
        ...

    @property
    def dropped(self) -> Mapping[str, int]:
        """What was not used, as counts by kind."""
        ...


class _Kept(AtOnce):
    """Classifies at once, and keeps the outputs for whoever watches."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[WindowOutput] = []

    def finished(self) -> list[WindowOutput]:
        found = super().finished()
        self.seen += found
        return found

    def take(self) -> list[WindowOutput]:
        found, self.seen = self.seen, []
        return found


class ObserverChain:
    """Terrain and target slip of any robot with a model."""

    name = "observer"

    def __init__(self, run: RunLog, model: TerrainModel, table: SlipTable, robot: Robot | None) -> None:
        channels = {name: run.streams[name].channels for name in SENSORS if name in run.streams}
        self._kept, self._table = _Kept(), table
        self._observer = TerrainObserver(model, table, robot, channels, classifying=self._kept)

    def step(self, sample: Sample) -> Replayed:
        """Take a sample."""
        self._observer.update(sample.readings)
        believed = self._observer.belief.terrain
        windows = self._kept.take() if self._kept.seen else []
        return Replayed(windows, believed, self._table.lookup(believed)["traction"].slip_ratio)

    @property
    def dropped(self) -> Mapping[str, int]:
        """What was not used."""
        return self._observer.dropped


class PilotChain:
    """The pilot of a swerve robot, whose commands drive nothing here."""

    name = "pilot"

    def __init__(self, model: TerrainModel | None, table: SlipTable, robot: Robot) -> None:
        self._kept = _Kept()
        self._source = NoTerrain() if model is None else Classifier(model, robot, self._kept)
        self._pilot = LivePilot(robot, table, self._source, _FOLLOWED)

    def step(self, sample: Sample) -> Replayed:
        """Take a sample."""
        command = self._pilot.step(sample)
        windows = self._kept.take() if self._kept.seen else []
        return Replayed(windows, self._pilot.belief.terrain, command.status["target_ratio"])

    @property
    def dropped(self) -> Mapping[str, int]:
        """What was not used."""
        return Counter(self._pilot.dropped) + Counter(getattr(self._source, "dropped", {}))


def chain_of(
    run: RunLog, model: TerrainModel | None, table: SlipTable, robot: Robot | None = None
) -> tuple[Chain, RunLog]:
    """Return the chain of a run's robot, and the run with the columns that the chain takes.

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
    described = _described(run, model, robot)
    if described is not None and described.drive == "swerve":
        return PilotChain(model, table, described), _columns_of_pilot(run)
    if model is None:
        raise ConfigError(f"run {run.run_id}: robot {run.robot!r} has no pilot: give a model with --model")
    try:
        return ObserverChain(run, model, table, described), run
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


def _columns_of_pilot(run: RunLog) -> RunLog:
    streams = {name: stream for name, stream in run.streams.items() if name not in SENSORS}
    for name, channels in CHANNELS.items():
        stream = run.streams.get(name)
        if stream is None:
            continue
        lacking = [channel for channel in channels if channel not in stream.channels]
        if set(lacking) - {UNNEEDED}:
            raise DataError(f"run {run.run_id}: stream {name} has no channel {lacking[0]!r} for the pilot")
        unknown = np.full(len(stream), np.nan)
        values = np.column_stack(
            [unknown if channel in lacking else stream.channel(channel) for channel in channels]
        )
        streams[name] = Stream(stream.time_s, values, channels)
    return RunLog(run.run_id, run.robot, streams, run.labels)
