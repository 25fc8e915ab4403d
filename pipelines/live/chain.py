"""The live chain: what takes the samples of a robot step by step, with what it has in common for all robots.

A service, a replay and a robot's own program run one :class:`Chain`.  There are two: the
:class:`~pipelines.live.observer.Observer` of any robot with a model, which gives terrain and target slip, and
the :class:`~pipelines.live.pilot.LivePilot` of a robot that is driven, which gives commands, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from types import MappingProxyType
from typing import Any, NamedTuple

from pipelines.live.classifying import WindowOutput
from pipelines.live.model import TerrainModel
from terrain.control.live_state import Bias, LiveState
from terrain.control.robot_control import check_table
from terrain.control.slip_table import SlipTable
from terrain.control.switching import (
    NO_BELIEF,
    SWITCHING,
    OutputStatus,
    SwitchSettings,
    TerrainBelief,
    TerrainSource,
    output_status,
    update,
)
from terrain.control.traction import TractionStatus
from terrain.estimation.clocks import Clocks, ClockWatch
from terrain.estimation.filter import Filter
from terrain.estimation.live import BIASES, Live, LiveEstimate
from terrain.records import Command, Sample

COMMAND_VALID_S = 0.25
"""What drives the wheels has to stop them when it has had no newer command for so long."""


class CommandStatus(StrEnum):
    """What a command is made of: all of the chain, or why not."""

    OK = "ok"
    NO_SAMPLES = "no samples yet"
    NO_TWIST = "stopped: the desired motion is too old"
    NOT_FINITE = "stopped: a command was not finite"
    FAILED = "stopped: the step failed"


class Step(NamedTuple):
    """What a chain gives for a sample, and what a session says of it."""

    windows: Sequence[WindowOutput] = ()  #: outputs of windows that were finished, in most steps none
    #: command, status: of the wheels; None of a chain that gives no commands
    command: Command | None = None
    status: CommandStatus = CommandStatus.OK
    failure: str = ""  #: why the step failed; empty where it did not
    time_s: float = math.nan  #: on the robot's clock; NaN before its first sample
    number: int = 0  #: of the step, from 1
    message: int = 0  #: number of the last message that is in it; 0 before the first
    #: what is known of the robot, as ``docs/service.md`` describes it; None and NaN where it is not
    observation: Mapping[str, Any] = MappingProxyType({})
    #: from the arrival of the newest sample to the end of the step; NaN without one
    latency_s: float = math.nan

    def content(self) -> dict[str, Any]:
        """Return the message of a session's step."""
        names = ("time_s", "number", "message", "latency_s", "observation")
        content = {"type": "step"} | {name: getattr(self, name) for name in names}
        if (command := self.command) is not None:
            code = int(command.status.get("status_code", TractionStatus.UNSOUND))
            content["command"] = {
                "status": self.status.value,
                "traction": TractionStatus(code).label,
                "valid_s": COMMAND_VALID_S,
                "wheel_radps": command.wheel_radps,
                "steer_rad": command.steer_rad,
                "twist": command.twist,
            }
        return content


class Chain:
    """Takes samples in order of time, and does not raise.

    Parameters
    ----------
    robot_name : whose samples; empty for a robot without a description
    table : of target slips
    switching : when an output of the source is accepted as the terrain
    clocks : of what arrives

    Attributes
    ----------
    belief : the terrain that is believed
    estimate : the last one of the motion; None before the first, and where none is made
    source : of the terrain

    Raises
    ------
    ConfigError
        if the table is another robot's.
    """

    name = ""
    source: TerrainSource
    _filter: Live | None = None

    def __init__(
        self, robot_name: str, table: SlipTable, switching: SwitchSettings, clocks: Clocks | ClockWatch
    ) -> None:
        self.robot_name, self.switching, self._clocks = robot_name, switching, clocks
        self.belief: TerrainBelief = NO_BELIEF
        self.estimate: LiveEstimate | None = None
        check_table(table, robot_name)
        self.table = table

    @property
    def is_estimated(self) -> bool:
        """Whether a filter estimates the motion."""
        return self._filter is not None

    @property
    def target_ratio(self) -> float:
        """Target slip in traction of the terrain that is believed."""
        return self.table.lookup(self.belief.terrain)["traction"].slip_ratio

    @property
    def health(self) -> Mapping[str, str]:
        """Health of each sensor by name; empty where none is judged."""
        return {}

    @property
    def too_late(self) -> tuple[float, float]:
        """When samples came last that were too late to be taken, and by how much, in s; minus infinity and NaN."""
        filtered = (-math.inf, math.nan) if self._filter is None else self._filter.too_late
        return max(self._clocks.too_late, filtered)

    @property
    def dropped(self) -> dict[str, int]:
        """What was not used so far, and how often a clock was set, as counts by stream and kind."""
        filtered = {} if self._filter is None else self._filter.dropped
        return {**self._clocks.counts, **filtered, **self.source.dropped}

    def take(self, sample: Sample) -> Step:
        """Take a sample."""
        raise NotImplementedError

    def check(self, model: TerrainModel | None, table: SlipTable) -> None:
        """Raise what :meth:`replace` would."""
        check_table(table, self.robot_name)
        self.source.check(model)

    def replace(self, model: TerrainModel | None, table: SlipTable) -> None:
        """Go on with another model and table, between two samples: none is lost, and the filter runs on.

        Where both models take the same windows, the one that is being cut is the first of the new model;
        otherwise its windows begin with the next sample.  ``ConfigError`` where the table is another robot's,
        ``DataError`` where the model does not suit what is measured and estimated, or is none.
        """
        check_table(table, self.robot_name)
        self.source.swap(model)
        self.table = table

    def _believe(self, sample: Sample, estimates: Sequence[LiveEstimate]) -> OutputStatus:
        """Update the belief by what the source finds in a sample; return what its last output was."""
        status, switching = OutputStatus.NONE, self.switching
        if self.source.settled:
            switching = switching._replace(dwell_s=0.0, probability_least=0.0)
        for found in self.source.update(sample, estimates):
            self.belief = update(self.belief, found.time_s, found.terrain, found.probability, switching)
            status = output_status(found.terrain, found.probability, switching)
        return OutputStatus.REFUSED if any(each.refused for each in self.source.outputs) else status

    def state(self, now_s: float) -> LiveState:
        """Return what is worth keeping over a restart, at a time in seconds since 1970."""
        session, name = self._session
        known = {} if session is None else session.known(BIASES)
        biases = {
            state: Bias(mean, std)
            for state, (mean, std) in known.items()
            if math.isfinite(mean + std) and std > 0.0
        }
        belief = self.belief.terrain, self.belief.probability, self.target_ratio
        return LiveState(self.robot_name, name, now_s, biases, *belief)

    def restore(self, state: LiveState, now_s: float) -> LiveState:
        """Start from a saved state, before the first sample; return what of it is used.

        Raises
        ------
        DataError
            if the filter has run already.
        """
        session, name = self._session
        fresh = state.usable(self.robot_name, name, now_s)
        if session is not None:
            session.begin_from(fresh.biases, max(now_s - state.saved_s, 0.0))
        self.belief = TerrainBelief(fresh.terrain, fresh.probability)
        return fresh

    @property
    def _session(self) -> tuple[Filter | None, str]:
        return (None, "") if self._filter is None else (self._filter.filter, self._filter.name)


class OnlyWatched(Chain):
    """Of a robot that is watched, without a model of the terrain: it gives neither terrain nor commands."""

    name = "watch"

    def __init__(self, robot_name: str, table: SlipTable) -> None:
        super().__init__(robot_name, table, SWITCHING, ClockWatch())
        self.source = TerrainSource()

    def take(self, sample: Sample) -> Step:
        """Take a sample; nothing is made of it."""
        return Step()
