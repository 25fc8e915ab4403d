"""Slip of each wheel from what a filter estimates, with its standard deviation, and a run's in a few figures.

The definition of the slip ratio is :func:`terrain.slip.slip_ratio`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.errors import DataError
from terrain.estimation.feed import UNMEASURED_AFTER_S, MeasurementTable, places_among
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
LONGEST_S = 1e300  #: Age of a speed over ground that was measured at any time.


class WheelSlip:
    """The slip of each wheel of a robot from the state of a filter.

    Parameters
    ----------
    robot : places and radius of the wheels
    states : of any filter of a swerve robot: ``speed_x_mps``, ``speed_y_mps``, ``yaw_rate_radps`` and
        ``steer_<i>_rad``; ``DataError`` where one is missing
    blind : whether the slip is that by the encoders and the filter's speed, whether or not it ever measured that over
        ground.  Without such a sensor a filter takes the wheels' speed for the robot's, and the figure is close to 0 on
        any ground (thesis 4.6)

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

    def __init__(self, robot: Robot, states: tuple[str, ...], blind: bool = False) -> None:
        names = ["speed_x_mps", "speed_y_mps", "yaw_rate_radps", *robot.steer_rows]
        for name in names:
            if name not in states:
                raise DataError(f"the track has no state {name!r}, only {', '.join(states)}")
        slips = list(map("slip_speed_{}_mps".format, robot.wheels))
        self._oldest_s = math.inf if blind else (LONGEST_S if slips[0] in states else STALE_AFTER_S)
        names += [""] * len(slips) if blind else slips
        self._places, self._positions_m = places_among(names, states), np.array(robot.wheel_positions_m)
        self._variance = wheel_speed_scatter_mps(robot) ** 2

    def __call__(
        self, mean: Array, cov: Array, wheel_speed_mps: Array, age_s: Array, unmeasured_s: Array
    ) -> tuple[Array, Array]:
        """Return slip and standard deviation (n, wheels); unless blind NaN where something is not known.

        Parameters
        ----------
        mean, cov : (n, d) and (n, d, d) of the state
        wheel_speed_mps : (n, wheels) as measured
        age_s : (n,) time since the speed over ground was measured
        unmeasured_s : (n, wheels) time since rate and angle of a wheel were
        """
        slip = np.full((2, *wheel_speed_mps.shape), np.nan)
        known = (age_s <= self._oldest_s)[:, None] & ~(unmeasured_s > UNMEASURED_AFTER_S)
        if known.any() or self._oldest_s == math.inf:
            speeds = np.ascontiguousarray(wheel_speed_mps)
            _slips(
                np.array(mean), np.array(cov), self._positions_m, self._places, speeds, self._variance, slip
            )
        if self._oldest_s < math.inf:
            slip[:, ~known] = np.nan
        return slip[0], slip[1]


def wheel_slip(track: StateTrack, table: MeasurementTable, robot: Robot, blind: bool = False) -> SlipTrack:
    """Return :class:`WheelSlip` of a log.

    ``table`` is what the filter measured, on the same clock; ``DataError`` if not, or if a state or a row is missing.
    """
    if not np.array_equal(track.time_s, table.time_s):
        raise DataError("the track and the measurements are not on one clock: filter this table")
    time_s = table.time_s[:, None]
    unmeasured_s = np.zeros((len(time_s), len(robot.wheels)))
    for rows in (robot.wheel_rows, robot.steer_rows):
        measured_s = np.where(np.isfinite(table.columns(rows)), time_s, -np.inf)
        unmeasured_s = np.maximum(unmeasured_s, time_s - np.maximum.accumulate(measured_s, axis=0))
    speeds, age_s = robot.wheel_speeds_mps(table.columns(robot.wheel_rows)), track.reference_age_s
    slip = WheelSlip(robot, track.states, blind)(track.mean, track.cov, speeds, age_s, unmeasured_s)
    channels = tuple(map("slip_{}_ratio".format, robot.wheels))
    return SlipTrack(track.time_s, *slip, channels, age_s > STALE_AFTER_S)


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
    """Write ratio and standard deviation (2, n, wheels) of the slip of n instants.

    ``places`` say where the state has speeds, yaw rate, steering angles and slip speeds, -1 for what is none; where it
    has no slip speeds, ``wheel_speed_mps`` (n, wheels) holds.
    """
    n_wheels = positions_m.shape[0]
    states, slopes = np.empty(5, np.int64), np.empty(5)
    for k in range(mean.shape[0] * n_wheels):
        n, i = k // n_wheels, k % n_wheels
        state = mean[n]
        states[0], states[1], states[2] = places[0], places[1], places[2]
        states[3], states[4] = places[3 + i], places[3 + n_wheels + i]
        x, y = positions_m[i, 0], positions_m[i, 1]
        ahead, left = point_velocity(state[states[0]], state[states[1]], state[states[2]], x, y)
        cos, sin = np.cos(state[states[3]]), np.sin(state[states[3]])
        ground, sideways = in_wheel_frame(ahead, left, cos, sin)
        in_state = states[4] >= 0
        wheel_speed = ground + state[states[4]] if in_state else wheel_speed_mps[n, i]
        traction = abs(wheel_speed) >= abs(ground)
        fastest = wheel_speed if traction else ground
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
        slip[0, n, i] = min(max((wheel_speed - ground) / size, -1.0), 1.0)
        slip[1, n, i] = np.sqrt(max(variance, 0.0))


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
    change = np.empty(speed.size)
    for k in range(speed.size):
        change[k] = np.ptp(speed[first[k] : last[k]])
    started = slip.time_s - slip.time_s[:1] >= STEADY_BEFORE_S - 1e-9
    moving = speed > STEADY_SPEED_MPS
    steady = moving & started & (change < STEADY_CHANGE_MPS)
    ratio = slip.mean if rolling is None else slip.mean * rolling
    known = np.isfinite(ratio)
    in_steady, transient = ratio[known & steady[:, None]], ratio[known & (moving & ~steady)[:, None]]
    mean = float(in_steady.mean()) if in_steady.size else math.nan
    peak = float(np.abs(transient).max()) if transient.size else math.nan
    return SlipFigures(read_only(steady, np.bool_), mean, peak)
