"""Steering law: convergence by its own equation, the actuator's lag taken out, and bad inputs."""

from __future__ import annotations

import numpy as np
import pytest

from terrain.control.paths import PathStatus, Place, path_from_curvature
from terrain.control.steering_law import (
    SteeringSettings,
    SteerState,
    SteerStatus,
    check_steering,
    law_17,
    steer,
)
from terrain.errors import ConfigError
from terrain.robots import load_robot

ROBOT = load_robot("adap2e")
SETTINGS = SteeringSettings()
STRAIGHT = path_from_curvature(np.array([0.0, 50.0]), np.zeros(2))
NO_SLIP = np.zeros(2)


def at(*place):
    return Place(*place, PathStatus.OK)


def steered(place, speed_mps=3.0, dt_s=0.02, state=SteerState(), slips=NO_SLIP):  # noqa: B008
    return steer(ROBOT, SETTINGS, state, STRAIGHT, at(*place), slips, speed_mps, dt_s)


def plain_17(lateral, angle, curvature, front, rear, k_p=0.16, k_d=0.8, base=1.2):
    gamma, alpha = angle + rear, 1 - curvature * lateral
    eta = np.tan(gamma)
    a = -k_p * lateral - k_d * alpha * eta + curvature * alpha * np.tan(gamma) ** 2
    inner = curvature * np.cos(gamma) / alpha + a * np.cos(gamma) ** 3 / alpha**2
    return np.arctan(np.tan(rear) + base / np.cos(rear) * inner) - front


def test_law_is_17():
    rng = np.random.default_rng(0)
    for values in rng.uniform(-0.3, 0.3, (50, 5)):
        assert law_17(SETTINGS, 1.2, *values) == pytest.approx(plain_17(*values))


@pytest.mark.parametrize(("front", "rear"), [(0.0, 0.0), (-0.06, -0.04), (0.02, 0.05)])
@pytest.mark.parametrize("curvature", [0.0, 0.08])
def test_deviation_converges_by_its_equation_whatever_the_slip(front, rear, curvature):
    """(2) with known slip under (17): y'' + K_d y' + K_p y = 0 over the distance along the path."""
    lateral, angle, s, ds, found = 0.5, -rear, 0.0, 0.005, []
    while s < 20.0:
        steer_rad = law_17(SETTINGS, 1.2, lateral, angle, curvature, front, rear)
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
    path = path_from_curvature(np.array([0.0, 20.0, 24.0, 60.0]), np.array([0.0, 0.0, 0.1, 0.1]))
    errors = {}
    for horizon in (0.0, 1.0, 3.0):
        settings = SteeringSettings(delay_s=0.0, horizon_time_constants=horizon)
        state, actual, late = SteerState(), 0.0, []
        for s in np.arange(0.0, 40.0, speed * 0.02):
            curvature = float(np.interp(s, path.distance_m, path.curvature_pm))
            place = at(float(s), 0.0, 0.0, curvature)
            command, state, _ = steer(ROBOT, settings, state, path, place, NO_SLIP, speed, 0.02)
            actual += (1 - np.exp(-0.02 / ROBOT.steering_time_constant_s)) * (command - actual)
            late.append(actual - np.arctan(1.2 * curvature))
        errors[horizon] = np.abs(late).max()
        assert abs(late[-1]) < 1e-6
    assert errors[1.0] < 0.7 * errors[0.0]


def test_slower_gains_above_the_bandwidth_limits_and_statuses():
    at_speed = {v: steered((5.0, 0.2, 0.0, 0.0), v)[0] for v in (1.0, 3.0, 6.0)}
    assert at_speed[1.0] == pytest.approx(at_speed[3.0])
    assert abs(at_speed[6.0]) < 0.5 * abs(at_speed[3.0])
    command, _, status = steered((5.0, 5.0, 0.0, 0.0), 1.0)
    assert command == -ROBOT.steering_max_rad
    assert status == SteerStatus.CLAMPED


def test_bad_inputs_have_a_status_and_a_finite_angle():
    before = SteerState(0.1, 0.12)
    for speed, dt_s in ((np.nan, 0.02), (3.0, np.nan), (3.0, -1.0), (3.0, 5.0), (np.inf, 0.02)):
        found = steered((5.0, 0.1, 0.0, 0.0), speed, dt_s, before)
        assert found == (0.12, before, SteerStatus.BAD_INPUT)
    command, _, status = steered((5.0, np.nan, np.nan, 0.0), state=before, slips=np.full(2, np.nan))
    assert status == SteerStatus.HELD
    assert abs(command) <= ROBOT.steering_max_rad
    for lateral, angle, curvature in ((11.0, 0.0, 0.1), (0.0, 2.0, 0.0), (-3.0, 3.1, -0.5)):
        command, after, status = steered((5.0, lateral, angle, curvature))
        assert np.isfinite([command, *after]).all()
        assert status in (SteerStatus.SINGULAR, SteerStatus.CLAMPED)


@pytest.mark.parametrize("bad", [{"position_pm2": 0.0}, {"delay_s": -1.0}, {"offset_m": np.nan}])
def test_settings_that_cannot_be_are_refused(bad):
    with pytest.raises(ConfigError):
        check_steering(SteeringSettings(**bad))
