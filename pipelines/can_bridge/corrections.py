"""What is added to the theoretical rates of the wheels, ``w_ODrive = w_low_level + PID_out`` (thesis, 8.3).

The low-level kinematics and this package compute the theoretical rates from the same twist.  A wheel can
follow a velocity at two steering angles half a turn apart, with opposite rates: where the measured angle is
the other one, the correction changes its sign.  Where it is neither, the low-level kinematics is at another
command than the one that was computed here, and nothing may be added to it.
"""

from __future__ import annotations

from enum import auto
from typing import NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.entry_point import entry_point
from terrain.kinematics.swerve import FAR_RAD, wheel_command_step
from terrain.records import Array, Command
from terrain.robots import SwerveRobot
from terrain.status import StatusCode

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
    """The theoretical rates of the wheels, as the low-level kinematics evaluates them.

    Parameters
    ----------
    robot : a swerve robot
    """

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
