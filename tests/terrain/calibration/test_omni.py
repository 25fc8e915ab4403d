import math
from dataclasses import replace

import numpy as np
import pytest

from terrain.calibration.omni import COM_X, COM_Y, FRICTION, RADIUS, identify_omni, motor_friction
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs.robotino import find_runs
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, spread_numbers
from terrain.simulation.run import simulate

ROBOT = load_robot("robotino")
NM_PER_A = 0.0514 * 16 * 0.75
BODY = replace(ROBOT.body, com_x_m=0.02, com_y_m=-0.015)
HIDDEN = ROBOT.with_parts(body=BODY)


def alone(rng, levels=(20.0, 60.0, 120.0, -90.0), least_a=(0.18, 0.15, 0.17), slope=3e-4, run_id="motors"):
    """A run of motors that turn nothing but the wheels, as they are tried on a bench."""
    rate = np.repeat(levels, 150)[:, None] + rng.normal(0.0, 1.0, (150 * len(levels), 3))
    current = np.array(least_a) + slope * np.abs(rate) + rng.normal(0.0, 0.02, rate.shape)
    channels = [f"motor_{i}_radps" for i in (1, 2, 3)] + [f"current_{i}_a" for i in (1, 2, 3)]
    time_s = 0.031 * np.arange(len(rate))
    return with_wheel_speeds(
        RunLog(run_id, "robotino", {"wheels": Stream(time_s, np.hstack([rate, current]), channels)}), ROBOT
    )


def drives(n=18, ratio=0.5, terrain="carpet"):
    runs = []
    for i in range(n):
        angle, twist = 2 * np.pi * i / n, np.zeros((201, 3))
        twist[25:] = 0.2 * np.cos(angle), 0.2 * np.sin(angle), 0.0
        ground = Ground(slip_ratio=1.5, rolling_ratio=0.0, roller_ratio=ratio / 1.5)
        options = {"effects": {"wheel_radius_ratio": -0.06}, "noise": spread_numbers("noise")}
        run = simulate(HIDDEN, twist, ground, i, run_id=f"{terrain}_{i}", terrain=terrain, **options)
        runs.append(with_wheel_speeds(run, ROBOT))
    return runs


@pytest.fixture(scope="module")
def runs():
    rng = np.random.default_rng(0)
    return [*drives(), *drives(12, 0.02, "cork"), alone(rng), alone(rng, run_id="motors_2")]


@pytest.fixture(scope="module")
def found(runs):
    return {finding.parameter: finding for finding in identify_omni(runs, ROBOT)}


def test_hidden_load_radius_and_friction_come_back_within_their_intervals(found):
    friction = np.mean([0.18, 0.15, 0.17]) * NM_PER_A
    truth = {COM_X: 0.02, COM_Y: -0.015, RADIUS: 0.94 * 0.04, FRICTION: friction}
    margin = {COM_X: 0.001, COM_Y: 0.001, RADIUS: 0.0002, FRICTION: 0.0}
    for name, value in truth.items():
        finding = found[name]
        assert finding.low - margin[name] < value < finding.high + margin[name], name
        assert finding.high - finding.low < {FRICTION: 0.06}.get(name, 0.01), name
    assert found[FRICTION].runs == ("motors", "motors_2")
    assert "0.30 mA more per rad/s" in found[FRICTION].note


def test_one_surface_does_not_part_radius_and_rollers_and_its_interval_says_so(runs, found):
    carpet = [run for run in runs if run.terrains == ("carpet",)]
    alone_on_carpet = next(each for each in identify_omni(carpet, ROBOT) if each.parameter == RADIUS)
    assert alone_on_carpet.low < 0.94 * 0.04 < alone_on_carpet.high
    assert alone_on_carpet.high - alone_on_carpet.low > 3.0 * (found[RADIUS].high - found[RADIUS].low)


def test_runs_with_another_load_say_nothing_of_the_robot_as_described(runs):
    loaded = [replace(run, session="weights_carpet") for run in runs if run.terrains]
    for finding in identify_omni(loaded, ROBOT):
        assert math.isnan(finding.value)
        assert finding.note


def test_a_drive_at_one_speed_is_not_taken_for_motors_alone():
    rng = np.random.default_rng(1)
    one = alone(rng, levels=(60.0, 60.0), least_a=(1.0, 1.0, 1.0))
    finding = motor_friction([one], ROBOT)
    assert not finding.determined
    assert "several speeds" in finding.note
    standing = alone(rng, levels=(0.0, 0.0))
    assert not motor_friction([standing], ROBOT).determined
    broken = replace(one, streams={"wheels": Stream(np.arange(3.0), np.zeros((3, 1)), ("motor_1_radps",))})
    assert not motor_friction([broken], ROBOT).determined


def test_friction_of_the_measured_motors_is_near_the_described_one(measured):
    runs = [read() for read in find_runs(measured("robotino") / "dc_motor")]
    finding = motor_friction(runs, ROBOT)
    assert finding.determined
    assert finding.low < ROBOT.motors.friction_nm < finding.high
