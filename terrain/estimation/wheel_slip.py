"""Slip of each wheel from what a filter estimates, with its standard deviation, and a run's in a few figures.

The definition of the slip ratio is :func:`terrain.slip.slip_ratio`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.estimation.feed import UNMEASURED_AFTER_S, MeasurementTable
from terrain.estimation.filter import Filter
from terrain.kernels import njit
from terrain.kinematics.wheels import in_wheel_frame, point_velocity
from terrain.records import Array, SlipTrack, StateTrack, read_only
from terrain.robots import Robot
from terrain.slip import MIN_SPEED_MPS

STEADY_SPEED_MPS = 0.2  #: Slower, 1 cm/s of error in the speed is over 5 % of slip.
#: Largest change of speed over :data:`STEADY_BEFORE_S` that counts as none: 0.1 m/s^2 asks for a hundredth of the
#: weight in traction, little beside what rolling on soft ground does.
STEADY_CHANGE_MPS = 0.1
#: How long the speed has to have been steady, for transients to have died out, and how long it has to remain so, for
#: the start of a braking not to count before it shows.
STEADY_BEFORE_S, STEADY_AFTER_S = 1.0, 0.25
#: Age of the last speed over ground beyond which slip counts as stale: one and a half periods of GNSS, at 10 Hz the
#: slowest sensor of it, so that no sound one is called so; a 1 m/s^2 start gains 0.15 m/s unseen.
STALE_AFTER_S = 0.15


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
    if f"slip_speed_{robot.wheels[0]}_mps" not in track.states:
        unseen = unseen | slip.stale
    unknown = np.repeat(unseen[:, None], len(robot.wheels), axis=1)
    for i, row in enumerate(robot.wheel_rows):  # a wheel whose rate or angle was not measured for long
        measured = np.isfinite(table.columns([row, *robot.steer_rows[i : i + 1]]))
        last_s = np.maximum.accumulate(np.where(measured, table.time_s[:, None], -np.inf), axis=0)
        unknown[:, i] |= (table.time_s[:, None] - last_s > UNMEASURED_AFTER_S).any(axis=1)
    ratio, std = (np.where(unknown, np.nan, v) for v in (slip.slip_ratio, slip.slip_std))
    return SlipTrack(slip.time_s, ratio, std, slip.wheels, slip.stale)


def blind_slip(track: StateTrack, table: MeasurementTable, robot: Robot) -> SlipTrack:
    """Return the slip by encoders and a filter's speed, whether or not it ever measured that over ground.

    For showing what a filter without such a sensor is blind to: it takes the wheels' speed for the robot's,
    and the figure is close to 0 on any ground (thesis 4.6).  :func:`wheel_slip`, for use, gives NaN there.
    """
    return _slip(track, table, robot, None, from_encoders=True)


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
    places = _places(robot, track.states, from_encoders)
    wheel_speed = np.ascontiguousarray(robot.wheel_speeds_mps(table.columns(robot.wheel_rows)))
    std_mps = wheel_speed_scatter_mps(robot) if wheel_speed_std_mps is None else wheel_speed_std_mps
    slip = np.empty((track.time_s.size, 2, len(robot.wheels)))
    positions = np.array(robot.wheel_positions_m)
    _slips(np.array(track.mean), np.array(track.cov), positions, places, wheel_speed, std_mps**2, slip)
    stale = track.reference_age_s > STALE_AFTER_S
    return SlipTrack(track.time_s, slip[:, 0], slip[:, 1], robot.wheels, stale)


class SlipOfInstant:
    """The slip of each wheel of a robot at the last step of a filter with some states: :func:`wheel_slip`, live."""

    def __init__(self, robot: Robot, states: tuple[str, ...]) -> None:
        self._robot, self._positions_m = robot, np.array(robot.wheel_positions_m)
        self._has_slip_speed = f"slip_speed_{robot.wheels[0]}_mps" in states
        self._places = _places(robot, states) if robot.steered else np.empty(0, np.int64)
        self._variance = wheel_speed_scatter_mps(robot) ** 2

    def at(self, time_s: float, session: Filter, rows: Array, feed: Array) -> tuple[Array, Array]:
        """Return slip and standard deviation (wheels,) at a tick, of the row (1, n) of a feed and its memory."""
        slip, age_s = np.full((1, 2, len(self._robot.wheels)), np.nan), session.reference_age_s
        if not math.isinf(age_s) and (age_s <= STALE_AFTER_S or self._has_slip_speed):
            speeds = self._robot.wheel_speeds_mps(rows[:, : len(self._robot.wheels)])
            mean, cov = session.mean[None], np.ascontiguousarray(session.cov)[None]
            _slips(mean, cov, self._positions_m, self._places, speeds, self._variance, slip)
            received_s = feed["received_s"][0].min(axis=0)
            slip[0, :, time_s - received_s > UNMEASURED_AFTER_S] = np.nan
        return slip[0, 0], slip[0, 1]


def _places(robot: Robot, states: tuple[str, ...], from_encoders: bool = False) -> Array:
    """Return where speeds, yaw rate, steering angles and slip speeds stand among states, -1 for what is none."""
    speed = "speed_mps" if "speed_mps" in states else "speed_x_mps"
    needed = [speed, "yaw_rate_radps", *(["speed_y_mps"] if robot.steered else []), *robot.steer_rows]
    for name in needed:
        if name not in states:
            raise DataError(f"the track has no state {name!r}, only {', '.join(states)}")
    slips = [f"slip_speed_{wheel}_mps" for wheel in robot.wheels]
    names = [speed, "speed_y_mps", "yaw_rate_radps", *(f"steer_{wheel}_rad" for wheel in robot.wheels)]
    names += ["" if from_encoders else name for name in slips]
    return np.array([states.index(name) if name in states else -1 for name in names])


@njit(error_model="numpy")
def _slips(
    mean: Array,
    cov: Array,
    positions_m: Array,
    places: Array,
    wheel_speed_mps: Array,
    wheel_speed_variance: float,
    slip: Array,
) -> None:
    """Write ratio and standard deviation (n, 2, wheels) of the slip of n instants.

    ``places`` say where the state has what :func:`_places` names; where it has no slip speeds,
    ``wheel_speed_mps`` (n, wheels) holds.
    """
    n_wheels = positions_m.shape[0]
    states, slopes = np.empty(5, np.int64), np.empty(5)
    for k in range(mean.shape[0] * n_wheels):
        n, i = k // n_wheels, k % n_wheels
        state = mean[n]
        states[0], states[1], states[2] = places[0], places[1], places[2]
        states[3], states[4] = places[3 + i], places[3 + n_wheels + i]
        x, y = positions_m[i, 0], positions_m[i, 1]
        across = state[states[1]] if states[1] >= 0 else 0.0
        steer = state[states[3]] if states[3] >= 0 else 0.0
        ahead, left = point_velocity(state[states[0]], across, state[states[2]], x, y)
        cos, sin = np.cos(steer), np.sin(steer)
        ground, sideways = in_wheel_frame(ahead, left, cos, sin)
        in_state = states[4] >= 0
        wheel_speed = ground + state[states[4]] if in_state else wheel_speed_mps[n, i]
        traction = abs(wheel_speed) >= abs(ground)
        fastest = wheel_speed if traction else ground
        slip[n, 0, i] = slip[n, 1, i] = np.nan
        if not (abs(fastest) >= MIN_SPEED_MPS and np.isfinite(wheel_speed)):
            continue
        size, sign = abs(fastest), np.sign(fastest)
        by_wheel_speed = sign * ground / fastest**2 if traction else 1.0 / size
        by_ground = -1.0 / size if traction else -sign * wheel_speed / fastest**2
        # a wheel speed that is in the state follows from the state's ground speed, too
        along = by_wheel_speed + by_ground if in_state else by_ground
        slopes[0], slopes[1], slopes[2] = along * cos, along * sin, along * (x * sin - y * cos)
        slopes[3], slopes[4] = along * sideways, by_wheel_speed
        variance = 0.0 if in_state else by_wheel_speed**2 * wheel_speed_variance
        for j in range(5):
            for m in range(5):
                if states[j] >= 0 and states[m] >= 0:
                    variance += slopes[j] * cov[n, states[j], states[m]] * slopes[m]
        slip[n, 0, i] = min(max((wheel_speed - ground) / size, -1.0), 1.0)
        slip[n, 1, i] = np.sqrt(max(variance, 0.0))


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


class SlipFigures(NamedTuple):
    """Slip of a run in a few figures, ratios; NaN where there was nothing to take them from."""

    steady: Array  #: (n,) where the robot drove steadily
    steady_mean: float  #: over all wheels then
    peak: float  #: largest absolute slip of any wheel while the robot moved and not steadily


def slip_figures(
    slip: SlipTrack, speed_mps: Array, time_s: Array, rolling: Array | None = None
) -> SlipFigures:
    """Return the figures of a run: steady slip, and the peak of its transients.

    Parameters
    ----------
    slip : of a filter; stale samples count as long as they are no NaN
    speed_mps, time_s : (k,) speed of the robot, on any clock
    rolling : (n, wheels) -1 where a wheel rolls backward, else 1: means are of slip positive in traction
        then, so that driving forward and backward does not cancel; without, slip counts as it is

    Notes
    -----
    Steady is faster than :data:`STEADY_SPEED_MPS`, with a speed that stays within :data:`STEADY_CHANGE_MPS`
    from :data:`STEADY_BEFORE_S` before to :data:`STEADY_AFTER_S` after.
    """
    known = np.isfinite(speed_mps)
    speed = np.full(slip.time_s.size, np.nan)
    if known.any():
        speed = np.abs(np.interp(slip.time_s, time_s[known], speed_mps[known], left=np.nan, right=np.nan))
    first = np.searchsorted(slip.time_s, slip.time_s - STEADY_BEFORE_S - 1e-9)
    last = np.searchsorted(slip.time_s, slip.time_s + STEADY_AFTER_S + 1e-9)
    change = np.array([np.ptp(speed[a:b]) for a, b in zip(first, last, strict=True)])
    started = slip.time_s - slip.time_s[:1] >= STEADY_BEFORE_S - 1e-9
    moving = speed > STEADY_SPEED_MPS
    steady = moving & started & (change < STEADY_CHANGE_MPS)
    ratio = slip.slip_ratio if rolling is None else slip.slip_ratio * rolling
    peak = _of_known(np.max, np.abs(ratio[moving & ~steady]))
    return SlipFigures(read_only(steady, np.bool_), _of_known(np.mean, ratio[steady]), peak)


def _of_known(statistic: Callable[[Array], Any], slip: Array) -> float:
    known = slip[np.isfinite(slip)]
    return float(statistic(known)) if known.size else math.nan
