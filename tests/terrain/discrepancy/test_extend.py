import numpy as np
import pytest

from terrain.discrepancy.extend import extend
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.verdict import Cause, Diagnosis, Value
from terrain.errors import ConfigError
from terrain.robots import load_robot


def diagnosis(causes=(), robot="husky"):
    verdict = "explained" if causes else "none"
    lists = (), (), (), (), (), ()
    return Diagnosis(robot, verdict, tuple(causes), (), np.empty((0, 0)), (), {}, *lists, None, {}, {}, 4)


def cause(name, parameter, value):
    told = Value(parameter, value, parameter.rpartition("_")[2], value - 0.01, value + 0.01)
    return Cause(name, (), (told,), 0.2, 0.1, 0.3, ("speed_x_mps",), 9.0, 5.0)


def test_causes_are_added_to_what_is_built_in_already():
    simulation = Simulation(
        load_robot("husky"),
        effects={"payload_ratio": 0.1, "scrub_ratio": 0.02},
        scatter={"gyro_bias_radps": 0.1},
    )
    found = extend(
        simulation,
        diagnosis([cause("payload", "payload_ratio", 0.05), cause("gyro_scale", "gyro_scale_ratio", 0.02)]),
    )
    assert found.effects == pytest.approx(
        {"payload_ratio": 0.15, "scrub_ratio": 0.02, "gyro_scale_ratio": 0.02}
    )
    assert (found.robot, found.ground, found.scatter) == (
        simulation.robot,
        simulation.ground,
        simulation.scatter,
    )


def test_nothing_named_and_another_robot_are_refused():
    simulation = Simulation(load_robot("husky"))
    with pytest.raises(ConfigError, match="names no cause"):
        extend(simulation, diagnosis())
    with pytest.raises(ConfigError, match="'agrimaro'"):
        extend(simulation, diagnosis([cause("payload", "payload_ratio", 0.05)], "agrimaro"))
