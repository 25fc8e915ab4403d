"""Car-like robots in the planar simulation: the single-track model against its equations."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from terrain.constants import GRAVITY_MPS2
from terrain.effects import library_of, vector_of
from terrain.extension import apply_homes
from terrain.robots import load_robot
from terrain.simulation.plants.planar import LEAST_RATIO, Ground, make_planar, move

CAR = replace(load_robot("adap2e"), com_ahead_m=0.5, front_cornering_npr=12000.0, rear_cornering_npr=18000.0)
FREE = Ground(slip_ratio=0.0, rolling_ratio=0.0)
DT = 0.01
VX, VY, W = range(3)


def moved(speed, steer, roll=0.0, values=None, robot=CAR, dt=DT, grade=0.0, ground=FREE):
    """Return the twist (n, 3) at speeds and angles (n,)."""
    n = len(speed)
    angles = np.column_stack([np.broadcast_to(steer, n), np.zeros(n)])
    tilt = [np.ascontiguousarray(np.broadcast_to(each, n), dtype=float) for each in (grade, roll)]
    wheels = np.ascontiguousarray(np.asarray(speed, dtype=float)[:, None])
    out = move(make_planar(robot, ground), vector_of(values or {}), dt, wheels, angles, *tilt)
    return np.column_stack([out[name] for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")])


def understeer(robot):
    a, b = robot.com_ahead_m, robot.com_behind_front_m
    return robot.mass_kg * (a / robot.front_cornering_npr - b / robot.rear_cornering_npr) / robot.wheelbase_m


def test_at_rest_it_rests_and_creeping_it_is_the_kinematic_bicycle():
    rest = moved(np.zeros(200), 0.3, roll=0.2)
    np.testing.assert_array_equal(rest[:, [VX, VY, W]], 0.0)
    stopped = moved(np.concatenate([np.ones(100), np.zeros(100)]), 0.3, roll=0.2)[102:]
    np.testing.assert_array_equal(stopped[:, [VX, VY, W]], 0.0)
    slow = moved(np.full(100, 1e-3), 0.3)[-1]
    np.testing.assert_allclose(slow[W], 1e-3 * math.tan(0.3) / CAR.wheelbase_m, rtol=1e-6)


def by_equations(t, speed, steer, roll):
    """Integrate the balances as they stand with a stiff solver: (n, 2) of lateral speed and turn."""
    v_of, d_of, ph_of = (CubicSpline(t, each) for each in (speed, steer, roll))
    a, b, m, inertia = CAR.com_ahead_m, CAR.com_behind_front_m, CAR.mass_kg, CAR.yaw_inertia_kgm2

    def rates(now, x):
        c, w = x
        v = float(v_of(now))
        fast = max(abs(v), 1e-3)
        front = -CAR.front_cornering_npr * (c + b * w - v * math.tan(d_of(now))) / fast
        rear = -CAR.rear_cornering_npr * (c - a * w) / fast
        down = m * GRAVITY_MPS2 * math.sin(ph_of(now))
        return [(front + rear - down) / m - v * w, (b * front - a * rear) / inertia]

    found = solve_ivp(rates, (t[0], t[-1]), [0.0, 0.0], "LSODA", t, rtol=1e-7, atol=1e-9)
    return np.column_stack([found.y[0] - a * found.y[1], found.y[1]])


def test_steps_follow_the_equations_of_motion_through_reversals_and_do_not_depend_on_the_step():
    t = DT * np.arange(1500)
    speed = 3.0 * np.sin(0.4 * t) * np.tanh(t)
    steer, roll = 0.25 * np.sin(1.3 * t) * np.tanh(t), 0.08 * np.sin(0.5 * t)
    out = moved(speed, steer, roll)[:, [VY, W]]
    true = by_equations(t, speed, steer, roll)
    size = true.std(axis=0)
    assert (np.abs(out - true).max(axis=0) < 3e-3 * size).all()
    coarse = moved(speed[::2], steer[::2], roll[::2], dt=2 * DT)[:, [VY, W]]
    assert (np.abs(coarse - out[::2]).max(axis=0) < 1e-2 * size).all()


@pytest.mark.parametrize("accel", [-1.0, 2.0])
def test_slip_along_is_exact_for_even_accelerations_at_any_step(accel):
    """By hand: ``tau dv/dt + v = u``, tau = u c / g: v = u - u c a / (g + c a) once the start is past."""
    soft = 0.3
    for dt in (0.01, 0.1):
        u = 4.0 + accel * dt * np.arange(round(3.0 / dt))
        speed = moved(u, 0.0, ground=Ground(slip_ratio=soft, rolling_ratio=0.0), dt=dt)[:, VX]
        share = soft * accel / (GRAVITY_MPS2 + soft * accel)
        lag, rate = u * soft / GRAVITY_MPS2, accel * soft / GRAVITY_MPS2
        started = u[0] * share * (lag / lag[0]) ** (-1.0 / rate)
        np.testing.assert_allclose(speed, u * (1.0 - share) + started, atol=1e-9)


def test_a_car_that_would_spin_turns_ten_times_as_tightly_at_the_most():
    free = replace(CAR, com_ahead_m=0.3, front_cornering_npr=30000.0)
    for speed, added in ((8.0, -0.01), (-8.0, 0.1), (-3.0, 0.1)):
        out = moved(np.full(3000, speed), 0.1, values={"understeer_s2pm": added}, robot=free)
        kinematic = abs(speed) * math.tan(0.1) / free.wheelbase_m
        assert np.isfinite(out).all()
        assert np.abs(out[:, W]).max() <= kinematic / LEAST_RATIO * (1 + 1e-9)


def test_extreme_values_of_every_effect_and_input_stay_finite():
    rng = np.random.default_rng(3)
    speed, steer = rng.normal(0.0, 5.0, 500), rng.normal(0.0, 3.0, 500)
    for effect in library_of("bicycle"):
        for bounds in (
            {p.name: p.low for p in effect.parameters},
            {p.name: p.high for p in effect.parameters},
        ):
            assert np.isfinite(moved(speed, steer, 0.3, bounds, grade=0.3, ground=Ground())).all(), (
                effect.name
            )


def test_effects_are_other_numbers_of_the_robot():
    t = DT * np.arange(1500)
    drive = 2.0 + np.sin(0.5 * t), 0.2 * np.sin(1.1 * t)
    values = {"cornering_stiffness_ratio": -0.4}
    softer = apply_homes(replace(CAR, effects=values))
    assert (softer.front_cornering_npr, softer.rear_cornering_npr) == (7200.0, 10800.0)
    np.testing.assert_allclose(moved(*drive, values=values), moved(*drive, robot=softer), atol=1e-12)
    yields = 1.0 / CAR.front_cornering_npr + 0.03 * CAR.wheelbase_m / (CAR.mass_kg * CAR.com_ahead_m)
    turning_less = replace(CAR, front_cornering_npr=1.0 / yields)
    assert understeer(turning_less) == pytest.approx(understeer(CAR) + 0.03)
    assert turning_less.understeer_s2pm == pytest.approx(understeer(turning_less))
    by_effect = moved(*drive, values={"understeer_s2pm": 0.03})
    np.testing.assert_allclose(by_effect, moved(*drive, robot=turning_less), atol=1e-12)
    loaded, soft = moved(*drive, values={"payload_ratio": 0.25}), 1.0 / 1.25 - 1.0
    same = moved(*drive, values={"cornering_stiffness_ratio": soft})
    np.testing.assert_allclose(loaded[:, [VY, W]], same[:, [VY, W]], atol=1e-12)
