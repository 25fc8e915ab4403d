from dataclasses import replace

import numpy as np
import pytest

from terrain.errors import DataError
from terrain.kinematics.wheels import rolling_matrix
from terrain.slip_learning.measured import measured_slip
from terrain.slip_learning.rollers import distance_bound, roller_findings, steady_twist, surface_of_windows

LOADS = {"": np.array([0.25, 0.45, 0.30]), "loaded": np.array([0.40, 0.35, 0.25])}
RATIO = {"cork": 0.05, "moss": 0.6}
KAPPA = 0.06


def place_of(robot):
    return robot.wheel_positions_m, robot.wheel_directions_rad


def slips_of(make_omni_run, robot, rng, surface, group, n=24):
    """Return measured runs of a robot that moves by the law, each at one speed and direction."""
    found = []
    for i in range(n):
        direction = 2 * np.pi * i / n
        desired = 0.1 * (1 + i % 3) * np.array([[np.cos(direction), np.sin(direction), 0.0]])
        wheels = desired @ rolling_matrix(*place_of(robot)).T
        twist = steady_twist(wheels, *place_of(robot), LOADS[group], RATIO[surface], KAPPA)[0]
        twist[:2] += rng.normal(0.0, 0.003, 2) * np.linalg.norm(desired)
        run = make_omni_run(rng, twist=tuple(twist), slip=0.0, start_s=-1.0, length_s=6.0)
        values = run.streams["wheels"].values.copy()
        names = [run.streams["wheels"].channels.index(f"speed_{w}_mps") for w in robot.wheels]
        values[:, names] = wheels
        stream = replace(run.streams["wheels"], values=values)
        found.append(measured_slip(replace(run, streams={**run.streams, "wheels": stream}), robot))
    return found


@pytest.fixture(scope="module")
def found(make_omni_run, robotino):
    rng = np.random.default_rng(0)
    parts = [("cork", ""), ("moss", ""), ("moss", "loaded")]
    runs = [slips_of(make_omni_run, robotino, rng, *part) for part in parts]
    groups = ["cork"] * 24 + ["moss"] * 24 + ["loaded"] * 24
    return roller_findings([run for part in runs for run in part], groups, robotino, ["cork", "moss"])


def test_hidden_rollers_loads_and_scale_come_back_within_their_intervals(found):
    for name, ratio in RATIO.items():
        low, high = found.roller_interval[name]
        assert low - 0.01 < ratio < high + 0.01
        assert high - low < 0.1
    for load, (low, high) in zip(LOADS[""], found.load_interval, strict=True):
        assert low - 0.005 < load < high + 0.005
    assert found.scale_interval[0] - 0.003 < KAPPA < found.scale_interval[1] + 0.003
    assert found.held_out_rms["moss"] < 0.2 * found.plain_rms["moss"]


def test_a_load_that_was_put_on_and_its_surface_are_named(found):
    assert found.other_surface == {"loaded": "moss"}
    np.testing.assert_allclose(found.other_loads["loaded"], LOADS["loaded"], atol=0.02)
    before, after = found.other_rms["loaded"]
    assert after < 0.5 * before


def test_rollers_name_the_surface_of_windows(make_omni_run, robotino, found):
    rng = np.random.default_rng(1)
    for surface in RATIO:
        runs = slips_of(make_omni_run, robotino, rng, surface, "", n=6)
        named = [name for run in runs for name in surface_of_windows(run, found, robotino)]
        assert {surface} <= set(named) <= {surface, ""}
        steady = sum(int((run.steady & np.isfinite(run.body_slip)).sum()) for run in runs)
        assert sum(name != "" for name in named) == steady


def test_too_few_runs_are_refused(make_omni_run, robotino):
    runs = [measured_slip(make_omni_run(), robotino)] * 4
    with pytest.raises(DataError, match="surface 'cork' has 4 runs in steady motion; 10 are needed"):
        roller_findings(runs, ["cork"] * 4, robotino, ["cork"])
    with pytest.raises(DataError, match="no surface is named"):
        roller_findings(runs, ["cork"] * 4, robotino, [])


def turning(make_omni_run, robot, rng, n, seen_yaw):
    """Return measured runs ahead with small turns of the wheels, as ``seen_yaw(pose)`` has the headings."""
    runs = []
    for _ in range(n):
        run = make_omni_run(rng, twist=(0.1, 0.0, rng.normal(0.0, 0.05)), slip=0.0, start_s=-1.0)
        pose = run.streams["pose"]
        seen = replace(pose, values=np.column_stack([pose.values[:, :2], seen_yaw(pose)]))
        runs.append(measured_slip(replace(run, streams={**run.streams, "pose": seen}), robot))
    return runs


@pytest.mark.parametrize("distance_m", [0.115, 0.135])
def test_a_hidden_distance_of_the_wheels_comes_back_by_small_turns(make_omni_run, robotino, distance_m):
    rng = np.random.default_rng(3)
    runs = turning(make_omni_run, robotino, rng, 20, lambda pose: pose.values[:, 2] * 0.125 / distance_m)
    found = distance_bound(runs, robotino, rng)
    assert found.interval_m[0] - 0.001 < distance_m < found.interval_m[1] + 0.001
    assert found.correlation > 0.95


def test_turns_that_do_not_follow_the_wheels_say_nothing_of_their_distance(make_omni_run, robotino):
    rng = np.random.default_rng(4)
    runs = turning(make_omni_run, robotino, rng, 8, lambda pose: 0.4 + rng.normal(0.0, 0.05) * pose.time_s)
    assert distance_bound(runs, robotino, rng) is None
    assert distance_bound(runs[:2], robotino, rng) is None
