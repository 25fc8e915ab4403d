"""Omni robots in the planar plant: the balance of forces, its differential equation, and measured slip."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from terrain.effects import vector_of
from terrain.errors import ConfigError
from terrain.extension import apply_homes
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.kinematics.wheels import rolling_matrix
from terrain.robots import load_robot
from terrain.simulation.plants.planar import (
    ROLLING_MPS,
    SUBSTEPS,
    TURNING_MPS,
    Ground,
    currents_of,
    make_planar,
    move,
    spread_numbers,
)
from terrain.simulation.run import simulate
from terrain.slip_learning.measured import measured_slip
from terrain.slip_learning.rollers import steady_twist

ROBOT = load_robot("robotino")
PLACE = ROBOT.wheel_positions_m, ROBOT.wheel_directions_rad
SOFT = 1.5
CARPET = Ground(slip_ratio=SOFT, rolling_ratio=0.0, roller_ratio=0.7 / SOFT)
NONE = vector_of({})
DT = 0.01


def centred(robot):
    return robot.with_parts(body=replace(robot.body, com_x_m=0.0, com_y_m=0.0))


def moved(robot, ground, wheels, p=NONE):
    level = np.zeros(len(wheels))
    return move(make_planar(robot, ground), p, DT, wheels, np.zeros((len(wheels), 3)), level, level)


def twists(truth):
    return np.column_stack([truth[name] for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")])


def numbers_of(robot, ground):
    """Return the plant's numbers of omni wheels, and those of every drive."""
    params = make_planar(robot, ground).params[0]
    return params, params["body"]


def wheels_for(twist, n=300):
    return np.tile(np.array(twist) @ rolling_matrix(*PLACE).T, (n, 1))


def heading_to(direction_rad, speed_mps=0.2):
    return speed_mps * np.cos(direction_rad), speed_mps * np.sin(direction_rad), 0.0


@pytest.mark.parametrize("ratio", [0.0, 0.25, 0.8])
@pytest.mark.parametrize("direction_rad", [0.0, 0.7, 2.9, 4.4])
def test_steady_motion_is_that_of_the_balance_of_forces(ratio, direction_rad):
    wheels = wheels_for(heading_to(direction_rad))
    ground = CARPET._replace(roller_ratio=ratio / SOFT)
    load = numbers_of(ROBOT, ground)[0]["wheel_load_ratio"]
    assert load.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(load @ PLACE[0], [ROBOT.body.com_x_m, ROBOT.body.com_y_m], atol=1e-12)
    expected = steady_twist(wheels[-1:], *PLACE, load, ratio)[0]
    found = twists(moved(ROBOT, ground, wheels))[-1]
    # rollers turn the robot, which takes a force to the inside, and slip with it
    inside = 2.0 * CARPET.slip_ratio * abs(expected[2]) * np.hypot(*expected[:2]) / 9.8
    np.testing.assert_allclose(found[:2], expected[:2], atol=1e-4 + 0.2 * inside)
    assert found[2] == pytest.approx(expected[2], abs=1e-4 + inside / ROBOT.wheel_distance_m)


def starting():
    ramp = np.minimum(np.arange(60) / 20.0, 1.0)[:, None]
    return ramp * np.array([0.15, 0.1, 0.6]) @ rolling_matrix(*PLACE).T


def test_a_start_is_that_of_the_differential_equation():
    """The other route: an integrator that chooses its own steps, and the module's equation."""
    ground, wheels = CARPET._replace(rolling_ratio=0.02), starting()
    rollers, body = numbers_of(ROBOT, ground)
    along, across, load = rollers["along"], rollers["across"], rollers["wheel_load_ratio"][:, None]
    mass, time_s = body["mass_kg"], DT * np.arange(len(wheels))
    weight = mass * 9.80665

    def rate(t, twist):
        u = np.array([np.interp(t, time_s, column) for column in wheels.T])
        v = along @ twist
        speed = np.sqrt(max((u**2).mean(), (v**2).mean()) + ROLLING_MPS**2)
        pull = weight / SOFT / speed * (u - v) - 0.02 * weight * v / np.hypot(v, ROLLING_MPS)
        resists = rollers["roller_ratio"] * weight / speed * (across @ twist)
        force = pull[:, None] * along - resists[:, None] * across
        turning = np.array([twist[2] * twist[1], -twist[2] * twist[0], 0.0])
        return (load * force).sum(axis=0) / [mass, mass, body["yaw_inertia_kgm2"]] + turning

    twist = solve_ivp(rate, (0.0, time_s[-1]), np.zeros(3), "BDF", time_s, rtol=1e-7, atol=1e-9).y
    com = body["com_x_m"], body["com_y_m"]
    expected = [twist[0] + twist[2] * com[1], twist[1] - twist[2] * com[0], twist[2]]
    found = twists(moved(ROBOT, ground, wheels))
    step_s = DT / SUBSTEPS  # implicit steps are late by up to one
    fastest = np.abs(np.gradient(expected, DT, axis=1)).max(axis=1)
    assert (np.abs(found - np.transpose(expected)).max(axis=0) < 1.2 * step_s * fastest).all()


def test_currents_are_those_of_friction_where_nothing_resists_and_grow_with_the_rollers():
    planar = make_planar(centred(ROBOT), CARPET._replace(roller_ratio=0.0))
    wheels = wheels_for((0.3, 0.1, 0.0))
    free = moved(centred(ROBOT), CARPET._replace(roller_ratio=0.0), wheels)
    direction = wheels[-1] / np.hypot(wheels[-1], TURNING_MPS)
    motors = ROBOT.motors
    per_a = motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio
    each = currents_of(planar.params, NONE, DT, wheels, free)[-1]
    np.testing.assert_allclose(each, motors.friction_nm / per_a * direction, atol=1e-9)
    held = moved(centred(ROBOT), CARPET, wheels)
    assert held["current_a"][-1] > free["current_a"][-1] + 0.5


def driven(direction_rad):
    twist = np.zeros((301, 3))
    twist[25:] = heading_to(direction_rad)
    run = simulate(ROBOT, twist, CARPET, 0, noise=spread_numbers("noise"), terrain="carpet")
    return with_wheel_speeds(run, ROBOT)


@pytest.mark.parametrize("direction_rad", [0.3, 2.0])
def test_measured_slip_of_a_simulated_run_is_its_truth(direction_rad):
    run = driven(direction_rad)
    found, truth = measured_slip(run, ROBOT), run.streams["truth"]
    steady = np.flatnonzero(found.steady & np.isfinite(found.body_slip))
    assert len(steady) >= 2
    for k in steady:
        inside = (truth.time_s >= found.start_s[k]) & (truth.time_s <= found.end_s[k])
        expected = truth.channel("slip_body_ratio")[inside].mean()
        assert found.body_slip[k] == pytest.approx(expected, abs=5 * found.body_slip_std[k] + 0.003)
        for i, wheel in enumerate(ROBOT.wheels):
            if np.isfinite(found.slip_ratio[k, i]) and abs(found.wheel_speed_mps[k, i]) > 0.1:
                slip = np.nanmean(truth.channel(f"slip_{wheel}_ratio")[inside])
                assert found.slip_ratio[k, i] == pytest.approx(slip, abs=5 * found.slip_std[k, i] + 0.01)


@pytest.mark.parametrize(
    "values",
    [
        {"load_shift_x_m": 0.02, "load_shift_y_m": -0.015},
        {"wheel_distance_ratio": 0.08},
        {"wheel_distance_ratio": -0.05, "load_shift_x_m": 0.01, "load_shift_y_m": 0.01},
        {"payload_ratio": 0.3},
        {"wheel_radius_ratio": -0.06},
    ],
)
def test_an_effect_with_a_home_moves_the_robot_as_that_description_does(values):
    """The other route: the kernel's geometry and loads against those of the description's numbers."""
    described = apply_homes(replace(ROBOT, effects=values))
    assert not described.effects
    wheels = starting() + wheels_for((0.1, -0.05, 0.3), 60)
    radius = described.wheel_radius_m / ROBOT.wheel_radius_m  # a larger wheel rolls further at one rate
    effect = moved(ROBOT, CARPET, wheels, vector_of(values))
    expected = moved(described, CARPET, radius * wheels)
    np.testing.assert_allclose(twists(effect), twists(expected), rtol=1e-9, atol=1e-12)
    # rotors: by the rate
    np.testing.assert_allclose(effect["current_a"][10:], expected["current_a"][10:], rtol=0.02)


def test_what_the_ground_adds_to_the_motion_is_in_no_current():
    """Noise of the motion has no force: measured currents are those of the motion without it."""
    quiet, rough = (
        spread_numbers("noise") | dict.fromkeys(("along_ratio", "across_ratio", "yaw_radps"), size)
        for size in (0.0, 0.05)
    )
    twist = np.zeros((301, 3))
    twist[25:] = heading_to(0.4)
    one, other = (simulate(ROBOT, twist, CARPET, 3, noise=noise).streams for noise in (quiet, rough))
    moved_by = np.abs(one["truth"].channel("speed_y_mps") - other["truth"].channel("speed_y_mps"))
    assert moved_by.max() > 0.002
    for i in (1, 2, 3):
        name = f"current_{i}_a"
        np.testing.assert_allclose(one["wheels"].channel(name), other["wheels"].channel(name), atol=1e-9)
    with pytest.raises(ConfigError, match="stick_slip_a is not simulated of robot robotino"):
        simulate(ROBOT, twist, CARPET, 3, outside={"stick_slip_a": 1.0})
