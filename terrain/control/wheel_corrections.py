"""Corrections of the wheels' speeds for a low-level controller, and when one may be added.

A low-level controller evaluates the theoretical rates of the wheels from the desired twist and adds a correction,
``w_ODrive = w_low_level + PID_out`` (Danzi, AgriMaRo thesis, 8.3).  The correction is that of a controller only while
what it is built on is fresh, and the steering is where it was computed; else it is zero, and a state says why.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import auto

import numpy as np

from terrain.angles import wrapped
from terrain.kinematics.commands import FAR_RAD, wheel_motion
from terrain.records import Array, Command, Reading
from terrain.robots import Robot
from terrain.status import StatusCode

AHEAD_S = 0.1  #: A sample whose stamp is further ahead of the time is not built on.


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


class LowLevelKinematics:
    """The theoretical rates of a robot's wheels, as its low-level kinematics evaluates them.

    ``steer_rad`` (wheels,) is the last command of the steering; at first where it is measured.
    """

    def __init__(self, robot: Robot, steer_rad: Array) -> None:
        self._robot, self.steer_rad = robot, np.array(steer_rad, dtype=np.float64)

    def step(self, twist: Array, dt_s: float) -> Array:
        """Return the rates (wheels,) for a twist, and move the steering to within a step."""
        found = wheel_motion(self._robot, twist[None], dt_s, self.steer_rad)
        self.steer_rad = found.steer_rad[0]
        return np.asarray(found.wheel_radps[0])


def corrections(
    command: Command, wheel_radps: Array, steer_rad: Array, measured_rad: Array
) -> tuple[Array, BridgeState]:
    """Return what is to be added to the theoretical rate (wheels,) of each wheel, and whether it can be.

    A wheel can follow a velocity at two steering angles half a turn apart, with opposite rates: where the
    measured angle is the other one, the correction changes its sign.  Where it is neither, the low-level
    kinematics is at another command than the one that was computed here, and nothing may be added to it.

    Rates and angles (wheels,) are those of the desired twist; measured angles have their zeros removed, and are NaN
    where unknown; of robots that are not swerve the commanded ones.

    Examples
    --------
    >>> command = Command(np.array([4.0, 4.0, 4.0]), np.zeros(3), np.zeros(3), {})
    >>> added, state = corrections(command, np.full(3, 5.0), np.zeros(3), np.array([0.01, -0.01, np.pi]))
    >>> added.tolist(), state.name
    ([-1.0, -1.0, 1.0], 'ACTIVE')
    >>> corrections(command, np.full(3, 5.0), np.zeros(3), np.array([0.01, 0.8, 0.0]))[1].name
    'STEERING'
    """
    if not (np.isfinite(command.wheel_radps).all() and np.isfinite(command.steer_rad).all()):
        return np.zeros_like(wheel_radps), BridgeState.NOT_FINITE
    same_solution = np.where(np.cos(command.steer_rad - steer_rad) < 0.0, -1.0, 1.0)
    added = same_solution * command.wheel_radps - wheel_radps
    apart_rad = np.abs(wrapped(measured_rad - steer_rad))
    to_nearest_rad = np.minimum(apart_rad, np.pi - apart_rad)
    if not (to_nearest_rad <= FAR_RAD).all():  # of NaN too
        return np.zeros_like(wheel_radps), BridgeState.STEERING
    return np.where(apart_rad > np.pi / 2, -added, added), BridgeState.ACTIVE


class LastSample:
    """Newest sample of a stream that measured anything: all of its values, or any where it need not be ``whole``.

    It is too old after ``stale_s``; ``missing`` and ``stale`` are the states while there is none, and while it is.
    """

    def __init__(
        self, stale_s: float, missing: BridgeState, stale: BridgeState, *, whole: bool = True
    ) -> None:
        self._stale_s, self._whole, self._missing, self._stale = stale_s, whole, missing, stale
        self.values: Array = np.full(3, math.nan)
        self.stamp_s = self._read_s = math.nan

    def take(self, reading: Reading | None, read_s: float) -> bool:
        """Take the newest sample of a reading that was read at a time; say whether there was one."""
        if reading is None:
            return False
        values = reading.values[:, :3]
        known = np.isfinite(values)
        usable = np.flatnonzero(known.all(axis=1) if self._whole else known.any(axis=1))
        if not usable.size:
            return False
        newest = usable[-1]
        self.values, self.stamp_s, self._read_s = values[newest], float(reading.time_s[newest]), read_s
        return True

    def state(self, now_s: float, read_s: float) -> BridgeState:
        """Return ``ACTIVE`` where it is new enough on both clocks, that of the stamps and that of this computer."""
        if math.isnan(self.stamp_s):
            return self._missing
        fresh = -AHEAD_S <= now_s - self.stamp_s <= self._stale_s and read_s - self._read_s <= self._stale_s
        return BridgeState.ACTIVE if fresh else self._stale


def last_samples(steered: bool = True) -> Mapping[str, LastSample]:
    """Return what a correction is built on, in the order in which what is missing is named; steering where it counts.

    Nothing older than ten samples of twist and steering, and five of the wheels at 50 Hz, is built on; 0.1 s at
    1 m/s are 0.1 m.
    """
    state = BridgeState
    last = {
        "twist": LastSample(0.2, state.NO_TWIST, state.STALE_TWIST),
        "wheels": LastSample(0.1, state.NO_WHEELS, state.STALE_WHEELS, whole=False),
        "steering": LastSample(0.2, state.STEERING, state.STEERING),
    }
    return last if steered else {name: last[name] for name in ("twist", "wheels")}
