"""Observers of sideslip: their equations, recovery of hidden truth, and sensor faults."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from terrain.estimation.models.observer import ObserverStatus, observe
from terrain.estimation.models.sideslip import RATE, SETTINGS, Sideslip
from terrain.robots import load_robot
from terrain.simulation.plants.car import CarCommand, CarDrive, level_ground
from terrain.simulation.run import simulate

ROBOT = load_robot("adap2e")
ANY = pytest.mark.parametrize("name", SETTINGS)
TICK_S, G = 0.02, 9.80665
L, AHEAD, BEHIND = ROBOT.wheelbase_m, ROBOT.com_ahead_m, ROBOT.com_behind_front_m
C_0 = np.array([ROBOT.front_cornering_npr, ROBOT.rear_cornering_npr])


@functools.cache
def drive(speed_mps=5.0, seed=0, roll_rad=0.0, stops=(), seconds=30.0):
    """Return times (n,), rows (n, 8) and a function that gives a channel of the truth at the ticks."""
    time_s = np.arange(0.0, 60.0, 4.0)
    angles = np.array([0, 0.1, 0.14, 0.05, -0.1, -0.15, -0.15, 0.0, 0.12, 0.12, -0.1, 0, 0.15, 0.05, 0])
    rows = []

    def controller(sample):
        rows.append(sample.measured)
        return CarCommand(float(np.interp(sample.time_s, time_s, angles)), sample.speed_desired_mps)

    car, ground = CarDrive(speed_mps, stops, seconds), level_ground(0.7, roll_rad)
    truth = simulate(ROBOT, car, ground, seed, controller=controller).streams["truth"]
    return np.arange(len(rows)) * TICK_S, np.array(rows), lambda name: truth.channel(name)[::2]


def true_slips(truth):
    return np.column_stack([truth("slip_front_rad"), truth("slip_rear_rad")])


def observed(name, time_s, rows):
    return observe(Sideslip(ROBOT, name), time_s, rows)


def without(rows, *columns):
    lost = rows.copy()
    lost[:, columns] = np.nan
    return lost


def derivative(function, x):
    steps = np.diag(1e-6 * np.maximum(1.0, np.abs(x)))
    return np.column_stack([(function(x + d) - function(x - d)) / (2 * d.sum()) for d in steps])


def equations(u, steer, roll, u_before, steer_before, by_dynamics):
    """Return a tick of forward motion, and what is measured, as functions of the state; A by differences."""

    def slips(r, w):
        return np.arctan([(w + BEHIND * r) / u, (w - AHEAD * r) / u]) - [steer, 0.0]

    def forces(r, w, c):
        front, rear = -C_0 * [c[0] + c[1], c[0] - c[1]] * slips(r, w) * [np.cos(steer), 1.0]
        return np.array(
            [(BEHIND * front - AHEAD * rear) / ROBOT.yaw_inertia_kgm2, (front + rear) / ROBOT.mass_kg]
        )

    def motion(x):
        if not by_dynamics:
            slip = np.arctan([x[4] + BEHIND / L * x[3], x[4] - AHEAD / L * x[3]]) - [steer_before, 0.0]
            turn = np.tan(steer + slip[0]) - np.tan(slip[1])
            return np.array([turn, np.tan(slip[1]) + AHEAD / L * turn])
        v = u_before * x[3:5] / [L, 1.0]

        def f(v):
            return forces(*v, x[5:]) - [0.0, u * v[0] + G * np.sin(roll)]

        v = v + np.linalg.solve(np.eye(2) - TICK_S * derivative(f, v), TICK_S * f(v))
        return v / [u / L, u]

    def move(x):
        after = motion(x)
        turn, side = 0.5 * (x[3:5] + after)
        step = u * np.exp(1j * (x[2] + 0.5 * TICK_S * u * turn / L)) * (1.0 + 1j * (side - AHEAD / L * turn))
        moved = TICK_S * np.array([step.real, step.imag, u * turn / L])
        return np.array([*(x[:3] + moved), *after, *x[5:]])

    def measure(x):
        turning, force = forces(u / L * x[3], u * x[4], x[5:])
        return np.array([*x[:3], u / L * x[3], force - AHEAD * turning])

    return move, measure


@ANY
def test_a_tick_is_that_of_the_equations_and_its_derivatives_leave_out_what_is_not_learned(name):
    model, chosen, rng = Sideslip(ROBOT, name).filter.model, SETTINGS[name], np.random.default_rng(0)
    for is_excited in (False, True) * 10:
        u, steer, roll = rng.uniform([1.0, -0.2, -0.2], [6.0, 0.2, 0.2])
        tick = u, steer, roll, u * rng.uniform(0.95, 1.05), steer + rng.normal(0.0, 0.01), chosen.by_dynamics
        x = np.concatenate([rng.normal(size=3), rng.normal(0.0, 0.05, 2), rng.normal([1.0, 0.0], 0.1)])
        params = np.array([*model.params, *tick, is_excited])
        x_next, f, z, h = np.zeros(7), np.zeros((7, 7)), np.zeros(5), np.zeros((5, 7))
        model.propagate(x, TICK_S, params, x_next, f)
        model.observe(x, params, z, h)
        move, measure = equations(*tick)
        np.testing.assert_allclose(x_next, move(x), atol=1e-8)
        np.testing.assert_allclose(z, measure(x), rtol=1e-9, atol=1e-9)
        by_x, seen = derivative(move, x), derivative(measure, x)
        by_x[:5, 5:] *= is_excited
        by_x[:3, 3:] *= chosen.by_fixes
        seen[:, 5:] *= is_excited
        np.testing.assert_allclose(f, by_x, atol=1e-4)
        np.testing.assert_allclose(h, seen, rtol=1e-6, atol=1e-6)


@ANY
@pytest.mark.parametrize("roll_rad", [0.0, 0.2])
def test_slip_comes_back_within_its_own_error(name, roll_rad):
    time_s, rows, truth = drive(4.0, seed=1, roll_rad=roll_rad, seconds=20.0)
    track = observed(name, time_s, rows)
    error = (track.slip - true_slips(truth))[time_s > 5.0]
    assert np.isfinite(error).all()
    assert np.sqrt((error**2).mean()) < np.radians({"sideslip-multi": 0.25}.get(name, 0.6))
    assert 0.4 < np.sqrt(((error / track.slip_std[time_s > 5.0]) ** 2).mean()) < 1.4


@pytest.mark.parametrize(("speed_mps", "seed", "roll_rad"), [(4.0, 4, 0.0), (5.0, 2, 0.2)])
def test_stiffness_is_the_secant_of_the_force(speed_mps, seed, roll_rad):
    time_s, rows, truth = drive(speed_mps, seed=seed, roll_rad=roll_rad)
    stiffness, slips = observed("sideslip-multi", time_s, rows).mean[:, 5:7], true_slips(truth)
    excited = (np.abs(truth("accel_y_mps2")) > 1.0) & (np.abs(slips) > 0.02).all(axis=1) & (time_s > 6.0)
    secant = -np.column_stack([truth("side_front_n"), truth("side_rear_n")])[excited] / slips[excited]
    error = stiffness[excited] / secant - 1.0
    assert np.abs(np.median(error, axis=0)).max() < 0.05
    assert (np.abs(error) < 0.2).mean() > 0.95


def test_the_dynamic_observer_needs_neither_positions_nor_headings():
    time_s, rows, truth = drive(4.0, seed=2)
    for columns, bar_rad in (((2, 3, 4), np.radians(0.6)), ((2, 3, 4, 7), np.radians(1.0))):
        track = observed("sideslip-dynamic", time_s, without(rows, *columns))
        error = (track.slip - true_slips(truth))[time_s > 3.0]
        assert np.sqrt((error**2).mean()) < bar_rad
        assert np.isnan(track.state("position_x_m")).all()
    fixed = observed("sideslip-dynamic", time_s, rows)
    blind = observed("sideslip-dynamic", time_s, without(rows, 2, 3, 4))
    np.testing.assert_allclose(fixed.slip[100:], blind.slip[100:], atol=1e-8)  # fixes correct the pose alone
    for name in ("sideslip-kinematic", "sideslip-multi"):
        track = observed(name, time_s, without(rows, 2, 3, 4))
        assert np.isnan(track.slip).all()
        assert set(track.status) == {ObserverStatus.STARTING}


@ANY
def test_at_rest_everything_is_as_it_was_and_reversing_has_the_slip_of_its_own_direction(name):
    time_s, rows, truth = drive(3.0, seed=7, stops=((10.0, 4.0),), seconds=18.0)
    track = observed(name, time_s, rows)
    stands = (truth("speed_x_mps") == 0.0) & (time_s > 2.0) & (np.abs(rows[:, 0]) < 0.05)
    assert stands.sum() > 150
    assert (track.status[stands] == ObserverStatus.STANDING).all()
    first = np.flatnonzero(stands)[0]
    assert stands[first : first + 100].all()
    for kept in (track.slip, track.mean):
        assert np.ptp(kept[first : first + 100], axis=0).max() == 0.0
    assert np.nanmax(np.abs(track.slip)) < np.radians(4.0)
    # backward along a slope: a side force opposes the same lateral speed as forward
    time_s, roll_rad = np.arange(400) * TICK_S, -0.1
    expected = -ROBOT.mass_kg * G * np.sin(roll_rad) / C_0.sum()
    rows = np.full((400, 8), np.nan)
    rows[:, :2], rows[:, 4:7] = (-2.0, 0.0), (0.0, 0.0, roll_rad)
    rows[:, 2], rows[:, 3] = -2.0 * time_s, 2.0 * expected * time_s
    rows[:, 7] = G * np.sin(roll_rad)
    assert observed(name, time_s, rows).slip[-1] == pytest.approx(expected, rel=0.2)


def test_without_a_gyro_slip_follows_the_pose_and_stiffness_stays():
    time_s, rows, truth = drive(4.0, seed=3)
    track = observed("sideslip-multi", time_s, without(rows, RATE))
    late = time_s > 5.0
    assert (np.sqrt(np.mean((track.slip - true_slips(truth))[late] ** 2, axis=0)) < np.radians(1.0)).all()
    assert np.ptp(track.mean[:, 5:7], axis=0).max() < 1.0  # N/rad
    assert not (track.status[late] == ObserverStatus.OK).any()
    faulty = rows.copy()
    faulty[(time_s > 8.0) & (time_s < 16.0), RATE] = np.nan
    track = observed("sideslip-multi", time_s, faulty)
    assert np.abs(track.slip - true_slips(truth))[time_s > 4.0].max() < np.radians(5.0)
    assert np.abs(track.mean[:, 3] - truth("yaw_rate_radps"))[time_s > 16.5].max() < 0.05
