"""From frames received to frames sent, without a bus: the caller gives each frame and the time.

Corrections are added to the theoretical rates of the wheels, ``w_ODrive = w_low_level + PID_out`` (thesis, 8.3).
They are the controller's only while the desired twist and the wheels' rates are fresh on both clocks, that of the
bus and that of this computer, and the steering is where it was computed; else they are zero, and the status says
why.  Nothing that is sent is older than the step that sends it.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from enum import auto
from typing import NamedTuple

import numpy as np

from pipelines.data.can_codec import RECEIVED, Frame, Layout, channels_of, encode
from pipelines.data.can_logs import Receiver
from terrain.angles import wrapped
from terrain.control.wheel_controllers import step_or_period
from terrain.entry_point import entry_point
from terrain.estimation.live.clocks import SessionClock
from terrain.kinematics.swerve import FAR_RAD, wheel_command_step
from terrain.records import Array, Command, Reading, Sample
from terrain.robots import SwerveRobot
from terrain.status import StatusCode

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
_wheel_command_step = entry_point(wheel_command_step)


class BridgeState(StatusCode):
    """Whether corrections are the controller's, or why they are zero; values of ``BridgeState`` in the DBC.

    A twist, or wheel rates, that never came or came too long ago; steering that is not where it was computed;
    a command that is not finite; a step that failed; a bridge that stops.
    """

    ACTIVE = 0
    NO_TWIST = auto()
    STALE_TWIST = auto()
    NO_WHEELS = auto()
    STALE_WHEELS = auto()
    STEERING = auto()
    NOT_FINITE = auto()
    STEP_FAILED = auto()
    STOPPED = auto()


class Theory(NamedTuple):
    """Theoretical rates and steering angles of the wheels (3,)."""

    wheel_radps: Array
    steer_rad: Array


class LowLevelKinematics:
    """The theoretical rates of the wheels of a swerve robot, as its low-level kinematics evaluates them."""

    def __init__(self, robot: SwerveRobot) -> None:
        self._positions_m = np.array(robot.wheel_positions_m)
        self._limits = (
            robot.wheel_radius_m,
            robot.equipment.motors.speed_max_radps,
            robot.equipment.steering.rate_max_radps,
        )
        self._steer_rad = np.zeros(3)

    def start(self, steer_rad: Array) -> None:
        """Begin at measured steering angles."""
        self._steer_rad = np.array(steer_rad, dtype=np.float64)

    def step(self, twist: Array, dt_s: float) -> Theory:
        """Return the rates for a twist, and where the steering moves to within a step."""
        _, wheel_radps, self._steer_rad = _wheel_command_step(
            self._positions_m, *self._limits, dt_s, FAR_RAD, twist, self._steer_rad
        )
        return Theory(wheel_radps, self._steer_rad)


def corrections(command: Command, theory: Theory, measured_rad: Array) -> tuple[Array, BridgeState]:
    """Return what is to be added to the theoretical rate (3,) of each wheel, and whether it can be.

    A wheel can follow a velocity at two steering angles half a turn apart, with opposite rates: where the
    measured angle is the other one, the correction changes its sign.  Where it is neither, the low-level
    kinematics is at another command than the one that was computed here, and nothing may be added to it.

    Parameters
    ----------
    command : of the controller
    theory : of the desired twist
    measured_rad : (3,) steering angles, zeros removed; NaN where unknown

    Examples
    --------
    >>> import numpy as np
    >>> command = Command(np.array([4.0, 4.0, 4.0]), np.zeros(3), np.zeros(3), {})
    >>> theory = Theory(np.array([5.0, 5.0, 5.0]), np.zeros(3))
    >>> added, state = corrections(command, theory, np.array([0.01, -0.01, np.pi]))
    >>> added.tolist(), state.name
    ([-1.0, -1.0, 1.0], 'ACTIVE')
    >>> corrections(command, theory, np.array([0.01, 0.8, 0.0]))[1].name
    'STEERING'
    """
    if not (np.isfinite(command.wheel_radps).all() and np.isfinite(command.steer_rad).all()):
        return np.zeros(3), BridgeState.NOT_FINITE
    same_solution = np.where(np.cos(command.steer_rad - theory.steer_rad) < 0.0, -1.0, 1.0)
    added = same_solution * command.wheel_radps - theory.wheel_radps
    apart_rad = np.abs(wrapped(measured_rad - theory.steer_rad))
    to_nearest_rad = np.minimum(apart_rad, np.pi - apart_rad)
    if not (to_nearest_rad <= FAR_RAD).all():  # of NaN too
        return np.zeros(3), BridgeState.STEERING
    return np.where(apart_rad > np.pi / 2, -added, added), BridgeState.ACTIVE


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
    receiver : of the frames; it counts those that are used, and what was not used by kind
    n_in : frames received
    samples, states : samples by stream; control steps by :class:`BridgeState`
    clipped : values sent as the end of their range, by signal
    failed : steps that raised, by message
    latencies_s : from the stamp of the wheels' newest sample to the correction sent
    """

    def __init__(self, layout: Layout, robot: SwerveRobot, make_step: MakeStep) -> None:
        self._layout, self._make_step = layout, make_step
        self._step: Step | None = None
        self.receiver = Receiver(layout, RECEIVED)
        self._kinematics, self.clock = LowLevelKinematics(robot), SessionClock()
        self._zeros_rad = robot.steering_zeros_rad
        self._last = {name: LastSample(stale_s, 3) for name, stale_s in STALE_S.items()}
        self._before_s, self._counter, self._new_wheels = math.nan, 0, False
        self.n_in = 0
        self.samples: Counter[str] = Counter()
        self.states: Counter[str] = Counter()
        self.clipped: Counter[str] = Counter()
        self.failed: Counter[str] = Counter()
        self.latencies_s: deque[float] = deque(maxlen=KEPT)

    def receive(self, frame: Frame, read_s: float) -> None:
        """Take a frame that was read at a time of this computer."""
        self.n_in += 1
        if self.receiver.take(frame) is not None:
            self.clock.received(frame.time_s, read_s)

    def tick(self, read_s: float) -> list[Frame]:
        """Return the frames of a control step at a time of this computer."""
        now_s = self.clock.at(read_s)
        readings = self.receiver.readings(now_s)
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
            self.latencies_s.append(self.clock.at(read_s) - self._last["wheels"].stamp_s)

    def stop(self, read_s: float) -> list[Frame]:
        """Return the last frames: corrections of zero."""
        return self._frames(np.zeros(3), {}, BridgeState.STOPPED, self.clock.at(read_s))

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
