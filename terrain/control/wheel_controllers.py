"""Controllers of the wheels' speeds behind one interface: from desired wheel speeds to commanded ones.

``plain`` and ``ramp`` use no measurement; ``thesis`` is the PID on each wheel of :mod:`terrain.control.pid`;
``traction`` is the controller of :mod:`terrain.control.traction`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from terrain.control.pid import LONGEST_STEP_S, DriveState, Gains, WheelPid, check_gains, wheel_step
from terrain.control.slip_table import DRIVE_STATES
from terrain.control.traction import (
    TractionSettings,
    TractionState,
    TractionStatus,
    TractionTarget,
    WheelMotion,
    WheelReport,
    check_settings,
    traction_step,
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
    return dt_s if 0.0 < dt_s <= LONGEST_STEP_S else PERIOD_S


_UNKNOWN = np.full(3, math.nan)
UNOBSERVED = WheelMotion(_UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN, math.nan, math.inf)
"""Before the first estimate."""


def observe_wheels(
    robot: Robot, steer_states: Array, estimate: LiveEstimate | None, time_s: float
) -> WheelMotion:
    """Return the motion along each wheel from an estimate of the robot's motion; NaN before the first one.

    Parameters
    ----------
    robot : swerve robot with motors
    steer_states : (wheels,) places of the steering angles among the estimate's states
    estimate, time_s : the last one, and the time of the step
    """
    if estimate is None:
        return UNOBSERVED
    motors, stale_s = robot.equipment.motors, estimate_age(estimate, time_s)
    steer = estimate.mean[steer_states]
    rows = estimate.wheel_speed_mps, estimate.slip_ratio, estimate.slip_std, steer
    motion = estimate.speed_x_mps, estimate.speed_y_mps, estimate.yaw_rate_radps
    columns = []
    for (x_m, y_m), wheel_speed, slip, std, steer_rad in zip(
        robot.wheel_positions_m, *(row.tolist() for row in rows), strict=True
    ):
        cos, sin = math.cos(steer_rad), math.sin(steer_rad)
        speed, _ = in_wheel_frame(*point_velocity(*motion, x_m, y_m), cos, sin)
        accel = estimate.accel_x_mps2 * cos + estimate.accel_y_mps2 * sin
        fastest = abs(speed) if abs(wheel_speed) <= abs(speed) else abs(wheel_speed)  # NaN too
        # a wheel stands by the filter's rate, which differs a little from the measured one
        standing = fastest < (2.0 if math.isnan(slip) else 1.0) * MIN_SPEED_MPS
        slip = 0.0 if standing and not math.isinf(stale_s) else slip
        columns.append((speed, accel, slip, 0.0 if standing else std))
    speed_mps, accel_mps2, slip_ratio, slip_std = np.array(columns).T
    return WheelMotion(
        speed_mps,
        accel_mps2,
        slip_ratio,
        slip_std,
        torque_nm=estimate.current_a
        * (motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio),
        wheel_radps=estimate.wheel_speed_mps / robot.wheel_radius_m,
        chassis_mps=math.hypot(estimate.speed_x_mps, estimate.speed_y_mps),
        stale_s=stale_s,
    )


def largest_forward(wheel_radps: Array, slip_ratio: Array) -> float:
    """Return the largest slip of the wheels, positive in traction in the desired direction; NaN where one is."""
    return float(np.where(wheel_radps < 0.0, -slip_ratio, slip_ratio).max())


def estimate_age(estimate: LiveEstimate, time_s: float) -> float:
    """Return the time since the speed over ground was measured last."""
    return estimate.reference_age_s + max(time_s - estimate.time_s, 0.0)


class WheelController:
    """Turns desired wheel speeds into commanded ones, step by step.

    Parameters
    ----------
    name : ``plain``, ``ramp``, ``thesis`` or ``traction``
    robot : swerve robot
    ramp_mps2 : largest rise of the speed of the fastest wheel, of ``ramp``
    traction : settings of ``traction``, checked for every controller; ``thesis`` uses no older speed over ground
    gains : of ``thesis``

    Raises
    ------
    ConfigError
        if a setting is not accepted.
    """

    def __init__(
        self, name: str, robot: Robot, ramp_mps2: float, traction: TractionSettings, gains: Gains
    ) -> None:
        self._name, self._radius_m = name, robot.wheel_radius_m
        self._traction = check_settings(traction, robot)
        self._gains = check_gains(gains) if name == "thesis" else gains
        self._ramp_mps2 = ramp_mps2 if name == "ramp" else math.inf
        self._state = TractionState()
        self._pids = [WheelPid()] * len(robot.wheels)
        self._wheel_radps, self._driven_mps = np.zeros(3), 0.0

    def reset_terrain(self) -> None:
        """Drop what was learned of the terrain, as another one is classified: balance, and floor of the target."""
        self._state = self._state.on_other_terrain()

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
        if self._name == "traction":
            command, self._state, report = traction_step(
                self._traction, self._state, target, self._radius_m, wheel_radps, seen, dt_s
            )
            return command, report
        if self._name == "thesis":
            return self._thesis(wheel_radps, seen, slip_targets, dt_s)
        desired_mps = max(map(abs, wheel_radps.tolist())) * self._radius_m
        before_mps = self._driven_mps if float(wheel_radps @ self._wheel_radps) >= 0.0 else 0.0
        rise_mps = self._ramp_mps2 * step_or_period(dt_s)
        self._wheel_radps, self._driven_mps = wheel_radps, min(desired_mps, before_mps + rise_mps)
        command = wheel_radps * (self._driven_mps / desired_mps) if desired_mps > 0.0 else wheel_radps
        unknown = math.nan, math.nan, math.nan
        return command, WheelReport(self._driven_mps, *unknown, DriveState.STEADY, TractionStatus.OK)

    def _thesis(
        self, wheel_radps: Array, seen: WheelMotion, slip_targets: Mapping[str, SlipTarget], dt_s: float
    ) -> tuple[Array, WheelReport]:
        stale = seen.stale_s > self._traction.stale_max_s
        targets = [slip_targets[state].slip_ratio for state in DRIVE_STATES]
        columns = (wheel_radps, seen.wheel_radps, _UNKNOWN if stale else seen.speed_mps, seen.accel_mps2)
        gains, radius_m, rows = self._gains, self._radius_m, (column.tolist() for column in columns)
        steps = [
            wheel_step(gains, radius_m, state, command, rate, speed, accel, seen.chassis_mps, targets, dt_s)
            for state, command, rate, speed, accel in zip(self._pids, *rows, strict=True)
        ]
        wheels, self._pids = [step for step, _ in steps], [state for _, state in steps]
        desired = np.array([one.desired_ratio for one in wheels])
        status = TractionStatus.OK if np.isfinite(desired).all() else TractionStatus.NO_SLIP
        if not 0.0 < dt_s <= LONGEST_STEP_S:
            status = TractionStatus.BAD_TIME
        command = wheel_radps + np.array([one.correction_radps for one in wheels])
        driven_mps = float(np.abs(command).max()) * self._radius_m
        aimed, largest = (largest_forward(wheel_radps, slips) for slips in (desired, seen.slip_ratio))
        return command, WheelReport(driven_mps, aimed, math.nan, largest, wheels[0].drive_state, status)
