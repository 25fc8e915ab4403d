"""How long a step of the adaptive observer of tracked vehicles takes, beside the same step in plain numpy."""

import math
import time

import numpy as np
import pytest

from terrain.estimation.observers.tracked import tracked_observer
from terrain.robots import load_robot

N_STEPS, DT_S = 2000, 0.02
MOST_US = 10.0
"""Of a step and what it says, called from the interpreter: a two-thousandth of a period of 20 ms."""
ROBOT = load_robot("orchard_ugv")
D = ROBOT.half_track_m


def rows():
    """A circle with raw fixes at every fifth tick, (n, 6)."""
    rng, time_s = np.random.default_rng(0), np.arange(N_STEPS) * DT_S
    given = np.full((N_STEPS, 6), np.nan)
    given[:, 0], given[:, 1] = 0.4, 0.6
    yaw = 0.04 * time_s
    pose = np.stack([11.5 * np.sin(yaw), 11.5 * (1 - np.cos(yaw)), yaw], axis=-1)
    given[::5, 2:5] = pose[::5] + rng.normal(size=(N_STEPS // 5, 3)) * [0.02, 0.02, 0.009]
    return given


def with_compiled_observer(given):
    observer = tracked_observer(ROBOT)
    memory = np.array(observer.start)
    for row in given:
        memory = observer.step(observer.params, memory, row, DT_S)
        reading = observer.read(observer.params, memory)
    return reading.mean[5:7]


def with_plain_numpy(given):
    """(8) by the midpoint rule with L and Lambda the identity: no covariance, gate or status."""
    eta, error, fix, travel, span, heading = (
        np.ones(2),
        np.zeros(3),
        given[0, 2:5],
        np.zeros((3, 2)),
        0.0,
        0.0,
    )
    for row in given[1:]:
        turn = DT_S * (eta[1] * row[1] - eta[0] * row[0]) / (2 * D)
        cos, sin = math.cos(heading + turn / 2) / 2, math.sin(heading + turn / 2) / 2
        columns = np.array([[cos, cos], [sin, sin], [-1 / (2 * D), 1 / (2 * D)]])
        travel = travel + DT_S * columns * row[:2]
        span, heading = span + DT_S, heading + turn
        pose = fix - error + travel @ eta
        if not np.isnan(row[2:5]).any():
            a = (1 + span / 2) * np.eye(3) + travel @ travel.T / 4
            middle = np.linalg.solve(a, error + (row[2:5] - fix - travel @ eta) / 2)
            error, eta = 2 * middle - error, eta + travel.T @ middle
            fix, travel, span, heading = row[2:5], np.zeros((3, 2)), 0.0, row[4]
    assert np.isfinite(pose).all()
    return eta


@pytest.mark.benchmark(group=f"{N_STEPS} steps of the adaptive observer", timer=time.process_time)
@pytest.mark.parametrize("run", [with_compiled_observer, with_plain_numpy])
def test_a_step_and_its_reading(benchmark, run):
    given = rows()
    np.testing.assert_allclose(benchmark(run, given), [1.1, 0.8], atol=0.02)
    if benchmark.stats and run is with_compiled_observer:  # absent where benchmarks are off
        assert benchmark.stats.stats.min / N_STEPS * 1e6 < MOST_US
