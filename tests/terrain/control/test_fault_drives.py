"""A pilot that fails keeps its last command, and the sensors that it names are recorded."""

import math
from enum import Enum

import numpy as np
import pytest

from terrain.control.fault_drives import GuardedPilot, named_sensors
from terrain.control.traction import TractionStatus
from terrain.records import Command, Sample


class FakePilot:
    """Commands the step's number, and fails as it is asked to."""

    estimate = None

    def __init__(self, fails=(), health=None):
        self.k, self.fails, self.command = -1, dict(fails), None
        if health is not None:
            self.health = health

    def step(self, sample):
        self.k += 1
        wheels = np.full(3, float(self.k))
        wrong = self.fails.get(self.k)
        if wrong == "raise":
            raise ValueError("no such row")
        if wrong == "nan":
            wheels[1] = math.nan
        if wrong == "shape":
            wheels = np.zeros(2)
        if wrong == "text":
            wheels = ["fast"] * 3
        return Command(wheels, np.zeros(3), np.zeros(3), {"status_code": 0.0, "slip_ratio": 0.1})


def driven(pilot, n=6):
    guarded = GuardedPilot(pilot)
    return guarded, [guarded.step(Sample(0.02 * k, np.zeros(3), {})) for k in range(n)]


def test_a_pilot_that_fails_keeps_its_last_command_and_is_counted():
    guarded, commands = driven(FakePilot({2: "raise", 3: "nan", 4: "shape", 5: "text"}))
    assert [command.wheel_radps[0] for command in commands] == [0.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    assert (guarded.n_exceptions, guarded.n_not_finite) == (1, 3)
    assert guarded.exception == "ValueError: no such row"
    codes = [command.status["status_code"] for command in commands]
    assert codes == [TractionStatus.OK] * 2 + [TractionStatus.NO_SLIP] * 4
    assert driven(FakePilot())[0].exception == ""
    with pytest.raises(ValueError, match="no such row"):
        driven(FakePilot({0: "raise"}))


class Health(Enum):
    FRESH = 0
    LOST = 1


@pytest.mark.parametrize("health", [{"imu": "lost"}, lambda: {"imu": Health.LOST, "wheels": Health.FRESH}])
def test_the_sensors_that_a_pilot_names_are_recorded(health):
    guarded, _ = driven(FakePilot(health=health))
    assert named_sensors(guarded.health, [True] * 6, 0.02) == {"imu": "lost"}
    assert named_sensors(guarded.health, [True] * 4 + [False] * 2, 0.02) == {}  # for 0.08 s
    assert named_sensors(driven(FakePilot())[0].health, [True] * 6, 0.02) is None
