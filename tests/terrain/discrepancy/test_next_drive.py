"""The suggested drive separates the effects that it names, when it is driven."""

import re
from dataclasses import replace

import numpy as np
import pytest

from terrain.discrepancy.evidence import Evidence, evidence_at
from terrain.discrepancy.next_drive import next_drive
from terrain.discrepancy.residuals import low_pass_of
from terrain.discrepancy.signals import signals_of
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.verdict import Limit, NextDrive
from terrain.records import RunLog
from terrain.robots import load_robot
from terrain.simulation.planar.noise import load_noise, load_scatter
from terrain.simulation.planar.run import Hills, simulate_planar
from terrain.simulation.scenario import make_scenario

SCATTER = load_scatter()._asdict()
HUSKY = Simulation(load_robot("husky"), scatter=SCATTER)
AGRIMARO = Simulation(
    load_robot("agrimaro"), scatter={k: v for k, v in SCATTER.items() if k != "effective_track_ratio"}
)


def drive(simulation: Simulation, name: str, grade_deg: float = 0.0, seed: int = 0) -> RunLog:
    twist = make_scenario(name, simulation.robot, "grass", speed_mps=0.6, seed=seed).twist
    hills = Hills((np.tan(np.radians(grade_deg)), 0.0))
    return simulate_planar(simulation.robot, twist, seed, hills=hills, noise=load_noise(), run_id=f"{seed}")


def information_of(simulation: Simulation, runs: list[RunLog], names: list[str]) -> Evidence:
    signals = [signals_of(run, simulation.robot) for run in runs]
    return evidence_at(signals, simulation, simulation.vector, names, low_pass_of(signals))


def collinearity(info: Evidence, names: list[str]) -> float:
    """Index of two parameters of one number each, by its definition."""
    at = info.places(names)
    a = info.a[:, at][:, :, at].sum(axis=0)
    return float(1 / np.sqrt(1 - abs(a[0, 1]) / np.sqrt(a[0, 0] * a[1, 1])))


@pytest.mark.parametrize(
    ("simulation", "group", "names"),
    [
        (HUSKY, ("rolling_resistance", "viscous_drag"), ["rolling_resistance_ratio", "viscous_drag_nspm"]),
        (HUSKY, ("force_slip", "shear_slip"), ["force_slip_ratio", "shear_slip_ratio"]),
        (AGRIMARO, ("steering_offset_1", "gyro_bias"), ["steering_offset_1_rad", "gyro_bias_radps"]),
    ],
)
def test_the_suggested_drive_has_the_stated_collinearity_index(simulation, group, names):
    before = information_of(
        simulation, [drive(simulation, "straight", seed=seed) for seed in range(3)], names
    )
    suggested = next_drive(simulation, [group], (), before)
    assert suggested is not None
    index = re.search(r"falls from (over )?([\d.]+) to ([\d.]+)$", suggested.reason)
    assert index is not None
    over, was, comes = index[1], float(index[2]), float(index[3])
    now = collinearity(before, names)
    assert now >= was if over else was == pytest.approx(now, rel=0.05)
    assert comes < 0.5 * was
    driven = information_of(
        simulation, [drive(simulation, suggested.scenario, suggested.grade_deg, seed=9)], names
    )
    assert collinearity(driven, names) < max(1.5 * comes, 0.5 * was)


def test_twins_need_a_sensor_and_the_reason_names_it():
    runs = [drive(HUSKY, "complex", seed=seed) for seed in range(3)]
    blind = [replace(run, streams={k: s for k, s in run.streams.items() if k != "odometry"}) for run in runs]
    names = ["gyro_scale_ratio", "effective_track_ratio"]
    suggested = next_drive(
        replace(HUSKY, scatter={}),
        [("effective_track", "gyro_scale")],
        (),
        information_of(replace(HUSKY, scatter={}), blind, names),
    )
    assert suggested is not None
    assert "one without heading_rate_radps" in suggested.reason


def test_an_effect_that_was_not_excited_gets_a_drive_with_its_limit():
    names = ["side_hill_slip_ratio", "camera_yaw_rad"]
    before = information_of(AGRIMARO, [drive(AGRIMARO, "straight", seed=seed) for seed in range(3)], names)
    missed = [Limit("side_hill_slip_ratio", np.inf, "ratio", "both signs of roll")]
    suggested = next_drive(AGRIMARO, (), missed, before)
    assert suggested is not None
    assert suggested.grade_deg > 0  # there is no roll on the level
    limit = re.search(r"from infinite to ([\d.]+) ratio", suggested.reason)
    assert limit is not None
    info = information_of(AGRIMARO, [drive(AGRIMARO, suggested.scenario, suggested.grade_deg)], names)
    at = info.places(names[:1])[0]
    assert 5.48 / np.sqrt(info.a[0, at, at]) == pytest.approx(float(limit[1]), rel=0.6)


def test_no_drive_is_suggested_without_need_or_without_effect():
    assert next_drive(HUSKY, (), ()) is None
    bare = replace(HUSKY, robot=HUSKY.robot.without("motors"))
    assert next_drive(bare, [("wheel_radius", "force_slip")], ()) is None
    typical = next_drive(AGRIMARO, [("steering_backlash", "steering_delay")], ())
    assert isinstance(typical, NextDrive)
    assert "would be" in typical.reason
