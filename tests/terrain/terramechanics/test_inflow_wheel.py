"""A wheel at a slip angle, its stresses and its sinkage: symmetry, limits, and the kernel against plain quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest

from terrain.terramechanics.inflow_wheel import (
    FORCE,
    INFLOW_EXPONENT,
    NAMES,
    UNIT_WEIGHT_NPM3,
    wheel_forces,
)
from terrain.terramechanics.travel_sinkage import TRAVEL, travel_sinkage

R, B, V, LOAD = 0.058, 0.05, 0.01, 22.0


def vector(**changes):
    named = {name: entry[0] for name, entry in FORCE.items()} | changes
    return np.array([named[name] for name in NAMES])


def forces(p, wheel_mps, angle_rad, depth_m, load_n=LOAD):
    trials = np.array([[wheel_mps / R, V, angle_rad, load_n]])
    return wheel_forces(p, R, B, trials, np.array([depth_m]))[0]


def quadrature(p, wheel_mps, angle, h, n=20001):
    """The documented integrals over many points, all at once; no numba, no loop."""
    q = dict(zip(NAMES, p, strict=True))
    omega, ahead, across = wheel_mps / R, V * math.cos(angle), V * math.sin(angle)
    slip = max((wheel_mps - V) / max(wheel_mps, V), 0.0)
    tf = math.acos(1 - h / R)
    tr = -np.clip(q["exit_ratio"] + q["exit_slip_ratio"] * slip, 0, 1) * tf
    tm = (q["peak_ratio"] + q["peak_slip_ratio"] * slip) * tf
    t = np.linspace(-tf, tf, n)
    seen = np.where(t >= tm, t, tf - (t - tr) / (tm - tr) * (tf - tm))
    lag = np.minimum((tf - t) / max(omega, 1e-12), R * (math.sin(tf) - np.sin(t)).clip(0) / max(ahead, 1e-12))
    part = (1 - across * lag / B).clip(0) * math.cos(angle) ** INFLOW_EXPONENT if q["inflow"] else 1.0

    def shape(angles):
        return ((R * (np.cos(angles) - math.cos(tf))).clip(0) / B) ** q["pressure_exponent"]

    inside = t > tr
    pressure = np.where(inside, part * shape(seen), 0) + q["side_inflow_ratio"] * math.sin(angle) * shape(t)
    over = wheel_mps - ahead * np.cos(t)
    size = np.hypot(over, across) + 1e-12
    slow = max(wheel_mps, 1e-2 * V)
    j = np.hypot(R * ((tf - t) - ahead / slow * (math.sin(tf) - np.sin(t))), R * (tf - t) * across / slow)
    sheared = 1 - np.exp(-j / q["shear_modulus_m"])
    sums = []
    for normal, stress in (
        (pressure, pressure * q["tan_friction"] * sheared),
        (0 * t, np.where(inside, q["cohesion_pa"], 0) * sheared),
    ):
        along = stress * over / size
        parts = (
            along * np.cos(t) - normal * np.sin(t),
            stress * across / size,
            normal * np.cos(t) + along * np.sin(t),
        )
        sums.append([R * B * np.trapezoid(part, t) for part in parts])
    d = np.linspace(0, h, n)
    e = R - h + d
    width = 2 * np.sqrt((R * R - e * e).clip(0))
    normal = UNIT_WEIGHT_NPM3 * q["side_pressure_ratio"] * B * (d / B) ** q["side_depth_exponent"] * width
    normal = normal * math.sin(angle) ** q["travel_exponent"]
    normal = normal * (V / np.hypot(V, omega * e)) ** q["rotation_exponent"]
    rub = omega * e - ahead
    length = np.hypot(rub, across) + 1e-15
    side_x = np.trapezoid(q["side_friction_ratio"] * normal * rub / length, d)
    side_y = np.trapezoid(normal, d)
    side_z = np.trapezoid(q["side_lift_ratio"] * normal * across / length, d)
    amplitude = (LOAD - side_z - sums[1][2]) / sums[0][2]
    across_n = amplitude * sums[0][1] + sums[1][1] + side_y
    pull_n = amplitude * sums[0][0] + sums[1][0] + side_x + q["coupling_ratio"] * across_n
    return pull_n, across_n, amplitude


def test_the_kernel_agrees_with_plain_quadrature():
    p = vector(cohesion_pa=200.0, coupling_ratio=-0.1, pressure_exponent=0.6)
    for angle_deg, depth_m in ((0, 0.02), (30, 0.03), (75, 0.045)):
        for wheel_mps in (0.0, 0.005, 0.01, 0.04):
            found = forces(p, wheel_mps, math.radians(angle_deg), depth_m)
            plain = quadrature(p, wheel_mps, math.radians(angle_deg), depth_m)
            assert found[:2] == pytest.approx(plain[:2], abs=0.02 * LOAD)
            assert found[2] == pytest.approx(plain[2], rel=0.03)


def test_no_slip_angle_no_side_force_and_turning_it_round_turns_the_side_force_alone():
    for wheel_mps in (0.0, 0.008, 0.01, 0.1):
        assert forces(vector(), wheel_mps, 0.0, 0.02)[1] == 0.0
        small, smaller = (forces(vector(), wheel_mps, angle, 0.02)[1] for angle in (1e-2, 1e-3))
        assert 0.0 < smaller < 0.5 * small < 0.1 * LOAD
        left, right = (forces(vector(), wheel_mps, angle, 0.03) for angle in (0.7, -0.7))
        assert right.tolist() == [left[0], -left[1], left[2]]
    pull_n, side_n, _ = forces(vector(), 0.0, math.pi / 2, 0.05)
    assert abs(pull_n) < 1e-9 * side_n  # locked, and dragged along its axle
    one, two = (forces(vector(), 0.012, 0.0, 0.02, load) for load in (10.0, 20.0))
    assert two == pytest.approx(2.0 * one)


def test_without_a_side_face_force_stays_within_friction_of_the_ground():
    """The shear stress is at most c + p tan(phi), so that side force is at most the arc's friction."""
    p = vector(side_pressure_ratio=0.0, side_lift_ratio=0.0, cohesion_pa=0.0)
    for angle in (0.2, 0.8, 1.3):
        for wheel_mps in (0.008, 0.01, 0.05):
            side_n = forces(p, wheel_mps, angle, 0.01)[1]
            assert 0.0 < side_n < 1.25 * LOAD * p[NAMES.index("tan_friction")]


def depth(wheel_mps, angle_rad):
    start, motion = np.array([value for value, _ in TRAVEL.values()]), ([wheel_mps], [V], [angle_rad])
    return float(travel_sinkage(start, *map(np.array, motion), R)[0])


def test_a_wheel_sinks_deeper_by_slip_skid_and_angle_down_to_its_axle():
    assert depth(0.01, 0.0) == pytest.approx(TRAVEL["rolling_m"][0])
    assert depth(0.0, np.pi / 2) == pytest.approx(R)
    assert depth(0.0, 0.0) > depth(0.005, 0.0) > depth(0.01, 0.0) < depth(0.02, 0.0) < depth(0.1, 0.0)
    for wheel_mps in (0.0, 0.01, 0.05):
        assert depth(wheel_mps, 0.6) == depth(wheel_mps, -0.6)
        assert (np.diff([depth(wheel_mps, angle) for angle in np.linspace(0.2, 1.5, 9)]) > 0.0).all()
