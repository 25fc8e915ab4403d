"""Sideslip and cornering stiffness of a car-like robot: one model, of which three observers are settings.

With the speed u of the rear axle along the body (what its wheel measures: u = v cos b_R for the speed v of the
papers), yaw rate r, lateral velocity w of the centre of mass, steering angle d, wheelbase L, and s the sign of u, the
slip angles of the axles are::

    tan(d + s b_F) = (w + L_F r) / u      tan(s b_R) = (w - L_R r) / u                               (4)

State: pose of the rear axle, r L / u and w / u, which stay what they are while the robot stands, and the cornering
stiffness of the axles over the nominal one, their mean and half their difference.  The pose moves by u, r and the
lateral speed w - L_R r of the rear axle, which are lines 2 and 3 of (2) without a path: (2) is singular where
1 - c(s) y = 0, and on a straight path both are the same.  Motion follows the slip angles of the moment, or dynamics,
with the roll a of the slope::

    b' = n                                                                      kinematic (5)
    r' = (L_R C_R b_R - L_F C_F b_F cos d) / I_z                                dynamic (3)
    w' = -(C_F b_F cos d + C_R b_R) / m - g sin a - u r
    C' = n                                                                      while side forces show it

========================  =======  ==========================================
setting                   motion   measured
========================  =======  ==========================================
``sideslip-kinematic``    (5)      fixes of the pose
``sideslip-dynamic``      (3)      yaw rate, lateral specific force; fixes correct the pose alone
``sideslip-multi``        (3)      all of them
========================  =======  ==========================================

The dynamics take a linearly implicit step (1 - h A)^-1 h f: the poles of (r, w), about -2C/(m u), are far faster than
any tick at low speed.  Below 0.3 m/s they say nothing (an observer that divides by u there diverges, Figs. 5 and 6 of
Deremetz et al.), and slip angles and C are as they were.  Yaw rate and force show two combinations of w, C_F and C_R;
the third comes from the stiffness assumed at first, or from fixes.  C is the secant -F/b of a force that saturates,
and has to follow it down and up again; it is learned only while the lateral specific force u r + g sin a is above a
bound, and kept within physical limits.

A Kalman filter stands in place of the gains of Deremetz et al. (8), (9), which are in ``examples/papers``.

Sources: Deremetz et al., ICRA 2017; Lenain et al. 2010; Guillet et al. 2014.  Corrected: line 1 of (3) is the moment of
side forces F = -C b, stable for C > 0 ((1) prints F = C b).  Line 2 prints the sign of the forces and of
v cos b_R yaw' reversed: it then has an unstable eigenvalue for either sign of C.  Line 3 of (2) is the derivative of
theta~ (printed: of theta).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.estimation.filter import FilterModel, FilterSettings, differentiate
from terrain.estimation.models.observer import (
    LONGEST_STEP_S,
    FilterObserver,
    ObserverOutput,
    ObserverStatus,
)
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import BicycleRobot

ROWS = (
    *("speed_rear_mps", "steer_front_rad", "position_x_m", "position_y_m", "yaw_rad"),
    *("yaw_rate_radps", "roll_rad", "accel_y_mps2"),
)
SPEED, STEER, X, Y, YAW, RATE, ROLL, ACCEL = range(8)
"""Place of each row."""

SLIPS = ("slip_front_rad", "slip_rear_rad")

STANDING_MPS = 0.05
"""Slower is standing, as in :mod:`terrain.slip`."""
SLIP_MAX_RAD = 0.5
"""Bound of a slip angle, beyond any that a tyre's force rises up to."""
UNKNOWN_STD_RAD = 0.15
"""A slip that is less certain is not known."""
LOST_S = 1.0
"""Longer without a fix the pose is dead reckoning; longer without an IMU the dynamic slip is predicted."""
C_LOW_NPR, C_HIGH_RATIO = 1000.0, 2.0
"""Least cornering stiffness of an axle, which at a slip of 0.5 rad carries 500 N; largest over the nominal one."""
FASTEST_MPS, FASTEST_RADPS, MOST_MPS2 = 60.0, 20.0, 50.0
"""More than a car, its gyro and its accelerometer measure."""
POSITION_STD_M, YAW_STD_RAD, GYRO_STD_RADPS, ACCEL_STD_MPS2 = 0.02, 0.005, 0.003, 0.1
"""Of a fix along an axis, and of samples."""
SLIP_WALK_RADPS = 0.02
"""Change of a slip angle within a second without dynamics."""
TURN_WALK_RADPS2, SIDE_WALK_MPS2 = 0.1, 4.0
"""What the model lacks of r and w within a second; the lag of a tyre that rolls into its slip is in it, which would
otherwise be taken for a softer tyre."""
STIFFNESS_STD_RATIO, STIFFNESS_WALK_RATIO, STIFFNESS_CORRELATION = 0.3, 0.13, 0.8
"""Of the nominal cornering stiffness: at first, its change within a second, and of both between the axles."""
EXCITED_MPS2 = 1.0
"""Least lateral specific force for learning C."""
RESET_S = 1.0
"""Time for which fixes have to be rejected before the pose begins anew."""
POSITION_WALK_M, YAW_WALK_RAD = 0.01, 0.002
"""Change of the pose within a second beside the motion of the model."""
SLIP_ERROR_RAD = 0.03
"""Of a slip angle that no fix corrects: what the pose that is carried on is off by."""
FIRST_STD = (0.07, 0.05)
"""Of r L / u and w / u at first: slip angles of three degrees."""
_GATE_PROBABILITY = 1.0 - 2e-9  # six standard deviations
_STATES = (
    *("position_x_m", "position_y_m", "yaw_rad", "turn_ratio", "sideslip_ratio"),
    *("stiffness_ratio", "stiffness_difference_ratio"),
)


class SideslipSettings(NamedTuple):
    """Which of the three observers it is: the columns of the table of this module."""

    by_dynamics: bool = True
    by_fixes: bool = True
    by_imu: bool = True
    slowest_mps: float = 0.3  #: below which there are no dynamics


SETTINGS = {
    "sideslip-kinematic": SideslipSettings(by_dynamics=False, by_imu=False),
    "sideslip-dynamic": SideslipSettings(by_fixes=False),
    "sideslip-multi": SideslipSettings(),
}
"""The three observers by name."""

# Places in `params`: those of the robot, and as inputs those of a tick.
_BASE, _AHEAD, _BEHIND, _MASS, _INERTIA, _C_FRONT, _C_REAR, _BY_FIXES = range(8)
_SPEED, _STEER, _ROLL, _SPEED_BEFORE, _STEER_BEFORE, _BY_DYNAMICS, _EXCITED = range(8, 15)
_INPUTS = ("speed", "steer", "roll", "speed_before", "steer_before", "by_dynamics", "is_excited")


@njit
def slip_angles(turn: float, side: float, steer: float, sign: float, params: Array) -> tuple[float, float]:
    """Return b_F and b_R of r L / u, w / u, the steering angle and the sign of the speed: (4)."""
    turn = turn / params[_BASE]
    front = math.atan(side + params[_BEHIND] * turn) - steer
    return sign * front, sign * math.atan(side - params[_AHEAD] * turn)


@njit
def force_rates(slip_f: float, slip_r: float, mean: float, half: float, params: Array) -> tuple[float, float]:
    """Return r' and the specific side force of the tyres, of slip angles and stiffness over the nominal one."""
    front = params[_C_FRONT] * (mean + half) * slip_f * math.cos(params[_STEER])
    rear = params[_C_REAR] * (mean - half) * slip_r
    turning = (params[_AHEAD] * rear - params[_BEHIND] * front) / params[_INERTIA]
    return turning, -(front + rear) / params[_MASS]


@njit
def _motion_after(x: Array, dt: float, params: Array) -> tuple[float, float]:
    """Return r L / u and w / u a tick later: of the same slip angles, or of the dynamics."""
    speed, base, steer = params[_SPEED], params[_BASE], params[_STEER]
    turn, side = x[3], x[4]
    sign = -1.0 if speed < 0.0 else 1.0
    if params[_BY_DYNAMICS] == 0.0:
        slip_f, slip_r = slip_angles(turn, side, params[_STEER_BEFORE], sign, params)
        rear = math.tan(sign * slip_r)
        turn = math.tan(min(max(steer + sign * slip_f, -1.4), 1.4)) - rear
        return turn, rear + params[_AHEAD] * turn / base
    faster = params[_SPEED_BEFORE] / speed
    turn, side = faster * turn, faster * side
    slip_f, slip_r = slip_angles(turn, side, steer, sign, params)
    turning, force = force_rates(slip_f, slip_r, x[5], x[6], params)
    pushed = force - GRAVITY_MPS2 * math.sin(params[_ROLL]) - speed * speed * turn / base
    # A, the derivative of (r', w') by (r, w), through that of the slip angles
    front_by_w = 1.0 / (abs(speed) * (1.0 + (side + params[_BEHIND] * turn / base) ** 2))
    rear_by_w = 1.0 / (abs(speed) * (1.0 + (side - params[_AHEAD] * turn / base) ** 2))
    r_by_front, w_by_front = force_rates(1.0, 0.0, x[5], x[6], params)
    r_by_rear, w_by_rear = force_rates(0.0, 1.0, x[5], x[6], params)
    front_by_r, rear_by_r = params[_BEHIND] * front_by_w, -params[_AHEAD] * rear_by_w
    a = 1.0 - dt * (r_by_front * front_by_r + r_by_rear * rear_by_r)
    b = -dt * (r_by_front * front_by_w + r_by_rear * rear_by_w)
    c = -dt * (w_by_front * front_by_r + w_by_rear * rear_by_r - speed)
    d = 1.0 - dt * (w_by_front * front_by_w + w_by_rear * rear_by_w)
    per_det = dt / (a * d - b * c)
    turn += per_det * (d * turning - b * pushed) * base / speed
    return turn, side + per_det * (a * pushed - c * turning) / speed


@njit
def _move(x: Array, dt: float, params: Array, x_next: Array) -> None:
    turn, side = _motion_after(x, dt, params)
    speed, base = params[_SPEED], params[_BASE]
    mean_turn = 0.5 * (x[3] + turn) / base
    lateral = speed * (0.5 * (x[4] + side) - params[_AHEAD] * mean_turn)
    middle = x[2] + 0.5 * dt * speed * mean_turn
    cos, sin = math.cos(middle), math.sin(middle)
    x_next[:] = x
    x_next[0] += dt * (speed * cos - lateral * sin)
    x_next[1] += dt * (speed * sin + lateral * cos)
    x_next[2] += dt * speed * mean_turn
    x_next[3], x_next[4] = turn, side


@njit
def _propagate(x: Array, dt: float, params: Array, x_next: Array, f: Array) -> None:
    differentiate(_move, x, dt, params, x_next, f)
    if params[_EXCITED] == 0.0:
        f[:5, 5:7] = 0.0
    if params[_BY_FIXES] == 0.0:
        f[:3, 3:7] = 0.0


@njit
def _measure(x: Array, _dt: float, params: Array, z: Array) -> None:
    z[:3] = x[:3]
    z[3] = params[_SPEED] * x[3] / params[_BASE]
    sign = -1.0 if params[_SPEED] < 0.0 else 1.0
    slip_f, slip_r = slip_angles(x[3], x[4], params[_STEER], sign, params)
    turning, force = force_rates(slip_f, slip_r, x[5], x[6], params)
    z[4] = force - params[_AHEAD] * turning


@njit
def _observe(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    differentiate(_measure, x, 0.0, params, z_hat, h)
    if params[_EXCITED] == 0.0:
        h[:, 5:7] = 0.0


@njit
def _outputs(x: Array, _dt: float, params: Array, y: Array) -> None:
    """Write pose, yaw rate, lateral velocity, cornering stiffness and slip angles of the axles."""
    y[:3] = x[:3]
    y[3], y[4] = params[_SPEED] * x[3] / params[_BASE], params[_SPEED] * x[4]
    y[5], y[6] = params[_C_FRONT] * (x[5] + x[6]), params[_C_REAR] * (x[5] - x[6])
    sign = -1.0 if params[_SPEED] < 0.0 else 1.0
    y[7], y[8] = slip_angles(x[3], x[4], params[_STEER], sign, params)


@njit
def _read(x: Array, params: Array) -> tuple[Array, Array]:
    y, by_x = np.empty(9), np.empty((9, 7))
    differentiate(_outputs, x, 0.0, params, y, by_x)
    return y, by_x


class Sideslip(FilterObserver):
    """An observer of sideslip of a car-like robot.

    Parameters
    ----------
    robot : car-like
    name : one of :data:`SETTINGS`
    settings : in place of those

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.estimation.models.observer import observe
    >>> time_s, slope = np.arange(200) * 0.02, np.full((200, 8), np.nan)
    >>> slope[:, [0, 1, 5, 6, 7]] = 3.0, 0.0, 0.0, 0.2, 9.81 * np.sin(0.2)  # straight along a slope
    >>> observe(Sideslip(load_robot("adap2e"), "sideslip-dynamic"), time_s, slope).slip[-1].round(2)
    array([-0.03, -0.03])
    """

    slips, rows = SLIPS, ROWS

    def __init__(self, robot: BicycleRobot, name: str, settings: SideslipSettings | None = None) -> None:
        self.settings = settings = SETTINGS[name] if settings is None else settings
        nominal = (robot.front_cornering_npr, robot.rear_cornering_npr)
        self._least_ratio = C_LOW_NPR / np.array(nominal)
        self._geometry_m = geometry = (robot.wheelbase_m, robot.com_ahead_m, robot.com_behind_front_m)
        axles = np.sqrt([0.5 + 0.5 * STIFFNESS_CORRELATION, 0.5 - 0.5 * STIFFNESS_CORRELATION])
        self._stiffness_walk = (STIFFNESS_WALK_RATIO * axles) ** 2
        model = FilterModel(
            name=name,
            states=_STATES,
            rows=(*ROWS[X : RATE + 1], ROWS[ACCEL]),
            sensors=(
                ("position", ROWS[X:YAW]),
                ("heading", (ROWS[YAW],)),
                ("gyro", (ROWS[RATE],)),
                ("force", (ROWS[ACCEL],)),
            ),
            propagate=_propagate,
            observe=_observe,
            params=np.array([*geometry, robot.mass_kg, robot.yaw_inertia_kgm2, *nominal, settings.by_fixes]),
            process_variance=np.zeros(7),
            measurement_variance=np.square(
                [POSITION_STD_M, POSITION_STD_M, YAW_STD_RAD, GYRO_STD_RADPS, ACCEL_STD_MPS2]
            ),
            initial_variance=np.square([1e4, 1e4, math.pi, *FIRST_STD, *(STIFFNESS_STD_RATIO * axles)]),
            initial_mean=np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
            inputs=_INPUTS,
            references=("position",),
            positions=_STATES[:2],
            angle_states=("yaw_rad",),
            angle_rows=("yaw_rad",),
        )
        super().__init__(model, FilterSettings(_GATE_PROBABILITY, RESET_S))
        motion = ("yaw_rate_radps", "speed_y_mps", "cornering_front_npr", "cornering_rear_npr")
        self.states = (*_STATES[:3], *(motion if settings.by_dynamics else ()))
        self._before: tuple[float, float] | None = None
        self._roll_rad, self._by_imu_alone = 0.0, settings.by_imu and not settings.by_fixes
        self._output = self._output_of(0.0, 0.0, ObserverStatus.STARTING)

    def step(self, row: Array, dt_s: float) -> ObserverOutput:
        """Take a row of :data:`ROWS`; a roll that was never measured is that of level ground.

        It has started where what the slip is seen by was measured: position and heading, or an IMU.
        """
        settings, mean, (base_m, ahead_m, behind_m) = self.settings, self.filter.mean, self._geometry_m
        speed, steer, *_, rate, roll, accel = row.tolist()
        size, sign = abs(speed), -1.0 if speed < 0.0 else 1.0
        if not (0.0 <= dt_s <= LONGEST_STEP_S and size < FASTEST_MPS and abs(steer) < 0.5 * math.pi):
            return self._hold(ObserverStatus.BAD_INPUT)
        if abs(roll) < 0.5 * math.pi:
            self._roll_rad = roll
        was_started = (self.age_s[2:].min() if self._by_imu_alone else self.age_s[:2].max()) < math.inf
        stands, moves = size < STANDING_MPS, size >= settings.slowest_mps
        if stands and self.age_s[:2].max() < math.inf:
            if was_started and self._output.status == ObserverStatus.STARTING:
                self._output = self._output_of(speed, steer, ObserverStatus.STANDING)
            return self._hold(ObserverStatus.STANDING if was_started else ObserverStatus.STARTING)
        z, by_dynamics = np.append(row[X:RATE], [math.nan, math.nan]), settings.by_dynamics and moves
        if settings.by_imu and moves:
            z[3] = rate if abs(rate) < FASTEST_RADPS else math.nan
            z[4] = accel if abs(accel) < MOST_MPS2 else math.nan
        force = speed * z[3] + GRAVITY_MPS2 * math.sin(self._roll_rad)
        is_excited = by_dynamics and abs(force) > EXCITED_MPS2
        if self._before is None:  # before the first tick there was no slip
            self._before = speed, steer
            mean[3:5] = np.array([1.0, ahead_m / base_m]) * math.tan(steer)
        speed_before, steer_before = self._before
        if not by_dynamics or not speed * speed_before > 0.0 or abs(speed_before) < settings.slowest_mps:
            speed_before = speed
        self._before = speed, steer
        inputs = (speed, steer, self._roll_rad, speed_before, steer_before, by_dynamics, is_excited)
        walk = np.zeros(7)  # as standard deviations, but of the stiffness
        if not stands:
            walk[:3] = (POSITION_WALK_M, POSITION_WALK_M, YAW_WALK_RAD)
            if not settings.by_fixes:
                walk[:3] += np.array([size, size, size / base_m]) * SLIP_ERROR_RAD
            arm = math.hypot(ahead_m, behind_m) / base_m
            walk[3:5] = math.sqrt(2.0) * SLIP_WALK_RADPS, arm * SLIP_WALK_RADPS
            if by_dynamics:
                walk[3:5] = TURN_WALK_RADPS2 * base_m / size, SIDE_WALK_MPS2 / size
            walk = np.square(walk)
            if is_excited:
                walk[5:] = self._stiffness_walk
        fix = self.advance(dt_s, z, np.array(inputs, float), walk)
        # bounds move the mean, the covariance stays
        angles = np.arctan([mean[4] + behind_m / base_m * mean[3], mean[4] - ahead_m / base_m * mean[3]])
        slips = sign * (angles - [steer, 0.0])
        if np.abs(slips).max() > SLIP_MAX_RAD:
            front, rear = np.tan([steer, 0.0] + sign * np.clip(slips, -SLIP_MAX_RAD, SLIP_MAX_RAD))
            mean[3:5] = front - rear, rear + ahead_m / base_m * (front - rear)
        ratios = np.clip([mean[5] + mean[6], mean[5] - mean[6]], self._least_ratio, C_HIGH_RATIO)
        mean[5:] = ratios.mean(), 0.5 * (ratios[0] - ratios[1])
        status = ObserverStatus.OK
        if fix is not ObserverStatus.OK:
            status = fix
        elif stands:
            status = ObserverStatus.STANDING
        elif (self.age_s[2:].min() if self._by_imu_alone else self.age_s[0]) > LOST_S:
            status = ObserverStatus.PREDICTED
        elif settings.by_dynamics and not is_excited:
            status = ObserverStatus.UNEXCITED
        self._output = self._output_of(speed, steer, status if was_started else ObserverStatus.STARTING)
        return self._output

    def _hold(self, status: ObserverStatus) -> ObserverOutput:
        """Return estimates as they were."""
        self._output = self._output._replace(status=int(status))
        return self._output

    def _output_of(self, speed: float, steer: float, status: ObserverStatus) -> ObserverOutput:
        mean, std = self.read(_read, np.array([speed, steer, *np.zeros(5)]))
        unknown = np.append(self.age_s[[0, 0, 1]] == np.inf, np.zeros(6, bool))
        is_starting = status == ObserverStatus.STARTING
        unknown[3:5] = is_starting
        unknown[7:] = is_starting or (not self._by_imu_alone and not std[7:].max() < UNKNOWN_STD_RAD)
        mean[unknown] = std[unknown] = np.nan
        n = len(self.states)
        return ObserverOutput(mean[:n], std[:n], mean[7:], std[7:], int(status))
