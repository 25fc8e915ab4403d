"""How long a minute takes to simulate: ``pytest tests/benchmarks --benchmark-enable``, on one core."""

import pytest

from terrain.robots import load_robot
from terrain.simulation.run import simulate
from terrain.simulation.scenario import make_scenario
from terrain.terramechanics.soil import load_soil

TIMES_REAL_TIME = 100.0  #: The bar: a minute in 0.6 s


@pytest.mark.benchmark(group="simulate a minute on grass, bar 0.6 s")
@pytest.mark.parametrize("scenario", ["complex", "straight"])
def test_a_minute_on_grass(benchmark, scenario):
    robot, soils = load_robot("agrimaro"), {"grass": load_soil("grass")}
    drive = make_scenario(scenario, robot, "grass", 60.0)
    simulate(
        robot, make_scenario("straight", robot, "grass", 4.0), soils, 0
    )  # compiled, or read from the cache
    run = benchmark(simulate, robot, drive, soils, 0)
    assert run.streams["truth"].time_s[-1] == pytest.approx(60.01)
    if benchmark.stats:  # absent where benchmarks are off
        benchmark.extra_info["times_real_time"] = 60.0 / benchmark.stats.stats.median
        assert benchmark.extra_info["times_real_time"] > TIMES_REAL_TIME
