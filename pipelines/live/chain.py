"""The live chain: what takes the samples of a robot step by step, whatever its parts are.

A service, a replay and a robot's own program run one :class:`Chain`.  There are two: the
:class:`~pipelines.live.observer.Observer` of any robot with a model, which gives terrain and target slip, and
the :class:`PilotChain` here of a robot that is driven, which gives commands, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from pipelines.live.classifying import AtOnce, WindowOutput
from pipelines.live.model import LiveModel
from pipelines.live.pilot import LivePilot
from pipelines.live.state import LiveState, Restorable
from pipelines.live.terrain_source import Classifier, NoTerrain
from pipelines.live.windows import Estimate
from terrain.control.pilot_settings import DEFAULT_SETTINGS, PilotSettings, check_table
from terrain.control.slip_table import SlipTable
from terrain.control.switching import TerrainBelief
from terrain.control.traction import TractionStatus
from terrain.estimation.live.estimator import CHANNELS
from terrain.records import Array, Command, Reading, Sample
from terrain.robots import Robot


class CommandStatus(StrEnum):
    """What a command is made of: all of the chain, or why not."""

    OK = "ok"
    NO_SAMPLES = "no samples yet"
    NO_TWIST = "stopped: the desired motion is too old"
    NOT_FINITE = "stopped: a command was not finite"
    FAILED = "stopped: the step failed"


class Step(NamedTuple):
    """What a chain gives for a sample.

    Parameters
    ----------
    windows : outputs of windows that were finished, in most steps none
    command, status : of the wheels; None of a chain that gives no commands
    failure : why the step failed; empty where it did not
    """

    windows: Sequence[WindowOutput] = ()
    command: Command | None = None
    status: CommandStatus = CommandStatus.OK
    failure: str = ""


class Chain(Protocol):
    """Takes samples in order of time, and does not raise.

    ``belief`` is the terrain that is believed, ``target_ratio`` its target slip in traction, ``estimate`` the
    last one of the motion, ``health`` that of each sensor by name (empty where none is judged), ``dropped``
    what was not used so far, as counts by kind.
    """

    name: str

    @property
    def belief(self) -> TerrainBelief: ...  # noqa: D102
    @property
    def target_ratio(self) -> float: ...  # noqa: D102
    @property
    def estimate(self) -> Estimate | None: ...  # noqa: D102
    @property
    def health(self) -> Mapping[str, str]: ...  # noqa: D102
    @property
    def dropped(self) -> dict[str, int]: ...  # noqa: D102

    def take(self, sample: Sample) -> Step:
        """Take a sample."""

    def check(self, model: LiveModel | None, table: SlipTable) -> None:
        """Raise what :meth:`replace` would: ``ConfigError`` or ``DataError``."""

    def replace(self, model: LiveModel | None, table: SlipTable) -> None:
        """Go on with another model and table, between two samples."""

    def state(self, now_s: float) -> LiveState:
        """Return what is worth keeping over a restart, at a time in seconds since 1970."""

    def restore(self, state: LiveState, now_s: float) -> Restorable:
        """Start from a saved state, before the first sample; return what of it is used."""


class PilotChain(LivePilot):
    """A pilot that takes its columns by name, begins where the steering stands, and is safe where it fails.

    Parameters
    ----------
    robot : a swerve robot with all sections
    model : that classifies; without one the terrain stays unknown
    table : of target slips
    channels : of each stream, in the order of the columns of its samples; what the pilot takes and is not
        among them is unknown
    classifying : where windows are classified; at once by default
    settings : of the pilot

    Raises
    ------
    ConfigError
        as :class:`~pipelines.live.pilot.LivePilot`.
    DataError
        if the model does not suit the robot.
    """

    name = "pilot"

    def __init__(
        self,
        robot: Robot,
        model: LiveModel | None,
        table: SlipTable,
        channels: Mapping[str, Sequence[str]],
        classifying: AtOnce | None = None,
        settings: PilotSettings = DEFAULT_SETTINGS,
    ) -> None:
        self._make = partial(Classifier, robot=robot, classifying=classifying)
        self.terrain_source = NoTerrain() if model is None else self._make(model)
        super().__init__(robot, table, self.terrain_source, settings)
        self._columns = schema_columns(channels)
        self._standing_rad = np.zeros(3)
        self._awaits_steering = "steering" in channels

    @property
    def dropped(self) -> dict[str, int]:
        """What was not used so far, as counts by kind."""
        return super().dropped | dict(self.terrain_source.dropped)

    def check(self, model: LiveModel | None, table: SlipTable) -> None:
        """Raise what :meth:`replace` would."""
        check_table(table, self.robot_name)
        if isinstance(self.terrain_source, Classifier):
            self.terrain_source.check(model)

    def replace(self, model: LiveModel | None, table: SlipTable) -> None:
        """Go on with another model and table, between two steps; no sample is lost.

        Raises
        ------
        ConfigError, DataError
            as when the chain begins, or if a model is to be replaced by none.
        """
        self.check(model, table)
        if isinstance(self.terrain_source, Classifier):
            self.terrain_source.swap(model)
        elif model is not None:
            self.terrain_source = self._make(model)
        self.swap(table, self.terrain_source)

    def take(self, sample: Sample) -> Step:
        """Return the command for a sample: to stand, where nothing is known yet or the step fails."""
        if math.isnan(sample.time_s) or not self._is_steered(sample.readings):
            return Step((), self._standing(), CommandStatus.NO_SAMPLES)
        readings = {
            name: reading._replace(values=ordered(reading.values, *self._columns[name]))
            for name, reading in sample.readings.items()
            if name in self._columns
        }
        try:
            command = self.step(sample._replace(readings=readings))
        except Exception as error:  # a robot without a command would go on with its last one
            failure = f"a step failed: {type(error).__name__}: {error}"
            return Step((), self._standing(), CommandStatus.FAILED, failure)
        windows, status = self.terrain_source.outputs, CommandStatus.OK
        numbers = (*command.wheel_radps.tolist(), *command.steer_rad.tolist(), *command.twist.tolist())
        if not all(map(math.isfinite, numbers)):
            command, status = self._standing()._replace(status=command.status), CommandStatus.NOT_FINITE
        self._standing_rad = command.steer_rad
        return Step(windows, command, status)

    def _is_steered(self, readings: Mapping[str, Reading]) -> bool:
        """Begin with the steering where it stands; return whether that is known, where it is measured."""
        if not self._awaits_steering:
            return True
        reading = readings.get("steering")
        if reading is None or not len(reading.values):
            return False
        measured_rad = ordered(reading.values, *self._columns["steering"])[-1]
        if not np.isfinite(measured_rad).all():
            return False
        self._standing_rad = self.start_steering(measured_rad)
        self._awaits_steering = False
        return True

    def _standing(self) -> Command:
        """Return the command to stand, steered as before."""
        status = {"status_code": float(TractionStatus.UNSOUND)}
        return Command(np.zeros(3), self._standing_rad, np.zeros(3), status)


def schema_columns(channels: Mapping[str, Sequence[str]]) -> dict[str, tuple[list[int], list[int], int]]:
    """Return which columns of each stream go where in the order of the schema, and how many that has."""
    found = {}
    for stream, names in CHANNELS.items():
        if stream in channels:
            places = [names.index(name) for name in channels[stream] if name in names]
            kept = [i for i, name in enumerate(channels[stream]) if name in names]
            found[stream] = kept, places, len(names)
    return found


def ordered(values: Array, kept: list[int], places: list[int], n_columns: int) -> Array:
    """Return columns in the order of the schema, NaN where a channel is not sent.

    Examples
    --------
    >>> ordered(np.array([[1.0, 2.0]]), [1], [0], 2).tolist()
    [[2.0, nan]]
    """
    if places == list(range(n_columns)) and kept == places and values.shape[1] == n_columns:
        return values
    found = np.full((len(values), n_columns), math.nan)
    found[:, places] = values[:, kept]
    return found
