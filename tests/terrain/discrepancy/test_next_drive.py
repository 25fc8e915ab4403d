"""The suggested drive separates the effects that it names, when it is driven."""

import re
from io import StringIO

import numpy as np
import pytest
from studies.blind_trials.trial import simulation_of

from terrain.discrepancy import next_drive as next_drive_module
from terrain.discrepancy.evidence import evidence_at
from terrain.discrepancy.next_drive import commands_of, next_command, next_drive
from terrain.discrepancy.runs import low_pass_of, signals_of
from terrain.discrepancy.verdict import Limit, NextDrive
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, spread_numbers
from terrain.simulation.run import simulate
from terrain.simulation.scenario import Conditions, from_commands, make_scenario

HUSKY, AGRIMARO = (simulation_of(load_robot(name)) for name in ("husky", "agrimaro"))


def drives(simulation, drive, seeds=range(3)):
    """Return runs of a scenario by name, or of a drive that was suggested."""
    robot, by_name = simulation.robot, isinstance(drive, str)
    hills = Conditions(grade_ratio=(0.0 if by_name else np.tan(np.radians(drive.grade_deg)), 0.0))
    twists = (
        [make_scenario(drive, robot, "grass", speed_mps=0.6, seed=seed).twist for seed in seeds]
        if by_name
        else []
    )
    twists = twists or [scenario_of(robot, drive).twist for _ in seeds]
    return [
        simulate(
            robot, twist, Ground(), seed, noise=spread_numbers("noise"), run_id=f"{seed}", conditions=hills
        )
        for seed, twist in zip(seeds, twists, strict=True)
    ]


def scenario_of(robot, drive):
    commands = np.genfromtxt(StringIO(commands_of(drive)), delimiter=",", skip_header=1)
    return from_commands("next", robot, "grass", commands)


def evidence_of(simulation, runs, names):
    signals = [signals_of(run, simulation.robot) for run in runs]
    return evidence_at(signals, simulation, simulation.vector, names, low_pass_of(signals))


def collinearity(info, names):
    """Index of two parameters of one number each, by its definition."""
    a, _ = info.total(names)
    return float(1 / np.sqrt(1 - abs(a[0, 1]) / np.sqrt(a[0, 0] * a[1, 1])))


@pytest.mark.parametrize(
    ("simulation", "group", "names"),
    [
        (HUSKY, ("rolling_resistance", "viscous_drag"), ["rolling_resistance_ratio", "viscous_drag_nspm"]),
        (AGRIMARO, ("steering_offset_1", "gyro_bias"), ["steering_offset_1_rad", "gyro_bias_radps"]),
    ],
)
def test_the_suggested_drive_has_the_stated_collinearity_index(simulation, group, names):
    before = evidence_of(simulation, drives(simulation, "straight"), names)
    suggested = next_drive(simulation, [group], (), before)
    index = re.search(r"falls from (over )?([\d.]+) to ([\d.]+)$", suggested.reason)
    over, was, comes = index[1], float(index[2]), float(index[3])
    now = collinearity(before, names)
    assert now >= was if over else was == pytest.approx(now, rel=0.05)
    assert comes < 0.5 * was
    driven = drives(simulation, suggested, seeds=[9])
    assert collinearity(evidence_of(simulation, driven, names), names) < max(1.5 * comes, 0.5 * was)


def test_an_effect_that_was_not_excited_gets_a_drive_with_its_limit():
    names = ["side_hill_slip_ratio", "camera_yaw_rad"]
    missed = [Limit("side_hill_slip_ratio", np.inf, "ratio", "both signs of roll")]
    suggested = next_drive(AGRIMARO, (), missed, evidence_of(AGRIMARO, drives(AGRIMARO, "straight"), names))
    assert suggested.grade_deg > 0  # there is no roll on the level
    limit = float(re.search(r"side hill slip from ([\d.]+) up", suggested.reason)[1])
    driven = drives(AGRIMARO, suggested, seeds=[0])
    a, _ = evidence_of(AGRIMARO, driven, names).total(names[:1])
    assert 5.48 / np.sqrt(a[0, 0]) == pytest.approx(limit, rel=0.6)


def test_no_drive_is_suggested_without_need():
    info = evidence_of(
        HUSKY, drives(HUSKY, "straight", seeds=[0]), ["wheel_radius_ratio", "force_slip_ratio"]
    )
    assert next_drive(HUSKY, (), (), info) is None


@pytest.mark.parametrize("simulation", [HUSKY, AGRIMARO])
def test_a_drive_stays_within_the_robot_the_field_and_what_was_driven(simulation):
    robot, names = simulation.robot, ["rolling_resistance_ratio", "viscous_drag_nspm"]
    info = evidence_of(simulation, drives(simulation, "straight"), names)
    suggested = next_drive(simulation, [("rolling_resistance", "viscous_drag")], (), info)
    twist = scenario_of(robot, suggested).twist
    assert len(twist) / 50 == pytest.approx(suggested.duration_s, abs=0.03)
    assert not twist[[0, -1]].any()
    assert np.hypot(*twist.T[:2]).max() <= 0.7  # the runs had 0.6 m/s
    assert twist[:, 1].any() <= robot.sideways
    yaw = np.cumsum(twist[:, 2]) / 50
    x_m = np.cumsum(np.cos(yaw) * twist[:, 0] - np.sin(yaw) * twist[:, 1]) / 50
    assert np.ptp(x_m) == pytest.approx(suggested.length_m, rel=0.05)
    assert max(suggested.length_m, suggested.width_m) <= 12.0


def test_it_is_a_command_of_the_described_robot():
    drive = NextDrive(((0.5, 0.0, 0.0, 2.0, 1.0),), 6.0, "it parts them", 3.0, 1.2, 0.0)
    assert next_command(drive, "my robot.yaml", HUSKY.robot, ()) == (
        "terrain simulate --robot 'my robot.yaml' --terrain grass --scenario next_drive.csv --grade 6 --runs 8 "
        "--out next_drive"
    )
    assert next_command(None, "husky", HUSKY.robot, ()) is None


def test_a_drive_that_is_improved_leg_by_leg_stays_in_its_room(monkeypatch):
    monkeypatch.setattr(next_drive_module, "ROOM_M", 4.5)
    monkeypatch.setattr(next_drive_module, "ROOM_S", 0.0)
    info = evidence_of(HUSKY, drives(HUSKY, "straight"), ["wheel_radius_ratio"])
    # the farther a drive goes in one direction, the more it shows of a radius
    missed = [Limit("wheel_radius_ratio", np.inf, "ratio", "any speed")]
    suggested = next_drive(HUSKY, (), missed, info)
    assert max(suggested.length_m, suggested.width_m) <= 4.5
