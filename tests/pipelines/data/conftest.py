"""A run of a swerve robot with its estimates, simulated and filtered once for all tests of this room."""

import pytest

from terrain.estimation.estimate import enriched, estimate_run
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run


@pytest.fixture(scope="session")
def estimated_run():
    robot = load_robot("agrimaro")
    return enriched(estimate_run(simulate_run(robot, "grass", "survey", 7, duration_s=8.5), robot, "vio15"))
