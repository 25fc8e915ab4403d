"""Steering law: convergence by its own equation, the actuator's lag taken out, and bad inputs."""

from __future__ import annotations

import numpy as np
import pytest

from terrain.control.paths import path_from_curvature
from terrain.control.steering_law import (
    STATE_SIZE,
    SteeringSettings,
    SteerStatus,
    law_17,
    steer,
    steering_params,
)
from terrain.errors import ConfigError
from terrain.robots import load_robot

ROBOT = load_robot("adap2e")
PARAMS = steering_params(ROBOT, SteeringSettings())
STRAIGHT = path_from_curvature(np.array([0.0, 50.0]), np.zeros(2)).rows
NO_SLIP = np.zeros(2)


def plain_17(lateral, angle, curvature, front, rear, k_p=0.16, k_d=0.8, base=1.2):
    gamma, alpha = angle + rear, 1 - curvature * lateral
    eta = np.tan(gamma)
    a = -k_p * lateral - k_d * alpha * eta + curvature * alpha * np.tan(gamma) ** 2
    inner = curvature * np.cos(gamma) / alpha + a * np.cos(gamma) ** 3 / alpha**2
    return np.arctan(np.tan(rear) + base / np.cos(rear) * inner) - front


def test_law_is_17():
    rng = np.random.default_rng(0)
    for values in rng.uniform(-0.3, 0.3, (50, 5)):
        assert law_17(PARAMS, *values) == pytest.approx(plain_17(*values))


@pytest.mark.parametrize(("front", "rear"), [(0.0, 0.0), (-0.06, -0.04), (0.02, 0.05)])
@pytest.mark.parametrize("curvature", [0.0, 0.08])
def test_deviation_converges_by_its_equation_whatever_the_slip(front, rear, curvature):
    """(2) with known slip under (17): y'' + K_d y' + K_p y = 0 over the distance along the path."""
    lateral, angle, s, ds, found = 0.5, -rear, 0.0, 0.005, []
    while s < 20.0:
        steer_rad = law_17(PARAMS, lateral, angle, curvature, front, rear)
        alpha, gamma = 1 - curvature * lateral, angle + rear
        per_s = alpha / np.cos(gamma)  # distance driven per distance along the path
        bend = np.cos(rear) * (np.tan(steer_rad + front) - np.tan(rear)) / 1.2
        lateral += ds * np.sin(gamma) * per_s
        angle += ds * (bend * per_s - curvature)
        s += ds
        found.append(lateral)
    s = np.arange(1, len(found) + 1) * ds
    assert np.array(found) == pytest.approx(0.5 * (1 + 0.4 * s) * np.exp(-0.4 * s), abs=0.01)


@pytest.mark.parametrize("speed", [2.0, 5.0])
def test_predicted_curvature_takes_the_lag_of_the_actuator_out(speed):
    rows = path_from_curvature(np.array([0.0, 20.0, 24.0, 60.0]), np.array([0.0, 0.0, 0.1, 0.1])).rows
    errors = {}
    for horizon in (0.0, 1.0, 3.0):
        params = steering_params(ROBOT, SteeringSettings(delay_s=0.0, horizon_time_constants=horizon))
        memory, actual, late = np.zeros(STATE_SIZE), 0.0, []
        for s in np.arange(0.0, 40.0, speed * 0.02):
            curvature = np.interp(s, rows[:, 0], rows[:, 4])
            place = np.array([s, 0.0, 0.0, curvature])
            command, memory, _ = steer(params, memory, rows, place, NO_SLIP, speed, 0.02)
            actual += (1 - np.exp(-0.02 / ROBOT.steering_time_constant_s)) * (command - actual)
            late.append(actual - np.arctan(1.2 * curvature))
        errors[horizon] = np.abs(late).max()
        assert abs(late[-1]) < 1e-6
    assert errors[1.0] < 0.7 * errors[0.0]


def test_slower_gains_above_the_bandwidth_limits_and_statuses():
    place, memory = np.array([5.0, 0.2, 0.0, 0.0]), np.zeros(STATE_SIZE)
    at = {v: steer(PARAMS, memory, STRAIGHT, place, NO_SLIP, v, 0.02)[0] for v in (1.0, 3.0, 6.0)}
    assert at[1.0] == pytest.approx(at[3.0])
    assert abs(at[6.0]) < 0.5 * abs(at[3.0])
    far = np.array([5.0, 5.0, 0.0, 0.0])
    command, _, status = steer(PARAMS, memory, STRAIGHT, far, NO_SLIP, 1.0, 0.02)
    assert command == -ROBOT.steering_max_rad
    assert status == SteerStatus.CLAMPED


def test_bad_inputs_have_a_status_and_a_finite_angle():
    memory = np.array([0.1, 0.12, 0.0, 0.0])
    good = np.array([5.0, 0.1, 0.0, 0.0])
    for speed, dt_s in ((np.nan, 0.02), (3.0, np.nan), (3.0, -1.0), (3.0, 5.0), (np.inf, 0.02)):
        command, after, status = steer(PARAMS, memory, STRAIGHT, good, NO_SLIP, speed, dt_s)
        assert (command, status) == (0.12, SteerStatus.BAD_INPUT)
        assert (after == memory).all()
    blind = np.array([5.0, np.nan, np.nan, 0.0])
    command, _, status = steer(PARAMS, memory, STRAIGHT, blind, np.full(2, np.nan), 3.0, 0.02)
    assert status == SteerStatus.HELD
    assert abs(command) <= ROBOT.steering_max_rad
    for lateral, angle, curvature in ((11.0, 0.0, 0.1), (0.0, 2.0, 0.0), (-3.0, 3.1, -0.5)):
        place = np.array([5.0, lateral, angle, curvature])
        command, after, status = steer(PARAMS, np.zeros(4), STRAIGHT, place, NO_SLIP, 3.0, 0.02)
        assert np.isfinite(command)
        assert np.isfinite(after).all()
        assert status in (SteerStatus.SINGULAR, SteerStatus.CLAMPED)


@pytest.mark.parametrize("bad", [{"position_pm2": 0.0}, {"delay_s": -1.0}, {"offset_m": np.nan}])
def test_settings_that_cannot_be_are_refused(bad):
    with pytest.raises(ConfigError):
        steering_params(ROBOT, SteeringSettings(**bad))
