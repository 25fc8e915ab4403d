"""Sideslip and cornering stiffness by the multi-model observer: kinematics and dynamics in one state.

State: pose, yaw rate r and lateral velocity w of the centre of mass, slip angles b and cornering stiffness C
of both axles.  With f of :mod:`~terrain.estimation.observers.sideslip_pose` (path-free; on a straight path
the paper's), g of :mod:`~terrain.estimation.observers.sideslip_forces`, and e for measured minus estimated::

    dev' = f(dev, b) + K_dev e_dev         dyn' = g(dyn, b, C) + K_dyn e_dyn                   (8)
    b' = (K_b / K_a) J_f^T e_dev + (K_C / K_a) G_b^T e_dyn       C' = K_C G_C^T e_dyn          (9)

with J_f, G_b and G_C the derivatives of f by b, and of g by b and by C.  Gains of section VI
(:data:`SECTION_VI`): K_dev = 15 (of the two printed "K of yaw rate", 15 and 20, the first is for theta~),
K_dyn = 20, K_b = 2e12, K_a = 5e11, K_C = 5e7.  With fixes of 2 cm they leave 0.7 to 1 degree of noise in b,
and C needs tens of seconds to follow; the gains that are used by default weigh the dynamics more.

The regressors of C' in (9), -b times what is in G_C, carry the noise of the same fixes as e_dyn: C comes out
a quarter too low.  Used instead are the slip angles that the side forces of steady cornering, which are known
from speed, yaw rate and roll, have at the estimated C: they carry none (``instrument``; False is as printed).

Discrete form: the part of e_dev is exact per fix, with the continuous poles; the part of e_dyn, at each tick
of length h, is implicit, e+ = (1 + h K_dyn + h^2 M)^-1 e with M = (K_C/K_a) G_b G_b^T + K_C G_C G_C^T, which
is stable for every gain.  w is not measured: (4) gives it from the slip angles that are estimated.  The proof
(14)-(16) takes it as measured, and is approximate.

Without a gyro e_dyn is not measured: yaw rate and w are then those of the slip angles, C is as it was.

C' vanishes with b: cornering stiffness is adapted only while the lateral specific force is above a bound, and
is kept within physical limits; otherwise it is as it was, with status UNEXCITED.  Its estimate is the secant
-F/b of a force that saturates, and has to follow it down and up again.

Deremetz et al., ICRA 2017, (7)-(9).  Corrected: signs of line 2 of (3); with ``as_printed`` they are the
paper's, and C runs to its limits although the robot is tracked as before.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.estimation.observers import sideslip_pose as pose
from terrain.estimation.observers.family import Observer, ObserverOutput, ObserverStatus
from terrain.estimation.observers.sideslip_forces import (
    BEHIND,
    C_HIGH_F,
    C_HIGH_R,
    C_LOW,
    DYNAMIC_STATES,
    MASS,
    N_DYNAMIC,
    inverted,
    is_excited,
    rates,
    rates_by_force,
    set_dynamics,
)
from terrain.estimation.observers.sideslip_kinematic import (
    add_pose_noise,
    error_growth,
    predict_pose,
    set_slips,
)
from terrain.estimation.observers.sideslip_pose import (
    AHEAD,
    BASE,
    HAS_POSITION,
    HAS_YAW,
    IN_RATE,
    ROLL,
    SHARED_SIZE,
    SLIP_F,
    SLIP_MAX_RAD,
    SLIP_R,
    SPEED,
    STANDING_MPS,
    STATUS,
    STEER,
    YAW,
    X,
    Y,
    correct_by_fix,
    slip_jacobian,
    spread,
    status_of,
    take_inputs,
    yaw_rate_of,
)
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import BicycleRobot

RATE, SIDE, C_F, C_R, RATE_AGE = range(SHARED_SIZE, SHARED_SIZE + 5)
"""Places of yaw rate, lateral velocity and cornering stiffness in the memory, and of the gyro's age."""
COV = SHARED_SIZE + 5
_N = 8
K_DYN, K_C, K_C_A, SLIP_WALK, C_WALK, GYRO_STD, INSTRUMENT = range(N_DYNAMIC, N_DYNAMIC + 7)
_SLOW_MPS = 0.3
"""Slower the dynamics are not used: side forces follow where the tyres were, not where they go."""
_GYRO_LOST_S = 0.1
"""So long the dynamics predict the yaw rate between samples of the gyro."""


class MultiModelSettings(NamedTuple):
    """Gains and noise of the multi-model observer.

    Parameters
    ----------
    pose : gains, noise and gates of fixes
    dynamic_gain_ps : K of yaw rate and of w
    stiffness_gain : K_C
    dynamic_slip_ratio : K_C / K_alpha
    excited_mps2 : least lateral specific force for adapting C
    slip_walk_radps, stiffness_walk_npr : change within a second, one standard deviation
    stiffness_std_ratio : of the nominal cornering stiffness at first
    gyro_std_radps : of the yaw rate
    instrument : whether the regressors of C are those of side forces, without the noise of fixes
    as_printed : line 2 of (3) with the printed signs, to show what they do
    """

    pose: pose.PoseSettings = pose.PoseSettings()
    dynamic_gain_ps: float = 20.0
    stiffness_gain: float = 1e9
    dynamic_slip_ratio: float = 3e-2
    excited_mps2: float = 1.0
    slip_walk_radps: float = 0.05
    stiffness_walk_npr: float = 3000.0
    stiffness_std_ratio: float = 0.4
    gyro_std_radps: float = 0.003
    instrument: bool = True
    as_printed: bool = False


SECTION_VI = MultiModelSettings(
    pose.PoseSettings(slip_gain=2e12 / 5e11),
    stiffness_gain=5e7,
    dynamic_slip_ratio=5e7 / 5e11,
    instrument=False,
)
"""Gains and regressors as the paper prints them."""


def sideslip_multi_observer(
    robot: BicycleRobot,
    settings: MultiModelSettings = MultiModelSettings(),  # noqa: B008
) -> Observer:
    """Return the multi-model observer.

    Parameters
    ----------
    robot : car-like
    settings : of the observer

    Raises
    ------
    ConfigError
        if a setting is not accepted.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> observer = sideslip_multi_observer(load_robot("adap2e"))
    >>> observer.states[3:]
    ('yaw_rate_radps', 'speed_y_mps', 'cornering_front_npr', 'cornering_rear_npr')
    """
    own = settings._asdict()
    own.pop("pose"), own.pop("as_printed"), own.pop("instrument")
    bad = [f"{name} is {value:g}" for name, value in own.items() if not 0.0 <= value < math.inf]
    if bad or settings.dynamic_gain_ps == 0.0:
        raise ConfigError(
            f"{', '.join(bad) or 'dynamic_gain_ps is 0'}; finite gains and deviations are needed"
        )
    params = pose.shared_params(robot, settings.pose, INSTRUMENT + 1)
    set_dynamics(params, robot, settings.excited_mps2, settings.as_printed)
    params[[K_DYN, K_C, K_C_A]] = (
        settings.dynamic_gain_ps, settings.stiffness_gain, settings.dynamic_slip_ratio
    )  # fmt: skip
    params[[SLIP_WALK, C_WALK]] = settings.slip_walk_radps, settings.stiffness_walk_npr
    params[[GYRO_STD, INSTRUMENT]] = settings.gyro_std_radps, settings.instrument
    start = pose.shared_start(COV + _N * _N)
    nominal = np.array([robot.front_cornering_npr, robot.rear_cornering_npr])
    start[[C_F, C_R]], start[RATE_AGE] = nominal, pose.LOST_S
    std = [0.0, 0.0, 0.1, 0.1, 0.1, 0.1, *settings.stiffness_std_ratio * nominal]
    start[COV:] = np.diag(np.square(std)).ravel()
    return Observer(
        "sideslip-multi", DYNAMIC_STATES, pose.SIDESLIPS, pose.SIDESLIP_ROWS, params, start, _step, _read
    )


@njit
def _motion_of(params: Array, after: Array) -> tuple[float, float]:
    """Return yaw rate and w by (4), of the slip angles; w is the lateral speed ahead of the rear axle."""
    rate = yaw_rate_of(params, after[SPEED], after[STEER], after[SLIP_F], after[SLIP_R])
    return rate, abs(after[SPEED]) * math.tan(after[SLIP_R]) + params[AHEAD] * rate


@njit
def _motion_by_slip(params: Array, after: Array) -> Array:
    """Return derivatives (2, 2) of the same by slip angles."""
    by_slip = slip_jacobian(params, after[SPEED], after[STEER], after[SLIP_F], after[SLIP_R])
    out = np.empty((2, 2))
    out[0], out[1] = by_slip[1], by_slip[0] + params[AHEAD] * by_slip[1]
    return out


@njit
def _error_model(params: Array, after: Array, adapted: bool, rate: float) -> tuple[Array, Array, Array]:
    """Return derivatives of g by b and by C (2, 2), 0 where C is not adapted, and of w in (4) by b (2,)."""
    regressors = np.array([after[SLIP_F], after[SLIP_R]])
    if params[INSTRUMENT] == 1.0:
        load = params[MASS] / params[BASE]
        load *= after[SPEED] * rate + GRAVITY_MPS2 * math.sin(after[ROLL])
        regressors[0] = -load * params[AHEAD] / (after[C_F] * math.cos(after[STEER]))
        regressors[1] = -load * params[BEHIND] / after[C_R]
    by_force = rates_by_force(params, after[STEER])
    by_slip, by_stiffness = np.zeros((2, 2)), np.zeros((2, 2))
    for i in range(2):
        by_slip[i, 0], by_slip[i, 1] = by_force[i, 0] * after[C_F], by_force[i, 1] * after[C_R]
        if adapted:
            by_stiffness[i, 0] = by_force[i, 0] * regressors[0]
            by_stiffness[i, 1] = by_force[i, 1] * regressors[1]
    return by_slip, by_stiffness, _motion_by_slip(params, after)[1]


@njit
def _dynamic_gains(params: Array, by_slip: Array, by_stiffness: Array, measured: bool, dt_s: float) -> Array:
    """Return the gains (_N, 2) of a tick on the errors of yaw rate and of w."""
    kept = np.eye(2) * (1.0 + dt_s * params[K_DYN])
    for i in range(2):
        for j in range(2):
            for k in range(2):
                kept[i, j] += dt_s**2 * params[K_C_A] * by_slip[i, k] * by_slip[j, k]
                kept[i, j] += dt_s**2 * params[K_C] * by_stiffness[i, k] * by_stiffness[j, k]
    if not measured:
        kept[0, 1] = kept[1, 0] = 0.0
    inverse = inverted(kept)
    if not measured:
        inverse[:, 0] = 0.0
    gains = np.zeros((_N, 2))
    for i in range(2):
        for j in range(2):
            gains[4 + i, j] = dt_s * params[K_DYN] * inverse[i, j]
            for k in range(2):
                gains[2 + i, j] += dt_s * params[K_C_A] * by_slip[k, i] * inverse[k, j]
                gains[6 + i, j] += dt_s * params[K_C] * by_stiffness[k, i] * inverse[k, j]
    return gains


@njit
def _correct_dynamics(params: Array, after: Array, cov: Array, rate_measured: float, dt_s: float) -> bool:
    """Predict and correct yaw rate, w, slip and C in place by a tick; return whether C was adapted."""
    measured = after[RATE_AGE] == 0.0
    rate = rate_measured if measured else after[RATE]
    adapted = measured and is_excited(params, after[SPEED], after[ROLL], rate)
    by_slip, by_stiffness, side = _error_model(params, after, adapted, rate)
    gains = _dynamic_gains(params, by_slip, by_stiffness, measured, dt_s)
    slips, stiffness = np.array([after[SLIP_F], after[SLIP_R]]), np.array([after[C_F], after[C_R]])
    turning, pushed = rates(params, after[SPEED], after[STEER], after[ROLL], rate, slips, stiffness)
    after[RATE] += dt_s * turning
    after[SIDE] += dt_s * pushed
    error = np.array([rate - after[RATE] if measured else 0.0, _motion_of(params, after)[1] - after[SIDE]])
    change = gains[:, 0] * error[0] + gains[:, 1] * error[1]
    after[SLIP_F] = min(max(after[SLIP_F] + change[2], -SLIP_MAX_RAD), SLIP_MAX_RAD)
    after[SLIP_R] = min(max(after[SLIP_R] + change[3], -SLIP_MAX_RAD), SLIP_MAX_RAD)
    after[RATE] += change[4]
    after[SIDE] += change[5]
    after[C_F] = min(max(after[C_F] + change[6], params[C_LOW]), params[C_HIGH_F])
    after[C_R] = min(max(after[C_R] + change[7], params[C_LOW]), params[C_HIGH_R])
    grown = error_growth(params, after, _N, dt_s)
    grown[4:6, 2:4] = dt_s * by_slip
    grown[4:6, 6:8] = dt_s * by_stiffness
    if not measured:
        grown[5, 4] = -dt_s * after[SPEED]
    for j in range(_N):
        of_rate = grown[4, j]
        of_side = grown[5, j] - side[0] * grown[2, j] - side[1] * grown[3, j]
        for i in range(2, _N):
            grown[i, j] -= gains[i, 0] * of_rate + gains[i, 1] * of_side
    spread(cov, grown)
    for i in range(_N):
        for j in range(_N):
            cov[i, j] += gains[i, 0] * gains[j, 0] * params[GYRO_STD] ** 2
    if adapted:
        for i in range(6, 8):
            cov[i, i] = min(cov[i, i] + params[C_WALK] ** 2 * dt_s, params[C_HIGH_F] ** 2)
    return bool(adapted)


@njit
def _follow_slips(params: Array, after: Array, cov: Array, dt_s: float) -> None:
    """Predict a tick without dynamics in place: yaw rate and w, and their errors, are those of the slips."""
    add_pose_noise(params, after, cov, params[SLIP_WALK], dt_s)
    grown = error_growth(params, after, _N, dt_s)
    grown[4:6, :] = 0.0
    after[RATE] = after[SIDE] = 0.0
    if abs(after[SPEED]) >= STANDING_MPS:
        grown[4:6, 2:4] = _motion_by_slip(params, after)
        after[RATE], after[SIDE] = _motion_of(params, after)
    spread(cov, grown)


@njit
def _step(params: Array, memory: Array, row: Array, dt_s: float) -> Array:
    after = memory.copy()
    if take_inputs(params, after, row, dt_s) != ObserverStatus.OK.value:
        return after
    cov = after[COV : COV + _N * _N].reshape(_N, _N)
    predict_pose(params, after, dt_s)
    rate_measured = row[IN_RATE]
    known = abs(rate_measured) < 20.0
    after[RATE_AGE] = 0.0 if known else min(after[RATE_AGE] + dt_s, 1e6)
    adapted, posed = False, after[HAS_POSITION] == 1.0 and after[HAS_YAW] == 1.0
    lost = after[RATE_AGE] > _GYRO_LOST_S
    if posed and dt_s > 0.0 and abs(after[SPEED]) >= _SLOW_MPS and not lost:
        if memory[RATE_AGE] > _GYRO_LOST_S:
            after[RATE] = rate_measured
        adapted = _correct_dynamics(params, after, cov, rate_measured, min(dt_s, 0.1))
        add_pose_noise(params, after, cov, params[SLIP_WALK], dt_s)
    elif posed and dt_s > 0.0:
        _follow_slips(params, after, cov, dt_s)
        if known:
            after[RATE], cov[4, :], cov[:, 4] = rate_measured, 0.0, 0.0
            cov[4, 4] = params[GYRO_STD] ** 2
    status = status_of(memory, after, correct_by_fix(params, after, cov, row))
    if status == ObserverStatus.OK.value and not adapted:
        status = ObserverStatus.UNEXCITED.value
    after[STATUS] = status
    return after


@njit
def _figures(memory: Array) -> Array:
    """Return means (7,), their deviations, slips (2,) and theirs, in one array."""
    out = np.empty(18)
    out[0], out[1], out[2] = memory[X], memory[Y], memory[YAW]
    out[3], out[4], out[5], out[6] = memory[RATE], memory[SIDE], memory[C_F], memory[C_R]
    for i in range(_N):
        std = math.sqrt(max(memory[COV + i * (_N + 1)], 0.0))
        if i in (2, 3):
            out[14 + i] = std
        else:
            out[8 + i if i < 2 else 6 + i] = std
    out[7] = out[8]
    if memory[HAS_POSITION] == 0.0:
        out[:2] = math.nan
    if memory[HAS_YAW] == 0.0:
        out[2] = math.nan
    if memory[STATUS] == ObserverStatus.STARTING.value:
        out[3:5] = math.nan
    set_slips(memory, out[14:16], out[16:18])
    return out


def _read(params: Array, memory: Array) -> ObserverOutput:
    out = _figures(memory)
    return ObserverOutput(out[:7], out[7:14], out[14:16], out[16:], int(memory[STATUS]))
