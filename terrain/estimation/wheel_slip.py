"""Slip of each wheel from what a filter estimates, with its standard deviation.

The definition of the slip ratio is :func:`terrain.slip.slip_ratio`.
"""

from __future__ import annotations

import numpy as np
from numba import float64, int64, njit, void

from terrain.errors import DataError
from terrain.estimation.measurements.table import MeasurementTable
from terrain.kinematics.wheel_velocity import in_wheel_frame, point_velocity
from terrain.records import Array, SlipTrack, StateTrack
from terrain.robots import Robot
from terrain.slip import MIN_SPEED_MPS, slip_ratio

STALE_AFTER_S = 0.15
"""Age of the last speed over ground beyond which slip counts as stale: one and a half periods of GNSS, at 10
Hz the slowest sensor of it, so that no sound one is called so; a 1 m/s^2 start gains 0.15 m/s unseen."""

UNMEASURED_AFTER_S = 0.5
"""After this time without a rate or an angle, the motion of a wheel is unknown."""


def wheel_slip(
    track: StateTrack, table: MeasurementTable, robot: Robot, wheel_speed_std_mps: float | None = None
) -> SlipTrack:
    """Return the slip of each wheel by what a filter believes; NaN unless it measured the speed over ground.

    Parameters
    ----------
    track : of any filter with the states ``speed_x_mps`` (or ``speed_mps``) and ``yaw_rate_radps``, and
        ``speed_y_mps`` and ``steer_<i>_rad`` where the robot can have them
    table : what the filter measured, on the same clock
    robot : places and radius of the wheels
    wheel_speed_std_mps : standard deviation of a wheel speed; by default that of the robot's file, unknown
        without

    Raises
    ------
    DataError
        if the clocks differ, or a state or a row is missing.

    Notes
    -----
    A filter with slip speeds l_i among its states (``slip_speed_<i>_mps``) gives
    ``s = l / max(|v + l|, |v|)`` from the state alone.  It goes on when the speed over ground is not measured
    for a while, ``stale`` and with the growing uncertainty of its state.  For any other the wheel speed is
    the encoders' own, no filter's (thesis 7.2); its slip falls to 0 of itself as soon as only the wheels hold
    the speed: NaN where stale.

    ``slip_std`` is to first order ``sqrt(g P g')`` with the state's whole covariance, and the wheel speed's
    variance added where that is not in the state.
    """
    slip = _slip(track, table, robot, wheel_speed_std_mps)
    unseen = np.isinf(track.reference_age_s)
    if not _has_slip_speed(track, robot):
        unseen = unseen | slip.stale
    unknown = unseen[:, None] | _unmeasured(table, robot)
    ratio, std = (np.where(unknown, np.nan, v) for v in (slip.slip_ratio, slip.slip_std))
    return SlipTrack(slip.time_s, ratio, std, slip.wheels, slip.stale)


def _unmeasured(table: MeasurementTable, robot: Robot) -> Array:
    """Return where (n, wheels) a wheel's rate or angle was not measured for :data:`UNMEASURED_AFTER_S`."""
    columns = []
    for i, row in enumerate(robot.wheel_rows):
        names = [row, *robot.steer_rows[i : i + 1]]
        measured = np.isfinite(table.columns(names))
        last_s = np.maximum.accumulate(np.where(measured, table.time_s[:, None], -np.inf), axis=0)
        columns.append((table.time_s[:, None] - last_s > UNMEASURED_AFTER_S).any(axis=1))
    return np.column_stack(columns)


def blind_slip(track: StateTrack, table: MeasurementTable, robot: Robot) -> SlipTrack:
    """Return the slip by encoders and a filter's speed, whether or not it ever measured that over ground.

    For showing what a filter without such a sensor is blind to: it takes the wheels' speed for the robot's,
    and the figure is close to 0 on any ground (thesis 4.6).  :func:`wheel_slip`, for use, gives NaN there.
    """
    return _slip(track, table, robot, None, from_encoders=True)


def _has_slip_speed(track: StateTrack, robot: Robot) -> bool:
    return f"slip_speed_{robot.wheels[0]}_mps" in track.states


def _slip(
    track: StateTrack,
    table: MeasurementTable,
    robot: Robot,
    wheel_speed_std_mps: float | None,
    from_encoders: bool = False,
) -> SlipTrack:
    """Slip and its standard deviation, measured over ground or not."""
    if not np.array_equal(track.time_s, table.time_s):
        raise DataError("the track and the measurements are not on one clock: filter this table")
    in_state = _has_slip_speed(track, robot) and not from_encoders
    ratio, std = np.full((2, track.time_s.size, len(robot.wheels)), np.nan)
    for i, wheel in enumerate(robot.wheels):
        ground, d_ground = _ground_speed(track, robot, i)
        if in_state:
            slip_speed = _state(track, f"slip_speed_{wheel}_mps")
            wheel_speed, d_wheel_speed, wheel_speed_variance = ground + slip_speed, d_ground.copy(), 0.0
            d_wheel_speed[:, track.states.index(f"slip_speed_{wheel}_mps")] += 1.0
        else:
            wheel_speed, d_wheel_speed = _wheel_speed(table, robot, i), np.zeros_like(d_ground)
            wheel_speed_variance = (
                wheel_speed_scatter_mps(robot) if wheel_speed_std_mps is None else wheel_speed_std_mps
            ) ** 2
        ratio[:, i] = slip_ratio(wheel_speed, ground)
        by_wheel_speed, by_ground = _slopes(wheel_speed, ground)
        gradient = by_wheel_speed[:, None] * d_wheel_speed + by_ground[:, None] * d_ground
        variance = (
            np.einsum("ni,nij,nj->n", gradient, track.cov, gradient)
            + by_wheel_speed**2 * wheel_speed_variance
        )
        std[:, i] = np.sqrt(np.maximum(variance, 0.0))
    return SlipTrack(track.time_s, ratio, std, robot.wheels, track.reference_age_s > STALE_AFTER_S)


def _state(track: StateTrack, name: str) -> Array:
    if name not in track.states:
        raise DataError(f"the track has no state {name!r}, only {', '.join(track.states)}")
    return track.state(name)


def _ground_speed(track: StateTrack, robot: Robot, wheel: int) -> tuple[Array, Array]:
    """Return the speed (n,) of a wheel's centre along it, (7.3)-(7.5), and its slopes (n, d) by the state."""
    x, y = robot.wheel_positions_m[wheel]
    speed_name = "speed_mps" if "speed_mps" in track.states else "speed_x_mps"
    steer_name = f"steer_{robot.wheels[wheel]}_rad"
    zero = np.zeros(track.time_s.size)
    across = _state(track, "speed_y_mps") if robot.steered else zero
    steer = _state(track, steer_name) if steer_name in robot.steer_rows else zero
    turn = _state(track, "yaw_rate_radps")
    ahead, left = point_velocity(_state(track, speed_name), across, turn, x, y)
    cos, sin = np.cos(steer), np.sin(steer)
    along, sideways = in_wheel_frame(ahead, left, cos, sin)
    slopes = {
        speed_name: cos,
        "speed_y_mps": sin,
        "yaw_rate_radps": x * sin - y * cos,
        steer_name: sideways,
    }
    gradient = np.zeros((track.time_s.size, len(track.states)))
    for name, slope in slopes.items():
        if name in track.states:
            gradient[:, track.states.index(name)] = slope
    return along, gradient


def _slopes(wheel_speed: Array, ground: Array) -> tuple[Array, Array]:
    """Return the derivatives of the slip ratio by the wheel speed and by the speed over ground."""
    traction = np.abs(wheel_speed) >= np.abs(ground)
    fastest = np.where(traction, wheel_speed, ground)
    fastest = np.where(np.abs(fastest) < MIN_SPEED_MPS, np.nan, fastest)
    sign = np.sign(fastest)
    by_wheel_speed = np.where(traction, sign * ground / fastest**2, 1.0 / np.abs(fastest))
    by_ground = np.where(traction, -1.0 / np.abs(fastest), -sign * wheel_speed / fastest**2)
    return by_wheel_speed, by_ground


@njit(
    void(float64[::1], float64[:, ::1], float64[:, ::1], int64[::1], float64[::1], float64, float64[:, ::1]),
    cache=True,
    error_model="numpy",
)
def instant_slip(
    mean: Array,
    cov: Array,
    places_m: Array,
    at: Array,
    wheel_speed_mps: Array,
    wheel_speed_variance: float,
    slip: Array,
) -> None:
    """Write ratio and standard deviation (2, wheels) of the slip of one instant: :func:`wheel_slip`, live.

    ``at`` says where in the state stand speed_x, speed_y, yaw rate, the steering angles and the slip speeds,
    the latter -1 where the state has none and ``wheel_speed_mps`` (wheels,) holds.
    """
    n = places_m.shape[0]
    states, slopes = np.empty(5, np.int64), np.empty(5)
    states[:3] = at[:3]
    for i in range(n):
        states[3], states[4] = at[3 + i], at[3 + n + i]
        x, y = places_m[i, 0], places_m[i, 1]
        turn = mean[at[2]]
        ahead, left = point_velocity(mean[at[0]], mean[at[1]], turn, x, y)
        cos, sin = np.cos(mean[states[3]]), np.sin(mean[states[3]])
        ground, sideways = in_wheel_frame(ahead, left, cos, sin)
        in_state = states[4] >= 0
        wheel_speed = ground + mean[states[4]] if in_state else wheel_speed_mps[i]
        traction = abs(wheel_speed) >= abs(ground)
        fastest = wheel_speed if traction else ground
        slip[:, i] = np.nan
        if not (abs(fastest) >= MIN_SPEED_MPS and np.isfinite(wheel_speed)):
            continue
        size, sign = abs(fastest), np.sign(fastest)
        by_wheel_speed = sign * ground / fastest**2 if traction else 1.0 / size
        by_ground = -1.0 / size if traction else -sign * wheel_speed / fastest**2
        along = (
            by_wheel_speed + by_ground if in_state else by_ground
        )  # the wheel speed follows from the state's ground speed too
        slopes[0], slopes[1], slopes[2] = along * cos, along * sin, along * (x * sin - y * cos)
        slopes[3], slopes[4] = along * sideways, by_wheel_speed
        variance = 0.0 if in_state else by_wheel_speed**2 * wheel_speed_variance
        for j in range(4 + in_state):
            for k in range(4 + in_state):
                variance += slopes[j] * cov[states[j], states[k]] * slopes[k]
        slip[0, i] = min(max((wheel_speed - ground) / size, -1.0), 1.0)
        slip[1, i] = np.sqrt(max(variance, 0.0))


def _wheel_speed(table: MeasurementTable, robot: Robot, wheel: int) -> Array:
    return robot.wheel_speeds_mps(table.columns([robot.wheel_rows[wheel]])[:, 0])


def wheel_speed_scatter_mps(robot: Robot) -> float:
    """Return the scatter of a wheel speed: the motor noise and the ripple of Hall steps; NaN where unknown.

    Each step of the wheel by ``2 pi / steps`` raises the low-passed rate of the motor driver by that over its
    time constant, and until the next it falls again: a saw-tooth of standard deviation height / sqrt(12).
    """
    if not robot.describes("sensors", "motors"):
        return float("nan")
    sensors, motors = robot.sensors, robot.motors
    noise = sensors.motor_std_radps / motors.reduction_ratio
    step_rad = 2 * np.pi / (sensors.hall_steps_ratio * motors.reduction_ratio)
    lag_s = sensors.encoder_time_constant_s
    ripple = step_rad / lag_s / np.sqrt(12.0) if lag_s > 0 else 0.0
    return float(np.hypot(noise, ripple) * robot.wheel_radius_m)
