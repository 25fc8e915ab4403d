"""Drives of the live chain's tests, simulated once."""

import pytest

from terrain.robots import load_robot
from terrain.simulation.run import simulate_run


@pytest.fixture(scope="session")
def survey():
    """A drive of AgriMaRo on grass with every kind of motion."""
    return simulate_run(load_robot("agrimaro"), "grass", "survey", 6, duration_s=25.0)
