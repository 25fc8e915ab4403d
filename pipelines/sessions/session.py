"""One robot that is served: its samples go in at any time, observations and commands come out at its steps.

Nothing of a network is known here, and nothing of one session is seen by another: they share a model and a
table, which are read only, and the thread that classifies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from time import monotonic, time
from typing import Any

import numpy as np

from pipelines.live.observer import TerrainObserver
from pipelines.live.pilot import LivePilot
from pipelines.live.pilot_settings import PilotSettings, check_table
from pipelines.live.state import LiveState, Restorable
from pipelines.live.terrain_source import Classifier, NoTerrain
from pipelines.recording.recorder import SessionRecorder
from pipelines.sessions.clock import SessionClock
from pipelines.sessions.inbox import Inbox, as_numbers
from pipelines.sessions.records import CommandStatus, Observation, Served, SessionRequest, StepOutput
from pipelines.sessions.stream_health import StreamHealth
from pipelines.streaming.classifying import Classifying, WindowOutput
from terrain.control.switching import TerrainBelief
from terrain.control.traction import TractionStatus
from terrain.errors import ConfigError, DataError
from terrain.estimation.live.estimate import LiveEstimate
from terrain.estimation.live.estimator import CHANNELS
from terrain.records import Array, Command, Reading, Sample
from terrain.robots import Robot

TWIST_FRESH_S = 0.5
"""A desired motion that is older is none: the robot is commanded to stop."""

COMMAND_VALID_S = 0.25
"""What drives the wheels has to stop them when it has had no newer command for so long."""

_NO_TWIST = np.zeros(3)


class RobotSession:
    """The live chain of one robot, from messages to steps.

    Parameters
    ----------
    request : of the robot
    served : model and table
    robot : its description; None for a robot that has none
    classifying : where its windows are classified

    Attributes
    ----------
    inbox : of its samples
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
        self, request: SessionRequest, served: Served, robot: Robot | None, classifying: Classifying
    ) -> None:
        self.request, self.served = request, served
        self.inbox = Inbox({stream: len(names) for stream, names in request.channels.items()})
        self._robot, self._classifying = robot, classifying
        self._pilot: LivePilot | None = None
        self._source: Classifier | None = None
        self._observer: TerrainObserver | None = None
        if request.control:
            self._begin_pilot(served)
        elif served.model is not None:
            self._observer = TerrainObserver(
                served.model, served.table, robot, request.channels, classifying=classifying
            )
        else:
            raise DataError("no model is served: only a robot that asks for commands can be served")
        self._wheels = () if robot is None else robot.wheels
        self._columns = _schema_columns(request.channels)
        self._streams = StreamHealth(request.channels)
        self._clock = SessionClock()
        self._twist, self._twist_s = _NO_TWIST, -math.inf
        self._steer_rad = np.zeros(3)
        self._awaits_steering = request.control and "steering" in request.channels
        self._received_s = self._known_s = math.nan
        self._n_steps = self._n_messages = 0
        self.finished: Sequence[WindowOutput] = ()
        self.failure = ""
        self._window: WindowOutput | None = None
        self._recorder: SessionRecorder | None = None

    def _begin_pilot(self, served: Served) -> None:
        if self._robot is None:
            raise ConfigError(
                f"robot {self.request.robot!r} has no description here: commands cannot be given to it"
            )
        if served.model is not None:
            self._source = Classifier(served.model, self._robot, self._classifying)
        settings = PilotSettings(follows=self.request.follows)
        self._pilot = LivePilot(self._robot, served.table, self._source, settings)

    def record(self, recorder: SessionRecorder) -> None:
        """Record samples, commands and windows from now on."""
        self._recorder = recorder

    @property
    def recording(self) -> str:
        """What the recording does: its status, or that there is none."""
        return "off" if self._recorder is None else self._recorder.status

    def end(self) -> None:
        """End the recording; it is written by its thread."""
        if self._recorder is not None:
            self._recorder.close()

    @property
    def belief(self) -> TerrainBelief:
        """The terrain that is believed."""
        if self._pilot is not None:
            return self._pilot.belief
        assert self._observer is not None  # one of both is there
        return self._observer.belief

    @property
    def dropped(self) -> dict[str, int]:
        """What was not used so far, as counts by kind."""
        counts = dict(self.inbox.refused)
        for part in (self._pilot, self._source, self._observer):
            if part is not None:
                counts |= part.dropped
        return counts | ({"time: clock set": n} if (n := self._clock.times_set) else {})

    def state(self, now_s: float | None = None) -> LiveState:
        """Return what is worth keeping over a restart.

        Parameters
        ----------
        now_s : in seconds since 1970; by default when the last sample came: what is known is as old as that
        """
        chain = self._pilot or self._observer
        assert chain is not None
        if now_s is None:
            now_s = time() if math.isnan(self._known_s) else self._known_s
        return chain.state(now_s)

    def restore(self, state: LiveState, now_s: float | None = None) -> Restorable:
        """Start from a saved state, before the first step; return what of it is used."""
        chain = self._pilot or self._observer
        assert chain is not None
        self._known_s = state.saved_s
        return chain.restore(state, time() if now_s is None else now_s)

    def check(self, served: Served) -> None:
        """Raise what :meth:`swap` would."""
        if self._robot is not None:
            check_table(served.table, self._robot.name)
        if served.model is None:
            if self._source is not None or self._observer is not None:
                raise DataError("a model cannot be replaced by none")
            return
        if self._source is not None:
            self._source.feed_of(served.model)
        elif self._observer is not None:
            self._observer.check(served.model)

    def swap(self, served: Served) -> None:
        """Go on with another model and table, between two steps; no sample is lost.

        Raises
        ------
        ConfigError, DataError
            as when a session begins.
        """
        self.check(served)
        if self._pilot is not None:
            source = self._source
            if source is None and served.model is not None and self._robot is not None:
                source = Classifier(served.model, self._robot, self._classifying)
            self._pilot.swap(served.table, NoTerrain() if source is None else source)
            if source is not None and served.model is not None:
                source.swap(served.model)
            self._source = source
        elif self._observer is not None and served.model is not None:
            self._observer.swap(served.model, served.table)
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
        if self._recorder is not None and readings:
            self._recorder.readings(readings)
        time_s = self._clock.at(now_s) if time_s is None else time_s
        self._n_steps += 1
        self.finished = ()
        command, status = None, CommandStatus.OK
        if self._pilot is not None:
            command, status = self._commanded(self._pilot, time_s, readings, now_s)
        elif self._observer is not None:
            self._found([found.output for found in self._observer.update(readings, time_s)])
        self._streams.take(readings, time_s)
        return StepOutput(
            time_s,
            self._n_steps,
            self._n_messages,
            command,
            status,
            self._observation(time_s),
            now_s - self._received_s + (monotonic() - begun_s),
        )

    def _commanded(
        self, pilot: LivePilot, time_s: float, readings: Mapping[str, Reading], now_s: float
    ) -> tuple[Command, CommandStatus]:
        fresh = now_s - self._twist_s <= TWIST_FRESH_S
        status = CommandStatus.OK if fresh else CommandStatus.NO_TWIST
        if math.isnan(time_s) or not self._is_steered(pilot, readings):
            return self._standing(), CommandStatus.NO_SAMPLES
        in_order = {
            name: Reading(reading.time_s, _ordered(reading.values, *self._columns[name]))
            for name, reading in readings.items()
            if name in self._columns
        }
        twist = self._twist if fresh else _NO_TWIST
        try:
            command = pilot.step(Sample(time_s, twist, in_order))
        except Exception as error:  # a robot without a command would go on with its last one
            self.failure = f"a step failed: {type(error).__name__}: {error}"
            return self._standing(), CommandStatus.FAILED
        if self._source is not None:
            self._found(self._source.outputs)
        numbers = (*command.wheel_radps.tolist(), *command.steer_rad.tolist(), *command.twist.tolist())
        if not all(map(math.isfinite, numbers)):
            command, status = self._standing()._replace(status=command.status), CommandStatus.NOT_FINITE
        self._steer_rad = command.steer_rad
        if self._recorder is not None:
            self._recorder.command(time_s, twist, command, command.status)
        return command, status

    def _is_steered(self, pilot: LivePilot, readings: Mapping[str, Reading]) -> bool:
        """Begin with the steering where it stands; return whether that is known, where it is measured."""
        if not self._awaits_steering:
            return True
        reading, columns = readings.get("steering"), self._columns["steering"]
        if reading is None or not len(reading.values):
            return False
        measured_rad = _ordered(reading.values, *columns)[-1]
        if not np.isfinite(measured_rad).all():
            return False
        self._steer_rad = pilot.start_steering(measured_rad)
        self._awaits_steering = False
        return True

    def _standing(self) -> Command:
        """Return the command to stand, steered as before."""
        status = {"status_code": float(TractionStatus.UNSOUND)}
        return Command(np.zeros(3), self._steer_rad, np.zeros(3), status)

    def _found(self, outputs: Sequence[WindowOutput]) -> None:
        """Keep the outputs of a step, and record them."""
        self.finished = outputs
        for output in outputs:
            self._window = output
            if self._recorder is not None:
                self._recorder.window(output)

    def _observation(self, time_s: float) -> Observation:
        belief = self.belief
        seen = self._pilot.estimate if self._pilot is not None else None
        if self._observer is not None:
            seen = self._observer.estimate  # type: ignore[assignment]
        n = len(self._wheels)
        unknown = np.full(n, math.nan)
        slip_ratio, slip_std, speeds_mps, currents_a = unknown, unknown, unknown, unknown
        motion = math.nan, math.nan, math.nan
        if isinstance(seen, LiveEstimate):
            slip_ratio, slip_std = seen.slip_ratio, seen.slip_std
            speeds_mps, currents_a = seen.wheel_speed_mps, seen.current_a
            motion = seen.speed_x_mps, seen.speed_y_mps, seen.yaw_rate_radps
        elif seen is not None:
            motion = seen.speed_mps, math.nan, seen.yaw_rate_radps
        if not isinstance(seen, LiveEstimate):
            speeds_mps = self._streams.last("wheels", [f"speed_{wheel}_mps" for wheel in self._wheels])
            currents_a = self._streams.last("wheels", [f"current_{wheel}_a" for wheel in self._wheels])
        sensors = self._pilot.health if self._pilot is not None else self._streams.health(time_s)
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


def _schema_columns(channels: Mapping[str, Sequence[str]]) -> dict[str, tuple[list[int], list[int], int]]:
    """Return where the columns of each stream go in the order of the schema, and how many it has."""
    found = {}
    for stream, names in CHANNELS.items():
        if stream in channels:
            sent = [names.index(name) for name in channels[stream] if name in names]
            kept = [i for i, name in enumerate(channels[stream]) if name in names]
            found[stream] = kept, sent, len(names)
    return found


def _ordered(values: Array, kept: list[int], places: list[int], n_columns: int) -> Array:
    """Return columns in the order of the schema, NaN where a channel is not sent."""
    if places == list(range(n_columns)) and kept == places and values.shape[1] == n_columns:
        return values
    ordered = np.full((len(values), n_columns), math.nan)
    ordered[:, places] = values[:, kept]
    return ordered
