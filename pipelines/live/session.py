"""One robot that is served: its samples go in at any time, observations and commands come out at its steps.

Nothing of a network is known here, and nothing of one session is seen by another: they share a model and a
table, which are read only, and the thread that classifies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import monotonic, time
from typing import Any, NamedTuple

import numpy as np

from pipelines.live.chain import Chain, CommandStatus
from pipelines.live.classifying import Classifier, ClassifierThread, WindowOutput
from pipelines.live.model import LiveModel
from pipelines.live.observer import Observer
from pipelines.live.pilot import LivePilot
from pipelines.live.recording import SessionRecorder
from pipelines.live.state import LiveState
from terrain.control.pilot_settings import PilotSettings
from terrain.control.slip_table import SlipTable
from terrain.control.switching import TerrainBelief
from terrain.errors import ConfigError, DataError
from terrain.estimation.live.arrivals import Inbox, StreamHealth, as_numbers
from terrain.estimation.live.clocks import SessionClock
from terrain.estimation.live.estimate import LiveEstimate
from terrain.estimation.live.skid_live import LiveSkidEstimate
from terrain.records import Array, Command, Sample, SlipTarget
from terrain.robots import Robot

TWIST_FRESH_S = 0.5
"""A desired motion that is older is none: the robot is commanded to stop."""

COMMAND_VALID_S = 0.25
"""What drives the wheels has to stop them when it has had no newer command for so long."""

_NO_TWIST = np.zeros(3)


class Served(NamedTuple):
    """What all sessions use; it is replaced whole.

    Parameters
    ----------
    number : rises with each replacement
    model, model_name : that classifies, and its URI; without one the terrain is unknown
    table : of target slips
    """

    number: int
    model: LiveModel | None
    model_name: str
    table: SlipTable


@dataclass(frozen=True, slots=True)
class SessionRequest:
    """What a robot says of itself before its first sample.

    Parameters
    ----------
    session : name of the session, one a robot
    robot : name of its description; a robot that has none is observed by its channels
    channels : of each stream that it sends, in the order of the columns
    control : whether commands are asked for
    follows : whether they drive the wheels; not where another controller does and these are only watched
    """

    session: str
    robot: str
    channels: Mapping[str, tuple[str, ...]]
    control: bool = False
    follows: bool = True


class Observation(NamedTuple):
    """What is known of the robot at a step; NaN and None where it is not.

    Parameters
    ----------
    terrain, probability : believed, and that of its last window; empty and NaN where unknown
    window : output of the last window
    target : target slip by drive state
    slip_ratio, slip_std, wheel_speed_mps, current_a : of each wheel
    speed_x_mps, speed_y_mps, yaw_rate_radps : of the robot
    sensors : health by name of the sensor, or of the stream where sensors are not judged one by one
    served : number of what was used
    """

    terrain: str
    probability: float
    window: WindowOutput | None
    target: Mapping[str, SlipTarget]
    slip_ratio: Array
    slip_std: Array
    wheel_speed_mps: Array
    current_a: Array
    speed_x_mps: float
    speed_y_mps: float
    yaw_rate_radps: float
    sensors: Mapping[str, str]
    served: int


class StepOutput(NamedTuple):
    """What comes out of a step.

    Parameters
    ----------
    time_s : on the robot's clock; NaN before its first sample
    number : of the step, from 1
    message : number of the last message that is in it; 0 before the first
    command, status : None where none was asked for
    observation : of the robot
    latency_s : from the arrival of the newest sample to the end of the step; NaN without one
    """

    time_s: float
    number: int
    message: int
    command: Command | None
    status: CommandStatus
    observation: Observation
    latency_s: float


class RobotSession:
    """The live chain of one robot, from messages to steps.

    Parameters
    ----------
    request : of the robot
    served : model and table
    robot : its description; None for a robot that has none
    thread : that classifies its windows; at once without one

    Attributes
    ----------
    inbox : of its samples
    chain : that its samples go through
    finished : outputs of windows at the last step, in most cases none
    failure : why the last step that failed did; empty where none has

    Raises
    ------
    ConfigError
        if commands are asked for a robot that has no pilot, or the table is another robot's.
    DataError
        if the model needs channels that the robot does not send, or there is neither model nor pilot.
    """

    def __init__(
        self,
        request: SessionRequest,
        served: Served,
        robot: Robot | None,
        thread: ClassifierThread | None = None,
    ) -> None:
        self.request, self.served = request, served
        self.inbox = Inbox({stream: len(names) for stream, names in request.channels.items()})
        self.chain = _chain(request, served, robot, thread)
        self._wheels = () if robot is None else robot.wheels
        self._streams = StreamHealth(request.channels)
        self._clock = SessionClock()
        self._twist, self._twist_s = _NO_TWIST, -math.inf
        self._received_s = self._known_s = math.nan
        self._n_steps = self._n_messages = 0
        self.finished: Sequence[WindowOutput] = ()
        self.failure = ""
        self._window: WindowOutput | None = None
        self._recorder: SessionRecorder | None = None

    def record(self, recorder: SessionRecorder) -> None:
        """Record samples, commands and windows from now on."""
        self._recorder = recorder

    @property
    def recording(self) -> str:
        """What the recording does: its status, or that there is none."""
        return "off" if self._recorder is None else self._recorder.status

    def end(self) -> None:
        """End the recording; its last samples are written by its thread."""
        if self._recorder is not None:
            self._recorder.close()

    @property
    def belief(self) -> TerrainBelief:
        """The terrain that is believed."""
        return self.chain.belief

    @property
    def dropped(self) -> dict[str, int]:
        """What was not used so far, as counts by kind."""
        counts = dict(self.inbox.refused) | self.chain.dropped
        return counts | ({"time: clock set": n} if (n := self._clock.times_set) else {})

    def state(self, now_s: float | None = None) -> LiveState:
        """Return what is worth keeping over a restart.

        Parameters
        ----------
        now_s : in seconds since 1970; by default when the last sample came: what is known is as old as that
        """
        if now_s is None:
            now_s = time() if math.isnan(self._known_s) else self._known_s
        return self.chain.state(now_s)

    def restore(self, state: LiveState, now_s: float | None = None) -> LiveState:
        """Start from a saved state, before the first step; return what of it is used."""
        self._known_s = state.saved_s
        return self.chain.restore(state, time() if now_s is None else now_s)

    def check(self, served: Served) -> None:
        """Raise what :meth:`swap` would."""
        self.chain.check(served.model, served.table)

    def swap(self, served: Served) -> None:
        """Go on with another model and table, between two steps; no sample is lost.

        Raises
        ------
        ConfigError, DataError
            as when a session begins.
        """
        self.chain.replace(served.model, served.table)
        self.served = served

    def put(self, streams: Any, twist: Any = None, now_s: float | None = None) -> int:
        """Take the samples of a message; return how many rows of it were taken.

        Parameters
        ----------
        streams : by name, a pair of stamps ``(k,)`` and rows ``(k, channels)``; whatever else is in it is
            refused and counted
        twist : desired motion ``(3,)``; None where the message has none
        now_s : of the local clock that never goes back
        """
        now_s = monotonic() if now_s is None else now_s
        self._n_messages += 1
        before = self.inbox.received.total()
        if isinstance(streams, Mapping):
            for name, given in streams.items():
                try:
                    time_s, values = given
                except (TypeError, ValueError):
                    self.inbox.refused["sample that is no pair of stamps and rows"] += 1
                    continue
                newest_s = self.inbox.put(str(name), time_s, values)
                if newest_s is not None:
                    self._clock.received(newest_s, now_s)
                    self._received_s, self._known_s = now_s, time()
        elif streams is not None:
            self.inbox.refused["samples that are not given by stream"] += 1
        if twist is not None:
            desired = as_numbers(twist)
            if desired is None or desired.shape != (3,) or not np.isfinite(desired).all():
                self.inbox.refused["twist that is not three numbers"] += 1
            else:
                self._twist, self._twist_s = desired, now_s
        return self.inbox.received.total() - before

    def step(self, now_s: float | None = None, time_s: float | None = None) -> StepOutput:
        """Run the chain over what has come since the last step; it does not raise.

        Parameters
        ----------
        now_s : of the local clock that never goes back
        time_s : of the robot's clock, where it says so itself; by default that of its clock now, as far as
            its messages tell
        """
        begun_s = monotonic()
        now_s = begun_s if now_s is None else now_s
        readings = self.inbox.take()
        time_s = self._clock.at(now_s) if time_s is None else time_s
        fresh = now_s - self._twist_s <= TWIST_FRESH_S
        twist = self._twist if fresh else _NO_TWIST
        done = self.chain.take(Sample(time_s, twist, readings))
        status = done.status
        if done.command is not None and status is CommandStatus.OK and not fresh:
            status = CommandStatus.NO_TWIST
        self._n_steps += 1
        self.finished, self.failure = done.windows, done.failure or self.failure
        self._window = done.windows[-1] if done.windows else self._window
        self._streams.take(readings, time_s)
        if self._recorder is not None:
            if readings:
                self._recorder.readings(readings)
            if done.command is not None and done.status not in _NOT_DECIDED:
                self._recorder.command(time_s, twist, done.command)
            for output in done.windows:
                self._recorder.window(output)
        return StepOutput(
            time_s,
            self._n_steps,
            self._n_messages,
            done.command,
            status,
            self._observation(time_s),
            now_s - self._received_s + (monotonic() - begun_s),
        )

    def _observation(self, time_s: float) -> Observation:
        belief, seen = self.chain.belief, self.chain.estimate
        slip_ratio = slip_std = np.full(len(self._wheels), math.nan)
        motion = math.nan, math.nan, math.nan
        if isinstance(seen, LiveEstimate):
            slip_ratio, slip_std = seen.slip_ratio, seen.slip_std
            speeds_mps, currents_a = seen.wheel_speed_mps, seen.current_a
            motion = seen.speed_x_mps, seen.speed_y_mps, seen.yaw_rate_radps
        else:
            speeds_mps = self._streams.last("wheels", [f"speed_{wheel}_mps" for wheel in self._wheels])
            currents_a = self._streams.last("wheels", [f"current_{wheel}_a" for wheel in self._wheels])
            if isinstance(seen, LiveSkidEstimate):
                motion = seen.speed_mps, math.nan, seen.yaw_rate_radps
            elif seen is not None and len(seen.slip) == len(self._wheels):
                slip_ratio, slip_std = seen.slip, seen.slip_std
        sensors = self.chain.health or self._streams.health(time_s)
        if math.isnan(time_s):
            sensors = dict.fromkeys(sensors, "lost")
        return Observation(
            belief.terrain,
            belief.probability,
            self._window,
            self.served.table.lookup(belief.terrain),
            slip_ratio,
            slip_std,
            speeds_mps,
            currents_a,
            *motion,
            sensors,
            self.served.number,
        )


_NOT_DECIDED = (CommandStatus.NO_SAMPLES, CommandStatus.FAILED)
"""Statuses of commands that no controller has decided on: they are not recorded."""


def _chain(
    request: SessionRequest, served: Served, robot: Robot | None, thread: ClassifierThread | None
) -> Chain:
    """Return what the samples of a robot go through."""
    if not request.control:
        if served.model is None:
            raise DataError("no model is served: only a robot that asks for commands can be served")
        return Observer(served.model, served.table, robot, request.channels, thread=thread)
    if robot is None:
        raise ConfigError(f"robot {request.robot!r} has no description here: commands cannot be given to it")
    settings, source = PilotSettings(follows=request.follows), Classifier(served.model, robot, thread)
    return LivePilot(robot, served.table, source, settings, channels=request.channels)
