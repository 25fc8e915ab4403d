"""How long live estimation takes a tick: ``pytest tests/benchmarks --benchmark-enable``."""

import time

import pytest

from terrain.estimation.live import CHANNELS, make_live_filter
from terrain.logs.replay import replay
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

MOST_US = 500.0  #: A robot commands at 50 to 100 Hz: half a millisecond of a step is fast enough


@pytest.mark.benchmark(timer=time.process_time)
def test_a_live_step_leaves_a_control_loop_its_time(benchmark):
    robot = load_robot("agrimaro")
    samples = list(replay(simulate_run(robot, "grass", "straight", 0, duration_s=5.0)))

    def drive():
        estimator = make_live_filter("vio15", robot, CHANNELS)
        return sum(len(estimator.step(sample.readings)) for sample in samples)

    assert benchmark(drive) >= len(samples) - 1
    if benchmark.stats:  # absent where benchmarks are off
        assert benchmark.stats.stats.min / len(samples) * 1e6 < MOST_US
