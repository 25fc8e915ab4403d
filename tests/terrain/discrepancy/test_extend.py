from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from terrain.discrepancy.diagnosed_runs import extend, extended_effects
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.verdict import INTERVAL_T, Cause, Diagnosis, Value, Verdict
from terrain.errors import ConfigError
from terrain.robots import load_robot


def diagnosis(causes=(), robot="husky"):
    verdict = Verdict.EXPLAINED if causes else Verdict.NONE
    lists = (), (), (), (), (), ()
    return Diagnosis(robot, verdict, tuple(causes), (), np.empty((0, 0)), (), {}, *lists, None, {}, {}, 4)


def cause(name, parameter, value):
    fitted = Value(parameter, value, parameter.rpartition("_")[2], value - 0.01, value + 0.01)
    return Cause(name, (), (fitted,), 0.2, 0.1, 0.3, ("speed_x_mps",), 9.0, 5.0)


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


def test_the_covariance_of_what_is_found_again_replaces_the_known_one():
    diagnosis = SimpleNamespace(
        parameters=("lever_x_m", "lever_y_m"),
        values={"lever_x_m": 0.1, "lever_y_m": -0.05},
        cov=np.array([[4.0, 1.0], [1.0, 9.0]]) * 1e-6,
    )
    known = {"lever_x_m": 0.2, "payload_ratio": 0.1}
    robot = replace(
        load_robot("husky"), effects=known, effects_cov=np.array([[1.0, 0.5], [0.5, 16.0]]) * 1e-4
    )
    values, cov, intervals = extended_effects(robot, diagnosis)
    assert values == pytest.approx({"lever_x_m": 0.3, "payload_ratio": 0.1, "lever_y_m": -0.05})
    np.testing.assert_allclose(cov, [[4e-6, 0, 1e-6], [0, 16e-4, 0], [1e-6, 0, 9e-6]])
    assert intervals["payload_ratio"] == pytest.approx((0.1 - INTERVAL_T * 0.04, 0.1 + INTERVAL_T * 0.04))
    with pytest.raises(ConfigError, match="no covariance"):
        extended_effects(replace(load_robot("husky"), effects=known), diagnosis)
