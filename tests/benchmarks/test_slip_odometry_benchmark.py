"""How long a step of an odometry of tracked robots takes: ``pytest tests/benchmarks --benchmark-enable``.

A step and its reading are called from Python, as in a live run; at most 10 microseconds are allowed.
"""

import time

import numpy as np
import pytest

from terrain.estimation.observers.plain_odometry import gyrodometry_observer
from terrain.estimation.observers.slip_learning import slip_learning_observer
from terrain.estimation.observers.slip_model import SlipModel
from terrain.estimation.observers.slip_odometry import slip_odometry_observer
from terrain.robots import load_robot

ROBOT = load_robot("patako")
MODEL = SlipModel(0.85, 0.05, 0.4, 0.2, 0.5, np.full(8, 0.02), turn_side_m=0.3, turn_shift_m=0.1)
OBSERVERS = {
    "slip-odometry": slip_odometry_observer(ROBOT, MODEL),
    "gyrodometry": gyrodometry_observer(ROBOT),
    "slip-learning": slip_learning_observer(ROBOT),
}
N_STEPS = 2000


@pytest.mark.benchmark(group=f"{N_STEPS} steps of odometry with reading", timer=time.process_time)
@pytest.mark.parametrize("name", OBSERVERS)
def test_a_step_with_its_reading(benchmark, name):
    observer = OBSERVERS[name]
    rows = np.tile([-0.02, 0.12, 0.25, 0.1, -0.05, 0.0, 0.0, 0.0], (N_STEPS, 1))[:, : len(observer.rows)]
    rows[np.arange(N_STEPS) % 5 > 0, 5:] = np.nan  # fixes at a fifth of the rate
    rows[:, 0] += 0.001 * np.random.default_rng(0).standard_normal(N_STEPS)

    def run():
        memory = observer.start
        for row in rows:
            memory = observer.step(observer.params, memory, row, 0.02)
            found = observer.read(observer.params, memory)
        return found

    assert np.isfinite(benchmark(run).std[:6]).all()
