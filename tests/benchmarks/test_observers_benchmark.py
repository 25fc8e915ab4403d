"""How long a step of an observer takes, called from Python as in a live run; at most half a millisecond is allowed.

``pytest tests/benchmarks/test_observers_benchmark.py --benchmark-enable``
"""

import time

import numpy as np
import pytest

from terrain.estimation.models.choice import OBSERVERS, make_observer, observers_of
from terrain.estimation.models.observer import FIX_ROWS, PLACE_ROWS
from terrain.estimation.models.slip_model import SlipModel
from terrain.robots import load_robot

N_STEPS = 1000
MOST_S = 5e-4
PATAKO, CAR = load_robot("patako"), load_robot("adap2e")
MODEL = SlipModel(0.85, 0.05, 0.4, 0.2, 0.5, np.full(8, 0.02), turn_side_m=0.3, turn_shift_m=0.1)
DRIVEN = {
    "speed_left_mps": 0.19,
    "speed_right_mps": 0.21,
    "speed_rear_mps": 0.2,
    "steer_front_rad": 0.05,
    "yaw_rate_radps": 0.05,
    "roll_rad": 0.1,
    "pitch_rad": -0.05,
    "accel_y_mps2": 0.7,
}


@pytest.mark.benchmark(group=f"{N_STEPS} steps of an observer", timer=time.process_time)
@pytest.mark.parametrize("name", OBSERVERS)
def test_a_step(benchmark, name):
    robot = PATAKO if name in observers_of(PATAKO) else CAR
    names = make_observer(name, robot, MODEL).rows
    rows = np.tile([DRIVEN.get(row, np.nan) for row in names], (N_STEPS, 1))
    fix = [names.index(row) for row in (*PLACE_ROWS, *FIX_ROWS["pose"]) if row in names]
    time_s = 0.02 * np.arange(N_STEPS)
    pose = np.stack([4.0 * np.sin(0.05 * time_s), 4.0 * (1 - np.cos(0.05 * time_s)), 0.05 * time_s], axis=1)
    rows[:, fix] = np.where((np.arange(N_STEPS) % 5 == 0)[:, None], pose[:, : len(fix)], np.nan)

    def run():
        observer = make_observer(name, robot, MODEL)
        for row in rows:
            output = observer.step(row, 0.02)
        return output

    assert np.isfinite(benchmark(run).mean[:2]).all()
    if benchmark.stats:  # absent where benchmarks are off
        assert benchmark.stats.stats.min / N_STEPS < MOST_S
