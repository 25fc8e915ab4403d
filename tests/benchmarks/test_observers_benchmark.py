"""How long a step of each observer takes with its reading: at most 10 us, beside (8) and (9) of two in plain numpy.

``pytest tests/benchmarks/test_observers_benchmark.py --benchmark-enable``; called from Python, as in a live run.
"""

import math
import time

import numpy as np
import pytest

from terrain.estimation.observers.plain_odometry import gyrodometry_observer
from terrain.estimation.observers.sideslip_dynamic import sideslip_dynamic_observer
from terrain.estimation.observers.sideslip_kinematic import sideslip_kinematic_observer
from terrain.estimation.observers.sideslip_multi import sideslip_multi_observer
from terrain.estimation.observers.slip_learning import slip_learning_observer
from terrain.estimation.observers.slip_model import SlipModel
from terrain.estimation.observers.slip_odometry import slip_odometry_observer
from terrain.estimation.observers.tracked import tracked_observer
from terrain.robots import load_robot

N_STEPS, DT_S = 2000, 0.02
MOST_US = 10.0  #: A two-thousandth of a period of 20 ms
CAR, ORCHARD, PATAKO = (load_robot(name) for name in ("adap2e", "orchard_ugv", "patako"))
MODEL = SlipModel(0.85, 0.05, 0.4, 0.2, 0.5, np.full(8, 0.02), turn_side_m=0.3, turn_shift_m=0.1)


def car_rows():
    """A steady circle with a pose at every fifth tick, (n, 8)."""
    yaw = 0.17 * DT_S * np.arange(N_STEPS)
    rows = np.full((N_STEPS, 8), np.nan)
    rows[:, [0, 1, 5, 6, 7]] = 4.0, 0.05, 0.17, 0.0, 0.7
    rows[::5, 2:5] = np.stack([np.sin(yaw) / 0.0425, (1 - np.cos(yaw)) / 0.0425, yaw], axis=-1)[::5]
    return rows


def track_rows():
    """A circle with raw fixes at every fifth tick, (n, 6)."""
    rng, yaw = np.random.default_rng(0), 0.04 * DT_S * np.arange(N_STEPS)
    rows = np.full((N_STEPS, 6), np.nan)
    rows[:, :2] = 0.4, 0.6
    pose = np.stack([11.5 * np.sin(yaw), 11.5 * (1 - np.cos(yaw)), yaw], axis=-1)
    rows[::5, 2:5] = pose[::5] + rng.normal(size=(N_STEPS // 5, 3)) * [0.02, 0.02, 0.009]
    return rows


def odometry_rows():
    """Two belts, a gyro and an accelerometer, with fixes at a fifth of the rate, (n, 8)."""
    rows = np.tile([-0.02, 0.12, 0.25, 0.1, -0.05, 0.0, 0.0, 0.0], (N_STEPS, 1))
    rows[np.arange(N_STEPS) % 5 > 0, 5:] = np.nan
    rows[:, 0] += 0.001 * np.random.default_rng(0).standard_normal(N_STEPS)
    return rows


OBSERVERS = {
    "kinematic": (lambda: sideslip_kinematic_observer(CAR), car_rows),
    "dynamic": (lambda: sideslip_dynamic_observer(CAR), car_rows),
    "multi": (lambda: sideslip_multi_observer(CAR), car_rows),
    "tracked": (lambda: tracked_observer(ORCHARD), track_rows),
    "slip-odometry": (lambda: slip_odometry_observer(PATAKO, MODEL), odometry_rows),
    "gyrodometry": (lambda: gyrodometry_observer(PATAKO), odometry_rows),
    "slip-learning": (lambda: slip_learning_observer(PATAKO), odometry_rows),
}
GROUP = f"{N_STEPS} steps of an observer with their readings"


@pytest.mark.benchmark(group=GROUP, timer=time.process_time)
@pytest.mark.parametrize("name", OBSERVERS)
def test_a_step_with_its_reading(benchmark, name):
    observer, rows = (make() for make in OBSERVERS[name])
    rows = rows[:, : len(observer.rows)]

    def run():
        memory = np.array(observer.start)
        for row in rows:
            memory = observer.step(observer.params, memory, row, DT_S)
            reading = observer.read(observer.params, memory)
        return reading

    reading = benchmark(run)
    assert np.isfinite(reading.mean[:6]).all()
    if name == "tracked":
        np.testing.assert_allclose(reading.mean[5:7], [1.1, 0.8], atol=0.02)
    if benchmark.stats:  # absent where benchmarks are off
        assert benchmark.stats.stats.min / N_STEPS * 1e6 < MOST_US


def tracked_by_numpy():
    """(8) by the midpoint rule with L and Lambda the identity: no covariance, gate or status."""
    rows, half_m = track_rows(), ORCHARD.half_track_m
    eta, error, fix = np.ones(2), np.zeros(3), rows[0, 2:5]
    travel, span, heading = np.zeros((3, 2)), 0.0, 0.0
    for row in rows[1:]:
        turn = DT_S * (eta[1] * row[1] - eta[0] * row[0]) / (2 * half_m)
        cos, sin = math.cos(heading + turn / 2) / 2, math.sin(heading + turn / 2) / 2
        columns = np.array([[cos, cos], [sin, sin], [-1 / (2 * half_m), 1 / (2 * half_m)]])
        travel = travel + DT_S * columns * row[:2]
        span, heading = span + DT_S, heading + turn
        if not np.isnan(row[2:5]).any():
            a = (1 + span / 2) * np.eye(3) + travel @ travel.T / 4
            middle = np.linalg.solve(a, error + (row[2:5] - fix - travel @ eta) / 2)
            error, eta = 2 * middle - error, eta + travel.T @ middle
            fix, travel, span, heading = row[2:5], np.zeros((3, 2)), 0.0, row[4]
    return eta


def sideslip_by_numpy():
    """Lines of (8) and (9) alone, without gates, statuses and covariance."""
    base, inertia, mass = 1.2, 200.0, 420.0
    dyn, slip, stiffness = np.zeros(2), np.zeros(2), np.full(2, 15000.0)
    for row in car_rows():
        u, steer, rate = row[0], row[1], row[5]
        by_force = np.array(
            [[-0.6 * np.cos(steer) / inertia, 0.6 / inertia], [-np.cos(steer) / mass, -1 / mass]]
        )
        side = u * (0.6 * np.tan(steer + slip[0]) + 0.6 * np.tan(slip[1])) / base
        dyn = dyn + DT_S * (by_force @ (stiffness * slip) - np.array([0.0, u * rate]))
        error = np.array([rate, side]) - dyn
        by_slip, by_stiffness = by_force * stiffness, by_force * slip
        gain = np.eye(2) * 1.4 + 4e-4 * (1e-2 * by_slip @ by_slip.T + 1e9 * by_stiffness @ by_stiffness.T)
        error = np.linalg.solve(gain, error)
        dyn, slip = dyn + 0.4 * error, slip + 2e-4 * by_slip.T @ error
        stiffness = stiffness + 2e7 * by_stiffness.T @ error
    return slip


@pytest.mark.benchmark(group=GROUP, timer=time.process_time)
@pytest.mark.parametrize("run", [tracked_by_numpy, sideslip_by_numpy])
def test_plain_numpy(benchmark, run):
    assert np.isfinite(benchmark(run)).all()
