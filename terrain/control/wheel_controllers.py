"""Controllers of the wheels' speeds behind one interface: from desired wheel speeds to commanded ones.

``plain`` and ``ramp`` use no measurement; ``thesis`` is the PID on each wheel of
:mod:`terrain.control.danzi_pid`; ``traction`` is the controller of :mod:`terrain.control.traction`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numba import boolean, float64, int64, njit, void

from terrain.control.danzi_pid import DriveState, new_state, thesis_settings, thesis_step
from terrain.control.pid import Gains
from terrain.control.slip_table import DRIVE_STATES
from terrain.control.traction import (
    MAX_STEP_S,
    TractionSettings,
    TractionStatus,
    TractionTarget,
    WheelMeasurements,
    check_settings,
    forget_terrain,
    initial_state,
    traction_step,
    with_motor_driver,
)
from terrain.entry_point import entry_point
from terrain.estimation.live.estimate import LiveEstimate
from terrain.kinematics.wheel_velocity import in_wheel_frame, point_velocity
from terrain.records import Array, SlipTarget
from terrain.robots import Robot
from terrain.slip import MIN_SPEED_MPS

PERIOD_S = 0.02
"""Time step of the control loop; assumed where the clock is not valid."""


def step_or_period(dt_s: float) -> float:
    """Return a time step, or :data:`PERIOD_S` where it is none of a control loop."""
    return dt_s if 0.0 < dt_s <= MAX_STEP_S else PERIOD_S


_traction_step = entry_point(traction_step)


class Observation(NamedTuple):
    """Estimated motion at the wheels.

    Parameters
    ----------
    wheels : along each wheel
    wheel_radps : (wheels,) rates
    chassis_mps : magnitude of the robot's velocity
    stale_s : time since the speed over ground was measured last; infinite before the first time
    """

    wheels: WheelMeasurements
    wheel_radps: Array
    chassis_mps: float
    stale_s: float


class WheelRequest(NamedTuple):
    """Inputs of one step.

    Parameters
    ----------
    wheel_radps, desired_mps : (wheels,) desired rates, and the circumferential speed of the fastest
    target : slips of the traction controller
    slip_targets : of the current terrain by drive state, for the thesis' controller
    observed : estimates
    dt_s : since the step before; NaN where the clock is not valid
    """

    wheel_radps: Array
    desired_mps: float
    target: TractionTarget
    slip_targets: Mapping[str, SlipTarget]
    observed: Observation
    dt_s: float


class WheelReport(NamedTuple):
    """What a step decided; NaN where a controller does not have the figure.

    Parameters
    ----------
    driven_mps : commanded speed of the fastest wheel
    aimed_ratio, balance_ratio, slip_ratio : target slip with its floor, slip of steady motion, and largest
        slip of a wheel
    drive_state : by what is commanded (traction) or of the first wheel (thesis)
    status : whether a correction was made
    """

    driven_mps: float
    aimed_ratio: float
    balance_ratio: float
    slip_ratio: float
    drive_state: int
    status: int


class WheelController(Protocol):
    """Turns desired wheel speeds into commanded ones, step by step."""

    def step(self, request: WheelRequest) -> tuple[Array, WheelReport]:
        """Return the commanded rates (wheels,) and what was decided."""
        ...

    def forget_terrain(self) -> None:
        """Drop what was learned of the terrain, as another one is classified."""
        ...


class WheelObserver:
    """Motion along each wheel from an estimate of the robot's motion.

    Parameters
    ----------
    robot : swerve robot with motors
    steer_states : (wheels,) places of the steering angles among the estimate's states
    """

    def __init__(self, robot: Robot, steer_states: Array) -> None:
        motors = robot.equipment.motors
        self._torque_per_amp_nm = (
            motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio
        )
        self._x_m, self._y_m = np.array(robot.wheel_positions_m).T.copy()
        self._radius_m, self._steer_states = robot.wheel_radius_m, steer_states

    def observe(self, estimate: LiveEstimate | None, time_s: float) -> Observation:
        """Return the motion at the wheels; NaN before the first estimate."""
        if estimate is None:
            return UNOBSERVED
        stale_s = estimate_age(estimate, time_s)
        found, wheel_radps = np.empty((5, 3)), np.empty(3)
        _observe(
            estimate.mean,
            self._steer_states,
            estimate.speed_x_mps,
            estimate.speed_y_mps,
            estimate.yaw_rate_radps,
            estimate.accel_x_mps2,
            estimate.accel_y_mps2,
            self._x_m,
            self._y_m,
            estimate.wheel_speed_mps,
            estimate.slip_ratio,
            estimate.slip_std,
            estimate.current_a,
            self._radius_m,
            self._torque_per_amp_nm,
            math.isinf(stale_s),
            found,
            wheel_radps,
        )
        chassis_mps = math.hypot(estimate.speed_x_mps, estimate.speed_y_mps)
        return Observation(WheelMeasurements(*found), wheel_radps, chassis_mps, stale_s)


_V, _M = float64[::1], float64[:, ::1]


@njit(
    void(
        *(_V, int64[::1], float64, float64, float64, float64, float64, _V, _V, _V, _V, _V, _V),
        *(float64, float64, boolean, _M, _V),
    ),
    cache=True,
    error_model="numpy",
)
def _observe_wheels(
    mean: Array,
    steer_states: Array,
    speed_x_mps: float,
    speed_y_mps: float,
    yaw_rate_radps: float,
    accel_x_mps2: float,
    accel_y_mps2: float,
    x_m: Array,
    y_m: Array,
    wheel_speed_mps: Array,
    slip_ratio: Array,
    slip_std: Array,
    current_a: Array,
    radius_m: float,
    torque_per_amp_nm: float,
    never_seen: bool,
    found: Array,
    wheel_radps: Array,
) -> None:
    """Write speed, acceleration, slip, its standard deviation and torque (5, wheels), and rates (wheels,)."""
    for i in range(steer_states.size):
        steer_rad = mean[steer_states[i]]
        cos, sin = math.cos(steer_rad), math.sin(steer_rad)
        forward, left = point_velocity(speed_x_mps, speed_y_mps, yaw_rate_radps, x_m[i], y_m[i])
        speed, _ = in_wheel_frame(forward, left, cos, sin)
        fastest = abs(speed)
        if not abs(wheel_speed_mps[i]) <= fastest:  # NaN too
            fastest = abs(wheel_speed_mps[i])
        # a wheel stands by the filter's rate, which differs a little from the measured one
        standing = fastest < (2.0 if math.isnan(slip_ratio[i]) else 1.0) * MIN_SPEED_MPS
        found[0, i], found[1, i] = speed, accel_x_mps2 * cos + accel_y_mps2 * sin
        found[2, i] = 0.0 if standing and not never_seen else slip_ratio[i]
        found[3, i] = 0.0 if standing else slip_std[i]
        found[4, i] = current_a[i] * torque_per_amp_nm
        wheel_radps[i] = wheel_speed_mps[i] / radius_m


_observe = entry_point(_observe_wheels)

UNOBSERVED = Observation(
    WheelMeasurements(*np.full((5, 3), math.nan)), np.full(3, math.nan), math.nan, math.inf
)
"""Before the first estimate."""


def estimate_age(estimate: LiveEstimate, time_s: float) -> float:
    """Return the time since the speed over ground was measured last."""
    return estimate.reference_age_s + max(time_s - estimate.time_s, 0.0)


class RampController:
    """Desired speeds, with a bounded rise of the fastest wheel's speed, and no measurement.

    Parameters
    ----------
    ramp_mps2 : largest rise; infinite for none
    """

    def __init__(self, ramp_mps2: float = math.inf) -> None:
        self._ramp_mps2 = ramp_mps2
        self._wheel, self._driven_mps = np.zeros(3), 0.0

    def step(self, request: WheelRequest) -> tuple[Array, WheelReport]:
        """Return the commanded rates (wheels,) and what was decided."""
        wheel, desired_mps = request.wheel_radps, request.desired_mps
        before_mps = self._driven_mps if float(wheel @ self._wheel) >= 0.0 else 0.0
        rise_mps = self._ramp_mps2 * step_or_period(request.dt_s)
        self._wheel, self._driven_mps = wheel, min(desired_mps, before_mps + rise_mps)
        command = wheel * (self._driven_mps / desired_mps) if desired_mps > 0.0 else wheel
        unknown = math.nan
        return command, WheelReport(
            self._driven_mps, unknown, unknown, unknown, DriveState.STEADY, TractionStatus.OK
        )

    def forget_terrain(self) -> None:
        """Do nothing: nothing is learned."""


class TractionController:
    """The controller of :mod:`terrain.control.traction` on a robot.

    Raises
    ------
    ConfigError
        if a setting is not accepted.
    """

    def __init__(self, robot: Robot, settings: TractionSettings) -> None:
        self._settings = with_motor_driver(check_settings(settings), robot)
        self._radius_m, self._state = robot.wheel_radius_m, initial_state()

    def step(self, request: WheelRequest) -> tuple[Array, WheelReport]:
        """Return the commanded rates (wheels,) and what was decided."""
        observed = request.observed
        command, self._state, report = _traction_step(
            self._settings,
            self._state,
            request.target,
            self._radius_m,
            request.wheel_radps,
            observed.wheels,
            observed.stale_s,
            request.dt_s,
        )
        return command, WheelReport(*report)

    def forget_terrain(self) -> None:
        """Drop the balance of steady motion and the floor of the target."""
        self._state = forget_terrain(self._state)


class ThesisController:
    """The thesis' PID of slip on each wheel.

    Parameters
    ----------
    robot : swerve robot
    gains, form : as :func:`terrain.control.danzi_pid.thesis_settings`
    stale_max_s : an older speed over ground is not used
    """

    def __init__(self, robot: Robot, gains: Gains, form: str, stale_max_s: float) -> None:
        self._settings = thesis_settings(robot.wheel_radius_m, gains, form)
        self._radius_m, self._stale_max_s, self._state = robot.wheel_radius_m, stale_max_s, new_state()

    def step(self, request: WheelRequest) -> tuple[Array, WheelReport]:
        """Return the commanded rates (wheels,) and what was decided."""
        wheel, observed, dt_s = request.wheel_radps, request.observed, request.dt_s
        targets = np.array([request.slip_targets[state].slip_ratio for state in DRIVE_STATES])
        stale = observed.stale_s > self._stale_max_s
        added, desired, drive_state, _, self._state = thesis_step(
            self._settings,
            self._state,
            wheel,
            observed.wheel_radps,
            UNOBSERVED.wheels.speed_mps if stale else observed.wheels.speed_mps,
            observed.wheels.accel_mps2,
            observed.chassis_mps,
            targets,
            dt_s,
        )
        status = TractionStatus.OK if np.isfinite(desired).all() else TractionStatus.NO_SLIP
        if not 0.0 < dt_s <= MAX_STEP_S:
            status = TractionStatus.BAD_TIME
        command = wheel + added
        driven_mps = float(np.abs(command).max()) * self._radius_m
        slip = observed.wheels.slip_ratio
        aimed, largest = (float(np.where(wheel < 0.0, -s, s).max()) for s in (desired, slip))
        return command, WheelReport(driven_mps, aimed, math.nan, largest, int(drive_state[0]), status)

    def forget_terrain(self) -> None:
        """Do nothing: nothing of the terrain is learned."""
