"""The multi-model observer of Deremetz et al., ICRA 2017, with the gains and the equations of the paper.

One state: pose, yaw rate r and lateral velocity w of the centre of mass, slip angles b and cornering stiffness C of
both axles.  With f the motion of the pose by the slip angles and g of (3), both as
:mod:`terrain.estimation.models.sideslip` has them, and e for measured minus estimated::

    dev' = f(dev, b) + K_dev e_dev         dyn' = g(dyn, b, C) + K_dyn e_dyn                   (8)
    b' = (K_b / K_a) J_f^T e_dev + (K_C / K_a) G_b^T e_dyn       C' = K_C G_C^T e_dyn          (9)

with J_f, G_b and G_C the derivatives of f by b, and of g by b and by C.  Gains of section VI (:data:`SECTION_VI`):
K_dev = 15 (of the two printed "K of yaw rate", 15 and 20, the first is for theta~), K_dyn = 20, K_b = 2e12, K_a = 5e11,
K_C = 5e7.

The regressors of C' in (9), -b times what is in G_C, carry the noise of the same fixes as e_dyn: C comes out a
quarter too low.  ``instrument`` takes the slip angles that the side forces of steady cornering, which are known from
speed, yaw rate and roll, have at the estimated C in their place: they carry none.  w is not measured: (4) gives it from
the slip angles that are estimated.  The proof (14)-(16) takes it as measured, and is approximate.

A fix comes only every T.  For one, errors have moved by e = e_0 + T J b~, and the corrections G_e e, G_b e that give
the sampled error the continuous poles Z = exp(z T) of z^2 + K z + q g^2 = 0, with q = K_b / K_a and g a singular value
of J::

    G_e = 1 - Z_1 Z_2 = 1 - exp(-K T)      G_b = J^T h(J J^T),   h(g^2) = (1 - Z_1)(1 - Z_2) / (g^2 T)

The part of e_dyn is implicit at each tick of length h, e+ = (1 + h K_dyn + h^2 M)^-1 e with
M = (K_C/K_a) G_b G_b^T + K_C G_C G_C^T.

Corrected: signs of line 2 of (3); with ``as_printed`` they are the paper's, and C runs to its limits although the robot
is tracked as before.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.estimation.models.observer import Observer, ObserverOutput, ObserverStatus
from terrain.estimation.models.sideslip import (
    C_HIGH_RATIO,
    C_LOW_NPR,
    ROWS,
    SLIP_MAX_RAD,
    SLIPS,
    STANDING_MPS,
    Sideslip,
)
from terrain.records import Array
from terrain.robots import BicycleRobot

SLOWEST_MPS, GAIN_PS, DYNAMIC_GAIN_PS = 0.3, 15.0, 20.0
"""Below which the dynamics are not used, K_dev and K_dyn."""


class Gains(NamedTuple):
    """Gains of (9).

    Parameters
    ----------
    slip_gain, stiffness_gain, dynamic_slip_ratio : q = K_b / K_a, K_C and K_C / K_a
    excited_mps2 : least lateral specific force for adapting C
    instrument : whether the regressors of C are those of side forces
    as_printed : line 2 of (3) with the printed signs
    """

    slip_gain: float = 2.5
    stiffness_gain: float = 1e9
    dynamic_slip_ratio: float = 3e-2
    excited_mps2: float = 1.0
    instrument: bool = True
    as_printed: bool = False


SECTION_VI = Gains(2e12 / 5e11, 5e7, 5e7 / 5e11, instrument=False)
"""Gains and regressors as the paper prints them."""


class MultiModel(Observer):
    """The observer of (8) and (9), for forward motion."""

    name, slips, rows = "multi-model", SLIPS, ROWS

    def __init__(self, robot: BicycleRobot, gains: Gains = SECTION_VI) -> None:
        self.states = Sideslip(robot, "sideslip-multi").states
        self._robot, self._gains = robot, gains
        self._nominal = np.array([robot.front_cornering_npr, robot.rear_cornering_npr])
        self._pose: Array | None = None
        self._left_rad = self._since_s = 0.0  # error of heading that a fix left, time since it
        self._slip, self._motion, self._stiffness = np.zeros(2), np.zeros(2), self._nominal.copy()

    def step(self, row: Array, dt_s: float) -> ObserverOutput:
        """Take a row; fixes are not judged."""
        speed, steer, rate, roll = row[[0, 1, 5, 6]].tolist()
        fix, fixed = row[2:5], bool(np.isfinite(row[2:5]).all())
        if self._pose is None:
            self._pose = fix.copy() if fixed else None
            return self._output(ObserverStatus.STARTING)
        robot, moves = self._robot, abs(speed) >= STANDING_MPS
        base, ahead, behind = robot.wheelbase_m, robot.com_ahead_m, robot.com_behind_front_m
        turning = speed * (np.tan(steer + self._slip[0]) - np.tan(self._slip[1])) / base if moves else 0.0
        middle = self._pose[2] + self._left_rad + 0.5 * dt_s * turning
        side = speed * np.tan(self._slip[1]) if moves else 0.0
        self._pose += dt_s * np.array(
            [
                (speed * np.cos(middle) - side * np.sin(middle)) * moves,
                (speed * np.sin(middle) + side * np.cos(middle)) * moves,
                turning,
            ]
        )
        self._since_s += dt_s
        if speed >= SLOWEST_MPS:
            self._take_motion(speed, steer, rate, roll, dt_s)
        else:
            lateral = speed * (ahead * np.tan(steer + self._slip[0]) + behind * np.tan(self._slip[1])) / base
            self._motion = np.array([rate, lateral if moves else 0.0])
        if fixed:
            self._take_fix(fix, speed if moves else 0.0, steer)
        return self._output(ObserverStatus.OK if moves else ObserverStatus.STANDING)

    def _take_motion(self, speed: float, steer: float, rate: float, roll: float, dt_s: float) -> None:
        """Take a tick of e_dyn."""
        robot, gains = self._robot, self._gains
        ahead, behind = robot.com_ahead_m, robot.com_behind_front_m
        axles = np.array([[-behind * np.cos(steer), ahead], [-np.cos(steer), -1.0]])
        by_force = axles / np.array([[robot.yaw_inertia_kgm2], [robot.mass_kg]])
        gravity, pull = GRAVITY_MPS2 * np.sin(roll), speed * rate
        force = pull + gravity
        if gains.as_printed:
            by_force[1], pull = -by_force[1], -pull
        load = -robot.mass_kg / robot.wheelbase_m * force
        held = load * np.array([ahead / np.cos(steer), behind]) / self._stiffness
        by_slip = by_force * self._stiffness
        by_stiffness = (
            by_force * (held if gains.instrument else self._slip) * (abs(force) > gains.excited_mps2)
        )
        before = self._motion + dt_s * (by_slip @ self._slip - np.array([0.0, pull + gravity]))
        side = ahead * np.tan(steer + self._slip[0]) + behind * np.tan(self._slip[1])
        ratio, k_c = gains.dynamic_slip_ratio, gains.stiffness_gain
        spread = ratio * by_slip @ by_slip.T + k_c * by_stiffness @ by_stiffness.T
        implicit = (1 + dt_s * DYNAMIC_GAIN_PS) * np.eye(2) + dt_s**2 * spread
        error = np.linalg.solve(implicit, np.array([rate, speed * side / robot.wheelbase_m]) - before)
        self._motion = before + dt_s * DYNAMIC_GAIN_PS * error
        self._slip = np.clip(self._slip + dt_s * ratio * by_slip.T @ error, -SLIP_MAX_RAD, SLIP_MAX_RAD)
        stiffness = self._stiffness + dt_s * k_c * by_stiffness.T @ error
        self._stiffness = np.clip(stiffness, C_LOW_NPR, C_HIGH_RATIO * self._nominal)

    def _take_fix(self, fix: Array, speed: float, steer: float) -> None:
        """Take a fix, with the continuous poles."""
        assert self._pose is not None
        base, rear = self._robot.wheelbase_m, 1 / np.cos(self._slip[1]) ** 2
        front = 1 / base / np.cos(steer + self._slip[0]) ** 2
        jacobian = speed * np.array([[0.0, rear], [front, -rear / base]])
        heading, since, ratio = (
            self._pose[2] + self._left_rad,
            max(self._since_s, 1e-4),
            self._gains.slip_gain,
        )
        turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        along, across = turn @ (fix[:2] - self._pose[:2])
        error = np.array([across, wrapped(fix[2] - self._pose[2])])
        squares, vectors = np.linalg.eigh(jacobian @ jacobian.T)
        h = []
        for square in squares:
            poles = np.exp(np.roots([1, GAIN_PS, ratio * square]).astype(complex) * since)
            exact = ((1 - poles[0]) * (1 - poles[1])).real / max(square * since, 1e-300)
            h.append(exact if square > 1e-8 else ratio * (1 - np.exp(-GAIN_PS * since)) / GAIN_PS)
        slip = self._slip + jacobian.T @ vectors @ np.diag(h) @ vectors.T @ error
        self._slip = np.clip(slip, -SLIP_MAX_RAD, SLIP_MAX_RAD)
        gain = 1 - np.exp(-GAIN_PS * since)
        self._pose[:2] += gain * turn.T @ [along, across]
        self._pose[2] += gain * error[1]
        self._left_rad, self._since_s = (1 - gain) * error[1], 0.0

    def _output(self, status: ObserverStatus) -> ObserverOutput:
        """Return the state; the paper states no standard deviations."""
        pose = np.full(3, np.nan) if self._pose is None else self._pose
        mean = np.concatenate([pose, self._motion, self._stiffness])
        slip = np.full(2, np.nan) if status is ObserverStatus.STARTING else self._slip.copy()
        return ObserverOutput(mean, np.full(7, np.nan), slip, np.full(2, np.nan), int(status))
