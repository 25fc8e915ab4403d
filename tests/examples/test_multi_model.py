"""The multi-model observer of Deremetz et al. with the gains of the paper against its equations.

What its misprints do is judged in the paper's rows (``test_papers``).
"""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "papers"))

from multi_model import Gains, MultiModel

from terrain.estimation.models.observer import observe
from terrain.robots import load_robot

ROBOT = load_robot("adap2e")


def test_on_a_straight_path_it_is_8_and_9():
    """With deviations y, theta~ of the path y = 0, integrated at 1 ms without noise."""
    dt_s, speed, steer, slips = 0.001, 3.0, 0.02, np.array([-0.03, 0.04])
    gains = Gains(4.0, 5e9, 1e-2, excited_mps2=0.0, instrument=False)
    base, arm = ROBOT.wheelbase_m, ROBOT.com_ahead_m
    time_s = np.arange(2000) * dt_s
    turning = speed * (np.tan(steer + slips[0]) - np.tan(slips[1])) / base
    yaw, along = turning * time_s, speed / np.cos(slips[1])  # v of the paper: u = v cos b_R is measured
    x, y = (np.cumsum(along * f(yaw + slips[1])) * dt_s for f in (np.cos, np.sin))
    rows = np.full((time_s.size, 8), np.nan)
    rows[:, :2], rows[:, 2], rows[:, 3], rows[:, 4] = (speed, steer), x, y, yaw
    rows[:, 5:7] = turning, 0.0
    track = observe(MultiModel(ROBOT, gains), time_s, rows)
    dev, slip, paper = np.array([y[0], yaw[0]]), np.zeros(2), np.full((time_s.size, 4), np.nan)
    dyn, stiffness, cos = np.zeros(2), np.full(2, 15000.0), np.cos(steer)
    axles = np.array([[-arm * cos, arm], [-cos, -1.0]]) / [[ROBOT.yaw_inertia_kgm2], [ROBOT.mass_kg]]
    for k in range(1, time_s.size):
        v = speed / np.cos(slip[1])
        error = np.array([y[k], yaw[k]]) - dev
        rate = v * np.cos(slip[1]) * (np.tan(steer + slip[0]) - np.tan(slip[1])) / base
        front, rear = speed / base / np.cos(steer + slip[0]) ** 2, speed / base / np.cos(slip[1]) ** 2
        jacobian = np.array([[0.0, v * np.cos(yaw[k] + slip[1])], [front, -rear]])
        dev = dev + dt_s * (np.array([v * np.sin(yaw[k] + slip[1]), rate]) + 15.0 * error)
        beta = np.arctan((arm * np.tan(slip[0] + steer) + arm * np.tan(slip[1])) / base)  # (4)
        virtual = v * np.cos(slip[1]) / np.cos(beta) * np.sin(beta)
        g = axles @ (stiffness * slip) - np.array([0.0, speed * turning])
        e_dyn = np.array([turning, virtual]) - dyn
        dyn = dyn + dt_s * (g + 20.0 * e_dyn)
        change = (
            gains.slip_gain * jacobian.T @ error + gains.dynamic_slip_ratio * (axles * stiffness).T @ e_dyn
        )
        stiffness = stiffness + dt_s * gains.stiffness_gain * (axles * slip).T @ e_dyn
        stiffness, slip = np.clip(stiffness, 1000.0, 30000.0), slip + dt_s * change
        paper[k] = *slip, *stiffness
    assert track.slip[500:] == pytest.approx(paper[500:, :2], abs=0.003)
    assert track.mean[500:, 5:7] == pytest.approx(paper[500:, 2:], rel=0.03)
    assert np.ptp(paper[1:, 2:], axis=0).min() > 1000.0
