"""The limit of the explicit step: sharp, on any ground, and refused with a margin."""

import dataclasses
import math

import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.robots import load_robot
from terrain.simulation.conditions import Conditions
from terrain.simulation.contact import DEFLECTION_DAMPING_S
from terrain.simulation.dynamic.plant import make_plant
from terrain.simulation.dynamic.profile import uniform_profile
from terrain.simulation.dynamic.simulate import simulate
from terrain.simulation.dynamic.states import start_state
from terrain.simulation.dynamic.step import advance, settle
from terrain.simulation.dynamic.step_limit import (
    CONTACT_LIMIT_PS2,
    LOAD_MARGIN_RATIO,
    check_step,
    contact_ratio,
    tyre_ratio,
)
from terrain.simulation.scenario.make import make_scenario
from terrain.simulation.sensors.motion import N_RECORD, STEP_S, Motion
from terrain.terramechanics.soil import load_soil

ROBOT = load_robot("agrimaro")
SOILS = ("tiles", "asphalt", "grass", "tilled_loam", "snow")


def plant_on(soil, roughness_m3=0.0):
    profile = uniform_profile(ROBOT, load_soil(soil), roughness_m3=roughness_m3)
    return make_plant(ROBOT, Conditions(), profile)


def loaded(plant, ratio):
    """The plant with a mass, and the yaw inertia that goes with it, that brings its contacts to a ratio."""
    low, high = 1.0, 1e6
    for _ in range(60):
        factor = math.sqrt(low * high)
        heavier = plant._replace(
            mass_kg=plant.mass_kg * factor, yaw_inertia_kgm2=plant.yaw_inertia_kgm2 * factor
        )
        low, high = (factor, high) if contact_ratio(heavier) < ratio else (low, factor)
    return heavier


def driven(plant, duration_s=6.0, seed=None):
    """What happens under equal commands that rise to 1 m/s within a second."""
    n = round(duration_s / STEP_S)
    wheel = np.repeat(5.0 * np.minimum(np.arange(n) * STEP_S, 1.0)[:, None], 3, axis=1)
    noise = np.zeros((n, 3)) if seed is None else np.random.default_rng(seed).standard_normal((n, 3))
    record, state = np.empty((n, N_RECORD)), start_state(plant, np.zeros(3))
    settle(plant, state)
    advance(plant, state, wheel, np.zeros((n, 3)), 1, noise, record)
    return Motion(record)


def change_of_rate_radps(motion):
    """The largest change of a wheel's rate from step to step in the last half second."""
    return np.abs(np.diff(motion.wheel("wheel_radps")[-500:], axis=0)).max()


def test_the_roots_of_the_step_are_on_the_unit_circle_at_the_limit():
    for factor, stable in ((0.999, True), (1.001, False)):
        k, damping_s = factor * CONTACT_LIMIT_PS2, DEFLECTION_DAMPING_S
        rate = np.array([1.0 - STEP_S * k * damping_s, -STEP_S * k])  # of x and u
        step = np.array([rate, STEP_S * rate + [0.0, 1.0]])
        assert (np.abs(np.linalg.eigvals(step)).max() < 1.0) == stable


@pytest.mark.parametrize("soil", SOILS)
def test_wheels_roll_evenly_below_the_limit_and_change_their_sign_above_it(soil):
    """Above it, the torque of the motors could not do this: 60 Nm move a wheel by 0.4 rad/s in a step."""
    plant = plant_on(soil)
    assert change_of_rate_radps(driven(loaded(plant, 0.93))) < 0.01
    assert change_of_rate_radps(driven(loaded(plant, 1.07))) > 0.4


def test_the_inertia_of_yaw_counts():
    """A mass without the inertia that goes with it turns by its side forces: it is refused, and rightly."""
    plant = plant_on("tiles")
    slim = plant._replace(mass_kg=600.0, yaw_inertia_kgm2=0.01)
    assert contact_ratio(slim) > 1.0 > contact_ratio(slim._replace(yaw_inertia_kgm2=200.0))
    slim_turns, stout_turns = (
        np.abs(driven(one, 2.0).body("yaw_rate_radps")).max()
        for one in (slim, slim._replace(yaw_inertia_kgm2=200.0))
    )
    assert stout_turns < 0.01
    assert not slim_turns < 1.0  # or NaN


@pytest.mark.parametrize("soil", SOILS)
def test_what_is_accepted_gains_no_momentum_that_the_motors_did_not_give(soil):
    """On ground as rough as a field, at the largest mass that is accepted."""
    plant = loaded(plant_on(soil, roughness_m3=load_soil(soil).roughness_m3), 0.99 / LOAD_MARGIN_RATIO)
    check_step(plant, "agrimaro")
    motion = driven(plant, seed=3)
    push_ns = STEP_S * np.cumsum((motion.wheel("torque_nm") / plant.radius_m).sum(axis=1))
    spin_ns = (plant.wheel_inertia_kgm2 * motion.wheel("wheel_radps") / plant.radius_m).sum(axis=1)
    momentum_ns = plant.mass_kg * motion.body("speed_x_mps")
    # what resists only takes from it
    assert (momentum_ns <= push_ns - spin_ns + 0.01 * plant.mass_kg).all()
    assert change_of_rate_radps(motion) < 0.4


def test_a_light_robot_on_stiff_tyres_is_refused():
    plant = plant_on("grass")
    limit_kg = STEP_S * (STEP_S * plant.ride_stiffness_npm + 2 * plant.ride_damping_nspm) / 4
    for factor, accepted in ((0.99, False), (1.01, True)):
        mass_kg = factor * limit_kg / plant.load_fraction.min()
        light = plant._replace(mass_kg=mass_kg)
        assert (tyre_ratio(light) < 1.0) == accepted
        motion = driven(light._replace(roughness_m3=np.array([1e-6])), 2.0, seed=4)
        load_n = motion.wheel("normal_n")
        even = np.isfinite(load_n).all() and load_n.max() < 100 * mass_kg * GRAVITY_MPS2
        assert even == accepted


@pytest.mark.parametrize(
    ("changes", "conditions", "why"),
    [
        ({"mass_kg": 1e5}, {}, "contacts are"),
        ({"mass_kg": 2e4}, {}, "contacts are"),
        ({"mass_kg": 0.1}, {}, "tyres are"),
        ({}, {"payload_kg": 1e5}, "contacts are"),
    ],
)
def test_a_mass_out_of_scale_is_refused_in_one_sentence(changes, conditions, why):
    robot = dataclasses.replace(ROBOT, **changes)
    scenario = make_scenario("straight", robot, ["tiles"], 4.0)
    with pytest.raises(ConfigError, match=f"cannot be integrated in steps of 0.001 s: .* {why}") as refused:
        simulate(robot, scenario, {"tiles": load_soil("tiles")}, 0, conditions=Conditions(**conditions))
    assert "\n" not in str(refused.value)
