"""One robot that is served: its samples go in at any time, observations and commands come out at its steps.

Nothing of a network is known here, and nothing of one session is seen by another: they share a model and a
table, which are read only, and the thread that classifies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic, time
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationInfo, field_validator

from pipelines.live.chain import COMMAND_VALID_S, Chain, CommandStatus, OnlyWatched, Step
from pipelines.live.gate import LiveGate
from pipelines.live.model import TerrainModel
from pipelines.live.observer import Observer
from pipelines.live.pilot import LivePilot, pilot_classifier
from pipelines.live.recording import RecordingThread, SessionRecorder
from terrain.control.live_state import LiveState
from terrain.control.robot_control import PilotSettings
from terrain.control.slip_table import SlipTable
from terrain.discrepancy.watch import FALSE_ALARM_H, Watch, Watched
from terrain.errors import ConfigError, DataError
from terrain.estimation.clocks import Inbox, SessionClock, numbers
from terrain.records import Sample
from terrain.robots import Robot

TWIST_FRESH_S = 0.5  #: A desired motion that is older is none: the robot is commanded to stop

CONTROL_RATE_LEAST_HZ = 5.0
"""Of commands: a longer step than half a second is taken for a clock that was set, and a command holds for a
quarter of a second."""

LATE_SHOWN_S = 4.0  #: Without a window for so long, late samples are what there is no terrain for

_NO_TWIST = np.zeros(3)

MOTION = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
SEEN = ("slip_ratio", "slip_std", "wheel_speed_mps", "current_a", *MOTION)
"""What an observation has of the estimate of a motion."""

NOT_ESTIMATED = "no filter runs: the model of the terrain takes none, and no robot is described or driven"
NO_SAMPLE, NO_WHEELS = "no sample of the wheels has come yet", "no speed of a wheel comes"
NOT_FOLLOWED = (
    "the wheels do not do what is commanded, and are left out (follows: false if another controller drives)"
)

WINDOW = (
    *("start_s", "end_s", "terrain", "probabilities", "refused", "nearest", "novelty", "supported"),
    *("answers", "reason"),
)
"""What an observation has of the last window; an empty text is null."""


class Served(NamedTuple):
    """What all sessions use; it is replaced whole."""

    number: int  #: rises with each replacement
    #: model, model_name: that classifies, and its URI; without one the terrain is unknown
    model: TerrainModel | None
    model_name: str
    table: SlipTable  #: of target slips

    def content(self) -> dict[str, Any]:
        """Return which model and table are used."""
        return {
            "number": self.number,
            "model": self.model_name or None,
            "classes": [] if self.model is None else list(self.model.info.classes),
            "table": self.table.name,
        }


Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+-]*$", max_length=64)]
Channel = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=64)]


class Hello(BaseModel):
    """What a robot says of itself before its first sample: what it is, what it sends, and what it asks for.

    Parameters
    ----------
    session : name of the session, one a robot
    robot : name of its description; a robot that has none is observed by its channels
    streams : channels of each stream that it sends, in the order of the columns
    control : whether commands are asked for
    follows : whether they drive the wheels; not where another controller does and these are only watched
    rate_hz : of the answers; 0 asks for one at each message with ``"step": true``
    record : whether the session is recorded
    start : terrain that its first 20 s are on, which adapt the model to the session
    """

    model_config = ConfigDict(extra="forbid", strict=True)

    type: Literal["hello"] = "hello"
    protocol: Literal[2] = 2
    session: Name
    robot: Name
    streams: Annotated[
        dict[Name, Annotated[tuple[Channel, ...], Field(min_length=1, max_length=64, strict=False)]],
        Field(min_length=1, max_length=16),
    ]
    control: bool = False
    follows: bool = True
    rate_hz: Annotated[float, Field(ge=0.0, le=200.0, strict=False)] = 10.0
    record: bool = False
    start: Annotated[str, StringConstraints(max_length=64)] = ""

    @field_validator("streams")
    @classmethod
    def _check_streams(cls, streams: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
        for stream, channels in streams.items():
            if len(set(channels)) < len(channels):
                raise ValueError(f"stream {stream!r} names a channel twice")
        return streams

    @field_validator("rate_hz")
    @classmethod
    def _check_rate(cls, rate_hz: float, others: ValidationInfo) -> float:
        if others.data.get("control") and 0.0 < rate_hz < CONTROL_RATE_LEAST_HZ:
            least = f"{CONTROL_RATE_LEAST_HZ:g} Hz or more"
            raise ValueError(f"commands need {least}, or 0: one at each message")
        return rate_hz


class RobotSession:
    """The live chain of one robot, from messages to steps.

    Parameters
    ----------
    hello : of the robot
    served : model and table
    robot : its description; None for a robot that has none
    thread : that classifies its windows; at once without one
    leave : called with a code and a sentence where the robot cannot be served any longer
    watched, false_alarm_h : robot that is watched where it is this one, and hours to a false alarm

    Attributes
    ----------
    inbox : of its samples
    chain : that its samples go through
    restored : what it was started from; None where it was not
    received_s : when its last message came, on the local clock that never goes back
    last : output of the last step; None before the first
    late : that there is no terrain because samples come too late; empty where that is not so
    gate : what is implausible or doubtful in its samples

    Raises
    ------
    ConfigError
        if commands are asked for a robot that has no pilot, the table is another robot's, or the terrain of its
        start was not learned.
    DataError
        if the model needs channels that the robot does not send, there is neither model nor pilot, or the model has
        nothing to adapt by.
    """

    def __init__(
        self,
        hello: Hello,
        served: Served,
        robot: Robot | None,
        thread: ThreadPoolExecutor | None = None,
        leave: Callable[[str, str], None] = lambda code, sentence: None,
        watched: Watched | None = None,
        false_alarm_h: float = FALSE_ALARM_H,
    ) -> None:
        self.hello, self.served, self.leave = hello, served, leave
        self.watch: Watch | None = None
        if watched is not None and watched.robot.name == hello.robot:
            self.watch = Watch(watched, hello.streams, false_alarm_h, thread)
        self.inbox = Inbox(hello.streams)
        self.gate = LiveGate(hello.robot, hello.streams, robot, thread)
        pilot = PilotSettings(follows=hello.follows) if hello.control else None
        if pilot is not None and robot is None:
            raise ConfigError(
                f"robot {hello.robot!r} has no description here: commands cannot be given to it"
            )
        about = self._model_of(served), served.table, pilot, thread, self.watch is not None
        self.chain = chain_of(robot, hello.streams, *about)
        self._wheels = () if robot is None else robot.wheels
        self._clock = SessionClock()
        self._twist, self._twist_s = _NO_TWIST, -math.inf
        self._sampled_s = self._known_s = math.nan
        self._n_steps = self._n_messages = 0
        self.received_s = monotonic()
        self.last: Step | None = None
        self.late, self._too_late = "", self.chain.too_late
        self._too_late_s, self._window_s = -math.inf, math.nan
        self.restored: LiveState | None = None
        self._recorder: SessionRecorder | None = None
        self._window: dict[str, Any] | None = None

    def record(self, folder: Path, writer: RecordingThread) -> None:
        """Record samples, commands and windows from now on, as a file of a folder that a thread writes."""
        hello, wheels = self.hello, self._wheels if self.hello.control else ()
        name = f"{hello.session}_{datetime.now(UTC):%Y%m%d_%H%M%S}"
        self._recorder = SessionRecorder(folder, name, hello.robot, hello.streams, wheels, writer=writer)

    @property
    def recording(self) -> str:
        """What the recording does: its status, or that there is none."""
        return "off" if self._recorder is None else self._recorder.status

    def end(self) -> None:
        """End the recording; its last samples are written by its thread."""
        if self._recorder is not None:
            self._recorder.close()

    def welcome(self) -> dict[str, Any]:
        """Return the answer to the hello."""
        hello, restored = self.hello, self.restored
        known = restored and {
            "age_s": max(time() - restored.saved_s, 0.0),
            "biases": sorted(restored.biases),
            "terrain": restored.terrain or None,
        }
        return {
            "type": "welcome",
            **{name: getattr(hello, name) for name in ("protocol", "session", "rate_hz", "control")},
            "command_valid_s": COMMAND_VALID_S,
            "served": self.served.content(),
            "recording": self.recording,
            "restored": known,
        }

    def content(self) -> dict[str, Any]:
        """Return what is shown of the session."""
        return {
            **{name: getattr(self.hello, name) for name in ("session", "robot", "control")},
            "terrain": self.chain.belief.terrain or None,
            "recording": self.recording,
            "late": self.late or None,
            "doubtful": self.gate.sentences,
            "adapted": self.adapted or None,
            "dropped": self.dropped,
        }

    @property
    def adapted(self) -> str:
        """What the start of the session shifted, in a sentence; empty before and without."""
        return str(getattr(self.chain.source, "adapted", ""))

    @property
    def dropped(self) -> dict[str, int]:
        """What was not used so far, as counts by kind."""
        counts = dict(self.inbox.refused) | self.chain.dropped
        return counts | ({"time: clock set": n} if (n := self._clock.times_set) else {})

    def state(self) -> LiveState:
        """Return what is worth keeping over a restart; it is as old as the last sample."""
        return self.chain.state(time() if math.isnan(self._known_s) else self._known_s)

    def restore(self, state: LiveState) -> None:
        """Start from a saved state, before the first step."""
        self._known_s = state.saved_s
        self.restored = self.chain.restore(state, time())

    def swap(self, served: Served) -> None:
        """Go on with another model and table, between two steps; no sample is lost, what is raised changes nothing."""
        self.chain.replace(self._model_of(served), served.table)
        self.served = served

    def _model_of(self, served: Served) -> TerrainModel | None:
        """Return the model of the service, to be adapted by a start on the terrain that the robot named."""
        if not self.hello.start or served.model is None:
            return served.model
        return served.model.at_start(self.hello.start)

    def put(self, streams: Any, twist: Any, now_s: float) -> int:
        """Take the samples of a message; return how many rows of it were taken.

        Parameters
        ----------
        streams : by name, a pair of stamps ``(k,)`` and rows ``(k, channels)``; whatever else is in it is
            refused and counted
        twist : desired motion ``(3,)``; None where the message has none
        now_s : of the local clock that never goes back
        """
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
                    self._sampled_s, self._known_s = now_s, time()
        elif streams is not None:
            self.inbox.refused["samples that are not given by stream"] += 1
        if twist is not None:
            desired = numbers(twist)
            if desired is None or desired.shape != (3,) or not np.isfinite(desired).all():
                self.inbox.refused["twist that is not three numbers"] += 1
            else:
                self._twist, self._twist_s = desired, now_s
        return self.inbox.received.total() - before

    def step(self, now_s: float | None = None, time_s: float | None = None) -> Step:
        """Run the chain over what has come since the last step; it does not raise.

        Parameters
        ----------
        now_s : of the local clock that never goes back
        time_s : of the robot's clock, where it says so itself; by default that of its clock now, as far as
            its messages tell
        """
        begun_s = monotonic()
        now_s = begun_s if now_s is None else now_s
        time_s = self._clock.at(now_s) if time_s is None else time_s
        readings = self.inbox.take(time_s)
        fresh = now_s - self._twist_s <= TWIST_FRESH_S
        twist = self._twist if fresh else _NO_TWIST
        done = self.chain.take(Sample(time_s, twist, readings))
        self.gate.step(time_s, readings)
        if self.watch is not None:
            self.watch.step(readings)
        self._n_steps += 1
        if done.windows or self.served.model is None or math.isnan(self._window_s):
            self._window_s = now_s
        if (too_late := self.chain.too_late) != self._too_late:
            self._too_late, self._too_late_s = too_late, now_s
        is_late = now_s - self._window_s > LATE_SHOWN_S > now_s - self._too_late_s
        self.late = f"no terrain: samples come late by {1e3 * too_late[1]:.0f} ms" if is_late else ""
        if done.windows:
            found = {name: getattr(done.windows[-1], name) for name in WINDOW}
            self._window = {name: None if value == "" else value for name, value in found.items()}
        if self._recorder is not None:
            self._recorder.readings(readings)
            self._recorder.step(time_s, twist, done)
        if done.command is not None and done.status is CommandStatus.OK and not fresh:
            done = done._replace(status=CommandStatus.NO_TWIST)
        self.last = done._replace(
            time_s=time_s,
            number=self._n_steps,
            message=self._n_messages,
            observation=self._observation(time_s),
            latency_s=now_s - self._sampled_s + (monotonic() - begun_s),
        )
        return self.last

    def _observation(self, time_s: float) -> dict[str, Any]:
        belief, seen = self.chain.belief, self.chain.estimate
        target = self.served.table.lookup(belief.terrain)
        if seen is not None:
            known = {name: getattr(seen, name) for name in SEEN}
        else:
            known = dict.fromkeys(SEEN[:2], np.full(len(self._wheels), math.nan)) | dict.fromkeys(
                MOTION, math.nan
            )
            for name, channel in (("wheel_speed_mps", "speed_{}_mps"), ("current_a", "current_{}_a")):
                known[name] = self.inbox.last("wheels", [channel.format(wheel) for wheel in self._wheels])
        reason = seen.reason if seen is not None else NO_SAMPLE if self.chain.is_estimated else NOT_ESTIMATED
        sensors = self.chain.health or self.inbox.health(time_s)
        if math.isnan(time_s):
            sensors = dict.fromkeys(sensors, "lost")
        wheels = {health for name, health in sensors.items() if name.startswith("wheel")}
        if seen is not None and wheels == {"lost"}:  # the last estimate is of their last sample
            known |= {name: np.full(len(self._wheels), math.nan) for name in SEEN[:3]}
            reason = NO_WHEELS
        if reason and isinstance(self.chain, LivePilot) and self.chain.control.not_followed:
            reason = NOT_FOLLOWED
        return {
            "terrain": belief.terrain or None,
            "probability": belief.probability,
            "window": self._window,
            "target_slip": {
                state: {"slip_ratio": one.slip_ratio, "slip_std": one.slip_std, "status": str(one.status)}
                for state, one in target.items()
            },
            "target_of": next(iter(target.values())).terrain,
            **known,
            "slip_unknown": reason or None,
            "sensors": sensors,
            "served": self.served.number,
            "late": self.late or None,
            "doubtful": self.gate.sentences,
            "watch": None if self.watch is None else self.watch.content(),
        }


def chain_of(
    robot: Robot | None,
    channels: Mapping[str, Sequence[str]],
    model: TerrainModel | None,
    table: SlipTable,
    pilot: PilotSettings | None = None,
    thread: ThreadPoolExecutor | None = None,
    watched: bool = False,
) -> Chain:
    """Return what the samples of a robot go through: a pilot of these settings, without them an observer.

    A robot that is watched needs no model.
    """
    if pilot is not None and robot is not None:
        source = pilot_classifier(model, robot, thread, channels)
        return LivePilot(robot, table, source, pilot, channels=channels)
    if model is None and watched:
        return OnlyWatched("" if robot is None else robot.name, table)
    if model is None:
        raise DataError("no model is served: only a robot that asks for commands can be served")
    return Observer(model, table, robot, channels, thread=thread)
