"""Controllers of the wheels' speeds behind one interface: from desired wheel speeds to commanded ones.

``plain`` and ``ramp`` use no measurement; ``thesis`` is the PID on each wheel of
:mod:`terrain.control.danzi_pid`; ``traction`` is the controller of :mod:`terrain.control.traction`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from terrain.control.danzi_pid import DriveState, ThesisSettings, WheelPid, check_thesis, thesis_step
from terrain.control.pid import Gains
from terrain.control.slip_table import DRIVE_STATES
from terrain.control.traction import (
    MAX_STEP_S,
    TractionSettings,
    TractionState,
    TractionStatus,
    TractionTarget,
    WheelMotion,
    WheelReport,
    check_settings,
    traction_step,
    with_motor_driver,
)
from terrain.estimation.live import LiveEstimate
from terrain.kinematics.wheels import in_wheel_frame, point_velocity
from terrain.records import Array, SlipTarget
from terrain.robots import Robot
from terrain.slip import MIN_SPEED_MPS

PERIOD_S = 0.02
"""Time step of the control loop; assumed where the clock is not valid."""


def step_or_period(dt_s: float) -> float:
    """Return a time step, or :data:`PERIOD_S` where it is none of a control loop."""
    return dt_s if 0.0 < dt_s <= MAX_STEP_S else PERIOD_S


class WheelController(Protocol):
    """Turns desired wheel speeds into commanded ones, step by step."""

    def step(
        self,
        wheel_radps: Array,
        seen: WheelMotion,
        target: TractionTarget,
        slip_targets: Mapping[str, SlipTarget],
        dt_s: float,
    ) -> tuple[Array, WheelReport]:
        """Return the commanded rates (wheels,) and what was decided.

        Parameters
        ----------
        wheel_radps : (wheels,) desired
        seen : as estimated
        target, slip_targets : slips of the current terrain, of the traction controller and by drive state
        dt_s : since the step before; NaN where the clock is not valid
        """
        ...

    def reset_terrain(self) -> None:
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
        self._positions_m = robot.wheel_positions_m
        self._radius_m, self._steer_states = robot.wheel_radius_m, steer_states

    def observe(self, estimate: LiveEstimate | None, time_s: float) -> WheelMotion:
        """Return the motion at the wheels; NaN before the first estimate."""
        if estimate is None:
            return UNOBSERVED
        stale_s = estimate_age(estimate, time_s)
        seen = (
            estimate.wheel_speed_mps,
            estimate.slip_ratio,
            estimate.slip_std,
            estimate.mean[self._steer_states],
        )
        wheels = zip(self._positions_m, *(row.tolist() for row in seen), strict=True)
        motion = estimate.speed_x_mps, estimate.speed_y_mps, estimate.yaw_rate_radps
        columns = []
        for (x_m, y_m), wheel_speed, slip, std, steer_rad in wheels:
            cos, sin = math.cos(steer_rad), math.sin(steer_rad)
            speed, _ = in_wheel_frame(*point_velocity(*motion, x_m, y_m), cos, sin)
            accel = estimate.accel_x_mps2 * cos + estimate.accel_y_mps2 * sin
            fastest = abs(speed) if abs(wheel_speed) <= abs(speed) else abs(wheel_speed)  # NaN too
            # a wheel stands by the filter's rate, which differs a little from the measured one
            standing = fastest < (2.0 if math.isnan(slip) else 1.0) * MIN_SPEED_MPS
            slip = 0.0 if standing and not math.isinf(stale_s) else slip
            columns.append((speed, accel, slip, 0.0 if standing else std))
        torque_nm = estimate.current_a * self._torque_per_amp_nm
        chassis_mps = math.hypot(estimate.speed_x_mps, estimate.speed_y_mps)
        rates = estimate.wheel_speed_mps / self._radius_m
        speed_mps, accel_mps2, slip_ratio, slip_std = np.array(columns).T
        return WheelMotion(
            speed_mps, accel_mps2, slip_ratio, slip_std, torque_nm, rates, chassis_mps, stale_s
        )


_UNKNOWN = np.full(3, math.nan)
UNOBSERVED = WheelMotion(_UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN, math.nan, math.inf)
"""Before the first estimate."""


def largest_forward(wheel_radps: Array, slip_ratio: Array) -> float:
    """Return the largest slip of the wheels, positive in traction in the desired direction; NaN where one is."""
    return float(np.where(wheel_radps < 0.0, -slip_ratio, slip_ratio).max())


def estimate_age(estimate: LiveEstimate, time_s: float) -> float:
    """Return the time since the speed over ground was measured last."""
    return estimate.reference_age_s + max(time_s - estimate.time_s, 0.0)


class RampController:
    """Desired speeds, with a bounded rise of the fastest wheel's speed, and no measurement.

    Parameters
    ----------
    radius_m : of the wheels
    ramp_mps2 : largest rise; infinite for none
    """

    def __init__(self, radius_m: float, ramp_mps2: float = math.inf) -> None:
        self._radius_m, self._ramp_mps2 = radius_m, ramp_mps2
        self._wheel, self._driven_mps = np.zeros(3), 0.0

    def step(
        self,
        wheel_radps: Array,
        seen: WheelMotion,
        target: TractionTarget,
        slip_targets: Mapping[str, SlipTarget],
        dt_s: float,
    ) -> tuple[Array, WheelReport]:
        """Return the commanded rates (wheels,) and what was decided."""
        desired_mps = max(map(abs, wheel_radps.tolist())) * self._radius_m
        before_mps = self._driven_mps if float(wheel_radps @ self._wheel) >= 0.0 else 0.0
        rise_mps = self._ramp_mps2 * step_or_period(dt_s)
        self._wheel, self._driven_mps = wheel_radps, min(desired_mps, before_mps + rise_mps)
        command = wheel_radps * (self._driven_mps / desired_mps) if desired_mps > 0.0 else wheel_radps
        unknown = math.nan
        return command, WheelReport(
            self._driven_mps, unknown, unknown, unknown, DriveState.STEADY, TractionStatus.OK
        )

    def reset_terrain(self) -> None:
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
        self._radius_m, self._state = robot.wheel_radius_m, TractionState()

    def step(
        self,
        wheel_radps: Array,
        seen: WheelMotion,
        target: TractionTarget,
        slip_targets: Mapping[str, SlipTarget],
        dt_s: float,
    ) -> tuple[Array, WheelReport]:
        """Return the commanded rates (wheels,) and what was decided."""
        command, self._state, report = traction_step(
            self._settings, self._state, target, self._radius_m, wheel_radps, seen, dt_s
        )
        return command, report

    def reset_terrain(self) -> None:
        """Drop the balance of steady motion and the floor of the target."""
        self._state = self._state.on_other_terrain()


class ThesisController:
    """The thesis' PID of slip on each wheel.

    Parameters
    ----------
    robot : swerve robot
    gains : of :class:`terrain.control.danzi_pid.ThesisSettings`
    stale_max_s : an older speed over ground is not used
    """

    def __init__(self, robot: Robot, gains: Gains, stale_max_s: float) -> None:
        self._settings = check_thesis(ThesisSettings(robot.wheel_radius_m, gains))
        self._stale_max_s, self._state = stale_max_s, [WheelPid()] * len(robot.wheels)

    def step(
        self,
        wheel_radps: Array,
        seen: WheelMotion,
        target: TractionTarget,
        slip_targets: Mapping[str, SlipTarget],
        dt_s: float,
    ) -> tuple[Array, WheelReport]:
        """Return the commanded rates (wheels,) and what was decided."""
        wheels, self._state = thesis_step(
            self._settings,
            self._state,
            wheel_radps,
            seen.wheel_radps,
            UNOBSERVED.speed_mps if seen.stale_s > self._stale_max_s else seen.speed_mps,
            seen.accel_mps2,
            seen.chassis_mps,
            [slip_targets[state].slip_ratio for state in DRIVE_STATES],
            dt_s,
        )
        desired = np.array([one.desired_ratio for one in wheels])
        status = TractionStatus.OK if np.isfinite(desired).all() else TractionStatus.NO_SLIP
        if not 0.0 < dt_s <= MAX_STEP_S:
            status = TractionStatus.BAD_TIME
        command = wheel_radps + np.array([one.correction_radps for one in wheels])
        driven_mps = float(np.abs(command).max()) * self._settings.wheel_radius_m
        aimed, largest = (largest_forward(wheel_radps, slips) for slips in (desired, seen.slip_ratio))
        return command, WheelReport(driven_mps, aimed, math.nan, largest, wheels[0].drive_state, status)

    def reset_terrain(self) -> None:
        """Do nothing: nothing of the terrain is learned."""
