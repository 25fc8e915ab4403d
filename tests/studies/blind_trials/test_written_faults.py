"""Faults written into logs: each is in the log, on the robots that show it, and is known by its sentence."""

import math

import numpy as np
import pytest

from studies.blind_trials.drives import rich_drives
from studies.blind_trials.hidden import FAULTS, Statement, fault_named, faults_of, hidden_runs, with_fault
from terrain.robots import load_robot

STATEMENTS = {
    "gyro_sign": Statement("sign", "gyro", "the sign of the gyro is turned: the heading rate does not agree"),
    "gyro_deg": Statement(
        "unit", "gyro", "the gyro is in deg/s instead of rad/s, the wheel speeds are right"
    ),
    "wheels_kmh": Statement("unit", "wheel speeds", "the wheel speeds are in km/h instead of m/s"),
    "camera_kmh": Statement("unit", "speed over ground", "it is in km/h, 3.6 times what the wheels predict"),
    "wheels_rpm": Statement("unit", "wheel speeds", "the wheel speeds are in rpm instead of rad/s"),
    "swapped_currents": Statement("swapped", "currents", "the currents of left and right are exchanged"),
    "swapped_wheels": Statement(
        "swapped", "wheel speeds", "left and right are exchanged; the currents are not"
    ),
}


@pytest.fixture(scope="module", params=["husky", "agrimaro"])
def plain(request):
    robot = load_robot(request.param)
    drives = rich_drives(np.random.default_rng(1), 1, 20.0)
    return robot, hidden_runs(robot, drives, np.random.SeedSequence(2), {})


def test_a_fault_changes_its_channels_and_no_others(plain):
    robot, runs = plain
    (run,) = runs
    for fault in faults_of(robot.drive):
        (broken,) = with_fault(runs, fault, robot)
        changed = {
            (name, channel)
            for name, stream in run.streams.items()
            for channel in stream.channels
            if not np.array_equal(stream.channel(channel), broken.streams[name].channel(channel))
        }
        assert changed, fault.name
        assert {name for name, _ in changed} == {fault.stream}
        assert len(changed) < sum(len(s.channels) for s in run.streams.values()) / 2


def test_signs_and_units_are_those_that_the_name_states(plain):
    robot, runs = plain
    factors = {
        "gyro_sign": -1.0,
        "gyro_deg": 180 / math.pi,
        "wheels_kmh": 3.6,
        "camera_kmh": 3.6,
        "wheels_rpm": 9.549,
    }
    channels = {"imu": "gyro_z_radps", "odometry": "speed_x_mps", "wheels": robot.rate_channels[0]}
    for fault in faults_of(robot.drive):
        if fault.name in factors:
            (broken,) = with_fault(runs, fault, robot)
            before, after = (
                r.streams[fault.stream].channel(channels[fault.stream]) for r in (runs[0], broken)
            )
            assert after == pytest.approx(before * factors[fault.name], rel=1e-4)


def test_a_swap_twice_is_none(plain):
    robot, runs = plain
    for fault in faults_of(robot.drive):
        if fault.name.startswith("swapped"):
            twice = with_fault(with_fault(runs, fault, robot), fault, robot)
            assert np.array_equal(twice[0].streams["wheels"].values, runs[0].streams["wheels"].values)


def test_a_statement_states_its_own_fault_and_no_other():
    assert set(STATEMENTS) == {fault.name for fault in FAULTS}
    for name, statement in STATEMENTS.items():
        assert [fault.name for fault in FAULTS if fault.stated_in([statement])] == [name]
    assert not any(fault.stated_in([]) for fault in FAULTS)


def test_both_wheel_columns_exchanged_is_not_one_of_them():
    both = Statement("swapped", "wheel speeds and currents", "left and right are exchanged")
    assert not fault_named("swapped_wheels").stated_in([both])
