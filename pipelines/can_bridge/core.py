"""From frames received to frames sent, without a bus: the caller gives each frame and the time.

Corrections are the controller's only while the desired twist and the wheels' rates are fresh and the steering
is where it was computed; else they are zero, and the status says why.  Nothing that is sent is older than the
step that sends it.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable

import numpy as np

from pipelines.can_bridge.bus_clock import BusClock
from pipelines.can_bridge.corrections import BridgeState, LowLevelKinematics, corrections
from pipelines.data.can_codec import Frame, Layout, encode
from pipelines.data.can_logs import Receiver
from pipelines.data.can_signals import RECEIVED, channels_of
from terrain.control.wheel_controllers import step_or_period
from terrain.records import Array, Command, Reading, Sample
from terrain.robots import SwerveRobot

Step = Callable[[Sample], Command]
MakeStep = Callable[[Array], Step]

STALE_S = {"twist": 0.2, "wheels": 0.1, "steering": 0.2}
"""An older sample is not built on: ten of the twist and of the steering, five of the wheels at 50 Hz; 0.1 s
at 1 m/s are 0.1 m."""

AHEAD_S = 0.1
"""Nor is one whose stamp is further ahead of the time."""

KEPT = 100_000
"""Latencies that are kept: half an hour at 50 Hz."""

_STATUS = channels_of("status")


class LastSample:
    """Newest sample of a stream that measured anything.

    Parameters
    ----------
    stale_s : when it is too old
    """

    def __init__(self, stale_s: float, width: int) -> None:
        self._stale_s = stale_s
        self.values: Array = np.full(width, math.nan)
        self.stamp_s = self._read_s = math.nan

    def take(self, reading: Reading | None, read_s: float, *, whole: bool) -> bool:
        """Take the newest sample; of a ``whole`` one all values have to be there. Say whether one was."""
        if reading is None:
            return False
        values = reading.values[:, : self.values.size]
        known = np.isfinite(values)
        usable = np.flatnonzero(known.all(axis=1) if whole else known.any(axis=1))
        if not usable.size:
            return False
        newest = usable[-1]
        self.values, self.stamp_s, self._read_s = values[newest], float(reading.time_s[newest]), read_s
        return True

    @property
    def came(self) -> bool:
        """Whether there was one."""
        return math.isfinite(self.stamp_s)

    def is_fresh(self, now_s: float, read_s: float) -> bool:
        """Say whether it is new enough on both clocks."""
        age_s = now_s - self.stamp_s
        return -AHEAD_S <= age_s <= self._stale_s and read_s - self._read_s <= self._stale_s


class BridgeCore:
    """Samples out of frames, a controller's step, corrections into frames.

    Parameters
    ----------
    layout : of the DBC
    robot : a swerve robot
    make_step : returns the step of a controller, given the measured steering angles (3,) that it starts from

    Attributes
    ----------
    n_in : frames received
    samples, states : samples by stream; control steps by :class:`BridgeState`
    clipped : values sent as the end of their range, by signal
    failed : steps that raised, by message
    """

    def __init__(self, layout: Layout, robot: SwerveRobot, make_step: MakeStep) -> None:
        self._layout, self._make_step = layout, make_step
        self._step: Step | None = None
        self._receiver = Receiver(layout, RECEIVED)
        self._kinematics, self.clock = LowLevelKinematics(robot), BusClock()
        self._zeros_rad = robot.steering_zeros_rad
        self._last = {name: LastSample(stale_s, 3) for name, stale_s in STALE_S.items()}
        self._before_s, self._counter, self._new_wheels = math.nan, 0, False
        self.n_in = 0
        self.samples: Counter[str] = Counter()
        self.states: Counter[str] = Counter()
        self.clipped: Counter[str] = Counter()
        self.failed: Counter[str] = Counter()
        self.latencies_s: deque[float] = deque(maxlen=KEPT)

    @property
    def dropped(self) -> Counter[str]:
        """What was received and not used, as counts by kind."""
        return self._receiver.dropped

    @property
    def n_used(self) -> int:
        """Frames of signals that are used."""
        return self._receiver.n_used

    def receive(self, frame: Frame, read_s: float) -> None:
        """Take a frame that was read at a time of this computer."""
        self.n_in += 1
        if self._receiver.take(frame) is not None:
            self.clock.received(frame.time_s, read_s)

    def tick(self, read_s: float) -> list[Frame]:
        """Return the frames of a control step at a time of this computer."""
        now_s = self.clock.time(read_s)
        readings = self._receiver.readings(now_s)
        for name, reading in readings.items():
            self.samples[name] += len(reading.time_s)
        last = self._last
        last["twist"].take(readings.pop("twist", None), read_s, whole=True)
        last["steering"].take(readings.get("steering"), read_s, whole=True)
        self._new_wheels = last["wheels"].take(readings.get("wheels"), read_s, whole=False)
        added, status, state = self._control(Sample(now_s, np.zeros(3), readings), read_s)
        self._before_s = now_s
        self.states[state.name] += 1
        return self._frames(added, status, state, now_s)

    def sent(self, read_s: float) -> None:
        """Note when the frames of the last step were sent."""
        if self._new_wheels:
            self.latencies_s.append(self.clock.time(read_s) - self._last["wheels"].stamp_s)

    def stop(self, read_s: float) -> list[Frame]:
        """Return the last frames: corrections of zero."""
        return self._frames(np.zeros(3), {}, BridgeState.STOPPED, self.clock.time(read_s))

    def _control(self, sample: Sample, read_s: float) -> tuple[Array, dict[str, float], BridgeState]:
        """Return corrections, the controller's status, and the state."""
        state = self._missing(sample.time_s, read_s)
        if not self._last["steering"].came:
            return np.zeros(3), {}, BridgeState.STEERING if state == BridgeState.ACTIVE else state
        measured_rad = self._last["steering"].values - self._zeros_rad
        if self._step is None:
            self._kinematics.start(measured_rad)
            self._step = self._make_step(measured_rad)
        if state not in (BridgeState.NO_TWIST, BridgeState.STALE_TWIST):
            sample = sample._replace(twist=self._last["twist"].values)
        theory = self._kinematics.step(sample.twist, step_or_period(sample.time_s - self._before_s))
        try:
            command = self._step(sample)
            status = {name: float(value) for name, value in command.status.items()}
            added, found = corrections(command, theory, measured_rad)
        except Exception as error:  # a controller that fails must not leave its last correction in force
            self.failed[f"{type(error).__name__}: {error}"[:160]] += 1
            return np.zeros(3), {}, BridgeState.STEP_FAILED
        if state == BridgeState.ACTIVE and not self._last["steering"].is_fresh(sample.time_s, read_s):
            state = BridgeState.STEERING
        state = found if state == BridgeState.ACTIVE else state
        return (added if state == BridgeState.ACTIVE else np.zeros(3)), status, state

    def _missing(self, now_s: float, read_s: float) -> BridgeState:
        """Return what is missing or stale."""
        twist, wheels = self._last["twist"], self._last["wheels"]
        if not twist.came:
            return BridgeState.NO_TWIST
        if not twist.is_fresh(now_s, read_s):
            return BridgeState.STALE_TWIST
        if not wheels.came:
            return BridgeState.NO_WHEELS
        if not wheels.is_fresh(now_s, read_s):
            return BridgeState.STALE_WHEELS
        return BridgeState.ACTIVE

    def _frames(
        self, added: Array, status: dict[str, float], state: BridgeState, now_s: float
    ) -> list[Frame]:
        figures = {"terrain_code": math.nan} | status | {"bridge_code": float(state)}
        values = [figures.get(name, math.nan) for name in _STATUS]
        # a code below zero stands for none
        coded = [
            math.nan if n.endswith("_code") and v < 0.0 else v for n, v in zip(_STATUS, values, strict=True)
        ]
        counter, self._counter = self._counter, self._counter + 1
        return [
            *encode(self._layout, "corrections", added.tolist(), counter, now_s, self.clipped),
            *encode(self._layout, "status", coded, counter, now_s, self.clipped),
        ]
