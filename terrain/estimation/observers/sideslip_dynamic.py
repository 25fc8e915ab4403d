"""Sideslip and cornering stiffness of a car-like robot from its dynamics: no position, no heading is needed.

State (r, w, C_F, C_R): yaw rate, lateral velocity of the centre of mass, and cornering stiffness of the
axles, which walk slowly while side forces show them, together rather than apart.  The model is (3) as
corrected in
:mod:`~terrain.estimation.observers.sideslip_forces`, with slip angles by the motion::

    tan(d + s b_F) = (w + L_F r) / u      tan(s b_R) = (w - L_R r) / u      s = sgn u
    r_measured = r                        a_measured = w' + u r + g sin a - (L_R - x_imu) r'

An extended Kalman filter, with a linearly implicit step (1 - h A)^-1 h f: the poles of (r, w), about
-2C/(m u), are far faster than any tick at low speed.  Below 0.3 m/s these equations say nothing (the observer
of the paper's Figs. 5 and 6 divides by u there, and diverges); slip and C are then as they were.

It takes steering, speed, yaw rate, roll and, where it is logged, lateral specific force; positions and
headings only correct the pose that it carries on.  Yaw rate and force show two combinations of w, C_F and
C_R; the third comes from the stiffness assumed at first: standard deviations include that.

Deremetz et al., ICRA 2017, section III, and Lenain et al. 2010.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.observers import sideslip_pose as pose
from terrain.estimation.observers.family import Observer, ObserverOutput, ObserverStatus
from terrain.estimation.observers.sideslip_forces import (
    BEHIND,
    C_HIGH_F,
    C_HIGH_R,
    C_LOW,
    DYNAMIC_STATES,
    N_DYNAMIC,
    inverted,
    is_excited,
    rates,
    rates_by_force,
    set_dynamics,
)
from terrain.estimation.observers.sideslip_kinematic import add_pose_noise, error_growth, predict_pose
from terrain.estimation.observers.sideslip_pose import (
    AHEAD,
    HAS_POSITION,
    HAS_YAW,
    IN_ACCEL,
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
    TIME,
    YAW,
    X,
    Y,
    correct_by_fix,
    spread,
    status_of,
    take_inputs,
)
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import BicycleRobot

RATE, SIDE, C_F, C_R, SEEN_AT = range(SHARED_SIZE, SHARED_SIZE + 5)
"""Places of the state in the memory, and of the time of the last yaw rate or force, plus one."""
_COV = SHARED_SIZE + 5
_POSE_COV = _COV + 16
GYRO_STD, ACCEL_STD, IMU_AHEAD, TURN_WALK, SIDE_WALK, C_WALK, C_TOGETHER, SLOWEST = range(
    N_DYNAMIC, N_DYNAMIC + 8
)
_GATE_STDS = 6.0


class DynamicSettings(NamedTuple):
    """Noise of the dynamic observer.

    Parameters
    ----------
    pose : of fixes; its slip gain is not used
    gyro_std_radps, accel_std_mps2 : of yaw rate and lateral specific force
    imu_ahead_m : of the accelerometer ahead of the rear axle
    turn_walk_radps2, side_walk_mps2 : what the model lacks of r and w within a second; the lag of a tyre that
        rolls into its slip is in it, which would otherwise be taken for a softer tyre
    stiffness_walk_npr : change of cornering stiffness within a second
    stiffness_correlation : of that change, between the axles
    stiffness_std_ratio : of the nominal cornering stiffness at first
    excited_mps2 : least lateral specific force for adapting C
    slowest_mps : below which slip is as it was
    """

    pose: pose.PoseSettings = pose.PoseSettings()
    gyro_std_radps: float = 0.003
    accel_std_mps2: float = 0.1
    imu_ahead_m: float = 0.0
    turn_walk_radps2: float = 0.1
    side_walk_mps2: float = 4.0
    stiffness_walk_npr: float = 2000.0
    stiffness_correlation: float = 0.8
    stiffness_std_ratio: float = 0.3
    excited_mps2: float = 1.0
    slowest_mps: float = 0.3


def sideslip_dynamic_observer(
    robot: BicycleRobot,
    settings: DynamicSettings = DynamicSettings(),  # noqa: B008
) -> Observer:
    """Return the dynamic observer.

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
    >>> from terrain.estimation.observers.family import observe
    >>> observer = sideslip_dynamic_observer(load_robot("adap2e"))
    >>> time_s, nan = np.arange(200) * 0.02, np.full(200, np.nan)
    >>> slope = np.column_stack([nan, nan, nan, nan, nan, nan, nan, nan])
    >>> slope[:, [0, 1, 5, 6, 7]] = 3.0, 0.0, 0.0, 0.2, 9.81 * np.sin(0.2)  # straight along a slope
    >>> observe(observer, time_s, slope).slip[-1].round(2)
    array([-0.03, -0.03])
    """
    own = settings._asdict()
    own.pop("pose")
    bad = [f"{name} is {value:g}" for name, value in own.items() if not 0.0 <= abs(value) < math.inf]
    needed = ("gyro_std_radps", "accel_std_mps2", "turn_walk_radps2", "side_walk_mps2", "slowest_mps")
    bad += [f"{name} is {own[name]:g}" for name in needed if not own[name] > 0.0]
    if bad or not 0.0 <= settings.stiffness_correlation <= 1.0:
        raise ConfigError(
            f"{', '.join(bad) or 'stiffness_correlation is beyond 0 to 1'}; finite deviations are needed"
        )
    params = pose.shared_params(robot, settings.pose._replace(slip_gain=0.0), SLOWEST + 1)
    set_dynamics(params, robot, settings.excited_mps2, as_printed=False)
    params[[GYRO_STD, ACCEL_STD]] = settings.gyro_std_radps, settings.accel_std_mps2
    params[[TURN_WALK, SIDE_WALK]] = settings.turn_walk_radps2, settings.side_walk_mps2
    params[IMU_AHEAD], params[C_WALK] = settings.imu_ahead_m, settings.stiffness_walk_npr
    params[C_TOGETHER], params[SLOWEST] = settings.stiffness_correlation, settings.slowest_mps
    start = pose.shared_start(_POSE_COV + 16)
    start[[C_F, C_R]] = robot.front_cornering_npr, robot.rear_cornering_npr
    cov = start[_COV:_POSE_COV].reshape(4, 4)
    cov[0, 0] = cov[1, 1] = 0.1**2
    std = settings.stiffness_std_ratio * start[[C_F, C_R]]
    cov[2:, 2:] = np.outer(std, std) * (
        np.eye(2) * (1.0 - settings.stiffness_correlation) + settings.stiffness_correlation
    )
    return Observer(
        "sideslip-dynamic", DYNAMIC_STATES, pose.SIDESLIPS, pose.SIDESLIP_ROWS, params, start, _step, _read
    )


@njit
def motion_slips(params: Array, after: Array) -> tuple[Array, Array]:
    """Return slip angles (2,) of yaw rate and w, and their derivative (2, 2) by both."""
    speed = after[SPEED]
    sign = -1.0 if speed < 0.0 else 1.0
    front = (after[SIDE] + params[BEHIND] * after[RATE]) / speed
    rear = (after[SIDE] - params[AHEAD] * after[RATE]) / speed
    slips, by_motion = np.empty(2), np.empty((2, 2))
    slips[0] = min(max(sign * (math.atan(front) - after[STEER]), -SLIP_MAX_RAD), SLIP_MAX_RAD)
    slips[1] = min(max(sign * math.atan(rear), -SLIP_MAX_RAD), SLIP_MAX_RAD)
    by_motion[0, 1] = 1.0 / (abs(speed) * (1.0 + front * front))
    by_motion[1, 1] = 1.0 / (abs(speed) * (1.0 + rear * rear))
    by_motion[0, 0], by_motion[1, 0] = params[BEHIND] * by_motion[0, 1], -params[AHEAD] * by_motion[1, 1]
    return slips, by_motion


@njit
def _predict(params: Array, after: Array, cov: Array, excited: bool, dt_s: float) -> None:
    """Predict state and covariance in place."""
    slips, by_motion = motion_slips(params, after)
    stiffness = after[C_F : C_R + 1]
    by_force = rates_by_force(params, after[STEER])
    kept = np.eye(2)
    for i in range(2):
        for j in range(2):
            for k in range(2):
                kept[i, j] -= dt_s * by_force[i, k] * stiffness[k] * by_motion[k, j]
    kept[1, 0] += dt_s * after[SPEED]
    inverse = inverted(kept)
    turning, pushed = rates(params, after[SPEED], after[STEER], after[ROLL], after[RATE], slips, stiffness)
    after[RATE] += dt_s * (inverse[0, 0] * turning + inverse[0, 1] * pushed)
    after[SIDE] += dt_s * (inverse[1, 0] * turning + inverse[1, 1] * pushed)
    grown = np.eye(4)
    grown[:2, :2] = inverse
    for i in range(2):
        for j in range(2):
            grown[i, 2 + j] = (
                dt_s * slips[j] * (inverse[i, 0] * by_force[0, j] + inverse[i, 1] * by_force[1, j])
            )
    spread(cov, grown)
    cov[0, 0] += params[TURN_WALK] ** 2 * dt_s
    cov[1, 1] += params[SIDE_WALK] ** 2 * dt_s
    if excited:
        walk = params[C_WALK] ** 2 * dt_s
        cov[2, 2] = min(cov[2, 2] + walk, params[C_HIGH_F] ** 2)
        cov[3, 3] = min(cov[3, 3] + walk, params[C_HIGH_R] ** 2)
        both = cov[2, 3] + params[C_TOGETHER] * walk
        most = 0.99 * math.sqrt(cov[2, 2] * cov[3, 3])
        cov[2, 3] = cov[3, 2] = min(max(both, -most), most)


@njit
def _condition(after: Array, cov: Array, error: float, row: Array, std: float, excited: bool) -> bool:
    """Condition in place on a measurement; return False where it is too far to be one."""
    variance, gain = std * std, np.zeros(4)
    for i in range(4):
        for j in range(4):
            gain[i] += cov[i, j] * row[j]
        variance += row[i] * gain[i]
    if error * error > _GATE_STDS**2 * variance:
        return False
    gain /= variance
    if not excited:
        gain[2:] = 0.0
    for i in range(4):
        after[RATE + i] += gain[i] * error
    kept = np.eye(4)
    for i in range(4):
        for j in range(4):
            kept[i, j] -= gain[i] * row[j]
    spread(cov, kept)
    for i in range(4):
        for j in range(4):
            cov[i, j] += gain[i] * gain[j] * std * std
    return True


@njit
def _correct(params: Array, after: Array, cov: Array, row: Array, excited: bool) -> bool:
    """Correct in place by yaw rate and force; return False where one was rejected."""
    used, seen = True, np.zeros(4)
    if abs(row[IN_RATE]) < 20.0:
        after[SEEN_AT] = 1.0 + after[TIME]
        seen[0] = 1.0
        used = _condition(after, cov, row[IN_RATE] - after[RATE], seen, params[GYRO_STD], excited)
    if abs(row[IN_ACCEL]) < 50.0:
        after[SEEN_AT] = 1.0 + after[TIME]
        slips, by_motion = motion_slips(params, after)
        by_force = rates_by_force(params, after[STEER])
        seen[:] = 0.0
        predicted = 0.0
        for i in range(2):
            by = by_force[1, i] - (params[AHEAD] - params[IMU_AHEAD]) * by_force[0, i]
            predicted += by * after[C_F + i] * slips[i]
            seen[0] += by * after[C_F + i] * by_motion[i, 0]
            seen[1] += by * after[C_F + i] * by_motion[i, 1]
            seen[2 + i] = by * slips[i]
        force = row[IN_ACCEL] - predicted
        used = _condition(after, cov, force, seen, params[ACCEL_STD], excited) and used
    after[RATE] = min(max(after[RATE], -20.0), 20.0)
    fastest = abs(after[SPEED])
    after[SIDE] = min(max(after[SIDE], -fastest), fastest)
    after[C_F] = min(max(after[C_F], params[C_LOW]), params[C_HIGH_F])
    after[C_R] = min(max(after[C_R], params[C_LOW]), params[C_HIGH_R])
    return used


@njit
def _step(params: Array, memory: Array, row: Array, dt_s: float) -> Array:
    after = memory.copy()
    if take_inputs(params, after, row, dt_s) != ObserverStatus.OK.value:
        return after
    cov = after[_COV:_POSE_COV].reshape(4, 4)
    pose_cov = after[_POSE_COV : _POSE_COV + 16].reshape(4, 4)
    predict_pose(params, after, dt_s)
    rate = row[IN_RATE] if abs(row[IN_RATE]) < 20.0 else after[RATE]
    moves = abs(after[SPEED]) >= params[SLOWEST]
    excited = moves and is_excited(params, after[SPEED], after[ROLL], rate)
    used = True
    if moves and dt_s > 0.0:
        _predict(params, after, cov, excited, min(dt_s, 0.1))
    if moves:
        used = _correct(params, after, cov, row, excited)
        slips, by_motion = motion_slips(params, after)
        after[SLIP_F], after[SLIP_R] = slips[0], slips[1]
        pose_cov[2:, :] = 0.0
        pose_cov[:, 2:] = 0.0
        for i in range(2):
            for j in range(2):
                for k in range(2):
                    by = by_motion[i, 0] * cov[0, k] + by_motion[i, 1] * cov[1, k]
                    pose_cov[2 + i, 2 + j] += by * by_motion[j, k]
    elif abs(after[SPEED]) < STANDING_MPS:
        after[RATE] = after[SIDE] = 0.0
    grown = error_growth(params, after, 4, dt_s)
    grown[:, 2:] *= 1.0 if after[HAS_POSITION] == 1.0 else 0.0
    grown[2, 2] = grown[3, 3] = 1.0
    spread(pose_cov, grown)
    add_pose_noise(params, after, pose_cov, 0.0, dt_s)
    fix = correct_by_fix(params, after, pose_cov, row)
    after[STATUS] = _status(memory, after, fix, used, excited)
    return after


@njit
def _status(before: Array, after: Array, fix: int, used: bool, excited: bool) -> int:
    if after[SEEN_AT] == 0.0:
        return ObserverStatus.STARTING.value
    posed = status_of(before, after, fix)
    if posed == ObserverStatus.REJECTED.value or not used:
        return ObserverStatus.REJECTED.value
    if posed == ObserverStatus.RESET.value:
        return int(posed)
    if abs(after[SPEED]) < STANDING_MPS:
        return ObserverStatus.STANDING.value
    if 1.0 + after[TIME] - after[SEEN_AT] > pose.LOST_S:
        return ObserverStatus.PREDICTED.value
    return ObserverStatus.OK.value if excited else ObserverStatus.UNEXCITED.value


@njit
def _figures(memory: Array) -> Array:
    """Return means (7,), their deviations, slips (2,) and theirs, in one array."""
    out = np.empty(18)
    out[0], out[1], out[2] = memory[X], memory[Y], memory[YAW]
    out[7] = out[8] = math.sqrt(max(memory[_POSE_COV], 0.0))
    out[9] = math.sqrt(max(memory[_POSE_COV + 5], 0.0))
    for i in range(4):
        out[3 + i] = memory[RATE + i]
        out[10 + i] = math.sqrt(max(memory[_COV + 5 * i], 0.0))
    for i in range(2):
        out[14 + i] = memory[SLIP_F + i]
        out[16 + i] = math.sqrt(max(memory[_POSE_COV + 10 + 5 * i], 0.0))
    if memory[HAS_POSITION] == 0.0 or memory[HAS_YAW] == 0.0:
        out[:3] = out[7:10] = math.nan
    if memory[STATUS] == ObserverStatus.STARTING.value:
        out[3:5] = out[14:] = math.nan
    return out


def _read(params: Array, memory: Array) -> ObserverOutput:
    out = _figures(memory)
    return ObserverOutput(out[:7], out[7:14], out[14:16], out[16:], int(memory[STATUS]))
